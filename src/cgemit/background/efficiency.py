"""Efficiencies of strips and wires: which of those that particles fire are read out."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.background.cells import cell_numbers
from cgemit.background.random import READ_CELLS, READ_STRIPS, Floats, Random
from cgemit.detector import Detector
from cgemit.detector.background import BackgroundLevel
from cgemit.tables import Table


def read_out(
    detector: Detector, level: BackgroundLevel, digis: Table, wire_hits: Table, seed: int
) -> tuple[Table, Table]:
    """Return the digis and wire hits that the efficiencies of a level leave; the same tables where they are 1.

    Rows without a truth are noise or other events, whose rates are those of what is read out: they stay. Positions
    measured without strips have the efficiency of their view.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel
    digis, wire_hits : Table
    seed : int
    """
    views = np.array([level.efficiency_x, level.efficiency_v])
    if np.any(views < 1):
        within = np.arange(len(digis)) - np.repeat(digis.offsets[:-1], np.diff(digis.offsets))
        place = np.where(digis["gid"] >= 0, digis["gid"], within)
        digis = digis[(digis["truth"] < 0) | (_draws(digis, place, READ_STRIPS, seed) < views[digis["view"]])]
    if level.efficiency_wires < 1:
        cells = cell_numbers(detector, wire_hits["layer"], wire_hits["wire"])
        drawn = _draws(wire_hits, cells, READ_CELLS, seed)
        wire_hits = wire_hits[(wire_hits["wire_truth"] < 0) | (drawn < level.efficiency_wires)]
    return digis, wire_hits


def _draws(table: Table, place: npt.NDArray[np.int64], purpose: int, seed: int) -> Floats:
    """Return a number for each row that depends on its event and channel only, (n,) float64 in [0, 1)."""
    drawn = np.empty(len(table))
    for event, begin, end in zip(table.events, table.offsets[:-1], table.offsets[1:], strict=True):
        mine = place[begin:end]
        if len(mine):
            drawn[begin:end] = Random(seed, int(event), purpose).uniform(int(mine.max()) + 1)[mine]
    return drawn
