"""Calibration of the cluster errors of an analog read-out with a reference sample (docs/methods/readout.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from cgemit.analysis.widths import measure
from cgemit.chain.result import Result
from cgemit.chain.run import run
from cgemit.covariance.analytic import entries_with
from cgemit.covariance.tracks import points_of
from cgemit.detector import Detector
from cgemit.detector.gas import drift_columns
from cgemit.detector.parts import local_v
from cgemit.detector.readouts import CalibratedReadout, Estimator
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.cluster import calibrated_clusterer
from cgemit.reconstruction.cluster_errors import (
    CHARGES,
    COS_THETA,
    DISTANCES,
    ESTIMATORS,
    PAIR,
    PATH_KNOTS,
    SIZES,
    SLOPE_EDGES,
    SLOPE_KNOTS,
    SLOPE_SIZES,
    Calibration,
    key_of,
    neutral,
)
from cgemit.reconstruction.find import truth
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

FEWEST = 200  # clusters that give a number of their own


class Measurements(NamedTuple):
    """Clusters of true crossings."""

    residual: Floats  # (n,) mm
    error: Floats  # (n,) mm
    slope: Floats  # (n,), of the electrons' places of origin at the anode, across the strips per radius
    size: Ints  # (n,)
    charge: Floats  # (n,) fC
    view: Ints  # (n,)
    layer: Ints  # (n,)
    truth: Ints  # (n,)
    first: Ints  # (n,), first strip


def measurements(detector: Detector, clusters: Table, truths: Table, *, lorentz: bool = True) -> Measurements:
    """Return residual, slope and size of the clusters of true crossings, as `own_clusters` links them.

    Parameters
    ----------
    detector : Detector
    clusters, truths : Table
    lorentz : bool
        Whether electrons drift at the Lorentz angle, which then is part of the slope.
    """
    own = truth.own_clusters(detector, clusters, truths)
    rows = clusters["truth"][own]
    view, layer = clusters["view"][own].astype(np.int64), clusters["layer"][own].astype(np.int64)
    residual = truth.residuals(detector, clusters, truths, own)
    error = np.where(view == 0, clusters["err_x"][own], clusters["err_v"][own])
    slope = crossing_slopes(detector, truths)[rows, view] - lorentz_slopes(detector, lorentz)[layer, view]
    size, first = (clusters[name][own].astype(np.int64) for name in ("size", "first"))
    return Measurements(residual, error, slope, size, clusters["charge"][own], view, layer, rows, first)


def lorentz_slopes(detector: Detector, lorentz: bool) -> Floats:
    """Return what the Lorentz angle takes from the slopes of X and V at the anode, (layers, 2) float64.

    Parameters
    ----------
    detector : Detector
    lorentz : bool
        Whether electrons drift at it.
    """
    tangent = drift_columns(detector)["tan_lorentz"] if lorentz else np.zeros(len(detector.cgem))
    return np.array(
        [
            np.array([tan, tan * np.cos(one.stereo)]) * (one.r_readout / one.r_mid)
            for tan, one in zip(tangent, detector.cgem, strict=True)
        ]
    )


def common(one: Measurements, other: Measurements) -> tuple[Measurements, Measurements]:
    """Return the measurements of the clusters that are in both samples, in the same order.

    Parameters
    ----------
    one, other : Measurements
        Of the same digis; of a crossing with several clusters they may have different ones.
    """
    _, rows, other_rows = np.intersect1d(_keys(one), _keys(other), return_indices=True)
    first = Measurements._make(values[rows] for values in one)
    return first, Measurements._make(values[other_rows] for values in other)


def distances(sample: Measurements, centroid: Measurements, line: Measurements) -> Floats:
    """Return how far centroid and line of each cluster are apart, (n,) float64 mm; 0 where one of them is missing.

    Parameters
    ----------
    sample, centroid, line : Measurements
        Of the same digis; of a crossing with several clusters they may have different ones.
    """
    centroid, line = common(centroid, line)
    key, known = _keys(sample), _keys(centroid)
    at = np.minimum(np.searchsorted(known, key), len(known) - 1)
    return np.where(known[at] == key, np.abs(centroid.residual - line.residual)[at], 0.0)


def _keys(sample: Measurements) -> Ints:
    """Return a number for each cluster, the same in all samples of the same digis."""
    return np.asarray((2 * sample.truth + sample.view) * (1 << 20) + sample.first)


def crossing_slopes(detector: Detector, truths: Table) -> Floats:
    """Return dX/dr and dV/dr at the anode of true crossings, (n, 2) float64.

    Parameters
    ----------
    detector : Detector
    truths : Table
    """
    (inner, first, below), (outer, last, above) = _ends(truths)
    turn = np.angle(np.exp(1j * (last - first)))
    slopes = np.zeros((len(truths), 2))
    for number, one in enumerate(detector.cgem):
        here = truths["layer"] == number
        dx, dz = one.r_readout * turn[here], (above - below)[here]
        across = np.column_stack([dx, local_v(one, dx, one.z_ref + dz)])
        slopes[here] = across / (outer - inner)[here, None]
    return slopes


def crossing_paths(truths: Table) -> Floats:
    """Return the path per radius of true crossings, (n,) float64.

    Parameters
    ----------
    truths : Table
    """
    (inner, *_), (outer, *_) = _ends(truths)
    path = np.sqrt(sum((truths[f"exit_{axis}"] - truths[f"entry_{axis}"]) ** 2 for axis in "xyz"))
    return np.asarray(path / np.abs(outer - inner))


def _ends(truths: Table) -> list[tuple[Floats, Floats, Floats]]:
    """Return radius, azimuth and z where crossings enter and leave the gap."""
    ends = []
    for end in ("entry", "exit"):
        x, y, z = (truths[f"{end}_{axis}"] for axis in "xyz")
        ends.append((np.hypot(x, y), np.arctan2(y, x), z))
    return ends


def true_directions(detector: Detector, clusters: Table, truths: Table) -> Floats:
    """Return the direction of the crossing of each cluster as `Clusterer.cluster` takes it, NaN where there is none.

    Parameters
    ----------
    detector : Detector
    clusters, truths : Table
    """
    directions = np.full((len(clusters), 2), np.nan)
    own = truth.own_clusters(detector, clusters, truths)
    rows = clusters["truth"][own]
    directions[own, 0] = crossing_slopes(detector, truths)[rows, clusters["view"][own].astype(np.int64)]
    directions[own, 1] = crossing_paths(truths)[rows]
    return directions


def pair_numbers(detector: Detector, clusters: Table, truths: Table) -> Floats:
    """Return the likelihood of pairs of X and V, see `Calibration.pairs`; pairs of two particles are of two events.

    Parameters
    ----------
    detector : Detector
    clusters, truths : Table
    """
    own = truth.own_clusters(detector, clusters, truths)
    found = np.ones((len(detector.cgem), PAIR))
    rows = np.full((2, len(truths)), -1, np.int64)
    rows[clusters["view"][own], clusters["truth"][own]] = own
    for number in range(len(detector.cgem)):
        x, v = rows[:, (rows >= 0).all(axis=0) & (truths["layer"] == number)]
        if len(x) < FEWEST:
            continue
        log_charge = [np.log(np.maximum(clusters["charge"][view], 1e-3)) for view in (x, v)]
        time = [clusters["time"][view] for view in (x, v)]
        for at, (of_x, of_v), least in ((0, log_charge, 0.02), (2, time, 0.5)):
            mean, width = _middle(of_x - of_v)
            found[number, at : at + 2] = mean, max(width, least)
            found[number, 4 + at // 2] = max(_middle(of_x - np.roll(of_v, 1))[1], least)
    return found


def _middle(values: Floats) -> tuple[float, float]:
    """Return median and half of the central 68.3 %."""
    low, middle, high = np.quantile(values, (0.1587, 0.5, 0.8413))
    return float(middle), float(0.5 * (high - low))


_ROUNDS = 5  # of outlier removal
_MEDIAN = 0.6745  # of the distance of a Gaussian variable from its mean, in its sigmas
_CORE = 2.0  # widths, within which residuals count
_USUAL = 0.5  # mm, of depths; keeps those that nothing tells near zero


def known_directions(
    detector: Detector, truths: Table, sample: Measurements, *, of_track: bool, lorentz: bool
) -> tuple[Floats, Floats]:
    """Return slope at the anode and path per radius as the clusters know them, (n,) float64 each.

    Parameters
    ----------
    detector : Detector
    truths : Table
    sample : Measurements
    of_track : bool
        Whether the track is known, else it is a straight one from the beam line.
    lorentz : bool
        Whether electrons drift at the Lorentz angle.
    """
    if of_track:
        return sample.slope, crossing_paths(truths)[sample.truth]
    slope = np.zeros(len(sample.residual))
    rise = truths["z"][sample.truth] / np.array([one.r_mid for one in detector.cgem])[sample.layer]
    for number, one in enumerate(detector.cgem):
        here = (sample.view == 1) & (sample.layer == number)
        slope[here] = local_v(one, np.zeros(np.count_nonzero(here)), one.z_ref + rise[here])
    return slope - lorentz_slopes(detector, lorentz)[sample.layer, sample.view], np.hypot(1, rise)


def set_depths(
    found: Calibration, of_track: bool, which: int, sample: Measurements, direction: tuple[Floats, Floats]
) -> None:
    """Set the depths of one estimator.

    Parameters
    ----------
    found : Calibration
        Changed; had no depths for the estimator when the clusters of the sample were made.
    of_track : bool
    which : int
        In `ESTIMATORS`.
    sample : Measurements
    direction : (ndarray, ndarray)
        See `known_directions`.
    """
    for view, layer in np.ndindex(found.depth.shape[:2]):
        mine = (sample.view == view) & (sample.layer == layer)
        if np.count_nonzero(mine) >= FEWEST:
            depths = _depths(sample.residual[mine], direction[0][mine], direction[1][mine])
            found.direction_depths[int(of_track), which, view, layer] = depths


def _depths(residual: Floats, slope: Floats, path: Floats) -> Floats:
    """Return the depths at all knots, mm, that times the slope give the residuals."""
    terms = np.hstack([_shares(np.abs(slope), SLOPE_KNOTS), _shares(path, PATH_KNOTS)]) * slope[:, None]
    depths: Floats = np.zeros(terms.shape[1])
    for _ in range(_ROUNDS):
        left = residual - terms @ depths
        width = float(np.median(np.abs(left))) / _MEDIAN
        use = np.abs(left) < _CORE * width
        weight = (width / _USUAL) ** 2 * np.eye(len(depths))
        depths = np.asarray(np.linalg.solve(terms[use].T @ terms[use] + weight, terms[use].T @ residual[use]))
    return depths


def _shares(values: Floats, knots: Floats) -> Floats:
    """Return the shares of the knots in values between them, (n, knots) float64."""
    return np.column_stack([np.interp(values, knots, one) for one in np.eye(len(knots))])


_FEWEST_SIZES = 100  # clusters of one charge that give a group of sizes an error of its own
_REFINED = 5  # times that the widths of pulls go into each of the factors


def set_errors(found: Calibration, which: int, sample: Measurements) -> None:
    """Set the errors of one estimator."""
    for view, layer, charge in np.ndindex(found.errors.shape[1:4]):
        own = select(sample, found, (view, layer, charge))
        if len(own.residual) >= FEWEST // 2:
            found.errors[which, view, layer, charge] = _errors(own)


def _errors(sample: Measurements) -> Floats:
    """Return the errors by number of strips, (SIZES,) mm."""
    errors = np.ones(SIZES)
    for first, last in groups(np.minimum(sample.size, SIZES)):
        errors[first - 1 : last] = core_width(
            sample.residual[(sample.size >= first) & (np.minimum(sample.size, SIZES) <= last)]
        )
    return errors


def by_slope(sample: Measurements, found: Calibration) -> Floats:
    """Return the width of residuals by view, layer, range of the slope and size; of all sizes where these are few."""
    values = np.ones(found.slope_shares.shape)
    at, size = slope_cells(sample)
    layers, ranges = found.slope_shares.shape[1:3]
    for view, layer in np.ndindex(2, layers):
        here = (sample.view == view) & (sample.layer == layer)
        numbers = [k for k in range(ranges) if np.count_nonzero(here & (at == k)) >= FEWEST]
        if numbers:
            widths = [core_width(sample.residual[here & (at == k)]) for k in numbers]
            values[view, layer] = np.interp(np.arange(ranges), numbers, widths)[:, None]
        for number, strips in np.ndindex(ranges, SLOPE_SIZES):
            mine = _in_cell(sample, at, size, (view, layer, number, strips))
            if np.count_nonzero(mine) >= FEWEST:
                values[view, layer, number, strips] = core_width(sample.residual[mine])
    return values


def refine(
    found: Calibration, along: int, which: int, sample: Measurements, apart: Floats, direction: tuple[Floats, Floats]
) -> None:
    """Make pulls of unit width in every range of distance, charge, size, slope and path.

    The error is a product of factors; each takes the widths that the others leave, in turns. With the track's angle,
    slope and size have one together.
    """
    slopes = np.searchsorted(SLOPE_KNOTS, np.abs(direction[0]), side="right") - 1
    paths = np.searchsorted(PATH_KNOTS, direction[1], side="right") - 1
    slope, strips = slope_cells(sample)
    for view, layer in np.ndindex(found.errors.shape[1:3]):
        mine = np.flatnonzero((sample.view == view) & (sample.layer == layer))
        size = np.minimum(sample.size[mine], SIZES) - 1
        charge = np.searchsorted(found.edges[view, layer], sample.charge[mine], side="right")
        edges = found.distance_edges[along, view, layer]
        near = np.where(apart[mine] > 0, 1 + np.searchsorted(edges, apart[mine], side="right"), 0)
        by_slope, by_path = np.split(found.direction_factors[along, which, view, layer], [len(SLOPE_KNOTS)])
        factors = found.distance_factors[along, which, view, layer]
        by_charge = (found.charge_factors if along else found.errors)[which, view, layer]
        pull = sample.residual[mine] / by_charge[charge, size]
        if along:
            by_cell = found.slope_errors[which, view, layer]
            pull /= by_cell[slope[mine], strips[mine]]
        for _ in range(_REFINED):
            for number in range(DISTANCES if apart.any() else 0):
                _unit_width(pull, near == number, factors, (number,))
            for number in range(CHARGES):
                for first, last in groups(size[charge == number] + 1):
                    here = (charge == number) & (size >= first - 1) & (size < last)
                    _unit_width(pull, here, by_charge, (number, slice(first - 1, last)))
            for first, last in groups(size + 1):  # sizes that are few at each charge
                _unit_width(pull, (size >= first - 1) & (size < last), by_charge, (slice(None), slice(first - 1, last)))
            if along:
                for cell in np.ndindex(*by_cell.shape):
                    _unit_width(pull, (slope[mine] == cell[0]) & (strips[mine] == cell[1]), by_cell, cell)
            else:
                for number in range(len(SLOPE_KNOTS)):
                    _unit_width(pull, slopes[mine] == number, by_slope, (number,))
            for number in range(len(PATH_KNOTS)):
                _unit_width(pull, paths[mine] == number, by_path, (number,))


def _unit_width(pull: Floats, here: npt.NDArray[np.bool_], errors: Floats, cell: tuple[int | slice, ...]) -> None:
    """Multiply the errors of a cell with the width of its pulls, which then is 1; of few clusters nothing changes."""
    if np.count_nonzero(here) >= _FEWEST_SIZES:
        width = core_width(pull[here])
        errors[cell] *= width
        pull[here] /= width


def select(sample: Measurements, calibration: Calibration, at: tuple[int, ...]) -> Measurements:
    """Return the clusters of one view, layer and range of the charge."""
    view, layer, charge = at
    edges = calibration.edges[view, layer]
    here = (sample.view == view) & (sample.layer == layer)
    here &= np.searchsorted(edges, sample.charge, side="right") == charge
    return Measurements(*(values[here] for values in sample))


def slope_cells(sample: Measurements) -> tuple[Ints, Ints]:
    """Return range of the slope and size, less 1, of each cluster as indices."""
    at = np.searchsorted(SLOPE_EDGES, np.abs(sample.slope), side="right")
    return at, np.minimum(sample.size, SLOPE_SIZES) - 1


def _in_cell(sample: Measurements, at: Ints, size: Ints, cell: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    view, layer, number, strips = cell
    return np.asarray((sample.view == view) & (sample.layer == layer) & (at == number) & (size == strips))


def groups(size: Ints) -> list[tuple[int, int]]:
    """Return ranges of sizes that cover all, each with enough clusters."""
    groups, first = [], 1
    for last in range(1, SIZES + 1):
        if np.count_nonzero((size >= first) & (size <= last)) >= _FEWEST_SIZES:
            groups.append((first, last))
            first = last + 1
    if groups and first <= SIZES:  # what is left joins the last group
        groups[-1] = (groups[-1][0], SIZES)
    return groups or [(1, SIZES)]


def core_width(residual: Floats) -> float:
    """Return the core width of residuals about 0, mm."""
    return float(measure(residual, parameter="position", unit="mm").core)


_USUAL_ERRORS = 0.3  # mm, error of clusters
_SMALLER = np.array([0.1, 0.03])  # mm, of one or two of them
_WRONG = 1e-6  # relative deviation of a variance
_PHI = 0.3  # rad, of the tracks
_VARIANCES = (0, 12)  # of dr and of dz among the entries of the upper triangle of a covariance


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
        return np.where(found.status == 0, found.covariance[:, _VARIANCES[view]], np.nan)

    covariances = np.full((2, len(COS_THETA), 1 + layers, 1 + layers), np.nan)
    for view in range(2):
        usual = variance(view, np.full(layers, _USUAL_ERRORS))
        gains = np.empty((layers, layers, len(_SMALLER), len(COS_THETA)))
        for i, j, k in np.ndindex(gains.shape[:3]):
            own = np.full(layers, _USUAL_ERRORS)
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
    g = 1 / (_SMALLER**-2 - _USUAL_ERRORS**-2)
    found = np.zeros((1 + layers, 1 + layers))
    found[0, 0] = usual
    for i in range(layers):
        one = gains[i, i]
        found[1 + i, 1 + i] = _USUAL_ERRORS**2 / 2  # of a layer without effect
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
    without[:, 1:] -= found[:, 1:] / _USUAL_ERRORS**2
    solved = np.asarray(np.linalg.solve(without, found), np.float64)
    found = (solved + solved.T) / 2
    for i, j, k in np.ndindex(gains.shape):
        errors = np.full((1, layers), _USUAL_ERRORS)
        errors[0, [i, j]] = _SMALLER[k]
        if abs(variance_at_origin(found, errors)[0] - (usual - gains[i, j, k])) > _WRONG * usual:
            return np.full_like(found, np.nan)
    return found


_CORE_WIDTH = 3.0  # errors, within which clusters count in correlations
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
        here = (sample.layer == layer) & (np.abs(pull) < _CORE_WIDTH)
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


_WINDOW = 1.0  # mm, of residuals from which the depth is found
_LEAST_SLOPE = 0.05  # below, heights do not matter and cannot be measured
_STEPS = 3  # of the depth: strips enter and leave the gap as it changes
_LOWEST, _HIGHEST = 0.2, 10.0  # GeV/c, of the muons of known tracks
_MOMENTA = 41  # odd: every charge has all of them
_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9, 0.97)  # of the charge, where ranges begin
_APART = (0.4, 0.7, 0.85, 0.93, 0.97, 0.985)  # quantiles of the distance of centroid and line, the same


def calibrate(
    detector: Detector, readout: CalibratedReadout, *, n: int = 40_000, seed: int = 101, p: float = 1.0,
    cos_theta: float = 0.93, threads: int | None = None,
) -> Calibration:  # fmt: skip
    """Return the calibration of a read-out from muons of both charges.

    Clusters alone are calibrated with muons of one momentum, clusters of known tracks with as many of all curvatures,
    since the slope of a track in X comes from its curvature.

    Parameters
    ----------
    detector : Detector
    readout : CalibratedReadout
    n : int
        Muons of one momentum, half of them of each charge.
    seed : int
    p : float
        GeV/c.
    cos_theta : float
        The samples cover cos(theta) from minus to plus this, uniformly.
    threads : int or None
    """

    def digitized(momenta: list[float], seed: int) -> Result:
        muons = _muons(momenta, n, seed, cos_theta)
        return run(detector, muons, seed=seed, readout=readout, until="digitize", workers=threads)

    lowest = min(p, _LOWEST)
    momenta = (1 / np.linspace(1 / lowest, 1 / max(p, _HIGHEST), _MOMENTA)).tolist()
    about = (
        f"{readout.name}, {detector.name}, {n} mu- and mu+ of {p:g} GeV/c, with the track {n} of {lowest:g} to "
        f"{max(p, _HIGHEST):g} GeV/c, |cos(theta)| < {cos_theta:g}, seed {seed}"
    )
    return calibration_from(digitized([p], seed), readout, about, digitized(momenta, seed + 1))


def _muons(momenta: list[float], n: int, seed: int, cos_theta: float) -> Table:
    """Return the particles table of `n` events with one muon each, charges and momenta in turn."""
    both = [generate(Gun(name, p=momenta, cos_theta=(-cos_theta, cos_theta)), n, seed) for name in ("mu-", "mu+")]
    positive = both[0]["event"] % 2 == 1
    columns = {name: np.where(positive, both[1][name], both[0][name]) for name in both[0].columns}
    return Table("particles", columns, n)


def calibration_from(
    result: Result, readout: CalibratedReadout, about: str, tracked: Result | None = None
) -> Calibration:
    """Return the calibration from the digis of runs.

    Parameters
    ----------
    result : Result
        Up to ``digis`` at least, with one particle in each event.
    readout : CalibratedReadout
        With which they were made.
    about : str
        What the calibration belongs to, for people.
    tracked : Result or None
        Of the clusters that know the angle of their track; None: `result`.
    """
    detector, digis, truths = result.detector, result.digis, result.truths
    clusterer = calibrated_clusterer(readout)
    lorentz, estimators = clusterer.lorentz, clusterer.estimators
    runs = result, result if tracked is None else tracked

    def measured(estimator: Estimator, calibration: Calibration, of_track: bool = False) -> Measurements:
        digis, truths = runs[of_track].digis, runs[of_track].truths
        clusters = clusterer.cluster_with(detector, digis, calibration, estimator=estimator)
        if of_track:
            directions = true_directions(detector, clusters, truths)
            clusters = clusterer.cluster_with(detector, digis, calibration, estimator=estimator, directions=directions)
        return measurements(detector, clusters, truths, lorentz=lorentz)

    def lined(name: Estimator, sample: Measurements, apart: Callable[[Measurements], Floats]) -> Measurements:
        return sample if name == "centroid" else _rows(sample, apart(sample) > 0)  # others have its position

    def known(sample: Measurements, of_track: bool) -> tuple[Floats, Floats]:
        return known_directions(detector, runs[of_track].truths, sample, of_track=of_track, lorentz=lorentz)

    layers = len(detector.cgem)
    found = replace(neutral(layers), key=key_of(detector, readout), about=about)
    first_table = clusterer.cluster_with(detector, digis, found, estimator="centroid")
    first = measurements(detector, first_table, truths, lorentz=lorentz)
    for view, layer in np.ndindex(2, layers):
        charge = first.charge[(first.view == view) & (first.layer == layer)]
        if len(charge) >= FEWEST:
            found.edges[view, layer] = np.quantile(charge, _QUANTILES)
    for at in np.ndindex(found.depth.shape):
        found.height[at] = _depth(select(first, found, at)) if lorentz else 0.0
    has_lines = "micro-tpc" in estimators
    for _ in range(_STEPS if has_lines else 0):
        lines = measured("micro-tpc", found)
        for at in np.ndindex(found.depth.shape):
            found.depth[at] += _depth(select(lines, found, at))
    found.pairs[:] = pair_numbers(detector, first_table, truths)
    for of_track in (False, True):
        pure: dict[Estimator, Measurements] = {
            name: measured(name, found, of_track) for name in estimators if name != "merged"
        }
        apart = _apart(pure)
        for name in pure:
            mine = lined(name, pure[name], apart)
            set_depths(found, of_track, ESTIMATORS.index(name), mine, known(mine, of_track))
        if has_lines:
            _set_distance_edges(found, int(of_track), *common(pure["centroid"], pure["micro-tpc"]))
            centroid, line = common(*(measured(name, found, of_track) for name in ("centroid", "micro-tpc")))
            (_set_slope_shares if of_track else _set_shares)(found, centroid, line)
            sample = lined("merged", measured("merged", found, of_track), apart)
            set_depths(found, of_track, ESTIMATORS.index("merged"), sample, known(sample, of_track))
        for name in estimators:
            which = ESTIMATORS.index(name)
            sample = measured(name, found, of_track)
            if of_track:
                found.slope_errors[which] = by_slope(sample, found)
            else:
                set_errors(found, which, sample)
            refine(found, int(of_track), which, sample, apart(sample), known(sample, of_track))
    runs = result, result  # of one momentum: curvature spreads the errors
    tracks = tracks_of(result.particles, truths, layers)
    p = float(np.median(np.sqrt(sum(result.particles[name] ** 2 for name in ("px", "py", "pz")))))
    for of_track in (False, True):
        for name in estimators:
            sample = measured(name, found, of_track)
            which = ESTIMATORS.index(name)
            rest = rest_of_tracks(detector, p, cores(sample, tracks))
            set_typical(found, int(of_track), which, sample, tracks, rest)
            set_correlations(found, int(of_track), which, sample, tracks)
    return found


def _apart(pure: dict[Estimator, Measurements]) -> Callable[[Measurements], Floats]:
    """Return what gives the distance of centroid and line of clusters, 0 without a line."""
    if "micro-tpc" not in pure:
        return lambda sample: np.zeros(len(sample.residual))
    return lambda sample: distances(sample, pure["centroid"], pure["micro-tpc"])


def _rows(sample: Measurements, rows: npt.NDArray[np.bool_]) -> Measurements:
    return Measurements._make(values[rows] for values in sample)


def _set_distance_edges(found: Calibration, along: int, centroid: Measurements, line: Measurements) -> None:
    """Set the ranges of the distance of centroid and line."""
    apart = np.abs(centroid.residual - line.residual)
    for view, layer in np.ndindex(found.distance_edges.shape[1:3]):
        plane = apart[(centroid.view == view) & (centroid.layer == layer) & (apart > 0)]
        if len(plane) >= FEWEST:
            found.distance_edges[along, view, layer] = np.quantile(plane, _APART)


def _set_shares(found: Calibration, centroid: Measurements, line: Measurements) -> None:
    """Set the weights of centroids in merged positions, by charge and size."""
    for at in np.ndindex(*found.depth.shape):
        own, other = select(centroid, found, at), select(line, found, at)
        for first, last in groups(np.minimum(own.size, SIZES)):
            here = (own.size >= first) & (np.minimum(own.size, SIZES) <= last)
            found.shares[(*at, slice(first - 1, last))] = _share(own.residual[here], other.residual[here])


def _set_slope_shares(found: Calibration, centroid: Measurements, line: Measurements) -> None:
    """Set the weights of centroids in merged positions, by slope and size; of all sizes where these are few."""
    at, size = slope_cells(centroid)
    layers, ranges = found.slope_shares.shape[1:3]
    for view, layer, number in np.ndindex(2, layers, ranges):
        plane = (centroid.view == view) & (centroid.layer == layer) & (at == number)
        found.slope_shares[view, layer, number] = _share(centroid.residual[plane], line.residual[plane])
        for strips in range(SLOPE_SIZES):
            here = plane & (size == strips)
            if np.count_nonzero(here) >= FEWEST:
                found.slope_shares[view, layer, number, strips] = _share(centroid.residual[here], line.residual[here])


def _share(centroid: Floats, line: Floats) -> float:
    """Return the weight of the centroid with which the mean of both has the least variance, from 0 to 1.

    Both follow the same electrons: their covariance counts. Tails do not.
    """
    use = np.ones(len(centroid), np.bool_)
    for _ in range(_ROUNDS):
        if not use.any():
            return 0.5
        spread = [max(3 * float(np.std(values[use])), 1e-9) for values in (centroid, line)]
        use = (np.abs(centroid) < spread[0]) & (np.abs(line) < spread[1])
    apart = centroid[use] - line[use]
    square = float(apart @ apart)
    return float(np.clip(-(line[use] @ apart) / square, 0, 1)) if square > 0 else 0.5


def _depth(sample: Measurements) -> float:
    """Return the height, mm, that times the slope gives the residual.

    An error e of heights moves line fits by -e times the slope, and charge at a mean height h centroids by h times it.
    """
    use, depth = (np.abs(sample.residual) < _WINDOW) & (sample.size > 2), 0.0
    for _ in range(_ROUNDS):
        slope, residual = sample.slope[use], sample.residual[use]
        if len(slope) < FEWEST // 2 or np.sqrt(np.mean(slope**2)) < _LEAST_SLOPE:
            return 0.0
        depth = float(slope @ residual / (slope @ slope))
        left = sample.residual - depth * sample.slope
        use &= np.abs(left) < 3 * np.std(left[use])
    return depth
