"""A detector as short text, as numbers in tables with units in their names, and as a detector file."""

import html
import math
from collections.abc import Container
from typing import Any

from cgemit.detector.field import field_text
from cgemit.detector.kept import once
from cgemit.detector.keys import keys_of, opened
from cgemit.detector.material import DensityEffect, Material
from cgemit.detector.materials import library
from cgemit.detector.parts import CgemLayer, Contents, SubLayer, WireLayer
from cgemit.detector.placement import PLACEMENT
from cgemit.detector.read_lists import strip_text
from cgemit.detector.slabs import Slab, slabs
from cgemit.io.toml import toml_text
from cgemit.units import NATIVE, format_quantity


def lines(detector: Contents) -> list[str]:
    """Return one line for the field and for each part that measures."""
    found = [f"field {field_text(detector.field)}"]
    for layer in detector.cgem:
        found.append(f"cgem {layer.label}: {layer.text()}")
    if detector.drift_chamber:
        found.append(f"drift chamber: {detector.drift_chamber.text()}")
    if detector.background:
        found.append("background: " + ", ".join(level.label for level in detector.background))
    return found


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
        `sub_layers`; `cgem` and `wires`: one entry per layer. Thickness in radiation lengths and energy loss at normal
        incidence.

    """
    material = [_scatterer(detector, slab) for slab in slabs(detector)]
    chamber = detector.drift_chamber
    wires = zip(chamber.layers, chamber.gid_first, strict=True) if chamber else ()
    return {
        "name": detector.name,
        "description": detector.description,
        "field_t": detector.field.bz,
        "field": field_text(detector.field),
        "material": material,
        "cgem": [_cgem(layer) for layer in detector.cgem],
        "wires": [_wires(layer, gid) for layer, gid in wires],
    }


def _scatterer(detector: Contents, slab: Slab) -> dict[str, Any]:
    first = slab.shells[0]
    middle = 0.5 * (slab.r_in + slab.r_out)
    owner = next((layer.label for layer in detector.cgem if layer.r_in < middle < layer.r_out), None)
    names = {"pipe": "beam pipe", "drift": "drift gap", "gas": "chamber gas"}
    part = names.get(first.group, first.group)
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
        "part": f"{owner} {part}" if owner else part,
        "r_in_mm": slab.r_in,
        "r_out_mm": slab.r_out,
        "radius_mm": slab.radius,
        "x0_percent": 100 * slab.x0,
        "sub_layers": rows,
    }


def _cgem(layer: CgemLayer) -> dict[str, Any]:
    return {
        "layer": layer.label,
        "r_mid_gap_mm": layer.r_mid,
        "r_readout_mm": layer.r_readout,
        "length_mm": layer.length,
        "drift_gap_mm": layer.drift_gap,
        "hole_outer_um": 1000 * layer.hole_outer,
        "hole_inner_um": 1000 * layer.hole_inner,
        "hole_pitch_um": 1000 * layer.hole_pitch,
        "sheets": layer.sheets,
        "phi_first_deg": math.degrees(layer.phi_first) % 360,
        "pitch_x_um": 1000 * layer.pitch_x,
        "pitch_v_um": 1000 * layer.pitch_v,
        "strips_x": layer.strips_x,
        "strips_v": layer.strips_v,
        "offset_v": layer.offset_v,
        "stereo_deg": math.degrees(layer.stereo),
    }


def _wires(layer: WireLayer, gid_first: int) -> dict[str, Any]:
    tilt = math.atan(layer.r_end * math.sin(0.5 * layer.twist) / layer.half_length)
    return {
        "layer": layer.number,
        "cells": layer.cells,
        "gid_first": gid_first,
        "r_end_mm": layer.r_end,
        "r_mid_mm": layer.r_mid,
        "half_length_mm": layer.half_length,
        "twist_deg": math.degrees(layer.twist),
        "tilt_mrad": 1000 * tilt,
        "phi_east_deg": math.degrees(layer.phi_east),
        "sigma_um": 1000 * layer.sigma,
        "sigma_slope_um_per_mm": 1000 * layer.sigma_slope,
        "efficiency": layer.efficiency,
    }


def to_dict(detector: Contents) -> dict[str, Any]:
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
    tables["background"] = {level.label: _table(level) for level in detector.background}
    tables["materials"] = {m.name: _table(m) for m in own_materials(detector)}
    return {name: value for name, value in tables.items() if value != {}}


def tables_of(detector: Contents, changed: Container[str] = ()) -> dict[str, Any]:
    """Return the tables of a complete detector file with its parts as they are, for variants (`merge.merged`).

    The drift chamber is a table of layers if `changed` names a group that changes it, otherwise one part.
    """
    tables: dict[str, Any] = {"name": detector.name, "description": detector.description, "field": detector.field}
    tables |= {group: {part.label: part for part in getattr(detector, group)} for group in _GROUPS}
    chamber = detector.drift_chamber
    if chamber and any(group in changed for group in ("drift_chamber", "materials", "remove")):
        layers = {str(layer.number): layer for layer in chamber.layers}
        tables["drift_chamber"] = opened(chamber) | {"layers": layers}
    elif chamber:
        tables["drift_chamber"] = chamber
    return tables | {"materials": {material.name: material for material in own_materials(detector)}}


_GROUPS = ("beam_pipe", "cgem", "walls", "background")


@once
def own_materials(detector: Contents) -> list[Material]:
    """Return the materials of a detector that differ from those that come with the program."""
    used = {m.name: m for m in materials_of(detector)}
    return [material for name, material in used.items() if library().get(name) != material]


def materials_of(detector: Contents) -> list[Material]:
    """Return every material of a detector."""
    found = [detector.air, *(part.material for part in (*detector.beam_pipe, *detector.walls))]
    for layer in detector.cgem:
        found += [layer.gas, *(part.material for part in (*layer.cathode, *layer.foil, *layer.anode))]
    if detector.drift_chamber:
        found += [detector.drift_chamber.gas, detector.drift_chamber.wire_material]
    return found


def to_toml(detector: Contents) -> str:
    """Return a complete detector file as text."""
    return toml_text(to_dict(detector), in_place=("composition", "density_effect"))


def _table(part: Any) -> dict[str, Any]:
    kind: Any = type(part)
    keys = {name: key for name, key in keys_of(kind).items() if name not in PLACEMENT or getattr(part, name) != 0}
    found = {name: _value(getattr(part, name), key.kind) for name, key in keys.items()}
    return {name: value for name, value in found.items() if value not in ({}, "", [])}


def _value(value: Any, kind: str) -> Any:
    if isinstance(value, Material):
        return value.name
    if isinstance(value, DensityEffect):
        return value._asdict()
    if kind == "composition":
        return dict(value)
    if kind == "profile":
        return [_table(point) for point in value]
    if kind == "counts":
        return list(value)
    if kind == "stack":
        return [_sub_layer(part) for part in value]
    if kind == "strips":
        return [strip_text(*one) for one in value]
    if kind == "gains":
        return [grid[0][0] if len(grid) == len(grid[0]) == 1 else [list(row) for row in grid] for grid in value]
    if kind in NATIVE and kind != "dimensionless":
        return format_quantity(value, kind)
    return value


def _sub_layer(part: SubLayer) -> dict[str, Any]:
    return {"label": part.label, **_table(part)}
