"""Comparison, printing and CSV files of results."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import astuple, fields
from html import escape
from pathlib import Path
from typing import Any

import numpy.typing as npt

from cgemit.tables.convert import data_frame


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
    """Return a unit, or a text with units, as figures and reports write it: with "µm" for "um"."""
    return re.sub(r"\bum\b", "µm", text)


def write_csv(path: Path, columns: Mapping[str, Sequence[Any] | npt.NDArray[Any]]) -> None:
    """Write columns under headers that carry the unit, such as ``sigma_p (MeV/c)``."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow(f"{value:.7g}" if isinstance(value, float) else value for value in row)
