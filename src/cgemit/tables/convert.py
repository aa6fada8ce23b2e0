"""Tables as pandas data frames and awkward arrays."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from cgemit.tables.check import Array, Rows


def _import(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"this needs {name}: pip install 'cgemit[io]'") from error


def columns_of(source: Any) -> dict[str, Array] | None:
    """Return the columns of a table, mapping, data frame or structured array; None for anything else."""
    if isinstance(source, np.ndarray):
        return {name: source[name] for name in source.dtype.names} if source.dtype.names else None
    if isinstance(source, Mapping) or hasattr(source, "columns"):
        return {str(name): np.asarray(source[name]) for name in source.keys()}  # noqa: SIM118  (tables, data frames)
    return None


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
