"""Hits of candidates and of particles, counted for the metrics of track finding (docs/methods/match.md)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit.candidates import HIT_V, HIT_WIRE, HIT_X, HIT_XV, XV_CLUSTER
from cgemit.detector import Detector
from cgemit.find import own_clusters, particle_rows, residuals
from cgemit.result import Result
from cgemit.tables import Table

Rows = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Column = npt.NDArray[Any]


class CandidateCounts(NamedTuple):
    """Hits of each candidate; an XV point counts as two.

    Attributes
    ----------
    particle : ndarray, (candidates,) int64
        Row of the particle with the most hits, daughters of its decays included; -1 without hits of a particle.
    hits : ndarray, (candidates,) int64
        All its hits.
    of_particle : ndarray, (candidates,) int64
        Hits of that particle and of its daughters, with clusters that it shares.
    of_daughters : ndarray, (candidates,) int64
        Those of its daughters.
    of_loops : ndarray, (candidates,) int64
        Those that the particle itself left on other half turns than the first one.
    found : ndarray, (candidates,) int64
        Measurements of that particle itself on its first half turn: crossings of a gap, counted per view, and cells;
        without the clusters that it shares, which are measurements of the particle with the larger part.
    """

    particle: Rows
    hits: Rows
    of_particle: Rows
    of_daughters: Rows
    of_loops: Rows
    found: Rows


class ParticleCounts(NamedTuple):
    """Measurements that each particle left on its first half turn, before any decay; all of shape (particles,).

    Attributes
    ----------
    x_layers, v_layers, points : ndarray, int64
        CGEM layers with an X cluster, with a V cluster, with both.
    wires, stereo : ndarray, int64
        Cells of the drift chamber, and those of its stereo layers.
    hits : ndarray, int64
        Crossings of a gap with a cluster, counted per view, and cells.
    """

    x_layers: Rows
    v_layers: Rows
    points: Rows
    wires: Rows
    stereo: Rows
    hits: Rows


def count_particles(result: Result) -> ParticleCounts:
    """Return the measurements of each particle.

    Parameters
    ----------
    result : Result
    """
    particles, clusters, wire_hits = result.particles, result.clusters, result.wire_hits
    n = len(particles)
    rows = own_clusters(result.detector, clusters, result.truths)
    of_truth = _origins(particles, result.truths)
    truth = clusters["truth"][rows]
    mine = of_truth.first[truth]
    rows, truth = rows[mine], truth[mine]
    views = len(result.detector.cgem) * 2
    seen = np.zeros((n, views), np.bool_)
    seen[of_truth.owner[truth], clusters["layer"][rows] * 2 + clusters["view"][rows]] = True
    x, v = seen[:, HIT_X::2], seen[:, HIT_V::2]
    of_wire = _origins(particles, result.wire_truths).linked(wire_hits["wire_truth"])
    on = of_wire.first
    chamber = result.detector.drift_chamber
    tilted = [layer.number for layer in chamber.layers if layer.twist != 0] if chamber else []
    wires, stereo = (
        np.bincount(of_wire.owner[which], minlength=n) for which in (on, on & np.isin(wire_hits["layer"], tilted))
    )
    crossings = np.bincount(of_truth.owner[truth], minlength=n)
    return ParticleCounts(
        x.sum(axis=1), v.sum(axis=1), (x & v).sum(axis=1), wires, stereo, (crossings + wires).astype(np.int64)
    )


def count_candidates(result: Result) -> CandidateCounts:
    """Return the hits of each candidate.

    Parameters
    ----------
    result : Result
    """
    particles, clusters, wire_hits = result.particles, result.clusters, result.wire_hits
    n, view, row = len(result.candidates), result.candidate_hits["view"], result.candidate_hits["row"]
    candidate = result.candidate_hits["candidate"]
    wire = view == HIT_WIRE
    of_cluster = _origins(particles, result.truths).linked(clusters["truth"])
    of_wire = _origins(particles, result.wire_truths).linked(wire_hits["wire_truth"])
    place = row + np.where(wire, len(clusters), 0)
    owner, late, looped = (np.concatenate(pair).take(place) for pair in zip(of_cluster, of_wire, strict=True))
    weight = np.where(view == HIT_XV, 2, 1)
    best = _most_common(owner, weight, candidate, n)
    shared = _shared(result, np.flatnonzero(~wire), best)
    own = ((owner >= 0) & (owner == best[candidate])) | shared

    def total(which: Flags) -> Rows:
        return np.bincount(candidate[which], weight[which], minlength=n).astype(np.int64)

    # A crossing counts once per view, however many of its clusters the candidate has.
    first = own & ~late & ~looped
    strips = np.flatnonzero(first & ~shared & ~wire)
    crossing = clusters["truth"][row[strips]]
    found = np.bincount(candidate[first & wire], minlength=n)
    for axis in (HIT_X, HIT_V):
        on = (view[strips] == axis) | (view[strips] == HIT_XV)
        pairs = np.unique(np.stack([candidate[strips[on]], crossing[on]]), axis=1)
        found = found + np.bincount(pairs[0], minlength=n)
    every = np.ones(len(row), np.bool_)
    loops = total(own & looped & ~late & ~shared)
    return CandidateCounts(best, total(every), total(own), total(own & late), loops, found.astype(np.int64))


class _Origins(NamedTuple):
    """Row of the particle of each truth (-1: none), and whether a daughter or another half turn left it."""

    owner: Rows
    late: Flags
    looped: Flags

    @property
    def first(self) -> Flags:
        """Whether a particle left it on its first half turn."""
        return (self.owner >= 0) & ~self.late & ~self.looped

    def linked(self, link: Rows) -> _Origins:
        """Return the same for rows that link to truths."""
        position = np.where(link >= 0, link, -1)
        return _Origins(
            *(
                np.append(values, values.dtype.type(none)).take(position)
                for values, none in zip(self, (-1, 0, 0), strict=True)
            )
        )


def _origins(particles: Table, truths: Table) -> _Origins:
    return _Origins(particle_rows(particles, truths), truths["daughter"] > 0, truths["half_turn"] != 0)


def _most_common(owner: Rows, weight: Rows, candidate: Rows, n: int) -> Rows:
    """Return the most common owner of the hits of each of n candidates: the first one on a tie; -1: none."""
    best = np.full(n, -1)
    known = np.flatnonzero(owner >= 0)
    if not len(known):
        return best
    width = int(owner.max()) + 1
    pairs, place = np.unique(candidate[known] * width + owner[known], return_inverse=True)
    counts = np.bincount(place, weight[known], minlength=len(pairs))
    order = np.lexsort((pairs, -counts, pairs // width))
    first = order[np.diff(pairs[order] // width, prepend=-1) != 0]
    best[pairs[first] // width] = pairs[first] % width
    return best


def _shared(result: Result, strips: Rows, best: Rows) -> Flags:
    """Tell which hits are clusters of several crossings, one of them of the candidate's particle.

    The link of such a cluster names the crossing with the most charge only. Another one belongs to it if its point at
    mid-gap lies within the strips, or a pitch beside them.
    """
    shared = np.zeros(len(result.candidate_hits), np.bool_)
    clusters, truths, particles = result.clusters, result.truths, result.particles
    row = result.candidate_hits["row"][strips]
    particle = best[result.candidate_hits["candidate"][strips]]
    several = (clusters["n_truths"][row] > 1) & (particle >= 0) & (clusters["view"][row] < XV_CLUSTER)
    strips, row, particle = strips[several], row[several], particle[several]
    if not len(strips):
        return shared
    own = (truths["daughter"] == 0) & (truths["half_turn"] == 0)
    of_truth = np.where(own, particle_rows(particles, truths), -1)
    layers = len(result.detector.cgem)
    key = of_truth * layers + truths["layer"]
    order = np.argsort(key, kind="stable")
    wanted = particle * layers + clusters["layer"][row]
    at = order[np.minimum(np.searchsorted(key, wanted, sorter=order), len(key) - 1)]
    other = (key[at] == wanted) & (of_truth[clusters["truth"][row]] != particle)
    strips, row, at = strips[other], row[other], at[other]
    if len(strips):
        shared[strips] = _covers(result.detector, clusters[row].with_columns(truth=at), truths)
    return shared


def _covers(detector: Detector, clusters: Table, truths: Table) -> Flags:
    """Tell which clusters hold the mid-gap point of the crossing that they link to, or end a pitch before it."""
    pitches = np.array([(cgem.pitch_x, cgem.pitch_v) for cgem in detector.cgem])
    pitch = pitches[clusters["layer"], clusters["view"]]
    off = np.abs(residuals(detector, clusters, truths, np.arange(len(clusters))))
    return np.asarray(off <= (0.5 * clusters["size"] + 1) * pitch)
