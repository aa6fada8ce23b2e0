"""Where tracks of a vertex begin, for a second fit without the matter that they never crossed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cgemit import helix
from cgemit.detector import Detector, compiled, load
from cgemit.tables import Table
from cgemit.tables.table import kind_problems


def begin_at_vertices(
    detector: Detector | str | Mapping[str, Any], candidates: Table, tracks: Table, vertices: Table
) -> Table:
    """Return candidates whose tracks begin at their vertex: a second `fit` of them leaves out the matter inside.

    The first fit takes all tracks to the origin. Tracks of a K_S that decays beyond the beam pipe never crossed the
    pipe; their loss in it is added, and its scattering counted.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    candidates : Table of kind "candidates"
    tracks : Table of kind "tracks"
        Of the first fit of these candidates.
    vertices : Table of kind "vertices"
        Of these tracks. A track of several vertices begins at the one with the smallest chi-square. Vertices whose
        `status` is not ok count for nothing.

    Returns
    -------
    Table of kind "candidates"
        With the column `start_radius` (`cgemit.helix.start_radius`); 0 for tracks without a vertex.

    Raises
    ------
    ValueError
        Listing the tables that are of another kind.
    """
    problems = kind_problems(candidates=candidates, tracks=tracks, vertices=vertices)
    if problems:
        raise ValueError("begin_at_vertices:\n  " + "\n  ".join(problems))
    bz = compiled(load(detector)).field.bz
    good = np.flatnonzero(vertices["status"] == 0)
    rows = np.concatenate([vertices[side][good] for side in ("first", "second")])
    vertex = np.concatenate([good, good])
    order = np.argsort(-vertices["chi2"][vertex], kind="stable")  # the best of a track is written last
    rows, vertex = rows[order], vertex[order]
    parameters = np.stack([tracks[name] for name in helix.PARAMETERS], axis=1)
    points = np.stack([vertices[name] for name in "xyz"], axis=1)
    begin = np.zeros(len(candidates))
    begin[tracks["candidate"][rows]] = helix.start_radius(parameters[rows], points[vertex], bz)
    return candidates.with_columns(start_radius=begin)
