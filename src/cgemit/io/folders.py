"""Output folders that are either complete or absent."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: The summary of a run's results.
SUMMARY = "summary.json"
#: Everything that results depend on.
RECORD = "run.json"
# Files that say what a folder holds: they are moved in last, so a folder that has them is complete.
_INDEXES = (SUMMARY, RECORD, "tables.json")


class OutputExistsError(FileExistsError, ValueError):
    """An output folder that already holds files, given without leave to overwrite them."""


@contextmanager
def new_folder(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary folder beside `path` whose files come to `path` when the block ends well.

    If the block raises (Ctrl-C too), the temporary folder is removed and `path` is as it was; folders that killed
    runs left beside `path` are removed, too. The new folder appears at once, by renaming. With `overwrite`, it takes
    the files of the old one that are not replaced, except `summary.json`, `run.json` and `tables.json`, with the
    tables it lists. Of two runs into the same place, one gets an error, or with `overwrite` the last one replaces the
    other as a whole.

    Raises
    ------
    OutputExistsError
        If `path` is a file, or a folder that is not empty and `overwrite` is false; asked before the block runs, and
        again at its end.
    """
    target = check_free(path, overwrite=overwrite)
    target.parent.mkdir(parents=True, exist_ok=True)
    _remove_left(target)
    temporary, lock = _locked(target)
    try:
        yield temporary
        with _alone(target.parent):
            _publish(temporary, target, overwrite=overwrite)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        os.close(lock)


def check_free(path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Return the path without links; raise an error if results cannot be written there, before anybody waits for them.

    Raises
    ------
    OutputExistsError
        If `path` or a folder above it is a file, or `path` is not empty and `overwrite` is false.
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
    above = next(folder for folder in target.parents if folder.exists())
    if not above.is_dir():
        raise OutputExistsError(f"{target} cannot be made: {above} is a file; expected a folder")
    try:  # permissions do not tell everything: the file system decides
        tempfile.TemporaryDirectory(prefix=".cgemit-", dir=above).cleanup()
    except OSError as error:
        raise ValueError(f"{target}: nothing can be written in {above} ({error.strerror})") from error
    return target


def _locked(target: Path) -> tuple[Path, int]:
    """Make a temporary folder beside the target; return it with its lock, which ends with this process."""
    while True:
        temporary = target.with_name(f".{target.name}-{secrets.token_hex(4)}.tmp")
        temporary.mkdir()
        # Before it is locked another run may take it for an abandoned one, and remove it.
        with contextlib.suppress(FileNotFoundError):
            lock = os.open(temporary, os.O_RDONLY)
            fcntl.flock(lock, fcntl.LOCK_EX)
            if temporary.exists():
                return temporary, lock
            os.close(lock)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep other runs from putting results into a folder in the meantime."""
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def _remove_left(target: Path) -> None:
    """Remove the temporary folders of the target that no running process has locked."""
    name = re.compile(rf"\.{re.escape(target.name)}-[0-9a-f]{{8}}\.tmp")
    for folder in target.parent.iterdir():
        if not name.fullmatch(folder.name) or folder.is_symlink() or not folder.is_dir():
            continue
        with contextlib.suppress(OSError):  # locked, or removed by another run
            lock = os.open(folder, os.O_RDONLY)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)


def _publish(temporary: Path, target: Path, *, overwrite: bool) -> None:
    """Put the temporary folder in the place of the target."""
    check_free(target, overwrite=overwrite)
    _take_over(temporary, target)
    if target.exists() and _stays_in_use(target):
        _replace_files(temporary, target)
        return
    old = temporary.with_suffix(".old")
    if target.exists():
        target.rename(old)
    try:
        temporary.rename(target)
    except OSError:
        if old.exists():
            old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _stays_in_use(folder: Path) -> bool:
    """Tell whether a folder cannot be replaced by another one: a mount point, or the current folder, or above it."""
    return folder.is_mount() or Path.cwd().resolve().is_relative_to(folder)


def _take_over(temporary: Path, target: Path) -> None:
    """Link the files of the target that stay into the temporary folder."""
    if not target.exists():
        return
    gone = {target / name for name in (*_tables_in(target), *_INDEXES)}
    for source in sorted(target.rglob("*")):
        place = temporary / source.relative_to(target)
        if source in gone or (source.is_dir() and not source.is_symlink()) or place.exists():
            continue
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            place.hardlink_to(source) if not source.is_symlink() else place.symlink_to(source.readlink())
        except OSError:
            shutil.copy2(source, place)


def _replace_files(temporary: Path, target: Path) -> None:
    """Move the files into a folder that stays; the indexes go first and come last."""
    for name in (*_tables_in(target), *_INDEXES):
        (target / name).unlink(missing_ok=True)
    for source in sorted(temporary.rglob("*"), key=lambda file: file.name in _INDEXES):
        if source.is_file() or source.is_symlink():
            place = target / source.relative_to(temporary)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(source, place)


def _tables_in(folder: Path) -> list[str]:
    """Return the files of the tables that an earlier run wrote: beside newer ones they would be taken for their own."""
    try:
        names = json.loads((folder / "tables.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    if not isinstance(names, dict):
        return []
    found = []
    for name, about in names.items():
        suffix = about.get("suffix", ".npz") if isinstance(about, dict) else ".npz"
        if re.fullmatch(r"\w+", name) and re.fullmatch(r"\.\w+", str(suffix)):
            found += [f"{name}{suffix}", *(f"{name}/{path.name}" for path in (folder / name).glob(f"part-*{suffix}"))]
    return found
