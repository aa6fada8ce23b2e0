"""How a table prints itself."""

from __future__ import annotations

from html import escape

import numpy as np

from cgemit.tables.check import Rows
from cgemit.tables.schemas import SCHEMAS

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
