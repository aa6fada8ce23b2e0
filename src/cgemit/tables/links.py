"""Columns that count rows of another table: which tables they link to, and the same links with other origins."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from cgemit.tables.check import Array, Rows
from cgemit.tables.columns import Column
from cgemit.tables.schemas import SCHEMAS

Origins = npt.NDArray[np.int64] | np.int64


def targets(column: Column) -> tuple[str, ...]:
    """Return the tables that a column links to: none, one, or one for each view."""
    return (column.links,) if isinstance(column.links, str) else column.links or ()


def linked(kind: str) -> set[str]:
    """Return the tables that a kind of table links to."""
    return {target for column in SCHEMAS[kind] for target in targets(column)}


def moved_links(table: Rows, moved: Callable[[str], Origins]) -> dict[str, Array]:
    """Return the link columns of a table with another origin of the rows they count; -1 stays -1.

    Parameters
    ----------
    table : Table
    moved : callable
        Returns what is added to links to a table of a name: a number, or (n,) int64, one for each row.
    """
    found = {}
    for column in SCHEMAS[table.kind]:
        names = targets(column)
        if not names:
            continue
        rows: Array = table.columns[column.name]
        shift: Origins = moved(names[0])
        if len(names) > 1:
            shifts = np.stack([np.broadcast_to(moved(name), len(rows)) for name in names])
            shift = shifts[table.columns["view"], np.arange(len(rows))]
        found[column.name] = np.where(rows < 0, rows, rows + shift)
    return found


def local_links(table: Rows, tables: Mapping[str, Rows]) -> dict[str, Array]:
    """Return the link columns of a table, counting rows within the event.

    Parameters
    ----------
    table : Table
    tables : mapping of str to Table
        All tables that it links to, of the same events.

    Raises
    ------
    ValueError
        Listing every table that is missing or of other events.
    """
    names = linked(table.kind)
    problems = [f"{name}: missing; {table.kind} links to it" for name in sorted(names - tables.keys())]
    problems += [
        f"{name}: covers other events than {table.kind}; expected the same"
        for name in sorted(names & tables.keys())
        if not np.array_equal(tables[name].events, table.events)
    ]
    if problems:
        raise ValueError("tables:\n  " + "\n  ".join(problems))
    place = np.repeat(np.arange(table.n_events), np.diff(table.offsets))  # of each row's event
    return moved_links(table, lambda name: -tables[name].offsets[place])
