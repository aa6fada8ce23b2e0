"""A detector as tables and as TOML text; reading them back gives an equal detector."""

from typing import Any

from cgemit.detector.keys import keys_of
from cgemit.detector.material import DensityEffect, Material
from cgemit.detector.model import Detector
from cgemit.detector.parts import SubLayer
from cgemit.io.toml import toml_text
from cgemit.units import NATIVE, format_quantity


def to_dict(detector: Detector) -> dict[str, Any]:
    """Return the tables of a complete detector file: quantities as text in native units, all digits kept."""
    tables: dict[str, Any] = {"name": detector.name, "description": detector.description}
    tables["field"] = _table(detector.field)
    tables["beam_pipe"] = {part.label: _table(part) for part in detector.beam_pipe}
    tables["cgem"] = {layer.label: _table(layer) for layer in detector.cgem}
    tables["walls"] = {part.label: _table(part) for part in detector.walls}
    if detector.drift_chamber:
        tables["drift_chamber"] = _table(detector.drift_chamber)
        layers = {str(layer.number): _table(layer) for layer in detector.drift_chamber.layers}
        tables["drift_chamber"]["layers"] = layers
    tables["materials"] = {m.name: _table(m) for m in own_materials(detector)}
    return {name: value for name, value in tables.items() if value != {}}


def own_materials(detector: Detector) -> list[Material]:
    """Return the materials of a detector that differ from those that come with the program."""
    from cgemit.detector.build import library

    used = {m.name: m for m in materials_of(detector)}
    return [material for name, material in used.items() if library().get(name) != material]


def materials_of(detector: Detector) -> list[Material]:
    """Return every material of a detector."""
    found = [detector.air, *(part.material for part in (*detector.beam_pipe, *detector.walls))]
    for layer in detector.cgem:
        found += [layer.gas, *(part.material for part in (*layer.cathode, *layer.foil, *layer.anode))]
    if detector.drift_chamber:
        found += [detector.drift_chamber.gas, detector.drift_chamber.wire_material]
    return found


def to_toml(detector: Detector) -> str:
    """Return a complete detector file as text."""
    return toml_text(to_dict(detector), in_place=("composition", "density_effect"))


def _table(part: Any) -> dict[str, Any]:
    found = {name: _value(getattr(part, name), key.kind) for name, key in keys_of(type(part)).items()}
    return {name: value for name, value in found.items() if value not in ({}, "")}


def _value(value: Any, kind: str) -> Any:
    if isinstance(value, Material):
        return value.name
    if isinstance(value, DensityEffect):
        return value._asdict()
    if kind == "composition":
        return dict(value)
    if kind == "stack":
        return [_sub_layer(part) for part in value]
    if kind in NATIVE and kind != "dimensionless":
        return format_quantity(value, kind)
    return value


def _sub_layer(part: SubLayer) -> dict[str, Any]:
    return {"label": part.label, **_table(part)}
