"""Which variants a sweep evaluates: a grid, Sobol points, a Latin hypercube, or a list."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.stats import qmc

from cgemit.detector.variants import factor_of
from cgemit.units import parse_quantity, units_of
from cgemit.values import is_whole

#: One variant: what it changes, by dotted key of the detector file.
Changes = Mapping[str, Any]

_MOST = 10_000_000
_QUANTITY = re.compile(r"\s*(x|×)?\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")


class SpaceError(ValueError):
    """A space with mistakes; every problem is a line of the message."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n  ".join(["wrong space of a sweep", *problems]))


@dataclass(frozen=True)
class Space:
    """The variants of a sweep in order.

    Attributes
    ----------
    kind : str
        ``"grid"``, ``"sobol"``, ``"latin_hypercube"`` or ``"list"``.
    variants : tuple of mapping
        What each variant changes.
    axes : mapping of str to tuple
        Of a grid: the values of each key; the last key changes fastest.
    """

    kind: str
    variants: tuple[Changes, ...]
    axes: Mapping[str, tuple[Any, ...]]

    @property
    def keys(self) -> tuple[str, ...]:
        """Every key that a variant changes, in order of appearance."""
        return tuple(dict.fromkeys(key for changes in self.variants for key in changes))

    def __len__(self) -> int:
        return len(self.variants)


def grid(axes: Mapping[str, Sequence[Any]]) -> Space:
    """Return every combination of some values.

    Parameters
    ----------
    axes : mapping of str to list
        Dotted key of the detector file, or several separated by commas, and its values. The keys ``base`` and
        ``field`` take names of presets or files.

    Raises
    ------
    SpaceError
        If an axis has no values, or the same value twice.
    """
    problems = []
    for key, values in axes.items():
        if isinstance(values, str) or not isinstance(values, Sequence | np.ndarray) or len(values) == 0:
            problems.append(f"{key}: got {values!r}, expected a list of at least one value")
        elif len({repr(value) for value in values}) < len(values):
            problems.append(f"{key}: got {list(values)!r}, expected each value once")
    _raise(problems, axes)
    plain = {key: tuple(_plain(value) for value in values) for key, values in axes.items()}
    variants = tuple(dict(zip(plain, values, strict=True)) for values in product(*plain.values()))
    return Space("grid", variants, plain)


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def listed(variants: Sequence[Changes]) -> Space:
    """Return given variants as a space."""
    wrong = [f"[{i}]: got {one!r:.60}, expected a table of changes" for i, one in enumerate(variants)
             if not isinstance(one, Mapping)]  # fmt: skip
    _raise(wrong, variants)
    return Space("list", tuple(dict(one) for one in variants), {})


def sobol(ranges: Mapping[str, Any], n: int, *, seed: int = 1) -> Space:
    """Return points of a scrambled Sobol sequence (`scipy.stats.qmc.Sobol`); powers of 2 are balanced best.

    Parameters
    ----------
    ranges : mapping of str to (low, high) or list
        Two texts with units of one dimension, ``("300 um", "800 um")``; two relative values, ``("x0.8", "x1.2")``; two
        numbers; or a list of values to choose from. Whole numbers give whole numbers, both ends included.
    n : int
        Number of variants.
    seed : int

    Raises
    ------
    SpaceError
        With every problem of the ranges.
    """

    def points(dimensions: int) -> Any:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The balance properties", UserWarning)
            return qmc.Sobol(dimensions, scramble=True, rng=np.random.default_rng(seed)).random(n)

    return _sampled("sobol", ranges, n, points)


def latin_hypercube(ranges: Mapping[str, Any], n: int, *, seed: int = 1) -> Space:
    """Return a Latin hypercube (`scipy.stats.qmc.LatinHypercube`).

    Parameters
    ----------
    ranges : mapping of str to (low, high) or list
        As of `sobol`.
    n : int
        Number of variants.
    seed : int

    Raises
    ------
    SpaceError
        With every problem of the ranges.
    """
    return _sampled(
        "latin_hypercube", ranges, n,
        lambda dimensions: qmc.LatinHypercube(dimensions, rng=np.random.default_rng(seed)).random(n),
    )  # fmt: skip


def _sampled(kind: str, ranges: Mapping[str, Any], n: int, points: Callable[[int], Any]) -> Space:
    problems: list[str] = []
    if not is_whole(n, 1, _MOST):
        problems.append(f"n: got {n!r}, expected a whole number from 1 to {_MOST}")
    makers = {key: _maker(key, given, problems) for key, given in ranges.items()}
    _raise(problems, ranges)
    rows = points(len(ranges))
    variants = [{key: make(float(u)) for (key, make), u in zip(makers.items(), row, strict=True)} for row in rows]
    return Space(kind, tuple(variants), {})


def _raise(problems: Sequence[str], given: Any) -> None:
    problems = problems or ([] if given else ["got nothing to vary, expected at least one key with its values"])
    if problems:
        raise SpaceError(problems)


def _maker(key: str, given: Any, problems: list[str]) -> Callable[[float], Any]:
    """Return the value of a key for a number from 0 to 1."""
    if isinstance(given, list) and given:
        return lambda u: given[min(int(u * len(given)), len(given) - 1)]
    if isinstance(given, tuple) and len(given) == 2:
        low, high = given
        if all(is_whole(end, -_MOST, _MOST) for end in given) and low <= high:
            return lambda u: min(low + int(u * (high - low + 1)), high)
        ends = split_range(low, high)
        if ends and ends[1] <= ends[2]:
            before, first, last, unit = ends
            number = not isinstance(low, str)
            return lambda u: _joined(before, first + u * (last - first), unit, number)
    problems.append(f"{key}: got {given!r}, expected (low, high) of one dimension, or a list to choose from")
    return lambda u: None


def _joined(before: str, value: float, unit: str, number: bool) -> Any:
    # Eight digits: enough for any design, short enough for a name.
    return float(f"{value:.8g}") if number else f"{before}{value:.8g} {unit}".strip()


def split_quantity(value: Any) -> tuple[str, float, str] | None:
    """Return ("x" of a relative value or "", the number, the unit) of a value; None if it is a word or a table."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int | float):
        return ("", float(value), "") if math.isfinite(value) else None
    match = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if not match:
        return None
    times, number, unit = match.groups()
    if times:
        return ("x", float(number), "") if not unit else None
    if factor_of(value) is not None:
        return ("%", float(number), "")
    return ("", float(number), unit) if unit in _UNITS else None


def split_range(low: Any, high: Any) -> tuple[str, float, float, str] | None:
    """Return ("x" or "", low, high, unit of low) of two values of one dimension; None if they are none."""
    one, other = split_quantity(low), split_quantity(high)
    if one is None or other is None or one[0] != other[0]:
        return None
    before, first, unit = one
    if unit == other[2]:
        return before, first, other[1], unit
    both = next((name for name in _DIMENSIONS if {unit, other[2]} <= set(units_of(name))), None)
    if both is None or not unit or not other[2]:
        return None
    last = parse_quantity(high, both) / parse_quantity(f"1 {unit}", both)
    return before, first, float(f"{last:.12g}"), unit


_DIMENSIONS = ("length", "angle", "field", "density", "energy", "momentum", "slope", "inverse area",
               "inverse area squared", "dimensionless")  # fmt: skip
_UNITS = frozenset(name for dimension in _DIMENSIONS for name in units_of(dimension))


_SAMPLES = {"sobol": sobol, "latin_hypercube": latin_hypercube}


def space_of(tables: Mapping[str, Any], problems: list[str]) -> Space | None:
    """Return the space of a plan's tables; every problem is added to `problems`."""
    sample = tables.get("sample", {})
    kind = sample.get("kind", "grid")
    try:
        if "variants" in tables:
            return listed(tables["variants"])
        if kind == "grid":
            return grid(tables["vary"])
        if kind not in _SAMPLES:
            problems.append(f"sample.kind: got {kind!r}, expected one of grid, {', '.join(_SAMPLES)}")
            return None
        ranges = {key: range_of(value) for key, value in tables["vary"].items()}
        return _SAMPLES[kind](ranges, sample.get("n", 0), seed=sample.get("seed", 1))
    except SpaceError as error:
        problems += str(error).split("\n  ")[1:]
    return None


def range_of(value: Any) -> Any:
    """Return ``{ from, to }`` of a plan as (low, high); other values as they are."""
    return (value["from"], value["to"]) if isinstance(value, Mapping) and value.keys() == {"from", "to"} else value
