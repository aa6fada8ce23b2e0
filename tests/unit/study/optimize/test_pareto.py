"""Several objectives: fronts, hypervolumes and errors by brute force; NSGA-II continued and limited."""

from __future__ import annotations

import os
import sys
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

import cgemit as cg
from cgemit.analysis.widths import GROUPS
from cgemit.draw.design import draw_front
from cgemit.draw.design import optimum_label as label
from cgemit.study import Evaluation, Optimization, PlanError, Search, optimize
from cgemit.study.optimize.pareto import by_noise, growth, hypervolume, nondominated, within_errors
from kill_sweeps import executor

DESIGN = cg.load("besiii-cgem-design")
SPACE = {
    "cgem.L1.anode_radius": ("80 mm", "115 mm"),
    "cgem.L2.anode_radius": ("100 mm", "155 mm"),
    "cgem.*.pitch_x": ("400 um", "900 um"),
    "cgem.*.foils": [1, 2, 3],
}
HOW: dict[str, Any] = {
    "minimize": ["dr @ 0.3", "dz", "channels"],
    "evaluate": Evaluation(p=[0.3, 1.0], samples=40),
    "constraints": {"x0": (None, 1.3)},
}


def search(calls: int, population: int = 12) -> Search:
    return Search(population=population, offspring=5, calls=calls)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Optimization, Path]:
    folder = tmp_path_factory.mktemp("front")
    return optimize(DESIGN, SPACE, output=folder, **HOW, search=search(6)), folder


def points(n: int, dimensions: int) -> Any:
    return np.random.default_rng(5).integers(0, 6, (n, dimensions)).astype(float)


@pytest.mark.parametrize("dimensions", [1, 2, 3, 4])
def test_front_and_hypervolume_by_brute_force(dimensions: int) -> None:
    values = points(25, dimensions)
    front = [not any((b <= a).all() and (b < a).any() for b in values) for a in values]
    assert nondominated(values).tolist() == front
    reference = np.full(dimensions, 5.0)
    cells = product(range(5), repeat=dimensions)  # unit cells by their lower corners
    inside = sum(any((one <= cell).all() for one in values) for cell in map(np.array, cells))
    assert hypervolume(values, reference) == inside
    assert hypervolume(values[:0], reference) == 0


def test_hypervolume_grows_to_that_of_all_designs() -> None:
    values = points(40, 3)
    values[::7] = np.nan
    reference = np.full(3, 5.0)
    grown = growth(values, np.repeat(range(8), 5).tolist(), reference)
    assert [one[:2] for one in grown] == [(i, 5 * i + 5) for i in range(8)]
    assert all(one[2] <= other[2] for one, other in pairwise(grown))
    assert grown[-1][2] == hypervolume(values[np.isfinite(values).all(axis=1)], reference)


def test_a_front_is_not_decided_by_noise() -> None:
    rng = np.random.default_rng(1)
    values = np.array([[1.0, 5.0], [1.01, 5.0], [1.2, 5.0], [1.01, 6.0]])
    own, common = rng.normal(0, 1, (4, GROUPS)), rng.normal(0, 1, GROUPS)
    replicas = np.repeat(values[:, :, None], GROUPS, axis=2)
    front = nondominated(values)
    assert front.tolist() == [True, False, False, False]
    replicas[:, 0] += 0.004 * own  # the error of a difference is about 0.02
    assert within_errors(values, replicas, front).tolist() == [False, True, False, False]
    replicas[:, 0] = values[:, :1] + 0.004 * common  # the same tracks: differences have no error
    assert not within_errors(values, replicas, front).any()
    # The second design is of the front by 0.01 +- 0.02 only, the third by 0.2.
    values = np.array([[1.01, 5.0], [1.0, 6.0], [0.8, 6.0]])
    replicas = np.repeat(values[:, :, None], GROUPS, axis=2)
    replicas[:, 0] += 0.004 * own[:3]
    assert by_noise(values[:2], replicas[:2], np.array([True, True])).tolist() == [False, True]
    assert by_noise(values[::2], replicas[::2], np.array([True, True])).tolist() == [False, False]


def test_the_front_of_a_search_keeps_the_limits_and_is_dominated_by_nothing(found: tuple[Optimization, Path]) -> None:
    result, _ = found
    table = result.to_pandas()
    assert len(table) == 1 + 12 + 6 * 5
    assert table["call"].value_counts().to_dict() == {0: 13} | dict.fromkeys(range(1, 7), 5)
    allowed = table[table["allowed"]]
    assert (allowed["x0 (%)"] <= 1.3 + 1e-6).all()
    assert set(table["status"]) == {"ok", "impossible"}  # L1 and L2 may touch
    names = [one.header for one in result.objectives]
    front = table.loc[result.front, names].to_numpy()
    for row in allowed[names].to_numpy():
        assert not ((row <= front).all(axis=1) & (row < front).any(axis=1)).any()
    assert (table["sigma_dz_error (mm)"][allowed.index] > 0).all()
    assert result.growth[-1][2] > 1.05 * result.growth[0][2] > 0
    assert 0 < result.hypervolume_error < 0.2 * result.growth[-1][2]


@pytest.mark.slow
def test_evolution_beats_random_designs() -> None:
    how = HOW | {"minimize": ["dr @ 0.3", "channels"], "constraints": {}}
    evolved = optimize(DESIGN, SPACE, **how, search=search(12))
    random = optimize(DESIGN, SPACE, **how, search=search(0, population=72))
    volumes = []
    for one in (evolved, random):
        values = np.array([one["sigma_dr at 0.3 GeV/c (um)"], one["channels"]]).T[one.front]
        volumes.append(hypervolume(values, np.array([400.0, 15000.0])))
    assert len(evolved) == len(random) == 73
    assert volumes[0] > 1.03 * volumes[1]


def test_each_call_and_each_seed_draws_other_designs(monkeypatch: pytest.MonkeyPatch) -> None:
    import optuna

    seeds: list[int] = []

    class Sampler(optuna.samplers.NSGAIISampler):
        def __init__(self, *, seed: int, **how: Any) -> None:
            seeds.append(seed)
            super().__init__(seed=seed, **how)

    monkeypatch.setattr(optuna.samplers, "NSGAIISampler", Sampler)
    for seed in (1, 2):
        few = Search(method="nsga2", population=4, offspring=2, calls=3, seed=seed)
        space = {"cgem.*.pitch_x": ("400 um", "900 um")}
        optimize(DESIGN, space, minimize=["channels", "area"], evaluate=Evaluation(samples=2), search=few)
    assert len(seeds) == len(set(seeds)) >= 6


def test_progress_is_the_share_of_the_calls() -> None:
    """The random designs and each of the three calls are a quarter."""
    told: list[tuple[float, str]] = []
    few = Search(method="nsga2", population=4, offspring=2, calls=3)
    space = {"cgem.*.pitch_x": ("400 um", "900 um")}
    how: dict[str, Any] = {"evaluate": Evaluation(samples=2), "search": few}
    optimize(DESIGN, space, minimize=["channels", "area"], **how, progress=lambda *one: told.append(one))
    evolution = [(share, text) for share, text in told if text.startswith("optimize, ")]
    assert evolution == [(0.25 * (i + 1), f"optimize, {4 + 2 * i} designs") for i in range(4)]


def test_an_interrupted_search_continues_to_the_same_end(found: tuple[Optimization, Path], tmp_path: Path) -> None:
    _, whole = found
    optimize(DESIGN, SPACE, output=tmp_path, **HOW, search=search(2))
    (journal,) = (tmp_path / "journals").iterdir()
    with journal.open("ab") as stream:  # killed while it wrote the next call
        stream.write((whole / "journals" / journal.name).read_bytes()[journal.stat().st_size :][:3000])
    chunk = next(iter((tmp_path / "chunks").iterdir()))
    chunk.write_bytes(chunk.read_bytes()[:-20])
    with pytest.warns(UserWarning, match=f"{chunk.name} cannot be read"):
        optimize(DESIGN, SPACE, output=tmp_path, **HOW, search=search(6))
    assert (tmp_path / "optimize.csv").read_bytes() == (whole / "optimize.csv").read_bytes()
    trials = JournalStorage(JournalFileBackend(str(journal))).get_all_trials(0)
    assert len(trials) == 42
    # Once more: nothing is asked, nothing is computed.
    before = journal.read_bytes()
    optimize(DESIGN, SPACE, output=tmp_path, **HOW, search=search(6))
    assert journal.read_bytes() == before


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of dask, about the cluster that is taken apart
def test_dask_finds_what_one_process_finds(found: tuple[Optimization, Path], tmp_path: Path) -> None:
    with executor("dask") as workers:
        other = optimize(DESIGN, SPACE, output=tmp_path / "dask", workers=workers, **HOW, search=search(6))
    assert (tmp_path / "dask" / "optimize.csv").read_bytes() == (found[1] / "optimize.csv").read_bytes()
    assert other.columns == found[0].columns


def test_a_file_that_is_no_journal_is_a_problem(tmp_path: Path) -> None:
    optimize(DESIGN, SPACE, output=tmp_path, **HOW, search=search(0))
    (journal,) = (tmp_path / "journals").iterdir()
    lines = journal.read_text()
    journal.write_text("[1]\n")
    with pytest.raises(ValueError, match="expected a journal of Optuna"):
        optimize(DESIGN, SPACE, output=tmp_path, **HOW, search=search(0))
    for wrong in ("{", "[" * 100_000, "1" * 5000):
        journal.write_text(f"{wrong}\n{lines}")
        with pytest.warns(UserWarning, match=r"line 1 cannot be read .* goes on from the lines before"):
            optimize(DESIGN, SPACE, output=tmp_path, **HOW, search=search(0))
    journal.unlink()
    os.mkfifo(journal)
    with pytest.raises(ValueError, match="a pipe or a device"):
        optimize(DESIGN, SPACE, output=tmp_path, **HOW, search=search(0))


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(PlanError, match=r"pip install 'cgemit\[opt\]'"):
        optimize(DESIGN, SPACE, **HOW, search=search(0))


def test_one_objective_with_choices_has_an_optimum() -> None:
    how = HOW | {"minimize": "dr", "constraints": {}}
    best = optimize(DESIGN, SPACE, **how, search=search(2))
    assert best.method == "nsga2"
    (row,) = best.front
    assert best["sigma_dr (um)"][row] == best["sigma_dr (um)"][1:][best["allowed"][1:]].min()


def test_pictures_show_the_table(found: tuple[Optimization, Path]) -> None:
    result, _ = found
    picture = result.draw("front")
    names = [one.header for one in result.objectives]
    panels = [axes for axes in picture.axes if axes.get_xlabel()]
    assert [(a.get_xlabel(), a.get_ylabel()) for a in panels] == [
        (label(x), label(y)) for x, y in ((names[0], names[1]), (names[0], names[2]), (names[1], names[2]))
    ]
    drawn = panels[0].collections[-1].get_offsets()
    rows = sorted(result.front)
    np.testing.assert_array_equal(drawn, np.array([result[names[0]][rows], result[names[1]][rows]]).T)
    (line,) = [one for one in result.draw("convergence").axes[0].lines if len(one.get_xdata()) > 1]
    assert line.get_xdata().tolist() == [one[1] for one in result.growth]
    parallel = result.draw("parallel").axes[0]
    lines = [one for one in parallel.lines if len(one.get_xdata()) == 4 + 4]
    assert len(lines) == len(result.front)
    with pytest.raises(ValueError, match="expected one of convergence, front, parallel"):
        result.draw("map")


def test_the_legend_of_two_objectives_fits_into_the_picture() -> None:
    columns = {
        "front": ["dominated", "front", "front within errors", "within errors", "dominated"],
        "allowed": [True] * 5,
        "sigma_dr (um)": [160.0, 110.0, 112.0, 113.0, 150.0],
        "channels": [5500.0, 6000.0, 5900.0, 5950.0, 6100.0],
    }
    picture = draw_front(columns, ["sigma_dr (um)", "channels"], [None, None], "tiny")
    picture.draw_without_rendering()
    (legend,) = picture.legends
    box = legend.get_window_extent()
    assert len(legend.get_texts()) == 5
    assert 0 <= box.x0 < box.x1 <= picture.bbox.x1


@pytest.mark.parametrize(
    ("header", "text"),
    [
        ("sigma_dr at 0.3 GeV/c (um)", r"σ($d_\rho$) at 0.3 GeV/c  (µm)"),
        ("sigma_p (MeV/c)", "σ(p)  (MeV/c)"),
        ("channels", "channels"),
        ("cgem.*.pitch_x (um)", "cgem.*.pitch_x  (µm)"),
        ("x0 (%)", "X/X₀ of the CGEM  (%)"),
    ],
)
def test_labels_have_units_and_symbols(header: str, text: str) -> None:
    assert label(header) == text
