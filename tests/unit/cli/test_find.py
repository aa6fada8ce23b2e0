"""`cgemit find`: numbers, table and picture."""

import csv
import json
import os
import subprocess
import sys

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
    assert names == {"efficiency.png", "efficiency.pdf", "efficiency.csv", "summary.json", ".cgemit"}
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
