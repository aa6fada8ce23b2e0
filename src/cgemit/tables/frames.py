"""Columns of any origin as a data frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy.typing as npt


def data_frame(columns: Mapping[str, Sequence[Any] | npt.NDArray[Any]]) -> Any:
    """Return columns as a `pandas.DataFrame`.

    Raises
    ------
    ImportError
        If pandas is not installed; says which extra installs it.
    """
    try:
        import pandas
    except ImportError as error:
        raise ImportError("this needs pandas: pip install 'cgemit[io]'") from error
    return pandas.DataFrame(dict(columns))
