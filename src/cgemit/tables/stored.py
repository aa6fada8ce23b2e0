"""Tables in a folder that are read when they are asked for: as a whole, part by part, or some columns."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.tables.check import Array
from cgemit.tables.files import COVER, INDEX, entry, files_of, index_problems, read_index, write_index
from cgemit.tables.formats import FORMATS, check_format, describe, load, load_columns, save
from cgemit.tables.join import append, concatenate
from cgemit.tables.links import moved_links
from cgemit.tables.table import Table

#: A part is closed when the columns of its tables reach this many bytes.
PART_BYTES = 2**25


#: What the index says about each part of a table.
_OF_PART = ("n_events", "first_event", "rows", "events", "crc32")


class LazyTables(Mapping[str, Table]):
    """Tables that are read when they are asked for."""

    def about(self, name: str) -> Mapping[str, Any]:
        """Return the description of a table."""
        raise NotImplementedError

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
        self._files = {name: files_of(name, about) for name, about in self.index.items()}
        self._tables: dict[str, Table] = {}

    def __getitem__(self, name: str) -> Table:
        if name not in self._tables:
            self._tables[name] = self.read(name)
        return self._tables[name]

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

    def __iter__(self) -> Iterator[str]:
        return iter(self.index)

    def __len__(self) -> int:
        return len(self.index)

    def __contains__(self, name: object) -> bool:
        return name in self.index

    def about(self, name: str) -> Mapping[str, Any]:
        """Return the description of a table."""
        return self.index[name]

    def column(self, name: str, column: str) -> Array:
        """Return one column of a table, (n,) or (n, ...); the others are not read."""
        if name in self._tables:
            return super().column(name, column)
        files = self._files[name]
        return np.concatenate([load_columns(self.folder / file, [column], about)[column] for file, about in files])

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
        table = Table(*load(self.folder / file, about))
        problems = index_problems(file, table, about) if check else []
        if problems:
            raise ValueError(f"{self.folder} holds tables of several runs:\n  " + "\n  ".join(problems))
        return table


class StoredPart(LazyTables):
    """The tables of one part of a folder by name, each read when it is first asked for, and kept."""

    def __init__(self, whole: StoredTables, number: int, before: Mapping[str, int]) -> None:
        self._whole, self._number, self._before = whole, number, before
        self._tables: dict[str, Table] = {}

    def __getitem__(self, name: str) -> Table:
        if name not in self._tables:
            table = self._whole.read_part(name, self._number)
            links = moved_links(table, lambda to: -np.int64(self._before.get(to, 0)))
            self._tables[name] = table.with_columns(**links)
        return self._tables[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._whole)

    def __len__(self) -> int:
        return len(self._whole)

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
        suffix = FORMATS[self._format]
        for name, table in joined.items():
            links = moved_links(table, lambda to: np.int64(self._before[to]))
            table = table.with_columns(**links)
            about = entry(table, suffix)
            cover = {key: about.pop(key) for key in _OF_PART if key in about}
            if suffix != ".csv":  # other files hold them themselves
                cover = {key: cover[key] for key in _OF_PART[:3]}
            kept = self._entries.setdefault(name, about | cover | {"n_events": 0, "rows": 0, "parts": []})
            for key in _OF_PART[3:]:
                kept.pop(key, None)
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
    """
    return dict(StoredTables(directory))
