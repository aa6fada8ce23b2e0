"""Competition of X and V clusters for the tracks that cross a layer (docs/methods/reconstruct.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats
from cgemit.detector import Detector
from cgemit.detector.layers.layer import Layer, local_v
from cgemit.detector.parts import cgem_numbers
from cgemit.helix import wrap_angle
from cgemit.reconstruction.fit import FitSettings, fit
from cgemit.reconstruction.refine import MOST_CHI2
from cgemit.reconstruction.states import crossings_of
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, HIT_XV, XV_CLUSTER, is_fitted

#: Turns over all layers.
TURNS = 3
#: Probability that a crossed layer has the cluster of a view, as the finder assumes it.
EFFICIENCY = 0.97
#: Largest distance of X and of V from the track without the layer, in its errors.
GATE = 5.0
#: What a cluster of another track costs: one in 20 holds the charge of two particles of an event.
SHARED = 3.0
#: mm. A track whose crossing is known worse keeps its clusters as they were found, and clusters with larger errors,
#: such as single strips near the threshold at the end of a layer, measure nothing.
WORST = 20.0
#: Growth of chi-square by which a fit without the layer has found another track.
WORSE = 1.0
#: ln(likelihood ratio) to the best other choice below which a cluster on a track is ambiguous, and to none which a
#: choice needs: odds of 20.
CERTAIN = 3.0


def settle_points(
    detector: Detector, clusters: Table, wire_hits: Table, found: Mapping[str, Table], settings: FitSettings
) -> dict[str, Table]:
    """Let the X and V clusters of each CGEM layer compete for the tracks that cross it.

    A track is fitted without the clusters of the layer; one with a bad chi-square keeps its clusters. Each X and V of
    the sheet that it crosses, alone or as a pair, and none, is a choice; the likeliest one counts. A cluster that
    another track has taken, with a larger gain, is less likely. Other layers follow with the new clusters, until no
    choice changes.

    Parameters
    ----------
    detector : Detector
    clusters, wire_hits : Table
    found : mapping of str to Table
        ``candidates`` and ``candidate_hits``.
    settings : FitSettings

    Returns
    -------
    dict of str to Table
        The same with other ``candidate_hits``, which have two columns more: `margin`, ln(likelihood ratio) of the
        choice to the best one without this cluster, NaN for wires and crossings that are not known, and `ambiguous`, 1
        below a margin of 3.
    """
    candidates, hits = found["candidates"], found["candidate_hits"]
    single = settings.hypothesis if len(settings.hypotheses()) == 1 else None
    settings = replace(settings, residuals=False, states=(), components=False, beam=None, hypothesis=single)
    hits = hits.with_columns(margin=np.full(len(hits), np.nan))
    for _ in range(TURNS):
        before = _keys(hits)
        for number in cgem_numbers(detector):
            hits = _settled_layer(detector, number, clusters, wire_hits, candidates, hits, settings)
        if _keys(hits) == before:
            break
    ambiguous = (hits["margin"] < CERTAIN).astype(np.int8)
    return {**found, "candidate_hits": hits.with_columns(ambiguous=ambiguous)}


def _keys(hits: Table) -> set[tuple[int, int, int]]:
    return set(zip(*(hits[name].tolist() for name in ("candidate", "view", "hit")), strict=True))


class _Choice(NamedTuple):
    """Clusters of one layer for a track: rows of X and V, -1 none, and the gain over none, a ln(likelihood ratio)."""

    gain: float
    x: int
    v: int

    @property
    def rows(self) -> set[int]:
        return {row for row in (self.x, self.v) if row >= 0}


def _settled_layer(
    detector: Detector, number: int, clusters: Table, wire_hits: Table, candidates: Table, hits: Table,
    settings: FitSettings,
) -> Table:  # fmt: skip
    """Return the hits of candidates with the clusters of one layer chosen anew."""
    of_layer = np.append(clusters["layer"] == number, False)
    on_layer = of_layer[np.where(hits["view"] != HIT_WIRE, hits["hit"], -1)]
    here = on_layer & (hits["view"] != HIT_XV)
    points = set(hits["candidate"][on_layer & (hits["view"] == HIT_XV)].tolist())  # measured as such: they stay
    whole, tracks = (
        fit.unchecked(detector, clusters, wire_hits, candidates, some, settings)["tracks"]
        for some in (hits, hits[~here])
    )
    # Fewer hits have a smaller chi-square, unless the sides of the wires are those of another track.
    same = ~is_fitted(whole) | (tracks["chi2"] <= whole["chi2"] + WORSE)
    same &= tracks["chi2"] <= MOST_CHI2 * tracks["ndf"]  # others tell no crossing
    known = np.flatnonzero(is_fitted(tracks) & np.isfinite(tracks["cov"]).all(axis=(1, 2)) & same)
    at = crossings_of(detector, tracks[known], number)
    layer, choices = detector.layers[number], dict[int, list[_Choice]]()
    rows = _rows_by_event(clusters, number)
    score = _scores(clusters, number)
    for i, track in enumerate(known[at.states["track"]].tolist()):
        if track not in points and np.sqrt(at.cov[i, [0, 1], [0, 1]].max()) < WORST:
            mine = rows.get(int(candidates["event"][track]), np.zeros(0, np.int64))
            choices[track] = _choices(layer, clusters, mine, at.phi[i], at.z[i], at.cov[i], score)
    taken = _shared_out(choices, candidates["event"])
    kept = hits[~(here & np.isin(hits["candidate"], list(choices)))]
    return _with_choices(kept, taken, choices, candidates)


def _rows_by_event(clusters: Table, number: int) -> dict[int, npt.NDArray[np.int64]]:
    """Return the rows of the X and V clusters of a layer by event."""
    rows = np.flatnonzero((clusters["layer"] == number) & (clusters["view"] != XV_CLUSTER))
    events, first = np.unique(clusters["event"][rows], return_index=True)
    return dict(zip(events.tolist(), np.split(rows, first[1:]), strict=True))


def _scores(clusters: Table, number: int) -> dict[tuple[int, int], float]:
    """Return the score of each pair of X and V that crosses on its sheet."""
    pairs = clusters[(clusters["layer"] == number) & (clusters["view"] == XV_CLUSTER) & (clusters["x_cluster"] >= 0)]
    columns = (pairs[name].tolist() for name in ("x_cluster", "v_cluster"))
    return dict(zip(zip(*columns, strict=True), np.nan_to_num(pairs["score"]).tolist(), strict=True))


def _choices(
    layer: Layer, clusters: Table, rows: npt.NDArray[np.int64], phi: float, z: float, cov: Floats,
    score: Mapping[tuple[int, int], float],
) -> list[_Choice]:  # fmt: skip
    """Return the choices of one crossing, the best first; none is always one of them."""
    width = 2 * np.pi * layer.r_readout / layer.sheets
    choices = [_Choice(0.0, -1, -1)]
    for sheet, start in enumerate(layer.sheet_phi):
        x = float(layer.r_readout * (wrap_angle(phi - start - np.pi / layer.sheets) + np.pi / layer.sheets))
        reach = GATE * math.sqrt(cov[0, 0]) + float(layer.pitch_x)
        if not -reach < x < width + reach:
            continue
        predicted = np.array([x, float(local_v(layer, x, z))])
        on_sheet = rows[clusters["sheet"][rows] == sheet]
        near: list[list[tuple[int, float, float, float]]] = []
        for view, name in enumerate("xv"):
            of_view = on_sheet[clusters["view"][on_sheet] == view]
            away, err = clusters[name][of_view] - predicted[view], clusters[f"err_{name}"][of_view]
            # A crossing has its cluster at a density of its own; foreign ones of the event are all over the sheet.
            gain = math.log(EFFICIENCY / (1 - EFFICIENCY)) - math.log(max(len(of_view), 1) / width)
            inside = (np.abs(away) < GATE * np.sqrt(cov[view, view] + err**2)) & (err < WORST)
            rows_here = zip(of_view[inside].tolist(), away[inside].tolist(), err[inside].tolist(), strict=True)
            near.append([(row, gain, one, sigma) for row, one, sigma in rows_here])
        for row, gain, distance, sigma in near[0]:
            choices.append(_Choice(gain + _log_normal(cov[0, 0] + sigma**2, distance), row, -1))
        for row, gain, distance, sigma in near[1]:
            choices.append(_Choice(gain + _log_normal(cov[1, 1] + sigma**2, distance), -1, row))
        for (i, gain_x, dx, ex), (k, gain_v, dv, ev) in product(*near):
            total, d = cov + np.diag([ex * ex, ev * ev]), np.array([dx, dv])
            chi2 = float(d @ np.linalg.solve(total, d))
            if chi2 < GATE * GATE and (i, k) in score:
                both = -0.5 * (chi2 + math.log(np.linalg.det(total))) - math.log(2 * math.pi)
                choices.append(_Choice(gain_x + gain_v + both + score[i, k], i, k))
    likely = [one for one in choices if one.gain > CERTAIN or not one.rows]
    return sorted(likely, key=lambda one: (-one.gain, one.x, one.v))


def _log_normal(variance: float, away: float) -> float:
    return -0.5 * (away * away / variance + math.log(2 * math.pi * variance))


def _shared_out(choices: Mapping[int, list[_Choice]], event: npt.NDArray[np.int64]) -> dict[int, _Choice]:
    """Return the choice of each track: the one with the larger gain comes first, and clusters of it cost the others."""
    taken: dict[int, _Choice] = {}
    of_event: dict[int, list[int]] = {}
    for track in choices:
        of_event.setdefault(int(event[track]), []).append(track)
    for tracks in of_event.values():
        used: set[int] = set()
        left = set(tracks)
        while left:
            best = {
                track: max(choices[track], key=lambda one: one.gain - SHARED * len(one.rows & used)) for track in left
            }
            track = min(left, key=lambda one: (-best[one].gain, one))
            taken[track] = best[track]
            used |= best[track].rows
            left.remove(track)
    return taken


def _with_choices(
    kept: Table, taken: Mapping[int, _Choice], choices: Mapping[int, list[_Choice]], candidates: Table
) -> Table:
    """Return the hits with those of the choices, by candidate."""
    more: list[tuple[int, int, int, float]] = []
    for track, choice in taken.items():
        for kind, cluster in ((HIT_X, choice.x), (HIT_V, choice.v)):
            if cluster >= 0:
                other = max(one.gain for one in choices[track] if cluster not in one.rows)
                more.append((track, kind, cluster, choice.gain - other))
    candidate, view, row, margin = (np.array(column) for column in (zip(*more, strict=True) if more else [[]] * 4))
    whole = candidate.astype(np.int64)
    added = {"event": candidates["event"][whole], "candidate": whole, "view": view, "hit": row, "margin": margin}
    columns = {name: np.concatenate([kept[name], added[name].astype(kept[name].dtype)]) for name in added}
    order = np.lexsort((columns["hit"], columns["view"], columns["candidate"]))
    return Table("candidate_hits", {n: c[order] for n, c in columns.items()}, meta=kept.meta, **kept.cover)
