"""Input that used to be taken in silence, or to end in errors of another kind."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.resolutions import fit_form
from cgemit.chain.record import RecordError
from cgemit.chain.settings import NotKeptError
from cgemit.cli.main import main
from cgemit.particles.table import read_hepmc
from cgemit.study import sweep
from cgemit.study.optimize.run import read_optimize_plan
from cgemit.study.sweep.plan import PlanError, read_plan
from cgemit.tables import Table

GUN = cg.Gun("mu-", p=1, cos_theta=(-0.5, 0.5))

HEPMC = """HepMC::Version 3.02.05
HepMC::Asciiv3-START_EVENT_LISTING
E 0 1 2
U {units}
V -1 0 [1] @ 0 0 0 0
P 1 0 443 0 0 0 3.1 3.1 2
P 2 -1 13 0.5 0 0 0.51 0.106 1
HepMC::Asciiv3-END_EVENT_LISTING
"""


@pytest.mark.parametrize(("units", "px"), [("GEV MM", 0.5), ("MEV CM", 0.5e-3)])
def test_units_of_hepmc(units, px, tmp_path):
    path = tmp_path / "events.hepmc3"
    path.write_text(HEPMC.format(units=units))
    assert read_hepmc(path)[0]["px"].tolist() == pytest.approx([px])


@pytest.mark.parametrize("units", ["TEV MM", "GEV FOOT", "GEV", "gev mm"])
def test_unknown_units_of_hepmc(units, tmp_path):
    path = tmp_path / "events.hepmc3"
    path.write_text(HEPMC.format(units=units))
    with pytest.raises(ValueError, match=f"got the units 'U {units}'; expected GEV or MEV, then MM or CM"):
        read_hepmc(path)


def test_hepmc_without_units(tmp_path):
    path = tmp_path / "events.hepmc3"
    path.write_text(HEPMC.replace("U {units}\n", ""))
    with pytest.raises(ValueError, match="1 of its 1 events do not name their units"):
        read_hepmc(path)


def test_all_problems_of_a_sweep_at_once():
    with pytest.raises(ValueError, match=r"^sweep:") as refused:
        sweep("no-such", {"cgem.L1.pitch_x": []}, {"method": "no", "particle": "x", "p": [-1], "quantities": ["zz"]})
    for part in (
        "evaluate.method: got 'no'",
        "quantities[0]: got 'zz'",
        "particle: got 'x'",
        "p[0]",
        "no-such",
        "cgem.L1.pitch_x",
    ):
        assert part in str(refused.value), part
    with pytest.raises(ValueError, match=r"sweep:[\s\S]*p\[0\]: got -1[\s\S]*cgem.L9.pitch_x: got 'L9'"):
        sweep("besiii-cgem", {"cgem.L9.pitch_x": ["1 mm"]}, {"p": [-1]})


@pytest.mark.parametrize("read", [read_plan, read_optimize_plan])
def test_unknown_keys_and_wrong_values_of_a_plan_at_once(read, tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(
        'bse = 1\n[vary]\n"cgem.L1.pitch_x" = ["1 mm", "2 mm"]\n[evaluate]\np = "1 mm"\nno = 1\n[settings.fit]\nx = 1\n'
    )
    with pytest.raises(PlanError) as refused:
        read(path)
    begins = [problem.path for problem in refused.value.problems]
    assert sorted(begins) == ["base", "bse", "evaluate.no", "evaluate.p", "settings.fit.x"]


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    cg.run("besiii-idc", GUN, n=6, output=folder, workers=cg.Workers(chunk=2))
    return folder


@pytest.mark.parametrize(
    ("file", "path", "value", "message"),
    [
        ("tables.json", ("tracks", "parts"), None, "parts: got None, expected a list of parts"),
        ("run.json", ("timings",), {}, "timings: got {}, expected seconds by stage, with 'wall' for all"),
        ("run.json", ("timings",), {"wall": "long"}, "timings: got"),
        ("run.json", ("tables",), None, "tables: got None, expected a list of names"),
        ("run.json", ("tables",), [3], "tables: got"),
        ("run.json", ("transported",), {"end": None}, "transported: got"),
    ],
)
def test_a_damaged_run(stored, file, path, value, message):
    text = (stored / file).read_text()
    data = json.loads(text)
    part = data
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    (stored / file).write_text(json.dumps(data))
    try:
        for read in (cg.open, cg.Result.load):
            with pytest.raises(RecordError) as refused:
                read(stored)
            assert message in str(refused.value)
    finally:
        (stored / file).write_text(text)
    assert len(cg.open(stored).tracks) == 6


@pytest.mark.parametrize("number", [3, 10**9 + 7, np.int64(10**15)])
def test_events_with_any_numbers_are_drawn(number):
    run = cg.run("besiii-cgem", GUN, n=3, seed=4)
    numbers = [3, 10**9 + 7, 10**15]
    tables = {
        name: Table(name, {**one.columns, "event": np.array(numbers)[one["event"]]}, 3, events=numbers, meta=one.meta)
        for name, one in run.tables.items()
    }
    gaps = replace(run, tables=tables)
    picture = cg.draw.event(gaps, number)
    assert f"event {int(number)}:" in picture.get_suptitle()
    for wrong in (4, 10**15 + 1, 0, 10**400, "x"):
        with pytest.raises(ValueError, match="expected one of 3, 1000000007, 1000000000000000"):
            cg.draw.event(gaps, wrong)


@pytest.mark.parametrize(
    "make",
    [
        lambda: cg.TigerReadout(jitter=1e300), lambda: cg.TigerReadout(noise=1e30), lambda: cg.Apv25Readout(jitter=1e6),
        lambda: cg.ProjectionReadout(noise=2000.0),
    ],
)  # fmt: skip
def test_noise_and_jitter_have_limits(make):
    with pytest.raises(ValueError, match=r"(jitter|noise): got .*expected 0 to 1000"):
        make()


@pytest.mark.parametrize(
    "table", [{"name": "a\ud800"}, {"description": "a\udfff"}, {"materials": {"\ud800": {"base": "Cu"}}}]
)
def test_halves_of_surrogate_pairs(table):
    """No file can hold them, so that a run would end at its last step."""
    with pytest.raises(cg.DetectorError, match="expected"):
        cg.load({"base": "besiii-cgem", "name": "x", **table})


def test_a_term_of_nothing_is_zero():
    """A constant curve: what its rising term has left is rounding, and is not printed as 1.9e-159."""
    p = np.linspace(0.2, 2.0, 10)
    found = fit_form("dz", p, np.full(10, 0.3), particle="e-")
    assert (found.b, found.a) == (0.0, pytest.approx(0.3))
    assert "b = 0 mm GeV/c" in str(found)
    assert "e-1" not in str(found)
    small = fit_form("dz", p, np.hypot(0.3, 0.01 / p), particle="e-")  # 3 % of the constant
    assert small.b == pytest.approx(0.01, rel=1e-4)
    noisy = fit_form("dz", p, np.full(10, 0.3), np.full(10, 0.01), particle="e-")
    assert math.isfinite(noisy.b_error)
    assert noisy.b_error > 0


def test_tables_that_were_not_kept(tmp_path):
    cg.run("besiii-idc", GUN, n=3, keep=["tracks"], output=tmp_path / "run")
    opened = cg.open(tmp_path / "run")
    for error in (AttributeError, ValueError, NotKeptError):
        with pytest.raises(error, match="made the table 'clusters', but kept only tracks, matches"):
            _ = opened.clusters
    assert opened.states is None
    assert set(opened.to_pandas()) == {"tracks", "matches"}
    early = cg.run("besiii-idc", GUN, n=3, until="digitize")
    assert early.clusters is early.tracks is None
    kept = cg.run("besiii-idc", GUN, n=3, until="find", keep=["candidates"])
    assert kept.tracks is None
    assert getattr(kept, "digis", "none") == "none"


def test_display_says_what_it_has_drawn(tmp_path):
    line = ["display", "-d", "besiii-cgem", "--p", "1", "--cos-theta", "0.1", "--seed", "7", "--event", "3", "--quiet"]
    assert main([*line, "--set", "fit.loss=mean", "-o", str(tmp_path / "out")]) == 0
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["seed"] == 7
    assert record["command"].startswith("cgemit display -d besiii-cgem")
    assert record["settings"]["fit"]["loss"] == "mean"
    assert (record["first_event"], record["events"]) == (3, 1)
    assert cg.load(tmp_path / "out" / "detector.toml") == cg.load("besiii-cgem")
    assert main([*line, "--settings", str(tmp_path / "out" / "run.json"), "-o", str(tmp_path / "again")]) == 0
