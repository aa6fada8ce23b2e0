"""Assignment of hits to tracks by truth: a stand-in for track finding (docs/methods/fit.md).

Every hit of a particle is given to it, and none of another; where two particles share a cluster or a cell, the one
that left more (or was closer) has it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.candidates import HIT_V, HIT_WIRE, Candidates
from cgemit.tables import Table


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
