"""A chamber without axial wires, in a weak field: finder, fit and covariance of `kloe2-like`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cgemit as cg
from cgemit.cli.main import main

NAME = "kloe2-like"
NO_DECAYS = cg.Settings(simulate=cg.SimulateSettings(decays=False))


def found(result: cg.Result, **settings: object) -> cg.study.Finding:
    """Return the run with the candidates of the finder without truth, compared with the particles."""
    tables = cg.find_tracks(result.detector, result.clusters, result.wire_hits, cg.FindSettings(**settings))
    return cg.study.finding(replace(result, tables={**result.tables, **tables}))


def test_tracks_are_found_from_the_cgem_and_from_the_wires_alone() -> None:
    """Segments of the CGEM lead to the wires, and circles of both stereo signs to the CGEM."""
    muons = cg.Gun("mu-", p=(0.2, 1.0), cos_theta=(-0.86, 0.86))
    result = cg.run(NAME, muons, n=300, seed=11, settings=NO_DECAYS, until="cluster")
    tables = cg.find_tracks(result.detector, result.clusters, result.wire_hits)
    assert not tables["searches"]["limits"].any()  # that there are no circles to search is not a limit
    finding = found(result)
    assert finding.findable.all()
    rates = finding.rates()
    assert (rates.fakes.count, rates.clones.count) == (0, 0)
    assert rates.efficiency.count >= 298
    assert finding.hit_efficiency > 0.99  # clusters that deltas widen do not keep tracks from the wires
    assert found(result, method="chamber").rates().efficiency.count >= 298


def test_segments_may_leave_out_a_layer() -> None:
    """Without the second layer, particles that begin 90 mm beside the beam line have three layers that make a seed."""
    pions = cg.Gun("pi+", p=(0.2, 1.0), cos_theta=(-0.8, 0.8), vertex=(90.0, 0.0, 0.0))
    result = cg.run(NAME, pions, n=200, seed=3, settings=NO_DECAYS, until="cluster")
    clusters = result.clusters[(result.clusters["layer"] != 1) & (result.clusters["view"] < 2)]
    less = replace(result, tables={**result.tables, "clusters": clusters})
    assert found(less).rates().efficiency.count >= 190


def test_widths_are_those_of_simulated_events() -> None:
    """Where the fit's assumptions hold: 4 standard errors, with which 10 % more would be seen."""
    how = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian", deltas=False, decays=False))
    gun = cg.Gun("mu-", p=0.5, cos_theta=0.4)
    result = cg.run(NAME, gun, n=4000, seed=21, settings=how, readout="gaussian")
    covariance = cg.analytic(NAME, "mu-", 0.5, 0.4, readout="gaussian")
    for quantity in ("dr", "phi0", "kappa", "dz", "tanl", "p"):
        measured = cg.resolution(result, quantity)
        expected, error = float(covariance.sigma(quantity)), 4 * measured.core_error
        assert measured.core == pytest.approx(expected, abs=error), quantity
        assert measured.core != pytest.approx(1.1 * expected, abs=error)


def test_sheets_of_a_layer_are_where_their_hits_are() -> None:
    """X clusters of layers with three and four sheets lie beside the true crossings, and all sheets have some."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))
    how = cg.Settings(simulate=cg.SimulateSettings(deltas=False, decays=False))
    result = cg.run(NAME, gun, n=400, seed=2, settings=how, until="cluster")
    clusters = result.clusters[result.clusters["view"] == 0]
    for number, layer in enumerate(result.detector.cgem):
        mine = clusters[clusters["layer"] == number]
        assert sorted(set(mine["sheet"].tolist())) == list(range(layer.sheets))
        phi = np.array(layer.sheet_phi)[mine["sheet"]] + mine["x"] / layer.r_readout
        off = np.remainder(phi - result.truths["phi"][mine["truth"]] + np.pi, 2 * np.pi) - np.pi
        assert np.abs(off * layer.r_readout).max() < 5  # mm; half a sheet is 136 mm


MUON = ["-d", NAME, "--particle", "mu-", "--p", "0.5", "--cos-theta", "0.3", "--quiet"]
PLAN = f"""
base = "{NAME}"
[vary]
"cgem.*.pitch_x" = ["500 um", "650 um"]
[evaluate]
particle = "mu-"
p = [0.5]
cos_theta = 0.0
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "written"),
    [
        (["simulate", *MUON, "-n", "20", "--fit"], "tracks.npz"),
        (["resolution", *MUON, "--method", "both", "--events", "100"], "resolution.png"),
        (["find", *MUON, "-n", "20"], "efficiency.png"),
        (["display", *MUON, "--html"], "event.html"),
        (["show", NAME, "--gdml"], "detector.gdml"),
        (["sweep", "plan.toml", "--quiet"], "sweep.csv"),
    ],
)
def test_every_command_runs(
    command: list[str],
    written: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plan.toml").write_text(PLAN, encoding="utf-8")
    assert main([*command, "-o", "out"]) == 0, capsys.readouterr().err
    assert Path("out", written).stat().st_size > 500
