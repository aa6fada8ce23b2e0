"""Turn given columns into those of a schema, or list all their problems."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from cgemit.problems import did_you_mean
from cgemit.tables.columns import Column
from cgemit.tables.schemas import SCHEMAS

Array = np.ndarray[Any, Any]

#: Further arrays of files.
RESERVED = {"offsets": "the per-event offsets", "events": "the numbers of the events"}


_MOST_EVENTS = 2**31 - 1


class Rows(Protocol):
    """The interface of a `Table` for modules that write, convert or show it."""

    kind: str
    columns: Mapping[str, Array]
    n_events: int
    first_event: int
    offsets: np.ndarray[tuple[int], np.dtype[np.int64]]
    meta: Mapping[str, Any]

    def __len__(self) -> int: ...
    @property
    def events(self) -> Array:
        """Numbers of the events covered."""
        ...

    @property
    def cover(self) -> dict[str, Any]:
        """Number, first and, where they have gaps, all numbers of the events covered."""
        ...


def schema_of(kind: str) -> tuple[Column, ...]:
    """Return the columns of a kind of table.

    Raises
    ------
    ValueError
        If there is no such kind.
    """
    if kind not in SCHEMAS:
        hint = did_you_mean(kind, SCHEMAS, "; ")
        raise ValueError(f"kind: there is no table {kind!r}, only {', '.join(SCHEMAS)}{hint}")
    return SCHEMAS[kind]


def event_range(n_events: int, first_event: int, events: npt.ArrayLike | None) -> tuple[int, Array | None]:
    """Return the first event, and the numbers of all where they have gaps, read-only (n_events,) int64.

    Raises
    ------
    ValueError
        If there are too many events, or `events` are not `n_events` whole numbers, each above the one before.
    """
    if not 0 <= n_events <= _MOST_EVENTS:
        raise ValueError(f"n_events: is {n_events}, expected 0 to {_MOST_EVENTS}")
    if events is None or not n_events:
        return int(first_event), None
    given = np.asarray(events)
    if given.shape != (n_events,) or given.dtype.kind not in "iu":
        expected = f"({n_events},), whole numbers"
        raise ValueError(f"events: got shape {given.shape}, {given.dtype}; expected {expected}")
    if np.any(given[1:] <= given[:-1]):
        raise ValueError("events: do not increase somewhere; expected each number above the one before")
    first = int(given[0])
    if not -(2**62) <= first <= int(given[-1]) <= 2**62:
        raise ValueError(f"events: got {first} to {given[-1]}, expected numbers within 2**62")
    if int(given[-1]) - first == n_events - 1:
        return first, None
    return first, read_only(given, np.dtype(np.int64))


def check_columns(
    kind: str,
    columns: Mapping[str, npt.ArrayLike],
    n_events: int,
    first_event: int,
    events: Array | None = None,
) -> dict[str, Array]:
    """Return read-only contiguous columns in schema order with the schema's dtypes, extra columns last.

    Arrays that fit already are not copied.

    Raises
    ------
    ValueError
        Listing every missing column, wrong shape, wrong dtype, and events that are unordered or out of range.
    """
    schema = schema_of(kind)
    problems = [f"{column.name}: missing ({column.doc})" for column in schema if column.name not in columns]
    rows = len(np.atleast_1d(np.asarray(columns["event"]))) if "event" in columns else None
    problems += [
        f"{name}: is the name of {what}, not of a column" for name, what in RESERVED.items() if name in columns
    ]
    known = {column.name: column for column in schema}
    order = [name for name in known if name in columns] + [name for name in columns if name not in known]
    checked = {}
    for name in order:
        array, column = np.asarray(columns[name]), known.get(name)
        # What the core makes fits as it is, column by column and chunk by chunk: said at once.
        fits = column is not None and array.dtype == column.dtype and array.shape == (rows, *column.shape)
        problem = "" if fits else _problem(array, rows, column)
        if problem:
            problems.append(f"{name}: {problem}")
        else:
            checked[name] = read_only(array, column.dtype if column else array.dtype)
    if "event" in checked:
        problems += _event_problems(checked["event"], n_events, first_event, events)
    if problems:
        raise ValueError(f"the columns do not make a {kind} table:\n  " + "\n  ".join(problems))
    return checked


def read_only(array: Array, dtype: np.dtype[Any]) -> Array:
    """Return the array as contiguous, of the dtype, and read-only, without changing the caller's own."""
    flags = array.flags
    if array.dtype != dtype or not flags.c_contiguous:
        array = np.ascontiguousarray(array, dtype=dtype)
    elif not flags.writeable:
        return array
    view = array.view()
    view.setflags(write=False)
    return view


def _problem(array: Array, rows: int | None, column: Column | None) -> str:
    """Return the problem of one column, or an empty text."""
    shape = column.shape if column else array.shape[1:]
    if array.ndim == 0 or array.shape[1:] != shape or (rows is not None and len(array) != rows):
        expected = ", ".join(str(n) for n in ("n" if rows is None else rows, *shape))
        return f"has shape {array.shape}, expected ({expected})"
    if array.dtype.hasobject:
        return f"has dtype {array.dtype}, expected numbers"
    if column and array.size and not np.can_cast(array.dtype, column.dtype, "same_kind"):
        return f"has dtype {array.dtype}, expected {column.dtype}"
    if column and column.dtype.kind in "iu" and not np.can_cast(array.dtype, column.dtype) and array.size:
        limits = np.iinfo(column.dtype.str)
        if array.min() < limits.min or array.max() > limits.max:
            return f"has values that do not fit into {column.dtype}"
    return ""


def _event_problems(event: Array, n_events: int, first_event: int, events: Array | None) -> list[str]:
    problems = []
    if np.any(event[1:] < event[:-1]):
        problems.append("event: decreases somewhere, expected rows sorted by event")
    elif not len(event):
        return problems
    elif events is not None:
        place = np.minimum(np.searchsorted(events, event), n_events - 1)
        strange = event[events[place] != event]
        if len(strange):
            problems.append(f"event: holds {strange[0]}, which is none of the {n_events} events covered")
    elif event[0] < first_event or event[-1] >= first_event + n_events:
        problems.append(
            f"event: runs from {event[0]} to {event[-1]}, expected {first_event} to {first_event + n_events - 1}"
        )
    return problems
