"""Mixing: each event gets the digis and wire hits of an event of other tables, at another time."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.background.random import MIXED, Floats, Random
from cgemit.detector import Detector, load
from cgemit.drift_times import XT_DISTANCE, XT_TIME
from cgemit.tables import Table
from cgemit.tables.files import INDEX
from cgemit.tables.stored import StoredTables
from cgemit.tables.table import kind_problems
from cgemit.values import is_whole, number

Rows = npt.NDArray[np.int64]

#: Read-out windows of wires and strips, ns. They begin early enough for the resolution of a drift time of 0.
BEGIN, WINDOWS = -20.0, {"wire_hits": 2000.0, "digis": 1000.0}
_STRIP = ("layer", "sheet", "view", "strip")


def mix_events(
    detector: Detector | str | Mapping[str, Any],
    digis: Table,
    wire_hits: Table,
    other: Mapping[str, Table] | str | os.PathLike[str],
    *,
    offset: tuple[float, float] = (0.0, 0.0),
    seed: int = 1,
) -> dict[str, Table]:
    """Return digis and wire hits with those of an event of other tables added to each event.

    The event is chosen at random. Its times are shifted by a number from a uniform range; hits before -20 ns or after
    the read-out window are lost, and drift distances follow from the shifted drift times. Of several hits of a cell the
    earliest is kept. Of a strip that both events fire, charges are added, and the earliest time is kept. Read-outs
    without strips are mixed on wires only.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
        Of both.
    digis, wire_hits : Table
        Of the same events.
    other : mapping of str to Table, or path
        ``digis`` and ``wire_hits``, such as `Result.tables`, or the folder of a run.
    offset : (float, float), ns
        Range of the shift, from low to high.
    seed : int
        From 0 to 2^64 - 1.

    Returns
    -------
    dict of str to Table
        ``digis`` and ``wire_hits``; rows of the other events link to no truth.

    Raises
    ------
    ValueError
        Listing what is wrong with the tables, the range and the seed.
    FileNotFoundError
        If there is no such folder.
    """
    detector = load(detector)
    problems = _argument_problems(digis, wire_hits, other, offset, seed)
    _raise(problems)
    tables = _stored(*_identity(other)) if isinstance(other, str | os.PathLike) else dict(other)
    _check(detector, tables)
    n = tables["wire_hits"].n_events
    draws = np.array([Random(seed, int(event), MIXED).uniform(2) for event in wire_hits.events]).reshape(-1, 2)
    chosen = np.minimum((draws[:, 0] * n).astype(np.int64), n - 1)
    shift = offset[0] + (offset[1] - offset[0]) * draws[:, 1]
    found = {"digis": digis, "wire_hits": _wires(wire_hits, tables["wire_hits"], chosen, shift)}
    if all(bool((one["strip"] >= 0).all()) for one in (digis, tables["digis"])):
        found["digis"] = _strips(digis, tables["digis"], chosen, shift)
    return found


def _wires(given: Table, other: Table, chosen: Rows, shift: Floats) -> Table:
    rows, event = _rows_of(given, other, chosen)
    time = other["drift_time"][rows] + shift[event]
    late = (XT_DISTANCE[-1] - XT_DISTANCE[-2]) / (XT_TIME[-1] - XT_TIME[-2])
    drift = np.interp(time, XT_TIME, XT_DISTANCE) + late * np.maximum(time - XT_TIME[-1], 0)
    # At the same time nothing changes: the measured distance is kept to the last digit.
    drift = np.where(shift[event] == 0, other["drift"][rows], drift)
    more = {name: other[name][rows] for name in given if name in other} | {
        "event": given.events[event], "drift_time": time, "drift": drift,
        "wire_truth": np.full(len(rows), -1), "side": np.zeros(len(rows)),
    }  # fmt: skip
    inside = (time >= BEGIN) & (time <= WINDOWS["wire_hits"])
    columns, added = _both(given, more, inside)
    order = np.lexsort((added, columns["drift_time"], columns["wire"], columns["layer"], columns["event"]))
    first = _firsts(columns, order, ("event", "layer", "wire"))
    return Table(given.kind, _taken(columns, order[first]), meta=given.meta, **given.cover)


def _strips(given: Table, other: Table, chosen: Rows, shift: Floats) -> Table:
    rows, event = _rows_of(given, other, chosen)
    time = other["time"][rows] + shift[event]
    more = {name: other[name][rows] for name in given if name in other} | {
        "event": given.events[event], "time": time, "truth": np.full(len(rows), -1), "n_truths": np.zeros(len(rows)),
    }  # fmt: skip
    columns, added = _both(given, more, (time >= BEGIN) & (time <= WINDOWS["digis"]))
    order = np.lexsort((added, *(columns[name] for name in reversed(("event", *_STRIP)))))
    begin = np.flatnonzero(_firsts(columns, order, ("event", *_STRIP)))
    found = _taken(columns, order[begin])
    if len(begin):
        found["charge"] = np.add.reduceat(columns["charge"][order], begin)
        found["time"] = np.minimum.reduceat(columns["time"][order], begin)
    return Table(given.kind, found, meta=given.meta, **given.cover)


def _rows_of(given: Table, other: Table, chosen: Rows) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return the rows of the chosen events, and the number of the event that each goes to."""
    first, count = other.offsets[chosen], np.diff(other.offsets)[chosen]
    event = np.repeat(np.arange(len(chosen)), count)
    within = np.arange(len(event)) - np.repeat(np.cumsum(count) - count, count)
    return np.asarray(first[event] + within, np.intp), event


def _both(given: Table, more: dict[str, Any], kept: npt.NDArray[np.bool_]) -> tuple[dict[str, Any], Any]:
    columns = {
        name: np.concatenate([given[name], np.asarray(more[name])[kept].astype(given[name].dtype)]) for name in given
    }
    return columns, np.arange(len(columns["event"])) >= len(given)


def _firsts(columns: Mapping[str, Any], order: Any, place: tuple[str, ...]) -> npt.NDArray[np.bool_]:
    """Return which of the ordered rows are the first in their place."""
    keys = np.stack([columns[name][order] for name in place])
    return np.append(np.ones(min(len(order), 1), np.bool_), np.any(keys[:, 1:] != keys[:, :-1], axis=0))


def _taken(columns: Mapping[str, Any], rows: Any) -> dict[str, Any]:
    return {name: column[rows] for name, column in columns.items()}


def _identity(folder: str | os.PathLike[str]) -> tuple[str, int]:
    """Return the path of a folder, and when its tables were written."""
    index = Path(folder) / INDEX
    if not index.is_file():
        raise FileNotFoundError(f"background.events: {folder} holds no tables ({INDEX} is missing)")
    return str(folder), index.stat().st_mtime_ns


@lru_cache(maxsize=4)
def _stored(folder: str, _: int) -> dict[str, Table]:
    """Return the tables of a folder that are mixed."""
    stored = StoredTables(folder)
    return {name: stored[name] for name in ("digis", "wire_hits") if name in stored}


def _argument_problems(digis: object, wire_hits: object, other: object, offset: object, seed: object) -> list[str]:
    """Return what is wrong with the arguments themselves."""
    problems = kind_problems(digis=digis, wire_hits=wire_hits)
    if not problems and not np.array_equal(digis.events, wire_hits.events):  # type: ignore[attr-defined]
        problems.append("digis: got other events than those of wire_hits, expected the same")
    if not isinstance(other, Mapping | str | os.PathLike):
        problems.append(f"other: got {type(other).__name__}, expected tables by their names or the folder of a run")
    ends = [number(end) for end in offset] if isinstance(offset, Sequence | np.ndarray) else []
    if isinstance(offset, str) or len(ends) != 2 or not np.isfinite(ends).all() or ends[0] > ends[1]:
        problems.append(f"offset: got {offset!r:.50}, expected a range (low, high) of two numbers, ns")
    if not is_whole(seed, 0, 2**64 - 1):
        problems.append(f"seed: got {seed!r:.50}, expected a whole number from 0 to {2**64 - 1}")
    return problems


def _check(detector: Detector, tables: Mapping[str, Table]) -> None:
    """Raise an error for tables of another kind or detector."""
    _raise([f"{name}: missing" for name in ("digis", "wire_hits") if name not in tables])
    digis, wires = tables["digis"], tables["wire_hits"]
    problems = kind_problems(digis=digis, wire_hits=wires)
    if not problems:
        cells = {one.number: one.cells for one in (detector.drift_chamber.layers if detector.drift_chamber else ())}
        most = np.zeros(max([*cells, *wires["layer"].tolist()], default=0) + 1, np.int64)
        most[list(cells)] = list(cells.values())
        strange = np.flatnonzero((wires["wire"] < 0) | (wires["wire"] >= most[wires["layer"]]))
        problems += _strange("wire_hits", strange, detector)
        strips = np.array([(one.strips_x, one.strips_v) for one in detector.cgem]).reshape(-1, 2)
        strange = np.flatnonzero(digis["layer"] >= len(strips))
        if not len(strange):
            strange = np.flatnonzero(digis["strip"] >= strips[digis["layer"], digis["view"]])
        problems += _strange("digis", strange, detector)
        if wires.n_events != digis.n_events:
            problems.append(f"digis: got {digis.n_events} events, expected {wires.n_events}, as wire_hits has")
        elif not wires.n_events:
            problems.append("wire_hits: got no events, expected at least one")
    _raise(problems)


def _raise(problems: list[str]) -> None:
    if problems:
        raise ValueError("mix_events:\n  " + "\n  ".join(problems))


def _strange(name: str, rows: npt.NDArray[np.intp], detector: Detector) -> list[str]:
    return [f"{name}: got a channel in row {rows[0]} that {detector.name} does not have"] if len(rows) else []
