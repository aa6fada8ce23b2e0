"""Analog read-out with the TIGER chip, that of the BESIII CGEM (docs/methods/readout.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cgemit.base.settings import Positive
from cgemit.simulation.readouts.analog import TIGER_E, TIGER_T, AnalogReadout
from cgemit.simulation.readouts.readout import Floats

CLOCK = 6.25  # ns
SAMPLE_DELAY = 4 * CLOCK * (6 + 0.5)
"""From the crossing of the threshold to the sample of the charge, ns (PARSIFAL, github.com/Hilldar/PARSIFAL)."""

_POINTS = 64  # of the delay's table
_LARGEST = 200.0  # fC, of the table
_STEP = 0.1  # ns, in which leading edges are searched


@dataclass(frozen=True, kw_only=True)
class TigerReadout(AnalogReadout):
    """Two branches: the fast one gives the time of the leading edge, the slow one is sampled for the charge.

    Attributes
    ----------
    saturation : float
        fC, largest charge that the chip measures.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    name: ClassVar[str] = "tiger"

    saturation: Positive = 48.0

    def chip(self) -> dict[str, Any]:
        """Return the chip as the core takes it."""
        return self._chip(
            "tiger", TIGER_T, TIGER_E, saturation=self.saturation, sample_delay=SAMPLE_DELAY, clock=CLOCK, samples=1
        )

    def delays(self, induction: Floats) -> tuple[Floats, Floats]:
        """Return measured charge and time of the leading edge after the arrival, see `find_clusters` (time walk).

        Parameters
        ----------
        induction : (layers,) float64, ns
        """
        rows = [
            leading_edges(float(duration), threshold)
            for duration in induction
            for threshold in (self.threshold_x, self.threshold_v)
        ]
        charge, delay = np.swapaxes(np.array(rows).reshape(-1, 2, _POINTS), 0, 1)
        return charge.copy(), delay.copy()


def leading_edges(duration: float, threshold: float) -> tuple[Floats, Floats]:
    """Return measured charge and time of the leading edge, each (64,) float64, for charges that flow in evenly.

    Parameters
    ----------
    duration : float
        ns, of the current.
    threshold : float
        fC.

    Returns
    -------
    charge : ndarray, fC, growing
    delay : ndarray, ns
        After the beginning of the current.
    """
    times = np.arange(0.0, 400.0, _STEP)
    edge = TIGER_T.pulse(times, duration)
    rise = slice(0, int(edge.argmax()) + 1)
    charge = np.geomspace(1.01 * threshold / edge.max(), _LARGEST, _POINTS)
    delay = np.interp(threshold / charge, edge[rise], times[rise])
    return charge * TIGER_E.pulse(delay + SAMPLE_DELAY, duration), delay
