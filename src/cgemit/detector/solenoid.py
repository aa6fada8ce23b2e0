"""Field of a finite solenoid: a thin current sheet, by complete elliptic integrals."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgemit.detector.field_grid import Axis, FieldGrid

Floats = NDArray[np.float64]

STEP = 20.0  # mm, of the grid; the spline between its points is exact to 1e-7 of the field 0.5 m from the coil


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
