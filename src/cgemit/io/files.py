"""Files that are either complete or absent, among them `.npz` files with named arrays and one JSON text."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np


@contextmanager
def new_file(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary path in the folder of `path` that becomes `path` when the block ends well.

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
    # The suffix stays, since writers such as matplotlib choose the format by it.
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(4)}.tmp{target.suffix}")
    try:
        yield temporary
        _refuse_existing(target, overwrite)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def _refuse_existing(target: Path, overwrite: bool) -> None:
    if target.exists() and not overwrite:
        raise FileExistsError(f"{target} exists; pass overwrite=True to replace it")


_META = "__meta__"  # the array that holds the JSON text


def write_arrays(
    path: str | os.PathLike[str],
    arrays: Mapping[str, np.ndarray[Any, Any]],
    meta: Mapping[str, Any],
    *,
    overwrite: bool = False,
) -> None:
    """Write arrays and what is said about them to one file, completely or not at all.

    Parameters
    ----------
    path : path
    arrays : mapping of str to ndarray
    meta : mapping
        What JSON can hold.
    overwrite : bool

    Raises
    ------
    FileExistsError
        If `path` exists and `overwrite` is false.
    TypeError
        If `meta` cannot be written as JSON.
    """
    text = json.dumps(dict(meta), allow_nan=False)
    with new_file(path, overwrite=overwrite) as temporary, temporary.open("wb") as stream:
        np.savez(stream, **{_META: np.array(text)}, **arrays)  # type: ignore[arg-type]


def read_arrays(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    """Read what `write_arrays` wrote.

    Parameters
    ----------
    path : path

    Returns
    -------
    arrays : dict of str to ndarray
    meta : dict

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is damaged or was not written by `write_arrays`.
    """
    try:
        with Path(path).open("rb") as stream:
            stored = np.load(stream, allow_pickle=False)
            if not isinstance(stored, np.lib.npyio.NpzFile):
                raise ValueError("not an .npz file")
            arrays = {name: stored[name] for name in stored.files}
        meta = json.loads(str(arrays.pop(_META)))
        if not isinstance(meta, dict):
            raise ValueError(f"{_META} holds {meta!r:.50}, not an object")
    except (BadZipFile, KeyError, EOFError, ValueError) as error:
        raise ValueError(f"{path} is not a complete table file of cgemit ({error})") from error
    return arrays, meta
