"""The error of the event's start time: drift times of all cells of an event are wrong by the same number."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.background.random import START_TIME, Floats, Random
from cgemit.drift_times import shifted
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
    shift = np.repeat(start_times(wire_hits.events, sigma, seed), np.diff(wire_hits.offsets))
    time = wire_hits["drift_time"]
    return wire_hits.with_columns(drift_time=time + shift, drift=shifted(wire_hits["drift"], time, shift))


def start_times(events: npt.NDArray[np.int64], sigma: float, seed: int) -> Floats:
    """Return the start times by which drift times are wrong, (n,) float64, ns: the truth of the fitted ones.

    Parameters
    ----------
    events : ndarray, (n,) int64
        Numbers of the events.
    sigma : float
        ns, standard deviation.
    seed : int
    """
    u = np.array([Random(seed, int(event), START_TIME).uniform(2) for event in events]).reshape(-1, 2)
    normal = np.sqrt(-2 * np.log(1 - u[:, 0])) * np.cos(2 * np.pi * u[:, 1])
    return np.asarray(sigma * normal, np.float64)
