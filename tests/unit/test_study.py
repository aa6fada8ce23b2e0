"""The reproduction of the paper: its files, and the small calculations it consists of."""

import csv
import json
import math
import pickle
import re
from functools import partial

import numpy as np
import pytest
from scipy.integrate import trapezoid
from test_report import outline

import cgemit
from cgemit import draw
from cgemit.analysis.clusters import cluster_residuals, v_spectrum, x_spectrum
from cgemit.analysis.curves import Line, track_spectrum, windowed_resolution
from cgemit.draw.curves import draw_grid, draw_resolutions
from cgemit.draw.event import helix_points, near
from cgemit.study import reproduce
from cgemit.study.paper import DETECTORS, MOMENTA
from cgemit.study.paper.figures import good_event
from cgemit.study.paper.report import paper_report
from cgemit.study.samples import record_of, seed_of
from cgemit.study.scan import scan
from cgemit.tables.show import with_error, write_csv

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
        tmp_path_factory.mktemp("study") / "out", events=400, seed=3, progress=lambda part, label: shown.append(part)
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
    assert not [path.name for path in study.folder.iterdir() if path.name.startswith(".")]


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


@pytest.mark.slow
def test_report_is_self_contained_and_complete(study):
    page = (study.folder / "report.html").read_text(encoding="utf-8")
    parsed = outline(page, study.folder)
    assert {path.name for path in study.folder.iterdir() if path.suffix in (".csv", ".pdf")} - {
        "momentum_scan.csv"
    } <= set(parsed.values("href"))
    assert parsed.tags.count("figure") == len(FIGURES)
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
def test_study_prints_itself(study):
    assert "x_residual_rms" in repr(study)
    assert "<table>" in study._repr_html_()
    assert study["sigma_dr"].unit == "um"
    with pytest.raises(KeyError, match="sigma_dr"):
        study["sigma"]


@pytest.mark.slow
def test_study_depends_on_the_seed_and_not_on_threads():
    one, two, other = (reproduce(events=400, seed=seed, threads=n) for seed, n in ((1, 1), (1, 2), (2, 1)))
    assert one == two
    assert one != other
    assert one.results == two.results
    assert all(a.value != b.value for a, b in zip(one.results, other.results, strict=True) if "fraction" not in a.id)


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
    share = re.search(r"Hits are found by ckf\. Muons of 1 GeV/c with a track: ([\d.]+) % in besiii-cgem-design", page)
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
        assert draw.residual(result, name)._repr_png_().startswith(b"\x89PNG")
    assert draw.residual(result.tracks, "p").axes[0].get_title(loc="left") == ""
    with pytest.raises(ValueError, match="parameter"):
        draw.residual(result, "pt")
    picture = draw.event(result, 7)
    assert [path.name for path in picture.save(tmp_path / "p-1.0")] == ["p-1.0.png", "p-1.0.pdf"]
    assert [path.name for path in picture.save(tmp_path / "p.pdf")] == ["p.pdf"]
    with pytest.raises(FileExistsError):
        picture.save(tmp_path / "p.pdf")
    with pytest.raises(ValueError, match="from 0 to 399"):
        draw.event(result, 400)
    assert draw.event(cgemit.run("besiii-idc", GUN, 1, 1)).axes


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
    """It ends below the box, which is opaque."""
    picture = draw.residual(result.tracks[:n], "dz")
    (axes,) = picture.axes
    picture.draw_without_rendering()
    box = axes.texts[0].get_bbox_patch().get_window_extent().transformed(axes.transData.inverted())
    n = track_spectrum(result.tracks[:n], "dz").counts["all"].max()
    assert n + np.sqrt(n) < box.y0


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
    with pytest.raises(ValueError, match=r"study:\n  events: 399, .* 400 to .*\n  seed: -1, .*\n  threads: 0, "):
        reproduce(quick=True, events=399, seed=-1, threads=0)


@pytest.mark.slow
def test_notes_of_other_readouts_do_not_speak_of_projected_strips():
    """Rows of clusters name the read-out; numbers of tracks keep their notes."""
    analog = cgemit.Settings(digitize=cgemit.DigitizeSettings(readout="tiger"))
    study = reproduce(events=400, settings=analog)
    for row in study.results:
        if row.id.startswith(("x_", "v_")):
            assert "binary" in row.note or "tiger" in row.note or "nominal gap" in row.note, row
            assert "sqrt" not in row.note
            assert "Geant4" not in row.note
    assert any("Read-out tiger" in row.note for row in study.results)
    assert not any("Read-out" in row.note for row in reproduce(events=400).results)
