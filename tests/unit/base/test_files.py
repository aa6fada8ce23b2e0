"""Output folders of concurrent and killed runs; files that are damaged, endless, or larger than they look."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from cgemit.base import files
from cgemit.base.files import CONTENTS, OutputExistsError, new_file, new_folder, parse_toml, read_json, read_npz
from cgemit.base.settings import SettingsError
from cgemit.chain.result import Result
from cgemit.chain.run import run
from cgemit.cli.main import main
from cgemit.detector import DetectorError, load, read_field_map, write_field_map
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.fit import FitSettings
from cgemit.study.optimize.run import read_optimize_plan
from cgemit.study.sweep.plan import PlanError, read_plan
from cgemit.tables import Table, load_tables
from cgemit.units import QuantityError, parse_quantity

GUN = Gun("mu-", p=1, theta=1)


def write(folder, text, **options):
    with new_folder(folder, **options) as place:
        (place / "run.json").write_text(text)
        (place / f"{text}.txt").write_text(text)


def names(folder):
    return sorted(path.name for path in folder.iterdir() if path.name != CONTENTS)


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
    """With leave to overwrite, the folder holds the files of one run in the end."""
    folder = tmp_path / "out"
    write(folder, "0")

    def work(text):
        for _ in range(20):
            write(folder, text, overwrite=True)

    threads = [threading.Thread(target=work, args=(text,)) for text in "1234"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    last = (folder / "run.json").read_text()
    assert names(folder) == [f"{last}.txt", "run.json"]
    assert names(tmp_path) == ["out"]


def test_overwriting_replaces_the_tables_as_a_set(tmp_path):
    run("besiii-cgem-design", GUN, 5, seed=1).save(tmp_path / "out")
    run("besiii-cgem-design", GUN, 6, seed=2, until="simulate").save(tmp_path / "out", overwrite=True)
    assert Result.load(tmp_path / "out").seed == 2
    assert not (tmp_path / "out" / "tracks.npz").exists()
    assert names(tmp_path) == ["out"]


def everything(folder):
    """Return all paths in a folder with their modes and contents."""
    return {path: (path.stat().st_mode, path.read_bytes() if path.is_file() else b"") for path in folder.rglob("*")}


@pytest.mark.parametrize("others", ["run.json", ".ssh/", "code/.git/refs/", "0.txt/", "more.txt", "link"])
def test_folders_that_hold_anything_else_are_not_overwritten(others, tmp_path):
    """Only what the program wrote is overwritten: no file of the user's, no empty folder, no mode changes."""
    folder = tmp_path / "home"
    if others in ("more.txt", "link"):
        write(folder, "0")
    folder.mkdir(exist_ok=True)
    place = folder / others
    if others == "link":
        (tmp_path / "elsewhere").mkdir()
        place.symlink_to(tmp_path / "elsewhere")
    elif others.endswith("/"):
        place.mkdir(parents=True)
        place.chmod(0o700)
    else:
        place.write_text('{"of": "the user"}')
    before = everything(folder)
    with pytest.raises(OutputExistsError, match=f"holds '{others.split('/')[0]}', which is not of the results"):
        write(folder, "1", overwrite=True)
    assert everything(folder) == before


def test_results_that_a_folder_got_meanwhile_are_not_overwritten(tmp_path):
    folder = tmp_path / "out"
    write(folder, "0")
    with (  # noqa: PT012
        pytest.raises(OutputExistsError, match="holds 'mine'"),
        new_folder(folder, overwrite=True) as place,
    ):
        (place / "run.json").write_text("1")
        (folder / "mine").mkdir()
    assert names(folder) == ["0.txt", "mine", "run.json"]


@pytest.mark.parametrize("step", range(6))
def test_a_run_that_is_killed_while_it_overwrites_leaves_no_mixture(step, tmp_path, monkeypatch):
    """Whatever step it was, the folder is incomplete or all new, and can be overwritten."""
    folder = tmp_path / "out"
    write(folder, "0")
    folder.chmod(0o700)
    left = step
    unlink, move = Path.unlink, shutil.move

    def counted(function):
        def called(*args, **kwargs):
            nonlocal left
            left -= 1
            if left < 0:
                raise KeyboardInterrupt
            return function(*args, **kwargs)

        return called

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", counted(unlink))
        patch.setattr(shutil, "move", counted(move))
        if step == 5:
            write(folder, "1", overwrite=True)
        else:
            with pytest.raises(KeyboardInterrupt):
                write(folder, "1", overwrite=True)
    assert (folder / "run.json").exists() == (step in (0, 5))
    write(folder, "2", overwrite=True)
    assert names(folder) == ["2.txt", "run.json"]
    assert folder.stat().st_mode & 0o777 == 0o700
    assert names(tmp_path) == ["out"]


def test_tables_of_several_runs_are_refused(tmp_path):
    for seed in (1, 2):
        run("besiii-cgem-design", GUN, 5, seed=seed).save(tmp_path / str(seed))
    (tmp_path / "2" / "tracks.npz").replace(tmp_path / "1" / "tracks.npz")
    with pytest.raises(ValueError, match=r"several runs: 1 problem\n  tracks.npz: seed: got 2, expected 1, as "):
        load_tables(tmp_path / "1")
    with pytest.raises(ValueError, match=r"tracks.npz: seed: got 2"):
        Result.load(tmp_path / "1")


@pytest.mark.parametrize("name", ["../2/tracks", "/etc/passwd", "", "a b", "x" * 100])
def test_names_of_tables_are_no_paths(name, tmp_path):
    (tmp_path / "tables.json").write_text(f'{{"{name}": {{}}}}')
    with pytest.raises(ValueError, match="got the table name"):
        load_tables(tmp_path)


@pytest.mark.parametrize("kind", ["new_folder", "new_file"])
def test_a_killed_run_is_cleaned_up_by_the_next(kind, tmp_path):
    """Whatever its results are called, and whatever the next one makes in the same place."""
    code = f"""
import sys, time
from cgemit.base.files import {kind}
with {kind}(sys.argv[1]) as place:
    print(place, flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code, tmp_path / "out"], stdout=subprocess.PIPE, text=True) as process:
        left = tmp_path / Path(process.stdout.readline().strip()).relative_to(tmp_path).parts[0]
        write(tmp_path / "folder", "1")
        assert left.exists()  # of a process that still runs
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert left.exists()
    with new_file(tmp_path / "file") as temporary:
        temporary.touch()
    assert names(tmp_path) == ["file", "folder"]


def test_the_current_folder_stays_the_same(tmp_path, monkeypatch):
    """A shell that stands in the folder must find the new files in it."""
    monkeypatch.chdir(tmp_path)
    inode = tmp_path.stat().st_ino
    write(".", "1")
    write(".", "2", overwrite=True)
    assert tmp_path.stat().st_ino == inode
    assert names(tmp_path) == ["2.txt", "run.json"]


HOLD = """
import fcntl, sys, time
fcntl.flock = lambda *_: None  # the locks of another host are not seen
from cgemit.base import files
files.BEAT = 0.1
if sys.argv[2] != "here":
    files._host = lambda: "0123abcd"
with files.new_folder(sys.argv[1]) as place:
    (place / "mine").write_text("mine")
    print(place, flush=True)
    sys.stdin.readline()
"""


@pytest.mark.parametrize("host", ["here", "there"])
def test_runs_in_one_folder_leave_each_other_alone_without_locks(host, tmp_path, monkeypatch):
    """Of this host, processes that are alive are known; of others, those with a heartbeat."""
    monkeypatch.setattr("fcntl.flock", lambda *_: None)
    monkeypatch.setattr(files, "SILENCE", 1.5)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path / "A", host], **pipes) as process:
        left = Path(process.stdout.readline().strip())
        for _ in range(10):
            write(tmp_path / "B", "1", overwrite=True)
            assert (left / "mine").exists()
            time.sleep(0.25)
        process.communicate("end")
        assert process.returncode == 0
    assert names(tmp_path) == ["A", "B"]
    assert names(tmp_path / "A") == ["mine"]
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path / "C", host], **pipes) as process:
        left = Path(process.stdout.readline().strip())
        process.kill()
        process.wait()
    write(tmp_path / "B", "2", overwrite=True)
    assert left.exists() == (host == "there")  # its heartbeat was a moment ago
    time.sleep(2)
    write(tmp_path / "B", "3", overwrite=True)
    assert names(tmp_path) == ["A", "B"]


def test_folders_that_only_look_temporary_stay(tmp_path):
    for name in (".cgemit-mine.tmp", ".cgemit-12345678.tmp"):
        (tmp_path / name).mkdir()
    with new_file(tmp_path / "file") as temporary:
        temporary.touch()
    assert names(tmp_path) == [".cgemit-12345678.tmp", ".cgemit-mine.tmp", "file"]


def test_a_process_number_that_another_process_has_now_is_no_owner(tmp_path):
    number, start = os.getpid(), files._started(os.getpid())
    assert files._started(2**22 + 1) == -1
    alive, reused, gone = (
        tmp_path / f".cgemit-{files._host()}-{who}-{when}-00000000.tmp"
        for who, when in ((number, start), (number, start + 1), (2**22 + 1, start))
    )
    for folder in (alive, reused, gone):
        folder.mkdir()
    files.remove_left(tmp_path)
    assert list(tmp_path.iterdir()) == [alive] if start else [alive, reused]


def test_of_two_hosts_without_common_locks_one_gets_the_folder(tmp_path, monkeypatch):
    """Both found the place free; the file system decides."""
    monkeypatch.setattr("fcntl.flock", lambda *_: None)
    checked = files.check_free

    def late(path, **how):
        target = checked(path, **how)
        monkeypatch.setattr(files, "check_free", checked)
        write(path, "other")
        return target

    with (  # noqa: PT012
        pytest.raises(OutputExistsError, match="already holds files"),
        new_folder(tmp_path / "out") as place,
    ):
        (place / "run.json").write_text("mine")
        monkeypatch.setattr(files, "check_free", late)
    assert names(tmp_path / "out") == ["other.txt", "run.json"]


@pytest.mark.parametrize("length", [200, 230, 255])
def test_names_as_long_as_the_file_system_has_them(length, tmp_path):
    write(tmp_path / ("x" * length), "1")
    write(tmp_path / ("x" * length), "2", overwrite=True)
    assert names(tmp_path / ("x" * length)) == ["2.txt", "run.json"]
    with new_file(tmp_path / ("y" * length)) as temporary:
        temporary.touch()
    assert names(tmp_path) == ["x" * length, "y" * length]


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


@pytest.fixture
def table_file(tmp_path):
    path = tmp_path / "particles.npz"
    generate(Gun("mu-", p=1, theta=1), 20, seed=1).save(path)
    return path


@pytest.fixture
def map_file(tmp_path):
    r = z = np.linspace(0, 100, 5)
    return write_field_map(tmp_path / "map.npz", {"r": r, "z": z, "br": np.zeros((5, 5)), "bz": np.ones((5, 5))})


@pytest.mark.slow
def test_a_damaged_file_is_bad_input_wherever_the_damage_is(table_file, map_file):
    """Every byte of the directory and the headers, and many others, changed in several ways."""
    random = np.random.default_rng(1)
    for path, read, error in ((table_file, Table.load, ValueError), (map_file, read_field_map, DetectorError)):
        whole = path.read_bytes()
        same = refused = 0
        places = [*range(200), *range(len(whole) - 400, len(whole)), *random.integers(0, len(whole), 300)]
        for place in places:
            damaged = bytearray(whole)
            damaged[place] ^= int(random.integers(1, 256))
            path.write_bytes(damaged)
            try:
                read(path)
                same += 1
            except error:
                refused += 1
        for end in random.integers(0, len(whole), 40):
            path.write_bytes(whole[:end])
            with pytest.raises(error):
                read(path)
        assert refused > same


def npz(path, header, data, *, compressed):
    """Write an archive with one array of any header."""
    method = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, header)
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("x.npy", stream.getvalue() + data)
    return path


def test_sizes_are_checked_before_memory_is_asked_for(tmp_path):
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    with pytest.raises(ValueError, match="in 208 bytes"):
        read_npz(npz(tmp_path / "large.npz", header, b"0" * 80, compressed=False))
    bomb = npz(tmp_path / "bomb.npz", header | {"shape": (25_000_000,)}, bytes(200_000_000), compressed=True)
    assert bomb.stat().st_size < 1_000_000
    with pytest.raises(ValueError, match="that unpack to 2000001"):
        read_npz(bomb)
    good = npz(tmp_path / "good.npz", header | {"shape": (2,)}, bytes(16), compressed=True)
    np.testing.assert_array_equal(read_npz(good)["x"], [0.0, 0.0])
    np.savez(tmp_path / "object.npz", x=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="object"):
        read_npz(tmp_path / "object.npz")


def test_the_number_of_events_must_be_that_of_the_offsets(table_file, tmp_path):
    with np.load(table_file) as stored:
        arrays = {name: stored[name] for name in stored.files}
    about = json.loads(str(arrays.pop("__meta__"))) | {"n_events": 10**12}
    np.savez(tmp_path / "other.npz", __meta__=json.dumps(about), **arrays)
    with pytest.raises(ValueError, match=r"1000000000000 events, but 21 offsets"):
        Table.load(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="n_events: is 1000000000000, expected 0 to"):
        Table.empty("truths", 10**12)


def read_plans(path):
    for read in (read_plan, read_optimize_plan):
        read(path)


READERS = {
    Table.load: ValueError,
    read_plans: PlanError,
    read_field_map: DetectorError,
    FitSettings.load: SettingsError,
    load: DetectorError,
}


@pytest.mark.parametrize(("read", "error"), READERS.items())
@pytest.mark.parametrize("suffix", [".npz", ".csv", ".toml", ".json", ".parquet", ".root", ".tcl"])
def test_pipes_are_refused_at_once(read, error, suffix, tmp_path):
    path = tmp_path / f"pipe{suffix}"
    os.mkfifo(path)
    with pytest.raises(error):
        read(path)


@pytest.mark.parametrize("text", ["[" * 100_000, "x = " + "[" * 100_000, '{"a":' * 100_000, "a." * 50_000 + "a = 1"])
def test_nesting_without_end(text, tmp_path):
    for name, read in (
        ("x.toml", load),
        ("x.toml", FitSettings.load),
        ("x.json", FitSettings.load),
        ("x.toml", read_plans),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(READERS[read]):
            read(tmp_path / name)


def test_texts_have_a_largest_size(tmp_path):
    path = tmp_path / "large.toml"
    path.write_text("#" * 10_000_001)
    with pytest.raises(DetectorError, match="10000001 bytes, expected at most 10000000"):
        load(path)
    with pytest.raises(SettingsError, match="10000001 bytes"):
        FitSettings.load(path)


def test_json_is_read_like_other_texts(tmp_path):
    path = tmp_path / "x.json"
    path.write_text("[" * 100_000)
    with pytest.raises(ValueError, match="too many levels of nesting"):
        read_json(path)
    path.write_text('{"a": [1]}')
    assert read_json(path) == {"a": [1]}
    with pytest.raises(ValueError, match="10 bytes, expected at most 9"):
        read_json(path, 9)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(ValueError, match="a pipe or a device"):
        read_json(path)


LONG = ".".join(["a"] * 1900)
#: s of the processor: a tenth is used by a reader whose time grows with the text, hours if with its square.
ENOUGH = 60.0


@pytest.mark.parametrize(
    "text",
    [
        "".join(f"[{LONG}.b{i}]\nx = 1\n" for i in range(250)),
        "".join(f"{LONG}.b{i} = 1\n" for i in range(250)),
        "".join(f"b{i} = {{ {LONG} = 1 }}\n" for i in range(250)),
        "".join(f'"b{i}" . {" . ".join(["c"] * 900)} = 1\n' for i in range(250)),
        ".".join(["a"] * 100) + " = 1",
        "x = " + "[" * 60 + "]" * 60,
        "x = " + "{ a = " * 60 + "1" + " }" * 60,
    ],
)
def test_keys_without_end_take_no_time(text):
    """The time to read a key grows with the square of its parts: 250 lines of them would take minutes."""
    begin = time.process_time()
    with pytest.raises(ValueError, match=r"dots in a key|levels of nesting"):
        parse_toml(text)
    assert time.process_time() - begin < 5


def test_usual_keys_comments_and_values_are_read():
    text = "# " + "." * 200 + "\na.b.c.d.e.f = [" + "1.5, " * 500 + "]\n"
    assert parse_toml(text)["a"]["b"]["c"]["d"]["e"]["f"] == [1.5] * 500


@pytest.mark.parametrize(
    "text",
    [
        "set DetectorGeometry {\n" * 400_000,
        "set" + " " * 9_000_000,
        "\n" * 9_000_000,
        "set DetectorGeometry { }\nset B " + "1" * 9_000_000 + "x",
    ],
)
def test_cards_without_end_take_no_time(text, tmp_path):
    path = tmp_path / "card.tcl"
    path.write_text(text)
    begin = time.process_time()
    with pytest.raises(DetectorError):
        load(path)
    assert time.process_time() - begin < ENOUGH


def test_long_quantities_take_no_time():
    begin = time.process_time()
    with pytest.raises(QuantityError):
        parse_quantity("1" + " " * 3900 + "a\nb", "length")
    assert time.process_time() - begin < ENOUGH
