"""Tracks that begin away from the beam line: which matter they have crossed (docs/methods/robustness.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector, slabs
from cgemit.fit_settings import FitSettings
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Column = npt.NDArray[Any]

#: Column of the candidates that comes before the setting of this name.
BEGIN = "start_radius"

#: A track is displaced if |dr| is more than this number of its errors, and than this share of the radius of the
#: innermost matter: for fast tracks the size of the beam counts, not their errors.
FAR, SHARE = 5.0, 0.1

#: Fits some rows of the candidates with the settings given: the tables that the fit makes.
FitRows = Callable[[Table, Table, FitSettings, Column], Mapping[str, Table]]


def displaced(dr: Floats, err_dr: Floats, detector: Detector) -> npt.NDArray[np.int8]:
    """Return whether tracks begin beside the beam line, (n,) int8; 0 without an error.

    Parameters
    ----------
    dr, err_dr : ndarray, (n,) float64, mm
        Closest approach to the beam line, and its standard deviation.
    detector : Detector
    """
    inner = slabs(detector)[0].shells[0].r_in
    return np.asarray(np.abs(dr) > np.maximum(FAR * err_dr, SHARE * inner), np.int8)


def slabs_inside(detector: Detector, radius: float) -> int:
    """Return the number of slabs of matter inside of a radius, with its sign.

    Parameters
    ----------
    detector : Detector
    radius : float, mm
    """
    count = sum(slab.radius < abs(radius) for slab in slabs(detector)) if radius else 0
    return -count if radius < 0 else count


def begins_of(candidates: Table, detector: Detector) -> Floats:
    """Return the radii at which the candidates begin, (n,) mm, one value for each set of slabs inside.

    Raises
    ------
    ValueError
        Listing each one that is no finite number.
    """
    radii = np.asarray(candidates[BEGIN], np.float64)
    wrong = np.flatnonzero(~np.isfinite(radii))
    if len(wrong):
        lines = [f"candidates row {row}: {BEGIN}: got {radii[row]}, expected a radius in mm" for row in wrong]
        raise ValueError("fit:\n  " + "\n  ".join(lines))
    places = np.sort([slab.radius for slab in slabs(detector)])
    between = np.concatenate([[0.0], 0.5 * (places[:-1] + places[1:]), places[-1:] + 1.0])
    return np.asarray(np.sign(radii) * between[np.searchsorted(places, np.abs(radii))])


def fit_by_begin(
    fit_rows: FitRows, begins: Floats, candidates: Table, candidate_hits: Table, settings: FitSettings
) -> dict[str, Table]:
    """Fit candidates that begin at the same radius together, and return the tables of all.

    Parameters
    ----------
    fit_rows : callable
        Takes candidates, their hits, settings and the rows of the candidates.
    begins : ndarray, (n,) float64, mm
    candidates, candidate_hits : Table
    settings : FitSettings
    """
    plain = {name: column for name, column in candidates.columns.items() if name != BEGIN}
    whole = Table("candidates", plain, meta=candidates.meta, **candidates.cover)
    masses = max(1, len(settings.hypotheses()))
    parts: dict[str, list[Table]] = {}
    of_track: list[Column] = []
    for begin in np.unique(begins):
        rows = np.flatnonzero(begins == begin)
        number = np.full(len(candidates), -1)
        number[rows] = np.arange(len(rows))
        mine = candidate_hits[number[candidate_hits["candidate"]] >= 0]
        mine = mine.with_columns(candidate=number[mine["candidate"]])
        made = fit_rows(whole[rows], mine, replace(settings, start_radius=float(begin)), rows)
        tracks = (rows[:, None] * masses + np.arange(masses)).ravel()  # their rows in the table of all
        of_track.append(tracks)
        for name, table in made.items():
            link = {"candidate": rows[table["candidate"]]} if name == "tracks" else {"track": tracks[table["track"]]}
            parts.setdefault(name, []).append(table.with_columns(**link))
    joined = {}
    for name, tables in parts.items():
        columns = {one: np.concatenate([table[one] for table in tables]) for one in tables[0]}
        order = np.argsort(np.concatenate(of_track) if name == "tracks" else columns["track"], kind="stable")
        picked = {one: column[order] for one, column in columns.items()}
        joined[name] = Table(name, picked, meta=tables[0].meta, **candidates.cover)
    return joined
