"""Quantities as strings with units, such as ``"87.5 mm"``; inside the program every quantity has one native unit."""

from __future__ import annotations

import math
import re
from decimal import Decimal

from cgemit.base.errors import WrongValueError, did_you_mean

#: Native unit of each dimension: the unit of every number inside the program.
NATIVE = {
    "length": "mm",
    "angle": "rad",
    "field": "T",
    "electric field": "kV/cm",
    "density": "g/cm3",
    "energy": "GeV",
    "momentum": "GeV/c",
    "time": "ns",
    "charge": "fC",
    "slope": "mm/mm",
    "diffusion": "mm/sqrt(mm)",
    "inverse area": "/mm2",
    "inverse area squared": "/mm4",
    "speed": "mm/ns",
    "rate": "kHz",
    "rate density": "kHz/cm2",
    "dimensionless": "",
}

#: Speed of light, mm/ns (exact).
LIGHT = 299.792458
#: Momentum of unit charge on a circle of 1 mm in 1 T, GeV/c (PDG, Phys. Rev. D 110, 030001 (2024), section 35.12).
GEV_PER_T_MM = LIGHT / 1e6

_DEGREE = Decimal(math.pi) / 180
# Value of one unit in the native unit of its dimension; decimal so that "650 um" is 0.65 mm to the last bit.
_UNITS: dict[str, dict[str, Decimal]] = {
    "length": {"mm": Decimal(1), "um": Decimal("1e-3"), "µm": Decimal("1e-3"), "μm": Decimal("1e-3"),
               "nm": Decimal("1e-6"), "cm": Decimal(10), "m": Decimal(1000)},
    "angle": {"rad": Decimal(1), "mrad": Decimal("1e-3"), "deg": _DEGREE, "°": _DEGREE},
    "field": {"T": Decimal(1), "mT": Decimal("1e-3"), "kG": Decimal("0.1"), "G": Decimal("1e-4")},
    "electric field": {"kV/cm": Decimal(1), "V/cm": Decimal("1e-3"), "V/mm": Decimal("1e-2"), "kV/mm": Decimal(10)},
    "density": {"g/cm3": Decimal(1), "mg/cm3": Decimal("1e-3"), "kg/m3": Decimal("1e-3"), "g/l": Decimal("1e-3")},
    "energy": {"GeV": Decimal(1), "MeV": Decimal("1e-3"), "keV": Decimal("1e-6"), "eV": Decimal("1e-9")},
    "momentum": {"GeV/c": Decimal(1), "MeV/c": Decimal("1e-3")},
    "time": {"ns": Decimal(1), "ps": Decimal("1e-3"), "us": Decimal(1000)},
    "charge": {"fC": Decimal(1), "pC": Decimal(1000), "e": Decimal("1.602176634e-4")},
    "diffusion": {"mm/sqrt(mm)": Decimal(1), "um/sqrt(cm)": Decimal("1e-3") / Decimal(10).sqrt()},
    "slope": {"mm/mm": Decimal(1), "um/mm": Decimal("1e-3")},
    "inverse area": {"/mm2": Decimal(1), "/cm2": Decimal("1e-2"), "/m2": Decimal("1e-6")},
    "inverse area squared": {"/mm4": Decimal(1), "/cm4": Decimal("1e-4"), "/m4": Decimal("1e-12")},
    "speed": {"mm/ns": Decimal(1), "cm/ns": Decimal(10), "m/ns": Decimal(1000),
              "um/ns": Decimal("1e-3"), "cm/us": Decimal("1e-2"), "mm/us": Decimal("1e-3")},
    "rate": {"kHz": Decimal(1), "Hz": Decimal("1e-3"), "MHz": Decimal(1000)},
    "rate density": {"kHz/cm2": Decimal(1), "Hz/cm2": Decimal("1e-3"), "Hz/mm2": Decimal("0.1")},
    "dimensionless": {"": Decimal(1), "%": Decimal("1e-2")},
}  # fmt: skip

#: Characters of a quantity; the time to read one grows with the square of its blanks.
LONGEST = 200
_QUANTITY = re.compile(r"\s*([+-]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|inf|nan))\s*(.*?)\s*", re.IGNORECASE)


class QuantityError(WrongValueError):
    """A quantity that cannot be read.

    Examples
    --------
    >>> try:
    ...     cg.units.parse_quantity("87.5", "length")
    ... except cg.units.QuantityError as error:
    ...     print(error.given)
    "87.5" (no unit)
    """


def parse_quantity(text: object, dimension: str) -> float:
    """Return the number in native units that a string such as ``"87.5 mm"`` stands for.

    Parameters
    ----------
    text : str
        Number and unit. A bare number is accepted for dimension "dimensionless" only.
    dimension : str
        One of the keys of `NATIVE`.

    Returns
    -------
    float
        The value in the dimension's native unit.

    Raises
    ------
    QuantityError
        If the unit is missing or belongs to another dimension, or the number is not a finite number.

    Examples
    --------
    >>> cg.units.parse_quantity("650 um", "length")  # mm
    0.65
    """
    expected = describe(dimension)
    if dimension == "dimensionless" and isinstance(text, int | float) and not isinstance(text, bool):
        return _finite(_float(text), _quoted(text), expected)
    if isinstance(text, int | float) and not isinstance(text, bool):
        raise QuantityError(f"{_quoted(text)} (no unit)", expected, _unit_hint(_float(text), dimension))
    match = _QUANTITY.fullmatch(text) if isinstance(text, str) and len(text) <= LONGEST else None
    if not match:
        raise QuantityError(_quoted(text), expected)
    number, unit = match.groups()
    unit = unit.replace("³", "3").replace("^", "").replace("**", "")
    if unit not in _UNITS[dimension]:
        raise QuantityError(*_unit_problem(str(text), number, unit, dimension))
    value = _finite(float(number), _quoted(text), expected)
    return value if unit == NATIVE[dimension] else float(Decimal(number) * _UNITS[dimension][unit])


def format_quantity(value: float, dimension: str, unit: str | None = None) -> str:
    """Return `value` (native units) as text with its unit.

    In the native unit (the default) all digits are kept, so that `parse_quantity` returns exactly `value`;
    in another unit six significant digits are written, for people.

    Parameters
    ----------
    value : float
    dimension : str
        Such as ``"length"``, a key of `NATIVE`.
    unit : str or None
        One of `units_of`; None: the native one.

    Examples
    --------
    >>> cg.units.format_quantity(0.65, "length", "um"), cg.units.format_quantity(0.65, "length")
    ('650 um', '0.65 mm')
    """
    if unit is None:
        return f"{value!r} {NATIVE[dimension]}".strip()
    return f"{float(Decimal(value) / _UNITS[dimension][unit]):.6g} {unit}".strip()


def describe(dimension: str) -> str:
    """Return what a value of this dimension looks like, for messages.

    Parameters
    ----------
    dimension : str
        Such as ``"length"``, a key of `NATIVE`.

    Examples
    --------
    >>> cg.units.describe("length")
    'a length with its unit (mm, um, nm, cm, m)'
    """
    if dimension == "dimensionless":
        return "a finite number"
    article = "an" if dimension[0] in "aeiou" else "a"
    return f"{article} {dimension} with its unit ({', '.join(u for u in _UNITS[dimension] if u.isascii())})"


def units_of(dimension: str) -> tuple[str, ...]:
    """Return the unit names that `parse_quantity` accepts for a dimension.

    Parameters
    ----------
    dimension : str
        Such as ``"length"``, a key of `NATIVE`.

    Examples
    --------
    >>> cg.units.units_of("angle")
    ('rad', 'mrad', 'deg', '°')
    """
    return tuple(_UNITS[dimension])


_LONGEST = 80  # characters of a value in a message


def _quoted(text: object) -> str:
    try:
        shown = text if isinstance(text, str) else repr(text)
    except ValueError:  # a whole number of thousands of digits
        return "a number too large to write"
    shown = shown if len(shown) <= _LONGEST else f"{shown[:_LONGEST]}..."
    return f'"{shown}"' if isinstance(text, str) else shown


def _float(number: float) -> float:
    try:
        return float(number)
    except OverflowError:  # a whole number of hundreds of digits
        return math.inf


def _finite(value: float, given: str, expected: str) -> float:
    if not math.isfinite(value):
        raise QuantityError(f"{given} (not finite)", expected)
    return value


def _unit_hint(number: float, dimension: str) -> str:
    examples = [f'"{number:g} {unit}"' for unit in _UNITS[dimension] if unit.isascii()][:2]
    return "write the unit, as in " + " or ".join(examples)


def _sister(number: str, unit: str, dimension: str) -> str:
    """Return a hint for an energy in place of a momentum, or the reverse: people write MeV for both."""
    sister = unit.removesuffix("/c") if unit.endswith("/c") else f"{unit}/c"
    return f'did you mean "{number} {sister}"?' if sister in _UNITS[dimension] else ""


def _unit_problem(text: str, number: str, unit: str, dimension: str) -> tuple[str, str, str]:
    """Return (given, expected, hint) for a unit that does not belong to `dimension`."""
    expected = describe(dimension)
    if not unit:
        return f"{_quoted(text)} (no unit)", expected, _unit_hint(float(number), dimension)
    for other, units in _UNITS.items():
        if unit in units:
            article = "an" if other[0] in "aeiou" else "a"
            return f"{_quoted(text)} ({article} {other})", expected, _sister(number, unit, dimension)
    hint = did_you_mean(unit, _UNITS[dimension]) or did_you_mean(f"{unit}/c", _UNITS[dimension])
    return f'{_quoted(text)} (unknown unit "{unit}")', expected, hint
