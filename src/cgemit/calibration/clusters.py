"""Constants of clusters from tracks: errors of X and V, and the Lorentz angle (docs/how-to/monitor.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgemit.analysis.hits import HitResiduals, hit_residuals, residuals_of
from cgemit.base.arrays import Flags, Floats
from cgemit.chain.result import Result
from cgemit.detector.gas import layer_drift
from cgemit.detector.layers import CgemLayer
from cgemit.detector.parts import cgem_numbers
from cgemit.detector.readouts import AnalogReadout
from cgemit.reconstruction.cluster_errors import LARGEST_SIZE, ErrorFactors, refuse_other_errors, with_factors
from cgemit.tables.schema import HIT_V, HIT_X
from cgemit.tables.show import Shown, Tabular, with_error

#: Hits that a factor or an angle needs; a class of clusters with fewer takes the factor of the layer or of the view.
LEAST_HITS = 20
#: Fits of the tracks, and the relative step of a factor that ends them.
TURNS, STAYS = 12, 0.003
#: Smallest factor: errors of tracks may leave nothing for the clusters.
SMALLEST = 0.1


def cluster_error_factors(result: Result) -> ErrorFactors:
    """Find by how much the errors of clusters are wrong, from the residuals of tracks.

    A residual r from the track fitted without the hit has the variance f^2 s^2 + t^2, with the error s of the cluster
    and t of the track. The factor f of a layer, view and number of strips makes the weighted mean of r^2 - t^2 that of
    f^2 s^2. Tracks are fitted again with the factors until they stay, since t depends on them. Residuals beyond five
    errors do not count. The factors cover whatever widens residuals, such as a layer that is not aligned.

    Parameters
    ----------
    result : Result
        Of clusters with charge (tiger, apv25, analog-projection); no truth is needed.

    Returns
    -------
    ErrorFactors
        `ErrorFactors.save` writes the table that the setting `cluster.error_factors` reads. Classes with fewer than 20
        hits have the factor of their layer and view, or of their view, or 1.

    Raises
    ------
    ValueError
        If the result has no tracks, or errors of its clusters follow from the number of strips (readout binary).

    Examples
    --------
    >>> muons = cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7))
    >>> r = cg.run("besiii-cgem", muons, n=100, readout="tiger")
    >>> factors = cg.cluster_error_factors(r)
    >>> bool(((factors.factor > 0.5) & (factors.factor < 2)).all())
    True
    """
    clusters, wires = result.fitted_hits
    refuse_other_errors("cluster_error_factors", clusters)
    hits = hit_residuals(result)
    factors = _no_factors(result)
    for _ in range(TURNS):
        renewed = _factors(factors, hits)
        step = np.abs(renewed.factor / factors.factor - 1).max(initial=0.0)
        factors = renewed
        if step < STAYS:
            break
        hits = residuals_of(result, with_factors(result.detector, clusters, factors), wires)
    return factors


def _no_factors(result: Result) -> ErrorFactors:
    """Return factors of 1 for all classes of clusters."""
    classes = [
        (number, view, size)
        for number in cgem_numbers(result.detector)
        for view in (0, 1)
        for size in range(1, LARGEST_SIZE + 1)
    ]
    layer, view, size = np.array(classes, np.int64).reshape(-1, 3).T
    ones = np.ones(len(classes))
    return ErrorFactors(layer, view, size, np.zeros(len(classes), np.int64), ones, np.full(len(classes), np.nan))


def _factors(before: ErrorFactors, hits: HitResiduals) -> ErrorFactors:
    """Return the factors that residuals of clusters with the former factors tell."""
    size = np.minimum(hits.size, LARGEST_SIZE)
    factor, err, count = np.ones(len(before.layer)), np.full(len(before.layer), np.nan), np.zeros(len(before.layer))
    good = hits.counts & (hits.view < 2)
    for i, (layer, view, of_size) in enumerate(zip(before.layer, before.view, before.size, strict=True)):
        of_view = good & (hits.view == view)
        of_layer = of_view & (hits.layer == layer)
        classes = (of_layer & (size == of_size), of_layer, of_view)
        count[i] = np.count_nonzero(classes[0])
        rows = next((one for one in classes if np.count_nonzero(one) >= LEAST_HITS), None)
        if rows is not None:
            factor[i], err[i] = _factor(hits, rows, before.of_hits(hits.layer, hits.view, hits.size))
    return ErrorFactors(before.layer, before.view, before.size, count.astype(np.int64), factor, err)


def _factor(hits: HitResiduals, rows: Flags, before: Floats) -> tuple[float, float]:
    """Return the factor on the first errors of some hits and its error; `before`: the factors they have."""
    variance = hits.err[rows] ** 2
    scaled = hits.own[rows] ** 2
    first = scaled / before[rows] ** 2
    track = np.maximum(variance - scaled, 0.0)
    weight = first / variance**2
    needed = np.sum(weight * first)
    square = float(np.sum(weight * (hits.residual[rows] ** 2 - track)) / needed)
    # The square of a residual has the standard deviation sqrt(2) of its variance.
    err_square = float(np.sqrt(2 * np.sum((weight * variance) ** 2)) / needed)
    factor = max(math.sqrt(max(square, 0.0)), SMALLEST)
    return factor, err_square / (2 * factor)


@dataclass(frozen=True, eq=False, repr=False)
class LorentzAngles(Shown, Tabular):
    """Lorentz angles in the drift gaps from data, one row for each CGEM layer and one for all together.

    Attributes
    ----------
    label : list of str
        Of the layer; ``"all"``: one angle for all of them.
    hits : list of int
        Tracks with an X and a V cluster.
    assumed, angle, err : ndarray, (n,) float64
        rad, without sign: what the clusters were made with, what the residuals tell, and its error. NaN with fewer than
        20 hits.
    shift : ndarray, (n,) float64, mm
        Shift in X from mid-gap to the anode that the clusters were made with; NaN for all together.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=40, readout="tiger")
    >>> found = cg.lorentz_angles(r)
    >>> found.label
    ['L1', 'L2', 'L3', 'all']
    """

    label: list[str]
    hits: list[int]
    assumed: Floats
    angle: Floats
    err: Floats
    shift: Floats

    @property
    def overrides(self) -> dict[str, str]:
        """Settings for `Detector.with_overrides`; layers with too few hits have the angle of all together.

        They keep the shift from mid-gap to the anode: tracks do not tell it from a rotation of the layer, and X of
        charge from mid-gap stays where it is.
        """
        settings = {}
        for label, alone, shift in zip(self.label[:-1], self.angle[:-1], self.shift[:-1], strict=True):
            angle = alone if np.isfinite(alone) else self.angle[-1]
            if np.isfinite(angle):
                settings[f"cgem.{label}.lorentz_angle"] = f"{angle:.6g} rad"
                settings[f"cgem.{label}.lorentz_shift"] = f"{shift:.6g} mm"
        return settings

    def columns(self) -> dict[str, Sequence[Any]]:
        """Return the rows as columns."""
        return {name: list(column) for name, column in vars(self).items()}

    def _table(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]]]:
        degrees = 180 / np.pi
        rows = [
            [label, str(n), f"{degrees * assumed:.2f}", with_error(degrees * angle, degrees * err)]
            for label, n, assumed, angle, err in zip(
                self.label, self.hits, self.assumed, self.angle, self.err, strict=True
            )
        ]
        return "Lorentz angles of drift gaps", ("layer", "crossings", "assumed (deg)", "from data (deg)"), rows


def lorentz_angles(result: Result) -> LorentzAngles:
    """Find the Lorentz angles of the drift gaps from the times of X clusters.

    Charge from a depth d = v t of the gap is displaced by d tan(a) along X, and clusters are corrected for this. If
    the angle is wrong, the residual of X grows with the time t of the cluster, the mean over its charge, by
    v (R/r) (tan(a) - tan(a0)). The slope is the covariance of residual and time of the V cluster of the same track over
    that of the times of X and V: an error of the time of X moves X, too, and would make a slope of its own. Position
    and start time change only the mean. A velocity v that differs from the gas table's scales the result.

    Parameters
    ----------
    result : Result
        With clusters that have times; no truth is needed.

    Raises
    ------
    ValueError
        If the result has no tracks, or no layer with a readout that measures time.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=100, readout="tiger")
    >>> found = cg.lorentz_angles(r)
    >>> bool((np.abs(found.angle - found.assumed) < 5 * found.err).all())
    True
    """
    detector = result.detector
    layers = [
        (layer_number, layer)
        for layer_number in cgem_numbers(detector)
        if isinstance(layer := detector.layers[layer_number], CgemLayer) and isinstance(layer.readout, AnalogReadout)
    ]
    if not layers:
        raise ValueError(f"lorentz_angles: {detector.name} has no readout with times, expected such as readout='tiger'")
    hits = hit_residuals(result)
    sign = float(np.copysign(1.0, detector.field.bz))
    tangents, samples, shifts = [], [], []
    for layer_number, layer in layers:
        drift = layer_drift(layer, detector.field.bz)
        x, times = _pairs(hits.select((hits.layer == layer_number) & hits.counts & np.isfinite(hits.time)))
        per_time = drift.velocity * layer.r_readout / layer.r_mid
        readout = layer.readout
        tangents.append(abs(drift.tan_lorentz) if isinstance(readout, AnalogReadout) and readout.lorentz else 0.0)
        shifts.append(layer.r_readout * (drift.shift + drift.tan_lorentz * math.log(layer.r_gap_out / layer.r_mid)))
        samples.append(np.array([1 / x.err**2, x.residual, per_time * x.time, per_time * times]))
    tangents.append(float(np.mean(tangents)))
    angles = [_angle([one], sign, tangent) for one, tangent in zip(samples, tangents[:-1], strict=True)]
    angles.append(_angle(samples, sign, tangents[-1]))
    counts = [one.shape[1] for one in samples]
    angle, err = np.array(angles, np.float64).T
    return LorentzAngles(
        [*(layer.label for _, layer in layers), "all"], [*counts, sum(counts)], np.arctan(tangents), angle, err,
        np.array([*shifts, math.nan]),
    )  # fmt: skip


def _pairs(hits: HitResiduals) -> tuple[HitResiduals, Floats]:
    """Return the X hits of one layer of tracks that have one of V, too, and the times of V."""
    v = hits.select(hits.view == HIT_V)
    time_of = dict(zip(v.track.tolist(), v.time.tolist(), strict=True))
    x = hits.select((hits.view == HIT_X) & np.isin(hits.track, v.track))
    return x, np.array([time_of[track] for track in x.track.tolist()], np.float64)


def _angle(samples: list[Floats], sign: float, tangent: float) -> tuple[float, float]:
    """Return the angle and its error, rad, of layers with weight, residual, depth by X and depth by V; NaN with few."""
    if sum(one.shape[1] for one in samples) < LEAST_HITS:
        return math.nan, math.nan
    weight = np.concatenate([one[0] for one in samples])
    residual, depth_x, depth_v = np.concatenate(
        [one[1:] - np.average(one[1:], axis=1, weights=one[0])[:, None] for one in samples if one.shape[1]], axis=1
    )
    spread = float(np.sum(weight * depth_v * depth_x))
    slope = float(np.sum(weight * depth_v * residual)) / spread
    rest = residual - slope * depth_x
    wanted = tangent + sign * slope
    err = math.sqrt(float(np.sum((weight * depth_v * rest) ** 2))) / abs(spread)
    return math.atan(wanted), err / (1 + wanted**2)
