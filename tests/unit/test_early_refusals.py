"""What a run cannot do is said before anything is simulated, all of it at once."""

import json
import os
import time

import numpy as np
import pytest

import cgemit as cg
from cgemit.chain import executor, run
from cgemit.chain.settings import STAGES, TABLES, Settings, tables_made
from cgemit.reconstruction.cluster_errors import CalibrationError, calibration_of, read_calibration

GUN = cg.Gun("mu-", p=1, cos_theta=(-0.5, 0.5))


@pytest.fixture
def nothing_runs(monkeypatch):
    def never(*_, **__):
        raise AssertionError("a chunk was begun")

    monkeypatch.setattr(run, "run_chunk", never)


def test_all_problems_of_a_run_at_once(nothing_runs):
    with pytest.raises(ValueError, match=r"^run:") as refused:
        cg.run(
            {"base": "besiii-cgem", "name": "x", "cgem": {"L9": {"pitch_x": "1 m"}}}, GUN, n=-1, seed=-2, finder="no",
            until="never", readout="none", output=cg.Output("folder", format="xlsx"),
        )  # fmt: skip
    text = str(refused.value)
    for part in ("cgem.L9", "n: -1", "seed: -2", "finder: got 'no'", "until: got 'never'", "readout", "xlsx"):
        assert part in text, part
    assert text.count("run:") == 1
    with pytest.raises(cg.DetectorError):  # one problem keeps its own kind
        cg.run({"base": "besiii-cgem", "name": "x", "cgem": {"L9": {}}}, GUN, n=1)


def test_tables_to_keep_are_checked_first(nothing_runs):
    with pytest.raises(ValueError, match="keep: got tracks, which this run does not make, only particles"):
        cg.run("besiii-cgem", GUN, n=2, until="find", keep=["tracks", "clusters"])
    with pytest.raises(ValueError, match="keep: got states"):
        cg.run("besiii-cgem", GUN, n=2, keep="states")


@pytest.mark.parametrize("until", STAGES)
def test_the_tables_that_a_run_makes(until):
    settings = Settings(fit=cg.FitSettings(residuals=True))
    result = cg.run("besiii-idc", GUN, n=2, until=until, settings=settings)
    assert tuple(result.tables) == tuple(name for name in TABLES if name in tables_made(until, settings))


def test_a_missing_calibration_is_said_first(nothing_runs):
    changed = cg.load("besiii-cgem").with_overrides({"cgem.L1.pitch_x": "500 um"})
    with pytest.raises(CalibrationError, match="got no calibration for this detector"):
        cg.run(changed, GUN, n=10, readout="tiger")
    with pytest.raises(AssertionError, match="a chunk was begun"):  # not needed without clusters
        cg.run(changed, GUN, n=10, readout="tiger", until="digitize")


@pytest.mark.parametrize("name", ["/dev/zero", "pipe", ".", "none", "x" * 5000])
def test_a_calibration_is_read_from_files_only(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    start = time.monotonic()
    with pytest.raises(CalibrationError, match=r"digitize.readout.calibration: 1 problem\n  got .*expected a file"):
        calibration_of(cg.load("besiii-cgem"), cg.TigerReadout(calibration=name))
    assert time.monotonic() - start < 5


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("errors", 1e9, "errors: got 1e"), ("errors", 0.0, "errors: got 0, expected numbers from 0.0001 to 100 mm"),
        ("depth", -1e4, "depth: got -10000"), ("height", float("nan"), "height: got nan"),
        ("shares", 1.1, "shares: got 1.1, expected numbers from 0 to 1"), ("pairs", 1e5, "pairs: got 100000"),
        ("edges", -1.0, "edges: got -1"), ("edges", 1e5, "edges: got charges that fall"),
        ("distance_edges", 1e3, "distance_edges: got distances that fall"),
        ("charge_factors", 0.0, "charge_factors: got 0, expected numbers from 0.001 to 10000$"),
        ("typical_errors", "wide", "expected a calibration file"), ("depth", 10**400, "expected a calibration file"),
    ],
)  # fmt: skip
def test_impossible_values_of_a_calibration(name, value, message):
    data = json.loads(calibration_of(cg.load("besiii-cgem"), cg.TigerReadout()).to_json())
    part = data[name]
    while isinstance(part[0], list):
        part = part[0]
    part[0] = value
    with pytest.raises(CalibrationError, match=message):
        read_calibration(json.dumps(data), "file")


def test_a_calibration_of_another_version():
    """Its arrays have other shapes: what to do is said."""
    data = json.loads(calibration_of(cg.load("besiii-cgem"), cg.TigerReadout()).to_json())
    data["typical_errors"] = np.array(data["typical_errors"])[..., 0].tolist()
    shapes = r"got shape \(2, 3, 2, 3\), expected \(2, 3, 2, 3, 17\)"
    message = rf"typical_errors: {shapes}; made by another version\? Make it again: cgemit"
    with pytest.raises(CalibrationError, match=message):
        read_calibration(json.dumps(data), "file")


def test_a_calibration_of_other_layers(tmp_path):
    """One that claims the right key, but holds two of three layers."""
    detector, readout = cg.load("besiii-cgem"), cg.TigerReadout()
    data = json.loads(calibration_of(detector, readout).to_json())
    axis = {"typical_errors": 3, "errors": 2, "slope_errors": 2, "charge_factors": 2, "distance_edges": 2,
            "distance_factors": 3, "direction_depths": 3, "direction_factors": 3, "correlations": 2,
            "pairs": 0}  # fmt: skip
    for name in set(data) - {"about", "key"}:
        data[name] = np.take(data[name], [0, 1], axis=axis.get(name, 1)).tolist()
    file = tmp_path / "two.json"
    file.write_text(json.dumps(data))
    with pytest.raises(CalibrationError, match="got 2 layers, expected 3"):
        calibration_of(detector, cg.TigerReadout(calibration=str(file)))


def test_chunks_that_do_not_fit_into_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(executor, "available", lambda: 1 << 30)
    for output in ({"output": tmp_path / "out"}, {}):
        with pytest.raises(ValueError, match=r"chunk: \d of 10000000 events at a time need about .* GB"):
            cg.run("besiii-cgem", GUN, n=10**7, keep=["tracks"], workers=cg.Workers(threads=1, chunk=10**7), **output)
    assert not (tmp_path / "out").exists()
    executor.check_chunk({"tracks": 1000}, 1, 1000, 4)
    with pytest.raises(ValueError, match="expected at most 268,435 events"):
        executor.check_chunk({"tracks": 1000}, 1, 300_000, 4)
