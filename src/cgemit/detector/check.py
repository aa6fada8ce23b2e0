"""Checks of a detector's values and geometry; each returns all problems it finds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from cgemit import _core
from cgemit.base.errors import Problem
from cgemit.detector.field import Field, FieldGrid, MapField, field_range
from cgemit.detector.keys import Part, keys_of, once
from cgemit.detector.layers import Layer
from cgemit.detector.layers.wires import DriftChamber, WireLayer
from cgemit.detector.parts import Contents, Cylinder, extent
from cgemit.detector.shells import TOUCH, Bounded, share_z
from cgemit.units import NATIVE, format_quantity

_COIL = 1.25
_THICK = 1000.0  # mm; no coil behind a tracker is thicker


def value_problems(detector: Contents) -> list[Problem]:
    """Return the values that lie outside the range of their key, for detectors made in Python."""
    problems = _below("field", _part_problems(detector.field))
    for group in ("beam_pipe", "walls", "background"):
        for part in getattr(detector, group):
            if wrong := _part_problems(part):
                problems += _below(f"{group}.{part.label}", wrong)
    for layer in detector.barrels:
        if wrong := _part_problems(layer):
            problems += _below(layer.path, wrong)
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
            problems.append(Problem(name, shown, key.expected(), part.hint_of(name)))
        elif key.kind == "gas" and value is not None and not value.gas:
            problems.append(Problem(name, f'"{value.name}", which is no gas', key.expected()))
        elif key.choices and value not in key.choices:
            problems.append(Problem(name, repr(value), key.expected()))
    if isinstance(part, Bounded) and (part.z_min is not None or part.z_max is not None):
        problems += _ends_problem(part.z_min, part.z_max)
    for path, one in part.inner():
        if found := _part_problems(one):
            problems += _below(path, found)
    return problems


def _ends_problem(low: float | None, high: float | None) -> list[Problem]:
    if low is None or high is None:
        return [Problem("z_max" if low is None else "z_min", "without the other end", "z_min and z_max")]
    return [] if not low >= high else [Problem("z_max", f"{high:g} mm", f"above z_min, {low:g} mm")]


def geometry_problems(
    beam_pipe: Sequence[Cylinder],
    barrels: Sequence[Layer],
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
            spans += [] if wrong else [Span(part.r_in, part.r_out, part.ends, f"{group}.{part.label}")]
    for layer in barrels:
        problems += layer.problems() + _readout_problems(layer)
        if not layer.r_in <= 0:
            spans.append(Span(layer.r_in, layer.r_out, layer.ends, layer.path))
    problems += _same_labels(barrels) + _overlaps(spans)
    if chamber and all(layer.cells and layer.half_length for layer in chamber.layers):
        problems += chamber.problems()
        wires = chamber.sound
        innermost = min((layer.r_mid for layer in wires), default=math.inf)
        near = [span for span in spans if not span.r_out <= innermost]  # all, if the first radius could not be read
        problems += [problem for span in near for problem in _wires_inside(span, wires)]
    return problems


def _same_labels(barrels: Sequence[Layer]) -> list[Problem]:
    """Return layers of different kinds with one label, by which results name them."""
    first: dict[str, Layer] = {}
    return [
        Problem(layer.path, f'the label "{layer.label}", which {other.path} has', "a label that no other layer has")
        for layer in barrels
        if (other := first.setdefault(layer.label, layer)).group != layer.group
    ]


@once
def _readout_problems(layer: Layer) -> list[Problem]:
    """Return a readout that layers of the kind cannot have, of a layer made in Python."""
    if type(layer.readout) in layer.readouts.values():
        return []
    return [Problem(f"{layer.path}.readout", layer.readout.name, f"one of {', '.join(layer.readouts)}")]


def _cylinder_problem(path: str, part: Cylinder) -> list[Problem]:
    if part.thickness <= 0:
        return [Problem(f"{path}.r_out", f"{part.r_out:g} mm", f"more than r_in = {part.r_in:g} mm")]
    if part.thickness > _THICK:
        return [Problem(f"{path}.r_out", f"a thickness of {part.thickness:g} mm", f"at most {_THICK:g} mm")]
    return []


def unreachable(detector: Contents) -> list[str]:
    """Return what part of each layer no track from the origin reaches; empty if all are reached.

    Straight tracks reach every point of the field's range. Tracks end at its edge.
    """
    radius, first, last = field_range(detector.field)
    paths_of: dict[str, list[str]] = {}
    layers: list[Layer | WireLayer] = [*detector.layers, *detector.wires]
    for layer in layers:
        low, high = layer.ends_within(radius)
        if text := _unreached(layer.ends, max(first, low), min(last, high)):
            paths_of.setdefault(text, []).append(layer.path)
    whole = len(layers)
    return [
        f"{', '.join(_shortened(paths))} ({len(paths)} of {whole} layers): {text}" for text, paths in paths_of.items()
    ]


def _unreached(ends: tuple[float, float], first: float, last: float) -> str:
    """Return what is left of a layer outside of the z from first to last; empty if nothing is."""
    if first > last:
        return "no track from the origin reaches it: the field ends before"
    below, above = first > ends[0], last < ends[1]
    if not (below or above):
        return ""
    places = [f"z below {first:g} mm"] * below + [f"z above {last:g} mm"] * above
    return f"no track from the origin reaches {' and '.join(places)}: the field ends there"


def _shortened(paths: Sequence[str]) -> Sequence[str]:
    return paths if len(paths) < 4 else [paths[0], f"{len(paths) - 2} more", paths[-1]]


class Span(NamedTuple):
    """The cylinder that a part fills, mm."""

    r_in: float
    r_out: float
    ends: tuple[float, float]
    path: str

    def __str__(self) -> str:
        return f"{self.path} ({self.r_in:.4f} to {self.r_out:.4f} mm)"


def _wires_inside(span: Span, layers: Sequence[WireLayer]) -> list[Problem]:
    """Return one problem for the wires that cross a part, which follow hyperboloids."""
    crossing = []
    for layer in layers:
        least, most = layer.radii_between(*span.ends)
        if least < span.r_out - TOUCH and most > span.r_in + TOUCH:
            crossing.append(Span(least, most, layer.ends, layer.path))
    return [_overlap(span, crossing)] if crossing else []


def _overlaps(spans: Sequence[Span]) -> list[Problem]:
    """Return the parts that begin inside another one at the same z."""
    covered: dict[Span, list[Span]] = {}
    known = sorted(span for span in spans if not math.isnan(span.r_in + span.r_out))  # others could not be read
    open_: list[Span] = []  # those that reach the next one
    for span in known:
        open_ = [one for one in open_ if span.r_in < one.r_out - TOUCH]
        if inside := [one for one in open_ if share_z(one.ends, span.ends)]:
            covered.setdefault(max(inside, key=lambda one: one.r_out), []).append(span)
        open_.append(span)
    # One problem for all that begin inside a part; the odd one out is the one to look at.
    return [
        _overlap(inside[0], [part]) if len(inside) == 1 else _overlap(part, inside) for part, inside in covered.items()
    ]


def _overlap(span: Span, over: Sequence[Span]) -> Problem:
    more = f" and {len(over) - 3} more" if len(over) > 3 else ""
    expected = f"no overlap with {', '.join(map(str, over[:3]))}{more}"
    return Problem(span.path, f"r = {span.r_in:.4f} to {span.r_out:.4f} mm", expected)
