"""Field maps in files: .npz with arrays, .csv with one row a point. Every problem of a file is listed at once."""

import csv
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgemit.detector.field.grid import Column, Columns, FieldGrid, checked_grid, names_in
from cgemit.io.files import check_regular, new_file, read_npz
from cgemit.problems import DetectorError, Problem
from cgemit.units import NATIVE, QuantityError, parse_quantity, units_of

Floats = NDArray[np.float64]

_HEADER = re.compile(r"\s*(\w+)\s*\[(.*)\]\s*")
_LARGEST_CSV = 500_000_000  # bytes
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
    grid = checked_grid(columns, problems) if columns is not None else None
    if grid is None or problems:
        raise DetectorError(str(path), problems)
    return grid


def write_field_map(path: str | Path, columns: Mapping[str, Any], *, overwrite: bool = False) -> Path:
    """Write a map file that detector files may name.

    Parameters
    ----------
    path : str or Path
        ``.npz`` or ``.csv``.
    columns : mapping of str to array_like
        Axes r, z or x, y, z (one-dimensional, equidistant, mm), and components br, bz or bx, by, bz on the grid, the
        axes in that order (T).
    overwrite : bool
        Whether a file of this name may be replaced.

    Returns
    -------
    Path

    Raises
    ------
    DetectorError
        With every problem of the columns; nothing is written then.
    FileExistsError
        If `path` exists and `overwrite` is false.

    """
    path = Path(path)
    problems: list[Problem] = []
    if path.suffix not in (".npz", ".csv"):
        _no_map(path, problems)
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in columns.items()}
    axes, _ = names_in(arrays)
    checked_grid({name: Column(array, "mm" if name in axes else "T") for name, array in arrays.items()}, problems)
    if problems:
        raise DetectorError(str(path), problems)
    with new_file(path, overwrite=overwrite) as temporary:
        if path.suffix == ".npz":
            units = {_LENGTH: np.array("mm"), _FIELD: np.array("T")}
            np.savez_compressed(temporary, **arrays, **units)  # type: ignore[arg-type]
        else:
            _write_csv(temporary, arrays)
    return path


def _write_csv(path: Path, arrays: Mapping[str, Floats]) -> None:
    axes, components = names_in(arrays)
    points = np.meshgrid(*(arrays[name] for name in axes), indexing="ij")
    rows = np.stack([*points, *(arrays[name] for name in components)], axis=-1).reshape(-1, len(axes) + len(components))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([f"{name}[mm]" for name in axes] + [f"{name}[T]" for name in components])
        writer.writerows([[repr(float(number)) for number in row] for row in rows])


def _no_map(path: Path, problems: list[Problem]) -> Columns | None:
    problems.append(Problem("", f'"{path.name}"', "a map file, .npz or .csv"))
    return None


def _scaled(values: Floats, unit: object, dimension: str) -> Column:
    """Return values in mm or T; as they are if the unit is unknown, which `_check_unit` notes."""
    try:
        return Column(values * parse_quantity(f"1 {unit}", dimension), NATIVE[dimension])
    except QuantityError:
        return Column(values * 1.0, "")


def _check_unit(unit: object, dimension: str, path: str, problems: list[Problem]) -> None:
    try:
        parse_quantity(f"1 {unit}", dimension)
    except QuantityError:
        expected = "one of " + ", ".join(unit for unit in units_of(dimension) if unit.isascii())
        problems.append(Problem(path, f'unit "{unit}"', expected))


def _read_npz(path: Path, problems: list[Problem]) -> Columns | None:
    """Return the arrays of a file in mm and T."""
    try:
        found = read_npz(path)
    except (OSError, ValueError) as error:
        problems.append(Problem("", str(error), "a .npz file of arrays"))
        return None
    axes, components = names_in(found)
    columns: Columns = {}
    for unit, dimension, names in ((_LENGTH, "length", axes), (_FIELD, "field", components)):
        if unit in found:
            _check_unit(found[unit], dimension, unit, problems)
        else:
            problems.append(Problem(unit, "nothing", f"the unit of {', '.join(names)}, as text"))
        for name in filter(found.__contains__, names):
            if np.issubdtype(found[name].dtype, np.number) and not np.iscomplexobj(found[name]):
                columns[name] = _scaled(found[name], found.get(unit, ""), dimension)
            else:
                columns[name] = None
                problems.append(Problem(name, f"an array of {found[name].dtype}", "numbers"))
    return columns


def _read_csv(path: Path, problems: list[Problem]) -> Columns | None:
    """Return the columns of a file as axes and arrays on the grid, in mm and T."""
    try:
        check_regular(path)
        if path.stat().st_size > _LARGEST_CSV:
            raise ValueError(f"{path.stat().st_size} bytes, expected at most {_LARGEST_CSV}")
        lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line and line[0] != "#"]
    except (OSError, ValueError) as error:
        problems.append(Problem("", str(error), "a text file"))
        return None
    header, *rows = list(csv.reader(lines)) or [[]]
    matches = [_HEADER.fullmatch(name) for name in header]
    given = {match[1]: match[2] for match in matches if match}
    axes, components = names_in(given)
    dimensions = dict.fromkeys(axes, "length") | dict.fromkeys(components, "field")
    missing = [name for name in dimensions if name not in given]
    if missing:
        text = f"columns {', '.join(header) or 'none'}"
        wanted = ", ".join(f"{name}[{NATIVE[kind]}]" for name, kind in dimensions.items())
        problems.append(Problem("header", text, f"{wanted}; no column {', '.join(missing)}"))
    usable = [name for name in dimensions if name in given]
    for name in usable:
        _check_unit(given[name], dimensions[name], f"header {name}", problems)
    columns: Columns = dict.fromkeys(dimensions)
    table = _numbers(rows, len(header), problems, any_width=bool(missing))
    if table is None:
        return columns
    places = {match[1]: place for place, match in enumerate(matches) if match}
    for name in usable:
        columns[name] = _scaled(table[:, places[name]], given[name], dimensions[name])
    return _on_grid(columns, axes, components, problems)


def _numbers(rows: list[list[str]], width: int, problems: list[Problem], *, any_width: bool) -> Floats | None:
    """Return the rows below the header; None if they cannot be read, which may be the header's fault (`any_width`)."""
    try:
        return np.array(rows, dtype=np.float64).reshape(len(rows), width)
    except ValueError:
        wrong = [not all(map(_is_number, row)) or (len(row) != width and not any_width) for row in rows]
        bad = [i for i, one in enumerate(wrong, start=1) if one]
        shown = ", ".join(map(str, bad[:5])) + (f" and {len(bad) - 5} more" if len(bad) > 5 else "")
        if bad:
            expected = "numbers" if any_width else f"{width} numbers in every row"
            problems.append(Problem("rows", f"row {shown} below the header", expected))
        return None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _on_grid(columns: Columns, axes: tuple[str, ...], components: tuple[str, ...], problems: list[Problem]) -> Columns:
    """Sort the rows of a table onto the grid that its axes span."""
    found = {name: columns[name] for name in axes}
    flat: Columns = {name: columns[name] for name in components}
    given = {name: column for name, column in found.items() if column}
    if len(given) < len(axes):
        return dict.fromkeys(axes) | flat
    spans = [np.unique(column.values) for column in given.values()]
    shape = tuple(map(len, spans))
    indices = (np.searchsorted(span, c.values) for span, c in zip(spans, given.values(), strict=True))
    rows = len(next(iter(given.values())).values)
    whole = rows == math.prod(shape)  # in whole numbers: the product may be too large for an array
    places = np.ravel_multi_index(tuple(indices), shape) if whole and rows else np.empty(0, dtype=np.intp)
    if not whole or len(np.unique(places)) != rows:
        size = " x ".join(map(str, shape))
        expected = f"each point of the {size} grid of {', '.join(axes)} once"
        problems.append(Problem("rows", f"{rows} rows", expected))
        return dict.fromkeys(axes) | flat
    order = np.argsort(places)
    sorted_axes = {name: Column(span, given[name].unit) for name, span in zip(axes, spans, strict=True)}
    return sorted_axes | {
        name: column and Column(column.values[order].reshape(shape), column.unit) for name, column in flat.items()
    }
