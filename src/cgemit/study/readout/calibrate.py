"""Calibration of the cluster errors of an analog read-out with a reference sample (docs/methods/readout.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.chain import run
from cgemit.detector import Detector
from cgemit.digitize.calibration import (
    ESTIMATORS,
    SIZES,
    SLOPE_SIZES,
    Calibration,
    key_of,
    neutral,
)
from cgemit.gun import Gun, generate
from cgemit.result import Result
from cgemit.study.readout.direction import known_directions, set_depths
from cgemit.study.readout.errors import (
    by_slope,
    groups,
    refine,
    select,
    set_errors,
    slope_cells,
)
from cgemit.study.readout.measure import (
    FEWEST,
    Measurements,
    common,
    distances,
    measurements,
    pair_numbers,
    true_directions,
)
from cgemit.study.readout.rest_of_track import rest_of_tracks
from cgemit.study.readout.typical import cores, set_correlations, set_typical, tracks_of
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_WINDOW = 1.0  # mm, of residuals from which the depth is found
_ROUNDS = 5  # of outlier removal
_LEAST_SLOPE = 0.05  # below, heights do not matter and cannot be measured
_STEPS = 3  # of the depth: strips enter and leave the gap as it changes
_LOWEST, _HIGHEST = 0.2, 10.0  # GeV/c, of the muons of known tracks
_MOMENTA = 41  # odd: every charge has all of them
_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9, 0.97)  # of the charge, where ranges begin
_APART = (0.4, 0.7, 0.85, 0.93, 0.97, 0.985)  # quantiles of the distance of centroid and line, the same


def calibrate(
    detector: Detector, readout: Any, *, n: int = 40_000, seed: int = 101, p: float = 1.0, cos_theta: float = 0.93,
    threads: int | None = None,
) -> Calibration:  # fmt: skip
    """Return the calibration of a read-out from muons of both charges.

    Clusters alone are calibrated with muons of one momentum, clusters of known tracks with as many of all curvatures,
    since the slope of a track in X comes from its curvature.

    Parameters
    ----------
    detector : Detector
    readout : AnalogReadout or ProjectionReadout
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
        return run(detector, muons, seed=seed, readout=readout, until="digitize", threads=threads)

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


def calibration_from(result: Result, readout: Any, about: str, tracked: Result | None = None) -> Calibration:
    """Return the calibration from the digis of runs.

    Parameters
    ----------
    result : Result
        Up to ``digis`` at least, with one particle in each event.
    readout : AnalogReadout or ProjectionReadout
        With which they were made.
    about : str
        What the calibration belongs to, for people.
    tracked : Result or None
        Of the clusters that know the angle of their track; None: `result`.
    """
    detector, digis, truths = result.detector, result.digis, result.truths
    runs = result, result if tracked is None else tracked

    def measured(estimator: str, calibration: Calibration, of_track: bool = False) -> Measurements:
        one = replace(readout, estimator=estimator)
        digis, truths = runs[of_track].digis, runs[of_track].truths
        clusters = one.cluster_with(detector, digis, calibration)
        if of_track:
            directions = true_directions(detector, clusters, truths)
            clusters = one.cluster_with(detector, digis, calibration, directions=directions)
        return measurements(detector, clusters, truths, lorentz=readout.lorentz)

    def lined(name: str, sample: Measurements, apart: Callable[[Measurements], Floats]) -> Measurements:
        return sample if name == "centroid" else _rows(sample, apart(sample) > 0)  # others have its position

    def known(sample: Measurements, of_track: bool) -> tuple[Floats, Floats]:
        return known_directions(detector, runs[of_track].truths, sample, of_track=of_track, lorentz=readout.lorentz)

    layers = len(detector.cgem)
    found = replace(neutral(layers), key=key_of(detector, readout), about=about)
    first_table = replace(readout, estimator="centroid").cluster_with(detector, digis, found)
    first = measurements(detector, first_table, truths, lorentz=readout.lorentz)
    for view, layer in np.ndindex(2, layers):
        charge = first.charge[(first.view == view) & (first.layer == layer)]
        if len(charge) >= FEWEST:
            found.edges[view, layer] = np.quantile(charge, _QUANTILES)
    for at in np.ndindex(found.depth.shape):
        found.height[at] = _depth(select(first, found, at)) if readout.lorentz else 0.0
    has_lines = "micro-tpc" in readout.estimators
    for _ in range(_STEPS if has_lines else 0):
        lines = measured("micro-tpc", found)
        for at in np.ndindex(found.depth.shape):
            found.depth[at] += _depth(select(lines, found, at))
    found.pairs[:] = pair_numbers(detector, first_table, truths)
    for of_track in (False, True):
        pure = {name: measured(name, found, of_track) for name in readout.estimators if name != "merged"}
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
        for name in readout.estimators:
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
        for name in readout.estimators:
            sample = measured(name, found, of_track)
            which = ESTIMATORS.index(name)
            rest = rest_of_tracks(detector, p, cores(sample, tracks))
            set_typical(found, int(of_track), which, sample, tracks, rest)
            set_correlations(found, int(of_track), which, sample, tracks)
    return found


def _apart(pure: dict[str, Measurements]) -> Callable[[Measurements], Floats]:
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
