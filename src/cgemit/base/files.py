"""Files and folders that are complete or absent, TOML text, and optional packages."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import functools
import hashlib
import importlib
import json
import math
import os
import re
import secrets
import shutil
import socket
import stat
import tempfile
import threading
import tomllib
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np


class MissingPackageError(ImportError, ValueError):
    """What was asked for needs a package that is not installed."""


def package(name: str, extra: str = "io") -> Any:
    """Return a module of another package.

    Parameters
    ----------
    name : str
        Module, such as ``"pyarrow.parquet"``.
    extra : str
        The extra of cgemit that installs the package.

    Raises
    ------
    MissingPackageError
        An ImportError and ValueError that names the extra, if the package is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        needed = name.partition(".")[0]
        raise MissingPackageError(f"this needs {needed}: pip install 'cgemit[{extra}]'") from error


@contextmanager
def new_file(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary path that becomes `path` when the block ends well.

    If the block raises (Ctrl-C too), nothing is left behind, so that no half-written file can look complete. A link
    stays; the file that it leads to is written.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist: a misspelt path must not become a folder.
    FileExistsError
        If `path` exists and `overwrite` is false; asked before the block runs, and again at its end. With `overwrite`,
        if it is no file, or one of a folder's results (`new_folder`) that was changed since it was written.
    """
    target = Path(path)
    target = target.resolve() if target.is_symlink() else target
    _refuse_existing(target, overwrite)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target}: there is no folder {target.parent}")
    with _temporary(target.parent) as folder:
        written = folder / Path(path).name  # with its suffix, by which writers such as matplotlib choose the format
        yield written
        recorded = _refuse_existing(target, overwrite)
        if recorded:
            _note(target.parent, {target.name: _checksum(written)})
        written.replace(target)


def _refuse_existing(target: Path, overwrite: bool) -> bool:
    """Raise an error if a file must not be replaced; return whether it is one of the results of its folder."""
    if not os.path.lexists(target):
        return False
    if not overwrite:
        raise FileExistsError(f"{target} exists; pass overwrite=True to replace it")
    if not target.is_file():
        raise FileExistsError(f"{target} is {'a folder' if target.is_dir() else 'a pipe or a device'}, no file")
    known = Record.of(target.parent).files.get(target.name)
    if known is not None and _checksum(target) not in known:
        raise OutputExistsError(f"{target} {_CHANGED}; expected a file as it was written")
    return known is not None


#: Seconds between two heartbeats of a temporary folder, and without one after which those of other hosts are removed.
BEAT, SILENCE = 60.0, 86_400.0
#: Name of the threads of heartbeats.
HEARTBEAT = "cgemit heartbeat"
_TEMPORARY = re.compile(r"\.cgemit-([0-9a-f]{8})-(\d+)-(\d+)-[0-9a-f]{8}\.tmp")


@contextmanager
def _temporary(parent: Path) -> Iterator[Path]:
    """Give a folder in `parent` that is removed at the end; remove those that killed runs left.

    Its name holds the host, the process and the start of the process, its time of modification is a heartbeat: locks
    may be local to a host, so that they do not show whether a run on another host is alive.
    """
    folder = parent / f".cgemit-{_host()}-{os.getpid()}-{_started(os.getpid())}-{secrets.token_hex(4)}.tmp"
    ended = threading.Event()
    try:
        folder.mkdir()
        remove_left(parent, now=folder.stat().st_mtime)
        _temporaries.add(folder)
        threading.Thread(target=_beat, args=(folder, ended), name=HEARTBEAT, daemon=True).start()
        yield folder
    finally:
        ended.set()
        shutil.rmtree(folder, ignore_errors=True)
        _temporaries.discard(folder)


_temporaries: set[Path] = set()


def remove_temporaries() -> None:
    """Remove the temporary folders of this process, which is about to end."""
    for folder in list(_temporaries):  # of the process that this one was copied from, too
        if folder.name.split("-")[2] == str(os.getpid()):
            shutil.rmtree(folder, ignore_errors=True)


def _beat(folder: Path, ended: threading.Event) -> None:
    """Renew the time of a folder until the event."""
    while not ended.wait(BEAT):
        with contextlib.suppress(OSError):
            os.utime(folder)  # by the clock of the file system, where that is another one


def remove_left(parent: Path, now: float | None = None) -> None:
    """Remove the temporary folders in a folder that runs left when they were killed.

    Those of this host are left if their process has ended, those of other hosts after a day without a heartbeat, by
    the file system's time `now`.
    """
    for folder in parent.glob(".cgemit-*.tmp"):
        with contextlib.suppress(OSError):  # removed by another run
            if folder.is_symlink() or (match := _TEMPORARY.fullmatch(folder.name)) is None:
                continue
            host, process, started = match.groups()
            if host == _host():
                alive = _started(int(process))
                left = alive < 0 or (0 < alive != int(started) > 0)
            else:
                left = now is not None and now - folder.stat().st_mtime > SILENCE
            if left:
                shutil.rmtree(folder, ignore_errors=True)


@functools.cache
def _host() -> str:
    """Return what tells apart hosts, and groups of processes that do not see each other's."""
    known = [socket.gethostname()]
    with contextlib.suppress(OSError):  # where there is no /proc
        known.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"))
        known.append(str(Path("/proc/self/ns/pid").readlink()))
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:8]


def _started(process: int) -> int:
    """Return when a process of this host started, in ticks since the host did; 0 if that is unknown, -1: no process."""
    try:
        text = Path(f"/proc/{process}/stat").read_text(encoding="ascii", errors="replace")
        return int(text.rpartition(")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        pass
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return -1
    except (OSError, OverflowError):  # of another user
        pass
    return 0


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, where the file system has locks."""
    lock = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


#: An archive that unpacks to more than this many times its size, and to more than this many bytes, is no data.
MOST_PACKED, FREE_BYTES = 50, 2**26


def check_unpacked(size: int, total: int) -> None:
    """Raise a ValueError if a file of `size` bytes cannot hold `total` bytes of data."""
    if total > max(FREE_BYTES, MOST_PACKED * size):
        raise ValueError(f"{size} bytes that unpack to {total}")


def read_npz(path: str | os.PathLike[str], names: Collection[str] | None = None) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays of an `.npz` file, or those named; sizes are checked before memory is asked for.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged, or no file of arrays of numbers and text.
    """
    check_regular(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            check_unpacked(Path(path).stat().st_size, sum(one.file_size for one in members))
            chosen = {one.filename.removesuffix(".npy"): one for one in members}
            return {name: _array(archive, one) for name, one in chosen.items() if names is None or name in names}
    except FileNotFoundError:
        raise
    except Exception as error:  # of zipfile, zlib, struct, numpy: a damaged file is bad input, whatever notices it
        raise ValueError(f"not a complete .npz file: {error}") from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray[Any, Any]:
    """Return one array of an archive; its header must agree with the size that the archive states."""
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
        stated = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or min(shape, default=0) < 0 or stated != member.file_size - stream.tell():
            raise ValueError(f"{member.filename} holds {dtype}, {shape}, in {member.file_size} bytes")
    with archive.open(member) as stream:
        found: np.ndarray[Any, Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return found


#: Bytes of the largest text file that is read.
LARGEST_TEXT = 10_000_000


def check_regular(path: str | os.PathLike[str]) -> None:
    """Raise an error for what is no regular file: reading from a pipe or a device may never end.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is something else.
    """
    try:
        mode = Path(path).stat().st_mode
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:  # too long a name, a circle of links, a null byte
        raise ValueError(f"{str(path)[:80]!r} is no file ({getattr(error, 'strerror', None) or error})") from error
    if not stat.S_ISREG(mode):
        raise ValueError(f"{str(path)[:80]!r} is {'a folder' if stat.S_ISDIR(mode) else 'a pipe or a device'}, no file")


def read_text(path: str | os.PathLike[str], largest: int = LARGEST_TEXT) -> str:
    """Return the text of a file in UTF-8, without its byte-order mark.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no file of text, or larger than `largest` bytes.
    """
    check_regular(path)
    size = Path(path).stat().st_size
    if size > largest:
        raise ValueError(f"{str(path)[:80]!r} has {size} bytes, expected at most {largest}")
    return Path(path).read_text(encoding="utf-8-sig")


def read_json(path: str | os.PathLike[str], largest: int = LARGEST_TEXT) -> Any:
    """Return what a file of JSON holds.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no JSON, too deeply nested, or larger than `largest` bytes.
    """
    text = read_text(path, largest)
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("too many levels of nesting") from None


#: The summary of a run's results.
SUMMARY = "summary.json"
#: Everything that results depend on.
RECORD = "run.json"
#: The record of a folder: what cgemit wrote there.
CONTENTS = ".cgemit"
# Files that say what a folder holds: they are moved in last, so a folder that has them is complete.
_INDEXES = (SUMMARY, RECORD, "tables.json")
# Files that a study adds while it goes on. They hold their own checksums, so their names are enough for the record.
_STORED = re.compile(r"chunks/[0-9a-f]{32}\.json|journals/[0-9a-f]{16}\.log")
_LARGEST_RECORD = 1_000_000_000  # bytes; a line for each chunk of a sweep
_CHANGED, _FOREIGN = "was changed after cgemit wrote it", "is not of the results that cgemit wrote there"


class OutputExistsError(FileExistsError, ValueError):
    """An output folder that already holds files, given without leave to overwrite them."""


@dataclass(frozen=True)
class Record:
    """What cgemit wrote to a folder: only that is replaced.

    Attributes
    ----------
    work : str
        The study that goes on in the folder, such as ``"sweep"``; empty for results that are written at once.
    plan : list of str
        Names of the parts of this study.
    files : dict of str to list of str
        SHA-256 of each file, by its name relative to the folder. A file that is being replaced has two.
    """

    work: str = ""
    plan: list[str] = field(default_factory=list)
    files: dict[str, list[str]] = field(default_factory=dict)

    @staticmethod
    def of(folder: Path) -> Record:
        """Return the record of a folder; an empty one where there is none, or a damaged one."""
        try:
            found = read_json(folder / CONTENTS, _LARGEST_RECORD)
            record = Record(**found)
            good = isinstance(record.work, str) and isinstance(record.plan, list) and isinstance(record.files, dict)
            good = good and all(isinstance(one, list) for one in record.files.values())
            return record if good and all(isinstance(one, str) for one in record.plan) else Record()
        except (OSError, ValueError, TypeError):
            return Record()

    def write(self, folder: Path) -> None:
        """Write the record of a folder, complete at all times."""
        with _temporary(folder) as temporary:
            (temporary / CONTENTS).write_text(json.dumps(asdict(self), indent=0) + "\n", encoding="utf-8")
            (temporary / CONTENTS).replace(folder / CONTENTS)

    def problem(self, folder: Path, name: str) -> str:
        """Return why something in the folder must not be replaced; an empty text if it may, or is not there."""
        path = folder / name
        if not os.path.lexists(path):
            return ""
        if name not in self.files or path.is_symlink() or not path.is_file():
            return "" if self.work and _STORED.fullmatch(name) and not path.is_dir() else f"{name!r}, which {_FOREIGN}"
        return "" if _checksum(path) in self.files[name] else f"{name!r}, which {_CHANGED}"

    def among(self, folder: Path, names: Iterable[str]) -> Iterator[str]:
        """Yield why files of these names must not be replaced."""
        return filter(None, (self.problem(folder, name) for name in names))

    def problems(self, folder: Path) -> Iterator[str]:
        """Yield why the folder must not be replaced: all that is not as cgemit wrote it."""
        inner = {parent.as_posix() for name in self.files for parent in PurePosixPath(name).parents}
        inner |= {"chunks", "journals"} if self.work else set()

        def within(place: Path) -> Iterator[str]:
            for path in sorted(place.iterdir()):
                name = path.relative_to(folder).as_posix()
                if path.is_dir() and not path.is_symlink():
                    if _TEMPORARY.fullmatch(path.name):
                        continue
                    if name in inner and name not in self.files:
                        yield from within(path)
                        continue
                if name != CONTENTS and (problem := self.problem(folder, name)):
                    yield problem

        return within(folder)


def _checksum(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _note(folder: Path, files: Mapping[str, str]) -> None:
    """Add checksums of files to the record of a folder, before they replace others: a run may be killed in between."""
    with _locked(folder):
        record = Record.of(folder)
        new = {name: sorted({*record.files.get(name, ()), checksum}) for name, checksum in files.items()}
        if any(record.files.get(name) != known for name, known in new.items()):
            replace(record, files=record.files | new).write(folder)


@contextmanager
def new_folder(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary folder beside `path` whose files come to `path` when the block ends well.

    If the block raises (Ctrl-C too), the temporary folder is removed and `path` is as it was. A new folder appears at
    once, by renaming. A folder that is there stays the same folder: its old results are removed, and the new ones are
    moved into it. Files such as ``run.json`` are removed first and come last, so that a folder that has them is
    complete. Of two runs into the same place, one gets an error, or with `overwrite` the last one replaces the other.
    The record `CONTENTS` holds names and checksums of the files.

    Raises
    ------
    OutputExistsError
        As `check_free`, before the block runs and again at its end.
    ValueError
        If nothing can be written there.
    """
    target = check_free(path, overwrite=overwrite)
    target.parent.mkdir(parents=True, exist_ok=True)
    with _temporary(target.parent) as folder:
        yield folder
        with _locked(target.parent):
            _publish(folder, target, overwrite=overwrite)


def check_free(path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Return the path without links; raise an error if results cannot be written there, before anybody waits for them.

    Raises
    ------
    OutputExistsError
        If `path` or a folder above it is a file, or if `path` is not empty and `overwrite` is false. With `overwrite`,
        if it holds anything that cgemit did not write there, or that was changed since.
    ValueError
        If nothing can be written there.
    """
    target = _folder_of(path)
    if target.exists() and not overwrite and not _is_empty(target):
        raise OutputExistsError(_held(target))
    if target.exists():
        _refuse_others(target)
    return target


def _held(target: Path, what: str = "files") -> str:
    return f"{target} already holds {what}; choose another folder or say --overwrite (in Python: overwrite=True)"


def _folder_of(path: str | os.PathLike[str]) -> Path:
    """Return the path of a folder without links; raise an error if it cannot be one, or cannot be written to."""
    try:
        target = Path(path).resolve()
        exists = target.exists()
    except (OSError, RuntimeError, ValueError) as error:  # too long a name, a circle of links, a null byte
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{str(path)[:80]!r} is no folder to write to ({reason})") from error
    if exists and not target.is_dir():
        raise OutputExistsError(f"{target} is a file; expected a folder to write results to")
    above = next(folder for folder in target.parents if folder.exists())
    if not above.is_dir():
        raise OutputExistsError(f"{target} cannot be made: {above} is a file; expected a folder")
    try:  # permissions do not tell everything: the file system decides
        tempfile.TemporaryFile(dir=above).close()  # without a name on Linux: nothing stays if the run is killed
    except OSError as error:
        raise ValueError(f"{target}: nothing can be written in {above} ({error.strerror})") from error
    return target


def _is_empty(folder: Path) -> bool:
    return all(_TEMPORARY.fullmatch(path.name) for path in folder.iterdir())


def _refuse_others(folder: Path) -> None:
    """Raise an error if a folder holds anything but what cgemit wrote there."""
    _refuse(folder, lambda record: record.problems(folder), "a folder with nothing else to overwrite")


def _refuse(folder: Path, problems: Callable[[Record], Iterable[str]], expected: str) -> None:
    """Raise an error if there are problems with what a folder holds, given its record."""
    while True:
        record = Record.of(folder)
        with contextlib.suppress(FileNotFoundError):  # of what another run removes
            problems_found = list(problems(record))
            if not problems_found:
                return
            if Record.of(folder) == record:  # else another run wrote its results meanwhile
                raise OutputExistsError(f"{_list(folder, problems_found)}; expected {expected}")


def _list(folder: Path, problems: Collection[str]) -> str:
    more = f", and {len(problems) - 5} more" if len(problems) > 5 else ""
    return f"{folder} holds {', '.join(list(problems)[:5])}{more}"


def _publish(temporary: Path, target: Path, *, overwrite: bool) -> None:
    """Rename the temporary folder, or move what it holds into the target in place of older results."""
    is_new = not target.exists()
    check_free(target, overwrite=overwrite)
    inner = (path for path in temporary.rglob("*") if path.is_file() and path != temporary / CONTENTS)
    files = {path.relative_to(temporary).as_posix(): [_checksum(path)] for path in inner}
    (temporary / CONTENTS).write_text(json.dumps(asdict(Record(files=files)), indent=0) + "\n", encoding="utf-8")
    if is_new:
        try:
            temporary.rename(target)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise
            raise OutputExistsError(_held(target)) from error  # of a run on another host, whose locks are not seen
        return
    # The record is there at all times, so that a folder in which a run was killed can be overwritten.
    _clear(target, {CONTENTS})
    for new in sorted(temporary.iterdir(), key=lambda path: (path.name != CONTENTS, path.name in _INDEXES)):
        shutil.move(new, target / new.name)  # the target may be a mount point


def _clear(folder: Path, keep: Collection[str]) -> None:
    """Remove all that a folder holds but temporary folders, and the files in it and its folders that are named."""
    for old in sorted(folder.iterdir(), key=lambda path: path.name not in _INDEXES):
        if not old.is_dir() or old.is_symlink():
            if old.name not in keep:
                old.unlink()
        elif not _TEMPORARY.fullmatch(old.name):
            _clear(old, set(keep) - {CONTENTS})
            with contextlib.suppress(OSError):  # it holds what is kept
                old.rmdir()


def keep_folder(
    path: str | os.PathLike[str], work: str, plan: Iterable[str], *, overwrite: bool = False, kept: Collection[str] = ()
) -> Path:
    """Return the folder of a study that adds files while it goes on, and is continued by later calls.

    A folder that is empty, or missing, is taken. One with the same work is continued if its plan has no parts but those
    of `plan`: nothing that was computed is then lost.

    Parameters
    ----------
    path : path
    work : str
        As "sweep".
    plan : iterable of str
        Names of all parts.
    overwrite : bool
        Remove all that the folder holds, if cgemit wrote it.
    kept : collection of str
        Names of files in folders of the folder that stay then, as those of parts that other jobs compute.

    Raises
    ------
    OutputExistsError
        If the folder holds something else and `overwrite` is false, or a file that was changed since. With `overwrite`,
        if it holds anything that cgemit did not write, or that was changed since.
    ValueError
        If nothing can be written there.
    """
    target, parts = _folder_of(path), list(plan)
    target.mkdir(parents=True, exist_ok=True)
    with _locked(target):
        record = Record.of(target)
        if overwrite:
            _refuse_others(target)
            _clear(target, {CONTENTS, *kept})
            record = Record()
        elif not _is_empty(target):
            if record.work != work:
                raise OutputExistsError(_held(target))
            if not set(record.plan) <= set(parts):
                raise OutputExistsError(_held(target, f"results of another plan of this {work}, or of another version"))
            _refuse(target, lambda record: record.among(target, record.files), "files as they were written")
        if (record.work, record.plan) != (work, parts):
            replace(record, work=work, plan=parts).write(target)
    return target


@contextmanager
def add_files(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary folder whose files come to `folder`, beside what that holds, when the block ends well.

    A file is replaced only if cgemit wrote it and nobody has changed it since.

    Raises
    ------
    OutputExistsError
        If there is another file in the place of one; then none is written.
    """
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    with _temporary(target) as temporary:
        yield temporary
        new = {path.relative_to(temporary).as_posix(): path for path in sorted(temporary.rglob("*")) if path.is_file()}
        _refuse(target, lambda record: record.among(target, new), "nothing there, or a file as it was written")
        _note(target, {name: _checksum(path) for name, path in new.items()})
        for name in new.keys() & set(_INDEXES):  # without it the folder is incomplete
            (target / name).unlink(missing_ok=True)
        for name, path in sorted(new.items(), key=lambda one: one[0] in _INDEXES):
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            path.replace(target / name)


_LARGEST, _LONGEST_LINE = 1_000_000, 4_000  # characters
# Parts of a dotted key, and levels of tables and arrays: the time to read a key grows with the square of its parts, and
# what walks through the tables does so level by level.
_DEEPEST = 40
_PIECES = re.compile(r"[=,{}\[\]#]")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises
    ------
    ValueError
        If it is no TOML, or too large or too deeply nested to be read.
    """
    lines = text.splitlines()
    if len(text) > _LARGEST or max(map(len, lines), default=0) > _LONGEST_LINE:
        raise ValueError(f"more than {_LARGEST} characters, or more than {_LONGEST_LINE} in a line")
    for line_number, line in enumerate(lines, start=1):
        pieces = [] if line.count(".") <= _DEEPEST or line.lstrip().startswith("#") else _PIECES.split(line)
        if any(piece.count(".") > _DEEPEST for piece in pieces):
            raise ValueError(f"line {line_number} has more than {_DEEPEST} dots in a key or a value")
    try:
        tables = tomllib.loads(text)
    except RecursionError:
        raise ValueError("too many levels of nesting") from None
    level: list[Any] = [tables]
    for _ in range(_DEEPEST):
        inner = (one.values() if isinstance(one, dict) else one for one in level)
        level = [value for values in inner for value in values if isinstance(value, dict | list)]
        if not level:
            return tables
    raise ValueError(f"more than {_DEEPEST} levels of nesting")


def toml_text(
    tables: Mapping[str, Any],
    *,
    in_place: Collection[str] = (),
    comment: Callable[[str], str] | None = None,
) -> str:
    """Return nested tables as the text of a TOML file.

    Parameters
    ----------
    tables : mapping
        Of str to bool, int, float, str, lists and mappings of these. TOML has no null.
    in_place : collection of str
        Names of tables that are written as ``name = { ... }`` instead of ``[name]``.
    comment : callable or None
        Returns what is written behind a value as a comment, given its dotted path; an empty text for nothing.

    Returns
    -------
    str
        Floats with all digits.
    """
    lines: list[str] = []
    _write_table(lines, "", tables, in_place, comment or (lambda _: ""))
    return "\n".join(lines).strip() + "\n"


def _write_table(
    lines: list[str], path: str, table: Mapping[str, Any], in_place: Collection[str], comment: Callable[[str], str]
) -> None:
    """Append a table: first its values, then its tables."""
    inner = {name: v for name, v in table.items() if isinstance(v, Mapping) and name not in in_place}
    values = {name: v for name, v in table.items() if name not in inner}
    if path and (values or not inner):
        lines += ["", f"[{path}]"]
    before = f"{path}." if path else ""
    for name, value in values.items():
        about = comment(before + name)
        lines.append(f"{_name(name)} = {_text(value)}" + (f"  # {about}" if about else ""))
    for name, sub in inner.items():
        _write_table(lines, before + _name(name), sub, in_place, comment)


def _name(name: str) -> str:
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isascii() and bare.isalnum() else _quoted(name)


def _text(value: Any) -> str:
    if isinstance(value, list) and any(isinstance(row, Mapping) for row in value):
        rows = "".join(f"\n    {_text(row)}," for row in value)
        return f"[{rows}\n]"
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_name(name)} = {_text(v)}" for name, v in value.items()) + " }"
    if isinstance(value, bool):
        return str(value).lower()
    return _quoted(value) if isinstance(value, str) else repr(value)


def _quoted(text: str) -> str:
    # JSON strings are TOML strings except for DEL, which TOML wants escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def nested(path: str, value: object) -> dict[str, Any]:
    """Return tables that hold one value at a dotted path."""
    *parents, last = path.split(".")
    tables: dict[str, Any] = {last: value}
    for name in reversed(parents):
        tables = {name: tables}
    return tables


def flat(path: str, value: object) -> Iterator[tuple[str, object]]:
    """Yield the dotted path and the value of everything in nested tables."""
    if not isinstance(value, Mapping):
        yield path, value
        return
    for name, inner in value.items():
        yield from flat(f"{path}.{name}" if path else str(name), inner)


def is_number(text: str) -> bool:
    """Return whether a cell of a text table is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
