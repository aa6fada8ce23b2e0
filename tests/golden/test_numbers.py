"""A few numbers of a small run, kept in a file: a change that nobody meant to make shows here.

They are those of the scalar code, which is the reference: what they are does not depend on the processor.

After a meant change, ``pytest tests/golden --update-golden`` writes the file anew; the change goes into CHANGELOG.md
under "Results change".
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import cgemit as cg

FILE = Path(__file__).with_name("numbers.json")
DETECTORS = ("besiii-cgem-design", "besiii-cgem", "besiii-idc", "besiii-idc-boss")


@pytest.fixture(autouse=True)
def scalar() -> Iterator[None]:
    """Compute with the scalar code, whatever the processor has; afterwards with what was in use before."""
    before = cg.isa.name()
    cg.isa.use("scalar")
    yield
    cg.isa.use(before)


def numbers(detector: str) -> dict[str, float]:
    """Return row counts and sums over 100 events."""
    result = cg.run(detector, cg.Gun("mu-", p=(0.3, 1.5), cos_theta=(-0.9, 0.9)), n=100, seed=1)
    found: dict[str, float] = {f"rows of {name}": len(table) for name, table in result.tables.items()}
    sums = {
        "energy in the gaps, keV": result.truths["energy"],
        "distances of closest approach, mm": np.abs(result.wire_truths["doca"]),
        "strips": result.digis["strip"],
        "drift distances, mm": result.wire_hits["drift"],
        "cluster sizes": result.clusters["size"],
        "chi2": result.tracks["chi2"],
    }
    sums |= {f"|{name}|": np.abs(result.tracks[name]) for name in ("dr", "phi0", "kappa", "dz", "tanl")}
    sums |= {f"error of {name}": result.tracks[f"err_{name}"] for name in ("dr", "phi0", "kappa", "dz", "tanl")}
    return found | {name: float(np.sum(values)) for name, values in sums.items()}


@pytest.mark.parametrize("detector", DETECTORS)
def test_numbers_are_those_on_file(detector: str, request: pytest.FixtureRequest) -> None:
    """Counts are equal and sums agree to one part in a million, which leaves room for compilers."""
    now = numbers(detector)
    kept = json.loads(FILE.read_text()) if FILE.exists() else {}
    if request.config.getoption("--update-golden"):
        FILE.write_text(json.dumps(kept | {detector: now}, indent=1) + "\n")
        return
    changed = {
        name: f"{kept[detector].get(name)} -> {value}"
        for name, value in now.items()
        if kept[detector].get(name) != pytest.approx(value, rel=1e-6, abs=1e-9)
    }
    assert not changed
    assert now.keys() == kept[detector].keys()
