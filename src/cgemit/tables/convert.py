"""Tables as pandas data frames and awkward arrays."""

from __future__ import annotations

import importlib
import itertools
from typing import Any

import numpy as np

from cgemit.tables.check import Rows


def _import(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"this needs {name}: pip install 'cgemit[io]'") from error


def to_pandas(table: Rows) -> Any:
    """Return a data frame, one row per row; a matrix column becomes ``name_0_0, name_0_1, ...``."""
    pandas = _import("pandas")
    plain = {}
    for name, column in table.columns.items():
        for index in itertools.product(*(range(n) for n in column.shape[1:])):
            place: Any = (slice(None), *index)
            plain["_".join([name, *map(str, index)])] = column[place]
    return pandas.DataFrame(plain)


def to_awkward(table: Rows) -> Any:
    """Return one list of records per event."""
    awkward = _import("awkward")
    records = awkward.zip({name: awkward.from_numpy(column) for name, column in table.columns.items()}, depth_limit=1)
    return awkward.unflatten(records, np.diff(table.offsets))
