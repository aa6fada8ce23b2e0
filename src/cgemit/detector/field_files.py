"""Field maps in files: .npz with arrays, .csv with one row a point. Every problem of a file is listed at once."""

import csv
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgemit.detector.field_grid import BOX, CYLINDER, Axis, FieldGrid
from cgemit.detector.problems import DetectorError, Problem
from cgemit.units import QuantityError, parse_quantity, units_of

Floats = NDArray[np.float64]

_FEWEST = 4  # points along an axis; a cubic needs as many
_UNEVEN = 1e-6  # of a step
_ON_AXIS = 1e-3  # of the largest field: Br on the beam line may be no more than that
_HEADER = re.compile(r"\s*(\w+)\s*\[(.*)\]\s*")
_LENGTH, _FIELD = "length_unit", "field_unit"


def read_field_map(path: str | Path) -> FieldGrid:
    """Return the grid that a map file holds (docs/methods/field.md).

    Parameters
    ----------
    path : str or Path
        ``.npz`` or ``.csv``.

    Raises
    ------
    DetectorError
        With every problem of the file.

    """
    path = Path(path)
    problems: list[Problem] = []
    columns = {".npz": _read_npz, ".csv": _read_csv}.get(path.suffix, _no_map)(path, problems)
    grid = _grid(columns, problems) if not problems else None
    if grid is None or problems:
        raise DetectorError(str(path), problems)
    return grid


def write_field_map(path: str | Path, columns: Mapping[str, Any]) -> Path:
    """Write a map file that detector files may name.

    Parameters
    ----------
    path : str or Path
        ``.npz`` or ``.csv``.
    columns : mapping of str to array_like
        Axes r, z or x, y, z (one-dimensional, equidistant, mm), and components br, bz or bx, by, bz on the grid, the
        axes in that order (T).

    Returns
    -------
    Path

    Raises
    ------
    DetectorError
        With every problem of the columns; nothing is written then.

    """
    path = Path(path)
    problems: list[Problem] = []
    if path.suffix not in (".npz", ".csv"):
        _no_map(path, problems)
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in columns.items()}
    grid = _grid(arrays, problems)
    if problems or grid is None:
        raise DetectorError(str(path), problems)
    if path.suffix == ".npz":
        np.savez_compressed(path, **arrays, **{_LENGTH: np.array("mm"), _FIELD: np.array("T")})  # type: ignore[arg-type]
        return path
    axes, components = _names(arrays)
    points = np.meshgrid(*(arrays[name] for name in axes), indexing="ij")
    rows = np.stack([*points, *(arrays[name] for name in components)], axis=-1).reshape(-1, len(axes) + len(components))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([f"{name}[mm]" for name in axes] + [f"{name}[T]" for name in components])
        writer.writerows([[repr(float(number)) for number in row] for row in rows])
    return path


def _no_map(path: Path, problems: list[Problem]) -> dict[str, Floats]:
    problems.append(Problem("", f'"{path.name}"', "a map file, .npz or .csv"))
    return {}


def _names(columns: Mapping[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    return BOX if columns.keys() & {"x", "y", "bx", "by"} else CYLINDER


def _scale(text: object, dimension: str, path: str, problems: list[Problem]) -> float:
    try:
        return parse_quantity(f"1 {text}", dimension)
    except QuantityError:
        expected = "one of " + ", ".join(unit for unit in units_of(dimension) if unit.isascii())
        problems.append(Problem(path, f'unit "{text}"', expected))
        return 1.0


def _read_npz(path: Path, problems: list[Problem]) -> dict[str, Floats]:
    """Return the arrays of a file in mm and T."""
    try:
        with np.load(path) as file:
            found = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        problems.append(Problem("", str(error), "a .npz file of arrays"))
        return {}
    axes, components = _names(found)
    columns = {}
    for unit, dimension, names in ((_LENGTH, "length", axes), (_FIELD, "field", components)):
        if unit not in found:
            problems.append(Problem(unit, "nothing", f"the unit of {', '.join(names)}, as text"))
        scale = _scale(found[unit], dimension, unit, problems) if unit in found else 1.0
        for name in names:
            if name not in found:
                problems.append(Problem(name, "nothing", f"an array {name}; a map has {_wanted(axes, components)}"))
            elif not np.issubdtype(found[name].dtype, np.number) or np.iscomplexobj(found[name]):
                problems.append(Problem(name, f"an array of {found[name].dtype}", "numbers"))
            else:
                columns[name] = found[name] * scale
    return columns


def _wanted(axes: tuple[str, ...], components: tuple[str, ...]) -> str:
    return ", ".join((*axes, *components))


def _read_csv(path: Path, problems: list[Problem]) -> dict[str, Floats]:
    """Return the columns of a file as axes and arrays on the grid, in mm and T."""
    try:
        lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line and line[0] != "#"]
    except (OSError, UnicodeDecodeError) as error:
        problems.append(Problem("", str(error), "a text file"))
        return {}
    header, *rows = list(csv.reader(lines)) or [[]]
    matches = [_HEADER.fullmatch(name) for name in header]
    given = {match[1]: match[2] for match in matches if match}
    axes, components = _names(given)
    dimensions = dict.fromkeys(axes, "length") | dict.fromkeys(components, "field")
    missing = [name for name in dimensions if name not in given]
    if missing:
        text = f"columns {', '.join(header) or 'none'}"
        wanted = ", ".join(f"{name}[{'mm' if kind == 'length' else 'T'}]" for name, kind in dimensions.items())
        problems.append(Problem("header", text, f"{wanted}; no column {', '.join(missing)}"))
    scales = {
        name: _scale(given[name], dimensions[name], f"header {name}", problems) for name in given if name in dimensions
    }
    table = _numbers(rows, len(header), problems)
    if problems:
        return {}
    places = [match[1] if match else "" for match in matches]
    columns = {name: table[:, places.index(name)] * scales[name] for name in dimensions}
    return _on_grid(columns, axes, components, problems)


def _numbers(rows: list[list[str]], width: int, problems: list[Problem]) -> Floats:
    try:
        return np.array(rows, dtype=np.float64).reshape(len(rows), width)
    except ValueError:
        bad = [i for i, row in enumerate(rows, start=1) if len(row) != width or not all(map(_is_number, row))]
        shown = ", ".join(map(str, bad[:5])) + (f" and {len(bad) - 5} more" if len(bad) > 5 else "")
        problems.append(Problem("rows", f"row {shown} below the header", f"{width} numbers in every row"))
        return np.empty((0, width))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _on_grid(
    columns: dict[str, Floats], axes: tuple[str, ...], components: tuple[str, ...], problems: list[Problem]
) -> dict[str, Floats]:
    """Sort the rows of a table onto the grid that its axes span."""
    spans = [np.unique(columns[name]) for name in axes]
    shape = tuple(map(len, spans))
    places = np.ravel_multi_index(
        tuple(np.searchsorted(span, columns[name]) for span, name in zip(spans, axes, strict=True)), shape
    )
    if len(places) != np.prod(shape) or len(np.unique(places)) != len(places):
        size = " x ".join(map(str, shape))
        problems.append(
            Problem("rows", f"{len(places)} rows", f"each point of the {size} grid of {', '.join(axes)} once")
        )
        return {}
    order = np.argsort(places)
    found = dict(zip(axes, spans, strict=True))
    return found | {name: columns[name][order].reshape(shape) for name in components}


def _grid(columns: Mapping[str, Floats], problems: list[Problem]) -> FieldGrid | None:
    """Return the grid of columns in mm and T after checking it."""
    axes, components = _names(columns)
    missing = [name for name in (*axes, *components) if name not in columns]
    if missing:
        problems.append(Problem("", f"no {', '.join(missing)}", _wanted(axes, components)))
        return None
    found = [_axis(name, columns[name], problems) for name in axes]
    shape = tuple(axis.points for axis in found if axis)
    for name in components:
        if len(shape) == len(axes) and columns[name].shape != shape:
            expected = f"shape {shape}: one value for each of {', '.join(axes)}"
            problems.append(Problem(name, f"shape {columns[name].shape}", expected))
        bad = int(np.count_nonzero(~np.isfinite(columns[name])))
        if bad:
            problems.append(Problem(name, f"{bad} values that are not finite", "a number at every point"))
    if problems:
        return None
    grid = FieldGrid(tuple(axis for axis in found if axis), np.stack([columns[name] for name in components], axis=-1))
    if axes == CYLINDER[0] and np.abs(grid.values[0, :, 0]).max() > _ON_AXIS * np.abs(grid.values).max():
        largest = np.abs(grid.values[0, :, 0]).max()
        problems.append(Problem("br", f"up to {largest:g} T at r = 0", "0 on the beam line"))
    return None if problems else grid


def _axis(name: str, values: Floats, problems: list[Problem]) -> Axis | None:
    """Return an axis; it must be equidistant and hold the origin, and r must begin there."""
    if values.ndim != 1 or len(values) < _FEWEST:
        problems.append(Problem(name, f"shape {values.shape}", f"one dimension of at least {_FEWEST} points"))
        return None
    step = (values[-1] - values[0]) / (len(values) - 1)
    even = values[0] + step * np.arange(len(values))
    if not (np.all(np.isfinite(values)) and step > 0 and np.abs(values - even).max() < _UNEVEN * step):
        steps = np.diff(values)
        problems.append(Problem(name, f"steps from {steps.min():g} to {steps.max():g} mm", "equal steps upward"))
        return None
    if name == "r" and abs(values[0]) > _UNEVEN * step:
        problems.append(Problem(name, f"{values[0]:g} mm first", "r = 0 first"))
    elif not values[0] - _UNEVEN * step <= 0 <= values[-1]:
        problems.append(
            Problem(name, f"{values[0]:g} to {values[-1]:g} mm", "a range with 0 in it, where tracks begin")
        )
    return Axis(name, 0.0 if name == "r" else float(values[0]), float(step), len(values))
