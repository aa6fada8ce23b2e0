"""The matter of a detector as slabs that scatter, from the beam line outward."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit.detector.check import TOUCH
from cgemit.detector.lattice import Holes, perforated
from cgemit.detector.material import Material
from cgemit.detector.parts import Contents, Cylinder, DriftChamber, Shell

ENDLESS = 1e9  # mm, half length of air
_LUMP = 70.0  # mm of chamber gas that act as one scatterer: about four wire layers


class Slab(NamedTuple):
    """Neighbouring shells that act as one scatterer; `gap` is the CGEM layer whose drift gap this is, or -1."""

    shells: tuple[Shell, ...]
    gap: int = -1
    ends: bool = False  # leaving it through an end means leaving the detector
    holes: Holes | None = None  # of a part of a foil at the density of its solid matter

    @property
    def r_in(self) -> float:
        """Inner radius, mm."""
        return self.shells[0].r_in

    @property
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
        return sum(shell.x0 * _middle(shell) for shell in self.shells) / self.x0

    @property
    def spread(self) -> float:
        """Standard deviation of the scattering power about `radius`, mm; each shell counts with its own width."""
        radius = self.radius
        widths = ((_middle(s) - radius) ** 2 + (s.r_out - s.r_in) ** 2 / 12 for s in self.shells)
        return math.sqrt(sum(s.x0 * width for s, width in zip(self.shells, widths, strict=True)) / self.x0)

    def log_term(self, ln_betagamma: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return -2 ln(I/GeV) - delta - 2 C/Z, (n,) float64, averaged over the shells with their xi."""
        terms = [shell.xi * shell.material.log_term(ln_betagamma) for shell in self.shells]
        return np.asarray(np.sum(terms, axis=0) / self.xi, dtype=np.float64)


def _middle(shell: Shell) -> float:
    return 0.5 * (shell.r_in + shell.r_out)


def slabs(detector: Contents, merge: bool = True, foil: str = "effective") -> list[Slab]:
    """Return the matter of a detector, ordered from the beam line outward.

    Parameters
    ----------
    detector : Detector
        The description.
    merge : bool
        Join touching cylinders of beam pipe and walls, in each CGEM layer cathode, foils (with the gas between
        them) and anode, and the chamber gas of some wire layers, to one slab each. The sums of X/X0 and xi do not
        change.
    foil : str
        ``"effective"``: foils at the density that the description gives them. ``"lattice"``: their sub-layers are
        slabs of solid matter with holes, whatever `merge` (docs/methods/foils.md).

    """
    solid = _cylinders("pipe", detector.beam_pipe, merge) + _cylinders("wall", detector.walls, merge)
    for number, layer in enumerate(detector.cgem):
        lattice = foil == "lattice"
        if lattice:
            first = sum(other.foils for other in detector.cgem[:number])
            solid += [Slab((shell,), holes=holes) for shell, holes in perforated(layer, first)]
        for group in ("cathode", "drift", "anode") if lattice else ("cathode", "drift", "foils", "anode"):
            shells = [shell for shell in layer.shells() if shell.group == group]
            solid += [Slab(tuple(part), number if group == "drift" else -1) for part in _parts(shells, merge)]
    solid.sort(key=lambda slab: slab.r_in)
    return sorted(solid + _fillers(detector, solid, merge), key=lambda slab: slab.r_in)


def _parts(shells: Sequence[Shell], merge: bool) -> list[list[Shell]]:
    return [list(shells)] if merge else [[shell] for shell in shells]


def _cylinders(group: str, cylinders: Iterable[Cylinder], merge: bool) -> list[Slab]:
    """Return cylinders as slabs; touching ones are joined and reach as far along the beam as the longest of them."""
    runs: list[list[Shell]] = []
    for part in cylinders:
        shell = Shell(group, part.label, part.r_in, part.r_out, part.half_length, part.material)
        if merge and runs and part.r_in - runs[-1][-1].r_out < TOUCH:
            runs[-1].append(shell)
        else:
            runs.append([shell])
    return [Slab(tuple(run)) for run in runs]


def _fillers(detector: Contents, solid: Sequence[Slab], merge: bool) -> list[Slab]:
    """Return air between the parts, and the gas of the drift chamber around and between its wire layers."""
    chamber = detector.drift_chamber
    first_wire = chamber.layers[0].r_mid if chamber else math.inf
    inside = [slab for slab in solid if slab.r_in < first_wire]
    found = []
    for inner, outer in pairwise(inside):
        if outer.r_in - inner.r_out > TOUCH:
            found.append(Slab((Shell("air", "air", inner.r_out, outer.r_in, ENDLESS, detector.air),)))
    gas = _chamber_gas(chamber, solid, inside) if chamber else []
    return found + (_lumps(gas) if merge else gas)


def _lumps(gas: Sequence[Slab]) -> list[Slab]:
    """Join neighbouring lumps of gas that end at about the same z, up to a certain depth."""
    found: list[Slab] = []
    for slab in gas:
        last = found[-1] if found else None
        touches = last is not None and slab.r_in - last.r_out < TOUCH
        if last is not None and touches and slab.r_out - last.r_in < _LUMP and _same_end(last, slab):
            found[-1] = Slab((*last.shells, *slab.shells), ends=True)
        else:
            found.append(slab)
    return found


def _same_end(a: Slab, b: Slab) -> bool:
    ends = [shell.half_length for slab in (a, b) for shell in slab.shells]
    return max(ends) < 1.01 * min(ends)


def _chamber_gas(chamber: DriftChamber, solid: Sequence[Slab], inside: Sequence[Slab]) -> list[Slab]:
    """Return one lump of gas before each wire layer; the innermost begins at the last part inside the chamber.

    Where the end plate steps outward from one layer to the next, the lump reaches to the farther plate.

    Without a part inside, the chamber begins at its first wire layer.
    """
    found = []
    start = inside[-1].r_out if inside else chamber.layers[0].r_mid
    inner = chamber.layers[0]
    for layer in chamber.layers:
        walls = [(s.r_in, s.r_out) for s in solid if start - TOUCH < s.r_in < layer.r_mid]
        length = max(inner.half_length, layer.half_length)
        for r_in, r_out in _between(start, layer.r_mid, walls):
            gas = Shell("gas", f"gas before layer {layer.number}", r_in, r_out, length, chamber.gas)
            share = (r_out - r_in) / (layer.r_mid - start)
            found.append(Slab((gas, *_wires(chamber, gas, layer.wire_x0 * share)), ends=True))
        start, inner = layer.r_mid, layer
    return found


def _between(start: float, end: float, walls: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return what is left of an interval without the walls in it."""
    edges = [start, *(edge for wall in sorted(walls) for edge in wall), end]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > TOUCH]


def _wires(chamber: DriftChamber, gas: Shell, x0: float) -> list[Shell]:
    """Return the wires as matter spread evenly over a lump of gas: nothing, or one shell of low density."""
    if chamber.wires == "none" or x0 == 0:
        return []
    metal = chamber.wire_material
    return [gas._replace(label="wires", material=_spread(metal, x0 * metal.x0 / gas.thickness))]


def _spread(metal: Material, filling: float) -> Material:
    return dataclasses.replace(
        metal, name=f"{metal.name} wires", density=metal.density * filling, x0=metal.x0 / filling
    )
