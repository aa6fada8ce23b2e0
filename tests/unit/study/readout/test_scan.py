"""Scans of a readout, wrong pairs, and the picture of the signal's formation."""

import csv
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.cli.main import main
from cgemit.detector.gas import transport
from cgemit.study.readout.scan import QUANTITIES, WAYS, formation, scan, scan_ghosts

pytestmark = pytest.mark.usefixtures("undrawn")

DESIGN = cg.load("besiii-cgem-design")
TIGER = cg.TigerReadout()


@pytest.mark.slow
def test_quantities_change_what_they_should() -> None:
    """Gain multiplies the charge, the threshold removes strips, the drift field bends less at 1 T, the field more."""
    gain = scan(cg.TigerReadout(saturation=1e4), "gain", [6000, 12_000], n=200)
    charge = gain.of_view(0, "charge")
    assert 1.9 < charge[1] / charge[0] < 2.3  # strips below the threshold come in
    threshold = scan(TIGER, "threshold", [1.5, 6.0], n=200)
    assert (np.diff(threshold.of_view(0, "size")) < -0.5).all()
    assert (np.diff(threshold.of_view(1, "efficiency")) < 0).all()
    drift = scan(TIGER, "drift_field", [1.0, 3.0], n=200)
    assert drift.curves()["centroid"][0][0] > 3 * drift.curves()["centroid"][0][1]
    field = scan(TIGER, "bz", [0.0, 1.0], n=200)
    assert field.curves(1)["centroid"][0][1] > 2 * field.curves(1)["centroid"][0][0]
    assert set(field.curves()) == {"centroid", "micro-tpc", "merged", "track"}
    assert "bz [T]" in repr(field)


def test_picture_shows_the_scan() -> None:
    """Lines and points of every panel are the numbers of the scan; axes name the quantity with its unit."""
    field = scan(TIGER, "bz", [0.0, 1.0], n=60)
    panels = field.draw().axes
    assert [axes.get_xlabel() for axes in panels[4:]] == ["magnetic field  (T)"] * 2
    for view, name in enumerate("XV"):
        widths, strips, efficiency = panels[view::2]
        assert widths.get_ylabel() == f"core width of the {name} residual  (µm)"
        for drawn, (core, error) in zip(widths.containers, field.curves(view).values(), strict=True):
            np.testing.assert_array_equal(drawn[0].get_xydata(), np.column_stack([field.values, core]))
            segments = np.array(drawn[2][0].get_segments())
            np.testing.assert_allclose(np.diff(segments[:, :, 1])[:, 0], 2 * error)
        np.testing.assert_array_equal(strips.lines[0].get_ydata(), field.of_view(view, "size"))
        np.testing.assert_array_equal(efficiency.lines[0].get_ydata(), 100 * field.of_view(view, "efficiency"))
    legend = [text.get_text() for text in panels[0].figure.legends[0].get_texts()]
    assert legend == ["charge centroid", "micro-TPC", "merged", "with the track's angle"]
    drift = scan(TIGER, "drift_field", [1.0, 2.0], n=50)
    assert drift.draw().axes[4].get_xlabel() == "drift field  (kV/cm)"


def test_track_angle_helps_where_the_angle_spreads_the_charge() -> None:
    """With the angle of the track, positions are better than merged ones without it, and never much worse."""
    curves = scan(TIGER, "angle", [0.0, -20.0], n=1000).curves()
    ratio = curves["track"][0] / curves["merged"][0]
    assert ratio[0] < 0.9
    assert ratio[1] < 1.0


def test_ghosts() -> None:
    """By geometry alone about half of the crossings of two tracks are as good; charge and time separate them."""
    found = scan_ghosts(DESIGN, TIGER, (1, 3), n=250)
    one, three = found.points
    assert all(share < 0.05 for share, _ in one.wrong.values())  # apart from delta electrons
    shares = [three.wrong[way][0] for way in WAYS]
    assert 0.4 < shares[0] < 0.65  # of three pairs two thirds would be wrong if all crossed on the sheet
    assert shares[1] < 0.4 * shares[0]
    assert [row["tracks"] for row in csv.DictReader(found.to_csv().splitlines())] == ["1", "3"]


def test_formation() -> None:
    """Without diffusion electrons end where the Lorentz angle of each gap takes them; strips lie where they end."""
    panels = {panel.title: panel for panel in formation(TIGER, angle=10.0, bz=1.0, seed=3)}
    assert len(panels) == 4
    straight = panels["without Lorentz angle, without diffusion"]
    bent = panels["with Lorentz angle, without diffusion"]
    assert all(np.ptp(line[:, 0]) < 1e-9 for line in straight.drift)
    first = [line for line in bent.drift if line[-1, 1] == pytest.approx(bent.foils[0])]
    tangent = transport("ar-ic4h10-90-10", 1.5, 1.0).tan_lorentz
    assert len(first) > 5
    for line in first:
        assert np.ptp(line[:, 0]) == pytest.approx(tangent * np.ptp(line[:, 1]), abs=1e-9)
    for panel in panels.values():
        ends = [line[-1, 0] for line in panel.drift if line[-1, 1] == pytest.approx(panel.anode)]
        assert abs(np.average(panel.strips, weights=panel.charge) - np.mean(ends)) < 0.35
        assert panel.track[:, 1] == pytest.approx([0, 5], abs=0.01)
    spread = [np.std([line[-1, 0] for line in panels[f"with Lorentz angle, {way} diffusion"].drift])
              for way in ("without", "with")]  # fmt: skip
    assert spread[1] > spread[0] + 0.1
    with pytest.raises(ValueError, match="expected one of tiger, apv25"):
        formation(cg.ProjectionReadout())


def test_angles_of_the_command_are_degrees(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    asked: list[Any] = []
    scan = sys.modules["cgemit.study.readout.scan"]
    monkeypatch.setattr(scan, "scan", lambda _, what, values, *, angle, **how: asked.append((what, values, angle)))
    command = ["readout", "--readout", "tiger", "--quiet"]
    assert main([*command, "--angles", "0 deg:40 deg:3"]) == 0
    assert main([*command, "--scan", "gain", "--values", "8000", "--angle", "0.5"]) == 0
    assert asked[0] == ("angle", pytest.approx([0, 20, 40]), pytest.approx(0))
    assert asked[1] == ("gain", [8000], pytest.approx(np.degrees(0.5)))


@pytest.mark.slow
def test_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Scans from the command line; contradictory options are refused."""
    common = ["readout", "--readout", "tiger", "--quiet"]
    out = tmp_path / "scan"
    assert main([*common, "--scan", "threshold", "--values", "2,4", "-n", "300", "-o", str(out)]) == 0
    rows = list(csv.DictReader((out / "readout.csv").read_text().splitlines()))
    assert [row["threshold_fC"] for row in rows] == ["2", "2", "4", "4"]
    assert (out / "readout.png").stat().st_size > 10_000
    assert main([*common, "--values", "2,4"]) == 2
    assert main([*common, "--scan", "gain", "--angles", "0 deg"]) == 2
    assert main([*common, "--scan", "gain", "--values", "1:2"]) == 2
    assert main([*common, "--angles=-25:25:3"]) == 2
    assert main([*common, "--scan", "gain", "--angle", "80 deg"]) == 2
    errors = capsys.readouterr().err
    for text in ("--values: got it with --scan angle", "--angles: got it with --scan gain",
                 "a range, expected a number, A,B,C or A:B:COUNT",
                 "--angles: got -25 rad = -1432.39 deg, expected between",
                 "--angle: got 1.39626 rad = 80 deg, expected between -80 and 80 deg"):  # fmt: skip
        assert text in errors
    assert set(QUANTITIES) == {"angle", "bz", "drift_field", "gain", "threshold"}
