"""What commands and functions may replace: only files that cgemit wrote and nobody has changed since."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bes3_layout
import cgemit as cg
from cgemit.base.files import CONTENTS, OutputExistsError
from cgemit.bes3 import events as bes3_events
from cgemit.cli.main import COMMANDS, build_parser, main
from cgemit.detector import write_field_map
from cgemit.draw.display import event_3d, save_page
from cgemit.tables import save_tables

pytestmark = pytest.mark.usefixtures("undrawn")

DESIGN = cg.load("besiii-cgem-design")
GUN = cg.Gun("mu-", p=1.0, cos_theta=0.0)
VARY, OTHER = ({"cgem.*.pitch_x": [pitch]} for pitch in ("400 um", "500 um"))
SHOT = ["-d", "besiii-cgem-design", "--p", "1", "--cos-theta", "0"]
SWEEP = 'base = "besiii-cgem-design"\n[vary]\n"cgem.*.pitch_x" = ["400 um"]\n[evaluate]\nsamples = 2\n'
OPTIMIZE = SWEEP.replace('["400 um"]', '{ from = "600 um", to = "700 um" }')
# Arguments of each command, and a file of its results.
LINES = {
    "study": (["--quick"], "summary.json"),
    "resolution": ([*SHOT[:4], "--method", "analytic"], "resolution.csv"),
    "sweep": (["sweep.toml"], "sweep.csv"),
    "optimize": (["optimize.toml"], "optimize.csv"),
    "simulate": ([*SHOT, "-n", "2"], "run.json"),
    "find": ([*SHOT, "-n", "5"], "summary.json"),
    "display": (SHOT, "event.png"),
    "readout": (["--angles", "0 deg,10 deg", "-n", "20"], "readout.csv"),
    "refit": (["run.rec", "-d", "besiii-cgem-design", "--hypothesis", "pi"], "kal.csv"),
    "reconstruct": (["run.rec", "-d", "besiii-cgem-design", "--hypothesis", "pi"], "bes3_tracks.csv"),
    "monitor": (["run.rec", "-d", "besiii-cgem-design", "--hypothesis", "pi"], "index.html"),
    "align": (["--forecast", "-d", "besiii-cgem-design", "--muons", "50"], "alignment.csv"),
    "slab": (["Be 1 mm", "--p", "1", "-n", "1000"], "summary.json"),
    "show": (["besiii-cgem-design"], "detector.toml"),
    "notebooks": ([], "00_quickstart.ipynb"),
}
SLOW = {"study", "readout", "find"}
KEPT = {"sweep", "optimize"}  # which the same command continues


def plain(command: str) -> list[str]:
    return [command, *LINES[command][0], "-o", "out"]


def commands() -> list[Any]:
    return [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in LINES]


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with the files that commands read."""
    monkeypatch.chdir(tmp_path)
    Path("sweep.toml").write_text(SWEEP)
    Path("optimize.toml").write_text(OPTIMIZE)
    Path("run.rec").write_bytes(b"root")
    run = cg.run(DESIGN, cg.Gun("pi-", p=0.5, cos_theta=(-0.5, 0.5)), 3)
    arrays = bes3_layout.events_of(run)
    monkeypatch.setattr(bes3_events, "read_bes3", lambda _: (bes3_events.columns_of_events(arrays), run.n_events))
    return tmp_path


def contents(folder: Path) -> dict[str, bytes | None]:
    return {path.relative_to(folder).as_posix(): None if path.is_dir() else path.read_bytes()
            for path in sorted(folder.rglob("*"))}  # fmt: skip


def test_every_command_that_writes_is_tried() -> None:
    parser = build_parser(*COMMANDS)
    (commands,) = (one.choices for one in parser._actions if isinstance(one, argparse._SubParsersAction))
    assert {name for name, one in commands.items() if "--overwrite" in one.options()} == LINES.keys()


@pytest.mark.parametrize("command", LINES)
def test_folders_of_the_user_are_never_written_to(command: str, work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also if they have names of results, or a record that is none."""
    (work / "out/chunks").mkdir(parents=True)
    for name in ("sweep.csv", "plan.toml", "run.json", "summary.json", "optimize.csv", "chunks/" + 32 * "0" + ".json"):
        (work / "out" / name).write_text(f"my own {name}")
    for record in (None, "", "[]", '{"files": {"plan.toml": ["0"]}, "work": "sweep", "plan": []}'):
        if record is not None:
            (work / "out" / CONTENTS).write_text(record)
        before = contents(work / "out")
        for more in ([], ["--overwrite"]):
            assert main([*plain(command), *more]) == 2
            assert contents(work / "out") == before
            error = capsys.readouterr().err
            assert (
                "already holds" in error or "which was changed after" in error or "which is not of the results" in error
            )


@pytest.mark.parametrize("command", commands())
def test_results_are_replaced_when_told_and_unchanged(
    command: str, work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(plain(command)) == 0
    first = contents(work / "out")
    assert CONTENTS in first
    recorded = json.loads((work / "out" / CONTENTS).read_text())["files"]
    stored = {name for name in first if name.startswith(("chunks", "journals"))} if command in KEPT else set()
    assert recorded.keys() == {name for name, text in first.items() if text is not None} - {CONTENTS} - stored
    assert main(plain(command)) == (0 if command in KEPT else 2)
    assert main([*plain(command), "--overwrite"]) == 0
    assert contents(work / "out").keys() == first.keys()
    changed = work / "out" / LINES[command][1]
    changed.write_text(changed.read_text(errors="replace") + "my note")
    (work / "out/notes.txt").write_text("mine")
    before = contents(work / "out")
    capsys.readouterr()
    assert main([*plain(command), "--overwrite"]) == 2
    error = capsys.readouterr().err
    assert f"'{changed.name}', which was changed after cgemit wrote it" in error
    assert "'notes.txt', which is not of the results" in error
    assert main(plain(command)) == 2
    assert changed.name in capsys.readouterr().err or command not in KEPT
    assert contents(work / "out") == before


@pytest.mark.parametrize("command", commands())
def test_results_of_another_command_are_replaced_when_told(command: str, work: Path) -> None:
    assert main(["slab", "Be 2 mm", "--p", "2", "-n", "1000", "-o", "out"]) == 0
    before = contents(work / "out")
    if command != "slab":
        assert main(plain(command)) == 2
        assert contents(work / "out") == before
    assert main([*plain(command), "--overwrite"]) == 0
    assert contents(work / "out").get("summary.json") != before["summary.json"]
    assert main(["slab", "Be 2 mm", "--p", "2", "-n", "1000", "-o", "out"]) == 2
    assert main(["slab", "Be 2 mm", "--p", "2", "-n", "1000", "-o", "out", "--overwrite"]) == 0
    assert contents(work / "out").keys() == before.keys()


@pytest.mark.parametrize("command", sorted(KEPT))
def test_another_plan_needs_leave(command: str, work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(plain(command)) == 0
    before = contents(work / "out")
    plan = work / f"{command}.toml"
    plan.write_text(plan.read_text().replace("pitch_x", "pitch_v"))
    capsys.readouterr()
    assert main(plain(command)) == 2
    error = capsys.readouterr().err
    assert f"results of another plan of this {command}" in error
    assert "say --overwrite" in error
    assert contents(work / "out") == before
    assert main([*plain(command), "--overwrite"]) == 0
    after = contents(work / "out")
    old, new = ({name for name in one if name.startswith("chunks/")} for one in (before, after))
    assert old - new
    assert new - old
    assert b"pitch_v" in (after["plan.toml"] or b"")
    assert main(plain(command)) == 0


def test_the_first_of_two_plans_has_the_folder_before_it_has_results(work: Path) -> None:
    """The plan is written down when a sweep begins, so that another one cannot join in."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    for method, run in (("sweep", cg.study.sweep), ("optimize", cg.study.optimize)):
        space = VARY if method == "sweep" else {"cgem.*.pitch_x": ("600 um", "700 um")}
        other = OTHER if method == "sweep" else {"cgem.*.pitch_v": ("600 um", "700 um")}
        with pytest.raises(KeyboardInterrupt):
            run(DESIGN, space, evaluate={"samples": 2}, output=method, started=stop)
        with pytest.raises(OutputExistsError, match="results of another plan"):
            run(DESIGN, other, evaluate={"samples": 2}, output=method)
        run(DESIGN, space, evaluate={"samples": 2}, output=method)


def test_parts_of_an_array_replace_their_own_chunks_only(work: Path) -> None:
    def part_of(space: dict[str, Any], part: tuple[int, int]) -> dict[Path, int]:
        out = cg.Output("out", overwrite=True)
        cg.study.sweep(DESIGN, space, lambda detector: {"a": 1}, output=out, part=part)
        return {path: path.stat().st_mtime_ns for path in (work / "out/chunks").iterdir()}

    space = {"cgem.*.pitch_x": ["400 um", "500 um", "600 um"]}
    assert len(part_of(space, (0, 2))) == 2
    first = part_of(space, (1, 2))
    assert len(first) == 4
    second = part_of(space, (1, 2))
    assert second.keys() == first.keys()
    assert sum(second[path] != first[path] for path in first) == 2
    other = {"cgem.*.pitch_x": ["700 um"]}
    assert part_of(other, (0, 2)).keys() - first.keys() == set()  # the base alone
    assert len(part_of(other, (1, 2))) == 2  # nothing of the other plan


def test_a_search_with_more_calls_continues_and_another_method_does_not(work: Path) -> None:
    space, how = {"cgem.*.pitch_x": ("600 um", "700 um")}, {"samples": 2}
    few, more = ({"method": "nsga2", "population": 4, "offspring": 2, "calls": calls} for calls in (1, 2))
    cg.study.optimize(DESIGN, space, evaluate=how, search=few, output="out")
    assert len(cg.study.optimize(DESIGN, space, evaluate=how, search=more, output="out")) == 9
    with pytest.raises(OutputExistsError, match="results of another plan"):
        cg.study.optimize(DESIGN, space, evaluate=how, search="cobyla", output="out")


def found(space: dict[str, Any]) -> cg.study.Sweep:
    return cg.study.sweep(DESIGN, space, {"samples": 2})


def best(space: dict[str, Any]) -> cg.study.Optimization:
    (key,) = space
    return cg.study.optimize(
        DESIGN, {key: ("600 um", "700 um" if space is VARY else "710 um")}, evaluate={"samples": 2}
    )


# Functions that write a folder, given results: of a key that is varied where it matters.
FOLDERS: dict[str, Callable[[Any, str, bool], object]] = {
    "Result.save": lambda space, out, over: cg.run(DESIGN, GUN, 2).save(out, overwrite=over),
    "run": lambda space, out, over: cg.run(DESIGN, GUN, 2, output=cg.Output(out, overwrite=over)),
    "Scan.save": lambda space, out, over: cg.study.scan(DESIGN, [1.0], events=60).save(out, overwrite=over),
    "save_tables": lambda space, out, over: save_tables(cg.run(DESIGN, GUN, 2).tables, out, overwrite=over),
    "Sweep.write": lambda space, out, over: found(space).write(out, overwrite=over),
    "Optimization.write": lambda space, out, over: best(space).write(out, overwrite=over),
}


@pytest.mark.parametrize("name", FOLDERS)
def test_functions_that_write_folders(name: str, work: Path) -> None:
    write = FOLDERS[name]
    write(VARY, "out", False)
    first = contents(work / "out")
    if name in ("Sweep.write", "Optimization.write"):
        with pytest.raises(OutputExistsError, match="results of another plan"):
            write(OTHER, "out", False)
        write(VARY, "out", False)
    else:
        with pytest.raises(FileExistsError):
            write(VARY, "out", False)
    assert contents(work / "out").keys() == first.keys()
    write(OTHER, "out", True)
    victim = next(path for path in sorted((work / "out").rglob("*")) if path.is_file() and path.name != CONTENTS)
    victim.write_text("mine")
    before = contents(work / "out")
    with pytest.raises(OutputExistsError, match=f"{victim.name}', which was changed after cgemit wrote it"):
        write(OTHER, "out", True)
    assert contents(work / "out") == before
    (work / "mine").mkdir()
    for path in before:
        if before[path] is not None and path != CONTENTS:
            (work / "mine" / path).parent.mkdir(exist_ok=True, parents=True)
            (work / "mine" / path).write_text("mine")
    before = contents(work / "mine")
    with pytest.raises(OutputExistsError, match="not of the results"):
        write(OTHER, "mine", True)
    assert contents(work / "mine") == before


def test_a_confirmation_replaces_only_its_own(work: Path) -> None:
    confirmation = best(VARY).confirm(events=20)
    confirmation.write("out")
    confirmation.write("out")
    (work / "out/confirmation.csv").write_text("mine")
    with pytest.raises(OutputExistsError, match="changed after"):
        confirmation.write("out")
    assert (work / "out/confirmation.csv").read_text() == "mine"


AXES = {"r": np.linspace(0, 900, 4), "z": np.linspace(-1300, 1300, 5), "br": np.zeros((4, 5)), "bz": np.ones((4, 5))}
# Functions that write the file that they are given.
FILES: dict[str, Callable[[str, bool], object]] = {
    "table.npz": lambda path, over: cg.run(DESIGN, GUN, 2).tracks.save(path, overwrite=over),
    "settings.toml": lambda path, over: cg.Settings().save(path, overwrite=over),
    "picture.png": lambda path, over: cg.draw.draw_detector(DESIGN).save(path, overwrite=over),
    "map.npz": lambda path, over: write_field_map(path, AXES, overwrite=over),
    "detector.gdml": lambda path, over: DESIGN.to_gdml(path, overwrite=over),
    "page.html": lambda path, over: save_page(event_3d(cg.run(DESIGN, GUN, 1), 0), path, overwrite=over),
}


@pytest.mark.parametrize("name", FILES)
def test_functions_that_write_a_file(name: str, work: Path) -> None:
    """The call names the file; but results of a folder that were changed stay, and what is no file."""
    FILES[name](name, False)
    with pytest.raises(FileExistsError):
        FILES[name](name, False)
    FILES[name](name, True)
    Path(name).unlink()
    Path(name).mkdir()
    with pytest.raises(FileExistsError, match="is a folder"):
        FILES[name](name, True)
    Path(name).rmdir()
    os.mkfifo(name)
    with pytest.raises(FileExistsError, match="is a pipe or a device"):
        FILES[name](name, True)
    Path(name).unlink()
    Path(name).symlink_to("elsewhere")  # a link stays, and what it leads to is written
    FILES[name](name, False)
    assert Path(name).is_symlink()
    assert Path("elsewhere").stat().st_size > 0
    with pytest.raises(FileExistsError):
        FILES[name](name, False)


def test_a_file_of_results_that_was_changed_stays(work: Path) -> None:
    run = cg.run(DESIGN, GUN, 2)
    run.save("out")
    with pytest.raises(FileExistsError):
        run.tracks.save("out/tracks.npz")
    run.tracks.save("out/tracks.npz", overwrite=True)
    run.save("out", overwrite=True)
    Path("out/tracks.npz").write_text("mine")
    with pytest.raises(OutputExistsError, match="was changed after cgemit wrote it"):
        run.tracks.save("out/tracks.npz", overwrite=True)
    assert Path("out/tracks.npz").read_text() == "mine"


def test_factors_of_errors_are_a_file_like_others(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cgemit.study.readout.errors.fit_errors", lambda *_, **__: pytest.fail("not before the check"))
    Path("errors.toml").write_text("mine")
    assert main(["readout", "--fit", "errors.toml"]) == 2
    Path("errors.toml").unlink()
    Path("errors.toml").mkdir()
    assert main(["readout", "--fit", "errors.toml", "--overwrite"]) == 2


@pytest.mark.slow
def test_a_killed_sweep_is_continued_whenever_it_was(work: Path) -> None:
    """A file that was being replaced has two checksums."""
    code = """
import os, sys
from pathlib import Path
import cgemit as cg
left = int(sys.argv[1])
replace = Path.replace
def counted(self, target):
    global left
    left -= 1
    if left < 0:
        os._exit(9)
    return replace(self, target)
Path.replace = counted
found = cg.study.sweep("besiii-cgem-design", {"cgem.*.pitch_x": ["400 um"]}, {"samples": 2}, output="out")
found.columns["name"][0] = "another text in the table " + sys.argv[1]
found.write("out")
"""
    ends = []
    for step in range(20):
        done = subprocess.run([sys.executable, "-c", code, str(step)], check=False, capture_output=True, text=True)
        ends.append(done.returncode)
        assert done.returncode in (0, 9), done.stderr
        if done.returncode == 0:
            break
    assert ends.count(9) > 5
    assert ends[-1] == 0
