"""Decays by phase space, after G. Raubold and G. R. Lynch (F. James, CERN 68-15, 1968)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def breakup_momentum(mass: npt.ArrayLike, first: npt.ArrayLike, second: npt.ArrayLike) -> Floats:
    """Momentum of the products of a two-body decay in the rest frame.

    p* = sqrt((M^2 - (m1 + m2)^2)(M^2 - (m1 - m2)^2)) / 2M.

    Parameters
    ----------
    mass, first, second : array_like, float64, GeV/c2

    Returns
    -------
    ndarray, GeV/c
        0 where the decay is not possible.
    """
    m, a, b = (np.asarray(one, np.float64) for one in (mass, first, second))
    both = (m - a - b) * (m + a + b) * (m - a + b) * (m + a - b)
    return np.asarray(np.sqrt(np.maximum(np.where(m >= a + b, both, 0.0), 0.0)) / (2 * m))


@lru_cache(maxsize=1000)
def largest_weight(mass: float, masses: tuple[float, ...]) -> float:
    """Largest weight of `phase_space`, found by changing one group mass after the other.

    The logarithm of the weight is concave in each group mass, so that there is one maximum.

    Parameters
    ----------
    mass : float, GeV/c2
    masses : tuple of float, GeV/c2
        Of the products, two or more; their sum is below `mass`.
    """
    m = np.array(masses)
    group, free = np.cumsum(m), mass - m.sum()
    least = group.copy()
    group += free * np.arange(len(m)) / (len(m) - 1)
    before, weight = 0.0, _weight(group, m)
    while weight > before * (1 + 1e-9):
        before = weight
        for i in range(1, len(m) - 1):
            low, high = group[i - 1] + m[i], group[i + 1] - m[i + 1]
            tried = np.repeat(group[:, None], _GRID, axis=1)
            for _ in range(4):  # each time the range becomes a tenth
                tried[i] = np.linspace(max(low, least[i]), high, _GRID)
                best = int(np.argmax(_weight(tried, m)))
                low, high = tried[i, max(best - 1, 0)], tried[i, min(best + 1, _GRID - 1)]
            group[i] = tried[i, best]
        weight = _weight(group, m)
    return float(weight) * (1 + 1e-6)


_GRID = 21


def _weight(group: Floats, masses: Floats) -> Any:
    """Return the product of the momenta of two-body decays with some group masses, (n,) or (n, tries)."""
    weight: Any = 1.0
    for i in range(1, len(masses)):
        weight = weight * breakup_momentum(group[i], group[i - 1], masses[i])
    return weight


def phase_space(mass: npt.ArrayLike, masses: npt.ArrayLike, uniforms: Floats) -> tuple[Floats, Floats]:
    """Momenta of the products in the rest frame of the parent, with a weight that makes them phase space.

    The masses of the groups of the first 2, 3 ... n - 1 products are drawn uniformly in the order of their size, and
    each group decays isotropically. The weight is the product of the n - 1 momenta of these two-body decays.

    Parameters
    ----------
    mass : array_like, (rows,) or () float64, GeV/c2
        Of the parent, at least the sum of the products' masses.
    masses : array_like, (rows, n) or (n,) float64, GeV/c2
        Of n >= 2 products.
    uniforms : ndarray, (rows, 3 n - 4) float64
        In (0, 1): n - 2 masses, then cosine and azimuth of each two-body decay. The last pair is the direction of
        the last product, in the rest frame of the parent.

    Returns
    -------
    momenta : ndarray, (rows, n, 4) float64, GeV/c
        px, py, pz, E of each product.
    weight : ndarray, (rows,) float64, (GeV/c)^(n - 1)
    """
    rows = len(uniforms)
    m = np.broadcast_to(np.asarray(masses, np.float64), (rows, np.shape(masses)[-1]))
    n = m.shape[1]
    free = np.broadcast_to(np.asarray(mass, np.float64), rows) - m.sum(axis=1)
    shares = np.sort(uniforms[:, : n - 2], axis=1)
    group = np.cumsum(m, axis=1)  # smallest mass of the first 1, 2 ... n products
    group[:, 1:-1] += shares * free[:, None]
    group[:, -1] += free
    momenta, weight = np.zeros((rows, n, 4)), np.ones(rows)
    momenta[:, 0, 3] = m[:, 0]
    for i in range(1, n):
        p = breakup_momentum(group[:, i], group[:, i - 1], m[:, i])
        weight = weight * p
        cos, turn = uniforms[:, n - 2 + 2 * (i - 1) : n + 2 * (i - 1)].T
        flight = p[:, None] * directions(2 * cos - 1, 2 * np.pi * turn)
        recoil = np.concatenate([-flight, np.hypot(group[:, i - 1], p)[:, None]], axis=1)
        momenta[:, :i] = boost(momenta[:, :i], recoil[:, None, :])
        momenta[:, i] = np.concatenate([flight, np.hypot(m[:, i], p)[:, None]], axis=1)
    return momenta, weight


def directions(cos_theta: Floats, phi: Floats) -> Floats:
    """Return unit vectors, (n, 3), from the cosine of the polar angle and the azimuth (rad), (n,) each."""
    sin = np.sqrt(np.maximum((1 - cos_theta) * (1 + cos_theta), 0.0))
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), cos_theta], axis=-1)


def boost(momenta: Floats, parent: Floats) -> Floats:
    """Return four-momenta of the parent's rest frame in the frame where the parent has a four-momentum.

    Parameters
    ----------
    momenta, parent : ndarray, (..., 4) float64, GeV/c
        px, py, pz, E; shapes that broadcast.
    """
    p, energy = parent[..., :3], parent[..., 3]
    mass = np.sqrt(np.maximum(energy**2 - np.sum(p * p, axis=-1), 1e-300))
    along = np.sum(p * momenta[..., :3], axis=-1)
    factor = (along / (energy + mass) + momenta[..., 3]) / mass
    moved = momenta[..., :3] + factor[..., None] * p
    return np.concatenate([moved, ((energy * momenta[..., 3] + along) / mass)[..., None]], axis=-1)
