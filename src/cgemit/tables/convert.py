"""Tables as pandas data frames, awkward arrays, text and HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.io.packages import package
from cgemit.tables.check import Array, Rows
from cgemit.tables.formats import plain_columns
from cgemit.tables.schemas import SCHEMAS


def data_frame(columns: Mapping[str, Sequence[Any] | npt.NDArray[Any]]) -> Any:
    """Return columns of any origin as a `pandas.DataFrame`.

    Raises
    ------
    ImportError
        If pandas is not installed; says which extra installs it.
    """
    return package("pandas").DataFrame(dict(columns))


def columns_of(source: Any) -> dict[str, Array] | None:
    """Return the columns of a table, mapping, data frame or structured array; None for anything else."""
    if isinstance(source, np.ndarray):
        return {name: source[name] for name in source.dtype.names} if source.dtype.names else None
    if hasattr(source, "column_names"):  # pyarrow
        return {str(name): np.asarray(source[name]) for name in source.column_names}
    if isinstance(source, Mapping) or hasattr(source, "columns"):
        return {str(name): np.asarray(source[name]) for name in source.keys()}  # noqa: SIM118  (tables, data frames)
    return None


def to_pandas(table: Rows) -> Any:
    """Return a data frame, one row per row; a matrix column becomes ``name_0_0, name_0_1, ...``."""
    return package("pandas").DataFrame(plain_columns(table.columns))


def to_awkward(table: Rows) -> Any:
    """Return one list of records per event; links stay as they are."""
    awkward = package("awkward")
    records = awkward.zip({name: awkward.from_numpy(column) for name, column in table.columns.items()}, depth_limit=1)
    return awkward.unflatten(records, np.diff(table.offsets))


_SHOWN_ROWS = 5


def _counts(table: Rows) -> str:
    events = f"{table.n_events} events from {table.first_event}"
    if table.cover["events"] is not None:
        events += f" to {table.events[-1]}, with gaps"
    return f"{table.kind}: {len(table)} rows, {events}"


def _units(table: Rows) -> dict[str, str]:
    known = {column.name: column.unit for column in SCHEMAS[table.kind]}
    return {name: known.get(name, "") for name in table.columns}


def text(table: Rows) -> str:
    """Return kind, sizes and columns with their units."""
    columns = ", ".join(f"{name} [{unit}]" if unit else name for name, unit in _units(table).items())
    return f"<{_counts(table)}; {columns}>"


def html(table: Rows) -> str:
    """Return the sizes and the first rows."""
    head = "".join(f"<th>{escape(name)}<br><small>{escape(unit)}</small></th>" for name, unit in _units(table).items())
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(_cell(column[row]))}</td>" for column in table.columns.values()) + "</tr>"
        for row in range(min(_SHOWN_ROWS, len(table)))
    )
    more = f"<p>... {len(table) - _SHOWN_ROWS} more rows</p>" if len(table) > _SHOWN_ROWS else ""
    return f"<p><b>{escape(_counts(table))}</b></p><table><tr>{head}</tr>{body}</table>{more}"


def _cell(value: np.generic) -> str:
    if np.ndim(value):
        return "x".join(map(str, np.shape(value))) + " matrix"
    return f"{value:.6g}" if isinstance(value, np.floating) else str(value)
