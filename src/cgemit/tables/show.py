"""Tables as pandas data frames, awkward arrays, text and HTML."""

from __future__ import annotations

import csv
import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, fields
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.base.files import package
from cgemit.tables.formats import plain_columns
from cgemit.tables.schema import SCHEMAS, Array, Rows


def data_frame(columns: Mapping[str, Sequence[Any] | npt.NDArray[Any]]) -> Any:
    """Return columns of any origin as a `pandas.DataFrame`.

    Raises
    ------
    ImportError
        If pandas is not installed; says which extra installs it.
    """
    return package("pandas").DataFrame(dict(columns))


def columns_of(source: Any) -> dict[str, Array] | None:
    """Return the columns of a table, mapping, data frame or structured array; None for anything else."""
    if isinstance(source, np.ndarray):
        _check_mask(source)
        return {name: source[name] for name in source.dtype.names} if source.dtype.names else None
    if hasattr(source, "column_names"):  # pyarrow
        return {str(name): np.asarray(source[name]) for name in source.column_names}
    if isinstance(source, Mapping) or hasattr(source, "columns"):
        for name in source.keys():  # noqa: SIM118  (tables, data frames)
            _check_mask(source[name], str(name))
        return {str(name): np.asarray(source[name]) for name in source.keys()}  # noqa: SIM118
    return None


def _check_mask(given: Any, name: str = "table") -> None:
    """Raise an error for masked values: what is below a mask is no number."""
    if np.ma.is_masked(given):
        raise ValueError(f"{name}: got masked values, expected numbers in every row")


def to_pandas(table: Rows) -> Any:
    """Return a data frame, one row per row; a matrix column becomes ``name_0_0, name_0_1, ...``."""
    return package("pandas").DataFrame(plain_columns(table.columns))


def to_awkward(table: Rows) -> Any:
    """Return one list of records per event; links stay as they are."""
    awkward = package("awkward")
    records = awkward.zip({name: awkward.from_numpy(column) for name, column in table.columns.items()}, depth_limit=1)
    return awkward.unflatten(records, np.diff(table.offsets))


#: Tables of at most so many rows are shown whole; of longer ones, the first rows.
_MOST_ROWS, _FIRST_ROWS = 20, 5
_WIDTH = 100  # characters of a line


def _rows_shown(table: Rows) -> int:
    return len(table) if len(table) <= _MOST_ROWS else _FIRST_ROWS


def _counts(table: Rows) -> str:
    events = f"{table.n_events} events from {table.first_event}"
    if table.cover["events"] is not None:
        events += f" to {table.events[-1]}, with gaps"
    return f"{table.kind}: {len(table)} rows, {events}"


def _units(kind: str, columns: Iterable[str]) -> dict[str, str]:
    """Return the units of columns; a true value, residual or error has that of what it belongs to."""
    known = {column.name: column.unit for column in SCHEMAS[kind]}
    return {name: known.get(name) or known.get(_OF.sub("", name), "") for name in columns}


_OF = re.compile("^(truth|res|err)_")


def _labels(table: Rows) -> list[str]:
    return [f"{name} [{unit}]" if unit else name for name, unit in _units(table.kind, table.columns).items()]


def text(table: Rows) -> str:
    """Return the sizes, the first rows, as many columns as a line holds, and the names of the others."""
    labels, shown = _labels(table), _rows_shown(table)
    cells = [[_cell(value) for value in column[:shown]] for column in table.columns.values()]
    widths = [max(map(len, [label, *column])) for label, column in zip(labels, cells, strict=True)]
    ends = np.cumsum(widths) + 2 * np.arange(len(widths))
    fit = max(1, int(np.searchsorted(ends, _WIDTH, side="right")))
    lines = [text_table(_counts(table), labels[:fit], list(zip(*cells[:fit], strict=True)))]
    if shown < len(table):
        lines.append(f"... {len(table) - shown} more rows")
    if fit < len(labels):
        more = "more columns: " + ", ".join(labels[fit:])
        lines += textwrap.wrap(more, _WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines)


def row_text(kind: str, row: Mapping[str, Any]) -> str:
    """Return the values of a row of a kind of table, one line for each."""
    units, width = _units(kind, row), max(map(len, row))
    return "\n".join(f"{name:{width}}  {_cell(value)} {units[name]}".rstrip() for name, value in row.items())


def html(table: Rows) -> str:
    """Return the sizes and the first rows."""
    shown = _rows_shown(table)
    head = "".join(
        f"<th>{escape(name)}<br><small>{escape(unit)}</small></th>"
        for name, unit in _units(table.kind, table.columns).items()
    )
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(_cell(column[row]))}</td>" for column in table.columns.values()) + "</tr>"
        for row in range(shown)
    )
    more = f"<p>... {len(table) - shown} more rows</p>" if shown < len(table) else ""
    return f"<p><b>{escape(_counts(table))}</b></p><table><tr>{head}</tr>{body}</table>{more}"


def _cell(value: np.generic) -> str:
    if np.ndim(value):
        return "x".join(map(str, np.shape(value))) + " matrix"
    return f"{value:.6g}" if isinstance(value, np.floating) else str(value)


class Comparable:
    """Equality of frozen dataclasses of plain values in which NaN equals NaN."""

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> str:
        fields: tuple[Any, ...] = astuple(self)  # type: ignore[call-overload]
        return repr(fields)  # a float's repr is exact


class Tabular:
    """A result that is a table of numbers."""

    def columns(self) -> Mapping[str, Sequence[Any]]:
        """Return the numbers as columns; of a dataclass of numbers, one row."""
        return {f.name: [getattr(self, f.name)] for f in fields(self)}  # type: ignore[arg-type]

    def to_pandas(self) -> Any:
        """Return the numbers as a `pandas.DataFrame`."""
        return data_frame(self.columns())


class Shown:
    """A result that is printed as a table, in a notebook as HTML."""

    def _table(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]]]:
        """Return title, head and rows of cells."""
        raise NotImplementedError

    def note(self) -> str:
        """Return the line below the table, if there is one."""
        return ""

    def __repr__(self) -> str:
        return "\n".join([text_table(*self._table()), *filter(None, [self.note()])])

    def _repr_html_(self) -> str:
        note = f"<p>{escape(self.note())}</p>" if self.note() else ""
        return html_table(*self._table()) + note


def with_error(value: float, error: float) -> str:
    """Return ``value ± error`` with two digits of the error."""
    if not math.isfinite(value):
        return "-"
    if not math.isfinite(error) or error <= 0:
        return f"{value:.4g}"
    digits = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def html_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a title and a table of cells, text to the left and numbers to the right."""
    left = [_is_text(column) for column in zip(*rows, strict=True)] or [True] * len(head)
    align = [f'style="text-align:{"left" if to_left else "right"}"' for to_left in left]
    top = "".join(f"<th {how}>{escape(cell)}</th>" for cell, how in zip(head, align, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td {how}>{escape(cell)}</td>" for cell, how in zip(row, align, strict=True)) + "</tr>"
        for row in rows
    )
    return f"<p><b>{escape(title)}</b></p><table><tr>{top}</tr>{body}</table>"


def text_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a title and a table of aligned columns, text to the left and numbers to the right."""
    left = [_is_text(column) for column in zip(*rows, strict=True)] or [True] * len(head)
    cells = [list(head), *(list(row) for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = [
        "  ".join(
            cell.ljust(width) if to_left else cell.rjust(width)
            for cell, width, to_left in zip(row, widths, left, strict=True)
        ).rstrip()
        for row in cells
    ]
    return "\n".join([title, *lines])


# A number with its error, a share, a range, or what stands for none.
_NUMBER = re.compile(r"[-+]?[\d.,]+(e[-+]?\d+)?( ± [\d.]+)?( %)?|\d+/\d+|[-+\d.]+ to [-+\d.]+|-|nan|none")


def _is_text(column: Sequence[str]) -> bool:
    """Tell whether a column holds text; "none" and "-" stand for no number."""
    return not all(_NUMBER.fullmatch(cell) for cell in column) or all(cell == "none" for cell in column)


def shown(text: str) -> str:
    """Return a unit, or a text with units, as figures and reports write it: with "µm" for "um", "µrad" for "urad"."""
    return re.sub(r"\bu(m|rad)\b", r"µ\1", text)


def write_csv(path: Path, columns: Mapping[str, Sequence[Any] | npt.NDArray[Any]], digits: int = 7) -> None:
    """Write columns under headers that carry the unit, such as ``sigma_p (MeV/c)``; 17 digits are exact."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow(f"{value:.{digits}g}" if isinstance(value, float) else value for value in row)
