"""The tidy table of scans: numbers recomputed from the tracks, paired differences, angles and momenta."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.clusters import cluster_residuals
from cgemit.analysis.quantities import QUANTITIES, REPORTED
from cgemit.cli.main import main
from cgemit.draw.curves import resolutions
from cgemit.draw.style import mathematical
from cgemit.study import measure, scan, scan_analytic
from cgemit.study.scan import columns_of, difference, save_scans

pytestmark = pytest.mark.usefixtures("undrawn")

DESIGN = "besiii-cgem-design"


@pytest.fixture(scope="module")
def pair() -> list[Any]:
    """Scans of two variants of a detector with the same events."""
    other = cg.load(DESIGN).with_overrides({"cgem.*.pitch_x": "700 um", "name": "wide"})
    return [scan(one, [0.4, 1.0], cos_theta=(-0.5, 0.5), events=400, seed=7) for one in (DESIGN, other)]


def by_hand(tracks: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return residuals and errors of each quantity in the unit of its column, from momentum vectors."""
    good = {name: column[tracks["status"] == 0] for name, column in tracks.columns.items()}
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
        groups = [one.tracks["event"][one.tracks["status"] == 0] % 20 for one in (other, base)]
        expected = measure(mine[0]).core - measure(theirs[0]).core
        assert columns[f"delta_sigma_{name} ({unit})"][3] == pytest.approx(expected, rel=1e-9)
        left_out = np.array([
            measure(mine[0][groups[0] != k]).core - measure(theirs[0][groups[1] != k]).core for k in range(20)
        ])  # fmt: skip
        error = np.sqrt(19 / 20 * np.sum((left_out - left_out.mean()) ** 2))
        assert columns[f"delta_sigma_{name}_error ({unit})"][3] == pytest.approx(error, rel=1e-9)
        medians = np.median(mine[1]) - np.median(theirs[1])
        assert columns[f"delta_median_error_{name} ({unit})"][3] == pytest.approx(medians, rel=1e-9)
    paired = difference(other, base, "dz")[1]
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
    other = cg.analytic(DESIGN, "mu-", one.p / sine, 0.5)
    np.testing.assert_allclose(one.sigma("p_rel"), 0.1 * other.sigma("p") / (one.p / sine), rtol=1e-9)
    np.testing.assert_allclose(one.sigma("theta"), other.sigma("theta"), rtol=1e-9)
    assert one.columns()["pt (GeV/c)"] == one.p.tolist()
    assert one.fits == []
    spread = scan_analytic(DESIGN, [1.0], theta=(0.5, 2.6)).sigma("dz")
    assert spread == pytest.approx(scan_analytic(DESIGN, [1.0], theta=np.linspace(0.5, 2.6, 400)).sigma("dz"), rel=0.01)
    with pytest.raises(ValueError, match="with pT; the analytic method expects fixed angles"):
        scan_analytic(DESIGN, pt=[0.5])


@pytest.mark.parametrize("make", [scan, scan_analytic])
@pytest.mark.parametrize("given", [[], np.array([]), 1.0, "1"])
@pytest.mark.parametrize("name", ["momenta", "pt"])
def test_momenta_are_a_list_of_at_least_one(make: Any, given: Any, name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}: got .*, expected a list of at least one"):
        make(DESIGN, **{name: given})


def test_wrong_momenta_and_angles_are_listed() -> None:
    for function in (scan, scan_analytic):
        with pytest.raises(ValueError, match=r"(?s)momenta, pt: expected exactly one.*cos_theta, theta: got both"):
            function(DESIGN, cos_theta=0.0, theta=1.0)


def test_the_picture_shows_every_quantity_of_every_scan(pair: list[Any]) -> None:
    picture = resolutions(pair)
    title = "core widths: mu-, cos θ = -0.5 to 0.5, 400 simulated events at each momentum"
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
        assert f"{DESIGN}, {particle}, θ = 1 to 2 rad" in text
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
