"""Analog read-out with the APV25 chip, that of the test beams (docs/methods/readout.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cgemit.base.settings import Positive
from cgemit.detector import Detector
from cgemit.simulation.readouts.analog import APV25, AnalogReadout
from cgemit.simulation.readouts.readout import Floats, Jitter

CLOCK = 25.0  # ns, between samples
SAMPLES = 27

_PHASES = np.arange(0.5, CLOCK, dtype=np.float64)  # ns, of the arrival after a sample


@dataclass(frozen=True, kw_only=True)
class Apv25Readout(AnalogReadout):
    """Samples every 25 ns: the largest is the charge, half of it on the leading edge the time.

    Attributes
    ----------
    saturation : float
        fC, largest charge that the chip measures.
    random_neighbours : bool
        Whether strips induce charge on their neighbours at random, with probability, share and time that depend on
        their charge, as PARSIFAL has them for a triple GEM; beside `neighbour`.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    name: ClassVar[str] = "apv25"

    threshold_x: Positive = 1.67
    threshold_v: Positive = 1.67
    jitter: Jitter = 7.12
    time_margin: Positive = 100.0
    saturation: Positive = 60.0
    random_neighbours: bool = False

    def core_arguments(self, detector: Detector) -> dict[str, Any]:
        """Return the arguments of the compiled digitization, see `AnalogReadout.core_arguments`.

        Parameters
        ----------
        detector : Detector
        """
        return super().core_arguments(detector) | {"induced": self.random_neighbours}

    def chip(self) -> dict[str, Any]:
        """Return the chip as the core takes it."""
        return self._chip(
            "apv25", APV25, APV25, saturation=self.saturation, sample_delay=0.0, clock=CLOCK, samples=SAMPLES
        )

    def delays(self, induction: Floats) -> tuple[Floats, Floats]:
        """Return the time of half the largest sample after the arrival, at any charge, see `find_clusters`.

        Parameters
        ----------
        induction : (layers,) float64, ns
        """
        delay = np.repeat([half_height(float(duration)) for duration in induction], 2)[:, None] * np.ones(2)
        return np.tile([0.0, 1.0], (len(delay), 1)), delay


def half_height(duration: float) -> float:
    """Return the mean time after the arrival, ns, at which samples reach half of the largest one.

    Parameters
    ----------
    duration : float
        ns, of the current.
    """
    times = CLOCK * np.arange(SAMPLES, dtype=np.float64)
    found = []
    for phase in _PHASES:
        arrival = 4 * CLOCK + float(phase)
        samples = APV25.pulse(times - arrival, duration)
        top = int(samples.argmax())
        first = int(np.flatnonzero(samples[: top + 1] <= 0.5 * samples[top])[-1])
        at = times[first] + CLOCK * (0.5 * samples[top] - samples[first]) / (samples[first + 1] - samples[first])
        found.append(at - arrival)
    return float(np.mean(found))
