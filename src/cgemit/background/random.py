"""Random numbers of the background: functions of seed, event and purpose."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

#: Purposes; part of every stream, so new ones go to the end.
CELLS, STRIPS, HOT_CELLS, HOT_STRIPS, MIXED, START_TIME, LISTED_STRIPS = 1, 2, 3, 4, 5, 6, 7
READ_CELLS, READ_STRIPS = 8, 9
#: Purposes of the choice of channels, which is the same in every event and run.
WIRE_CHANNELS, STRIP_CHANNELS = 1, 2
_CHANNELS = 0x6368616E6E656C73  # key of the channels, instead of a seed


class Random:
    """Random numbers of one event and purpose."""

    def __init__(self, seed: int, event: int, purpose: int) -> None:
        self._words = np.random.Philox(key=[seed % 2**64, event], counter=[0, 0, 0, purpose])

    def uniform(self, n: int) -> Floats:
        """Return the next n numbers from 0 to 1, excluded."""
        return np.asarray((self._words.random_raw(n) >> np.uint64(11)) * 2.0**-53)


def poisson(mean: float, uniform: float) -> int:
    """Return a Poisson number by inversion, at most 1000."""
    term = total = float(np.exp(-mean))
    n = 0
    while uniform > total and n < 1000:
        n += 1
        term *= mean / n
        total += term
    return n


def channels(purpose: int, n: int) -> Floats:
    """Return a number for each of n channels that decides whether it is hot or dead, (n,) float64 in [0, 1)."""
    return Random(_CHANNELS, 0, purpose).uniform(n)
