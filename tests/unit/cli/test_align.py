"""`cgemit align`: files of an alignment and of a forecast, and input that is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

import cgemit as cg
from cgemit.cli.main import main

NOMINAL = cg.load("besiii-cgem-design").with_readout("gaussian")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("runs") / "muons"
    real = NOMINAL.with_alignment({"cgem.L2.shift_x": 0.1})
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    cg.run(real, gun, n=200, seed=3, fit_detector=NOMINAL).save(place)
    return place


@pytest.mark.usefixtures("undrawn")
def test_a_run_is_aligned(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "aligned"
    assert main(["align", str(folder), "--free", "cgem.*.shift_x", "--fix", "cgem.L1", "-o", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((out / "report.json").read_text())
    found = {one["name"]: one for one in report["constants"]}
    assert abs(found["cgem.L2.shift_x"]["value"] - 0.1) < 4 * found["cgem.L2.shift_x"]["err"] < 0.15
    assert found["cgem.L1.shift_x"]["status"] == "fixed"
    assert report["converged"]
    assert report["p_value"] < 1e-3
    aligned = cg.load(out / "detector.toml")
    again = NOMINAL.with_alignment(out / "alignment.csv")
    assert aligned.cgem["L2"].shift_x == pytest.approx(again.cgem["L2"].shift_x, rel=1e-9)


def test_pairs_of_known_mass_tell_the_momentum_scale(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """J/psi to two muons at rest; the description has a field that is 0.5 % too weak."""
    p = (3.0969**2 / 4 - 0.1056584**2) ** 0.5
    back = {"event": [0, 0] * 40, "pdg": [13, -13] * 40, "px": [p, -p] * 40, "py": [0.0] * 80, "pz": [0.0] * 80}
    angle = [0.15 * (i // 2) for i in range(80)]
    back["event"] = [i // 2 for i in range(80)]
    back["px"], back["py"] = (
        [x * of(a) for x, a in zip(back["px"], angle, strict=True)] for of in (math.cos, math.sin)
    )
    settings = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian"))
    wrong = NOMINAL.with_alignment({"field.scale": -5e-3})
    cg.run(NOMINAL, back, seed=6, fit_detector=wrong, settings=settings).save(tmp_path / "jpsi")
    line = ["align", str(tmp_path / "jpsi"), "--free", "field.scale", "--pairs", "mass", "--json"]
    assert main([*line, "--mass", "3.0969"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["constants"]
    assert abs(found["value"] - 5e-3) < 4 * found["err"] < 5e-3
    assert main(line) == 2
    assert "mass: got None" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_a_forecast_needs_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "forecast"
    line = ["align", "--forecast", "-d", "besiii-cgem", "--muons", "1000", "--cosmics", "500", "-o", str(out)]
    assert main(line) == 0
    assert "18 constants" in capsys.readouterr().out
    report = json.loads((out / "report.json").read_text())
    assert len(report["weak_modes"]) == 5
    assert report["tracks"] > 1500
    assert not (out / "detector.toml").exists()


@pytest.mark.usefixtures("undrawn")
def test_end_plates_times_and_records_for_pede(folder: Path, tmp_path: Path) -> None:
    from cgemit.calibration.mille import read_mille

    plates, time = "drift_chamber.plates.8-9.*_rotation", "drift_chamber.layers.20.t0"
    line = ["align", str(folder), "--free", plates, "--free", time, "--plates", "2,33", "--pairs", "none"]
    line += ["--mille", str(tmp_path / "mille.bin"), "-o", str(tmp_path / "out")]
    assert main(line) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    names = [one["name"] for one in report["constants"]]
    assert names == [plates.replace("*", "east"), plates.replace("*", "west"), time]
    assert sum(1 for _ in read_mille(tmp_path / "mille.bin")) > 190
    assert (tmp_path / "mille.txt").is_file()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (["align", "--forecast", "-d", "besiii-cgem", "--muons", "10", "--mille", "mille.bin"], "nor --mille"),
        (["align", "--forecast", "-d", "besiii-cgem", "--muons", "10", "--plates", "2,2"], "plates: got 4 wire layers"),
        (["align"], "expected folders of runs"),
        (["align", "--forecast", "-d", "besiii-cgem"], "--muons N"),
        (["align", "--forecast", "-d", "besiii-cgem", "--muons", "10", "--free", "cgem.L7"], "free: got 'cgem.L7'"),
        (["align", "nowhere"], "nowhere"),
    ],
)
def test_bad_input(line: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line) == 2
    assert expected in capsys.readouterr().err
