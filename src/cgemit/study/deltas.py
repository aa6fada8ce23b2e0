"""How often delta electrons leave deposits away from the track that knocked them out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cgemit.result import Result
from cgemit.statistics.estimate import share_error
from cgemit.statistics.formatting import Comparable, html_table, text_table, with_error
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

#: Distances from the track, mm.
DISTANCES = (0.2, 0.5, 1.0, 2.0, 5.0)

_HEAD = ("beyond [mm]", "in r-phi [%]", "in z [%]")


@dataclass(frozen=True, eq=False, repr=False)
class DeltaFractions(Comparable):
    """Fractions of the crossings of a drift gap with a delta electron's deposit beyond some distances from the track.

    Attributes
    ----------
    beyond : tuple of float, mm
    crossings : int
        Number of crossings, with and without delta electrons.
    rphi, rphi_error : tuple of float
        Fractions by distance along the circumference, and their binomial errors (half of Wilson's interval).
    z, z_error : tuple of float
        The same along the beam.
    """

    beyond: tuple[float, ...]
    crossings: int
    rphi: tuple[float, ...]
    rphi_error: tuple[float, ...]
    z: tuple[float, ...]
    z_error: tuple[float, ...]

    def _rows(self) -> list[list[str]]:
        pairs = zip(self.rphi, self.rphi_error, self.z, self.z_error, strict=True)
        cells = [[with_error(100 * v, 100 * e), with_error(100 * w, 100 * f)] for v, e, w, f in pairs]
        return [[f"{distance:g}", *row] for distance, row in zip(self.beyond, cells, strict=True)]

    def _title(self) -> str:
        return f"delta electrons away from their track, {self.crossings:,} crossings"

    def __repr__(self) -> str:
        return text_table(self._title(), _HEAD, self._rows())

    def _repr_html_(self) -> str:
        return html_table(self._title(), _HEAD, self._rows())


def delta_fractions(result: Result, beyond: Sequence[float] = DISTANCES) -> DeltaFractions:
    """Return how many crossings have a delta electron's deposit beyond some distances from the track.

    Parameters
    ----------
    result : Result
    beyond : sequence of float
        Distances, mm.

    Returns
    -------
    DeltaFractions
        NaN without any crossing.
    """
    rphi, z = delta_displacements(result.truths, result.steps)
    n = len(rphi)

    def shares(displacement: Floats) -> tuple[tuple[float, ...], tuple[float, ...]]:
        values = [float(np.mean(displacement > distance)) if n else float("nan") for distance in beyond]
        return tuple(values), tuple(share_error(value, n) for value in values)

    return DeltaFractions(tuple(beyond), n, *shares(rphi), *shares(z))


def delta_displacements(truths: Table, steps: Table) -> tuple[Floats, Floats]:
    """Return the largest distance of a delta electron's deposit from the track, for each crossing.

    The track is the line between entry and exit, taken at the deposit's radius; both ends of each step count.

    Parameters
    ----------
    truths, steps : Table
        Links of `steps` count rows of `truths`.

    Returns
    -------
    rphi, z : ndarray, (n,) float64, mm
        Along the circumference and along the beam, without sign; 0 where there is no delta electron.
    """
    largest = np.zeros((2, len(truths)))
    rows = np.flatnonzero(steps["parent"] != 0)
    link = steps["truth"][rows]
    entry, exit_ = (_cylindrical(*(truths[f"{end}_{axis}"][link] for axis in "xyz")) for end in ("entry", "exit"))
    for side in (-0.5, 0.5):
        r, phi, z = _cylindrical(*(steps[axis][rows] + side * steps[f"d{axis}"][rows] for axis in "xyz"))
        share = (r - entry[0]) / (exit_[0] - entry[0])
        beside = r * _turn(phi - entry[1] - share * _turn(exit_[1] - entry[1]))
        along = z - entry[2] - share * (exit_[2] - entry[2])
        for values, distance in zip(largest, (beside, along), strict=True):
            np.maximum.at(values, link, np.abs(distance))
    return largest[0], largest[1]


def _cylindrical(x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
    return np.hypot(x, y), np.arctan2(y, x), z


def _turn(phi: Floats) -> Floats:
    """Bring angles between -pi and pi."""
    return np.asarray((phi + np.pi) % (2 * np.pi) - np.pi)
