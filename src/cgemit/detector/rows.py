"""The numbers of a scatterer that the core needs, from those of its shells and their materials."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit import _core
from cgemit.detector.kept import once
from cgemit.detector.material import Element, Material
from cgemit.detector.shell import Shell

#: Numbers of a slab, in the order of `Row.numbers`: mm, but `x0` dimensionless and `xi` in GeV.
NUMBERS = ("half_length", "r_in", "r_out", "radius", "spread", "x0", "xi")


class Row(NamedTuple):
    """What the core needs of a slab: the columns `NUMBERS`, the Bethe logarithm, (Z, A, mol/cm2) of its elements."""

    numbers: tuple[float, ...]
    log_terms: NDArray[np.float64]  # (LOSS_POINTS,)
    elements: NDArray[np.float64]  # (elements, 3)


@once
def _compiled(material: Material) -> _core.Material:
    grid = _core.LOSS_GRID_FIRST + _core.LOSS_GRID_STEP * np.arange(_core.LOSS_POINTS, dtype=np.float64)
    elements = [(_first(one), moles * material.density * 0.1) for one, moles in material.elements()]
    return _core.Material(
        x0=material.x0, xi=material.xi_per_mm, log_term=material.log_term(grid),
        elements=[(id(one), one.z, one.a, per_mm) for one, per_mm in elements],
    )  # fmt: skip


@cache
def _first(element: Element) -> Element:
    """Return the first element that was equal, so that equal ones are the same object."""
    return element


def row_of(shells: Sequence[Shell]) -> Row:
    """Return the row of neighbouring shells that act as one scatterer.

    Parameters
    ----------
    shells : sequence of Shell
    """
    _, _, r_in, r_out, half_lengths, materials = zip(*shells, strict=True)
    made = {id(material): _compiled(material) for material in {id(one): one for one in materials}.values()}
    radius, spread, x0, xi, log_terms, elements = _core.sum_shells(
        materials=[made[id(material)] for material in materials], r_in=r_in, r_out=r_out
    )
    numbers = (max(half_lengths), r_in[0], max(r_out), radius, spread, x0, xi)
    return Row(numbers, log_terms, elements)
