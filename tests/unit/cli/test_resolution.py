"""Resolution curves without events: numbers, files, options and print-out of `cgemit resolution`."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.curves import Line
from cgemit.analysis.quantities import REPORTED
from cgemit.chain.settings import Settings
from cgemit.cli.main import main
from cgemit.cli.options import values_of_key
from cgemit.draw.curves import draw_resolutions
from cgemit.reconstruction.fit import FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.study import fit_form, scan, scan_analytic
from cgemit.study.scan import compared, fits_text, line_values, save_scans
from cgemit.tables.schema import has_momentum

pytestmark = pytest.mark.usefixtures("undrawn")

DESIGN, IDC = "besiii-cgem-design", "besiii-idc"
MOMENTA = [0.3, 1.0, 0.5]
UNITS = {"dr": "um", "dz": "mm", "p": "MeV/c"}


@pytest.fixture(scope="module")
def line():
    return scan_analytic(DESIGN, MOMENTA, cos_theta=0.3, particle="pi+")


@pytest.fixture(scope="module")
def points():
    return scan(DESIGN, MOMENTA, cos_theta=0.3, particle="pi+", events=60, seed=2)


def rows_of(path):
    with path.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_momenta_of_a_line():
    found = line_values(MOMENTA)
    assert len(found) >= 60
    assert (found[0], found[-1]) == (0.3, 1.0)
    assert set(MOMENTA) <= set(found.tolist())
    assert np.all(np.diff(found) > 1e-6)
    assert np.max(found[1:] / found[:-1]) <= (1.0 / 0.3) ** (1 / 59) * (1 + 1e-9)
    assert line_values([0.7]).tolist() == [0.7]
    assert line_values([0.7, 0.7]).tolist() == [0.7]


def test_momenta_over_a_decade_have_a_logarithmic_axis_with_ticks_at_the_points():
    x = np.array([0.1, 0.105, 0.2, 0.5, 1.0])
    simulated = Line("sigma_dr", DESIGN, x, "GeV/c", x, 0 * x, "um", "mc", "mu-")
    (axes,) = draw_resolutions([("σ(d_ρ)", [simulated])], "p").axes
    assert axes.get_xscale() == "log"
    # 0.1 is too near to 0.105.
    labels = {label.get_text(): tick for tick, label in zip(axes.get_xticks(), axes.get_xticklabels(), strict=True)}
    assert labels == {"0.105": 0.105, "0.2": 0.2, "0.5": 0.5, "1": 1.0}
    (drawn,) = axes.containers
    np.testing.assert_array_equal(drawn.lines[0].get_xdata(), x)
    low, high = axes.get_xlim()
    assert 0.05 < low < 0.1
    assert 1.0 < high < 2.0
    for changed in ({"x": 0.11 + x}, {"x_unit": ""}):  # less than a decade; no momenta
        (axes,) = draw_resolutions([("σ(d_ρ)", [replace(simulated, **changed)])], "p").axes
        assert axes.get_xscale() == "linear"


def test_many_momenta_have_round_ticks():
    x = np.geomspace(0.12, 3.0, 60)
    line = Line("sigma_dr", DESIGN, x, "GeV/c", x, 0 * x, "um", method="analytic", particle="mu-")
    (axes,) = draw_resolutions([("σ(d_ρ)", [line])], "p").axes
    assert sorted(axes.get_xticks()) == [0.2, 0.5, 1.0, 2.0]


def test_lines_are_those_of_analytic(line):
    expected = cg.analytic(DESIGN, "pi+", line.x, 0.3)
    for found, (name, unit) in zip(line.lines, UNITS.items(), strict=True):
        assert (found.id, found.detector, found.method) == (f"sigma_{name}", DESIGN, "analytic")
        assert (found.x_unit, found.y_unit) == ("GeV/c", unit)
        np.testing.assert_array_equal(found.x, line.x)
        np.testing.assert_allclose(found.y, expected.sigma(name), rtol=1e-12)
        assert np.isnan(found.y_error).all()
    pt = line.x * np.sqrt(1 - 0.3**2)
    np.testing.assert_allclose(line.sigma("pt_rel"), 0.1 * expected.sigma("pt") / pt, rtol=1e-9)
    np.testing.assert_allclose(line.at("dz"), expected.sigma("dz")[np.searchsorted(line.x, MOMENTA)])


def test_ranges_and_lists_of_angles():
    of_range = scan_analytic(IDC, [0.5], cos_theta=(-0.8, 0.8))
    np.testing.assert_allclose(of_range.sigma("dz"), cg.analytic(IDC, p=[0.5], cos_theta=(-0.8, 0.8)).sigma("dz"))
    of_list = scan_analytic(IDC, 0.5, cos_theta=[0.6, 0.0])
    expected = cg.analytic(IDC, p=0.5, cos_theta=of_list.x).sigma("dz")
    np.testing.assert_allclose(of_list.sigma("dz"), expected, rtol=1e-12)
    np.testing.assert_allclose(of_list.at("dz"), cg.analytic(IDC, p=0.5, cos_theta=[0.6, 0.0]).sigma("dz"), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "settings", "change"),
    [
        (["--set", "cgem.*.readout=gaussian", "--set", "digitize.reveal_sides=true"],
         Settings(digitize=DigitizeSettings(reveal_sides=True)),
         {"detector": cg.load(DESIGN).with_overrides({"cgem.*.readout": "gaussian"}), "reveal_sides": True}),
        (["--set", "fit.loss=mean", "--cos-theta=-0.5:0.5"], Settings(fit=FitSettings(loss="mean")),
         {"fit": FitSettings(loss="mean"), "cos_theta": (-0.5, 0.5)}),
        (["--set", "cgem.L2.pitch_x=500 um", "--particle", "p"], None,
         {"detector": cg.load(DESIGN).with_overrides({"cgem.L2.pitch_x": "500 um"}), "particle": "p"}),
        (["--threads", "1", "--events", "7"], None, {}),
    ],
)  # fmt: skip
def test_options_are_arguments_of_python(words, settings, change, tmp_path):
    """Each option gives the numbers of `scan_analytic` and of `analytic` itself, in CSV and JSON."""
    out = tmp_path / "out"
    how = ["--method", "analytic", "--p", "0.3,0.6", "--quiet", "-o", str(out)]
    cosine = [] if any("--cos-theta" in word for word in words) else ["--cos-theta", "0.2"]
    assert main(["resolution", "-d", DESIGN, *cosine, *how, *words]) == 0
    given = {"detector": DESIGN, "particle": "mu-", "cos_theta": 0.2} | change
    shot = {name: given[name] for name in ("particle", "cos_theta")}
    same = scan_analytic(given["detector"], [0.3, 0.6], **shot, settings=settings)
    expected = cg.analytic(given.pop("detector"), p=same.x, **given)
    rows, summary = rows_of(out / "resolution.csv"), json.loads((out / "summary.json").read_text())
    assert summary["curves"] == [one.as_json() for one in same.all_lines]
    assert summary["fits"] == [one.as_json() for one in same.fits]
    assert {row["method"] for row in rows} == {"analytic"}
    for curve, (name, unit) in zip(summary["curves"][:3], UNITS.items(), strict=True):
        np.testing.assert_allclose(curve["y"], expected.sigma(name), rtol=1e-12)
        for kind, values in (("sigma", expected.sigma(name)), ("rms", expected.rms(name))):
            column = [float(row[f"{kind}_{name} ({unit})"]) for row in rows]
            np.testing.assert_allclose(column, values, rtol=1e-6)
    usual = cg.analytic(DESIGN, p=same.x, cos_theta=0.2)
    assert np.allclose(expected.sigma("p"), usual.sigma("p"), rtol=1e-9) is (words[0] in ("--threads", "--events"))


def test_no_event_is_simulated(monkeypatch, tmp_path, capsys):
    def forbidden(*_, **__):
        raise AssertionError("events simulated")

    monkeypatch.setattr("cgemit.chain.run.run", forbidden)
    usual = ["resolution", "-d", DESIGN, "--p", "0.5", "--quiet", "-o", str(tmp_path / "out")]
    assert main([*usual, "--method", "analytic"]) == 0
    assert main([*usual, "--method", "both", "--overwrite"]) == 3
    assert "events simulated" in capsys.readouterr().err
    inputs = json.loads((tmp_path / "out" / "summary.json").read_text())["inputs"]
    assert inputs["method"] == "analytic"
    assert "events" not in inputs


def test_files_of_both_methods(line, points, tmp_path):
    save_scans([points, line], tmp_path / "out")
    rows = rows_of(tmp_path / "out" / "resolution.csv")
    assert [row["method"] for row in rows] == ["mc"] * 3 + ["analytic"] * len(line.x)
    for scanned, part in ((points, rows[:3]), (line, rows[3:])):
        for one, (name, unit) in zip(scanned.lines, UNITS.items(), strict=True):
            np.testing.assert_allclose([float(row[f"sigma_{name} ({unit})"]) for row in part], one.y, rtol=1e-6)
            np.testing.assert_allclose([float(row["p (GeV/c)"]) for row in part], one.x, rtol=1e-6)
    assert {row["events"] for row in rows[3:]} == {""}
    assert [row["reached"] for row in rows[3:]] == ["1"] * len(line.x)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [(curve["id"], curve["method"]) for curve in summary["curves"]] == [
        (f"sigma_{name}", method) for method in ("mc", "analytic") for name in REPORTED
    ]
    assert [(fit["quantity"], fit["method"], fit["statistical"]) for fit in summary["fits"]] == [
        (name, method, method == "mc") for method in ("mc", "analytic") for name in ("dr", "dz", "pt_rel")
    ]
    assert summary["inputs"]["method"] == "both"
    assert summary["inputs"]["events"] == 60
    assert summary["inputs"]["detectors"] == [DESIGN]
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [one["events"] for one in record["source"]] == [60] * 3 + [0] * 3
    assert (tmp_path / "out" / "detector.toml").exists()


def test_both_methods_side_by_side(line, points):
    text = compared(points, line).splitlines()
    assert text[1].split("  ")[0] == "p [GeV/c]"
    for place, p in enumerate(MOMENTA):
        cells = [cell for cell in text[2 + place].split("  ") if cell.strip()]
        assert float(cells[0]) == p
        for number, (name, mc) in enumerate(zip(UNITS, points.lines, strict=True)):
            simulated, analytic, ratio = cells[1 + 3 * number : 4 + 3 * number]
            value, error = mc.y[place], mc.y_error[place]
            assert float(simulated.split(" ± ")[0]) == pytest.approx(value, abs=error / 10)
            assert float(analytic) == pytest.approx(line.at(name)[place], rel=1e-3)
            assert float(ratio.split(" ± ")[0]) == pytest.approx(value / line.at(name)[place], abs=0.01)
            assert float(ratio.split(" ± ")[1]) == pytest.approx(error / line.at(name)[place], rel=0.06)
    fits = fits_text([points, line]).splitlines()
    assert [one.split(":")[0] for one in fits] == ["simulated"] * 3 + ["analytic"] * 3


def test_momenta_that_lose_over_5_percent_of_the_tracks_are_named(line, points):
    removed = [{}, {"stopped": 3}, {"stopped": 3, "not_converged": 1}]  # of 60 tracks
    samples = [replace(one, removed=lost) for one, lost in zip(points.samples, removed, strict=True)]
    lossy = replace(points, orders=tuple(samples))
    note = "at 0.5 GeV/c: over 5 % of the tracks are not fitted; the widths of the others may be too small"
    assert points.note() == ""
    assert lossy.note() == note
    assert compared(lossy, line).splitlines()[-1] == note


def test_fits_are_those_of_the_curves(line, points):
    names = {"dr": 0, "dz": 1}
    for scanned in (line, points):
        for fit in scanned.fits:
            if fit.quantity in names:
                curve = scanned.lines[names[fit.quantity]]
                error = None if scanned is line else curve.y_error
                sigma = curve.y
            elif scanned is line:
                sigma, error = line.sigma("pt_rel"), None
            else:
                rows = [s.tracks for s in points.samples]
                ratios = [np.abs(t["truth_kappa"] / t["kappa"])[has_momentum(t)] - 1 for t in rows]
                widths = [cg.study.measure(100 * one) for one in ratios]
                sigma, error = ([getattr(w, what) for w in widths] for what in ("core", "core_error"))
            p = line.x if scanned is line else MOMENTA
            how = {"particle": "pi+", "cos_theta": 0.3, "detector": DESIGN, "method": scanned.method}
            again = fit_form(fit.quantity, p, sigma, error, **how)
            assert str(fit) == str(again)
            # The minimum is flat: rounding of sigma, here computed in another order, moves it by the root of its size.
            assert [fit.a, fit.b, fit.deviation] == pytest.approx([again.a, again.b, again.deviation], rel=1e-7)


def test_lines_and_points_of_a_detector_have_one_colour(line, points):
    other = [replace(one, detector="other", y=2 * one.y) for one in (points.lines[2], line.lines[2])]
    curves = [points.lines[2], other[0], line.lines[2], other[1]]
    (axes,) = draw_resolutions([("σ(p)", curves)], "p").axes
    drawn = {artist.get_label(): artist for artist in axes.lines if not artist.get_label().startswith("_")}
    bars = {bar.get_label(): bar.lines[0] for bar in axes.containers}
    assert drawn.keys() == {f"{DESIGN}, analytic", "other, analytic"}
    assert bars.keys() == {f"{DESIGN}, simulated", "other, simulated"}
    assert {text.get_text() for text in axes.get_legend().get_texts()} == drawn.keys() | bars.keys()
    for name, (point, analytic) in {DESIGN: (curves[0], curves[2]), "other": (curves[1], curves[3])}.items():
        mc, smooth = bars[f"{name}, simulated"], drawn[f"{name}, analytic"]
        assert mc.get_color() == smooth.get_color()
        assert (mc.get_linestyle(), smooth.get_linestyle(), smooth.get_marker()) == ("None", "-", "None")
        assert mc.get_marker() != "None"
        for artist, curve in ((mc, point), (smooth, analytic)):
            order = np.argsort(curve.x)
            np.testing.assert_array_equal(artist.get_xdata(), curve.x[order])
            np.testing.assert_array_equal(artist.get_ydata(), curve.y[order])
    assert drawn[f"{DESIGN}, analytic"].get_color() != drawn["other, analytic"].get_color()
    assert axes.get_ylim()[1] > np.max(other[1].y)


def test_a_single_momentum_is_seen():
    one = scan_analytic(IDC, [0.5], cos_theta=0.0)
    assert one.fits == []
    (axes,) = draw_resolutions([("σ(p)", one.lines[2:])], "p").axes
    assert (axes.lines[0].get_marker(), len(axes.lines[0].get_xdata())) == ("_", 1)


@pytest.mark.parametrize("method", ["analytic", "both"])
def test_no_covariance_anywhere_has_exit_code_3(method, tmp_path, capsys):
    slow = ["resolution", "-d", DESIGN, "--p", "0.01,0.02", "--cos-theta", "0", "--events", "20", "--quiet"]
    assert main([*slow, "--method", method, "-o", str(tmp_path / "out")]) == 3
    captured = capsys.readouterr()
    assert f"{DESIGN}: at 0.01, 0.02 GeV/c: no track has a covariance (stopped)" in captured.err
    assert not captured.out
    assert list(tmp_path.iterdir()) == []


def test_momenta_without_a_covariance_are_named(tmp_path, capsys):
    words = ["resolution", "-d", DESIGN, "-d", IDC, "--p", "0.02,0.5", "--cos-theta", "0", "--quiet"]
    assert main([*words, "--method", "analytic", "-o", str(tmp_path / "out")]) == 0
    tables = capsys.readouterr().out.split("\n\n")
    assert [table.split(",")[0] for table in tables] == [DESIGN, IDC]
    assert "at 0.02 GeV/c: no track has a covariance (stopped)" in tables[0]
    curves = json.loads((tmp_path / "out" / "summary.json").read_text())["curves"]
    assert curves[0]["y"][0] is None
    assert curves[0]["y"][-1] > 0


def test_the_mass_of_another_particle_is_refused(tmp_path, capsys):
    words = ["resolution", "-d", DESIGN, "--p", "1", "--method", "analytic", "--quiet", "-o", str(tmp_path / "out")]
    assert main([*words, "--hypothesis", "pi"]) == 2
    assert "fit.hypothesis: got pi for mu-" in capsys.readouterr().err
    assert main([*words, "--hypothesis", "mu"]) == 0


def test_a_map_has_the_numbers_of_python(tmp_path, capsys):
    out = tmp_path / "out"
    words = ["resolution", "-d", DESIGN, "--method", "analytic", "--map", "--p", "1,0.3", "--cos-theta", "0,0.5"]
    assert main([*words, "--particle", "pi-", "--set", "fit.loss=mean", "-o", str(out)]) == 0
    expected = cg.analytic(
        DESIGN, "pi-", p=np.array([[0.3], [1.0]]), cos_theta=[0.0, 0.5], fit=cg.FitSettings(loss="mean")
    )
    rows = rows_of(out / "map.csv")
    assert [(row["p (GeV/c)"], row["cos_theta"]) for row in rows] == [
        ("0.3", "0"), ("0.3", "0.5"), ("1", "0"), ("1", "0.5")
    ]  # fmt: skip
    for name, unit in UNITS.items():
        column = [float(row[f"sigma_{name} ({unit})"]) for row in rows]
        np.testing.assert_allclose(column, expected.sigma(name).ravel(), rtol=1e-6)
    assert str(expected) in capsys.readouterr().out
    files = {path.name for path in out.iterdir() if path.name != ".cgemit"}
    assert files == {"map.csv", "map.png", "map.pdf", "detector.toml", "run.json"}
    assert json.loads((out / "run.json").read_text())["source"]["p"] == [0.3, 1.0]


def test_a_key_goes_through_values_and_not_through_a_range(tmp_path, capsys):
    words = ["resolution", "-d", DESIGN, "--method", "analytic", "-o", str(tmp_path / "out"), "--against"]
    assert main([*words, "cgem.L1.pitch_x=300 um:400 um"]) == 2
    said = "cgem.L1.pitch_x: got 300 um:400 um, a range; expected A,B,C or A:B:COUNT, such as 300 um:400 um:5"
    assert said in capsys.readouterr().err
    assert main([*words, "cgem.L1.pitch_x=300 um:400 um:x"]) == 2
    assert "--against: cgem.L1.pitch_x: got 'x', expected a whole number" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_map_says_all_that_it_needs(tmp_path, capsys):
    words = ["resolution", "-d", DESIGN, "-d", IDC, "--map", "--p", "1", "--cos-theta", "0:0.5"]
    assert main([*words, "-o", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    for text in ("--p: got [1.0]", "--cos-theta: got (0.0, 0.5)", "--method", "one detector"):
        assert text in said
    assert not (tmp_path / "out").exists()


def test_budgets_and_sensitivities_are_those_of_python(tmp_path, capsys):
    out = tmp_path / "out"
    words = ["resolution", "-d", DESIGN, "--method", "analytic", "--budget", "dr", "--budget", "p", "--sensitivity"]
    words += ["--particle", "pi-", "--set", "fit.loss=mean", "-o", str(out)]
    assert main([*words, "--p", "1,0.2", "--cos-theta", "0.3"]) == 0
    how = {"p": [0.2, 1.0], "cos_theta": 0.3, "fit": cg.FitSettings(loss="mean")}
    expected = cg.analytic(DESIGN, "pi-", **how)
    effects = cg.sensitivity(DESIGN, "pi-", **how)
    said = capsys.readouterr().out
    for name in ("dr", "p"):
        budget = expected.budget(name)
        rows = rows_of(out / f"budget_{name}.csv")
        groups = budget.grouped("part")
        assert [(row["p (GeV/c)"], row["part"]) for row in rows] == [(p, one) for p in ("0.2", "1") for one in groups]
        variances = np.array([float(row[f"variance ({budget.unit}2)"]) for row in rows]).reshape(2, -1)
        np.testing.assert_allclose(variances.sum(axis=1), expected.rms(name) ** 2, rtol=1e-6)
        assert str(budget) in said
    rows = rows_of(out / "sensitivity.csv")
    keys = effects.ordered()
    assert [row["key"] for row in rows[: len(keys)]] == keys
    wanted = [effects.of(key, "dr")[0] for key in keys]
    found = [float(row["dln_sigma_dr (% per %)"] or "nan") for row in rows[: len(keys)]]
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-9)
    assert str(effects) in said
    files = {path.name for path in out.iterdir() if path.name != ".cgemit"}
    names = ("budget_dr", "budget_p", "sensitivity")
    assert files == {"detector.toml", "run.json"} | {f"{one}.{end}" for one in names for end in ("csv", "png", "pdf")}


def test_a_budget_against_angles_has_a_row_for_each(tmp_path):
    out = tmp_path / "out"
    words = ["resolution", "-d", DESIGN, "--method", "analytic", "--budget", "dz", "--pt", "0.5"]
    assert main([*words, "--theta", "60 deg,90 deg,45 deg", "-o", str(out)]) == 0
    budget = cg.analytic(DESIGN, pt=0.5, theta=["45 deg", "60 deg", "90 deg"]).budget("dz")
    rows = rows_of(out / "budget_dz.csv")
    variances = [float(row["variance (mm2)"]) for row in rows]
    np.testing.assert_allclose(variances, budget.table("part")["variance"], rtol=1e-5, atol=1e-12)
    assert len({row["cos_theta"] for row in rows}) == 3


def test_budgets_say_all_that_they_need(tmp_path, capsys):
    words = ["resolution", "-d", DESIGN, "-d", IDC, "--budget", "dr", "--json", "--p", "1,2", "--cos-theta", "0,0.5"]
    assert main([*words, "-o", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    for text in ("several momenta or several angles, not both", "--method: --budget expects analytic",
                 "-d: --budget expects one detector", "--json: --budget has no summary"):  # fmt: skip
        assert text in said
    words = ["resolution", "-d", DESIGN, "--method", "analytic", "--p", "1", "-o", str(tmp_path / "out")]
    assert main([*words, "--budget", "drr", "--cos-theta", "0"]) == 2
    assert "drr" in capsys.readouterr().err
    assert main([*words, "--budget", "p"]) == 2  # over the default range of angles
    assert "expected fixed values" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--p", "1", "--d", "5"], "--d: got --method analytic; expected mc"),
        (["--against", "d=0,10"], "--d: got --method analytic; expected mc"),
        (["--budget", "dr"], "got no --p or --pt; expected one of them, or --against AXIS=VALUES"),
        (["--p", "1", "--budget", "dr", "--against", "pt=1,2"], "--against, --p: got both"),
        (["--p", "1", "--cos-theta", "0", "--budget", "dr", "--against", "theta=1,2"],
         "--against, --cos-theta: got both"),
        (["--against", "cgem.*.pitch_x=300 um:900 um:1"], "--against: cgem.*.pitch_x: got '1', expected a whole"),
        (["--against", "theta"], "--against: got theta alone"),
        (["--against", "theta=x"], '--against: theta: got "x", expected an angle'),
    ],
)  # fmt: skip
def test_what_rows_cannot_go_through_is_said(words, text, tmp_path, capsys):
    """Nothing of it is left out without a word, as an origin of tracks that the analytic method does not know."""
    for method in ("analytic", "both") if "--budget" not in words else ("analytic",):
        here = [*words, "--method", method, "--events", "20", "-o", str(tmp_path / method), "--quiet"]
        assert main(["resolution", "-d", "besiii-cgem-design", *here]) == 2
        assert text.replace("analytic", method) in capsys.readouterr().err
        assert not (tmp_path / method).exists()


def test_keys_of_whole_numbers_have_whole_numbers():
    assert values_of_key("76:80:3") == [76, 78, 80]
    assert all(isinstance(one, int) for one in values_of_key("76:80:3"))
    assert values_of_key("1:2:3") == [1.0, 1.5, 2.0]
    assert values_of_key("0.5 T:1 T:2") == ["0.5 T", "1 T"]
