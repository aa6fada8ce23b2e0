"""Positions with errors of their own, without strips."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

from cgemit.detector.readouts.readout import Readout


class Precision(NamedTuple):
    """How a layer measures positions."""

    sigma_x: float  # mm; 0: the middle of a strip
    sigma_v: float  # mm; 0: the middle of a strip
    sigma_time: float  # ns

    def errors(self, pitch_x: float, pitch_v: float) -> tuple[float, float]:
        """Return the errors of X and V with strips of some pitches, mm; 0 where neither is given."""
        return self.sigma_x or pitch_x / math.sqrt(12), self.sigma_v or pitch_v / math.sqrt(12)


@dataclass(frozen=True, kw_only=True)
class PositionReadout(Readout):
    """No strips: positions X and V, with the errors and the time of each layer (`[layer.NAME]`)."""

    name: ClassVar[str] = "positions"
    makes: ClassVar[Literal["strips", "positions"]] = "positions"

    @property
    def least_electrons(self) -> int:
        """0: positions need no ionization."""
        return 0

    @property
    def gain(self) -> float:
        """Electrons per electron of ionization; 0: the charge is not measured."""
        return 0.0

    def precision(self, own: Precision) -> Precision:
        """Return how a layer measures.

        Parameters
        ----------
        own : Precision
            What the layer states.
        """
        return own
