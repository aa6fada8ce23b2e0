"""Detector files: where they are, what they say, and the chain of bases below them."""

import re
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from cgemit.detector.field_sources import place_map
from cgemit.detector.merge import merged
from cgemit.problems import DetectorError, Problem, did_you_mean

_DATA = resources.files("cgemit.data") / "detectors"


class Source(NamedTuple):
    """What a file says: a name for messages, the folder that relative bases refer to, and the tables."""

    name: str
    folder: Path | None
    tables: dict[str, Any]


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets; files that begin with an underscore are parts of presets."""
    names = (entry.name for entry in _DATA.iterdir() if entry.name.endswith(".toml"))
    return tuple(sorted(name.removesuffix(".toml") for name in names if not name.startswith("_")))


def detectors() -> dict[str, str]:
    """Return the presets: name and description."""
    return {name: _preset_tables(name)["description"] for name in preset_names()}


@cache
def _preset_tables(name: str) -> dict[str, Any]:
    return tomllib.loads((_DATA / f"{name}.toml").read_text(encoding="utf-8"))


def library_materials() -> dict[str, Any]:
    """Return the tables of the materials that come with the program."""
    tables: dict[str, Any] = _preset_tables("_materials")["materials"]
    return tables


def open_source(source: str | Path | Mapping[str, Any], folder: Path | None = None) -> Source:
    """Return what a preset, a file or a mapping says.

    Raises
    ------
    DetectorError
        If there is no such preset or file, or the file is not TOML.

    """
    if isinstance(source, Mapping):
        return Source(str(source.get("name", "detector")), folder, place_map(dict(source), folder))
    text = str(source)
    if re.fullmatch(r"[\w-]+", text) and (_DATA / f"{text}.toml").is_file():
        return Source(text, None, _preset_tables(text))
    path = Path(text) if folder is None else folder / text
    if not path.is_file():
        known = ", ".join(preset_names())
        given = f'"{text}"' + (", a folder" if text and path.is_dir() else "")
        problem = Problem("", given, f"one of {known}, or a detector file", did_you_mean(text, preset_names()))
        raise DetectorError(text, [problem])
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DetectorError(str(path), [Problem("", str(error), "a TOML file")]) from error
    return Source(str(path), path.parent, place_map(tables, path.parent))


def resolve(source: Source, problems: list[Problem]) -> dict[str, Any]:
    """Return the tables of a file laid over those of its bases; problems of the chain are noted."""
    chain = [source]
    while (base := chain[-1].tables.get("base")) is not None:
        below = _base_of(chain, base, problems)
        if below is None:
            break
        chain.append(below)
    tables: dict[str, Any] = {}
    for link in reversed(chain):
        tables = merged(tables, link.tables, problems)
    return tables


def _base_of(chain: list[Source], base: object, problems: list[Problem]) -> Source | None:
    if not isinstance(base, str):
        problems.append(Problem("base", repr(base), "the name of a preset or of a detector file"))
        return None
    try:
        found = open_source(base, chain[-1].folder)
    except DetectorError as error:
        problems += [problem._replace(path="base") for problem in error.problems]
        return None
    if any(found.name == link.name for link in chain):
        problems.append(Problem("base", f'"{base}"', "a base that does not lead back to the file itself"))
        return None
    return found
