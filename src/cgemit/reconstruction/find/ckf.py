"""Track finding without truth: combinatorial Kalman filter and its settings (docs/methods/find.md)."""

from __future__ import annotations

import enum
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Column
from cgemit.base.errors import report
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Check, Momentum, Quantity, Whole
from cgemit.detector import Detector, WireLayer, compiled, load
from cgemit.detector.channels import checked
from cgemit.particles.species import Species, hypothesis_name, hypothesis_of, is_hypothesis
from cgemit.reconstruction.fit import FitSettings, compiled_matter
from cgemit.reconstruction.states import USUAL_MOMENTUM
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, HIT_XV, XV_CLUSTER

Method = Literal["combined", "segments", "chamber"]

Count = Annotated[int, Whole(1, 1000)]
Few = Annotated[int, Whole(1, 50)]
Layers = Annotated[int, Whole(4, 60)]
Gate = Annotated[float, Quantity(low=2, high=20)]
Efficiency = Annotated[float, Quantity(low=0.5, high=1, below=True)]
Score = Annotated[float, Quantity()]
ParticleName = Annotated[str, Check(is_hypothesis, "e, mu, pi, K, p, or the name of another charged particle")]
Length = Annotated[float, Quantity("length", 0, 2000, above=True)]


@dataclass(frozen=True, kw_only=True)
class FindSettings(SettingsData):
    """How tracks are found (docs/methods/find.md).

    Attributes
    ----------
    method : str
        Source of the seeds: ``"segments"`` of the CGEM, circles in the drift ``"chamber"``, or ``"combined"``:
        segments, then circles from the remaining hits. A track may have hits of all layers.
    hypothesis : str or None
        Particle whose mass and charge the finder assumes and the candidates have: ``"e"``, ``"mu"``, ``"pi"``, ``"K"``,
        ``"p"``, or the name of another charged particle. None: in `run` the particle of the gun, sample or table, if
        all charged ones are of one kind, else ``"mu"``.
    efficiency : float
        Probability that a crossed layer or cell has its hit.
    gate : float
        Largest distance of a hit from the prediction, in standard deviations.
    branches : int
        Branches of a seed that are kept at a time.
    passes : int
        Most passes of the filter over a track.
    holes_in_row : int
        A branch ends after more missing hits in a row.
    max_d : float
        mm, largest distance of a track from the beam line.
    max_z : float
        mm, largest distance of this point from the origin along the beam line.
    min_pt : float
        GeV/c, smallest transverse momentum of a seed.
    least_axial : int
        Layers of axial wires and X clusters that a seed of the chamber needs; without axial wires, layers of each sign
        of the stereo angle.
    min_score : float
        Threshold of the score of a track, the logarithm of its likelihood ratio to foreign hits. Higher: fewer fakes,
        lower efficiency. A track of n hits needs `min_score` + 2.5 n, and 4 more if n < 6 (in a detector of three CGEM
        layers alone, `min_score`).
    max_seeds : int
        Most seeds that are followed in an event, of each source, the best first.
    annealing : bool
        Whether a wire hit near several tracks is assigned to the one that it fits best.
    momentum : float or None
        GeV/c, with which tracks scatter in fields below 20 mT, which do not tell their momenta (docs/methods/find.md).
        None: that of the fit, or the gun's, in `run`, else 1 GeV/c.

    Raises
    ------
    ValueError
        Listing every invalid value.

    Examples
    --------
    >>> settings = cg.Settings(find=cg.FindSettings(min_pt=0.05))
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5, finder="ckf", settings=settings)
    >>> len(result.tracks)
    5
    """

    method: Method = "combined"
    hypothesis: ParticleName | None = None
    efficiency: Efficiency = 0.97
    gate: Gate = 4.5
    branches: Few = 5
    passes: Few = 8
    holes_in_row: Few = 5
    max_d: Length = 200.0
    max_z: Length = 400.0
    min_pt: Momentum = 0.03
    least_axial: Layers = 6
    min_score: Score = 2.0
    max_seeds: Count = 200
    annealing: bool = True
    momentum: Momentum | None = None


class SearchLimits(enum.IntFlag):
    """Limits that the search for the tracks of an event has reached (docs/methods/find.md); 0 is good."""

    segments = 1
    circles = 2
    boxes = 4
    local = 8
    heights = 16
    layers = 32
    failures = 64


#: Limits behind which tracks may be left. Circles are tried in the order of their layers: `failures` is how a search
#: ends that has found its tracks.
BEYOND = ~SearchLimits.failures


#: Layers with X and V that a segment needs, one at most between them, and layers along the beam that a line needs.
_TWO = 2


class SeedLayers(NamedTuple):
    """Layers of a detector, or those in which each of some particles left measurements.

    Attributes
    ----------
    points : ndarray, (n, layers) bool
        Layers with both X and V; `layers` are those of the detector without wires.
    across, along : ndarray, (n,) int64
        Layers with axial wires or X, and with stereo wires or V.
    signs : ndarray, (n, 2) int64
        Layers with stereo wires of positive and of negative twist.
    """

    points: Column
    across: Column
    along: Column
    signs: Column


def have_seeds(detector: Detector, layers: SeedLayers, settings: FindSettings) -> tuple[Column, Column]:
    """Return which sets of layers make a seed of the finder: a segment, circles; both (n,) bool.

    Segments need X and V in two layers with one between them at most, circles as many layers across the beam as
    where no cell fires by chance and two along it. With fewer axial layers than of each stereo sign, or none, a circle
    of each sign makes a seed, too.
    """
    points = layers.points
    pairs = np.array(_core.reconstruction.segment_pairs(compiled(detector)), np.int64).reshape(-1, 2)
    segments = np.any(points[:, pairs[:, 0]] & points[:, pairs[:, 1]], axis=1) & (settings.method != "chamber")
    circles = (layers.across >= _circle_layers(detector, settings)) & (layers.along >= _TWO)
    least = _view_layers(detector, settings)
    if least is not None:
        circles |= np.all(layers.signs >= least, axis=1)
    return segments, circles & (settings.method != "segments")


def _circle_layers(detector: Detector, settings: FindSettings) -> int:
    return _core.reconstruction.circle_layers(compiled(detector), least_axial=settings.least_axial)


def _view_layers(detector: Detector, settings: FindSettings) -> Column | None:
    """Return how many layers of each stereo sign make a circle, (2,) int64; None where there are as many axial ones."""
    twist = np.array([layer.twist for layer in wire_layers(detector)])
    signs = (int(np.count_nonzero(twist > 0)), int(np.count_nonzero(twist < 0)))
    axial = len(twist) - sum(signs)
    if len(twist) == 0 or (axial > 0 and axial >= min(signs)):
        return None
    return np.array([_core.reconstruction.view_layers(layers=n, least_axial=settings.least_axial) for n in signs])


def seedless(detector: Detector, settings: FindSettings | None = None) -> str:
    """Return in which layers of a detector no track of `find_tracks` can begin, as text; empty if all make seeds.

    Returns
    -------
    str
        That no track can begin anywhere, or that wires make no seeds, and what is missing.
    """
    settings = FindSettings.of(settings)
    wires, views = wire_layers(detector), [layer.views for layer in detector.layers]
    x, v = (np.array([name in one for one in views], np.bool_) for name in "XV")
    # Of straight tracks from the origin: where all layers are about z = 0, one across the beam crosses all of them.
    places = [(*one.ends, one.r_mid) for one in detector.layers] + [(*one.ends, one.r_mid) for one in wires]
    low, high, r = np.array(places).reshape(-1, 3).T
    slope = np.append(low / r, 0.0)[:, None]
    crossed, on_wires = np.split((low / r <= slope) & (slope < high / r), [len(views)], axis=1)
    twist = np.sign([layer.twist for layer in wires])
    axial, up, down = (on_wires[:, twist == sign].sum(axis=1) for sign in (0, 1, -1))
    on_x, on_v = axial + crossed[:, x].sum(axis=1), up + down + crossed[:, v].sum(axis=1)
    sets = SeedLayers(crossed & x & v, on_x, on_v, np.stack([up, down], axis=1))
    segments, circles = (bool(one.any()) for one in have_seeds(detector, sets, settings))
    across, along, plus, minus = (int(one.max()) for one in (on_x, on_v, up, down))
    if circles or (segments and not wires):
        return ""
    least = _circle_layers(detector, settings)
    lacks = [f"{least} layers with axial wires or X (got {across})"] * (across < least)
    lacks += [f"{_TWO} layers with stereo wires or V (got {along})"] * (along < _TWO)
    by_sign, signs = _view_layers(detector, settings), ""
    if by_sign is not None and not (plus >= by_sign[0] and minus >= by_sign[1]):
        signs = f", or {by_sign[0]} and {by_sign[1]} of positive and negative stereo angle (got {plus} and {minus})"
    elif by_sign is not None:
        lacks = []
    needs = f"circles need {' and '.join(lacks)}{signs}" if lacks else "find.method leaves out circles"
    if segments:
        labels = ", ".join(layer.label for layer, one in zip(detector.layers, x & v, strict=True) if one)
        return f"no track begins in wires alone: it needs X and V in two of {labels}, since {needs}"
    none = settings.method == "chamber"
    pairs = "find.method leaves out segments" if none else "segments need X and V in two layers, one apart at most"
    return f"{_NOWHERE}: {needs}, and {pairs}"


_NOWHERE = "no track can begin"


def warn_of_no_seeds(detector: Detector, settings: FindSettings) -> None:
    """Warn if no track can begin in any layers of a detector."""
    text = seedless(detector, settings)
    if text.startswith(_NOWHERE):
        warnings.warn(f"{detector.name}: finder ckf: {text}", stacklevel=3)


def wire_layers(detector: Detector) -> tuple[WireLayer, ...]:
    """Return the layers of the drift chamber; none without one."""
    return detector.drift_chamber.layers if detector.drift_chamber else ()


@checked("clusters", "wire_hits", ignore=("gid",))
def find_tracks(
    detector: Detector | str | Mapping[str, Any],
    clusters: Table,
    wire_hits: Table,
    settings: FindSettings | None = None,
    *,
    fit: FitSettings | None = None,
) -> dict[str, Table]:
    """Find the tracks of each event from its clusters and wire hits; links to truths are not read.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
        Field and material that the finder assumes.
    clusters, wire_hits : Table
        Of the same events, in any order within an event.
    settings : FindSettings or None
    fit : FitSettings or None
        Of the fit of the candidates. The finder assumes its matter (`screening`, `loss`, `momentum_error`, `radiation`,
        `matter`) and its errors of clusters (`cluster_errors`, `least_width`, `delta_strips`).

    Returns
    -------
    dict of str to Table
        ``candidates``, the best one of an event first, ``candidate_hits`` and ``searches``.

    Raises
    ------
    TypeError
        If the settings are something else.
    ValueError
        Listing every problem of the tables or their hits.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    >>> found = cg.find_tracks(r.detector, r.clusters, r.wire_hits)
    >>> found["candidates"]["event"].tolist()
    [0, 1, 2, 3, 4]
    """
    detector, settings, fit = load(detector), FindSettings.of(settings), FitSettings.of(fit, "fit")
    if not clusters.covers_as(wire_hits):
        report("find_tracks", ["wire_hits: cover other events than the clusters; expected the same"])
    event, view, hits, points, hit_of = _measurements(clusters, wire_hits, by_size=fit.cluster_errors == "track")
    order = np.argsort(event, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    points, hit_of = _Points(points.row, rank[points.x], rank[points.v]), np.where(hit_of < 0, -1, rank[hit_of])
    offsets = np.searchsorted(event[order], np.append(clusters.events, np.iinfo(np.int64).max)).astype(np.int64)
    hits = {name: np.ascontiguousarray(column[order]) for name, column in hits.items()}
    core, weak = compiled_matter(detector, fit), abs(detector.field.bz) < _WEAK_FIELD
    out = _core.reconstruction.find_tracks(
        core.in_field(math.copysign(_FIELD, detector.field.bz)) if weak else core, event_offsets=offsets, hits=hits,
        settings=_core_settings(settings, fit, weak), pairs=_pairs(detector, clusters, hit_of, points),
    )  # fmt: skip
    return _tables(out, clusters, view[order], hits["hit"], points, settings)


#: T. A weaker field does not tell the momentum of a track. The finder then scales it to the other one: the tracks are
#: the same, with another kappa, and search and priors are those of a common field.
_WEAK_FIELD, _FIELD = 0.02, 1.0


#: Assumed where neither the settings nor the source of the particles tell it.
_USUAL = "mu"


def _kind(settings: FindSettings) -> Species:
    """Return the particle that the finder assumes."""
    return hypothesis_of(settings.hypothesis or _USUAL)


def _core_settings(settings: FindSettings, fit: FitSettings, weak: bool) -> dict[str, Any]:
    """Return the fields of the core's settings."""
    values = {field.name: getattr(settings, field.name) for field in fields(settings)}
    method, kind = values.pop("method"), _kind(settings)
    del values["hypothesis"]
    return values | {
        "segments": method in ("combined", "segments"), "chamber": method != "segments",
        "mass": kind.mass, "charge": float(abs(kind.charge)),
        "momentum": (settings.momentum or fit.momentum or USUAL_MOMENTUM) if weak else 0.0,
        "least_width": fit.least_width, "delta_strips": fit.delta_strips,
    }  # fmt: skip


class _Points(NamedTuple):
    """XV clusters whose X and V are in no rows of their own: row, and numbers of X and V among the measurements."""

    row: Column
    x: Column
    v: Column


#: X of several points that differ by less are one cluster, mm, and V: far below a pitch, above the rounding of files.
_SAME = 0.01


def _measurements(
    clusters: Table, wire_hits: Table, *, by_size: bool
) -> tuple[Column, Column, dict[str, Column], _Points, Column]:
    """Return event, view in `candidate_hits`, and columns of all measurements: X, V, and wires; points; and numbers.

    An XV cluster is left out if its X and V clusters are in the table. Otherwise it is a point, whose X and V may be
    those of others, too: each is one measurement, as is a cluster that is given twice. The numbers are those of the
    measurements of X and V clusters, (clusters,) int64. `by_size`: errors of clusters of strips follow from their size.
    """
    points = (clusters["view"] == XV_CLUSTER) & (clusters["x_cluster"] < 0)
    size = clusters["size"] * (clusters["method"] == 0) * (clusters["view"] != XV_CLUSTER) * by_size
    x, v = (np.flatnonzero((clusters["view"] == view) | points) for view in (HIT_X, HIT_V))
    (first_x, of_x), (first_v, of_v) = (
        _merged(clusters, rows, points[rows], size[rows], name) for rows, name in ((x, "x"), (v, "v"))
    )
    hit_of = np.full((2, len(clusters)), -1)
    hit_of[HIT_X, x], hit_of[HIT_V, v] = of_x, of_v + len(first_x)
    rows = np.flatnonzero(points)
    _, once = np.unique(hit_of[:, rows], axis=1, return_index=True)
    of_points = _Points(rows[once], *hit_of[:, rows[once]])
    x, v = x[first_x], v[first_v]
    strips = np.concatenate([x, v])
    kind = np.repeat([HIT_X, HIT_V], [len(x), len(v)])
    n = len(wire_hits)

    def both(of_strips: Column, of_wires: Column, dtype: str) -> Column:
        return np.concatenate([of_strips, of_wires]).astype(dtype)

    hits = {
        "kind": both(kind, np.full(n, HIT_WIRE), "u1"),
        "layer": both(clusters["layer"][strips], wire_hits["layer"], "i4"),
        "channel": both(clusters["sheet"][strips], wire_hits["wire"], "i4"),
        "size": both(size[strips], np.zeros(n), "i4"),
        "value": both(np.concatenate([clusters["x"][x], clusters["v"][v]]), wire_hits["drift"], "f8"),
        "sigma": both(np.concatenate([clusters["err_x"][x], clusters["err_v"][v]]), wire_hits["sigma"], "f8"),
        "hit": both(strips, np.arange(n), "i8"),
    }
    view = both(np.where(points[strips], HIT_XV, kind), np.full(n, HIT_WIRE), "i1")
    event = both(clusters["event"][strips], wire_hits["event"], "i8")
    return event, view, hits, of_points, np.where(points, -1, hit_of.max(axis=0))


def _merged(clusters: Table, rows: Column, points: Column, size: Column, name: str) -> tuple[Column, Column]:
    """Return the first of the rows of each measurement of one view, and the measurement of each row, both int64."""
    value, sigma = clusters[name][rows], clusters[f"err_{name}"][rows]
    keys = (size, points, clusters["sheet"][rows], clusters["layer"][rows], clusters["event"][rows])
    order = np.lexsort((sigma, value, *keys))
    new = np.ones(len(rows), np.bool_)
    if len(rows):
        near = np.where(points[order][1:], _SAME, 0.0)
        new[1:] = ~(np.diff(value[order]) <= near) | ~(np.abs(np.diff(sigma[order])) <= near)
        for key in keys:
            new[1:] |= key[order][1:] != key[order][:-1]
    hit_of = np.empty(len(rows), np.int64)
    hit_of[order] = np.cumsum(new) - 1
    return order[new], hit_of


def _pairs(detector: Detector, clusters: Table, hit_of: Column, points: _Points) -> dict[str, Column]:
    """Return the scores of XV clusters with the numbers of their X and V among the measurements, if there are any.

    Sensors of `[layer.NAME]` measure points: their pairs are certain, with a score of infinity.
    """
    of_points = np.array([layer.measures_points for layer in detector.layers], bool)
    certain = of_points[clusters["layer"]]
    score = np.where(certain, np.inf, np.nan_to_num(clusters["score"]))
    pairs = np.flatnonzero((score != 0) & (clusters["view"] == XV_CLUSTER) & (clusters["x_cluster"] >= 0))
    certain_rows = np.flatnonzero(certain[points.row])
    x, v = (hit_of[clusters[name][pairs]] for name in ("x_cluster", "v_cluster"))
    scores = np.concatenate([score[pairs], np.full(len(certain_rows), np.inf)])
    return {"x": np.append(x, points.x[certain_rows]), "v": np.append(v, points.v[certain_rows]), "score": scores}


def _rejoined(candidate: Column, hit: Column, points: _Points, n: int) -> Column:
    """Return the row of the point that a candidate has of each X of its points, -1 for V, and where it has no V to it.

    Parameters
    ----------
    candidate, hit : ndarray, (hits,) int64
        Candidate and measurement, X or V of a point.
    points : _Points
    n : int
        Number of measurements.
    """
    order = np.argsort(points.x, kind="stable")
    begin, end = (np.searchsorted(points.x, hit, side=side, sorter=order) for side in ("left", "right"))
    which = np.repeat(np.arange(len(hit)), end - begin)
    at = order[begin[which] + np.arange(len(which)) - np.searchsorted(which, which)]
    both = np.isin(candidate[which] * n + points.v[at], candidate * n + hit)
    row = np.full(len(hit), -1)
    row[which[both]] = points.row[at[both]]
    return row


def _tables(
    out: dict[str, Column], clusters: Table, view: Column, row: Column, points: _Points, settings: FindSettings
) -> dict[str, Table]:
    """Return the tables of the finder; `view` and `row` of each measurement."""
    event = clusters.events[out["event"]]
    n = len(event)
    kind = _kind(settings)
    candidates = {
        "event": event, "candidate": np.arange(n) - np.searchsorted(event, event),
        "pdg": np.full(n, abs(kind.pdg)), "mass": np.full(n, kind.mass), "charge": np.full(n, abs(kind.charge)),
    }  # fmt: skip
    candidate = np.repeat(np.arange(n), np.diff(out["offsets"]))
    of_points = np.flatnonzero(view[out["hits"]] == HIT_XV)
    measurements = len(row)
    view, row = view[out["hits"]], row[out["hits"]]
    row[of_points] = _rejoined(candidate[of_points], out["hits"][of_points], points, measurements)
    once = row >= 0
    hits = {"event": event[candidate[once]], "candidate": candidate[once], "view": view[once], "hit": row[once]}
    cover = clusters.cover | {"meta": {"finder": "ckf", "hypothesis": hypothesis_name(kind.pdg)}}
    return {
        "candidates": Table("candidates", candidates, **cover),
        "candidate_hits": Table("candidate_hits", hits, **cover),
        "searches": Table(
            "searches", {"event": clusters.events, "seeds": out["seeds"], "limits": out["limits"]}, **cover
        ),
    }
