"""What a track's other hits and scattering know of its clusters of one view (docs/methods/readout.md)."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import numpy.typing as npt

from cgemit.covariance.asked import points_of
from cgemit.covariance.points import entries_with
from cgemit.covariance.tracks import variances
from cgemit.detector import Detector
from cgemit.digitize.readout import COS_THETA

Floats = npt.NDArray[np.float64]

_USUAL = 0.3  # mm, error of clusters
_SMALLER = np.array([0.1, 0.03])  # mm, of one or two of them
_WRONG = 1e-6  # relative deviation of a variance
_PHI = 0.3  # rad, of the tracks


def rest_of_tracks(detector: Detector, p: float, errors: Floats) -> Floats:
    """Return the covariances of a track at the origin and in the layers, of each view without the clusters of this one.

    Clusters with errors e have the variance at the origin ``[(C^-1 + diag(0, 1/e^2))^-1]_00``. The covariance without
    events gives it for some e, from which C follows but for the signs of the layers.

    Parameters
    ----------
    detector : Detector
    p : float
        GeV/c, momentum of the muons.
    errors : (2, layers) float64, mm
        Of X and V, for the clusters of the other view; NaN: hardly known.

    Returns
    -------
    ndarray, (2, len(COS_THETA), 1 + layers, 1 + layers) float64, mm2
        Of d_rho and the X of the layers; of d_z and their V. NaN where there is none: a track needs hits beside these.
        A layer that the tracks do not cross has no correlation with the others.
    """
    layers = len(detector.cgem)
    errors = np.nan_to_num(errors, nan=1.0)
    points = points_of("mu-", p, COS_THETA, _PHI, samples=1)

    def variance(view: int, own: Floats) -> Floats:
        both = (own, errors[1]) if view == 0 else (errors[0], own)
        found = entries_with(points, detector, *both)
        values = variances(found.covariance, found.sample.kappa, found.sample.tanl, ("dr", "dz")[view])
        return np.where(found.status == 0, values, np.nan)

    covariances = np.full((2, len(COS_THETA), 1 + layers, 1 + layers), np.nan)
    for view in range(2):
        usual = variance(view, np.full(layers, _USUAL))
        gains = np.empty((layers, layers, len(_SMALLER), len(COS_THETA)))
        for i, j, k in np.ndindex(gains.shape[:3]):
            own = np.full(layers, _USUAL)
            own[[i, j]] = _SMALLER[k]
            gains[i, j, k] = usual - variance(view, own)
        for number in np.flatnonzero(np.isfinite(usual)):
            covariances[view, number] = _covariance(float(usual[number]), gains[..., number])
    return covariances


def variance_at_origin(covariance: Floats, errors: Floats) -> Floats:
    """Return the variance at the origin of tracks with clusters, (n,) float64 mm2.

    Parameters
    ----------
    covariance : (1 + layers, 1 + layers) float64, mm2
        See `rest_of_tracks`.
    errors : (n, layers) float64, mm
    """
    own, shared = covariance[1:, 1:], covariance[0, 1:]
    measured = own + errors[:, :, None] ** 2 * np.eye(len(shared))
    solved = np.linalg.solve(measured, np.broadcast_to(shared[:, None], (len(errors), len(shared), 1)))
    return np.asarray(covariance[0, 0] - solved[:, :, 0] @ shared)


def _covariance(usual: float, gains: Floats) -> Floats:
    """Return the covariance of one direction, (1 + layers, 1 + layers) mm2; NaN if there is none.

    With clusters of usual errors the covariance is U. More information 1/g of one cluster makes the variance smaller by
    ``U_0i^2 / (g + U_ii)``, of two by ``u^T (g + U)^-1 u`` with their entries of U.

    Parameters
    ----------
    usual : float, mm2
        The variance at the origin with them.
    gains : (layers, layers, len(_SMALLER)) float64, mm2
        By how much it is less if these two clusters, or one, have smaller errors.
    """
    layers = len(gains)
    g = 1 / (_SMALLER**-2 - _USUAL**-2)
    found = np.zeros((1 + layers, 1 + layers))
    found[0, 0] = usual
    for i in range(layers):
        one = gains[i, i]
        found[1 + i, 1 + i] = _USUAL**2 / 2  # of a layer without effect
        if (one > _WRONG**2 * usual).all():
            square = (g[0] - g[1]) / (1 / one[0] - 1 / one[1])
            found[0, 1 + i] = found[1 + i, 0] = np.sqrt(square)
            found[1 + i, 1 + i] = square / one[0] - g[0]
    for i, j in combinations(range(layers), 2):
        shared = found[0, 1 + i] * found[0, 1 + j]
        if shared > 0:
            both = gains[i, j]
            square = (g + found[1 + i, 1 + i]) * (g + found[1 + j, 1 + j]) * (both - gains[i, i]) * (both - gains[j, j])
            root = np.sqrt(np.maximum(square, 0))
            entries = (shared + np.outer([1, -1], root)) / both  # for each smaller error one of the two is right
            first, second = min(product((0, 1), repeat=2), key=lambda at: abs(entries[at[0], 0] - entries[at[1], 1]))
            found[1 + i, 1 + j] = found[1 + j, 1 + i] = (entries[first, 0] + entries[second, 1]) / 2
    without = np.eye(1 + layers)
    without[:, 1:] -= found[:, 1:] / _USUAL**2
    solved = np.asarray(np.linalg.solve(without, found), np.float64)
    found = (solved + solved.T) / 2
    for i, j, k in np.ndindex(gains.shape):
        errors = np.full((1, layers), _USUAL)
        errors[0, [i, j]] = _SMALLER[k]
        if abs(variance_at_origin(found, errors)[0] - (usual - gains[i, j, k])) > _WRONG * usual:
            return np.full_like(found, np.nan)
    return found
