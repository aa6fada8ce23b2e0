"""A run read from its folder equals the one that was written; damaged and mixed folders are refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.base.files import CONTENTS
from cgemit.chain.record import RecordError, gun_data, gun_from, versions
from cgemit.chain.result import Result
from cgemit.chain.run import run
from cgemit.chain.settings import NotKeptError, Settings
from cgemit.detector import load, write_field_map
from cgemit.particles.gun import Gun, Guns, generate
from cgemit.reconstruction.fit import FitSettings
from cgemit.simulation.transport import SimulateSettings
from cgemit.tables import Table

GUN = Gun("pi-", p=(0.4, 0.6), cos_theta=[-0.3, 0.3], vertex=(0.1, (-1.0, 1.0), [1.0, 2.0])) + Gun("mu+", p=1, theta=1)
SETTINGS = Settings(
    simulate=SimulateSettings(deltas=False, steps=True), fit=FitSettings(loss="mean", residuals=True, states=("hits",))
)


@pytest.fixture(scope="module")
def result() -> Result:
    return run("besiii-cgem-design", GUN, 12, seed=2**63 + 1, settings=SETTINGS, fit_detector="besiii-cgem")


@pytest.fixture
def saved(result: Result, tmp_path: Path) -> Path:
    result.save(tmp_path / "run")
    return tmp_path / "run"


def test_a_run_is_read_back_equal(result: Result, saved: Path) -> None:
    read = Result.load(saved)
    assert read == result
    assert repr(read.gun) == repr(GUN)
    assert (read.settings, read.seed, read.timings) == (SETTINGS, 2**63 + 1, result.timings)
    assert (read.detector, read.fit_detector) == (load("besiii-cgem-design"), load("besiii-cgem"))
    assert read.tables.keys() == result.tables.keys()
    assert [dict(table.meta) for table in read.tables.values()] == [dict(t.meta) for t in result.tables.values()]
    assert run(read.detector, read.gun, 12, read.seed, settings=read.settings, fit_detector=read.fit_detector) == read


def test_a_run_of_given_particles_has_no_gun(tmp_path: Path) -> None:
    particles = generate(Gun("mu-", p=1, cos_theta=0), 3, seed=1, first_event=5)
    result = run("besiii-idc", particles, seed=4)
    result.save(tmp_path / "run")
    read = Result.load(tmp_path / "run")
    assert (read, read.gun, read.particles.first_event) == (result, None, 5)
    assert read.fit_detector is None


@pytest.mark.parametrize("keeps", ["save", "output"])
def test_a_run_in_a_field_of_a_file_may_be_moved(keeps: str, tmp_path: Path) -> None:
    """Both maps come along: what stands in the folder names no other place."""
    axes = {"r": np.linspace(0, 900, 4), "z": np.linspace(-1300, 1300, 5)}
    for name, bz in (("measured.npz", -1.0), ("assumed.csv", -0.9)):
        write_field_map(tmp_path / name, {**axes, "br": np.zeros((4, 5)), "bz": np.full((4, 5), bz)})
    detectors = [load("besiii-cgem").with_field(tmp_path / name) for name in ("measured.npz", "assumed.csv")]
    how = {"output": tmp_path / "run"} if keeps == "output" else {}
    result = run(detectors[0], Gun("mu-", p=1, cos_theta=0), 2, fit_detector=detectors[1], **how)  # type: ignore[arg-type]
    if keeps == "save":
        result.save(tmp_path / "run")
    moved = (tmp_path / "run").rename(tmp_path / "elsewhere")
    for name in ("measured.npz", "assumed.csv"):
        (tmp_path / name).unlink()
    read = Result.load(moved)
    assert (read.detector, read.fit_detector) == tuple(detectors)
    assert [load(moved / f"{role}.toml") for role in ("detector", "fit_detector")] == detectors
    assert not [path for path in moved.glob("*.[tj]*") if str(tmp_path) in path.read_text()]


def test_the_record_says_everything(result: Result, saved: Path) -> None:
    entries = json.loads((saved / "run.json").read_text())
    assert entries["settings"] == SETTINGS.to_dict()
    assert entries["versions"] == versions()
    assert entries["versions"]["numpy"] == np.__version__
    assert entries["seed"] == 2**63 + 1
    assert entries["source"][0]["p"] == {"from": 0.4, "to": 0.6}
    assert entries["detectors"]["detector"] == result.detector.to_toml() == (saved / "detector.toml").read_text()
    assert entries["configuration"] == result.tracks.meta["configuration"]


@pytest.mark.parametrize(
    "change",
    [
        {"gun": Gun("mu-", p=1, cos_theta=0.1)},
        {"settings": Settings(fit=FitSettings(kinks=False))},
        {"fit_detector": "besiii-idc-boss"},
        {"detector": load("besiii-idc").with_overrides({"field.bz": "0.9 T", "name": "besiii-idc"})},
    ],
)
def test_the_hash_tells_configurations_apart(change: dict[str, Any]) -> None:
    usual = {"detector": "besiii-idc", "gun": Gun("mu-", p=1, cos_theta=0), "n": 1}
    first, again, other = (run(**(usual | more)) for more in ({}, {"seed": 9}, change))
    hashes = [one.tracks.meta["configuration"] for one in (first, again, other)]
    assert hashes[0] == hashes[1] != hashes[2]
    assert first != other


@pytest.mark.parametrize("gun", [GUN, Gun("K+", pt=[0.3], theta=(0.5, 1)), Guns((Gun("mu-", p=1, theta=1),) * 3), None])
def test_guns_are_read_back(gun: Gun | Guns | None) -> None:
    problems: list[str] = []
    assert repr(gun_from(json.loads(json.dumps(gun_data(gun))), problems)) == repr(gun)
    assert not problems


def edit(**changes: Any) -> Callable[[Path], None]:
    """Return what changes entries of run.json."""

    def change(folder: Path) -> None:
        entries = json.loads((folder / "run.json").read_text())
        (folder / "run.json").write_text(json.dumps(entries | changes))

    return change


def truncate(name: str) -> Callable[[Path], None]:
    """Return what cuts off the second half of a file."""

    def change(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: len(data) // 2])

    return change


def replace_table(**how: Any) -> Callable[[Path], None]:
    """Return what puts the digis of another run in the place of this one's."""

    def change(folder: Path) -> None:
        given = {"seed": 2**63 + 1, "settings": SETTINGS, "fit_detector": "besiii-cgem", "n": 12, **how}
        other = run("besiii-cgem-design", GUN, **given)
        other.digis.save(folder / "digis.npz", overwrite=True)

    return change


def index_of(name: str) -> Callable[[Path], None]:
    """Make a table the only one that a folder lists."""

    def damage(folder: Path) -> None:
        (folder / "tables.json").write_text(json.dumps({name: {"suffix": ".npz"}}))

    return damage


def wrong_kind(folder: Path) -> None:
    """Give the truths under the name of the digis."""
    shutil.copy(folder / "truths.npz", folder / "digis.npz")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncate("tracks.npz"), "tracks.npz: "),
        (truncate("run.json"), "run.json: got "),
        (truncate("tables.json"), "tables.json is damaged"),
        (lambda folder: (folder / "clusters.npz").unlink(), "clusters.npz: "),
        (lambda folder: (folder / "tables.json").unlink(), "tables.json is missing"),
        (index_of("tracks"), "particles.npz: got nothing"),
        (index_of("hits"), "hits.npz: got a table that no run has"),
        (wrong_kind, "digis.npz: got a table of kind 'truths', expected 'digis'"),
        (replace_table(seed=1), f"digis.npz: seed: got 1, expected {2**63 + 1}, as run.json says"),
        (replace_table(settings=Settings()), "digis.npz: configuration: got "),
        (replace_table(n=11), "digis.npz: events: got 11, expected 12, as run.json says"),
        (edit(seed=1), "tracks.npz: seed: got 9223372036854775809, expected 1, as run.json says"),
        (edit(events=13), "tracks.npz: events: got 12, expected 13"),
        (edit(versions={"cgemit": "0.0"}), "tracks.npz: version: got "),
        (edit(settings={"fit": {"loss": "meen"}}), "run.json: settings.fit.loss: got 'meen', expected one of"),
        (edit(settings=Settings().to_dict()), "run.json: configuration: got "),
        (edit(source=[{"particle": "mu-", "p": -1, "theta": 1}]), "run.json: source.p: got -1"),
        (edit(source=3), "run.json: source: "),
        (edit(detectors={"detector": "name = 3"}), "run.json: detectors.detector: "),
        (edit(detectors={}), "run.json: detectors.detector: got nothing"),
        (edit(format="cgemit-run-0"), "run.json: got format 'cgemit-run-0', expected 'cgemit-run-1'"),
        (edit(seed=None), "run.json: got no entry, or a wrong one, for seed"),
        (lambda folder: (folder / "run.json").write_text("[]"), "run.json: got format []"),
        (
            lambda folder: (folder / "detector.toml").write_text(load("besiii-idc").to_toml()),
            "detector.toml: got another detector, expected that of run.json",
        ),
    ],
)  # fmt: skip
def test_damaged_and_mixed_folders_are_refused(damage: Callable[[Path], None], message: str, saved: Path) -> None:
    damage(saved)
    with pytest.raises(RecordError) as error:
        Result.load(saved)
    assert any(message in str(problem) for problem in error.value.problems), str(error.value)


def test_all_damage_is_listed_at_once(saved: Path) -> None:
    truncate("tracks.npz")(saved)
    replace_table(seed=1)(saved)
    edit(settings={"fit": {"loss": "meen", "kinks": 1}})(saved)
    with pytest.raises(RecordError) as error:
        Result.load(saved)
    begins = ("run.json: configuration", "run.json: settings.fit.loss", "run.json: settings.fit.kinks", "tracks.npz")
    for begin in (*begins, "digis.npz: seed"):
        assert sum(str(problem).startswith(begin) for problem in error.value.problems) == 1, begin


def test_a_folder_without_a_run(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"run\.json is missing"):
        Result.load(tmp_path)


def test_files_are_replaced_when_asked_only(result: Result, saved: Path) -> None:
    other = run("besiii-idc", Gun("mu-", p=1, cos_theta=0), 2)
    with pytest.raises(FileExistsError, match="already holds files"):
        other.save(saved)
    assert Result.load(saved) == result
    files = other.save(saved, overwrite=True)
    assert Result.load(saved) == other
    assert {path.name for path in saved.iterdir()} == {
        CONTENTS,
        *(path.name for path in files),
    }  # no states, no residuals
    assert Table.load(saved / "tracks.npz") == other.fitted


GUN_REFUSALS = cg.Gun("mu-", p=1, cos_theta=(-0.5, 0.5))


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    cg.run("besiii-idc", GUN_REFUSALS, n=6, output=folder, workers=cg.Workers(chunk=2))
    return folder


@pytest.mark.parametrize(
    ("file", "path", "value", "message"),
    [
        ("tables.json", ("tracks", "parts"), None, "parts: got None, expected a list of parts"),
        ("run.json", ("timings",), {}, "timings: got {}, expected seconds by stage, with 'wall' for all"),
        ("run.json", ("timings",), {"wall": "long"}, "timings: got"),
        ("run.json", ("tables",), None, "tables: got None, expected a list of names"),
        ("run.json", ("tables",), [3], "tables: got"),
        ("run.json", ("transported",), {"end": None}, "transported: got"),
    ],
)
def test_a_damaged_run(stored, file, path, value, message):
    text = (stored / file).read_text()
    data = json.loads(text)
    part = data
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    (stored / file).write_text(json.dumps(data))
    try:
        for read in (cg.open, cg.Result.load):
            with pytest.raises(RecordError) as refused:
                read(stored)
            assert message in str(refused.value)
    finally:
        (stored / file).write_text(text)
    assert len(cg.open(stored).tracks) == 6


def test_tables_that_were_not_kept(tmp_path):
    cg.run("besiii-idc", GUN_REFUSALS, n=3, keep=["tracks"], output=tmp_path / "run")
    opened = cg.open(tmp_path / "run")
    for error in (AttributeError, ValueError, NotKeptError):
        with pytest.raises(error, match="made the table 'clusters', but kept only tracks, matches"):
            _ = opened.clusters
    assert opened.states is None
    assert set(opened.to_pandas()) == {"tracks", "matches"}
    early = cg.run("besiii-idc", GUN_REFUSALS, n=3, until="digitize")
    assert early.clusters is early.tracks is None
    kept = cg.run("besiii-idc", GUN_REFUSALS, n=3, until="find", keep=["candidates"])
    assert kept.tracks is None
    assert getattr(kept, "digis", "none") == "none"
