"""Columns of what a sweep varies: headers with units, and the base's own values."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

from cgemit.detector import Detector
from cgemit.detector.variants import matching, value_at
from cgemit.study.sweeps.space import split_quantity
from cgemit.units import NATIVE, format_quantity, units_of


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
    return key, [_own_text(key, base), *(_text(value) for value in values)]


def _text(value: Any) -> str:
    return "" if value is None else value if isinstance(value, str) else json.dumps(value, default=str)


def _values(key: str, base: Detector) -> list[tuple[Any, Any]]:
    paths = [path for one in key.split(",") for path in matching(base, one.strip(), [])]
    return [found for path in paths if (found := value_at(base, path)) is not None]


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


def _own_text(key: str, base: Detector) -> str:
    if key == "base":
        return base.name
    texts = {getattr(value, "name", str(value)) for value, _ in _values(key, base)}
    return texts.pop() if len(texts) == 1 else ""
