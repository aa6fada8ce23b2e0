"""Sweeps from plans and from the command line are the same as the calls in Python."""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import cgemit as cg
from cgemit.cli.main import main
from cgemit.cli.sweep import add_workers, workers
from cgemit.detector import load, write_field_map
from cgemit.study import Evaluation, grid, sweep
from cgemit.study.sweep.plan import PlanError, read_plan

pytestmark = pytest.mark.usefixtures("undrawn")

DESIGN = cg.load("besiii-cgem-design")


PLAN = """
base = "besiii-cgem-design"
[vary]
"cgem.*.pitch_x" = ["400 um", "900 um"]
[evaluate]
method = "mc"
p = [0.5, "1 GeV/c"]
cos_theta = [0.0, "-0.3:0.3"]
events = 60
seed = 7
particle = "pi+"
[settings.simulate]
deltas = false
"""


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    path = tmp_path / "plan.toml"
    path.write_text(PLAN, encoding="utf-8")
    return path


def test_options_choose_the_workers() -> None:
    """Threads, processes or the default; both at once are refused."""
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_workers(parser)
    with ExitStack() as stack:
        assert workers(parser.parse_args([]), stack) is None
        assert workers(parser.parse_args(["--threads", "3"]), stack) == 3
        pool: Any = workers(parser.parse_args(["--processes", "2"]), stack)
        assert (type(pool), pool._max_workers) == (ProcessPoolExecutor, 2)
    with pytest.raises(argparse.ArgumentError, match="not allowed with argument"):
        parser.parse_args(["--threads", "1", "--processes", "1"])


@pytest.mark.slow
def test_a_plan_is_the_same_call_in_python(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", str(plan), "-o", str(tmp_path / "a"), "--quiet", "--threads", "1"]) == 0
    assert "2 variants, 12 rows" in capsys.readouterr().out
    settings = cg.Settings(simulate=cg.SimulateSettings(deltas=False))
    evaluate = Evaluation(
        "mc", p=[0.5, 1.0], cos_theta=[0.0, (-0.3, 0.3)], events=60, seed=7, particle="pi+", settings=settings
    )
    sweep(DESIGN, {"cgem.*.pitch_x": ["400 um", "900 um"]}, evaluate, output=tmp_path / "b")
    for name in ("sweep.csv", "summary.json", "detector.toml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert (tmp_path / "a" / "sweep.png").stat().st_size > 5000
    assert main(["sweep", str(plan), "-o", str(tmp_path / "c"), "--quiet", "--processes", "2"]) == 0
    assert (tmp_path / "c/sweep.csv").read_bytes() == (tmp_path / "a/sweep.csv").read_bytes()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("evaluate.events=61", {"events": 61}),
        ("evaluate.seed=8", {"seed": 8}),
        ("evaluate.p=0.7", {"p": 0.7}),
        ("evaluate.particle=mu-", {"particle": "mu-"}),
        ("evaluate.cos_theta=0.1", {"cos_theta": 0.1}),
        ("base=besiii-cgem", {"base": "besiii-cgem"}),
        ("evaluate.chunk=2", {"chunk": 2}),
        ("evaluate.samples=2", {"samples": 2}),
        ('evaluate.quantities=["p"]', {"quantities": ["p"]}),
        ('vary.cgem.*.pitch_x=["500 um"]', {"space": {"cgem.*.pitch_x": ["500 um"]}}),
        ("settings.simulate.deltas=true", {"settings": cg.Settings()}),
    ],
)
def test_set_changes_one_value_of_the_plan(plan: Path, change: str, named: dict[str, Any]) -> None:
    from cgemit.cli.options import plan_changes

    before, after = dict(read_plan(plan).arguments), dict(read_plan(plan, plan_changes([change])).arguments)
    expected = before | {name: value for name, value in named.items() if name in before}
    if "space" in named:
        expected["space"] = grid(named["space"])
    elif "base" not in named:
        expected["evaluate"] = dataclasses.replace(before["evaluate"], **named)
    assert after == expected != before


@pytest.mark.slow
def test_parts_of_an_array_are_merged(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main(["sweep", str(plan), "-o", str(whole), "--quiet"]) == 0
    assert main(["sweep", str(plan), "-o", str(parts), "--quiet", "--array-index", "1/2"]) == 0
    assert sorted(path.name for path in parts.iterdir()) == [".cgemit", "chunks", "plan.toml"]
    assert main(["sweep", "--merge", str(parts), "--quiet"]) == 3
    assert "2 of 3 variants are missing" in capsys.readouterr().err
    assert main(["sweep", str(plan), "-o", str(parts), "--quiet", "--array-index", "0/2"]) == 0
    capsys.readouterr()
    assert main(["sweep", "--merge", str(parts), "--quiet", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((whole / "summary.json").read_text())
    assert (parts / "sweep.csv").read_bytes() == (whole / "sweep.csv").read_bytes()


def test_functions_of_a_file_beside_the_plan(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def foils(detector):\n    return {'foils': detector.cgem[0].foils}\n")
    text = 'base = "besiii-cgem-design"\n[evaluate]\nmethod = "mine.py:foils"\n[[variants]]\n"cgem.L1.foils" = 2\n'
    (tmp_path / "plan.toml").write_text(text)
    assert read_plan(tmp_path / "plan.toml").run().columns["foils"] == [3, 2]


def test_a_killed_sweep_leaves_its_plan(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    assert main(["sweep", "--merge", str(tmp_path / "out")]) == 2
    assert "out holds no plan.toml; expected the folder of a sweep" in capsys.readouterr().err
    monkeypatch.setattr(sys.modules["cgemit.study.sweep.run"], "compute_rows", killed)
    assert main(["sweep", str(plan), "-o", str(tmp_path / "out"), "--quiet"]) == 130
    monkeypatch.undo()
    assert main(["sweep", "--merge", str(tmp_path / "out")]) == 3
    assert "3 of 3 variants are missing" in capsys.readouterr().err


def test_merging_reads_a_folder_that_was_moved_and_runs_nothing(tmp_path: Path) -> None:
    (tmp_path / "study").mkdir()
    mine = tmp_path / "study/mine.py"
    mine.write_text("def foils(detector):\n    return {'foils': detector.cgem[0].foils}\n")
    (tmp_path / "study/own.toml").write_text('base = "besiii-cgem-design"\n[cgem.L1]\npitch_x = "700 um"\n')
    text = 'base = "own.toml"\n[evaluate]\nmethod = "mine.py:foils"\n[[variants]]\n"cgem.L1.foils" = 2\n'
    (tmp_path / "study/plan.toml").write_text(text)
    plan = str(tmp_path / "study/plan.toml")
    assert main(["sweep", plan, "-o", str(tmp_path / "study/out"), "--quiet", "--array-index", "0/1"]) == 0
    moved = (tmp_path / "study").rename(tmp_path / "elsewhere")
    stored = str(moved / "out/plan.toml")
    assert str(tmp_path) not in Path(stored).read_text()
    assert read_plan(stored).run().columns["foils"] == [3, 2]
    (moved / "out").rename(tmp_path / "out")
    (moved / "mine.py").write_text("raise RuntimeError\n")
    assert main(["sweep", "--merge", str(tmp_path / "out"), "--quiet"]) == 0
    table = pd.read_csv(tmp_path / "out/sweep.csv")
    assert table["foils"].tolist() == [3, 2]
    assert table["name"][0] == "own"


def test_files_that_variants_name_come_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are relative to the plan; the folder of the results holds copies, under names of the plan where it can."""
    study = tmp_path / "study"
    (study / "thin").mkdir(parents=True)
    axes = {"r": np.linspace(0, 900, 4), "z": np.linspace(-1300, 1300, 5)}
    for name, bz in (("map.npz", -1.0), ("thin/map.csv", -0.9), ("other.npz", -0.8)):
        write_field_map(study / name, {**axes, "br": np.zeros((4, 5)), "bz": np.full((4, 5), bz)})
    (study / "other.npz").rename(tmp_path / "other.npz")
    detector = 'base = "besiii-cgem-design"\n[cgem.L1]\npitch_x = "700 um"\n'
    field = '[field]\nkind = "map"\nfile = "map.csv"\n'
    (study / "detector.toml").write_text(detector)
    (study / "thin/detector.toml").write_text(detector + field)
    (study / "thin/field.toml").write_text(field)
    (study / "plan.toml").write_text("""
base = "besiii-cgem-design"
evaluate = { samples = 2, p = 1.0 }
variants = [
    { base = "detector.toml", "cgem.L1.foils" = 2 }, { base = "thin/detector.toml" }, { base = "besiii-cgem" },
    { field = "map.npz" }, { field = "../other.npz" }, { field = "thin/field.toml" }, { field = "besiii" },
    { field = { kind = "map", file = "map.npz" } }, { base = "thin/detector.toml", "field.file" = "map.npz" },
]
""")
    monkeypatch.chdir(tmp_path)
    for output, part in (("whole", []), ("parts", ["--array-index", "0/1"])):
        assert main(["sweep", "study/plan.toml", "-o", output, "--quiet", *part]) == 0
    table = pd.read_csv("whole/sweep.csv")
    assert table["base"].tolist()[1:4] == ["detector-1.toml", "thin/detector.toml", "besiii-cgem"]
    assert table["field"].tolist()[4:8] == ["map.npz", "other.npz", "thin/field.toml", "besiii"]
    hashes = [
        load("study/detector.toml").with_overrides({"cgem.L1.foils": 2}),
        load("study/thin/detector.toml"),
        load("besiii-cgem"),
        *(
            DESIGN.with_field(f)
            for f in ("study/map.npz", "other.npz", "study/thin/map.csv", "besiii", "study/map.npz")
        ),
        load("study/thin/detector.toml").with_overrides({"field.file": "study/map.npz"}),
    ]
    assert table["hash"].tolist()[1:] == [one.content_hash for one in hashes]
    shutil.rmtree(study)
    (tmp_path / "other.npz").unlink()
    moved = (tmp_path / "parts").rename(tmp_path / "elsewhere")
    assert not [
        path for path in moved.rglob("*.*") if path.is_file() and str(tmp_path) in path.read_text(errors="replace")
    ]
    assert main(["sweep", "--merge", str(moved), "--quiet"]) == 0
    assert (moved / "sweep.csv").read_bytes() == (tmp_path / "whole/sweep.csv").read_bytes()


def test_problems_of_a_plan_are_all_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "plan.toml"
    path.write_text('bse = "x"\n[vary]\n[[variants]]\n[sample]\nkin = "grid"\n[draw]\n')
    with pytest.raises(PlanError) as caught:
        read_plan(path)
    begins = sorted(problem.path for problem in caught.value.problems)
    assert begins == ["base", "bse", "sample.kin", "vary, variants"]
    path.write_text('base = 3\n[vary]\na = []\n[evaluate]\np = "1 mm"\nmethod = "no.py:f"\n[settings.fit]\nlos = 1\n')
    with pytest.raises(PlanError) as caught:
        read_plan(path)
    begins = sorted(problem.path for problem in caught.value.problems)
    assert begins == ["a", "base", "evaluate.method", "evaluate.p", "settings.fit.los"]
    wrong = 'base = "besiii"\n[vary]\n"cgem.L2.anode_radius" = ["-8 mm"]\n"cgem.L1.foil" = [1]\n[evaluate]\nq = 1\n'
    path.write_text(wrong)
    with pytest.raises(PlanError) as caught:
        read_plan(path)
    assert [problem.path for problem in caught.value.problems] == ["evaluate.q", "base"]
    path.write_text(wrong.replace('"besiii"', '"besiii-cgem"').replace("foil", "foilz"))
    with pytest.raises(PlanError) as caught:
        read_plan(path)
    begins = [problem.path for problem in caught.value.problems]
    assert begins == ["evaluate.q", "cgem.L1.foilz", "cgem.L2.anode_radius"]
    assert main(["sweep", str(path), "-o", str(tmp_path / "out")]) == 2
    assert main(["sweep", str(tmp_path / "none.toml"), "-o", str(tmp_path / "out")]) == 2
    assert main(["sweep", str(path)]) == 2
    assert "-o: missing" in capsys.readouterr().err


def test_the_quantity_of_the_picture_is_checked_before_the_sweep(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    text = 'base = "besiii-cgem-design"\n[vary]\n"cgem.L1.foils" = [2]\n[draw]\nquantity = "sigma_dr"\n[evaluate]\n'
    path.write_text(text + 'quantities = ["dr", "p"]\n')
    with pytest.raises(PlanError, match=r'draw.quantity: got .*sigma_dr \(um\), .*did you mean "sigma_dr \(um\)"'):
        read_plan(path)
    for method in ("analytic", "mc"):
        path.write_text(f'{text}method = "{method}"\nevents = 40\nsamples = 2\n'.replace('"sigma_dr"', '"nothing"'))
        with pytest.raises(PlanError) as caught:
            read_plan(path)
        known = caught.value.problems[0].expected.removeprefix("one of ").split(", ")
        found = sweep(DESIGN, [{"cgem.L1.foils": 2}], Evaluation(method, events=40, samples=2))  # type: ignore[arg-type]
        assert set(known) == {name for name in found.results if name != "tracks"}  # which is a word


def test_a_sweep_of_impossible_variants_has_failed_though_the_base_has_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = 'base = "besiii-cgem-design"\n[vary]\n"cgem.L2.anode_radius" = ["160 mm"]\n[evaluate]\nsamples = 2\n'
    (tmp_path / "plan.toml").write_text(text)
    assert main(["sweep", str(tmp_path / "plan.toml"), "-o", str(tmp_path / "out"), "--quiet"]) == 3
    error = capsys.readouterr().err
    assert "no variant could be evaluated" in error
    assert "no overlap with cgem.L2" in error


def test_a_sweep_without_a_possible_variant_has_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.py").write_text("def wrong(detector):\n    raise ValueError('never')\n")
    text = 'base = "besiii-cgem-design"\n[evaluate]\nmethod = "mine.py:wrong"\n[vary]\n"cgem.L1.foils" = [2]\n'
    (tmp_path / "plan.toml").write_text(text)
    assert main(["sweep", str(tmp_path / "plan.toml"), "-o", str(tmp_path / "out"), "--quiet"]) == 3
    assert "ValueError: never" in capsys.readouterr().err
