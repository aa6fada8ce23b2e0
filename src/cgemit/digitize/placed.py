"""Crossings as displaced CGEM layers see them: in the axes of each layer (docs/methods/alignment.md)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.detector import CgemLayer, Detector
from cgemit.detector.placement import seen_by
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]


def in_layer_axes(detector: Detector, truths: Table, steps: Table) -> tuple[Table, Table]:
    """Return truths and steps in the axes of their layers; the same tables where no layer is displaced.

    A straight track through the crossing is continued to the displaced layer. Points of delta electrons keep their
    places relative to it.

    Parameters
    ----------
    detector : Detector
    truths, steps : Table
        Of these kinds, steps linked to truths; layers as in the detector.

    Returns
    -------
    truths, steps : Table
        With other `entry`, `exit`, `phi`, `z` of truths, and `x`, `y`, `z`, `dx`, `dy`, `dz` of steps.
    """
    if not any(layer.is_moved for layer in detector.cgem):
        return truths, steps
    entry, out = _points(truths, "entry_x", "entry_y", "entry_z"), _points(truths, "exit_x", "exit_y", "exit_z")
    direction = out - entry
    radius = np.array([layer.r_mid for layer in detector.cgem])[truths["layer"]]
    middle = np.column_stack([radius * np.cos(truths["phi"]), radius * np.sin(truths["phi"]), truths["z"]])
    at, length = _points(steps, "x", "y", "z"), _points(steps, "dx", "dy", "dz")
    along = direction[steps["truth"]]
    for number, layer in enumerate(detector.cgem):
        if not layer.is_moved:
            continue
        mine, of_mine = truths["layer"] == number, steps["layer"] == number
        for points in (entry, out, middle):
            points[mine] = seen_by(layer, points[mine], direction[mine])
        at[of_mine], length[of_mine] = _steps_seen_by(layer, at[of_mine], length[of_mine], along[of_mine])
    moved = _columns(("entry_x", "entry_y", "entry_z"), entry) | _columns(("exit_x", "exit_y", "exit_z"), out)
    moved |= {"phi": np.arctan2(middle[:, 1], middle[:, 0]), "z": middle[:, 2]}
    of_steps = _columns(("x", "y", "z"), at) | _columns(("dx", "dy", "dz"), length)
    return truths.with_columns(**moved), steps.with_columns(**of_steps)


def _steps_seen_by(layer: CgemLayer, middle: Floats, length: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Return middles and lengths of steps, (n, 3), of which both ends keep their radius."""
    begin, end = (seen_by(layer, middle + side * length, along) for side in (-0.5, 0.5))
    return 0.5 * (begin + end), end - begin


def _points(table: Table, *names: str) -> Floats:
    return np.column_stack([table[name] for name in names]).astype(np.float64)


def _columns(names: tuple[str, str, str], points: Floats) -> dict[str, Floats]:
    return dict(zip(names, points.T.copy(), strict=True))
