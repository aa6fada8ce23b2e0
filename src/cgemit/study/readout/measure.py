"""Clusters of a read-out beside the true crossings that made them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import find
from cgemit.detector import Detector
from cgemit.detector.strips import local_v
from cgemit.digitize.calibration import (
    PAIR,
)
from cgemit.digitize.transport import drift_columns
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
    """Return residual, slope and size of the clusters of true crossings, see `cgemit.find.own_clusters`.

    Parameters
    ----------
    detector : Detector
    clusters, truths : Table
    lorentz : bool
        Whether electrons drift at the Lorentz angle, which then is part of the slope.
    """
    own = find.own_clusters(detector, clusters, truths)
    rows = clusters["truth"][own]
    view, layer = clusters["view"][own].astype(np.int64), clusters["layer"][own].astype(np.int64)
    residual = find.residuals(detector, clusters, truths, own)
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
    """Return the direction of the crossing of each cluster as `find_clusters` takes it, NaN where there is none.

    Parameters
    ----------
    detector : Detector
    clusters, truths : Table
    """
    directions = np.full((len(clusters), 2), np.nan)
    own = find.own_clusters(detector, clusters, truths)
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
    own = find.own_clusters(detector, clusters, truths)
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
