"""Variants of a sweep: a grid, Sobol points, a Latin hypercube, or a list."""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.base.errors import DetectorError, Problem, Problems, ProblemsError, did_you_mean
from cgemit.base.validate import check_seed, check_whole, is_whole
from cgemit.detector import Detector
from cgemit.detector.keys import CELLS
from cgemit.detector.variants import factor_of, values_at
from cgemit.units import LONGEST, NATIVE, format_quantity, parse_quantity, units_of

#: One variant: what it changes, by dotted key of the detector file.
Changes = Mapping[str, Any]

_MOST = 10_000_000
_QUANTITY = re.compile(r"\s*(x|×)?\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")


class PlanError(ProblemsError):
    """The plan of a study with mistakes, in a file or in Python; `problems` lists them all.

    Examples
    --------
    >>> try:
    ...     cg.study.sweep("besiii-cgem", {"cgem.L1.pitch_y": ["400 um"]})
    ... except cg.study.PlanError as error:
    ...     print(error.problems[0].path, error.problems[0].hint)
    cgem.L1.pitch_y did you mean "pitch_x"?
    """


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
    files : mapping of (str, str) to path
        Where files are that values of `base` or `field` name, by key and name; others are relative to the working
        directory.

    Examples
    --------
    >>> space = cg.study.grid({"cgem.L1.pitch_x": ["400 um", "650 um"], "field.bz": ["0.9 T", "1 T"]})
    >>> space.kind, len(space.variants)
    ('grid', 4)
    """

    kind: str
    variants: tuple[Changes, ...]
    axes: Mapping[str, tuple[Any, ...]]
    files: Mapping[tuple[str, str], Path] = field(default_factory=dict)

    @property
    def keys(self) -> tuple[str, ...]:
        """Every key that a variant changes, in order of appearance."""
        return tuple(dict.fromkeys(key for changes in self.variants for key in changes))

    def __len__(self) -> int:
        return len(self.variants)


#: Keys of variants whose values may name files.
NAMES_FILES = ("base", "field", "field.file")


def with_files(key: str, value: Any, renamed: Callable[[str, str], str]) -> Any:
    """Return a value of one of these keys with its name of a file, that of a map in a table [field] too, renamed."""
    if isinstance(value, Mapping) and isinstance(value.get("file"), str):
        return {**value, "file": renamed(key, value["file"])}
    return renamed(key, value) if isinstance(value, str) else value


def grid(axes: Mapping[str, Sequence[Any]]) -> Space:
    """Return every combination of some values.

    Parameters
    ----------
    axes : mapping of str to list
        Dotted key of the detector file, or several separated by commas, and its values. The keys ``base`` and
        ``field`` take names of presets or files.

    Raises
    ------
    PlanError
        If an axis has no values, or the same value twice.

    Examples
    --------
    >>> space = cg.study.grid({"cgem.L1.pitch_x": ["400 um", "650 um"], "field.bz": ["0.9 T", "1 T"]})
    >>> dict(space.variants[1])
    {'cgem.L1.pitch_x': '400 um', 'field.bz': '1 T'}
    """
    problems = Problems()
    count = 1
    for key, values in _by_key(axes, problems).items():
        if isinstance(values, str) or not isinstance(values, Sequence | np.ndarray) or len(values) == 0:
            problems.note(key, repr(values), "a list of at least one value")
        elif len({repr(value) for value in values}) < len(values):
            problems.note(key, repr(list(values)), "each value once")
        else:
            count *= len(values)
    if count > _MOST:
        problems.note("space", f"{float(count):.4g} variants", f"at most {_MOST}")
    _raise(problems, axes)
    plain = {key: tuple(_plain(value) for value in values) for key, values in axes.items()}
    variants = tuple(dict(zip(plain, values, strict=True)) for values in product(*plain.values()))
    return Space("grid", variants, plain)


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _by_key(given: Any, problems: Problems) -> Mapping[str, Any]:
    """Return what stands at each key; note another value than a mapping, and keys that are no text."""
    if not isinstance(given, Mapping):
        problems.note("space", f"{given!r:.60}", "a dict with values by dotted key")
        return {}
    for key in given:
        if not isinstance(key, str):
            problems.note("space", f"the key {key!r:.60}", "a dotted key")
    return given


def listed(variants: Sequence[Changes]) -> Space:
    """Return given variants as a space."""
    problems = Problems()
    if isinstance(variants, str) or not isinstance(variants, Sequence):
        problems.note("space", f"{variants!r:.60}", "a dict of lists, a list of dicts, or a Space")
        variants = ()
    for i, one in enumerate(variants):
        if not isinstance(one, Mapping) or not all(isinstance(key, str) for key in one):
            problems.note(f"variants[{i}]", f"{one!r:.60}", "a table of changes by dotted key")
    _raise(problems, variants)
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
    PlanError
        With every problem of the ranges.

    Examples
    --------
    >>> space = cg.study.sobol({"cgem.L1.pitch_x": ("400 um", "650 um")}, 4)
    >>> space.kind, len(space.variants)
    ('sobol', 4)
    """
    from scipy.stats import qmc

    def points(dimensions: int) -> Any:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The balance properties", UserWarning)
            return qmc.Sobol(dimensions, scramble=True, rng=np.random.default_rng(seed)).random(n)

    return _sampled("sobol", ranges, (n, seed), points)


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
    PlanError
        With every problem of the ranges.

    Examples
    --------
    >>> space = cg.study.latin_hypercube({"cgem.L1.pitch_x": ("400 um", "650 um")}, 4)
    >>> space.kind, len(space.variants)
    ('latin_hypercube', 4)
    """
    from scipy.stats import qmc

    return _sampled(
        "latin_hypercube", ranges, (n, seed),
        lambda dimensions: qmc.LatinHypercube(dimensions, rng=np.random.default_rng(seed)).random(n),
    )  # fmt: skip


def _sampled(kind: str, ranges: Mapping[str, Any], n_and_seed: tuple[int, int], points: Callable[[int], Any]) -> Space:
    problems = Problems()
    check_whole("n", n_and_seed[0], 1, _MOST, problems)
    check_seed(n_and_seed[1], problems)
    makers = {str(key): _maker(str(key), given, problems) for key, given in _by_key(ranges, problems).items()}
    _raise(problems, ranges)
    rows = points(len(ranges))
    variants = [{key: make(float(u)) for (key, make), u in zip(makers.items(), row, strict=True)} for row in rows]
    return Space(kind, tuple(variants), {})


def _raise(problems: Problems, given: Any) -> None:
    if not problems and not given:
        problems.note("space", "nothing to vary", "at least one key with its values")
    problems.report("space of a sweep", PlanError)


def _maker(key: str, given: Any, problems: Problems) -> Callable[[float], Any]:
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
        if ends:
            problems.note(key, repr(given), "the lower end first")
            return lambda u: None
    problems.note(key, repr(given), "(low, high) of one dimension, or a list to choose from")
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
    match = _QUANTITY.fullmatch(value) if isinstance(value, str) and len(value) <= LONGEST else None
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
    start, end = split_quantity(low), split_quantity(high)
    if start is None or end is None or start[0] != end[0]:
        return None
    before, first, unit = start
    if unit == end[2]:
        return before, first, end[1], unit
    dimension = next((name for name in _DIMENSIONS if {unit, end[2]} <= set(units_of(name))), None)
    if dimension is None or not unit or not end[2]:
        return None
    last = parse_quantity(high, dimension) / parse_quantity(f"1 {unit}", dimension)
    return before, first, float(f"{last:.12g}"), unit


_DIMENSIONS = ("length", "angle", "field", "density", "energy", "momentum", "slope", "inverse area",
               "inverse area squared", "dimensionless")  # fmt: skip
_UNITS = frozenset(name for dimension in _DIMENSIONS for name in units_of(dimension))


def axis_of(key: str, base: Detector, values: Sequence[Any]) -> tuple[str, list[Any]]:
    """Return header and column of a key: numbers with the unit in the header where all values have the same one.

    The first entry is the base's own value; where there is none, NaN or an empty text.
    """
    parsed = [split_quantity(value) for value in values]
    kinds = {(one[0], one[2]) for one in parsed if one}
    if None not in parsed and len(kinds) == 1:
        times, unit = kinds.pop()
        header = f"{key} ({'times' if times == 'x' else 'change in %' if times else unit})".replace(" ()", "")
        neutral = {"x": 1.0, "%": 0.0}
        first = neutral[times] if times else own_value(key, base, unit)
        return header, [first, *(one[1] for one in parsed if one)]
    return key, [own_text(key, base), *(_text(value) for value in values)]


def _text(value: Any) -> str:
    return "" if value is None else value if isinstance(value, str) else json.dumps(value, default=str)


def _values(key: str, base: Detector) -> list[tuple[Any, Any]]:
    return [found for found in values_at(base, key, []) if found is not None and found[0] is not None]


def own_value(key: str, base: Detector, unit: str) -> float:
    """Return the base's value of a key in a unit; NaN if it has none, several, or one of another dimension."""
    numbers = {(value, one.kind) for value, one in _values(key, base) if isinstance(value, int | float)}
    if len(numbers) != 1:
        return math.nan
    value, kind = numbers.pop()
    if kind not in NATIVE or not unit:
        return float(value)
    if unit not in units_of(kind):  # of a value that is wrong for this key
        return math.nan
    return float(format_quantity(value, kind, unit).split()[0])


def own_text(key: str, base: Detector) -> str:
    """Return the base's value of a key as text, a number with its unit; an empty text if it has none, or several."""
    if key == "base":
        return base.name
    texts = {
        format_quantity(value, one.kind) if one.kind in NATIVE and isinstance(value, float)
        else getattr(value, "name", str(value))
        for value, one in _values(key, base)
    }  # fmt: skip
    return texts.pop() if len(texts) == 1 else ""


#: Groups of parts with labels.
_GROUPS = ("beam_pipe", "cgem", "layer", "walls")


def key_problems(pairs: Iterable[tuple[Detector, Changes]]) -> list[Problem]:
    """Return a problem for each key that names nothing in any detector that it would change.

    Parameters
    ----------
    pairs : iterable of (Detector, mapping)
        Each variant's base and changes. The first variant of each base and key is built.

    Returns
    -------
    list of Problem
        Wrong values are no problem here (`value_problems`).
    """
    tried: set[tuple[str, int]] = set()
    by_key: dict[str, Problem] = {}
    fine: set[str] = set()
    for base, changes in pairs:
        new = [key for key in changes if (key, id(base)) not in tried]
        if not new:
            continue
        tried |= {(key, id(base)) for key in new}
        problems = _unknown(base, changes)
        for key in new:
            own = next((one for one in problems if _is_of(one, key)), None)
            if own is None:
                fine.add(key)
            else:
                by_key[key] = _of_key(base, key, own)
    return [one for key, one in by_key.items() if key not in fine]


#: Wrong values of one key that are listed.
_MOST_LISTED = 5


def value_problems(pairs: Iterable[tuple[Detector, Changes]]) -> list[Problem]:
    """Return a problem for each number that its key never allows: without its unit, or beyond the limits of the key.

    Parameters
    ----------
    pairs : iterable of (Detector, mapping)
        Each variant's base and changes. Relative values and numbers that depend on other parts are no problem here.
    """
    by_key: dict[str, Problems] = {}
    tried: set[tuple[str, int, type, Any]] = set()
    for base, changes in pairs:
        for key, value in changes.items():
            if isinstance(value, bool) or not isinstance(value, str | int | float) or factor_of(value) is not None:
                continue
            if (one := (key, id(base), type(value), value)) in tried:
                continue
            tried.add(one)
            problems = by_key.setdefault(key, Problems())
            for _, limits in _values(key, base)[:1] if len(problems) < _MOST_LISTED else ():
                if limits.kind in NATIVE and limits not in CELLS.values():
                    limits.read(key, value, problems)
    return [problem for problems in by_key.values() for problem in dict.fromkeys(problems)]


def _unknown(base: Detector, changes: Changes) -> list[Problem]:
    """Return those problems of a variant that tell of names that the base does not have."""
    try:
        base.with_overrides(dict(changes))
    except DetectorError as error:
        return [one for one in error.problems if one.unknown]
    return []


def _is_of(problem: Problem, key: str) -> bool:
    """Return whether the path of a problem leads to a key, or from it to a value of its table."""
    names = [re.sub(r"\[\d+\]$", "", name) for name in problem.path.split(".")]
    for part in (part.strip() for part in key.split(",")):
        if problem.path == part or all(fnmatchcase(*pair) for pair in zip(names, part.split("."), strict=False)):
            return True
    return False


def _of_key(base: Detector, key: str, problem: Problem) -> Problem:
    """Return the problem of a variant as one of the key of the plan."""
    group, _, rest = problem.path.partition(".")
    label = rest.partition(".")[0]
    labels = [part.label for part in getattr(base, group)] if group in _GROUPS else []
    if labels and label not in labels and not any(mark in label for mark in "*?["):
        expected = f"one of {', '.join(labels)}"
        return Problem(key, f"{label!r}, which the base does not have", expected, did_you_mean(label, labels))
    return problem._replace(path=key)
