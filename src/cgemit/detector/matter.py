"""Matter of a detector as slabs that scatter, from the beam line outward; foils also as solid matter with holes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit import _core
from cgemit.detector.check import TOUCH
from cgemit.detector.keys import once
from cgemit.detector.material import Element, Material
from cgemit.detector.parts import CgemLayer, Contents, Cylinder, DriftChamber, MeasurementLayer, Shell, WireLayer

#: Numbers of a slab, in the order of `Row.numbers`: mm, but `x0` dimensionless and `xi` in GeV.
NUMBERS = ("half_length", "r_in", "r_out", "radius", "spread", "x0", "xi")


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
    """Return the row of neighbouring shells that act as one scatterer.

    Parameters
    ----------
    shells : sequence of Shell
    """
    _, _, r_in, r_out, half_lengths, materials = zip(*shells, strict=True)
    made = {id(material): _compiled(material) for material in {id(one): one for one in materials}.values()}
    radius, spread, x0, xi, log_terms, elements = _core.detector.sum_shells(
        materials=[made[id(material)] for material in materials], r_in=r_in, r_out=r_out
    )
    numbers = (max(half_lengths), r_in[0], max(r_out), radius, spread, x0, xi)
    return Row(numbers, log_terms, elements)


#: RNG places of slabs that only a lattice has count from here, so that other slabs keep theirs.
_FIRST_PLACE = 1 << 16


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


def perforated(layer: CgemLayer, first_foil: int) -> Iterator[tuple[Shell, Holes | None]]:
    """Yield the foils of a layer and the gas behind each, sub-layer by sub-layer: foils solid, and with holes.

    Parameters
    ----------
    layer : CgemLayer
    first_foil : int
        Running number of the layer's first foil.

    """
    shells = [shell for shell in layer.shells() if shell.group == "foils"]
    n = len(layer.foil)
    for number in range(layer.foils):
        *parts, gas = shells[number * (n + 1) : (number + 1) * (n + 1)]
        for shell, holes in zip(parts, _holes(layer, first_foil + number), strict=True):
            yield shell._replace(material=shell.material.solid()), holes
        yield gas, None


def _holes(layer: CgemLayer, foil: int) -> Iterator[Holes]:
    """Yield the holes of each sub-layer of a foil.

    The first and the last of three or more sub-layers are electrodes, with cylindrical holes; between them holes are
    double cones with their waist in the middle.
    """
    edges = np.cumsum([0.0, *(part.thickness for part in layer.foil)])
    edges -= 0.5 * edges[-1]
    last = len(layer.foil) - 1
    inner = slice(1, last) if last > 1 else slice(0, last + 1)
    low, high = edges[inner.start], edges[inner.stop]
    middle = 0.5 * (low + high)
    cone = (layer.hole_outer - layer.hole_inner) / (high - low)
    for i, (begin, end) in enumerate(zip(edges[:-1] - middle, edges[1:] - middle, strict=True)):
        electrode = not inner.start <= i < inner.stop
        shape = (0.5 * layer.hole_outer, 0.0) if electrode else (0.5 * layer.hole_inner, cone)
        yield Holes(foil, layer.hole_pitch, *map(float, (*shape, begin, end)))


def hole_table(holes: Sequence[Holes | None], groups: Sequence[str], merge: bool) -> dict[str, NDArray[np.generic]]:
    """Return holes as the core takes them.

    Parameters
    ----------
    holes : sequence of (Holes or None), one per slab
    groups : sequence of str
        Group of each slab.
    merge : bool
        Whether the other slabs are merged.

    Returns
    -------
    dict of ndarray
        place (slabs,) uint32; of slabs with holes, (m,): slab, foil int32; pitch, waist, begin, end float64 mm;
        widening float64.

    """
    rows = [(number, *found) for number, found in enumerate(holes) if found]
    names = ("slab", *Holes._fields)
    columns = dict(zip(names, np.array(rows, dtype=np.float64).reshape(-1, len(names)).T.copy(), strict=True))
    table: dict[str, NDArray[np.generic]] = dict(columns)
    table |= {name: columns[name].astype(np.int32) for name in ("slab", "foil")}
    return {**table, "place": np.array(_places(groups, merge), dtype=np.uint32)}


def _places(groups: Sequence[str], merge: bool) -> list[int]:
    """Return the RNG place of each slab: as without a lattice, so that both share their noise."""
    if not merge:
        return list(range(len(groups)))
    places: list[int] = []
    merged, parts = 0, _FIRST_PLACE
    for is_foils, run in groupby(group == "foils" for group in groups):
        n = len(list(run))
        places += range(parts, parts + n) if is_foils else range(merged, merged + n)
        merged += 1 if is_foils else n
        parts += n if is_foils else 0
    return places


ENDLESS = 1e9  # mm, half length of air
_LUMP = 70.0  # mm of chamber gas that act as one scatterer: about four wire layers


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
        return self.row.numbers[3]

    @property
    def spread(self) -> float:
        """Standard deviation of the scattering power about `radius`, mm; each shell counts with its own width."""
        return self.row.numbers[4]

    @cached_property
    def row(self) -> Row:
        """What the core needs of it; a variant shares most slabs with its base."""
        return row_of(self.shells)

    def log_term(self, ln_betagamma: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return -2 ln(I/GeV) - delta - 2 C/Z, (n,) float64, averaged over the shells with their xi."""
        terms = [shell.xi * shell.material.log_term(ln_betagamma) for shell in self.shells]
        return np.asarray(np.sum(terms, axis=0) / self.xi, dtype=np.float64)


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

    Examples
    --------
    >>> from cgemit.detector import slabs
    >>> slabs = slabs(cg.load("besiii-cgem"))
    >>> len([slab for slab in slabs if slab.gap >= 0])
    3
    """
    solid = [*_cylinders("pipe", detector.beam_pipe, merge), *_cylinders("wall", detector.walls, merge)]
    foils = 0
    for number, layer in enumerate(detector.layers):
        if isinstance(layer, CgemLayer):
            solid += _layer(layer, number, foils, merge, foil == "lattice")
            foils += layer.foils
        else:
            solid += _sensor(layer, number, merge)
    for layer in detector.layer:
        solid += () if layer.views else _sensor(layer, -1, merge)
    solid.sort(key=lambda slab: slab.r_in)
    return sorted(solid + _fillers(detector, solid, merge), key=lambda slab: slab.r_in)


#: The keys of a CGEM layer that its matter depends on.
_MATTER = ("anode_radius", "length", "drift_gap", "transfer_gap", "induction_gap", "foils", "hole_outer", "hole_inner",
           "hole_pitch", "gas", "cathode", "foil", "anode")  # fmt: skip


@dataclass(frozen=True)
class _Matter:
    """A CGEM layer that is equal to others of the same matter, whatever their strips are."""

    values: tuple[object, ...]
    layer: CgemLayer = field(compare=False)


@once
def _layer(layer: CgemLayer, number: int, first_foil: int, merge: bool, lattice: bool) -> tuple[Slab, ...]:
    """Return the slabs of a CGEM layer; `number` is its own, `first_foil` that of its first foil in the detector."""
    matter = _Matter(tuple([getattr(layer, name) for name in _MATTER]), layer)
    return _same_matter(matter, number, first_foil, merge, lattice)


@lru_cache(maxsize=256)
def _same_matter(matter: _Matter, number: int, first_foil: int, merge: bool, lattice: bool) -> tuple[Slab, ...]:
    found, layer = [], matter.layer
    if lattice:
        found += [Slab((shell,), holes=holes) for shell, holes in perforated(layer, first_foil)]
    for shells in layer.stacks():
        group = shells[0].group
        if not lattice or group != "foils":
            gap = number if group == "drift" else -1
            found += [Slab(part, gap) for part in ([shells] if merge else [(shell,) for shell in shells])]
    return tuple(found)


@once
def _sensor(layer: MeasurementLayer, number: int, merge: bool) -> tuple[Slab, ...]:
    """Return the slabs of a measurement layer: the sensor, where the track is measured, and the support behind it."""
    sensor, *support = layer.stacks()
    return (
        Slab(sensor, number),
        *(Slab(part) for part in (support if merge else [(one,) for run in support for one in run])),
    )


@lru_cache(maxsize=256)
def _cylinders(group: str, cylinders: tuple[Cylinder, ...], merge: bool) -> tuple[Slab, ...]:
    """Return cylinders as slabs; touching ones are joined and reach as far along the beam as the longest of them."""
    runs: list[list[Shell]] = []
    for part in cylinders:
        shell = Shell(group, part.label, part.r_in, part.r_out, part.half_length, part.material)
        if merge and runs and part.r_in - runs[-1][-1].r_out < TOUCH:
            runs[-1].append(shell)
        else:
            runs.append([shell])
    return tuple(Slab(tuple(run)) for run in runs)


def _fillers(detector: Contents, solid: Sequence[Slab], merge: bool) -> list[Slab]:
    """Return air between the parts, and the gas of the drift chamber around and between its wire layers."""
    chamber = detector.drift_chamber
    first_wire = chamber.layers[0].r_mid if chamber else math.inf
    inside = [slab for slab in solid if slab.r_in < first_wire]
    found = []
    for inner, outer in pairwise(inside):
        end, begin = inner.r_out, outer.r_in
        if begin - end > TOUCH:
            found.append(_air(end, begin, detector.air))
    if chamber:
        # Without a part inside, the chamber begins at its first wire layer, or with the cells of wires that count.
        gas = _gas(chamber)
        half_cell = math.pi * first_wire / chamber.layers[0].cells if gas.layers[0].wires else 0.0
        start = inside[-1].r_out if inside else first_wire - half_cell
        walls = tuple((slab.r_in, slab.r_out) for slab in solid if slab.r_in > start - TOUCH)
        found += _chamber_gas(gas, start, walls, merge)
        found += _behind(detector, chamber, solid)
    return found


def _behind(detector: Contents, chamber: DriftChamber, solid: Sequence[Slab]) -> list[Slab]:
    """Return the gas from the outermost wires to the part behind them, and air between the parts from there on."""
    last = chamber.layers[-1]
    outside = [slab for slab in solid if slab.r_in > last.r_mid - TOUCH]
    found = []
    if outside and outside[0].r_in - last.r_mid > TOUCH:
        text = f"gas behind layer {last.number}"
        shell = Shell("gas", text, last.r_mid, outside[0].r_in, last.half_length, last.gas or chamber.gas)
        found.append(Slab((shell,)))
    for inner, outer in pairwise(outside):
        if outer.r_in - inner.r_out > TOUCH:
            found.append(_air(inner.r_out, outer.r_in, detector.air))
    return found


@lru_cache(maxsize=256)
def _air(r_in: float, r_out: float, air: Material) -> Slab:
    return Slab((Shell("air", "air", r_in, r_out, ENDLESS, air),))


class _GasLayer(NamedTuple):
    """What the gas before a wire layer depends on."""

    number: int
    r_mid: float  # mm
    half_length: float  # mm
    material: Material
    wires: tuple[tuple[Material, float], ...]  # materials and X/X0 of wires that count


class _Gas(NamedTuple):
    """What the gas of a chamber depends on: not the errors of the wires, for example."""

    layers: tuple[_GasLayer, ...]


@once
def _gas(chamber: DriftChamber) -> _Gas:
    return _Gas(tuple(_gas_layer(chamber, one) for one in chamber.layers))


def _gas_layer(chamber: DriftChamber, layer: WireLayer) -> _GasLayer:
    wires = layer.wire_matter(chamber.wire_material) if chamber.wires == "smeared" else ()
    return _GasLayer(layer.number, layer.r_mid, layer.half_length, layer.gas or chamber.gas, wires)


def row_shells(chamber: DriftChamber, layer: WireLayer, width: float) -> list[Shell]:
    """Return the gas about a wire layer, some mm wide, and the layer's wires spread over it.

    Parameters
    ----------
    chamber : DriftChamber
    layer : WireLayer
    width : float
        mm.
    """
    gas = _gas_layer(chamber, layer)
    shell = Shell("gas", "", layer.r_mid - 0.5 * width, layer.r_mid + 0.5 * width, layer.half_length, gas.material)
    return [shell, *_wires(gas, shell, 1.0)]


def _lumps(gas: Sequence[Slab]) -> list[Slab]:
    """Join neighbouring lumps of gas that end at about the same z, up to a certain depth."""
    found: list[Slab] = []
    for slab in gas:
        last = found[-1] if found else None
        touches = last is not None and slab.r_in - last.r_out < TOUCH
        if last is not None and touches and slab.r_out - last.r_in < _LUMP and _same_end(last, slab):
            found[-1] = Slab((*last.shells, *slab.shells))
        else:
            found.append(slab)
    return found


def _same_end(a: Slab, b: Slab) -> bool:
    ends = [shell.half_length for slab in (a, b) for shell in slab.shells]
    return max(ends) < 1.01 * min(ends)


@lru_cache(maxsize=256)
def _chamber_gas(gas: _Gas, start: float, walls: tuple[tuple[float, float], ...], merge: bool) -> tuple[Slab, ...]:
    """Return one lump of gas before each wire layer, the innermost from `start`, or if merged larger lumps.

    Where the end plate steps outward from one layer to the next, the lump reaches to the farther plate.
    """
    found = []
    before = gas.layers[0].half_length
    for layer in gas.layers:
        number, radius, half_length = layer.number, layer.r_mid, layer.half_length
        here = [wall for wall in walls if start - TOUCH < wall[0] < radius]
        for r_in, r_out in _between(start, radius, here):
            text = f"gas before layer {number}"
            shell = Shell("gas", text, r_in, r_out, max(before, half_length), layer.material)
            share = (r_out - r_in) / (radius - start)
            found.append(Slab((shell, *_wires(layer, shell, share))))
        start, before = radius, half_length
    return tuple(_lumps(found) if merge else found)


def _between(start: float, end: float, walls: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the parts of an interval outside the walls in it."""
    edges = [start, *(edge for wall in sorted(walls) for edge in wall), end]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > TOUCH]


def _wires(layer: _GasLayer, shell: Shell, share: float) -> list[Shell]:
    """Return a share of the wires as matter spread evenly over a lump of gas: a shell of low density a material."""
    return [
        shell._replace(label="wires", material=_spread(metal, x0 * share * metal.x0 / shell.thickness))
        for metal, x0 in layer.wires
    ]


def _spread(metal: Material, filling: float) -> Material:
    return dataclasses.replace(
        metal, name=f"{metal.name} wires", density=metal.density * filling, x0=metal.x0 / filling
    )
