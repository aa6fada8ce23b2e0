"""Magnetic fields of a detector file, one class a kind. Field in T, lengths in mm; `bz` is the field at the origin."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
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

_FEWEST, _MOST = 4, 5000  # points along an axis; a cubic needs four, and memory grows with the square
_MOST_POINTS = 20_000_000  # of a grid
_STRONGEST = 10.0  # T
_UNEVEN = 1e-3  # of a step: the digits of text and of single precision
_ON_AXIS = 1e-3  # of the largest field: Br on the beam line may be no more than that


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

    @property
    def values(self) -> Floats:
        """All points, mm; `step` follows from the ends to the last bit, so that a written map keeps its checksum."""
        values: Floats = self.first + self.step * np.arange(self.points, dtype=np.float64)
        while (step := (values[-1] - values[0]) / (self.points - 1)) != self.step:
            values[-1] = np.nextafter(values[-1], math.copysign(math.inf, self.step - step))
        return values


@dataclass(frozen=True, eq=False)
class FieldGrid:
    """Values of a field at the points of a grid; equal grids hold the same numbers.

    Attributes
    ----------
    axes : tuple of Axis
        r, z or x, y, z.
    values : ndarray, (points of each axis, components) float64, T
        Br, Bz or Bx, By, Bz.
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
        """Axes (mm) and components (T) by name, as `write_field_map` takes them."""
        axes, components = (CYLINDER, BOX)[len(self.axes) - 2]
        values = {name: self.values[..., i] for i, name in enumerate(components)}
        return {**{name: axis.values for name, axis in zip(axes, self.axes, strict=True)}, **values}

    def range_text(self) -> str:
        """Return where the map is valid."""
        ranges = ", ".join(f"{axis.name} = {axis.first:g} to {axis.last:g} mm" for axis in self.axes)
        return ranges + (f", mirrored in {', '.join(self.mirrored)}" if self.mirrored else "")

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

    @cached_property
    def inaccuracy(self) -> float:
        """How far the field between the points may be off, relative to the largest field.

        The larger of two numbers: the error of the interpolation, which is 1/16 of the error at every second point of
        an axis without these points (of cubic splines it falls with the fourth power of the step), and the divergence
        of the splines at the points times half the largest step.
        """
        from scipy.interpolate import CubicSpline

        splines = [CubicSpline(axis.values, self.values, axis=i) for i, axis in enumerate(self.axes)]
        off = 0.0
        for i, axis in enumerate(self.axes):
            if axis.points >= 2 * _FEWEST:
                kept = np.take(self.values, range(0, axis.points, 2), axis=i)
                between = CubicSpline(axis.values[::2], kept, axis=i)(axis.values[1 : axis.points - 1 : 2])
                given = np.take(self.values, range(1, axis.points - 1, 2), axis=i)
                off = max(off, float(np.abs(between - given).max(initial=0.0)) / 16)
        slopes = [
            spline(axis.values, 1)[..., i] for i, (spline, axis) in enumerate(zip(splines, self.axes, strict=True))
        ]
        divergence = sum(slopes[1:], slopes[0])
        if self.axes[0].name == "r":  # at r = 0 the limit of Br/r is its slope
            r = self.axes[0].values[:, None]
            divergence = divergence + np.where(r > 0, self.values[..., 0] / np.where(r > 0, r, 1.0), slopes[0])
        step = max(axis.step for axis in self.axes)
        return max(off, float(np.abs(divergence).max()) * 0.5 * step) / max(self.largest(), 1e-300)

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
Columns = dict[str, Column | None]


def names_in(columns: Mapping[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the axes and components of the map that these columns belong to."""
    return BOX if columns.keys() & {"x", "y", "bx", "by"} else CYLINDER


def checked_grid(columns: Columns, problems: list[Problem]) -> FieldGrid | None:
    """Return the grid of columns in mm and T after checking all that can be checked."""
    axes, components = names_in(columns)
    unread = [name for name in columns if name not in (*axes, *components)]
    if unread:
        wanted = f"only {', '.join((*axes, *components))} of a map in {', '.join(axes)}"
        wanted += ", or values in x, y, z that are interpolated from those in r, phi, z" if "phi" in unread else ""
        problems.append(Problem(", ".join(unread), "an array that is not read", wanted))
    for name in (*axes, *components):
        if name not in columns:
            wanted = ", ".join((*axes, *components))
            problems.append(Problem(name, "nothing", f"an array {name}; a map has {wanted}"))
    found = [_axis(name, column, problems) for name in axes if (column := columns.get(name))]
    given = [column.values for name in axes if (column := columns.get(name))]
    known = len(given) == len(axes) and all(values.ndim == 1 and len(values) >= _FEWEST for values in given)
    shape = tuple(map(len, given)) if known else None  # uneven axes have a length, too
    if shape is not None and math.prod(shape) > _MOST_POINTS:
        problems.append(Problem("", f"a grid of {math.prod(shape)} points", f"at most {_MOST_POINTS}"))
    for name in components:
        if column := columns.get(name):
            _check_component(name, column, shape, axes, problems)
    r, br, bz = (columns.get(name) for name in ("r", "br", "bz"))
    if axes == CYLINDER[0] and r and br and bz and br.values.shape == bz.values.shape == shape and _from_0(r.values):
        _check_beam_line(br, bz, problems)
    usable = [column.values for name in components if (column := columns.get(name))]
    if problems:
        return None
    return _completed(FieldGrid(tuple(axis for axis in found if axis), np.stack(usable, axis=-1)), components, problems)


def _completed(grid: FieldGrid, components: tuple[str, ...], problems: list[Problem]) -> FieldGrid | None:
    """Return a grid whose axes are on both sides of 0: half a map is completed by its mirror image.

    The symmetry is that of a solenoid: for z, Bz is even and the other components are odd; for x and y, the component
    along the axis is odd and the others are even. Odd components vanish at 0.
    """
    axes, values, mirrored = list(grid.axes), grid.values, []
    largest = grid.largest()
    for number, axis in enumerate(axes):
        near = _UNEVEN * axis.step
        if axis.name == "r" or min(-axis.first, axis.last) > near:
            continue
        odd = np.array([(name == f"b{axis.name}") != (axis.name == "z") for name in components])
        from_0 = abs(axis.first) <= near
        middle = np.abs(np.take(grid.values, 0 if from_0 else -1, axis=number)).reshape(-1, len(components))
        for name, value in zip(components, middle.max(axis=0), strict=True):
            if odd[components.index(name)] and value > _ON_AXIS * largest:
                expected = f"0 there, or a map on both sides of {axis.name} = 0: half of it is completed by symmetry"
                problems.append(Problem(name, f"up to {value:g} T at {axis.name} = 0", expected))
        other = np.flip(values, axis=number) * np.where(odd, -1.0, 1.0)
        halves = (np.delete(other, -1, axis=number), values) if from_0 else (values, np.delete(other, 0, axis=number))
        if math.prod(values.shape[:-1]) * 2 > _MOST_POINTS:
            given = f"a grid of more than {_MOST_POINTS} points with its mirror images"
            problems.append(Problem("", given, f"at most {_MOST_POINTS}"))
            return None
        values = np.concatenate(halves, axis=number)
        reach = axis.step * (axis.points - 1)
        axes[number] = Axis(axis.name, -reach, axis.step, 2 * axis.points - 1)
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
    if name == "r" and not _from_0(values):
        problems.append(Problem(name, f"{column.text(values[0])} first", "r = 0 first"))
    elif not values[0] - _UNEVEN * step <= 0 <= values[-1] + _UNEVEN * step:
        given = column.text(values[0], values[-1])
        problems.append(Problem(name, given, "a range with 0 in it, where tracks begin"))
    return Axis(name, first, float(step), len(values))


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
    tolerance: float = field(metadata=_TOLERANCE, default=1e-3)  # mm
    grid: FieldGrid  # as in the file, not scaled


def field_range(detector_field: Field) -> tuple[float, float, float]:
    """Return the radius up to which a field holds at every azimuth, and its first and last z, mm; infinite without end.

    Parameters
    ----------
    detector_field : Field
    """
    if isinstance(detector_field, HarmonicField):
        return detector_field.r_max, -detector_field.z_max, detector_field.z_max
    if isinstance(detector_field, MapField):
        *across, z = detector_field.grid.axes
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


def field_text(detector_field: Field) -> str:
    """Return one line about a field."""
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
        accuracy = f"accurate to about {100 * grid.inaccuracy:.1g} % of {abs(detector_field.bz):g} T"
        return f"{text} at the origin, map {detector_field.file}, {grid.range_text()}, {accuracy}"
    return text
