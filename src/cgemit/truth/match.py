"""Match of tracks to particles: class, purity, true parameters, residuals and pulls (docs/methods/match.md)."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.base.arrays import Flags, Floats, Rows
from cgemit.detector import Detector, compiled, load
from cgemit.detector.channels import checked
from cgemit.tables import Table
from cgemit.tables.schema import HIT_WIRE, XV_CLUSTER, FitStatus, has_momentum, is_fitted
from cgemit.truth.assign import residuals
from cgemit.truth.origins import particle_rows

Statuses = npt.NDArray[np.int8]


class MatchStatus(enum.IntEnum):
    """Class of a candidate or track by its hits; 0 is the one that measures its particle.

    ``clone``: a further one of a particle. ``decay_daughter``: with hits mostly of the particle's charged daughters,
    a further one or one with too few hits of the particle itself. ``other_half_turn``: with hits mostly of other half
    turns than the first outward one. ``fake``: of no particle, or with too few hits of one. ``no_hits``: without
    hits.

    Examples
    --------
    >>> [status.name for status in cg.MatchStatus]
    ['matched', 'clone', 'decay_daughter', 'other_half_turn', 'fake', 'no_hits']
    """

    matched = 0
    clone = 1
    decay_daughter = 2
    other_half_turn = 3
    fake = 4
    no_hits = 5


class CandidateCounts(NamedTuple):
    """Numbers of hits of each candidate, all of shape (candidates,); an XV cluster counts as two.

    Attributes
    ----------
    particle : ndarray, int64
        Row of the particle with the most hits, daughters of its decays included; -1 without hits of a particle.
    hits : ndarray, int64
        All its hits.
    of_particle : ndarray, int64
        Hits of that particle and of its daughters, with clusters that it shares.
    of_daughters : ndarray, int64
        Hits of its daughters.
    of_loops : ndarray, int64
        Hits that the particle itself left on other half turns than the first.
    half_turn : ndarray, int8
        Half turn of most hits that the particle itself left; 0 without any.
    found : ndarray, int64
        Measurements of that particle itself on its first half turn: crossings of a gap, counted per view, and cells.
        A cluster of several particles counts for the one with the most charge.
    left : ndarray, int64
        Measurements that the particle left on its first half turn; 0 without a particle.
    """

    particle: Rows
    hits: Rows
    of_particle: Rows
    of_daughters: Rows
    of_loops: Rows
    half_turn: Statuses
    found: Rows
    left: Rows


def count_candidates(detector: Detector, tables: Mapping[str, Table]) -> CandidateCounts:
    """Return the hits of each candidate.

    Parameters
    ----------
    detector : Detector
    tables : mapping of str to Table
        candidates, candidate_hits, clusters, wire_hits, particles, truths and wire_truths.

    Raises
    ------
    ValueError
        If a hit of a candidate counts a row that is not there.
    """
    return _counts(detector, tables, _match_hits(tables))


def _match_hits(tables: Mapping[str, Table]) -> dict[str, npt.NDArray[Any]]:
    names = ("particles", "truths", "wire_truths", "clusters", "wire_hits", "candidate_hits")
    columns = {name: dict(tables[name].columns) for name in names}
    return _core.truth.match_hits(**columns, candidates=len(tables["candidates"]))


def _counts(detector: Detector, tables: Mapping[str, Table], of: Mapping[str, npt.NDArray[Any]]) -> CandidateCounts:
    shared = _shared(detector, tables, of["particle"])
    return CandidateCounts(
        of["particle"], of["hits"], of["own"] + of["of_daughters"] + shared, of["of_daughters"], of["of_loops"],
        of["half_turn"], of["crossings"], np.append(of["crossings_left"], 0)[of["particle"]],
    )  # fmt: skip


def _shared(detector: Detector, tables: Mapping[str, Table], best: Rows) -> Rows:
    """Return how many hits of each candidate are clusters of several crossings, one of them of its particle.

    The link of such a cluster names the crossing with the most charge only. Another one belongs to it if its point at
    mid-gap lies within the strips, or a pitch beside them.
    """
    clusters, truths, hits = (tables[name] for name in ("clusters", "truths", "candidate_hits"))
    several = (clusters["n_truths"] > 1) & (clusters["view"] < XV_CLUSTER)
    shared = np.zeros(len(best), np.int64)
    if not several.any() or not len(truths):
        return shared
    strips = np.flatnonzero(hits["view"] != HIT_WIRE)
    candidate, row = hits["candidate"][strips], hits["hit"][strips]
    chosen = several[row] & (best[candidate] >= 0)
    candidate, row = candidate[chosen], row[chosen]
    of_itself = (truths["daughter"] == 0) & (truths["half_turn"] == 0)
    owner = particle_rows(tables["particles"], truths)
    of_truth = np.where(of_itself, owner, -1)
    layers = len(detector.layers)
    key = of_truth * layers + truths["layer"]
    order = np.argsort(key, kind="stable")
    wanted = best[candidate] * layers + clusters["layer"][row]
    at = order[np.minimum(np.searchsorted(key, wanted, sorter=order), len(key) - 1)]
    link = clusters["truth"][row]
    # Hits whose link leads to the particle, its daughters or other half turns are counted already.
    other = (key[at] == wanted) & (np.where(link >= 0, owner[link], -1) != best[candidate])
    candidate, row, at = candidate[other], row[other], at[other]
    if len(row):
        covered = _covers(detector, clusters[row].with_columns(truth=at), truths)
        shared += np.bincount(candidate[covered], minlength=len(best))
    return shared


def _covers(detector: Detector, clusters: Table, truths: Table) -> Flags:
    """Tell which clusters hold the mid-gap point of the crossing that they link to, or end a pitch before it."""
    of_layer = np.array([layer.pitches for layer in detector.layers]).reshape(-1, 2)
    pitch = of_layer[clusters["layer"], clusters["view"]]
    off = np.abs(residuals(detector, clusters, truths, np.arange(len(clusters))))
    return np.asarray(off <= (0.5 * clusters["size"] + 1) * pitch)


def belle2(of: CandidateCounts) -> Statuses:
    """Return the `MatchStatus` of each candidate by the definition of Belle II, (candidates,) int8.

    A candidate is of a particle that left 2/3 of its hits, if it holds 1/20 of the particle's measurements. With fewer
    it is a decay product's if most of these hits are those of daughters.
    """
    is_pure = (of.particle >= 0) & (3 * of.of_particle >= 2 * of.hits) & (of.hits > 0)
    enough = (20 * of.found >= of.left) & ~((of.found == 0) & _daughters(of)) | _loops(of)
    classes = _classes(of, is_pure & enough)
    classes[is_pure & ~enough & _daughters(of)] = MatchStatus.decay_daughter
    return classes


def acts(of: CandidateCounts) -> Statuses:
    """Return the `MatchStatus` of each candidate by the definition of ACTS, (candidates,) int8.

    A candidate is of a particle that left half of its hits.
    """
    return _classes(of, (of.particle >= 0) & (2 * of.of_particle >= of.hits) & (of.hits > 0))


def _loops(of: CandidateCounts) -> Flags:
    """Return which candidates have most of their particle's hits on other half turns than the first."""
    return 2 * of.of_loops > of.of_particle


def _daughters(of: CandidateCounts) -> Flags:
    """Return which candidates have most of their particle's hits from its daughters."""
    return 2 * of.of_daughters > of.of_particle


def _classes(of: CandidateCounts, good: Flags) -> Statuses:
    """Return the class of each candidate; of several of a particle the one with most of its hits is matched."""
    classes = np.where(of.hits > 0, MatchStatus.fake, MatchStatus.no_hits).astype(np.int8)
    classes[good & _loops(of)] = MatchStatus.other_half_turn
    rows = np.flatnonzero(good & ~_loops(of))
    order = rows[np.lexsort((rows, -of.found[rows], of.particle[rows]))]
    first = np.diff(of.particle[order], prepend=-1) != 0
    classes[order] = np.where(_daughters(of)[order], MatchStatus.decay_daughter, MatchStatus.clone)
    classes[order[first]] = MatchStatus.matched
    return classes


@checked(
    "tracks", "candidates", "candidate_hits", "clusters", "wire_hits", "particles", "truths", "wire_truths",
    ignore=("gid",),
)  # fmt: skip
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
    components: Table | None = None,
) -> dict[str, Table]:
    """Find the particle of each track, and compare the track with it.

    A track belongs to the particle that most hits of its candidate come from. If several particles have as many hits,
    it belongs to the first one in the table of particles. An XV cluster counts as two hits, its X and its V cluster.
    Noise belongs to no particle. Hits of the charged daughters of a decay count as hits of the particle here, but
    neither in purity nor in efficiency. The efficiency counts the first half turn alone. The class of a track
    (`MatchStatus`) is that of `cgemit.study.finding` by the definition of Belle II.

    `other_mass` tells which tracks were fitted as another particle than theirs: their momenta and errors are those of
    that hypothesis.

    The true helix is the particle's where it started. A track of another half turn is not a measurement of it: it has
    no residuals and no pulls.

    Parameters
    ----------
    tracks, candidates, candidate_hits, clusters, wire_hits : Table
    particles, truths, wire_truths : Table
        Of the same events; links of `clusters` and `wire_hits` count rows of `truths` and `wire_truths`.
    detector : Detector, or what `load` accepts
        The simulated detector: its field bends the true helix.
    components : Table or None
        Densities of the momenta of electrons (``FitSettings(components=True)``), for `quantile_p`.

    Returns
    -------
    dict of str to Table
        ``matches``, one row per track; without a particle everything but `match`, `half_turn` and `purity` is -1 or
        NaN.

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
    chamber = load(detector)
    counts = _match_hits(tables)
    of_candidate = _counts(chamber, tables, counts)
    candidate = tracks["candidate"]
    row, pure, total, n_found = (counts[name][candidate] for name in ("particle", "own", "hits", "found"))
    known = row >= 0
    of = np.where(known, row, 0)
    none = np.full(len(tracks), np.nan)
    columns = {
        "event": tracks["event"],
        "track": np.arange(len(tracks)),
        "particle": np.where(known, particles["particle"].take(of), -1) if len(particles) else np.full(len(tracks), -1),
        "match": belle2(of_candidate)[candidate],
        "half_turn": of_candidate.half_turn[candidate],
        "purity": np.divide(pure, total, out=none.copy(), where=total > 0),
        "efficiency": (
            np.divide(n_found, counts["left"].take(of), out=none.copy(), where=known) if len(particles) else none
        ),
    }
    decayed = np.append(particles["status"] == _core.common.TransportStatus.decayed, False)
    columns["decayed"] = np.where(known, decayed.take(of), -1)
    other = tracks["hypothesis"] != np.append(np.abs(particles["pdg"]), 0).take(of)
    columns["other_mass"] = np.where(known, other, -1)
    comparison = compare(tracks, particles, row, compiled(chamber).field)
    comparison["quantile_p"] = quantiles(tracks, comparison["truth_p"], components)
    other = columns["match"] == MatchStatus.other_half_turn
    for name, values in comparison.items():
        columns[name] = values if name.startswith("truth_") else np.where(other, np.nan, values)
    return {"matches": Table("matches", columns, meta=tracks.meta, **tracks.cover)}


def compare(tracks: Table, particles: Table, row: Rows, field: _core.detector.Field) -> dict[str, Floats]:
    """Return true parameters, residuals and pulls of tracks whose particles are known.

    Parameters
    ----------
    tracks, particles : Table
    row : ndarray, (tracks,) int64
        Row of the particle of each track; -1 none.
    field : _core.detector.Field
        Field of the simulated detector.

    Returns
    -------
    dict of str to ndarray
        Columns truth_*, res_*, pull_* of the matches table; NaN where there is no particle.
    """
    truth = np.concatenate([helix.at_origin_in(particles, field), np.full((1, 5), np.nan)])[row]
    charge = np.append(particles["charge"], 0)[row]
    columns: dict[str, Floats] = {}
    quantities = [(name, truth[:, i]) for i, name in enumerate(helix.PARAMETERS)]
    for name, true in [*quantities, ("p", helix.momentum(truth, charge))]:
        residual = tracks[name] - true
        if name == "phi0":
            residual = helix.wrap_angle(residual)
        columns |= {f"truth_{name}": true, f"res_{name}": residual, f"pull_{name}": residual / tracks[f"err_{name}"]}
    return columns


def quantiles(tracks: Table, truth: Floats, components: Table | None = None) -> Floats:
    """Return the probability by the fit that momenta are below the true ones, (tracks,) float64.

    Without its components the density of an electron's momentum is not known: NaN. Inverse momenta of other tracks are
    normal.

    Parameters
    ----------
    tracks : Table
    truth : ndarray, (tracks,) float64, GeV/c
    components : Table or None
        Of these tracks.
    """
    p = tracks["p"]
    with np.errstate(divide="ignore", invalid="ignore"):
        below = _normal_below((1 - p / truth) * p / tracks["err_p"])
        change = np.log(truth / p)
    below = np.where(tracks["p_mode"] == p, below, np.nan)
    if components is not None and len(components):
        track = components["track"]
        parts = components["weight"] * _normal_below((change[track] - components["change"]) / components["spread"])
        rows = np.unique(track)
        below[rows] = np.bincount(track, parts, len(tracks))[rows].clip(0, 1)
    return np.asarray(below, np.float64)


def _normal_below(z: Floats) -> Floats:
    """Return the probability of a standard normal number below z, to 1e-7 (Abramowitz and Stegun, 26.2.17)."""
    a = np.abs(z)
    t = 1 / (1 + 0.2316419 * a)
    series = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = np.exp(-0.5 * a * a) * series / np.sqrt(2 * np.pi)
    return np.asarray(np.where(z > 0, 1 - tail, np.where(np.isnan(z), np.nan, tail)), np.float64)


def is_matched(tracks: Any) -> Flags:
    """Return which tracks measure their particle (`MatchStatus`), (tracks,) bool.

    Parameters
    ----------
    tracks : Table, or columns by name
        With the columns of their matches.
    """
    return np.asarray(tracks["match"] == MatchStatus.matched)


def measuring(tracks: Any) -> Flags:
    """Return which tracks were fitted and measure their particle, (tracks,) bool.

    Parameters
    ----------
    tracks : Table, or columns by name
        With the columns of their matches.
    """
    return is_fitted(tracks) & is_matched(tracks)


def counts_left_out(
    status: npt.NDArray[Any], match: npt.NDArray[Any] | None = None, fitted: Flags | None = None
) -> dict[str, int]:
    """Return how many tracks resolutions leave out, by `FitStatus` and, of those that were fitted, `MatchStatus`.

    Parameters
    ----------
    status, match : ndarray, (tracks,) int
        Without a truth, `match` is None.
    fitted : ndarray or None, (tracks,) bool
        Tracks whose status is no reason to leave them out; None: those of `has_momentum`.
    """
    fitted = has_momentum({"status": status}) if fitted is None else fitted
    codes, numbers = np.unique(status[~fitted], return_counts=True)
    names = {int(one): one.name for one in FitStatus}
    counts = {names.get(int(code), f"status {code}"): int(n) for code, n in zip(codes, numbers, strict=True)}
    if match is not None:
        others = (one for one in MatchStatus if one != MatchStatus.matched)
        counts |= {one.name: n for one in others if (n := int(np.count_nonzero(match[fitted] == one)))}
    return counts


def joined(tracks: Table, matches: Table) -> Table:
    """Return the tracks with the columns of their matches."""
    return tracks.with_columns(**{name: matches[name] for name in matches if name not in ("event", "track")})
