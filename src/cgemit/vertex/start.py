"""Where the vertex fit of two helices begins: at the crossing of their circles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit import helix

Floats = npt.NDArray[np.float64]


def starting_points(parameters: Floats, bz: float) -> Floats:
    """Return the point across the beam where two circles cross or come closest, at the mean z of the helices there.

    Of two crossings the one is taken at which the helices are closer in z.

    Parameters
    ----------
    parameters : ndarray, (n, 2, 5) float64
        Helices about the origin.
    bz : float
        T; without a field, circles are straight lines but for 1e-6 of the bending in 1 T.

    Returns
    -------
    ndarray, (n, 3) float64, mm
    """
    dr, phi0, kappa = (parameters[..., i] for i in range(3))
    radius = helix.RADIUS_PER_KAPPA / ((bz or 1e-6) * kappa)
    centre = (dr + radius)[..., None] * np.stack([np.cos(phi0), np.sin(phi0)], axis=-1)
    apart = centre[:, 1] - centre[:, 0]
    distance = np.maximum(np.hypot(*apart.T), 1e-9)
    along = apart / distance[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    first, second = np.abs(radius.T)
    # From the first centre along the line of centres to the chord. Differences of large numbers are factorised.
    foot = 0.5 * (distance + (first - second) * (first + second) / distance)
    half2 = (first - foot) * (first + foot)
    beside = np.sqrt(np.maximum(half2, 0.0))
    # Circles that do not cross are closest on the line of centres, half way between them.
    outside = distance > first + second
    gap = np.where(outside, 0.5 * (distance + first - second), np.sign(first - second) * 0.5 * (first + second))
    gap = np.where(outside, gap, gap + np.where(first > second, 0.5 * distance, -0.5 * distance))
    foot = np.where(half2 >= 0, foot, gap)
    middle = centre[:, 0] + foot[:, None] * along
    options = np.stack([middle + beside[:, None] * across, middle - beside[:, None] * across], axis=1)
    z = np.stack([_heights(parameters, options[:, k], bz) for k in range(2)], axis=1)
    best = np.argmin(np.abs(z[..., 0] - z[..., 1]), axis=1)
    rows = np.arange(len(best))
    return np.concatenate([options[rows, best], z[rows, best].mean(axis=-1)[:, None]], axis=1)


def _heights(parameters: Floats, points: Floats, bz: float) -> Floats:
    """Return z of both helices of each pair where they are closest to a point across the beam, (n, 2) mm."""
    flat = parameters.reshape(-1, 5)
    pivots = np.concatenate([np.repeat(points, 2, axis=0), np.zeros((len(flat), 1))], axis=1)
    moved, _ = helix.change_pivot(flat, np.zeros((len(flat), 5, 5)), np.zeros(3), pivots, bz)
    return np.asarray(np.where(np.isfinite(moved[:, 3]), moved[:, 3], 0.0).reshape(-1, 2))
