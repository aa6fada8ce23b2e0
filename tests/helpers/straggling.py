"""Energy loss of heavy particles without samples: Vavilov's distribution folded with a Gaussian, and its core."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import sici

EULER = 0.5772156649015329


def _exponent(t, w_max, beta2):
    """Return ln of the characteristic function of loss minus its mean, in units of xi.

    Integral of (e^itE - 1 - itE)/E^2 (1 - beta^2 E/w_max) up to w_max (P.V. Vavilov, Sov. Phys. JETP 5 (1957) 749).
    """
    u = t * w_max
    size = np.where(u == 0, 1.0, np.abs(u))
    sine, cosine = sici(size)
    first = np.where(u == 0, 0, cosine - EULER - np.log(size) + 1j * np.sign(u) * sine)  # of (e^ix - 1)/x
    second = np.where(u == 0, 0, -(np.exp(1j * u) - 1 - 1j * u) / np.where(u == 0, 1, u) + 1j * first)
    return t * second - beta2 / w_max * (first - 1j * u)


def folded(w_max, beta2, sigma, points=2**17):
    """Return loss minus its mean and density, both in units of xi, of Vavilov's loss with a Gaussian error `sigma`."""
    half = max(60.0, 14 * sigma, 2.5 * w_max)
    step = 2 * half / points
    t = 2 * np.pi * np.fft.fftfreq(points, step)
    density = np.fft.fft(np.exp(_exponent(t, w_max, beta2) - 0.5 * (sigma * t) ** 2)).real / (points * step)
    return (np.arange(points) - points // 2) * step, np.fft.fftshift(density)


def core(x, density):
    """Return mean and sigma of the Gaussian within 3 of its sigmas, as `cgemit.analysis.widths.measure` has them."""
    inside = math.erf(3 / math.sqrt(2))
    shrink = 1 - 6 * math.exp(-4.5) / math.sqrt(2 * math.pi) / inside
    edges = np.concatenate([[x[0]], 0.5 * (x[1:] + x[:-1]), [x[-1]]])
    sums = [np.concatenate([[0.0], np.cumsum(density * x**power)]) for power in range(3)]
    mean, sigma = x[np.argmax(density)], 1 / (density.max() * (x[1] - x[0]) / np.sum(density) * 2.5)
    for _ in range(3000):
        ends = mean - 3 * sigma, mean + 3 * sigma
        number, first, second = (np.diff(np.interp(ends, edges, s))[0] for s in sums)
        before, mean = (mean, sigma), first / number
        sigma = math.sqrt((second / number - mean**2) / shrink)
        if abs(mean - before[0]) + abs(sigma - before[1]) < 1e-9 * sigma:
            break
    return mean, sigma
