"""Packages that only some functions need: imported when they are used."""

from __future__ import annotations

import importlib
from typing import Any


class MissingPackageError(ImportError, ValueError):
    """What was asked for needs a package that is not installed."""


def package(name: str, extra: str = "io") -> Any:
    """Return a module of another package.

    Parameters
    ----------
    name : str
        Module, such as ``"pyarrow.parquet"``.
    extra : str
        The extra of cgemit that installs the package.

    Raises
    ------
    MissingPackageError
        An ImportError and ValueError that names the extra, if the package is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        needed = name.partition(".")[0]
        raise MissingPackageError(f"this needs {needed}: pip install 'cgemit[{extra}]'") from error
