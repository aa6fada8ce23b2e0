"""Mixtures of centred Gaussians: how they are sampled, and their widths."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.statistics.estimate import SECOND_INSIDE

Floats = npt.NDArray[np.float64]


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
        0 (ok) if any sample is, else that of most samples.
    reached : ndarray, (points,) float64
    """
    ok = status == 0
    worst = np.zeros(len(ok), np.int8)
    for i in np.flatnonzero(~ok.any(axis=1)):
        worst[i] = np.bincount(status[i]).argmax()
    return worst, ok.mean(axis=1)


@functools.lru_cache(maxsize=16)
def draws(number: int, dimensions: int) -> Floats:
    """Return (number, dimensions) numbers from 0 to 1: azimuths in equal steps, the others from a Sobol sequence."""
    from scipy.stats import qmc

    found = np.empty((number, dimensions))
    found[:, 0] = (np.arange(number) + 0.5) / number
    rest = qmc.Sobol(dimensions - 1, scramble=True, rng=np.random.default_rng(1)).random(1 << (number - 1).bit_length())
    found[:, 1:] = rest[:number]
    found.flags.writeable = False
    return found


def core_width(variances: Floats) -> Floats:
    """Return the core of mixtures of centred Gaussians of equal weight, (points, samples) to (points,).

    The core is the Gaussian whose variance, cut at +-3 sigma, equals that of the mixture within the same window (as in
    `cgemit.statistics.estimate`). With u = 3 s/sqrt(v), a Gaussian of variance v has the fraction erf(u/sqrt 2) inside
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
            found, slope = _narrowed(now, v[left], weight[left])
            # Newton's step to the fixed point, where the slope is not too close to 1.
            better = now + (found - now) / (1 - slope)
            newton = (slope < 0.5) & (better > 0)
            square[left] = np.where(newton, better, found)
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
    found = (v * (inside - edge)).sum(axis=1) / total / SECOND_INSIDE
    # d(inside)/du = edge/u, d(second)/du = v u edge, du/d(square) = u/(2 square), and v u^2 = 9 square.
    edges = edge.sum(axis=1)
    slope = (4.5 / SECOND_INSIDE - 0.5 * found / square) * edges / total
    return found, slope
