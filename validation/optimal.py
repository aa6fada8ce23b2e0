"""The best that any estimate can do: least squares with the noise of matter, worked out without the fit.

A track is followed through detector and matter with plain numpy; what it measures is differentiated by the helix
parameters, and by one scattering angle or loss after the other, through differences. With A and B these derivatives
(B in standard deviations) and R the variances of the measurements, the covariance of generalised least squares is
(A^T V^-1 A)^-1, V = R + B B^T.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import cgemit as cg
from cgemit.fit import PARAMETERS
from plain_tracks import Hit, follow, stack_of

Floats = npt.NDArray[np.float64]

_PART = 0.3  # of a standard deviation, the steps of noise
_STEP = np.array([1e-2, 1e-5, 1e-5, 1e-2, 1e-5])  # of the helix parameters; kappa relative


@dataclass(frozen=True)
class Optimum:
    """The optimal estimate of a helix from some hits, in the order of `PARAMETERS`.

    Attributes
    ----------
    cov : ndarray, (5, 5) float64
        Its covariance, where all is linear.
    bias : ndarray, (5,) float64
        Its mean error, in its standard deviations, because what is measured is not linear in helix, angles and losses
        (M. J. Box, J. R. Stat. Soc. B 33 (1971) 171, eq. 2.16).
    linear_bias : ndarray, (5,) float64
        The same of an estimate that takes what is measured as linear in angles and losses.
    pull : ndarray, (5,) float64
        Mean of its pulls where the error is worked out at the estimate, as it has to be: the bias, less the covariance
        of the estimate and the logarithm of its error. NaN where it was not asked for.
    """

    cov: Floats
    bias: Floats
    linear_bias: Floats
    pull: Floats


@dataclass(frozen=True)
class _Linear:
    """What is seen about a helix: how it changes with helix and noise, the noise, and its second derivatives by that.

    `gain` is that of the linear estimate; `noise` are slab, which of its five kicks, and the standard deviation;
    `by_kicks` is half the sum of second derivatives.
    """

    cov: Floats
    gain: Floats
    by_helix: Floats
    by_noise: Floats
    noise: list[tuple[int, int, float]]
    by_kicks: Floats
    centre: Floats


def optimum(
    detector: cg.Detector,
    hits: Sequence[Hit],
    helix: npt.ArrayLike,
    mass: float,
    cuts: tuple[float, float],
    *,
    pulls: bool = False,
) -> Optimum:
    """Return covariance, bias and mean pulls of the optimal estimate.

    Parameters
    ----------
    detector : Detector
    hits : sequence of Hit
        Ordered outward.
    helix : (5,) array_like
        mm, rad, (GeV/c)^-1; about which it is linearised.
    mass : float
        GeV.
    cuts : (float, float)
        Collisions that count for mean and variance of the loss transfer less than these multiples of the track's xi.
    pulls : bool
        Whether the mean of the pulls is worked out, which takes ten times as long.
    """
    helix = np.asarray(helix, np.float64)
    found = _linear(detector, hits, helix, mass, cuts)
    sigma, axes = np.sqrt(np.diag(found.cov)), np.linalg.cholesky(found.cov)
    stack = stack_of(detector, helix[4], cuts)

    def seen(by_helix: Floats, by_noise: Floats) -> Floats:
        """What is seen after steps of helix and noise (columns), added and subtracted in turn."""
        kicks = {i: np.zeros((5, 2 * by_helix.shape[1])) for i, _, _ in found.noise}
        for (slab, which, spread), row in zip(found.noise, by_noise, strict=True):
            kicks[slab][which] = spread * np.stack([row, -row], axis=1).ravel()
        return follow(detector, hits, _pairs(helix, by_helix), mass, kicks, stack)

    def curved(by_helix: Floats, by_noise: Floats) -> Floats:
        """Half the second derivatives of what is seen, summed over steps."""
        moved = seen(_PART * by_helix, _PART * by_noise)
        return np.asarray(((moved[:, 0::2] + moved[:, 1::2]) / 2 - found.centre).sum(axis=1) / _PART**2)

    straight = np.zeros((len(found.noise), 5))
    by_estimate = curved(axes, straight)
    linear_bias = found.gain @ (found.by_kicks - by_estimate) / sigma
    # About the kinks that the hits show there are two more terms. Angles and losses that are found do not count, what
    # is left of them does; and derivatives change with what is found, which goes with the residuals.
    variance = found.by_noise @ found.by_noise.T + np.diag([hit.sigma**2 for hit in hits])
    weighted = np.linalg.solve(variance, found.by_noise)
    residual = variance - found.by_helix @ found.cov @ found.by_helix.T
    left = np.eye(len(found.noise)) - weighted.T @ residual @ weighted
    by_left = curved(np.zeros((5, len(left))), np.linalg.cholesky(left))
    with_residual = np.linalg.solve(variance, residual @ weighted).T  # (noise, hits)
    size = np.linalg.norm(with_residual, axis=0)
    n = len(hits)
    to_helix, to_noise = found.cov / sigma, -(found.gain @ found.by_noise).T / sigma  # columns: errors of the helix
    changes = np.zeros(5)
    for sign in (1, -1):
        noise_steps = np.repeat(to_noise, n, axis=1) + sign * np.tile(with_residual / size, 5)
        moved = seen(_PART * np.repeat(to_helix, n, axis=1), _PART * noise_steps)
        sums = (moved[:, 0::2] + moved[:, 1::2]).reshape(n, 5, n)[np.arange(n), :, np.arange(n)]
        changes += sign * (sums * size[:, None]).sum(axis=0) / (4 * _PART**2)
    bias = found.gain @ (by_left - by_estimate) / sigma + changes
    if not pulls:
        return Optimum(found.cov, bias, linear_bias, np.full(5, np.nan))
    logs = [
        np.log(np.diag(_linear(detector, hits, near, mass, cuts).cov)) / 2 for near in _pairs(helix, _PART * axes).T
    ]
    slope = (np.array(logs[0::2]) - logs[1::2]).T / (2 * _PART)  # of the logarithm of each error along each axis
    return Optimum(found.cov, bias, linear_bias, bias - (slope * axes).sum(axis=1) / sigma)


def _linear(
    detector: cg.Detector, hits: Sequence[Hit], helix: Floats, mass: float, cuts: tuple[float, float]
) -> _Linear:
    stack = stack_of(detector, helix[4], cuts)
    centre = follow(detector, hits, helix[:, None], mass, {}, stack)  # fills in the noise
    noise = [(i, k, s.sigma[k]) for i, s in enumerate(stack) for k in range(5) if s.sigma[k] > 0]
    n = 5 + len(noise)
    steps = _STEP * [1, 1, abs(helix[2]), 1, 1]
    kicks = {i: np.zeros((5, 2 * n)) for i, _, _ in noise}
    for j, (slab, which, sigma) in enumerate(noise, start=5):
        kicks[slab][which, [2 * j, 2 * j + 1]] = _PART * sigma, -_PART * sigma
    tracks = _pairs(helix, np.concatenate([np.diag(steps), np.zeros((5, len(noise)))], axis=1))
    seen = follow(detector, hits, tracks, mass, kicks, stack)
    change = (seen[:, 0::2] - seen[:, 1::2]) / 2
    by_helix, by_noise = change[:, :5] / steps, change[:, 5:] / _PART
    variance = by_noise @ by_noise.T + np.diag([hit.sigma**2 for hit in hits])
    weighted = np.linalg.solve(variance, by_helix)
    cov = np.linalg.inv(by_helix.T @ weighted)
    by_kicks = ((seen[:, 10::2] + seen[:, 11::2] - 2 * centre) / 2).sum(axis=1) / _PART**2
    return _Linear(cov, cov @ weighted.T, by_helix, by_noise, noise, by_kicks, centre)


def _pairs(helix: Floats, steps: Floats) -> Floats:
    """Return the helix with each step (columns) added and subtracted in turn, (5, 2 n)."""
    return np.asarray(helix[:, None] + np.stack([steps, -steps], axis=2).reshape(5, -1), np.float64)


def errors(helix: npt.ArrayLike, cov: Floats) -> dict[str, float]:
    """Return standard deviations of dr, dz (mm) and p (GeV/c) from helix and covariance."""
    _, _, kappa, _, tanl = np.asarray(helix, np.float64)
    p = np.hypot(1, tanl) / abs(kappa)
    by = np.array([0, 0, -p / kappa, 0, p * tanl / (1 + tanl**2)])
    sigma = dict(zip(PARAMETERS, np.sqrt(np.diag(cov)), strict=True))
    return {"dr": float(sigma["dr"]), "dz": float(sigma["dz"]), "p": float(np.sqrt(by @ cov @ by))}
