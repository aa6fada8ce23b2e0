"""Make the map of the field of BESIII that the preset `besiii` reads (docs/methods/field.md).

A coil between iron plates, and one anti-solenoid in each of the two packages of final quadrupoles; the three parameters
were fitted to tracks of public Monte Carlo files of the experiment. Lengths in mm, fields in T.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.special import i0, i1, k0, k1

from cgemit.detector import write_field_map
from cgemit.detector.core import solenoid_field

Floats = npt.NDArray[np.float64]

# Fitted: main field at the origin, effective plane of the end iron, current sheet of the anti-solenoids (mu0 K).
MAIN, IRON_Z, SHEET = 1.0026, 1806.0, 3.2  # T, mm, T
# Coil (radius, half length) and the inner side of the barrel iron: NIM A 614 (2010) 345 and the experiment's geometry.
COIL_RADIUS, COIL_HALF_LENGTH, IRON_RADIUS = 1482.0, 1760.0, 1740.0
HARMONICS = 60
# The winding of an anti-solenoid, smeared so that splines follow it: radii and half lengths with their weights.
ANTI_Z = 850.0
ANTI_RADII = np.arange(65.0, 136.0, 10.0)
ANTI_HALF_LENGTHS = np.array([160.0, 180.0, 200.0, 220.0, 240.0])
ANTI_LENGTH_WEIGHTS = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9
BESIDE = 1.0  # mm, distance to the winding below which both sides are averaged
STEP, R_LAST, Z_LAST = 12.5, 850.0, 1300.0


def main_field(r: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return the field of the coil in its iron, all of infinite permeability: an endless row of image coils.

    Parameters
    ----------
    r, z : ndarray, (...) float64, mm

    Returns
    -------
    br, bz : ndarray, (...) float64, T
        1 T at the origin times `MAIN`, along +z.
    """
    br, bz, norm = np.zeros(np.broadcast(r, z).shape), np.ones(np.broadcast(r, z).shape), 1.0
    for n in range(1, HARMONICS + 1):
        k = n * np.pi / IRON_Z
        ka, kr = k * COIL_RADIUS, k * IRON_RADIUS
        c = 2 * IRON_Z * np.sin(k * COIL_HALF_LENGTH) / (n * np.pi * COIL_HALF_LENGTH)
        c *= ka * (k1(ka) + i1(ka) * k0(kr) / i0(kr))
        br = br + c * i1(k * r) * np.sin(k * z)
        bz = bz + c * i0(k * r) * np.cos(k * z)
        norm += c
    return MAIN * br / norm, MAIN * bz / norm


def anti_solenoids(r: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return the field of the two smeared anti-solenoids, which point along -z."""
    weights = np.cos(np.pi * (ANTI_RADII - 100.0) / 90.0) ** 2
    br = bz = np.zeros(np.broadcast(r, z).shape)
    for radius, share in zip(ANTI_RADII, weights / weights.sum(), strict=True):
        for half_length, part in zip(ANTI_HALF_LENGTHS, ANTI_LENGTH_WEIGHTS, strict=True):
            middle = SHEET * half_length / np.hypot(half_length, radius)  # of one coil, T
            for centre in (-ANTI_Z, ANTI_Z):
                one_r, one_z = beside_winding(radius, half_length, r, z - centre)
                br, bz = br - share * part * middle * one_r, bz - share * part * middle * one_z
    return br, bz


def beside_winding(radius: float, half_length: float, r: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return the field of a thin coil; on the coil's radius, where it may jump, the mean of both sides."""
    sides = [np.where(np.abs(r - radius) < BESIDE, radius + side, r) for side in (-BESIDE, BESIDE)]
    (inner_r, inner_z), (outer_r, outer_z) = (solenoid_field(radius, half_length, side, z) for side in sides)
    return 0.5 * (inner_r + outer_r), 0.5 * (inner_z + outer_z)


def besiii_field(r: npt.ArrayLike, z: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Return the field of BESIII in the tracker, along -z as the experiment's software codes it.

    Parameters
    ----------
    r, z : array_like, (...)
        Points, mm; |z| below the end iron, r below the coil.

    Returns
    -------
    br, bz : ndarray, (...) float64, T
    """
    r, z = np.broadcast_arrays(np.asarray(r, np.float64), np.asarray(z, np.float64))
    parts = main_field(r, z), anti_solenoids(r, z)
    return -(parts[0][0] + parts[1][0]), -(parts[0][1] + parts[1][1])


def main() -> None:
    """Write the map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path, help="map file to write, such as src/cgemit/detector/fields/besiii.npz")
    parser.add_argument("--overwrite", action="store_true", help="replace the file")
    arguments = parser.parse_args()
    r, z = np.arange(0.0, R_LAST + 1, STEP), np.arange(-Z_LAST, Z_LAST + 1, STEP)
    br, bz = (np.round(values, 10) for values in besiii_field(r[:, None], z[None, :]))
    write_field_map(arguments.path, {"r": r, "z": z, "br": br, "bz": bz}, overwrite=arguments.overwrite)


if __name__ == "__main__":
    main()
