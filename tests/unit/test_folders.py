"""Output folders of runs at the same time, of killed runs, and in places that cannot be replaced."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from cgemit.base.files import OutputExistsError, new_folder
from cgemit.chain.result import Result
from cgemit.chain.run import run
from cgemit.cli.main import main
from cgemit.particles.gun import Gun
from cgemit.tables import load_tables

GUN = Gun("mu-", p=1, theta=1)


def write(folder, text, **options):
    with new_folder(folder, **options) as place:
        (place / "run.json").write_text(text)
        (place / f"{text}.txt").write_text(text)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_of_two_runs_into_one_place_the_second_fails(tmp_path):
    """Both find the place free; only one may say that its results are there."""
    with (  # noqa: PT012
        pytest.raises(OutputExistsError, match="already holds files"),
        new_folder(tmp_path / "out") as place,
    ):
        (place / "run.json").write_text("first")
        write(tmp_path / "out", "second")
    assert names(tmp_path / "out") == ["run.json", "second.txt"]
    assert names(tmp_path) == ["out"]


def test_runs_at_the_same_time_never_mix(tmp_path):
    """With leave to overwrite, the folder is at all times that of one run, and what others put there stays."""
    folder = tmp_path / "out"
    write(folder, "0")
    (folder / "deep").mkdir()
    (folder / "deep" / "mine.txt").write_text("mine")

    def work(text):
        for _ in range(20):
            write(folder, text, overwrite=True)

    threads = [threading.Thread(target=work, args=(text,)) for text in "1234"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    last = (folder / "run.json").read_text()
    assert (folder / f"{last}.txt").exists()
    assert (folder / "deep" / "mine.txt").read_text() == "mine"
    assert not list(tmp_path.glob(".*.tmp"))


def test_a_folder_that_another_run_removes_before_it_is_locked_is_made_again(tmp_path, monkeypatch):
    opened = os.open
    removed = []

    def remove_first(path, flags, *args, **kwargs):
        if not removed and str(path).endswith(".tmp"):
            removed.append(path)
            Path(path).rmdir()
        return opened(path, flags, *args, **kwargs)

    monkeypatch.setattr(os, "open", remove_first)
    write(tmp_path / "out", "1")
    assert removed
    assert names(tmp_path) == ["out"]
    assert names(tmp_path / "out") == ["1.txt", "run.json"]


def test_overwriting_replaces_the_tables_as_a_set(tmp_path):
    run("besiii-cgem-design", GUN, 5, seed=1).save(tmp_path / "out")
    (tmp_path / "out" / "mine.txt").touch()
    run("besiii-cgem-design", GUN, 6, seed=2, until="simulate").save(tmp_path / "out", overwrite=True)
    assert Result.load(tmp_path / "out").seed == 2
    assert not (tmp_path / "out" / "tracks.npz").exists()
    assert (tmp_path / "out" / "mine.txt").exists()
    assert names(tmp_path) == ["out"]


def test_tables_of_several_runs_are_refused(tmp_path):
    for seed in (1, 2):
        run("besiii-cgem-design", GUN, 5, seed=seed).save(tmp_path / str(seed))
    (tmp_path / "2" / "tracks.npz").replace(tmp_path / "1" / "tracks.npz")
    with pytest.raises(ValueError, match=r"several runs:\n  tracks.npz: seed: got 2, expected 1, as tables.json says"):
        load_tables(tmp_path / "1")
    with pytest.raises(ValueError, match=r"tracks.npz: seed: got 2"):
        Result.load(tmp_path / "1")


@pytest.mark.parametrize("name", ["../2/tracks", "/etc/passwd", "", "a b", "x" * 100])
def test_names_of_tables_are_no_paths(name, tmp_path):
    (tmp_path / "tables.json").write_text(f'{{"{name}": {{}}}}')
    with pytest.raises(ValueError, match="got the table name"):
        load_tables(tmp_path)


def test_a_killed_run_is_cleaned_up_by_the_next(tmp_path):
    code = """
import sys, time
from cgemit.base.files import new_folder
with new_folder(sys.argv[1]) as place:
    (place / "part").touch()
    print(place, flush=True)
    time.sleep(60)
"""
    folder = tmp_path / "out"
    with subprocess.Popen([sys.executable, "-c", code, folder], stdout=subprocess.PIPE, text=True) as process:
        left = Path(process.stdout.readline().strip())
        write(tmp_path / "other", "1")
        write(folder, "1")
        assert left.exists()  # of a process that still runs
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert left.exists()
    write(folder, "2", overwrite=True)
    assert names(tmp_path) == ["other", "out"]


def test_the_current_folder_stays_the_same(tmp_path, monkeypatch):
    """A shell that stands in the folder must find the new files in it."""
    (tmp_path / "mine.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    inode = tmp_path.stat().st_ino
    write(".", "1", overwrite=True)
    assert tmp_path.stat().st_ino == inode
    assert names(tmp_path) == ["1.txt", "mine.txt", "run.json"]
    assert not list(tmp_path.parent.glob(f".{tmp_path.name}-*"))


@pytest.mark.parametrize("where", ["loop", "x" * 300, "a\0b"])
def test_places_that_cannot_be(where, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to("loop")
    arguments = ["simulate", "-d", "besiii-cgem-design", "--p", "1", "--theta", "1", "-n", "1", "--quiet", "-o", where]
    assert main(arguments) == 2
    assert "is no folder to write to" in capsys.readouterr().err
    assert names(tmp_path) == ["loop"]


def test_a_full_disk_says_so(tmp_path, monkeypatch):
    from cgemit.draw.style import new_picture

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        new_picture()[0].save(tmp_path / "picture")
    assert names(tmp_path) == []
