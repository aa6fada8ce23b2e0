"""Sources of particles, and several of them together."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cgemit.tables.check import Array
from cgemit.values import InTurn

if TYPE_CHECKING:
    from cgemit.detector import Detector


class Source:
    """Anything that shoots particles; ``source + other`` shoots both in every event.

    Attributes
    ----------
    multiplicity : int
        Most particles in an event; particle numbers of the next source begin there.
    """

    multiplicity: int

    def shoot(self, seed: int, events: npt.NDArray[np.int64], number: int) -> dict[str, Array]:
        """Return the columns of a particles table, rows in any order.

        Parameters
        ----------
        seed : int
        events : ndarray, (n,) int64
        number : int
            Of its first particle in each event.
        """
        raise NotImplementedError

    def within(self, detector: Detector) -> Source:
        """Return the source as it shoots in a detector: itself, unless its particles start in matter."""
        return self

    def __add__(self, other: Source | Guns) -> Guns:
        """Return the sources that shoot together in every event."""
        return Guns((self,)) + other


@dataclass(frozen=True, repr=False)
class Guns:
    """Several sources that shoot in every event, numbered in the order in which they were added."""

    guns: tuple[Source, ...]

    def __add__(self, other: Source | Guns) -> Guns:
        """Return these sources and another one, or others, together."""
        if not isinstance(other, Source | Guns):
            return NotImplemented
        return Guns((*self.guns, *((other,) if isinstance(other, Source) else other.guns)))

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.guns))

    def _repr_html_(self) -> str:
        names = [name for name in _UNITS if any(getattr(gun, name, None) is not None for gun in self.guns)]
        left = 'style="text-align:left"'
        rows = "".join(
            f"<tr><th {left}>{name} {_UNITS[name]}</th>"
            + "".join(f"<td {left}>{escape(_shown(getattr(gun, name, None)))}</td>" for gun in self.guns)
            + "</tr>"
            for name in names
        )
        return f"<p><b>Gun</b></p><table>{rows}</table>"


_UNITS = {
    "name": "", "particle": "", "p": "[GeV/c]", "pt": "[GeV/c]", "theta": "[rad]", "cos_theta": "", "phi": "[rad]",
    "vertex": "[mm]", "vertex_sigma": "[mm]", "radius": "[mm]", "crossing": "[rad]", "multiplicity": "",
}  # fmt: skip


def _shown(value: object) -> str:
    """Return a quantity as text: a fixed value, a range, or values in turn."""
    if isinstance(value, InTurn):
        shown = ", ".join(f"{one:g}" for one in value.values[:6])
        return f"in turn {shown}" + (f" ... ({len(value.values)})" if len(value.values) > 6 else "")
    if isinstance(value, tuple) and len(value) == 2:
        return f"{value[0]:g} to {value[1]:g}"
    if isinstance(value, tuple):
        return ", ".join(map(_shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
