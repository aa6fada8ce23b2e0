"""Files that are either complete or absent, among them `.npz` files with named arrays and one JSON text."""

from __future__ import annotations

import json
import math
import os
import secrets
import stat
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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
    compressed: bool = False,
) -> None:
    """Write arrays and what is said about them to one file, completely or not at all.

    Parameters
    ----------
    path : path
    arrays : mapping of str to ndarray
    meta : mapping
        What JSON can hold.
    overwrite, compressed : bool

    Raises
    ------
    FileExistsError
        If `path` exists and `overwrite` is false.
    TypeError
        If `meta` cannot be written as JSON.
    """
    text = json.dumps(dict(meta), allow_nan=False)
    with new_file(path, overwrite=overwrite) as temporary, temporary.open("wb") as stream:
        write = np.savez_compressed if compressed else np.savez
        write(stream, **{_META: np.array(text)}, **arrays)  # type: ignore[arg-type]


def read_arrays(
    path: str | os.PathLike[str], names: Collection[str] | None = None
) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    """Read what `write_arrays` wrote: all arrays, or those named.

    Parameters
    ----------
    path : path
    names : collection of str or None

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
        arrays = read_npz(path, None if names is None else {_META, *names})
        meta = json.loads(str(arrays.pop(_META)))
        if not isinstance(meta, dict):
            raise ValueError(f"{_META} holds {meta!r:.50}, not an object")
    except (KeyError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not a complete table file of cgemit ({error})") from error
    return arrays, meta


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
