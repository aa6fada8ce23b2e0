"""The best that any estimate can do: least squares with the noise of matter, worked out without the fit.

A track is followed through detector and matter with plain numpy; what it measures is differentiated by the helix
parameters, and by one scattering angle or loss after the other, through differences. With A and B these derivatives
(B in standard deviations) and R the variances of the measurements, the covariance of generalised least squares is
(A^T V^-1 A)^-1, V = R + B B^T.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

import cgemit as cg
from cgemit.reconstruction.fit import PARAMETERS
from plain_tracks import Hit, TracedSlab, follow, stack_of

Floats = npt.NDArray[np.float64]
Stack = Callable[[cg.Detector, float, tuple[float, float]], list[TracedSlab]]

#: What the optimum is worked out for: the helix parameters, and p.
QUANTITIES = (*PARAMETERS, "p")

_PART = 0.3  # of a standard deviation, the steps of noise
_STEP = np.array([1e-2, 1e-5, 1e-5, 1e-2, 1e-5])  # of the helix parameters; kappa relative


@dataclass(frozen=True)
class Optimum:
    """The optimal estimate of a helix from some hits, in the order of `PARAMETERS`.

    Attributes
    ----------
    cov : ndarray, (5, 5) float64
        Its covariance, where all is linear.
    bias : ndarray, (6,) float64
        Mean error of `QUANTITIES`, in standard deviations, because what is measured is not linear in helix, angles and
        losses: to second order, as M. J. Box, J. R. Stat. Soc. B 33 (1971) 171, but with angles and losses that are
        random.
    linear_bias : ndarray, (5,) float64
        That of the helix for an estimate that takes what is measured as linear in angles and losses.
    pull : ndarray, (6,) float64
        Mean of the pulls of `QUANTITIES` where the error is worked out at the estimate, as it has to be: the bias, less
        the covariance of the estimate and the logarithm of its error. NaN where it was not asked for.
    """

    cov: Floats
    bias: Floats
    linear_bias: Floats
    pull: Floats


@dataclass(frozen=True)
class _Track:
    """Hits, and the helix about which they are looked at."""

    detector: cg.Detector
    hits: Sequence[Hit]
    helix: Floats
    mass: float
    cut: tuple[float, float]
    matter: Stack

    def stack(self) -> list[TracedSlab]:
        """Return the matter that it meets."""
        return self.matter(self.detector, self.helix[4], self.cut)


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
    cut: tuple[float, float],
    *,
    pulls: bool = False,
    matter: Stack = stack_of,
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
    cut : (float, float)
        Collisions that count for mean and variance of the loss transfer less than this multiple of the track's xi plus
        this share of p beta.
    pulls : bool
        Whether the mean of the pulls is worked out, which takes ten times as long.
    matter : callable
        Makes the slabs that the track meets from detector, tan(lambda) and `cut`.
    """
    track = _Track(detector, hits, np.asarray(helix, np.float64), mass, cut, matter)
    found = _linear(track)
    sigma, axes = np.sqrt(np.diag(found.cov)), np.linalg.cholesky(found.cov)
    by_estimate = _curved(track, found, axes, np.zeros((len(found.noise), 5)))
    linear_bias = found.gain @ (found.by_kicks - by_estimate) / sigma
    bias = _bias_with_kinks(track, found, by_estimate)
    bias = np.append(bias, _bias_of_p(track.helix, found.cov, bias * sigma))
    pull = bias - _pull_of_errors(track, found) if pulls else np.full(6, np.nan)
    return Optimum(found.cov, bias, linear_bias, pull)


def _bias_of_p(helix: Floats, cov: Floats, bias: Floats) -> float:
    """Return the mean error of p in its standard deviations, to second order, from that of the helix."""
    _, _, kappa, _, tanl = helix
    p, stretch2 = np.hypot(1, tanl) / abs(kappa), 1 + tanl**2
    by_kappa2, by_tanl2, mixed = 2 * p / kappa**2, p / stretch2**2, -p * tanl / (kappa * stretch2)
    curved = by_kappa2 * cov[2, 2] / 2 + by_tanl2 * cov[4, 4] / 2 + mixed * cov[2, 4]
    return float((_by_helix(helix) @ bias + curved) / errors(helix, cov)["p"])


def _bias_with_kinks(track: _Track, found: _Linear, by_estimate: Floats) -> Floats:
    """Return the bias of the estimate about the angles and losses that the hits show, in standard deviations.

    Second derivatives by angles and losses count as far as these stay unknown; and first derivatives change with what
    is found of them, which goes with the residuals of the hits.
    """
    sigma, n = np.sqrt(np.diag(found.cov)), len(track.hits)
    variance = found.by_noise @ found.by_noise.T + np.diag([hit.sigma**2 for hit in track.hits])
    weighted = np.linalg.solve(variance, found.by_noise)
    residual = variance - found.by_helix @ found.cov @ found.by_helix.T  # covariance of hits about the linear estimate
    unknown = np.eye(len(found.noise)) - weighted.T @ residual @ weighted
    by_unknown = _curved(track, found, np.zeros((5, len(unknown))), np.linalg.cholesky(unknown))
    # Mixed derivatives of every hit: by each parameter's error, and by what is found of the noise when that hit lies
    # beside the track by its weighted residual.
    with_residual = np.linalg.solve(variance, residual @ weighted).T  # (noise, hits)
    size = np.linalg.norm(with_residual, axis=0)
    helix_steps = np.repeat(found.cov / sigma, n, axis=1)
    noise_errors = np.repeat(-(found.gain @ found.by_noise).T / sigma, n, axis=1)
    changes = np.zeros(5)
    for sign in (1, -1):
        noise_steps = noise_errors + sign * np.tile(with_residual / size, 5)
        moved = _seen(track, found, _PART * helix_steps, _PART * noise_steps)
        sums = (moved[:, 0::2] + moved[:, 1::2]).reshape(n, 5, n)[np.arange(n), :, np.arange(n)]
        changes += sign * (sums * size[:, None]).sum(axis=0) / (4 * _PART**2)
    return np.asarray(found.gain @ (by_unknown - by_estimate) / sigma + changes)


def _pull_of_errors(track: _Track, found: _Linear) -> Floats:
    """Return covariance of the estimate and the logarithm of its error, in standard deviations of the estimate."""
    axes = np.linalg.cholesky(found.cov)
    near = [_linear(replace(track, helix=helix)) for helix in _pairs(track.helix, _PART * axes).T]
    helices = _pairs(track.helix, _PART * axes).T
    sigmas = [_sigmas(helix, one.cov) for helix, one in zip(helices, near, strict=True)]
    slope = (np.log(sigmas[0::2]) - np.log(sigmas[1::2])).T / (2 * _PART)  # along each principal axis
    changes = np.vstack([axes, _by_helix(track.helix) @ axes])
    return np.asarray((slope * changes).sum(axis=1) / _sigmas(track.helix, found.cov))


def _sigmas(helix: Floats, cov: Floats) -> Floats:
    """Return the standard deviations of `QUANTITIES`."""
    return np.append(np.sqrt(np.diag(cov)), errors(helix, cov)["p"])


def _seen(track: _Track, found: _Linear, by_helix: Floats, by_noise: Floats) -> Floats:
    """Return what is seen after steps of helix and noise (columns), added and subtracted in turn."""
    kicks = {i: np.zeros((5, 2 * by_helix.shape[1])) for i, _, _ in found.noise}
    for (slab, which, spread), row in zip(found.noise, by_noise, strict=True):
        kicks[slab][which] = spread * np.stack([row, -row], axis=1).ravel()
    return follow(track.detector, track.hits, _pairs(track.helix, by_helix), track.mass, kicks, track.stack())


def _curved(track: _Track, found: _Linear, by_helix: Floats, by_noise: Floats) -> Floats:
    """Return half the second derivatives of what is seen, summed over steps."""
    moved = _seen(track, found, _PART * by_helix, _PART * by_noise)
    return np.asarray(((moved[:, 0::2] + moved[:, 1::2]) / 2 - found.centre).sum(axis=1) / _PART**2)


def _linear(track: _Track) -> _Linear:
    detector, hits, helix, mass, stack = track.detector, track.hits, track.helix, track.mass, track.stack()
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
    by = _by_helix(np.asarray(helix, np.float64))
    sigma = dict(zip(PARAMETERS, np.sqrt(np.diag(cov)), strict=True))
    return {"dr": float(sigma["dr"]), "dz": float(sigma["dz"]), "p": float(np.sqrt(by @ cov @ by))}


def _by_helix(helix: Floats) -> Floats:
    """Return the derivatives of p by the helix parameters."""
    _, _, kappa, _, tanl = helix
    p = np.hypot(1, tanl) / abs(kappa)
    return np.array([0, 0, -p / kappa, 0, p * tanl / (1 + tanl**2)])
