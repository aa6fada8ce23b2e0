"""Build the parts of a detector from the tables of its file; all problems are collected."""

import math
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from cgemit.detector import check
from cgemit.detector.background import BackgroundLevel
from cgemit.detector.field import KINDS, Field, MapField, kind_key
from cgemit.detector.field.files import read_field_map
from cgemit.detector.files import map_path
from cgemit.detector.keys import CENTRED, keys_of, plain
from cgemit.detector.materials import library, read_materials
from cgemit.detector.merge import FOR_ALL_LAYERS
from cgemit.detector.parts import CgemLayer, Contents, Cylinder, DriftChamber, WireLayer
from cgemit.detector.read import LAST_WIRE_LAYER, NAME, TOP_LEVEL, UNUSABLE, WIRE_NUMBER, Reader
from cgemit.detector.read_lists import shown, writable
from cgemit.problems import DetectorError, Problem, did_you_mean


def read_contents(source: str, tables: Mapping[str, Any], problems: list[Problem]) -> Contents:
    """Return the parts of the detector that complete tables describe; `Detector` checks how they fit together.

    Raises
    ------
    DetectorError
        With `problems` and those found here.

    """
    reader = Reader(problems=problems, baseless=any(problem.path == "base" for problem in problems))
    for name in tables.keys() - TOP_LEVEL.keys():
        reader.note(str(name), "an unknown key", "one of " + ", ".join(TOP_LEVEL), did_you_mean(name, TOP_LEVEL))
    texts = {name: _text(reader, name, tables.get(name, "")) for name in ("name", "description")}
    tables = _check_names(reader, tables, texts["name"])
    own = reader.mapping("materials", tables.get("materials", {}))
    reader.materials = read_materials(reader, library(), own)
    field = _field(reader, tables.get("field"))
    pipe = _cylinders(reader, "beam_pipe", tables.get("beam_pipe", {}))
    cgem = _cgem(reader, tables.get("cgem", {}))
    walls = _cylinders(reader, "walls", tables.get("walls", {}))
    chamber = _chamber(reader, tables["drift_chamber"]) if "drift_chamber" in tables else None
    levels = _background(reader, tables.get("background", {}))
    if not cgem and not chamber and not reader.baseless:
        reader.note("", "no detector", "at least one [cgem.<label>] or a [drift_chamber]")
    if problems:
        more = check.field_problems(field) + check.geometry_problems(pipe, cgem, walls, chamber)
        raise DetectorError(source, problems + more)
    air = reader.materials["Air"]
    assert air is not None  # otherwise there was a problem
    return Contents(
        **texts, field=field, beam_pipe=pipe, cgem=cgem, walls=walls, drift_chamber=chamber, background=levels, air=air
    )  # fmt: skip


# More parts than any detector has: a mistake, or meant to exhaust the memory.
_MOST_PARTS = {"beam_pipe": 100, "cgem": 100, "walls": 100, "background": 100, "materials": 1000}
_MOST_WIRE_LAYERS, _MOST_CELLS = 1000, 1_000_000


def _check_names(reader: Reader, tables: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Note names that cannot be names of files, and groups of too many parts; return the tables without these."""
    if not _is_name(name):
        expected = "one line of text, up to 100 characters, without / and \\, since files are called by it"
        reader.note("name", shown(name), expected)
    for group, most in _MOST_PARTS.items():
        parts = tables.get(group)
        if not isinstance(parts, Mapping):
            continue
        if len(parts) > most:
            reader.note(group, f"{len(parts)} tables", f"at most {most}")
            tables, parts = {**tables, group: {}}, {}
        for label in parts:
            if not _is_name(str(label)):
                expected = "one line of text, up to 100 characters, without / and \\"
                reader.note(f"{group}.{shown(str(label))}", "as a label", expected)
    return tables


@lru_cache(maxsize=4096)
def _is_name(text: str) -> bool:
    return re.fullmatch(NAME, text) is not None


def _text(reader: Reader, name: str, raw: object) -> str:
    if not isinstance(raw, str):
        reader.note(name, shown(raw), "text")
    elif not writable(raw) and name != "name":  # whose own check says so
        reader.note(name, shown(raw), "text that a file can hold")
    return str(raw)


def _field(reader: Reader, raw: object) -> Field:
    if isinstance(raw, Field):
        return raw
    if raw is None:
        if not reader.baseless:
            reader.note("field", "nothing", 'a table [field] with kind = "uniform" and bz')
        return Field(kind="uniform", bz=UNUSABLE)
    given = plain(reader.mapping("field", raw).get("kind", "uniform"))
    if not isinstance(given, str) or given not in KINDS:
        # The other keys are checked as those of any kind.
        kinds: list[Any] = list(KINDS.values())
        keys = {name: key for kind in kinds for name, key in keys_of(kind).items()}
        reader.table("field", raw, Field, keys=keys | {"kind": kind_key()})
        return Field(kind="uniform", bz=UNUSABLE)
    kind = KINDS[given]
    values = reader.table("field", raw, kind)
    if kind is MapField:
        _read_map(reader, values)
    return kind(**values)


def _read_map(reader: Reader, values: dict[str, Any]) -> None:
    """Read the map that the values of a table [field] name, and fill in what follows from it."""
    values["grid"] = UNUSABLE
    checksum, stated = values.get("checksum"), "bz" in values
    values.setdefault("checksum", UNUSABLE)
    values.setdefault("bz", UNUSABLE)
    if not isinstance(values["file"], str):
        return
    try:
        grid = read_field_map(map_path(values["file"]))
    except DetectorError as error:
        for problem in error.problems:
            place = f" {problem.path}" if problem.path else ""
            reader.note("field.file", f"{values['file']}{place}: {problem.given}", problem.expected, problem.hint)
        return
    if checksum is not None and checksum != grid.checksum:
        reader.note("field.checksum", str(checksum), f"{grid.checksum}, that of {values['file']}: the map has changed")
    own = grid.bz_at_origin()
    if stated and own == 0:
        reader.note("field.bz", "a value to scale the map to", "none: the map is 0 at the origin")
    values |= {"grid": grid, "checksum": grid.checksum}
    if not stated:
        values["bz"] = own


def _cylinders(reader: Reader, group: str, raw: object) -> tuple[Cylinder, ...]:
    tables = reader.mapping(group, raw)
    found = [
        table
        if isinstance(table, Cylinder)
        else Cylinder(label=label, **reader.table(f"{group}.{label}", table, Cylinder, siblings=tables))
        for label, table in tables.items()
    ]
    return tuple(sorted(found, key=lambda part: part.r_in))


def _background(reader: Reader, raw: object) -> tuple[BackgroundLevel, ...]:
    tables = reader.mapping("background", raw)
    return tuple(
        table
        if isinstance(table, BackgroundLevel)
        else BackgroundLevel(
            label=label, **reader.table(f"background.{label}", table, BackgroundLevel, siblings=tables)
        )
        for label, table in sorted(tables.items())
    )


def _cgem(reader: Reader, raw: object) -> tuple[CgemLayer, ...]:
    found = []
    tables = reader.mapping("cgem", raw)
    for label, table in tables.items():
        if isinstance(table, CgemLayer):
            found.append(table)
            continue
        values = reader.table(f"cgem.{label}", table, CgemLayer, siblings=tables)
        complete_layer(values)
        found.append(CgemLayer(label=label, **values))
    return tuple(sorted(found, key=lambda layer: layer.anode_radius))


def _chamber(reader: Reader, raw: object) -> DriftChamber | None:
    if isinstance(raw, DriftChamber):
        return raw
    if not isinstance(raw, Mapping):
        reader.mapping("drift_chamber", raw)
        return None
    tables = {"wire_material": "Al", **raw}
    rows = reader.mapping("drift_chamber.layers", tables.pop("layers", {}))
    # Values for all layers are read once, so that a mistake in one is reported once.
    keys = {name: keys_of(WireLayer)[name] for name in FOR_ALL_LAYERS}
    common = {
        name: reader.value(f"drift_chamber.{name}", tables.pop(name), key)
        for name, key in keys.items()
        if name in tables
    }
    values = reader.table("drift_chamber", tables, DriftChamber, elsewhere=(*keys, "layers"))
    layers = []
    if len(rows) > _MOST_WIRE_LAYERS:
        reader.note("drift_chamber.layers", f"{len(rows)} tables", f"at most {_MOST_WIRE_LAYERS}")
        rows = {}
    for number, row in rows.items():
        path = f"drift_chamber.layers.{shown(str(number))[1:-1]}"
        if isinstance(row, WireLayer):
            layers.append(row)
        elif re.fullmatch(WIRE_NUMBER, str(number)) and int(number) <= LAST_WIRE_LAYER:
            found = reader.table(path, row, WireLayer, defaults=common, siblings=rows)
            layers.append(WireLayer(number=int(number), **found))
        else:
            reader.note(path, shown(str(number)), f"the number of a layer, such as 8, up to {LAST_WIRE_LAYER}")
    cells = sum(layer.cells for layer in layers)
    if cells > _MOST_CELLS:
        reader.note("drift_chamber.layers", f"{cells} cells", f"at most {_MOST_CELLS}")
    return DriftChamber(**values, layers=tuple(sorted(layers, key=lambda layer: layer.number)))


def complete_layer(values: dict[str, Any]) -> None:
    """Add strips_x, stereo and strips_v to the values (native units) of a CGEM layer where they are missing.

    An `offset_v` of ``"centred"`` becomes a number.

    The stereo angle is that of the sheet's diagonal in whole strips, as in the read-out of the BESIII CGEM
    (docs/methods/detector.md). `stereo_sign` is removed.
    """
    sign = values.pop("stereo_sign", 1)
    if "strips_x" not in values:
        radius = values["anode_radius"] + values.get("readout_offset", 0.0)
        values["strips_x"] = strips_x(radius, values["sheets"], values["pitch_x"])
    width = (values["strips_x"] - 1) * values["pitch_x"]
    if "stereo" not in values:
        values["stereo"] = sign * math.atan2(width, values["length"])
    if "strips_v" not in values:
        values["strips_v"] = strips_v(width, values["length"], values["stereo"], values["pitch_v"])
    if values.get("offset_v") == CENTRED:
        values["offset_v"] = centred_v(values)


def strips_x(radius: float, sheets: int, pitch: float) -> int:
    """Return how many whole X strips fit on a sheet."""
    return _floor(2 * math.pi * radius / (sheets * pitch))


def strips_v(width: float, length: float, stereo: float, pitch: float) -> int:
    """Return how many whole V strips fit between two corners of a sheet.

    `width` runs from the first X strip to the last. With the stereo angle of the diagonal this is the experiment's
    2 length sin(stereo)/pitch.
    """
    return _floor((width * math.cos(stereo) + length * math.sin(abs(stereo))) / pitch)


def centred_v(values: dict[str, Any]) -> float:
    """Return the `offset_v` with which both corners of a sheet have the same room beside the V strips."""
    stereo = values["stereo"]
    extent = values["strips_x"] * values["pitch_x"] * math.cos(stereo) + values["length"] * math.sin(abs(stereo))
    return float(0.5 * (extent / values["pitch_v"] - values["strips_v"]))


def _floor(value: float) -> int:
    # A value that could not be read stays unusable; its problem has been noted.
    return value if math.isnan(value) else math.floor(value)  # type: ignore[return-value]
