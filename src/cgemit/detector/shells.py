"""Placed matter: shells of one material, and slabs of neighbouring shells that scatter as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit import _core
from cgemit.detector.keys import Known, Part, key, once, plain
from cgemit.detector.material import Element, Material
from cgemit.units import parse_quantity

TOUCH = 1e-6  # mm; parts closer than this touch
ENDLESS = (-1e9, 1e9)  # mm, ends of air

_END = "z of the end at {}; both ends take the place of the length"
_FAR = 5000.0  # mm, of an end from z = 0


@dataclass(frozen=True, kw_only=True)
class Bounded(Part):
    """A part with ends along the beam: z_min and z_max, or a length if they are as far from z = 0 on both sides."""

    #: Name of the short form, and its value over the distance of the ends.
    short_form: ClassVar[tuple[str, float]] = ("half_length", 0.5)

    z_min: float | None = field(metadata=key("length", _END.format("-z"), -_FAR, _FAR, quiet=True), default=None)  # mm
    z_max: float | None = field(metadata=key("length", _END.format("+z"), -_FAR, _FAR, quiet=True), default=None)  # mm

    if TYPE_CHECKING:

        @property
        def half_length(self) -> float:
            """Half of the distance of the ends, mm."""

    @property
    def ends(self) -> tuple[float, float]:
        """Ends along the beam, mm."""
        if self.z_min is None or self.z_max is None:
            return -self.half_length, self.half_length
        return self.z_min, self.z_max

    @property
    def z_mid(self) -> float:
        """Middle between the ends, mm."""
        low, high = self.ends
        return 0.5 * (low + high)

    @classmethod
    def drop_ends(cls, base: dict[str, Any], variant: Mapping[str, Any]) -> None:
        """Remove the ends of a base that a variant replaces; the short form of the base stands for the other end."""
        short, share = cls.short_form
        if short in variant:
            base.pop("z_min", None)
            base.pop("z_max", None)
        elif ("z_min" in variant or "z_max" in variant) and short in base:
            old = plain(base[short])
            try:
                half = 0.5 / share * (parse_quantity(old, "length") if isinstance(old, str) else old)
            except (TypeError, ValueError):
                return  # it is noted where it is read
            del base[short]
            if plain(base.get("z_min")) is None:
                base |= {"z_min": Known(-half), "z_max": Known(half)}

    def length_text(self) -> str:
        """Return the ends as a part of a line."""
        low, high = self.ends
        return f"length {high - low:g} mm" if low == -high else f"z = {low:g} to {high:g} mm"


def share_z(ends: tuple[float, float], other: tuple[float, float]) -> bool:
    """Return whether parts with these ends, mm, have a part of z in common; ends that touch are none."""
    return not (ends[1] <= other[0] + TOUCH or other[1] <= ends[0] + TOUCH)


class Shell(NamedTuple):
    """A placed sub-layer; `group` is pipe, wall, air, cathode, drift, foils, anode or gas.

    Examples
    --------
    >>> shells = cg.load("besiii-cgem").cgem["L1"].shells()
    >>> print(*[(shell.group, shell.label) for shell in shells][-3:])
    ('anode', 'Epoxy5') ('anode', 'Cu3') ('anode', 'Kapton5')
    """

    group: str
    label: str
    r_in: float  # mm
    r_out: float  # mm
    ends: tuple[float, float]  # mm, along the beam
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


#: Numbers of a slab, in the order of `Row.numbers`: mm, but `x0` dimensionless and `xi` in GeV.
NUMBERS = ("z_min", "z_max", "r_in", "r_out", "radius", "spread", "x0", "xi")


class Row(NamedTuple):
    """What the core needs of a slab: the columns `NUMBERS`, the Bethe logarithm, (Z, A, mol/cm2) of its elements."""

    numbers: tuple[float, ...]
    log_terms: NDArray[np.float64]  # (LOSS_POINTS,)
    elements: NDArray[np.float64]  # (elements, 3)


@once
def _compiled(material: Material) -> _core.detector.Material:
    grid = _core.detector.LOSS_GRID_FIRST + _core.detector.LOSS_GRID_STEP * np.arange(
        _core.detector.LOSS_POINTS, dtype=np.float64
    )
    elements = [(_first(one), moles * material.density * 0.1) for one, moles in material.elements()]
    return _core.detector.Material(
        x0=material.x0, xi=material.xi_per_mm, log_term=material.log_term(grid),
        elements=[(id(one), one.z, one.a, per_mm) for one, per_mm in elements],
    )  # fmt: skip


@cache
def _first(element: Element) -> Element:
    """Return the first element that was equal, so that equal ones are the same object."""
    return element


def row_of(shells: Sequence[Shell]) -> Row:
    """Return the row of neighbouring shells that act as one scatterer."""
    _, _, r_in, r_out, ends, materials = zip(*shells, strict=True)
    compiled = {id(material): _compiled(material) for material in {id(one): one for one in materials}.values()}
    radius, spread, x0, xi, log_terms, elements = _core.detector.sum_shells(
        materials=[compiled[id(material)] for material in materials], r_in=r_in, r_out=r_out
    )
    low, high = zip(*ends, strict=True)
    numbers = (min(low), max(high), r_in[0], max(r_out), radius, spread, x0, xi)
    return Row(numbers, log_terms, elements)


class Holes(NamedTuple):
    """A hexagonal lattice of holes through one sub-layer of a foil.

    Their radius is `waist` in the middle of the foil and grows by `widening` per mm from there; `begin` and `end` tell
    where the sub-layer lies, outward from the middle of the foil.
    """

    foil: int  # running number in the detector
    pitch: float  # mm
    waist: float  # mm
    widening: float
    begin: float  # mm
    end: float  # mm


@dataclass(frozen=True)
class Slab:
    """Neighbouring shells that act as one scatterer; `gap` is the CGEM layer whose drift gap this is, or -1.

    Examples
    --------
    >>> from cgemit.detector import slabs
    >>> slabs = slabs(cg.load("besiii-cgem"))
    >>> [slab.gap for slab in slabs if slab.gap >= 0]  # drift gaps
    [0, 1, 2]
    """

    shells: tuple[Shell, ...]
    gap: int = -1
    holes: Holes | None = None  # of a part of a foil at the density of its solid matter

    @property
    def ends(self) -> tuple[float, float]:
        """Ends along the beam, mm."""
        low, high = zip(*(shell.ends for shell in self.shells), strict=True)
        return min(low), max(high)

    @property
    def filler(self) -> int:
        """What fills the space between parts: 0 for a part, 1 for air, 2 for gas of the drift chamber."""
        return {"air": 1, "gas": 2}.get(self.shells[0].group, 0)

    @property
    def r_in(self) -> float:
        """Inner radius, mm."""
        return self.shells[0].r_in

    @cached_property
    def r_out(self) -> float:
        """Outer radius, mm."""
        return max(shell.r_out for shell in self.shells)

    @property
    def x0(self) -> float:
        """Thickness in radiation lengths at normal incidence."""
        return sum(shell.x0 for shell in self.shells)

    @property
    def xi(self) -> float:
        """(K/2) sum of Z/A times mass thickness at normal incidence, GeV."""
        return sum(shell.xi for shell in self.shells)

    @property
    def radius(self) -> float:
        """Centroid of the scattering power, mm."""
        return self.row.numbers[4]

    @property
    def spread(self) -> float:
        """Standard deviation of the scattering power about `radius`, mm; each shell counts with its own width."""
        return self.row.numbers[5]

    @cached_property
    def row(self) -> Row:
        """What the core needs of it; a variant shares most slabs with its base."""
        return row_of(self.shells)

    def log_term(self, ln_betagamma: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return -2 ln(I/GeV) - delta - 2 C/Z, (n,) float64, averaged over the shells with their xi."""
        terms = [shell.xi * shell.material.log_term(ln_betagamma) for shell in self.shells]
        return np.asarray(np.sum(terms, axis=0) / self.xi, dtype=np.float64)
