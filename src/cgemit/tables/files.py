"""Sets of tables in folders: a file or a folder of parts for each, and one JSON text that describes them."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cgemit.io import new_file
from cgemit.io.files import read_text
from cgemit.tables.check import Rows
from cgemit.tables.formats import FORMATS, check_format, describe, describe_fully, save

INDEX = "tables.json"
_LARGEST = 200_000_000  # bytes of an index, which has a line for each of many parts
#: What every entry says about the size of its table.
COVER = {"n_events": 0, "first_event": 0, "rows": 0}.keys()


def save_tables(
    tables: Mapping[str, Rows], directory: str | os.PathLike[str], *, overwrite: bool = False, format: str = "npz"
) -> list[Path]:
    """Write each table to a file of its name in a directory, and last of all their description to ``tables.json``.

    The directory is made if it is missing. Without ``tables.json`` it is not complete.

    Parameters
    ----------
    tables : mapping of str to Table
    directory : path
    overwrite : bool
    format : str
        One of "npz", "npz-compressed", "parquet" (pyarrow), "root" (a TTree of the table's name; uproot), "csv".

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    FileExistsError
        If one of the files exists and `overwrite` is false; nothing is written then.
    ValueError
        If the format is unknown, needs a package that is not installed, or cannot hold a column.
    """
    folder, suffix = Path(directory), FORMATS[check_format(format)]
    paths = {name: folder / f"{name}{suffix}" for name in tables}
    index = folder / INDEX
    existing = [str(path) for path in (*paths.values(), index) if path.exists()]
    if existing and not overwrite:
        raise FileExistsError(f"{', '.join(existing)} would be replaced; pass overwrite=True to do so")
    folder.mkdir(parents=True, exist_ok=True)
    index.unlink(missing_ok=True)
    for name, table in tables.items():
        save(table, paths[name], overwrite=overwrite, form=format)
    return [*paths.values(), write_index(folder, {name: entry(table, suffix) for name, table in tables.items()})]


def entry(table: Rows, suffix: str) -> dict[str, Any]:
    """Return what the index says about a table in a file."""
    found = describe(table) if suffix == ".npz" else describe_fully(table)
    return found if suffix == ".npz" else found | {"suffix": suffix}


def write_index(folder: Path, entries: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write the description of all tables."""
    path = folder / INDEX
    with new_file(path) as temporary:
        temporary.write_text(json.dumps(entries, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return path


def read_index(directory: str | os.PathLike[str]) -> dict[str, dict[str, Any]]:
    """Return the tables that `save_tables` wrote to a directory, described by name; raises as `load_tables`."""
    index = Path(directory) / INDEX
    if not index.exists():
        raise FileNotFoundError(f"{directory} holds no complete set of tables ({INDEX} is missing)")
    try:
        tables = json.loads(read_text(index, _LARGEST))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{index} is damaged ({error})") from error
    if not isinstance(tables, dict) or not all(isinstance(about, dict) for about in tables.values()):
        raise ValueError(f"{index} is damaged (expected an object with a key for each table)")
    strange = [name for name in tables if not re.fullmatch(r"[A-Za-z_]\w{0,63}", name, re.ASCII)]
    if strange:
        raise ValueError(f"{index} is damaged (got the table name {strange[0][:80]!r}, expected letters and digits)")
    for name, about in tables.items():
        problem = _entry_problem(about)
        if problem:
            raise ValueError(f"{index} is damaged ({name}: {problem})")
    return tables


def _entry_problem(about: Mapping[str, Any]) -> str:
    """Return what is wrong with the entry of a table, or an empty text."""
    suffix = about.get("suffix", ".npz")
    if suffix not in FORMATS.values():
        return f"suffix: got {suffix!r:.40}, expected one of {', '.join(dict.fromkeys(FORMATS.values()))}"
    parts = about.get("parts")
    if "parts" not in about:
        return ""
    if not isinstance(parts, list) or not parts or not all(isinstance(part, dict) for part in parts):
        return f"parts: got {parts!r:.40}, expected a list of parts"
    if any(not isinstance(part.get(key), int) or part[key] < 0 for part in parts for key in COVER):
        return f"parts: expected {', '.join(COVER)} of each, whole numbers"
    for key in ("n_events", "rows"):
        total = sum(part[key] for part in parts)
        if total != about.get(key):
            return f"parts: got {total} {key}, expected {about.get(key)!r:.20}"
    return ""


def files_of(name: str, about: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Return the files of a table, relative to the folder, each with the description of what it holds."""
    suffix = about.get("suffix", ".npz")
    if "parts" not in about:
        return [(f"{name}{suffix}", dict(about))]
    common = {key: value for key, value in about.items() if key != "parts"}
    return [(f"{name}/part-{i:06d}{suffix}", common | part) for i, part in enumerate(about["parts"])]


def index_problems(file: str, table: Rows, about: Mapping[str, Any]) -> list[str]:
    """Return how a table differs from its description in the index: it is of another run, or half replaced."""
    found = json.loads(json.dumps(describe(table)))
    pairs = [(key, found[key], about.get(key)) for key in ("kind", *COVER)]
    meta, expected = found["meta"], about.get("meta")
    expected = expected if isinstance(expected, dict) else {}
    pairs += [(key, meta.get(key), expected.get(key)) for key in dict.fromkeys([*meta, *expected])]
    return [
        f"{file}: {key}: got {given!r:.100}, expected {wanted!r:.100}, as {INDEX} says"
        for key, given, wanted in pairs
        if given != wanted
    ]
