"""Calculations that share nothing with the library: the equation of motion, integrated step by step."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

LIGHT = 0.299792458e-3  # GeV/c per (T mm): p = LIGHT B R for unit charge


def integrate(position, momentum, charge, bz, length, n=2, events=None):
    """Integrate dp/dt = q v x B, B = (0, 0, bz), along the path.

    Returns
    -------
    solution of solve_ivp over the path length in mm; state (x, y, z, px, py, pz), `n` equidistant points.
    """
    total = np.linalg.norm(momentum)

    def motion(_, state):
        flight = state[3:] / total
        force = LIGHT * charge * bz * np.array([flight[1], -flight[0], 0.0])
        return np.concatenate([flight, force])

    start = np.concatenate([position, momentum])
    times = np.linspace(0, length, n)
    # The tolerance is a fraction of the largest coordinate and of the momentum.
    absolute = [1e-10] * 3 + [1e-13 * total] * 3
    return solve_ivp(motion, (0, length), start, "DOP853", times, rtol=1e-12, atol=absolute, events=events)


def helix_point(position, momentum, charge, bz):
    """Return the row (x y z ux uy tanl w) that the compiled module calls a helix point."""
    pt = np.hypot(momentum[0], momentum[1])
    turning = -LIGHT * charge * bz / pt  # a positive charge in a positive field turns clockwise
    return np.array([*position, momentum[0] / pt, momentum[1] / pt, momentum[2] / pt, turning])
