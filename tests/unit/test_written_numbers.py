"""Every number that a study writes is recomputed from its tables; every drawn artist is compared with its data."""

import csv
import json
import math
from html.parser import HTMLParser

import numpy as np
import pytest

from cgemit import Gun, run
from cgemit.analysis.clusters import geant4_runs
from cgemit.analysis.curves import Line, Spectrum, track_spectrum
from cgemit.analysis.quantities import QUANTITIES
from cgemit.analysis.widths import gaussian_fit
from cgemit.draw import curves
from cgemit.draw.style import new_picture
from cgemit.study import measure, reproduce, scan
from cgemit.study.paper.published import paper_values
from cgemit.study.scan import save_scans, scan_columns
from cgemit.tables.show import shown, with_error

UNITS = {"dr": 1e3, "phi0": 1e3, "kappa": 1.0, "dz": 1.0, "tanl": 1e3, "p": 1e3}


def widths(tracks, name, kind="res", rows=slice(None)):
    """Return the widths of a residual or pull from the columns of the tracks."""
    values = tracks[f"{kind}_{name}"][rows][tracks["status"][rows] == 0]
    return measure(values[np.isfinite(values)] * (UNITS[name] if kind == "res" else 1))


def read(path):
    """Return the columns of a CSV table as texts."""
    with path.open(encoding="utf-8") as stream:
        head, *rows = csv.reader(stream)
    return dict(zip(head, zip(*rows, strict=True), strict=True))


def numbers(texts):
    return np.array([float(text) for text in texts])


@pytest.fixture(scope="module")
def scanned():
    return scan("besiii-cgem-design", [0.15, 1.0], events=120, seed=4)


def test_units_are_those_that_are_quoted():
    assert {name: QUANTITIES[name].factor for name in UNITS} == UNITS


@pytest.mark.slow
def test_numbers_of_a_scan(scanned, tmp_path):
    """Table, curves, summary and print-out of a scan hold the width that they name."""
    save_scans([scanned], tmp_path / "out")
    columns, unit = read(tmp_path / "out" / "resolution.csv"), {"dr": "um", "dz": "mm", "p": "MeV/c"}
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    drawn = {curve["id"]: curve for curve in summary["curves"]}
    assert columns.keys() == scan_columns(scanned.samples).keys()
    np.testing.assert_allclose(numbers(columns["p (GeV/c)"]), [0.15, 1.0])
    for name, text in unit.items():
        expected = [widths(sample.tracks, name) for sample in scanned.samples]
        for what, head in (("core", "sigma"), ("q68", "q68"), ("rms", "rms")):
            np.testing.assert_allclose(
                numbers(columns[f"{head}_{name} ({text})"]), [getattr(w, what) for w in expected], rtol=1e-6
            )
            errors = [getattr(w, f"{what}_error") for w in expected]
            np.testing.assert_allclose(numbers(columns[f"{head}_{name}_error ({text})"]), errors, rtol=1e-6)
        np.testing.assert_allclose(numbers(columns[f"tail_{name}"]), [w.tail for w in expected], rtol=1e-6)
        curve = drawn[f"sigma_{name}"]
        assert (curve["x"], curve["x_unit"], curve["y_unit"]) == ([0.15, 1.0], "GeV/c", text)
        assert curve["y"] == [w.core for w in expected]
        assert curve["y_error"] == [w.core_error for w in expected]
    fitted = [int(np.sum(sample.tracks["status"] == 0)) for sample in scanned.samples]
    assert [int(text) for text in columns["fitted"]] == fitted
    first = repr(scanned).splitlines()[2]
    cells = [with_error(w.core, w.core_error) for w in (widths(scanned.samples[0].tracks, n) for n in unit)]
    positions = [first.find(cell) for cell in cells]
    assert -1 not in positions
    assert positions == sorted(positions)
    assert f"{fitted[0]}/120" in first


def bars(axes, place):
    """Return x, y and the half lengths of the error bars of a drawn set of points."""
    container = axes.containers[place]
    points, _, (lines,) = container
    ends = np.array([segment[:, 1] for segment in lines.get_segments()])
    return points.get_xdata(), points.get_ydata(), (ends[:, 1] - ends[:, 0]) / 2


def test_drawn_curves():
    x, y, error = np.array([[0.2, 1.0], [3.0, 5.0], [0.1, 0.2]])
    lines = [
        Line(f"sigma_{i}", name, x + i, "GeV/c", y * (i + 1), error, "um") for i, name in enumerate(("one", "two"))
    ]
    picture = curves.draw_resolutions([("σ(d_ρ)", lines), ("σ(d_z)", lines[1:])], "p", [(1.0, 7.0), None])
    first, second = picture.get_axes()
    for place, line in enumerate(lines):
        for found, expected in zip(bars(first, place), (line.x, line.y, line.y_error), strict=True):
            np.testing.assert_allclose(found, expected)
    np.testing.assert_allclose(bars(second, 0)[1], lines[1].y)
    assert (first.get_xlabel(), first.get_ylabel()) == ("p  (GeV/c)", "σ($d_\\rho$)  (µm)")
    assert second.get_ylabel() == "σ($d_z$)  (µm)"
    star = next(line for line in first.lines if line.get_marker() == "*")
    assert (star.get_xdata()[0], star.get_ydata()[0], star.get_label()) == (1.0, 7.0, "paper, CGEM")
    assert [text.get_text() for text in first.get_legend().get_texts()] == ["paper, CGEM", "one", "two"]


def test_drawn_grid():
    rows = [[(f"r{row}c{column}", [line(10 * row + column)]) for column in range(3)] for row in range(2)]
    axes = curves.draw_grid(rows, "cos θ", unity_rows=(1,)).get_axes()
    assert [plot.get_ylabel() for plot in axes] == [label for row in rows for label, _ in row]
    for plot, (_, (expected,)) in zip(axes, [panel for row in rows for panel in row], strict=True):
        np.testing.assert_allclose(bars(plot, 0)[1], expected.y)
        assert plot.get_xlabel() == "cos θ"
    assert [any(np.all(np.equal(one.get_ydata(), 1)) for one in plot.lines) for plot in axes] == [False] * 3 + [
        True
    ] * 3


def line(value):
    return Line("pull", "one", np.array([-0.5, 0.5]), "", np.array([value, value + 0.5]), np.array([0.1, 0.1]), "")


def test_drawn_spectrum():
    tracks = run("besiii-cgem-design", Gun("mu-", p=1, theta=1), 300).tracks
    for name in ("dr", "dz", "p"):
        spectrum = track_spectrum(tracks, name)
        picture = curves.residual(tracks, name)
        (axes,) = picture.get_axes()
        values = UNITS[name] * tracks[f"res_{name}"][tracks["status"] == 0]
        counts = np.histogram(values, spectrum.edges)[0]
        x, y, error = bars(axes, 0)
        centres = 0.5 * (spectrum.edges[1:] + spectrum.edges[:-1])
        np.testing.assert_allclose(x, centres[counts > 0])
        np.testing.assert_array_equal(y, counts[counts > 0])
        np.testing.assert_allclose(error, np.sqrt(y))
        core = widths(tracks, name)
        curve = max(axes.lines, key=lambda drawn: len(drawn.get_xdata()))
        top = curve.get_xdata()[np.argmax(curve.get_ydata())]
        assert top == pytest.approx(core.core_mean, abs=0.02 * core.core)
        half = curve.get_xdata()[curve.get_ydata() > 0.6065 * curve.get_ydata().max()]
        assert np.ptp(half) / 2 == pytest.approx(core.core, rel=0.05)
        text = axes.texts[0].get_text()
        unit = {"dr": "µm", "dz": "mm", "p": "MeV/c"}[name]
        assert f"core: {with_error(core.core, core.core_error)} {unit}" in text
        assert f"q68: {with_error(core.q68, core.q68_error)} {unit}" in text
        assert f"mean: {with_error(core.core_mean, core.core_mean_error)} {unit}" in text
        assert axes.get_xlabel().endswith(f"fitted − true  ({unit})")


def test_drawn_parts():
    edges = np.linspace(-2, 2, 5)
    counts = {"all": np.array([1, 5, 4, 2]), "a": np.array([1, 2, 0, 1]), "b": np.array([0, 3, 4, 1])}
    spectrum = Spectrum("X", "um", edges, counts, measure(np.linspace(-1, 1, 40)), gaussian_fit(np.linspace(-1, 1, 40)))
    for draw in (curves.draw_parts, lambda axes, *given: curves.draw_tails(axes, *given, [(1.5, "RMS 7 µm")])):
        _, (axes,) = new_picture()
        draw(axes, spectrum, {"a": ("red", "part a"), "b": ("blue", "part b")})
        drawn = {patch.get_label(): patch.get_data() for patch in axes.patches}
        for label, name in (("part a", "a"), ("part b", "b"), ("all", "all")):
            np.testing.assert_array_equal(drawn[label].values, counts[name])
            np.testing.assert_array_equal(drawn[label].edges, edges)
    assert sorted(line.get_xdata()[0] for line in axes.lines) == [-1.5, 1.5]


def test_drawn_pulls_and_probabilities():
    random = np.random.default_rng(2)
    names = [QUANTITIES[name].symbol for name in UNITS]
    samples = {d: {name: random.normal(i, 1 + j, 400) for i, name in enumerate(names)} for j, d in enumerate("AB")}
    texts = {d: {name: f"{d} {name}" for name in names} for d in samples}
    axes = curves.draw_pulls(samples, texts).get_axes()
    edges = np.linspace(-5, 5, 51)
    for plot, name in zip(axes, names, strict=True):
        for drawn, (detector, each) in zip(plot.lines, samples.items(), strict=False):
            np.testing.assert_allclose(drawn.get_ydata(), np.histogram(each[name], edges)[0] / 400 / 0.2)
            np.testing.assert_allclose(drawn.get_xdata(), 0.5 * (edges[1:] + edges[:-1]))
            assert drawn.get_label() == f"{detector} {name}"
        unit = plot.lines[2]
        np.testing.assert_allclose(unit.get_ydata(), np.exp(-0.5 * unit.get_xdata() ** 2) / math.sqrt(2 * math.pi))
        assert plot.get_xlabel().replace("$", "").replace("\\rho", "ρ") == f"pull of {name}"
    values = {"A": random.uniform(size=800), "B": random.uniform(0, 0.5, 400)}
    (plot,) = curves.draw_probabilities(values).get_axes()
    for patch, (detector, each) in zip(plot.patches, values.items(), strict=True):
        expected = np.histogram(each, np.linspace(0, 1, 41))[0] * 40 / len(each)
        np.testing.assert_allclose(patch.get_data().values, expected)
        assert patch.get_label() == f"{detector}: n = {len(each):,}, mean = {each.mean():.3f}"


class Tables(HTMLParser):
    """The tables of a page: a list of rows of cells."""

    def __init__(self):
        super().__init__()
        self.tables, self.inside = [], False

    def handle_starttag(self, tag, attrs):
        """Open a table, a row or a cell."""
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
            self.inside = True

    def handle_endtag(self, tag):
        """Close a cell."""
        self.inside = self.inside and tag not in ("td", "th")

    def handle_data(self, data):
        """Add to a cell."""
        if self.inside:
            self.tables[-1][-1][-1] += data


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return reproduce(tmp_path_factory.mktemp("study") / "out", events=400, seed=5)


@pytest.fixture(scope="module")
def report(study):
    """Return the tables of the report by the heading of their first column."""
    parser = Tables()
    parser.feed((study.folder / "report.html").read_text(encoding="utf-8"))
    return {table[0][0] + "/" + table[0][1]: table for table in parser.tables}


def rows_of(path):
    """Return the rows of a table of curves by (curve, detector)."""
    columns = read(path)
    found = {}
    for place, key in enumerate(zip(columns["curve"], columns["detector"], strict=True)):
        found.setdefault(key, []).append([float(columns[name][place]) for name in ("x", "y", "y error")])
    return {key: np.array(rows).T for key, rows in found.items()}


@pytest.mark.slow
def test_curves_of_a_study_hold_the_widths_that_they_name(study):
    files = {"figure6_d_rho_d_z_vs_p": "res", "figure8_p_vs_p": "res", "pulls_vs_p": "pull"}
    seen = set()
    for name, kind in files.items():
        for (curve, detector), (x, y, error) in rows_of(study.folder / f"{name}.csv").items():
            samples = next(scan for scan in study.scans.values() if scan[0].detector.name == detector)
            parameter = curve.partition("_")[2]
            expected = [widths(sample.tracks, parameter, kind) for sample in samples]
            np.testing.assert_allclose(x, [sample.gun.p for sample in samples])
            np.testing.assert_allclose(y, [w.core for w in expected], rtol=1e-6)
            np.testing.assert_allclose(error, [w.core_error for w in expected], rtol=1e-6)
            assert curve.startswith({"res": "sigma_", "pull": "pull_"}[kind])
            seen.add((curve, detector))
    assert len(seen) == 2 * (3 + 6)
    edges = np.linspace(-0.93, 0.93, 1 + len(rows_of(study.folder / "resolution_vs_cos_theta.csv")[
        ("sigma_dr_cos_theta", "besiii-idc")][0]))  # fmt: skip
    for (curve, detector), (x, y, error) in rows_of(study.folder / "resolution_vs_cos_theta.csv").items():
        tracks = next(s.tracks for s in study.samples.values() if s.detector.name == detector)
        cosine = tracks["truth_tanl"] / np.hypot(1, tracks["truth_tanl"])
        kind, parameter = curve.split("_")[:2]
        for i, found in enumerate(zip(x, y, error, strict=True)):
            rows = (cosine >= edges[i]) & (cosine < edges[i + 1])
            w = widths(tracks, parameter, {"sigma": "res", "pull": "pull"}[kind], rows)
            np.testing.assert_allclose(found, (cosine[rows].mean(), w.core, w.core_error), rtol=1e-6)


@pytest.mark.slow
def test_table_of_pulls_of_a_study(study):
    columns = read(study.folder / "pulls.csv")
    for place, (detector, name) in enumerate(zip(columns["detector"], columns["parameter"], strict=True)):
        tracks = next(s.tracks for s in study.samples.values() if s.detector.name == detector)
        w = widths(tracks, name, "pull")
        for what in ("core", "core_mean", "rms", "mean"):
            assert float(columns[what][place]) == pytest.approx(getattr(w, what), rel=1e-6)
            assert float(columns[f"{what}_error"][place]) == pytest.approx(getattr(w, f"{what}_error"), rel=1e-6)
    assert len(columns["detector"]) == 12


@pytest.mark.slow
def test_columns_of_the_report(study, report):
    """The paper's numbers stand under "paper", ours under "cgemit", Geant4's under the run that they are from."""
    head, *rows = report["quantity/paper"]
    elsewhere = ("x_residual_rms_1mm", "x_residual_rms_2mm", "x_residual_rms_3mm", "x_residual_rms_5mm")
    by_title = {row.title: row for row in study.results if row.id not in elsewhere}  # which have a table of their own
    assert head[1:3] == ["paper", "cgemit ± statistical error"]
    published = 0
    for title, paper, ours, _ in rows:
        row = by_title[title]
        assert ours.startswith(with_error(row.value, row.error))
        assert (paper == "-") == (row.paper is None)
        if row.paper is not None:
            assert float(paper.split()[0]) == pytest.approx(paper_values()[row.id].value)
            published += 1
    assert published == 5  # the numbers that the text of the paper quotes
    head, *rows = report["X residual/cgemit ± statistical error"]
    for place, one in enumerate(geant4_runs(), start=2):
        assert head[place] == f"Geant4, {shown(one.title)}"
        assert [row[place] for row in rows[: len(one.rms)]] == [str(value) for value in one.rms]
        assert [row[place] for row in rows[len(one.rms) :]] == [str(one.beyond_3mm), str(one.single_strip)]
    x = 1e3 * study.samples["cgem"].clusters.x
    for row, window in zip(rows, (1.0, 2.0, 3.0, 5.0), strict=False):
        inside = x[np.abs(x) < 1e3 * window]
        assert float(row[1].split()[0]) == pytest.approx(inside.std(ddof=1), abs=1)
        assert f"{window:g} mm" in row[0]


@pytest.mark.slow
def test_resolutions_and_removed_rows_of_the_report(study, report):
    for key, kind in (("detector/quantity", "res"), ("detector/pull of", "pull")):
        head, *rows = report[key]
        assert len(rows) == 12
        for row in rows:
            cells = dict(zip(head, row, strict=True))
            tracks = next(s.tracks for s in study.samples.values() if s.detector.name == cells["detector"])
            name = next(n for n in UNITS if QUANTITIES[n].symbol == row[1].split(" (")[0])
            w = widths(tracks, name, kind)
            assert cells["core"] == with_error(w.core, w.core_error)
            assert cells["q68"] == with_error(w.q68, w.q68_error)
            assert cells["bias"] == with_error(w.core_mean, w.core_mean_error)
            assert cells["tail %"] == with_error(100 * w.tail, 100 * w.tail_error)
            assert int(cells["rows"]) == np.count_nonzero(tracks["status"] == 0)
    head, *rows = report["sample/tracks"]
    samples = [*study.samples.values(), *(s for one in study.scans.values() for s in one)]
    assert [row[0] for row in rows] == [sample.label for sample in samples]
    for row, sample in zip(rows, samples, strict=True):
        cells = dict(zip(head, row, strict=True))
        bad = len(sample.tracks) - np.count_nonzero(sample.tracks["status"] == 0)
        assert int(cells["tracks"].replace(",", "")) == sample.n_events
        counts = [int(part.split()[0]) for part in cells["not fitted"].split(", ") if part != "none"]
        assert sum(counts) == bad
        ends = {part.split()[1]: int(part.split()[0]) for part in cells["end of transport"].split(", ")}
        assert ends == dict(sample.transport)
        assert int(cells["clusters without truth"]) == sample.clusters.without_truth


@pytest.mark.parametrize(
    ("gun", "text"),
    [
        (Gun("pi+", pt=0.5, theta=(0.5, 1.5)), "pi+, pT = 0.5 GeV/c, θ = 0.5 to 1.5 rad"),
        (Gun("mu-", p=[0.5, 1.0], cos_theta=0.1) + Gun("K-", p=1, theta=1),
         "mu-, p = 0.5, 1 GeV/c, cos θ = 0.1; K-, p = 1 GeV/c, θ = 1 rad"),
    ],
)  # fmt: skip
def test_pictures_of_residuals_say_what_was_shot(gun, text):
    axes = curves.residual(run("besiii-cgem-design", gun, 20, 1), "p").axes[0]
    assert axes.get_title(loc="left") == f"besiii-cgem-design, 20 events\n{text}"
