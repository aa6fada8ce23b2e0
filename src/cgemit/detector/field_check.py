"""Is it a field map? From columns to a grid, with every problem noted."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit.detector.field_grid import BOX, CYLINDER, Axis, FieldGrid
from cgemit.problems import Problem

Floats = NDArray[np.float64]

_FEWEST = 4  # points along an axis; a cubic needs as many
_UNEVEN = 1e-6  # of a step
_ON_AXIS = 1e-3  # of the largest field: Br on the beam line may be no more than that


class Column(NamedTuple):
    """What a map says of an axis or a component, in mm or T; without a unit if the file's own is unknown."""

    values: Floats
    unit: str

    def text(self, *numbers: float) -> str:
        """Return numbers of this column as text."""
        return f"{' to '.join(f'{number:g}' for number in numbers)} {self.unit}".rstrip()


#: By name; None for a column whose problem has been noted.
Columns = dict[str, Column | None]


def names_in(columns: Mapping[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of axes and components of the map that these columns are of."""
    return BOX if columns.keys() & {"x", "y", "bx", "by"} else CYLINDER


def checked_grid(columns: Columns, problems: list[Problem]) -> FieldGrid | None:
    """Return the grid of columns in mm and T after checking all that can be checked."""
    axes, components = names_in(columns)
    for name in (*axes, *components):
        if name not in columns:
            wanted = ", ".join((*axes, *components))
            problems.append(Problem(name, "nothing", f"an array {name}; a map has {wanted}"))
    found = [_axis(name, column, problems) for name in axes if (column := columns.get(name))]
    given = [column.values for name in axes if (column := columns.get(name))]
    known = len(given) == len(axes) and all(values.ndim == 1 and len(values) >= _FEWEST for values in given)
    shape = tuple(map(len, given)) if known else None  # uneven axes have a length, too
    for name in components:
        if column := columns.get(name):
            _check_component(name, column, shape, axes, problems)
    r, br, bz = (columns.get(name) for name in ("r", "br", "bz"))
    if axes == CYLINDER[0] and r and br and bz and br.values.shape == bz.values.shape == shape and _from_0(r.values):
        _check_beam_line(br, bz, problems)
    usable = [column.values for name in components if (column := columns.get(name))]
    return None if problems else FieldGrid(tuple(axis for axis in found if axis), np.stack(usable, axis=-1))


def _check_component(
    name: str, column: Column, shape: tuple[int, ...] | None, axes: tuple[str, ...], problems: list[Problem]
) -> None:
    if shape is not None and column.values.shape != shape:
        expected = f"shape {shape}: one value for each of {', '.join(axes)}"
        problems.append(Problem(name, f"shape {column.values.shape}", expected))
    _check_finite(name, column, problems)


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
    if values.ndim != 1 or len(values) < _FEWEST:
        problems.append(Problem(name, f"shape {values.shape}", f"one dimension of at least {_FEWEST} points"))
        return None
    if not _check_finite(name, column, problems):
        return None
    step = (values[-1] - values[0]) / (len(values) - 1)
    even = values[0] + step * np.arange(len(values))
    if not (step > 0 and np.abs(values - even).max() < _UNEVEN * step):
        steps = np.diff(values)
        problems.append(Problem(name, f"steps from {column.text(steps.min(), steps.max())}", "equal steps upward"))
        return None
    if name == "r" and not _from_0(values):
        problems.append(Problem(name, f"{column.text(values[0])} first", "r = 0 first"))
    elif not values[0] - _UNEVEN * step <= 0 <= values[-1]:
        given = column.text(values[0], values[-1])
        problems.append(Problem(name, given, "a range with 0 in it, where tracks begin"))
    return Axis(name, 0.0 if name == "r" else float(values[0]), float(step), len(values))


def _from_0(r: Floats) -> bool:
    return bool(abs(r[0]) <= _UNEVEN * abs(r[1] - r[0]))
