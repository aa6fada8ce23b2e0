"""The tidy table of scans: numbers recomputed from the tracks, paired differences, angles and momenta."""

from __future__ import annotations

import csv
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.clusters import cluster_residuals
from cgemit.analysis.quantities import QUANTITIES, REPORTED
from cgemit.cli.main import main
from cgemit.covariance.tracks import core_width
from cgemit.draw.curves import resolutions
from cgemit.draw.style import mathematical
from cgemit.study import measure, scan, scan_analytic
from cgemit.study.evaluation import seed_of
from cgemit.study.scan import columns_of, save_scans
from cgemit.tables.schema import has_momentum

pytestmark = pytest.mark.usefixtures("undrawn")

DESIGN = "besiii-cgem-design"


@pytest.fixture(scope="module")
def pair() -> list[Any]:
    """Scans of two variants of a detector with the same events."""
    other = cg.load(DESIGN).with_overrides({"cgem.*.pitch_x": "700 um", "name": "wide"})
    return [scan(one, [0.4, 1.0], cos_theta=(-0.5, 0.5), events=400, seed=7) for one in (DESIGN, other)]


def by_hand(tracks: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return residuals and errors of each quantity in the unit of its column, from momentum vectors."""
    good = {name: column[has_momentum(tracks)] for name, column in tracks.columns.items()}
    fitted, true = ([good[f"{start}{name}"] for name in ("kappa", "tanl")] for start in ("", "truth_"))
    pt, true_pt = (1 / np.abs(kappa) for kappa, _ in (fitted, true))
    theta, true_theta = (np.arccos(tanl / np.sqrt(1 + tanl**2)) for _, tanl in (fitted, true))
    p, true_p = (np.hypot(1, tanl) / np.abs(kappa) for kappa, tanl in (fitted, true))
    turn = (good["phi0"] - good["truth_phi0"] + np.pi) % (2 * np.pi) - np.pi
    err_pt = pt * good["err_kappa"] * pt
    return {
        "dr": (1e3 * (good["dr"] - good["truth_dr"]), 1e3 * good["err_dr"]),
        "dz": (good["dz"] - good["truth_dz"], good["err_dz"]),
        "p": (1e3 * (p - true_p), 1e3 * good["err_p"]),
        "pt": (1e3 * (pt - true_pt), 1e3 * err_pt),
        "p_rel": (100 * (p - true_p) / true_p, 100 * good["err_p"] / p),
        "pt_rel": (100 * (pt - true_pt) / true_pt, 100 * err_pt / pt),
        "phi0": (1e3 * turn, 1e3 * good["err_phi0"]),
        "theta": (1e3 * (theta - true_theta), 1e3 * good["err_tanl"] * np.sin(theta) ** 2),
        "tanl": (1e3 * (good["tanl"] - good["truth_tanl"]), 1e3 * good["err_tanl"]),
    }


@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_a_sample_has_the_tracks_and_residuals_of_a_whole_run(finder: str) -> None:
    """Though it keeps a third of the tables; also where clusters and drift times are refined, and states wanted."""
    settings = cg.Settings(
        digitize=cg.DigitizeSettings(wire_times="raw"),
        fit=cg.FitSettings(states=("beam_pipe",), residuals=True),
    )
    detector = cg.load(DESIGN).with_readout(cg.TigerReadout(second_pass=True))
    (sample,) = scan(detector, [0.5], cos_theta=0.2, events=30, settings=settings, finder=finder).orders
    run = cg.run(detector, sample.gun, 30, sample.seed, settings=settings, finder=finder)
    assert sample.tracks == run.tracks
    for name, values in vars(cluster_residuals(run)).items():
        np.testing.assert_array_equal(getattr(sample.clusters, name), values)
    assert sample.deltas == cg.study.delta_fractions(run)
    assert (sample.removed, sample.transport) == (run.removed(), run.transport())


UNITS = {
    "dr": "um", "dz": "mm", "p": "MeV/c", "pt": "MeV/c", "p_rel": "%", "pt_rel": "%", "phi0": "mrad", "theta": "mrad",
    "tanl": "1e-3",
}  # fmt: skip


def test_every_number_of_the_table_is_that_of_the_tracks(pair: list[Any], tmp_path: Path) -> None:
    save_scans(pair, tmp_path / "out")
    with (tmp_path / "out" / "resolution.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    samples = [sample for one in pair for sample in one.samples]
    assert set(REPORTED) == UNITS.keys()
    for row, sample in zip(rows, samples, strict=True):
        assert (row["name"], row["hash"]) == (sample.detector.name, sample.detector.content_hash)
        assert (row["particle"], row["method"], row["cos_theta"]) == ("mu-", "mc", "-0.5:0.5")
        assert float(row["p (GeV/c)"]) == sample.gun.p
        for name, (residuals, errors) in by_hand(sample.tracks).items():
            widths, unit = measure(residuals), UNITS[name]
            for head, what in (("sigma", "core"), ("q68", "q68"), ("rms", "rms")):
                assert float(row[f"{head}_{name} ({unit})"]) == pytest.approx(getattr(widths, what), rel=1e-6)
                error = getattr(widths, f"{what}_error")
                assert float(row[f"{head}_{name}_error ({unit})"]) == pytest.approx(error, rel=1e-6)
            assert float(row[f"median_error_{name} ({unit})"]) == pytest.approx(np.median(errors), rel=1e-6)
    with (tmp_path / "out" / "summary.json").open(encoding="utf-8") as stream:
        curves = json.load(stream)["curves"]
    assert [(one["id"], one["y_unit"]) for one in curves] == 2 * [(f"sigma_{n}", UNITS[n]) for n in REPORTED]
    assert {one["particle"] for one in curves} == {"mu-"}
    with (tmp_path / "out" / "summary.json").open(encoding="utf-8") as stream:
        summary = json.load(stream)
    assert summary["timings"] == {"total_s": pair[0].seconds + pair[1].seconds}
    inputs = {"particle": "mu-", "momenta": [0.4, 1.0], "events": 400, "method": "mc", "detectors": [DESIGN, "wide"]}
    assert inputs.items() <= summary["inputs"].items()
    assert summary["seed"] == 7
    with (tmp_path / "out" / "run.json").open(encoding="utf-8") as stream:
        source = json.load(stream)["source"]
    assert [one["label"] for one in source] == [sample.label for sample in samples]
    for one, sample in zip(source, samples, strict=True):  # each sample is made again from its record
        assert one["events"] == 400
        again = cg.run(sample.detector, sample.gun, 5, one["seed"]).tracks
        assert again["dr"].tobytes() == sample.tracks["dr"][:5].tobytes()


def test_columns_of_sweeps_have_the_same_names_and_numbers() -> None:
    found = scan(DESIGN, [1.0], cos_theta=0.0, events=200, seed=3).to_pandas()
    swept = cg.study.sweep(
        DESIGN,
        {"cgem.L1.pitch_x": ["600 um"]},
        evaluate=cg.study.Evaluation("mc", p=[1.0], cos_theta=0.0, events=200, seed=3),
    ).to_pandas()
    shared = [name for name in swept if name.startswith("sigma_")]
    assert len(shared) == 14
    for name in (*shared, "fitted", "events", "name", "hash", "p (GeV/c)", "cos_theta"):
        assert found[name][0] == swept[name][0], name


def test_differences_have_the_errors_of_pairs(pair: list[Any]) -> None:
    columns = columns_of(pair)
    assert columns["delta_sigma_dr (um)"][:2] == ["", ""]
    base, other = (one.samples[1] for one in pair)
    for name, unit in UNITS.items():
        mine, theirs = (by_hand(one.tracks)[name] for one in (other, base))
        groups = [one.tracks["event"][has_momentum(one.tracks)] % 20 for one in (other, base)]
        expected = measure(mine[0]).core - measure(theirs[0]).core
        assert columns[f"delta_sigma_{name} ({unit})"][3] == pytest.approx(expected, rel=1e-9)
        left_out = np.array([
            measure(mine[0][groups[0] != k]).core - measure(theirs[0][groups[1] != k]).core for k in range(20)
        ])  # fmt: skip
        error = np.sqrt(19 / 20 * np.sum((left_out - left_out.mean()) ** 2))
        assert columns[f"delta_sigma_{name}_error ({unit})"][3] == pytest.approx(error, rel=1e-9)
        medians = np.median(mine[1]) - np.median(theirs[1])
        assert columns[f"delta_median_error_{name} ({unit})"][3] == pytest.approx(medians, rel=1e-9)
    paired = other.minus(base, "dz")[1]
    apart = np.hypot(*(measure(by_hand(one.tracks)["dz"][0]).core_error for one in (other, base)))
    assert paired < 0.9 * apart
    found = pair[1].minus(pair[0])
    text = repr(found).splitlines()
    frame = found.to_pandas()
    assert frame["delta_sigma_dz (mm)"].tolist() == columns["delta_sigma_dz (mm)"][2:]
    assert found._repr_html_().count("<tr>") == 3
    with pytest.raises(ValueError, match="got different particles"):
        pair[1].minus(scan(DESIGN, [0.4, 1.0], cos_theta=(-0.5, 0.5), events=40))
    assert text[0].startswith("wide minus besiii-cgem-design, mu-: differences of core widths")
    value = columns["delta_sigma_dr (um)"][2]
    assert float(text[2].split()[1]) == pytest.approx(value, abs=abs(columns["delta_sigma_dr_error (um)"][2]) / 15)


def test_transverse_momenta_and_angles_are_those_of_the_gun() -> None:
    found = scan(DESIGN, pt=[0.5], theta="60 deg", events=30, seed=2)
    tracks = found.samples[0].tracks
    np.testing.assert_allclose(1 / np.abs(tracks["truth_kappa"]), 0.5, rtol=1e-3)
    np.testing.assert_allclose(tracks["truth_tanl"], 1 / np.tan(np.pi / 3), rtol=1e-6)
    assert found.columns()["pt (GeV/c)"] == [0.5]
    assert found.columns()["theta (rad)"] == [pytest.approx(np.pi / 3)]
    assert "p (GeV/c)" not in found.columns()
    assert repr(found).splitlines()[1].startswith("pt [GeV/c]")
    assert "θ = 1.0472 rad" in repr(found)


def test_analytic_lines_take_transverse_momenta_and_angles() -> None:
    sine = np.sin(np.pi / 3)
    one = scan_analytic(DESIGN, pt=[0.5, 1.0], theta="60 deg")
    other = cg.analytic(DESIGN, "mu-", one.x / sine, 0.5)
    np.testing.assert_allclose(one.sigma("p_rel"), 0.1 * other.sigma("p") / (one.x / sine), rtol=1e-9)
    np.testing.assert_allclose(one.sigma("theta"), other.sigma("theta"), rtol=1e-9)
    assert one.columns()["pt (GeV/c)"] == one.x.tolist()
    assert one.fits == []
    for name, ends, pt in (("theta", (0.5, 2.6), None), ("eta", (-1.0, 1.0), None), ("cos_theta", (-0.8, 0.8), 0.5)):
        momentum = {"p": 1.0} if pt is None else {"pt": pt}
        spread = scan_analytic(DESIGN, **momentum, **{name: ends}).sigma("dz")
        middles = np.linspace(*ends, 401)
        middles = 0.5 * (middles[1:] + middles[:-1])
        each = cg.analytic(DESIGN, **momentum, **{name: middles}).variances("dz")
        assert spread == pytest.approx(core_width(each.reshape(1, -1)), rel=0.01)
    with pytest.raises(ValueError, match=r"pt: got 0\.5:1, expected fixed values with the analytic method"):
        scan_analytic(DESIGN, pt=(0.5, 1.0))
    with pytest.raises(ValueError, match="phi: got all azimuths beside fixed ones"):
        cg.study.Evaluation(phi=[(-np.pi, np.pi), 0.1])
    with pytest.raises(ValueError, match=r"phi: got the range \(0.0, 1.0\), expected numbers"):
        cg.analytic(DESIGN, phi=(0.0, 1.0))


@pytest.mark.parametrize("make", [scan, scan_analytic])
@pytest.mark.parametrize("given", [[], np.array([])])
@pytest.mark.parametrize("name", ["p", "pt"])
def test_momenta_are_a_list_of_at_least_one(make: Any, given: Any, name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}: got .*, expected a list of at least one"):
        make(DESIGN, **{name: given})


def test_wrong_momenta_and_angles_are_listed() -> None:
    for function in (scan, scan_analytic):
        with pytest.raises(ValueError, match=r"(?s)p, pt: got none, .*cos_theta, theta, eta: got cos_theta and"):
            function(DESIGN, cos_theta=0.0, theta=1.0)


def test_the_picture_shows_every_quantity_of_every_scan(pair: list[Any]) -> None:
    picture = resolutions(pair)
    title = "core widths: mu-, cos θ = -0.5 to 0.5 (mixture), 400 simulated events at each momentum"
    assert picture.get_suptitle() == title + ", readout binary, hits assigned by truth"
    for axes, name in zip(picture.axes, REPORTED, strict=True):
        lines = {bar.get_label(): bar.lines[0] for bar in axes.containers}
        assert list(lines) == [DESIGN, "wide"]
        for one in pair:
            curve = next(line for line in one.all_lines if line.id == f"sigma_{name}")
            np.testing.assert_array_equal(lines[one.detector.name].get_xdata(), curve.x)
            np.testing.assert_array_equal(lines[one.detector.name].get_ydata(), curve.y)
        assert axes.get_ylabel().startswith(mathematical(QUANTITIES[name].sigma))
        assert axes.get_ylabel().endswith(f"({UNITS[name].replace('um', 'µm')})")


def test_particles_are_told_apart() -> None:
    scans = [scan_analytic(DESIGN, [0.3, 1.0], cos_theta=0.0, particle=name) for name in ("pi+", "K+")]
    axes = resolutions(scans).axes[0]
    for one, line in zip(scans, axes.lines, strict=True):
        assert line.get_label() == f"{one.orders[0].gun.particle}, analytic"
        np.testing.assert_array_equal(line.get_ydata(), one.sigma("dr"))


def test_several_particles_and_detectors_from_the_shell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["resolution", "-d", DESIGN, "-d", "besiii-idc", "--particle", "pi+", "--particle", "K+", "--pt", "0.5"]
    words += ["--theta", "1:2", "--events", "40", "--quiet"]
    assert main([*words, "-o", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    for particle in ("pi+", "K+"):
        assert f"{DESIGN}, {particle}, θ = 1 to 2 rad (mixture)" in text
        assert f"besiii-idc minus {DESIGN}, {particle}: differences" in text
    with (tmp_path / "out" / "resolution.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["particle"], row["name"]) for row in rows] == [
        (particle, name) for particle in ("pi+", "K+") for name in (DESIGN, "besiii-idc")
    ]
    same = scan("besiii-idc", pt=[0.5], theta=(1.0, 2.0), particle="K+", events=40).columns()
    assert float(rows[3]["sigma_dr (um)"]) == pytest.approx(same["sigma_dr (um)"][0], rel=1e-6)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["inputs"]["particles"] == ["pi+", "K+"]
    assert (summary["inputs"]["pt"], summary["inputs"]["theta"]) == ([0.5], [1.0, 2.0])


def test_titles_name_readout_and_finder() -> None:
    detector = cg.load(DESIGN).with_readout("gaussian")
    one = scan(detector, [1.0], events=60, finder="ckf")
    assert str(one).splitlines()[0].endswith("errors; readout gaussian, hits found by ckf, mass mu")
    assert resolutions([one]).get_suptitle().endswith("momentum, readout gaussian, hits found by ckf")
    line = scan_analytic(detector, [1.0], cos_theta=0.0)
    assert str(line).splitlines()[0].endswith("core widths, analytic; readout gaussian")
    assert resolutions([line]).get_suptitle().endswith("readout gaussian")
    chamber = scan("besiii-idc", [1.0], events=60)
    assert "readout" not in str(chamber) + resolutions([chamber]).get_suptitle()  # it has no CGEM layers


AXES = {
    "p": [1.0, 0.4], "pt": [0.4, 1.0], "cos_theta": [-0.5, 0.0, 0.7], "theta": ["60 deg", 2.0], "eta": [-1.0, 0.5],
    "phi": [0.0, "90 deg"], "d": [0.0, "2 cm"],
}  # fmt: skip


def shot(name: str, values: list[Any]) -> dict[str, Any]:
    """Return the arguments of scans against one variable."""
    return ({} if name in ("p", "pt") else {"p": 0.6}) | {name: values}


@pytest.mark.parametrize("name", AXES)
def test_a_list_has_a_row_for_each_value(name: str) -> None:
    found = scan(DESIGN, **shot(name, AXES[name]), events=30, seed=4)
    native = {"60 deg": np.pi / 3, "90 deg": np.pi / 2, "2 cm": 20.0}
    values = [native.get(value, value) for value in AXES[name]]
    columns = found.columns()
    assert columns[found.against.head.replace("[", "(").replace("]", ")")] == pytest.approx(values)
    for number, (sample, value) in enumerate(zip(found.samples, values, strict=True), start=1):
        given = shot(name, value) | ({} if name in ("cos_theta", "theta", "eta") else {"cos_theta": (-0.93, 0.93)})
        vertex = (given.pop("d", 0.0), 0.0, 0.0)
        again = cg.run(DESIGN, cg.Gun("mu-", vertex=vertex, **given), 30, seed_of(4, number))
        assert sample.tracks == again.tracks
        assert columns["clusters"][number - 1] == pytest.approx(again.tracks["n_clusters"].mean())
        assert columns["efficiency"][number - 1] == np.mean(again.tracks["status"] == 0)
        matter = columns["x0 (%)"][number - 1]
        assert np.isnan(matter) == (vertex[0] > 0)
        if name == "theta":
            assert matter == pytest.approx(cg.material_scan(DESIGN, [np.cos(value)]).total[0])
        elif "cos_theta" in given and name != "cos_theta" and vertex[0] == 0:  # the mean of a range
            cosines = np.linspace(-0.93, 0.93, 400)
            assert matter == pytest.approx(cg.material_scan(DESIGN, cosines).total.mean(), rel=0.01)
    same = scan(DESIGN, **shot(name, None), against={name: AXES[name]}, events=30, seed=4)
    assert str(same) == str(found)
    assert repr(found).splitlines()[1].startswith(found.against.head)


@pytest.mark.parametrize("name", [one for one in AXES if one != "d"])
def test_analytic_lines_against_anything_are_those_of_analytic(name: str) -> None:
    angle = {} if name in ("cos_theta", "theta", "eta") else {"cos_theta": 0.2}
    found = scan_analytic(DESIGN, **shot(name, AXES[name]), **angle)
    assert len(found.x) >= 60
    expected = cg.analytic(DESIGN, **shot(name, found.x), **angle)
    for quantity in ("dr", "p"):
        np.testing.assert_allclose(found.sigma(quantity), expected.sigma(quantity), rtol=1e-9)
        np.testing.assert_allclose(found.sigma(quantity, rms=True), expected.rms(quantity), rtol=1e-9)
    columns = found.columns()
    np.testing.assert_allclose(columns["clusters"], expected.n_clusters, rtol=1e-12)
    np.testing.assert_allclose(columns["wires"], expected.n_wires, rtol=1e-12)
    cosines = np.broadcast_to(expected.cos_theta, found.x.shape)
    np.testing.assert_allclose(columns["x0 (%)"], cg.material_scan(DESIGN, cosines).total, rtol=1e-9)
    asked = cg.analytic(DESIGN, **shot(name, AXES[name]), **angle)
    np.testing.assert_allclose(found.at("dz"), asked.sigma("dz"), rtol=1e-9)
    assert found.columns()[found.against.head.replace("[", "(").replace("]", ")")] == found.x.tolist()


def test_scans_against_a_key_of_the_design() -> None:
    key, values = "cgem.*.pitch_x", ["400 um", "0.8 mm"]
    found = scan(DESIGN, 0.6, cos_theta=0.1, against={key: values}, events=60, seed=4)
    lines = scan_analytic(DESIGN, 0.6, cos_theta=0.1, against={key: values})
    base = cg.load(DESIGN)
    assert found.detector == base
    for number, (sample, value) in enumerate(zip(found.samples, values, strict=True)):
        design = base.with_overrides({key: value})
        gun = cg.Gun("mu-", p=0.6, cos_theta=0.1)
        assert sample.tracks == cg.run(design, gun, 60, seed_of(4, number + 1)).tracks
        assert lines.at("dr")[number] == pytest.approx(float(cg.analytic(design, p=0.6, cos_theta=0.1).sigma("dr")))
    swept = cg.study.sweep(base, {"cgem.L1.pitch_x": ["400 um", "800 um"]}, cg.study.Evaluation(p=0.6, cos_theta=0.1))
    one = scan_analytic(base, 0.6, cos_theta=0.1, against={"cgem.L1.pitch_x": ["400 um", "800 um"]})
    assert one.columns()["cgem.L1.pitch_x (um)"] == [400.0, 800.0]
    np.testing.assert_allclose(one.at("dr"), swept["sigma_dr (um)"][1:], rtol=1e-12)
    assert "p = 0.6 GeV/c, cos θ = 0.1" in str(found)
    words = scan_analytic(DESIGN, 0.6, cos_theta=0.1, against={"cgem.*.readout": ["tiger", "binary"]})
    assert words.columns()["cgem.*.readout"] == ["tiger", "binary"]
    expected = [cg.analytic(DESIGN, p=0.6, cos_theta=0.1, readout=name).sigma("dr") for name in ("tiger", "binary")]
    np.testing.assert_allclose(words.at("dr"), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("given", "label", "ticks"),
    [
        ({"p": 0.6, "cos_theta": [-0.5, 0.0, 0.7]}, "cos θ", {"-0.5": -0.5, "0": 0.0, "0.7": 0.7}),
        ({"pt": [0.3, 0.6]}, "$p_T$  (GeV/c)", {"0.3": 0.3, "0.6": 0.6}),
        ({"p": 0.6, "theta": [1.0, 1.5, 1.51]}, "θ  (rad)", {"1": 1.0, "1.51": 1.51}),  # 1.5 is too near
        ({"p": 0.6, "against": {"cgem.*.pitch_x": ["400 um", "800 um"]}}, "cgem.*.pitch_x  (µm)",
         {"400": 400.0, "800": 800.0}),
        ({"p": 0.6, "against": {"cgem.*.readout": ["tiger", "binary"]}}, "cgem.*.readout", {"tiger": 0, "binary": 1}),
    ],
)  # fmt: skip
def test_the_axis_of_a_picture_has_ticks_at_the_rows(given: Any, label: str, ticks: Any) -> None:
    points, lines = scan(DESIGN, **given, events=60), scan_analytic(DESIGN, **given)
    picture = resolutions([points, lines])
    for axes, name in zip(picture.axes, REPORTED, strict=True):
        assert axes.get_xlabel() == label
        shown = {one.get_text(): at for one, at in zip(axes.get_xticklabels(), axes.get_xticks(), strict=True)}
        assert shown == ticks
        (drawn,) = axes.containers
        np.testing.assert_array_equal(drawn.lines[0].get_xdata(), points.against.x)
        np.testing.assert_array_equal(drawn.lines[0].get_ydata(), [one.width(name).core for one in points.samples])
        line = next(one for one in axes.lines if one.get_label() == f"{DESIGN}, analytic")
        np.testing.assert_array_equal(line.get_xdata(), lines.x)
        np.testing.assert_array_equal(line.get_ydata(), lines.sigma(name))
    assert (
        picture.get_suptitle()
        == f"core widths: mu-, {points.fixed}, 60 simulated events at each "
        + ("momentum" if "pt" in given else "point")
        + ("" if label == "cgem.*.readout" else ", readout binary")
        + ", hits assigned by truth"
    )


def test_lines_of_unordered_values_do_not_go_back() -> None:
    given: Any = {"p": 0.6, "cos_theta": 0.1, "against": {"cgem.L1.pitch_x": ["400 um", "900 um", "600 um"]}}
    lines, points = scan_analytic(DESIGN, **given), scan(DESIGN, **given, events=60)
    assert lines.x.tolist() == [400, 900, 600]
    for one, width in ((lines, lines.at("dr")), (points, points.line("dr").y)):
        (axes, *_) = resolutions([one]).axes
        drawn = axes.lines[0]
        assert drawn.get_xdata().tolist() == [400, 600, 900]
        assert drawn.get_ydata().tolist() == width[[0, 2, 1]].tolist()


def test_labels_of_ticks_do_not_overlap() -> None:
    angles = np.radians(np.linspace(20, 160, 15))
    picture = resolutions([scan_analytic("belle2-like", 1.0, theta=angles.tolist())])
    for axes in picture.axes[: len(REPORTED)]:
        np.testing.assert_allclose(sorted(axes.get_xticks()), angles[2::3])
        axes.figure.canvas.draw()
        boxes = sorted((one.get_window_extent().x0, one.get_window_extent().x1) for one in axes.get_xticklabels())
        assert all(end < start for (_, end), (start, _) in itertools.pairwise(boxes))


def test_a_range_is_a_mixture_and_said() -> None:
    found = scan(DESIGN, against={"theta": [1.0, 1.5]}, p=(0.3, 1.0), events=40, seed=2)
    assert found.fixed == "p = 0.3 to 1 GeV/c (mixture)"
    p = found.samples[1].tracks["truth_p"]
    assert 0.3 < p.min() < 0.4 < 0.9 < p.max() < 1.0
    lines = scan_analytic(DESIGN, against={"theta": [1.0, 1.5]}, p=(0.3, 1.0))
    expected = cg.analytic(DESIGN, p=(0.3, 1.0), theta=[1.0, 1.5])
    np.testing.assert_allclose(lines.at("dr"), expected.sigma("dr"), rtol=1e-9)
    one = scan_analytic(DESIGN, 1.0)
    assert one.fixed == "cos θ = -0.93 to 0.93 (mixture)"
    np.testing.assert_allclose(one.at("dr"), cg.analytic(DESIGN, p=1.0, cos_theta=(-0.93, 0.93)).sigma("dr"))


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"p": [0.3, 1.0], "cos_theta": [0.0, 0.5]}, "p, cos_theta: got lists, expected one list"),
        ({"p": [0.3, 1.0], "against": {"cgem.L1.pitch_x": ["400 um"]}}, "p: got lists beside cgem.L1.pitch_x"),
        ({"against": "theta"}, "against: got 'theta' alone, expected theta with its values"),
        ({"against": "cos_theta"}, "against: got 'cos_theta' alone"),
        ({"p": 1.0, "against": "pt"}, "against: got 'pt' alone"),
        ({"against": ["p"]}, r"against: got \['p'\], expected one of p, pt"),
        ({"against": {3: ["400 um"]}}, "against: got the key 3, expected a dotted key"),
        ({"p": [0.5, 0.5]}, r"p: got \[0.5, 0.5\], expected each value once"),
        ({"against": {"cgem.L1.pitch_x": ["400 um", "400 um"]}}, "cgem.L1.pitch_x: got .*, expected each value once"),
        ({"against": "z"}, "against: got 'z', expected one of p, pt, cos_theta"),
        ({"against": {"theta": [1.0]}, "theta": 1.0}, "against, theta: got both"),
        ({"against": {"theta": [1.0], "eta": [1.0]}}, "against: got 2 keys"),
        ({"against": {"cgem.L1.pitch_y": ["400 um"]}}, "cgem.L1.pitch_y"),
        ({"against": {"cgem.L1.pitch_x": [400]}}, "cgem.L1.pitch_x: got 400"),
        ({"against": {"cgem.L1.pitch_x": "400 um"}}, "cgem.L1.pitch_x: got '400 um', expected a list"),
        ({"against": {"cos_theta": [0.0, 1.5]}}, r"cos_theta\[1\]: got 1.5"),
        ({"p": 1.0, "cos_theta": [0.0, (0.1, 0.5)]}, "cos_theta: got a range in a list"),
        (
            {"against": {"cos_theta": (0.1, 0.5)}},
            'cos_theta: got a range, of which one row is a mixture, expected values, as in "0.1:0.5:5" or "0.1,0.5"',
        ),
        ({"against": "p", "p": "0.3:1"}, "p: got a range, of which one row is a mixture"),
        (
            {"against": {"thteta": [0.5, 1.0]}},
            r'thteta: got an unknown key, expected one of p, pt, cos_theta, .*pitch_x; did you mean "theta"\?',
        ),
    ],
)
def test_what_a_scan_cannot_go_through_is_said(given: Any, text: str) -> None:
    for function in (scan, scan_analytic):
        with pytest.raises(ValueError, match=text):
            function(DESIGN, **given)
