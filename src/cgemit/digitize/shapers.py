"""Pulse shapes of front-end chips (docs/methods/readout.md): sums of damped terms, normalised to a peak of 1.

The response to a charge at time 0 is the sum of (a + b u) exp(-rate u), u = t - delay > 0. Times in ns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

_FINE = 0.01  # ns, step in which peaks are searched


@dataclass(frozen=True)
class Shaper:
    """Response of an amplifier to a charge.

    Attributes
    ----------
    terms : tuple of (float, float, float)
        a, b (1/ns) and rate (1/ns) of each term, of any scale.
    delay : float
        ns.
    """

    terms: tuple[tuple[float, float, float], ...]
    delay: float = 0.0

    @cached_property
    def normalised(self) -> Floats:
        """The terms, (n, 3) float64, scaled so that the peak is 1."""
        terms = np.array(self.terms)
        terms[:, :2] /= _sum(terms, np.arange(0.0, 500.0, _FINE)).max()
        return terms

    def response(self, t: Floats) -> Floats:
        """Return the amplitude, (n,) float64, at times t, (n,) float64 ns, after a charge of 1."""
        u = np.asarray(t, np.float64) - self.delay
        return np.where(u > 0, _sum(self.normalised, np.maximum(u, 0.0)), 0.0)

    def pulse(self, t: Floats, duration: float) -> Floats:
        """Return the amplitude, (n,), at times t, (n,) ns, for a charge of 1 that flows in evenly for `duration` ns."""
        u = np.asarray(t, np.float64) - self.delay
        return (self._step(u) - self._step(u - duration)) / duration

    def _step(self, u: Floats) -> Floats:
        """Return the integral of the response up to u, (n,), in ns."""
        a, b, rate = (column[:, None] for column in self.normalised.T)
        at = np.maximum(u, 0.0)[None, :]
        level = a / rate + b / rate**2
        return np.asarray(np.sum(level - np.exp(-rate * at) * (level + b * at / rate), axis=0))


def _sum(terms: Floats, u: Floats) -> Floats:
    a, b, rate = (column[:, None] for column in terms.T)
    return np.asarray(np.sum((a + b * u) * np.exp(-rate * u), axis=0))


#: CR-RC with 50 ns: (t/tau) exp(1 - t/tau); PARSIFAL (github.com/Hilldar/PARSIFAL).
APV25 = Shaper(((0.0, math.e / 50, 1 / 50),))
#: Branch T of TIGER, for the time: PARSIFAL. Peak 53.6 ns after the charge, 13.3 mV/fC.
TIGER_T = Shaper(((0.00181928, 0.0, 1 / 3), (-0.0147059, 0.0, 1 / 20), (0.0128866, 0.0, 1 / 100)), delay=10.0)
#: Branch E of TIGER, for the charge: PARSIFAL. Peak 154.7 ns after the charge, 12.3 mV/fC.
TIGER_E = Shaper(((100164.0, 1358.7, 0.0385647), (-100164.0, 1358.7, 0.0114353)), delay=5.0)
