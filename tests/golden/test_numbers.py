"""Numbers of small runs of every kind, kept in files: an unintended change of a result shows here.

They are numbers of the scalar code, which is the reference and does not depend on the processor. A file holds one case:
for each column of each table the four numbers of `sums`.

After an intended change, ``pytest tests/golden --update-golden`` rewrites the files, and CHANGELOG.md says so under
"Results change". `cgemit.base.version.PHYSICS` rises, with its hash in `VERSIONS`, and makes stored sweeps stale.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.base.version import PHYSICS

FOLDER = Path(__file__).parent / "numbers"
#: Hash of the files for the present physics version, and for those that were released.
VERSIONS = {33: "2c3e36cbff919265"}
DESIGN = "besiii-cgem-design"
MUONS = cg.Gun("mu-", p=(0.3, 1.5), cos_theta=(-0.9, 0.9))
DIMUONS = cg.Gun("mu-", p=(0.3, 1.5), cos_theta=(-0.9, 0.9)) + cg.Gun("mu+", p=(0.3, 1.5), cos_theta=(-0.9, 0.9))
#: A sensor outside of the CGEM, in front of the wires.
WRAPPED = {
    "base": DESIGN,
    "name": "wrapped",
    "layer": {"W": {"radius": "182 mm", "length": "700 mm", "sigma": "50 um", "thickness": "0.3 mm", "material": "Si"}},
}
SPACE = {"cgem.L1.pitch_x": ("400 um", "1000 um"), "cgem.L2.anode_radius": ("120 mm", "150 mm")}


def settings(**stages: Mapping[str, Any]) -> cg.Settings:
    """Return the settings with these fields of some stages changed."""
    return cg.Settings.from_dict(stages)


def run(
    detector: Any = DESIGN, gun: Any = MUONS, n: int | None = 40, *, stages: Mapping[str, Any] | None = None, **how: Any
) -> dict[str, Any]:
    """Return the tables of a run."""
    return dict(cg.run(detector, gun, n, 1, settings=settings(**(stages or {})), **how).tables)


def decays_in_flight() -> dict[str, Any]:
    slow: dict[str, Any] = {"p": (0.2, 0.5), "cos_theta": (-0.9, 0.9)}
    return run(gun=cg.Gun("K+", **slow) + cg.Gun("K-", **slow) + cg.Gun("pi-", **slow))


def vertices() -> dict[str, Any]:
    result = cg.run(DESIGN, cg.sample("ks-pipi"), 40, 1, settings=settings(simulate={"decays": False}))
    return {"vertices": cg.fit_vertices(DESIGN, result.tracks, particles=("pi", "pi"))}


def analytic() -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, detector, how in (
        ("binary", DESIGN, {}),
        ("map", cg.load(DESIGN).with_field("besiii"), {}),
        ("tiger", DESIGN, {"readout": "tiger"}),
        ("layer", DESIGN, {"radius": 120.0}),
    ):
        covariance = cg.analytic(detector, "mu-", p=[0.3, 1.0], cos_theta=[0.0, 0.8], **how)
        found[name] = covariance.table()
        if "radius" not in how:
            found[f"budget {name}"] = covariance.budget("dr").table()
    sensitivity = cg.sensitivity(DESIGN, "mu-", p=1.0)
    return found | {"sensitivity": sensitivity.to_pandas()}


def sweep() -> dict[str, Any]:
    pitches = {"cgem.*.pitch_x": ["400 um", "650 um"]}
    analytic, simulated = (
        cg.study.sweep(DESIGN, pitches, cg.study.Evaluation(how, p=[0.3, 1.0], events=40, samples=16)).to_pandas()
        for how in ("analytic", "mc")
    )
    return {"analytic": analytic, "simulated": simulated}


def optimize() -> dict[str, Any]:
    how: dict[str, Any] = {"evaluate": cg.study.Evaluation(p=0.3, samples=16)}
    search = cg.study.Search(population=8, offspring=4, calls=3)
    optimum = cg.study.optimize(DESIGN, SPACE, minimize="dr", constraints={"channels": (None, 10010)}, **how)
    front = cg.study.optimize(DESIGN, SPACE, minimize=["dr", "channels"], search=search, **how)
    return {"optimum": optimum.to_pandas(), "front": front.to_pandas()}


#: Every kind of result. Cases are small: all of them take seconds.
CASES: dict[str, Callable[[], dict[str, Any]]] = {
    **{
        name: lambda name=name: run(name, n=100)
        for name in ("besiii-cgem-design", "besiii-cgem", "besiii-idc", "besiii-idc-boss", "kloe2-like")
    },
    "gaussian": lambda: run(readout="gaussian"),
    "tiger": lambda: run(readout="tiger"),
    "apv25": lambda: run(readout="apv25"),
    "tiger-second-pass": lambda: run(readout=cg.TigerReadout(second_pass=True)),
    "analog-projection": lambda: run(readout="analog-projection"),
    "ckf-background": lambda: run(gun=DIMUONS, finder="ckf", n=10, stages={"background": {"level": "bes2009"}}),
    "pixel-binary": lambda: run("besiii-pixel"),
    "pixel-tiger2": lambda: run("besiii-pixel", readout=cg.TigerReadout(second_pass=True)),
    "pixel-background-ckf": lambda: run(
        "besiii-pixel", gun=DIMUONS, finder="ckf", n=10, stages={"background": {"level": "bes2009"}}
    ),
    "wrap-tiger2": lambda: run(WRAPPED, readout=cg.TigerReadout(second_pass=True)),
    "raw-times": lambda: run("besiii-cgem", finder="ckf", stages={"digitize": {"wire_times": "raw"}}),
    "start-time": lambda: run(
        gun=DIMUONS, finder="ckf", n=20, stages={"background": {"start_time": 5.0}, "refine": {"start_time": "fitted"}}
    ),
    "raw-start-tiger": lambda: run(
        "besiii-cgem",
        finder="ckf",
        readout="tiger",
        stages={
            "digitize": {"wire_times": "raw"},
            "background": {"start_time": 5.0},
            "refine": {"start_time": "fitted"},
        },
    ),
    "half-turns": lambda: run(
        gun=cg.Gun("pi-", p=(0.06, 0.12), cos_theta=(-0.3, 0.3)), finder="ckf", stages={"simulate": {"half_turns": 4}}
    ),
    "decays": decays_in_flight,
    "field-map": lambda: run(
        cg.load(DESIGN).with_field("besiii"), stages={"fit": {"states": ["hits"], "residuals": True}}
    ),
    "vertices": vertices,
    "analytic": analytic,
    "sweep": sweep,
    "optimize": optimize,
}  # fmt: skip


@pytest.fixture(autouse=True)
def scalar() -> Iterator[None]:
    """Compute with the scalar code; restore the instruction set afterwards."""
    before = cg.isa.name()
    cg.isa.use("scalar")
    yield
    cg.isa.use(before)


def sums(table: Any) -> dict[str, list[float]]:
    """Return four numbers of each column of numbers, over its finite entries.

    They are the number of entries, their sum, the sum of their squares, and the sum weighted with their position in the
    column (from 1): a change of sign shows in the second, a change of order in the last.
    """
    columns = {name: np.asarray(table[name]) for name in getattr(table, "columns", table)}
    return {name: _moments(values) for name, values in columns.items() if values.dtype.kind in "iufb"}


def _moments(values: np.ndarray[Any, Any]) -> list[float]:
    flat = values.astype(np.float64).ravel()
    finite = np.isfinite(flat)
    x = np.where(finite, flat, 0.0)
    found = (np.count_nonzero(finite), x.sum(), (x * x).sum(), (x * np.arange(1, len(x) + 1)).sum())
    return [float(f"{number:.10g}") for number in found]


def changes(tables: Mapping[str, Any], kept: Mapping[str, Mapping[str, list[float]]]) -> dict[str, str]:
    """Return the columns whose numbers are not those on file.

    Counts are equal. Sums agree to one part in a million of the sum of absolute values, which leaves room for
    compilers, also where positive and negative entries cancel.
    """
    found = {}
    for name in {**kept, **tables}:
        now = sums(tables[name]) if name in tables else {}
        sizes = {column: _moments(np.abs(np.asarray(tables[name][column]))) for column in now}
        before = kept.get(name, {})
        for column in {**before, **now}:
            pair = before.get(column), now.get(column)
            if None in pair or not _agree(*pair, sizes[column]):
                found[f"{name}: {column}"] = f"{pair[0]} -> {pair[1]}"
    return found


def _agree(before: list[float], now: list[float], sizes: list[float]) -> bool:
    pairs = zip(before[1:], now[1:], sizes[1:], strict=True)
    return before[0] == now[0] and all(abs(a - b) <= max(1e-6 * size, 1e-9) for a, b, size in pairs)


@pytest.mark.parametrize("case", CASES)
def test_numbers_are_those_on_file(case: str, request: pytest.FixtureRequest) -> None:
    tables = {name: table for name, table in CASES[case]().items() if table is not None}
    file = FOLDER / f"{case}.json"
    if request.config.getoption("--update-golden"):
        texts = []
        for name, table in tables.items():
            lines = ",\n".join(f"  {json.dumps(column)}: {json.dumps(of)}" for column, of in sums(table).items())
            texts.append(f"{json.dumps(name)}: {{\n{lines}\n}}")
        file.write_text("{\n" + ",\n".join(texts) + "\n}\n")
        return
    assert not changes(tables, json.loads(file.read_text()))


@pytest.fixture(scope="module")
def small() -> dict[str, Any]:
    """Return the columns of tracks and matches of a small run."""
    tables = run(n=5)
    return {
        name: {column: np.asarray(tables[name][column]) for column in tables[name]} for name in ("tracks", "matches")
    }


@pytest.mark.parametrize("column", ["dr", "phi0", "kappa", "dz", "tanl", "cov", "res_dr", "pull_dz"])
@pytest.mark.parametrize("mistake", ["negated", "reversed", "one negated", "one missing"])
def test_wrong_column_is_noticed(small: dict[str, Any], column: str, mistake: str) -> None:
    """The numbers on file see signs, order and values that are missing, of that column alone."""
    kept = {name: sums(table) for name, table in small.items()}
    assert not changes(small, kept)
    name = "tracks" if column in small["tracks"] else "matches"
    right = small[name][column]
    one = np.arange(len(right)).reshape(-1, *[1] * (right.ndim - 1)) == 2
    wrong = {
        "negated": -right, "reversed": right[::-1], "one negated": np.where(one, -right, right),
        "one missing": np.where(one, np.nan, right),
    }  # fmt: skip
    assert list(changes({**small, name: {**small[name], column: wrong[mistake]}}, kept)) == [f"{name}: {column}"]


def test_every_file_belongs_to_a_case() -> None:
    assert {file.stem for file in FOLDER.glob("*.json")} == set(CASES)


def test_physics_version_belongs_to_the_numbers() -> None:
    texts = (file.name.encode() + file.read_bytes() for file in sorted(FOLDER.glob("*.json")))
    found = hashlib.sha256(b"".join(texts)).hexdigest()[:16]
    assert (max(VERSIONS), VERSIONS[PHYSICS]) == (PHYSICS, found)
