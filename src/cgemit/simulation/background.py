"""Background: noise, inefficiency, dead channels, wrong start times and mixed events (docs/methods/background.md)."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from cgemit.base.errors import Problems, did_you_mean
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Check, is_whole
from cgemit.base.validate import number as number_check
from cgemit.detector import Detector, load
from cgemit.detector.core import in_dead_area, strip_lists
from cgemit.detector.drift import XT_DISTANCE, XT_TIME, shifted
from cgemit.detector.parts import BackgroundLevel, CgemLayer, WireLayer, local_v, strips_of_v
from cgemit.simulation.digitize import without_dead
from cgemit.tables import Table
from cgemit.tables.store import INDEX, StoredTables
from cgemit.tables.table import kind_problems

Level = Annotated[str, Check(lambda value: 0 < len(value) <= 100, "off, or the label of a level of the detector")]
Factor = Annotated[float, Check(lambda value: 0 <= value <= 100, "a number from 0 to 100")]
Time = Annotated[float, Check(lambda value: abs(value) <= 1e6, "a time in ns, within +-1e6")]
StartTime = Annotated[float, Check(lambda value: 0 <= value <= 1e3, "a time in ns from 0 to 1000")]
Offset = tuple[Time, Time]
Share = Annotated[float, Check(lambda value: 0 <= value <= 0.6, "a share from 0 to 0.6")]


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings(SettingsData):
    """Background that is added to the digis and wire hits of every event.

    Attributes
    ----------
    level : str
        ``"off"``, or a table ``[background.LEVEL]`` of the detector. BESIII detectors have ``"bes2009"``, cells of the
        drift chamber from random triggers, and clusters of the CGEM at rates extrapolated from them, and
        ``"bes2026"``, with noise of single strips as well.
    factor : float
        All rates are multiplied by it, up to 100. Times `cells` it is a share, up to 0.6.
    cells : float
        If above 0: share of the cells of every layer that fire within the drift time, instead of the level's rates.
    clumps : bool
        Whether cells fire in clumps of neighbours, as measured, or each for itself.
    events : str
        Folder of a run whose digis and wire hits are mixed in, a random event of it in each event; empty: none.
    offset : (float, float)
        ns, range of the time of these events, uniform.
    start_time : float
        ns, standard deviation of the start time of the event: all drift times of an event are wrong by the same number.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    level: Level = "off"
    factor: Factor = 1.0
    cells: Share = 0.0
    clumps: bool = True
    events: str = ""
    offset: Offset = (0.0, 0.0)
    start_time: StartTime = 0.0

    def contradictions(self, problems: Problems) -> None:
        """Note what does not go together."""
        if isinstance(self.offset, tuple) and len(self.offset) == 2 and self.offset[0] > self.offset[1]:
            problems.note("offset", str(self.offset), "a range from low to high")
        numbers = [value for value in (self.factor, self.cells) if isinstance(value, int | float)]
        if len(numbers) == 2 and self.cells * self.factor > 0.6:
            problems.note("cells", f"{self.cells:g}, times factor {self.factor:g}", "a product up to 0.6")

    @property
    def is_off(self) -> bool:
        """Whether no cell and no strip is added; events may still be mixed in, and the start time be wrong."""
        return (self.level == "off" and self.cells == 0) or self.factor == 0


def level_of(detector: Detector, settings: BackgroundSettings) -> BackgroundLevel | None:
    """Return the level that settings ask for; None for ``"off"``.

    Parameters
    ----------
    detector : Detector
    settings : BackgroundSettings

    Raises
    ------
    ValueError
        If the detector has no such level.
    """
    if settings.level == "off":
        return None
    levels = {level.label: level for level in detector.background}
    if settings.level in levels:
        return levels[settings.level]
    known = ", ".join(["off", *levels])
    missing = "" if levels else f"; {detector.name} has no table [background.{settings.level}]"
    hint = did_you_mean(settings.level, levels, "; ")
    raise ValueError(f"background.level: got {settings.level!r}, expected one of {known}{missing}{hint}")


Floats = npt.NDArray[np.float64]

#: Purposes; part of every stream, so new ones go to the end.
CELLS, STRIPS, HOT_CELLS, HOT_STRIPS, MIXED, START_TIME, LISTED_STRIPS = 1, 2, 3, 4, 5, 6, 7
READ_CELLS, READ_STRIPS = 8, 9
#: Purposes of the choice of channels, which is the same in every event and run.
WIRE_CHANNELS, STRIP_CHANNELS = 1, 2
_CHANNELS = 0x6368616E6E656C73  # key of the channels, instead of a seed


class Random:
    """Random numbers of one event and purpose."""

    def __init__(self, seed: int, event: int, purpose: int) -> None:
        self._words = np.random.Philox(key=[seed % 2**64, event], counter=[0, 0, 0, purpose])

    def uniform(self, n: int) -> Floats:
        """Return the next n numbers from 0 to 1, excluded."""
        return np.asarray((self._words.random_raw(n) >> np.uint64(11)) * 2.0**-53)


def poisson(mean: float, uniform: float) -> int:
    """Return a Poisson number by inversion, at most 1000."""
    term = total = float(np.exp(-mean))
    n = 0
    while uniform > total and n < 1000:
        n += 1
        term *= mean / n
        total += term
    return n


def channels(purpose: int, n: int) -> Floats:
    """Return a number for each of n channels that decides whether it is hot or dead, (n,) float64 in [0, 1)."""
    return Random(_CHANNELS, 0, purpose).uniform(n)


Rows = npt.NDArray[np.int64]

STRESS_WINDOW = 400.0  # ns, of a given share of cells: all of them look like hits of tracks
#: Fired cells in a row for a given share of cells, and how often: as measured at BESIII, where most are in clumps.
STRESS_RUNS = (646, 167, 52, 39, 25, 21, 51)


def background_cells(
    detector: Detector, level: BackgroundLevel | None, settings: BackgroundSettings, seed: int, event: int
) -> dict[str, Any]:
    """Return the cells of one event that fire, as columns of wire hits; a cell may be there twice.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel or None
    settings : BackgroundSettings
    seed, event : int
    """
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    total = sum(layer.cells for layer in layers)
    random = Random(seed, event, CELLS).uniform(3 * total).reshape(3, total)
    stress = settings.cells > 0
    window = STRESS_WINDOW if stress or level is None else level.wire_window
    runs = STRESS_RUNS if stress or level is None else level.wire_runs
    fired, begin = [np.empty(0, np.int64)], 0
    for layer in layers:
        fire, length = random[:2, begin : begin + layer.cells]
        share = settings.cells * settings.factor if stress else _share(layer, level, settings.factor)
        fired.append(begin + _fired(share, fire, length, runs if settings.clumps else ()))
        begin += layer.cells
    cell = np.concatenate(fired)
    time = random[2][cell] * window
    if level is not None and not stress and level.hot_wires > 0:
        hot, hot_time = _hot(level, settings.factor, total, seed, event)
        cell, time = np.concatenate([cell, hot]), np.concatenate([time, hot_time])
    return _columns(detector, cell, time, event)


def dead_cells(detector: Detector, level: BackgroundLevel) -> npt.NDArray[np.bool_]:
    """Return which cells never fire, in the order of layers and wires, (cells,) bool.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel
    """
    total = sum(layer.cells for layer in detector.drift_chamber.layers) if detector.drift_chamber else 0
    return channels(WIRE_CHANNELS, total) < level.dead_wires


def cell_numbers(detector: Detector, layer: npt.NDArray[Any], wire: npt.NDArray[Any]) -> Rows:
    """Return the number of each cell in the order of layers and wires, (n,) int64.

    Parameters
    ----------
    detector : Detector
    layer, wire : ndarray, (n,) int
    """
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    first = np.zeros(max((one.number for one in layers), default=0) + 1, np.int64)
    first[[one.number for one in layers]] = np.cumsum([0, *(one.cells for one in layers)])[:-1]
    return np.asarray(first[layer] + wire, np.int64)


def _share(layer: WireLayer, level: BackgroundLevel | None, factor: float) -> float:
    """Return the share of the cells of a layer that fire in the window."""
    if level is None or not level.wire_rate:
        return 0.0
    area = 2 * np.pi * layer.r_mid / layer.cells * 2 * layer.half_length / 100  # cm^2
    rate = np.interp(layer.r_mid, [one.r for one in level.wire_rate], [one.rate for one in level.wire_rate])
    return 1 - float(np.exp(-float(rate) * area * level.wire_window * 1e-6 * factor))


def _fired(share: float, fire: Floats, length: Floats, how_often: tuple[float, ...]) -> Rows:
    """Return the numbers of the cells of a layer that fire; with clumps, each begins a run of neighbours."""
    cells = len(fire)
    if not how_often:
        return np.flatnonzero(fire < share)
    often = np.array(how_often, np.float64)
    runs = np.cumsum(often) / often.sum()
    mean = float(np.sum(often * np.arange(1, len(often) + 1)) / often.sum())
    # Runs overlap: a cell stays silent if no run that would reach it begins.
    first = np.flatnonzero(fire < 1 - (1 - min(share, 0.95)) ** (1 / mean))
    size = 1 + np.searchsorted(runs, length[first])
    wire = np.repeat(first, size) + np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
    return np.unique(wire % cells)


def _hot(level: BackgroundLevel, factor: float, total: int, seed: int, event: int) -> tuple[Rows, Floats]:
    """Return the hot cells that fire in one event, and their times, ns."""
    fire, time = Random(seed, event, HOT_CELLS).uniform(2 * total).reshape(2, total)
    share = 1 - np.exp(-level.hot_wire_rate * level.wire_window * 1e-6 * factor)
    hot = np.flatnonzero((channels(WIRE_CHANNELS, total) >= 1 - level.hot_wires) & (fire < share))
    return hot, time[hot] * level.wire_window


def _columns(detector: Detector, cell: Rows, time: Floats, event: int) -> dict[str, Any]:
    """Return the columns of wire hits of cells, numbered in the order of layers and wires."""
    chamber = detector.drift_chamber
    layers = chamber.layers if chamber else ()
    begin = np.cumsum([0, *(layer.cells for layer in layers)])
    row = np.searchsorted(begin, cell, side="right") - 1
    wire = cell - begin[row]

    def of_layer(values: list[Any]) -> npt.NDArray[Any]:
        return np.array(values or [0])[row]

    late = (XT_DISTANCE[-1] - XT_DISTANCE[-2]) / (XT_TIME[-1] - XT_TIME[-2])
    drift = np.interp(time, XT_TIME, XT_DISTANCE) + late * np.maximum(time - XT_TIME[-1], 0)
    sigma = of_layer([one.sigma for one in layers]) + of_layer([one.sigma_slope for one in layers]) * drift
    n = len(cell)
    return {
        "layer": of_layer([one.number for one in layers]), "wire": wire,
        "gid": of_layer(list(chamber.gid_first) if chamber else []) + wire, "drift_time": time,
        "event": np.full(n, event), "drift": drift, "sigma": np.maximum(sigma, 1e-3),
        "side": np.zeros(n), "wire_truth": np.full(n, -1),
    }  # fmt: skip


def read_out(
    detector: Detector, level: BackgroundLevel, digis: Table, wire_hits: Table, seed: int
) -> tuple[Table, Table]:
    """Return the digis and wire hits that the efficiencies of a level leave; the same tables where they are 1.

    Rows without a truth are noise or other events, whose rates are those of what is read out: they stay. Positions
    measured without strips have the efficiency of their view.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel
    digis, wire_hits : Table
    seed : int
    """
    views = np.array([level.efficiency_x, level.efficiency_v])
    if np.any(views < 1):
        within = np.arange(len(digis)) - np.repeat(digis.offsets[:-1], np.diff(digis.offsets))
        place = np.where(digis["gid"] >= 0, digis["gid"], within)
        digis = digis[(digis["truth"] < 0) | (_draws(digis, place, READ_STRIPS, seed) < views[digis["view"]])]
    if level.efficiency_wires < 1:
        cells = cell_numbers(detector, wire_hits["layer"], wire_hits["wire"])
        drawn = _draws(wire_hits, cells, READ_CELLS, seed)
        wire_hits = wire_hits[(wire_hits["wire_truth"] < 0) | (drawn < level.efficiency_wires)]
    return digis, wire_hits


def _draws(table: Table, place: npt.NDArray[np.int64], purpose: int, seed: int) -> Floats:
    """Return a number for each row that depends on its event and channel only, (n,) float64 in [0, 1)."""
    drawn = np.empty(len(table))
    for event, begin, end in zip(table.events, table.offsets[:-1], table.offsets[1:], strict=True):
        mine = place[begin:end]
        if len(mine):
            drawn[begin:end] = Random(seed, int(event), purpose).uniform(int(mine.max()) + 1)[mine]
    return drawn


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
    ends = [number_check(end) for end in offset] if isinstance(offset, Sequence | np.ndarray) else []
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


def with_start_time(wire_hits: Table, sigma: float, seed: int) -> Table:
    """Return wire hits whose drift times are shifted by a Gaussian number for each event.

    Drift distances follow from the times; their standard deviations stay, since a fit does not know of the shift.

    Parameters
    ----------
    wire_hits : Table
    sigma : float
        ns, standard deviation.
    seed : int
    """
    shift = np.repeat(start_times(wire_hits.events, sigma, seed), np.diff(wire_hits.offsets))
    time = wire_hits["drift_time"]
    return wire_hits.with_columns(drift_time=time + shift, drift=shifted(wire_hits["drift"], time, shift))


def start_times(events: npt.NDArray[np.int64], sigma: float, seed: int) -> Floats:
    """Return the start times by which drift times are wrong, (n,) float64, ns: the truth of the fitted ones.

    Parameters
    ----------
    events : ndarray, (n,) int64
        Numbers of the events.
    sigma : float
        ns, standard deviation.
    seed : int
    """
    u = np.array([Random(seed, int(event), START_TIME).uniform(2) for event in events]).reshape(-1, 2)
    normal = np.sqrt(-2 * np.log(1 - u[:, 0])) * np.cos(2 * np.pi * u[:, 1])
    return np.asarray(sigma * normal, np.float64)


def background_strips(
    detector: Detector, level: BackgroundLevel, settings: BackgroundSettings, seed: int, event: int
) -> dict[str, Any]:
    """Return the strips of one event that fire, as columns of digis; a strip may be there twice.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel
    settings : BackgroundSettings
    seed, event : int
    """
    found: dict[str, list[Any]] = {name: [] for name in ("layer", "sheet", "view", "strip", "gid")}
    random, gid = Random(seed, event, STRIPS), 0
    hot = _hot_strips(detector, level, settings, seed, event)
    for number, layer in enumerate(detector.cgem):
        for sheet, view, strip in [*_of_layer(layer, number, level, settings, random), *hot.get(number, [])]:
            on = np.unique(strip[(strip >= 0) & (strip < (layer.strips_x, layer.strips_v)[view])])
            for name, value in (("layer", number), ("sheet", sheet), ("view", view)):
                found[name].append(np.full(len(on), value))
            found["strip"].append(on)
            found["gid"].append(gid + sheet * (layer.strips_x + layer.strips_v) + view * layer.strips_x + on)
        gid += layer.sheets * (layer.strips_x + layer.strips_v)
    columns = {name: np.concatenate([*parts, np.empty(0)]).astype(np.int64) for name, parts in found.items()}
    n = len(columns["strip"])
    charge, time = random.uniform(2 * n).reshape(2, n)
    return columns | {
        "event": np.full(n, event), "position": np.full(n, np.nan),
        "charge": level.charge_low + charge * (level.charge_high - level.charge_low),
        "time": time * level.strip_window, "truth": np.full(n, -1), "n_truths": np.zeros(n),
    }  # fmt: skip


def listed_hot_strips(detector: Detector, level: BackgroundLevel | None, seed: int, event: int) -> dict[str, Any]:
    """Return the hot strips that the layers list as columns of digis of one event: all of them fire.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel or None
        Charges and read-out window; those of an empty level if None.
    seed, event : int
    """
    level = level or BackgroundLevel(label="")
    gid = strip_lists(detector).hot
    n = len(gid)
    charge, time = Random(seed, event, LISTED_STRIPS).uniform(2 * n).reshape(2, n)
    return _addresses(detector, gid) | {
        "event": np.full(n, event), "gid": gid, "position": np.full(n, np.nan),
        "charge": level.charge_low + charge * (level.charge_high - level.charge_low),
        "time": time * level.strip_window, "truth": np.full(n, -1), "n_truths": np.zeros(n),
    }  # fmt: skip


def _addresses(detector: Detector, gid: npt.NDArray[np.int32]) -> dict[str, Any]:
    """Return layer, sheet, view and strip of running numbers."""
    per_sheet = np.array([layer.strips_x + layer.strips_v for layer in detector.cgem])
    strips_x = np.array([layer.strips_x for layer in detector.cgem])
    first = np.cumsum([0, *(per_sheet * [layer.sheets for layer in detector.cgem])])
    layer = np.searchsorted(first, gid, side="right") - 1
    sheet, in_sheet = np.divmod(gid - first[layer], per_sheet[layer])
    view = (in_sheet >= strips_x[layer]).astype(np.int64)
    return {"layer": layer, "sheet": sheet, "view": view, "strip": in_sheet - view * strips_x[layer]}


def dead_strips(detector: Detector, level: BackgroundLevel) -> npt.NDArray[np.bool_]:
    """Return which strips never fire, by their `gid`, (strips,) bool.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel
    """
    return channels(STRIP_CHANNELS, _total(detector)) < level.dead_strips


def _total(detector: Detector) -> int:
    return sum(layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem)


def _hot_strips(
    detector: Detector, level: BackgroundLevel, settings: BackgroundSettings, seed: int, event: int
) -> dict[int, list[tuple[int, int, Rows]]]:
    """Return (sheet, view, strips) of the hot strips that fire in one event, by layer."""
    if level.hot_strips == 0:
        return {}
    total = _total(detector)
    share = 1 - np.exp(-level.hot_strip_rate * level.strip_window * 1e-6 * settings.factor)
    fires = Random(seed, event, HOT_STRIPS).uniform(total) < share
    fires &= channels(STRIP_CHANNELS, total) >= 1 - level.hot_strips
    found: dict[int, list[tuple[int, int, Rows]]] = {}
    begin = 0
    for number, layer in enumerate(detector.cgem):
        for sheet in range(layer.sheets):
            for view, strips in ((0, layer.strips_x), (1, layer.strips_v)):
                found.setdefault(number, []).append((sheet, view, np.flatnonzero(fires[begin : begin + strips])))
                begin += strips
    return found


def _of_layer(
    layer: CgemLayer, number: int, level: BackgroundLevel, settings: BackgroundSettings, random: Random
) -> list[tuple[int, int, Rows]]:
    """Return (sheet, view, strips) of clusters and of noise in a layer; strips may lie beyond the sheet's edges."""
    width = layer.strips_x * layer.pitch_x
    area = width * layer.sheets * 2 * layer.half_length / 100  # cm^2
    rate = level.cluster_rate * (layer.r_readout / level.cluster_radius) ** level.cluster_power * area  # kHz
    window = level.strip_window * 1e-6 * settings.factor  # 1/kHz
    parts = []
    n = poisson(rate * window, float(random.uniform(1)[0]))
    for across, along, size_x, size_v in random.uniform(4 * n).reshape(n, 4).tolist():
        sheet = int(across * layer.sheets)
        x, z = (across * layer.sheets - sheet) * width, (2 * along - 1) * layer.half_length
        if in_dead_area(layer, np.array(x), np.array(z)):
            continue
        v = float(strips_of_v(layer, local_v(layer, x, z)))
        for view, middle, size in ((0, x / layer.pitch_x, size_x), (1, v, size_v)):
            strips = 1 + int(size * level.cluster_strips)
            parts.append((sheet, view, np.arange(strips) + int(np.floor(middle - 0.5 * (strips - 1)))))
    noise = (level.noise_x, level.noise_v)
    if number == 0 and any(noise):
        for sheet in range(layer.sheets):
            for view, strips in ((0, layer.strips_x), (1, layer.strips_v)):
                parts.append((sheet, view, np.flatnonzero(random.uniform(strips) < 1 - np.exp(-noise[view] * window))))
    return parts


def add_background(
    detector: Detector, digis: Table, wire_hits: Table, settings: BackgroundSettings, seed: int
) -> dict[str, Table]:
    """Return digis and wire hits with background and other events; of several hits of a cell, the earliest is kept.

    Hot strips that the layers of the detector file list fire in every event, whatever the settings. A strip that has
    fired already stays as it is. Dead channels have no hit. Read-outs without strips get background on wires only.

    Parameters
    ----------
    detector : Detector
    digis, wire_hits : Table
        Of the same events.
    settings : BackgroundSettings
    seed : int
        Key of the random numbers. They depend on seed and event only.

    Returns
    -------
    dict of str to Table
        ``digis`` and ``wire_hits``; rows of the background link to no truth.

    Raises
    ------
    ValueError
        If the detector has no such level, or the mixed events are of another detector.
    """
    level = level_of(detector, settings)
    if settings.events:
        mixed = mix_events(detector, digis, wire_hits, settings.events, offset=settings.offset, seed=seed)
        digis, wire_hits = mixed["digis"], mixed["wire_hits"]
    if _has_strips(digis) and len(strip_lists(detector).hot):
        hot = [listed_hot_strips(detector, level, seed, int(event)) for event in digis.events]
        digis = joined(digis, hot, _STRIP, keep="given")
    if not settings.is_off:
        digis, wire_hits = _with_level(detector, level, digis, wire_hits, settings, seed)
    if settings.start_time > 0:
        wire_hits = with_start_time(wire_hits, settings.start_time, seed)
    return {"digis": digis, "wire_hits": wire_hits}


def _has_strips(digis: Table) -> bool:
    return not len(digis) or bool((digis["strip"] >= 0).all())


def _with_level(
    detector: Detector, level: BackgroundLevel | None, digis: Table, wire_hits: Table, settings: BackgroundSettings,
    seed: int,
) -> tuple[Table, Table]:  # fmt: skip
    """Return digis and wire hits with the cells and strips of a level, without dead channels."""
    has_strips = _has_strips(digis)
    if level is not None:
        digis, wire_hits = read_out(detector, level, digis, wire_hits, seed)
    cells, strips = [], []
    for event in wire_hits.events:
        cells.append(background_cells(detector, level, settings, seed, int(event)))
        if has_strips and level is not None:
            strips.append(background_strips(detector, level, settings, seed, int(event)))
    wire_hits = joined(wire_hits, cells, ("layer", "wire"), keep="earliest")
    if strips:
        digis = without_dead(detector, joined(digis, strips, _STRIP, keep="given"))
    if level is not None and level.dead_wires > 0:
        dead = dead_cells(detector, level)[cell_numbers(detector, wire_hits["layer"], wire_hits["wire"])]
        wire_hits = wire_hits[~dead]
    if level is not None and level.dead_strips > 0 and has_strips:
        digis = digis[~dead_strips(detector, level)[digis["gid"]]]
    return digis, wire_hits


def joined(table: Table, parts: list[dict[str, Any]], place: tuple[str, ...], keep: str) -> Table:
    """Return a table with more rows, ordered by event and place, one row a place.

    Parameters
    ----------
    table : Table
    parts : list of dict
        Columns of further rows.
    place : tuple of str
        Columns that tell places apart.
    keep : str
        ``"earliest"``: the row with the smallest `drift_time`; ``"given"``: the rows of `table`.
    """
    columns = {
        name: np.concatenate([table[name], *(part[name] for part in parts)]).astype(table[name].dtype) for name in table
    }
    added = np.arange(len(columns["event"])) >= len(table)
    last = columns["drift_time"] if keep == "earliest" else added
    order = np.lexsort((added, last, *(columns[name] for name in reversed(place)), columns["event"]))
    keys = np.stack([columns[name][order] for name in ("event", *place)])
    first = np.ones(len(order), np.bool_)
    first[1:] = np.any(keys[:, 1:] != keys[:, :-1], axis=0)
    # Hits of particles in one place are the digitization's own affair: only background is removed or removes.
    rows = order[first] if keep == "earliest" else order[first | ~added[order]]
    return Table(table.kind, {name: column[rows] for name, column in columns.items()}, meta=table.meta, **table.cover)
