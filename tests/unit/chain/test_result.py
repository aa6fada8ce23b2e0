"""Runs in files: every format read back by value, parts written while a run goes on, tables read when asked for."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.resolutions import pulls, resolution_against
from cgemit.base.files import OutputExistsError
from cgemit.chain import executor
from cgemit.chain.result import Result
from cgemit.chain.settings import Settings
from cgemit.cli.main import main
from cgemit.tables import SCHEMAS, Table, formats, load_tables, save_tables, store
from cgemit.tables.formats import FORMATS
from cgemit.tables.table import targets

GUN = cg.Gun("pi-", p=(0.3, 1.0), cos_theta=(-0.9, 0.9)) + cg.Gun("mu+", p=1.0, theta=1.0)
SETTINGS = Settings(simulate=cg.SimulateSettings(steps=True), fit=cg.FitSettings(residuals=True, states=("origin",)))
HOW: dict[str, Any] = {"n": 16, "seed": 7, "workers": cg.Workers(threads=2, chunk=4), "settings": SETTINGS}
DESIGN = "besiii-cgem-design"


@pytest.fixture(scope="module")
def whole() -> Result:
    return cg.run(DESIGN, GUN, **HOW)


@pytest.fixture
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of few events."""
    monkeypatch.setattr(store, "PART_BYTES", 10_000)


def same(one: Table, other: Table) -> bool:
    """Compare bytes: NaN, signs of zero and dtypes count."""
    return one == other and all(one[name].tobytes() == other[name].tobytes() for name in one.columns)


@pytest.mark.parametrize("form", FORMATS)
def test_a_run_is_read_back_from_every_format(whole: Result, tmp_path: Path, form: str) -> None:
    files = whole.save(tmp_path / "run", format=form)
    assert {path.suffix for path in files[: len(whole.tables)]} == {FORMATS[form].suffix}
    for read in (Result.load(tmp_path / "run"), cg.open(tmp_path / "run")):
        assert list(read.tables) == list(whole.tables)
        for name, table in whole.tables.items():
            assert same(read.tables[name], table), name
            assert read.tables[name].meta == table.meta
        assert (read.n_events, read.rows, read.transport()) == (16, whole.rows, whole.transport())


@pytest.mark.parametrize("form", FORMATS)
def test_extra_columns_and_gaps_between_events_are_kept(tmp_path: Path, form: str) -> None:
    columns = {column.name: np.zeros((3, *column.shape), column.dtype) for column in SCHEMAS["digis"]}
    columns |= {"event": np.array([3, 3, 2**40]), "charge": np.array([0.1, -0.0, np.nan]), "first": np.arange(3.0)}
    columns["matrix"] = np.arange(18, dtype=np.float32).reshape(3, 3, 2) / 7
    table = Table("digis", columns, 3, meta={"seed": 2**64 - 1}, events=[3, 10, 2**40])
    save_tables({"digis": table}, tmp_path, format=form)
    read = load_tables(tmp_path)["digis"]
    assert same(read, table)
    assert (read.meta, read.events.tolist()) == ({"seed": 2**64 - 1}, [3, 10, 2**40])


@pytest.mark.parametrize("form", FORMATS)
def test_tables_without_rows_are_kept(tmp_path: Path, form: str) -> None:
    tables = {name: Table.empty(name, n_events, 5) for name, n_events in (("tracks", 3), ("digis", 0))}
    save_tables(tables, tmp_path, format=form)
    read = load_tables(tmp_path)
    assert all(same(read[name], table) for name, table in tables.items())


@pytest.mark.parametrize("suffix", [".npz", ".parquet", ".root"])
def test_one_table_in_one_file(whole: Result, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"tracks{suffix}"
    whole.tables["tracks"].save(path)
    assert same(Table.load(path), whole.tables["tracks"])
    with pytest.raises(FileExistsError):
        whole.tables["tracks"].save(path)


def test_other_programs_read_the_files(whole: Result, tmp_path: Path) -> None:
    import pandas
    import uproot

    wanted = whole.tables["tracks"].to_pandas()
    for form, read in (("parquet", pandas.read_parquet),):
        whole.save(tmp_path / form, format=form)
        found = read(tmp_path / form / f"tracks.{form}")
        pandas.testing.assert_frame_equal(found, wanted, check_exact=True)
    whole.save(tmp_path / "root", format="root")
    with uproot.open(tmp_path / "root" / "tracks.root") as file:
        cov = file["tracks"]["cov"].array(library="np")
    assert np.array_equal(cov, whole.tables["tracks"]["cov"])


def damage(name: str) -> Callable[[bytes], bytes]:
    """Return what damages the bytes of a file."""
    return {
        "cut": lambda data: data[: len(data) * 2 // 3],
        "empty": lambda data: b"",
        "noise": lambda data: bytes(255 - byte for byte in data),
        "hole": lambda data: data[: len(data) // 3] + bytes(len(data) // 3) + data[len(data) // 3 * 2 :],
        "text": lambda data: b"hits\n1\n",
    }[name]


@pytest.mark.parametrize("how", ["cut", "empty", "noise", "hole", "text"])
@pytest.mark.parametrize("form", FORMATS)
def test_damaged_files_are_refused(whole: Result, tmp_path: Path, form: str, how: str) -> None:
    whole.save(tmp_path / "run", format=form)
    path = tmp_path / "run" / f"truths{FORMATS[form].suffix}"
    path.write_bytes(damage(how)(path.read_bytes()))
    with pytest.raises(ValueError, match="truths"):
        Result.load(tmp_path / "run")
    opened = cg.open(tmp_path / "run")
    assert same(opened.clusters, whole.clusters)
    with pytest.raises(ValueError, match="truths"):
        opened.truths  # noqa: B018


@pytest.mark.parametrize("form", FORMATS)
def test_another_number_in_a_file_is_seen(
    whole: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    z = whole.truths["z"].copy()
    z[3] = np.nextafter(z[3], 0)
    turn = itertools.cycle([formats.checksum(column) for column in whole.truths.columns.values()])
    monkeypatch.setattr(formats, "checksum", lambda column: next(turn))
    save_tables({"truths": whole.truths}, tmp_path / "good", format=form)
    save_tables({"truths": whole.truths.with_columns(z=z)}, tmp_path / "wrong", format=form)
    monkeypatch.undo()
    assert same(load_tables(tmp_path / "good")["truths"], whole.truths)
    with pytest.raises(ValueError, match=rf"truths.{form} is damaged: the checksum of z is another one"):
        load_tables(tmp_path / "wrong")
    with pytest.raises(ValueError, match="the checksum of z"):
        store.StoredTables(tmp_path / "wrong").column("truths", "z")


@pytest.mark.parametrize("form", ["npz", "parquet", pytest.param("root", marks=pytest.mark.slow)])
def test_streamed_parts_make_the_same_run(whole: Result, tmp_path: Path, form: str, small_parts: None) -> None:
    result = cg.run(DESIGN, GUN, output=cg.Output(tmp_path / "run", format=form), **HOW)
    assert len(list((tmp_path / "run" / "tracks").glob(f"part-*{FORMATS[form].suffix}"))) == 4
    assert result == whole == cg.open(tmp_path / "run") == Result.load(tmp_path / "run")
    events = 0
    for part in result.parts():
        assert part == whole.select_events(events, events + part.n_events)
        events += part.n_events
    assert events == 16
    assert [part.n_events for part in whole.parts()] == [16]


def test_columns_of_parts_are_those_of_the_whole(whole: Result, tmp_path: Path, small_parts: None) -> None:
    for form in ("npz", "parquet"):
        result = cg.run(DESIGN, GUN, output=cg.Output(tmp_path / form, format=form), **HOW)
        for name in ("cov", "res_dr", "status"):
            assert result.column("tracks", name).tobytes() == whole.tracks[name].tobytes()
        for name in ("color", "res_color"):
            with pytest.raises(KeyError, match=name):
                result.column("tracks", name)
        part = next(result.parts())
        assert np.array_equal(part.column("tracks", "dr"), whole.tracks["dr"][: len(part.tracks)])
    with pytest.raises(KeyError, match="no table 'hits'"):
        whole.column("hits", "x")


def test_only_kept_tables_are_there(whole: Result, tmp_path: Path, small_parts: None) -> None:
    kept = cg.run(DESIGN, GUN, keep=("tracks", "clusters"), **HOW)
    streamed = cg.run(DESIGN, GUN, keep=("clusters", "tracks"), output=tmp_path / "run", **HOW)
    assert list(kept.tables) == list(streamed.tables) == ["clusters", "tracks", "matches"]
    assert kept == streamed == Result.load(tmp_path / "run")
    for name in ("digis", "particles", "candidates"):
        with pytest.raises(AttributeError, match=f"made the table '{name}', but kept only clusters, tracks, matches"):
            getattr(streamed, name)
    assert kept.residuals is kept.states is None  # which it did not make
    for name, table in kept.tables.items():
        gone = {c.name for c in SCHEMAS[name] if targets(c) and not set(targets(c)) <= kept.tables.keys()}
        assert gone == {"clusters": {"truth"}, "tracks": {"candidate"}, "matches": set()}[name]
        for column in table.columns:
            wanted = whole.tables[name][column]
            assert np.array_equal(table[column], -np.ones_like(wanted) if column in gone else wanted, equal_nan=True)
    for result in (kept, streamed):
        assert result.transport() == whole.transport()
        assert (result.removed(), result.finder, result.n_events) == (whole.removed(), "truth", 16)
        assert str(whole.transport()["end"]) in repr(result)
        assert result.select_events(5, 9).clusters == kept.clusters.select_events(5, 9).with_columns(
            **{name: result.select_events(5, 9).clusters[name] for name in ("x_cluster", "v_cluster")}
        )
        assert result.to_awkward()["tracks"]["res_dr"].tolist() == whole.to_awkward()["tracks"]["res_dr"].tolist()
    steps = cg.run(DESIGN, GUN, keep="residuals", **HOW).residuals
    assert np.all(steps["hit"] == -1)
    assert np.all(steps["track"] == -1)


def test_keep_says_what_is_wrong() -> None:
    gun = cg.Gun("mu-", p=1, theta=1)
    with pytest.raises(ValueError, match=r"keep: got 'tracs', expected some of .*\n  until: got 'fits'"):
        cg.run(DESIGN, gun, 1, keep=["tracs"], until="fits")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match='did you mean "tracks"'):
        cg.run(DESIGN, gun, 1, keep=["tracs"])
    with pytest.raises(ValueError, match="keep: got no table"):
        cg.run(DESIGN, gun, 1, keep=[])
    with pytest.raises(ValueError, match="keep: got states, which this run does not make, expected some of particles"):
        cg.run(DESIGN, gun, 1, keep=["states"])
    with pytest.raises(ValueError, match=r"format: got 'parket', expected one of 'npz', .*; did you mean \"parquet\""):
        cg.run(DESIGN, gun, 1, output=cg.Output("never", format="parket"))


def test_studies_of_files_give_the_same_numbers(tmp_path: Path, small_parts: None) -> None:
    gun = cg.Gun("mu-", p=(0.3, 1.0), cos_theta=(-0.9, 0.9))
    whole = cg.run(DESIGN, gun, 200, workers=cg.Workers(chunk=20))
    result = cg.run(
        DESIGN,
        gun,
        200,
        keep="tracks",
        output=cg.Output(tmp_path / "run", format="parquet"),
        workers=cg.Workers(chunk=20),
    )
    assert len(list(result.parts())) > 1
    assert cg.resolution(result, "dr") == cg.resolution(whole, "dr") == cg.resolution(whole.tracks, "dr")
    assert pulls(result) == pulls(whole)
    assert resolution_against(result, "p", "p", 3) == resolution_against(whole, "p", "p", 3)
    assert result.tables._tables == {}  # type: ignore[attr-defined]  # no table was read as a whole


def test_old_parts_do_not_stay_beside_new_ones(tmp_path: Path, small_parts: None) -> None:
    folder = tmp_path / "run"
    cg.run(DESIGN, GUN, output=folder, **HOW)
    with pytest.raises(OutputExistsError):
        cg.run(DESIGN, GUN, output=folder, **HOW)
    shorter = cg.run(DESIGN, GUN, keep="clusters", output=cg.Output(folder, overwrite=True), **HOW | {"n": 4})
    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()) == [
        ".cgemit", "clusters/part-000000.npz", "detector.toml", "run.json", "tables.json",
    ]  # fmt: skip
    assert shorter.n_events == 4


def edit_index(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the entries of tables.json."""
    index = json.loads((folder / "tables.json").read_text())
    change(index)
    (folder / "tables.json").write_text(json.dumps(index))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda index: index["clusters"].update(suffix="/../x"), "clusters: suffix: got '/../x'"),
        (lambda index: index["clusters"]["parts"].pop(), "clusters: parts: got 12 n_events, expected 16"),
        (lambda index: index["clusters"].update(parts=[]), "clusters: parts: got \\[\\], expected a list of parts"),
        (lambda index: index["clusters"]["parts"][0].update(rows=-1), "whole numbers"),
        (lambda index: index["clusters"].pop("rows"), "expected None"),
        (lambda index: index["clusters"]["meta"].update(seed=8), "seed: got 8, expected 7, as run.json says"),
    ],
)
def test_a_damaged_index_is_refused(
    tmp_path: Path, small_parts: None, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    cg.run(DESIGN, GUN, keep=("clusters", "truths"), output=tmp_path / "run", **HOW)
    edit_index(tmp_path / "run", change)
    with pytest.raises(ValueError, match=message):
        cg.open(tmp_path / "run").clusters  # noqa: B018


def test_a_missing_or_exchanged_part_is_refused(tmp_path: Path, small_parts: None) -> None:
    result = cg.run(DESIGN, GUN, keep="clusters", output=tmp_path / "run", **HOW)
    first, second = (tmp_path / "run" / "clusters" / f"part-00000{i}.npz" for i in range(2))
    second.replace(first)
    with pytest.raises(ValueError, match=r"clusters/part-000001.npz: missing"):
        cg.open(tmp_path / "run")
    with pytest.raises(ValueError, match=r"part-000000.npz: (rows|first_event): got .* as tables.json says"):
        next(result.parts()).clusters  # noqa: B018


def test_an_error_or_interrupt_leaves_nothing(tmp_path: Path, small_parts: None) -> None:
    def stop(fraction: float) -> None:
        if fraction > 0.7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cg.run(DESIGN, GUN, progress=stop, output=tmp_path / "run", **HOW)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_killed_run_is_no_result(tmp_path: Path) -> None:
    arguments = ["simulate", "-d", DESIGN, "--p", "1", "--theta", "1", "--keep", "tracks", "-o", str(tmp_path / "run")]
    work = subprocess.Popen([sys.executable, "-m", "cgemit", *arguments, "-n", "1000000", "--quiet"])
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".cgemit-*.tmp/*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(work.pid, signal.SIGKILL)
    work.wait()
    assert not (tmp_path / "run").exists()
    with pytest.raises(FileNotFoundError):
        cg.open(tmp_path / "run")
    assert main([*arguments, "-n", "20", "--quiet"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_answers_do_not_pile_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With `output` no more than twice as many chunks as threads are begun and not yet written."""
    from cgemit.chain import run
    from cgemit.tables import store

    waiting: Counter[str] = Counter()
    most = []
    work, add = run._chunk, store.PartsWriter.add

    def counted(*arguments: Any) -> Any:
        waiting["begun"] += 1
        return work(*arguments)

    def added(self: Any, tables: Any) -> bool:
        time.sleep(0.01)  # slower than the work, so that answers would pile up
        waiting["written"] += 1
        most.append(waiting["begun"] - waiting["written"])
        return add(self, tables)

    monkeypatch.setattr(run, "_chunk", counted)
    monkeypatch.setattr(store.PartsWriter, "add", added)
    cg.run(
        DESIGN,
        cg.Gun("mu-", p=1, theta=1),
        60,
        keep="tracks",
        output=tmp_path / "run",
        workers=cg.Workers(threads=2, chunk=1),
    )
    assert max(most) <= 4


def test_what_does_not_fit_says_what_would(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_parts: None) -> None:
    sizes = {"digis": 6_000, "tracks": 700, "matches": 300}
    monkeypatch.setattr(executor, "available", lambda: 3 * 10**9)
    with pytest.raises(ValueError, match=r"n: 1000000 events need about 14 GB of memory \(7.0 kB an event, 2 times\), "
                       r"and 3 GB are free; expected at most 214,285 events at a time, or less of each: "
                       r"keep=\('tracks',\) needs 2 GB; output=FOLDER \(on the command line --keep\) needs no more "
                       r"memory than a few chunks, and 7 GB on disk, or 1 GB with keep=\('tracks',\)"):  # fmt: skip
        executor.check_memory(sizes, set(sizes), 1, 10**6)
    with pytest.raises(ValueError, match=r"expected at most 1,500,000 events at a time, or less of each: output="):
        executor.check_memory(sizes, {"tracks", "matches"}, 1, 10**7)
    executor.check_memory(sizes, {"tracks", "matches"}, 1, 10**6)
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1000}))
    with pytest.raises(ValueError, match=r"n: 16 events need about 0.0\d+ GB on disk \(\d+.\d+ kB an event\), and "):
        cg.run(DESIGN, GUN, output=tmp_path / "run", **HOW)
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_named_before_events_are_simulated(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    arguments = ["simulate", "-d", DESIGN, "--p", "1", "--theta", "1", "-n", "5", "-o", "never", "--format", "parquet"]
    assert main(arguments) == 2
    assert capsys.readouterr().err == "cgemit: this needs pyarrow: pip install 'cgemit[io]'\n"
    assert not Path("never").exists()


def test_the_command_line_writes_what_python_does(tmp_path: Path, small_parts: None) -> None:
    common = ["simulate", "-d", DESIGN, "--p", "1", "--theta", "1", "-n", "60", "--seed", "3", "--quiet"]
    gun = cg.Gun("mu-", p=1, theta=1)
    assert main([*common, "--keep", "tracks,clusters", "--format", "parquet", "-o", str(tmp_path / "kept")]) == 0
    kept = cg.open(tmp_path / "kept")
    assert kept == cg.run(DESIGN, gun, 60, seed=3, keep=("tracks", "clusters"))
    assert (tmp_path / "kept" / "tracks" / "part-000000.parquet").exists()
    assert json.loads((tmp_path / "kept" / "summary.json").read_text())["rows"] == kept.rows
    assert "--keep tracks,clusters" in json.loads((tmp_path / "kept" / "run.json").read_text())["command"]
    assert main([*common, "--keep", "all", "-o", str(tmp_path / "all")]) == 0
    assert cg.open(tmp_path / "all") == cg.run(DESIGN, gun, 60, seed=3, until="cluster")
    assert main([*common, "--format", "root", "-o", str(tmp_path / "root")]) == 0
    assert (tmp_path / "root" / "digis.root").exists()
    assert Result.load(tmp_path / "root") == cg.open(tmp_path / "all")
