"""One error for all clusters of a view and layer, and the correlation of X and V, by cos(theta) of the track."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit.digitize.calibration import Calibration
from cgemit.digitize.readout import COS_THETA
from cgemit.study.readout.errors import core_width
from cgemit.study.readout.measure import FEWEST, Measurements
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_CORE = 3.0  # errors, within which clusters count in correlations
_TAILS = 5.0  # errors, beyond which the fit drops hits


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


def set_typical(
    found: Calibration, along: int, which: int, sample: Measurements, tracks: Tracks, radii: Floats
) -> None:
    """Set the errors, equal for all clusters of a view and layer, with which tracks are as precise as with these.

    They are the core widths of the residuals, times a factor: a straight line is fitted to the clusters of each track
    with their own errors; clusters beyond five errors are left out, as in the fit. The core of its intercepts at the
    beam line over that for equal Gaussian errors is the factor. It holds what a fit gains from errors that differ, and
    loses by tails and by clusters that are left out. Tracks of a range of cos(theta) have their own errors; ranges with
    few have those of the nearest others.

    Parameters
    ----------
    found : Calibration
        Changed.
    along, which : int
    sample : Measurements
    tracks : Tracks
    radii : (layers,) float64, mm
    """
    near = nearest_cos_theta(tracks.cos_theta)
    for view in range(2):
        residual = np.full((len(near), len(radii)), np.nan)
        error = np.full(residual.shape, np.nan)
        for layer in range(len(radii)):
            mine = (sample.view == view) & (sample.layer == layer)
            row = tracks.of_truth[sample.truth[mine]]
            residual[row, layer] = sample.residual[mine]
            error[row, layer] = sample.error[mine]
        errors = np.full((len(radii), 1 + len(COS_THETA)), np.nan)  # of all tracks, and by cos(theta)
        for number in range(errors.shape[1]):
            rows = near == number - 1 if number else np.ones(len(near), np.bool_)
            layers, own = _equal_errors(residual[rows], error[rows], tracks.crossed[rows], radii)
            errors[layers, number] = own
        _fill(found.typical_errors[along, which, view], errors)


def _fill(values: Floats, measured: Floats) -> None:
    """Set (layers, len(COS_THETA)) values to measured ones of all tracks and by cos(theta), NaN where there are few."""
    for own, (of_all, *by_angle) in zip(values, measured, strict=True):
        known = np.isfinite(by_angle)
        if known.any():
            own[:] = np.interp(COS_THETA, COS_THETA[known], np.array(by_angle)[known])
        elif np.isfinite(of_all):
            own[:] = of_all


def _equal_errors(
    residual: Floats, error: Floats, crossed: npt.NDArray[np.bool_], radii: Floats
) -> tuple[Ints, Floats]:
    """Return the layers with enough clusters, and their typical errors, mm; of (tracks, layers), NaN: no cluster."""
    layers = np.flatnonzero(np.count_nonzero(np.isfinite(residual), axis=0) >= FEWEST)
    residual, error, radii = residual[:, layers], error[:, layers], radii[layers]
    core = np.array([core_width(one[np.isfinite(one)]) for one in residual.T])
    good = np.abs(residual) < _TAILS * error
    used = (np.count_nonzero(good, axis=1) >= 2) & crossed[:, layers].all(axis=1)
    if len(layers) < 2 or np.count_nonzero(used) < FEWEST:
        return layers, core
    weight = np.where(good, error, np.inf)[used] ** -2
    intercepts = (_at_beam_line(weight, radii) * np.where(good, residual, 0.0)[used]).sum(axis=1)
    equal = _at_beam_line(core[None] ** -2, radii)[0]
    return layers, core * (core_width(intercepts) / float(np.sqrt(np.sum((equal * core) ** 2))))


def _at_beam_line(weight: Floats, radii: Floats) -> Floats:
    """Return what each layer adds to the intercept at radius 0 of a straight line, (tracks, layers) float64."""
    s, x, xx = ((weight * radii**power).sum(axis=1, keepdims=True) for power in range(3))
    return np.asarray(weight * (xx - x * radii) / (s * xx - x * x))


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
