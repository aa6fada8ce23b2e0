"""Files of results: rows of a dataclass as CSV, after lines that say what was run."""

from __future__ import annotations

import csv
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

import cgemit as cg

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "validation" / "results"
IMAGES = ROOT / "docs" / "images"
PAGE = ROOT / "docs" / "validation.md"

Row = TypeVar("Row", bound="DataclassInstance")


def versions() -> str:
    """Return what the numbers are made with."""
    return f"cgemit {cg.__version__}, Python {platform.python_version()}, numpy {np.__version__}"


def write_rows(
    path: Path, rows: Sequence[DataclassInstance], about: Mapping[str, str], derived: Sequence[str] = ()
) -> None:
    """Write rows of one dataclass, with what was run (`about`) and properties (`derived`) as further columns."""
    names = [*(field.name for field in fields(rows[0])), *derived]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        file.writelines(f"# {name}: {text}\n" for name, text in about.items())
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_cell(getattr(row, name)) for name in names] for row in rows)


def _cell(value: object) -> str:
    if value is None or value == math.inf:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)


def read_rows(path: Path, kind: type[Row]) -> tuple[list[Row], dict[str, str]]:
    """Return the rows of a file, and what was run; columns that are no fields of `kind` are skipped."""
    lines = path.read_text(encoding="utf-8").splitlines()
    about = dict(line.removeprefix("# ").split(": ", 1) for line in lines if line.startswith("#"))
    table = csv.DictReader(line for line in lines if not line.startswith("#"))
    return [kind(**{f.name: _value(row[f.name], str(f.type)) for f in fields(kind)}) for row in table], about


def _value(text: str, kind: str) -> Any:
    if kind == "bool":
        return text == "yes"
    if kind == "str":
        return text
    return float(text) if text else None


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a table as Markdown, with empty lines around it; a cell with "|" is several."""
    columns = sum(cell.count("|") + 1 for cell in head)
    rows = [f"| {' | '.join(row)} |" for row in (head, *lines)]
    return "\n".join(["", rows[0], "|---" * columns + "|", *rows[1:], ""])
