"""A detector in numbers: material and read-out as plain tables, units in the names."""

import math
from typing import Any

from cgemit.detector.field import field_text
from cgemit.detector.model import Detector
from cgemit.detector.parts import CgemLayer, WireLayer
from cgemit.detector.slabs import Slab, slabs


def describe(detector: Detector) -> dict[str, Any]:
    """Return everything that `cgemit show` prints, ready for JSON.

    Parameters
    ----------
    detector : Detector

    Returns
    -------
    dict
        name, description, field_t (at the origin), field (in words); `material`: one entry per scatterer with its
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


def _scatterer(detector: Detector, slab: Slab) -> dict[str, Any]:
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
