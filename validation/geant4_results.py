"""The file of results: every number of cgemit beside every number of Geant4, as CSV."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path

from geant4_reference import Comparison

RESULTS = Path(__file__).resolve().parent / "results" / "geant4.csv"

_COLUMNS = ("slab", "p", "quantity", "model", "screening", "value", "error", "reference", "reference_error", "gated")


def write_results(path: Path, rows: Sequence[Comparison], about: Mapping[str, str]) -> None:
    """Write the comparisons, after lines that say what was run (`about`)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        file.writelines(f"# {name}: {text}\n" for name, text in about.items())
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*_COLUMNS, "ratio", "ratio_error", "allowed"])
        for row in rows:
            cells = [_cell(getattr(row, name)) for name in _COLUMNS]
            allowed = f"{row.allowed:.4f}" if row.gated else ""
            writer.writerow([*cells, f"{row.ratio:.4f}", f"{row.ratio_error:.4f}", allowed])


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return "" if value is None else str(value)


def read_results(path: Path = RESULTS) -> tuple[list[Comparison], dict[str, str]]:
    """Return the comparisons of a file, and what was run."""
    lines = path.read_text(encoding="utf-8").splitlines()
    about = dict(line.removeprefix("# ").split(": ", 1) for line in lines if line.startswith("#"))
    return [_row(row) for row in csv.DictReader(line for line in lines if not line.startswith("#"))], about


def _row(row: Mapping[str, str]) -> Comparison:
    numbers = {name: float(row[name]) for name in ("p", "value", "error", "reference")}
    texts = {name: row[name] for name in ("slab", "quantity", "model", "screening")}
    error = float(row["reference_error"]) if row["reference_error"] else None
    assert len(numbers) + len(texts) + 2 == len(fields(Comparison))
    return Comparison(**texts, **numbers, reference_error=error, gated=row["gated"] == "yes")
