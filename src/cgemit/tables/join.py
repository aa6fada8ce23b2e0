"""Join the tables of consecutive chunks of events."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from cgemit.tables.check import Array
from cgemit.tables.columns import Column
from cgemit.tables.schemas import SCHEMAS
from cgemit.tables.table import Table


def concatenate(chunks: Sequence[Mapping[str, Table]]) -> dict[str, Table]:
    """Join chunk results table by table, and let the link columns count rows of the joined tables.

    Parameters
    ----------
    chunks : sequence of mapping of str to Table
        The tables of each chunk, in the order of events. Every chunk holds the same tables, among them all that
        its link columns point into.

    Returns
    -------
    dict of str to Table

    Raises
    ------
    ValueError
        If chunks are missing, do not follow each other, or lack a table that is linked to.
    """
    if not chunks:
        raise ValueError("chunks: expected at least one")
    names = list(chunks[0])
    problems = [problem for name in names for problem in _problems(name, chunks)]
    problems += [
        f"chunk {i}: holds {sorted(chunk)}, expected {sorted(names)}"
        for i, chunk in enumerate(chunks)
        if set(chunk) != set(names)
    ]
    if problems:
        raise ValueError("the chunks cannot be joined:\n  " + "\n  ".join(problems))
    if len(chunks) == 1:
        return dict(chunks[0])
    # Rows of each table before each chunk.
    before = {name: np.cumsum([0, *(len(chunk[name]) for chunk in chunks[:-1])], dtype=np.int64) for name in names}
    return {name: _join([chunk[name] for chunk in chunks], before) for name in names}


def _problems(name: str, chunks: Sequence[Mapping[str, Table]]) -> list[str]:
    tables = [chunk[name] for chunk in chunks if name in chunk]
    problems = [
        f"{name}: ends before event {_stop(a)}, but the next chunk starts at {b.first_event}"
        for a, b in itertools.pairwise(tables)
        if b.first_event != _stop(a) and not (_has_gaps(a, b) and b.first_event > _stop(a))
    ]
    if len({(table.kind, *table.columns) for table in tables}) > 1:
        problems.append(f"{name}: kinds or columns differ between chunks")
    linked = {target for column in SCHEMAS[tables[0].kind] for target in _targets(column)}
    missing = sorted(linked - set(chunks[0])) if len(chunks) > 1 else []
    return problems + [f"{name}: links to {target}, which the chunks do not hold" for target in missing]


def _stop(table: Table) -> int:
    """Return the number behind the last event."""
    return int(table.events[-1]) + 1 if table.n_events else table.first_event


def _has_gaps(*tables: Table) -> bool:
    return any(table.cover["events"] is not None for table in tables)


def _targets(column: Column) -> tuple[str, ...]:
    return (column.links,) if isinstance(column.links, str) else column.links or ()


def _join(tables: list[Table], before: Mapping[str, Array]) -> Table:
    links = {column.name: _targets(column) for column in SCHEMAS[tables[0].kind] if column.links}
    joined = {}
    for name in tables[0].columns:
        parts = [table.columns[name] for table in tables]
        if name in links:
            parts = [_shifted(table, name, links[name], before, i) for i, table in enumerate(tables)]
        joined[name] = np.concatenate(parts)
    same = {
        key: value
        for key, value in tables[0].meta.items()
        if all(key in table.meta and table.meta[key] == value for table in tables)
    }
    events = np.concatenate([table.events for table in tables]) if _has_gaps(*tables) else None
    n_events = sum(table.n_events for table in tables)
    return Table(tables[0].kind, joined, n_events, tables[0].first_event, same, events)


def _shifted(table: Table, name: str, targets: tuple[str, ...], before: Mapping[str, Array], chunk: int) -> Array:
    """Return the link column of one chunk, counting rows of the joined table; -1 stays -1."""
    rows: Array = table.columns[name]
    shifts = np.array([before[target][chunk] for target in targets])
    shift = shifts[table.columns["view"]] if len(targets) > 1 else shifts[0]
    return np.where(rows < 0, rows, rows + shift)
