"""Resolutions without events: from momenta and angles to covariances."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.covariance.ends import near_ends
from cgemit.covariance.mixture import draws, mean
from cgemit.covariance.result import UPPER, Covariance
from cgemit.covariance.surfaces import at_cylinders
from cgemit.covariance.tracks import Tracks
from cgemit.detector import Detector, load
from cgemit.digitize import DigitizeSettings
from cgemit.digitize.readout import Readout
from cgemit.fit import FitSettings
from cgemit.species import species
from cgemit.units import QuantityError, parse_quantity

Floats = npt.NDArray[np.float64]
Quantity = float | str | tuple[float | str, float | str] | npt.ArrayLike


def analytic(
    detector: Detector | str | Mapping[str, Any],
    particle: str | int = "mu-",
    p: Quantity = 1.0,
    cos_theta: Quantity = 0.0,
    *,
    phi: Quantity | None = None,
    radius: Quantity | None = None,
    charge: npt.ArrayLike | None = None,
    mass: npt.ArrayLike | None = None,
    readout: Readout | str = "binary",
    reveal_sides: bool = False,
    fit: FitSettings | None = None,
    samples: int | None = None,
    threads: int | None = None,
) -> Covariance:
    """Return the covariance of a track's helix at the origin or at any radius, without events.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    particle : str or int
        Name or number of the Particle Data Group.
    p : float, str, array_like or tuple of two, GeV/c
        Momentum at the origin. A tuple is a range, over which each point is averaged uniformly; an array holds points.
    cos_theta : float, array_like or tuple of two
        Cosine of the polar angle, likewise.
    phi : float, str, array_like or None, rad
        Azimuth of the momentum; None: averaged over the full circle.
    radius : float, str, array_like or None, mm
        Of the cylinder where the covariance is wanted: from all hits, inside and outside, after all matter inside the
        cylinder and before all outside. None: at the origin.
    charge, mass : array_like or None
        e, GeV/c2. None: those of the particle. `p`, `cos_theta`, `phi`, `radius`, `charge` and `mass` are broadcast.
    readout : Readout or str
        Of the CGEM layers. Binary clusters have the error that follows from their number of strips; the positions of
        the strips under the track are sampled.
    reveal_sides : bool
        Whether wire hits tell their side. If not, hits close to their wire have the weights of the fit.
    fit : FitSettings or None
        Energy loss, screening and cluster errors that the fit assumes.
    samples : int or None
        Tracks that are averaged at each point. None: 128, or 1 if nothing varies.
    threads : int or None
        None: all cores.

    Returns
    -------
    Covariance

    Raises
    ------
    DetectorError
        If the detector is not valid.
    ValueError
        Listing every problem of the other arguments.

    Notes
    -----
    Scattering and straggling enter with the variances of the fit (docs/methods/matter.md), measurements with the errors
    of the read-out, so that the result is that of a fit whose assumptions hold: simulation with
    ``fluctuations="gaussian"``. Near the ends of the layers, where scattering decides which hits a track has, the
    trajectories of the samples scatter (only at the origin, and if more than one track is averaged).
    """
    detector, fit = load(detector), fit or FitSettings()
    digitize = DigitizeSettings(readout=readout, reveal_sides=reveal_sides)
    kind = species(particle)
    problems: list[str] = []
    p_low, p_high = _limits("p", p, "momentum", problems)
    c_low, c_high = _limits("cos_theta", cos_theta, "", problems)
    azimuth = None if phi is None else _limits("phi", phi, "angle", problems)
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
    sigma_x, sigma_v = _errors(digitize.readout, detector)
    varies = azimuth is None or not (np.all(sigma_x > 0) and np.all(sigma_v > 0))
    varies = varies or bool(np.any(p_low != p_high) or np.any(c_low != c_high)) or _inefficient(detector)
    number = samples or (128 if varies else 1)
    given = [p_low, p_high, c_low, c_high, charges, masses, at, *(azimuth or (np.array(math.nan),) * 2)]
    p_low, p_high, c_low, c_high, charges, masses, at, phi_low, _ = np.broadcast_arrays(*given)
    shape = p_low.shape
    drawn = draws(number, 3 + 2 * len(detector.cgem))
    momentum = _sampled(p_low, p_high, drawn[:, 1])
    cosine = _sampled(c_low, c_high, drawn[:, 2])
    turned = 2 * np.pi * drawn[:, 0] - np.pi
    psi = np.where(np.isnan(phi_low).reshape(-1, 1), turned, phi_low.reshape(-1, 1))
    sine = np.sqrt(1 - cosine * cosine)
    model = _core.HitModel(
        sigma_x=list(sigma_x), sigma_v=list(sigma_v), least_width=fit.least_width, delta_strips=fit.delta_strips,
        sides_known=reveal_sides, seed=0, prior_sigma=fit.prior_sigma,
    )  # fmt: skip
    kappa, tanl = (charges.reshape(-1, 1) / (momentum * sine)).ravel(), (cosine / sine).ravel()
    sampled = number > 1 and radius is None
    scatters = near_ends(detector, kappa, tanl).astype(np.float64) if sampled else np.zeros(len(kappa))
    tracks = Tracks(
        detector, fit, model, psi.ravel(), kappa, tanl, np.repeat(masses.ravel(), number), scatters, number,
        np.ascontiguousarray(drawn[:, 3:]), threads,
    )  # fmt: skip
    if radius is None:
        out = tracks.run(budget=False)
    else:
        tracks, out = at_cylinders(tracks, np.repeat(at.ravel(), number))
    return _result(detector, kind.name, digitize.readout, tracks, out, shape, momentum, cosine, phi_low, at)


def _result(
    detector: Detector, particle: str, readout: Readout, tracks: Tracks, out: dict[str, npt.NDArray[Any]],
    shape: tuple[int, ...], momentum: Floats, cosine: Floats, phi: Floats, radius: Floats,
) -> Covariance:  # fmt: skip
    """Return the result of the core's columns."""

    def by_point(column: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return column.reshape(-1, tracks.samples, *column.shape[1:])

    status = by_point(out["status"])
    ok = status == 0
    entries = by_point(out["covariance"])
    cov = np.empty((len(entries), 5, 5))
    cov[:, UPPER[0], UPPER[1]] = cov[:, UPPER[1], UPPER[0]] = mean(np.moveaxis(entries, 1, -1), ok[:, None, :])
    worst = np.array([0 if good.any() else np.bincount(row).argmax() for row, good in zip(status, ok, strict=True)])
    return Covariance(
        detector, particle, readout, momentum.mean(axis=1).reshape(shape), cosine.mean(axis=1).reshape(shape),
        phi.reshape(shape), radius.reshape(shape), worst.astype(np.int8).reshape(shape), ok.mean(axis=1).reshape(shape),
        mean(by_point(out["n_clusters"]), ok).reshape(shape), mean(by_point(out["n_wires"]), ok).reshape(shape),
        cov.reshape(*shape, 5, 5), tracks, entries,
    )  # fmt: skip


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


def _errors(readout: Readout, detector: Detector) -> tuple[Floats, Floats]:
    expected = getattr(readout, "expected_errors", None)
    if expected is None:
        raise ValueError(f"read-out {readout.name}: expected a method expected_errors(detector), see Readout")
    sigma_x, sigma_v = expected(detector)
    return np.asarray(sigma_x, np.float64), np.asarray(sigma_v, np.float64)


def _inefficient(detector: Detector) -> bool:
    chamber = detector.drift_chamber
    return chamber is not None and any(layer.efficiency < 1 for layer in chamber.layers)


def _sampled(low: Floats, high: Floats, draws: Floats) -> Floats:
    """Return (points, samples) values between the limits of each point."""
    return np.asarray(low.reshape(-1, 1) + (high - low).reshape(-1, 1) * draws)
