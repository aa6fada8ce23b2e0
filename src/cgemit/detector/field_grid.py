"""A magnetic field on a regular grid, and the splines through it that the core evaluates."""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Columns of a map: axes, components.
CYLINDER = (("r", "z"), ("br", "bz"))
BOX = (("x", "y", "z"), ("bx", "by", "bz"))


class Axis(NamedTuple):
    """Equidistant points of a grid along one axis."""

    name: str
    first: float  # mm
    step: float  # mm
    points: int

    @property
    def last(self) -> float:
        """The last point, mm."""
        return self.first + self.step * (self.points - 1)


@dataclass(frozen=True, eq=False)
class FieldGrid:
    """Values of a field at the points of a grid; equal grids hold the same numbers.

    Attributes
    ----------
    axes : tuple of Axis
        r, z or x, y, z.
    values : ndarray, (points of each axis, components) float64, T
        Br, Bz or Bx, By, Bz.
    """

    axes: tuple[Axis, ...]
    values: Floats = field(repr=False)

    @cached_property
    def checksum(self) -> str:
        """The first 16 hexadecimal digits of the SHA-256 of all numbers."""
        numbers = [number for axis in self.axes for number in axis[1:]]
        digest = hashlib.sha256(np.array(numbers, dtype="<f8").tobytes())
        digest.update(np.ascontiguousarray(self.values, dtype="<f8").tobytes())
        return digest.hexdigest()[:16]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FieldGrid) and self.checksum == other.checksum

    def __hash__(self) -> int:
        return hash(self.checksum)

    def range_text(self) -> str:
        """Return where the map is valid."""
        return ", ".join(f"{axis.name} = {axis.first:g} to {axis.last:g} mm" for axis in self.axes)

    def coefficients(self) -> Floats:
        """Return the coefficients of cubic B-splines through the values.

        Returns
        -------
        ndarray, (points + 2 of each axis, components) float64, T
            Around the beam line Br is odd and Bz even in r; at every other edge the outermost two intervals share one
            polynomial ("not a knot": C. de Boor, A Practical Guide to Splines, 1978, chapter IV).
        """
        if len(self.axes) == 3:
            found = self.values
            for number in range(3):
                found = _along(_spline_matrix(self.axes[number].points), found, number)
            return np.ascontiguousarray(found)
        r, z = self.axes
        parts = [
            _along(_spline_matrix(r.points, parity), self.values[..., i : i + 1], 0)
            for i, parity in enumerate((-1.0, 1.0))
        ]
        return np.ascontiguousarray(_along(_spline_matrix(z.points), np.concatenate(parts, axis=-1), 1))

    def bz_at_origin(self) -> float:
        """Return Bz at the origin, T; the grid must hold it."""
        row = self.coefficients()[..., -1]
        for axis in self.axes:
            row = np.tensordot(_weights(axis, 0.0), row, axes=(0, 0))
        return float(row)


def _weights(axis: Axis, at: float) -> Floats:
    """Return the B-splines of an axis at a point."""
    position = (at - axis.first) / axis.step
    distance = np.abs(np.arange(-1, axis.points + 1) - position)
    near = (4 - 6 * distance**2 + 3 * distance**3) / 6
    return np.asarray(np.where(distance < 1, near, np.maximum(2 - distance, 0) ** 3 / 6), dtype=np.float64)


def _along(matrix: Floats, values: Floats, axis: int) -> Floats:
    return np.asarray(np.moveaxis(np.tensordot(matrix, values, axes=(1, axis)), 0, axis), dtype=np.float64)


def _spline_matrix(points: int, parity: float = 0.0) -> Floats:
    """Return what makes coefficients (points + 2) of values (points); `parity` about the first point, 0 for none."""
    equations = np.zeros((points + 2, points + 2))
    for i in range(points):
        equations[i, i : i + 3] = 1 / 6, 4 / 6, 1 / 6
    one_polynomial: Any = (1, -4, 6, -4, 1)
    if parity:
        equations[points, [0, 2]] = 1, -parity
    else:
        equations[points, :5] = one_polynomial
    equations[points + 1, -5:] = one_polynomial
    return np.asarray(np.linalg.inv(equations)[:, :points], dtype=np.float64)
