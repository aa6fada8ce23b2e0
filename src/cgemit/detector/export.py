"""A detector as text, as tables with units, as a detector file, as JSON schema, and as GDML."""

from __future__ import annotations

import html
import itertools
import os
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from cgemit.base.files import new_file, toml_text
from cgemit.detector.build import library
from cgemit.detector.check import unreachable
from cgemit.detector.field import KINDS, MIRRORS, MapField, field_text, kind_key
from cgemit.detector.files import OWN_MAP, write_field_map
from cgemit.detector.keys import CELLS, CENTRED, Key, Known, default, file_keys, keys_of, once, opened, required_of
from cgemit.detector.layers import LAYER_KINDS, CgemLayer
from cgemit.detector.layers.layer import STRIPS, SubLayer, strip_text
from cgemit.detector.layers.wires import (
    FOR_ALL_LAYERS,
    GENERATED,
    WIRE_NUMBER,
    WIRES,
    CellWire,
    DriftChamber,
    DriftPoint,
    ErrorPoint,
    Superlayer,
    WireLayer,
    wire_text,
)
from cgemit.detector.material import DensityEffect, Material, elements
from cgemit.detector.matter import slabs
from cgemit.detector.parts import BackgroundLevel, Contents, Cylinder, RatePoint, extent
from cgemit.detector.reader import MOST_POINTS, NAME, OF_LISTS, TOP_LEVEL
from cgemit.detector.readouts import READOUTS, Readout
from cgemit.detector.shells import ENDLESS, Shell, Slab
from cgemit.units import NATIVE, format_quantity, units_of


def lines(detector: Contents) -> list[str]:
    """Return one line for the field and for each part that measures."""
    lines = [f"field {field_text(detector.field, *extent(detector))}"]
    for group, layers in detector.by_kind():
        lines += [f"{group} {layer.label}: {layer.text()}" for layer in layers]
    if detector.drift_chamber:
        lines.append(f"drift chamber: {detector.drift_chamber.text()}")
    if detector.background:
        lines.append("background: " + ", ".join(level.label for level in detector.background))
    return lines + unreachable(detector)


def summary(detector: Contents) -> str:
    """Return a few lines for the terminal."""
    return "\n  ".join([f"Detector {detector.name!r}", *lines(detector)])


def summary_html(detector: Contents) -> str:
    """Return the same for a notebook."""
    rows = "".join(f"<li>{html.escape(line)}</li>" for line in lines(detector))
    return f"<b>Detector {html.escape(detector.name)}</b> {html.escape(detector.description)}<ul>{rows}</ul>"


def describe(detector: Contents) -> dict[str, Any]:
    """Return everything that `cgemit show` prints, ready for JSON.

    Parameters
    ----------
    detector : Contents

    Returns
    -------
    dict
        name, description, field_t (at the origin), field (text); `material`: one entry per scatterer with its
        `sub_layers`; `cgem`, `layers` and `wires`: one entry per layer; `unreachable`: lines that say what part of a
        layer no track from the origin reaches. Thickness in radiation lengths and energy loss at normal incidence.

    Examples
    --------
    >>> from cgemit.detector import describe
    >>> found = describe(cg.load("besiii-cgem"))
    >>> found["name"], [(row["layer"], row["strips_x"]) for row in found["cgem"]]
    ('besiii-cgem', [('L1', 856), ('L2', 630), ('L3', 832)])
    """
    material = [_scatterer(detector, slab) for slab in slabs(detector)]
    chamber = detector.drift_chamber
    wires = zip(chamber.layers, chamber.gid_first, strict=True) if chamber else ()
    return {
        "name": detector.name,
        "description": detector.description,
        "field_t": detector.field.bz,
        "field": field_text(detector.field, *extent(detector)),
        "material": material,
        "cgem": [layer.described() for layer in detector.cgem],
        "layers": [layer.described() for group, layers in detector.by_kind() if group != "cgem" for layer in layers],
        "wires": [layer.described(gid) for layer, gid in wires],
        "unreachable": unreachable(detector),
    }


def _scatterer(detector: Contents, slab: Slab) -> dict[str, Any]:
    first = slab.shells[0]
    middle = 0.5 * (slab.r_in + slab.r_out)
    owner = next((layer.label for layer in detector.barrels if layer.r_in < middle < layer.r_out), None)
    names = {"pipe": "beam pipe", "drift": "drift gap", "gas": "chamber gas"}
    group = names.get(first.group, first.group)
    rows = [
        {
            "label": shell.label,
            "material": shell.material.name,
            "r_in_mm": shell.r_in,
            "r_out_mm": shell.r_out,
            "thickness_mm": shell.thickness,
            "x0_percent": 100 * shell.x0,
        }
        for shell in slab.shells
    ]
    return {
        "part": f"{owner} {group}" if owner else group,
        "r_in_mm": slab.r_in,
        "r_out_mm": slab.r_out,
        "radius_mm": slab.radius,
        "x0_percent": 100 * slab.x0,
        "sub_layers": rows,
    }


def to_dict(detector: Contents) -> dict[str, Any]:
    """Return the tables of a complete detector file: quantities as text in native units, all digits kept."""
    tables: dict[str, Any] = {"name": detector.name, "description": detector.description}
    tables["field"] = _table(detector.field)
    tables["beam_pipe"] = {part.label: _table(part) for part in detector.beam_pipe}
    tables |= {group: {layer.label: _table(layer) for layer in layers} for group, layers in detector.by_kind()}
    tables["walls"] = {part.label: _table(part) for part in detector.walls}
    if detector.drift_chamber:
        tables["drift_chamber"] = _table(detector.drift_chamber)
        layers = {str(layer.number): _table(layer) for layer in detector.drift_chamber.layers}
        for name in relation_of_all(detector.drift_chamber):
            for row in layers.values():
                tables["drift_chamber"][name] = row.pop(name)
        tables["drift_chamber"]["layers"] = layers
    tables["background"] = {level.label: _table(level) for level in detector.background}
    tables["materials"] = {m.name: _table(m) for m in own_materials(detector)}
    return {name: value for name, value in tables.items() if value != {}}


def relation_of_all(chamber: DriftChamber) -> dict[str, Known]:
    """Return the values of the relation of distance and time that all layers have, unless they are the usual ones."""
    overrides = {}
    for name in ("drift_relation", "drift_velocity", "t0"):
        values = {getattr(layer, name) for layer in chamber.layers}
        if len(values) == 1 and values != {default(WireLayer, name)}:
            overrides[name] = Known(values.pop())
    return overrides


def tables_of(detector: Contents, changed: Container[str] = ()) -> dict[str, Any]:
    """Return the tables of a complete detector file with its parts as they are, for variants (`merge.merged`).

    The drift chamber is a table of layers if `changed` names a group that changes it, otherwise one part.
    """
    tables: dict[str, Any] = {"name": detector.name, "description": detector.description, "field": detector.field}
    tables |= detector.labelled()
    chamber = detector.drift_chamber
    if chamber and any(group in changed for group in ("drift_chamber", "materials", "remove")):
        layers = {str(layer.number): layer for layer in chamber.layers}
        tables["drift_chamber"] = opened(chamber) | relation_of_all(chamber) | {"layers": layers}
        if chamber.superlayers:
            superlayers = {part.label: part for part in chamber.superlayers}
            tables["drift_chamber"] |= {"superlayers": superlayers, GENERATED: True}
    elif chamber:
        tables["drift_chamber"] = chamber
    return tables | {"materials": {material.name: material for material in own_materials(detector)}}


@once
def own_materials(detector: Contents) -> list[Material]:
    """Return the materials of a detector that differ from those that come with the program."""
    used = {m.name: m for m in materials_of(detector)}
    return [material for name, material in used.items() if library().get(name) != material]


def materials_of(detector: Contents) -> list[Material]:
    """Return every material of a detector."""
    materials = [detector.air, *(part.material for part in (*detector.beam_pipe, *detector.walls))]
    for _, layers in detector.by_kind():
        materials += [material for layer in layers for material in layer.materials()]
    return [*materials, *(detector.drift_chamber.materials() if detector.drift_chamber else ())]


def to_toml(detector: Contents) -> str:
    """Return a complete detector file as text."""
    return toml_text(to_dict(detector), in_place=("composition", "density_effect"))


@once
def stored_toml(detector: Contents) -> str:
    """Return the detector file that `write_files` writes, the same in any folder."""
    tables = to_dict(detector)
    if (name := _map_beside(detector)) is not None:
        tables["field"]["file"] = name
        tables["field"].pop("mirror", None)  # that map is complete
    return toml_text(tables, in_place=("composition", "density_effect"))


def write_files(folder: Path, detectors: Mapping[str, Contents]) -> list[Path]:
    """Write detector files by name, with field maps beside them, so that the folder may be moved; return all files."""
    written = []
    for name, detector in detectors.items():
        with new_file(folder / name, overwrite=True) as temporary:
            temporary.write_text(stored_toml(detector), encoding="utf-8")
        written.append(folder / name)
        field, beside = detector.field, _map_beside(detector)
        if beside is not None and (path := written[-1].with_name(beside)) not in written:
            assert isinstance(field, MapField)
            written.append(write_field_map(path, field.grid.columns, overwrite=True))
    return written


def _map_beside(detector: Contents) -> str | None:
    """Return the name of the map beside stored detector files; None without a map, or with one of the program."""
    field = detector.field
    if not isinstance(field, MapField) or field.file.startswith(OWN_MAP):
        return None
    return f"field-{field.checksum}.npz"


def _table(part: Any) -> dict[str, Any]:
    kind: Any = type(part)
    stated = keys_of(kind).items()
    keys = {name: key for name, key in stated if not key.quiet or getattr(part, name) != default(kind, name)}
    usual = getattr(part, "usual_readout", None)
    keys = {name: key for name, key in keys.items() if key.kind != "readout" or getattr(part, name) != usual}
    table = {name: _value(getattr(part, name), key.kind) for name, key in keys.items()}
    if table.get("sigma_points"):
        table |= dict.fromkeys(("sigma", "sigma_slope"))
    if table.get("z_min"):
        table[kind.short_form[0]] = None
    return {name: value for name, value in table.items() if value not in (None, {}, "", [])}


def _value(value: Any, kind: str) -> Any:
    if value is None:
        return None
    if isinstance(value, Readout):
        return _readout(value)
    if isinstance(value, Material):
        return value.name
    if isinstance(value, DensityEffect):
        return value._asdict()
    if kind == "composition":
        return dict(value)
    if kind in ("profile", "relation", "errors"):
        return [_table(point) for point in value]
    if kind in ("counts", "mirrors"):
        return list(value)
    if kind == "stack":
        return [_sub_layer(part) for part in value]
    if kind == "wires":
        return [_table(one) for one in value]
    if kind == "strips":
        return [strip_text(*one) for one in value]
    if kind in OF_LISTS:
        return [format_quantity(one, OF_LISTS[kind]) for one in value]
    if kind == "channels":
        return [wire_text(*one) for one in value]
    if kind == "gains":
        return [grid[0][0] if len(grid) == len(grid[0]) == 1 else [list(row) for row in grid] for grid in value]
    if kind in NATIVE and kind != "dimensionless":
        return format_quantity(value, kind)
    return value


def _readout(readout: Readout) -> str | dict[str, Any]:
    """Return a readout as a file states it: its name, and what differs from its defaults."""
    kind: Any = type(readout)
    keys = keys_of(kind)
    stated = {
        name: _value(value, keys[name].kind) if name in keys else value for name, value in readout.stated().items()
    }
    return stated if len(stated) > 1 else readout.name


def _sub_layer(part: SubLayer) -> dict[str, Any]:
    return {"label": part.label, **_table(part)}


_NUMBER = r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"
_WIRE_NUMBER = rf"^({WIRE_NUMBER})$"


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a detector file.

    A file with a base may state any part of a table; without a base, tables must be complete.

    Examples
    --------
    >>> from cgemit.detector import schema
    >>> sorted(schema())[:2]
    ['$defs', '$schema']
    """
    parts = {
        "partial": _top(complete=False),
        "complete": _top(complete=True),
        "sub_layer": _schema_table(SubLayer, complete=True),
        "rate_point": _schema_table(RatePoint, complete=True),
        "cell_wire": _schema_table(CellWire, complete=True),
        "drift_point": _schema_table(DriftPoint, complete=True),
        "error_point": _schema_table(ErrorPoint, complete=True),
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "cgemit detector",
        "description": "A tracker of cylindrical GEM layers and drift chambers. Quantities are strings with units.",
        "type": "object",
        "if": {"required": ["base"]},
        "then": {"$ref": "#/$defs/partial"},
        "else": {"$ref": "#/$defs/complete"},
        "$defs": parts,
    }


def _top(complete: bool) -> dict[str, Any]:
    kinds: dict[str, dict[str, Any]] = {
        "field": _field(complete),
        "beam_pipe": _labelled(_schema_table(Cylinder, complete)),
        **{group: _labelled(_layer(kind, complete)) for group, kind in LAYER_KINDS.items()},
        "walls": _labelled(_schema_table(Cylinder, complete)),
        "drift_chamber": _chamber(complete),
        "background": _labelled(_schema_table(BackgroundLevel, complete=False)),
        "materials": _labelled(_material()),
        "name": {"pattern": f"^{NAME}$"},
        "remove": {"type": "array", "items": {"type": "string"}},
        "readout": {"type": ["string", "object"], **_schema_value(keys_of(CgemLayer)["readout"])},
    }
    properties = {
        name: {"type": "string", **kinds.get(name, {}), "description": doc} for name, doc in TOP_LEVEL.items()
    }
    schema = {"type": "object", "properties": properties, "additionalProperties": False}
    if complete:
        schema |= {"required": ["field"], "anyOf": [{"required": [one]} for one in (*LAYER_KINDS, "drift_chamber")]}
    return schema


def _field(complete: bool) -> dict[str, Any]:
    """Return the field; with a base, the kind may be the base's, and any key may stand alone."""
    kinds = {name: _schema_table(kind, complete) for name, kind in KINDS.items()}
    if not complete:
        properties = {key: value for kind in kinds.values() for key, value in kind["properties"].items()}
        return {
            "type": "object",
            "properties": properties | {"kind": _schema_value(kind_key())},
            "additionalProperties": False,
        }
    for name, kind in kinds.items():
        kind["properties"]["kind"] = {"const": name}
        kind["required"] = sorted({*kind["required"], "kind"})
    return {"type": "object", "oneOf": list(kinds.values())}


def _labelled(table: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": table}


_LIKE = "label of the layer that this one is a copy of"


def _layer(kind: type, complete: bool) -> dict[str, Any]:
    """Return a layer: a copy of another one states what differs, and sub-layers of its stacks by label."""
    partial = _schema_table(kind, complete=False, more={"like": {"type": "string", "description": _LIKE}})
    rows = _labelled(_schema_table(SubLayer, complete=False))
    for name, one in keys_of(kind).items():
        if one.kind == "stack":
            whole = partial["properties"][name]
            about = {"description": whole.pop("description")}
            partial["properties"][name] = about | {"if": {"type": "object"}, "then": rows, "else": whole}
    if not complete:
        return partial
    return {"if": {"required": ["like"]}, "then": partial, "else": _schema_table(kind, complete=True)}


def _schema_table(kind: type, complete: bool, more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    keys = file_keys(kind)
    properties = {name: _schema_value(key) for name, key in keys.items()} | dict(more or {})
    schema = {"type": "object", "properties": properties, "additionalProperties": False}
    if not complete:
        return schema
    required = required_of(kind)
    short = getattr(kind, "short_form", ("",))[0]
    if short in required:
        schema["anyOf"] = [{"required": [short]}, {"required": ["z_min", "z_max"]}]
    return {**schema, "required": sorted(required - {short})}


_ENDS = ("half_length", "z_min", "z_max")


def _chamber(complete: bool) -> dict[str, Any]:
    """Return the drift chamber: values stated for all layers may be left out in each layer."""
    layer = _schema_table(WireLayer, complete)
    superlayer = _schema_table(Superlayer, complete)
    common = {name: layer["properties"][name] for name in FOR_ALL_LAYERS}
    if complete:
        layer["required"] = [name for name in layer["required"] if name not in common]
        superlayer["required"] = ["cells", "layers"]
        del superlayer["anyOf"]
    groups = {
        **{name: superlayer["properties"][name] for name in _ENDS},
        "layers": {"type": "object", "patternProperties": {_WIRE_NUMBER: layer}, "additionalProperties": False},
        "superlayers": _labelled(superlayer) | {"description": "wire layers from a few numbers, from inside, by label"},
    }
    schema = _schema_table(DriftChamber, complete, common | groups)
    ways = [{"required": ["layers"]}, {"required": ["superlayers"]}]
    return (
        {**schema, "oneOf": ways, "dependentRequired": {name: ["superlayers"] for name in _ENDS}}
        if complete
        else schema
    )


def _material() -> dict[str, Any]:
    bulk = ["density", "x0", "z_over_a", "excitation_energy"]
    ways = [["base"], ["density", "composition"], bulk]
    return {**_schema_table(Material, complete=False), "anyOf": [{"required": names} for names in ways]}


def _schema_value(key: Key) -> dict[str, Any]:
    limits = {} if key.low == -float("inf") else {"minimum": key.low, "maximum": key.high}
    if key.kind in NATIVE:
        return _quantity(key, limits)
    if key.kind == "cells":
        return {"description": key.doc, "anyOf": [_schema_value(one) for one in CELLS.values()]}
    if key.kind in OF_LISTS:
        value = _quantity(replace(key, kind=OF_LISTS[key.kind]), limits)
        if key.kind == "shifts":
            return {"description": key.doc, "type": "array", "items": value}
        rows = {"type": "array", "minItems": 1, "maxItems": MOST_POINTS, "items": value}
        return {"description": key.doc, "anyOf": [value, rows]}
    if key.kind == "readout":
        return {"description": key.doc, "anyOf": [{"type": "string"}, _schema_readout()]}
    kinds: dict[str, dict[str, Any]] = {
        "setting": {},
        "integer": {"type": "integer", **limits},
        "sign": {"enum": [-1, 1]},
        "boolean": {"type": "boolean"},
        "text": {"enum": list(key.choices)} if key.choices else {"type": "string"},
        "material": {"type": "string"},
        "gas": {"type": "string"},
        "stack": {"type": "array", "minItems": 1, "items": {"$ref": "#/$defs/sub_layer"}},
        "wires": {"type": "array", "maxItems": MOST_POINTS, "items": {"$ref": "#/$defs/cell_wire"}},
        "composition": {
            "anyOf": [
                {"type": "string", "pattern": r"^([A-Z][a-z]?([1-9]\d*)?)+$"},
                {"type": "object", "additionalProperties": {"type": "number", "exclusiveMinimum": 0, "maximum": 1}},
            ]
        },
        "profile": {"type": "array", "maxItems": MOST_POINTS, "items": {"$ref": "#/$defs/rate_point"}},
        "relation": {"type": "array", "maxItems": MOST_POINTS, "items": {"$ref": "#/$defs/drift_point"}},
        "errors": {"type": "array", "maxItems": MOST_POINTS, "items": {"$ref": "#/$defs/error_point"}},
        "counts": {"type": "array", "minItems": 1, "maxItems": MOST_POINTS, "items": {"type": "number", "minimum": 0}},
        "offset": {"anyOf": [{"const": CENTRED}, {"type": "number", **limits}]},
        "mirrors": {
            "anyOf": [{"enum": list(MIRRORS)}, {"type": "array", "uniqueItems": True, "items": {"enum": list(MIRRORS)}}]
        },
        "strips": {"type": "array", "items": {"type": "string", "pattern": f"^{STRIPS}$"}},
        "channels": {"type": "array", "items": {"type": "string", "pattern": f"^{WIRES}$"}},
        "gains": {"type": "array", "items": {"anyOf": [{"type": "number", **limits}, _grid(limits)]}},
        "numbers": {
            "type": "object",
            "properties": {name: {"type": "number"} for name in DensityEffect._fields},
            "required": list(DensityEffect._fields),
            "additionalProperties": False,
        },
    }
    return {"description": key.doc, **kinds[key.kind]}


def _schema_readout() -> dict[str, Any]:
    kinds: list[Any] = list(READOUTS.values())
    keys = {name: key for kind in kinds for name, key in keys_of(kind).items()}
    properties = {"name": {"type": "string"}} | {name: _schema_value(key) for name, key in keys.items()}
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _grid(limits: dict[str, float]) -> dict[str, Any]:
    row = {"type": "array", "minItems": 1, "items": {"type": "number", **limits}}
    return {"type": "array", "minItems": 1, "items": row}


def _quantity(key: Key, limits: dict[str, float]) -> dict[str, Any]:
    units = "|".join(re.escape(unit) for unit in units_of(key.kind) if unit)
    text = {"type": "string", "pattern": rf"^\s*{_NUMBER}\s*({units})\s*$"}
    if key.kind == "dimensionless":
        return {"description": key.doc, "anyOf": [{"type": "number", **limits}, text]}
    span = f" ({format_quantity(key.low, key.kind)} to {format_quantity(key.high, key.kind)})" if limits else ""
    return {"description": key.doc + span, **text}


_SCHEMA = "http://service-spi.web.cern.ch/service-spi/app/releases/GDML/schema/gdml.xsd"
_MARGIN = 10.0  # mm, from the detector to the wall of the world
_VACUUM = 1e-25  # g/cm3, as Geant4's G4_Galactic


def write_gdml(detector: Contents, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write the volumes and materials of a detector; see `Detector.to_gdml`."""
    tree = ElementTree.ElementTree(_gdml(detector))
    ElementTree.indent(tree, "  ")
    with new_file(path, overwrite=overwrite) as temporary, Path(temporary).open("wb") as stream:
        tree.write(stream, encoding="UTF-8", xml_declaration=True)


def _gdml(detector: Contents) -> ElementTree.Element:
    """Return the root of the file: a world of air with one tube for each shell, and a tube of vacuum on the axis."""
    found = [slab.shells for slab in slabs(detector, merge=False)]
    placed = [shells for shells in found if shells[0].ends != ENDLESS]
    low, high = zip(*(shell.ends for shells in placed for shell in shells), strict=True)
    whole, length = (min(low), max(high)), max(-min(low), max(high))
    radius = max(shell.r_out for shells in placed for shell in shells)
    root = ElementTree.Element("gdml")
    root.set("xmlns:xsi", "http://www.w3.org/2001/XMLSchema-instance")
    root.set("xsi:noNamespaceSchemaLocation", _SCHEMA)
    ElementTree.SubElement(root, "define")
    materials = _Materials(ElementTree.SubElement(root, "materials"))
    solids, structure = ElementTree.SubElement(root, "solids"), ElementTree.SubElement(root, "structure")
    volumes: list[tuple[str, float, float, tuple[float, float], str, float | None]] = [
        ("beam_vacuum", 0.0, placed[0][0].r_in, whole, "vacuum", None)
    ]
    for number, shells in enumerate(placed):
        name = _name(f"tube{number:03d}_{shells[0].group}_{shells[0].label}")
        shell = shells[0]
        volumes.append((name, shell.r_in, shell.r_out, shell.ends, materials.of(shells), _x0(shells)))
    for name, r_in, r_out, ends, material, x0 in volumes:
        attributes = {"name": f"{name}_solid", "lunit": "mm", "aunit": "deg", "startphi": "0", "deltaphi": "360"}
        size = {"rmin": repr(float(r_in)), "rmax": repr(float(r_out)), "z": repr(float(ends[1] - ends[0]))}
        ElementTree.SubElement(solids, "tube", attributes | size)
        _volume(structure, name, material, f"{name}_solid", x0)
    across, along = repr(2 * (radius + _MARGIN)), repr(2 * (length + _MARGIN))
    ElementTree.SubElement(solids, "box", name="world_solid", lunit="mm", x=across, y=across, z=along)
    air = Shell("air", "air", 0.0, 1.0, (-1.0, 1.0), detector.air)
    world = _volume(structure, "world", materials.of((air,)), "world_solid", detector.air.x0)
    for name, _, _, ends, *_ in volumes:
        physical = ElementTree.SubElement(world, "physvol", name=f"{name}_placed")
        ElementTree.SubElement(physical, "volumeref", ref=name)
        if middle := 0.5 * (ends[0] + ends[1]):
            attributes = {"name": f"{name}_position", "unit": "mm", "x": "0", "y": "0", "z": repr(float(middle))}
            ElementTree.SubElement(physical, "position", attributes)
    materials.write()
    setup = ElementTree.SubElement(root, "setup", name="Default", version="1.0")
    ElementTree.SubElement(setup, "world", ref="world")
    return root


def _volume(
    structure: ElementTree.Element, name: str, material: str, solid: str, x0: float | None
) -> ElementTree.Element:
    """Add a volume; the radiation length that cgemit uses stands beside it, since GDML has no place for it."""
    volume = ElementTree.SubElement(structure, "volume", name=name)
    ElementTree.SubElement(volume, "materialref", ref=material)
    ElementTree.SubElement(volume, "solidref", ref=solid)
    if x0 is not None:
        ElementTree.SubElement(volume, "auxiliary", auxtype="X0", auxvalue=repr(x0), auxunit="mm")
    return volume


def _x0(shells: Sequence[Shell]) -> float:
    """Return the radiation length of shells in the same place, mm: gas and the wires spread over it."""
    return 1 / sum(1 / shell.material.x0 for shell in shells)


class _Materials:
    """The materials of a file; equal ones are written once, under names that differ."""

    def __init__(self, parent: ElementTree.Element) -> None:
        self._parent = parent
        self._names: dict[tuple[Material, ...], str] = {}
        self._elements: set[str] = set()
        self._mixtures: list[ElementTree.Element] = []
        vacuum = ElementTree.Element("material", name="vacuum", Z="1")
        ElementTree.SubElement(vacuum, "D", value=repr(_VACUUM), unit="g/cm3")
        ElementTree.SubElement(vacuum, "atom", value="1.008")
        self._mixtures.append(vacuum)

    def of(self, shells: Sequence[Shell]) -> str:
        """Return the name of the material of shells in the same place."""
        key = tuple(shell.material for shell in shells)
        if key not in self._names:
            wanted = _name("_and_".join(material.name for material in key))
            taken = {*self._names.values(), "vacuum"}
            names = itertools.chain([wanted], (f"{wanted}_{i}" for i in itertools.count(2)))
            self._names[key] = next(name for name in names if name not in taken)
            self._mixtures.append(self._mixture(self._names[key], key))
        return self._names[key]

    def write(self) -> None:
        """Add elements and materials to the file, the elements first."""
        self._parent.extend(self._mixtures)

    def _mixture(self, name: str, parts: Sequence[Material]) -> ElementTree.Element:
        """Return a material; a mixture has the sum of the densities of its parts."""
        density = sum(part.density for part in parts)
        shares: dict[str, float] = {}
        for material in parts:
            for element, share in self._composition(material):
                shares[element] = shares.get(element, 0.0) + share * material.density / density
        gas = all(part.gas for part in parts)
        element_of_mixture = ElementTree.Element("material", name=name, state="gas" if gas else "solid")
        ElementTree.SubElement(element_of_mixture, "D", value=repr(density), unit="g/cm3")
        total = sum(shares.values())
        for element, share in shares.items():
            ElementTree.SubElement(element_of_mixture, "fraction", n=repr(share / total), ref=element)
        return element_of_mixture

    def _composition(self, material: Material) -> list[tuple[str, float]]:
        """Return the elements of a material by mass; one equivalent element where only bulk properties are known."""
        if not material.composition:
            ((equivalent, _),) = material.elements()
            name = _name(f"element_of_{material.name}")
            self._add(name, name, equivalent.z, equivalent.a)
            return [(name, 1.0)]
        for symbol, _ in material.composition:
            self._add(f"element_{symbol}", symbol, elements()[symbol].z, elements()[symbol].a)
        return [(f"element_{symbol}", share) for symbol, share in material.composition]

    def _add(self, name: str, formula: str, z: float, a: float) -> None:
        if name in self._elements:
            return
        self._elements.add(name)
        element = ElementTree.SubElement(self._parent, "element", name=name, formula=formula, Z=f"{z:g}")
        ElementTree.SubElement(element, "atom", type="A", unit="g/mol", value=repr(a))


def _name(text: str) -> str:
    """Return a name that XML allows as a reference."""
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", text)
    return plain if re.match(r"[A-Za-z_]", plain) else f"v{plain}"
