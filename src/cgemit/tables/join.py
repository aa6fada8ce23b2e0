"""Join the tables of consecutive chunks of events, and cut events out of them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from cgemit.tables.check import Array
from cgemit.tables.links import lost_links, moved_links
from cgemit.tables.table import Table


def concatenate(chunks: Sequence[Mapping[str, Table]], *, gaps: bool = False) -> dict[str, Table]:
    """Join chunk results table by table, and let the link columns count rows of the joined tables.

    Parameters
    ----------
    chunks : sequence of mapping of str to Table
        The tables of each chunk, in the order of events. Every chunk holds the same tables, among them all that
        its link columns point into.
    gaps : bool
        Whether event numbers may be missing between two chunks.

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
    problems = [problem for name in names for problem in _problems(name, chunks, gaps)]
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


def append(tables: Sequence[Table]) -> Table:
    """Join the parts of one table, whose links count rows of the joined tables already.

    Parameters
    ----------
    tables : sequence of Table
        At least one, in the order of events.
    """
    return tables[0] if len(tables) == 1 else _join(list(tables), {})


def select_events(tables: Mapping[str, Table], first: int, stop: int) -> dict[str, Table]:
    """Return the rows of the events ``first ... stop - 1`` of all tables of a run; links count the selected rows.

    Parameters
    ----------
    tables : mapping of str to Table
        Of the same events, among them all that links point into.
    first, stop : int

    Returns
    -------
    dict of str to Table

    Raises
    ------
    IndexError
        If the tables do not cover the events.
    ValueError
        If a table that is linked to is missing.
    """
    problems = [
        f"{name}: links to {target}, which is missing"
        for name, table in tables.items()
        for target in lost_links(table, tables)
    ]
    if problems:
        raise ValueError("select_events:\n  " + "\n  ".join(problems))
    before = {name: np.searchsorted(table["event"], [first]) for name, table in tables.items()}
    picked = {name: table.select_events(first, stop) for name, table in tables.items()}
    return {name: table.with_columns(**_moved(table, 0, before, sign=-1)) for name, table in picked.items()}


def _problems(name: str, chunks: Sequence[Mapping[str, Table]], gaps: bool) -> list[str]:
    tables = [chunk[name] for chunk in chunks if name in chunk]
    problems = [
        f"{name}: ends before event {_stop(a)}, but the next chunk starts at {b.first_event}"
        for a, b in itertools.pairwise(tables)
        if b.first_event != _stop(a) and not ((gaps or _has_gaps(a, b)) and b.first_event > _stop(a))
    ]
    if len({(table.kind, *table.columns) for table in tables}) > 1:
        problems.append(f"{name}: kinds or columns differ between chunks")
    missing = sorted({to for table in tables for to in lost_links(table, chunks[0])}) if len(chunks) > 1 else []
    return problems + [f"{name}: links to {target}, which the chunks do not hold" for target in missing]


def _stop(table: Table) -> int:
    """Return the number behind the last event."""
    return int(table.events[-1]) + 1 if table.n_events else table.first_event


def _has_gaps(*tables: Table) -> bool:
    return any(table.cover["events"] is not None for table in tables)


def _moved(table: Table, place: int, before: Mapping[str, Array], sign: int = 1) -> dict[str, Array]:
    """Return the link columns with the rows before added; those to tables that are not kept are all -1."""
    nothing = np.zeros(place + 1, np.int64)
    return moved_links(table, lambda to: sign * before.get(to, nothing)[place])


def _join(tables: list[Table], before: Mapping[str, Array]) -> Table:
    links = [_moved(table, i, before) for i, table in enumerate(tables)]
    joined = {
        name: np.concatenate([moved.get(name, table.columns[name]) for table, moved in zip(tables, links, strict=True)])
        for name in tables[0].columns
    }
    same = {
        key: value
        for key, value in tables[0].meta.items()
        if all(key in table.meta and table.meta[key] == value for table in tables)
    }
    events = np.concatenate([table.events for table in tables])
    n_events = sum(table.n_events for table in tables)
    return Table(tables[0].kind, joined, n_events, tables[0].first_event, same, events)
