"""Track candidates: sets of hits taken as one track. Finders make them, the fit takes them (docs/methods/find.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Column
from cgemit.base.errors import did_you_mean, report
from cgemit.detector import Detector, compiled
from cgemit.detector.channels import checked
from cgemit.particles.species import HYPOTHESES
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, HIT_XV, XV_CLUSTER
from cgemit.tables.table import kind_problems, what


@dataclass(frozen=True, eq=False)
class FitHits:
    """The measurements of all candidates as flat columns, the input of the compiled fit.

    An XV cluster is two measurements: X, and V - k X, which is uncorrelated with it, k being the covariance of X and V
    over the variance of X.

    Attributes
    ----------
    hit_offsets : ndarray, (n + 1,) int64
        Hits ``hit_offsets[i]`` to ``hit_offsets[i + 1]`` belong to row i of the candidates, ordered from the beam line
        outward; in a layer by sheet or wire, X before V.
    kind : ndarray, (hits,) uint8
        `HIT_X`, `HIT_V` or `HIT_WIRE`.
    layer : ndarray, (hits,) int32
        CGEM layer, or the experiment's number of the wire layer.
    channel : ndarray, (hits,) int32
        Sheet or wire.
    value : ndarray, (hits,) float64, mm
        Local X or V on the sheet, or drift distance.
    sigma : ndarray, (hits,) float64, mm
    size : ndarray, (hits,) int32
        Strips of the cluster; 0 for wires, XV clusters and clusters with a fixed error (`method` 1).
    side : ndarray, (hits,) int8
        Side of the wire; 0 where unknown and for clusters.
    hit : ndarray, (hits,) int64
        Row of the clusters or wire_hits table.
    k, x : ndarray, (hits,) float64
        For the V of an XV cluster: k, and the measured X in mm; otherwise 0.
    """

    hit_offsets: npt.NDArray[np.int64]
    kind: npt.NDArray[np.uint8]
    layer: npt.NDArray[np.int32]
    channel: npt.NDArray[np.int32]
    value: npt.NDArray[np.float64]
    sigma: npt.NDArray[np.float64]
    size: npt.NDArray[np.int32]
    side: npt.NDArray[np.int8]
    hit: npt.NDArray[np.int64]
    k: npt.NDArray[np.float64]
    x: npt.NDArray[np.float64]

    def columns(self) -> dict[str, Column]:
        """Return all columns except the offsets, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "hit_offsets"}


def collect_hits(
    detector: Detector | _core.detector.Detector,
    candidates: Table,
    candidate_hits: Table,
    clusters: Table,
    wire_hits: Table,
) -> FitHits:
    """Collect the measurements of the candidates from the tables that they point into, in the order of the fit.

    Parameters
    ----------
    detector : Detector or _core.detector.Detector
        Gives the order of layers from the beam line outward.
    candidates, candidate_hits, clusters, wire_hits : Table

    Returns
    -------
    FitHits

    Raises
    ------
    ValueError
        Listing every table of another kind; or every hit that does not exist, belongs to another event or is given
        twice, and every problem of the measurements.
    """
    tables = {
        "candidates": candidates, "candidate_hits": candidate_hits, "clusters": clusters, "wire_hits": wire_hits
    }  # fmt: skip
    problems = kind_problems(**tables) or _repeated_points(candidate_hits, clusters)
    report("hits of candidates", problems)
    columns = {
        name: {column: table[column] for column in _READ[name] if column in table} for name, table in tables.items()
    }
    # Clusters with a fixed error are fitted like clusters without strips.
    columns["clusters"]["size"] = clusters["size"] * (clusters["method"] == 0)
    core = detector if isinstance(detector, _core.detector.Detector) else compiled(detector)
    return FitHits(**_core.reconstruction.collect_hits(core, **columns))


_READ = {
    "candidates": ("event", "mass"),
    "candidate_hits": ("event", "candidate", "view", "hit"),
    "clusters": ("event", "layer", "sheet", "size", "view", "x", "v", "err_x", "err_v", "cov_xv", "corr_xv"),
    "wire_hits": ("event", "layer", "wire", "drift", "sigma", "side"),
}


def _repeated_points(candidate_hits: Table, clusters: Table) -> list[str]:
    """Return which XV clusters repeat X or V clusters of the same candidate."""
    view, row, candidate = (candidate_hits[name] for name in ("view", "hit", "candidate"))
    points = np.flatnonzero((view == HIT_XV) & (row >= 0) & (row < len(clusters)))
    if not len(points):
        return []
    strips = (view == HIT_X) | (view == HIT_V)
    strip_rows = set(zip(candidate[strips].tolist(), row[strips].tolist(), strict=True))
    return [
        f"candidates row {candidate[i]}: got clusters row {row[i]}, an XV cluster, and row {view_row}, a part of it; "
        "expected one of both"
        for i in points
        for name in ("x_cluster", "v_cluster")
        if (int(candidate[i]), view_row := int(clusters[name][row[i]])) in strip_rows
    ]


@checked("clusters", "wire_hits", ignore=("gid",))
def label_candidates(
    clusters: Table,
    wire_hits: Table,
    cluster_label: npt.ArrayLike,
    wire_label: npt.ArrayLike,
    hypothesis: str = "mu",
) -> dict[str, Table]:
    """Make candidates from one number per hit.

    Parameters
    ----------
    clusters, wire_hits : Table
        Of the same events.
    cluster_label : array_like, (clusters,) int
        Number of the candidate, within its event, that each cluster belongs to; negative: none. An XV cluster is a
        measurement of both coordinates; it is left out where its X or V cluster has the same number.
    wire_label : array_like, (wire_hits,) int
        The same for the wire hits.
    hypothesis : str
        Particle whose mass the fit assumes: ``"e"``, ``"mu"``, ``"pi"``, ``"K"`` or ``"p"``.

    Returns
    -------
    dict of str to Table
        ``candidates``, by event and number, and ``candidate_hits``.

    Raises
    ------
    ValueError
        If a label is missing, or there is no such particle.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    >>> found = cg.label_candidates(r.clusters, r.wire_hits, r.clusters["event"], r.wire_hits["event"])
    >>> len(found["candidates"]), sorted(found)
    (5, ['candidate_hits', 'candidates'])
    """
    labels = [np.asarray(label) for label in (cluster_label, wire_label)]
    problems = _label_problems(clusters, wire_hits, labels[0], labels[1], hypothesis)
    report("label_candidates", problems)
    of_cluster, of_wire = (label.astype(np.int64) for label in labels)
    of_cluster = _without_repeats(clusters, of_cluster)
    rows = [np.flatnonzero(label >= 0) for label in (of_cluster, of_wire)]
    view = np.where(clusters["view"] == XV_CLUSTER, HIT_XV, clusters["view"])
    event, label, row = (
        np.concatenate(pair)
        for pair in (
            (clusters["event"][rows[0]], wire_hits["event"][rows[1]]), (of_cluster[rows[0]], of_wire[rows[1]]), rows
        )
    )  # fmt: skip
    order = np.lexsort((label, event))
    event, label = event[order], label[order]
    first = np.concatenate([[True], (np.diff(event) != 0) | (np.diff(label) != 0)])[: len(event)]
    kind = HYPOTHESES[hypothesis]
    n = int(np.count_nonzero(first))
    candidates = {
        "event": event[first], "candidate": label[first], "pdg": np.full(n, kind.pdg), "mass": np.full(n, kind.mass),
        "charge": np.full(n, abs(kind.charge)),
    }  # fmt: skip
    hits = {
        "event": event,
        "candidate": np.cumsum(first) - 1,
        "view": np.concatenate([view[rows[0]], np.full(len(rows[1]), HIT_WIRE)])[order],
        "hit": row[order],
    }
    cover = clusters.cover
    return {
        "candidates": Table("candidates", candidates, **cover),
        "candidate_hits": Table("candidate_hits", hits, **cover),
    }


def _label_problems(
    clusters: Table, wire_hits: Table, of_cluster: Column, of_wire: Column, hypothesis: object
) -> list[str]:
    problems = [
        f"{name}: got shape {label.shape}, {label.dtype}; expected ({len(table)},), whole numbers below 2**31"
        for name, label, table in (("cluster_label", of_cluster, clusters), ("wire_label", of_wire, wire_hits))
        if label.shape != (len(table),) or (label.size and (label.dtype.kind not in "iub" or label.max() >= 2**31))
    ]
    if not clusters.covers_as(wire_hits):
        problems.append("wire_hits: cover other events than the clusters; expected the same")
    if not isinstance(hypothesis, str) or hypothesis not in HYPOTHESES:
        known = ", ".join(map(repr, HYPOTHESES))
        problems.append(
            f"hypothesis: got {hypothesis!r}, expected one of {known}{did_you_mean(hypothesis, HYPOTHESES, '; ')}"
        )
    return problems


def _without_repeats(clusters: Table, label: Column) -> Column:
    """Return the labels with -1 for XV clusters whose X or V cluster has the same."""
    repeats = np.zeros(len(label), np.bool_)
    for name in ("x_cluster", "v_cluster"):
        view_row = clusters[name]
        known = np.flatnonzero((clusters["view"] == XV_CLUSTER) & (view_row >= 0) & (view_row < len(label)))
        repeats[known] |= label[view_row[known]] == label[known]
    return np.where(repeats, -1, label)


#: A finder takes detector, clusters and wire hits, and returns tables of candidates and their hits.
Finder = Callable[[Detector, Table, Table], Mapping[str, Table]]
#: Tables that a finder returns, and one that it may return.
FOUND, MAY_FIND = ("candidates", "candidate_hits"), "searches"


def by_finder(finder: Finder, detector: Detector, clusters: Table, wire_hits: Table) -> dict[str, Table]:
    """Return the tables that a finder makes.

    Returns
    -------
    dict of str to Table
        ``candidates`` and ``candidate_hits``, with the finder's name in `meta`; ``searches`` if it returns them.

    Raises
    ------
    TypeError, ValueError
        If it returns anything but a mapping with these two tables, of the same events.
    """
    return check_found(finder(detector, clusters, wire_hits), finder_name(finder), clusters)


def finder_name(finder: object) -> str:
    """Return the name of a finder in tables: the name of the function, also of a partial one, or of the class.

    Parameters
    ----------
    finder : callable, or str
        A name is returned as it is.
    """
    if isinstance(finder, str):
        return finder
    function = getattr(finder, "func", finder)
    return str(getattr(function, "__name__", type(function).__name__))


def check_found(returned: object, finder: str, clusters: Table) -> dict[str, Table]:
    """Return the tables that a finder has made.

    Parameters
    ----------
    returned : object
        Its return value.
    finder : str
        Its name.
    clusters : Table
        Clusters that it was given.

    Raises
    ------
    TypeError, ValueError
        If `returned` is not a mapping with tables of candidates and their hits, of the same events.
    """
    if not isinstance(returned, Mapping) or not set(FOUND) <= set(returned):
        got = (
            f"a mapping with {', '.join(map(repr, returned)) or 'nothing'}"
            if isinstance(returned, Mapping)
            else what(returned)
        )
        raise TypeError(f"finder {finder}: returned {got}; expected a mapping with 'candidates' and 'candidate_hits'")
    tables = {name: returned[name] for name in (*FOUND, MAY_FIND) if name in returned}
    problems = kind_problems(**tables) or [
        f"{name}: cover other events than the clusters; expected the same"
        for name, table in tables.items()
        if not table.covers_as(clusters)
    ]
    report(f"finder {finder}", problems)
    return {name: table.with_meta(finder=finder) for name, table in tables.items()}
