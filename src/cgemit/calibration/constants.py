"""Constants of a detector that tracks measure: their names, and their columns in the core."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Floats, Ints
from cgemit.base.errors import Problems, did_you_mean
from cgemit.detector import Detector
from cgemit.detector.alignment import hat, points_of_relation
from cgemit.detector.drift import relation_of
from cgemit.detector.layers import CgemLayer
from cgemit.detector.layers.layer import PLACEMENT
from cgemit.detector.layers.wires import END_SHIFT, WIRE_SHIFT
from cgemit.detector.readouts import AnalogReadout
from cgemit.units import QuantityError, parse_quantity

#: Constants of a CGEM layer and of the field, which are asked for by their own names.
LORENTZ, Z_SCALE, FIELD = "lorentz_shift", "z_scale", "field.scale"
#: mm, of the tables in which the core looks up what a constant does to a drift distance.
_DRIFT_STEP = 0.05


@dataclass(frozen=True)
class Constant:
    """A number of the description that tracks can measure.

    Attributes
    ----------
    name : str
        Dotted key of the detector file, such as ``"cgem.L1.shift_x"``, or a name of docs/methods/alignment.md.
    unit : str
        ``"mm"``, ``"rad"``, ``"ns"``, or empty for a pure number.
    columns : tuple of (str, tuple of int)
        Arrays of the core that hold its column, and where.
    """

    name: str
    unit: str
    columns: tuple[tuple[str, tuple[int, ...]], ...]

    @property
    def part(self) -> str:
        """Dotted key of the part."""
        return self.name.rpartition(".")[0]

    @property
    def key(self) -> str:
        """Last word of the name."""
        return self.name.rpartition(".")[2]


def constants_of(detector: Detector, plates: Sequence[int] = (), *, wires: bool = False) -> tuple[Constant, ...]:
    """Return all constants of a detector, from the beam line outward.

    Parameters
    ----------
    detector : Detector
    plates : sequence of int
        Numbers of wire layers that share a pair of end plates, from the inside.
    wires : bool
        Whether also of the ends of single wires, after the others.
    """
    return (*_constants(detector, plates), *(_single(detector) if wires else ()))


def _single(detector: Detector) -> Iterator[Constant]:
    for i_layer, layer in enumerate(detector.wires):
        for wire in range(layer.cells):
            for i, key in enumerate(WIRE_SHIFT):
                yield Constant(f"{layer.path}.wires.{wire}.{key}", "mm", (("single", (i_layer, wire, i)),))


def of_single_wires(constants: Sequence[Constant]) -> bool:
    """Tell whether constants are those of single wires.

    Parameters
    ----------
    constants : sequence of Constant
    """
    return bool(constants) and constants[0].columns[0][0] == "single"


def _constants(detector: Detector, plates: Sequence[int]) -> Iterator[Constant]:
    for i_layer, layer in enumerate(detector.layers):
        yield from _rigid(layer.path, "layers", i_layer)
        if not isinstance(layer, CgemLayer):
            continue
        for sheet in range(layer.sheets):
            for key, i in (("shift_z", 2), ("rotation", 5)):
                name = f"{layer.path}.sheets.{sheet}.{key}"
                yield Constant(name, _unit(key), (("sheets", (i_layer, sheet, i)),))
        yield Constant(f"{layer.path}.{Z_SCALE}", "", (("z_scale", (i_layer,)),))
        # With an analog readout electrons drift in the simulation; their shift is no constant of the description.
        if not isinstance(layer.readout, AnalogReadout):
            yield Constant(f"{layer.path}.{LORENTZ}", "mm", (("lorentz", (i_layer,)),))
    chamber = detector.drift_chamber
    if chamber is not None and chamber.layers:
        yield from _rigid("drift_chamber", "chamber", 0)
        for first, last in _plates(plates):
            inside = range(first, min(last, len(chamber.layers)))
            if not len(inside):
                continue
            path = f"drift_chamber.plates.{chamber.layers[inside[0]].number}-{chamber.layers[inside[-1]].number}"
            for key, end, i in _ends():
                yield Constant(f"{path}.{key}", _unit(key), tuple((end, (number, i)) for number in inside))
        points = points_of_relation(detector)
        for i_layer, wires in enumerate(chamber.layers):
            yield from _rigid(wires.path, "wires", i_layer)
            for key, end, i in _ends():
                yield Constant(f"{wires.path}.{key}", _unit(key), ((end, (i_layer, i)),))
            yield Constant(f"{wires.path}.t0", "ns", (("drift", (i_layer, 0)),))
            for k, distance in enumerate(points):
                yield Constant(f"{wires.path}.drift_relation.{distance}mm", "ns", (("drift", (i_layer, 1 + k)),))
        every = range(len(chamber.layers))
        for k, distance in enumerate(points):
            columns = tuple(("drift", (number, 1 + len(points) + k)) for number in every)
            yield Constant(f"drift_chamber.drift_relation.{distance}mm", "ns", columns)
    yield Constant(FIELD, "", (("field", (0,)),))


def _ends() -> Iterator[tuple[str, str, int]]:
    for end in ("east", "west"):
        for key, i in (("shift_x", 0), ("shift_y", 1), ("rotation", 5)):
            yield f"{end}_{key}", end, i


def _unit(key: str) -> str:
    return "rad" if key.endswith(("tilt_x", "tilt_y", "rotation")) else "mm"


def _plates(plates: Sequence[int]) -> Iterator[tuple[int, int]]:
    last = 0
    for n_layers in plates:
        yield last, last + n_layers
        last += n_layers


def _rigid(path: str, array: str, row: int) -> Iterator[Constant]:
    for i, key in enumerate(PLACEMENT):
        yield Constant(f"{path}.{key}", _unit(key), ((array, (row, i)),))


def matches(constant: Constant, pattern: str) -> bool:
    """Tell whether a pattern names a constant, or the part of one that displaces it.

    Parameters
    ----------
    constant : Constant
    pattern : str
        ``*``, ``?`` and ``[...]`` match labels and keys, not dots.
    """
    if _fits(constant.name, pattern):
        return True
    if constant.columns[0][0] == "single":
        return _fits(constant.part, pattern)
    displaces = constant.key in (END_SHIFT if ".plates." in constant.name else PLACEMENT)
    return displaces and _fits(constant.part, pattern)


def _fits(name: str, pattern: str) -> bool:
    words, patterns = name.split("."), pattern.split(".")
    return len(words) == len(patterns) and all(map(fnmatchcase, words, patterns))


def chosen(constants: Sequence[Constant], patterns: Sequence[str], path: str, problems: Problems) -> set[str]:
    """Return the names of the constants that patterns name.

    Parameters
    ----------
    constants : sequence of Constant
    patterns : sequence of str
    path : str
        Of the patterns, for messages.
    problems : Problems
        Receives every pattern that names none.
    """
    selected: set[str] = set()
    for pattern in patterns:
        names = [one.name for one in constants if matches(one, pattern)]
        if not names:
            known = [*dict.fromkeys(one.part for one in constants), *(one.name for one in constants)]
            problems.note(path, repr(pattern), "a part or a constant of the detector", did_you_mean(pattern, known))
        selected.update(names)
    return selected


def priors_of(constants: Sequence[Constant], texts: Sequence[str], problems: Problems) -> dict[str, float]:
    """Return the errors of surveys by the names of constants, mm, rad, ns or 1.

    Parameters
    ----------
    constants : sequence of Constant
    texts : sequence of str
        Patterns with errors, ``"cgem.*.shift_z=100 um"``; later ones count.
    problems : Problems
        Receives every text that is none.
    """
    errors: dict[str, float] = {}
    for text in texts:
        pattern, equals, value = (word.strip() for word in text.partition("="))
        named = [one for one in constants if matches(one, pattern)]
        if not equals or not named:
            problems.note("priors", repr(text), "a part or a constant, and its error: 'cgem.*.shift_z=100 um'")
            continue
        for constant in named:
            kind = {"mm": "length", "rad": "angle", "ns": "time"}.get(constant.unit, "dimensionless")
            try:
                error = parse_quantity(value, kind)
            except QuantityError as error_of_text:
                problems.take(error_of_text, f"priors: {text}")
                break
            if not 0 < error < np.inf:
                problems.note("priors", repr(text), "an error above 0")
                break
            errors[constant.name] = error
    return errors


def columns_of(detector: Detector, constants: Sequence[Constant]) -> dict[str, Any]:
    """Return the columns of constants as the core takes them.

    Parameters
    ----------
    detector : Detector
        With the present displacements.
    constants : sequence of Constant
        Column i belongs to number i, of single wires to number i of `neighbours`.
    """
    layers = len(detector.layers)
    chamber = detector.drift_chamber
    wires = chamber.layers if chamber is not None else ()
    changes = _drift_changes(detector, constants)
    shapes: Mapping[str, tuple[int, ...]] = {
        "layers": (layers, 6), "sheets": (layers, _core.detector.MOST_SHEETS, 6), "chamber": (1, 6),
        "wires": (len(wires), 6), "east": (len(wires), 6), "west": (len(wires), 6), "lorentz": (layers,),
        "z_scale": (layers,), "drift": changes.shape[:2], "field": (1,),
    }  # fmt: skip
    arrays: dict[str, Ints] = {name: np.full(shape, -1, np.int32) for name, shape in shapes.items()}
    single = [np.full((layer.cells, len(WIRE_SHIFT)), -1, np.int32) for layer in wires]
    of_single = of_single_wires(constants)
    if of_single:
        for column, i in enumerate(neighbours(detector, constants).tolist()):
            layer_number, *at = constants[i].columns[0][1]
            single[layer_number][tuple(at)] = column
    else:
        for column, one in enumerate(constants):
            for name, place in one.columns:
                arrays[name][place] = column
    return {name: array.ravel() for name, array in arrays.items()} | {
        "single": [one.ravel() for one in single] if of_single else [],
        "columns": len(constants), "chamber_shift": np.zeros(3) if chamber is None else chamber.shift,
        "chamber_turn": (np.eye(3) if chamber is None else chamber.turn).ravel(),
        "drift_change": changes, "drift_step": _DRIFT_STEP,
    }  # fmt: skip


def neighbours(detector: Detector, constants: Sequence[Constant]) -> Ints:
    """Return the numbers of constants of single wires by the azimuth of the wires in their middle, (n,).

    Parameters
    ----------
    detector : Detector
    constants : sequence of Constant
    """
    layers = detector.wires
    layer, wire = np.array([one.columns[0][1][:2] for one in constants]).T
    first = np.array([one.phi_east - 0.5 * one.twist for one in layers])
    cells = np.array([one.cells for one in layers])
    phi = (first[layer] + 2 * np.pi * wire / cells[layer]) % (2 * np.pi)
    return np.lexsort((layer, phi))


def _drift_changes(detector: Detector, constants: Sequence[Constant]) -> Floats:
    """Return what 1 ns of each constant of drift times does to a distance, (wire layers, constants, distances) mm.

    A true time that is later makes the distance that is read larger, by the velocity there.
    """
    wires = detector.drift_chamber.layers if detector.drift_chamber is not None else ()
    if not any(array == "drift" for one in constants for array, _ in one.columns):
        return np.zeros((len(wires), 0, 1))
    points = points_of_relation(detector)
    distance = np.arange(0, points[-1] + 1, _DRIFT_STEP)
    shares = np.array([np.ones_like(distance), *2 * [hat(point, distance, points) for point in points]])
    velocities = np.array([relation_of(layer).velocity_at(distance) for layer in wires])
    return np.asarray(velocities[:, None, :] * shares)
