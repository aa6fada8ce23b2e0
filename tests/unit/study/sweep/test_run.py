"""Sweeps: spaces and tables, errors of differences, chunks continued after damage, any executor, killed workers."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import cgemit as cg
from cgemit.analysis.widths import jackknife, without_groups
from cgemit.base.files import CONTENTS, OutputExistsError
from cgemit.detector import Detector
from cgemit.study import Evaluation, grid, latin_hypercube, sobol, sweep
from cgemit.study.evaluation import seed_of
from cgemit.study.sweep.evaluate import budgets
from cgemit.study.sweep.run import Task, rows_of_text, work
from cgemit.study.sweep.space import PlanError, key_problems, value_problems
from cgemit.tables.schema import FitStatus
from cgemit.tables.show import with_error
from kill_sweeps import FILES, SPACE, killed_until_complete, swept, written

DESIGN = cg.load("besiii-cgem-design")
PITCHES = {"cgem.*.pitch_x": ["400 um", "900 um"], "cgem.L2.anode_radius": ["132.5 mm", "160 mm"]}


def channels(detector: Detector) -> dict[str, Any]:
    """Return the number of strips, and the thickness of the first layer."""
    strips = sum(layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem)
    return {"strips": strips, "x0 (%)": 100 * sum(shell.x0 for shell in detector.cgem[0].shells())}


def test_a_grid_is_a_table_with_a_row_for_each_variant_and_the_base_first() -> None:
    found = sweep(DESIGN, PITCHES, evaluate=channels)
    table = found.to_pandas()
    assert table["cgem.*.pitch_x (um)"].tolist() == [650, 400, 400, 900, 900]
    assert table["cgem.L2.anode_radius (mm)"].tolist() == [132.5, 132.5, 160, 132.5, 160]
    assert table["status"].tolist() == ["ok", "ok", "impossible", "ok", "impossible"]
    assert table["strips"][[0, 1, 3]].tolist() == [channels(found.detector(i))["strips"] for i in (0, 1, 3)]
    assert table["strips"].isna().tolist() == [False, False, True, False, True]
    assert "no overlap with cgem.L2" in table["problems"][2]
    assert table["hash"].tolist() == [DESIGN.content_hash, *(found.detector(1).content_hash, ""), table["hash"][3], ""]
    assert len(set(table["name"])) == 5
    assert table["name"][1] == found.detector(1).name
    assert found.detector(1).cgem[0].pitch_x == 0.4


def test_a_grid_becomes_an_xarray_dataset() -> None:
    found = sweep(DESIGN, PITCHES, evaluate=channels)
    cube = found.to_xarray()
    assert dict(cube.sizes) == {"cgem.*.pitch_x (um)": 2, "cgem.L2.anode_radius (mm)": 2}
    cell = cube["strips"].sel({"cgem.*.pitch_x (um)": 900, "cgem.L2.anode_radius (mm)": 132.5})
    assert float(cell) == found["strips"][3]
    with pytest.raises(ValueError, match="expected a grid"):
        sweep(DESIGN, [{"cgem.L1.foils": 2}], evaluate=channels).to_xarray()


def test_axes_of_words_of_relative_values_and_of_other_bases() -> None:
    space = {"base": ["besiii-cgem-design", "besiii-cgem"], "field": ["uniform", "besiii"],
             "cgem.*.drift_gap": ["x0.5", "x1"], "cgem.*.gas": ["CgemGas", "MdcGas"]}  # fmt: skip
    found = sweep(DESIGN, space, evaluate=lambda d: {"gap": d.cgem[0].drift_gap, "kind": d.field.kind})
    assert found.parameters == ("base", "field", "cgem.*.drift_gap (times)", "cgem.*.gas")
    assert found.columns["cgem.*.drift_gap (times)"][:3] == [1.0, 0.5, 0.5]
    assert found.columns["cgem.*.gas"][:3] == ["CgemGas", "CgemGas", "MdcGas"]
    assert set(found.columns["status"]) == {"ok"}
    gaps = {"besiii-cgem-design": 5.0, "besiii-cgem": cg.load("besiii-cgem").cgem[0].drift_gap}
    factors = found["cgem.*.drift_gap (times)"][1:]
    assert found["gap"][1:].tolist() == [gaps[b] * f for b, f in zip(found["base"][1:], factors, strict=True)]
    assert len(set(found.columns["name"])) == 17


def test_the_base_has_a_number_where_a_key_stands_for_all_wire_layers() -> None:
    space = {"drift_chamber.sigma": ["110 um", "140 um"], "cgem.*.pitch_x": ["x2", "500 um"]}
    found = sweep(DESIGN, space, evaluate=channels)
    assert found.columns["drift_chamber.sigma (um)"][:3] == [130.0, 110.0, 110.0]
    assert found.columns["cgem.*.pitch_x"][:3] == ["0.65 mm", "x2", "500 um"]


@pytest.mark.parametrize("sample", [sobol, latin_hypercube])
def test_samples_fill_their_ranges(sample: Callable[..., Any]) -> None:
    ranges = {"cgem.*.pitch_x": ("400 um", "900 um"), "cgem.*.drift_gap": ("x0.5", "x1.5"), "cgem.*.foils": (1, 4),
              "cgem.*.gas": ["CgemGas", "MdcGas"], "drift_chamber.efficiency": (0.5, 1.0)}  # fmt: skip
    found = sample(ranges, 64, seed=3)
    pitches = [float(one["cgem.*.pitch_x"].removesuffix(" um")) for one in found.variants]
    assert np.histogram(pitches, 8, (400, 900))[0].tolist() == [8] * 8
    assert sorted({one["cgem.*.foils"] for one in found.variants}) == [1, 2, 3, 4]
    assert [one["cgem.*.gas"] for one in found.variants].count("MdcGas") == 32
    assert all(0.5 <= one["drift_chamber.efficiency"] <= 1 for one in found.variants)
    assert found == sample(ranges, 64, seed=3) != sample(ranges, 64, seed=4)
    table = sweep(DESIGN, found, evaluate=channels)
    assert table.columns["cgem.*.pitch_x (um)"][1:] == pitches
    assert set(table.columns["status"]) == {"ok"}


def test_problems_of_spaces_and_arguments_are_all_listed() -> None:
    with pytest.raises(PlanError) as caught:
        sobol({"a": ("1 mm", "2 um"), "b": ("3 mm", "1 mm"), "c": 4}, 0)
    assert [line.partition(":")[0].strip() for line in str(caught.value).splitlines()[1:]] == ["n", "a", "b", "c"]
    with pytest.raises(PlanError, match="each value once"):
        grid({"a": [1, 1]})
    with pytest.raises(ValueError, match="sweep: 7 problems") as wrong:
        sweep(
            DESIGN,
            PITCHES,
            {"method": "magic", "p": -1, "chunk": 0, "events": 0, "quantities": ["x"], "samples": 0},
            part=(3, 2),
        )  # type: ignore[arg-type]
    for text in (
        "evaluate.method: got 'magic'",
        "events: got 0",
        "evaluate.p: got",
        "part: got (3, 2)",
        "chunk: got 0",
        "quantities[0]: got 'x'",
        "samples: got 0",
    ):
        assert text in str(wrong.value)
    with pytest.raises(ValueError, match="expected a charged particle"):
        sweep(DESIGN, PITCHES, evaluate=Evaluation(particle="gamma"))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"cgem.*.ptich_x": "400 um"}, ["cgem.*.ptich_x: got an unknown key", 'did you mean "pitch_x"?']),
        ({"cgem.L1.ptich_x": "x1.1"}, ["cgem.L1.ptich_x: ", 'did you mean "pitch_x"?']),
        ({"cgem.L9.pitch_x": "400 um"}, ["cgem.L9.pitch_x: got 'L9'", "expected one of L1, L2, L3"]),
        ({"cgem.L9.pitch_x": "x1.1"}, ["cgem.L9.pitch_x: got 'L9'", "expected one of L1, L2, L3"]),
        ({"cgem.*.foil.Kaptn.thickness": "60 um"}, ["cgem.*.foil.Kaptn.thickness: "]),
        ({"cgem.L1": {"ptich_x": "400 um"}}, ["cgem.L1: got an unknown key", 'did you mean "pitch_x"?']),
        ({"cgem.L[89].foils": 2}, ["cgem.L[89].foils: ", "matches nothing"]),
        ({"cgm.L1.foils": 2, "cgem.L1.foil": 2}, ["cgm.L1.foils: ", 'did you mean "cgem"?']),
    ],
)
def test_keys_that_name_nothing_are_refused_at_once(changes: dict[str, Any], expected: list[str]) -> None:
    def never(detector: Detector) -> dict[str, Any]:
        raise AssertionError

    with pytest.raises(PlanError) as caught:
        sweep(DESIGN, [{"cgem.L1.foils": 2}, changes], evaluate=never)
    (text,) = str(caught.value).splitlines()[1:]
    assert text.strip().startswith(expected[0])
    assert all(part in text for part in expected)


def test_numbers_that_a_key_never_allows_are_refused_at_once() -> None:
    """Without a unit, of another dimension, negative; each once, five of a key. Overlaps depend on other parts."""
    space = {
        "cgem.L2.anode_radius": ["-80 mm", 85, "120", "160 mm", "x0.9"],
        "cgem.*.pitch_x": ["1 rad", "400 um"],
        "drift_chamber.efficiency": [0.9, 2],
        "cgem.L1.gas": ["MdcGas"],
    }
    with pytest.raises(PlanError) as caught:
        sweep(DESIGN, space, channels)
    assert [(problem.path, problem.given) for problem in caught.value.problems] == [
        ("cgem.L2.anode_radius", '"-80 mm"'),
        ("cgem.L2.anode_radius", "85 (no unit)"),
        ("cgem.L2.anode_radius", '"120" (no unit)'),
        ("cgem.*.pitch_x", '"1 rad" (an angle)'),
        ("drift_chamber.efficiency", "2"),
    ]
    many = [(DESIGN, {"cgem.L1.pitch_x": number}) for number in range(30)]
    assert len(value_problems(many)) == 5
    assert value_problems([(DESIGN, {"cgem.L4.anode_radius": 3})]) == []  # of a new layer
    assert value_problems([(cg.load("cepc-like"), {"drift_chamber.superlayers.S1.cells": 200})]) == []  # or their width


def test_simulated_widths_are_printed_with_their_errors() -> None:
    found = sweep(DESIGN, {"cgem.L1.foils": [2]}, Evaluation("mc", p=1.0, events=60, quantities=("dr",)))
    sigma, error = (found[f"sigma_dr{name} (um)"][1] for name in ("", "_error"))
    head, *rows = (line.split("  ") for line in str(found).splitlines()[1:])
    assert "sigma_dr (um)" in [cell.strip() for cell in head]
    assert with_error(sigma, error) in [cell.strip() for cell in rows[1]]


def test_wrong_types_are_problems_of_their_arguments() -> None:
    for part in (1, (1,), (0.5, 2), "01"):
        with pytest.raises(PlanError, match="part: got"):
            sweep(DESIGN, PITCHES, channels, part=part)  # type: ignore[arg-type]
    for space in (None, 5, "a", {5: [1]}, [{5: 1}]):
        with pytest.raises(PlanError, match=r"dotted key|dict of lists"):
            sweep(DESIGN, space, channels)  # type: ignore[arg-type]
    for sample in (sobol, latin_hypercube):
        for wrong in (None, 5, []):
            with pytest.raises(PlanError, match="space: got"):
                sample(wrong, 2)  # type: ignore[arg-type]
        with pytest.raises(PlanError, match="seed: got 'a'"):
            sample({"cgem.*.foils": (1, 3)}, 2, seed="a")  # type: ignore[arg-type]
        with pytest.raises(PlanError, match="expected the lower end first"):
            sample({"cgem.*.pitch_x": ("500 um", "400 um")}, 2)
    with pytest.raises(TypeError, match="output: got 5"):
        sweep(DESIGN, PITCHES, channels, output=5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="workers: got 0"):
        sweep(DESIGN, PITCHES, channels, workers=0)
    found = sweep(DESIGN, PITCHES, channels)
    for variant in (-1, 99, "a", None):
        with pytest.raises(ValueError, match="variant: got"):
            found.detector(variant)  # type: ignore[arg-type]


def test_a_grid_too_large_is_refused_before_it_is_made() -> None:
    with pytest.raises(PlanError, match=r"got 1e\+12 variants, expected at most 10000000"):
        grid({f"cgem.L{i}.{name}": list(range(100)) for i in (1, 2, 3) for name in ("pitch_x", "pitch_v")})


def test_keys_of_new_parts_and_of_other_bases_are_no_mistakes() -> None:
    added = {"cgem.L4": {"like": "L3"}, "cgem.L4.anode_radius": "x1.3", "remove": ["walls"]}
    assert key_problems([(DESIGN, {}), (DESIGN, {**added, "cgem.L4.anode_radius": "230 mm"})]) == []
    assert key_problems([(DESIGN, {"cgem.L2.anode_radius": "160 mm"})]) == []  # a wrong value, not a wrong key
    fewer = DESIGN.with_overrides({"remove": ["cgem.L1"]})
    change = {"cgem.L1.foils": 2}
    assert key_problems([(fewer, change), (DESIGN, change)]) == []
    assert len(key_problems([(fewer, change)])) == 1


def test_columns_that_only_some_variants_have() -> None:
    """What is missing is NaN among numbers, which are then floats, and an empty text among texts."""

    def own(detector: Detector) -> dict[str, Any]:
        more = {"few": True, "word": "two", "mixed": "two"} if detector.cgem[0].foils == 2 else {"mixed": 1}
        return {"foils": detector.cgem[0].foils, **more}

    found = sweep(DESIGN, {"cgem.L1.foils": [1, 2]}, evaluate=Evaluation(own, chunk=2))
    assert found.results == ("foils", "mixed", "few", "word")
    assert found.columns["foils"] == [3, 1, 2]
    assert all(type(value) is int for value in found.columns["foils"])
    np.testing.assert_array_equal(found.columns["few"], [math.nan, math.nan, 1.0])
    assert found.columns["word"] == ["", "", "two"]
    assert found.columns["mixed"] == [1, 1, "two"]


def test_neighbours_in_a_chunk_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Widths of a chunk are computed together, in parts if they are many; samples of its detectors may differ."""
    space = [{"cgem.*.pitch_x": "900 um"}, {"remove": ["cgem.L2"]}, {"drift_chamber.efficiency": 0.9},
             {"cgem.L2.anode_radius": "30 mm"}, {"base": "kloe2-like"},
             {"field": {"kind": "uniform", "bz": "0.5 T"}}]  # fmt: skip
    alone, together = (
        sweep(DESIGN, space, evaluate=Evaluation(p=[0.05, 0.5], cos_theta=[0.2, (-0.9, 0.9)], chunk=chunk))
        for chunk in (1, 7)
    )
    monkeypatch.setattr("cgemit.covariance.result._MOST_TRACKS", 512)
    split = sweep(DESIGN, space, evaluate=Evaluation(p=[0.05, 0.5], cos_theta=[0.2, (-0.9, 0.9)], chunk=7))
    assert repr(together.columns) == repr(alone.columns) == repr(split.columns)
    assert alone.columns["status"].count("ok") == 24


def test_simulated_resolutions_are_those_of_a_run(tmp_path: Path) -> None:
    found = sweep(
        DESIGN, {"cgem.*.pitch_x": ["900 um"]}, evaluate=Evaluation("mc", p=[0.3, 1.0], cos_theta=0.2, events=300)
    )
    assert found.columns["p (GeV/c)"] == [0.3, 1.0, 0.3, 1.0]
    result = cg.run(found.detector(1), cg.Gun("mu-", p=1.0, cos_theta=0.2), 300, seed_of(1, 2))
    for name, unit in (("dr", "um"), ("dz", "mm"), ("p", "MeV/c"), ("phi0", "mrad"), ("tanl", "1e-3")):
        width = cg.resolution(result, name)
        assert found.columns[f"sigma_{name} ({unit})"][3] == width.core
        assert found.columns[f"sigma_{name}_error ({unit})"][3] == width.core_error
        base, variant = found.columns[f"sigma_{name} ({unit})"][1::2]
        assert found.columns[f"delta_sigma_{name} ({unit})"][3] == variant - base
    assert found.columns["delta_sigma_dr (um)"][:2] == [0, 0]
    assert found.columns["delta_sigma_dr_error (um)"][:2] == [0, 0]


def test_analytic_resolutions_are_those_of_the_covariance() -> None:
    space = {"cgem.*.pitch_x": ["900 um"], "drift_chamber.sigma": ["x1", "x2"]}
    found = sweep(
        DESIGN, space, evaluate=Evaluation(p=[0.01, 0.3, 1.0], cos_theta=[0.2, (-0.5, 0.5)], particle="pi+", chunk=2)
    )
    one, mixed = (cg.analytic(found.detector(2), "pi+", [0.01, 0.3, 1.0], c) for c in (0.2, (-0.5, 0.5)))
    rows = slice(12, 18)  # of variant 2: momenta, and for each the two angles
    assert found.columns["cos_theta"][rows] == ["0.2", "-0.5:0.5"] * 3
    for name, header in (("p", "sigma_p (MeV/c)"), ("dr", "sigma_dr (um)"), ("dz", "sigma_dz (mm)"),
                         ("theta", "sigma_theta (mrad)"), ("tanl", "sigma_tanl (1e-3)")):  # fmt: skip
        expected = np.array([one.sigma(name), mixed.sigma(name)]).T.ravel()
        np.testing.assert_array_equal(found[header][rows], expected)
    assert found.columns["tracks"][rows][::2] == [FitStatus(int(status)).name for status in one.status]
    assert found.columns["tracks"][12] != "ok" == found.columns["tracks"][14]
    assert found.columns["reached"][rows] == np.array([one.reached, mixed.reached]).T.ravel().tolist()
    for point in (2, 4):  # the momenta 0.3 and 1.0 at the first angle
        of_point = budgets(found.evaluation, {"base": DESIGN}, "p", point)["base"]
        expected = [(0.3, 1.0)[point // 2 - 1], 0.2]
        assert [float(of_point.p), float(of_point.cos_theta)] == pytest.approx(expected, rel=1e-12)
    assert found.columns["sigma_p (MeV/c)"][16] > 1.5 * found.columns["sigma_p (MeV/c)"][10]
    few = sweep(DESIGN, space, evaluate=Evaluation(quantities=["dz", "pt"], samples=3))
    assert [name for name in few.results if name.startswith("sigma")] == ["sigma_dz (mm)", "sigma_pt (MeV/c)"]
    expected = cg.analytic(few.detector(1), samples=3).sigma("dz")
    assert few.columns["sigma_dz (mm)"][1] == pytest.approx(float(expected), rel=1e-12)
    smeared = cg.load(DESIGN).with_readout(cg.GaussianReadout(sigma_x=0.3, sigma_v=0.3))
    changed = sweep(smeared, space, evaluate=Evaluation())
    expected = cg.analytic(few.detector(1), readout=smeared.cgem["L1"].readout).sigma("dr")
    assert changed.columns["sigma_dr (um)"][1] == pytest.approx(float(expected), rel=1e-12)


def test_unseen_matter_of_electrons_is_a_column() -> None:
    """It is the sum of what `Covariance.losses` has; muons and ranges of angles have none."""
    space = {"cgem.*.pitch_x": ["400 um"]}
    pipe = {"walls.extra": {"r_in": "70 mm", "r_out": "71 mm", "half_length": "300 mm", "material": "Al"}}
    thicker = DESIGN.with_overrides(pipe)
    evaluation = Evaluation(particle="e+", p=[0.3, 1.0], cos_theta=[0.0, 0.7])
    plain, more = (sweep(one, space, evaluate=evaluation).columns["unseen_x0 (%)"] for one in (DESIGN, thicker))
    at = [cg.analytic(DESIGN, "e+", p=[0.3, 1.0], cos_theta=c).losses().effective.sum(axis=1) for c in (0.0, 0.7)]
    np.testing.assert_allclose(np.array(plain[:4]).reshape(2, 2), 100 * np.transpose(at), rtol=1e-9)
    assert 0.9 * 100 / 88.97 < more[0] - plain[0] < 1.1 * 100 / 88.97  # 1 mm of aluminium before the first hit
    for other in (Evaluation(p=1.0), Evaluation(particle="e+", p=1.0, cos_theta=(-0.5, 0.5))):
        assert "unseen_x0 (%)" not in sweep(DESIGN, space, evaluate=other).columns


def test_error_of_a_difference_of_widths_of_the_same_events() -> None:
    random = np.random.default_rng(5)
    errors, differences = [], []
    for _ in range(300):
        common, own = random.normal(size=(2, 400))
        samples = (common, common + 0.3 * own)
        one, other = (without_groups(x, np.arange(400), np.std) for x in samples)
        errors.append(jackknife(one - other))
        differences.append(samples[1].std() - samples[0].std())
    spread = np.std(differences)
    # 300 differences know their spread to 4 %; unpaired errors would be 3 times as large.
    assert np.mean(errors) == pytest.approx(spread, rel=0.12)
    assert spread < 0.5 * math.hypot(1, 1.04) / math.sqrt(800)


def test_tables_are_written_and_read_back(tmp_path: Path) -> None:
    found = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path)
    csv = pd.read_csv(tmp_path / "sweep.csv", keep_default_na=False, na_values=["nan"])
    assert csv.columns.tolist() == list(found.columns)
    pd.testing.assert_frame_equal(csv, found.to_pandas(), check_dtype=False, rtol=1e-6)
    assert cg.load(tmp_path / "detector.toml").content_hash == DESIGN.content_hash
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["status"], summary["variants"]) == ({"impossible": 2, "ok": 3}, 4)
    head, base, _, overlap = repr(found).splitlines()[1:5]
    assert (head.split()[-1], base.split()[-1]) == ("problems", f"{channels(DESIGN)['x0 (%)']:.5g}")
    assert overlap.split()[1] == "impossible"
    assert found.columns["problems"][2] in overlap
    assert "problems" not in repr(sweep(DESIGN, {"cgem.*.foils": [2]}, evaluate=channels))
    assert "<table>" in found._repr_html_()


def test_the_message_of_a_failure_is_one_line_of_the_printed_table() -> None:
    def fails(detector: Detector) -> dict[str, Any]:
        if detector.cgem["L1"].foils == 2:
            raise ValueError("first line\n  second line" + 200 * "x")
        return {"foils": 3}

    last = repr(sweep(DESIGN, {"cgem.*.foils": [2]}, evaluate=fails)).splitlines()[-1]
    assert last.partition("ValueError: ")[2] == f"first line second line{200 * 'x'}"[: 120 - len("ValueError: ")]


class Counting(Executor):
    """Runs what is submitted at once, and counts it; interrupts like Ctrl-C after some."""

    def __init__(self, stop: int = 10**9) -> None:
        self.submitted, self.stop = 0, stop

    def submit(self, function: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        """Return a future that is done."""
        self.submitted += 1
        future: Future[Any] = Future()
        if self.submitted > self.stop:
            future.set_exception(KeyboardInterrupt())
        else:
            future.set_result(function(*given, **named))
        return future


class Losing(Counting):
    """Loses the first tasks, as Dask's executor may if a worker dies while its result is fetched."""

    def __init__(self, lost: int) -> None:
        super().__init__()
        self.lost = lost

    def submit(self, function: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        """Return a future that is done, with an error of the executor's own if the task is lost."""
        future = super().submit(function, *given, **named)
        if self.submitted <= self.lost:
            future = Future()
            future.set_exception(ValueError("too many values to unpack (expected 3)"))
        return future


def test_what_an_executor_loses_is_computed_once_more(tmp_path: Path) -> None:
    expected = sweep(DESIGN, PITCHES, evaluate=Evaluation(channels, chunk=1))
    tasks = len(expected)
    losing = Losing(2)
    found = sweep(DESIGN, PITCHES, Evaluation(channels, chunk=1), output=tmp_path / "out", workers=losing)
    assert losing.submitted == tasks + 2
    assert found.columns == expected.columns
    with pytest.raises(ValueError, match="too many values to unpack"):
        sweep(DESIGN, PITCHES, evaluate=Evaluation(channels, chunk=1), workers=Losing(tasks + 1))


class Unfinished:
    """An evaluation whose last step fails."""

    def described(self) -> dict[str, Any]:
        """Return nothing that results depend on."""
        return {}

    def __call__(self, detector: Detector) -> str:
        """Return something."""
        return detector.name

    def results(self, found: Sequence[Any]) -> list[dict[str, Any]]:
        """Fail."""
        raise RuntimeError(f"no results of {found}")


def test_results_that_fail_are_rows() -> None:
    (row,) = rows_of_text(work(Task((DESIGN,), ({},), Unfinished())))
    assert (row["status"], row["problems"]) == ("failed", [f"RuntimeError: no results of ['{DESIGN.name}']"])


def test_a_function_that_fails_is_a_row_and_is_tried_again(tmp_path: Path) -> None:
    broken = [True]

    def fragile(detector: Detector) -> dict[str, Any]:
        if broken[0] and detector.cgem[0].foils == 2:
            raise RuntimeError("no licence")
        return {"foils": detector.cgem[0].foils}

    space = {"cgem.L1.foils": [1, 2]}
    first = sweep(DESIGN, space, evaluate=fragile, output=tmp_path / "out")
    assert first.columns["status"] == ["ok", "ok", "failed"]
    assert first.columns["problems"][2] == "RuntimeError: no licence"
    broken[0] = False
    again = Counting()
    second = sweep(DESIGN, space, evaluate=fragile, output=tmp_path / "out", workers=again)
    assert (again.submitted, second.columns["foils"]) == (1, [3, 1, 2])


def test_a_sweep_goes_on_where_it_was_interrupted(tmp_path: Path) -> None:
    whole = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out", workers=Counting(stop=2))
    rest = Counting()
    found = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out", workers=rest)
    assert rest.submitted == 3
    assert found.columns.keys() == whole.columns.keys()
    for name in ("sweep.csv", "summary.json", "detector.toml"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    nothing = Counting()
    larger = {"cgem.*.pitch_x": ["400 um", "900 um", "500 um"], "cgem.L2.anode_radius": ["132.5 mm", "160 mm"]}
    sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out", workers=nothing)
    sweep(DESIGN, larger, evaluate=channels, output=tmp_path / "out", workers=nothing)
    assert nothing.submitted == 2  # the new pitch


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "other"])
def test_damaged_chunks_are_found_and_computed_anew(tmp_path: Path, damage: str) -> None:
    first = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path)
    before = (tmp_path / "sweep.csv").read_bytes()
    chunk, other, *_ = sorted((tmp_path / "chunks").iterdir())
    text = chunk.read_text()
    marked = "ok" if "ok" in text else "impossible"
    changed = {
        "cut": text[:-30],
        "flip": text.replace(marked, marked[::-1], 1),
        "empty": "",
        "other": other.read_text(),
    }
    chunk.write_text(changed[damage])
    counted = Counting()
    with pytest.warns(UserWarning, match=rf"{chunk.name} cannot be read \(.*\); its variants are computed anew"):
        again = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path, workers=counted)
    assert counted.submitted == 1
    assert str(again.columns) == str(first.columns)
    assert (tmp_path / "sweep.csv").read_bytes() == before


@pytest.mark.slow
def test_chunks_depend_on_all_that_results_depend_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output: Any = tmp_path

    def computed(**how: Any) -> int:
        counted = Counting()
        base = how.pop("base", DESIGN)
        evaluate = Evaluation("mc", **{"events": 20} | how)
        sweep(base, {"cgem.L1.foils": [2]}, evaluate, output=output, workers=counted)
        return counted.submitted

    assert computed() == 2
    assert computed() == 0
    assert computed(base=DESIGN.with_overrides({"name": "other"})) == 0
    for change in ({"seed": 2}, {"events": 21}, {"p": 0.5}, {"cos_theta": 0.1}, {"particle": "pi-"},
                   {"quantities": ["dr"]}, {"base": DESIGN.with_overrides({"field.bz": "0.9 T"})},
                   {"settings": cg.Settings(simulate=cg.SimulateSettings(deltas=False))}):  # fmt: skip
        with pytest.raises(OutputExistsError, match="results of another plan"):
            computed(**change)
        output = cg.Output(tmp_path, overwrite=True)
        assert computed(**change) == 2, change
        output = tmp_path
        assert computed(**change) == 0, change
    output = cg.Output(tmp_path, overwrite=True)
    assert computed() == 2
    monkeypatch.setattr(sys.modules["cgemit.study.sweep.run"], "PHYSICS", 10**6)
    output = tmp_path
    with pytest.raises(OutputExistsError, match="or of another version"):
        computed()
    output = cg.Output(tmp_path, overwrite=True)
    assert computed() == 2


def test_each_value_of_an_evaluation_is_described_where_it_counts() -> None:
    """Stored chunks are found by this description: a value that it leaves out would return old results."""
    other = {
        "particle": "pi-", "p": 0.5, "cos_theta": 0.1, "events": 21, "seed": 2, "quantities": ("dr",), "samples": 3,
        "chunk": 5, "settings": cg.Settings(fit=cg.FitSettings(loss="mean")), "pt": 0.5, "theta": 1.0, "eta": 0.5,
        "phi": 0.1, "d": 5.0,
    }  # fmt: skip
    assert {"method", *other} == {field.name for field in dataclasses.fields(Evaluation) if field.name != "_"}
    with pytest.raises(ValueError, match="d: got 5, expected tracks from the origin with the analytic method"):
        Evaluation("analytic", d=other["d"])
    unused = {"mc": {"samples", "chunk"}, "analytic": {"events", "seed", "chunk"}}
    for method, idle in unused.items():
        usual = Evaluation(method).described()
        given = {name: value for name, value in other.items() if method == "mc" or name != "d"}
        same = {name for name, value in given.items() if Evaluation(method, **{name: value}).described() == usual}
        assert same == idle
        assert usual["method"] == method


def test_folders_of_others_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="already holds files"):
        sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path)
    sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out")
    counted = Counting()
    sweep(DESIGN, PITCHES, evaluate=channels, output=cg.Output(tmp_path / "out", overwrite=True), workers=counted)
    assert counted.submitted == 5
    chunks = tmp_path / "chunks"
    chunks.mkdir()
    (chunks / "mine.json").write_text("mine")
    for overwrite, words in ((True, "'chunks', which is not of the results"), (False, "already holds files")):
        with pytest.raises(OutputExistsError, match=words):
            sweep(DESIGN, PITCHES, evaluate=channels, output=cg.Output(tmp_path, overwrite=overwrite))
    assert (chunks / "mine.json").read_text() == "mine"


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    with ThreadPoolExecutor(1) as one:
        return swept(tmp_path_factory.mktemp("serial") / "out", workers=one)


@pytest.mark.slow
def test_every_executor_makes_the_same_files(serial: list[bytes], tmp_path: Path) -> None:
    assert swept(tmp_path / "threads") == serial
    assert swept(tmp_path / "large chunks", chunk=4) == serial
    with ProcessPoolExecutor(2) as pool:
        assert swept(tmp_path / "processes", workers=pool) == serial


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of dask, about the cluster that is taken apart
def test_dask_makes_the_same_files_when_a_worker_is_killed(serial: list[bytes], tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, local_directory=str(tmp_path)
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        workers = [nanny.pid for nanny in cluster.workers.values()]
        killed = []

        def kill_one(done: float, label: str) -> None:
            if done > 0.2 and not killed:
                killed.append(workers[0])
                os.kill(workers[0], signal.SIGKILL)

        executor: Executor = client.get_executor()
        assert swept(tmp_path / "out", workers=executor, progress=kill_one) == serial
    assert killed


@pytest.mark.slow
def test_a_killed_sweep_ends_as_an_uninterrupted_one(serial: list[bytes], tmp_path: Path) -> None:
    folder = tmp_path / "out"
    assert killed_until_complete(folder, "threads", [0.0, 0.2, 0.1]) > 0
    assert written(folder) == serial
    assert sorted(path.name for path in folder.iterdir()) == [CONTENTS, "chunks", *sorted(FILES)]
    assert not list((folder / "chunks").glob(".*"))


def test_variants_of_the_space_are_not_all_alike() -> None:
    found = sweep("besiii-cgem-design", SPACE, evaluate=lambda detector: {"is": detector.name})
    assert sorted(found.columns["status"]) == ["impossible"] * 4 + ["ok"] * 5
    assert cg.load("besiii-cgem-design").name == found.columns["is"][0] == found.columns["name"][0]


@pytest.mark.parametrize("name", ["variant", "name", "hash", "status", "problems", "cgem.*.pitch_x (um)"])
def test_a_function_cannot_replace_columns_of_the_table(name: str, tmp_path: Path) -> None:
    """It is refused with its first result, and nothing of it is stored."""
    calls = []

    def own(detector: Detector) -> dict[str, Any]:
        calls.append(detector)
        return {"good": 1, name: 0.5}

    with pytest.raises(PlanError, match=rf"evaluate.method: got a result named {re.escape(repr(name))}"):
        sweep(DESIGN, {"cgem.*.pitch_x": ["400 um", "500 um"]}, own, output=tmp_path / "out", workers=1)
    assert len(calls) < 3
    assert list((tmp_path / "out/chunks").iterdir()) == []


def test_names_of_results_have_no_other_meaning(tmp_path: Path) -> None:
    def own(detector: Detector) -> dict[str, Any]:
        return {"float": math.nan, "columns": math.inf, "found": "float", "NaN": -math.inf}

    for _ in range(2):  # computed, then read
        found = sweep(DESIGN, {"cgem.*.pitch_x": ["400 um"]}, own, output=tmp_path)
        assert found.results == ("float", "columns", "found", "NaN")
        np.testing.assert_array_equal(found["float"], [math.nan] * 2)
        assert found.columns["columns"] == [math.inf] * 2
        assert found.columns["NaN"] == [-math.inf] * 2


@pytest.mark.parametrize("kind", ["pipe", "nested", "rows", "link", "device"])
def test_chunks_that_cannot_be_read_are_computed_anew(kind: str, tmp_path: Path) -> None:
    first = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path)
    chunk = sorted((tmp_path / "chunks").iterdir())[0]
    text = chunk.read_text()
    chunk.unlink()
    if kind == "pipe":
        os.mkfifo(chunk)
    elif kind == "device":
        chunk.symlink_to("/dev/zero")
    elif kind == "link":
        (tmp_path / "chunks/loop").symlink_to(chunk)
        chunk.symlink_to("loop")
    elif kind == "nested":
        chunk.write_text("[" * 100_000)
    else:
        rows = "[" * 50_000
        chunk.write_text(
            json.dumps({**json.loads(text), "rows": rows, "sha256": hashlib.sha256(rows.encode()).hexdigest()})
        )
    with pytest.warns(UserWarning, match="cannot be read"):
        again = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path)
    assert str(again.columns) == str(first.columns)
    assert chunk.read_text() == text
