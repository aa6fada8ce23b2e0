"""Wire hits of all cells that fired in events of the BESIII software (docs/how-to/real_events.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats, Ints
from cgemit.base.errors import Problems
from cgemit.bes3.events import Bes3Events
from cgemit.detector import Detector
from cgemit.detector.drift import propagation_time, relations_of
from cgemit.reconstruction.candidates import label_candidates
from cgemit.reconstruction.find.ckf import find_tracks
from cgemit.reconstruction.given_hits import hit_tables
from cgemit.reconstruction.reconstruct import reconstruct
from cgemit.reconstruction.refine import DriftTimes
from cgemit.tables import SCHEMAS, Table
from cgemit.tables.schema import HIT_WIRE, has_momentum
from cgemit.truth.match import match
from cgemit.units import LIGHT

#: TDC time minus start time of a signal without flight, drift and propagation, ns: the median of the public events.
ZERO_TIME = -233.5
#: Raw drift times that can be of a track, ns.
WINDOW = (-20.0, 700.0)
#: Start times that a search tries, ns in the readout window. A fit of the start time finds it from 30 ns away.
SEARCH = tuple(np.arange(0.0, 1500.0, 25.0).tolist())

_OUTER = 8  # first layer of the outer chamber
_LEAST_TIMES, _LEAST_DISTANCES = 10, 100  # hits that a zero time, or a drift relation, needs
_LIMIT = 5.0  # standard deviations of a count, for hot and dead cells


@dataclass(frozen=True, eq=False)
class DriftCalibration:
    """How TDC times become drift distances.

    Attributes
    ----------
    zero_time : dict of int to float
        By layer: TDC time minus start time of a signal without flight, drift and propagation, ns. Layers that are not
        in it have `ZERO_TIME`.
    relation : dict of (int, int) to (ndarray, ndarray)
        By layer and side (+1, -1): drift times, ns, ascending, and the distances of them, mm, both (n,) float64. Others
        have the relation of their layer in the detector.
    """

    zero_time: Mapping[int, float] = field(default_factory=dict)
    relation: Mapping[tuple[int, int], tuple[Floats, Floats]] = field(default_factory=dict)

    def zero(self, layer: Ints) -> Floats:
        """Return the zero times of layers, (n,) float64, ns."""
        return np.array([self.zero_time.get(one, ZERO_TIME) for one in layer.tolist()], np.float64)

    def distance(self, detector: Detector, layer: Ints, time: Floats) -> Floats:
        """Return drift distances, (n,) float64, mm: means of both sides, which a hit does not know."""
        distances = np.maximum(relations_of(detector).distance_at(layer, time), 0.0)
        for number in np.unique(layer).tolist():
            mine = layer == number
            sides = [self.relation[number, side] for side in (1, -1) if (number, side) in self.relation]
            if sides:
                distances[mine] = np.mean([np.interp(time[mine], *points) for points in sides], axis=0)
        return distances


def calibrate(events: Bes3Events) -> DriftCalibration:
    """Find zero times and drift relations from the hits on the experiment's tracks.

    A layer needs 10 hits for its zero time, and 100 on a side for its relation; a layer of the inner chamber (0 to 7)
    with fewer has the relation of all of it, if that has 100. The outer layers then have the common one.
    """
    hits = events.wire_hits
    if not len(hits):
        return DriftCalibration()
    layer, time, drift = hits["layer"].astype(np.int64), hits["drift_time"], np.abs(hits["drift"])
    radius = _radius(events.detector, layer)
    delay = np.hypot(radius, hits["z"]) / LIGHT + propagation_time(events.detector, layer, hits["z"])
    zero = hits["tdc"] - events.start_time[hits["event"]] - time - delay
    known = np.isfinite(zero)
    zeros, relation = {}, {}
    for number in np.unique(layer).tolist():
        mine = layer == number
        if np.count_nonzero(mine & known) >= _LEAST_TIMES:
            zeros[number] = float(np.median(zero[mine & known]))
        for side in (1, -1):
            rows = mine & (hits["side"] == side)
            if np.count_nonzero(rows) < _LEAST_DISTANCES and number < _OUTER:
                rows = layer < _OUTER
            if np.count_nonzero(rows) >= _LEAST_DISTANCES:
                relation[number, side] = _curve(time[rows], drift[rows])
    return DriftCalibration(zeros, relation)


def _radius(detector: Detector, layer: Ints) -> Floats:
    """Return the radii of the layers in the middle, mm."""
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    radii = {one.number: one.r_mid for one in layers}
    return np.array([radii[one] for one in layer.tolist()], np.float64)


def _curve(time: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """Return medians of distances in bins of equal numbers of hits; they do not fall."""
    order = np.argsort(time)
    bins = np.array_split(order, min(len(order) // 10, 30))
    times = [0.0, *(float(np.median(time[rows])) for rows in bins)]
    medians = [0.0, *(float(np.median(distance[rows])) for rows in bins)]
    return np.array(times), np.maximum.accumulate(np.array(medians))


def all_wire_hits(
    events: Bes3Events,
    start_time: npt.ArrayLike | None = None,
    *,
    calibration: DriftCalibration | None = None,
    without: npt.ArrayLike = (),
) -> Table:
    """Return the fired cells, on tracks and off, as wire hits.

    Their drift times are raw: they hold the time of flight and the propagation along the wire (`RefineSettings` with
    ``drift_times="raw"``). Times outside -20 to 700 ns are left out.

    Parameters
    ----------
    events : Bes3Events
    start_time : array_like, (events,) float64, or float, or None
        Start of each event in the readout window, ns. None: as the experiment reconstructed it. Events without
        one (NaN) have no hits.
    calibration : DriftCalibration or None
        None: what `calibrate` finds.
    without : array_like of int64
        Numbers (`gid`) of cells to leave out, such as hot ones.

    Returns
    -------
    Table of kind "wire_hits"
        With the columns of `wire_digis`.

    Raises
    ------
    ValueError
        If there is another number of start times than of events.
    """
    of, n = events.wire_digis, len(events.run)
    start = events.start_time if start_time is None else np.asarray(start_time, np.float64)
    if start.shape not in ((), (n,)):
        raise ValueError(f"start_time: got shape {start.shape}, expected one number, or one for each of {n} events")
    calibration = calibrate(events) if calibration is None else calibration
    time = of["tdc"] - np.broadcast_to(start, n)[of["event"]] - calibration.zero(of["layer"])
    good = (time >= WINDOW[0]) & (time <= WINDOW[1]) & ~np.isin(_gid(events.detector, of), without)
    picked = {name: column[good] for name, column in of.items()}
    picked |= {"drift_time": time[good], "drift": calibration.distance(events.detector, picked["layer"], time[good])}
    return hit_tables(events.detector, None, picked, Problems(), labelled=False, events=np.arange(n))[1]


def _gid(detector: Detector, of: Mapping[str, Any]) -> Ints:
    """Return the numbers of cells in the whole chamber."""
    chamber = detector.drift_chamber
    first = {} if chamber is None else dict(zip((one.number for one in chamber.layers), chamber.gid_first, strict=True))
    return np.asarray(of["wire"] + np.array([first[one] for one in of["layer"].tolist()], np.int64))


def cell_status(events: Bes3Events) -> npt.NDArray[np.int8]:
    """Return a mask of hot and dead cells, from how often each fires.

    A cell is hot if it fires in more events than five standard deviations above the mean of its layer, and dead if it
    never fires and the mean is so large that none of a million cells would do so by chance. Few events show neither.

    Returns
    -------
    ndarray, (cells,) int8
        By `gid`: 1 hot, -1 dead, 0 neither.
    """
    chamber = events.detector.drift_chamber
    if chamber is None:
        return np.zeros(0, np.int8)
    cells = chamber.gid_first[-1] + chamber.layers[-1].cells
    valid = np.isfinite(events.wire_digis["tdc"])
    of = {name: events.wire_digis[name][valid] for name in ("event", "layer", "wire")}
    pairs = np.unique(np.stack([of["event"], _gid(events.detector, of)]), axis=1)
    fires = np.bincount(pairs[1], minlength=cells)
    status = np.zeros(cells, np.int8)
    for first, layer in zip(chamber.gid_first, chamber.layers, strict=True):
        mine = slice(first, first + layer.cells)
        mean = np.median(fires[mine])
        status[mine] = np.where(fires[mine] > mean + _LIMIT * np.sqrt(mean + 1), 1, 0)
        status[mine][(fires[mine] == 0) & (mean > -np.log(1e-6))] = -1
    return status


def find_start_times(
    events: Bes3Events, times: npt.ArrayLike = SEARCH, *, calibration: DriftCalibration | None = None
) -> Floats:
    """Find the start of each event without the experiment's: the time with which its tracks have most wire hits.

    A fit of the start time (`RefineSettings` with ``start_time="fitted"``) finds it from there.

    Parameters
    ----------
    events : Bes3Events
    times : array_like, (n,) float64
        Start times to try, ns, not more than 40 apart.
    calibration : DriftCalibration or None
        None: what `calibrate` finds, from the experiment's tracks if there are some.

    Returns
    -------
    ndarray, (events,) float64
        Start times, ns; NaN where no time gives a track.
    """
    n = len(events.run)
    most, start_times = np.zeros(n), np.full(n, np.nan)
    calibration = calibrate(events) if calibration is None else calibration
    for time in np.asarray(times, np.float64):
        hits = events.clusters, all_wire_hits(events, time, calibration=calibration)
        made = reconstruct(events.detector, *hits, find_tracks, refinements=[DriftTimes()], find_again=False)
        tracks = made["tracks"][has_momentum(made["tracks"])]
        count = np.bincount(tracks["event"], tracks["n_wires"], minlength=n)
        start_times[count > most] = time
        most = np.maximum(most, count)
    return start_times


def match_wires(events: Bes3Events, wire_hits: Table, fitted: Mapping[str, Table] | None = None) -> Table:
    """Compare tracks of simulated events with the particles that fired their wires.

    Parameters
    ----------
    events : Bes3Events
    wire_hits : Table
        Of `all_wire_hits`.
    fitted : mapping of str to Table, or None
        ``tracks``, ``candidates`` and ``candidate_hits`` of these hits, as `reconstruct` returns them. None: the
        experiment's first fits.

    Returns
    -------
    Table of kind "matches"
        `purity` and `efficiency` count wire hits alone.

    Raises
    ------
    ValueError
        If the events have no generated particles, as those of an experiment.
    """
    if not len(events.particles):
        raise ValueError(
            "match_wires: the events have no generated particles, as those of an experiment; expected simulated events"
        )
    if fitted is None:
        named = label_candidates(events.clusters, wire_hits, np.full(len(events.clusters), -1), wire_hits["track"])
        candidates, tracks = named["candidates"], events.mdc_tracks
        keys = zip(candidates["event"].tolist(), candidates["candidate"].tolist(), strict=True)
        row = {key: i for i, key in enumerate(keys)}
        keys = zip(tracks["event"].tolist(), tracks["track"].tolist(), strict=True)
        rows = np.array([row.get(key, -1) for key in keys], np.int64)
        fitted = {**named, "tracks": tracks.with_columns(candidate=rows)[rows >= 0]}
    hits = fitted["candidate_hits"]
    of_wires = fitted["tracks"], fitted["candidates"], hits[hits["view"] == HIT_WIRE]
    no_clusters = events.clusters[np.zeros(len(events.clusters), np.bool_)]
    true = wire_hits["particle"] >= 0
    linked = wire_hits.with_columns(wire_truth=np.where(true, np.cumsum(true) - 1, -1))
    crossed = {one.name: np.zeros(np.count_nonzero(true), one.dtype) for one in SCHEMAS["wire_truths"]}
    crossed |= {name: wire_hits[name][true] for name in ("event", "particle", "layer", "wire")}
    truth = events.particles, events.truths, Table("wire_truths", crossed, **wire_hits.cover)
    return match(*of_wires, no_clusters, linked, *truth, detector=events.detector)["matches"]
