"""Strips and wires as the core sees them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cgemit.detector.parts import CgemLayer, DriftChamber

Columns = dict[str, NDArray[np.generic]]


def cgem_table(layers: Sequence[CgemLayer]) -> Columns:
    """Return the read-out of CGEM layers as columns: mm, rad, strips; phi_first is (n, 2), the rest (n,)."""
    names = ("r_readout", "r_gap_in", "r_gap_out", "half_length", "pitch_x", "pitch_v", "stereo", "offset_v")
    columns: Columns = {name: np.array([getattr(layer, name) for layer in layers], dtype=np.float64) for name in names}
    for name in ("sheets", "strips_x", "strips_v"):
        columns[name] = np.array([getattr(layer, name) for layer in layers], dtype=np.int32)
    # A layer of one sheet fills the second place with the first: the core reads `sheets` of them.
    edges = [(*layer.sheet_phi, *layer.sheet_phi)[:2] for layer in layers]
    columns["phi_first"] = np.array(edges, dtype=np.float64).reshape(-1, 2)
    strips = [layer.sheets * (layer.strips_x + layer.strips_v) for layer in layers]
    columns["gid_first"] = np.cumsum([0, *strips])[:-1].astype(np.int32)
    return columns


def wire_table(chamber: DriftChamber | None) -> Columns:
    """Return the wire layers of a chamber as columns (n,): mm, rad."""
    layers = chamber.layers if chamber else ()
    names = ("r_end", "half_length", "twist", "phi_east", "sigma", "sigma_slope", "efficiency")
    columns: Columns = {name: np.array([getattr(layer, name) for layer in layers], dtype=np.float64) for name in names}
    for name in ("number", "cells"):
        columns[name] = np.array([getattr(layer, name) for layer in layers], dtype=np.int32)
    columns["gid_first"] = np.array(chamber.gid_first if chamber else (), dtype=np.int32)
    return columns
