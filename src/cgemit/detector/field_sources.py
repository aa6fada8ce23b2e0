"""Where fields come from: presets, detector files, map files, tables."""

import re
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from cgemit.problems import DetectorError, Problem, did_you_mean

_DATA = resources.files("cgemit.data") / "fields"


@cache
def fields() -> tuple[str, ...]:
    """Return the names of the preset fields."""
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in _DATA.iterdir() if entry.name.endswith(".toml")))


def field_tables(source: str | Path | Mapping[str, Any]) -> dict[str, Any]:
    """Return the table [field] that a preset, a TOML file with one, a map file or a mapping stands for.

    Raises
    ------
    DetectorError
        If there is no such preset or file, or it holds no field.

    """
    if isinstance(source, Mapping):
        return dict(source)
    text = str(source)
    if re.fullmatch(r"[\w-]+", text) and (_DATA / f"{text}.toml").is_file():
        return _field_of(text, tomllib.loads((_DATA / f"{text}.toml").read_text(encoding="utf-8")), None)
    path = Path(text)
    if not path.is_file():
        expected = f"one of {', '.join(fields())}, a map (.npz, .csv), or a TOML file with a table [field]"
        raise DetectorError(text, [Problem("field", f'"{text}"', expected, did_you_mean(text, fields()))])
    if path.suffix in (".npz", ".csv"):
        return {"kind": "map", "file": str(path.absolute())}
    try:
        return _field_of(text, tomllib.loads(path.read_text(encoding="utf-8-sig")), path.parent)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DetectorError(text, [Problem("field", str(error), "a TOML file or a map (.npz, .csv)")]) from error


def place_map(tables: dict[str, Any], folder: Path | None) -> dict[str, Any]:
    """Return the tables of a file with the path of its field map made absolute; relative ones begin at `folder`."""
    field = tables.get("field")
    if not isinstance(field, Mapping) or not isinstance(field.get("file"), str):
        return tables
    return {**tables, "field": {**field, "file": str(((folder or Path()) / field["file"]).absolute())}}


def _field_of(name: str, tables: dict[str, Any], folder: Path | None) -> dict[str, Any]:
    found = place_map(tables, folder).get("field")
    if not isinstance(found, Mapping):
        raise DetectorError(name, [Problem("field", "nothing", "a table [field]")])
    return dict(found)
