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
    from scipy.special import erf

    good = ~np.isnan(variances)
    v = np.where(good, variances, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        square = mean(v, good)
        if v.shape[1] == 1:
            return np.asarray(np.sqrt(square))
        weight = good.astype(np.float64)

        def narrowed(square: Floats) -> Floats:
            """Return the variance of the Gaussian that a window of 3 sigma of this variance finds."""
            u = 3 * np.sqrt(square[:, None] / v)
            inside = weight * erf(u / math.sqrt(2))
            second = v * (inside - weight * u * math.sqrt(2 / math.pi) * np.exp(-0.5 * u * u))
            return np.asarray(second.sum(axis=1) / inside.sum(axis=1) / SECOND_INSIDE)

        for _ in range(100):
            one = narrowed(square)
            two = narrowed(one)
            if not np.any(np.abs(two - one) > 1e-13 * one):
                break
            # Steffensen's step to the fixed point; where rounding decides it, the last value.
            curved, step = two - 2 * one + square, one - square
            better = square - step * step / curved
            square = np.where((np.abs(curved) > 1e-9 * square) & (better > 0), better, two)
        return np.asarray(np.sqrt(two))
