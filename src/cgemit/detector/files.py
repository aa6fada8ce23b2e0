"""Detector and field files: paths, tables, and chains of bases."""

from __future__ import annotations

import csv
import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.errors import DetectorError, Problem, did_you_mean
from cgemit.base.files import is_number, new_file, parse_toml, read_npz, read_text
from cgemit.detector.field import Column, FieldGrid, MapColumns, checked_grid, names_in
from cgemit.detector.reader import merged
from cgemit.units import NATIVE, QuantityError, parse_quantity, units_of

_DETECTORS = resources.files("cgemit.detector") / "presets"
_FIELDS = resources.files("cgemit.detector") / "fields"

#: Begins the name of a field map that comes with the program, such as ``cgemit:besiii.npz``.
OWN_MAP = "cgemit:"


class Source(NamedTuple):
    """The content of a file: a name for messages, the folder that relative bases refer to, and the tables."""

    name: str
    folder: Path | None
    tables: dict[str, Any]


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets; files that begin with an underscore are parts of presets."""
    names = (entry.name for entry in _DETECTORS.iterdir() if entry.name.endswith(".toml"))
    return tuple(sorted(name.removesuffix(".toml") for name in names if not name.startswith("_")))


def detectors() -> dict[str, str]:
    """Return the presets: name and description.

    Examples
    --------
    >>> cg.detectors()["besiii-cgem-design"]
    'the CGEM inner tracker of arXiv:1504.02570 (design) and the BESIII outer drift chamber'
    """
    return {name: _preset_tables(name)["description"] for name in preset_names()}


@cache
def _preset_tables(name: str) -> dict[str, Any]:
    return tomllib.loads((_DETECTORS / f"{name}.toml").read_text(encoding="utf-8"))


def library_materials() -> dict[str, Any]:
    """Return the tables of the materials that come with the program."""
    tables: dict[str, Any] = _preset_tables("_materials")["materials"]
    return tables


#: Ending of the name of a Delphes card.
CARD = ".tcl"
#: How a text begins that is the rows of such a card alone.
ROWS = re.compile(r"\s*[12][ \t]+[A-Za-z_]\w*[ \t]+[-+.\d]")


def is_card(path: Path) -> bool:
    """Return whether a file is a Delphes card, or a text (``.txt``) with its rows alone."""
    return is_file(path) and (path.suffix == CARD or (path.suffix == ".txt" and bool(ROWS.match(read_text(path)))))


_ReadCard = Callable[[Path], dict[str, Any]]


def open_source(
    source: str | Path | Mapping[str, Any], folder: Path | None = None, read_card: _ReadCard | None = None
) -> Source:
    """Return the content of a preset, a file or a mapping; of a Delphes card as `read_card` returns it.

    Raises
    ------
    DetectorError
        If there is no such preset or file, or the file is not TOML.

    """
    if isinstance(source, Mapping):
        return Source(str(source.get("name", "detector")), folder, place_map(dict(source), folder))
    text = str(source)
    if is_preset(text):
        return Source(text, None, _preset_tables(text))
    path = Path(text) if folder is None else folder / text
    if not is_file(path):
        known = ", ".join(preset_names())
        problem = Problem(
            "", _no_file(path, text), f"one of {known}, or a detector file",
            did_you_mean(text[:_LONGEST], preset_names()),
        )  # fmt: skip
        raise DetectorError(text[:_LONGEST], [problem])
    if read_card is not None and is_card(path):
        return Source(str(path), path.parent, read_card(path))
    try:
        tables = parse_toml(read_text(path))
    except ValueError as error:
        raise DetectorError(str(path), [Problem("", f"not a TOML file: {error}", "")]) from error
    return Source(str(path), path.parent, place_map(tables, path.parent))


_LONGEST = 300  # characters of a path in a message
#: Endings of field maps.
MAPS = (".npz", ".csv")


def _quoted(text: str) -> str:
    return f'"{text}"' if len(text) <= _LONGEST else f'"{text[:_LONGEST]}..."'


def _no_file(path: Path, text: str) -> str:
    """Return the text that is no file, and why."""
    if text and is_file(path, Path.is_dir):
        return f"{_quoted(text)}, a folder"
    missing = path.suffix in (".toml", *MAPS) or path.parent.name
    return _quoted(text) + (", which does not exist" if missing else "")


def is_preset(name: str) -> bool:
    """Return whether a preset, or a part of presets, has this name."""
    return _is_preset(_DETECTORS, name)


def is_field(name: str) -> bool:
    """Return whether a preset field has this name."""
    return _is_preset(_FIELDS, name)


def _is_preset(folder: Traversable, name: str) -> bool:
    return bool(re.fullmatch(r"[\w-]{1,100}", name, re.ASCII)) and (folder / f"{name}.toml").is_file()


def is_file(path: Path, test: Callable[[Path], bool] = Path.is_file) -> bool:
    """Return whether there is such a file; a path that no file can have has none."""
    try:
        return test(path)
    except (OSError, ValueError):  # too long a name, a null byte
        return False


def resolve(source: Source, problems: list[Problem], read_card: _ReadCard | None = None) -> dict[str, Any]:
    """Return the tables of a file laid over those of its bases; problems of the chain are noted."""
    chain = [source]
    while (base := chain[-1].tables.get("base")) is not None:
        below = _base_of(chain, base, problems, read_card)
        if below is None:
            break
        chain.append(below)
    tables: dict[str, Any] = {}
    for link in reversed(chain):
        chamber = link.tables.get("drift_chamber")
        if isinstance(chamber, Mapping) and {"layers", "superlayers"} <= chamber.keys():
            problems.append(Problem("drift_chamber", "both layers and superlayers", "one of them"))
        tables = merged(tables, link.tables, problems)
    return tables


def _base_of(chain: list[Source], base: object, problems: list[Problem], read_card: _ReadCard | None) -> Source | None:
    if not isinstance(base, str):
        problems.append(Problem("base", repr(base)[:80], "the name of a preset or of a detector file"))
        return None
    try:
        source = open_source(base, chain[-1].folder, read_card)
    except DetectorError as error:
        for problem in error.problems:
            given = f"{problem.path}: {problem.given}" if problem.path else problem.given
            problems.append(problem._replace(path="base", given=given))
        return None
    if any(_place(source) == _place(link) for link in chain) or len(chain) > _MOST_BASES:
        problems.append(Problem("base", _quoted(base), "a base that does not lead back to the file itself"))
        return None
    return source


_MOST_BASES = 50


def _place(source: Source) -> object:
    """Return what is equal for equal files, however their paths are written; tables are equal to nothing else."""
    if _is_preset(_DETECTORS, source.name) and source.folder is None and source.tables is _preset_tables(source.name):
        return source.name
    return id(source.tables) if source.folder is None else Path(source.name).resolve()


@cache
def fields() -> tuple[str, ...]:
    """Return the names of the preset fields.

    Examples
    --------
    >>> from cgemit.detector import fields
    >>> fields()
    ('besiii', 'besiii-harmonic', 'finite-solenoid', 'uniform')
    """
    return tuple(
        sorted(entry.name.removesuffix(".toml") for entry in _FIELDS.iterdir() if entry.name.endswith(".toml"))
    )


def field_tables(source: str | Path | Mapping[str, Any]) -> dict[str, Any]:
    """Return the table [field] that a preset, a TOML file with one, a map file or a mapping stands for.

    Raises
    ------
    DetectorError
        If there is no such preset or file, or it holds no field.

    """
    if isinstance(source, Mapping):
        return dict(source)
    text = str(source)
    if _is_preset(_FIELDS, text):
        return _field_of(text, tomllib.loads((_FIELDS / f"{text}.toml").read_text(encoding="utf-8")), None)
    path = Path(text)
    if not is_file(path):
        expected = f"one of {', '.join(fields())}, a map (.npz, .csv), or a TOML file with a table [field]"
        raise DetectorError(
            text[:_LONGEST], [Problem("field", _no_file(path, text), expected, did_you_mean(text[:_LONGEST], fields()))]
        )
    if path.suffix in MAPS:
        return {"kind": "map", "file": str(path.absolute())}
    try:
        return _field_of(text, parse_toml(read_text(path)), path.parent)
    except DetectorError:
        raise
    except ValueError as error:
        raise DetectorError(text, [Problem("field", str(error), "a TOML file or a map (.npz, .csv)")]) from error


def place_map(tables: dict[str, Any], folder: Path | None) -> dict[str, Any]:
    """Return the tables of a file with the path of its field map made absolute; relative ones begin at `folder`.

    Maps of the program (`OWN_MAP`) keep their names, so that a detector file means the same on every machine.
    """
    field = tables.get("field")
    if not isinstance(field, Mapping) or not isinstance(field.get("file"), str) or field["file"].startswith(OWN_MAP):
        return tables
    return {**tables, "field": {**field, "file": str(((folder or Path()) / field["file"]).absolute())}}


def map_path(file: str) -> Path:
    """Return the path of the map that `file` of a table [field] names."""
    return Path(str(_FIELDS / file.removeprefix(OWN_MAP))) if file.startswith(OWN_MAP) else Path(file)


def _field_of(name: str, tables: dict[str, Any], folder: Path | None) -> dict[str, Any]:
    field = place_map(tables, folder).get("field")
    if not isinstance(field, Mapping):
        raise DetectorError(name, [Problem("field", "nothing", "a table [field]")])
    return dict(field)


_HEADER = re.compile(r"\s*(\w+)\s*\[(.*)\]\s*")
_LARGEST_CSV = 500_000_000  # bytes
_UNITS = {"length": "length_unit", "angle": "angle_unit", "field": "field_unit"}  # by dimension, in .npz files


def _dimensions(axes: tuple[str, ...], components: tuple[str, ...]) -> dict[str, str]:
    """Return the dimension of each column of a map."""
    return {name: "angle" if name == "phi" else "length" for name in axes} | dict.fromkeys(components, "field")


def read_field_map(path: str | Path, columns: str = "", mirror: str | Sequence[str] | None = None) -> FieldGrid:
    """Return the grid that a map file holds (docs/methods/field.md).

    Parameters
    ----------
    path : str or Path
        ``.npz`` or ``.csv``; any text file if `columns` are given.
    columns : str
        Columns of a text table without a header, such as ``"x[cm] y[cm] z[cm] - bx[G] by[G] bz[G]"``; ``-`` is a column
        that is not read. Numbers are separated by white space, commas or semicolons. Empty lines, lines that begin with
        ``#``, ``%``, ``!`` or ``//``, and lines of text before the first row of numbers are left out.
    mirror : str or sequence of str
        Axes x, y, z of which the file has one side of 0; the other side follows by the symmetry of a solenoid. By
        default those with one side.

    Raises
    ------
    DetectorError
        With every problem of the file.

    Examples
    --------
    >>> from cgemit.detector import read_field_map, write_field_map
    >>> r, z = np.linspace(0, 900, 4), np.linspace(-500, 500, 5)  # mm
    >>> field = {"r": r, "z": z, "br": np.zeros((4, 5)), "bz": np.full((4, 5), -1.0)}  # T
    >>> grid = read_field_map(write_field_map("field.npz", field))
    >>> len(grid.axes), grid.values.shape
    (2, (4, 5, 2))
    """
    path = Path(path)
    problems: list[Problem] = []
    if columns:
        raw = _read_text(path, columns, problems)
    else:
        raw = {".npz": _read_npz, ".csv": _read_csv}.get(path.suffix, _no_map)(path, problems)
    mirrored = (mirror,) if isinstance(mirror, str) else mirror
    grid = checked_grid(raw, problems, mirrored) if raw is not None else None
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
        Axes r, z or x, y, z or r, phi, z (one-dimensional, equidistant, mm and rad), and components br, bz or bx, by,
        bz (with phi also br, bphi, bz) on the grid, the axes in that order (T).
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

    Examples
    --------
    >>> from cgemit.detector import write_field_map
    >>> r, z = np.linspace(0, 900, 4), np.linspace(-500, 500, 5)  # mm
    >>> field = {"r": r, "z": z, "br": np.zeros((4, 5)), "bz": np.full((4, 5), -1.0)}  # T
    >>> path = write_field_map("map.npz", field)
    >>> round(cg.load("besiii-cgem").with_field(path).field.bz, 3)
    -1.0
    """
    path = Path(path)
    problems: list[Problem] = []
    if path.suffix not in (".npz", ".csv"):
        _no_map(path, problems)
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in columns.items()}
    dimensions = _dimensions(*names_in(arrays))
    units = {name: NATIVE[dimensions.get(name, "field")] for name in arrays}
    checked_grid({name: Column(array, units[name]) for name, array in arrays.items()}, problems)
    if problems:
        raise DetectorError(str(path), problems)
    with new_file(path, overwrite=overwrite) as temporary:
        if path.suffix == ".npz":
            texts = {_UNITS[dimension]: np.array(NATIVE[dimension]) for dimension in dimensions.values()}
            np.savez_compressed(temporary, **arrays, **texts)  # type: ignore[arg-type]
        else:
            _write_csv(temporary, arrays)
    return path


def _write_csv(path: Path, arrays: Mapping[str, Floats]) -> None:
    axes, components = names_in(arrays)
    points = np.meshgrid(*(arrays[name] for name in axes), indexing="ij")
    rows = np.stack([*points, *(arrays[name] for name in components)], axis=-1).reshape(-1, len(axes) + len(components))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(f"{name}[{NATIVE[kind]}]" for name, kind in _dimensions(axes, components).items())
        writer.writerows([[repr(float(number)) for number in row] for row in rows])


def _no_map(path: Path, problems: list[Problem]) -> MapColumns | None:
    hint = "a text table: read_field_map(path, columns) and write_field_map"
    problems.append(Problem("", f'"{path.name}"', "a map file, .npz or .csv", hint))
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


def _read_npz(path: Path, problems: list[Problem]) -> MapColumns | None:
    """Return the arrays of a file in mm and T."""
    try:
        arrays = read_npz(path)
    except (OSError, ValueError) as error:
        problems.append(Problem("", str(error), "a .npz file of arrays"))
        return None
    dimensions = _dimensions(*names_in(arrays))
    units = {dimension: _UNITS[dimension] for dimension in dimensions.values()}
    # Names that no map has are noted with the grid.
    columns: MapColumns = dict.fromkeys(sorted(arrays.keys() - {*dimensions, *units.values()}))
    for dimension, unit in units.items():
        names = [name for name, kind in dimensions.items() if kind == dimension]
        if unit in arrays:
            _check_unit(arrays[unit], dimension, unit, problems)
        else:
            problems.append(Problem(unit, "nothing", f"the unit of {', '.join(names)}, as text"))
        for name in filter(arrays.__contains__, names):
            if np.issubdtype(arrays[name].dtype, np.number) and not np.iscomplexobj(arrays[name]):
                columns[name] = _scaled(arrays[name], arrays.get(unit, ""), dimension)
            else:
                columns[name] = None
                problems.append(Problem(name, f"an array of {arrays[name].dtype}", "numbers"))
    return columns


_COMMENTS = ("#", "%", "!", "//")


def _lines(path: Path, problems: list[Problem]) -> list[str] | None:
    try:
        return read_text(path, _LARGEST_CSV).splitlines()
    except (OSError, ValueError) as error:
        problems.append(Problem("", str(error), "a text file"))
        return None


def _read_text(path: Path, columns: str, problems: list[Problem]) -> MapColumns | None:
    """Return the columns of a text table without a header as axes and arrays on the grid, in mm and T."""
    lines = _lines(path, problems)
    if lines is None:
        return None
    stripped = (line.strip() for line in lines)
    rows = [re.split(r"[\s,;]+", line.rstrip(",;")) for line in stripped if line and not line.startswith(_COMMENTS)]
    first = next((i for i, row in enumerate(rows) if all(map(is_number, row))), 0)
    header = re.findall(r"\S+(?:\s*\[[^\]]*\])?", columns.replace(",", " "))
    return _table(header, rows[first:], problems)


def _read_csv(path: Path, problems: list[Problem]) -> MapColumns | None:
    """Return the columns of a file as axes and arrays on the grid, in mm and T."""
    lines = _lines(path, problems)
    if lines is None:
        return None
    header, *rows = list(csv.reader([line for line in lines if line and line[0] != "#"])) or [[]]
    return _table(header, rows, problems)


def _table(header: list[str], rows: list[list[str]], problems: list[Problem]) -> MapColumns:
    """Return the columns of a table by its header; a column ``-`` is not read."""
    matches = [_HEADER.fullmatch(name) for name in header]
    units = {match[1]: match[2] for match in matches if match}
    axes, components = names_in(units)
    dimensions = _dimensions(axes, components)
    missing = [name for name in dimensions if name not in units]
    if missing:
        text = f"columns {', '.join(header) or 'none'}"
        wanted = ", ".join(f"{name}[{NATIVE[kind]}]" for name, kind in dimensions.items())
        problems.append(Problem("header", text, f"{wanted}; no column {', '.join(missing)}"))
    named = [name for name in header if name != "-"]
    unread = [name for name in named if (match := _HEADER.fullmatch(name)) is None or match[1] not in dimensions]
    if unread and not missing:
        expected = f"only {', '.join(dimensions)}"
        problems.append(Problem("header", f"columns {', '.join(unread)} that are not read", expected))
    usable = [name for name in dimensions if name in units]
    for name in usable:
        _check_unit(units[name], dimensions[name], f"header {name}", problems)
    columns: MapColumns = dict.fromkeys(dimensions)
    table = _numbers(rows, len(header), problems, any_width=bool(missing))
    if table is None:
        return columns
    places = {match[1]: place for place, match in enumerate(matches) if match}
    for name in usable:
        columns[name] = _scaled(table[:, places[name]], units[name], dimensions[name])
    return _on_grid(columns, axes, components, problems)


def _numbers(rows: list[list[str]], width: int, problems: list[Problem], *, any_width: bool) -> Floats | None:
    """Return the rows below the header; None if they cannot be read, which may be the header's fault (`any_width`)."""
    try:
        return np.array(rows, dtype=np.float64).reshape(len(rows), width)
    except ValueError:
        wrong = [not all(map(is_number, row)) or (len(row) != width and not any_width) for row in rows]
        bad = [i for i, one in enumerate(wrong, start=1) if one]
        shown = ", ".join(map(str, bad[:5])) + (f" and {len(bad) - 5} more" if len(bad) > 5 else "")
        if bad:
            expected = "numbers" if any_width else f"{width} numbers in every row"
            problems.append(Problem("rows", f"row {shown} below the header", expected))
        return None


def _on_grid(
    columns: MapColumns, axes: tuple[str, ...], components: tuple[str, ...], problems: list[Problem]
) -> MapColumns:
    """Sort the rows of a table onto the grid that its axes span."""
    on_axes = {name: columns[name] for name in axes}
    flat: MapColumns = {name: columns[name] for name in components}
    known = {name: column for name, column in on_axes.items() if column}
    if len(known) < len(axes):
        return dict.fromkeys(axes) | flat
    spans = [np.unique(column.values) for column in known.values()]
    shape = tuple(map(len, spans))
    indices = (np.searchsorted(span, c.values) for span, c in zip(spans, known.values(), strict=True))
    rows = len(next(iter(known.values())).values)
    whole = rows == math.prod(shape)  # in whole numbers: the product may be too large for an array
    places = np.ravel_multi_index(tuple(indices), shape) if whole and rows else np.empty(0, dtype=np.intp)
    if not whole or len(np.unique(places)) != rows:
        size = " x ".join(map(str, shape))
        expected = f"each point of the {size} grid of {', '.join(axes)} once"
        problems.append(Problem("rows", f"{rows} rows", expected))
        return dict.fromkeys(axes) | flat
    order = np.argsort(places)
    sorted_axes = {name: Column(span, known[name].unit) for name, span in zip(axes, spans, strict=True)}
    return sorted_axes | {
        name: column and Column(column.values[order].reshape(shape), column.unit) for name, column in flat.items()
    }
