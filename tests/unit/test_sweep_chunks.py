"""Sweeps: chunks on disk, continued after interruptions and damage."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest

import cgemit as cg
from cgemit.detector import Detector
from cgemit.study import Evaluation, sweep
from cgemit.study.sweep.run import Task, rows_of_text, work

DESIGN = cg.load("besiii-cgem-design")
PITCHES = {"cgem.*.pitch_x": ["400 um", "900 um"], "cgem.L2.anode_radius": ["132.5 mm", "160 mm"]}


def channels(detector: Detector) -> dict[str, Any]:
    """Return the number of strips, and the thickness of the first layer."""
    strips = sum(layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem)
    return {"strips": strips, "x0 (%)": 100 * sum(shell.x0 for shell in detector.cgem[0].shells())}


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
    found = sweep(DESIGN, PITCHES, Evaluation(channels, chunk=1), output=tmp_path / "out", executor=losing)
    assert losing.submitted == tasks + 2
    assert found.columns == expected.columns
    with pytest.raises(ValueError, match="too many values to unpack"):
        sweep(DESIGN, PITCHES, evaluate=Evaluation(channels, chunk=1), executor=Losing(tasks + 1))


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
    second = sweep(DESIGN, space, evaluate=fragile, output=tmp_path / "out", executor=again)
    assert (again.submitted, second.columns["foils"]) == (1, [3, 1, 2])


def test_a_sweep_goes_on_where_it_was_interrupted(tmp_path: Path) -> None:
    whole = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out", executor=Counting(stop=2))
    rest = Counting()
    found = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out", executor=rest)
    assert rest.submitted == 3
    assert found.columns.keys() == whole.columns.keys()
    for name in ("sweep.csv", "summary.json", "detector.toml"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    nothing = Counting()
    larger = {"cgem.*.pitch_x": ["400 um", "900 um", "500 um"], "cgem.L2.anode_radius": ["132.5 mm", "160 mm"]}
    sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out", executor=nothing)
    sweep(DESIGN, larger, evaluate=channels, output=tmp_path / "out", executor=nothing)
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
    again = sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path, executor=counted)
    assert counted.submitted == 1
    assert str(again.columns) == str(first.columns)
    assert (tmp_path / "sweep.csv").read_bytes() == before


@pytest.mark.slow
def test_chunks_depend_on_all_that_results_depend_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def computed(**how: Any) -> int:
        counted = Counting()
        base = how.pop("base", DESIGN)
        evaluate = Evaluation("mc", **{"events": 20} | how)
        sweep(base, {"cgem.L1.foils": [2]}, evaluate, output=tmp_path, executor=counted)
        return counted.submitted

    assert computed() == 2
    assert computed() == 0
    assert computed(base=DESIGN.with_overrides({"name": "other"})) == 0
    for change in ({"seed": 2}, {"events": 21}, {"p": 0.5}, {"cos_theta": 0.1}, {"particle": "pi-"},
                   {"quantities": ["dr"]}, {"base": DESIGN.with_overrides({"field.bz": "0.9 T"})},
                   {"settings": cg.Settings(simulate=cg.SimulateSettings(deltas=False))}):  # fmt: skip
        assert computed(**change) == 2, change
    monkeypatch.setattr(sys.modules["cgemit.study.sweep.run"], "PHYSICS", 10**6)
    assert computed() == 2


def test_folders_of_others_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="already holds files"):
        sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path)
    sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out")
    with pytest.raises(ValueError, match="already holds a sweep"):
        sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out", resume=False)
    counted = Counting()
    sweep(DESIGN, PITCHES, evaluate=channels, output=tmp_path / "out", overwrite=True, executor=counted)
    assert counted.submitted == 5
