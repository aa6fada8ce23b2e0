"""Detector and field files: their paths, their tables, and variants merged into their bases."""

import re
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from cgemit.detector.keys import CENTRED, Known, opened, plain
from cgemit.problems import DetectorError, Problem, did_you_mean

_DETECTORS = resources.files("cgemit.data") / "detectors"
_FIELDS = resources.files("cgemit.data") / "fields"

#: Begins the name of a field map that comes with the program, such as ``cgemit:besiii.npz``.
OWN_MAP = "cgemit:"

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
    if re.fullmatch(r"[\w-]+", text) and (_DETECTORS / f"{text}.toml").is_file():
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


def merged(base: Mapping[str, Any], variant: Mapping[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """Return `base` with the tables of `variant` laid over it; what `variant["remove"]` names is taken out first.

    The base may hold parts that were read before (`describe.tables_of`); those that the variant does not change are
    the same objects in the result. CGEM layers with the key `like` are copies of other layers with some values changed.
    """
    copies = {label: layer for label, layer in _tables(variant, "cgem").items() if _has_like(layer)}
    if copies:
        variant = {**variant, "cgem": {k: v for k, v in variant["cgem"].items() if k not in copies}}
    result: dict[str, Any] = _copied(base, open_parts="materials" in variant)
    _remove(result, variant.get("remove", []), problems)
    for label, layer in _tables(variant, "cgem").items():
        if isinstance(layer, Mapping):
            _drop_derived(_open(_tables(result, "cgem"), label), layer)
    _drop_field(result, _tables(variant, "field"))
    chamber = variant.get("drift_chamber")
    if isinstance(chamber, Mapping):
        for name in FOR_ALL_LAYERS.keys() & chamber.keys():
            layers = _tables(_tables(result, "drift_chamber"), "layers")
            for layer in (_open(layers, number) for number in layers):
                for old in FOR_ALL_LAYERS[name]:
                    layer.pop(old, None)
    _lay_over(result, {k: v for k, v in variant.items() if k not in ("remove", "base")}, "")
    for label, layer in copies.items():
        _copy_layer(result.setdefault("cgem", {}), label, layer, problems)
    return result


def _copied(tree: Any, *, open_parts: bool = False) -> Any:
    """Return nested tables whose dicts may be changed; parts that were read before are shared, or opened."""
    if isinstance(tree, Mapping):
        return {name: _copied(one, open_parts=open_parts and name != "materials") for name, one in tree.items()}
    return opened(tree) if open_parts else tree


def _open(tables: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a table of others, opened if it is a part that was read before; an empty one if it is none."""
    if name in tables:
        tables[name] = opened(tables[name])
    return _tables(tables, name)


def _has_like(layer: object) -> bool:
    return isinstance(layer, Mapping) and "like" in layer


def _copy_layer(layers: dict[str, Any], label: str, changes: Mapping[str, Any], problems: list[Problem]) -> None:
    """Add a CGEM layer that is a copy of another one with some values changed; those derived from them are left out."""
    like = changes["like"]
    if not isinstance(like, str) or like not in layers:
        given = f'"{like}"' if isinstance(like, str) else repr(like)
        expected = "the label of another layer: " + ", ".join(layers)
        problems.append(Problem(f"cgem.{label}.like", given, expected, did_you_mean(like, layers)))
        return
    layer = _copied(opened(layers[like]))
    own = {name: value for name, value in changes.items() if name != "like"}
    _drop_derived(layer, own)
    _lay_over(layer, own, label)
    layers[label] = layer


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
            old = plain(old)
            if name == "stereo" and isinstance(old, str | float):
                base["stereo_sign"] = -1 if str(old).lstrip().startswith("-") else 1
            if name == "offset_v" and old:
                base["offset_v"] = CENTRED  # strips that were moved off the corner stay on the sheet


def _drop_field(base: dict[str, Any], variant: Mapping[str, Any]) -> None:
    """Keep only the strength of the base's field if the variant has another kind; a map has its own strength."""
    if not variant:
        return
    old, kind = _open(base, "field"), variant.get("kind")
    if kind is not None and kind != plain(old.get("kind")):
        base["field"] = {"bz": old["bz"]} if "bz" in old and kind != "map" else {}
    elif "file" in variant:
        base["field"] = {name: value for name, value in old.items() if name not in ("bz", "checksum")}


def _lay_over(base: dict[str, Any], variant: Mapping[str, Any], path: str) -> None:
    for name, value in variant.items():
        # A material is replaced as a whole: keys of the old and of the new one would not be consistent.
        if isinstance(value, Mapping) and name in base and path != "materials":
            base[name] = _stack_of(base[name])
            if isinstance(base[name], list):
                base[name] = _changed_stack(base[name], value)
                continue
            if isinstance(_open(base, name), dict) and isinstance(base[name], dict):
                _lay_over(base[name], value, name)
                continue
        base[name] = _copied(value)


def _stack_of(value: Any) -> Any:
    """Return the sub-layers of a part that was read before as rows of a file; anything else as it is."""
    if not isinstance(value, Known) or not isinstance(value.value, tuple):
        return value
    return [{"label": part.label, **opened(part)} for part in value.value]


def _changed_stack(rows: list[Any], changes: Mapping[str, Any]) -> list[Any]:
    """Return the rows of a stack with those changed that `changes` names by label; a new label is a row that is wrong.

    A row without a label has its material's name for one.
    """
    found, left = [], dict(changes)
    for row in rows:
        label = row.get("label", row.get("material")) if isinstance(row, Mapping) else None
        change = changes.get(str(label))
        left.pop(str(label), None)
        found.append({"label": label, **row, **change} if isinstance(change, Mapping) else row)
    return found + [{"label": label, **change} for label, change in left.items() if isinstance(change, Mapping)]


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
    if re.fullmatch(r"[\w-]+", text) and (_FIELDS / f"{text}.toml").is_file():
        return _field_of(text, tomllib.loads((_FIELDS / f"{text}.toml").read_text(encoding="utf-8")), None)
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
