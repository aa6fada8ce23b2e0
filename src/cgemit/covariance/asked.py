"""The points at which covariances are asked for: arguments checked, and the tracks that are averaged at each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.covariance.mixture import draws
from cgemit.detector.kept import Part, once
from cgemit.species import species
from cgemit.units import QuantityError, parse_quantity

Floats = npt.NDArray[np.float64]
Quantity = float | str | tuple[float | str, float | str] | npt.ArrayLike


@dataclass(frozen=True, eq=False)
class Points(Part):
    """Particle, momenta and directions, the same for any detector; arrays have the shape of the points.

    Attributes
    ----------
    particle : str
    p, cos_theta, phi : (ndarray, ndarray), float64, GeV/c, 1, rad
        Lower and upper limits; `phi` is NaN where it is averaged.
    charge, mass : ndarray, float64, e and GeV/c2
    radius : ndarray, float64, mm
        Where the covariance is wanted; NaN: at the origin.
    samples : int or None
        Tracks of each point, None for the default.
    """

    particle: str
    p: tuple[Floats, Floats]
    cos_theta: tuple[Floats, Floats]
    phi: tuple[Floats, Floats]
    charge: Floats
    mass: Floats
    radius: Floats
    samples: int | None

    @property
    def vary(self) -> bool:
        """Whether the tracks of a point differ."""
        return bool(np.any(np.isnan(self.phi[0]))) or any(np.any(low != high) for low, high in (self.p, self.cos_theta))


@dataclass(frozen=True, eq=False)
class Sample:
    """The tracks of points, (tracks,) float64 in native units, and their mean `p` and `cos_theta`, shape of the points.

    `phases` (samples, 2 layers) are the positions of the strips of each view.
    """

    p: Floats
    cos_theta: Floats
    psi: Floats
    kappa: Floats
    tanl: Floats
    mass: Floats
    phases: Floats


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
    """Return the points that arguments of `analytic` stand for.

    Parameters
    ----------
    particle, p, cos_theta, phi, radius, charge, mass, samples
        As of `analytic`.

    Raises
    ------
    ValueError
        Listing every problem.
    """
    kind = species(particle)
    problems: list[str] = []
    p_low, p_high = _limits("p", p, "momentum", problems)
    c_low, c_high = _limits("cos_theta", cos_theta, "", problems)
    azimuth = (np.array(math.nan),) * 2 if phi is None else _limits("phi", phi, "angle", problems)
    at = np.array(math.nan) if radius is None else _numbers("radius", radius, "length", problems)
    if radius is not None and not (np.all(at > 0) and np.all(np.isfinite(at))):
        problems.append(f"radius: got {radius!r:.60}, expected positive lengths in mm")
    charges = np.asarray(kind.charge if charge is None else charge, np.float64)
    masses = np.asarray(kind.mass if mass is None else mass, np.float64)
    problems += _problems(p_low, p_high, c_low, c_high, charges, masses, at, samples)
    for name, numbers in (("p", p_low), ("cos_theta", c_low), ("radius", at)):
        if np.size(numbers) == 0:
            problems.append(f"{name}: got no number, expected one or more")
    if problems:
        raise ValueError("analytic:\n  " + "\n  ".join(problems))
    given = np.broadcast_arrays(p_low, p_high, c_low, c_high, *azimuth, charges, masses, at)
    p_low, p_high, c_low, c_high, phi_low, phi_high, charges, masses, at = given
    limits = (p_low, p_high), (c_low, c_high), (phi_low, phi_high)
    return Points(kind.name, *limits, charges, masses, at, samples)


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
    azimuth = points.phi[0].reshape(-1, 1)
    psi = np.where(np.isnan(azimuth), 2 * np.pi * drawn[:, 0] - np.pi, azimuth)
    sine = np.sqrt(1 - cosine * cosine)
    kappa, tanl = (points.charge.reshape(-1, 1) / (momentum * sine)).ravel(), (cosine / sine).ravel()
    mass = np.repeat(points.mass.ravel(), number)
    shape = points.charge.shape
    mean_p, mean_cosine = momentum.mean(axis=1).reshape(shape), cosine.mean(axis=1).reshape(shape)
    phases = np.ascontiguousarray(drawn[:, 3:])
    return Sample(mean_p, mean_cosine, psi.ravel(), kappa, tanl, mass, phases)


def _limits(name: str, given: Any, dimension: str, problems: list[str]) -> tuple[Floats, Floats]:
    """Return the lower and upper limits of a range, or the same values twice."""
    if isinstance(given, tuple) and len(given) == 2:
        low, high = (_numbers(f"{name}[{i}]", one, dimension, problems) for i, one in enumerate(given))
        if low.shape or high.shape or low > high:
            problems.append(f"{name}: got {given!r}; expected a range (low, high) of numbers")
        return low, high
    values = _numbers(name, given, dimension, problems)
    return values, values


def _numbers(name: str, given: Any, dimension: str, problems: list[str]) -> Floats:
    try:
        if dimension and isinstance(given, str):
            return np.asarray(parse_quantity(given, dimension), np.float64)
        if dimension and isinstance(given, list):
            given = [parse_quantity(one, dimension) if isinstance(one, str) else one for one in given]
        return np.asarray(given, np.float64)
    except (QuantityError, TypeError, ValueError) as error:
        problems.append(f"{name}: got {error}")
        return np.array(0.5)


def _problems(
    p_low: Floats, p_high: Floats, c_low: Floats, c_high: Floats, charge: Floats, mass: Floats, radius: Floats,
    samples: int | None,
) -> list[str]:  # fmt: skip
    found = []
    if not (np.all(p_low > 0) and np.all(np.isfinite(p_high))):
        found.append("p: expected positive momenta in GeV/c")
    if not (np.all(np.abs(c_low) < 1) and np.all(np.abs(c_high) < 1)):
        found.append("cos_theta: expected numbers between -1 and 1")
    if not (np.all(np.isfinite(charge)) and np.all(charge != 0)):
        found.append("charge: expected charged particles, since others leave no track")
    if not np.all((mass > 0) & np.isfinite(mass)):
        found.append("mass: expected positive masses in GeV/c2")
    if samples is not None and not (isinstance(samples, int | np.integer) and 1 <= samples <= 2**20):
        found.append(f"samples: got {samples!r}; expected a whole number from 1 to {2**20}")
    try:
        np.broadcast_shapes(p_low.shape, c_low.shape, charge.shape, mass.shape, radius.shape)
    except ValueError:
        shapes = ", ".join(map(str, (p_low.shape, c_low.shape, charge.shape, mass.shape, radius.shape)))
        found.append(f"p, cos_theta, charge, mass, radius: got shapes {shapes}; expected shapes that can be broadcast")
    return found


def _sampled(low: Floats, high: Floats, draws: Floats) -> Floats:
    """Return (points, samples) values between the limits of each point."""
    return np.asarray(low.reshape(-1, 1) + (high - low).reshape(-1, 1) * draws)
