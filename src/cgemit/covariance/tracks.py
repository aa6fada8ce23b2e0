"""The tracks of a grid of points: particles, momenta, angles, mixtures over a range."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.analysis.widths import SECOND_INSIDE
from cgemit.base.arrays import Floats
from cgemit.base.errors import Problems, WrongValueError
from cgemit.base.validate import NO, check_whole, number_of, split_values
from cgemit.base.validate import Quantity as Limits
from cgemit.chain.executor import Workers, pool_of
from cgemit.detector import Detector
from cgemit.detector.gas import clusters_per_mm, enough_electrons, most_lost
from cgemit.detector.keys import Part, once
from cgemit.detector.layers import Layer
from cgemit.detector.layers.wires import DriftChamber
from cgemit.helix import path_to
from cgemit.particles.species import species
from cgemit.reconstruction.fit import FitSettings, compiled_for_fit
from cgemit.units import QuantityError

#: Fields of the core's model of the expected hits.
HitModel = dict[str, Any]


_CHUNK = 4096  # tracks of one task


@dataclass(frozen=True, eq=False)
class Tracks:
    """The tracks of all points and samples, and how their covariances are computed."""

    detector: Detector
    fit: FitSettings
    model: HitModel
    phi: Floats  # azimuth of the momentum at the origin; this and the following (tracks,)
    kappa: Floats
    tanl: Floats
    mass: Floats
    charge: Floats  # e, unsigned
    scatters: Floats  # 1 for trajectories that scatter, with the angles of their sample; 0 for the expected trajectory
    samples: int
    phases: Floats
    threads: int | None
    efficiencies: Floats  # (tracks, layers) probability of clusters; (0,): they are certain
    alignment: Floats | None = None  # (tracks, 15) covariance that errors of constants add

    def run(
        self, budget: bool, variants: Sequence[_core.detector.Detector] = (), hits: bool = False
    ) -> dict[str, npt.NDArray[Any]]:
        """Return the columns of the core, computed in chunks on all cores; those of variants as the first axis.

        Parameters
        ----------
        budget : bool
            Whether to return the sums of the budget's terms.
        variants : sequence of _core.detector.Detector
            Detectors that get the hits of the first; then every column has a first axis of 1 + their number.
        hits : bool
            Whether to return the expected hits of all tracks, without variants: ``hit_kind``, ``hit_layer``,
            ``hit_channel``, ``hit_value`` (mm) and ``hit_variance`` (mm2), ordered by track.
        """
        core = compiled_for_fit(self.detector, self.fit)
        n = len(self.phi)
        step = max(1, _CHUNK // self.samples) * self.samples

        def part(first: int) -> dict[str, npt.NDArray[Any]]:
            rows = slice(first, min(first + step, n))
            columns: dict[str, Any] = _core.covariance.covariances(
                core, phi=self.phi[rows], kappa=self.kappa[rows], tanl=self.tanl[rows], mass=self.mass[rows],
                charge=self.charge[rows], scatters=self.scatters[rows],
                samples=self.samples, phases=self.phases,
                efficiencies=self.efficiencies[rows], model=self.model, budget=budget, hits=hits,
                variants=list(variants),
            )  # fmt: skip
            if hits:
                columns |= {f"hit_{name}": column for name, column in columns.pop("hits").items()}
            if not variants:
                return columns
            return {name: column.reshape(1 + len(variants), -1, *column.shape[1:]) for name, column in columns.items()}

        starts = range(0, n, step)
        if len(starts) == 1:
            return part(0)
        with pool_of(Workers(threads=self.threads)) as pool:
            parts = list(pool.map(part, starts))
        axis = 1 if variants else 0
        return {name: np.concatenate([one[name] for one in parts], axis=axis) for name in parts[0]}


#: Least cosine of the angle of incidence across the beam; tracks that turn back have none.
_MOST_SLANTED = 0.141
#: Largest probability of no clusters that is left out.
_LEAST_LOSS = 1e-6


def most_unseen(layer: Layer) -> float:
    """Return the probability that a minimum ionizing particle straight across a layer has no clusters.

    Parameters
    ----------
    layer : Layer
        In gas they need electrons.
    """
    return 1 - layer.efficiency * (1 - most_lost(layer))


def efficiencies_of(detector: Detector, kappa: Floats, tanl: Floats, mass: Floats, charge: Floats) -> Floats:
    """Return the probability that tracks from the origin have clusters, (tracks, layers) or, if they are certain, (0,).

    The path through a gap is that of the direction in its middle, on a circle in the field at the origin.

    Parameters
    ----------
    detector : Detector
    kappa, tanl, mass, charge : ndarray, (tracks,) float64, (GeV/c)^-1, 1, GeV/c2 and e
    """
    if all(most_unseen(layer) < _LEAST_LOSS for layer in detector.layers):
        return np.zeros(0)
    slant = np.hypot(1.0, tanl)
    ln_betagamma = np.log(charge * slant / np.abs(kappa) / mass)
    efficiency = np.ones((len(kappa), len(detector.layers)))
    for layer_number, layer in enumerate(detector.layers):
        if layer.gas is None:
            efficiency[:, layer_number] = layer.efficiency
            continue
        turned, _ = path_to(layer.r_mid, kappa, detector.field.bz)
        path = layer.drift_gap * slant / np.maximum(np.cos(turned), _MOST_SLANTED)
        clusters = charge**2 * clusters_per_mm(layer.gas, ln_betagamma) * path
        efficiency[:, layer_number] = layer.efficiency * enough_electrons(
            layer.gas, clusters, layer.readout.least_electrons
        )
    return efficiency


#: Of the distance to an end: scatters move tracks by less than a fifth of it.
_NEAR = 0.8
#: And by less than this angle times the arc, where an end is at z = 0.
_SCATTER = 0.02


@once
def _wire_layers(chamber: DriftChamber) -> list[tuple[float, float, float]]:
    return [(layer.r_mid, *layer.ends) for layer in chamber.layers]


def near_ends(detector: Detector, kappa: Floats, tanl: Floats) -> npt.NDArray[np.bool_]:
    """Return whether tracks from the origin come near the end of a layer, or pass beyond it.

    Parameters
    ----------
    detector : Detector
    kappa, tanl : ndarray, (tracks,) float64, (GeV/c)^-1 and 1
    """
    layers = [(layer.r_mid, *layer.ends) for layer in detector.layers]
    layers += _wire_layers(detector.drift_chamber) if detector.drift_chamber is not None else []
    is_near = np.zeros(len(kappa), bool)
    if not layers:
        return is_near
    radius, low, high = np.array(layers).T
    steep = np.abs(tanl)
    # The arc to a cylinder is at most half a turn about its radius.
    maybe = np.flatnonzero(0.5 * np.pi * steep > _NEAR * np.min(np.minimum(-low, high) / radius))
    if not len(maybe):
        return is_near
    _, arc = path_to(radius, kappa[maybe, None], detector.field.bz)
    z, back = steep[maybe, None] * arc, tanl[maybe, None] < 0
    far, near = np.where(back, -low, high), np.where(back, -high, low)
    # Of a layer beside z = 0, tracks come near the first end, too, and none behind reaches it.
    begins = (near >= 0) & (np.abs(z - near) < (1 - _NEAR) * np.maximum(z, near) + _SCATTER * arc)
    is_near[maybe] = np.any(np.where(far > 0, z > _NEAR * far, z < far + _SCATTER * arc) | begins, axis=1)
    return is_near


def mean(values: npt.NDArray[Any], good: npt.NDArray[np.bool_]) -> Floats:
    """Return the mean over the last axis of the good values; NaN where there are none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(good, values, 0.0).sum(axis=-1) / good.sum(axis=-1), np.float64)


def status_of(status: npt.NDArray[np.int8]) -> tuple[npt.NDArray[np.int8], Floats]:
    """Return the status of points, and their fraction of samples that are ok, from those of samples.

    Parameters
    ----------
    status : ndarray, (points, samples) int8

    Returns
    -------
    status : ndarray, (points,) int8
        0 (ok) if any sample is ok, else the most frequent status.
    reached : ndarray, (points,) float64
    """
    ok = status == 0
    worst = np.zeros(len(ok), np.int8)
    for i in np.flatnonzero(~ok.any(axis=1)):
        worst[i] = np.bincount(status[i]).argmax()
    return worst, ok.mean(axis=1)


@functools.lru_cache(maxsize=16)
def draws(samples: int, dimensions: int) -> Floats:
    """Return (number, dimensions) numbers from 0 to 1: azimuths in equal steps, the others from a Sobol sequence."""
    from scipy.stats import qmc

    numbers = np.empty((samples, dimensions))
    numbers[:, 0] = (np.arange(samples) + 0.5) / samples
    further = qmc.Sobol(dimensions - 1, scramble=True, rng=np.random.default_rng(1)).random(
        1 << (samples - 1).bit_length()
    )
    numbers[:, 1:] = further[:samples]
    numbers.flags.writeable = False
    return numbers


def core_width(variances: Floats) -> Floats:
    """Return the core of mixtures of centred Gaussians of equal weight, (points, samples) to (points,).

    The core is the Gaussian whose variance, cut at +-3 sigma, equals that of the mixture within the same window (as in
    `cgemit.analysis.widths`). With u = 3 s/sqrt(v), a Gaussian of variance v has the fraction erf(u/sqrt 2) inside
    and the second moment v (erf(u/sqrt 2) - u sqrt(2/pi) exp(-u^2/2)) there.
    """
    good = ~np.isnan(variances)
    v = np.where(good, variances, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        square = mean(v, good)
        if v.shape[1] == 1:
            return np.asarray(np.sqrt(square))
        weight = good.astype(np.float64)
        left = np.flatnonzero(~np.isnan(square))
        for _ in range(1000):
            if len(left) == 0:
                break
            now = square[left]
            narrowed, slope = _narrowed(now, v[left], weight[left])
            # Newton's step to the fixed point, where the slope is not too close to 1.
            better = now + (narrowed - now) / (1 - slope)
            newton = (slope < 0.5) & (better > 0)
            square[left] = np.where(newton, better, narrowed)
            # The error after a step of Newton is of second order in the step.
            left = left[np.abs(square[left] - now) > np.where(newton, 1e-8, 1e-13) * now]
        return np.asarray(np.sqrt(square))


def _narrowed(square: Floats, v: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return the variance of the Gaussian that a window of 3 sigma of this variance finds, and its derivative."""
    from scipy.special import erf

    u = 3 * np.sqrt(square[:, None] / v)
    inside = weight * erf(u / math.sqrt(2))
    edge = weight * u * math.sqrt(2 / math.pi) * np.exp(-0.5 * u * u)
    total = inside.sum(axis=1)
    width = (v * (inside - edge)).sum(axis=1) / total / SECOND_INSIDE
    # d(inside)/du = edge/u, d(second)/du = v u edge, du/d(square) = u/(2 square), and v u^2 = 9 square.
    edges = edge.sum(axis=1)
    slope = (4.5 / SECOND_INSIDE - 0.5 * width / square) * edges / total
    return width, slope


Quantity = float | str | tuple[float | str, float | str] | npt.ArrayLike


@dataclass(frozen=True, eq=False)
class Points(Part):
    """Particle, momenta and directions, the same for any detector; arrays have the shape of the points.

    Attributes
    ----------
    particle : str
    p, cos_theta : (ndarray, ndarray), float64, GeV/c, 1
        Lower and upper limits.
    phi : ndarray, float64, rad
        NaN where it is averaged.
    charge, mass : ndarray, float64, e and GeV/c2
    radius : ndarray, float64, mm
        Where the covariance is wanted; NaN: at the origin.
    samples : int or None
        Tracks of each point, None for the default.
    """

    particle: str
    p: tuple[Floats, Floats]
    cos_theta: tuple[Floats, Floats]
    phi: Floats
    charge: Floats
    mass: Floats
    radius: Floats
    samples: int | None

    @cached_property
    def at_origin(self) -> bool:
        """Whether all covariances are wanted at the origin."""
        return bool(np.all(np.isnan(self.radius)))

    @cached_property
    def vary(self) -> bool:
        """Whether the tracks of a point differ."""
        return bool(np.any(np.isnan(self.phi))) or any(np.any(low != high) for low, high in (self.p, self.cos_theta))

    def texts(self, number: int) -> tuple[str, str]:
        """Return momentum (GeV/c) and cosine of one of the flattened points as text, ranges as ``-0.93 to 0.93``."""
        p = [f"{end.flat[number]:.4g}" for end in self.p]
        cosine = [f"{round(float(end.flat[number]), 12) + 0.0:.4g}" for end in self.cos_theta]  # of 90 deg: 0
        return " to ".join(dict.fromkeys(p)), " to ".join(dict.fromkeys(cosine))


@dataclass(frozen=True, eq=False)
class Sample:
    """The tracks of points, (tracks,) float64 in native units; `charge` is unsigned.

    `phases` (samples, 2 layers) are the positions of the strips of each view.
    """

    psi: Floats
    kappa: Floats
    tanl: Floats
    mass: Floats
    charge: Floats
    phases: Floats


#: Most tracks of a point; their quasi-random numbers tell a width to far less than 0.1 %.
MOST_SAMPLES = 2**16


def points_of(
    particle: str | int,
    p: Quantity,
    cos_theta: Quantity,
    phi: Quantity | None = None,
    radius: Quantity | None = None,
    charge: npt.ArrayLike | None = None,
    mass: npt.ArrayLike | None = None,
    samples: int | None = None,
) -> Points:
    """Return the points that arguments of `analytic` stand for; those of the same numbers are made once.

    Parameters
    ----------
    particle, p, cos_theta, phi, radius, charge, mass, samples
        As of `analytic`.

    Raises
    ------
    ValueError
        Listing every problem.
    """
    arguments: tuple[Any, ...] = (particle, p, cos_theta, phi, radius, charge, mass, samples)
    try:
        return _points_once(*arguments)
    except TypeError:  # lists and arrays cannot be looked up
        return _points(*arguments)


def _points(
    particle: str | int, p: Quantity, cos_theta: Quantity, phi: Quantity | None, radius: Quantity | None,
    charge: npt.ArrayLike | None, mass: npt.ArrayLike | None, samples: int | None,
) -> Points:  # fmt: skip
    problems = Problems()
    try:
        kind = species(particle)
    except WrongValueError as error:
        problems.take(error, "particle")
        problems.report("analytic")
    p_low, p_high = _limits("p", p, "momentum", problems)
    c_low, c_high = _limits("cos_theta", cos_theta, "", problems)
    azimuth = np.array(math.nan) if phi is None else _numbers("phi", phi, "angle", problems)
    if isinstance(phi, tuple):
        problems.note("phi", f"the range {phi!r:.60}", "numbers, or None for all azimuths")
    at = np.array(math.nan) if radius is None else _numbers("radius", radius, "length", problems)
    charges = _numbers("charge", kind.charge if charge is None else charge, "", problems)
    masses = _numbers("mass", kind.mass if mass is None else mass, "", problems)
    for name, given, values in (("phi", phi, azimuth), ("radius", radius, at)):
        if given is not None and np.isnan(values).any():
            problems.note(name, "nan", "a number; None for all azimuths" if name == "phi" else "a number")
    if not problems:
        arrays = {"p": p_low, "cos_theta": c_low, "phi": azimuth, "charge": charges, "mass": masses, "radius": at}
        _check(arrays, p_high, c_high, problems)
    if samples is not None:
        check_whole("samples", samples, 1, MOST_SAMPLES, problems)
    problems.report("analytic")
    given = np.broadcast_arrays(p_low, p_high, c_low, c_high, azimuth, charges, masses, at)
    p_low, p_high, c_low, c_high, azimuth, charges, masses, at = given
    return Points(
        kind.name,
        (p_low, p_high),
        (c_low, c_high),
        azimuth,
        charges,
        masses,
        at,
        None if samples is None else int(samples),
    )


def shot_of(
    p: Quantity | None, pt: Quantity | None, cos_theta: Quantity | None, theta: Quantity | None, eta: Quantity | None
) -> tuple[Quantity, Quantity]:
    """Return momentum and cosine of the polar angle, 1 GeV/c and 0 if nothing is given.

    Parameters
    ----------
    p, pt, cos_theta, theta, eta
        As of `analytic`.

    Raises
    ------
    ValueError
        If two of a kind are given, or ranges where numbers are needed; listing every problem.
    """
    problems = Problems()
    for given in ({"p": p, "pt": pt}, {"cos_theta": cos_theta, "theta": theta, "eta": eta}):
        names = [name for name, value in given.items() if value is not None]
        if len(names) > 1:
            problems.note(" and ".join(names), "both" if len(names) == 2 else "all", "one of them")
    for name, value in {"pt": pt, "theta": theta, "eta": eta}.items():
        if isinstance(value, tuple):
            problems.note(name, f"the range {value!r:.60}", "numbers; ranges are those of p and cos_theta")
    if pt is not None and isinstance(cos_theta, tuple):
        problems.note("cos_theta", f"the range {cos_theta!r:.60}", "fixed angles, since pt is given")
    problems.report("analytic")
    if theta is not None:
        angles = _numbers("theta", theta, "angle", problems)
        if not ((angles > 0) & (angles < np.pi)).all():
            wrong = angles[~((angles > 0) & (angles < np.pi))].flat[0]
            plain = not any(isinstance(one, str) for one in (theta if isinstance(theta, list) else [theta]))
            hint = f'did you mean "{wrong:g} deg"?' if plain and 0 < wrong < 180 else ""
            problems.note("theta", f"{theta!r:.60}", "angles between 0 and pi rad", hint)
        cos_theta = np.cos(angles)
    elif eta is not None:
        cos_theta = np.tanh(_numbers("eta", eta, "", problems))
    cos_theta = 0.0 if cos_theta is None else cos_theta
    if pt is not None:
        transverse = _numbers("pt", pt, "momentum", problems)
        cosines = _numbers("cos_theta", cos_theta, "", problems)
        with np.errstate(divide="ignore", invalid="ignore"):
            p = transverse / np.sqrt(1 - cosines * cosines)
    problems.report("analytic")
    return 1.0 if p is None else p, cos_theta


_points_once = functools.lru_cache(maxsize=64, typed=True)(_points)


@once
def sample_of(points: Points, number: int, layers: int) -> Sample:
    """Return the tracks of points, which all detectors with as many CGEM layers share.

    Parameters
    ----------
    points : Points
    number : int
        Of the tracks of each point.
    layers : int
        CGEM layers of the detector.
    """
    drawn = draws(number, 3 + 2 * layers)
    momentum = _sampled(*points.p, drawn[:, 1])
    cosine = _sampled(*points.cos_theta, drawn[:, 2])
    azimuth = points.phi.reshape(-1, 1)
    psi = np.where(np.isnan(azimuth), 2 * np.pi * drawn[:, 0] - np.pi, azimuth)
    sine = np.sqrt(1 - cosine * cosine)
    kappa, tanl = (points.charge.reshape(-1, 1) / (momentum * sine)).ravel(), (cosine / sine).ravel()
    mass, charge = (np.repeat(one.ravel(), number) for one in (points.mass, np.abs(points.charge)))
    return Sample(psi.ravel(), kappa, tanl, mass, charge, np.ascontiguousarray(drawn[:, 3:]))


def _limits(name: str, raw: Any, dimension: str, problems: Problems) -> tuple[Floats, Floats]:
    """Return the lower and upper limits of a range, or the same values twice."""
    if dimension and isinstance(raw, str):
        raw = split_values(name, raw, Limits(dimension), problems)
        raw = 0.5 if raw is NO else raw
    if isinstance(raw, tuple) and len(raw) == 2:
        low, high = (_numbers(f"{name}[{i}]", one, dimension, problems) for i, one in enumerate(raw))
        if low.shape != high.shape or np.any(low > high):
            problems.note(name, f"{raw!r:.60}", "a range (low, high) of numbers")
        return low, high
    values = _numbers(name, raw, dimension, problems)
    return values, values


def _numbers(name: str, raw: Any, dimension: str, problems: Problems) -> Floats:
    try:
        if dimension and isinstance(raw, str):
            return np.asarray(number_of(raw, dimension), np.float64)
        if dimension and isinstance(raw, list):
            raw = [number_of(one, dimension) if isinstance(one, str) else one for one in raw]
        return np.asarray(raw, np.float64)
    except QuantityError as error:
        problems.take(error, name)
    except (TypeError, ValueError):
        hint = "a range is a tuple (low, high)" if isinstance(raw, str) and ":" in raw else ""
        problems.note(name, f"{raw!r:.60}", "one or more numbers", hint)
    return np.array(0.5)


def _check(arrays: Mapping[str, Floats], p_high: Floats, c_high: Floats, problems: Problems) -> None:
    """Note numbers that no track has, and shapes that do not go together."""

    def check(name: str, fits: npt.NDArray[np.bool_], expected: str) -> None:
        if arrays[name].size == 0:
            problems.note(name, "no number", "one or more")
        elif not fits.all():
            problems.note(name, f"{arrays[name][~np.asarray(fits)].flat[0]:g}", expected)

    check("p", (arrays["p"] > 0) & np.isfinite(p_high), "positive momenta in GeV/c")
    check("cos_theta", np.maximum(np.abs(arrays["cos_theta"]), np.abs(c_high)) < 1, "numbers between -1 and 1")
    check("phi", ~np.isinf(arrays["phi"]), "angles in rad")
    charged = np.isfinite(arrays["charge"]) & (arrays["charge"] != 0)
    check("charge", charged, "charged particles, since others leave no track")
    check("mass", (arrays["mass"] > 0) & np.isfinite(arrays["mass"]), "positive masses in GeV/c2")
    check("radius", ~(arrays["radius"] <= 0) & ~np.isinf(arrays["radius"]), "positive lengths in mm")
    shapes = [numbers.shape for numbers in arrays.values()]
    try:
        np.broadcast_shapes(*shapes)
    except ValueError:
        several = {name: numbers.shape for name, numbers in arrays.items() if numbers.shape}
        given = f"shapes {', '.join(map(str, several.values()))}"
        first = next(iter(several))
        hint = f"with {first} as a column, np.array({first})[:, None], every {first} is combined with the others"
        problems.note(", ".join(several), given, "shapes that can be broadcast", hint)


def _sampled(low: Floats, high: Floats, draws: Floats) -> Floats:
    """Return (points, samples) values between the limits of each point."""
    return np.asarray(low.reshape(-1, 1) + (high - low).reshape(-1, 1) * draws)
