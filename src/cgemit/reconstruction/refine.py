"""Refinements: what fitted tracks tell about their hits (docs/methods/reconstruct.md).

A refinement makes a first guess before any track is known. After each fit it computes the hits anew from what was
measured, never from an earlier guess: drift times along the wires, the start time of the event, cluster directions.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.base.arrays import Flags, Floats, Rows
from cgemit.base.errors import Problems
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Quantity
from cgemit.detector import Detector
from cgemit.detector.drift import DriftRelations, _of_layers, propagation_time, relations_of
from cgemit.detector.layers.layer import local_v
from cgemit.particles.species import HYPOTHESES
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.clusterers.clusterer import ClusterSettings
from cgemit.reconstruction.fit import added_error, displaced, with_wider_momenta
from cgemit.reconstruction.states import USUAL_MOMENTUM
from cgemit.tables import Table
from cgemit.tables.schema import HIT_WIRE, is_fitted
from cgemit.units import LIGHT

TimeError = Annotated[float, Quantity("time", 1e-3, 1e3)]

_STRIP_VIEWS = 2  # X and V in `candidate_hits`


@dataclass(frozen=True, kw_only=True)
class RefineSettings(SettingsData):
    """What fitted tracks correct of their hits.

    Attributes
    ----------
    drift_times : str
        ``"raw"``: drift times also hold flight and propagation along the wire, which are subtracted. A run with
        ``digitize.wire_times = "raw"`` takes ``"raw"``.
    flight : str
        Flight in raw drift times. ``"outward"``: away from the beam line. ``"cosmic"``: muons from above, with y up;
        hits of upward tracks are earlier than the closest approach. A run of cosmic muons alone takes ``"cosmic"``.
    start_time : str
        ``"fitted"``: a common offset of the drift times of each event is fitted from its tracks
        (docs/methods/reconstruct.md).
    start_time_error : float or None
        Prior uncertainty of the start time, ns; only with a fitted one. None: no prior.
    find_again : bool
        Whether tracks are found a second time with the corrected hits.
    points : str
        ``"compete"``: before the last fit, the X and V clusters of each CGEM layer compete for the tracks that cross it
        (docs/methods/reconstruct.md). ``"found"``: tracks keep those of the finder. A run with true hits keeps them.

    Raises
    ------
    SettingsError
        A ValueError that lists every invalid value.

    Examples
    --------
    >>> refine = cg.RefineSettings(drift_times="raw", start_time="fitted")
    >>> settings = cg.Settings(digitize=cg.DigitizeSettings(wire_times="raw"), refine=refine)
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5, settings=settings)
    >>> bool(np.abs(result.start_times["start_time"]).max() < 5)  # ns
    True
    """

    drift_times: Literal["corrected", "raw"] = "corrected"
    flight: Literal["outward", "cosmic"] = "outward"
    start_time: Literal["given", "fitted"] = "given"
    start_time_error: TimeError | None = None
    find_again: bool = True
    points: Literal["found", "compete"] = "found"

    def contradictions(self, problems: Problems) -> None:
        """Note an error of a start time that is not fitted."""
        if isinstance(self.start_time_error, int | float) and self.start_time == "given":
            problems.note("start_time_error", str(self.start_time_error), "none unless start_time is 'fitted'")


@dataclass(frozen=True, eq=False)
class Hits:
    """Measurements of the same events.

    Attributes
    ----------
    clusters, wire_hits : Table
    digis : Table or None
        Strips of the clusters, in case that these are made again.
    """

    clusters: Table
    wire_hits: Table
    digis: Table | None = None

    def refined(self, measured: Hits) -> dict[str, Table]:
        """Return the tables ``refined_clusters`` and ``refined_wire_hits``, where they differ from measured ones."""
        pairs = {name: (getattr(self, name), getattr(measured, name)) for name in ("clusters", "wire_hits")}
        return {
            f"refined_{name}": Table(f"refined_{name}", refined.columns, meta=refined.meta, **refined.cover)
            for name, (refined, unrefined) in pairs.items()
            if refined is not unrefined
        }


class Turn(NamedTuple):
    """Tracks of one turn of the reconstruction.

    Attributes
    ----------
    number, turns : int
        Of this turn, and of all.
    hits : Hits
        As the fit took them.
    candidates, candidate_hits, tracks, residuals : Table
        One track for each candidate.
    states : Table or None
        At the origin and at the hits, if a refinement needs them.
    """

    number: int
    turns: int
    hits: Hits
    candidates: Table
    candidate_hits: Table
    tracks: Table
    residuals: Table
    states: Table | None = None


class Refinement:
    """One kind of correction of the hits; an object serves one reconstruction."""

    turns = 2  # fits that it needs
    needs_states = True  # of the tracks, at the origin and at the hits

    def guess(self, detector: Detector, hits: Hits) -> Hits:
        """Return the hits corrected as far as possible before any track is known.

        Parameters
        ----------
        detector : Detector
        hits : Hits
        """
        return hits

    def refine(self, detector: Detector, hits: Hits, turn: Turn) -> Hits:
        """Return the hits corrected by the tracks of a turn.

        Parameters
        ----------
        detector : Detector
        hits : Hits
            As measured, with the corrections of the refinements before this one.
        turn : Turn
        """
        raise NotImplementedError

    def finish(self, detector: Detector, tables: Mapping[str, Table]) -> dict[str, Table]:
        """Return tables that the refinement adds to the tables of the last fit, or puts in their place.

        Parameters
        ----------
        detector : Detector
        tables : mapping of str to Table
        """
        return {}


class DriftTimes(Refinement):
    """Time of flight and propagation along the wire, subtracted from raw drift times.

    Parameters
    ----------
    cosmic : bool
        Whether particles come from above (`RefineSettings.flight`).
    """

    def __init__(self, *, cosmic: bool = False) -> None:
        self._cosmic = cosmic

    def guess(self, detector: Detector, hits: Hits) -> Hits:
        """Subtract the delay at the middle of each wire."""
        return replace(hits, wire_hits=expected(detector, hits.wire_hits, cosmic=self._cosmic))

    def refine(self, detector: Detector, hits: Hits, turn: Turn) -> Hits:
        """Subtract the delay on the track; hits on no good track keep the guess."""
        corrected, measured = expected(detector, hits.wire_hits, cosmic=self._cosmic), hits.wire_hits
        states = _known(turn.states)
        time = flight(states, turn.candidates, turn.tracks)
        if self._cosmic:
            first = np.searchsorted(states["track"], states["track"])  # the state at the origin
            time = np.where(states["py"][first] > 0, -time, time)
        wire = states["view"] == HIT_WIRE
        row, time, z = states["hit"][wire], time[wire], states["z"][wire]
        row, first = np.unique(row, return_index=True)  # of several tracks the first one counts
        delay = time[first] + propagation_time(detector, measured["layer"][row], z[first])
        exact = _earlier(relations_of(detector), measured[row], delay)
        columns = {name: corrected[name].copy() for name in ("drift", "drift_time", "sigma")}
        for name, column in columns.items():
            column[row] = exact[name]
        return replace(hits, wire_hits=corrected.with_columns(**columns))


def expected(detector: Detector, wire_hits: Table, *, cosmic: bool = False) -> Table:
    """Return wire hits corrected for the delay at the middle of their wires, before any track is known.

    The time of flight is taken for light on a straight line from the origin to the middle of the wire; with particles
    from above it is negative for wires above the origin. Errors include the uniform spread of the propagation over the
    wire of length L, L/(v sqrt(12)) times the drift velocity.

    Parameters
    ----------
    detector : Detector
    wire_hits : Table
        With raw drift times.
    cosmic : bool
        Whether particles come from above, with y up.

    Raises
    ------
    ValueError
        If a hit has no drift time, a layer is not in the detector, or the detector does not say how signals run.
    """
    layer = wire_hits["layer"]
    radius, z, half_length, speed = _of_layers(detector, layer, "r_mid", "z_mid", "half_length", "signal_speed")
    relations = relations_of(detector)
    time = np.hypot(radius, z) / LIGHT
    if cosmic:
        first, twist, cells = _of_layers(detector, layer, "phi_east", "twist", "cells")
        above = np.sin(first - 0.5 * twist + 2 * np.pi * wire_hits["wire"] / cells) > 0
        time = np.where(above, -time, time)
    corrected = _earlier(relations, wire_hits, time + propagation_time(detector, layer, z))
    spread = 2 * half_length / (speed * np.sqrt(12)) * relations.velocity_at(layer, corrected["drift"])
    return corrected.with_columns(sigma=np.hypot(corrected["sigma"], spread))


def _known(states: Table | None) -> Table:
    """Return the states that are known."""
    assert states is not None
    known: Table = states[(states["status"] == 0) & np.isfinite(states["x"])]
    return known


def flight(states: Table, candidates: Table, tracks: Table) -> Floats:
    """Return the time of flight from the closest approach to each state, (n,) float64, ns.

    Between two states a track turns by psi: its arc is the chord times (psi/2)/sin(psi/2), exact on a helix. An arc
    against the direction of flight counts as negative.

    Parameters
    ----------
    states : Table
        By track and along it, the one at the origin first.
    candidates, tracks : Table
        Masses and momenta.
    """
    x, y, px, py, track = (states[name] for name in ("x", "y", "px", "py", "track"))
    dx, dy = np.diff(x, prepend=0.0), np.diff(y, prepend=0.0)
    turn = np.diff(np.arctan2(py, px), prepend=0.0)
    half = 0.5 * helix.wrap_angle(turn)
    arc = np.hypot(dx, dy) / np.sinc(half / np.pi) * np.sign(dx * px + dy * py)
    begins = np.flatnonzero(np.diff(track, prepend=-1))
    row = np.repeat(np.arange(len(begins)), np.diff(begins, append=len(track)))
    rank = np.arange(len(track)) - begins[row] if len(track) else row
    # A row for each track: sums of one do not depend on the tracks before it.
    length = np.zeros((len(begins), int(rank.max(initial=0)) + 1))
    length[row, rank] = np.where(rank > 0, arc * np.hypot(1.0, states["tanl"]), 0.0)
    along = np.cumsum(length, axis=1)[row, rank]
    parameters = np.stack([tracks[name] for name in helix.PARAMETERS], axis=1)
    # Tracks may be unconstrained along z alone.
    known = ~(
        helix.momentum_error(parameters, tracks["cov"], tracks["charge"])
        > _core.reconstruction.MOST_ERROR * tracks["p"]
    )
    p = np.where(known, tracks["p"], tracks.meta.get("momentum", USUAL_MOMENTUM))
    slowness = np.hypot(1.0, _masses(candidates, tracks) / p) / LIGHT
    return np.asarray(along * slowness[track], np.float64)


def _masses(candidates: Table, tracks: Table) -> Floats:
    """Return the mass that each track was fitted with, GeV/c2."""
    rows = tracks["candidate"]
    mass = candidates["mass"][rows].copy()
    for kind in HYPOTHESES.values():
        mass[(tracks["hypothesis"] == kind.pdg) & (candidates["pdg"][rows] != kind.pdg)] = kind.mass
    return np.asarray(mass, np.float64)


def _earlier(relations: DriftRelations, wire_hits: Table, delay: Floats) -> Table:
    """Return wire hits with drift times that are shorter by a delay, ns, and distances to match."""
    time = wire_hits["drift_time"]
    unknown = np.count_nonzero(~np.isfinite(time))
    if unknown:
        raise ValueError(f"wire_hits: {unknown} of {len(time)} have no drift_time, expected one for each")
    return wire_hits.with_columns(drift_time=time - delay, drift=relations.shifted(wire_hits, -delay))


class ClusterDirection(Refinement):
    """Positions and errors of clusters for the direction of their track.

    Parameters
    ----------
    settings : ClusterSettings
    """

    def __init__(self, settings: ClusterSettings) -> None:
        self._settings = settings

    def refine(self, detector: Detector, hits: Hits, turn: Turn) -> Hits:
        """Make the clusters on good tracks again; the others are as before."""
        if hits.digis is None:
            raise ValueError("reconstruct: got no digis, expected the strips of the clusters, which are made again")
        directions = track_directions(detector, len(hits.clusters), turn.states)
        again = cluster.unchecked(detector, hits.digis, self._settings, directions=directions, clusters=hits.clusters)
        return replace(hits, clusters=again)


def track_directions(detector: Detector, n_clusters: int, states: Table | None) -> Floats:
    """Return dX/dr or dV/dr at the anode, and the path per radius, of the track of each cluster, (clusters, 2) float64.

    They are NaN for clusters on no good track, or on one so inclined that it may not cross the whole gap. The
    direction of the state at mid-gap is taken for the whole gap: within 0.2 % up to 45 degrees, 0.4 % at 55 degrees.

    Parameters
    ----------
    detector : Detector
    n_clusters : int
    states : Table
        At the hits.
    """
    directions = np.full((n_clusters, 2), np.nan)
    states = _known(states)
    states = states[(states["view"] >= 0) & (states["view"] < _STRIP_VIEWS)]
    r = np.hypot(states["x"], states["y"])
    outward = (states["x"] * states["px"] + states["y"] * states["py"]) / r
    around = (states["x"] * states["py"] - states["y"] * states["px"]) / r
    for layer_number, layer in enumerate(detector.layers):
        gap = layer.r_gap_out - layer.r_gap_in
        crosses = (outward > 0) & (outward**2 * r > gap * (outward**2 + around**2))
        here = np.flatnonzero((states["layer"] == layer_number) & crosses)
        tangent = around[here] / outward[here]
        dx = layer.r_readout * tangent / layer.r_mid
        path = np.hypot(1.0, tangent)
        dz = path * states["tanl"][here]
        dv = local_v(layer, gap * dx, layer.z_ref + gap * dz) / gap
        across = np.where(states["view"][here] == 0, dx, dv)
        directions[states["hit"][here]] = np.column_stack([across, np.hypot(path, dz)])
    return directions


#: Errors of the drift times in the first fits, ns: hits far from tracks with a wrong start time stay in.
FIRST_ERRORS = (20.0, 5.0)
#: The side of a wire is certain if the track is this number of the hit's errors away from it.
CERTAIN = 2.0
#: Longest step, ns; a start time further than five of them from the given one counts as not found.
MOST_STEP = 30.0
#: A track whose chi-square is above this number of degrees of freedom at its own best start time does not count.
MOST_CHI2 = 3.0
#: A track does not count if its own start time is this number of errors away from the median of the event.
MOST_PULL = 5.0
#: A start time stays once a step is shorter than this share of its error. From the fourth step on, steps are halved:
#: hits that change sides would let them alternate.
TOLERANCE, WHOLE_STEPS = 0.1, 3
#: Shift of the fit that gives the second derivative of chi-square, ns.
PROBE = 2.0


class StartTimeStatus(enum.IntEnum):
    """How the fit of a start time ended; 0 is good.

    Examples
    --------
    >>> cg.StartTimeStatus.ok.value, [status.name for status in cg.StartTimeStatus][:3]
    (0, ['ok', 'no_track', 'not_converged'])
    """

    ok = 0
    no_track = 1
    not_converged = 2


@dataclass
class _StartTimes:
    """What one reconstruction has found so far of the start times of its events, (events,)."""

    relations: DriftRelations
    time: Floats  # ns
    error: Floats  # ns
    moving: Flags
    counted: Rows  # tracks
    status: npt.NDArray[np.int8]
    slope: Floats  # (candidates, 5), of the helices with the start time, 1/ns
    fits: _Fits | None = None  # of the turn before

    @classmethod
    def at_zero(cls, relations: DriftRelations, n: int, error: float) -> _StartTimes:
        """Return the given start times of `n` events with their error, before any track is known."""
        status = np.full(n, StartTimeStatus.no_track, np.int8)
        return cls(
            relations, np.zeros(n), np.full(n, error), np.ones(n, np.bool_), np.zeros(n, np.int64), status,
            np.zeros((0, 5)),
        )  # fmt: skip


class StartTime(Refinement):
    """The start time of each event, from the residuals of its tracks (docs/methods/reconstruct.md).

    Each turn but the last two is a step of Newton's method. The last but one shifts all hits by `PROBE`: the change of
    gradients and helices gives the error of the start time and its part in the errors of the tracks.

    Parameters
    ----------
    prior_error : float or None
        Prior uncertainty of the given start time, ns.
    """

    turns = 11
    needs_states = False

    def __init__(self, prior_error: float | None = None) -> None:
        self._prior = 0.0 if prior_error is None else prior_error**-2
        self._prior_error = math.nan if prior_error is None else prior_error
        self._times = _StartTimes.at_zero(DriftRelations(()), 0, self._prior_error)

    def guess(self, detector: Detector, hits: Hits) -> Hits:
        """Start at the given time, with errors for that it is wrong."""
        unknown = int(np.count_nonzero(~np.isfinite(hits.wire_hits["drift_time"])))
        if unknown:
            raise ValueError(
                f"fit: start_time: got 'fitted' and {unknown} of {len(hits.wire_hits)} wire hits without a drift_time, "
                "expected one for each"
            )
        self._times = _StartTimes.at_zero(relations_of(detector), len(hits.wire_hits.events), self._prior_error)
        return self._shifted(hits, FIRST_ERRORS[0])

    def refine(self, detector: Detector, hits: Hits, turn: Turn) -> Hits:
        """Move the start times by one step, or find their errors."""
        event = np.searchsorted(turn.candidates.events, turn.candidates["event"])
        turns_left = turn.turns - turn.number
        if turns_left == 2:  # the fit of this turn was shifted
            self._set_errors(_Fits.of(self._times.relations, turn, self._times.time[event] + PROBE), event)
            return self._shifted(hits)
        now = self._times.fits = _Fits.of(self._times.relations, turn, self._times.time[event])
        self._step(now, event, turn.number)
        if turns_left == 3:
            return self._shifted(hits, shift=PROBE)
        return self._shifted(hits, FIRST_ERRORS[turn.number + 1] if turn.number + 1 < len(FIRST_ERRORS) else 0.0)

    def finish(self, detector: Detector, tables: Mapping[str, Table]) -> dict[str, Table]:
        """Return the table ``start_times``, and the tracks with its errors in their covariance."""
        candidates, tracks = tables["candidates"], tables["tracks"]
        event = np.searchsorted(candidates.events, candidates["event"])
        before, tracks = tracks["err_p"], _with_time_error(tracks, self._times.slope, self._times.error[event])
        tracks = tracks.with_columns(displaced=displaced(tracks["dr"], tracks["err_dr"], detector))
        columns = {
            "event": candidates.events, "start_time": self._times.time, "err_start_time": self._times.error,
            "n_tracks": self._times.counted, "status": self._times.status,
        }  # fmt: skip
        changed = {"tracks": tracks, "start_times": Table("start_times", columns, **candidates.cover)}
        if "components" in tables:
            parts = tables["components"]
            wider = np.hypot(parts["spread"], added_error(tracks, before)[parts["track"]])
            changed["components"] = parts.with_columns(spread=wider)
        return changed

    def _shifted(self, hits: Hits, error: float = 0.0, shift: float = 0.0) -> Hits:
        """Return hits with drift times counted from the present start times; `error`: of these times, ns."""
        wires = hits.wire_hits
        wires = start_subtracted(self._times.relations, wires, wires.events, self._times.time + shift)
        if error:
            velocity = self._times.relations.velocity_at(wires["layer"], np.abs(wires["drift"]))
            wires = wires.with_columns(sigma=np.hypot(wires["sigma"], error * velocity))
        return replace(hits, wire_hits=wires)

    def _step(self, now: _Fits, event: Rows, step: int) -> None:
        """Move the start times by a step of Newton's method."""
        time, total, self._times.counted = self._combined(now, event, early=step < len(FIRST_ERRORS))
        has_time = (self._times.counted > 0) & (np.abs(time) <= 5 * MOST_STEP)
        moved = np.where(has_time & self._times.moving, time - self._times.time, 0.0).clip(-MOST_STEP, MOST_STEP)
        self._times.time = self._times.time + moved * (1.0 if step < WHOLE_STEPS else 0.5)
        self._times.moving = ~has_time | (np.abs(moved) * np.sqrt(total) > TOLERANCE) | (step < len(FIRST_ERRORS))
        status = np.where(self._times.moving, StartTimeStatus.not_converged, StartTimeStatus.ok)
        self._times.status = np.where(has_time, status, StartTimeStatus.no_track).astype(np.int8)

    def _set_errors(self, probed: _Fits, event: Rows) -> None:
        """Set errors and slopes from the change of the gradients, and of the helices, with the start time."""
        now = self._times.fits
        assert now is not None
        has_time = self._times.status != StartTimeStatus.no_track
        self._times.counted = np.where(has_time, self._times.counted, 0)
        self._times.time = np.where(has_time, self._times.time, 0.0)
        have_both = (now.info > 0) & (probed.info > 0) & has_time[event]
        lever = np.where(have_both, probed.at - now.at, 1.0)
        info = np.where(have_both, (now.gradient - probed.gradient) / lever, now.info)
        info = np.where((info > 0.5 * now.info) & (info < 2 * now.info), info, now.info)
        self._times.slope = np.where(have_both[:, None], _difference(probed.helix, now.helix) / lever[:, None], 0.0)
        _, total, _ = self._combined(now._replace(info=np.where(now.info > 0, info, 0.0)), event, early=False)
        self._times.error[has_time] = total[has_time] ** -0.5

    def _combined(self, now: _Fits, event: Rows, *, early: bool) -> tuple[Floats, Floats, Rows]:
        """Return the mean start time of the tracks of each event, its 1/variance, and how many tracks count.

        Tracks far from the median do not count, nor do those with a bad chi-square unless it is `early`.
        """
        step = np.divide(now.gradient, now.info, out=np.zeros(len(now.info)), where=now.info > 0)
        best = now.chi2 - step * now.gradient
        info = np.where(early | (best <= MOST_CHI2 * now.ndf), now.info, 0.0)
        time, events = now.at + step, len(self._times.time)
        median, width = _medians(time, info, event, events)
        far = np.abs(time - median) > MOST_PULL * np.hypot(_spread(info), width)
        info = np.where(far, 0.0, info)
        total = np.bincount(event, info, events) + self._prior
        mean = np.bincount(event, info * time, events)
        counted = np.bincount(event, info > 0, events).astype(np.int64)
        return np.divide(mean, total, out=np.zeros(events), where=total > 0), np.asarray(total), counted


def start_subtracted(
    relations: DriftRelations, wire_hits: Table, events: npt.NDArray[np.int64], start: Floats
) -> Table:
    """Return wire hits with drift times counted from the start times of their events, and distances to match.

    Parameters
    ----------
    relations : DriftRelations
    wire_hits : Table
    events : ndarray, (n,) int64
        Numbers of events, ascending; hits of other events stay.
    start : ndarray, (n,) float64, ns
    """
    if not len(events):
        return wire_hits
    row = np.searchsorted(events, wire_hits["event"]).clip(max=len(events) - 1)
    shift = -np.where(events[row] == wire_hits["event"], start[row], 0.0)
    drift = relations.shifted(wire_hits, shift)
    return wire_hits.with_columns(drift_time=wire_hits["drift_time"] + shift, drift=drift)


class _Fits(NamedTuple):
    """Tracks at the start times `at`, ns, (candidates,) or (candidates, 5); without a good fit, `info` is 0.

    `gradient` is -1/2 d chi2/d start time, 1/ns. `info` is about 1/2 its second derivative, 1/ns2: half the mean if
    the sides of the wires were random.
    """

    at: Floats
    gradient: Floats
    info: Floats
    chi2: Floats
    ndf: Floats
    helix: Floats

    @classmethod
    def of(cls, relations: DriftRelations, turn: Turn, at: Floats) -> _Fits:
        """Return the derivatives of chi-square of the tracks of a turn.

        With W the weight matrix of the measurements m in the fit, chi2 = m W m. The residual of hit i to the track
        without it is (W m)_i/W_ii, with variance 1/W_ii: both derivatives follow from the residuals, the second one
        without the terms of two hits, whose signs change with the sides.
        """
        tracks, residuals, wires = turn.tracks, turn.residuals, turn.hits.wire_hits
        side = residuals["side"]
        wire = np.flatnonzero((residuals["view"] == HIT_WIRE) & (residuals["used"] == 1) & (side != 0))
        hit, track, side = residuals["hit"][wire], residuals["track"][wire], side[wire]
        residual, err = residuals["residual"][wire], residuals["err"][wire]
        # Velocity and cut at the predicted distance, which the error of the hit does not move.
        predicted = side * wires["drift"][hit] - residual
        certain = np.abs(predicted) > CERTAIN * wires["sigma"][hit]
        slope = np.where(certain, side * relations.velocity_at(wires["layer"][hit], np.abs(predicted)), 0.0)
        good = is_fitted(tracks)
        return cls(
            at=at, gradient=np.bincount(track, slope * residual / err**2, len(tracks)).astype(np.float64),
            info=np.where(good, np.bincount(track, (slope / err) ** 2, len(tracks)), 0.0),
            chi2=np.where(good, tracks["chi2"], 0.0), ndf=tracks["ndf"].astype(np.float64),
            helix=np.column_stack([tracks[name] for name in helix.PARAMETERS]),
        )  # fmt: skip


def _spread(info: Floats) -> Floats:
    """Return the error of a start time, ns; 0 for a track that does not count."""
    return np.where(info > 0, info, np.inf) ** -0.5


def _medians(time: Floats, info: Floats, event: Rows, events: int) -> tuple[Floats, Floats]:
    """Return for each track the median of the start times of its event's tracks, and the error of that one.

    Of two middle ones it is the more precise one. Ranks, not sums: events do not depend on each other.
    """
    if not len(time):
        return time, time
    order = np.lexsort((time, info <= 0, event))
    begin = np.searchsorted(event[order], np.arange(events))
    count = np.bincount(event, info > 0, events).astype(np.int64)
    low, high = (
        order[(begin + place).clip(0, len(order) - 1)] for place in (np.maximum(count - 1, 0) // 2, count // 2)
    )
    middle = np.where(info[high] > info[low], high, low)
    return time[middle][event], _spread(info)[middle][event]


def _difference(new: Floats, old: Floats) -> Floats:
    """Return the difference of helices, (n, 5), azimuths by the short way."""
    difference = new - old
    difference[:, 1] = helix.wrap_angle(difference[:, 1])
    return difference


def _with_time_error(tracks: Table, slope: Floats, error: Floats) -> Table:
    """Return tracks whose covariance includes the error of the start time; `slope`, `error` of each candidate."""
    rows = tracks["candidate"]
    moved = slope[rows] * np.where(np.isfinite(error), error, 0.0)[rows, None]
    cov = tracks["cov"] + moved[:, :, None] * moved[:, None, :]
    err = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    fitted = np.column_stack([tracks[name] for name in helix.PARAMETERS])
    columns = {f"err_{name}": err[:, i] for i, name in enumerate(helix.PARAMETERS)}
    columns["err_p"] = helix.momentum_error(fitted, cov, tracks["charge"])
    return with_wider_momenta(tracks, columns["err_p"]).with_columns(cov=cov, **columns)


def refinements(settings: RefineSettings) -> list[Refinement]:
    """Return the refinements that settings ask for, each for one reconstruction.

    Parameters
    ----------
    settings : RefineSettings

    Examples
    --------
    >>> [type(one).__name__ for one in cg.refinements(cg.RefineSettings(drift_times="raw", start_time="fitted"))]
    ['DriftTimes', 'StartTime']
    """
    chosen: list[Refinement] = []
    if settings.drift_times == "raw":
        chosen = [DriftTimes(cosmic=settings.flight == "cosmic")]
    return [*chosen, StartTime(settings.start_time_error)] if settings.start_time == "fitted" else chosen
