"""Amplitudes of a shaper for a charge at once, and one that flows in over some time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.detector.readouts.analog import Shaper

Floats = npt.NDArray[np.float64]


def response(shaper: Shaper, t: Floats) -> Floats:
    """Return the amplitude, (n,) float64, at times t, (n,) float64 ns, after a charge of 1."""
    a, b, rate = (column[:, None] for column in shaper.normalised.T)
    u = np.asarray(t, np.float64) - shaper.delay
    return np.where(u > 0, np.sum((a + b * u) * np.exp(-rate * np.maximum(u, 0.0)), axis=0), 0.0)


def pulse(shaper: Shaper, t: Floats, duration: float, parts: Floats | None = None) -> Floats:
    """Return the amplitude, (..., n) float64, for a charge that flows in for `duration` ns.

    Parameters
    ----------
    shaper : Shaper
    t : (n,) float64
        ns, after the begin.
    duration : float
        ns.
    parts : (..., parts) float64 or None
        Charge in equal parts of the duration; None: a charge of 1 flows in evenly.
    """
    parts = np.ones(1) if parts is None else parts
    step = duration / parts.shape[-1]
    u = np.asarray(t, np.float64) - shaper.delay
    level = np.array([risen(shaper, u - k * step) for k in range(parts.shape[-1] + 1)])
    return np.asarray(parts @ (level[:-1] - level[1:]) / step)


def risen(shaper: Shaper, u: Floats) -> Floats:
    """Return the integral of the response up to u, (n,), in ns."""
    a, b, rate = (column[:, None] for column in shaper.normalised.T)
    at = np.maximum(u, 0.0)[None, :]
    level = a / rate + b / rate**2
    return np.asarray(np.sum(level - np.exp(-rate * at) * (level + b * at / rate), axis=0))
