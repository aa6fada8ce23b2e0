"""Hits of other programs: columns of any origin become tables, and are fitted (docs/how-to/own_hits.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from cgemit import _core, helix
from cgemit.base.arrays import Column, Columns
from cgemit.base.errors import Problem, Problems, did_you_mean
from cgemit.base.settings import SettingsData
from cgemit.detector import Detector, compiled, load
from cgemit.detector.layers.layer import crossing_z, local_v
from cgemit.detector.parts import cgem_numbers
from cgemit.particles.species import HYPOTHESES
from cgemit.reconstruction.candidates import Finder, check_found, label_candidates
from cgemit.reconstruction.clusterers.binary import cluster_errors
from cgemit.reconstruction.clusterers.clusterer import ClusterSettings
from cgemit.reconstruction.finders import HIT_FINDERS
from cgemit.reconstruction.fit import FitSettings
from cgemit.reconstruction.reconstruct import reconstruct
from cgemit.reconstruction.refine import RefineSettings, refinements
from cgemit.tables import SCHEMAS, Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, XV_CLUSTER
from cgemit.tables.show import columns_of

#: Columns that are read.
_SHARED = ("event", "candidate", "layer")
_COORDINATES = ("sheet", "view", "phi", "z", "x", "v", "first", "last", "size")
_ERRORS = ("err", "err_phi", "err_z", "err_x", "err_v", "cov", "cov_phi_z", "cov_xv")
_READ = {
    "clusters": (*_SHARED, *_COORDINATES, *_ERRORS),
    "wire_hits": (*_SHARED, "wire", "drift", "sigma", "side", "drift_time"),
}
_WHOLE = ("event", "layer", "sheet", "view", "first", "last", "size", "wire", "side", "candidate", "gid")


def read(kind: str, source: Any, needed: tuple[str, ...], problems: Problems) -> Columns:
    """Return the columns of a source, whole numbers as integers, with `event`, `given_row` and what is needed.

    Parameters
    ----------
    kind : str
        Name of the argument, for messages.
    source : Table, mapping of arrays, pandas.DataFrame, structured ndarray or None
    needed : tuple of str
    problems : Problems
        What is wrong is added.
    """
    if source is None:
        return {name: np.zeros(0, np.int64) for name in ("event", "given_row", *needed)}
    columns = columns_of(source)
    if columns is None:
        expected = "a table, a mapping of arrays, a data frame or a structured array"
        problems.note(kind, type(source).__name__, expected)
        return read(kind, None, needed, problems)
    missing = [name for name in needed if name not in columns]
    rows = len(columns["layer"]) if "layer" in columns and columns["layer"].ndim else 0
    for name in missing:
        problems.note(f"{kind}: {name}", f"missing, expected columns {', '.join(needed)}", "")
    for name, column in columns.items():
        depth = 3 if name == "cov" else 1
        if column.ndim == 0 or len(column) != rows or column.ndim > depth or column.dtype.kind not in "iufb":
            if not missing:
                problems.note(f"{kind}: {name}", f"{column.dtype}, shape {column.shape}", f"{rows} numbers")
        elif name in _WHOLE:
            columns[name] = _whole(kind, name, column, problems)
        elif name == "cov" and column.shape != (rows, 2, 2):
            problems.note(f"{kind}: cov", f"shape {column.shape}", f"({rows}, 2, 2)")
    absent = [name for name in _READ[kind] if name not in columns]
    known = {*_READ[kind], *(column.name for column in SCHEMAS[kind])}
    for name in columns:  # a finder may read others
        if name not in known and (hint := did_you_mean(name, absent, near=0.85)):
            problems.note(f"{kind}: {name}", "got an unknown column", "", hint)
    if problems:
        return read(kind, None, needed, problems)
    columns.setdefault("event", np.zeros(rows, np.int64))
    return columns | {"given_row": np.arange(rows)}


def _whole(kind: str, name: str, column: Column, problems: Problems) -> Column:
    """Return the column as integers; say which number is none, or too large for the tables."""
    if column.dtype.kind == "f":
        wrong = np.flatnonzero(~(column == np.rint(column)))
        if len(wrong):
            problems.note(f"{kind} row {wrong[0]}: {name}", f"{column[wrong[0]]}", "a whole number")
        column = np.where(np.isfinite(column), column, 0)
    bits = 62 if name == "event" else 31
    wrong = np.flatnonzero((column < -(2.0**bits)) | (column >= 2.0**bits))
    if len(wrong):
        problems.note(f"{kind} row {wrong[0]}: {name}", f"{column[wrong[0]]}", f"a number below 2**{bits}")
        return np.zeros(len(column), np.int64)
    return column.astype(np.int64)


_RANGES = {
    "phi": "an azimuth in rad, within -2 pi and 2 pi",
    "z": "a position in mm, at most a tenth of its half length beyond the end of the layer",
}


def _reach(detector: Detector, layer: Column) -> Column:
    """Return the range of z of a point on each layer, (n, 2) mm; without limits for layers that are not there."""
    ends = np.array([*(one.ends for one in detector.layers), (-np.inf, np.inf)])
    ends[:-1] += 0.05 * np.diff(ends[:-1], axis=1) * (-1, 1)
    return ends[np.where((layer >= 0) & (layer < len(detector.layers)), layer, -1)]


class RowProblem(NamedTuple):
    """What is wrong with a row of hits: the column, its value and what was expected of it."""

    table: str
    row: int
    name: str
    got: str
    expected: str

    @property
    def problem(self) -> Problem:
        """The problem of the hits as a whole."""
        return Problem(f"{self.table} row {self.row}: {self.name}", self.got, self.expected)


def value_problems(detector: Detector, clusters: Columns) -> list[RowProblem]:
    """Say which layers, coordinates, errors and strips of clusters cannot be, by the names that they were given under.

    Parameters
    ----------
    detector : Detector
    clusters : dict of str to ndarray
        As given, with `view`.
    """
    layers, layer = len(detector.layers), clusters["layer"]
    problems: list[RowProblem] = []

    def refuse(name: str, wrong: Column, expected: str) -> None:
        for row in np.flatnonzero(wrong):
            value = clusters[name][row]
            got = f"{value:g}" if value.ndim == 0 else str(value.tolist())
            problems.append(RowProblem("clusters", int(row), name, got, expected))

    refuse("layer", (layer < 0) | (layer >= layers), f"a layer of the detector, 0 to {layers - 1}")
    view = clusters["view"]
    refuse("view", (view < HIT_X) | (view > XV_CLUSTER), "0 (X), 1 (V) or 2 (XV)")
    point = view == XV_CLUSTER
    for name, other, unit in (("phi", "x", "rad"), ("z", "v", "mm")):
        if name in clusters:
            by_position = np.isnan(clusters[name]) & np.isfinite(clusters.get(other, np.full(len(layer), np.nan)))
            refuse(name, point & ~np.isfinite(clusters[name]) & ~by_position, f"a finite number, {unit}")
        if name in clusters:  # in another unit, a position may still lie somewhere on the layer
            low, high = (-2 * np.pi, 2 * np.pi) if name == "phi" else _reach(detector, layer).T
            by_other = np.isfinite(clusters.get(other, np.full(len(layer), np.nan)))
            beyond = (clusters[name] < low) | (clusters[name] > high)
            refuse(name, point & ~by_other & np.isfinite(clusters[name]) & beyond, _RANGES[name])
    for name, largest in (("err_phi", np.pi), ("err_z", 1e5)):  # only their squares reach the fit
        if name in clusters:
            refuse(name, clusters[name] <= 0, "a number above 0")
            refuse(name, clusters[name] > largest, f"at most {largest:.6g}")
    if {"cov_phi_z", "err_phi", "err_z"} <= clusters.keys():
        limit = np.abs(clusters["err_phi"] * clusters["err_z"])
        large = (limit > 0) & ~(np.abs(clusters["cov_phi_z"]) < limit)
        refuse("cov_phi_z", point & large, "less in size than err_phi err_z")
    if "cov" in clusters:
        cov = clusters["cov"]
        lowest = cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] ** 2
        good = (cov[:, 0, 1] == cov[:, 1, 0]) & (cov[:, 0, 0] > 0) & (lowest > 0)
        refuse("cov", point & ~(good | np.isnan(cov).any(axis=(1, 2))), "a symmetric, positive definite matrix")
    return problems + _strip_problems(detector, clusters)


#: Standard deviations by which noise may make a drift distance negative.
_BELOW_0 = 8


def drift_problems(detector: Detector, wires: Columns) -> list[RowProblem]:
    """Say which drift distances are longer than any in their cells, or negative.

    A cell's longest distance is three diagonals, since tracks may turn back there. Errors of small distances may make
    them negative by `_BELOW_0` standard deviations.

    Parameters
    ----------
    detector : Detector
    wires : dict of str to ndarray
        As given, with `layer` and `drift`.
    """
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    problems = []
    for i, layer in enumerate(layers):
        width = 2 * np.pi * layer.r_end / layer.cells
        beside = [abs(other.r_end - layer.r_end) for other in layers[max(0, i - 1) : i + 2]]
        most = 3 * float(np.hypot(width, max(width, *beside)))
        for row in np.flatnonzero((wires["layer"] == layer.number) & (np.abs(wires["drift"]) > most)):
            drift, expected = wires["drift"][row], f"at most three diagonals of a cell, {most:.4g} mm"
            if np.isfinite(drift):
                problems.append(RowProblem("wire_hits", int(row), "drift", f"{drift:g}", expected))
        errors = wires.get("sigma", np.full(len(wires["drift"]), np.nan))
        errors = np.where(errors > 0, errors, layer.sigma)
        for row in np.flatnonzero((wires["layer"] == layer.number) & (wires["drift"] < -_BELOW_0 * errors)):
            drift = f"{wires['drift'][row]:g}"
            expected = "a distance without sign, which is that of the column side"
            problems.append(RowProblem("wire_hits", int(row), "drift", drift, expected))
    return problems


def _strip_problems(detector: Detector, clusters: Columns) -> list[RowProblem]:
    """Say which clusters of strips, whose position follows from them, have strips that are not there."""
    if not {"first", "last"} <= clusters.keys():
        return []
    first, last, layer, view = (clusters[name] for name in ("first", "last", "layer", "view"))
    problems = []
    for is_view, name in ((HIT_X, "x"), (HIT_V, "v")):
        position = clusters.get(name, np.full(len(layer), np.nan))
        for layer_number, of_strips in enumerate(detector.layers):
            strips = (of_strips.strips_x, of_strips.strips_v)[is_view]
            bare = (layer == layer_number) & (view == is_view) & np.isnan(position)
            for row in np.flatnonzero(bare & ((first < 0) | (last < first) | (last >= strips))):
                got, expected = (
                    f"{first[row]}, {last[row]}",
                    f"strips from 0 to {strips - 1}, the first not above the last",
                )
                problems.append(RowProblem("clusters", int(row), "first, last", got, expected))
    return problems


def repeated(kind: str, columns: Columns, names: tuple[str, ...]) -> list[Problem]:
    """Say which hits of a candidate are given twice: they would count double. Hits of none (number below 0) may repeat.

    Parameters
    ----------
    kind : str
        Name of the argument, for messages.
    columns : dict of str to ndarray
        With `given_row`.
    names : tuple of str
        Columns that tell hits apart; NaN equals NaN.
    """
    rows = len(columns["given_row"])
    keys = [columns[name] for name in ("event", "candidate", *names) if name in columns]
    order = np.lexsort([columns["given_row"], *keys])
    same = np.ones(max(rows - 1, 0), np.bool_)
    for key in keys:
        before, after = key[order[:-1]], key[order[1:]]
        same &= (before == after) | ((before != before) & (after != after))
    same &= columns.get("candidate", np.zeros(rows))[order[1:]] >= 0
    return [
        Problem(f"{kind} row {order[i + 1]}", f"the hit of row {order[i]} again", "each hit once")
        for i in sorted(np.flatnonzero(same), key=lambda i: order[i + 1])
    ]


def fit_hits(
    detector: Detector | str | Mapping[str, Any],
    clusters: Any = None,
    wire_hits: Any = None,
    *,
    candidates: Finder | str | Mapping[str, Table] | None = None,
    hypothesis: str = "mu",
    settings: FitSettings | None = None,
    refine: RefineSettings | None = None,
    cluster: ClusterSettings | None = None,
    find: SettingsData | None = None,
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
    candidates : str, callable, mapping of str to Table, or None
        A finder as for `run`, but not ``"truth"``, or the tables ``candidates`` and ``candidate_hits`` for hits
        that are tables. None: the column `candidate` of the hits, a number within the event (below 0: none), or all
        hits of an event together.
    hypothesis : str
        Particle whose mass the fit assumes, ``"e"``, ``"mu"``, ``"pi"``, ``"K"`` or ``"p"``.
    settings : FitSettings or None
    refine : RefineSettings or None
        Whether drift times are raw, and whether tracks give the start time; hits then need `drift_time` (ns).
    cluster : ClusterSettings or None
        Reference sample for the errors of clusters that are given by their strips.
    find : FindSettings or None
        Of the finder, only with a name as `candidates`.

    Returns
    -------
    dict of str to Table
        ``tracks`` and what else `reconstruct` makes, and the tables ``clusters``, ``wire_hits``, ``candidates`` and
        ``candidate_hits``. Their rows are sorted by `event`, a column that may be left out, too: one event. The column
        `given_row` of the hits says where a row was.

    Raises
    ------
    ValueError
        Listing what is wrong with the columns or the hits, by their rows as given; the first 10 of many.

    Examples
    --------
    >>> hits = {"layer": [0, 1, 2], "phi": [0.3770, 0.3631, 0.3504], "z": [16.6, 25.3, 34.0],  # rad, mm
    ...         "err_phi": [1.8e-3, 1.2e-3, 0.5e-3], "err_z": [0.3, 0.4, 0.3]}
    >>> tracks = cg.fit_hits("besiii-cgem", clusters=hits)["tracks"]
    >>> print(cg.FitStatus(tracks["status"][0]).name, tracks["tanl"].round(2))
    ok [0.2]
    """
    detector = load(detector)
    problems = Problems()
    if not isinstance(hypothesis, str) or hypothesis not in HYPOTHESES:
        problems.note("hypothesis", repr(hypothesis), f"one of {', '.join(map(repr, HYPOTHESES))}")
    how, fitted = RefineSettings.of(refine, "refine"), FitSettings.of(settings)
    names = " or ".join(map(repr, HIT_FINDERS))
    if isinstance(candidates, str) and candidates in HIT_FINDERS:
        named = HIT_FINDERS[candidates]
        candidates = named.of(named.settings.of(find, "find"), fitted)
    elif isinstance(candidates, str):
        problems.note("candidates", repr(candidates), f"{names}, a finder, tables or None")
    elif find is not None:
        problems.note("find", "settings of the finder", f"None unless candidates is {names}")
    hits = hit_tables(detector, clusters, wire_hits, problems, labelled=candidates is None, settings=cluster)
    if candidates is None:
        labels = [part["candidate"] if "candidate" in part else np.zeros(len(part), np.int64) for part in hits]
        candidates = label_candidates(*hits, labels[0], labels[1], hypothesis)
    tables = None if callable(candidates) else check_found(candidates, "given", hits[0])

    def given(detector: Detector, clusters: Table, wire_hits: Table) -> Mapping[str, Table]:
        assert tables is not None
        return tables

    finder = candidates if callable(candidates) else given
    out = reconstruct(
        detector, *hits, finder, fitted, refinements=refinements(how), find_again=how.find_again and tables is None,
        compete=how.points == "compete",
    )  # fmt: skip
    return {"clusters": hits[0], "wire_hits": hits[1], **out}


def hit_tables(
    detector: Detector,
    clusters: Any,
    wire_hits: Any,
    problems: Problems,
    *,
    labelled: bool = True,
    events: Column | None = None,
    settings: ClusterSettings | None = None,
) -> tuple[Table, Table]:
    """Return the tables of clusters and wire hits given as columns, as for `fit_hits`.

    Parameters
    ----------
    detector : Detector
    clusters, wire_hits : Table, mapping of arrays, pandas.DataFrame, pyarrow.Table, structured ndarray or None
    problems : Problems
        What is wrong already.
    labelled : bool
        Whether the column `candidate`, or else the event, says which hits belong together.
    events : ndarray, (n,) int64, or None
        Events that the tables cover; None: those with hits.
    settings : ClusterSettings or None
        Reference sample for the errors of clusters that are given by their strips.

    Raises
    ------
    ValueError
        Listing everything that is wrong.
    """
    reference = ClusterSettings.of(settings, "cluster")
    inputs = {
        "clusters": read("clusters", clusters, ("layer",), problems),
        "wire_hits": read("wire_hits", wire_hits, ("layer", "wire", "drift"), problems),
    }
    sources = {"clusters": clusters, "wire_hits": wire_hits}
    for label in ("event", "candidate") if labelled else ("event",):
        named = [name for name, source in sources.items() if source is not None and label in (columns_of(source) or {})]
        bare = [name for name, columns in inputs.items() if len(columns["layer"]) and name not in named]
        if named and bare:
            problems.note(bare[0], f"have no column '{label}', as the {named[0]} have; expected both or none", "")
    _raise(problems)
    with np.errstate(invalid="ignore"):  # infinite numbers are listed below
        of_clusters = _cluster_columns(detector, inputs["clusters"], reference, problems)
        columns = of_clusters, _wire_columns(detector, inputs["wire_hits"])
    _raise(problems)
    wrong = value_problems(detector, inputs["clusters"] | {"view": columns[0]["view"]})
    wrong += drift_problems(detector, inputs["wire_hits"])
    rows = {(one.table, one.row) for one in wrong}  # X, V and their errors follow from wrong numbers there
    measured = _measurements(*columns)
    listed, count = _core.reconstruction.hit_problems(compiled(detector), measured)
    tables = np.where(measured["kind"] == HIT_WIRE, "wire_hits", "clusters")
    wrong += [
        one for i, *about in listed if (one := RowProblem(tables[i], int(measured["hit"][i]), *about))[:2] not in rows
    ]
    problems += dict.fromkeys(one.problem for one in sorted(wrong, key=lambda one: one[:2]))
    if labelled:  # else a finder may tell equal hits apart
        problems += repeated("clusters", columns[0], ("layer", "sheet", "view", "x", "v"))
        problems += repeated("wire_hits", columns[1], ("layer", "wire", "drift"))
    _raise(problems, unlisted=count - len(listed))
    if events is None:
        events = np.unique(np.concatenate([part["event"] for part in columns]))
    return _table("clusters", columns[0], events), _table("wire_hits", columns[1], events)


#: Problems that an error lists.
_MOST_LISTED = 10


def _raise(problems: Problems, unlisted: int = 0) -> None:
    more = max(len(problems) - _MOST_LISTED, 0) + unlisted
    rest = [Problem("", f"and {more} more", "")] if more else []
    Problems(problems[:_MOST_LISTED] + rest).report("fit_hits")


def _cluster_columns(detector: Detector, named: Columns, settings: ClusterSettings, problems: Problems) -> Columns:
    """Return X, V and their errors of each row, whichever way they are given, and the other columns."""
    n = len(named["layer"])
    has = named.keys()
    if n and "view" not in has and not {"phi", "z"} <= has:
        problems.note("clusters", "neither view nor phi and z", "points (phi, z) or views with x, v or strips")
    columns = dict(named)
    view = columns["view"] = named.get("view", np.full(n, XV_CLUSTER))
    if np.any(view == XV_CLUSTER) and not ({"err_phi", "err_z"} <= has or {"err_x", "err_v"} <= has or "cov" in has):
        problems.note("clusters", "points without errors", "err_phi and err_z, cov, or err_x and err_v")
    if n and not detector.layers:
        problems.note("clusters", f"{n} rows", f"none, {detector.name} has no layers of clusters")
    if problems:
        return columns
    nan = np.full(n, np.nan)
    names = ("x", "v", "phi", "z", "err_x", "err_v", "err_phi", "err_z")
    for name in (*names, "r"):
        columns[name] = np.asarray(named.get(name, nan), np.float64).copy()
    columns["cov_xv"] = np.asarray(named.get("cov_xv", np.zeros(n)), np.float64).copy()
    columns["sheet"] = _sheets(detector, columns, "sheet" in has, problems)
    for name, value in (("first", -1), ("last", -1), ("size", 0)):
        columns[name] = named.get(name, np.full(n, value)).copy()
    of_cgem: dict[int, tuple[Column, Column]] = {}
    if "first" in has:
        errors = cluster_errors(detector, settings)
        of_cgem = dict(zip(cgem_numbers(detector), zip(*errors, strict=True), strict=True))
    for layer_number, layer in enumerate(detector.layers):
        rows = np.flatnonzero(named["layer"] == layer_number)
        of_layer = {name: columns[name][rows] for name in (*names, "view", "sheet", "first", "last", "size", "cov_xv")}
        of_layer |= {name: named[name][rows] for name in ("err", "cov", "cov_phi_z") if name in has}
        of_layer["r"] = np.full(len(rows), layer.r_mid)
        _fill_layer(layer, of_layer, of_cgem.get(layer_number), keep_size="size" in has)
        for name in (*names, "size", "cov_xv", "r"):
            columns[name][rows] = of_layer[name]
    return columns


def _sheets(detector: Detector, columns: Columns, has_sheet: bool, problems: Problems) -> Column:
    """Return the sheet of each cluster: as given, the only one of its layer, or that below its azimuth."""
    if has_sheet:
        return columns["sheet"]
    sheet = np.zeros(len(columns["layer"]), np.int64)
    for layer_number, layer in enumerate(detector.layers):
        rows = np.flatnonzero(columns["layer"] == layer_number)
        around = np.remainder(columns["phi"][rows] - layer.sheet_phi[0], 2 * np.pi)
        if layer.sheets == 1 or not len(rows):
            continue
        if np.any(columns["view"][rows] != XV_CLUSTER):
            text = f"missing; expected it where a layer has {layer.sheets}, as layer {layer_number}"
            problems.note("clusters: sheet", text, "")
        edge = np.remainder(layer.sheet_phi[1] - layer.sheet_phi[0], 2 * np.pi)
        sheet[rows] = around >= edge
    return sheet


def _fill_layer(layer: Any, columns: Columns, of_strips: tuple[Column, Column] | None, *, keep_size: bool) -> None:
    """Fill in positions and errors of the clusters of one layer."""
    view, start = columns["view"], np.array(layer.sheet_phi)[np.clip(columns["sheet"], 0, layer.sheets - 1)]
    point = view == XV_CLUSTER
    given_errors = np.isfinite(np.where(view == HIT_V, columns["err_v"], columns["err_x"])) | ("err" in columns)
    strips = (columns["first"] >= 0) & (columns["last"] >= columns["first"]) & ~point
    size = np.where(strips, columns["last"] - columns["first"] + 1, 0)
    pitch_x, pitch_v = layer.pitches
    of_views = (HIT_X, "x", pitch_x, 0.0, 0), (HIT_V, "v", pitch_v, layer.offset_v, 1)
    for is_view, name, pitch, offset, which in of_views:
        rows, error = view == is_view, columns[f"err_{name}"]
        centre = (0.5 * (columns["first"] + columns["last"] + 1) + offset) * pitch
        columns[name] = np.where(rows & strips & np.isnan(columns[name]), centre, columns[name])
        if "err" in columns:
            error = np.where(rows & np.isnan(error), columns["err"], error)
        if of_strips is not None:
            by_size = of_strips[which][np.clip(size - 1, 0, len(of_strips[which]) - 1)]
            error = np.where(rows & strips & np.isnan(error), by_size, error)
        columns[f"err_{name}"] = error
    if not keep_size:  # the fit takes errors as they are where a cluster has no strips
        columns["size"] = np.where(given_errors, 0, size)
    _fill_points(layer, columns, start, point)
    on_x = (view == HIT_X) & np.isnan(columns["phi"])
    columns["phi"] = np.where(on_x, helix.wrap_angle(start + columns["x"] / layer.r_readout), columns["phi"])
    columns["err_phi"] = np.where(on_x, columns["err_x"] / layer.r_readout, columns["err_phi"])


def _fill_points(layer: Any, columns: Columns, start: Column, point: Column) -> None:
    """Fill in X and V of points from phi and z with their covariance, or phi and z from X and V."""
    r, cosine, sine = layer.r_readout, np.cos(layer.stereo), layer.sin_stereo
    by_phi = point & np.isnan(columns["x"])
    x = r * np.remainder(columns["phi"] - start, 2 * np.pi)
    columns["x"] = np.where(by_phi, x, columns["x"])
    by_z = point & np.isnan(columns["v"])
    columns["v"] = np.where(by_z, local_v(layer, columns["x"], columns["z"]), columns["v"])
    columns["phi"] = np.where(
        point & np.isnan(columns["phi"]), helix.wrap_angle(start + columns["x"] / r), columns["phi"]
    )
    columns["z"] = np.where(point & np.isnan(columns["z"]), crossing_z(layer, columns["x"], columns["v"]), columns["z"])
    phi2, z2, covariance = columns["err_phi"] ** 2, columns["err_z"] ** 2, columns.get("cov_phi_z", np.zeros(len(x)))
    if "cov" in columns:
        phi2, z2, covariance = (columns["cov"][:, i, j] for i, j in ((0, 0), (1, 1), (0, 1)))
    # X = r (phi - start), V = X cos + (z_ref - z) sin.
    from_phi = point & np.isnan(columns["err_x"]) & np.isnan(columns["err_v"])
    with np.errstate(invalid="ignore"):
        err_v = np.sqrt(cosine**2 * r**2 * phi2 + sine**2 * z2 - 2 * cosine * sine * r * covariance)
        columns["err_x"] = np.where(from_phi, r * np.sqrt(phi2), columns["err_x"])
    columns["err_v"] = np.where(from_phi, err_v, columns["err_v"])
    columns["cov_xv"] = np.where(from_phi, cosine * r**2 * phi2 - sine * r * covariance, columns["cov_xv"])


def _wire_columns(detector: Detector, named: Columns) -> Columns:
    """Return the columns of wire hits with those that were left out."""
    n, columns = len(named["layer"]), dict(named)
    columns["drift"] = np.asarray(named["drift"], np.float64)
    distance = np.where(np.isfinite(columns["drift"]), np.maximum(columns["drift"], 0), 0)
    sigma, gid = np.ones(n), np.full(n, -1)  # layers that are not there are refused
    if detector.drift_chamber:
        for layer, first in zip(detector.drift_chamber.layers, detector.drift_chamber.gid_first, strict=True):
            in_layer = named["layer"] == layer.number
            sigma[in_layer] = layer.error_at(distance[in_layer])
            gid[in_layer] = first + named["wire"][in_layer]
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
        of |= {"kind": np.full(len(layer), kind), "hit": table["given_row"][rows], "size": np.zeros(len(layer))}
        of["side"] = table["side"][rows] if kind == HIT_WIRE else np.zeros(len(layer))
        for name, column in of.items():
            joined.setdefault(name, []).append(column)
    kinds = {"kind": "u1", "layer": "i4", "channel": "i4", "size": "i4", "side": "i8", "hit": "i8"}
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
    for name, view in (("x_cluster", HIT_X), ("v_cluster", HIT_V)):
        if name not in picked:
            continue
        # Of some rows of another table, links count the rows of that one.
        strip_row = position[np.clip(picked[name], -1, len(order))]
        is_part = (
            (strip_row >= 0) & (picked["view"][strip_row] == view) & (picked["event"][strip_row] == picked["event"])
        )
        picked[name] = np.where(is_part, strip_row, -1)
    integers = {c.name: c.dtype for c in schema if c.dtype.kind in "iu"}
    picked = {name: column.astype(integers[name]) if name in integers else column for name, column in picked.items()}
    return Table(kind, picked, len(events), events=events)
