"""Layers of matter as text, such as ``"Kapton 300 um + Cu 33 um"``."""

import re
from typing import NamedTuple

from cgemit.detector.material import Material
from cgemit.detector.materials import MaterialNameError, material_named
from cgemit.problems import Problem
from cgemit.units import NATIVE, QuantityError, parse_quantity

_EXAMPLE = '"Kapton 300 um", "He/C3H8 60/40 16 mm" or "C 2.0 g/cm3 213.5 um"'
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\s*(?:[^\s\d.+-]\S*)?)")
_FRACTIONS = re.compile(r"\s*((?:\d+\.?\d*|\.\d+)(?:/(?:\d+\.?\d*|\.\d+))+)%?(?=\s|$)")
#: mm. Thinner than an atom is no layer; far below, X/X0 vanishes in the arithmetic.
THINNEST, THICKEST = 1e-9, 1e6
_DENSITIES = (1e-6, 25.0)  # g/cm3, as in detector files


class Layer(NamedTuple):
    """A plane layer: material, thickness in mm, and the default chosen for an incomplete text."""

    material: Material
    thickness: float
    note: str = ""


def parse_stack(text: str, problems: list[Problem]) -> tuple[Layer, ...]:
    """Return the layers that a text describes; add its problems to `problems`.

    Parameters
    ----------
    text : str
        Layers with "+" between them: name of the material (`material_named`), for gases fractions by volume such as
        ``60/40``, a density if it is not the usual one, and the thickness.
    problems : list of Problem
        Added to; their path names the layer and its first character.

    """
    found = []
    # An exponent such as 1e+3 is not the end of a layer.
    ends = [m.start() for m in re.finditer(r"(?<![\d.][eE])\+", text)]
    starts = [0, *(end + 1 for end in ends)]
    for number, (start, end) in enumerate(zip(starts, [*ends, len(text)], strict=True), 1):
        part = text[start:end]
        column = start + len(part) - len(part.lstrip()) + 1
        layer = _layer(part, f"layer {number}, character {column}", problems)
        if layer:
            found.append(layer)
    return tuple(found)


def _layer(part: str, place: str, problems: list[Problem]) -> Layer | None:
    name, _, rest = part.strip().partition(" ")
    if not name:
        problems.append(Problem(place, "nothing", f"material and thickness, as {_EXAMPLE}"))
        return None
    before = len(problems)
    volumes = None
    fractions = _FRACTIONS.match(rest)
    if fractions:
        volumes = tuple(map(float, fractions[1].split("/")))
        rest = rest[fractions.end() :]
    density, thickness = _numbers(rest, place, problems)
    try:
        material, note = material_named(name, volumes, density)
    except MaterialNameError as error:
        problems.append(Problem(place, error.given, error.expected, error.hint))
    return Layer(material, thickness, note) if len(problems) == before else None


def _numbers(text: str, place: str, problems: list[Problem]) -> tuple[float | None, float]:
    """Return density (None if not given) and thickness; 1 for a wrong value, since the name is still to be read."""
    quantities = [match[1] for match in _QUANTITY.finditer(text)]
    if re.sub(r"\s", "", "".join(quantities)) != re.sub(r"\s", "", text) or not 1 <= len(quantities) <= 2:
        given = f'"{text.strip()}" after the material' if text.strip() else "no thickness"
        problems.append(Problem(place, given, f"a thickness, before it a density if need be, as {_EXAMPLE}"))
        return 1.0, 1.0
    limits = {"density": _DENSITIES, "length": (THINNEST, THICKEST)}
    values = []
    for quantity, dimension in zip(quantities, ("density", "length")[-len(quantities) :], strict=True):
        least, most = limits[dimension]
        values.append(1.0)
        try:
            value = parse_quantity(quantity, dimension)
        except QuantityError as error:
            problems.append(Problem(place, error.given, error.expected, error.hint))
            continue
        if least <= value <= most:
            values[-1] = value
        else:
            expected = f"a {dimension} from {least:g} to {most:g} {NATIVE[dimension]}"
            problems.append(Problem(place, f'"{quantity.strip()}"', expected))
    return (values[0] if len(values) == 2 else None), values[-1]
