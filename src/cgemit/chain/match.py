"""Match of tracks to particles: purity, efficiency, true parameters, residuals and pulls (docs/methods/match.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.detector import Detector, compiled, load
from cgemit.reconstruction.candidates import HIT_WIRE, HIT_XV, XV_CLUSTER
from cgemit.reconstruction.find.truth import link_problems, particle_rows
from cgemit.tables import Table
from cgemit.tables.table import kind_problems

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Scalar = TypeVar("Scalar", bound=np.generic)


def match(
    tracks: Table,
    candidates: Table,
    candidate_hits: Table,
    clusters: Table,
    wire_hits: Table,
    particles: Table,
    truths: Table,
    wire_truths: Table,
    *,
    detector: Detector | str | Mapping[str, Any],
) -> dict[str, Table]:
    """Find the particle of each track, and compare the track with it.

    A track belongs to the particle that most hits of its candidate come from. If several particles have as many hits,
    it belongs to the first one in the table of particles. An XV point counts as two hits, its X and its V cluster.
    Noise belongs to no particle. Hits of the charged daughters of a decay count as hits of the particle here, but
    neither in purity nor in efficiency. The efficiency counts the first half turn alone.

    Parameters
    ----------
    tracks, candidates, candidate_hits, clusters, wire_hits : Table
    particles, truths, wire_truths : Table
        Of the same events; links of `clusters` and `wire_hits` count rows of `truths` and `wire_truths`.
    detector : Detector, or what `load` accepts
        The simulated detector: its field bends the true helix.

    Returns
    -------
    dict of str to Table
        ``matches``, one row per track; without a particle everything but `purity` is -1 or NaN.

    Raises
    ------
    ValueError
        If tables are of another kind, or do not belong to each other.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=20)
    >>> fitted, truth = (r.fitted, r.candidates, r.candidate_hits), (r.particles, r.truths, r.wire_truths)
    >>> matches = cg.match(*fitted, r.clusters, r.wire_hits, *truth, detector=r.detector)["matches"]
    >>> print(matches["truth_p"].mean().round(3), matches["purity"].mean())
    1.0 1.0
    """
    tables = {
        "tracks": tracks, "candidates": candidates, "candidate_hits": candidate_hits, "clusters": clusters,
        "wire_hits": wire_hits, "particles": particles, "truths": truths, "wire_truths": wire_truths,
    }  # fmt: skip
    problems = kind_problems(**tables)
    problems = problems or (
        link_problems(clusters, "truth", truths)
        + link_problems(wire_hits, "wire_truth", wire_truths)
        + _row_problems(tracks, candidates, candidate_hits, clusters, wire_hits)
    )
    if problems:
        raise ValueError("match:\n  " + "\n  ".join(problems))
    of_cluster, late_cluster = _owners(particles, clusters["truth"], truths)
    of_wire, late_wire = _owners(particles, wire_hits["wire_truth"], wire_truths)
    owner = _pick(candidate_hits, of_cluster, of_wire)
    weight = np.where(candidate_hits["view"] == HIT_XV, 2, 1)
    row, own, hits = _most_common(owner, weight, candidate_hits["candidate"], len(candidates))
    late = _pick(candidate_hits, late_cluster, late_wire) & (owner == row[candidate_hits["candidate"]])
    own = own - np.bincount(candidate_hits["candidate"], weight * late, minlength=len(candidates)).astype(np.int64)
    other_cluster, other_wire = _other(clusters["truth"], truths), _other(wire_hits["wire_truth"], wire_truths)
    left = _hits_left(
        clusters, np.where(other_cluster, -1, of_cluster), np.where(other_wire, -1, of_wire), len(particles)
    )
    first = (owner == row[candidate_hits["candidate"]]) & ~_pick(candidate_hits, other_cluster, other_wire)
    found = np.bincount(candidate_hits["candidate"], weight * first, minlength=len(candidates)).astype(np.int64)
    candidate = tracks["candidate"]
    row, own, hits, found = row[candidate], own[candidate], hits[candidate], found[candidate]
    known = row >= 0
    of = np.where(known, row, 0)
    none = np.full(len(tracks), np.nan)
    columns = {
        "event": tracks["event"],
        "track": np.arange(len(tracks)),
        "particle": np.where(known, particles["particle"].take(of), -1) if len(particles) else np.full(len(tracks), -1),
        "purity": np.divide(own, hits, out=none.copy(), where=hits > 0),
        "efficiency": np.divide(found, left.take(of), out=none.copy(), where=known) if len(particles) else none,
    }
    decayed = np.append(particles["status"] == _core.TransportStatus.decayed, False)
    columns["decayed"] = np.where(known, decayed.take(of), -1)
    columns |= compare(tracks, particles, row, compiled(load(detector)).field)
    return {"matches": Table("matches", columns, meta=tracks.meta, **tracks.cover)}


def compare(tracks: Table, particles: Table, row: Rows, field: _core.Field) -> dict[str, Floats]:
    """Return true parameters, residuals and pulls of tracks whose particles are known.

    Parameters
    ----------
    tracks, particles : Table
    row : ndarray, (tracks,) int64
        Row of the particle of each track; -1 none.
    field : _core.Field
        Field of the simulated detector.

    Returns
    -------
    dict of str to ndarray
        Columns truth_*, res_*, pull_* of the matches table; NaN where there is no particle.
    """
    truth = np.concatenate([helix.at_origin_in(particles, field), np.full((1, 5), np.nan)])[row]
    columns: dict[str, Floats] = {}
    quantities = [(name, truth[:, i]) for i, name in enumerate(helix.PARAMETERS)]
    for name, true in [*quantities, ("p", helix.momentum(truth))]:
        residual = tracks[name] - true
        if name == "phi0":
            residual = np.remainder(residual + np.pi, 2 * np.pi) - np.pi
        columns |= {f"truth_{name}": true, f"res_{name}": residual, f"pull_{name}": residual / tracks[f"err_{name}"]}
    return columns


def joined(tracks: Table, matches: Table) -> Table:
    """Return the tracks with the columns of their matches.

    Parameters
    ----------
    tracks, matches : Table
    """
    return tracks.with_columns(**{name: matches[name] for name in matches if name not in ("event", "track")})


def _row_problems(
    tracks: Table, candidates: Table, candidate_hits: Table, clusters: Table, wire_hits: Table
) -> list[str]:
    """Say which tracks and hits count rows that are not there."""
    view, row = candidate_hits["view"], candidate_hits["row"]
    of_wire = view == HIT_WIRE
    checks = [
        ("tracks", "candidate", tracks["candidate"], len(candidates), "rows of candidates", True),
        ("candidate_hits", "candidate", candidate_hits["candidate"], len(candidates), "rows of candidates", True),
        ("candidate_hits", "view", view, HIT_XV + 1, "views", True),
        ("candidate_hits", "row", row, len(clusters), "rows of clusters", ~of_wire),
        ("candidate_hits", "row", row, len(wire_hits), "rows of wire_hits", of_wire),
    ]
    problems = []
    for table, name, values, n, of, where in checks:
        wrong = np.flatnonzero(((values < 0) | (values >= n)) & where)
        if len(wrong):
            problems.append(
                f"{table} row {wrong[0]}: {name}: got {values[wrong[0]]}, expected 0 to {n} (excluded), {of}"
            )
    return problems


def _owners(particles: Table, link: Rows, truths: Table) -> tuple[Rows, Flags]:
    """Row of the particle behind each row of a table that links to truths (-1: none); whether a daughter left it."""
    position = np.where(link >= 0, link, -1)
    owner: Rows = np.append(particle_rows(particles, truths), -1).take(position)
    late: Flags = np.append(truths["daughter"] > 0, False).take(position)
    return owner, late


def _other(link: Rows, truths: Table) -> Flags:
    """Whether a daughter, or another half turn than the first, is behind each row of a table that links to truths."""
    other = (truths["daughter"] > 0) | (truths["half_turn"] != 0)
    position = np.where(link >= 0, link, -1)
    flags: Flags = np.append(other, False).take(position)
    return flags


def _pick(candidate_hits: Table, of_cluster: npt.NDArray[Scalar], of_wire: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
    """Value behind each hit of the candidates, from the values of all clusters and wire hits."""
    wire = candidate_hits["view"] == HIT_WIRE
    joined_rows = candidate_hits["row"] + np.where(wire, len(of_cluster), 0)
    picked: npt.NDArray[Scalar] = np.concatenate([of_cluster, of_wire]).take(joined_rows)
    return picked


def _hits_left(clusters: Table, of_cluster: Rows, of_wire: Rows, n: int) -> Rows:
    """How many X clusters, V clusters and wire hits each of n particles left."""
    view = clusters["view"]
    # An XV cluster counts only where the table holds no X or V cluster of its strips.
    weight = np.where(view == XV_CLUSTER, np.where(clusters["x_cluster"] < 0, 2, 0), 1)
    known, on_wire = of_cluster >= 0, of_wire >= 0
    left = np.bincount(of_cluster[known], weight[known], minlength=n) + np.bincount(of_wire[on_wire], minlength=n)
    return np.asarray(np.maximum(left, 1).astype(np.int64))


def _most_common(owner: Rows, weight: Rows, candidate: Rows, n: int) -> tuple[Rows, Rows, Rows]:
    """Return for each of n candidates the most common owner of its hits (-1: none), its hits there, and all hits."""
    if np.any(candidate[1:] < candidate[:-1]):
        order = np.argsort(candidate, kind="stable")
        owner, weight, candidate = owner[order], weight[order], candidate[order]
    hits = np.bincount(candidate, weight, minlength=n).astype(np.int64)
    best, own = np.full(n, -1), np.zeros(n, np.int64)
    first = np.flatnonzero(np.diff(candidate, prepend=-1))
    if not len(first):
        return best, own, hits
    which = candidate[first]
    least, most = np.minimum.reduceat(owner, first), np.maximum.reduceat(owner, first)
    pure = least == most  # usually all of them
    best[which[pure]] = least[pure]
    own[which[pure]] = np.where(least[pure] >= 0, hits[which[pure]], 0)
    mixed = np.zeros(n, np.bool_)
    mixed[which[~pure]] = True
    rows = np.flatnonzero(mixed[candidate] & (owner >= 0))
    width = int(owner.max(initial=0)) + 1
    pairs, place = np.unique(candidate[rows] * width + owner[rows], return_inverse=True)
    counts = np.bincount(place, weight[rows], minlength=len(pairs)).astype(np.int64)
    order = np.lexsort((pairs, -counts, pairs // width))
    chosen = order[np.diff(pairs[order] // width, prepend=-1) != 0]
    best[pairs[chosen] // width], own[pairs[chosen] // width] = pairs[chosen] % width, counts[chosen]
    return best, own, hits
