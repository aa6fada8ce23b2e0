"""Dead and hot strips and the gain of a CGEM layer's sheets: lists of the detector file, and arrays for the core."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit.detector.model import Detector
from cgemit.detector.parts import CgemLayer

Ints = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float64]


class StripLists(NamedTuple):
    """Running numbers of strips, each (n,) int32, growing."""

    dead: Ints
    hot: Ints

    @property
    def masked(self) -> Ints:
        """Strips of which clusters are not made, (n,) int32."""
        return np.union1d(self.dead, self.hot).astype(np.int32)


@lru_cache(maxsize=64)
def strip_lists(detector: Detector) -> StripLists:
    """Return the dead and the hot strips of a detector; a strip in both lists is dead, as is an X strip in a dead seam.

    Parameters
    ----------
    detector : Detector
    """
    found: dict[str, list[Ints]] = {"dead": [], "hot": []}
    first = 0
    for layer in detector.cgem:
        per_sheet = layer.strips_x + layer.strips_v
        for sheet in range(layer.sheets):
            found["dead"].append(seam_strips(layer) + first + sheet * per_sheet)
        for kind, parts in found.items():
            for view, offset in (("x", 0), ("v", layer.strips_x)):
                for sheet, low, high in getattr(layer, f"{kind}_{view}"):
                    parts.append(np.arange(low, high + 1, dtype=np.int32) + first + sheet * per_sheet + offset)
        first += layer.sheets * per_sheet
    dead, hot = (np.unique(np.concatenate([*parts, np.empty(0, np.int32)])) for parts in found.values())
    return StripLists(dead.astype(np.int32), np.setdiff1d(hot, dead).astype(np.int32))


def seam_strips(layer: CgemLayer) -> Ints:
    """Return the X strips of a sheet whose middle is in the dead part of a seam, (n,) int32."""
    middle = (np.arange(layer.strips_x) + 0.5) * layer.pitch_x
    beside = np.minimum(middle, layer.strips_x * layer.pitch_x - middle)
    return np.flatnonzero(beside < 0.5 * layer.dead_seam).astype(np.int32)


def in_dead_area(layer: CgemLayer, x: Floats, z: Floats) -> npt.NDArray[np.bool_]:
    """Return whether points of a sheet are in the dead part of a seam or of an end, (n,) bool.

    Parameters
    ----------
    layer : CgemLayer
    x : ndarray, (n,) float64, mm
        From the edge of the sheet.
    z : ndarray, (n,) float64, mm
    """
    beside = np.minimum(x, layer.strips_x * layer.pitch_x - x)
    # Nothing is dead by default, not even at the edge: strips end there by themselves.
    at_seam = (beside < 0.5 * layer.dead_seam) & (layer.dead_seam > 0)
    return np.asarray(at_seam | ((np.abs(z) > layer.half_length - layer.dead_ends) & (layer.dead_ends > 0)))


@lru_cache(maxsize=64)
def gain_table(detector: Detector) -> dict[str, npt.NDArray[Any]]:
    """Return the gain maps of all layers as the core takes them; an empty dict if no layer has one.

    Parameters
    ----------
    detector : Detector

    Returns
    -------
    dict of str to ndarray
        shape (2 layers,) int32, rows and columns of each layer's grids, 0 for a layer without; values (n,) float64,
        sheet by sheet, row by row.
    """
    if not any(layer.gain_map for layer in detector.cgem):
        return {}
    grids = [grid_of(layer) for layer in detector.cgem]
    return {
        "shape": np.array([n for grid in grids for n in grid.shape[1:]], dtype=np.int32),
        "values": np.concatenate([grid.ravel() for grid in grids]),
    }


def grid_of(layer: CgemLayer) -> Floats:
    """Return the relative gain of a layer, (sheets, rows along z, columns along X) float64.

    Without a map there are no rows and columns. Grids of different shapes are repeated to the least common one.

    Parameters
    ----------
    layer : CgemLayer
    """
    if not layer.gain_map:
        return np.ones((layer.sheets, 0, 0))
    grids = [np.array(sheet, np.float64) for sheet in layer.gain_map]
    rows, columns = (int(np.lcm.reduce([grid.shape[axis] for grid in grids])) for axis in (0, 1))
    return np.array([np.kron(grid, np.ones((rows // grid.shape[0], columns // grid.shape[1]))) for grid in grids])


@lru_cache(maxsize=64)
def strip_gains(detector: Detector) -> Floats:
    """Return the mean relative gain along each strip by its running number, (strips,) float64; (0,) without maps.

    V strips have the mean of their sheet: they cross many cells.

    Parameters
    ----------
    detector : Detector
    """
    if not any(layer.gain_map for layer in detector.cgem):
        return np.empty(0)
    parts = []
    for layer in detector.cgem:
        grid = grid_of(layer)
        for sheet in range(layer.sheets):
            if not grid.size:
                parts.append(np.ones(layer.strips_x + layer.strips_v))
                continue
            columns = grid[sheet].mean(axis=0)
            at = (np.arange(layer.strips_x) + 0.5) / layer.strips_x * len(columns)
            parts += [columns[at.astype(np.int64)], np.full(layer.strips_v, grid[sheet].mean())]
    return np.concatenate(parts)
