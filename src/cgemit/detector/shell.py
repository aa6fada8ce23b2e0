"""One placed layer of one material."""

from __future__ import annotations

from typing import NamedTuple

from cgemit.detector.material import Material


class Shell(NamedTuple):
    """A placed sub-layer; `group` is pipe, wall, air, cathode, drift, foils, anode or gas."""

    group: str
    label: str
    r_in: float  # mm
    r_out: float  # mm
    half_length: float  # mm
    material: Material

    @property
    def thickness(self) -> float:
        """Thickness in mm."""
        return self.r_out - self.r_in

    @property
    def x0(self) -> float:
        """Thickness in radiation lengths at normal incidence."""
        return self.thickness / self.material.x0

    @property
    def xi(self) -> float:
        """(K/2) (Z/A) times the mass thickness at normal incidence, GeV."""
        return self.material.xi(self.thickness)
