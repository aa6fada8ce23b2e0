"""Sets of tables in folders: a file or a folder of parts for each, and one JSON text that describes them."""

from __future__ import annotations

import itertools
import json
import os
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.base.errors import report
from cgemit.base.files import add_files, new_file, read_json
from cgemit.tables.formats import BY_SUFFIX, FORMATS, check_format, describe, load, load_columns, save
from cgemit.tables.schema import Array, Rows, schema_of
from cgemit.tables.table import Table, lost_links, moved_links, targets

INDEX = "tables.json"
_LARGEST = 200_000_000  # bytes of an index, which has a line for each of many parts
#: What every entry says about the size of its table.
COVER = {"n_events": 0, "first_event": 0, "rows": 0}.keys()


def save_tables(
    tables: Mapping[str, Rows], directory: str | os.PathLike[str], *, overwrite: bool = False, format: str = "npz"
) -> list[Path]:
    """Write each table to a file of its name in a directory, and last of all their description to ``tables.json``.

    The directory is made if it is missing. Without ``tables.json`` it is not complete.

    Parameters
    ----------
    tables : mapping of str to Table
    directory : path
    overwrite : bool
    format : str
        One of `FORMATS`: "npz", "parquet" (pyarrow), "root" (a TTree of the table's name; uproot).

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    FileExistsError
        If one of the files exists and `overwrite` is false; with `overwrite`, if it was not written by this function,
        or was changed since. Nothing is written then.
    ValueError
        If the format is unknown, needs a package that is not installed, or cannot hold a column.

    Examples
    --------
    >>> from cgemit.tables import save_tables
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=2)
    >>> files = save_tables({"particles": result.particles}, "particles")
    >>> [file.name for file in files]
    ['particles.npz', 'tables.json']
    """
    folder, suffix = Path(directory), FORMATS[check_format(format)].suffix
    paths = {name: folder / f"{name}{suffix}" for name in tables}
    index = folder / INDEX
    existing = [str(path) for path in (*paths.values(), index) if path.exists()]
    if existing and not overwrite:
        raise FileExistsError(f"{', '.join(existing)} would be replaced; pass overwrite=True to do so")
    with add_files(folder) as place:
        write_tables(tables, place, format)
    return [*paths.values(), index]


def write_tables(tables: Mapping[str, Rows], folder: Path, format: str) -> list[Path]:
    """Write tables and their description to a folder that holds nothing of these names; return the files."""
    suffix = FORMATS[check_format(format)].suffix
    paths = [folder / f"{name}{suffix}" for name in tables]
    for path, table in zip(paths, tables.values(), strict=True):
        save(table, path, form=format)
    return [*paths, write_index(folder, {name: entry(table, suffix) for name, table in tables.items()})]


def entry(table: Rows, suffix: str) -> dict[str, Any]:
    """Return what the index says about a table in a file."""
    return describe(table) | {"suffix": suffix}


def write_index(folder: Path, entries: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write the description of all tables."""
    path = folder / INDEX
    with new_file(path) as temporary:
        temporary.write_text(json.dumps(entries, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return path


def read_index(directory: str | os.PathLike[str]) -> dict[str, dict[str, Any]]:
    """Return the tables that `save_tables` wrote to a directory, described by name; raises as `load_tables`."""
    index = Path(directory) / INDEX
    if not index.exists():
        raise FileNotFoundError(f"{directory} holds no complete set of tables ({INDEX} is missing)")
    try:
        tables = read_json(index, _LARGEST)
    except ValueError as error:
        raise ValueError(f"{index} is damaged ({error})") from error
    if not isinstance(tables, dict) or not all(isinstance(about, dict) for about in tables.values()):
        raise ValueError(f"{index} is damaged (expected an object with a key for each table)")
    strange = [name for name in tables if not re.fullmatch(r"[A-Za-z_]\w{0,63}", name, re.ASCII)]
    if strange:
        raise ValueError(f"{index} is damaged (got the table name {strange[0][:80]!r}, expected letters and digits)")
    for name, about in tables.items():
        problem = _entry_problem(about)
        if problem:
            raise ValueError(f"{index} is damaged ({name}: {problem})")
    return tables


def _entry_problem(about: Mapping[str, Any]) -> str:
    """Return what is wrong with the entry of a table, or an empty text."""
    suffix = about.get("suffix")
    if suffix not in tuple(BY_SUFFIX):
        return f"suffix: got {suffix!r:.40}, expected one of {', '.join(BY_SUFFIX)}"
    parts = about.get("parts")
    if "parts" not in about:
        return ""
    if not isinstance(parts, list) or not parts or not all(isinstance(part, dict) for part in parts):
        return f"parts: got {parts!r:.40}, expected a list of parts"
    if any(not isinstance(part.get(key), int) or part[key] < 0 for part in parts for key in COVER):
        return f"parts: expected {', '.join(COVER)} of each, whole numbers"
    for key in ("n_events", "rows"):
        total = sum(part[key] for part in parts)
        if total != about.get(key):
            return f"parts: got {total} {key}, expected {about.get(key)!r:.20}"
    return ""


def files_of(name: str, about: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Return the files of a table, relative to the folder, each with the description of what it holds."""
    suffix = about["suffix"]
    if "parts" not in about:
        return [(f"{name}{suffix}", dict(about))]
    common = {key: value for key, value in about.items() if key != "parts"}
    return [(f"{name}/part-{i:06d}{suffix}", common | part) for i, part in enumerate(about["parts"])]


def index_problems(file: str, table: Rows, about: Mapping[str, Any]) -> list[str]:
    """Return how a table differs from its description in the index: it is of another run, or half replaced."""
    described = json.loads(json.dumps(describe(table)))
    pairs = [(key, described[key], about.get(key)) for key in ("kind", *COVER)]
    meta, expected = described["meta"], about.get("meta")
    expected = expected if isinstance(expected, dict) else {}
    pairs += [(key, meta.get(key), expected.get(key)) for key in dict.fromkeys([*meta, *expected])]
    return [
        f"{file}: {key}: got {given!r:.100}, expected {wanted!r:.100}, as {INDEX} says"
        for key, given, wanted in pairs
        if given != wanted
    ]


def concatenate(chunks: Sequence[Mapping[str, Table]], *, gaps: bool = False) -> dict[str, Table]:
    """Join chunk results table by table, and let the link columns count rows of the joined tables.

    Parameters
    ----------
    chunks : sequence of mapping of str to Table
        The tables of each chunk, in the order of events. Every chunk holds the same tables, among them all that
        its link columns point into.
    gaps : bool
        Whether event numbers may be missing between two chunks.

    Returns
    -------
    dict of str to Table

    Raises
    ------
    ValueError
        If chunks are missing, do not follow each other, or lack a table that is linked to.

    Examples
    --------
    >>> from cgemit.tables import concatenate
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> r = cg.run("besiii-cgem", gun, n=4)
    >>> parts = [r.select_events(0, 2).tables, r.select_events(2, 4).tables]
    >>> concatenate(parts)["clusters"] == r.clusters
    True
    """
    return dict(JoinedTables(chunks, gaps=gaps))


def append(tables: Sequence[Table]) -> Table:
    """Join the parts of one table, whose links count rows of the joined tables already.

    Parameters
    ----------
    tables : sequence of Table
        At least one, in the order of events.
    """
    return tables[0] if len(tables) == 1 else _join(list(tables), {})


def select_events(tables: Mapping[str, Table], first: int, stop: int) -> dict[str, Table]:
    """Return the rows of the events ``first ... stop - 1`` of all tables of a run; links count the selected rows.

    Parameters
    ----------
    tables : mapping of str to Table
        Of the same events, among them all that links point into.
    first, stop : int

    Returns
    -------
    dict of str to Table

    Raises
    ------
    IndexError
        If the tables do not cover the events.
    ValueError
        If a table that is linked to is missing.

    Examples
    --------
    >>> from cgemit.tables import select_events
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=4)
    >>> later = select_events(result.tables, 2, 4)
    >>> later["particles"]["event"].tolist()
    [2, 3]
    """
    problems = [
        f"{name}: links to {target}, which is missing"
        for name, table in tables.items()
        for target in lost_links(table, tables)
    ]
    report("select_events", problems)
    before = {name: np.searchsorted(table["event"], [first]) for name, table in tables.items()}
    picked = {name: table.select_events(first, stop) for name, table in tables.items()}
    return {name: table.with_columns(**_moved(table, 0, before, sign=-1)) for name, table in picked.items()}


def _problems(name: str, chunks: Sequence[Mapping[str, Table]], gaps: bool) -> list[str]:
    tables = [chunk[name] for chunk in chunks if name in chunk]
    problems = [
        f"{name}: ends before event {_stop(a)}, but the next chunk starts at {b.first_event}"
        for a, b in itertools.pairwise(tables)
        if b.first_event != _stop(a) and not ((gaps or _has_gaps(a, b)) and b.first_event > _stop(a))
    ]
    if len({(table.kind, *table.columns) for table in tables}) > 1:
        problems.append(f"{name}: kinds or columns differ between chunks")
    missing = sorted({to for table in tables for to in lost_links(table, chunks[0])}) if len(chunks) > 1 else []
    return problems + [f"{name}: links to {target}, which the chunks do not hold" for target in missing]


def _stop(table: Table) -> int:
    """Return the number behind the last event."""
    return int(table.events[-1]) + 1 if table.n_events else table.first_event


def _has_gaps(*tables: Table) -> bool:
    return any(table.cover["events"] is not None for table in tables)


def _moved(table: Table, place: int, before: Mapping[str, Array], sign: int = 1) -> dict[str, Array]:
    """Return the link columns with the rows before added; those to tables that are not kept are all -1."""
    nothing = np.zeros(place + 1, np.int64)
    return moved_links(table, lambda to: sign * before.get(to, nothing)[place])


def _join(tables: list[Table], before: Mapping[str, Array]) -> Table:
    links = [_moved(table, i, before) for i, table in enumerate(tables)]
    joined = {
        name: np.concatenate([moved.get(name, table.columns[name]) for table, moved in zip(tables, links, strict=True)])
        for name in tables[0].columns
    }
    events = np.concatenate([table.events for table in tables])
    n_events = sum(table.n_events for table in tables)
    return Table(tables[0].kind, joined, n_events, tables[0].first_event, _same_meta(tables), events)


def _same_meta(tables: Sequence[Table]) -> dict[str, Any]:
    """Return what all tables say of themselves."""
    first, *others = (table.meta for table in tables)
    return {key: value for key, value in first.items() if all(key in one and one[key] == value for one in others)}


#: A part is closed when the columns of its tables reach this many bytes.
PART_BYTES = 2**25


class LazyTables(Mapping[str, Table], ABC):
    """Tables that are made when they are first asked for, and kept."""

    def __init__(self, names: Collection[str]) -> None:
        self._names = names
        self._tables: dict[str, Table] = {}

    def __getitem__(self, name: str) -> Table:
        if name not in self._tables:
            self._tables[name] = self._made(name)
        return self._tables[name]

    @abstractmethod
    def _made(self, name: str) -> Table:
        """Return a table anew."""

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    @abstractmethod
    def about(self, name: str) -> Mapping[str, Any]:
        """Return the description of a table."""

    def __or__(self, others: Mapping[str, Table]) -> dict[str, Table]:
        """Return all tables and others, as of a dict."""
        return {**self, **others}

    def column(self, name: str, column: str) -> Array:
        """Return one column of a table, (n,) or (n, ...)."""
        found: Array = self[name][column]
        return found


def about_of(tables: Mapping[str, Table], name: str) -> Mapping[str, Any]:
    """Return rows, events (`n_events`, `first_event`) and `meta` of a table without reading its columns."""
    return tables.about(name) if isinstance(tables, LazyTables) else describe(tables[name])


def column_of(tables: Mapping[str, Table], name: str, column: str) -> Array:
    """Return one column of a table; of tables in files the others are not read."""
    found: Array = tables.column(name, column) if isinstance(tables, LazyTables) else tables[name][column]
    return found


class JoinedTables(LazyTables):
    """The tables of chunks, see `concatenate`; each is joined when it is first asked for, and kept.

    Parameters
    ----------
    chunks : sequence of mappings of str to Table
    gaps : bool
    meta : mapping
        Added to the description of each table.

    Raises
    ------
    ValueError
        Listing every reason why the chunks cannot be joined.
    """

    def __init__(
        self, chunks: Sequence[Mapping[str, Table]], *, gaps: bool = False, meta: Mapping[str, Any] | None = None
    ) -> None:
        if not chunks:
            raise ValueError("chunks: expected at least one")
        names = list(chunks[0])
        problems = [problem for name in names for problem in _problems(name, chunks, gaps)]
        problems += [
            f"chunk {i}: holds {sorted(chunk)}, expected {sorted(names)}"
            for i, chunk in enumerate(chunks)
            if set(chunk) != set(names)
        ]
        report("the chunks cannot be joined", problems)
        self._meta = dict(meta or {})
        super().__init__(names)
        self._parts = {name: [chunk[name] for chunk in chunks] for name in names}
        # Rows of each table before each chunk.
        self._before = {
            name: np.cumsum([0, *(len(table) for table in parts[:-1])], dtype=np.int64)
            for name, parts in self._parts.items()
        }

    def _made(self, name: str) -> Table:
        parts = self._parts[name]
        joined = parts[0] if len(parts) == 1 else _join(parts, self._before)
        joined = joined.with_meta(**self._meta) if self._meta else joined
        self._parts[name] = [joined]
        return joined

    def about(self, name: str) -> Mapping[str, Any]:
        """Return the description of a table."""
        parts = self._parts[name]
        sums = {"rows": sum(map(len, parts)), "n_events": sum(part.n_events for part in parts)}
        return describe(parts[0]) | sums | {"meta": {**_same_meta(parts), **self._meta}}

    def column(self, name: str, column: str) -> Array:
        """Return one column of a table, (n,) or (n, ...); the others are not joined, unless it is a link."""
        parts = self._parts[name]
        if len(parts) == 1 or any(one.name == column and targets(one) for one in schema_of(parts[0].kind)):
            return super().column(name, column)
        return np.concatenate([part[column] for part in parts])


class StoredTables(LazyTables):
    """The tables of a folder by name; each is read and checked when it is first asked for, and kept.

    Parameters
    ----------
    folder : path

    Attributes
    ----------
    folder : Path
    index : mapping
        Description of each table.

    Raises
    ------
    FileNotFoundError
        If the folder holds no complete set of tables.
    ValueError
        If ``tables.json`` is damaged.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.index = read_index(folder)
        super().__init__(self.index)
        self._files = {name: files_of(name, about) for name, about in self.index.items()}

    def _made(self, name: str) -> Table:
        return self.read(name)

    def read(self, name: str, *, check: bool = True) -> Table:
        """Return a table, if the index describes its parts, and without `check` also if it does not describe it."""
        files = self._files[name]
        return append([self._read(*file, check=check or len(files) > 1) for file in files])

    def problems(self) -> list[str]:
        """Return which files are missing, and which tables the index does not describe completely."""
        files = [file for files in self._files.values() for file, _ in files if not (self.folder / file).is_file()]
        incomplete = [name for name, about in self.index.items() if not about.keys() >= COVER]
        return [f"{file}: missing" for file in files] + [f"{INDEX}: {name}: is incomplete" for name in incomplete]

    def file(self, name: str) -> str:
        """Return the file of a table, or the folder of its parts, relative to the folder of all tables."""
        files = self._files[name]
        return files[0][0] if len(files) == 1 else name

    def about(self, name: str) -> Mapping[str, Any]:
        """Return the description of a table."""
        return self.index[name]

    def column(self, name: str, column: str) -> Array:
        """Return one column of a table, (n,) or (n, ...); the others are not read."""
        if name in self._tables:
            return super().column(name, column)
        parts = []
        for file, about in self._files[name]:
            parts.append(load_columns(self.folder / file, [column])[column])
            if len(parts[-1]) != about["rows"]:
                raise ValueError(f"{self.folder / file}: got {len(parts[-1])} rows, expected {about['rows']}")
        return np.concatenate(parts)

    def parts(self) -> list[StoredPart]:
        """Return the tables of each part; links count rows of the part's own tables."""
        counts = {name: [about["rows"] for _, about in files] for name, files in self._files.items()}
        number = max(map(len, counts.values()), default=0)
        if any(len(rows) != number for rows in counts.values()):
            raise ValueError(f"{self.folder} is damaged: its tables have different numbers of parts")
        return [StoredPart(self, i, {name: sum(rows[:i]) for name, rows in counts.items()}) for i in range(number)]

    def read_part(self, name: str, number: int) -> Table:
        """Return one part of a table; links count rows of the whole tables."""
        return self._read(*self._files[name][number])

    def part_about(self, name: str, number: int) -> Mapping[str, Any]:
        """Return the description of a part of a table."""
        return self._files[name][number][1]

    def _read(self, file: str, about: Mapping[str, Any], *, check: bool = True) -> Table:
        """Return the table of a file, if it is the one that the index describes."""
        table = Table(*load(self.folder / file))
        problems = index_problems(file, table, about) if check else []
        report(f"{self.folder} holds tables of several runs", problems)
        return table


class StoredPart(LazyTables):
    """The tables of one part of a folder by name, each read when it is first asked for, and kept."""

    def __init__(self, whole: StoredTables, number: int, before: Mapping[str, int]) -> None:
        super().__init__(whole)
        self._whole, self._number, self._before = whole, number, before

    def _made(self, name: str) -> Table:
        table = self._whole.read_part(name, self._number)
        return table.with_columns(**moved_links(table, lambda to: -np.int64(self._before.get(to, 0))))

    def about(self, name: str) -> Mapping[str, Any]:
        """Return the description of a table."""
        return self._whole.part_about(name, self._number)


class PartsWriter:
    """Write the tables of consecutive chunks to the parts of an empty folder.

    Parameters
    ----------
    folder : Path
    format : str
        As for `save_tables`.
    gaps : bool
        Whether event numbers may be missing between two chunks.

    Attributes
    ----------
    events : int
        Number of events in the parts that are written.
    size : int
        Bytes of their files.
    """

    def __init__(self, folder: Path, format: str, *, gaps: bool = False) -> None:
        self._folder, self._format, self._gaps = folder, check_format(format), gaps
        self._waiting: list[Mapping[str, Table]] = []
        self._bytes = 0
        self._before: Counter[str] = Counter()
        self._entries: dict[str, dict[str, Any]] = {}
        self.events = self.size = 0

    def add(self, tables: Mapping[str, Table]) -> bool:
        """Take the tables of the next chunk, whose links count its own rows; tell whether a part was written."""
        self._waiting.append(tables)
        self._bytes += sum(column.nbytes for table in tables.values() for column in table.columns.values())
        if self._bytes < PART_BYTES:
            return False
        self._write()
        return True

    def close(self) -> list[Path]:
        """Write the last part and the index; return the files."""
        if self._waiting or not self._entries:
            self._write()
        index = write_index(self._folder, self._entries)
        files = [file for name, about in self._entries.items() for file, _ in files_of(name, about)]
        return [*(self._folder / file for file in files), index]

    def _write(self) -> None:
        joined = concatenate(self._waiting, gaps=self._gaps)
        for name, table in joined.items():
            links = moved_links(table, lambda to: np.int64(self._before[to]))
            table = table.with_columns(**links)
            about = entry(table, FORMATS[self._format].suffix)
            cover = {key: about[key] for key in COVER}
            kept = self._entries.setdefault(name, about | {"n_events": 0, "rows": 0, "parts": []})
            kept["parts"].append(cover)
            kept["n_events"] += cover["n_events"]
            kept["rows"] += cover["rows"]
            path = self._folder / files_of(name, kept)[-1][0]
            path.parent.mkdir(exist_ok=True)
            save(table, path, form=self._format)
            self.size += path.stat().st_size
        self._before.update({name: len(table) for name, table in joined.items()})
        self.events += next(iter(joined.values())).n_events
        self._waiting, self._bytes = [], 0


def load_tables(directory: str | os.PathLike[str]) -> dict[str, Table]:
    """Read what `save_tables` wrote.

    Parameters
    ----------
    directory : path

    Raises
    ------
    FileNotFoundError
        If the directory holds no complete set of tables.
    ValueError
        If a file is damaged or missing, or tables are not those that ``tables.json`` describes.

    Examples
    --------
    >>> from cgemit.tables import load_tables, save_tables
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=2)
    >>> files = save_tables(result.tables, "tables")
    >>> load_tables("tables")["digis"] == result.digis
    True
    """
    return dict(StoredTables(directory))
