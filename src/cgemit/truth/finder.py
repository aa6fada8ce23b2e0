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

from cgemit import _core
from cgemit.detector import Detector, load
from cgemit.detector.channels import checked
from cgemit.detector.core import wire_lists
from cgemit.tables import Table
from cgemit.truth.assign import own_clusters
from cgemit.truth.origins import have_flown


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
    repeat their X and V clusters. Hits of hot wires, without a truth, of a particle that is not in the table, of the
    daughters of a decay, or of half turns other than the first are not assigned.

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
    links = wire_hits["wire_truth"]
    if detector.drift_chamber and len(masked := wire_lists(detector.drift_chamber).masked):
        links = np.where(np.isin(wire_hits["gid"], masked), -1, links)
    hits = _core.truth.assign_hits(
        particles=dict(particles.columns), truths=dict(truths.columns), wire_truths=dict(wire_truths.columns),
        clusters=dict(clusters.columns), wire_hits={**wire_hits.columns, "wire_truth": links}, candidates=candidate_of,
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
    cover = particles.cover | {"meta": {"finder": "truth"}}
    return {
        "candidates": Table("candidates", columns, **cover),
        "candidate_hits": Table("candidate_hits", hits, **cover),
    }
