"""Constants of a detector that tracks measure: their names, and their columns in the core."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.errors import Problems, did_you_mean
from cgemit.detector import Detector
from cgemit.detector.layers import CgemLayer
from cgemit.detector.layers.layer import PLACEMENT
from cgemit.detector.readouts import AnalogReadout
from cgemit.units import QuantityError, parse_quantity

Ints = npt.NDArray[np.int32]

#: Constants of a CGEM layer and of the field, which are asked for by their own names.
LORENTZ, FIELD = "lorentz_shift", "field.scale"


@dataclass(frozen=True)
class Constant:
    """A number of the description that tracks can measure.

    Attributes
    ----------
    name : str
        Dotted key of the detector file, such as ``"cgem.L1.shift_x"``; ``"field.scale"`` is ln of the field over that
        of the description.
    unit : str
        ``"mm"``, ``"rad"``, or empty for a pure number.
    column : (str, tuple of int)
        Array of the core that holds its column, and where.
    """

    name: str
    unit: str
    column: tuple[str, tuple[int, ...]]

    @property
    def part(self) -> str:
        """Dotted key of the part."""
        return self.name.rpartition(".")[0]

    @property
    def key(self) -> str:
        """Last word of the name."""
        return self.name.rpartition(".")[2]


def constants_of(detector: Detector) -> tuple[Constant, ...]:
    """Return all constants of a detector, from the beam line outward.

    Parameters
    ----------
    detector : Detector
    """
    return tuple(_constants(detector))


def _constants(detector: Detector) -> Iterator[Constant]:
    for number, layer in enumerate(detector.layers):
        path = f"{layer.group}.{layer.label}"
        yield from _rigid(path, "layers", number)
        # With an analog readout electrons drift in the simulation; their shift is no constant of the description.
        if isinstance(layer, CgemLayer) and not isinstance(layer.readout, AnalogReadout):
            yield Constant(f"{path}.{LORENTZ}", "mm", ("lorentz", (number,)))
    if detector.drift_chamber is not None and detector.drift_chamber.layers:
        yield from _rigid("drift_chamber", "chamber", 0)
        for number, wires in enumerate(detector.drift_chamber.layers):
            path = f"drift_chamber.layers.{wires.number}"
            yield from _rigid(path, "wires", number)
            for end in ("east", "west"):
                for key, i in (("shift_x", 0), ("shift_y", 1), ("rotation", 5)):
                    yield Constant(f"{path}.{end}_{key}", "mm" if i < 5 else "rad", (end, (number, i)))
    yield Constant(FIELD, "", ("field", (0,)))


def _rigid(path: str, array: str, number: int) -> Iterator[Constant]:
    for i, key in enumerate(PLACEMENT):
        yield Constant(f"{path}.{key}", "mm" if key.startswith("shift") else "rad", (array, (number, i)))


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
    return constant.key in PLACEMENT and _fits(constant.part, pattern)


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
    found: set[str] = set()
    for pattern in patterns:
        names = [one.name for one in constants if matches(one, pattern)]
        if not names:
            known = [*dict.fromkeys(one.part for one in constants), *(one.name for one in constants)]
            problems.note(path, repr(pattern), "a part or a constant of the detector", did_you_mean(pattern, known))
        found.update(names)
    return found


def priors_of(constants: Sequence[Constant], given: Sequence[str], problems: Problems) -> dict[str, float]:
    """Return the errors of surveys by the names of constants, mm, rad or 1.

    Parameters
    ----------
    constants : sequence of Constant
    given : sequence of str
        Patterns with errors, ``"cgem.*.shift_z=100 um"``; later ones count.
    problems : Problems
        Receives every text that is none.
    """
    found: dict[str, float] = {}
    for text in given:
        pattern, equals, value = (word.strip() for word in text.partition("="))
        named = [one for one in constants if matches(one, pattern)]
        if not equals or not named:
            problems.note("priors", repr(text), "a part or a constant, and its error: 'cgem.*.shift_z=100 um'")
            continue
        for one in named:
            kind = {"mm": "length", "rad": "angle"}.get(one.unit, "dimensionless")
            try:
                error = parse_quantity(value, kind)
            except QuantityError as error_of_text:
                problems.take(error_of_text, f"priors: {text}")
                break
            if not 0 < error < np.inf:
                problems.note("priors", repr(text), "an error above 0")
                break
            found[one.name] = error
    return found


def columns_of(detector: Detector, constants: Sequence[Constant]) -> dict[str, Any]:
    """Return the columns of constants as the core takes them.

    Parameters
    ----------
    detector : Detector
        With the present displacements.
    constants : sequence of Constant
        Column i belongs to number i.
    """
    layers = len(detector.layers)
    chamber = detector.drift_chamber
    wires = len(chamber.layers) if chamber is not None else 0
    shapes: Mapping[str, tuple[int, ...]] = {
        "layers": (layers, 6), "sheets": (layers, _core.calibration.MOST_SHEETS, 6), "chamber": (1, 6),
        "wires": (wires, 6), "east": (wires, 6), "west": (wires, 6), "lorentz": (layers,), "z_scale": (layers,),
        "drift": (wires, 0), "field": (1,),
    }  # fmt: skip
    arrays: dict[str, Ints] = {name: np.full(shape, -1, np.int32) for name, shape in shapes.items()}
    for number, one in enumerate(constants):
        name, at = one.column
        arrays[name][at] = number
    return {name: array.ravel() for name, array in arrays.items()} | {
        "columns": len(constants), "chamber_shift": np.zeros(3) if chamber is None else chamber.shift,
        "chamber_turn": (np.eye(3) if chamber is None else chamber.turn).ravel(),
        "drift_change": np.zeros((wires, 0, 1)), "drift_step": 1.0,
    }  # fmt: skip
