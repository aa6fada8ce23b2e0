"""What all readouts have in common: the electronics of a layer as hardware (docs/methods/readout.md)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar, Literal

from cgemit.base.settings import SettingsData
from cgemit.base.validate import Quantity, Whole, default_of
from cgemit.detector.keys import Part
from cgemit.units import parse_quantity

Share = Annotated[float, Quantity("dimensionless", 0.0, 0.99)]

# An avalanche of 1e8 electrons is a discharge (Raether's limit).
Gain = Annotated[float, Quantity("dimensionless", 0.0, 1e8, above=True)]

Width = Annotated[float, Quantity("length", 0.0, 1000.0, above=True)]

# Of a strip and of a time, to far beyond any chip.
Noise = Annotated[float, Quantity("charge", 0.0, 1000.0)]

Threshold = Annotated[float, Quantity("charge", 0.0, 1e12, above=True)]

Jitter = Annotated[float, Quantity("time", 0.0, 10_000.0)]

Margin = Annotated[float, Quantity("time", 0.0, 1e12, above=True)]

Probability = Annotated[float, Quantity("dimensionless", 0.0, 1.0, above=True)]

Factor = Annotated[float, Quantity("dimensionless", 0.0, 10.0)]

Missing = Annotated[int, Whole(0, 10)]

Estimator = Literal["merged", "centroid", "micro-tpc"]

#: Electrons on the anode per electron of ionization: effective gain of a triple GEM.
GAIN = 12_000.0

SURVIVAL = 0.957 * 0.962
"""An electron enters a hole of the first foil, and its gain is not zero (PARSIFAL, at the nominal voltage)."""

ELECTRON = parse_quantity("1 e", "charge")
"""fC."""


@dataclass(frozen=True, kw_only=True)
class Readout(SettingsData, Part):
    """Electronics of a layer, and what is made of their signals: a frozen dataclass of settings (`readouts`).

    Attributes
    ----------
    name : str
        Under which `cgemit.detector.readouts.READOUTS` holds the class.
    makes : str
        What its digis are: strips, or positions.
    """

    name: ClassVar[str]
    makes: ClassVar[Literal["strips", "positions"]] = "strips"

    @property
    def least_electrons(self) -> int:
        """Electrons of ionization in a gap below which a crossing has no clusters; 0: clusters need none."""
        return 1

    def children(self) -> dict[str, Any]:
        """Return the name and the values."""
        return super().children() | {"name": self.name}

    def stated(self) -> dict[str, Any]:
        """Return the name, and the values that differ from their defaults, by key."""
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        usual = {one.name: default_of(one) for one in fields(self)}
        return {"name": self.name} | {name: value for name, value in values.items() if value != usual[name]}


@dataclass(frozen=True)
class ChipErrors:
    """Factors of a chip in the errors of its clusters, fitted to simulated clusters (``cgemit readout --fit``).

    Errors of clusters: docs/methods/readout.md.

    Attributes
    ----------
    ionization : float
        On the variance of the mean height of the charge, from the numbers and sizes of ionization clusters.
    cut : float
        On the variance by charge of strips below the threshold.
    diffusion : float
        On the variance by diffusion, holes and gain over the number of electrons.
    span : float
        On the variance of heights, from the part of the gap that a strip sees and its number of electrons.
    time : float
        On the variance of heights by jitter, and by noise on the leading edge.
    wide : float
        On the variance that charge wider than expected shows, by the share that its largest ionization cluster has.
    line : float
        On the variance of a line fit by its own slope.
    height_by_threshold : float
        What to add to heights, over the part of the gap that a strip sees and the share of the thresholds of all strips
        in the charge of a cluster.
    """

    ionization: float
    cut: float
    diffusion: float
    span: float
    time: float
    wide: float
    line: float
    height_by_threshold: float
