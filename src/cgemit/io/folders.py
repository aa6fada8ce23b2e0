"""Output folders that are either complete or absent."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: The summary of a run's results.
SUMMARY = "summary.json"
# Files that say what a folder holds: they are moved in last, so a folder that has them is complete.
_INDEXES = (SUMMARY, "tables.json")


class OutputExistsError(FileExistsError, ValueError):
    """An output folder that already holds files, given without leave to overwrite them."""


@contextmanager
def new_folder(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary folder beside `path` whose files come to `path` when the block ends well.

    If the block raises (Ctrl-C too), the temporary folder is removed and `path` is as it was. A folder that did not
    exist appears at once, by renaming. In an existing one, files of the same name are replaced and others are left
    alone; `summary.json` and `tables.json` are removed first and the new ones come last.

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
    """Raise `OutputExistsError` if results cannot be written to `path`."""
    target = Path(path)
    if target.exists() and not target.is_dir():
        raise OutputExistsError(f"{target} is a file; expected a folder to write results to")
    if target.is_dir() and not overwrite and any(target.iterdir()):
        raise OutputExistsError(
            f"{target} already holds files; choose another folder or say --overwrite (in Python: overwrite=True)"
        )


def _publish(temporary: Path, target: Path) -> None:
    if not target.exists():
        temporary.rename(target)
        return
    for name in _INDEXES:
        (target / name).unlink(missing_ok=True)
    for source in sorted(temporary.rglob("*"), key=lambda file: file.name in _INDEXES):
        if source.is_file():
            place = target / source.relative_to(temporary)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(source, place)
