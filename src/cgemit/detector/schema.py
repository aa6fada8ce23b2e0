"""JSON Schema of detector files, for editors: made from the same keys that the reader uses."""

import re
from collections.abc import Mapping
from typing import Any

from cgemit.detector.background import BackgroundLevel, RatePoint
from cgemit.detector.field import KINDS, kind_key
from cgemit.detector.keys import CENTRED, Key, keys_of, required_of
from cgemit.detector.material import DensityEffect, Material
from cgemit.detector.merge import FOR_ALL_LAYERS
from cgemit.detector.parts import CgemLayer, Cylinder, DriftChamber, SubLayer, WireLayer
from cgemit.detector.read import EXTRA, NAME, TOP_LEVEL, WIRE_NUMBER
from cgemit.detector.read_lists import MOST_POINTS, STRIPS
from cgemit.units import NATIVE, format_quantity, units_of

_NUMBER = r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"
_WIRE_NUMBER = rf"^({WIRE_NUMBER})$"


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a detector file.

    A file with a base may state any part of a table; without a base, tables must be complete.
    """
    parts = {
        "partial": _top(complete=False),
        "complete": _top(complete=True),
        "sub_layer": _table(SubLayer, complete=True),
        "rate_point": _table(RatePoint, complete=True),
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
        "beam_pipe": _labelled(_table(Cylinder, complete)),
        "cgem": _labelled(_layer(complete)),
        "walls": _labelled(_table(Cylinder, complete)),
        "drift_chamber": _chamber(complete),
        "background": _labelled(_table(BackgroundLevel, complete=False)),
        "materials": _labelled(_material()),
        "name": {"pattern": f"^{NAME}$"},
        "remove": {"type": "array", "items": {"type": "string"}},
    }
    properties = {
        name: {"type": "string", **kinds.get(name, {}), "description": doc} for name, doc in TOP_LEVEL.items()
    }
    found = {"type": "object", "properties": properties, "additionalProperties": False}
    if complete:
        found |= {"required": ["field"], "anyOf": [{"required": ["cgem"]}, {"required": ["drift_chamber"]}]}
    return found


def _field(complete: bool) -> dict[str, Any]:
    """Return the field; with a base, the kind may be the base's, and any key may stand alone."""
    kinds = {name: _table(kind, complete) for name, kind in KINDS.items()}
    if not complete:
        properties = {key: value for kind in kinds.values() for key, value in kind["properties"].items()}
        return {
            "type": "object",
            "properties": properties | {"kind": _value(kind_key())},
            "additionalProperties": False,
        }
    for name, kind in kinds.items():
        kind["properties"]["kind"] = {"const": name}
        kind["required"] = sorted({*kind["required"], "kind"})
    return {"type": "object", "oneOf": list(kinds.values())}


def _labelled(table: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": table}


_LIKE = "label of the layer that this one is a copy of"


def _layer(complete: bool) -> dict[str, Any]:
    """Return a CGEM layer: a copy of another one states what differs, and sub-layers of its stacks by label."""
    partial = _table(CgemLayer, complete=False, more={"like": {"type": "string", "description": _LIKE}})
    rows = _labelled(_table(SubLayer, complete=False))
    for name, one in keys_of(CgemLayer).items():
        if one.kind == "stack":
            whole = partial["properties"][name]
            about = {"description": whole.pop("description")}
            partial["properties"][name] = about | {"if": {"type": "object"}, "then": rows, "else": whole}
    if not complete:
        return partial
    return {"if": {"required": ["like"]}, "then": partial, "else": _table(CgemLayer, complete=True)}


def _table(kind: type, complete: bool, more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    keys = {**keys_of(kind), **EXTRA.get(kind, {})}
    properties = {name: _value(key) for name, key in keys.items()} | dict(more or {})
    found = {"type": "object", "properties": properties, "additionalProperties": False}
    return {**found, "required": sorted(required_of(kind))} if complete else found


def _chamber(complete: bool) -> dict[str, Any]:
    """Return the drift chamber: values stated for all layers may be left out in each layer."""
    layer = _table(WireLayer, complete)
    common = {name: layer["properties"][name] for name in FOR_ALL_LAYERS}
    if complete:
        layer["required"] = [name for name in layer["required"] if name not in common]
    layers = {"type": "object", "patternProperties": {_WIRE_NUMBER: layer}, "additionalProperties": False}
    found = _table(DriftChamber, complete, {**common, "layers": layers})
    return {**found, "required": [*found["required"], "layers"]} if complete else found


def _material() -> dict[str, Any]:
    bulk = ["density", "x0", "z_over_a", "excitation_energy"]
    ways = [["base"], ["density", "composition"], bulk]
    return {**_table(Material, complete=False), "anyOf": [{"required": names} for names in ways]}


def _value(key: Key) -> dict[str, Any]:
    limits = {} if key.low == -float("inf") else {"minimum": key.low, "maximum": key.high}
    if key.kind in NATIVE:
        return _quantity(key, limits)
    kinds: dict[str, dict[str, Any]] = {
        "integer": {"type": "integer", **limits},
        "sign": {"enum": [-1, 1]},
        "boolean": {"type": "boolean"},
        "text": {"enum": list(key.choices)} if key.choices else {"type": "string"},
        "material": {"type": "string"},
        "gas": {"type": "string"},
        "stack": {"type": "array", "minItems": 1, "items": {"$ref": "#/$defs/sub_layer"}},
        "composition": {
            "anyOf": [
                {"type": "string", "pattern": r"^([A-Z][a-z]?([1-9]\d*)?)+$"},
                {"type": "object", "additionalProperties": {"type": "number", "exclusiveMinimum": 0, "maximum": 1}},
            ]
        },
        "profile": {"type": "array", "maxItems": MOST_POINTS, "items": {"$ref": "#/$defs/rate_point"}},
        "counts": {"type": "array", "minItems": 1, "maxItems": MOST_POINTS, "items": {"type": "number", "minimum": 0}},
        "offset": {"anyOf": [{"const": CENTRED}, {"type": "number", **limits}]},
        "strips": {"type": "array", "items": {"type": "string", "pattern": f"^{STRIPS}$"}},
        "gains": {"type": "array", "items": {"anyOf": [{"type": "number", **limits}, _grid(limits)]}},
        "numbers": {
            "type": "object",
            "properties": {name: {"type": "number"} for name in DensityEffect._fields},
            "required": list(DensityEffect._fields),
            "additionalProperties": False,
        },
    }
    return {"description": key.doc, **kinds[key.kind]}


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
