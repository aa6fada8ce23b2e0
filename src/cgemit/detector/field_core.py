"""The field of a detector as the core sees it."""

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgemit import _core
from cgemit.detector.field import HarmonicField, MapField, SolenoidField
from cgemit.detector.solenoid import solenoid_grid

if TYPE_CHECKING:
    from cgemit.detector.field_grid import FieldGrid
    from cgemit.detector.model import Detector

_MARGIN_R, _MARGIN_Z = 50.0, 600.0  # mm, beyond the outermost part; steep tracks go on beyond the ends


def extent(detector: "Detector") -> tuple[float, float]:
    """Return the outermost radius and |z| of a detector's parts, mm."""
    cylinders = [*detector.beam_pipe, *detector.walls]
    radii = [part.r_out for part in cylinders] + [layer.r_out for layer in detector.cgem]
    lengths = [part.half_length for part in cylinders] + [layer.half_length for layer in detector.cgem]
    for wire in detector.drift_chamber.layers if detector.drift_chamber else ():
        radii.append(wire.r_end)
        lengths.append(wire.half_length)
    return max(radii, default=0.0), max(lengths, default=0.0)


def compiled_field(detector: "Detector") -> _core.Field | None:
    """Return the field that tracks step through, or None where it is uniform."""
    field = detector.field
    if isinstance(field, HarmonicField):
        return _core.Field(bz=field.bz, b=field.b, q=field.q, tolerance=field.tolerance)
    if isinstance(field, SolenoidField):
        r, z = extent(detector)
        reach = (r + _MARGIN_R, z + _MARGIN_Z)
        grid = solenoid_grid(field.coil_radius, field.half_length, field.z_offset, reach)
        return _on_grid(grid, field.bz, field.bz, field.tolerance)
    if isinstance(field, MapField):
        return _on_grid(field.grid, field.bz / field.grid.bz_at_origin(), field.bz, field.tolerance)
    return None


def _on_grid(grid: "FieldGrid", scale: float, bz: float, tolerance: float) -> _core.Field:
    axes = [(axis.first, axis.step, axis.points) for axis in grid.axes]
    return _core.Field(bz=bz, axes=axes, coefficients=scale * grid.coefficients().ravel(), tolerance=tolerance)


def field_at(detector: "Detector", points: ArrayLike) -> NDArray[np.float64]:
    """Return the magnetic field of a detector at points.

    Parameters
    ----------
    detector : Detector
    points : array_like, (n, 3) float64
        x, y, z in mm.

    Returns
    -------
    ndarray, (n, 3) float64, T
        Bx, By, Bz; NaN beyond the range of a map.

    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    field = compiled_field(detector)
    if field is None:
        return np.tile([0.0, 0.0, detector.field.bz], (len(points), 1))
    values, _, inside = field.values(points)
    return np.where(inside[:, None] == 1, values, math.nan)
