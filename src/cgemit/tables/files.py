"""Tables in files: one `.npz` per table, with one JSON text beside a set of them."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.io import new_file, read_arrays, write_arrays
from cgemit.io.files import read_text
from cgemit.tables.check import Array, Rows, schema_of
from cgemit.version import VERSION

FORMAT = "cgemit-table-1"
INDEX = "tables.json"
_ABOUT = {"kind": str, "n_events": int, "first_event": int, "meta": dict}  # what `load` takes from `describe`


def describe(table: Rows) -> dict[str, Any]:
    """Return the description of a table in a file, without its columns."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "kind": table.kind,
        "rows": len(table),
        "n_events": table.n_events,
        "first_event": table.first_event,
        "units": {column.name: column.unit for column in schema_of(table.kind)},
        "meta": dict(table.meta),
    }


def save(table: Rows, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write one table; see `Table.save`."""
    beside = {"offsets": table.offsets}
    events = table.cover["events"]
    if events is not None:
        beside["events"] = events
    write_arrays(path, {**table.columns, **beside}, describe(table), overwrite=overwrite)


def load(path: str | os.PathLike[str]) -> tuple[str, dict[str, Array], int, int, dict[str, Any], Array | None]:
    """Read the arguments of `Table` from a file; see `Table.load`."""
    arrays, about = read_arrays(path)
    if about.get("format") != FORMAT:
        raise ValueError(f"{path} has format {about.get('format')!r}, expected {FORMAT!r}")
    wrong = [name for name, kind in _ABOUT.items() if not isinstance(about.get(name), kind)]
    if wrong:
        raise ValueError(f"{path} is not a complete table file of cgemit (missing or wrong: {', '.join(wrong)})")
    offsets = arrays.pop("offsets", np.empty(0))  # they follow from the event column
    if len(np.atleast_1d(offsets)) != about["n_events"] + 1:
        raise ValueError(f"{path} is damaged: {about['n_events']} events, but {len(offsets)} offsets")
    events = arrays.pop("events", None)
    return about["kind"], arrays, about["n_events"], about["first_event"], about["meta"], events


def save_tables(
    tables: Mapping[str, Rows], directory: str | os.PathLike[str], *, overwrite: bool = False
) -> list[Path]:
    """Write each table to ``<name>.npz`` in a directory, and last of all their description to ``tables.json``.

    The directory is made if it is missing. Without ``tables.json`` it is not complete.

    Parameters
    ----------
    tables : mapping of str to Table
    directory : path
    overwrite : bool

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    FileExistsError
        If one of the files exists and `overwrite` is false; nothing is written then.
    """
    folder = Path(directory)
    paths = {name: folder / f"{name}.npz" for name in tables}
    index = folder / INDEX
    existing = [str(path) for path in (*paths.values(), index) if path.exists()]
    if existing and not overwrite:
        raise FileExistsError(f"{', '.join(existing)} would be replaced; pass overwrite=True to do so")
    folder.mkdir(parents=True, exist_ok=True)
    index.unlink(missing_ok=True)
    for name, table in tables.items():
        save(table, paths[name], overwrite=overwrite)
    with new_file(index) as temporary:
        about = {name: describe(table) for name, table in tables.items()}
        temporary.write_text(json.dumps(about, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return [*paths.values(), index]


def read_index(directory: str | os.PathLike[str]) -> dict[str, dict[str, Any]]:
    """Return the tables that `save_tables` wrote to a directory, described by name; raises as `load_tables`."""
    index = Path(directory) / INDEX
    if not index.exists():
        raise FileNotFoundError(f"{directory} holds no complete set of tables ({INDEX} is missing)")
    try:
        tables = json.loads(read_text(index))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{index} is damaged ({error})") from error
    if not isinstance(tables, dict) or not all(isinstance(about, dict) for about in tables.values()):
        raise ValueError(f"{index} is damaged (expected an object with a key for each table)")
    strange = [name for name in tables if not re.fullmatch(r"[A-Za-z_]\w{0,63}", name, re.ASCII)]
    if strange:
        raise ValueError(f"{index} is damaged (got the table name {strange[0][:80]!r}, expected letters and digits)")
    return tables


def index_problems(name: str, table: Rows, about: Mapping[str, Any]) -> list[str]:
    """Return how a table differs from its description in the index: it is of another run, or half replaced."""
    found = json.loads(json.dumps(describe(table)))
    pairs = [(key, found[key], about.get(key)) for key in ("kind", "rows", "n_events", "first_event")]
    meta, expected = found["meta"], about.get("meta")
    expected = expected if isinstance(expected, dict) else {}
    pairs += [(key, meta.get(key), expected.get(key)) for key in dict.fromkeys([*meta, *expected])]
    return [
        f"{name}.npz: {key}: got {given!r:.100}, expected {wanted!r:.100}, as {INDEX} says"
        for key, given, wanted in pairs
        if given != wanted
    ]
