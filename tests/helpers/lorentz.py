"""Lorentz shift of a layer as a whole."""

from __future__ import annotations

import math

from cgemit.detector.gas import layer_drift
from cgemit.detector.layers.cgem import CgemLayer


def mean_shift(layer: CgemLayer, bz: float) -> float:
    """Return the Lorentz shift of electrons from mid-gap to the anode, mm of X; `bz` in T, signed."""
    drift = layer_drift(layer, bz)
    return layer.r_readout * (drift.tan_lorentz * math.log(layer.r_gap_out / layer.r_mid) + drift.shift)
