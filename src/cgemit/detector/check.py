"""Checks of a detector's values and geometry; each returns all problems it finds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from cgemit import _core
from cgemit.base.errors import Problem
from cgemit.detector.field import Field, FieldGrid, MapField, field_range
from cgemit.detector.keys import Part, keys_of, once
from cgemit.detector.parts import (
    STACKS,
    CgemLayer,
    Contents,
    Cylinder,
    DriftChamber,
    MeasurementLayer,
    WireLayer,
    extent,
    layers_of,
)
from cgemit.detector.reader import strip_text
from cgemit.units import NATIVE, format_quantity

TOUCH = 1e-6  # mm; parts closer than this touch
_COIL = 1.25
_THICK = 1000.0  # mm; no coil behind a tracker is thicker


def value_problems(detector: Contents) -> list[Problem]:
    """Return the values that lie outside the range of their key, for detectors made in Python."""
    problems = _below("field", _part_problems(detector.field))
    for group in ("beam_pipe", "walls", "background", "cgem", "layer"):
        for part in getattr(detector, group):
            if found := _part_problems(part):
                problems += _below(f"{group}.{part.label}", found)
    chamber = detector.drift_chamber
    problems += _below("drift_chamber", _part_problems(chamber)) if chamber else []
    return problems + field_problems(detector.field) + _coil_problems(detector)


#: T. A map may be that of straight tracks at the origin only if it is weak everywhere.
_WEAK = 1e-2


def field_problems(field: Field) -> list[Problem]:
    """Return whether a map bends tracks, but not at the origin: kappa of a curvature is that in the field there."""
    if not isinstance(field, MapField) or not isinstance(field.grid, FieldGrid):
        return []
    if not abs(field.bz) < _core.kalman.STRAIGHT_FIELD:
        return []
    own = abs(field.grid.bz_at_origin())
    largest = field.grid.largest() * (abs(field.bz) / own if own else 1.0)
    if largest < _WEAK:
        return []
    least = f"at least {1e3 * _core.kalman.STRAIGHT_FIELD:g} mT, or a map below {1e3 * _WEAK:g} mT everywhere"
    return [Problem("field.bz", f"{field.bz:g} T at the origin of a map of up to {largest:.3g} T", least)]


def _coil_problems(detector: Contents) -> list[Problem]:
    """Return whether the coil is not well outside the detector: close to it no grid follows its field."""
    radius = getattr(detector.field, "coil_radius", math.inf)
    if radius == math.inf or radius >= (least := _COIL * extent(detector)[0]):
        return []
    return [
        Problem("field.coil_radius", f"{radius:g} mm", f"at least {least:g} mm, {_COIL} times the detector's radius")
    ]


def _below(path: str, problems: Sequence[Problem]) -> list[Problem]:
    return [problem._replace(path=f"{path}.{problem.path}") for problem in problems]


_NUMBERS = (int, float)


@once
def _part_problems(part: Part) -> list[Problem]:
    """Return the problems of a part and of the parts in it, with paths that begin inside the part."""
    problems = []
    kind: Any = type(part)
    for name, key in keys_of(kind).items():
        value = getattr(part, name)
        if type(value) is float and key.low <= value <= key.high and abs(value) < math.inf:
            continue  # most values, without the time of a call
        if isinstance(value, _NUMBERS) and not isinstance(value, bool) and not key.admits(value):
            shown = format_quantity(value, key.kind) if key.kind in NATIVE else str(value)
            hint = _derived_from(part, name) if isinstance(part, CgemLayer) else ""
            problems.append(Problem(name, shown, key.expected(), hint))
        elif key.kind == "gas" and value is not None and not value.gas:
            problems.append(Problem(name, f'"{value.name}", which is no gas', key.expected()))
        elif key.choices and value not in key.choices:
            problems.append(Problem(name, repr(value), key.expected()))
    for name in STACKS.get(kind, ()):
        for i, one in enumerate(getattr(part, name)):
            if found := _part_problems(one):
                problems += _below(f"{name}[{i}]", found)
    if isinstance(part, DriftChamber):
        for layer in part.layers:
            problems += _below(f"layers.{layer.number}", _part_problems(layer))
    return problems


#: Values of a CGEM layer that follow from others unless they are given.
_DERIVED = {
    "strips_x": ("anode_radius", "sheets", "pitch_x"),
    "stereo": ("anode_radius", "sheets", "length"),
    "strips_v": ("anode_radius", "sheets", "length", "pitch_v"),
}


def _derived_from(layer: CgemLayer, name: str) -> str:
    """Return what a value follows from, as a hint; nothing if it does not follow from others."""
    values = ((one, getattr(layer, one), keys_of(CgemLayer)[one].kind) for one in _DERIVED.get(name, ()))
    texts = [f"{one} = {format_quantity(value, kind) if kind in NATIVE else value}" for one, value, kind in values]
    return f"unless given, it follows from {', '.join(texts)}" if texts else ""


def geometry_problems(
    beam_pipe: Sequence[Cylinder],
    cgem: Sequence[CgemLayer],
    layers: Sequence[MeasurementLayer],
    walls: Sequence[Cylinder],
    chamber: DriftChamber | None,
) -> list[Problem]:
    """Return overlaps, inverted cylinders, implausible thicknesses, and strips and holes that do not fit."""
    problems: list[Problem] = []
    spans: list[Span] = []
    for group, cylinders in (("beam_pipe", beam_pipe), ("walls", walls)):
        for part in cylinders:
            wrong = _cylinder_problem(f"{group}.{part.label}", part)
            problems += wrong
            spans += [] if wrong else [Span(part.r_in, part.r_out, part.half_length, f"{group}.{part.label}")]
    for layer in cgem:
        problems += _read_out_problems(layer)
        if layer.r_in <= 0:
            given = f"an inner face at {layer.r_in:g} mm"
            problems.append(Problem(f"cgem.{layer.label}", given, "gaps and electrodes that fit inside anode_radius"))
            continue
        spans.append(Span(layer.r_in, layer.r_out, layer.half_length, f"cgem.{layer.label}"))
    for sensor in layers:
        problems += _sensor_problems(sensor)
        spans.append(Span(sensor.r_in, sensor.r_out, sensor.half_length, f"layer.{sensor.label}"))
    problems += _overlaps(spans)
    if chamber and _has_wires(chamber):
        problems += _chamber_problems(chamber)
        wires = _sound_layers(chamber)
        innermost = min((layer.r_mid for layer in wires), default=math.inf)
        near = [span for span in spans if not span.r_out <= innermost]  # all, if the first radius could not be read
        problems += [problem for span in near for problem in _wires_inside(span, wires)]
    return problems


def _cylinder_problem(path: str, part: Cylinder) -> list[Problem]:
    if part.thickness <= 0:
        return [Problem(f"{path}.r_out", f"{part.r_out:g} mm", f"more than r_in = {part.r_in:g} mm")]
    if part.thickness > _THICK:
        return [Problem(f"{path}.r_out", f"a thickness of {part.thickness:g} mm", f"at most {_THICK:g} mm")]
    return []


def unreachable(detector: Contents) -> list[str]:
    """Return what part of each layer no track from the origin reaches; empty if all are reached.

    Straight tracks reach every point of the field's range. Tracks end at its edge.

    Parameters
    ----------
    detector : Contents
    """
    radius, first, last = field_range(detector.field)
    found: dict[str, list[str]] = {}
    for layer in layers_of(detector):
        path = f"{'cgem' if isinstance(layer, CgemLayer) else 'layer'}.{layer.label}"
        inside = layer.half_length if layer.r_gap_out <= radius else -math.inf
        if text := _unreached(layer.half_length, max(first, -inside), min(last, inside)):
            found.setdefault(text, []).append(path)
    for wire in detector.drift_chamber.layers if detector.drift_chamber else ():
        inside = _inside(wire, radius)
        if text := _unreached(wire.half_length, max(first, -inside), min(last, inside)):
            found.setdefault(text, []).append(f"drift_chamber.layers.{wire.number}")
    whole = len(layers_of(detector)) + (len(detector.drift_chamber.layers) if detector.drift_chamber else 0)
    return [f"{', '.join(_shortened(paths))} ({len(paths)} of {whole} layers): {text}" for text, paths in found.items()]


def _inside(wire: WireLayer, radius: float) -> float:
    """Return the |z| up to which wires are within a radius, mm; below 0 if they are nowhere."""
    if wire.r_end <= radius:
        return wire.half_length
    if wire.r_mid > radius:
        return -math.inf
    return wire.half_length * math.sqrt((radius**2 - wire.r_mid**2) / (wire.r_end**2 - wire.r_mid**2))


def _unreached(half_length: float, first: float, last: float) -> str:
    """Return what is left of a layer outside of the z from first to last; empty if nothing is."""
    if first > last:
        return "no track from the origin reaches it: the field ends before"
    below, above = first > -half_length, last < half_length
    if not (below or above):
        return ""
    places = [f"z below {first:g} mm"] * below + [f"z above {last:g} mm"] * above
    return f"no track from the origin reaches {' and '.join(places)}: the field ends there"


def _shortened(paths: Sequence[str]) -> Sequence[str]:
    return paths if len(paths) < 4 else [paths[0], f"{len(paths) - 2} more", paths[-1]]


@once
def _read_out_problems(layer: CgemLayer) -> list[Problem]:
    return _strip_problems(layer) + _hole_problems(layer) + _map_problems(layer) + _dead_problems(layer)


@once
def _sensor_problems(layer: MeasurementLayer) -> list[Problem]:
    """Return a sensor that begins inside the beam line, and wrong sizes, angles and errors of its coordinates."""
    path = f"layer.{layer.label}"
    problems = []
    if layer.r_in <= 0:
        problems.append(Problem(f"{path}.thickness", f"{layer.thickness:g} mm", "an inner face outside the beam line"))
    for view in "xv":
        pitch = getattr(layer, f"pitch_{view}")
        most = 2 * math.pi * layer.radius if view == "x" else layer.extent_v
        if pitch > most:
            problems.append(
                Problem(f"{path}.pitch_{view}", f"{pitch:g} mm", f"at most {most:g} mm, the size of the layer")
            )
        if pitch and getattr(layer, f"sigma_{view}"):
            given = f"{pitch:g} mm and sigma_{view} = {getattr(layer, f'sigma_{view}'):g} mm"
            expected = "one of them: strips have the error pitch/sqrt(12)"
            problems.append(Problem(f"{path}.pitch_{view}", given, expected))
    for view in layer.views:
        if layer.sigma_tan and not getattr(layer, f"sigma_{view.lower()}"):
            given = f"{layer.sigma_tan:g} mm and no sigma_{view.lower()}"
            problems.append(Problem(f"{path}.sigma_tan", given, "a sigma of each coordinate that is measured"))
    if "V" in layer.views and abs(layer.stereo) < 1e-3:
        given = f"{1000 * layer.stereo:g} mrad"
        problems.append(Problem(f"{path}.stereo", given, "at least 1 mrad, either sign: otherwise V is X"))
    return problems


def _strip_problems(layer: CgemLayer) -> list[Problem]:
    """Return X strips wider than the sheet and V strips beyond its far corner."""
    path = f"cgem.{layer.label}"
    width = 2 * math.pi * layer.r_readout / layer.sheets
    problems = []
    if layer.strips_x * layer.pitch_x > width + TOUCH:
        most = math.floor(width / layer.pitch_x + 1e-9)
        given = f"{layer.strips_x} strips of {layer.pitch_x:g} mm"
        problems.append(Problem(f"{path}.strips_x", given, f"at most {most} on a sheet {width:.3f} mm wide"))
        return problems  # V strips cross the X strips: nothing to say about them yet
    extent = layer.strips_x * layer.pitch_x * math.cos(layer.stereo) + layer.length * math.sin(abs(layer.stereo))
    if (layer.strips_v + layer.offset_v) * layer.pitch_v > extent + TOUCH:
        most = math.floor(extent / layer.pitch_v - layer.offset_v + 1e-9)
        given = f"{layer.strips_v} strips of {layer.pitch_v:g} mm"
        given += f" after an offset of {layer.offset_v:g} strips" if layer.offset_v else ""
        problems.append(
            Problem(f"{path}.strips_v", given, f"at most {most}: the sheet measures {extent:.3f} mm along V")
        )
    if abs(layer.stereo) < math.radians(1):
        given = f"{math.degrees(layer.stereo):g} deg"
        expected = "at least 1 deg, either sign: otherwise z is not measured"
        problems.append(Problem(f"{path}.stereo", given, expected, _derived_from(layer, "stereo")))
    return problems


def _map_problems(layer: CgemLayer) -> list[Problem]:
    """Return strips that the layer does not have, and gains of sheets that it does not have."""
    problems = []
    for view, strips in (("x", layer.strips_x), ("v", layer.strips_v)):
        for name in (f"dead_{view}", f"hot_{view}"):
            for i, (sheet, first, last) in enumerate(getattr(layer, name)):
                if sheet >= layer.sheets or not first <= last or last >= strips:
                    expected = f"sheet 0 to {layer.sheets - 1} and strips 0 to {strips - 1}, first to last"
                    path = f"cgem.{layer.label}.{name}[{i}]"
                    problems.append(Problem(path, strip_text(sheet, first, last), expected))
    if layer.gain_map and len(layer.gain_map) != layer.sheets:
        given = f"gains of {len(layer.gain_map)} sheets"
        problems.append(Problem(f"cgem.{layer.label}.gain_map", given, f"those of {layer.sheets}"))
    return problems


def _dead_problems(layer: CgemLayer) -> list[Problem]:
    """Return dead seams and ends that leave nothing of a sheet."""
    sizes = (
        ("dead_seam", layer.dead_seam, layer.strips_x * layer.pitch_x),
        ("dead_ends", layer.dead_ends, layer.half_length),
    )
    return [
        Problem(f"cgem.{layer.label}.{name}", f"{given:g} mm", f"less than {most:g} mm, which leaves a part of a sheet")
        for name, given, most in sizes
        if given > 0 and given >= most
    ]


def _hole_problems(layer: CgemLayer) -> list[Problem]:
    """Return holes of a foil that are wider inside than outside, or that touch."""
    path = f"cgem.{layer.label}"
    problems = []
    if layer.hole_inner > layer.hole_outer:
        expected = f"at most hole_outer = {layer.hole_outer:g} mm"
        problems.append(Problem(f"{path}.hole_inner", f"{layer.hole_inner:g} mm", expected))
    if layer.hole_outer >= layer.hole_pitch:
        expected = f"less than hole_pitch = {layer.hole_pitch:g} mm"
        problems.append(Problem(f"{path}.hole_outer", f"{layer.hole_outer:g} mm", expected))
    return problems


@once
def _chamber_problems(chamber: DriftChamber) -> list[Problem]:
    if not chamber.layers:
        expected = "at least one [drift_chamber.layers.<number>] or [drift_chamber.superlayers.<label>]"
        return [Problem("drift_chamber.layers", "no wire layer", expected)]
    problems = [problem for layer in chamber.layers for problem in _wire_problems(layer)]
    sound = _sound_layers(chamber)
    if chamber.wires == "smeared" and not any(layer.wire_x0 or layer.cell_wires for layer in chamber.layers):
        expected = 'cell_wires or wire_x0 of [drift_chamber] or of a layer, or wires = "none"'
        problems.append(Problem("drift_chamber.wires", '"smeared" and no matter of any wires', expected))
    problems += [found for i in range(len(sound)) if (found := _crossed_wires(sound, i))]
    return problems + _error_problems(sound)


def _crossed_wires(layers: Sequence[WireLayer], number: int) -> Problem | None:
    """Return whether a layer crosses one inside of it at a |z| where both have wires.

    The squares of the radii are linear in z squared, so that they are compared at 0 and at the nearer end. Layers
    inside of one that is as long as this one have been compared with that one.
    """
    outer = layers[number]
    for inner in reversed(layers[:number]):
        for z in (0.0, min(inner.half_length, outer.half_length)):
            if outer.radius_at(z) <= inner.radius_at(z) + TOUCH:
                given = f"wires at r = {outer.radius_at(z):g} mm at |z| = {z:g} mm"
                expected = f"more than the {inner.radius_at(z):g} mm of layer {inner.number} there"
                return Problem(f"drift_chamber.layers.{outer.number}", given, expected)
        if inner.half_length >= outer.half_length:
            break
    return None


def _error_problems(wires: list[WireLayer]) -> list[Problem]:
    """Return the layers whose error of the drift distance is not positive in all of their cells."""
    problems = []
    for i, wire in enumerate(wires):
        if wire.sigma_slope >= 0 or wire.sigma_points:
            continue
        # Tracks pass at most as far from the wire as an outer corner of its cell, midway to the next layer.
        others = (*wires[max(i - 1, 0) : i], *wires[i + 1 : i + 2])
        apart = [abs(one.radius_at(z) - wire.radius_at(z)) for one in others for z in (0.0, wire.half_length)]
        height = 0.5 * max(apart, default=2 * math.pi * wire.r_end / wire.cells)
        farthest = math.hypot(math.pi * (wire.r_end + height) / wire.cells, height)
        error = wire.sigma + wire.sigma_slope * farthest
        if error <= 0:
            given = f"an error of {error:g} mm at {farthest:.3g} mm"
            path = f"drift_chamber.layers.{wire.number}.sigma_slope"
            problems.append(Problem(path, given, "a positive error over the whole cell"))
    return problems


@once
def _has_wires(chamber: DriftChamber) -> bool:
    return all(layer.cells and layer.half_length for layer in chamber.layers)


@once
def _sound_layers(chamber: DriftChamber) -> list[WireLayer]:
    """Return the layers of wires without problems of their own, which they would only repeat as overlaps."""
    return [layer for layer in chamber.layers if not _wire_problems(layer)]


@once
def _wire_problems(wire: WireLayer) -> list[Problem]:
    problems = []
    path = f"drift_chamber.layers.{wire.number}"
    if abs(wire.twist) > math.pi / 2:
        given = f"{wire.twist_cells:g} cells of {wire.cells}"
        problems.append(Problem(f"{path}.twist_cells", given, "at most a quarter turn"))
    return problems


class Span(NamedTuple):
    """The cylinder that a part fills, mm."""

    r_in: float
    r_out: float
    half_length: float
    path: str

    def __str__(self) -> str:
        return f"{self.path} ({self.r_in:.4f} to {self.r_out:.4f} mm)"


def _wires_inside(span: Span, layers: Sequence[WireLayer]) -> list[Problem]:
    """Return one problem for the wires that cross a part, which follow hyperboloids."""
    crossing = []
    for layer in layers:
        reach = layer.radius_at(min(span.half_length, layer.half_length))
        if layer.r_mid < span.r_out - TOUCH and reach > span.r_in + TOUCH:
            crossing.append(Span(layer.r_mid, reach, layer.half_length, f"drift_chamber.layers.{layer.number}"))
    return [_overlap(span, crossing)] if crossing else []


def _overlaps(spans: Sequence[Span]) -> list[Problem]:
    """Return the parts that begin inside another one; all reach z = 0."""
    covered: dict[Span, list[Span]] = {}
    known = [span for span in spans if not math.isnan(span.r_in + span.r_out)]  # others could not be read
    before = Span(0.0, 0.0, 0.0, "")
    for span in sorted(known):
        if span.r_in < before.r_out - TOUCH:
            covered.setdefault(before, []).append(span)
        before = span if span.r_out > before.r_out else before
    # One problem for all that begin inside a part; the odd one out is the one to look at.
    return [
        _overlap(inside[0], [part]) if len(inside) == 1 else _overlap(part, inside) for part, inside in covered.items()
    ]


def _overlap(part: Span, others: Sequence[Span]) -> Problem:
    more = f" and {len(others) - 3} more" if len(others) > 3 else ""
    expected = f"no overlap with {', '.join(map(str, others[:3]))}{more}"
    return Problem(part.path, f"r = {part.r_in:.4f} to {part.r_out:.4f} mm", expected)
