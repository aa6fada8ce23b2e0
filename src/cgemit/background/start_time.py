"""The error of the event's start time: drift times of all cells of an event are wrong by the same number."""

from __future__ import annotations

import numpy as np

from cgemit.background.random import START_TIME, Floats, Random
from cgemit.digitize import XT_DISTANCE, XT_TIME
from cgemit.tables import Table


def with_start_time(wire_hits: Table, sigma: float, seed: int) -> Table:
    """Return wire hits whose drift times are shifted by a Gaussian number for each event.

    Drift distances follow from the times; their standard deviations stay, since a fit does not know of the shift.

    Parameters
    ----------
    wire_hits : Table
    sigma : float
        ns, standard deviation.
    seed : int
    """
    u = np.array([Random(seed, int(event), START_TIME).uniform(2) for event in wire_hits.events]).reshape(-1, 2)
    normal = np.sqrt(-2 * np.log(1 - u[:, 0])) * np.cos(2 * np.pi * u[:, 1])
    shift = np.repeat(sigma * normal, np.diff(wire_hits.offsets))
    time = wire_hits["drift_time"]
    drift = wire_hits["drift"] + _distance(time + shift) - _distance(time)
    return wire_hits.with_columns(drift_time=time + shift, drift=drift)


def _distance(time: Floats) -> Floats:
    """Return the drift distance of a time, mm; beyond both ends of the table along its last slope."""
    early, late = ((XT_DISTANCE[i + 1] - XT_DISTANCE[i]) / (XT_TIME[i + 1] - XT_TIME[i]) for i in (0, -2))
    inside = np.interp(time, XT_TIME, XT_DISTANCE)
    return np.asarray(
        inside + early * np.minimum(time - XT_TIME[0], 0) + late * np.maximum(time - XT_TIME[-1], 0), np.float64
    )
