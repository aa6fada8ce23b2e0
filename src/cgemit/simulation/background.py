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

from cgemit import _core
from cgemit.base.arrays import Floats, Rows
from cgemit.base.errors import Problem, Problems, did_you_mean
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Check, Quantity, check_numbers, check_seed
from cgemit.base.validate import number as number_check
from cgemit.detector import Detector, load
from cgemit.detector.channels import channels_of, checked
from cgemit.detector.core import compiled, layer_table, strip_lists, wire_lists
from cgemit.detector.drift import DriftRelations, relations_of
from cgemit.detector.layers.wires import WireLayer
from cgemit.detector.parts import BackgroundLevel, cgem_numbers
from cgemit.simulation.digitize import without_dead, without_dead_wires
from cgemit.tables import Table
from cgemit.tables.check import table_problems
from cgemit.tables.store import INDEX, StoredTables
from cgemit.tables.table import merged, stacked

Level = Annotated[str, Check(lambda value: 0 < len(value) <= 100, "off, or the label of a level of the detector")]
Factor = Annotated[float, Quantity(low=0, high=100)]
Time = Annotated[float, Quantity("time", -1e6, 1e6)]
StartTime = Annotated[float, Quantity("time", 0, 1e3)]
Offset = tuple[Time, Time]
Share = Annotated[float, Quantity(low=0, high=0.6)]


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings(SettingsData):
    """Background that is added to the digis and wire hits of every event.

    Attributes
    ----------
    level : str
        ``"off"``, or a table `[background.LEVEL]` of the detector: BESIII has ``"bes2009"`` and ``"bes2026"``
        (docs/methods/background.md).
    factor : float
        Factor on all rates. Times `cells` it is at most 0.6.
    cells : float
        If above 0: share of the cells that fire within the drift time, instead of the level's rates.
    clumps : bool
        Whether cells fire in runs of neighbours, as measured.
    events : str
        Folder of a run whose events are mixed in at random; empty: none.
    offset : (float, float)
        ns, range of the time of these events, uniform.
    start_time : float
        ns, standard deviation of a common error of all drift times of an event.

    Raises
    ------
    ValueError
        Listing every invalid value.

    Examples
    --------
    >>> settings = cg.Settings(background=cg.BackgroundSettings(cells=0.05))
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5, settings=settings)
    >>> len(result.wire_hits) > 5 * len(result.wire_truths)
    True
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


Channels = npt.NDArray[np.integer[Any]]

STRESS_WINDOW = 400.0  # ns, of a given share of cells: all of them look like hits of tracks
#: Fired cells in a row for a given share of cells, and how often: as measured at BESIII, where most are in clumps.
STRESS_RUNS = (646, 167, 52, 39, 25, 21, 51)
#: Readout windows of wires and strips, ns. They begin early enough for the resolution of a drift time of 0.
BEGIN, WINDOWS = -20.0, {"wire_hits": 2000.0, "digis": 1000.0}


@checked("digis", "wire_hits")
def add_background(
    detector: Detector, digis: Table, wire_hits: Table, settings: BackgroundSettings, seed: int
) -> dict[str, Table]:
    """Return digis and wire hits with background and other events; of several hits of a cell, the earliest is kept.

    Hot strips and wires that the layers of the detector file list fire in every event, whatever the settings. A strip
    that has fired already stays as it is. Dead channels have no hit. Readouts without strips get background on wires
    only.

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
    TypeError
        If the settings are something else.
    ValueError
        If the detector has no such level, or the mixed events are of another detector.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    >>> noisy = cg.add_background(r.detector, r.digis, r.wire_hits, cg.BackgroundSettings(cells=0.05), seed=1)
    >>> len(noisy["wire_hits"]) > 5 * len(r.wire_hits)
    True
    """
    check_numbers("add_background", seed)
    level = level_of(detector, BackgroundSettings.of(settings))
    if settings.events:
        mixed = mix_events.unchecked(detector, digis, wire_hits, settings.events, offset=settings.offset, seed=seed)
        digis, wire_hits = mixed["digis"], mixed["wire_hits"]
    has_strips = bool((digis["strip"][_of_cgem(detector, digis)] >= 0).all())
    if level is not None and not settings.is_off:
        digis, wire_hits = read_out(level, digis, wire_hits, seed)
        if has_strips:
            digis = _with_strips(detector, level, settings.factor, digis, seed)
    elif has_strips and len(strip_lists(detector).hot):
        digis = _with_strips(detector, level or BackgroundLevel(label=""), 0.0, digis, seed)
    hot_wires = wire_lists(detector.drift_chamber).hot if detector.drift_chamber else ()
    if not settings.is_off or len(hot_wires):
        wire_hits = _with_cells(detector, level, settings, wire_hits, seed)
    if settings.start_time > 0:
        wire_hits = _with_start_time(relations_of(detector), wire_hits, settings.start_time, seed)
    return {"digis": digis, "wire_hits": wire_hits}


def read_out(level: BackgroundLevel, digis: Table, wire_hits: Table, seed: int) -> tuple[Table, Table]:
    """Return the digis and wire hits that the efficiencies of a level leave; the same tables where they are 1.

    Rows without a truth are noise or other events, whose rates are those of what is read out: they stay. Positions
    measured without strips have the efficiency of their view.
    """

    def drawn(table: Table, place: Channels, purpose: _core.common.Purpose) -> Floats:
        return _uniforms(seed, table["event"], purpose, place)[:, 3]

    views = np.array([level.efficiency_x, level.efficiency_v])
    if np.any(views < 1):
        within = np.arange(len(digis)) - np.repeat(digis.offsets[:-1], np.diff(digis.offsets))
        place = np.where(digis["gid"] >= 0, digis["gid"], within)
        is_read = drawn(digis, place, _core.common.Purpose.background_strip) < views[digis["view"]]
        digis = digis[(digis["truth"] < 0) | is_read]
    if level.efficiency_wires < 1:
        is_read = drawn(wire_hits, wire_hits["gid"], _core.common.Purpose.background_cell) < level.efficiency_wires
        wire_hits = wire_hits[(wire_hits["wire_truth"] < 0) | is_read]
    return digis, wire_hits


def _uniforms(
    seed: int, events: Rows, purpose: _core.common.Purpose, place: Channels | int = 0, block: int = 0
) -> npt.NDArray[np.float64]:
    """Return four numbers in (0, 1) for each event and place, (n, 4) float64."""
    no_particle = np.zeros(len(events), np.int32)
    return _core.common.uniforms(seed, events, no_particle, purpose, np.asarray(place).astype(np.uint32), block)


CELLS, STRIPS = 0, 1


def channel_kinds(gid: Channels, what: int) -> Floats:
    """Return a number for each channel that decides whether it is dead (low) or hot (high), (n,) float64 in (0, 1).

    It is the same in every event and run.

    Parameters
    ----------
    gid : ndarray, (n,) int
    what : int
        `CELLS` or `STRIPS`.
    """
    return _uniforms(0, np.zeros(len(gid), np.int64), _core.common.Purpose.channel_kind, gid, what)[:, 0]


def _probability(rate: npt.ArrayLike, window: float, factor: float) -> Floats:
    """Return the probability of one hit or more at a rate, kHz, in a window, ns."""
    return np.asarray(1 - np.exp(-np.asarray(rate, np.float64) * window * 1e-6 * factor))


def _with_cells(
    detector: Detector, level: BackgroundLevel | None, settings: BackgroundSettings, wire_hits: Table, seed: int
) -> Table:
    """Return wire hits with cells of the background and listed hot wires, without dead ones."""
    chamber = detector.drift_chamber
    layers, first = (chamber.layers, chamber.gid_first) if chamber else ((), ())
    hot, hot_fires = np.empty(0, np.int32), np.empty(0)
    listed = wire_lists(chamber).hot if chamber else hot
    if settings.is_off:
        window, runs, begins = BackgroundLevel(label="").wire_window, np.ones(1), np.zeros(len(layers))
    elif level is None or settings.cells > 0:
        window, runs = STRESS_WINDOW, np.array(STRESS_RUNS)
        begins = np.full(len(layers), settings.cells * settings.factor)
    else:
        window, runs = level.wire_window, np.array(level.wire_runs)
        begins = _shares(layers, level, settings.factor)
        gids = np.arange(first[0], first[-1] + layers[-1].cells, dtype=np.int32) if layers else hot
        hot = gids[channel_kinds(gids, CELLS) >= 1 - level.hot_wires]
        hot_fires = np.full(len(hot), _probability(level.hot_wire_rate, window, settings.factor))
    lengths = np.ones(1)
    if settings.clumps:
        lengths = np.cumsum(runs) / np.sum(runs)
        mean = np.sum(runs * np.arange(1, len(runs) + 1)) / np.sum(runs)
        # Runs overlap: a cell stays silent if no run that would reach it begins.
        begins = 1 - (1 - np.minimum(begins, 0.95)) ** (1 / mean)
    cells = _core.simulation.background_cells(
        compiled(detector), wire_hits.events, begins=begins, lengths=lengths, window=window,
        hot=np.concatenate([hot, listed]), hot_fires=np.concatenate([hot_fires, np.ones(len(listed))]), seed=seed,
    )  # fmt: skip
    drift = relations_of(detector).distance_at(cells["layer"], cells["drift_time"])
    sigma = np.zeros(len(drift))
    for layer in layers:
        mine = cells["layer"] == layer.number
        sigma[mine] = layer.error_at(drift[mine])
    n = len(drift)
    cells |= {"drift": drift, "sigma": np.maximum(sigma, 1e-3)}
    wire_hits = _earliest(wire_hits, cells | {"side": np.zeros(n), "wire_truth": np.full(n, -1)})
    wire_hits = without_dead_wires(detector, wire_hits)
    if level is not None and level.dead_wires > 0:
        wire_hits = wire_hits[channel_kinds(wire_hits["gid"], CELLS) >= level.dead_wires]
    return wire_hits


def _shares(layers: Sequence[WireLayer], level: BackgroundLevel, factor: float) -> Floats:
    """Return the share of the cells of each layer that fire in the window, (layers,) float64."""
    if not level.wire_rate:
        return np.zeros(len(layers))
    r, cells, half_length = np.array([(one.r_mid, one.cells, one.half_length) for one in layers]).reshape(-1, 3).T
    area = 2 * np.pi * r / cells * 2 * half_length / 100  # cm^2
    rate = np.interp(r, [one.r for one in level.wire_rate], [one.rate for one in level.wire_rate])
    return _probability(rate * area, level.wire_window, factor)


def _with_strips(detector: Detector, level: BackgroundLevel, factor: float, digis: Table, seed: int) -> Table:
    """Return digis with strips of the background and listed hot strips, without dead ones; CGEM layers only."""
    is_strip = _of_cgem(detector, digis)
    if not is_strip.all():  # positions have no channel
        return merged([_with_strips(detector, level, factor, digis[is_strip], seed), digis[~is_strip]])
    layers, listed = detector.cgem, strip_lists(detector).hot
    if not layers:
        return digis
    area = [layer.sheets * layer.strips_x * layer.pitch_x * 2 * layer.half_length / 100 for layer in layers]  # cm^2
    rate = (
        level.cluster_rate
        * (np.array([layer.r_readout for layer in layers]) / level.cluster_radius) ** level.cluster_power
    )
    numbers, gid_first = list(cgem_numbers(detector)), layer_table(detector.layers)["gid_first"]
    gids = np.concatenate([
        gid_first[number] + np.arange(layer.sheets * (layer.strips_x + layer.strips_v), dtype=np.int32)
        for number, layer in zip(numbers, layers, strict=True)
    ])  # fmt: skip
    clusters = np.zeros(len(detector.layers))
    clusters[numbers] = rate * area * level.strip_window * 1e-6 * factor
    single = np.zeros((len(detector.layers), 2))
    single[numbers] = _probability([level.outer_noise_x, level.outer_noise_v], level.strip_window, factor)
    single[numbers[0]] = _probability([level.noise_x, level.noise_v], level.strip_window, factor)
    hot = gids[channel_kinds(gids, STRIPS) >= 1 - level.hot_strips]
    hot_fires = np.full(len(hot), _probability(level.hot_strip_rate, level.strip_window, factor))
    strips = _core.simulation.background_strips(
        compiled(detector), digis.events, clusters=clusters, most_strips=level.cluster_strips,
        single=single.ravel(), charge=(level.charge_low, level.charge_high),
        noise_charge=(
            level.charge_low if level.noise_low is None else level.noise_low,
            level.charge_high if level.noise_high is None else level.noise_high,
        ),
        window=level.strip_window,
        hot=np.concatenate([hot, listed]), hot_fires=np.concatenate([hot_fires, np.ones(len(listed))]), seed=seed,
    )  # fmt: skip
    n = len(strips["event"])
    strips |= {"position": np.full(n, np.nan), "truth": np.full(n, -1), "n_truths": np.zeros(n)}
    columns = stacked(digis, strips)
    order, first = _core.simulation.by_channel(columns["event"], columns["gid"], np.zeros(len(digis) + n))
    # Several digis of particles in one place are the digitization's own affair: only background gives way.
    is_kept = order < len(digis)
    is_kept[first] = True
    digis = without_dead(detector, _like(digis, columns, order[is_kept]))
    if level.dead_strips > 0:
        digis = digis[channel_kinds(digis["gid"], STRIPS) >= level.dead_strips]
    return digis


def _of_cgem(detector: Detector, digis: Table) -> npt.NDArray[np.bool_]:
    """Return which digis are those of CGEM layers, (digis,) bool."""
    is_cgem = np.zeros(len(detector.layers), np.bool_)
    is_cgem[list(cgem_numbers(detector))] = True
    return np.asarray(is_cgem[digis["layer"]])


def _like(given: Table, columns: Mapping[str, Any], rows: Rows) -> Table:
    return Table(given.kind, {name: one[rows] for name, one in columns.items()}, meta=given.meta, **given.cover)


def _earliest(wire_hits: Table, more: Mapping[str, Any]) -> Table:
    """Return wire hits with further ones, of which the earliest of each cell is kept."""
    columns = stacked(wire_hits, more)
    order, first = _core.simulation.by_channel(columns["event"], columns["gid"], columns["drift_time"])
    return _like(wire_hits, columns, order[first])


def _with_start_time(relations: DriftRelations, wire_hits: Table, sigma: float, seed: int) -> Table:
    """Return wire hits whose drift times are shifted by a Gaussian number for each event.

    Drift distances follow from the times; their standard deviations stay, since a fit does not know of the shift.
    """
    shift = np.repeat(start_times(wire_hits.events, sigma, seed), np.diff(wire_hits.offsets))
    drift = relations.shifted(wire_hits, shift)
    return wire_hits.with_columns(drift_time=wire_hits["drift_time"] + shift, drift=drift)


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
    no_particle = np.zeros(len(events), np.int32)
    return np.asarray(sigma * _core.common.normals(seed, events, no_particle, _core.common.Purpose.start_time, 0)[:, 0])


@checked("digis", "wire_hits")
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
    the readout window are lost, and drift distances follow from the shifted drift times. Of several hits of a cell the
    earliest is kept. Of a strip that both events fire, charges are added, and the earliest time is kept. Readouts
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

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    >>> other = cg.run("besiii-cgem", cg.Gun("pi+", p=0.5, cos_theta=0.2), n=5, seed=2)
    >>> mixed = cg.mix_events(r.detector, r.digis, r.wire_hits, other.tables)
    >>> len(r.digis) < len(mixed["digis"])
    True
    """
    detector = load(detector)
    _argument_problems(digis, wire_hits, other, offset, seed).report("mix_events")
    tables = _stored(*_identity(other)) if isinstance(other, str | os.PathLike) else dict(other)
    _check(detector, tables)
    n = tables["wire_hits"].n_events
    drawn = _uniforms(seed, wire_hits.events, _core.common.Purpose.mixed_event)
    chosen = (drawn[:, 0] * n).astype(np.int64)
    shift = offset[0] + (offset[1] - offset[0]) * drawn[:, 1]
    mixed = {
        "digis": digis,
        "wire_hits": _mixed_cells(relations_of(detector), wire_hits, tables["wire_hits"], chosen, shift),
    }
    if all(bool((one["strip"] >= 0).all()) for one in (digis, tables["digis"])):
        mixed["digis"] = _mixed_strips(digis, tables["digis"], chosen, shift)
    return mixed


def _mixed_cells(relations: DriftRelations, cells: Table, other: Table, chosen: Rows, shift: Floats) -> Table:
    more, shift = _of_others(cells, other, "drift_time", chosen, shift)
    # At the same time nothing changes: the measured distance is kept to the last digit.
    distance = relations.distance_at(more["layer"], more["drift_time"])
    drift = np.where(shift == 0, more["drift"], np.maximum(distance, 0.0))
    return _earliest(
        cells, more | {"drift": drift, "wire_truth": np.full(len(shift), -1), "side": np.zeros(len(shift))}
    )


def _mixed_strips(digis: Table, other: Table, chosen: Rows, shift: Floats) -> Table:
    more, shift = _of_others(digis, other, "time", chosen, shift)
    columns = stacked(digis, more | {"truth": np.full(len(shift), -1), "n_truths": np.zeros(len(shift))})
    # The first row of a strip is that of the given event.
    order, first = _core.simulation.by_channel(columns["event"], columns["gid"], np.zeros(len(columns["event"])))
    merged_digis = _like(digis, columns, order[first])
    if not len(merged_digis):
        return merged_digis
    charge, time = np.add.reduceat(columns["charge"][order], first), np.minimum.reduceat(columns["time"][order], first)
    return merged_digis.with_columns(charge=charge, time=time)


def _of_others(own_rows: Table, other: Table, clock: str, chosen: Rows, shift: Floats) -> tuple[dict[str, Any], Floats]:
    """Return the columns of the chosen events' rows that are in time for the given events, and the shift of each."""
    count = np.diff(other.offsets)[chosen]
    event = np.repeat(np.arange(len(chosen)), count)
    rows = np.arange(len(event)) + np.repeat(other.offsets[chosen] - np.cumsum(count) + count, count)
    time = other[clock][rows] + shift[event]
    inside = (time >= BEGIN) & (time <= WINDOWS[own_rows.kind])
    columns = {name: other[name][rows[inside]] for name in own_rows if name in other}
    return columns | {"event": own_rows.events[event[inside]], clock: time[inside]}, shift[event[inside]]


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


def _argument_problems(digis: object, wire_hits: object, other: object, offset: object, seed: object) -> Problems:
    """Return what is wrong with the arguments themselves."""
    problems = Problems()
    if not digis.covers_as(wire_hits):  # type: ignore[attr-defined]
        problems.note("digis", "other events than those of wire_hits", "the same")
    if not isinstance(other, Mapping | str | os.PathLike):
        problems.note("other", type(other).__name__, "tables by their names or the folder of a run")
    ends = [number_check(end) for end in offset] if isinstance(offset, Sequence | np.ndarray) else []
    if isinstance(offset, str) or len(ends) != 2 or not np.isfinite(ends).all() or ends[0] > ends[1]:
        problems.note("offset", f"{offset!r:.50}", "a range (low, high) of two numbers, ns")
    check_seed(seed, problems)
    return problems


def _check(detector: Detector, tables: Mapping[str, Table]) -> None:
    """Raise an error for tables of another kind or detector."""
    Problems(Problem(name, "missing", "") for name in ("digis", "wire_hits") if name not in tables).report("mix_events")
    digis, wires = tables["digis"], tables["wire_hits"]
    texts = table_problems(channels_of(detector), digis=digis, wire_hits=wires)
    problems = Problems(Problem("other", text, "") for text in texts)
    if not problems:
        if wires.n_events != digis.n_events:
            problems.note("digis", f"{digis.n_events} events", f"{wires.n_events}, as wire_hits has")
        elif not wires.n_events:
            problems.note("wire_hits", "no events", "at least one")
    problems.report("mix_events")
