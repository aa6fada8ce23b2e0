"""Factors of a chip in the errors of its clusters, found with simulated clusters in many designs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields, replace
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from cgemit.analysis.widths import measure
from cgemit.base.arrays import Floats
from cgemit.base.validate import check_numbers
from cgemit.chain.run import run
from cgemit.detector import Detector, ReadoutGroup, load
from cgemit.detector.gas import MAX_B, drift_columns
from cgemit.detector.layers.layer import local_v
from cgemit.detector.readouts import AnalogReadout, ChargeReadout, ChipErrors, Estimator
from cgemit.particles.table import particles_from
from cgemit.reconstruction.cluster import charge_clusterer
from cgemit.reconstruction.cluster_errors import ErrorInputs, error_inputs
from cgemit.reconstruction.clusterers.charge import ChargeClusterer
from cgemit.tables import Table
from cgemit.truth import assign

Ints = npt.NDArray[np.int64]
Some = TypeVar("Some", bound=ChargeReadout)


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
    own = assign.own_clusters(detector, clusters, truths)
    rows = clusters["truth"][own]
    view, layer = clusters["view"][own].astype(np.int64), clusters["layer"][own].astype(np.int64)
    residual = assign.residuals(detector, clusters, truths, own)
    error = np.where(view == 0, clusters["err_x"][own], clusters["err_v"][own])
    slope = crossing_slopes(detector, truths)[rows, view] - lorentz_slopes(detector, lorentz)[layer, view]
    size, first = (clusters[name][own].astype(np.int64) for name in ("size", "first"))
    return Measurements(residual, error, slope, size, clusters["charge"][own], view, layer, rows, first)


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


def _keys(sample: Measurements) -> Ints:
    """Return a number for each cluster, the same in all samples of the same digis."""
    return np.asarray((2 * sample.truth + sample.view) * (1 << 20) + sample.first)


def inside_of_sheet(detector: Detector, sample: Measurements) -> npt.NDArray[np.bool_]:
    """Return which clusters have strips of their sheet on both sides, as has their crossing's X, (clusters,) bool.

    V shares the charge of X, and its error with the charge that X has lost.

    Parameters
    ----------
    detector : Detector
    sample : Measurements
    """
    strips = np.array([(layer.strips_x, layer.strips_v) for layer in detector.cgem])[sample.layer, sample.view]
    inside = (sample.first > 0) & (sample.first + sample.size < strips)
    return np.asarray(inside & ~np.isin(sample.truth, sample.truth[~inside & (sample.view == 0)]))


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
    for number, layer in enumerate(detector.cgem):
        here = truths["layer"] == number
        dx, dz = layer.r_readout * turn[here], (above - below)[here]
        across = np.column_stack([dx, local_v(layer, dx, layer.z_ref + dz)])
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
    own = assign.own_clusters(detector, clusters, truths)
    rows = clusters["truth"][own]
    directions[own, 0] = crossing_slopes(detector, truths)[rows, clusters["view"][own].astype(np.int64)]
    directions[own, 1] = crossing_paths(truths)[rows]
    return directions


_RADII = (60.0, 250.0)  # mm, of the layers
_APART = 25.0  # mm, of their radii at least
_PITCHES, _GAPS, _STEREO = (0.3, 1.2), (3.0, 8.0), (20.0, 50.0)  # mm, mm, deg
_DISPLACED = 50.0  # mm, from the beam line, of tracks with other slopes than those of the beam line
_MOMENTA = (0.3, 10.0)  # GeV/c, of muons, even in the logarithm
_COS_THETA = 0.9
_RANGE = 2.0  # factor up and down, of gain and threshold
_WITHOUT_FIELD = 0.2  # share of the designs


class Design(NamedTuple):
    """A detector of three CGEM layers and a readout, drawn at random."""

    detector: Detector
    readout: ChargeReadout


def design(readout: Some, number: int) -> Design:
    """Return one of the designs in which errors are found and shown.

    Parameters
    ----------
    readout : ChargeReadout
    number : int
        Even ones are those in which the factors are found.
    """
    random = np.random.default_rng([7, number])
    while True:
        radii = np.sort(random.uniform(*_RADII, 3))
        if np.diff(radii).min() > _APART:
            break
    layers = {}
    for label, radius in zip(("L1", "L2", "L3"), radii, strict=True):
        pitch, gap = random.uniform(*_PITCHES), random.uniform(*_GAPS)
        layers[label] = {
            "anode_radius": f"{radius:.2f} mm", "length": "900 mm", "sheets": 1, "phi_first": "180 deg",
            "pitch_x": f"{pitch:.3f} mm", "pitch_v": f"{pitch:.3f} mm", "drift_gap": f"{gap:.2f} mm",
            "stereo": f"{random.choice([-1, 1]) * random.uniform(*_STEREO):.1f} deg",
        }  # fmt: skip
    bz = 1e-3 if random.random() < _WITHOUT_FIELD else random.uniform(0, MAX_B)
    detector = load({
        "base": "besiii-cgem-design", "name": f"design {number}", "remove": ["beam_pipe", "walls", "drift_chamber"],
        "field": {"kind": "uniform", "bz": f"{bz:.3f} T"}, "cgem": layers,
    })  # fmt: skip
    gain, threshold = (_RANGE ** float(random.uniform(-1, 1)) for _ in range(2))
    if isinstance(readout, AnalogReadout):
        changed = {"threshold_x": threshold * readout.threshold_x, "threshold_v": threshold * readout.threshold_v}
    else:
        changed = {"threshold": threshold * readout.threshold}
    return Design(detector, replace(readout, gain=gain * readout.gain, **changed))


def with_estimator(readout: ChargeReadout, estimator: str) -> ChargeReadout:
    """Return a readout whose clusters have another position."""
    changed: dict[str, Any] = {"estimator": estimator}
    return replace(readout, **changed)


def muons(n: int, seed: int, displaced: float) -> Table:
    """Return the particles table of muons of both charges, at most `displaced` (mm) from the beam line."""
    random = np.random.default_rng(seed)
    phi, cos_theta = random.uniform(0, 2 * np.pi, n), random.uniform(-_COS_THETA, _COS_THETA, n)
    low, high = np.log(_MOMENTA).tolist()
    p = np.exp(random.uniform(low, high, n))
    away, sine = random.uniform(-displaced, displaced, n), np.sqrt(1 - cos_theta**2)
    return particles_from(
        {
            "event": np.arange(n), "pdg": 13 * random.choice([-1, 1], n), "x": -away * np.sin(phi),
            "y": away * np.cos(phi), "z": np.zeros(n), "px": p * sine * np.cos(phi), "py": p * sine * np.sin(phi),
            "pz": p * cos_theta,
        }
    )  # fmt: skip


class Terms(NamedTuple):
    """Residuals and variances of clusters as sums of factors times these."""

    residual: Floats  # (n,) mm, with heights as the chip gives them
    heights: Floats  # (n,) mm, what the factor of heights adds to the residual
    fixed: Floats  # (n,) mm2, variance without factors
    variances: dict[str, Floats]  # (n,) mm2, by the factor


_HEIGHT = "height_by_threshold"
_FACTORS = tuple(one.name for one in fields(ChipErrors) if one.name != _HEIGHT)


def terms(
    detector: Detector,
    readout: ChargeReadout,
    digis: Table,
    truths: Table,
    *,
    of_track: bool,
    heights: ChipErrors | None,
) -> Terms:
    """Return the terms of the clusters of true crossings that end inside of their sheets.

    At the edge of a sheet charge is lost: errors there are no sum of terms (docs/methods/readout.md, Lost charge).

    Parameters
    ----------
    detector : Detector
    readout : ChargeReadout
    digis, truths : Table
    of_track : bool
        Whether clusters know the direction of their crossing.
    heights : ChipErrors or None
        Whose heights the residuals have; None: those without corrections.
    """
    clusterer, inputs = charge_clusterer(readout), error_inputs(detector, readout)
    (group,) = detector.with_readout(readout).groups
    none = {one.name: 0.0 for one in fields(ChipErrors)}
    if heights is not None:
        none[_HEIGHT] = heights.height_by_threshold

    def measured(changed: dict[str, float], directions: Floats | None) -> tuple[Table, Measurements]:
        chip = inputs.chip | none | changed
        table = _clusters(clusterer, group, digis, inputs._replace(chip=chip), directions)
        return table, measurements(detector, table, truths, lorentz=clusterer.lorentz)

    directions = true_directions(detector, measured({}, None)[0], truths) if of_track else None

    def of(changed: dict[str, float]) -> Measurements:
        _, found = measured(changed, directions)
        order = np.argsort(_keys(found))
        return Measurements._make(values[order] for values in found)

    # With other factors another part of a divided cluster can be that of the crossing: differences are then of two
    # parts, negative ones too, and whether a crossing counts is decided once.
    whole = of({})
    inside = inside_of_sheet(detector, whole)
    base = Measurements._make(values[inside] for values in whole)
    moved = (of({_HEIGHT: 1e-3}).residual[inside] - base.residual) / 1e-3
    variances = {name: np.maximum(of({name: 1.0}).error[inside] ** 2 - base.error**2, 0.0) for name in _FACTORS}
    return Terms(base.residual, moved, base.error**2, variances)


_FARTHEST = 2.0  # widths, beyond which residuals count less
_ROUNDS = 20
_TAIL, _WIDER = 0.05, 4.0  # share and width, over that of the core, of clusters with charge of something else


def fitted_height(sample: Terms) -> float:
    """Return the factor of heights with which residuals are zero in the mean; tails count little."""
    height = 0.0
    for _ in range(_ROUNDS):
        left = sample.residual + sample.heights * height
        width = float(np.median(np.abs(left))) / 0.6745
        weight = 1 / (1 + (left / (_FARTHEST * width)) ** 2)
        weighted = sample.heights * weight
        height = -float(weighted @ sample.residual / (weighted @ sample.heights))
    return height


def fitted_factors(sample: Terms, names: tuple[str, ...], given: dict[str, float]) -> dict[str, float]:
    """Return the factors with which the residuals are most likely: a Gaussian core and a wider tail.

    Parameters
    ----------
    sample : Terms
    names : tuple of str
        The factors that are found.
    given : dict of str to float
        The others.
    """
    from scipy.optimize import minimize

    rest = sample.fixed + sum(value * sample.variances[name] for name, value in given.items())
    own = np.array([sample.variances[name] for name in names])

    def unlikely(logarithms: Floats) -> float:
        variance = rest + np.exp(logarithms) @ own
        square = sample.residual**2 / variance
        core = (1 - _TAIL) * np.exp(-0.5 * square) + _TAIL / _WIDER * np.exp(-0.5 * square / _WIDER**2)
        return -float(np.mean(np.log(core + 1e-300) - 0.5 * np.log(variance)))

    start = np.full(len(names), -1.0)
    for _ in range(2):
        start = minimize(unlikely, start, method="Nelder-Mead", options={"maxiter": 1500, "fatol": 1e-7}).x
    return dict(zip(names, np.exp(start).tolist(), strict=True))


def fit_errors(
    readout: ChargeReadout, *, designs: int = 16, n: int = 3000, seed: int = 1, threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> ChipErrors:  # fmt: skip
    """Return the factors of a chip in the errors of its clusters, from muons in designs that differ.

    Pitch, gap, stereo angle and radius of three layers, field, gain and threshold are drawn at random; the even ones of
    `design` are used.

    Parameters
    ----------
    readout : ChargeReadout
    designs : int
    n : int
        Muons in each, half of them displaced from the beam line.
    seed : int
    threads : int or None
    progress : callable or None
        Called with the fraction done.
    """
    check_numbers("fit_errors", seed, threads)
    timed = isinstance(readout, AnalogReadout)
    digitized = []
    for number in range(designs):
        at = design(readout, 2 * number)
        for displaced in (0.0, _DISPLACED):
            result = run(
                at.detector, muons(n // 2, seed + number, displaced), seed=seed + number, readout=at.readout,
                until="digitize", workers=threads,
            )  # fmt: skip
            digitized.append((at, displaced > 0, result.digis, result.truths))
        if progress is not None:
            progress(0.5 * (number + 1) / designs)

    def sample(estimator: str, of_track: bool, heights: ChipErrors | None) -> Terms:
        parts = [
            terms(at.detector, with_estimator(at.readout, estimator), digis, truths, of_track=of_track, heights=heights)
            for at, displaced, digis, truths in digitized
            if of_track or not displaced
        ]
        return Terms(
            np.concatenate([one.residual for one in parts]), np.concatenate([one.heights for one in parts]),
            np.concatenate([one.fixed for one in parts]),
            {name: np.concatenate([one.variances[name] for one in parts]) for name in _FACTORS},
        )  # fmt: skip

    factors = dict.fromkeys((one.name for one in fields(ChipErrors)), 0.0)
    if timed:
        factors[_HEIGHT] = fitted_height(sample("merged", True, None))
    heights = ChipErrors(**factors)
    centroid = sample("centroid", False, heights)
    if not timed:
        return ChipErrors(**factors | fitted_factors(centroid, ("ionization", "cut", "wide"), {}))
    merged = sample("merged", True, heights)
    of_merged = ("diffusion", "span", "time", "wide")
    for _ in range(3):  # each takes the others' factors
        others = {name: factors[name] for name in of_merged}
        factors |= fitted_factors(centroid, ("ionization", "cut"), others)
        factors |= fitted_factors(merged, of_merged, {"cut": factors["cut"]})
    line = {name: factors[name] for name in (*of_merged, "cut")}
    factors |= fitted_factors(sample("micro-tpc", False, heights), ("line",), line)
    if progress is not None:
        progress(1.0)
    return ChipErrors(**factors)


def _clusters(
    clusterer: ChargeClusterer, group: ReadoutGroup, digis: Table, inputs: ErrorInputs, directions: Floats | None = None
) -> Table:
    return Table("clusters", clusterer.columns(group, digis, inputs, 0, directions), **digis.cover)


class PullBin(NamedTuple):
    """Pulls of the clusters of a range of one quantity."""

    quantity: str
    low: float
    high: float
    clusters: int
    mean: float  # median, with the sign of the slope
    core: float
    beyond: float  # share beyond three errors


_BINS: dict[str, tuple[float, ...]] = {
    "slope": (0, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.2, 2.0), "strips": (1, 2, 3, 4, 5, 6, 7, 9, 12, 100),
    "charge": (0, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 1.0), "view": (0, 1, 2),
}  # fmt: skip


def pulls(
    readout: ChargeReadout, *, estimator: Estimator | None = None, of_track: bool = True,
    errors: ChipErrors | None = None, designs: int = 16, n: int = 3000, seed: int = 1, threads: int | None = None,
) -> list[PullBin]:  # fmt: skip
    """Return the pulls of clusters in the odd ones of `design`, which no fit of factors has seen.

    Charge is counted by its order among the clusters of a design; "design" is the number of the design.

    Parameters
    ----------
    readout : ChargeReadout
    estimator : str or None
        None: as the readout says.
    of_track : bool
        Whether clusters know the directions of their crossings; then half of the muons are displaced.
    errors : ChipErrors or None
        None: those of the readout.
    designs, n, seed, threads
        See `fit_errors`.
    """
    check_numbers("pulls", seed, threads)
    parts: list[tuple[npt.NDArray[Any], ...]] = []
    for number in range(designs):
        at = design(readout, 2 * number + 1)
        own = with_estimator(at.readout, estimator or readout.estimator)
        clusterer, inputs = charge_clusterer(own), error_inputs(at.detector, own)
        (group,) = at.detector.with_readout(own).groups
        if errors is not None:
            inputs = inputs._replace(chip=inputs.chip | asdict(errors))
        for displaced in (0.0, _DISPLACED) if of_track else (0.0,):
            particles = muons(n // 2, 1000 + seed + number, displaced)
            result = run(
                at.detector, particles, seed=1000 + seed + number, readout=own, until="digitize", workers=threads
            )
            clusters = _clusters(clusterer, group, result.digis, inputs)
            if of_track:
                directions = true_directions(at.detector, clusters, result.truths)
                clusters = _clusters(clusterer, group, result.digis, inputs, directions)
            measured = measurements(at.detector, clusters, result.truths, lorentz=clusterer.lorentz)
            rank = np.argsort(np.argsort(measured.charge)) / len(measured.charge)
            pull = measured.residual / measured.error
            of_design = np.full(len(pull), float(number))
            parts.append(
                (
                    pull,
                    np.sign(measured.slope),
                    np.abs(measured.slope),
                    measured.size * 1.0,
                    rank,
                    measured.view * 1.0,
                    of_design,
                )
            )
    pull, sign, *values = (np.concatenate(column) for column in zip(*parts, strict=True))
    by = dict(zip(("slope", "strips", "charge", "view", "design"), values, strict=True))
    bins = [("all", -np.inf, np.inf, np.ones(len(pull), bool))]
    for name, edges in (_BINS | {"design": tuple(range(designs + 1))}).items():
        bins += [(name, low, high, (by[name] >= low) & (by[name] < high)) for low, high in pairwise(edges)]
    return [
        PullBin(
            name, low, high, int(np.count_nonzero(here)), float(np.median((pull * sign)[here])),
            float(measure(pull[here], parameter="pull", unit="").core), float(np.mean(np.abs(pull[here]) > 3)),
        )
        for name, low, high, here in bins
        if np.count_nonzero(here) >= 200
    ]  # fmt: skip


def as_toml(name: str, found: ChipErrors) -> str:
    """Return the table of a file such as ``cluster_errors.toml``.

    Parameters
    ----------
    name : str
        Of the readout.
    found : ChipErrors
    """
    return "\n".join([f"[{name}]", *(f"{key} = {value:.3g}" for key, value in asdict(found).items())]) + "\n"
