"""Columns that count rows of another table: which tables they link to, and the same links with other origins."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

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


def lost_links(table: Rows, tables: Collection[str]) -> list[str]:
    """Return the tables that rows of a table link to and that are missing; links that are all -1 do not count."""
    lost = set()
    for column in SCHEMAS[table.kind]:
        names = targets(column)
        if names and any(name not in tables for name in names):
            rows, view = table.columns[column.name], table.columns.get("view", np.zeros(len(table), np.int8))
            linked_here = rows >= 0
            lost |= {
                name
                for i, name in enumerate(names)
                if name not in tables and np.any(linked_here & ((view == i) if len(names) > 1 else True))
            }
    return sorted(lost)


def without_links(table: Rows, tables: Collection[str]) -> dict[str, Array]:
    """Return the link columns that count rows of tables that are not kept, with -1 in their place."""
    found = {}
    for column in SCHEMAS[table.kind]:
        gone = [i for i, name in enumerate(targets(column)) if name not in tables]
        if gone:
            rows = table.columns[column.name]
            several = len(targets(column)) > 1
            found[column.name] = np.where(np.isin(table.columns["view"], gone), -1, rows) if several else rows * 0 - 1
    return found


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
    problems = [f"{name}: missing; {table.kind} links to it" for name in lost_links(table, tables)]
    problems += [
        f"{name}: covers other events than {table.kind}; expected the same"
        for name in sorted(names & tables.keys())
        if not np.array_equal(tables[name].events, table.events)
    ]
    if problems:
        raise ValueError("tables:\n  " + "\n  ".join(problems))
    place = np.repeat(np.arange(table.n_events), np.diff(table.offsets))  # of each row's event
    return moved_links(table, lambda name: -tables[name].offsets[place] if name in tables else np.int64(0))
