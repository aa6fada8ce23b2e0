"""The field of a detector as the core sees it; the field of a solenoid is computed on a grid."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgemit import _core
from cgemit.detector.field import HarmonicField, MapField, SolenoidField
from cgemit.detector.field.grid import Axis, FieldGrid
from cgemit.detector.parts import Contents

Floats = NDArray[np.float64]

# mm, of the solenoid's grid; the spline between its points is exact to 1e-7 of the field 0.5 m from the coil
STEP = 20.0
_MARGIN_R, _MARGIN_Z = 50.0, 600.0  # mm, beyond the outermost part; steep tracks go on beyond the ends


def extent(detector: Contents) -> tuple[float, float]:
    """Return the outermost radius and |z| of a detector's parts, mm."""
    cylinders = [*detector.beam_pipe, *detector.walls]
    radii = [part.r_out for part in cylinders] + [layer.r_out for layer in detector.cgem]
    lengths = [part.half_length for part in cylinders] + [layer.half_length for layer in detector.cgem]
    for wire in detector.drift_chamber.layers if detector.drift_chamber else ():
        radii.append(wire.r_end)
        lengths.append(wire.half_length)
    return max(radii, default=0.0), max(lengths, default=0.0)


def compiled_field(detector: Contents) -> _core.Field | None:
    """Return the field that tracks step through, or None where it is uniform."""
    field = detector.field
    if isinstance(field, HarmonicField):
        reach = (field.r_max, field.z_max)
        return _core.Field(bz=field.bz, b=field.b, q=field.q, tolerance=field.tolerance, reach=reach)
    if isinstance(field, SolenoidField):
        r, z = extent(detector)
        reach = (r + _MARGIN_R, z + _MARGIN_Z)
        grid = solenoid_grid(field.coil_radius, field.half_length, field.z_offset, reach)
        return _on_grid(grid, field.bz, field.bz, field.tolerance)
    if isinstance(field, MapField):
        return _on_grid(field.grid, field.bz / field.grid.bz_at_origin(), field.bz, field.tolerance)
    return None


def _on_grid(grid: FieldGrid, scale: float, bz: float, tolerance: float) -> _core.Field:
    axes = [(axis.first, axis.step, axis.points) for axis in grid.axes]
    return _core.Field(bz=bz, axes=axes, coefficients=scale * grid.coefficients().ravel(), tolerance=tolerance)


def field_at(detector: Contents, points: ArrayLike) -> NDArray[np.float64]:
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


def solenoid_field(radius: float, half_length: float, r: ArrayLike, z: ArrayLike) -> tuple[Floats, Floats]:
    """Return the field of a thin coil around z = 0, for a field of 1 T in its middle.

    N. Derby and S. Olbert, Am. J. Phys. 78 (2010) 229, eqs. 4 and 5, with their generalized complete elliptic integral
    C written in Carlson's forms: C(k, p, c, s) = c R_F(0, k^2, 1) + (s - p c) R_J(0, k^2, 1, p)/3 (B. C. Carlson,
    Numer. Algorithms 10 (1995) 13).

    Parameters
    ----------
    radius, half_length : float
        Of the coil, mm.
    r, z : array_like, (...)
        Points, mm; not on the coil.

    Returns
    -------
    br, bz : ndarray, (...) float64, T

    """
    from scipy.special import elliprf, elliprj

    def integral(k2: Floats, p: Floats | float, c: float, s: Floats | float) -> Floats:
        return np.asarray(c * elliprf(0, k2, 1) + (s - p * c) / 3 * elliprj(0, k2, 1, p), dtype=np.float64)

    r, z = np.broadcast_arrays(np.asarray(r, np.float64), np.asarray(z, np.float64))
    sign, distance = np.where(r < 0, -1.0, 1.0), np.abs(r)
    gamma = (radius - distance) / (radius + distance)
    br, bz = np.zeros_like(z), np.zeros_like(z)
    for end, weight in ((half_length, 1.0), (-half_length, -1.0)):
        along = z + end
        far = along**2 + (radius + distance) ** 2
        k2 = (along**2 + (radius - distance) ** 2) / far
        br += weight * radius / np.sqrt(far) * integral(k2, 1.0, 1.0, -1.0)
        bz += weight * along / np.sqrt(far) * integral(k2, gamma**2, 1.0, gamma)
    middle = np.pi * half_length / np.hypot(half_length, radius)
    return sign * br / middle, radius / (radius + distance) * bz / middle


def solenoid_grid(radius: float, half_length: float, z_offset: float, reach: tuple[float, float]) -> FieldGrid:
    """Return the field on a grid, with 1 T at the origin.

    Parameters
    ----------
    radius, half_length, z_offset : float
        Of the coil, mm.
    reach : tuple of float
        Largest r and |z| that the grid must hold, mm.

    """
    n_r, n_z = (int(np.ceil(length / STEP)) for length in reach)
    r, z = STEP * np.arange(n_r + 1), STEP * np.arange(-n_z, n_z + 1)
    values = np.stack(solenoid_field(radius, half_length, r[:, None], z - z_offset), axis=-1)
    scale = solenoid_field(radius, half_length, 0.0, -z_offset)[1]
    axes = (Axis("r", 0.0, STEP, n_r + 1), Axis("z", -n_z * STEP, STEP, 2 * n_z + 1))
    return FieldGrid(axes, values / scale)
