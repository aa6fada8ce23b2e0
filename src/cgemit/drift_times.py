"""Drift distance against drift time of the cells, and what another start time of the event changes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

#: Drift distance (mm) against drift time (ns) of the outer drift chamber's cells: medians of reconstructed hits of
#: BESIII (BOSS 7.2.0 files published with pybes3), with the wire itself put at time 0. Straight lines between the
#: points; the outermost ones are continued.
XT_DISTANCE = np.array([0.0, 0.5, 1.2, 2.0, 2.8, 3.45, 4.7, 5.75, 6.9, 7.9, 8.3])
XT_TIME = np.array([0.0, 10.0, 25.0, 50.0, 75.0, 100.0, 150.0, 200.0, 250.0, 300.0, 350.0])
_VELOCITY = np.diff(XT_DISTANCE) / np.diff(XT_TIME)


def distance_at(time: npt.ArrayLike) -> Floats:
    """Return the drift distance of a time, mm; beyond both ends of the table along its last slope.

    Parameters
    ----------
    time : array_like, (n,) float64, ns
    """
    time = np.asarray(time, np.float64)
    outside = _VELOCITY[0] * np.minimum(time - XT_TIME[0], 0) + _VELOCITY[-1] * np.maximum(time - XT_TIME[-1], 0)
    return np.asarray(np.interp(time, XT_TIME, XT_DISTANCE) + outside, np.float64)


def velocity_at(distance: npt.ArrayLike) -> Floats:
    """Return the drift velocity at a distance from the wire, mm/ns, (n,) float64.

    Parameters
    ----------
    distance : array_like, (n,) float64, mm
    """
    return np.asarray(_VELOCITY[np.searchsorted(XT_DISTANCE[1:-1], distance, side="right")])


def shifted(drift: Floats, time: Floats, shift: npt.ArrayLike) -> Floats:
    """Return measured drift distances after a shift of their drift times, (n,) float64, mm.

    The deviation of a distance from that of its time, the resolution of the cell, stays.

    Parameters
    ----------
    drift : ndarray, (n,) float64, mm
    time : ndarray, (n,) float64, ns
    shift : float or ndarray, (n,) float64, ns
        Added to the times.
    """
    # This order keeps the last digit of runs with a start time given.
    return np.asarray(drift + distance_at(time + np.asarray(shift)) - distance_at(time))
