"""The holes of foils: their lattice in each sub-layer, and their table for the core."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit.detector.parts import CgemLayer
from cgemit.detector.shell import Shell

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
