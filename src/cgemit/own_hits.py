"""Hits from elsewhere: columns of any origin become tables, and are fitted (docs/own_hits.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cgemit import _core
from cgemit.candidates import HIT_V, HIT_WIRE, HIT_X, XV_CLUSTER, label_candidates
from cgemit.cluster import ClusterSettings, cluster_errors
from cgemit.detector import Detector, compiled, load
from cgemit.detector.strips import crossing_z, local_v
from cgemit.finders import Finder, by_finder, check_found
from cgemit.fit import FitSettings, fit
from cgemit.hit_columns import Column, Columns, drift_problems, read, repeated, value_problems
from cgemit.species import HYPOTHESES
from cgemit.tables import SCHEMAS, Table


def fit_hits(
    detector: Detector | str | Mapping[str, Any],
    clusters: Any = None,
    wire_hits: Any = None,
    *,
    candidates: Finder | Mapping[str, Table] | None = None,
    hypothesis: str = "mu",
    settings: FitSettings | None = None,
) -> dict[str, Table]:
    """Fit tracks to hits of any origin, given as columns in any order of rows; what is not needed may be left out.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    clusters : Table, mapping of arrays, pandas.DataFrame, pyarrow.Table, structured ndarray or None
        Rows with `layer` and one of: `phi` rad and `z` mm, a point; `view` (0 X, 1 V) with `x` or `v`, mm on the sheet;
        `view` with `first` and `last` strip. Errors of points: `err_phi` rad and `err_z` mm, with `cov_phi_z` rad mm
        if they are correlated, or `cov`, (n, 2, 2) of phi and z, or `err_x` and `err_v` mm. Errors of `x` and `v`:
        `err`, or `err_x` and `err_v`, mm. Strips need none. `sheet` is needed where a layer has two, but for points.
    wire_hits : Table, mapping of arrays, pandas.DataFrame, pyarrow.Table, structured ndarray or None
        Rows with `layer`, `wire`, `drift` mm; `sigma` mm (default: the detector's), `side` (+1, -1; 0 unknown).
    candidates : callable, mapping of str to Table, or None
        A finder as for `run`, or the tables ``candidates`` and ``candidate_hits`` for hits that are tables. None: the
        column `candidate` of the hits, a number within the event (below 0: none), or all hits of an event together.
    hypothesis : str
        Particle whose mass the fit assumes, ``"e"``, ``"mu"``, ``"pi"``, ``"K"`` or ``"p"``.
    settings : FitSettings or None

    Returns
    -------
    dict of str to Table
        ``tracks`` and what else `fit` makes, and the tables ``clusters``, ``wire_hits``, ``candidates`` and
        ``candidate_hits``. Their rows are sorted by `event`, a column that may be left out, too: one event. The column
        `given_row` of the hits says where a row was.

    Raises
    ------
    ValueError
        Listing everything that is wrong with the columns or the hits, by their rows as given.
    """
    detector = load(detector)
    problems: list[str] = []
    if not isinstance(hypothesis, str) or hypothesis not in HYPOTHESES:
        problems.append(f"hypothesis: got {hypothesis!r}, expected one of {', '.join(map(repr, HYPOTHESES))}")
    hits = hit_tables(detector, clusters, wire_hits, problems, labelled=candidates is None)
    events = hits[0].events
    if callable(candidates):
        found = by_finder(candidates, detector, *hits)
    elif candidates is not None:
        found = check_found(candidates, "given", events)
    else:
        labels = [part["candidate"] if "candidate" in part else np.zeros(len(part), np.int64) for part in hits]
        found = check_found(label_candidates(*hits, labels[0], labels[1], hypothesis), "given", events)
    fitted = fit(detector, *hits, found["candidates"], found["candidate_hits"], settings)
    return {"clusters": hits[0], "wire_hits": hits[1], **found, **fitted}


def hit_tables(
    detector: Detector,
    clusters: Any,
    wire_hits: Any,
    problems: list[str],
    *,
    labelled: bool = True,
    events: Column | None = None,
) -> tuple[Table, Table]:
    """Return the tables of clusters and wire hits given as columns, as for `fit_hits`.

    Parameters
    ----------
    detector : Detector
    clusters, wire_hits : Table, mapping of arrays, pandas.DataFrame, pyarrow.Table, structured ndarray or None
    problems : list of str
        What is wrong already.
    labelled : bool
        Whether the column `candidate`, or else the event, says which hits belong together.
    events : ndarray, (n,) int64, or None
        Events that the tables cover; None: those with hits.

    Raises
    ------
    ValueError
        Listing everything that is wrong.
    """
    given = {
        "clusters": read("clusters", clusters, ("layer",), problems),
        "wire_hits": read("wire_hits", wire_hits, ("layer", "wire", "drift"), problems),
    }
    named = [name for name, columns in given.items() if "candidate" in columns]
    bare = [name for name, columns in given.items() if len(columns["layer"]) and name not in named]
    if labelled and named and bare:
        problems.append(f"{bare[0]}: have no column 'candidate', as the {named[0]} have; expected both or none")
    _raise(problems)
    with np.errstate(invalid="ignore"):  # infinite numbers are listed below
        columns = _cluster_columns(detector, given["clusters"], problems), _wire_columns(detector, given["wire_hits"])
    _raise(problems)
    problems += value_problems(detector, given["clusters"] | {"view": columns[0]["view"]})
    problems += drift_problems(detector, given["wire_hits"])
    rows = {line.partition(":")[0] for line in problems}  # X, V and their errors follow from wrong numbers there
    try:
        _core.check_hits(compiled(detector), _measurements(*columns))
    except ValueError as error:
        lines = dict.fromkeys(line.strip() for line in str(error).splitlines()[1:])
        if not lines:  # not a list of problems
            raise
        problems += [line for line in lines if line.partition(":")[0] not in rows]
    if labelled:  # else a finder may tell equal hits apart
        problems += repeated("clusters", columns[0], ("layer", "sheet", "view", "x", "v"))
        problems += repeated("wire_hits", columns[1], ("layer", "wire", "drift"))
    _raise(problems)
    if events is None:
        events = np.unique(np.concatenate([part["event"] for part in columns]))
    return _table("clusters", columns[0], events), _table("wire_hits", columns[1], events)


def _raise(problems: list[str]) -> None:
    if problems:
        raise ValueError("fit_hits:\n  " + "\n  ".join(problems))


def _cluster_columns(detector: Detector, given: Columns, problems: list[str]) -> Columns:
    """Return X, V and their errors of each row, whichever way they are given, and the other columns."""
    n = len(given["layer"])
    has = given.keys()
    if n and "view" not in has and not {"phi", "z"} <= has:
        problems.append(
            "clusters: got neither view nor phi and z; expected points (phi, z) or views with x, v or strips"
        )
    columns = dict(given)
    view = columns["view"] = given.get("view", np.full(n, XV_CLUSTER))
    wrong = np.flatnonzero((view < HIT_X) | (view > XV_CLUSTER))
    if len(wrong):
        problems.append(f"clusters row {wrong[0]}: view: got {view[wrong[0]]}, expected 0 (X), 1 (V) or 2 (XV)")
    if n and not detector.cgem:
        problems.append(f"clusters: got {n} rows; expected none, {detector.name} has no CGEM layers")
    if problems:
        return columns
    nan = np.full(n, np.nan)
    names = ("x", "v", "phi", "z", "err_x", "err_v", "err_phi", "err_z")
    for name in (*names, "r"):
        columns[name] = np.asarray(given.get(name, nan), np.float64).copy()
    columns["cov_xv"] = np.asarray(given.get("cov_xv", np.zeros(n)), np.float64).copy()
    columns["sheet"] = _sheets(detector, columns, "sheet" in has, problems)
    for name, value in (("first", -1), ("last", -1), ("size", 0)):
        columns[name] = given.get(name, np.full(n, value)).copy()
    errors = cluster_errors(detector, ClusterSettings()) if "first" in has else None
    for number, layer in enumerate(detector.cgem):
        rows = np.flatnonzero(given["layer"] == number)
        mine = {name: columns[name][rows] for name in (*names, "view", "sheet", "first", "last", "size", "cov_xv")}
        mine |= {name: given[name][rows] for name in ("err", "cov", "cov_phi_z") if name in has}
        mine["r"] = np.full(len(rows), layer.r_mid)
        of_strips = None if errors is None else (errors[0][number], errors[1][number])
        _fill_layer(layer, mine, of_strips, keep_size="size" in has)
        for name in (*names, "size", "cov_xv", "r"):
            columns[name][rows] = mine[name]
    return columns


def _sheets(detector: Detector, columns: Columns, given: bool, problems: list[str]) -> Column:
    """Return the sheet of each cluster: as given, the only one of its layer, or that below its azimuth."""
    if given:
        return columns["sheet"]
    sheet = np.zeros(len(columns["layer"]), np.int64)
    for number, layer in enumerate(detector.cgem):
        rows = np.flatnonzero(columns["layer"] == number)
        around = np.remainder(columns["phi"][rows] - layer.sheet_phi[0], 2 * np.pi)
        if layer.sheets == 1 or not len(rows):
            continue
        if np.any(columns["view"][rows] != XV_CLUSTER):
            problems.append(
                f"clusters: sheet: missing; expected it where a layer has {layer.sheets}, as layer {number}"
            )
        edge = np.remainder(layer.sheet_phi[1] - layer.sheet_phi[0], 2 * np.pi)
        sheet[rows] = around >= edge
    return sheet


def _fill_layer(layer: Any, mine: Columns, of_strips: tuple[Column, Column] | None, *, keep_size: bool) -> None:
    """Fill in positions and errors of the clusters of one layer."""
    view, start = mine["view"], np.array(layer.sheet_phi)[np.clip(mine["sheet"], 0, layer.sheets - 1)]
    point = view == XV_CLUSTER
    given_errors = np.isfinite(np.where(view == HIT_V, mine["err_v"], mine["err_x"])) | ("err" in mine)
    strips = (mine["first"] >= 0) & (mine["last"] >= mine["first"]) & ~point
    size = np.where(strips, mine["last"] - mine["first"] + 1, 0)
    of_views = (HIT_X, "x", layer.pitch_x, 0.0, 0), (HIT_V, "v", layer.pitch_v, layer.offset_v, 1)
    for is_view, name, pitch, offset, which in of_views:
        rows, error = view == is_view, mine[f"err_{name}"]
        centre = (0.5 * (mine["first"] + mine["last"] + 1) + offset) * pitch
        mine[name] = np.where(rows & strips & np.isnan(mine[name]), centre, mine[name])
        if "err" in mine:
            error = np.where(rows & np.isnan(error), mine["err"], error)
        if of_strips is not None:
            by_size = of_strips[which][np.clip(size - 1, 0, len(of_strips[which]) - 1)]
            error = np.where(rows & strips & np.isnan(error), by_size, error)
        mine[f"err_{name}"] = error
    if not keep_size:  # the fit takes errors as they are where a cluster has no strips
        mine["size"] = np.where(given_errors, 0, size)
    _fill_points(layer, mine, start, point)
    on_x = (view == HIT_X) & np.isnan(mine["phi"])
    mine["phi"] = np.where(on_x, _wrapped(start + mine["x"] / layer.r_readout), mine["phi"])
    mine["err_phi"] = np.where(on_x, mine["err_x"] / layer.r_readout, mine["err_phi"])


def _fill_points(layer: Any, mine: Columns, start: Column, point: Column) -> None:
    """Fill in X and V of points from phi and z with their covariance, or phi and z from X and V."""
    r, cosine, sine = layer.r_readout, np.cos(layer.stereo), np.sin(layer.stereo)
    by_phi = point & np.isnan(mine["x"])
    x = r * np.remainder(mine["phi"] - start, 2 * np.pi)
    mine["x"] = np.where(by_phi, x, mine["x"])
    by_z = point & np.isnan(mine["v"])
    mine["v"] = np.where(by_z, local_v(layer, mine["x"], mine["z"]), mine["v"])
    mine["phi"] = np.where(point & np.isnan(mine["phi"]), _wrapped(start + mine["x"] / r), mine["phi"])
    mine["z"] = np.where(point & np.isnan(mine["z"]), crossing_z(layer, mine["x"], mine["v"]), mine["z"])
    phi2, z2, both = mine["err_phi"] ** 2, mine["err_z"] ** 2, mine.get("cov_phi_z", np.zeros(len(x)))
    if "cov" in mine:
        phi2, z2, both = (mine["cov"][:, i, j] for i, j in ((0, 0), (1, 1), (0, 1)))
    # X = r (phi - start), V = X cos + (z_ref - z) sin.
    from_phi = point & np.isnan(mine["err_x"]) & np.isnan(mine["err_v"])
    with np.errstate(invalid="ignore"):
        err_v = np.sqrt(cosine**2 * r**2 * phi2 + sine**2 * z2 - 2 * cosine * sine * r * both)
        mine["err_x"] = np.where(from_phi, r * np.sqrt(phi2), mine["err_x"])
    mine["err_v"] = np.where(from_phi, err_v, mine["err_v"])
    mine["cov_xv"] = np.where(from_phi, cosine * r**2 * phi2 - sine * r * both, mine["cov_xv"])


def _wrapped(angle: Column) -> Column:
    return np.asarray(np.remainder(angle + np.pi, 2 * np.pi) - np.pi)


def _wire_columns(detector: Detector, given: Columns) -> Columns:
    """Return the columns of wire hits with those that were left out."""
    n, columns = len(given["layer"]), dict(given)
    columns["drift"] = np.asarray(given["drift"], np.float64)
    distance = np.where(np.isfinite(columns["drift"]), np.maximum(columns["drift"], 0), 0)
    sigma, gid = np.ones(n), np.full(n, -1)  # layers that are not there are refused
    if detector.drift_chamber:
        for layer, first in zip(detector.drift_chamber.layers, detector.drift_chamber.gid_first, strict=True):
            mine = given["layer"] == layer.number
            sigma[mine] = layer.sigma + layer.sigma_slope * distance[mine]
            gid[mine] = first + given["wire"][mine]
    defaults = {"sigma": sigma, "gid": gid, "side": np.zeros(n, np.int64), "drift_time": np.full(n, np.nan)}
    return {**defaults, **columns}


def _measurements(clusters: Columns, wires: Columns) -> Columns:
    """Return every number that is measured, by its row as given, for the checks of the core."""
    x, v = (np.flatnonzero((clusters["view"] == view) | (clusters["view"] == XV_CLUSTER)) for view in (HIT_X, HIT_V))
    parts: list[tuple[Columns, Column, int, str, str, str]] = [
        (clusters, x, HIT_X, "sheet", "x", "err_x"),
        (clusters, v, HIT_V, "sheet", "v", "err_v"),
        (wires, np.arange(len(wires["layer"])), HIT_WIRE, "wire", "drift", "sigma"),
    ]  # fmt: skip
    joined: dict[str, list[Column]] = {}
    for table, rows, kind, channel, value, sigma in parts:
        layer = table["layer"][rows]
        of = {"layer": layer, "channel": table[channel][rows], "value": table[value][rows], "sigma": table[sigma][rows]}
        of |= {"kind": np.full(len(layer), kind), "row": table["given_row"][rows], "size": np.zeros(len(layer))}
        of["side"] = table["side"][rows] if kind == HIT_WIRE else np.zeros(len(layer))
        for name, column in of.items():
            joined.setdefault(name, []).append(column)
    kinds = {"kind": "u1", "layer": "i4", "channel": "i4", "size": "i4", "side": "i8", "row": "i8"}
    columns = {name: np.concatenate(column).astype(kinds.get(name, "f8")) for name, column in joined.items()}
    return columns | {"side": np.clip(columns["side"], -128, 127).astype(np.int8)}


def _table(kind: str, columns: Columns, events: Column) -> Table:
    """Return the table of some columns, sorted by event, with defaults for what is missing."""
    order = np.argsort(columns["event"], kind="stable")
    defaults = {"x_cluster": -1, "v_cluster": -1, "truth": -1, "wire_truth": -1}
    schema = SCHEMAS[kind]
    filled = {c.name: np.full(len(order), defaults.get(c.name, 0), c.dtype) for c in schema if c.name not in columns}
    picked = {name: column[order] for name, column in {**filled, **columns}.items()}
    position = np.append(np.argsort(order), -1)  # of each row as given
    for name in picked.keys() & {"x_cluster", "v_cluster"}:
        picked[name] = position[np.clip(picked[name], -1, len(order))]
    integers = {c.name: c.dtype for c in schema if c.dtype.kind in "iu"}
    picked = {name: column.astype(integers[name]) if name in integers else column for name, column in picked.items()}
    return Table(kind, picked, len(events), events=events)
