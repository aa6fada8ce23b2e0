"""The table of generated background in docs/methods/background.md against the program that writes it."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def program():
    """Return the names of the program."""
    return runpy.run_path(str(ROOT / "docs" / "background_numbers.py"))


def test_the_table_holds_what_is_generated(program):
    page = (ROOT / "docs" / "methods" / "background.md").read_text(encoding="utf-8")
    (written,) = re.findall(r"<!-- begin generated -->\n(.*)\n<!-- end", page, re.DOTALL)
    found = program["generated"](150)
    new = program["table"](found)
    numbers = [[float(x) for x in re.findall(r"\d+\.?\d*", line.split("|")[-2])] for line in written.splitlines()[2:]]
    renewed = [[float(x) for x in re.findall(r"\d+\.?\d*", line.split("|")[-2])] for line in new.splitlines()[2:]]
    for old, again in zip(numbers, renewed, strict=True):
        np.testing.assert_allclose(again, old, rtol=0.12, atol=0.6)
    assert [line.split("|")[1:3] for line in written.splitlines()] == [
        line.split("|")[1:3] for line in new.splitlines()
    ]


def test_runs_go_around_the_chamber(program):
    # Layer 0 of six cells: 5, 0, 1 in event 0, two runs 2-3 and 5 in event 1; layer 1 of four cells: all of them.
    wires = {
        "event": [0, 0, 0, 1, 1, 1, 2, 2, 2, 2],
        "layer": [0] * 6 + [1] * 4,
        "wire": [5, 0, 1, 3, 2, 5, 0, 1, 2, 3],
    }
    hits = {name: np.array(column) for name, column in wires.items()}
    assert sorted(program["runs"](hits, np.array([6, 4]))) == [1, 2, 3, 4]
