"""Perfect finder: hits assigned to particles by truth (docs/methods/find.md).

Every charged particle gets its wire hits and one cluster per view of each of its crossings, and no hit of another
particle. A cluster or cell that two particles share goes to the one that left more (or was closer). Hits of the
daughters of a decay in flight are not the particle's own: its candidate ends at the decay. Of a particle that makes
several half turns in the field, it takes the hits of the first one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.detector import Detector, load
from cgemit.detector.channels import checked
from cgemit.detector.parts import local_v, pitches
from cgemit.reconstruction.candidates import HIT_V, HIT_X
from cgemit.tables import Table

Rows = npt.NDArray[np.intp]

_OF_STRIPS = 0  # `method` of clusters whose position is that of their strips
_NEARER = 1e-6  # orders crossings inside several clusters


@checked(
    "particles", "clusters", "wire_hits", "truths", "wire_truths", ignore=("gid", "particle", "x_cluster", "v_cluster")
)
def by_truth(
    detector: Detector | str | Mapping[str, Any],
    particles: Table,
    clusters: Table,
    wire_hits: Table,
    truths: Table,
    wire_truths: Table,
) -> dict[str, Table]:
    """Give each charged particle the X clusters, V clusters and wire hits that its truths link to.

    Of several clusters of one crossing in one view, `own_clusters` selects one. XV clusters are left out, since they
    repeat their X and V clusters. Hits without a truth, of a particle that is not in the table, of the daughters of a
    decay, or of half turns other than the first are not assigned.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
        In which the clusters were made.
    particles, clusters, wire_hits, truths, wire_truths : Table
        Of the same events; links of `clusters` and `wire_hits` count rows of `truths` and `wire_truths`.

    Returns
    -------
    dict of str to Table
        ``candidates``, one per charged particle that flew and in their order, with its own mass and charge, and
        ``candidate_hits``, ordered from the beam line outward.

    Raises
    ------
    ValueError
        If the tables do not belong to each other or to the detector.
    """
    detector = load(detector)
    charged = np.flatnonzero(have_flown(particles))
    candidate_of = np.full(len(particles), -1)  # of each particle; neutral ones have none
    candidate_of[charged] = np.arange(len(charged))
    hits = _core.assign_hits(
        particles=dict(particles.columns), truths=dict(truths.columns), wire_truths=dict(wire_truths.columns),
        clusters=dict(clusters.columns), wire_hits=dict(wire_hits.columns), candidates=candidate_of,
        rows=own_clusters(detector, clusters, truths),
    )  # fmt: skip
    event = particles["event"].take(charged)
    columns = {
        "event": event,
        "candidate": np.arange(len(event)) - np.searchsorted(event, event),
        "pdg": np.abs(particles["pdg"].take(charged)),
        "mass": particles["mass"].take(charged),
        "charge": np.abs(particles["charge"].take(charged)),
    }
    hits["event"] = event.take(hits["candidate"])
    about = particles.cover | {"meta": {"finder": "truth"}}
    return {
        "candidates": Table("candidates", columns, **about),
        "candidate_hits": Table("candidate_hits", hits, **about),
    }


def have_flown(particles: Table) -> Any:
    """Return which particles may have left hits, (n,) bool: charged ones that the simulation transports.

    Parameters
    ----------
    particles : Table of kind "particles"
    """
    return (particles["charge"] != 0) & (particles["status"] < _core.TransportStatus.at_rest)


def link_problems(table: Table, link: str, target: Table) -> list[str]:
    """Return whether links of a table lead to missing rows or to rows of another event.

    Parameters
    ----------
    table : Table
    link : str
        Column of `table` that counts rows of `target`.
    target : Table

    Returns
    -------
    list of str
    """
    rows, event = table[link], table["event"]
    first = _core.strange_link(rows, event, target["event"])
    if first < 0:
        return []
    if rows.max() >= len(target):
        return [f"{target.kind}: got {len(target)} rows; expected more, {table.kind} link to row {rows.max()}"]
    given = f"{table.kind} row {first}, of event {event[first]}, links to one of event {target['event'][rows[first]]}"
    return [f"{target.kind}: {given}; expected the rows that {table.kind} were made from"]


def own_clusters(detector: Detector, clusters: Table, truths: Table) -> Rows:
    """Return the one cluster of each crossing and view that the particle itself made.

    Delta electrons may fire strips away from the particle's own, and at a seam of the readout a crossing fires strips
    of two sheets. The cluster with the strip at the crossing's mid-gap point is selected, otherwise the nearest one.

    Parameters
    ----------
    detector : Detector
    clusters, truths : Table
        Links of `clusters` count rows of `truths`.

    Returns
    -------
    ndarray, (n,) intp
        Increasing row numbers of X and V clusters; clusters without a truth are left out.
    """
    rows = np.flatnonzero((clusters["view"] <= HIT_V) & (clusters["truth"] >= 0))
    place = clusters["truth"].take(rows) * 2 + clusters["view"].take(rows)
    several = np.flatnonzero(np.bincount(place).take(place) > 1)
    order = several[np.lexsort((_distances(detector, clusters, truths, rows[several]), place[several]))]
    chosen = np.ones(len(rows), np.bool_)
    chosen[order[np.diff(place[order], prepend=-1) == 0]] = False  # all but the nearest of each crossing
    return rows[chosen]


def residuals(detector: Detector, clusters: Table, truths: Table, rows: Rows) -> Floats:
    """Return how far clusters are from the crossings they link to, at mid-gap.

    Parameters
    ----------
    detector : Detector
    clusters, truths : Table
    rows : ndarray, (n,) int
        X and V clusters that link to a truth.

    Returns
    -------
    ndarray, (n,) float64, mm
        X or V of the cluster minus that of the crossing's phi and z, at the nearest of all turns about the beam line.
    """
    layer, sheet, view = (clusters[name][rows] for name in ("layer", "sheet", "view"))
    truth = clusters["truth"][rows]
    residual = np.empty(len(rows))
    for number, cgem in enumerate(detector.layers):
        for half_shell, start in enumerate(cgem.sheet_phi):
            for axis in (HIT_X, HIT_V):
                mine = (layer == number) & (sheet == half_shell) & (view == axis)
                phi, z = truths["phi"][truth[mine]], truths["z"][truth[mine]]
                x, turn = cgem.r_readout * (phi - start), 2 * np.pi * cgem.r_readout
                if axis == HIT_X:
                    difference = clusters["x"][rows[mine]] - x
                else:  # a whole turn changes V by hundreds of mm: the nearest turn is the right one
                    difference = clusters["v"][rows[mine]] - local_v(cgem, x, z)
                    turn *= np.cos(cgem.stereo)
                residual[mine] = difference - turn * np.round(difference / turn)
    return residual


def _distances(detector: Detector, clusters: Table, truths: Table, rows: Rows) -> Floats:
    """How far crossings lie from the edge of their cluster (mm), 0 if inside."""
    first, size, layer, view = (clusters[name][rows] for name in ("first", "size", "layer", "view"))
    of_layer = np.array([pitches(cgem) for cgem in detector.layers]).reshape(-1, 2)
    begins = np.array([(0.0, cgem.offset_v) for cgem in detector.layers]).reshape(-1, 2)
    pitch = of_layer[layer, view]
    position = np.where(view == HIT_X, clusters["x"][rows], clusters["v"][rows])
    # A position weighted by charge is not the middle of the strips; one of charge and time is corrected for the Lorentz
    # shift, which strips are not. Of two parts of such a cluster at the crossing, the nearer one counts.
    strips = clusters["method"][rows] == _OF_STRIPS
    shifts = [(cgem.lorentz_shift or 0.0) * np.array([1.0, np.cos(cgem.stereo)]) for cgem in detector.layers]
    shift = np.reshape(shifts, (-1, 2))[layer, view]
    middle = np.where(strips, (first + begins[layer, view] + 0.5 * size) * pitch - shift, position)
    beside = np.abs(residuals(detector, clusters, truths, rows) - (position - middle))
    return np.asarray(np.maximum(beside - 0.5 * size * pitch, np.where(strips, 0.0, _NEARER * beside)))


def particle_rows(particles: Table, truths: Table) -> npt.NDArray[np.int64]:
    """Return the particle behind each truth.

    Parameters
    ----------
    particles : Table
    truths : Table
        Of kind "truths" or "wire_truths".

    Returns
    -------
    ndarray, (truths,) int64
        Row of the particles table; -1 where it holds no such particle.
    """
    found: npt.NDArray[np.int64] = _core.particle_rows(dict(particles.columns), dict(truths.columns))
    return found
