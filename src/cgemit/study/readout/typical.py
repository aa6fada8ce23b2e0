"""One error for all clusters of a view and layer, and the correlation of X and V, by cos(theta) of the track."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from cgemit.digitize.calibration import Calibration
from cgemit.digitize.readout import COS_THETA
from cgemit.fit import FitSettings
from cgemit.study.readout.errors import core_width
from cgemit.study.readout.measure import FEWEST, Measurements
from cgemit.study.readout.rest_of_track import variance_at_origin
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_CORE = 3.0  # errors, within which clusters count in correlations
_FAR = FitSettings().outlier_pull
_DRAWS = 4  # of the rest of each track
_FACTORS = (0.2, 20.0)  # of typical errors, over core widths


class Tracks(NamedTuple):
    """The tracks of a sample, one particle in each event."""

    cos_theta: Floats  # (tracks,)
    of_truth: Ints  # (truths,), row of the track of each crossing
    crossed: npt.NDArray[np.bool_]  # (tracks, layers)


def tracks_of(particles: Table, truths: Table, layers: int) -> Tracks:
    """Return the tracks of a run.

    Parameters
    ----------
    particles, truths : Table
    layers : int

    Raises
    ------
    ValueError
        If an event has several particles.
    """
    event = particles["event"]
    if (np.diff(event) <= 0).any():
        raise ValueError("particles: got events with several particles, expected one in each event of a calibration")
    px, py, pz = (particles[name] for name in ("px", "py", "pz"))
    of_truth = np.searchsorted(event, truths["event"])
    crossed = np.zeros((len(particles), layers), np.bool_)
    crossed[of_truth, truths["layer"]] = True
    return Tracks(np.asarray(pz / np.sqrt(px**2 + py**2 + pz**2)), of_truth, crossed)


def set_typical(found: Calibration, along: int, which: int, sample: Measurements, tracks: Tracks, rest: Floats) -> None:
    """Set the errors, equal for all clusters of a view and layer, with which tracks are as precise as with these.

    They are the core widths of the residuals, times a factor: tracks are fitted with the residuals of their clusters
    and the errors of these, and clusters far from the rest of their track are left out, as in the fit. The factor is
    the one with which equal Gaussian errors give the core width at the origin. It holds what a fit gains from errors
    that differ, and loses by tails and by clusters that are left out. Tracks of a range of cos(theta) have their own
    errors; ranges with few have those of the nearest others.

    Parameters
    ----------
    found : Calibration
        Changed.
    along, which : int
    sample : Measurements
    tracks : Tracks
    rest : (2, len(COS_THETA), 1 + layers, 1 + layers) float64, mm2
        Of both views, see `rest_of_tracks`. Where it is NaN the factor is 1.
    """
    near = nearest_cos_theta(tracks.cos_theta)
    for view in range(2):
        residual, error = _by_track(sample, view, tracks)
        errors = np.full((residual.shape[1], 1 + len(COS_THETA)), np.nan)  # of all tracks, and by cos(theta)
        errors[:, 0] = _cores(residual)
        for number in range(len(COS_THETA)):
            mine = near == number
            errors[:, 1 + number] = _equal_errors(residual[mine], error[mine], tracks.crossed[mine], rest[view, number])
        _fill(found.typical_errors[along, which, view], errors)


def cores(sample: Measurements, tracks: Tracks) -> Floats:
    """Return the core widths of the residuals of X and V, (2, layers) float64 mm; NaN of layers with few clusters."""
    return np.array([_cores(_by_track(sample, view, tracks)[0]) for view in range(2)])


def _by_track(sample: Measurements, view: int, tracks: Tracks) -> tuple[Floats, Floats]:
    """Return residuals and errors of a view, (tracks, layers) mm each, NaN: no cluster."""
    found = np.full((2, *tracks.crossed.shape), np.nan)
    mine = sample.view == view
    place = tracks.of_truth[sample.truth[mine]], sample.layer[mine]
    found[0][place], found[1][place] = sample.residual[mine], sample.error[mine]
    return found[0], found[1]


def _fill(values: Floats, measured: Floats) -> None:
    """Set (layers, len(COS_THETA)) values to measured ones of all tracks and by cos(theta), NaN where there are few."""
    for own, (of_all, *by_angle) in zip(values, measured, strict=True):
        known = np.isfinite(by_angle)
        if known.any():
            own[:] = np.interp(COS_THETA, COS_THETA[known], np.array(by_angle)[known])
        elif np.isfinite(of_all):
            own[:] = of_all


def _cores(residual: Floats) -> Floats:
    """Return the core widths of (tracks, layers) residuals, mm; NaN of layers with few clusters."""
    widths = np.full(residual.shape[1], np.nan)
    for layer, own in enumerate(residual.T):
        there = own[np.isfinite(own)]
        if len(there) >= FEWEST:
            widths[layer] = core_width(there)
    return widths


def _equal_errors(residual: Floats, error: Floats, crossed: npt.NDArray[np.bool_], rest: Floats) -> Floats:
    """Return the typical errors of layers, mm, NaN of layers with few clusters; of (tracks, layers), NaN: no cluster.

    `rest` is the covariance of the tracks at the origin and in the layers without these clusters.
    """
    core = _cores(residual)
    layers = np.flatnonzero(np.isfinite(core))
    used = crossed[:, layers].all(axis=1)
    if not len(layers) or np.count_nonzero(used) < FEWEST or not np.isfinite(rest).all():
        return core
    places = np.append(0, 1 + layers)
    rest = rest[np.ix_(places, places)]
    width = core_width(misses(residual[used][:, layers], error[used][:, layers], rest))

    def excess(factor: float) -> float:
        return float(np.sqrt(variance_at_origin(rest, factor * core[None, layers])[0])) - width

    low, high = _FACTORS
    if excess(low) >= 0 or excess(high) <= 0:  # clusters do not matter at the origin
        return core
    return np.asarray(core * brentq(excess, low, high))


def misses(residual: Floats, error: Floats, rest: Floats) -> Floats:
    """Return by how much fits miss tracks at the origin, some for each track.

    Tracks are drawn from `rest`. Their clusters are at the residuals from them. Those far from the track without them
    are left out, the farthest first.

    Parameters
    ----------
    residual, error : (tracks, layers) float64, mm
        NaN: no cluster.
    rest : (1 + layers, 1 + layers) float64, mm2
        See `rest_of_tracks`.

    Returns
    -------
    ndarray, (4 tracks,) float64, mm
        Of all tracks in order, four times.
    """
    residual, error = np.tile(residual, (_DRAWS, 1)), np.tile(error, (_DRAWS, 1))
    states = drawn(rest, len(residual))
    there = np.isfinite(residual)
    weight = np.where(there, error, np.inf) ** -2
    place = states[:, 1:] + np.where(there, residual, 0.0)
    diagonal, rows = np.arange(1, len(rest)), np.arange(len(residual))
    while True:
        smaller = np.tile(np.eye(len(rest)), (len(residual), 1, 1))  # 1 + rest * weights, for rest may be singular
        smaller[:, :, 1:] += rest[:, 1:] * weight[:, None, :]
        covariance = np.linalg.solve(smaller, np.broadcast_to(rest, smaller.shape))
        fitted = (covariance[:, :, 1:] @ (weight * place)[:, :, None])[:, :, 0]
        shares = 1 - weight * covariance[:, diagonal, diagonal]  # of a residual to the track without the cluster
        pulls = weight * (place - fitted[:, 1:]) ** 2 / shares
        worst = pulls.argmax(axis=1)
        far = pulls[rows, worst] > _FAR**2
        if not far.any():
            return np.asarray(fitted[:, 0] - states[:, 0])
        weight[rows[far], worst[far]] = 0


def drawn(covariance: Floats, n: int) -> Floats:
    """Return vectors of a covariance, always the same, (n, its size) float64."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(
        np.random.default_rng(0).standard_normal((n, len(values))) * np.sqrt(np.maximum(values, 0)) @ vectors.T
    )


def set_correlations(found: Calibration, along: int, which: int, sample: Measurements, tracks: Tracks) -> None:
    """Set the correlations of the errors of X and V of one crossing, those beyond three errors left out.

    Parameters
    ----------
    found : Calibration
        Changed.
    along, which : int
    sample : Measurements
    tracks : Tracks
    """
    pull = sample.residual / sample.error
    layers = found.correlations.shape[2]
    values = np.full((layers, 1 + len(COS_THETA)), np.nan)  # of all tracks, and by cos(theta)
    for layer in range(layers):
        here = (sample.layer == layer) & (np.abs(pull) < _CORE)
        x, v = (np.flatnonzero(here & (sample.view == view)) for view in (0, 1))
        truth, of_x, of_v = np.intersect1d(sample.truth[x], sample.truth[v], return_indices=True)
        pulls = np.array([pull[x[of_x]], pull[v[of_v]]])
        near = nearest_cos_theta(tracks.cos_theta[tracks.of_truth[truth]])
        for number in range(values.shape[1]):
            mine = near == number - 1 if number else np.ones(len(near), np.bool_)
            if np.count_nonzero(mine) >= FEWEST:
                values[layer, number] = np.corrcoef(pulls[:, mine])[0, 1]
    _fill(found.correlations[along, which], values)


def nearest_cos_theta(cos_theta: Floats) -> Ints:
    """Return the number of the nearest of `COS_THETA`, (n,) int64."""
    return np.asarray(np.searchsorted(0.5 * (COS_THETA[1:] + COS_THETA[:-1]), cos_theta))
