"""One table in one file of any format: `.npz`, Parquet, ROOT, CSV."""

from __future__ import annotations

import itertools
import json
import math
import os
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.base.errors import did_you_mean
from cgemit.base.files import check_regular, check_unpacked, new_file, package, read_arrays, write_arrays
from cgemit.base.version import __version__
from cgemit.tables.schema import Array, Rows, schema_of

_KEY = b"cgemit"  # of the JSON text


def write_parquet(path: Path, columns: Mapping[str, np.ndarray[Any, Any]], about: Mapping[str, Any]) -> None:
    """Write columns (n,) and what is said about them."""
    pyarrow, parquet = package("pyarrow"), package("pyarrow.parquet")
    table = pyarrow.table(dict(columns))
    parquet.write_table(table.replace_schema_metadata({_KEY: json.dumps(dict(about), allow_nan=False)}), path)


def write_columns(path: str | os.PathLike[str], columns: Mapping[str, Any], *, overwrite: bool = False) -> Path:
    """Write columns of any origin as a Parquet file for other programs."""
    pyarrow, parquet = package("pyarrow"), package("pyarrow.parquet")
    with new_file(path, overwrite=overwrite) as temporary:
        parquet.write_table(pyarrow.table(dict(columns)), temporary)
    return Path(path)


def read_parquet(
    path: Path, names: Collection[str] | None = None
) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    """Read what `write_parquet` wrote: all columns, or those named.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged or was not written by `write_parquet`.
    """
    parquet = package("pyarrow.parquet")
    try:
        with parquet.ParquetFile(path) as file:
            schema = file.schema_arrow
            about = json.loads(schema.metadata[_KEY])
            width = sum(field.type.bit_width for field in schema) // 8
            check_unpacked(path.stat().st_size, file.metadata.num_rows * width)
            table = file.read(columns=None if names is None else list(names), use_threads=False)
        if not isinstance(about, dict):
            raise ValueError(f"its JSON text holds {about!r:.50}, not an object")
        return {name: table[name].to_numpy() for name in table.column_names}, about
    except FileNotFoundError:
        raise
    except Exception as error:  # of pyarrow and json: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete Parquet file of cgemit ({error})") from error


_ROOT_KEY = "cgemit"  # of the JSON text, a TObjString


def write_root(path: Path, tree: str, columns: Mapping[str, np.ndarray[Any, Any]], about: Mapping[str, Any]) -> None:
    """Write columns (n, ...) as a tree, and what is said about them."""
    branches = {name: (column.dtype, column.shape[1:]) for name, column in columns.items()}
    with package("uproot").recreate(path) as file:
        made = file.mktree(tree, branches)
        if len(next(iter(columns.values()))):
            made.extend(dict(columns))
        file[_ROOT_KEY] = json.dumps(dict(about), allow_nan=False)


def read_root(
    path: Path, names: Collection[str] | None = None
) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    """Read what `write_root` wrote: all columns, or those named.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged or was not written by `write_root`.
    """
    uproot = package("uproot")
    try:
        with uproot.open(path) as file:
            about = json.loads(str(file[_ROOT_KEY]))
            if not isinstance(about, dict):
                raise ValueError(f"its JSON text holds {about!r:.50}, not an object")
            tree = file[about["kind"]]
            width = sum(branch.interpretation.numpy_dtype.itemsize for branch in tree.branches)
            check_unpacked(path.stat().st_size, tree.num_entries * width)
            wanted = None if names is None else [name for name in names if name in tree]
            arrays = tree.arrays(wanted, library="np")
        return {str(name): np.asarray(column) for name, column in arrays.items()}, about
    except FileNotFoundError:
        raise
    except Exception as error:  # of uproot and json: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete ROOT file of cgemit ({error})") from error


_ROWS = 10_000  # that are turned into text at a time


def write_csv(path: Path, columns: Mapping[str, np.ndarray[Any, Any]]) -> None:
    """Write columns of numbers (n,)."""
    rows = len(next(iter(columns.values())))
    with path.open("w", encoding="ascii") as stream:
        stream.write(",".join(columns) + "\n")
        for first in range(0, rows, _ROWS):
            texts = [map(repr, column[first : first + _ROWS].tolist()) for column in columns.values()]
            stream.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))


def read_csv(path: Path, dtypes: Mapping[str, np.dtype[Any]]) -> dict[str, np.ndarray[Any, Any]]:
    """Read what `write_csv` wrote.

    Parameters
    ----------
    path : Path
    dtypes : mapping of str to dtype
        Of each column, in their order.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged, or has other columns.
    """
    check_regular(path)
    try:
        with path.open(encoding="ascii") as stream:
            names = stream.readline().rstrip("\n").split(",")
            if names != list(dtypes):
                raise ValueError(f"got the columns {', '.join(names)[:200]}, expected {', '.join(dtypes)[:200]}")
            lines = iter(stream)
            first = next(lines, None)
            if first is None:
                return {name: np.empty(0, dtype) for name, dtype in dtypes.items()}
            _check_end(path)
            rows = np.loadtxt(_after(first, stream), dtype=list(dtypes.items()), delimiter=",", ndmin=1, comments=None)
        return {name: np.ascontiguousarray(rows[name]) for name in dtypes}
    except FileNotFoundError:
        raise
    except Exception as error:  # of numpy and of the decoder: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete CSV file of cgemit ({error})") from error


def _after(first: str, rest: Any) -> Any:
    """Yield a line, and those that follow it."""
    yield first
    yield from rest


def _check_end(path: Path) -> None:
    """Raise a ValueError for a file that ends within a line: its last number may be cut off."""
    with path.open("rb") as stream:
        stream.seek(-1, os.SEEK_END)
        if stream.read() != b"\n":
            raise ValueError("the last line is cut off")


FORMAT = "cgemit-table-1"

#: Formats of files by name, with the ending of the files' names.
FORMATS = {"npz": ".npz", "npz-compressed": ".npz", "parquet": ".parquet", "root": ".root", "csv": ".csv"}

_PACKAGES = {"parquet": "pyarrow", "root": "uproot"}
_ABOUT = {"kind": str, "n_events": int, "first_event": int, "meta": dict}  # what `load` takes from `describe`

#: Arguments of `Table`: kind, columns, n_events, first_event, meta, events.
Arguments = tuple[str, dict[str, Array], int, int, dict[str, Any], Any]


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
    if name in _PACKAGES:
        package(_PACKAGES[name])
    return name


def describe(table: Rows) -> dict[str, Any]:
    """Return the description of a table in a file, without its columns."""
    return {
        "format": FORMAT,
        "version": __version__,
        "kind": table.kind,
        "rows": len(table),
        "n_events": table.n_events,
        "first_event": table.first_event,
        "units": {column.name: column.unit for column in schema_of(table.kind)},
        "meta": dict(table.meta),
    }


def describe_fully(table: Rows) -> dict[str, Any]:
    """Return the description with all that a file of plain columns does not hold.

    These are dtypes, shapes, checksums and gaps of events; `.npz` files hold them already.
    """
    columns = {name: [column.dtype.str[1:], *column.shape[1:]] for name, column in table.columns.items()}
    sums = {name: _checksum(column) for name, column in table.columns.items()}
    gaps = table.cover["events"]
    return describe(table) | {"columns": columns, "crc32": sums} | ({} if gaps is None else {"events": gaps.tolist()})


def _checksum(column: Array) -> int:
    """Return the checksum of a column; all NaN are the same, since text does not tell them apart."""
    if column.dtype.kind == "f" and np.isnan(column).any():
        column = np.where(np.isnan(column), np.array(np.nan, column.dtype), column)
    return zlib.crc32(np.ascontiguousarray(column).tobytes())


def _check_sums(path: str | os.PathLike[str], arrays: Mapping[str, Array], about: Mapping[str, Any]) -> None:
    """Raise a ValueError if a column is not the one that was written."""
    sums = about.get("crc32")
    if not isinstance(sums, dict):
        raise ValueError(f"{path} is damaged: it has no checksums")
    wrong = [name for name, array in arrays.items() if sums.get(name) != _checksum(array)]
    if wrong:
        raise ValueError(f"{path} is damaged: the checksum of {', '.join(wrong)} is another one")


def save(table: Rows, path: str | os.PathLike[str], *, overwrite: bool = False, form: str = "npz") -> None:
    """Write one table; see `Table.save`."""
    if form.startswith("npz"):
        beside = {"offsets": table.offsets}
        events = table.cover["events"]
        if events is not None:
            beside["events"] = events
        compressed = form == "npz-compressed"
        arrays = {**table.columns, **beside}
        write_arrays(path, arrays, describe(table), overwrite=overwrite, compressed=compressed)
        return
    _check_dtypes(table, form)
    about = describe_fully(table)
    with new_file(path, overwrite=overwrite) as temporary:
        if form == "root":
            write_root(temporary, table.kind, table.columns, about)
        elif form == "parquet":
            write_parquet(temporary, plain_columns(table.columns), about)
        else:
            write_csv(temporary, plain_columns(table.columns))


def load(path: str | os.PathLike[str], about: Mapping[str, Any] | None = None) -> Arguments:
    """Read the arguments of `Table` from a file; see `Table.load`.

    Parameters
    ----------
    path : path
        Its ending tells the format.
    about : mapping or None
        `describe_fully` of the table, which a CSV file does not hold itself.
    """
    arrays, found = _read(Path(path), None, about)
    if found.get("format") != FORMAT:
        raise ValueError(f"{path} has format {found.get('format')!r}, expected {FORMAT!r}")
    wrong = [name for name, kind in _ABOUT.items() if not isinstance(found.get(name), kind)]
    if wrong:
        raise ValueError(f"{path} is not a complete table file of cgemit (missing or wrong: {', '.join(wrong)})")
    if Path(path).suffix in _OTHERS:
        events = found.get("events")
        _check_rows(path, arrays, found)
        _check_sums(path, arrays, found)
    else:
        offsets = arrays.pop("offsets", np.empty(0))  # they follow from the event column
        if len(np.atleast_1d(offsets)) != found["n_events"] + 1:
            raise ValueError(f"{path} is damaged: {found['n_events']} events, but {len(offsets)} offsets")
        events = arrays.pop("events", None)
    return found["kind"], arrays, found["n_events"], found["first_event"], found["meta"], events


def load_columns(path: Path, names: Collection[str], about: Mapping[str, Any]) -> dict[str, Array]:
    """Read some columns (n,) or (n, ...) of a table.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    KeyError
        If it does not hold a column.
    ValueError
        If it is damaged, or holds another number of rows than `about` says.
    """
    arrays, found = _read(path, names, about)
    missing = [name for name in names if name not in arrays]
    if missing:
        raise KeyError(f"{path} has no column {', '.join(missing)}")
    _check_rows(path, arrays, about)
    if path.suffix in _OTHERS:
        _check_sums(path, arrays, found)
    return {name: arrays[name] for name in names}


_OTHERS = {".parquet", ".root", ".csv"}


def _read(
    path: Path, names: Collection[str] | None, about: Mapping[str, Any] | None
) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return columns and description of a file."""
    if path.suffix == ".root":
        return read_root(path, names)
    if path.suffix == ".parquet":
        wanted = None
        if names is not None:
            shapes = _shapes(path, about or {})
            wanted = [plain for name in names if name in shapes for plain in _plain_names(name, shapes[name])]
        columns, found = read_parquet(path, wanted)
        return _joined(columns, _shapes(path, found)), found
    if path.suffix == ".csv":
        if about is None:
            raise ValueError(f"{path}: a CSV file does not say what it covers; expected its folder with tables.json")
        shapes = _shapes(path, about)
        dtypes = {
            plain: np.dtype(about["columns"][name][0])
            for name, shape in shapes.items()
            for plain in _plain_names(name, shape)
        }
        return _joined(read_csv(path, dtypes), shapes), dict(about)
    return read_arrays(path, names)


def _shapes(path: Path, about: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return the shape of one entry of each column, as a description says."""
    columns = about.get("columns")
    try:
        shapes = {name: tuple(map(int, shape)) for name, (_, *shape) in columns.items()}  # type: ignore[union-attr]
        dtypes = [np.dtype(given[0]) for given in columns.values()]  # type: ignore[union-attr]
        if any(dtype.kind not in "iuf" for dtype in dtypes) or any(min(s, default=1) < 1 for s in shapes.values()):
            raise ValueError("strange dtypes or shapes")
        if sum(math.prod(shape) for shape in shapes.values()) > _MOST_COLUMNS:
            raise ValueError("too many numbers in a row")
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path} is damaged: got {columns!r:.100} for its columns ({error})") from error
    return shapes


_MOST_COLUMNS = 100_000  # of a file of plain columns


def _check_rows(path: str | os.PathLike[str], arrays: Mapping[str, Array], about: Mapping[str, Any]) -> None:
    """Raise a ValueError if a file holds another number of rows than its description says."""
    found = {len(array) for array in arrays.values()} - {about.get("rows")}
    if found:
        raise ValueError(f"{path} is damaged: {about.get('rows')!r:.20} rows, but {found.pop()} in a column")


def _check_dtypes(table: Rows, form: str) -> None:
    """Raise a ValueError for columns that a format cannot hold."""
    wrong = [
        f"{name}: got {column.dtype}, expected whole numbers, or numbers of 4 or 8 bytes, in a {form} file"
        for name, column in table.columns.items()
        if column.dtype.kind not in "iuf" or (column.dtype.kind == "f" and column.dtype.itemsize not in (4, 8))
    ]
    plain = [name for name, column in table.columns.items() for name in _plain_names(name, column.shape[1:])]
    wrong += [f"{name}: two columns have this name in a {form} file" for name in sorted(set(plain)) if
              form != "root" and plain.count(name) > 1]  # fmt: skip
    if wrong:
        raise ValueError(f"{table.kind}:\n  " + "\n  ".join(wrong))


def _plain_names(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return the names of the plain columns of a column: ``name_0_0, name_0_1, ...`` for a matrix."""
    return ["_".join([name, *map(str, index)]) for index in itertools.product(*map(range, shape))]


def plain_columns(columns: Mapping[str, Array]) -> dict[str, Array]:
    """Return columns (n,) of numbers; a matrix column becomes ``name_0_0, name_0_1, ...``."""
    plain: dict[str, Array] = {}
    for name, column in columns.items():
        flat = column.reshape(len(column), math.prod(column.shape[1:])) if column.ndim > 1 else column[:, None]
        plain |= {one: flat[:, i] for i, one in enumerate(_plain_names(name, column.shape[1:]))}
    return plain


def _joined(plain: Mapping[str, Array], shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """Return the columns that `plain_columns` was made from, as far as they are there."""
    joined = {}
    for name, shape in shapes.items():
        names = _plain_names(name, shape)
        if not any(one in plain for one in names):
            continue
        missing = [one for one in names if one not in plain]
        if missing:
            raise ValueError(f"the column {missing[0]} is missing")
        columns = [plain[one] for one in names]
        joined[name] = np.stack(columns, axis=1).reshape(-1, *shape) if shape else columns[0]
    return joined
