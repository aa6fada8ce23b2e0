"""Drift chamber: passages of cells become drift distances."""

from __future__ import annotations

import numpy as np

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.tables import Table

#: Drift distance (mm) against drift time (ns) of the outer drift chamber's cells: medians of reconstructed hits of
#: BESIII (BOSS 7.2.0 files published with pybes3), with the wire itself put at time 0. Straight lines between the
#: points; the outermost ones are continued.
XT_DISTANCE = np.array([0.0, 0.5, 1.2, 2.0, 2.8, 3.45, 4.7, 5.75, 6.9, 7.9, 8.3])
XT_TIME = np.array([0.0, 10.0, 25.0, 50.0, 75.0, 100.0, 150.0, 200.0, 250.0, 300.0, 350.0])


def read_out_wires(detector: Detector, wire_truths: Table, *, reveal_sides: bool, seed: int) -> Table:
    """Return the table ``wire_hits`` of a table ``wire_truths``.

    Parameters
    ----------
    detector : Detector
    wire_truths : Table
    reveal_sides : bool
        Whether wire hits tell on which side of the wire the particle passed.
    seed : int

    Raises
    ------
    ValueError
        If a wire is not in the detector, or a value is not finite.
    """
    hits = _core.read_out_wires(
        compiled(detector), dict(wire_truths.columns), xt_distance=XT_DISTANCE, xt_time=XT_TIME,
        reveal_sides=reveal_sides, seed=seed,
    )  # fmt: skip
    return Table("wire_hits", hits, **wire_truths.cover)
