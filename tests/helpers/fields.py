"""Magnetic fields for tests, by formulas of their own."""

from __future__ import annotations

import numpy as np

from cgemit import _core
from cgemit.detector import write_field_map
from cgemit.detector.field import Axis, FieldGrid

#: The preset besiii-harmonic without its limits in r and z: an uneven field that steep tracks do not leave.
HARMONIC = {"kind": "harmonic", "bz": "-0.980 T", "b": "0.175 /m2", "q": "-0.251 /m4"}


def harmonic_by_hand(x, y, z, bz=-0.98, b=0.175e-6, q=-0.251e-12):
    """Return the gradient of the scalar potential whose Bz is quoted, term by term; b, q and lengths in mm."""
    r2 = x * x + y * y
    radial = bz * (b * z + q * (1.5 * z * r2 - 2 * z**3))
    along = bz * (1 - b * (z * z - r2 / 2) + q * (z**4 - 3 * z * z * r2 + 3 * r2 * r2 / 8))
    return np.stack([x * radial, y * radial, along], axis=-1)


def box_grid(values, half=600.0, step=50.0, half_z=1000.0) -> FieldGrid:
    """Return a grid of a field given as a function."""
    axes = tuple(
        Axis(name, -length, step, round(2 * length / step) + 1)
        for name, length in (("x", half), ("y", half), ("z", half_z))
    )
    points = np.meshgrid(*(a.first + a.step * np.arange(a.points) for a in axes), indexing="ij")
    return FieldGrid(axes, values(*points))


def on_core(grid: FieldGrid, tolerance=1e-3) -> _core.detector.Field:
    axes = [(axis.first, axis.step, axis.points + (axis.name == "phi")) for axis in grid.axes]
    how = {"coefficients": grid.coefficients().ravel(), "polar": grid.is_polar, "tolerance": tolerance}
    return _core.detector.Field(bz=grid.bz_at_origin(), axes=axes, **how)


def small_map(folder):
    """Write the harmonic field within r = 500 mm to a file."""
    r, z = np.linspace(0, 500, 26), np.linspace(-1300, 1300, 66)
    values = harmonic_by_hand(r[:, None], 0.0, z[None, :])
    return write_field_map(folder / "small.npz", {"r": r, "z": z, "br": values[..., 0], "bz": values[..., 2]})
