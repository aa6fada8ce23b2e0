"""TIGER, the chip of the BESIII CGEM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cgemit.detector.readouts.analog import AnalogReadout, Chip, Shaper

#: Of the BESIII CGEM. Branch T peaks 53.6 ns after a charge, with 13.3 mV/fC; branch E after 154.7 ns, with 12.3 mV/fC.
TIGER = Chip(
    kind="tiger",
    timing=Shaper(((0.00181928, 0.0, 1 / 3), (-0.0147059, 0.0, 1 / 20), (0.0128866, 0.0, 1 / 100)), delay=10.0),
    charge=Shaper(((100164.0, 1358.7, 0.0385647), (-100164.0, 1358.7, 0.0114353)), delay=5.0),
    clock=6.25,
    level=0.0,
    sample_delay=4 * 6.25 * (6 + 0.5),
)


@dataclass(frozen=True, kw_only=True)
class TigerReadout(AnalogReadout):
    """Two branches: the fast one gives the time of the leading edge, the slow one is sampled for the charge.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> result = cg.run("besiii-cgem-design", gun, n=5, readout=cg.TigerReadout(threshold_x=3.0), until="digitize")
    >>> x = result.digis[result.digis["view"] == 0]
    >>> bool((x["charge"] > 1).all()), bool(np.isfinite(x["time"]).all())
    (True, True)
    """

    name: ClassVar[str] = "tiger"
    chip: ClassVar[Chip] = TIGER
