"""Calibration of the cluster errors of an analog read-out with a reference sample (docs/methods/readout.md)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import find
from cgemit.chain import run
from cgemit.detector import Detector
from cgemit.detector.strips import local_v
from cgemit.digitize.analog_cluster import CHARGES, ESTIMATORS, SIZES, Calibration, key_of, neutral
from cgemit.digitize.transport import drift_columns
from cgemit.gun import Gun
from cgemit.result import Result
from cgemit.statistics.estimate import measure
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_FEWEST = 200  # clusters that give an error of their own
_WINDOW = 1.0  # mm, of residuals from which the depth is found
_ROUNDS = 5  # of outlier removal
_LEAST_SLOPE = 0.05  # below, heights do not matter and cannot be measured
_STEPS = 3  # of the depth: strips enter and leave the gap as it changes
_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)  # of the charge, where ranges begin


class Measurements(NamedTuple):
    """Clusters of true crossings."""

    residual: Floats  # (n,) mm
    slope: Floats  # (n,), of the electrons' places of origin at the anode, across the strips per radius
    size: Ints  # (n,)
    charge: Floats  # (n,) fC
    view: Ints  # (n,)
    layer: Ints  # (n,)


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
    slope, tangent = (
        np.zeros(len(own)),
        drift_columns(detector)["tan_lorentz"] if lorentz else np.zeros(len(detector.cgem)),
    )
    ends = []
    for end in ("entry", "exit"):
        x, y, z = (truths[f"{end}_{axis}"][rows] for axis in "xyz")
        ends.append((np.hypot(x, y), np.arctan2(y, x), z))
    turn = np.angle(np.exp(1j * (ends[1][1] - ends[0][1])))
    for number, one in enumerate(detector.cgem):
        here = layer == number
        dx, dz = one.r_readout * turn[here], (ends[1][2] - ends[0][2])[here]
        dv = local_v(one, dx, one.z_ref + dz)
        bend = tangent[number] * one.r_readout / one.r_mid * np.where(view[here] == 0, 1.0, np.cos(one.stereo))
        slope[here] = np.where(view[here] == 0, dx, dv) / (ends[1][0] - ends[0][0])[here] - bend
    return Measurements(residual, slope, clusters["size"][own].astype(np.int64), clusters["charge"][own], view, layer)


def calibrate(
    detector: Detector, readout: Any, *, n: int = 20_000, seed: int = 101, p: float = 1.0, cos_theta: float = 0.93,
    threads: int | None = None,
) -> Calibration:  # fmt: skip
    """Return the calibration of a read-out from muons of one momentum.

    Parameters
    ----------
    detector : Detector
    readout : AnalogReadout or ProjectionReadout
    n : int
        Muons.
    seed : int
    p : float
        GeV/c.
    cos_theta : float
        The sample covers cos(theta) from minus to plus this, uniformly.
    threads : int or None
    """
    result = run(
        detector, Gun("mu-", p=p, cos_theta=(-cos_theta, cos_theta)), n, seed, readout=readout, until="digitize",
        threads=threads,
    )  # fmt: skip
    about = f"{readout.name}, {detector.name}, {n} mu- of {p:g} GeV/c, |cos(theta)| < {cos_theta:g}, seed {seed}"
    return calibration_from(result, readout, about)


def calibration_from(result: Result, readout: Any, about: str) -> Calibration:
    """Return the calibration from the digis of a run.

    Parameters
    ----------
    result : Result
        Up to ``digis`` at least.
    readout : AnalogReadout or ProjectionReadout
        With which they were made.
    about : str
        What the calibration belongs to, for people.
    """
    detector, digis, truths = result.detector, result.digis, result.truths

    def measured(estimator: str, calibration: Calibration) -> Measurements:
        one = replace(readout, estimator=estimator)
        return measurements(detector, one.cluster_with(detector, digis, calibration), truths, lorentz=readout.lorentz)

    layers = len(detector.cgem)
    found = replace(neutral(layers), key=key_of(detector, readout), about=about)
    first = measured("centroid", found)
    for view, layer in np.ndindex(2, layers):
        charge = first.charge[(first.view == view) & (first.layer == layer)]
        if len(charge) >= _FEWEST:
            found.edges[view, layer] = np.quantile(charge, _QUANTILES)
    for at in np.ndindex(found.depth.shape):
        found.height[at] = _depth(_select(first, found, at)) if readout.lorentz else 0.0
    for _ in range(_STEPS if "micro-tpc" in readout.estimators else 0):
        lines = measured("micro-tpc", found)
        for at in np.ndindex(found.depth.shape):
            found.depth[at] += _depth(_select(lines, found, at))
    for estimator in readout.estimators:
        which, sample = ESTIMATORS.index(estimator), measured(estimator, found)
        for view, layer in np.ndindex(2, layers):
            plane = sample.residual[(sample.view == view) & (sample.layer == layer)]
            if len(plane) >= _FEWEST:
                found.typical_errors[which, view, layer] = _width(plane)
                for charge in range(CHARGES):
                    found.errors[which, view, layer, charge] = _errors(_select(sample, found, (view, layer, charge)))
    return found


def _select(sample: Measurements, calibration: Calibration, at: tuple[int, ...]) -> Measurements:
    """Return the clusters of one view, layer and range of the charge."""
    view, layer, charge = at
    edges = calibration.edges[view, layer]
    here = (sample.view == view) & (sample.layer == layer)
    here &= np.searchsorted(edges, sample.charge, side="right") == charge
    return Measurements(*(values[here] for values in sample))


def _depth(sample: Measurements) -> float:
    """Return the height, mm, that times the slope gives the residual.

    An error e of heights moves line fits by -e times the slope, and charge at a mean height h centroids by h times it.
    """
    use, depth = (np.abs(sample.residual) < _WINDOW) & (sample.size > 2), 0.0
    for _ in range(_ROUNDS):
        slope, residual = sample.slope[use], sample.residual[use]
        if len(slope) < _FEWEST // 2 or np.sqrt(np.mean(slope**2)) < _LEAST_SLOPE:
            return 0.0
        depth = float(slope @ residual / (slope @ slope))
        left = sample.residual - depth * sample.slope
        use &= np.abs(left) < 3 * np.std(left[use])
    return depth


def _errors(sample: Measurements) -> Floats:
    """Return the errors by number of strips, (SIZES,) mm."""
    errors = np.ones(SIZES)
    for first, last in _groups(np.minimum(sample.size, SIZES)):
        errors[first - 1 : last] = _width(
            sample.residual[(sample.size >= first) & (np.minimum(sample.size, SIZES) <= last)]
        )
    return errors


def _groups(size: Ints) -> list[tuple[int, int]]:
    """Return ranges of sizes that cover all, each with enough clusters."""
    groups, first = [], 1
    for last in range(1, SIZES + 1):
        if np.count_nonzero((size >= first) & (size <= last)) >= _FEWEST:
            groups.append((first, last))
            first = last + 1
    if groups and first <= SIZES:  # what is left joins the last group
        groups[-1] = (groups[-1][0], SIZES)
    return groups or [(1, SIZES)]


def _width(residual: Floats) -> float:
    """Return the core width of residuals about 0, mm."""
    return float(measure(residual, parameter="position", unit="mm").core)
