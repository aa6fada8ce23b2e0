"""The table: read-only numpy columns, event offsets, and links to rows of other tables."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, KeysView, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.base.errors import did_you_mean, report
from cgemit.tables import formats, show
from cgemit.tables.schema import SCHEMAS, Array, Column, Rows, check_columns, event_range, schema_of

Origins = npt.NDArray[np.int64] | np.int64


def targets(column: Column) -> tuple[str, ...]:
    """Return the tables that a column links to: none, one, or one for each view."""
    return (column.links,) if isinstance(column.links, str) else column.links or ()


def linked(kind: str) -> set[str]:
    """Return the tables that a kind of table links to."""
    return {target for column in SCHEMAS[kind] for target in targets(column)}


def lost_links(table: Rows, tables: Collection[str]) -> list[str]:
    """Return the tables that rows of a table link to and that are missing; links that are all -1 do not count."""
    lost = set()
    for column in SCHEMAS[table.kind]:
        names = targets(column)
        if names and any(name not in tables for name in names):
            rows, view = table.columns[column.name], table.columns.get("view", np.zeros(len(table), np.int8))
            linked_here = rows >= 0
            lost |= {
                name
                for i, name in enumerate(names)
                if name not in tables and np.any(linked_here & ((view == i) if len(names) > 1 else True))
            }
    return sorted(lost)


def without_links(table: Rows, tables: Collection[str]) -> dict[str, Array]:
    """Return the link columns that count rows of tables that are not kept, with -1 in their place."""
    links = {}
    for column in SCHEMAS[table.kind]:
        gone = [i for i, name in enumerate(targets(column)) if name not in tables]
        if gone:
            rows = table.columns[column.name]
            several = len(targets(column)) > 1
            links[column.name] = np.where(np.isin(table.columns["view"], gone), -1, rows) if several else rows * 0 - 1
    return links


def moved_links(table: Rows, moved: Callable[[str], Origins]) -> dict[str, Array]:
    """Return the link columns of a table with another origin of the rows they count; -1 stays -1.

    Parameters
    ----------
    table : Table
    moved : callable
        Returns what is added to links to a table of a name: a number, or (n,) int64, one for each row.
    """
    links = {}
    for column in SCHEMAS[table.kind]:
        names = targets(column)
        if not names:
            continue
        rows: Array = table.columns[column.name]
        shift: Origins = moved(names[0])
        if len(names) > 1:
            shifts = np.stack([np.broadcast_to(moved(name), len(rows)) for name in names])
            shift = shifts[table.columns["view"], np.arange(len(rows))]
        links[column.name] = np.where(rows < 0, rows, rows + shift)
    return links


def local_links(table: Rows, tables: Mapping[str, Rows]) -> dict[str, Array]:
    """Return the link columns of a table, counting rows within the event.

    Parameters
    ----------
    table : Table
    tables : mapping of str to Table
        All tables that it links to, of the same events.

    Raises
    ------
    ValueError
        Listing every table that is missing or of other events.
    """
    names = linked(table.kind)
    problems = [f"{name}: missing; {table.kind} links to it" for name in lost_links(table, tables)]
    problems += [
        f"{name}: covers other events than {table.kind}; expected the same"
        for name in sorted(names & tables.keys())
        if not np.array_equal(tables[name].events, table.events)
    ]
    report("tables", problems)
    place = np.repeat(np.arange(table.n_events), np.diff(table.offsets))  # of each row's event
    return moved_links(table, lambda name: -tables[name].offsets[place] if name in tables else np.int64(0))


class Row(dict[str, Any]):
    """One row of a table: its values by column, printed one a line with their units.

    Parameters
    ----------
    kind : str
        Of the table.
    values : mapping of str to value

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=2)
    >>> result.particles[1]
    event     1
    particle  0
    pdg       13
    charge    -1 e
    mass      0.105658 GeV/c2
    x         0 mm
    y         0 mm
    z         0 mm
    px        0.997649 GeV/c
    py        -0.0685292 GeV/c
    pz        0 GeV/c
    status    0
    """

    def __init__(self, kind: str, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.kind = kind

    def __repr__(self) -> str:
        return show.row_text(self.kind, self)


class Table:
    """Rows of one kind as numpy columns, sorted by event.

    Parameters
    ----------
    kind : str
        A name of `SCHEMAS`.
    columns : mapping of str to array_like
        The columns of the schema, each (n,) or (n, ...), in the schema's dtype or one that fits into it without
        loss; more columns may follow. Arrays are not copied where they fit already.
    n_events : int
        Number of events the table covers, with and without rows.
    first_event : int
        Number of the first event; rows belong to ``first_event ... first_event + n_events - 1``.
    meta : mapping or None
        Values for JSON that belong into every file, such as the configuration hash and the seed.
    events : array_like or None
        Numbers of the events covered, (n_events,) int64, strictly increasing, where they have gaps; `first_event` is
        not used then.

    Attributes
    ----------
    columns : mapping of str to ndarray
        Read-only, C-contiguous.
    offsets : ndarray, (n_events + 1,) int64
        Rows ``offsets[i]`` to ``offsets[i + 1]`` belong to event ``events[i]``.

    Raises
    ------
    ValueError
        Listing every problem of the columns.

    Examples
    --------
    >>> clusters = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5).clusters
    >>> x = clusters[clusters["view"] == 0]
    >>> len(x), x["layer"][:3].tolist(), int(x[1]["layer"]), len(x.head())
    (15, [0, 1, 2], 1, 5)
    """

    __slots__ = ("_gaps", "columns", "first_event", "kind", "meta", "n_events", "offsets")

    kind: str
    columns: Mapping[str, Array]
    n_events: int
    first_event: int
    offsets: np.ndarray[tuple[int], np.dtype[np.int64]]
    meta: Mapping[str, Any]
    _gaps: Array | None  # numbers of the events, where they do not follow each other

    def __init__(
        self,
        kind: str,
        columns: Mapping[str, npt.ArrayLike],
        n_events: int,
        first_event: int = 0,
        meta: Mapping[str, Any] | None = None,
        events: npt.ArrayLike | None = None,
    ) -> None:
        first_event, gaps = event_range(n_events, first_event, events)
        checked, offsets = check_columns(kind, columns, n_events, first_event, gaps)
        values = (kind, MappingProxyType(checked), int(n_events), first_event, offsets, dict(meta or {}), gaps)
        names = ("kind", "columns", "n_events", "first_event", "offsets", "meta", "_gaps")
        for name, value in zip(names, values, strict=True):
            object.__setattr__(self, name, value)

    @classmethod
    def empty(cls, kind: str, n_events: int = 0, first_event: int = 0, events: npt.ArrayLike | None = None) -> Table:
        """Return a table without rows."""
        columns = {column.name: np.empty((0, *column.shape), column.dtype) for column in schema_of(kind)}
        return cls(kind, columns, n_events, first_event, events=events)

    @property
    def events(self) -> Array:
        """Numbers of the events covered, (n_events,) int64, increasing."""
        if self._gaps is not None:
            return self._gaps
        return np.arange(self.first_event, self.first_event + self.n_events, dtype=np.int64)

    @property
    def cover(self) -> dict[str, Any]:
        """Arguments of `Table` that say which events it covers, for tables of the same ones."""
        return {"n_events": self.n_events, "first_event": self.first_event, "events": self._gaps}

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a table does not change; with_columns() makes a new one (tried to set {name!r})")

    def __len__(self) -> int:
        return len(self.columns["event"])

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __iter__(self) -> Any:
        return iter(self.columns)

    def __array__(self, *_: object, **__: object) -> Array:
        """Refuse: numpy and pandas, and by `__dlpack__` awkward, would take the names of the columns for rows."""
        raise TypeError(f"{self.kind}: got a table; expected to_pandas(), to_awkward(), or a column such as ['event']")

    __dlpack__ = __dlpack_device__ = __array__

    def keys(self) -> KeysView[str]:
        """Return the names of the columns."""
        return self.columns.keys()

    def __getitem__(self, key: str | slice | npt.ArrayLike) -> Any:
        """Return a column by name, a `Row` by number, or the table of the rows picked by a mask, a slice or numbers.

        Links of other tables count rows of the unpicked table, and links between its own rows are not changed.

        Raises
        ------
        KeyError
            If there is no such column.
        IndexError
            If a mask or a row number does not fit.
        ValueError
            If the picked rows are no longer sorted by event.
        """
        if isinstance(key, str):
            if key not in self.columns:
                raise KeyError(f"{self.kind} has no column {key!r}{did_you_mean(key, self.columns, '; ')}")
            return self.columns[key]
        rows = key if isinstance(key, slice) else np.asarray(key)
        if not isinstance(rows, slice) and rows.ndim == 0 and rows.dtype.kind in "iu":
            return Row(self.kind, {name: column[rows] for name, column in self.columns.items()})
        if not isinstance(rows, slice) and rows.ndim != 1:
            raise IndexError(f"rows are picked by a slice, a mask or an array of row numbers, not by {key!r}")
        if not isinstance(rows, slice) and rows.size == 0 and rows.dtype.kind == "f":
            rows = rows.astype(np.int64)  # numpy makes an empty list one of floats
        picked = {name: column[rows] for name, column in self.columns.items()}
        return self._like(picked)

    def head(self, n: int = 5) -> Table:
        """Return the first `n` rows."""
        return self[:n]  # type: ignore[no-any-return]

    def select_events(self, first: int, stop: int) -> Table:
        """Return the rows of the events ``first ... stop - 1`` as a table that covers just these events.

        Links still count rows of the whole tables; `cgemit.tables.select_events` and `Result.select_events` change
        them for all tables of a run.

        Parameters
        ----------
        first, stop : int

        Raises
        ------
        IndexError
            If the table does not cover them.
        """
        gaps = self._gaps
        last = self.first_event + self.n_events if gaps is None else int(gaps[-1]) + 1
        if not self.first_event <= first <= stop <= last:
            raise IndexError(f"events {first} to {stop} are not within {self.first_event} to {last}")
        if gaps is None:
            begin, end = first - self.first_event, stop - self.first_event
        else:
            begin, end = map(int, np.searchsorted(gaps, [first, stop]))
        rows = slice(*self.offsets[[begin, end]])
        picked = {name: column[rows] for name, column in self.columns.items()}
        return Table(self.kind, picked, end - begin, first, self.meta, None if gaps is None else gaps[begin:end])

    def with_columns(self, **arrays: npt.ArrayLike) -> Table:
        """Return the same rows with columns added or replaced."""
        return self._like({**self.columns, **arrays})

    def with_meta(self, **meta: Any) -> Table:
        """Return the same rows with `meta` added to."""
        same = object.__new__(Table)
        for name in self.__slots__:
            object.__setattr__(same, name, getattr(self, name))
        object.__setattr__(same, "meta", {**self.meta, **meta})
        return same

    def _like(self, columns: Mapping[str, npt.ArrayLike]) -> Table:
        """Return other columns of the same events and origin."""
        return Table(self.kind, columns, meta=self.meta, **self.cover)

    def __eq__(self, other: object) -> bool:
        """Compare events and columns, NaN equal to NaN; their origin (`meta`) does not count."""
        if not isinstance(other, Table):
            return NotImplemented
        if (self.kind, list(self.columns)) != (other.kind, list(other.columns)):
            return False
        return self.covers_as(other) and all(
            column.dtype == other.columns[name].dtype
            and np.array_equal(column, other.columns[name], equal_nan=column.dtype.kind == "f")
            for name, column in self.columns.items()
        )

    def covers_as(self, other: Table) -> bool:
        """Tell whether another table covers the same events."""
        same = (self.n_events, self.first_event) == (other.n_events, other.first_event)
        mine, theirs = self._gaps, other._gaps
        return same and (mine is theirs or (mine is not None and theirs is not None and np.array_equal(mine, theirs)))

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        return Table, (self.kind, dict(self.columns), self.n_events, self.first_event, self.meta, self._gaps)

    def __repr__(self) -> str:
        return show.text(self)

    def _repr_html_(self) -> str:
        return show.html(self)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.columns)

    def to_pandas(self) -> Any:
        """Return a pandas data frame, one row per row; a matrix column becomes ``name_0_0, name_0_1, ...``."""
        return show.to_pandas(self)

    def to_awkward(self, tables: Mapping[str, Table] | None = None) -> Any:
        """Return an awkward array with one list of records per event.

        Parameters
        ----------
        tables : mapping of str to Table, optional
            All tables of the run (`Result.tables`). With them, links count rows of the linked table within the event,
            as lists per event need it; without them, rows of the whole table, as in the columns.

        Raises
        ------
        ValueError
            If `tables` lacks a table that is linked to, or holds it for other events.
        """
        return show.to_awkward(self if tables is None else self.with_columns(**local_links(self, tables)))

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the table to a file that `Table.load` reads: the columns and a JSON text.

        A name that ends in ``.parquet`` (needs pyarrow) or ``.root`` (a TTree; needs uproot) gives a file of that
        kind, any other an `.npz` file, which holds the offsets, too. The file is complete or absent. The text holds
        version, units, event range, `meta` and checksums.

        Raises
        ------
        FileExistsError
            If `path` exists and `overwrite` is false.
        ValueError
            If the format needs a package that is not installed, or cannot hold a column.
        """
        formats.save(self, path, overwrite=overwrite)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Table:
        """Read what `save` wrote.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If it is damaged or holds something else.
        """
        return cls(*formats.load(path))


def stacked(table: Rows, more: Mapping[str, npt.ArrayLike]) -> dict[str, Array]:
    """Return the columns of a table with further rows; columns that these do not have are NaN, -1 or empty there.

    Parameters
    ----------
    table : Table
    more : mapping of str to array_like
        Columns of the further rows, each (n,): those of the schema, and perhaps others.
    """
    n, columns = len(np.asarray(more["event"])), {}
    for name, column in table.columns.items():
        if name in more:
            added = np.asarray(more[name]).astype(column.dtype)
        else:
            blank = {"f": np.nan, "c": np.nan, "i": -1}.get(column.dtype.kind, 0)
            added = np.full((n, *column.shape[1:]), blank).astype(column.dtype)
        columns[name] = np.concatenate([column, added])
    return columns


def what(given: object) -> str:
    """Return a short description of a value given for a table, for messages."""
    return f"a table of kind {given.kind!r}" if isinstance(given, Table) else type(given).__name__


def kind_problems(**tables: object) -> list[str]:
    """Return which of some tables are not of the kind that they are named after."""
    return [
        f"{name}: got {what(table)}, expected a table of kind {name!r}"
        for name, table in tables.items()
        if not isinstance(table, Table) or table.kind != name
    ]


def merged(parts: Sequence[Table]) -> Table:
    """Return the rows of tables of the same events by event and layer, those of one layer in their order.

    Links among rows of a part follow. A column that a part does not have is 0 there.

    Parameters
    ----------
    parts : sequence of Table
        Of one kind; no layer is in two of them.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    models = {name: column for part in reversed(parts) for name, column in part.columns.items()}

    def values(part: Table, name: str) -> Array:
        return part[name] if name in part else np.zeros(len(part), models[name].dtype)

    columns = {name: np.concatenate([values(part, name) for part in parts]) for name in models}
    order = np.lexsort((columns["layer"], columns["event"]))
    row = np.empty(len(order) + 1, np.int64)  # of each row in the result; the last is that of a link to none
    row[order], row[-1] = np.arange(len(order)), -1
    begins = np.repeat(np.cumsum([0, *map(len, parts[:-1])]), [len(part) for part in parts])
    for column in SCHEMAS[first.kind]:
        if column.links == first.kind and column.name in columns:
            link = columns[column.name]
            columns[column.name] = row[np.where(link < 0, -1, link + begins)].astype(link.dtype)
    meta = {name: value for part in reversed(parts) for name, value in part.meta.items()}
    return Table(first.kind, {name: one[order] for name, one in columns.items()}, meta=meta, **first.cover)


def made_by(maker: str, kind: str, table: object, source: Table) -> Table:
    """Return a table that a part from outside the package may have made of another one.

    Parameters
    ----------
    maker : str
        For messages, such as ``"readout tiger"``.
    kind : str
    table : object
        What it returned.
    source : Table

    Raises
    ------
    TypeError, ValueError
        If it is not a table of this kind, of the same events.
    """
    problems = kind_problems(**{kind: table})
    if problems or not isinstance(table, Table):
        raise TypeError(f"{maker}: {problems[0]}")
    if not table.covers_as(source):
        raise ValueError(f"{maker}: {kind}: cover other events than {source.kind}; expected the same")
    return table
