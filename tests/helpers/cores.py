"""Cores of samples with heavy tails, such as momenta of electrons, in narrower windows than those of `widths`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class Core(NamedTuple):
    """Mean and width of the Gaussian within `window` of its sigmas, and about the standard error of the width."""

    mean: float
    width: float
    error: float


def core_of(sample: npt.ArrayLike, window: float = 2.0) -> Core:
    """Return the core of a sample; the width is that of a whole Gaussian."""
    x = np.sort(np.asarray(sample, np.float64))
    cut = 2 * window * math.exp(-0.5 * window**2) / math.sqrt(2 * math.pi) / math.erf(window / math.sqrt(2))
    low, mean, high = np.quantile(x, (0.4, 0.5, 0.6))
    width = (high - low) / 0.507
    for _ in range(500):
        inside = x[np.searchsorted(x, mean - window * width) : np.searchsorted(x, mean + window * width)]
        before, mean, width = (mean, width), inside.mean(), inside.std() / math.sqrt(1 - cut)
        if abs(before[0] - mean) + abs(before[1] - width) < 1e-9 * width:
            break
    # The window follows the width: for 4000 Gaussian numbers and a window of 2 sigmas, the width scatters 1.6 times as
    # much as the standard deviation of all.
    return Core(float(mean), float(width), float(1.6 * width / math.sqrt(2 * len(x))))


def mode_of(sample: npt.ArrayLike, sigma: float) -> float:
    """Return the mode of a sample whose core has this sigma, smoothed by half of it."""
    x = np.asarray(sample, np.float64)
    grid = np.median(x) + np.linspace(-3, 3, 301) * sigma
    density = np.exp(-0.5 * ((grid[:, None] - x) / (0.5 * sigma)) ** 2).sum(axis=1)
    return float(grid[density.argmax()])
