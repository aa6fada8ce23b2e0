"""`cgemit find`: numbers, table and picture."""

import csv
import json

import pytest

import cgemit as cg
from cgemit.cli.main import main

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


def test_files(tmp_path, capsys):
    assert main([*LINE, "-o", str(tmp_path / "out")]) == 0
    assert "efficiency (Belle II)" in capsys.readouterr().out
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"efficiency.png", "efficiency.pdf", "efficiency.csv", "summary.json"}
    with (tmp_path / "out" / "efficiency.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    for quantity in ("pt", "cos_theta", "phi"):
        assert sum(int(row["findable"]) for row in rows if row["quantity"] == quantity) == 20
    assert main([*LINE, "-o", str(tmp_path / "out")]) == 2  # the folder holds results


@pytest.mark.parametrize(("words", "fakes"), [(["--finder", "truth"], 0), (["--set", "find.min_score=1000"], 0)])
def test_finder_and_settings(words, fakes, capsys):
    assert main([*LINE, "--json", *words]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["belle2"]["fakes"]["count"] == fakes
    assert numbers["belle2"]["efficiency"]["count"] == (20 if "truth" in words else 0)
