"""The reproduction of the paper: every number is recomputed from its tables, every artist compared with its data."""

import csv
import json
import math
import pickle
import re
from functools import partial
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import trapezoid

import cgemit
from cgemit import Gun, Settings, load, run
from cgemit import draw as draw_of_cgemit
from cgemit.analysis.clusters import cluster_residuals, geant4_runs, v_spectrum, x_spectrum
from cgemit.analysis.curves import Line, Spectrum, track_spectrum, windowed_resolution
from cgemit.analysis.quantities import QUANTITIES
from cgemit.analysis.widths import gaussian_fit
from cgemit.draw import curves
from cgemit.draw.curves import draw_grid, draw_resolutions
from cgemit.draw.event import helix_points, near
from cgemit.draw.style import mathematical, new_picture
from cgemit.study import measure, reproduce
from cgemit.study.evaluation import record_of, row_columns, seed_of
from cgemit.study.paper import DETECTORS, MOMENTA, results
from cgemit.study.paper.figures import good_event
from cgemit.study.paper.published import paper_values
from cgemit.study.paper.report import paper_report
from cgemit.study.scan import save_scans, scan
from cgemit.tables.show import shown, with_error, write_csv
from outlines import outline

FIGURES = (
    "figure1_layer", "figure2_chain", "figure3_cluster", "figure4_x_residual", "figure4_x_tails",
    "figure4_v_residual", "figure5_d_rho_d_z",
    "figure6_d_rho_d_z_vs_p", "figure7_p", "figure8_p_vs_p", "pulls", "pulls_vs_p", "resolution_vs_cos_theta",
    "chi2_probability", "event",
)  # fmt: skip
RESULTS = (
    "x_residual_rms", "x_residual_core", "x_single_strip_fraction", "v_residual_sigma", "sigma_dr", "sigma_dz",
    "sigma_p", "sigma_dr_idc", "sigma_dz_idc", "sigma_p_idc", "x_residual_rms_gap3mm", "x_residual_core_gap3mm",
    "x_single_strip_fraction_gap3mm", "x_residual_rms_1mm", "x_residual_rms_2mm", "x_residual_rms_3mm",
    "x_residual_rms_5mm", "x_residual_rms_all",
    *(f"delta_fraction_{way}_{far}" for way in ("rphi", "z") for far in ("200um", "500um", "1mm", "2mm", "5mm")),
)  # fmt: skip
GUN = cgemit.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Return a small reproduction with its files."""
    shown = []
    result = reproduce(
        tmp_path_factory.mktemp("study") / "out",
        events=400,
        seed=3,
        pdf=True,
        progress=lambda part, label: shown.append(part),
    )
    assert shown[0] >= 0
    assert shown == sorted(shown)
    assert shown[-1] == 1.0
    return result


@pytest.fixture(scope="module")
def result():
    """Return a run of the chain."""
    return cgemit.run("besiii-cgem-design", GUN, 400, 5)


@pytest.mark.slow
def test_all_figures_are_written_as_png_and_pdf(study):
    for name in FIGURES:
        assert (study.folder / f"{name}.png").read_bytes().startswith(b"\x89PNG"), name
        assert (study.folder / f"{name}.pdf").read_bytes().startswith(b"%PDF"), name
    assert [path.name for path in study.folder.iterdir() if path.name.startswith(".")] == [".cgemit"]


@pytest.mark.slow
def test_a_study_has_pdf_files_only_if_asked(study, tmp_path):
    plain = reproduce(tmp_path / "out", events=400, seed=3)
    names = {path.name for path in plain.folder.iterdir()}
    assert names == {path.name for path in study.folder.iterdir() if path.suffix != ".pdf"}
    assert ".pdf" not in (plain.folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_summary(study):
    summary = json.loads((study.folder / "summary.json").read_text())
    assert summary == json.loads(json.dumps(study.summary()))
    assert tuple(row["id"] for row in summary["results"]) == RESULTS
    for row in summary["results"]:
        assert row.keys() == {"id", "detector", "value", "error", "unit", "paper", "note"}
        assert row["error"] > 0
    curves = {(curve["id"], curve["detector"]): curve for curve in summary["curves"]}
    assert set(curves) == {(name, detector) for name in ("sigma_dr", "sigma_dz", "sigma_p") for detector in DETECTORS}
    for curve in curves.values():
        assert curve["x"] == list(MOMENTA)
        assert len(curve["y"]) == len(curve["y_error"]) == len(MOMENTA)
        assert all(value > 0 for value in curve["y"] + curve["y_error"])
    assert summary["seed"] == 3
    assert summary["inputs"]["events"] == 400
    assert summary["inputs"]["events_per_momentum"] == 100
    assert summary["timings"]["total_s"] > 0
    assert len(summary["removed"]) == 3 + 2 * len(MOMENTA)


@pytest.mark.slow
def test_removed_rows_add_up(study):
    for sample in [*study.samples.values(), *study.scans["cgem"], *study.scans["idc"]]:
        good = int(np.count_nonzero(sample.tracks["status"] == 0))
        assert good + sum(sample.removed.values()) == sample.n_events
        assert sum(sample.transport.values()) == sample.n_events


def without_symbols(page):
    """Return the report with d_z in place of its symbol, as results name it."""
    return re.sub(r"<i>d</i><sub>(.)</sub>", r"d_\1", page)


@pytest.mark.slow
def test_report_is_self_contained_and_complete(study):
    page = (study.folder / "report.html").read_text(encoding="utf-8")
    parsed = outline(page, study.folder)
    assert {path.name for path in study.folder.iterdir() if path.suffix in (".csv", ".pdf")} - {
        "momentum_scan.csv"
    } <= set(parsed.values("href"))
    assert parsed.tags.count("figure") == len(FIGURES)
    page = without_symbols(page)
    for text in ("217.1", "187.6 µm", "delta electrons", "assigned by truth", "--seed 3"):
        assert text in page, text
    for row in study.results:
        in_per_cent = row.id.startswith("delta_fraction_")  # a line for each distance
        text = with_error(100 * row.value, 100 * row.error) if in_per_cent else row.title.removeprefix("X residual, ")
        assert text in page


@pytest.mark.slow
def test_tables_carry_units_and_the_numbers_of_the_figures(study):
    tables = {path.stem: list(csv.reader(path.read_text().splitlines())) for path in study.folder.glob("*.csv")}
    assert tables["figure4_x_residual"][0] == ["low (um)", "high (um)", "all", "single strip", "several strips"]
    counts = np.array(tables["figure4_x_residual"][1:], float)
    np.testing.assert_array_equal(counts[:, 2], counts[:, 3] + counts[:, 4])
    x = 1e3 * study.samples["cgem"].clusters.x
    assert counts[:, 2].sum() == np.count_nonzero(np.abs(x) <= 500)
    tails = np.array(tables["figure4_x_tails"][1:], float)
    assert tails[:, 2].sum() == np.count_nonzero(np.abs(x) <= 8000)
    lines = [line for line in tables["figure8_p_vs_p"][1:] if line[1] == "besiii-idc"]
    idc = next(line for line in study.curves if (line.id, line.detector) == ("sigma_p", "besiii-idc"))
    np.testing.assert_allclose([float(line[4]) for line in lines], idc.y, rtol=1e-6)
    for name, rows in tables.items():
        assert len(rows) > 2, name
        assert not any("nan" in cell for row in rows for cell in row), name


@pytest.mark.slow
def test_study_depends_on_the_seed_and_not_on_threads():
    one, two, other = (reproduce(events=400, seed=seed, threads=n) for seed, n in ((1, 1), (1, 2), (2, 1)))
    assert one == two
    assert one != other
    assert one.results == two.results
    assert all(a.value != b.value for a, b in zip(one.results, other.results, strict=True) if "fraction" not in a.id)


@pytest.mark.slow
def test_what_the_paper_gives_is_printed(study):
    """The other numbers are counted; they are in the results."""
    given = [row.id for row in study.results if row.paper is not None]
    _, _, *rows, note = repr(study).splitlines()
    assert [row.split()[0] for row in rows] == given
    assert note.startswith(f"report.html: {len(study.results) - len(given)} numbers")


def test_notes_compare_in_the_right_direction():
    assert results.explain_idc("dr", 300.0, 150.0).startswith("2.00 times the CGEM value")
    assert "10.0 % more than with the nominal gap" in results.explain_gap_variant(3.0, 110.0, 100.0)
    assert results.deviation(90.0, 5.0, 100.0) == "10.0 % below the paper (2.0 standard errors)"


def test_notes_hold_the_numbers_of_their_rows(monkeypatch):
    """The gap and the nominal value; the residuals outside of each window, beside Geant4's RMS in the same one."""
    detector = load("besiii-cgem-design").with_overrides({"cgem.*.drift_gap": "3 mm"})
    sample = SimpleNamespace(detector=detector, settings=Settings(), clusters=None)
    numbers = {name: (value, 1.0) for name, value in (("x_residual_rms", 110.0), ("x_residual_core", 90.0))}
    monkeypatch.setattr(results, "_x_numbers", lambda _: numbers)
    more, less = results._gap_rows(sample, dict.fromkeys(numbers, 100.0))
    assert "10.0 % more than with the nominal gap: in a 3 mm gap" in more.note
    assert "10.0 % less than with the nominal gap: in a 3 mm gap" in less.note
    windows = list(results.X_WINDOWS.values())

    def widths(_, window):
        return SimpleNamespace(rms=200.0, rms_error=1.0, outside=11 + windows.index(window), n=345)

    monkeypatch.setattr(results, "x_widths", widths)
    for number, row in enumerate(results._window_rows(sample)):
        few = f"{11 + number} of 345 residuals are outside"
        assert row.note.startswith(few if number + 1 < len(windows) else "A few clusters decide it")
        for run_of_geant4 in geant4_runs():
            assert f"{run_of_geant4.rms[number]} um ({run_of_geant4.title})" in row.note


@pytest.fixture(scope="module")
def found():
    """Return a small reproduction with found tracks."""
    return reproduce(events=400, seed=3, finder="ckf")


@pytest.mark.slow
def test_a_finder_changes_the_tracks_and_is_named(study, found, tmp_path):
    """Clusters are the same; resolutions move by less than their errors; every output says who found the hits."""
    assert found != study
    assert "found by ckf" in repr(found)
    assert found.summary()["inputs"]["hits"] == "found by ckf"
    for row in study.results:
        same = not row.id.startswith("sigma")
        moved = abs(found[row.id].value - row.value)
        assert moved == 0 if same else 0 < moved < row.error, row.id
    page = paper_report(found, study.folder)
    share = re.search(r"Hits are found by ckf\. .*mu.* Muons of 1 GeV/c with a track: ([\d.]+) % in besiii-cgem", page)
    assert float(share[1]) > 99.5
    assert "--finder ckf" in page
    assert "assigned by truth, which no finder" in paper_report(study, study.folder)
    entries = record_of(found.every_sample, 3)
    assert {one["finder"] for one in entries["source"]} == {"ckf"}
    assert not any("finder" in one for one in record_of(study.every_sample, 3)["source"])


def test_scans_take_a_finder_and_compare_with_fakes():
    """Differences of detectors hold where some tracks belong to no particle."""
    background = cgemit.BackgroundSettings(level="bes2026", factor=2)
    noisy = cgemit.Settings(background=background, find=cgemit.FindSettings(min_score=-20.0))
    how = {"events": 100, "seed": 2, "finder": "ckf", "settings": noisy}
    one, base = (scan(name, [0.5], **how) for name in ("besiii-cgem", "besiii-idc"))
    assert one.hits == "found by ckf"
    assert (one.samples[0].tracks["particle"] < 0).any()
    assert np.isfinite(one.minus(base).columns()["delta_sigma_dr_error (um)"]).all()
    with pytest.raises(ValueError, match="finder: got 'nothing'"):
        scan("besiii-cgem", [0.5], events=10, finder="nothing")


@pytest.mark.slow
def test_study_pickles(study):
    copy = pickle.loads(pickle.dumps(study))
    assert copy == study
    assert copy.display == study.display


def test_too_few_events_and_taken_folders_are_refused_before_work(tmp_path):
    with pytest.raises(ValueError, match="400"):
        reproduce(events=399)
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileExistsError, match="already holds files"):
        reproduce(tmp_path)
    with pytest.raises(FileExistsError, match="is a file"):
        reproduce(tmp_path / "file")


def test_cluster_residuals_against_each_cluster_by_hand(result):
    residuals = cluster_residuals(result)
    clusters, truths = result.clusters, result.truths
    expected = {0: {}, 1: {}}
    for row in np.flatnonzero(clusters["view"] < 2):
        layer = result.detector.cgem[clusters["layer"][row]]
        truth, view = clusters["truth"][row], clusters["view"][row]
        x, y = (0.5 * (truths[f"entry_{c}"][truth] + truths[f"exit_{c}"][truth]) for c in "xy")
        phi = np.arctan2(y, x)  # the middle of the chord, some um from mid-gap
        # The truth at the same turn as the cluster: try all of them.
        turns = layer.r_readout * (phi - layer.sheet_phi[clusters["sheet"][row]] + 2 * np.pi * np.arange(-2, 3))
        if view == 0:
            difference = clusters["x"][row] - turns
        else:
            z = layer.z_ref - truths["z"][truth]
            difference = clusters["v"][row] - turns * np.cos(layer.stereo) - z * np.sin(layer.stereo)
        nearest = difference[np.argmin(np.abs(difference))]
        beyond = abs(nearest) - 0.5 * clusters["size"][row] * 0.65  # the edge of its strips
        if truth not in expected[view] or beyond < expected[view][truth][0]:
            expected[view][truth] = (beyond, nearest)
    for view, found in enumerate((residuals.x, residuals.v)):
        by_truth = [expected[view][truth][1] for truth in sorted(expected[view])]
        np.testing.assert_allclose(found, by_truth, atol=5e-3)
    assert len(residuals.x) == len(residuals.x_size) > 1000
    assert residuals.without_truth == 0
    assert len(residuals.x) + len(residuals.v) + residuals.beside == np.count_nonzero(clusters["view"] < 2)
    share, error = residuals.single_strip_fraction
    assert share == np.mean(residuals.x_size == 1)
    assert 0 < error < 0.02


def test_detectors_without_cgem_have_no_cluster_residuals():
    residuals = cluster_residuals(cgemit.run("besiii-idc", GUN, 5, 1))
    assert len(residuals.x) == len(residuals.v) == 0


def test_fitted_curve_holds_as_many_entries_as_the_histogram(result):
    spectrum = track_spectrum(result.tracks, "dr")
    x, y = spectrum.fit_curve()
    width = spectrum.edges[1] - spectrum.edges[0]
    core = spectrum.resolution
    inside = core.n * (1 - core.tail)
    assert trapezoid(y, x) / width == pytest.approx(inside, rel=1e-3)
    assert spectrum.counts["all"].sum() == core.n - core.outside
    v = v_spectrum(cluster_residuals(result))
    x, y = v.fit_curve()
    assert trapezoid(y, x) / 10.0 == pytest.approx(0.9973 * v.fit.n, rel=1e-3)


def test_parts_of_the_x_histogram(result):
    spectrum = x_spectrum(cluster_residuals(result))
    parts = spectrum.counts["single strip"] + spectrum.counts["several strips"]
    np.testing.assert_array_equal(parts, spectrum.counts["all"])
    assert any("one strip" in line for line in spectrum.statistics())


def test_window_leaves_out_far_tracks_and_counts_them(result):
    far = result.tracks["res_dr"].copy()
    far[:3] = 1000.0
    tracks = result.tracks.with_columns(res_dr=far)
    before, after = (windowed_resolution(table, "dr") for table in (result.tracks, tracks))
    assert after.outside >= before.outside + 2
    assert after.rms == pytest.approx(before.rms, rel=0.05)


@pytest.mark.slow
def test_pictures(result, tmp_path):
    for name in ("dr", "phi0", "kappa", "dz", "tanl", "p"):
        assert draw_of_cgemit.residual(result, name)._repr_png_().startswith(b"\x89PNG")
    assert draw_of_cgemit.residual(result.tracks, "p").axes[0].get_title(loc="left") == ""
    with pytest.raises(ValueError, match="parameter"):
        draw_of_cgemit.residual(result, "charge")
    picture = draw_of_cgemit.event(result, 7)
    assert [path.name for path in picture.save(tmp_path / "p-1.0")] == ["p-1.0.png", "p-1.0.pdf"]
    assert [path.name for path in picture.save(tmp_path / "p.pdf")] == ["p.pdf"]
    with pytest.raises(FileExistsError):
        picture.save(tmp_path / "p.pdf")
    with pytest.raises(ValueError, match="from 0 to 399"):
        draw_of_cgemit.event(result, 400)
    assert draw_of_cgemit.event(cgemit.run("besiii-idc", GUN, 1, 1)).axes


def test_drawn_event_shows_a_crossing_of_two_x_and_three_v_strips(result):
    event = good_event(result)
    rows = (result.clusters["event"] == event) & (result.clusters["layer"] == 0)
    sizes = {int(view): result.clusters["size"][rows & (result.clusters["view"] == view)].tolist() for view in (0, 1)}
    assert sizes == {0: [2], 1: [3]}


def test_helix_points_meet_the_true_crossings():
    settings = cgemit.Settings(simulate=cgemit.SimulateSettings(fluctuations="off"))
    result = cgemit.run("besiii-cgem-design", cgemit.Gun("mu+", p=0.5, cos_theta=0.3), 20, 1, settings=settings)
    truths = result.truths
    for row in range(20):
        helix = np.array([result.tracks[f"truth_{name}"][row] for name in ("dr", "phi0", "kappa", "dz", "tanl")])
        x, y, z = helix_points(helix, result.detector.field.bz, 200.0, 1000.0, n=4000)
        for hit in np.flatnonzero(truths["event"] == row):
            r = truths["r"][hit]
            phi = np.interp(r, np.hypot(x, y), near(np.arctan2(y, x), truths["phi"][hit]))
            # The loss of energy on the way bends the track by some um more.
            assert abs(r * (phi - truths["phi"][hit])) < 0.05
            assert np.interp(r, np.hypot(x, y), z) == pytest.approx(truths["z"][hit], abs=0.05)


def test_seeds_of_samples_differ():
    seeds = {seed_of(seed, number) for seed in range(50) for number in range(50)}
    assert len(seeds) == 2500
    assert all(0 <= seed < 2**64 for seed in seeds)


@pytest.mark.usefixtures("undrawn")
def test_scan_prints_and_refuses_to_overwrite(tmp_path):
    detector = cgemit.load("besiii-cgem-design")
    result = scan(detector, [0.2, 1.0], cos_theta=0.0, events=50)
    assert len(repr(result).splitlines()) == 4
    assert "<table>" in result._repr_html_()
    result.save(tmp_path / "out")
    with pytest.raises(FileExistsError):
        result.save(tmp_path / "out")
    assert result.lines[0].y[0] > result.lines[0].y[1]


def test_every_curve_of_a_picture_has_a_look_of_its_own():
    x = np.array([1.0, 2.0])
    lines = [Line("sigma_p", f"d{i}", x, "GeV/c", x, 0.1 * x, "MeV/c") for i in range(12)]
    (axes,) = draw_resolutions([("σ(p)", lines)], "p").axes
    curves = [bars.lines[0] for bars in axes.containers]
    assert len({(curve.get_marker(), curve.get_color()) for curve in curves}) == 12
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [f"d{i}" for i in range(12)]


def line_at(x, y, y_error):
    """Return a curve of σ(p)."""
    return Line("sigma_p", "one", np.array(x), "GeV/c", np.array(y), np.array(y_error), "MeV/c")


def test_curves_show_whole_error_bars_and_every_momentum():
    """Points with their errors, a published point and momenta without a fitted track lie within the axes."""
    line = line_at([0.2, 0.5, 1.0], [math.nan, 4.0, 5.0], [math.nan, 0.1, 2.0])
    (axes,) = draw_resolutions([("σ(p)", [line])], "p").axes
    assert 7.0 < axes.get_ylim()[1] < 8.0
    assert axes.get_xlim()[0] < 0.2
    assert axes.get_xlim()[1] > 1.0
    assert not axes.texts
    (axes,) = draw_resolutions([("σ(p)", [line])], "p", [(1.0, 9.0)]).axes
    assert axes.get_ylim()[1] > 9.0
    (_, axes) = draw_grid([[("σ(p)", [line]), ("pull", [line])]], "p", unity_rows=[0]).axes
    assert axes.get_ylim()[1] > 7.0


def test_curves_without_a_track_say_so():
    """The range is that of the momenta asked for."""
    (axes,) = draw_resolutions([("σ(p)", [line_at([0.5, 1.0], [math.nan] * 2, [math.nan] * 2)])], "p").axes
    assert [text.get_text() for text in axes.texts] == ["no fitted track, or fewer than ten"]
    assert 0.4 < axes.get_xlim()[0] < 0.5 < 1.0 < axes.get_xlim()[1] < 1.1


@pytest.mark.parametrize("n", [30, 400])
def test_statistics_do_not_hide_the_highest_error_bar(result, n):
    """Those beside a box, which is opaque, end below it."""
    picture = draw_of_cgemit.residual(result.tracks[:n], "dz")
    (axes,) = picture.axes
    picture.draw_without_rendering()
    spectrum = track_spectrum(result.tracks[:n], "dz")
    counts, centres = spectrum.counts["all"], 0.5 * (spectrum.edges[1:] + spectrum.edges[:-1])
    assert len(axes.texts) == 2
    for text in axes.texts:
        box = text.get_bbox_patch().get_window_extent().transformed(axes.transData.inverted())
        below = counts[(centres > box.x0) & (centres < box.x1)]
        assert (below + np.sqrt(below) < box.y0).all()


def test_line_without_value_is_null_in_json():
    values = np.array([1.0, np.nan])
    line = Line("sigma_p", "d", values, "GeV/c", values, values, "MeV/c")
    assert line.as_json()["y"] == [1.0, None]


def test_csv(tmp_path):
    write_csv(tmp_path / "t.csv", {"a (mm)": [1.5, 2.0], "b": [1, 2], "c": ["x, y", "z"]})
    assert (tmp_path / "t.csv").read_text() == 'a (mm),b,c\n1.5,1,"x, y"\n2,2,z\n'
    assert not re.search(r"\r", (tmp_path / "t.csv").read_bytes().decode())


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [{"seed": -1}, {"seed": 1.5}, {"seed": "a"}, {"events": "x"}, {"threads": 0}])
@pytest.mark.parametrize("study", [reproduce, partial(scan, cgemit.load("besiii-idc"), [1.0])])
def test_numbers_that_are_none(study, numbers):
    (name,) = numbers
    with pytest.raises(ValueError, match=rf"{name}: .*, expected a whole number from [014]+ to \d+$"):
        study(**numbers)


def test_all_wrong_numbers_of_a_study_at_once():
    with pytest.raises(ValueError, match=r"\n  events: got 399, .* 400 to .*\n  threads: got 0, .*\n  seed: got -1, "):
        reproduce(quick=True, events=399, seed=-1, threads=0)


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
    assert columns.keys() == row_columns(scanned.samples).keys()
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
        text = "\n".join(one.get_text().replace("\n", ": ") for one in axes.texts)
        unit = {"dr": "µm", "dz": "mm", "p": "MeV/c"}[name]
        assert f"core: {with_error(core.core, core.core_error)} {unit}" in text
        assert f"q68: {with_error(core.q68, core.q68_error)} {unit}" in text
        assert f"mean: {with_error(core.core_mean, core.core_mean_error)} {unit}".replace("-", "−") in text
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
        assert plot.get_xlabel() == f"pull of {mathematical(name)}"
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
def report(study):
    """Return the tables of the report by the heading of their first column."""
    parser = Tables()
    parser.feed(without_symbols((study.folder / "report.html").read_text(encoding="utf-8")))
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
        counts = [int(part.split()[0]) for part in cells["left out"].split(", ") if part != "none"]
        assert sum(counts) == bad
        ends = {part.split()[1]: int(part.split()[0]) for part in cells["end of transport"].split(", ")}
        assert ends == dict(sample.transport)
        assert int(cells["clusters without truth"]) == sample.clusters.without_truth
