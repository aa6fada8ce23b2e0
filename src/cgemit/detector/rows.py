"""The numbers of a scatterer that the core needs, from those of its shells and their materials."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit import _core
from cgemit.detector.kept import once
from cgemit.detector.material import Element, Material
from cgemit.detector.parts import Shell

#: Numbers of a slab, in the order of `Row.numbers`: mm, but `x0` dimensionless and `xi` in GeV.
NUMBERS = ("half_length", "r_in", "r_out", "radius", "spread", "x0", "xi")


class Row(NamedTuple):
    """What the core needs of a slab: the columns `NUMBERS`, the Bethe logarithm, (Z, A, mol/cm2) of its elements."""

    numbers: tuple[float, ...]
    log_terms: NDArray[np.float64]
    elements: tuple[tuple[float, float, float], ...]


class _Matter(NamedTuple):
    """What a millimetre of a material adds to a slab."""

    xi: float  # GeV/mm
    log_term: NDArray[np.float64]
    elements: tuple[tuple[Element, int, float], ...]  # with a number that only equal ones share, and mol/(cm2 mm)


@cache
def _first(element: Element) -> Element:
    """Return the first element that was equal, so that equal ones are the same object."""
    return element


@once
def _matter(material: Material) -> _Matter:
    grid = _core.LOSS_GRID_FIRST + _core.LOSS_GRID_STEP * np.arange(_core.LOSS_POINTS, dtype=np.float64)
    elements = [(_first(element), moles * material.density * 0.1) for element, moles in material.elements()]
    numbered = tuple((element, id(element), per_mm) for element, per_mm in elements)
    return _Matter(material.xi_per_mm, material.log_term(grid), numbered)


def moments(shells: Sequence[Shell]) -> tuple[float, float, float]:
    """Return X/X0 of shells at normal incidence, and centroid and standard deviation of their scattering power, mm.

    Each shell counts with its own width.

    Parameters
    ----------
    shells : sequence of Shell
    """
    parts = []
    for _, _, r_in, r_out, _, material in shells:
        width = r_out - r_in
        parts.append((width / material.x0, 0.5 * (r_in + r_out), width))
    x0 = sum([part for part, _, _ in parts])
    radius = sum([part * middle for part, middle, _ in parts]) / x0
    total = sum([part * ((middle - radius) ** 2 + width**2 / 12) for part, middle, width in parts])
    return x0, radius, math.sqrt(total / x0)


def row_of(shells: Sequence[Shell]) -> Row:
    """Return the row of neighbouring shells that act as one scatterer.

    Parameters
    ----------
    shells : sequence of Shell
    """
    xi, log_terms = [], []
    found: list[Element] = []
    moles: dict[int, float] = {}
    for _, _, r_in, r_out, _, material in shells:
        width, matter = r_out - r_in, _matter(material)
        xi.append(matter.xi * width)
        log_terms.append(matter.log_term)
        for element, number, per_mm in matter.elements:
            if number in moles:
                moles[number] += per_mm * width
            else:
                moles[number] = per_mm * width
                found.append(element)
    total = sum(xi)
    weighted = np.array(log_terms) * np.array(xi)[:, None] if len(xi) > 1 else None
    terms = log_terms[0] * total if weighted is None else np.add.reduce(weighted, axis=0)
    x0, radius, spread = moments(shells)
    half_length, r_out = max([shell.half_length for shell in shells]), max([shell.r_out for shell in shells])
    numbers = (half_length, shells[0].r_in, r_out, radius, spread, x0, total)
    elements = tuple([(one.z, one.a, amount) for one, amount in zip(found, moles.values(), strict=True)])
    return Row(numbers, terms / total, elements)
