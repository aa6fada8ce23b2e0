"""Detector and field files: their paths, their tables, and variants merged into their bases."""

import copy
import re
import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NamedTuple

from cgemit.detector.keys import CENTRED
from cgemit.io.files import read_text
from cgemit.io.toml import parse_toml
from cgemit.problems import DetectorError, Problem, did_you_mean

_DETECTORS = resources.files("cgemit.data") / "detectors"
_FIELDS = resources.files("cgemit.data") / "fields"

#: Begins the name of a field map that comes with the program, such as ``cgemit:besiii.npz``.
OWN_MAP = "cgemit:"

#: Key of the material that a material of a variant replaces.
BELOW = "<below>"

#: Derived values of a CGEM layer in the order of their computation, each with the values that it depends on.
DERIVED_FROM = {
    "strips_x": {"anode_radius", "readout_offset", "sheets", "pitch_x"},
    "stereo": {"strips_x", "pitch_x", "length", "stereo_sign"},
    "strips_v": {"stereo", "strips_x", "pitch_x", "pitch_v", "length"},
    "offset_v": {"strips_v", "stereo", "strips_x", "pitch_x", "pitch_v", "length"},
}

#: Values of [drift_chamber] that hold for every layer which does not state its own; a new value in a variant
#: replaces the listed values of the base's layers.
FOR_ALL_LAYERS = {
    "sigma": ("sigma", "sigma_slope"),
    "sigma_slope": ("sigma_slope",),
    "efficiency": ("efficiency",),
    "wire_x0": ("wire_x0",),
}


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
    if _is_preset(_DETECTORS, text):
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


def merged(base: Mapping[str, Any], variant: Mapping[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """Return `base` with the tables of `variant` laid over it; what `variant["remove"]` names is taken out first."""
    result = copy.deepcopy(dict(base))
    _remove(result, variant.get("remove", []), problems)
    for label, layer in _tables(variant, "cgem").items():
        if isinstance(layer, Mapping):
            _drop_derived(_tables(result, "cgem").get(label, {}), layer)
    _drop_field(result, _tables(variant, "field"))
    chamber = variant.get("drift_chamber")
    if isinstance(chamber, Mapping):
        for name in FOR_ALL_LAYERS.keys() & chamber.keys():
            for layer in _tables(_tables(result, "drift_chamber"), "layers").values():
                for old in FOR_ALL_LAYERS[name]:
                    layer.pop(old, None)
    _lay_over(result, {k: v for k, v in variant.items() if k not in ("remove", "base")}, "")
    return result


def set_path(tree: dict[str, Any], dotted: str, value: object) -> bool:
    """Set a value in nested tables by its dotted path; return False if a part of the path is a value already."""
    *parents, last = dotted.split(".")
    for name in parents:
        tree = tree.setdefault(name, {})
        if not isinstance(tree, dict):
            return False
    tree[last] = value
    return True


def _tables(tree: Mapping[str, Any], name: str) -> dict[str, Any]:
    found = tree.get(name)
    return found if isinstance(found, dict) else {}


def _drop_derived(base: dict[str, Any], variant: Mapping[str, Any]) -> None:
    """Remove the derived values of a layer of the base that depend on changed values."""
    changed = set(variant)
    for name, depends in DERIVED_FROM.items():
        if name not in variant and changed & depends:
            old = base.pop(name, None)
            changed.add(name)
            if name == "stereo" and isinstance(old, str):
                base["stereo_sign"] = -1 if old.lstrip().startswith("-") else 1
            if name == "offset_v" and old:
                base["offset_v"] = CENTRED  # strips that were moved off the corner stay on the sheet


def _drop_field(base: dict[str, Any], variant: Mapping[str, Any]) -> None:
    """Keep only the strength of the base's field if the variant has another kind; a map has its own strength."""
    old, kind = _tables(base, "field"), variant.get("kind")
    if kind is not None and kind != old.get("kind"):
        base["field"] = {"bz": old["bz"]} if "bz" in old and kind != "map" else {}
    elif "file" in variant:
        base["field"] = {name: value for name, value in old.items() if name not in ("bz", "checksum")}


def _lay_over(base: dict[str, Any], variant: Mapping[str, Any], path: str) -> None:
    for name, value in variant.items():
        if isinstance(value, Mapping) and isinstance(base.get(name), dict):
            # Values of a material depend on each other: the reader decides what of the old one stays.
            if path == "materials":
                base[name] = {**copy.deepcopy(dict(value)), BELOW: base[name]}
            else:
                _lay_over(base[name], value, name)
        else:
            base[name] = copy.deepcopy(value)


def _remove(tree: dict[str, Any], paths: object, problems: list[Problem]) -> None:
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        problems.append(Problem("remove", repr(paths), 'a list of paths such as ["cgem.L2", "drift_chamber"]'))
        return
    for path in paths:
        *parents, last = path.split(".")
        table: Any = tree
        for name in parents:
            table = table.get(name, {}) if isinstance(table, dict) else {}
        if isinstance(table, dict) and last in table:
            del table[last]
        else:
            prefix = "".join(name + "." for name in parents)
            known = [prefix + name for name in table] if isinstance(table, dict) else []
            problems.append(Problem("remove", f'"{path}"', "a part of the base", did_you_mean(path, known)))


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
