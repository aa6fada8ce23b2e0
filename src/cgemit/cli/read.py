"""Values of the command line as numbers: quantities with units, ranges, lists, names."""

from __future__ import annotations

import argparse
import math

from cgemit.units import QuantityError, parse_quantity

#: What a gun takes for a quantity: one number, a uniform range, or values in turn.
Values = float | tuple[float, float] | list[float]

_MOST_STEPS = 10_000  # values of A:B:N; more are a mistake


def momenta(text: str) -> Values:
    """Read momenta in GeV/c or with a unit: a number, ``A:B`` (uniform), ``A:B:N`` (ends included) or ``A,B,C``."""
    return _values(text, "momentum")


def cosines(text: str) -> Values:
    """Read cosines of the polar angle, as `momenta`."""
    return _values(text, "dimensionless")


def numbers(text: str) -> Values:
    """Read numbers without a unit, as `momenta`."""
    return _values(text, "dimensionless")


def angles(text: str) -> Values:
    """Read angles in rad or with a unit, as `momenta`."""
    return _values(text, "angle")


def triple(text: str) -> tuple[float, float, float]:
    """Read three lengths, ``X,Y,Z``."""
    found = _values(text, "length")
    if not isinstance(found, list) or len(found) != 3:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected three lengths X,Y,Z")
    return found[0], found[1], found[2]


def names(text: str) -> tuple[str, ...]:
    """Read names, ``A,B,C``."""
    return tuple(part.strip() for part in text.split(","))


def surfaces(text: str) -> tuple[float | str, ...]:
    """Read the surfaces of states, ``A,B,C``: a length is a radius, a name stays a name."""
    try:
        return tuple(part if part.isidentifier() else _number(part, "length") for part in names(text))
    except QuantityError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def positive(text: str) -> int:
    """Read a whole number of at least 1."""
    return whole(text, 1, 2**31 - 1)


def event(text: str) -> int:
    """Read the number of an event."""
    return whole(text, 0, 2**31 - 1)


def seed(text: str) -> int:
    """Read the seed of the random numbers."""
    return whole(text, 0, 2**64 - 1)


def whole(text: str, least: int, most: int) -> int:
    """Read a whole number from `least` to `most`."""
    try:
        number = int(text) if text.strip().lstrip("+-").isdecimal() else _from_scientific(text)
    except ValueError:
        number = least - 1
    if number < least:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected a whole number of at least {least}")
    if number > most:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected a whole number of at most {most}")
    return number


def _from_scientific(text: str) -> int:
    """Return the whole number that a text such as ``1e4`` stands for."""
    value = float(text)
    if not value.is_integer() or abs(value) > 2**53:  # beyond, a float is not exact
        raise ValueError(text)
    return int(value)


def length(text: str) -> float:
    """Read a positive length, in mm; `160 um` or `0.16 mm`."""
    value = _number(text, "length")
    if not value > 0:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a length above 0")
    return value


def _values(text: str, dimension: str) -> Values:
    try:
        if "," in text:
            return [_number(part, dimension) for part in text.split(",")]
        parts = text.split(":")
        if len(parts) == 3:
            count = whole(parts[2], 1, _MOST_STEPS)
            return _steps(_number(parts[0], dimension), _number(parts[1], dimension), count)
        numbers = [_number(part, dimension) for part in parts]
    except QuantityError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if len(numbers) > 2:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected a number, A:B, A:B:COUNT or A,B,C")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def _steps(start: float, stop: float, count: int) -> list[float]:
    if count == 1:
        return [start]
    # Rounded, so that 0.2:2.0:10 is 0.2, 0.4, 0.6 and not 0.6000000000000001.
    return [round(start + (stop - start) * i / (count - 1), 12) for i in range(count)]


def _number(text: str, dimension: str) -> float:
    try:
        number = float(text)
    except ValueError:
        return parse_quantity(text, dimension)
    if not math.isfinite(number):
        raise QuantityError(f"{text!r} (not finite)", "a finite number")
    return number
