"""Charge profiles integrated over strips, and the command that scans readouts and fits errors."""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from cgemit import Gun, ProjectionReadout, Workers, _core, load, run
from cgemit.analysis.widths import measure
from cgemit.cli.main import main
from cgemit.reconstruction.cluster_errors import ChipErrors, chip_errors
from cgemit.study.readout.errors import measurements

DESIGN = load("besiii-cgem-design")


@pytest.mark.parametrize(("a", "b", "sigma"), [(0.0, 2.3, 0.3), (1.0, 1.0, 0.45), (-1.0, 0.2, 1.5), (0.0, 1e-7, 0.3)])
def test_profile_is_a_smeared_line(a: float, b: float, sigma: float) -> None:
    for edge in (-1.0, 0.4, 1.2, 3.0):
        exact = norm.cdf((edge - a) / sigma)
        if b - a > 1e-3:
            exact = quad(lambda x, e=edge: norm.cdf((e - x) / sigma), a, b)[0] / (b - a)
        assert _core._testing.profile_below(edge, a, b, sigma) == pytest.approx(exact, abs=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-9, -0.03, 0.0499, 0.0501, -1.2, 3.1, -3.1])
def test_turns_of_all_sizes_are_exact(angle: float) -> None:
    """Small turns are a power series; both branches give the angle to rounding, in every direction."""
    for phi in np.linspace(-3, 3, 7):
        turned = _core._testing.turn_between(
            78 * np.cos(phi), 78 * np.sin(phi), 83 * np.cos(phi + angle), 83 * np.sin(phi + angle)
        )
        assert turned == pytest.approx(angle, rel=1e-15, abs=2e-15)


def test_strips_hold_the_deposit() -> None:
    """Without threshold and noise both views hold half of the charge each; positions are unbiased."""
    quiet = ProjectionReadout(threshold=1e-9, noise=0)
    result = run(DESIGN, Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), 200, seed=3, readout=quiet, until="digitize")
    charge = result.truths["energy"] / 25.9e-3 * quiet.gain * 1.602176634e-4
    for view in (0, 1):  # a few lose charge to the area between sheets
        rows = result.digis["view"] == view
        found = np.bincount(result.digis["truth"][rows], result.digis["charge"][rows], minlength=len(charge))
        assert np.median(found / charge) == pytest.approx(0.5, abs=1e-4)
        assert (found / charge).max() < 0.5 + 1e-9
    again = run(
        DESIGN,
        Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)),
        200,
        seed=3,
        readout=quiet,
        until="digitize",
        workers=Workers(chunk=7),
    )
    assert np.array_equal(again.digis["charge"], result.digis["charge"])


def test_the_chain_with_its_errors() -> None:
    result = run(DESIGN, Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93)), 400, seed=6, readout="analog-projection")
    assert (result.tracks["status"] == 0).mean() > 0.99
    x = result.clusters["err_x"][result.clusters["view"] == 0]
    assert np.median(x) < 0.1 < 0.14  # better than the binary readout's 0.139 mm
    sample = measurements(DESIGN, result.clusters, result.truths, lorentz=False)
    assert abs(np.median(sample.residual)) < 0.01
    pull = sample.residual / sample.error
    assert measure(pull).core == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_command_scans_and_fits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, file = tmp_path / "scan", tmp_path / "mine.toml"
    scan = ["readout", "--readout", "apv25", "--bz", "0", "--angles", "0 deg,30 deg", "-n", "400", "--quiet"]
    assert main([*scan, "--set", "readout.gain=39000", "-o", str(out)]) == 0
    rows = list(csv.DictReader((out / "readout.csv").read_text().splitlines()))
    assert [(float(row["angle_deg"]), row["view"]) for row in rows] == [(0, "X"), (0, "V"), (30, "X"), (30, "V")]
    assert float(rows[2]["centroid_um"]) > 4 * float(rows[0]["centroid_um"])
    assert float(rows[2]["track_um"]) < 0.6 * float(rows[2]["centroid_um"])
    assert float(rows[1]["efficiency"]) > 0.99
    assert (out / "readout.png").stat().st_size > 10_000
    assert main(["readout", "--readout", "binary", "--bz", "0"]) == 2
    assert main([*scan, "--bz", "1.5"]) == 2
    assert "expected 0 to 1.2 T" in capsys.readouterr().err
    fit = ["readout", "--readout", "analog-projection", "--set", "readout.sigma=0.4 mm", "-n", "200"]
    assert main([*fit, "--fit", str(file), "--quiet"]) == 0
    assert main([*fit, "--fit", str(file), "--quiet"]) == 2
    assert "expected another file, or --overwrite" in capsys.readouterr().err
    found = ChipErrors(**tomllib.loads(file.read_text())["analog-projection"])
    own = chip_errors("analog-projection")
    assert found.cut == pytest.approx(own.cut, rel=0.5)
    assert found.span == own.span == 0.0
