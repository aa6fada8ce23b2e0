"""Tracks whose hits may depend on how they scatter, because they pass near the ends of the read-out layers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector
from cgemit.detector.kept import once
from cgemit.detector.parts import DriftChamber
from cgemit.helix import RADIUS_PER_KAPPA

Floats = npt.NDArray[np.float64]

#: Of the half length: scatters move tracks by less than a fifth of it.
_NEAR = 0.8


@once
def _wire_layers(chamber: DriftChamber) -> list[tuple[float, float]]:
    return [(layer.r_mid, layer.half_length) for layer in chamber.layers]


def near_ends(detector: Detector, kappa: Floats, tanl: Floats) -> npt.NDArray[np.bool_]:
    """Return whether tracks from the origin come near the end of a layer, or pass beyond it.

    Parameters
    ----------
    detector : Detector
    kappa, tanl : ndarray, (tracks,) float64, (GeV/c)^-1 and 1
    """
    layers = [(layer.r_mid, layer.half_length) for layer in detector.cgem]
    layers += _wire_layers(detector.drift_chamber) if detector.drift_chamber is not None else []
    found = np.zeros(len(kappa), bool)
    if not layers:
        return found
    radius, half_length = np.array(layers).T
    steep = np.abs(tanl)
    # The arc to a cylinder is at most half a turn about its radius.
    maybe = np.flatnonzero(0.5 * np.pi * steep > _NEAR * np.min(half_length / radius))
    if not len(maybe):
        return found
    with np.errstate(divide="ignore"):
        diameter = 2 * RADIUS_PER_KAPPA / np.abs(detector.field.bz * kappa[maybe, None])
        ratio = np.minimum(radius / diameter, 1.0)
    arc = radius * np.where(ratio > 0, np.arcsin(ratio) / np.where(ratio > 0, ratio, 1.0), 1.0)
    found[maybe] = np.any(steep[maybe, None] * arc > _NEAR * half_length, axis=1)
    return found
