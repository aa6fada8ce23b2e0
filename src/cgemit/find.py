"""Assignment of hits to tracks by truth: a stand-in for track finding (docs/methods/fit.md).

Every hit of a particle is given to it, and none of another; where two particles share a cluster or a cell, the one
that left more (or was closer) has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.tables import Table

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
        Strips of the cluster; 0 for wires and for clusters without strips.
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


def by_truth(particles: Table, clusters: Table, wire_hits: Table, truths: Table, wire_truths: Table) -> Candidates:
    """Give each particle the X clusters, V clusters and wire hits that its truths link to.

    XV clusters are left out: they repeat what their X and V clusters say. Hits without a truth, or of a particle
    that the table does not hold, belong to nobody.

    Parameters
    ----------
    particles, clusters, wire_hits, truths, wire_truths : Table
        Of the same events; links of `clusters` and `wire_hits` count rows of `truths` and `wire_truths`.

    Returns
    -------
    Candidates
    """
    in_view = np.flatnonzero((clusters["view"] <= HIT_V) & (clusters["truth"] >= 0))
    linked = np.flatnonzero(wire_hits["wire_truth"] >= 0)
    owner_of_truth = _particle_rows(particles, truths)
    owner_of_passage = _particle_rows(particles, wire_truths)
    owner = np.concatenate(
        [owner_of_truth[clusters["truth"][in_view]], owner_of_passage[wire_hits["wire_truth"][linked]]]
    )
    kind = np.concatenate([clusters["view"][in_view], np.full(len(linked), HIT_WIRE)]).astype(np.uint8)
    layer = np.concatenate([clusters["layer"][in_view], wire_hits["layer"][linked]])
    row = np.concatenate([in_view, linked])
    layers = int(layer.max(initial=0)) + 1
    outward = (owner * 2 + (kind == HIT_WIRE)) * layers + layer
    # Stable: within a layer the order of the tables stays (sheet, then X before V; wire).
    order = np.argsort(outward, kind="stable")
    order = order[np.searchsorted(outward[order], 0) :]  # drops the hits of nobody, whose owner is -1
    offsets = np.searchsorted(owner[order], np.arange(len(particles) + 1)).astype(np.int64)
    return Candidates(offsets, kind[order], row[order])


def fit_hits(candidates: Candidates, clusters: Table, wire_hits: Table) -> FitHits:
    """Collect the measurements of the candidates from the tables they point into.

    Parameters
    ----------
    candidates : Candidates
    clusters, wire_hits : Table

    Returns
    -------
    FitHits
    """
    kind, row = candidates.kind, candidates.row
    on_wire = kind == HIT_WIRE
    at_cluster, at_wire = row[~on_wire], row[on_wire]
    is_x = kind[~on_wire] == HIT_X

    def mixed(of_cluster: Column, of_wire: Column | int, dtype: str) -> Column:
        column: Column = np.empty(len(kind), dtype)
        column[~on_wire], column[on_wire] = of_cluster, of_wire
        return column

    def by_view(x: str, v: str) -> Column:
        column: Column = np.where(is_x, clusters[x][at_cluster], clusters[v][at_cluster])
        return column

    return FitHits(
        hit_offsets=candidates.hit_offsets,
        kind=kind,
        layer=mixed(clusters["layer"][at_cluster], wire_hits["layer"][at_wire], "i4"),
        element=mixed(clusters["sheet"][at_cluster], wire_hits["wire"][at_wire], "i4"),
        value=mixed(by_view("x", "v"), wire_hits["drift"][at_wire], "f8"),
        sigma=mixed(by_view("err_x", "err_v"), wire_hits["sigma"][at_wire], "f8"),
        size=mixed(clusters["size"][at_cluster], 0, "i4"),
        side=mixed(np.zeros(len(at_cluster), "i1"), wire_hits["side"][at_wire], "i1"),
        row=row,
    )


def _particle_rows(particles: Table, truths: Table) -> npt.NDArray[np.int64]:
    """Row of the particles table for each row of a truth table, -1 where it holds no such particle."""
    span = int(max(particles["particle"].max(initial=0), truths["particle"].max(initial=0))) + 1
    first = min(particles.first_event, truths.first_event)
    known = (particles["event"] - first) * span + particles["particle"]
    wanted = (truths["event"] - first) * span + truths["particle"]
    order = np.argsort(known, kind="stable")
    at = np.searchsorted(known, wanted, sorter=order)
    if not len(known):
        return np.full(len(wanted), -1)
    row = order[np.minimum(at, len(known) - 1)]
    return np.where(known[row] == wanted, row, -1)
