"""Track candidates: which hits belong together. Finding makes them, the fit takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.tables import Table
from cgemit.tables.table import kind_problems

Column = npt.NDArray[Any]

HIT_X, HIT_V, HIT_WIRE = 0, 1, 2
"""Kinds of hits; 0 and 1 are the views of the clusters table."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Which hits make up which track candidate, one candidate per row of the particles table.

    Attributes
    ----------
    hit_offsets : ndarray, (n + 1,) int64
        Hits ``hit_offsets[i]`` to ``hit_offsets[i + 1]`` belong to particle row i, ordered from the beam line
        outward: CGEM layers, then wire layers.
    kind : ndarray, (hits,) uint8
        `HIT_X`, `HIT_V` or `HIT_WIRE`.
    row : ndarray, (hits,) int64
        Row of the clusters table, of wire_hits for `HIT_WIRE`.
    """

    hit_offsets: npt.NDArray[np.int64]
    kind: npt.NDArray[np.uint8]
    row: npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class FitHits:
    """The measurements of all candidates as flat columns, the input of the fit.

    Attributes
    ----------
    hit_offsets : ndarray, (n + 1,) int64
    kind : ndarray, (hits,) uint8
    layer : ndarray, (hits,) int32
        CGEM layer, or the experiment's number of the wire layer.
    element : ndarray, (hits,) int32
        Sheet or wire.
    value : ndarray, (hits,) float64, mm
        Local X or V on the sheet, or drift distance.
    sigma : ndarray, (hits,) float64, mm
    size : ndarray, (hits,) int32
        Strips of the cluster; 0 for wires and for clusters whose error holds as it is (`method` 1).
    side : ndarray, (hits,) int8
        Side of the wire; 0 where hidden and for clusters.
    row : ndarray, (hits,) int64
        Row of the clusters or wire_hits table.
    """

    hit_offsets: npt.NDArray[np.int64]
    kind: npt.NDArray[np.uint8]
    layer: npt.NDArray[np.int32]
    element: npt.NDArray[np.int32]
    value: npt.NDArray[np.float64]
    sigma: npt.NDArray[np.float64]
    size: npt.NDArray[np.int32]
    side: npt.NDArray[np.int8]
    row: npt.NDArray[np.int64]


def with_masses(
    particles: Table, candidates: Candidates, kinds: Sequence[tuple[int, float]]
) -> tuple[Table, Candidates]:
    """Return every particle and candidate once for each mass that the fit shall assume.

    Parameters
    ----------
    particles : Table of kind "particles"
    candidates : Candidates
    kinds : sequence of (int, float)
        Number of the Particle Data Group, unsigned, and mass in GeV/c2; none: the particles' own.

    Returns
    -------
    particles : Table of kind "particles"
        With the column `hypothesis`, the number.
    candidates : Candidates

    Raises
    ------
    ValueError
        If the candidates are not those of the particles.
    """
    if len(candidates.hit_offsets) != len(particles) + 1:
        given = f"{len(candidates.hit_offsets) - 1} for {len(particles)} particles"
        raise ValueError(f"candidates: got {given}, expected one per row of the particles table")
    if not kinds:
        return particles.with_columns(hypothesis=np.abs(particles["pdg"])), candidates
    n = len(particles)
    rows = np.repeat(np.arange(n), len(kinds))
    pdg, mass = (np.tile(values, n) for values in zip(*kinds, strict=True))
    counts = np.diff(candidates.hit_offsets)[rows]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    # Hit j of a repeated candidate is as far behind its first one as in the original.
    at = np.arange(offsets[-1]) + np.repeat(candidates.hit_offsets[:-1][rows] - offsets[:-1], counts)
    repeated = particles[rows].with_columns(mass=mass, hypothesis=pdg)
    return repeated, Candidates(offsets, candidates.kind[at], candidates.row[at])


def fit_hits(candidates: Candidates, clusters: Table, wire_hits: Table) -> FitHits:
    """Collect the measurements of the candidates from the tables they point into.

    Parameters
    ----------
    candidates : Candidates
    clusters, wire_hits : Table

    Returns
    -------
    FitHits

    Raises
    ------
    ValueError
        If the candidates point to rows that the tables do not have.
    """
    kind, row = candidates.kind, candidates.row
    problems = kind_problems(clusters=clusters, wire_hits=wire_hits) or _row_problems(candidates, clusters, wire_hits)
    if problems:
        raise ValueError("fit_hits:\n  " + "\n  ".join(problems))
    # Row numbers of the two tables put one behind the other, so that a column is picked in one go; for what X and V
    # clusters measure, the clusters come twice.
    joined = np.array([0, 0, len(clusters)])[kind] + row
    by_view = np.array([0, len(clusters), 2 * len(clusters)])[kind] + row

    def pick(rows: Column, *columns: Column) -> Column:
        return np.concatenate(columns).take(rows)

    return FitHits(
        hit_offsets=candidates.hit_offsets,
        kind=kind,
        layer=pick(joined, clusters["layer"], wire_hits["layer"]),
        element=pick(joined, clusters["sheet"], wire_hits["wire"]),
        value=pick(by_view, clusters["x"], clusters["v"], wire_hits["drift"]),
        sigma=pick(by_view, clusters["err_x"], clusters["err_v"], wire_hits["sigma"]),
        size=pick(joined, clusters["size"] * (clusters["method"] == 0), np.zeros(len(wire_hits), "i4")),
        side=pick(joined, np.zeros(len(clusters), "i1"), wire_hits["side"]),
        row=row,
    )


def _row_problems(candidates: Candidates, clusters: Table, wire_hits: Table) -> list[str]:
    """Say which hits of the candidates are not in the tables."""
    kind, row = candidates.kind, candidates.row
    if kind.max(initial=0) > HIT_WIRE:
        return [f"candidates: got kind {kind.max()}, expected {HIT_X}, {HIT_V} or {HIT_WIRE}"]
    problems = []
    for table, rows in ((clusters, row[kind != HIT_WIRE]), (wire_hits, row[kind == HIT_WIRE])):
        if rows.min(initial=0) < 0 or rows.max(initial=-1) >= len(table):
            given = f"rows {rows.min()} to {rows.max()} of {table.kind}, which has {len(table)} rows"
            problems.append(f"candidates: got {given}; expected the table that they were found in")
    return problems
