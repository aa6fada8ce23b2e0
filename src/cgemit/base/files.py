"""Files and folders that are complete or absent, TOML text, and optional packages."""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import json
import math
import os
import secrets
import shutil
import stat
import tempfile
import tomllib
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
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

    If the block raises (Ctrl-C too), nothing is left behind, so that no half-written file can look complete.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist: a misspelt path must not become a folder.
    FileExistsError
        If `path` exists and `overwrite` is false; asked before the block runs, and again at its end.
    """
    target = Path(path)
    _refuse_existing(target, overwrite)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target}: there is no folder {target.parent}")
    with _temporary(target.parent) as folder:
        yield folder / target.name  # with its suffix, by which writers such as matplotlib choose the format
        _refuse_existing(target, overwrite)
        (folder / target.name).replace(target)


def _refuse_existing(target: Path, overwrite: bool) -> None:
    if target.exists() and not overwrite:
        raise FileExistsError(f"{target} exists; pass overwrite=True to replace it")


@contextmanager
def _temporary(place: Path) -> Iterator[Path]:
    """Give a folder in `place` that is removed at the end, locked until then; remove those that killed runs left."""
    remove_left(place)
    while True:
        folder = place / f".cgemit-{secrets.token_hex(4)}.tmp"
        folder.mkdir()
        with contextlib.suppress(FileNotFoundError):  # before it is locked, another run may take it for abandoned
            lock = os.open(folder, os.O_RDONLY)
            _lock(lock)
            if folder.exists():
                break
            os.close(lock)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def remove_left(place: Path) -> None:
    """Remove the temporary folders in a folder that no running process has locked."""
    for folder in place.glob(".cgemit-*.tmp"):
        with contextlib.suppress(OSError):  # locked, or removed by another run
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)


def _lock(file: int) -> None:
    """Wait for the lock of an open file. Where the file system has no locks, abandoned folders stay."""
    with contextlib.suppress(OSError):
        fcntl.flock(file, fcntl.LOCK_EX)


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


#: The summary of a run's results.
SUMMARY = "summary.json"
#: Everything that results depend on.
RECORD = "run.json"
#: Names of all that cgemit wrote to a folder of results, a line each.
CONTENTS = ".cgemit"
# Files that say what a folder holds: they are moved in last, so a folder that has them is complete.
_INDEXES = (SUMMARY, RECORD, "tables.json")


class OutputExistsError(FileExistsError, ValueError):
    """An output folder that already holds files, given without leave to overwrite them."""


@contextmanager
def new_folder(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary folder beside `path` whose files come to `path` when the block ends well.

    If the block raises (Ctrl-C too), the temporary folder is removed and `path` is as it was. A new folder appears at
    once, by renaming. A folder that is there stays the same folder: its old results are removed, and the new ones are
    moved into it. Files such as ``run.json`` are removed first and come last, so that a folder that has them is
    complete. Of two runs into the same place, one gets an error, or with `overwrite` the last one replaces the other.

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
        lock = os.open(target.parent, os.O_RDONLY)
        try:
            _lock(lock)
            _publish(folder, target, overwrite=overwrite)
        finally:
            os.close(lock)


def check_free(path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Return the path without links; raise an error if results cannot be written there, before anybody waits for them.

    Raises
    ------
    OutputExistsError
        If `path` or a folder above it is a file, or if `path` is not empty and `overwrite` is false. With `overwrite`,
        if it holds anything but what `new_folder` put there.
    ValueError
        If nothing can be written there.
    """
    try:
        target = Path(path).resolve()
        exists = target.exists()
    except (OSError, RuntimeError, ValueError) as error:  # too long a name, a circle of links, a null byte
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{str(path)[:80]!r} is no folder to write to ({reason})") from error
    if exists and not target.is_dir():
        raise OutputExistsError(f"{target} is a file; expected a folder to write results to")
    if exists and not overwrite and any(target.iterdir()):
        raise OutputExistsError(
            f"{target} already holds files; choose another folder or say --overwrite (in Python: overwrite=True)"
        )
    if exists and (other := _not_ours(target)):
        raise OutputExistsError(
            f"{target} holds {other!r}, which is not of the results that cgemit wrote there; expected a folder with "
            "nothing else to overwrite"
        )
    above = next(folder for folder in target.parents if folder.exists())
    if not above.is_dir():
        raise OutputExistsError(f"{target} cannot be made: {above} is a file; expected a folder")
    try:  # permissions do not tell everything: the file system decides
        tempfile.TemporaryFile(dir=above).close()  # without a name on Linux: nothing stays if the run is killed
    except OSError as error:
        raise ValueError(f"{target}: nothing can be written in {above} ({error.strerror})") from error
    return target


def _contents(folder: Path) -> Iterator[str]:
    """Yield the names of all files and folders in a folder, relative to it, but for the list of them."""
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if name != CONTENTS:
            yield name


def _not_ours(folder: Path) -> str:
    """Return the name of something that `new_folder` did not put into a folder, or an empty text."""
    while True:
        ours = _listed(folder)
        with contextlib.suppress(FileNotFoundError):  # of a folder that another run removes
            other = next((name for name in _contents(folder) if name not in ours), "")
            if not other or _listed(folder) == ours:  # else another run wrote its results meanwhile
                return other


def _listed(folder: Path) -> set[str]:
    """Return the names that `new_folder` wrote down in a folder."""
    with contextlib.suppress(OSError, ValueError):
        return set(read_text(folder / CONTENTS).splitlines())
    return set()


def _publish(temporary: Path, target: Path, *, overwrite: bool) -> None:
    """Rename the temporary folder, or move what it holds into the target in place of older results."""
    check_free(target, overwrite=overwrite)
    (temporary / CONTENTS).write_text("\n".join(_contents(temporary)), encoding="utf-8")
    if not target.exists():
        temporary.rename(target)
        return
    # The list is there at all times, so that a folder in which a run was killed can be overwritten.
    for old in sorted(target.iterdir(), key=lambda path: path.name not in _INDEXES):
        if old.is_dir() and not old.is_symlink():
            shutil.rmtree(old)
        elif old.name != CONTENTS:
            old.unlink()
    for new in sorted(temporary.iterdir(), key=lambda path: (path.name != CONTENTS, path.name in _INDEXES)):
        shutil.move(new, target / new.name)  # the target may be a mount point


_LARGEST, _LONGEST_LINE = 1_000_000, 4_000  # characters; the time to read dotted keys grows with their square


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises
    ------
    ValueError
        If it is no TOML, or too large or too deeply nested to be read.
    """
    if len(text) > _LARGEST or max(map(len, text.splitlines()), default=0) > _LONGEST_LINE:
        raise ValueError(f"more than {_LARGEST} characters, or more than {_LONGEST_LINE} in a line")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("too many levels of nesting") from None


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
