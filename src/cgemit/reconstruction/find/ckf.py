"""Track finding without truth: combinatorial Kalman filter and its settings (docs/methods/find.md)."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Check, Positive
from cgemit.detector import Detector, compiled, load
from cgemit.particles.species import HYPOTHESES, Hypothesis
from cgemit.reconstruction.candidates import HIT_V, HIT_WIRE, HIT_X, HIT_XV, XV_CLUSTER
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables import Table
from cgemit.tables.table import kind_problems

Method = Literal["combined", "segments", "chamber"]

_COUNT = "a whole number from {} to {}"
Count = Annotated[int, Check(lambda value: 1 <= value <= 1000, _COUNT.format(1, 1000))]
Few = Annotated[int, Check(lambda value: 1 <= value <= 50, _COUNT.format(1, 50))]
Layers = Annotated[int, Check(lambda value: 4 <= value <= 60, _COUNT.format(4, 60))]
Gate = Annotated[float, Check(lambda value: 2 <= value <= 20, "a number from 2 to 20 standard deviations")]
Efficiency = Annotated[float, Check(lambda value: 0.5 <= value < 1, "a probability from 0.5 to below 1")]
Score = Annotated[float, Check(math.isfinite, "a finite number")]
Length = Annotated[float, Check(lambda value: 0 < value <= 2000, "a length in mm, above 0, at most 2000")]


@dataclass(frozen=True, kw_only=True)
class FindSettings(SettingsData):
    """How tracks are found (docs/methods/find.md).

    Attributes
    ----------
    method : str
        Source of the seeds. ``"combined"``: CGEM segments, then circles in the drift chamber from the hits that are
        left. ``"segments"``: CGEM segments alone. ``"chamber"``: circles in the drift chamber alone; CGEM clusters
        join by the prediction of the track. In each case a track may have hits of all layers.
    hypothesis : str
        Particle whose mass the finder assumes, and which the candidates name for the fit.
    efficiency : float
        Probability that a layer or cell that a track crosses has its hit.
    gate : float
        A hit farther from the prediction is not tried, in standard deviations.
    branches : int
        Branches of a seed that are kept at a time.
    passes : int
        Passes of the filter over a track, each about the track that the last one found, as long as hits change.
    holes_in_row : int
        A branch ends after more missing hits than this, one after the other.
    max_d : float
        mm, largest distance of a track from the beam line at the closest approach.
    max_z : float
        mm, largest distance of this point from the origin along the beam line.
    min_pt : float
        GeV/c, smallest transverse momentum of a seed.
    least_axial : int
        Layers of axial wires and X clusters that a seed of the chamber needs.
    min_score : float
        Smallest logarithm of the likelihood ratio of a track to foreign hits, beyond 2.5 for each hit of a track that
        is followed. In a detector of three CGEM layers and nothing else, where no track is followed, without these 2.5.
    max_seeds : int
        Seeds of an event that are followed, of each source; the best ones come first.
    annealing : bool
        Whether a wire hit near several tracks is given to the one that it fits best, whichever was found first.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    method: Method = "combined"
    hypothesis: Hypothesis = "mu"
    efficiency: Efficiency = 0.97
    gate: Gate = 4.5
    branches: Few = 5
    passes: Few = 8
    holes_in_row: Few = 5
    max_d: Length = 200.0
    max_z: Length = 400.0
    min_pt: Positive = 0.03
    least_axial: Layers = 6
    min_score: Score = 2.0
    max_seeds: Count = 200
    annealing: bool = True


Column = npt.NDArray[Any]


class SearchLimits(enum.IntFlag):
    """Limits that the search for the tracks of an event has reached (docs/methods/find.md); 0 is good."""

    segments = 1
    circles = 2
    boxes = 4
    local = 8
    heights = 16
    layers = 32
    failures = 64


#: Limits behind which tracks may be left. Boxes and circles of the chamber are tried in the order of their layers, so
#: that a search which ends with `boxes` or `failures` has seen the best ones: it ends like this in usual background.
BEYOND = ~(SearchLimits.boxes | SearchLimits.failures)


def find_tracks(
    detector: Detector | str | Mapping[str, Any],
    clusters: Table,
    wire_hits: Table,
    settings: FindSettings | None = None,
) -> dict[str, Table]:
    """Find the tracks of each event from its clusters and wire hits; links to truths are not read.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
        Field and material that the finder assumes.
    clusters, wire_hits : Table
        Of the same events, in any order within an event.
    settings : FindSettings or None

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
    """
    detector, settings = load(detector), FindSettings() if settings is None else settings
    if not isinstance(settings, FindSettings):
        raise TypeError(f"settings: got {type(settings).__name__}, expected FindSettings")
    problems = kind_problems(clusters=clusters, wire_hits=wire_hits)
    if not problems and not np.array_equal(clusters.events, wire_hits.events):
        problems = ["wire_hits: cover other events than the clusters; expected the same"]
    if problems:
        raise ValueError("find_tracks:\n  " + "\n  ".join(problems))
    event, view, hits = _measurements(clusters, wire_hits)
    order = np.argsort(event, kind="stable")
    offsets = np.searchsorted(event[order], np.append(clusters.events, np.iinfo(np.int64).max)).astype(np.int64)
    found = _core.find_tracks(
        compiled(detector, gaps=False), event_offsets=offsets,
        hits={name: np.ascontiguousarray(column[order]) for name, column in hits.items()},
        settings=_core_settings(settings), pairs=_pairs(clusters, view[order], hits["row"][order]),
    )  # fmt: skip
    return _tables(found, clusters, view[order], hits["row"][order], settings)


def _core_settings(settings: FindSettings) -> dict[str, Any]:
    """Return the fields of the core's settings."""
    values, fit = {field.name: getattr(settings, field.name) for field in fields(settings)}, FitSettings()
    method, hypothesis = values.pop("method"), values.pop("hypothesis")
    return values | {
        "segments": method in ("combined", "segments"), "chamber": method != "segments",
        "mass": HYPOTHESES[hypothesis].mass, "least_width": fit.least_width, "delta_strips": fit.delta_strips,
    }  # fmt: skip


def _measurements(clusters: Table, wire_hits: Table) -> tuple[Column, Column, dict[str, Column]]:
    """Return event, view in `candidate_hits`, and columns of all measurements: X, V, and wires.

    An XV cluster is left out if its X and V clusters are in the table, and otherwise gives two measurements.
    """
    unknown = np.flatnonzero(~np.isin(clusters["view"], (HIT_X, HIT_V, XV_CLUSTER)))
    if len(unknown):
        view = clusters["view"][unknown[0]]
        raise ValueError(f"find_tracks: clusters row {unknown[0]}: view: got {view}, expected 0, 1 or 2")
    points = (clusters["view"] == XV_CLUSTER) & (clusters["x_cluster"] < 0)
    x = np.flatnonzero((clusters["view"] == HIT_X) | points)
    v = np.flatnonzero((clusters["view"] == HIT_V) | points)
    strips = np.concatenate([x, v])
    kind = np.repeat([HIT_X, HIT_V], [len(x), len(v)])
    n = len(wire_hits)
    size = clusters["size"] * (clusters["method"] == 0) * (clusters["view"] != XV_CLUSTER)

    def both(of_strips: Column, of_wires: Column, dtype: str) -> Column:
        return np.concatenate([of_strips, of_wires]).astype(dtype)

    hits = {
        "kind": both(kind, np.full(n, HIT_WIRE), "u1"),
        "layer": both(clusters["layer"][strips], wire_hits["layer"], "i4"),
        "channel": both(clusters["sheet"][strips], wire_hits["wire"], "i4"),
        "size": both(size[strips], np.zeros(n), "i4"),
        "value": both(np.concatenate([clusters["x"][x], clusters["v"][v]]), wire_hits["drift"], "f8"),
        "sigma": both(np.concatenate([clusters["err_x"][x], clusters["err_v"][v]]), wire_hits["sigma"], "f8"),
        "row": both(strips, np.arange(n), "i8"),
    }
    view = both(np.where(points[strips], HIT_XV, kind), np.full(n, HIT_WIRE), "i1")
    return both(clusters["event"][strips], wire_hits["event"], "i8"), view, hits


def _pairs(clusters: Table, view: Column, row: Column) -> dict[str, Column]:
    """Return the scores of XV clusters with the numbers of their X and V among the measurements, if there are any."""
    pairs = np.flatnonzero(np.nan_to_num(clusters["score"]) * (clusters["x_cluster"] >= 0))
    if not len(pairs):
        return {}
    number = np.full(len(clusters), -1, np.int64)
    of_clusters = np.flatnonzero(view < HIT_WIRE)
    number[row[of_clusters]] = of_clusters
    x, v = (number[clusters[name][pairs]] for name in ("x_cluster", "v_cluster"))
    return {"x": x, "v": v, "score": clusters["score"][pairs]}


def _tables(
    found: dict[str, Column], clusters: Table, view: Column, row: Column, settings: FindSettings
) -> dict[str, Table]:
    """Return the tables of the finder; `view` and `row` of each measurement."""
    event = clusters.events[found["event"]]
    n = len(event)
    kind = HYPOTHESES[settings.hypothesis]
    candidates = {
        "event": event, "candidate": np.arange(n) - np.searchsorted(event, event),
        "pdg": np.full(n, kind.pdg), "mass": np.full(n, kind.mass),
    }  # fmt: skip
    candidate = np.repeat(np.arange(n), np.diff(found["offsets"]))
    view, row = view[found["hits"]], row[found["hits"]]
    # A point is one hit, whether X, V or both were found.
    once = np.ones(len(row), np.bool_)
    points = np.flatnonzero(view == HIT_XV)
    _, first = np.unique(np.stack([candidate[points], row[points]]), axis=1, return_index=True)
    once[np.delete(points, first)] = False
    hits = {"event": event[candidate[once]], "candidate": candidate[once], "view": view[once], "row": row[once]}
    about = clusters.cover | {"meta": {"finder": "ckf"}}
    return {
        "candidates": Table("candidates", candidates, **about),
        "candidate_hits": Table("candidate_hits", hits, **about),
        "searches": Table(
            "searches", {"event": clusters.events, "seeds": found["seeds"], "limits": found["limits"]}, **about
        ),
    }
