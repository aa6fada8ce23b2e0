"""What tracks know from their clusters: equal errors that serve as well, and correlations, by cos(theta)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.digitize.calibration import Calibration
from cgemit.digitize.readout import COS_THETA
from cgemit.study.readout.errors import core_width
from cgemit.study.readout.measure import FEWEST, Measurements

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_CORE = 3.0  # errors, within which clusters count in correlations
_TAILS = 5.0  # errors, beyond which the fit drops hits


def set_typical(
    found: Calibration, along: int, which: int, sample: Measurements, event: Ints, cos_theta: Floats, radii: Floats
) -> None:
    """Set the errors, equal for all clusters of a view and layer, with which tracks are as precise as with these.

    They are the core widths of the residuals, times a factor: a straight line is fitted to the clusters of each track
    with their own errors; clusters beyond five errors are left out, as in the fit. The core of its intercepts at the
    beam line over that for equal Gaussian errors is the factor. It holds what a fit gains from errors that differ, and
    loses by tails and by clusters that are left out. Tracks of a range of cos(theta) have their own errors; where they
    are few, those of all.

    Parameters
    ----------
    found : Calibration
        Changed.
    along, which : int
    sample : Measurements
    event : (n,) int64
        Of each cluster.
    cos_theta : (events,) float64
        Of the track of each event.
    radii : (layers,) float64, mm
    """
    near = nearest_cos_theta(cos_theta)
    for view in range(2):
        widths = found.typical_errors[along, which, view]
        residual = np.full((len(cos_theta), len(radii)), np.nan)
        error = np.full(residual.shape, np.nan)
        for layer in range(len(radii)):
            mine = (sample.view == view) & (sample.layer == layer)
            residual[event[mine], layer] = sample.residual[mine]
            error[event[mine], layer] = sample.error[mine]
        layers, errors = _equal_errors(residual, error, radii)
        widths[layers] = errors[:, None]
        for number in range(len(COS_THETA)):
            layers, errors = _equal_errors(residual[near == number], error[near == number], radii)
            widths[layers, number] = errors


def _equal_errors(residual: Floats, error: Floats, radii: Floats) -> tuple[Ints, Floats]:
    """Return the layers with enough clusters, and their typical errors, mm; of (tracks, layers), NaN: no cluster."""
    layers = np.flatnonzero(np.count_nonzero(np.isfinite(residual), axis=0) >= FEWEST)
    core = np.array([core_width(one[np.isfinite(one)]) for one in residual.T[layers]])
    good = np.abs(residual) < _TAILS * error
    used = np.count_nonzero(good, axis=1) >= 2
    if len(layers) < max(2, len(radii)) or np.count_nonzero(used) < FEWEST:
        return layers, core
    weight = np.where(good, error, np.inf)[used] ** -2
    intercepts = (_at_beam_line(weight, radii) * np.where(good, residual, 0.0)[used]).sum(axis=1)
    equal = _at_beam_line(core[None] ** -2, radii)[0]
    return layers, core * (core_width(intercepts) / float(np.sqrt(np.sum((equal * core) ** 2))))


def _at_beam_line(weight: Floats, radii: Floats) -> Floats:
    """Return what each layer adds to the intercept at radius 0 of a straight line, (tracks, layers) float64."""
    s, x, xx = ((weight * radii**power).sum(axis=1, keepdims=True) for power in range(3))
    return np.asarray(weight * (xx - x * radii) / (s * xx - x * x))


def set_correlations(found: Calibration, along: int, which: int, sample: Measurements, cos_theta: Floats) -> None:
    """Set the correlations of the errors of X and V of one crossing, those beyond three errors left out.

    Parameters
    ----------
    found : Calibration
        Changed.
    along, which : int
    sample : Measurements
    cos_theta : (truths,) float64
        Of the track of each crossing.
    """
    pull = sample.residual / sample.error
    for layer in range(found.correlations.shape[2]):
        here = (sample.layer == layer) & (np.abs(pull) < _CORE)
        x, v = (np.flatnonzero(here & (sample.view == view)) for view in (0, 1))
        truth, of_x, of_v = np.intersect1d(sample.truth[x], sample.truth[v], return_indices=True)
        pulls, near = np.array([pull[x[of_x]], pull[v[of_v]]]), nearest_cos_theta(cos_theta[truth])
        for knots in (slice(None), *range(len(COS_THETA))):
            mine = np.ones(len(near), np.bool_) if isinstance(knots, slice) else near == knots
            if np.count_nonzero(mine) >= FEWEST:
                found.correlations[along, which, layer, knots] = np.corrcoef(pulls[:, mine])[0, 1]


def nearest_cos_theta(cos_theta: Floats) -> Ints:
    """Return the number of the nearest of `COS_THETA`, (n,) int64."""
    return np.asarray(np.searchsorted(0.5 * (COS_THETA[1:] + COS_THETA[:-1]), cos_theta))
