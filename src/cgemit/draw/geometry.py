"""Points of a helix and of wires for pictures, and angles near a reference."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cgemit.helix import RADIUS_PER_KAPPA

if TYPE_CHECKING:
    from cgemit.detector import Detector, WireLayer

Array = npt.NDArray[np.float64]


def helix_points(helix: Array, bz: float, r_max: float, z_max: float, n: int = 400) -> tuple[Array, Array, Array]:
    """Return points of a track from its closest approach to the beam line until it leaves a cylinder or turns back.

    Parameters
    ----------
    helix : (5,) float64
        dr mm, phi0 rad, kappa 1/(GeV/c), dz mm, tanl; pivot at the origin.
    bz : float
        Field, T.
    r_max, z_max : float
        Radius and half length of the cylinder, mm.
    n : int
        Number of points.

    Returns
    -------
    x, y, z : (m,) float64, mm
        m <= n.
    """
    dr, phi0, kappa, dz, tanl = helix
    radius = RADIUS_PER_KAPPA / (bz * kappa)
    # Half a turn, or the whole way out of the cylinder for an almost straight track.
    length = np.linspace(0.0, min(np.pi * abs(radius), 1.5 * (r_max + abs(dr))), n)
    turn = -length / radius
    x = dr * np.cos(phi0) + radius * (np.cos(phi0) - np.cos(phi0 + turn))
    y = dr * np.sin(phi0) + radius * (np.sin(phi0) - np.sin(phi0 + turn))
    z = dz + length * tanl
    inside = (np.hypot(x, y) <= r_max) & (np.abs(z) <= z_max)
    last = n if inside.all() else int(np.argmin(inside))
    return x[:last], y[:last], z[:last]


def near(phi: npt.ArrayLike, reference: float) -> Array:
    """Return angles shifted by whole turns to lie within pi of a reference, rad."""
    difference = np.asarray(phi, dtype=np.float64) - reference
    return reference + (difference + np.pi) % (2 * np.pi) - np.pi


def wire_layers(detector: Detector) -> tuple[WireLayer, ...]:
    """Return the wire layers of a detector; none without a drift chamber."""
    return detector.drift_chamber.layers if detector.drift_chamber else ()


def wire_positions(layer: WireLayer, wires: npt.NDArray[np.integer[Any]], z: Array | float) -> tuple[Array, Array]:
    """Return x and y, (n,) float64 mm, of wires, (n,) int, at z, (n,) float64 mm."""
    east = layer.phi_east + wires * 2 * np.pi / layer.cells
    west = east - layer.twist
    share = 0.5 * (1 + np.clip(z / layer.half_length, -1, 1))
    x = layer.r_end * (share * np.cos(east) + (1 - share) * np.cos(west))
    y = layer.r_end * (share * np.sin(east) + (1 - share) * np.sin(west))
    return x, y


def wire_profile(layer: WireLayer) -> tuple[Array, Array]:
    """Return z and r, (41,) float64 mm, along the wires of a layer: a hyperbola for straight stereo wires."""
    z = np.linspace(-layer.half_length, layer.half_length, 41)
    sag = layer.r_end**2 - layer.r_mid**2
    return z, np.sqrt(layer.r_mid**2 + sag * (z / layer.half_length) ** 2)


def smooth_curve(points: Array, directions: Array, steps: int = 12) -> Array:
    """Return a curve through points with given directions: a cubic between neighbours, as long as the arc would be.

    Parameters
    ----------
    points, directions : (n, 3) float64
        In their order along the curve; directions of any length.
    steps : int
        Points for each interval.

    Returns
    -------
    (m, 3) float64
    """
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    here, there = points[:-1], points[1:]
    chord = np.linalg.norm(there - here, axis=1)
    half = 0.5 * np.arccos(np.clip(np.sum(unit[:-1] * unit[1:], axis=1), -1, 1))
    length = (chord / np.sinc(half / np.pi))[:, None, None]  # of the arc of a circle with this chord and turn
    t = np.linspace(0, 1, steps, endpoint=False)[None, :, None]
    start, end = unit[:-1, None], unit[1:, None]
    cubic = (
        (1 + 2 * t) * (1 - t) ** 2 * here[:, None] + t**2 * (3 - 2 * t) * there[:, None]
        + length * (t * (1 - t) ** 2 * start - t**2 * (1 - t) * end)
    )  # fmt: skip
    return np.concatenate([cubic.reshape(-1, 3), points[-1:]])
