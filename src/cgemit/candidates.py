"""Track candidates: which hits belong together. Finding makes them, the fit takes them."""

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
