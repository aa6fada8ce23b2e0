"""Hits given as columns of any origin: the page about them runs, every way to give them leads to the same tracks."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import cgemit as cg
from cgemit.base.errors import Problem
from cgemit.base.settings import SettingsData
from cgemit.detector.channels import checked
from cgemit.detector.layers.layer import crossing_z
from cgemit.reconstruction.finders import HIT_FINDERS, HitFinder
from cgemit.reconstruction.fit import PARAMETERS
from cgemit.reconstruction.given_hits import RowProblem

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "own_hits.md"
DETECTOR = cg.load("besiii-cgem-design")
FAR = np.array([17, 4, 900_000_000_001, 5, 99])  # numbers of events, in no order
STRIPS = ("event", "layer", "sheet", "view", "first", "last")


@pytest.fixture(scope="module")
def run():
    """Return five simulated muons with every cluster that their own."""
    settings = cg.Settings(simulate=cg.SimulateSettings(deltas=False))
    return cg.run(DETECTOR, cg.Gun("mu-", p=(0.5, 1.0), cos_theta=(-0.6, 0.6)), 5, seed=4, settings=settings)


def columns(table, names, rows):
    """Return some columns of some rows, with the events numbered anew."""
    return {name: table[name][rows] for name in names if name != "event"} | {"event": FAR[table["event"][rows]]}


def shuffled(given, seed=1):
    """Return columns with their rows in random order."""
    order = np.random.default_rng(seed).permutation(len(given["layer"]))
    return {name: column[order] for name, column in given.items()}


def wires_of(run, *more):
    """Return the wire hits."""
    return columns(run.wire_hits, ("layer", "wire", "drift", *more), slice(None))


def strips_of(run):
    """Return X and V clusters as strips."""
    return columns(run.clusters, STRIPS, np.flatnonzero(run.clusters["view"] < 2))


def points_of(run, *names):
    """Return XV clusters, phi and z with other columns."""
    return columns(run.clusters, ("layer", "phi", "z", *names), np.flatnonzero(run.clusters["view"] == 2))


def assert_tracks_of(out, run):
    """Fail unless the tracks are those of the run, in the order of the event numbers."""
    assert out["tracks"]["event"].tolist() == sorted(FAR.tolist())
    for name in (*PARAMETERS, "chi2", "err_p"):
        np.testing.assert_array_equal(out["tracks"][name], run.fitted[name][np.argsort(FAR)])


def blocks():
    """Return the programs of the page."""
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


def test_the_page_runs(tmp_path, monkeypatch, capsys):
    """All programs, one after the other."""
    monkeypatch.chdir(tmp_path)
    programs = blocks()
    assert len(programs) == 3
    assert len(programs[0].splitlines()) <= 10
    for program in programs:
        exec(compile(program, str(PAGE), "exec"), {})
    text = capsys.readouterr().out
    (shown,) = re.findall(r"```output\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert shown in text
    chi2 = {name: float(value) for name, value in re.findall(r"^taken as (\w+) +chi2/ndf (\S+)$", text, re.MULTILINE)}
    assert chi2["corrected"] > 1.5
    assert 0.9 < chi2["raw"] < 1.1


def test_strips_and_drift_distances_are_enough(run):
    """Strips and wires in random order, events with gaps: the tracks of the chain to the last bit."""
    assert_tracks_of(cg.fit_hits(DETECTOR, shuffled(strips_of(run)), shuffled(wires_of(run))), run)


def test_v_strips_that_begin_beside_zero():
    """The first V strip of the as-built detector begins `offset_v` pitches from V = 0."""
    run = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), n=3, until="cluster")
    strips = run.clusters[run.clusters["view"] < 2]
    found = cg.fit_hits("besiii-cgem", columns(run.clusters, STRIPS, np.flatnonzero(run.clusters["view"] < 2)))
    back = np.argsort(found["clusters"]["given_row"])
    np.testing.assert_allclose(found["clusters"]["v"][back], strips["v"], rtol=0, atol=1e-12)


def test_data_frames_structured_arrays_and_tables(run):
    """The same hits in whatever holds columns."""
    pandas = pytest.importorskip("pandas")
    strips, wires = strips_of(run), wires_of(run)
    kinds = [(name, column.dtype) for name, column in wires.items()]
    structured = np.empty(len(wires["layer"]), kinds)
    for name, column in wires.items():
        structured[name] = column
    assert_tracks_of(cg.fit_hits("besiii-cgem-design", pandas.DataFrame(strips), structured), run)
    arrow = pytest.importorskip("pyarrow")
    assert_tracks_of(cg.fit_hits(DETECTOR, arrow.table(strips), arrow.table(wires)), run)
    of_tables = cg.fit_hits(DETECTOR, run.clusters[run.clusters["view"] < 2], run.wire_hits)
    np.testing.assert_array_equal(of_tables["tracks"]["dr"], run.fitted["dr"])


def test_points_are_joined_clusters(run):
    """Phi and z with errors of X and V are X and V; with their covariance, the same again."""
    errors = cg.FitSettings(cluster_errors="cluster")
    wires = wires_of(run)
    strips = cg.fit_hits(DETECTOR, strips_of(run), wires, settings=errors)["tracks"]
    given = points_of(run, "err_x", "err_v")
    layers = [DETECTOR.cgem[number] for number in given["layer"]]
    r, alpha = (np.array([getattr(layer, name) for layer in layers]) for name in ("r_readout", "stereo"))
    phi2, z2 = (
        (given["err_x"] / r) ** 2,
        (given["err_v"] ** 2 + (np.cos(alpha) * given["err_x"]) ** 2) / np.sin(alpha) ** 2,
    )
    both = np.cos(alpha) * given["err_x"] ** 2 / (r * np.sin(alpha))
    bare = {name: given[name] for name in ("event", "layer", "phi", "z")}
    by_name = bare | {"err_phi": np.sqrt(phi2), "err_z": np.sqrt(z2), "cov_phi_z": both}
    matrix = bare | {"cov": np.stack([np.stack([phi2, both], 1), np.stack([both, z2], 1)], 1)}
    for points in (given, by_name, matrix):
        tracks = cg.fit_hits(DETECTOR, shuffled(points), wires, settings=errors)["tracks"]
        for name in PARAMETERS:
            np.testing.assert_allclose(tracks[name], strips[name], atol=1e-6 * strips[f"err_{name}"].max())
            np.testing.assert_allclose(tracks[f"err_{name}"], strips[f"err_{name}"], rtol=1e-6)
    uncorrelated = {name: by_name[name] for name in by_name if name != "cov_phi_z"}
    tracks = cg.fit_hits(DETECTOR, uncorrelated, wires, settings=errors)["tracks"]
    assert np.max(np.abs(tracks["dz"] - strips["dz"]) / strips["err_dz"]) > 1e-3


def test_positions_with_errors(run):
    """X and V with `err`, or with errors of their own: as the clusters, which the fit takes as they are."""
    rows = np.flatnonzero(run.clusters["view"] < 2)
    given = columns(run.clusters, ("layer", "sheet", "view", "x", "v", "err_x", "err_v"), rows)
    expected = cg.fit_hits(DETECTOR, strips_of(run), wires_of(run), settings=cg.FitSettings(cluster_errors="cluster"))
    err = np.where(given["view"] == 0, given["err_x"], given["err_v"])
    one = {name: given[name] for name in ("event", "layer", "sheet", "view", "x", "v")} | {"err": err}
    for way in (given, one):
        tracks = cg.fit_hits(DETECTOR, way, wires_of(run))["tracks"]
        np.testing.assert_array_equal(tracks["dr"], expected["tracks"]["dr"])


def test_filled_columns(run):
    """What was left out: errors and numbers of wires, azimuth and z, and where each row was."""
    wires = shuffled(wires_of(run))
    out = cg.fit_hits(DETECTOR, points_of(run, "err_x", "err_v"), wires)
    order = np.argsort(FAR)
    hits = out["wire_hits"]
    np.testing.assert_array_equal(hits["wire"], wires["wire"][hits["given_row"]])
    first = hits.select_events(4, 5)
    mine = run.wire_hits.select_events(1, 2)
    for name in ("gid", "sigma"):
        np.testing.assert_allclose(np.sort(first[name]), np.sort(mine[name]))
    assert set(hits["wire_truth"]) == {-1}
    assert hits.events.tolist() == FAR[order].tolist()
    points = out["clusters"]
    layers = [DETECTOR.cgem[number] for number in points["layer"]]
    z = [crossing_z(*at) for at in zip(layers, points["x"], points["v"], strict=True)]
    np.testing.assert_allclose(points["z"], z, atol=1e-9)
    assert out["candidates"].meta["finder"] == out["tracks"].meta["finder"] == "given"


def test_two_sheets_are_told_apart_by_azimuth():
    """Points of layers with two sheets lie on that below them; coordinates without a sheet are refused."""
    detector = cg.load("besiii-cgem-design")
    run = cg.run(detector, cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), 40, seed=1)
    points = run.clusters[run.clusters["view"] == 2]
    given = {name: points[name] for name in ("event", "layer", "phi", "z", "err_x", "err_v")}
    out = cg.fit_hits(detector, given)["clusters"]
    np.testing.assert_array_equal(out["sheet"], points["sheet"])
    np.testing.assert_allclose(out["x"], points["x"], atol=1e-9)
    np.testing.assert_allclose(out["v"], points["v"], atol=1e-9)
    with pytest.raises(ValueError, match="sheet: missing; expected it where a layer has 2, as layer 1"):
        cg.fit_hits(detector, {"layer": [1], "view": [0], "x": [1.0], "err": [0.1]})


def test_candidates_by_column_finder_and_table(run):
    """Tracks of one event told apart by numbers; a finder and its tables give the same."""

    def number(event):
        return np.searchsorted(np.sort(FAR), event)

    wires, strips = wires_of(run), strips_of(run)
    labels = [
        {"candidate": np.where(part["event"] == 4, -1, number(part["event"])), "event": 0 * part["event"]}
        for part in (strips, wires)
    ]
    out = cg.fit_hits(DETECTOR, strips | labels[0], wires | labels[1])
    assert out["candidates"]["candidate"].tolist() == [1, 2, 3, 4]
    expected = run.fitted["dr"][np.argsort(FAR)][1:]
    np.testing.assert_array_equal(out["tracks"]["dr"], expected)

    def by_number(detector, clusters, wire_hits):
        return cg.label_candidates(clusters, wire_hits, clusters["number"], wire_hits["number"])

    numbered = [
        part | {"number": label["candidate"], "event": label["event"]}
        for part, label in zip((strips, wires), labels, strict=True)
    ]
    found = cg.fit_hits(DETECTOR, *numbered, candidates=by_number)
    np.testing.assert_array_equal(found["tracks"]["dr"], expected)
    assert found["tracks"].meta["finder"] == "by_number"
    assert [found["candidates"]["candidate"][row] for row in found["tracks"]["candidate"]] == [1, 2, 3, 4]
    tables = {name: found[name] for name in ("candidates", "candidate_hits")}
    again = cg.fit_hits(DETECTOR, found["clusters"], found["wire_hits"], candidates=tables)
    np.testing.assert_array_equal(again["tracks"]["dr"], expected)


def test_the_finder_of_run_by_its_name(run):
    """It finds the five muons; other names are refused."""
    found, same = (
        cg.fit_hits(DETECTOR, strips_of(run), wires_of(run), candidates=by) for by in ("ckf", cg.find_tracks)
    )
    assert found["tracks"]["event"].tolist() == sorted(FAR.tolist())
    np.testing.assert_array_equal(found["tracks"]["dr"], same["tracks"]["dr"])
    with pytest.raises(ValueError, match="candidates: got 'truth', expected 'ckf', a finder, tables or None"):
        cg.fit_hits(DETECTOR, strips_of(run), candidates="truth")


def test_a_finder_of_the_registry_has_its_name_and_settings(run, monkeypatch):
    """Of the settings of a second finder, those of another class are refused; one seed finds fewer tracks."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class FewSettings(SettingsData):
        seeds: int = 200

    @checked("clusters", "wire_hits", ignore=("gid",))
    def few(detector, clusters, wire_hits, settings, *, fit):
        return cg.find_tracks(detector, clusters, wire_hits, cg.FindSettings(max_seeds=settings.seeds), fit=fit)

    monkeypatch.setitem(HIT_FINDERS, "few", HitFinder("few", few, FewSettings, "few"))
    hits = {"clusters": one_event(strips_of(run)), "wire_hits": one_event(wires_of(run))}
    many, one = (cg.fit_hits(DETECTOR, **hits, candidates="few", find=FewSettings(seeds=n))["tracks"] for n in (200, 1))
    assert many.meta["finder"] == "few"
    assert len(one) < len(many)
    with pytest.raises(TypeError, match="find: got FindSettings, expected FewSettings"):
        cg.fit_hits(DETECTOR, **hits, candidates="few", find=cg.FindSettings())


def one_event(hits):
    """Return hits as if all were of one event."""
    return {name: column for name, column in hits.items() if name != "event"}


def test_one_kind_of_hits_alone(run):
    """No clusters, or no wires: what is there is fitted."""
    wires = cg.fit_hits(DETECTOR, wire_hits=wires_of(run))["tracks"]
    assert (wires["n_clusters"].max(), (wires["status"] == 0).all()) == (0, True)
    points = cg.fit_hits(DETECTOR, points_of(run, "err_x", "err_v"))["tracks"]
    assert points["n_wires"].max() == 0
    assert len(cg.fit_hits(DETECTOR)["tracks"]) == 0


@pytest.mark.parametrize(
    ("clusters", "wires", "messages"),
    [
        ([1, 2], 3, ["clusters: got list, expected a table", "wire_hits: got int, expected a table"]),
        ({"phi": [1.0]}, {"layer": [8], "wire": [1]}, ["clusters: layer: missing", "wire_hits: drift: missing"]),
        (
            {"layer": [0], "phi": [1.0], "z": [0.0], "err_phi": [1e-3], "err_zz": [1.0], "candidates": [0], "q": [1]},
            {"layer": [8], "wire": [1], "drift": [1.0], "Side": [1]},
            [
                'clusters: err_zz: got an unknown column; did you mean "err_z"?',
                'clusters: candidates: got an unknown column; did you mean "candidate"?',
                'wire_hits: Side: got an unknown column; did you mean "side"?',
            ],
        ),
        (  # every wrong row, although strips depend on the view
            {"layer": [0, 0, 0], "view": [7, 0, -1], "first": [1, 5, 1], "last": [1, 3, 1]}, None,
            [
                "clusters row 0: view: got 7, expected 0 (X), 1 (V) or 2 (XV)",
                "clusters row 1: first, last: got 5, 3",
                "clusters row 2: view: got -1, expected 0",
            ],
        ),
        ({"layer": [0, 1], "phi": [1.0]}, None, ["clusters: phi: got float64, shape (1,), expected 2 numbers"]),
        ({"layer": [0.5], "phi": [1.0], "z": [1.0]}, None, ["clusters row 0: layer: got 0.5, expected a whole number"]),
        ({"layer": [0], "x": [1.0]}, None, ["got neither view nor phi and z"]),
        ({"layer": [0], "phi": [1.0], "z": [0.0]}, None, ["clusters: got points without errors, expected err_phi and"]),
        ({"layer": [0], "view": [3]}, None, ["clusters row 0: view: got 3, expected 0 (X), 1 (V) or 2 (XV)"]),
        (
            {"layer": [0, 9], "phi": [1.0, 1.0], "z": [0.0, 0.0], "err_phi": [0.0, 1e-3], "err_z": [-1.0, 1.0]},
            {"layer": [8, 8, 1], "wire": [-1, 0, 0], "drift": [1.0, np.nan, 1.0], "side": [0, 7, 0]},
            [
                "clusters row 0: err_phi: got 0, expected a number above 0",
                "clusters row 0: err_z: got -1, expected a number above 0",
                "clusters row 1: layer: got 9",
                "wire_hits row 0: wire: got -1", "wire_hits row 1: drift: got nan", "wire_hits row 1: side: got 7",
                "wire_hits row 2: layer: got 1, expected the number of a wire layer",
            ],
        ),
        (  # more than 32 bits would come out as other wires and layers
            {"layer": [2**32], "phi": [1.0], "z": [1.0]}, {"layer": [8], "wire": [2**32 + 5], "drift": [1.0]},
            [
                "clusters row 0: layer: got 4294967296, expected a number below 2**31",
                "wire_hits row 0: wire: got 4294967301, expected a number below 2**31",
            ],
        ),
        (
            {"layer": [0], "phi": [1.0], "z": [1.0], "event": np.array([2**64 - 1], np.uint64)},
            {"layer": [8], "wire": [5], "drift": [1.0], "event": [2**63 - 1]},
            [
                "clusters row 0: event: got 18446744073709551615, expected a number below 2**62",
                "wire_hits row 0: event: got 9223372036854775807, expected",
            ],
        ),
        (
            {"layer": [0, 9, 0], "phi": [np.inf, 1.0, 1.0], "z": [1.0, 1.0, np.nan], "cov": [np.eye(2)] * 3}, None,
            [
                "clusters row 0: phi: got inf, expected a finite number, rad",
                "clusters row 1: layer: got 9, expected a layer of the detector, 0 to 2",
                "clusters row 2: z: got nan, expected a finite number, mm",
            ],
        ),
        (
            {"layer": [0], "phi": [1.0], "z": [1.0], "cov": [[1.0, 1.0]]}, None,
            ["clusters: cov: got shape (1, 2), expected (1, 2, 2)"],
        ),
        (
            {"layer": [0], "phi": [1.0], "z": [1.0], "cov": [[[1.0, 0.5], [0.0, 1.0]]]}, None,
            ["clusters row 0: cov: got [[1.0, 0.5], [0.0, 1.0]], expected a symmetric, positive definite matrix"],
        ),
        (
            {"layer": [0, 1], "phi": [1.0] * 2, "z": [1.0] * 2, "err_phi": [1e-3] * 2, "err_z": [0.5] * 2,
             "cov_phi_z": [6e-4, np.nan]}, None,
            [f"clusters row {row}: cov_phi_z: got {got}, expected less in size than err_phi err_z"
             for row, got in enumerate(("0.0006", "nan"))],
        ),
        (
            {"layer": [0] * 3, "view": [0] * 3, "first": [5, -2, 10], "last": [3, 4, 10**6]}, None,
            [f"clusters row {row}: first, last: got {pair}, expected strips from 0 to 844, the first not above the last"
             for row, pair in enumerate(("5, 3", "-2, 4", "10, 1000000"))],
        ),
        (  # degrees, micrometres
            {"layer": [0, 1, 2], "phi": [57.3, 6.2, -6.2], "z": [-293.0, 380.0, 1000.0], "err_phi": [4.0, 1e-3, 1e-3],
             "err_z": [1e6, 1.0, 1.0]},
            {"layer": [8], "wire": [1], "drift": [np.inf]},
            [
                "clusters row 0: phi: got 57.3, expected an azimuth in rad, within -2 pi and 2 pi",
                "clusters row 0: z: got -293, expected a position in mm",
                "clusters row 1: z: got 380, expected a position in mm",
                "clusters row 2: z: got 1000, expected a position in mm",
                "clusters row 0: err_phi: got 4, expected at most 3.14159",
                "clusters row 0: err_z: got 1e+06, expected at most 100000",
                "wire_hits row 0: drift: got inf",
            ],
        ),
        ({"layer": [0], "phi": [[1.0, 2.0]], "z": [0.0]}, None, ["clusters: phi: got float64, shape (1, 2), expected"]),
        (
            {"layer": [0], "phi": [1.0], "z": [0.0], "err_phi": [1e-3], "err_z": [1.0], "candidate": [1]},
            {"layer": [8], "wire": [1], "drift": [1.0]},
            ["wire_hits: have no column 'candidate', as the clusters have"],
        ),
        (
            {"layer": [0], "phi": [1.0], "z": [0.0], "err_phi": [1e-3], "err_z": [1.0]},
            {"layer": [8], "wire": [1], "drift": [1.0], "event": [5]},
            ["clusters: have no column 'event', as the wire_hits have; expected both or none"],
        ),
        (
            None,
            {"layer": [8, 8, 8], "wire": [1, 2, 3], "drift": [-1.0, -1.1, 3.0], "sigma": [0.13, 0.13, 0.13]},
            ["wire_hits row 1: drift: got -1.1, expected a distance without sign, which is that of the column side"],
        ),
    ],
)  # fmt: skip
def test_mistakes_are_listed_by_the_rows_given(clusters, wires, messages):
    """What cannot be columns, what is missing, and every number that is none."""
    with pytest.raises(ValueError, match=r"fit_hits|hits:") as error:
        cg.fit_hits(DETECTOR, clusters, wires)
    assert [text for text in messages if text not in str(error.value)] == []
    assert len(set(lines := str(error.value).splitlines())) == len(lines)
    assert "sigma: got" not in str(error.value)  # which was not given


def test_rows_are_told_by_numbers_not_by_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    """X and V follow from a wrong azimuth: the core's complaints about them are left out, whatever texts say."""
    monkeypatch.setattr(RowProblem, "problem", property(lambda one: Problem(f"{one.name} of {one.row}", "wrong", "")))
    points = {"layer": [0, 1], "phi": [1.0, np.inf], "z": [0.0, 0.0], "err_phi": [1e-3, 1e-3], "err_z": [0.3, 0.3]}
    wires = {"layer": [8] * 60, "wire": np.arange(60), "drift": [1.0] * 60, "sigma": [0.0] * 60}
    with pytest.raises(ValueError, match="fit_hits:") as error:
        cg.fit_hits(DETECTOR, points, wires)
    sigmas = [f"sigma of {row}: wrong" for row in range(9)]  # 10 of 61; the core also names X and V of the point
    assert [line.strip() for line in str(error.value).splitlines()[1:]] == ["phi of 1: wrong", *sigmas, "and 51 more"]


def test_hits_given_twice(run):
    """A row that repeats another one of its candidate is named; another candidate may have the same hit."""
    points, wires = points_of(run, "err_x", "err_v"), wires_of(run)
    again = [{name: np.append(column, column[[3, 0]]) for name, column in hits.items()} for hits in (points, wires)]
    with pytest.raises(ValueError, match="fit_hits:") as error:
        cg.fit_hits(DETECTOR, *again)
    assert [line.strip() for line in str(error.value).splitlines()[1:]] == [
        f"{kind} row {len(hits['layer']) + i}: got the hit of row {row} again, expected each hit once"
        for kind, hits in (("clusters", points), ("wire_hits", wires))
        for i, row in enumerate((3, 0))
    ]
    numbers = [np.append(np.zeros(len(hits["layer"]), int), [1, 1]) for hits in (points, wires)]
    shared = [hits | {"candidate": number} for hits, number in zip(again, numbers, strict=True)]
    n = len({*points["event"][[3, 0]], *wires["event"][[3, 0]]})
    assert len(cg.fit_hits(DETECTOR, *shared)["tracks"]) == len(FAR) + n


def test_hypothesis_and_clusters_without_layers(run):
    """A particle that is none; clusters for a detector without CGEM layers."""
    with pytest.raises(ValueError, match="hypothesis: got 'tau', expected one of 'e', 'mu'"):
        cg.fit_hits(DETECTOR, hypothesis="tau")
    with pytest.raises(ValueError, match=r"hypothesis: got \['pi'\], expected one of 'e', 'mu'"):
        cg.fit_hits(DETECTOR, hypothesis=["pi"])
    with pytest.raises(TypeError, match="settings: got Settings, expected FitSettings"):
        cg.fit_hits(DETECTOR, settings=cg.Settings())
    with pytest.raises(ValueError, match="expected none, besiii-idc has no layers of clusters"):
        cg.fit_hits("besiii-idc", strips_of(run))
