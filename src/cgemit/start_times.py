"""The start time of each event, fitted from its tracks (docs/methods/fit.md)."""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import helix
from cgemit.candidates import HIT_WIRE
from cgemit.drift_times import shifted, velocity_at
from cgemit.fit_settings import FitSettings
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.signedinteger[Any]]

#: Fits candidates to wire hits with the settings given, from starting helices, (n, 5) or (0, 5) for none.
FitShifted = Callable[[Table, Table, Table, FitSettings, Floats], Mapping[str, Table]]

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
#: The start time has converged when it changes by less than this share of its error. From the fourth step on, steps
#: are halved: hits that change sides would let them alternate.
TOLERANCE, WHOLE_STEPS, MOST_STEPS = 0.1, 3, 10
#: Shift of the fit that gives the second derivative of chi-square, ns.
PROBE = 2.0


class StartTimeStatus(enum.IntEnum):
    """How the fit of a start time ended; 0 is good."""

    ok = 0
    no_track = 1
    not_converged = 2


def fit_with_start_times(
    fit_rows: FitShifted, wire_hits: Table, candidates: Table, candidate_hits: Table, settings: FitSettings,
    start: Floats,
) -> dict[str, Table]:  # fmt: skip
    """Fit the start time of every event, then all candidates with it; errors of tracks include its error.

    Parameters
    ----------
    fit_rows : callable
        See `FitShifted`.
    wire_hits, candidates, candidate_hits : Table
    settings : FitSettings
    start : ndarray, (n, 5) or (0, 5) float64

    Returns
    -------
    dict of str to Table
        Those of the fit, and ``start_times``.

    Raises
    ------
    ValueError
        If wire hits have no drift times.
    """
    unknown = int(np.count_nonzero(~np.isfinite(wire_hits["drift_time"])))
    if unknown:
        raise ValueError(
            f"fit: start_time: got 'fitted' and {unknown} of {len(wire_hits)} wire hits without a drift_time, expected "
            "one for each"
        )
    search = _Search(fit_rows, wire_hits, candidates, candidate_hits, settings, start)
    search.run()
    given = replace(settings, start_time="given", start_time_error=None)
    tables = dict(fit_rows(search.hits(), candidates, candidate_hits, given, start))
    tables["tracks"] = _with_time_error(tables["tracks"], search.slope, search.error[search.event])
    columns = {
        "event": candidates.events, "start_time": search.time, "err_start_time": search.error,
        "n_tracks": search.counted, "status": search.status,
    }  # fmt: skip
    return tables | {"start_times": Table("start_times", columns, **candidates.cover)}


def corrected(wire_hits: Table, start_times: Table) -> Table:
    """Return wire hits with drift times counted from the fitted start times, and distances to match.

    Parameters
    ----------
    wire_hits : Table
    start_times : Table of kind "start_times"
    """
    return _from(wire_hits, start_times["event"], start_times["start_time"])


def _from(wire_hits: Table, events: npt.NDArray[np.int64], start: Floats) -> Table:
    if not len(events):
        return wire_hits
    row = np.searchsorted(events, wire_hits["event"]).clip(max=len(events) - 1)
    shift = -np.where(events[row] == wire_hits["event"], start[row], 0.0)
    time = wire_hits["drift_time"]
    return wire_hits.with_columns(drift_time=time + shift, drift=shifted(wire_hits["drift"], time, shift))


@dataclass(eq=False)
class _Fits:
    """Fits of candidates at the start times `at`, ns, (n,) or (n, 5); without a good fit, `info` is 0.

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
    def of(cls, tracks: Table, residuals: Table, wires: Table, rows: Rows, at: Floats) -> _Fits:
        """Return what tracks and residuals say; row i of the tracks is candidate `rows[i]`, at the time `at[rows[i]]`.

        With W the weight matrix of the measurements m in the fit, chi2 = m W m. The residual of hit i to the track
        without it is (W m)_i/W_ii, with variance 1/W_ii: both derivatives follow from the residuals, the second one
        without the terms of two hits, whose signs change with the sides.
        """
        side = residuals["side"]
        wire = np.flatnonzero((residuals["view"] == HIT_WIRE) & (residuals["used"] == 1) & (side != 0))
        hit, track, side = residuals["hit"][wire], residuals["track"][wire], side[wire]
        residual, err = residuals["residual"][wire], residuals["err"][wire]
        # Velocity and cut at the predicted distance, which the error of the hit does not move.
        predicted = side * wires["drift"][hit] - residual
        certain = np.abs(predicted) > CERTAIN * wires["sigma"][hit]
        slope = np.where(certain, side * velocity_at(np.abs(predicted)), 0.0)
        found = {
            "at": at[rows], "gradient": np.bincount(track, slope * residual / err**2, len(tracks)),
            "info": np.bincount(track, (slope / err) ** 2, len(tracks)) * (tracks["status"] == 0),
            "chi2": tracks["chi2"], "ndf": tracks["ndf"].astype(np.float64),
            "helix": np.column_stack([tracks[name] for name in helix.PARAMETERS]),
        }  # fmt: skip
        made = {name: np.zeros((len(at), *column.shape[1:])) for name, column in found.items()}
        for name, column in found.items():
            made[name][rows] = column
        return cls(**made)

    def with_rows(self, fresh: _Fits) -> _Fits:
        """Return the fits with those rows of other ones that have a good fit there."""
        good = fresh.info > 0
        return _Fits(
            **{
                name: np.where(good.reshape(-1, *[1] * (old.ndim - 1)), getattr(fresh, name), old)
                for name, old in vars(self).items()
            }
        )


class _Search:
    """The search for the start times: fits of all candidates at several of them."""

    def __init__(
        self, fit_rows: FitShifted, wire_hits: Table, candidates: Table, candidate_hits: Table, settings: FitSettings,
        start: Floats,
    ) -> None:  # fmt: skip
        self._fit, self._wires, self._candidates, self._hits = fit_rows, wire_hits, candidates, candidate_hits
        one = settings.hypothesis if len(settings.hypotheses()) == 1 else None
        self._settings = replace(
            settings, start_time="given", start_time_error=None, residuals=True, states=(), hypothesis=one
        )
        self._prior = 0.0 if settings.start_time_error is None else settings.start_time_error**-2
        events = len(candidates.events)
        self._start = start
        self.event = np.searchsorted(candidates.events, candidates["event"])
        self.time, self.counted = np.zeros(events), np.zeros(events, np.int64)
        self.error = np.full(events, np.nan if settings.start_time_error is None else settings.start_time_error)
        self.status = np.full(events, StartTimeStatus.no_track, np.int8)
        self.slope = np.zeros((len(candidates), 5))  # d helix/d start time

    def hits(self, error: float = 0.0) -> Table:
        """Return the wire hits with drift times counted from the present start times; `error`: of these times, ns."""
        hits = _from(self._wires, self._candidates.events, self.time)
        if not error:
            return hits
        return hits.with_columns(sigma=np.hypot(hits["sigma"], error * velocity_at(np.abs(hits["drift"]))))

    def run(self) -> None:
        """Find the start times by Newton's method, then their errors from one more fit."""
        now = self._fits(np.arange(len(self._candidates)), self._start, FIRST_ERRORS[0])
        moving = np.ones(len(self.time), np.bool_)
        for i in range(MOST_STEPS):
            time, total, self.counted = self._combined(now, bool(i < len(FIRST_ERRORS)))
            found = (self.counted > 0) & (np.abs(time) <= 5 * MOST_STEP)
            moved = np.where(found & moving, time - self.time, 0.0).clip(-MOST_STEP, MOST_STEP)
            self.time = self.time + moved * (1.0 if i < WHOLE_STEPS else 0.5)
            moving = found & ((np.abs(moved) * np.sqrt(total) > TOLERANCE) | (i < len(FIRST_ERRORS)))
            rows = np.flatnonzero((now.info > 0) & moving[self.event])
            if not len(rows):
                break
            error = FIRST_ERRORS[i + 1] if i + 1 < len(FIRST_ERRORS) else 0.0
            now = now.with_rows(self._fits(rows, now.helix, error))
        self.status = np.where(found, np.where(moving, StartTimeStatus.not_converged, 0), self.status).astype(np.int8)
        self._errors(now)

    def _errors(self, now: _Fits) -> None:
        """Set errors and slopes from the change of the gradient, and of the helices, with the start time."""
        found = self.status != StartTimeStatus.no_track
        self.counted = np.where(found, self.counted, 0)
        rows = np.flatnonzero((now.info > 0) & found[self.event])
        best, self.time = self.time, self.time + PROBE
        probed = self._fits(rows, now.helix)
        self.time = np.where(found, best, 0.0)
        both = probed.info > 0
        lever = np.where(both, probed.at - now.at, 1.0)
        info = np.where(both, (now.gradient - probed.gradient) / lever, now.info)
        info = np.where((info > 0.5 * now.info) & (info < 2 * now.info), info, now.info)
        self.slope = np.where(both[:, None], _difference(probed.helix, now.helix) / lever[:, None], 0.0)
        now.info[:] = np.where(now.info > 0, info, 0.0)
        _, total, _ = self._combined(now, False)
        self.error[found] = total[found] ** -0.5

    def _combined(self, now: _Fits, early: bool) -> tuple[Floats, Floats, Rows]:
        """Return the mean start time of the tracks of each event, its 1/variance, and how many tracks count.

        Tracks far from the median do not count, nor do those with a bad chi-square unless it is `early`.
        """
        step = np.divide(now.gradient, now.info, out=np.zeros(len(now.info)), where=now.info > 0)
        best = now.chi2 - step * now.gradient
        info = np.where(early | (best <= MOST_CHI2 * now.ndf), now.info, 0.0)
        time, events = now.at + step, len(self.time)
        median, width = _medians(time, info, self.event, events)
        far = np.abs(time - median) > MOST_PULL * np.hypot(_spread(info), width)
        info = np.where(far, 0.0, info)
        total = np.bincount(self.event, info, events) + self._prior
        mean = np.bincount(self.event, info * time, events)
        counted = np.bincount(self.event, info > 0, events).astype(np.int64)
        return np.divide(mean, total, out=np.zeros(events), where=total > 0), np.asarray(total), counted

    def _fits(self, rows: Rows, begin: Floats, error: float = 0.0) -> _Fits:
        """Fit some candidates at the present start times."""
        number = np.full(len(self._candidates), -1)
        number[rows] = np.arange(len(rows))
        mine = self._hits[number[self._hits["candidate"]] >= 0]
        mine = mine.with_columns(candidate=number[mine["candidate"]])
        wires = self.hits(error)
        start = begin[rows] if len(begin) else begin
        made = self._fit(wires, self._candidates[rows], mine, self._settings, start)
        return _Fits.of(made["tracks"], made["residuals"], wires, rows, self.time[self.event])


def _spread(info: Floats) -> Floats:
    """Return the error of a start time, ns; 0 for what does not count."""
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
    difference[:, 1] = np.remainder(difference[:, 1] + np.pi, 2 * np.pi) - np.pi
    return difference


def _with_time_error(tracks: Table, slope: Floats, error: Floats) -> Table:
    """Return tracks whose covariance includes the error of the start time; `slope`, `error` of each candidate."""
    rows = tracks["candidate"]
    moved = slope[rows] * np.where(np.isfinite(error), error, 0.0)[rows, None]
    cov = tracks["cov"] + moved[:, :, None] * moved[:, None, :]
    err = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    fitted = np.column_stack([tracks[name] for name in helix.PARAMETERS])
    columns = {f"err_{name}": err[:, i] for i, name in enumerate(helix.PARAMETERS)}
    return tracks.with_columns(cov=cov, err_p=helix.momentum_error(fitted, cov), **columns)
