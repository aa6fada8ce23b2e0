"""One table in one file, of any of the `FORMATS`: the columns, and a JSON text that describes them."""

from __future__ import annotations

import itertools
import json
import math
import os
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.base.errors import did_you_mean, report
from cgemit.base.files import MissingPackageError, check_regular, check_unpacked, new_file, package, read_npz
from cgemit.base.version import __version__
from cgemit.tables.schema import Array, Rows, schema_of

#: The columns of a file, or some of them, and their description.
Stored = tuple[dict[str, Array], dict[str, Any]]


@dataclass(frozen=True)
class Format:
    """How a table is stored in a file.

    Attributes
    ----------
    name, suffix : str
    write : callable
        Writes a table and its description to a path.
    read : callable
        Returns the columns of a file, of which only those of the given names need to be read (None: all), and the
        description. Any exception but FileNotFoundError tells that the file is damaged.
    package : str
        The package that the format needs, if any.
    """

    name: str
    suffix: str
    write: Callable[[Path, Rows, dict[str, Any]], None]
    read: Callable[[Path, Collection[str] | None], Stored]
    package: str = ""


_VERSION = "cgemit-table-1"
_ABOUT = {"kind": str, "rows": int, "n_events": int, "first_event": int, "meta": dict, "crc32": dict}


def _described(text: str | bytes) -> dict[str, Any]:
    """Return the description that a file holds as a JSON text."""
    about = json.loads(text)
    if not isinstance(about, dict):
        raise ValueError(f"its description holds {about!r:.50}, not an object")
    if about.get("format") != _VERSION:
        raise ValueError(f"it has format {about.get('format')!r:.50}, expected {_VERSION!r}")
    wrong = [name for name, kind in _ABOUT.items() if not isinstance(about.get(name), kind)]
    if wrong:
        raise ValueError(f"missing or wrong: {', '.join(wrong)}")
    return about


_META = "__meta__"  # the array that holds the JSON text


def _write_npz(path: Path, table: Rows, about: dict[str, Any]) -> None:
    events = about.pop("events", None)  # as an array: there may be millions
    beside = {"offsets": table.offsets} | ({} if events is None else {"events": np.array(events, np.int64)})
    text = np.array(json.dumps(about, allow_nan=False))
    with path.open("wb") as stream:
        np.savez(stream, **{_META: text}, **table.columns, **beside)  # type: ignore[arg-type]


def _read_npz(path: Path, names: Collection[str] | None) -> Stored:
    arrays: dict[str, Array] = read_npz(path, None if names is None else {_META, *names})
    about = _described(str(arrays.pop(_META)))
    if names is None:
        offsets = np.atleast_1d(arrays.pop("offsets", np.empty(0)))  # they follow from the event column
        if len(offsets) != about["n_events"] + 1:
            raise ValueError(f"{about['n_events']} events, but {len(offsets)} offsets")
        if "events" in arrays:
            about["events"] = arrays.pop("events")
    return arrays, about


_KEY = "cgemit"  # of the JSON text in other files


def _write_parquet(path: Path, table: Rows, about: dict[str, Any]) -> None:
    pyarrow, parquet = package("pyarrow"), package("pyarrow.parquet")
    _check_numbers(table, "parquet")
    columns = plain_columns(table.columns)
    if len(columns) < sum(math.prod(column.shape[1:]) for column in table.columns.values()):
        raise ValueError(f"{table.kind}: two columns have the same name in a parquet file")
    arrow = pyarrow.table(columns)
    parquet.write_table(arrow.replace_schema_metadata({_KEY: json.dumps(about, allow_nan=False)}), path)


def _read_parquet(path: Path, names: Collection[str] | None) -> Stored:
    with package("pyarrow.parquet").ParquetFile(path) as file:
        schema = file.schema_arrow
        about = _described(schema.metadata[_KEY.encode()])
        shapes = _shapes(about)
        width = sum(field.type.bit_width for field in schema) // 8
        check_unpacked(path.stat().st_size, file.metadata.num_rows * width)
        wanted = [plain for name in shapes if names is None or name in names for plain in _plain(name, shapes[name])]
        found = file.read(columns=wanted, use_threads=False)
    columns = {name: found[name].to_numpy() for name in found.column_names}
    return _joined(columns, {name: shapes[name] for name in shapes if names is None or name in names}), about


def _write_root(path: Path, table: Rows, about: dict[str, Any]) -> None:
    _check_numbers(table, "root")
    branches = {name: (column.dtype, column.shape[1:]) for name, column in table.columns.items()}
    with package("uproot").recreate(path) as file:
        tree = file.mktree(table.kind, branches)
        if len(table):
            tree.extend(dict(table.columns))
        file[_KEY] = json.dumps(about, allow_nan=False)


def _read_root(path: Path, names: Collection[str] | None) -> Stored:
    with package("uproot").open(path) as file:
        about = _described(str(file[_KEY]))
        tree = file[about["kind"]]
        width = sum(branch.interpretation.numpy_dtype.itemsize for branch in tree.branches)
        check_unpacked(path.stat().st_size, tree.num_entries * width)
        arrays = tree.arrays(None if names is None else [name for name in names if name in tree], library="np")
    return {str(name): np.asarray(column) for name, column in arrays.items()}, about


#: All formats by name; a further one is a line here.
FORMATS = {
    one.name: one
    for one in (
        Format("npz", ".npz", _write_npz, _read_npz),
        Format("parquet", ".parquet", _write_parquet, _read_parquet, package="pyarrow"),
        Format("root", ".root", _write_root, _read_root, package="uproot"),
    )
}
#: The same by the ending of the files' names.
BY_SUFFIX = {one.suffix: one for one in FORMATS.values()}


def check_format(name: object) -> str:
    """Return the name of a format that can be written here.

    Raises
    ------
    ValueError
        If there is no such format, or the package that it needs is not installed.
    """
    if not isinstance(name, str) or name not in FORMATS:
        hint = did_you_mean(str(name), FORMATS, "; ")
        raise ValueError(f"format: got {name!r:.50}, expected one of {', '.join(map(repr, FORMATS))}{hint}")
    if FORMATS[name].package:
        package(FORMATS[name].package)
    return name


#: Arguments of `Table`: kind, columns, n_events, first_event, meta, events.
Arguments = tuple[str, dict[str, Array], int, int, dict[str, Any], Any]


def describe(table: Rows) -> dict[str, Any]:
    """Return the description of a table, without what only its own file says: columns, checksums, gaps of events."""
    return {
        "format": _VERSION,
        "version": __version__,
        "kind": table.kind,
        "rows": len(table),
        "n_events": table.n_events,
        "first_event": table.first_event,
        "units": {column.name: column.unit for column in schema_of(table.kind)},
        "meta": dict(table.meta),
    }


def save(table: Rows, path: str | os.PathLike[str], *, overwrite: bool = False, form: str | None = None) -> None:
    """Write one table; see `Table.save`. Without `form` the ending tells the format, any unknown one `npz`."""
    chosen = FORMATS[check_format(BY_SUFFIX.get(Path(path).suffix, FORMATS["npz"]).name if form is None else form)]
    columns = {name: [column.dtype.str[1:], *column.shape[1:]] for name, column in table.columns.items()}
    sums = {name: checksum(column) for name, column in table.columns.items()}
    gaps = table.cover["events"]
    about = describe(table) | {"columns": columns, "crc32": sums} | ({} if gaps is None else {"events": gaps.tolist()})
    with new_file(path, overwrite=overwrite) as temporary:
        chosen.write(temporary, table, about)


def load(path: str | os.PathLike[str]) -> Arguments:
    """Read the arguments of `Table` from a file, whose ending tells the format; see `Table.load`."""
    arrays, about = _read(Path(path), None)
    return about["kind"], arrays, about["n_events"], about["first_event"], about["meta"], about.get("events")


def is_own(path: Path) -> bool:
    """Return whether a file holds a description of a table, whole or not, or cannot be looked into.

    Parameters
    ----------
    path : Path
        Its ending tells the format.
    """
    form = BY_SUFFIX.get(path.suffix, FORMATS["npz"]).name
    try:
        if form == "parquet":
            with package("pyarrow.parquet").ParquetFile(path) as file:
                return _KEY.encode() in (file.schema_arrow.metadata or {})
        if form == "root":
            with package("uproot").open(path) as file:
                return any(name.partition(";")[0] == _KEY for name in file.keys(recursive=False))
        with zipfile.ZipFile(path) as archive:
            return f"{_META}.npy" in archive.namelist()
    except (FileNotFoundError, MissingPackageError):
        raise
    except Exception:  # of a damaged file: reading it tells what is wrong
        return True


def load_columns(path: Path, names: Collection[str]) -> dict[str, Array]:
    """Read some columns (n,) or (n, ...) of a table.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    KeyError
        If it does not hold a column.
    ValueError
        If it is damaged.
    """
    arrays, _ = _read(path, names)
    missing = [name for name in names if name not in arrays]
    if missing:
        raise KeyError(f"{path} has no column {', '.join(missing)}")
    return {name: arrays[name] for name in names}


def _read(path: Path, names: Collection[str] | None) -> Stored:
    """Return columns and description of a file, which agree."""
    form = BY_SUFFIX.get(path.suffix, FORMATS["npz"])
    try:
        check_regular(path)
        arrays, about = form.read(path, names)
    except (FileNotFoundError, MissingPackageError):
        raise
    except Exception as error:  # of numpy, pyarrow, uproot, json: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete table file of cgemit ({error})") from error
    lengths = {len(array) for array in arrays.values()} - {about["rows"]}
    if lengths:
        raise ValueError(f"{path} is damaged: {about['rows']} rows, but {lengths.pop()} in a column")
    wrong = [name for name, array in arrays.items() if about["crc32"].get(name) != checksum(array)]
    if wrong:
        raise ValueError(f"{path} is damaged: the checksum of {', '.join(wrong)} is another one")
    return arrays, about


def checksum(column: Array) -> int:
    """Return the checksum of a column."""
    return zlib.crc32(np.ascontiguousarray(column).data)


def _check_numbers(table: Rows, form: str) -> None:
    """Raise a ValueError for columns that are no numbers of C."""
    wrong = [
        f"{name}: got {column.dtype}, expected whole numbers, or numbers of 4 or 8 bytes, in a {form} file"
        for name, column in table.columns.items()
        if column.dtype.kind not in "iuf" or (column.dtype.kind == "f" and column.dtype.itemsize not in (4, 8))
    ]
    report(table.kind, wrong)


def write_columns(path: Path, form: str, name: str, columns: Mapping[str, Array]) -> None:
    """Write columns (n,) of numbers, of no kind of table, for other programs.

    Parameters
    ----------
    path : Path
    form : str
        ``"parquet"`` or ``"root"``.
    name : str
        Of the TTree.
    columns : mapping of str to ndarray
    """
    if form == "parquet":
        package("pyarrow.parquet").write_table(package("pyarrow").table(dict(columns)), path)
        return
    with package("uproot").recreate(path) as file:
        tree = file.mktree(name, {key: column.dtype for key, column in columns.items()})
        if len(next(iter(columns.values()))):
            tree.extend(dict(columns))


_MOST_COLUMNS = 100_000  # of a file of plain columns


def _shapes(about: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return the shape of one entry of each column, as a description says."""
    shapes = {name: tuple(map(int, shape)) for name, (_, *shape) in about["columns"].items()}
    if any(min(shape, default=1) < 1 for shape in shapes.values()):
        raise ValueError("strange shapes")
    if sum(map(math.prod, shapes.values())) > _MOST_COLUMNS:
        raise ValueError("too many numbers in a row")
    return shapes


def _plain(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return the names of the plain columns of a column: ``name_0_0, name_0_1, ...`` for a matrix."""
    return ["_".join([name, *map(str, index)]) for index in itertools.product(*map(range, shape))]


def plain_columns(columns: Mapping[str, Array]) -> dict[str, Array]:
    """Return columns (n,) of numbers; a matrix column becomes ``name_0_0, name_0_1, ...``."""
    plain: dict[str, Array] = {}
    for name, column in columns.items():
        flat = column.reshape(len(column), math.prod(column.shape[1:]))
        plain |= {one: flat[:, i] for i, one in enumerate(_plain(name, column.shape[1:]))}
    return plain


def _joined(plain: Mapping[str, Array], shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """Return the columns that `plain_columns` was made from."""
    return {
        name: np.stack([plain[one] for one in _plain(name, shape)], axis=1).reshape(-1, *shape)
        if shape
        else plain[name]
        for name, shape in shapes.items()
    }
