"""Local coordinates on the unrolled read-out of a CGEM layer (docs/conventions.md)."""

import numpy as np
import numpy.typing as npt

from cgemit.detector.parts import CgemLayer

Floats = npt.NDArray[np.float64]


def local_v(layer: CgemLayer, x: Floats | float, z: Floats | float) -> Floats:
    """Return V, (n,) float64 mm, of points with X and z, (n,) float64 mm."""
    return np.asarray(x * np.cos(layer.stereo) + (layer.z_ref - z) * np.sin(layer.stereo))


def strips_of_v(layer: CgemLayer, v: Floats | float) -> Floats:
    """Return V, (n,) float64 mm, counted in V strips: i is the edge where strip i begins."""
    return np.asarray(np.divide(v, layer.pitch_v) - layer.offset_v)


def v_of_strips(layer: CgemLayer, strips: Floats | float) -> Floats:
    """Return V, (n,) float64 mm, of positions counted in V strips: i is the edge where strip i begins."""
    return np.asarray(np.add(strips, layer.offset_v) * layer.pitch_v)


def crossing_z(layer: CgemLayer, x: Floats | float, v: Floats | float) -> Floats:
    """Return z, (n,) float64 mm, at which lines of constant V meet those of constant X, (n,) float64 mm."""
    return np.asarray(layer.z_ref - (v - x * np.cos(layer.stereo)) / np.sin(layer.stereo))
