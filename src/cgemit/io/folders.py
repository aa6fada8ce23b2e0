"""Output folders that are either complete or absent."""

from __future__ import annotations

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

    If the block raises (Ctrl-C too), the temporary folder is removed and `path` is as it was. A folder that did not
    exist appears at once, by renaming. In an existing one, files of the same name are replaced and others are left
    alone; `summary.json`, `run.json` and `tables.json`, with the tables it lists, are removed first, and the new ones
    come last.

    Raises
    ------
    OutputExistsError
        If `path` is a file, or a folder that is not empty and `overwrite` is false; asked before the block runs.
    """
    target = Path(path).resolve()
    check_free(target, overwrite=overwrite)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}-{secrets.token_hex(4)}.tmp")
    temporary.mkdir()
    try:
        yield temporary
        _publish(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_free(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Raise an error if results cannot be written to `path`, so that nobody waits for results that get lost.

    Raises
    ------
    OutputExistsError
        If `path` or a folder above it is a file, or `path` is not empty and `overwrite` is false.
    ValueError
        If nothing can be written there.
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_dir():
        raise OutputExistsError(f"{target} is a file; expected a folder to write results to")
    if target.is_dir() and not overwrite and any(target.iterdir()):
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


def _publish(temporary: Path, target: Path) -> None:
    if not target.exists():
        temporary.rename(target)
        return
    for name in (*_tables_in(target), *_INDEXES):
        (target / name).unlink(missing_ok=True)
    for source in sorted(temporary.rglob("*"), key=lambda file: file.name in _INDEXES):
        if source.is_file():
            place = target / source.relative_to(temporary)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(source, place)


def _tables_in(folder: Path) -> list[str]:
    """Return the files of the tables that an earlier run wrote: beside newer ones they would be taken for their own."""
    try:
        names = json.loads((folder / "tables.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return [f"{name}.npz" for name in names if re.fullmatch(r"\w+", name)] if isinstance(names, dict) else []
