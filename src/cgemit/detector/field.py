"""Magnetic fields of a detector file, one class a kind. Field in T, lengths in mm; `bz` is the field at the origin."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.errors import Problem
from cgemit.detector.keys import Key, Part, key

#: Columns of a map: axes, components.
CYLINDER = (("r", "z"), ("br", "bz"))
BOX = (("x", "y", "z"), ("bx", "by", "bz"))
POLAR = (("r", "phi", "z"), ("bx", "by", "bz"))
TURNING = ("br", "bphi", "bz")  # other components of a map in r, phi, z

#: Axes whose other side of 0 may follow by symmetry.
MIRRORS = ("x", "y", "z")

_FEWEST, _MOST = 4, 5000  # points along an axis; a cubic needs four, and memory grows with the square
_MOST_POINTS = 20_000_000  # of a grid
_STRONGEST = 10.0  # T
_UNEVEN = 1e-3  # of a step: the digits of text and of single precision
_ON_AXIS = 1e-3  # of the largest field: Br on the beam line may be no more than that
_STATED = 1e-2  # of the largest field: odd components in the plane of a mirror that is named may be no more than that


class Axis(NamedTuple):
    """Equidistant points of a grid along one axis; those of phi are a whole turn."""

    name: str
    first: float  # mm; rad
    step: float  # mm; rad
    points: int

    @property
    def last(self) -> float:
        """The last point, mm or rad."""
        return self.first + self.step * (self.points - 1)

    @property
    def values(self) -> Floats:
        """All points, mm; `step` follows from the ends to the last bit, so that a written map keeps its checksum.

        Azimuths are in rad, and their step follows from their number.
        """
        values: Floats = self.first + self.step * np.arange(self.points, dtype=np.float64)
        while self.name != "phi" and (step := (values[-1] - values[0]) / (self.points - 1)) != self.step:
            values[-1] = np.nextafter(values[-1], math.copysign(math.inf, self.step - step))
        return values


@dataclass(frozen=True, eq=False)
class FieldGrid:
    """Values of a field at the points of a grid; equal grids hold the same numbers.

    Attributes
    ----------
    axes : tuple of Axis
        r, z or x, y, z or r, phi, z.
    values : ndarray, (points of each axis, components) float64, T
        Br, Bz in r and z; else Bx, By, Bz.
    mirrored : tuple of str
        Axes of which the file has one side of 0; the other one is its mirror image.

    Examples
    --------
    >>> from cgemit.detector import read_field_map, write_field_map
    >>> r, z = np.linspace(0, 900, 4), np.linspace(-500, 500, 5)  # mm
    >>> field = {"r": r, "z": z, "br": np.zeros((4, 5)), "bz": np.full((4, 5), -1.0)}  # T
    >>> grid = read_field_map(write_field_map("grid.npz", field))
    >>> grid.values.shape
    (4, 5, 2)
    """

    axes: tuple[Axis, ...]
    values: Floats = field(repr=False)
    mirrored: tuple[str, ...] = ()

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

    @property
    def columns(self) -> dict[str, Floats]:
        """Axes (mm, rad) and components (T) by name, as `write_field_map` takes them."""
        axes, components = names_in(dict.fromkeys(axis.name for axis in self.axes))
        values = {name: self.values[..., i] for i, name in enumerate(components)}
        return {**{name: axis.values for name, axis in zip(axes, self.axes, strict=True)}, **values}

    def range_text(self) -> str:
        """Return where the map is valid."""
        ranges = ", ".join(
            f"{axis.points} steps of phi" if axis.name == "phi" else f"{axis.name} = {axis.first:g} to {axis.last:g} mm"
            for axis in self.axes
        )
        return ranges + (f", mirrored in {', '.join(self.mirrored)}" if self.mirrored else "")

    def coefficients(self) -> Floats:
        """Return the coefficients of cubic B-splines through the values.

        Returns
        -------
        ndarray, (points + 2 of each axis, points + 3 of phi, components) float64, T
            Around the beam line Br is odd and Bz even in r, and components in phi go on at phi + pi; at every other
            edge the outermost two intervals share one polynomial ("not a knot": C. de Boor, A Practical Guide to
            Splines, 1978, chapter IV).
        """
        if self.is_polar:
            return self._around()
        if len(self.axes) == 3:
            values = self.values
            for number in range(3):
                values = _along(_spline_matrix(self.axes[number].points), values, number)
            return np.ascontiguousarray(values)
        r, z = self.axes
        parts = [
            _along(_spline_matrix(r.points, parity), self.values[..., i : i + 1], 0)
            for i, parity in enumerate((-1.0, 1.0))
        ]
        return np.ascontiguousarray(_along(_spline_matrix(z.points), np.concatenate(parts, axis=-1), 1))

    @property
    def is_polar(self) -> bool:
        """Whether the axes are r, phi, z."""
        return self.axes[1].name == "phi"

    def _around(self) -> Floats:
        """Return the coefficients in r, phi, z, wave by wave around: wave m is even in r for even m, else odd."""
        r, phi, z = self.axes
        waves = np.fft.rfft(self.values, axis=1)
        at_points = (2 + np.cos(2 * np.pi * np.arange(waves.shape[1]) / phi.points)) / 3  # of periodic B-splines
        waves /= at_points[:, None, None]
        along_r = np.empty((r.points + 2, *waves.shape[1:]), dtype=waves.dtype)
        for order, parity in enumerate((1.0, -1.0)):
            along_r[:, order::2] = np.tensordot(_spline_matrix(r.points, parity), waves[:, order::2], axes=(1, 0))
        around = np.fft.irfft(along_r, phi.points, axis=1)
        closed = np.concatenate([around[:, -1:], around, around[:, :2]], axis=1)
        return np.ascontiguousarray(_along(_spline_matrix(z.points), closed, 2))

    def bz_at_origin(self) -> float:
        """Return Bz at the origin, T; the grid must hold it."""
        row = self.coefficients()[..., -1]
        for axis in self.axes:
            # On the beam line all azimuths have the same field.
            row = row[1:-2].mean(axis=0) if axis.name == "phi" else np.tensordot(_weights(axis, 0.0), row, axes=(0, 0))
        return float(row)

    @cached_property
    def inaccuracy(self) -> float:
        """How far the field between the points may be off, relative to the largest field.

        The larger of two numbers: the error of the interpolation, which is 1/16 of the error at every second point of
        an axis without these points (of cubic splines it falls with the fourth power of the step), and the divergence
        of the splines at the points times half the largest step.
        """
        from scipy.interpolate import CubicSpline

        off, slopes = 0.0, []
        for i, axis in enumerate(self.axes):
            closed, points, values = "not-a-knot", axis.values, self.values
            if axis.name == "phi":
                closed, points = "periodic", np.append(points, points[0] + 2 * np.pi)
                values = np.concatenate([values, values[:, :1]], axis=1)
            # Every second point; of an uneven number of steps around, no periodic ones.
            if len(points) >= 2 * _FEWEST and (closed != "periodic" or len(points) % 2):
                kept = np.take(values, range(0, len(points), 2), axis=i)
                between = CubicSpline(points[::2], kept, axis=i, bc_type=closed)(points[1 : len(points) - 1 : 2])
                given = np.take(values, range(1, len(points) - 1, 2), axis=i)
                off = max(off, float(np.abs(between - given).max(initial=0.0)) / 16)
            slopes.append(CubicSpline(points, values, axis=i, bc_type=closed)(axis.values, 1))
        step: Any = max(axis.step for axis in self.axes if axis.name != "phi")
        if self.is_polar:
            r, phi = self.axes[0].values[1:, None, None], self.axes[1].values[:, None]
            step = np.maximum(step, r * self.axes[1].step)
            outward, around = (one[1:] for one in slopes[:2])  # at r = 0 the slope around is 0/0
            divergence = np.cos(phi) * outward[..., 0] - np.sin(phi) / r * around[..., 0]
            divergence += np.sin(phi) * outward[..., 1] + np.cos(phi) / r * around[..., 1] + slopes[2][1:, ..., 2]
        else:
            divergence = sum(one[..., i] for i, one in enumerate(slopes))
            if self.axes[0].name == "r":  # at r = 0 the limit of Br/r is its slope
                r = self.axes[0].values[:, None]
                ratio = np.where(r > 0, self.values[..., 0] / np.where(r > 0, r, 1.0), slopes[0][..., 0])
                divergence = divergence + ratio
        return max(off, float((np.abs(divergence) * 0.5 * step).max())) / max(self.largest(), 1e-300)

    def within(self, radius: float, z: float) -> FieldGrid:
        """Return the part of the grid that holds all points up to a radius and a distance along the beam.

        Parameters
        ----------
        radius, z : float, mm
        """
        axes, values = [], self.values
        for i, axis in enumerate(self.axes):
            reach = z if axis.name == "z" else radius
            inside = np.flatnonzero(np.abs(axis.values) < reach + axis.step)
            if axis.name == "phi" or len(inside) < _FEWEST:
                axes.append(axis)
                continue
            first, last = int(inside[0]), int(inside[-1])
            axes.append(Axis(axis.name, axis.first + first * axis.step, axis.step, last - first + 1))
            values = np.take(values, range(first, last + 1), axis=i)
        return FieldGrid(tuple(axes), values, self.mirrored)

    def largest(self) -> float:
        """Return the largest size of the field on the grid, T."""
        return float(np.sqrt(np.max(np.sum(np.square(self.values), axis=-1))))


def _weights(axis: Axis, at: float) -> Floats:
    """Return the B-splines of an axis at a point."""
    position = (at - axis.first) / axis.step
    distance = np.abs(np.arange(-1, axis.points + 1) - position)
    near = (4 - 6 * distance**2 + 3 * distance**3) / 6
    return np.asarray(np.where(distance < 1, near, np.maximum(2 - distance, 0) ** 3 / 6), dtype=np.float64)


def _along(matrix: Floats, values: Floats, axis: int) -> Floats:
    return np.asarray(np.moveaxis(np.tensordot(matrix, values, axes=(1, axis)), 0, axis), dtype=np.float64)


@lru_cache(maxsize=16)
def _spline_matrix(points: int, parity: float = 0.0) -> Floats:
    """Return the matrix (points + 2, points) from values to coefficients; `parity` about the first point, or 0."""
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


class Column(NamedTuple):
    """Values of an axis or a component of a map, in mm or T; without a unit if the file's unit is unknown."""

    values: Floats
    unit: str

    def text(self, *numbers: float) -> str:
        """Return numbers of this column as text."""
        return f"{' to '.join(f'{number:g}' for number in numbers)} {self.unit}".rstrip()


#: By name; None for a column whose problem has been noted.
MapColumns = dict[str, Column | None]


def names_in(columns: Mapping[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the axes and components of the map that these columns belong to."""
    if "phi" in columns:
        return POLAR[0], TURNING if columns.keys() & {"br", "bphi"} else POLAR[1]
    return BOX if columns.keys() & {"x", "y", "bx", "by"} else CYLINDER


def checked_grid(columns: MapColumns, problems: list[Problem], mirror: Sequence[str] | None = None) -> FieldGrid | None:
    """Return the grid of columns in mm, rad and T after checking all that can be checked.

    `mirror` names the axes that are completed by symmetry; None: those of which the columns have one side of 0.
    """
    axes, components = names_in(columns)
    unread = [name for name in columns if name not in (*axes, *components)]
    if unread:
        wanted = f"only {', '.join((*axes, *components))} of a map in {', '.join(axes)}"
        problems.append(Problem(", ".join(unread), "an array that is not read", wanted))
    for name in (*axes, *components):
        if name not in columns:
            wanted = ", ".join((*axes, *components))
            problems.append(Problem(name, "nothing", f"an array {name}; a map has {wanted}"))
    axes_of = [_axis(name, column, problems) for name in axes if (column := columns.get(name))]
    spans = [column.values for name in axes if (column := columns.get(name))]
    known = len(spans) == len(axes) and all(values.ndim == 1 and len(values) >= _FEWEST for values in spans)
    shape = tuple(map(len, spans)) if known else None  # uneven axes have a length, too
    if shape is not None and math.prod(shape) > _MOST_POINTS:
        problems.append(Problem("", f"a grid of {math.prod(shape)} points", f"at most {_MOST_POINTS}"))
    for name in components:
        if column := columns.get(name):
            _check_component(name, column, shape, axes, problems)
    r, br, bz = (columns.get(name) for name in ("r", "br", "bz"))
    if axes == CYLINDER[0] and r and br and bz and br.values.shape == bz.values.shape == shape and _from_0(r.values):
        _check_beam_line(br, bz, problems)
    usable = [column.values for name in components if (column := columns.get(name))]
    _check_mirror(mirror, axes, axes_of, problems)
    if problems:
        return None
    values = np.stack(usable, axis=-1)
    if "phi" in axes:
        (phi,) = (axis for axis in axes_of if axis and axis.name == "phi")
        values = _turned(values, components, phi, problems)
        components = POLAR[1]
    grid = FieldGrid(tuple(axis for axis in axes_of if axis), values)
    return None if problems else _completed(grid, components, problems, named=mirror is not None)


def _check_mirror(
    mirror: Sequence[str] | None, axes: tuple[str, ...], grid_axes: Sequence[Axis | None], problems: list[Problem]
) -> None:
    """Note axes to mirror that a map has not, or of which it has both sides, and halves that are not to be mirrored."""
    if mirror is None:
        return
    if unknown := [name for name in mirror if name not in axes or name not in MIRRORS]:
        known = ", ".join(name for name in axes if name in MIRRORS)
        problems.append(Problem("mirror", ", ".join(unknown), f"none but {known}, axes of the map"))
    for axis in grid_axes:
        if axis is None or axis.name not in MIRRORS:
            continue
        got = f"{axis.first:g} to {axis.last:g} mm"
        if axis.name in mirror and not _is_half(axis):
            problems.append(Problem("mirror", f"{axis.name}, which goes from {got}", "an axis with one side of 0"))
        elif axis.name not in mirror and _is_half(axis):
            problems.append(Problem(axis.name, got, f"both sides of 0, or {axis.name} in mirror"))


def _is_half(axis: Axis) -> bool:
    return min(-axis.first, axis.last) <= _UNEVEN * axis.step


def _turned(values: Floats, components: tuple[str, ...], phi: Axis, problems: list[Problem]) -> Floats:
    """Return Bx, By, Bz in r, phi, z without a last azimuth that repeats the first one; both must then be equal."""
    angle = (phi.first + phi.step * np.arange(values.shape[1]))[:, None]
    if components == TURNING:
        br, bphi = values[..., 0], values[..., 1]
        bx, by = np.cos(angle) * br - np.sin(angle) * bphi, np.sin(angle) * br + np.cos(angle) * bphi
        values = np.stack([bx, by, values[..., 2]], axis=-1)
    least = _ON_AXIS * float(np.sqrt(np.max(np.sum(np.square(values), axis=-1))))
    if values.shape[1] > phi.points:
        off = float(np.abs(values[:, -1] - values[:, 0]).max())
        if off > least:
            problems.append(Problem("phi", f"fields that differ by {off:g} T after a whole turn", "the same field"))
        values = values[:, :-1]
    on_axis = values[0].mean(axis=0)
    off = float(np.abs(values[0] - on_axis).max())
    if off > least:
        given = f"components across that differ by up to {off:g} T at r = 0"
        problems.append(Problem(", ".join(components), given, "one field on the beam line, the same at every phi"))
    values = np.ascontiguousarray(values)
    values[0] = on_axis
    return values


def _completed(
    grid: FieldGrid, components: tuple[str, ...], problems: list[Problem], *, named: bool
) -> FieldGrid | None:
    """Return a grid whose axes are on both sides of 0: half a map is completed by its mirror image.

    The symmetry is that of a solenoid: for z, Bz is even and the other components are odd; for x and y, the component
    along the axis is odd and the others are even. Odd components vanish at 0, where those of a map with a `named` axis
    may differ a little from 0 and are set to it.
    """
    axes, values, mirrored = list(grid.axes), grid.values, []
    largest = grid.largest()
    for i, axis in enumerate(axes):
        if axis.name not in MIRRORS or not _is_half(axis):
            continue
        odd = np.array([(name == f"b{axis.name}") != (axis.name == "z") for name in components])
        from_0 = abs(axis.first) <= _UNEVEN * axis.step
        middle = np.abs(np.take(grid.values, 0 if from_0 else -1, axis=i)).reshape(-1, len(components))
        for name, value in zip(components, middle.max(axis=0), strict=True):
            if odd[components.index(name)] and value > (_STATED if named else _ON_AXIS) * largest:
                expected = f"0 there, or a map on both sides of {axis.name} = 0: half of it is completed by symmetry"
                hint = "" if named else f"mirror = {axis.name!r} allows {_STATED * largest:.2g} T"
                problems.append(Problem(name, f"up to {value:g} T at {axis.name} = 0", expected, hint))
        values = values.copy()
        np.moveaxis(values, i, 0)[0 if from_0 else -1][..., odd] = 0
        other = np.flip(values, axis=i) * np.where(odd, -1.0, 1.0)
        halves = (np.delete(other, -1, axis=i), values) if from_0 else (values, np.delete(other, 0, axis=i))
        if math.prod(values.shape[:-1]) * 2 > _MOST_POINTS:
            given = f"a grid of more than {_MOST_POINTS} points with its mirror images"
            problems.append(Problem("", given, f"at most {_MOST_POINTS}"))
            return None
        values = np.concatenate(halves, axis=i)
        reach = axis.step * (axis.points - 1)
        axes[i] = Axis(axis.name, -reach, axis.step, 2 * axis.points - 1)
        mirrored.append(axis.name)
    return None if problems else FieldGrid(tuple(axes), np.ascontiguousarray(values), tuple(mirrored))


def _check_component(
    name: str, column: Column, shape: tuple[int, ...] | None, axes: tuple[str, ...], problems: list[Problem]
) -> None:
    if shape is not None and column.values.shape != shape:
        expected = f"shape {shape}: one value for each of {', '.join(axes)}"
        problems.append(Problem(name, f"shape {column.values.shape}", expected))
    if _check_finite(name, column, problems) and column.unit:
        largest = np.abs(column.values).max(initial=0.0)
        if largest > _STRONGEST:
            problems.append(Problem(name, f"up to {column.text(largest)}", f"at most {_STRONGEST:g} T"))


def _check_finite(name: str, column: Column, problems: list[Problem]) -> bool:
    bad = int(np.count_nonzero(~np.isfinite(column.values)))
    if bad:
        problems.append(Problem(name, f"{bad} values that are not finite", "a number at every point"))
    return not bad


def _check_beam_line(br: Column, bz: Column, problems: list[Problem]) -> None:
    finite = [column.values[np.isfinite(column.values)] for column in (br, bz)]
    on_axis = br.values[0][np.isfinite(br.values[0])]
    largest = np.abs(on_axis).max(initial=0.0)
    if largest > _ON_AXIS * max(np.abs(values).max(initial=0.0) for values in finite):
        problems.append(Problem("br", f"up to {br.text(largest)} at r = 0", "0 on the beam line"))


def _axis(name: str, column: Column, problems: list[Problem]) -> Axis | None:
    """Return an axis; it must be equidistant and hold the origin, and r must begin there."""
    values = column.values
    if values.ndim != 1 or not _FEWEST <= len(values) <= _MOST:
        problems.append(Problem(name, f"shape {values.shape}", f"one dimension of {_FEWEST} to {_MOST} points"))
        return None
    if not _check_finite(name, column, problems):
        return None
    first = 0.0 if name == "r" and _from_0(values) else float(values[0])
    step = (values[-1] - first) / (len(values) - 1)
    even = first + step * np.arange(len(values))
    if not (step > 0 and np.abs(values - even).max() < _UNEVEN * step):
        steps = np.diff(values)
        problems.append(Problem(name, f"steps from {column.text(steps.min(), steps.max())}", "equal steps upward"))
        return None
    if name == "phi":
        return _whole_turn(column, step, problems) if column.unit else None
    if name == "r" and not _from_0(values):
        problems.append(Problem(name, f"{column.text(values[0])} first", "r = 0 first"))
    elif not values[0] - _UNEVEN * step <= 0 <= values[-1] + _UNEVEN * step:
        given = column.text(values[0], values[-1])
        problems.append(Problem(name, given, "a range with 0 in it, where tracks begin"))
    return Axis(name, first, float(step), len(values))


def _whole_turn(column: Column, step: float, problems: list[Problem]) -> Axis | None:
    """Return the azimuths of a map without a last one that repeats the first; the first is in [-pi, pi)."""
    points = round(2 * np.pi / step)
    first = float(column.values[0])
    if abs(points * step - 2 * np.pi) > _UNEVEN * step or len(column.values) not in (points, points + 1):
        given = column.text(first, column.values[-1])
        problems.append(Problem("phi", given, "a whole turn, with or without the first azimuth at its end"))
        return None
    if points < _FEWEST:
        problems.append(Problem("phi", f"{points} azimuths", f"at least {_FEWEST}"))
        return None
    return Axis("phi", first - 2 * np.pi * math.floor((first + np.pi) / (2 * np.pi)), 2 * np.pi / points, points)


def _from_0(r: Floats) -> bool:
    return bool(abs(r[0]) <= _UNEVEN * abs(r[1] - r[0]))


_TOLERANCE = key("length", "error allowed to one step of a track through the field", 1e-9, 1.0)


EVERYWHERE = 1e6  # mm, farther than any detector


@dataclass(frozen=True, kw_only=True)
class Field(Part):
    """Uniform magnetic field along the beam.

    Examples
    --------
    >>> cg.load("besiii-cgem").field
    Field(kind='uniform', bz=-1.0)
    """

    kind: str = field(
        metadata=key("text", "shape of the field", choices=("uniform", "solenoid", "harmonic", "map")),
        default="uniform",
    )
    bz: float = field(metadata=key("field", "component along the beam at the origin, signed", -10.0, 10.0))  # T


@dataclass(frozen=True, kw_only=True)
class SolenoidField(Field):
    """Field of a thin, finite coil without iron around it (docs/methods/field.md).

    Examples
    --------
    >>> from cgemit.detector import field_at
    >>> field = {"kind": "solenoid", "bz": "-1 T", "coil_radius": "1.4 m", "half_length": "1.8 m"}
    >>> det = cg.load("besiii-cgem").with_field(field)
    >>> print(field_at(det, [[0.0, 0.0, 1000.0]])[0, 2].round(3))  # Bz at z = 1 m, T
    -0.881
    """

    kind: str = field(metadata=key("text", "shape of the field", choices=("solenoid",)), default="solenoid")
    coil_radius: float = field(metadata=key("length", "radius of the coil", 10.0, 10_000.0))  # mm
    half_length: float = field(metadata=key("length", "half length of the coil along the beam", 10.0, 20_000.0))  # mm
    z_offset: float = field(metadata=key("length", "z of the middle of the coil", -2000.0, 2000.0), default=0.0)  # mm
    tolerance: float = field(metadata=_TOLERANCE, default=1e-3)  # mm


@dataclass(frozen=True, kw_only=True)
class HarmonicField(Field):
    """Bz = bz [1 - b (z^2 - r^2/2) + q (z^4 - 3 z^2 r^2 + 3 r^4/8)]; Br follows from Maxwell's equations.

    Examples
    --------
    >>> from cgemit.detector import field_at
    >>> field = {"kind": "harmonic", "bz": "-1 T", "b": "0.1 /m2"}
    >>> det = cg.load("besiii-cgem").with_field(field)
    >>> print(field_at(det, [[0.0, 0.0, 1000.0]])[0, 2].round(3))  # Bz at z = 1 m, T
    -0.9
    """

    kind: str = field(metadata=key("text", "shape of the field", choices=("harmonic",)), default="harmonic")
    b: float = field(metadata=key("inverse area", "quadratic decrease along the beam", -1e-5, 1e-5))  # mm^-2
    q: float = field(metadata=key("inverse area squared", "fourth-order term", -1e-11, 1e-11), default=0.0)  # mm^-4
    r_max: float = field(
        metadata=key("length", "largest radius at which the field holds", 1.0, EVERYWHERE), default=EVERYWHERE
    )  # mm
    z_max: float = field(
        metadata=key("length", "largest |z| at which the field holds", 1.0, EVERYWHERE), default=EVERYWHERE
    )  # mm
    tolerance: float = field(metadata=_TOLERANCE, default=1e-3)  # mm


@dataclass(frozen=True, kw_only=True)
class MapField(Field):
    """Field on a grid read from a file; `bz`, if it is stated, scales the map to that value at the origin.

    Examples
    --------
    >>> from cgemit.detector import write_field_map
    >>> r, z = np.linspace(0, 900, 4), np.linspace(-500, 500, 5)  # mm
    >>> field = {"r": r, "z": z, "br": np.zeros((4, 5)), "bz": np.full((4, 5), -1.0)}  # T
    >>> path = write_field_map("measured.npz", field)
    >>> found = cg.load("besiii-cgem").with_field(path).field
    >>> found.kind, round(found.bz, 3)
    ('map', -1.0)
    """

    kind: str = field(metadata=key("text", "shape of the field", choices=("map",)), default="map")
    bz: float = field(
        metadata=key("field", "component along the beam at the origin (default: the map's)", -10.0, 10.0, derived=True)
    )  # T
    file: str = field(metadata=key("text", "the map, .npz or .csv, or cgemit:besiii.npz"), compare=False)
    checksum: str = field(metadata=key("text", "what the map's numbers must have (default: anything)", derived=True))
    mirror: tuple[str, ...] | None = field(
        metadata=key("mirrors", "axes that are completed by symmetry (default: those with one side of 0)", quiet=True),
        default=None,
        compare=False,
    )
    tolerance: float = field(metadata=_TOLERANCE, default=1e-3)  # mm
    grid: FieldGrid  # as in the file, not scaled


def field_range(detector_field: Field) -> tuple[float, float, float]:
    """Return the radius up to which a field holds at every azimuth, and its first and last z, mm; infinite without."""
    if isinstance(detector_field, HarmonicField):
        return detector_field.r_max, -detector_field.z_max, detector_field.z_max
    if isinstance(detector_field, MapField):
        *across, z = detector_field.grid.axes
        across = [axis for axis in across if axis.name != "phi"]
        radius = min(min(axis.last, -axis.first if axis.name != "r" else math.inf) for axis in across)
        return radius, z.first, z.last
    return math.inf, -math.inf, math.inf


KINDS: dict[str, type[Field]] = {
    "uniform": Field,
    "solenoid": SolenoidField,
    "harmonic": HarmonicField,
    "map": MapField,
}


def kind_key() -> Key:
    """Return what `kind` may be."""
    found: Key = Field.__dataclass_fields__["kind"].metadata["key"]
    return found


@lru_cache(maxsize=16)
def _accuracy(grid: FieldGrid, scale: float, radius: float, z: float) -> str:
    """Return how far a map may be off where the detector is."""
    part = grid.within(radius, z)
    return f"accurate to about {100 * part.inaccuracy:.1g} % of {scale * part.largest():.3g} T in the detector"


def field_text(detector_field: Field, radius: float, z: float) -> str:
    """Return one line about the field of a detector that reaches a radius and a distance along the beam, mm."""
    text = f"{detector_field.bz:g} T"
    if isinstance(detector_field, SolenoidField):
        coil = f"coil of radius {detector_field.coil_radius:g} mm, half length {detector_field.half_length:g} mm"
        return f"{text} at the origin, {coil}"
    if isinstance(detector_field, HarmonicField):
        shape = f"b = {1e6 * detector_field.b:g} /m2, q = {1e12 * detector_field.q:g} /m4"
        reach = f" for r < {detector_field.r_max:g} mm, |z| < {detector_field.z_max:g} mm"
        limited = min(detector_field.r_max, detector_field.z_max) < EVERYWHERE
        return f"{text} at the origin, harmonic with {shape}" + (reach if limited else "")
    if isinstance(detector_field, MapField):
        grid = detector_field.grid
        own = grid.bz_at_origin()
        accuracy = _accuracy(grid, abs(detector_field.bz / own) if own else 1.0, radius, z)
        return f"{text} at the origin, map {detector_field.file}, {grid.range_text()}, {accuracy}"
    return text
