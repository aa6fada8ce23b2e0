"""Detector and field files: their paths, their tables, and the chain of their bases."""

import re
import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NamedTuple

from cgemit.detector.merge import merged
from cgemit.io.files import read_text
from cgemit.io.toml import parse_toml
from cgemit.problems import DetectorError, Problem, did_you_mean

_DETECTORS = resources.files("cgemit.data") / "detectors"
_FIELDS = resources.files("cgemit.data") / "fields"

#: Begins the name of a field map that comes with the program, such as ``cgemit:besiii.npz``.
OWN_MAP = "cgemit:"


class Source(NamedTuple):
    """The content of a file: a name for messages, the folder that relative bases refer to, and the tables."""

    name: str
    folder: Path | None
    tables: dict[str, Any]


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets; files that begin with an underscore are parts of presets."""
    names = (entry.name for entry in _DETECTORS.iterdir() if entry.name.endswith(".toml"))
    return tuple(sorted(name.removesuffix(".toml") for name in names if not name.startswith("_")))


def detectors() -> dict[str, str]:
    """Return the presets: name and description."""
    return {name: _preset_tables(name)["description"] for name in preset_names()}


@cache
def _preset_tables(name: str) -> dict[str, Any]:
    return tomllib.loads((_DETECTORS / f"{name}.toml").read_text(encoding="utf-8"))


def library_materials() -> dict[str, Any]:
    """Return the tables of the materials that come with the program."""
    tables: dict[str, Any] = _preset_tables("_materials")["materials"]
    return tables


def open_source(source: str | Path | Mapping[str, Any], folder: Path | None = None) -> Source:
    """Return the content of a preset, a file or a mapping.

    Raises
    ------
    DetectorError
        If there is no such preset or file, or the file is not TOML.

    """
    if isinstance(source, Mapping):
        return Source(str(source.get("name", "detector")), folder, place_map(dict(source), folder))
    text = str(source)
    if is_preset(text):
        return Source(text, None, _preset_tables(text))
    path = Path(text) if folder is None else folder / text
    if not _is_file(path):
        known = ", ".join(preset_names())
        given = _quoted(text) + (", a folder" if text and _is_file(path, Path.is_dir) else "")
        problem = Problem(
            "", given, f"one of {known}, or a detector file", did_you_mean(text[:_LONGEST], preset_names())
        )
        raise DetectorError(text[:_LONGEST], [problem])
    try:
        tables = parse_toml(read_text(path))
    except ValueError as error:
        raise DetectorError(str(path), [Problem("", str(error), "a TOML file")]) from error
    return Source(str(path), path.parent, place_map(tables, path.parent))


_LONGEST = 300  # characters of a path in a message


def _quoted(text: str) -> str:
    return f'"{text}"' if len(text) <= _LONGEST else f'"{text[:_LONGEST]}..."'


def is_preset(name: str) -> bool:
    """Return whether a preset, or a part of presets, has this name.

    Parameters
    ----------
    name : str
    """
    return _is_preset(_DETECTORS, name)


def _is_preset(folder: Traversable, name: str) -> bool:
    return bool(re.fullmatch(r"[\w-]{1,100}", name, re.ASCII)) and (folder / f"{name}.toml").is_file()


def _is_file(path: Path, test: Callable[[Path], bool] = Path.is_file) -> bool:
    """Tell whether there is such a file; a path that no file can have has none."""
    try:
        return test(path)
    except (OSError, ValueError):  # too long a name, a null byte
        return False


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
        problems.append(Problem("base", repr(base)[:80], "the name of a preset or of a detector file"))
        return None
    try:
        found = open_source(base, chain[-1].folder)
    except DetectorError as error:
        problems += [problem._replace(path="base") for problem in error.problems]
        return None
    if any(_place(found) == _place(link) for link in chain) or len(chain) > _MOST_BASES:
        problems.append(Problem("base", _quoted(base), "a base that does not lead back to the file itself"))
        return None
    return found


_MOST_BASES = 50


def _place(source: Source) -> object:
    """Return what is equal for equal files, however their paths are written; tables are equal to nothing else."""
    if _is_preset(_DETECTORS, source.name) and source.folder is None and source.tables is _preset_tables(source.name):
        return source.name
    return id(source.tables) if source.folder is None else Path(source.name).resolve()


@cache
def fields() -> tuple[str, ...]:
    """Return the names of the preset fields."""
    return tuple(
        sorted(entry.name.removesuffix(".toml") for entry in _FIELDS.iterdir() if entry.name.endswith(".toml"))
    )


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
    if _is_preset(_FIELDS, text):
        return _field_of(text, tomllib.loads((_FIELDS / f"{text}.toml").read_text(encoding="utf-8")), None)
    path = Path(text)
    if not _is_file(path):
        expected = f"one of {', '.join(fields())}, a map (.npz, .csv), or a TOML file with a table [field]"
        raise DetectorError(
            text[:_LONGEST], [Problem("field", _quoted(text), expected, did_you_mean(text[:_LONGEST], fields()))]
        )
    if path.suffix in (".npz", ".csv"):
        return {"kind": "map", "file": str(path.absolute())}
    try:
        return _field_of(text, parse_toml(read_text(path)), path.parent)
    except DetectorError:
        raise
    except ValueError as error:
        raise DetectorError(text, [Problem("field", str(error), "a TOML file or a map (.npz, .csv)")]) from error


def place_map(tables: dict[str, Any], folder: Path | None) -> dict[str, Any]:
    """Return the tables of a file with the path of its field map made absolute; relative ones begin at `folder`.

    Maps of the program (`OWN_MAP`) keep their names, so that a detector file means the same on every machine.
    """
    field = tables.get("field")
    if not isinstance(field, Mapping) or not isinstance(field.get("file"), str) or field["file"].startswith(OWN_MAP):
        return tables
    return {**tables, "field": {**field, "file": str(((folder or Path()) / field["file"]).absolute())}}


def map_path(file: str) -> Path:
    """Return the path of the map that `file` of a table [field] names."""
    return Path(str(_FIELDS / file.removeprefix(OWN_MAP))) if file.startswith(OWN_MAP) else Path(file)


def _field_of(name: str, tables: dict[str, Any], folder: Path | None) -> dict[str, Any]:
    found = place_map(tables, folder).get("field")
    if not isinstance(found, Mapping):
        raise DetectorError(name, [Problem("field", "nothing", "a table [field]")])
    return dict(found)
