"""Values that users give: plain numbers, and a gun's quantities.

Of a gun's quantities a number is fixed, a tuple a uniform range, and a list or array holds values to use in turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.units import QuantityError, parse_quantity


def number(given: object) -> float:
    """Return a number of Python or numpy as a float; NaN, which no range holds, for anything else."""
    if not isinstance(given, int | float | np.integer | np.floating) or isinstance(given, bool):
        return math.nan
    try:
        return float(given)
    except OverflowError:  # a whole number of hundreds of digits
        return math.inf


def is_whole(given: object, least: int, most: int) -> bool:
    """Tell whether something is a whole number, of Python or numpy, within limits."""
    return isinstance(given, int | np.integer) and not isinstance(given, bool) and bool(least <= given <= most)


def check_numbers(where: str, seed: int, threads: int | None, **others: tuple[int | None, int, int]) -> None:
    """Check whole numbers; None is allowed.

    Parameters
    ----------
    where : str
        The beginning of the message.
    seed : int
    threads : int or None
    **others : (int or None, int, int)
        More numbers by name, each with its least and most.

    Raises
    ------
    ValueError
        Listing every problem.
    """
    numbers = {**others, "seed": (seed, 0, 2**64 - 1), "threads": (threads, 1, 2**15)}
    problems = [
        f"{name}: {value!r}, expected a whole number from {least} to {most}"
        for name, (value, least, most) in numbers.items()
        if value is not None and not (isinstance(value, int | np.integer) and least <= value <= most)
    ]
    if problems:
        raise ValueError(f"{where}:\n  " + "\n  ".join(problems))


@dataclass(frozen=True)
class InTurn:
    """Values used one after the other: event number `i` gets the value at position ``i modulo their number``."""

    values: tuple[float, ...]

    def __repr__(self) -> str:
        return repr(list(self.values))


#: A quantity in native units, as it is kept.
Value = float | tuple[float, float] | InTurn
#: What is accepted for it; strings carry a unit.
ValueLike = Value | str | tuple[str, str] | Sequence[float | str] | npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Limit:
    """What a quantity may be: its dimension, whether a number fits, and how to say so."""

    dimension: str
    fits: Callable[[float], bool]
    expected: str


def parse_value(path: str, given: Any, limit: Limit, problems: list[str]) -> Value:
    """Return a quantity in the form it is kept in; add what is wrong with it to `problems`.

    Parameters
    ----------
    path : str
        Name of the quantity in messages.
    given : ValueLike
    limit : Limit
    problems : list of str
        Added to.
    """
    if isinstance(given, InTurn):
        given = list(given.values)
    if isinstance(given, np.ndarray):
        given = given.tolist()
    if isinstance(given, tuple):
        return _range(path, given, limit, problems)
    if isinstance(given, list):
        if not given:
            problems.append(f"{path}: got an empty list; expected a list of at least one number")
            return 0.0
        return InTurn(tuple(_number(f"{path}[{i}]", one, limit, problems) for i, one in enumerate(given)))
    return _number(path, given, limit, problems)


def _range(path: str, given: tuple[Any, ...], limit: Limit, problems: list[str]) -> Value:
    if len(given) != 2:
        problems.append(f"{path}: got {given!r}; expected (low, high), or a list for values to use in turn")
        return 0.0
    before = len(problems)
    low, high = (_number(f"{path}[{i}]", one, limit, problems) for i, one in enumerate(given))
    if low > high and len(problems) == before:
        problems.append(f"{path}: got ({low}, {high}); expected a range from low to high")
    return low, high


def _number(path: str, given: Any, limit: Limit, problems: list[str]) -> float:
    """Return one number in native units; 0, with a problem added, if it is not a number in the limits."""
    if isinstance(given, str):
        try:
            value = parse_quantity(given, limit.dimension)
        except QuantityError as error:
            problems.append(f"{path}: got {error}")
            return 0.0
    else:
        value = number(given)
    if math.isfinite(value) and limit.fits(value):
        return value
    degrees = limit.dimension == "angle" and not isinstance(given, str) and limit.fits(math.radians(value))
    hint = f' (did you mean "{given:g} deg"?)' if degrees and math.isfinite(value) else ""
    problems.append(f"{path}: got {given!r}; expected {limit.expected}{hint}")
    return 0.0


def parse_three(path: str, given: Any, limit: Limit, problems: list[str]) -> tuple[Value, Value, Value]:
    """Return quantities along x, y and z; add what is wrong with them to `problems`."""
    if not isinstance(given, tuple | list | np.ndarray) or len(given) != 3:
        problems.append(f"{path}: got {given!r}; expected three, along x, y and z")
        return 0.0, 0.0, 0.0
    x, y, z = (parse_value(f"{path}.{axis}", one, limit, problems) for axis, one in zip("xyz", given, strict=True))
    return x, y, z
