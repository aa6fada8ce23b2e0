"""APV25, the chip of the test beams."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from cgemit.detector.readouts.analog import AnalogReadout, Chip, Shaper
from cgemit.detector.readouts.readout import Jitter, Margin, Threshold

# Shapers and times are those of PARSIFAL (github.com/Hilldar/PARSIFAL).
_CR_RC = Shaper(((0.0, math.e / 50, 1 / 50),))  # (t/tau) exp(1 - t/tau), 50 ns

#: Of the test beams.
APV25 = Chip(kind="apv25", timing=_CR_RC, charge=_CR_RC, clock=25.0, level=0.5, samples=27)


@dataclass(frozen=True, kw_only=True)
class Apv25Readout(AnalogReadout):
    """Samples every 25 ns: the largest is the charge, half of it on the leading edge the time.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> result = cg.run("besiii-cgem-design", gun, n=5, readout=cg.Apv25Readout(noise=0.4), until="digitize")
    >>> bool((result.digis["charge"] > 1).all())  # fC; the threshold is 1.67
    True
    """

    name: ClassVar[str] = "apv25"
    chip: ClassVar[Chip] = APV25

    threshold_x: Threshold = 1.67
    threshold_v: Threshold = 1.67
    jitter: Jitter = 7.12
    time_margin: Margin = 100.0
    saturation: Threshold = 60.0
