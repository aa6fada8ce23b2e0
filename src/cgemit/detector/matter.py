"""Matter of a detector as slabs that scatter, from the beam line outward; foils also as solid matter with holes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit.detector.keys import once
from cgemit.detector.layers.wires import DriftChamber, WireLayer
from cgemit.detector.material import Material
from cgemit.detector.parts import Contents, Cylinder
from cgemit.detector.shells import ENDLESS, TOUCH, Holes, Shell, Slab, share_z

#: RNG places of slabs that only a lattice has count from here, so that other slabs keep theirs.
_FIRST_PLACE = 1 << 16


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


_LUMP = 70.0  # mm of chamber gas that act as one scatterer: about four wire layers


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
    lattice, foils = foil == "lattice", 0
    for number, layer in enumerate(detector.layers):
        of_layer = layer.slabs(number, merge, lattice, foils)
        foils += len({slab.holes.foil for slab in of_layer if slab.holes})
        solid += of_layer
    for layer in detector.barrels:
        solid += () if layer.views else layer.slabs(-1, merge, lattice, 0)
    solid.sort(key=lambda slab: slab.r_in)
    return sorted(solid + _fillers(detector, solid, merge), key=lambda slab: slab.r_in)


@lru_cache(maxsize=256)
def _cylinders(group: str, cylinders: tuple[Cylinder, ...], merge: bool) -> tuple[Slab, ...]:
    """Return cylinders as slabs; touching ones about z = 0 are joined and reach as far along the beam as any of them.

    Others are joined only with their like: they may lie beside each other.
    """
    runs: list[list[Shell]] = []
    for part in cylinders:
        shell = Shell(group, part.label, part.r_in, part.r_out, part.ends, part.material)
        if merge and runs and part.r_in - runs[-1][-1].r_out < TOUCH and _may_join(runs[-1][-1].ends, part.ends):
            runs[-1].append(shell)
        else:
            runs.append([shell])
    return tuple(Slab(tuple(run)) for run in runs)


def _may_join(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one == other or all(low < 0 < high for low, high in (one, other))


def _fillers(detector: Contents, solid: Sequence[Slab], merge: bool) -> list[Slab]:
    """Return air between the parts, and the gas of the drift chamber around and between its wire layers."""
    chamber = detector.drift_chamber
    first_wire = chamber.layers[0].r_mid if chamber else math.inf
    fillers = _airs([slab for slab in solid if slab.r_in < first_wire], detector.air)
    if chamber:
        # Parts beside the chamber along the beam do not bound its gas. Without a part inside, the chamber begins at
        # its first wire layer, or with the cells of wires that count.
        low, high = zip(*(layer.ends for layer in chamber.layers), strict=True)
        beside = [slab for slab in solid if share_z(slab.ends, (min(low), max(high)))]
        inside = [slab for slab in beside if slab.r_in < first_wire]
        gas = _gas(chamber)
        half_cell = math.pi * first_wire / chamber.layers[0].cells if gas.layers[0].wires else 0.0
        start = inside[-1].r_out if inside else first_wire - half_cell
        walls = tuple((slab.r_in, slab.r_out) for slab in beside if slab.r_in > start - TOUCH)
        fillers += _chamber_gas(gas, start, walls, merge)
        fillers += _behind(detector, chamber, solid)
    return fillers


def _airs(solid: Sequence[Slab], air: Material) -> list[Slab]:
    """Return the air between parts."""
    airs, end = [], math.inf
    for slab in solid:
        if slab.r_in - end > TOUCH:
            airs.append(_air(end, slab.r_in, air))
        end = slab.r_out if end == math.inf else max(end, slab.r_out)
    return airs


def _behind(detector: Contents, chamber: DriftChamber, solid: Sequence[Slab]) -> list[Slab]:
    """Return the gas from the outermost wires to the part behind them, and air between the parts from there on."""
    last = chamber.layers[-1]
    outside = [slab for slab in solid if slab.r_in > last.r_mid - TOUCH]
    behind = next((slab for slab in outside if share_z(slab.ends, last.ends)), None)
    outer = []
    if behind and behind.r_in - last.r_mid > TOUCH:
        text = f"gas behind layer {last.number}"
        shell = Shell("gas", text, last.r_mid, behind.r_in, last.ends, last.gas or chamber.gas)
        outer.append(Slab((shell,)))
    return outer + _airs(outside, detector.air)


@lru_cache(maxsize=256)
def _air(r_in: float, r_out: float, air: Material) -> Slab:
    return Slab((Shell("air", "air", r_in, r_out, ENDLESS, air),))


class _GasLayer(NamedTuple):
    """What the gas before a wire layer depends on."""

    number: int
    r_mid: float  # mm
    ends: tuple[float, float]  # mm
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
    return _GasLayer(layer.number, layer.r_mid, layer.ends, layer.gas or chamber.gas, wires)


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
    shell = Shell("gas", "", layer.r_mid - 0.5 * width, layer.r_mid + 0.5 * width, layer.ends, gas.material)
    return [shell, *_wires(gas, shell, 1.0)]


def _lumps(gas: Sequence[Slab]) -> list[Slab]:
    """Join neighbouring lumps of gas that end at about the same z, up to a certain depth."""
    lumps: list[Slab] = []
    for slab in gas:
        last = lumps[-1] if lumps else None
        touches = last is not None and slab.r_in - last.r_out < TOUCH
        if last is not None and touches and slab.r_out - last.r_in < _LUMP and _same_end(last, slab):
            lumps[-1] = Slab((*last.shells, *slab.shells))
        else:
            lumps.append(slab)
    return lumps


def _same_end(a: Slab, b: Slab) -> bool:
    ends = [shell.ends for slab in (a, b) for shell in slab.shells]
    west, east = ([one[side] for one in ends] for side in (0, 1))
    return all(max(one) - min(one) < 0.01 * min(map(abs, one)) for one in (west, east)) or len(set(ends)) == 1


@lru_cache(maxsize=256)
def _chamber_gas(gas: _Gas, start: float, walls: tuple[tuple[float, float], ...], merge: bool) -> tuple[Slab, ...]:
    """Return one lump of gas before each wire layer, the innermost from `start`, or if merged larger lumps.

    Where the end plate steps outward from one layer to the next, the lump reaches to the farther plate.
    """
    gas_slabs = []
    before = gas.layers[0].ends
    for layer in gas.layers:
        layer_number, radius, ends = layer.number, layer.r_mid, layer.ends
        here = [wall for wall in walls if start - TOUCH < wall[0] < radius]
        for r_in, r_out in _between(start, radius, here):
            text = f"gas before layer {layer_number}"
            reach = min(before[0], ends[0]), max(before[1], ends[1])
            shell = Shell("gas", text, r_in, r_out, reach, layer.material)
            share = (r_out - r_in) / (radius - start)
            gas_slabs.append(Slab((shell, *_wires(layer, shell, share))))
        start, before = radius, ends
    return tuple(_lumps(gas_slabs) if merge else gas_slabs)


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
