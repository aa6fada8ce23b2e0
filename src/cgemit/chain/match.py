"""Match of tracks to particles: purity, efficiency, true parameters, residuals and pulls (docs/methods/match.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.detector import Detector, compiled, load
from cgemit.reconstruction.candidates import HIT_WIRE, HIT_XV
from cgemit.reconstruction.find.truth import link_problems
from cgemit.tables import Table
from cgemit.tables.table import kind_problems

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]


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
    it belongs to the first one in the table of particles. An XV cluster counts as two hits, its X and its V cluster.
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
    hits = _core.match_hits(
        particles=dict(particles.columns), truths=dict(truths.columns), wire_truths=dict(wire_truths.columns),
        clusters=dict(clusters.columns), wire_hits=dict(wire_hits.columns),
        candidate_hits=dict(candidate_hits.columns), candidates=len(candidates),
    )  # fmt: skip
    row, own, total, found = (hits[name][tracks["candidate"]] for name in ("particle", "own", "hits", "found"))
    known = row >= 0
    of = np.where(known, row, 0)
    none = np.full(len(tracks), np.nan)
    columns = {
        "event": tracks["event"],
        "track": np.arange(len(tracks)),
        "particle": np.where(known, particles["particle"].take(of), -1) if len(particles) else np.full(len(tracks), -1),
        "purity": np.divide(own, total, out=none.copy(), where=total > 0),
        "efficiency": np.divide(found, hits["left"].take(of), out=none.copy(), where=known) if len(particles) else none,
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
    n, limits = len(candidates), [len(clusters)] * (HIT_XV + 1)
    limits[HIT_WIRE] = len(wire_hits)
    of_candidates = (table["candidate"] for table in (tracks, candidate_hits))
    if all(_core.outside(numbers, [n]) < 0 for numbers in of_candidates) and _core.outside(row, limits, view) < 0:
        return []
    of_wire = view == HIT_WIRE
    checks = [
        ("tracks", "candidate", tracks["candidate"], n, "rows of candidates", True),
        ("candidate_hits", "candidate", candidate_hits["candidate"], n, "rows of candidates", True),
        ("candidate_hits", "view", view, HIT_XV + 1, "views", True),
        ("candidate_hits", "row", row, len(clusters), "rows of clusters", ~of_wire),
        ("candidate_hits", "row", row, len(wire_hits), "rows of wire_hits", of_wire),
    ]
    problems = []
    for table, name, values, limit, of, where in checks:
        wrong = np.flatnonzero(((values < 0) | (values >= limit)) & where)
        if len(wrong):
            problems.append(
                f"{table} row {wrong[0]}: {name}: got {values[wrong[0]]}, expected 0 to {limit} (excluded), {of}"
            )
    return problems
