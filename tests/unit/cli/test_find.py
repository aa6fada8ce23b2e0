"""`cgemit find`: numbers, table and picture."""

import csv
import json
import os
import re
import subprocess
import sys
from dataclasses import fields

import pytest

import cgemit as cg
from cgemit.analysis.finding import finding
from cgemit.chain import run as chain
from cgemit.cli.main import main
from cgemit.draw import curves

pytestmark = pytest.mark.usefixtures("undrawn")

LINE = ["find", "-d", "besiii-cgem", "--pt", "0.1:0.5", "--cos-theta", "-0.6:0.6", "-n", "20", "--quiet"]


def test_the_command_prints_what_python_gives(capsys):
    assert main([*LINE, "--tracks", "2", "--json", "--seed", "4"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    gun = cg.Gun("mu-", pt=(0.1, 0.5), cos_theta=(-0.6, 0.6))
    found = cg.study.finding(cg.run("besiii-cgem", gun + gun, n=20, seed=4, finder="ckf", until="find"))
    assert numbers["belle2"]["efficiency"]["n"] == found.findable.sum() == 40
    assert numbers["belle2"]["efficiency"]["count"] == found.rates().efficiency.count
    assert numbers["purity"] == found.purity
    assert numbers["finder"] == "ckf"
    assert numbers["removed"] == found.removed
    assert numbers["belle2"]["wrong_z"]["n"] == numbers["belle2"]["short"]["n"] == len(found.candidates.hits) == 40


def test_layers_without_seeds_are_told(tmp_path, capsys):
    """Wires of one stereo sign make no seeds: tracks need the CGEM."""
    one_sign = {"layers": 12, "r_in": "290 mm", "cells": "15 mm", "half_length": "1 m", "stereo": "60 mrad"}
    text = "\n".join(f"{key} = {json.dumps(value)}" for key, value in one_sign.items())
    path = tmp_path / "one_sign.toml"
    path.write_text(f'base = "kloe2-like"\n[drift_chamber.superlayers.U]\n{text}\n', encoding="utf-8")
    line = ["find", "-d", str(path), "--p", "1", "--cos-theta", "-0.3:0.3", "-n", "5", "--quiet"]
    assert main(line) == 0
    printed = capsys.readouterr().out
    assert re.search(r"layers without seeds +no track begins in wires alone", printed)
    assert re.search(r"findable, in layers that make no seed +0", printed)
    assert main([*line, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["seedless"] == 0
    assert main([*LINE]) == 0
    assert "layers without seeds" not in capsys.readouterr().out


def test_files_hold_the_numbers_of_the_run(tmp_path, capsys, monkeypatch):
    """Few hits are enough for a track: there are fakes, and more of them than clones."""
    runs, pictures = [], []
    simulated, drawn = chain.run, curves.draw_finding
    monkeypatch.setattr(chain, "run", lambda *given, **how: runs.append(simulated(*given, **how)) or runs[-1])
    monkeypatch.setattr(curves, "draw_finding", lambda *given: pictures.append(drawn(*given)) or pictures[-1])
    changes = ("find.min_score=-30", "background.level=bes2026", "background.factor=4")
    loose = ["--tracks", "2", *(f"--set={change}" for change in changes)]
    assert main([*LINE, *loose, "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"efficiency.png", "efficiency.pdf", "efficiency.csv", "summary.json", ".cgemit"}
    found, text = finding(runs[0]), (tmp_path / "out" / "summary.json").read_text(encoding="utf-8")
    rates, milliseconds = found.rates(), 1e3 * runs[0].timings["find"] / 20
    assert rates.fakes.count > rates.clones.count
    assert json.loads(text)["time_per_event"] == {"value": milliseconds, "unit": "ms"}
    assert f"{milliseconds:.2f} ms" in printed
    for name, each in (("belle2", rates), ("acts", found.rates("acts"))):
        numbers = json.loads(text)[name]
        assert numbers.keys() == {field.name for field in fields(each)}
        for rate, one in numbers.items():
            share = getattr(each, rate)
            assert (one["count"], one["n"]) == (share.count, share.n)
            assert [one["value"], one["low"], one["high"]] == [share.value, *share.interval()]
    label = " ".join(part.get_text() for part in pictures[0].texts)
    assert re.findall(r"(fakes|clones) (\d+)", label) == [
        ("fakes", str(rates.fakes.count)), ("clones", str(rates.clones.count)),
    ]  # fmt: skip
    assert re.findall(r"(cut short|wrong in z) (\d+)", label) == [
        ("cut short", str(rates.short.count)), ("wrong in z", str(rates.wrong_z.count)),
    ]  # fmt: skip
    assert f"hit purity {100 * found.purity:.2f} " in label
    assert f"hit efficiency {100 * found.hit_efficiency:.2f} " in label
    with (tmp_path / "out" / "efficiency.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    charged = found.charged & found.findable
    for quantity in ("pt", "cos_theta", "phi"):
        values = getattr(found, quantity)
        bins = [row for row in rows if row["quantity"] == quantity]
        assert sum(int(row["findable"]) for row in bins) == charged.sum()
        for row in bins:
            inside = charged & (values >= float(row["low"]) - 1e-6) & (values < float(row["high"]))
            if int(row["findable"]) == inside.sum() > 0:  # limits have seven digits
                share = found.rates(among=inside).efficiency
                assert float(row["efficiency"]) == pytest.approx(share.value, rel=1e-6)
                ends = [float(row["efficiency_low"]), float(row["efficiency_high"])]
                assert ends == pytest.approx(share.interval(), rel=1e-6)
    assert main([*LINE, "-o", str(tmp_path / "out")]) == 2  # the folder holds results


@pytest.mark.parametrize(("words", "fakes"), [(["--finder", "truth"], 0), (["--set", "find.min_score=1000"], 0)])
def test_finder_and_settings(words, fakes, capsys):
    assert main([*LINE, "--json", *words]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["belle2"]["fakes"]["count"] == fakes
    assert numbers["belle2"]["efficiency"]["count"] == (20 if "truth" in words else 0)


@pytest.mark.slow
def test_memory_is_bounded():
    """Fifty times the background of 2026, with 3 GB of address space for all of the program."""
    line = [
        "find",
        "-d",
        "besiii-cgem-design",
        "--p",
        "1",
        "--cos-theta",
        "0.2",
        "-n",
        "1",
        "--threads",
        "1",
        "--quiet",
    ]
    background = ["--set", "background.level=bes2026", "--set", "background.factor=50"]
    program = "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30)); "
    program += f"from cgemit.cli.main import main; sys.exit(main({[*line, *background]!r}))"
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, env=environment)
