"""What a study hands on: numbers beside the paper's, and lines; the entries of `summary.json`."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class PaperValue:
    """A quantity of the paper.

    Attributes
    ----------
    title, unit : str
    statistic : str
        How the paper got its number, or that it gives none.
    value : float or None
        As published.
    """

    title: str
    unit: str
    statistic: str
    value: float | None = None


@cache
def paper_values() -> Mapping[str, PaperValue]:
    """Return the quantities of arXiv:1504.02570 by result id (`data/paper_values.toml`)."""
    text = resources.files("cgemit.data").joinpath("paper_values.toml").read_text(encoding="utf-8")
    return {name: PaperValue(**entry) for name, entry in tomllib.loads(text).items()}


@dataclass(frozen=True)
class Row:
    """One number of the study beside the paper's.

    Attributes
    ----------
    id, detector, unit : str
    value, error : float
        In `unit`; the error is statistical, one standard deviation.
    paper : float or None
        Published number, where there is one.
    note : str
        What the number is, and why it differs.
    """

    id: str
    detector: str
    value: float
    error: float
    unit: str
    paper: float | None
    note: str

    @property
    def title(self) -> str:
        """What people call it."""
        return paper_values()[self.id].title

    def as_json(self) -> dict[str, Any]:
        """Return the row as `summary.json` has it."""
        return {
            "id": self.id, "detector": self.detector, "value": self.value, "error": self.error, "unit": self.unit,
            "paper": self.paper, "note": self.note,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Line:
    """A quantity against another for one detector.

    Attributes
    ----------
    id, detector : str
    x, y, y_error : (n,) float64
        In `x_unit`, `y_unit`; the error is statistical.
    x_unit, y_unit : str
    """

    id: str
    detector: str
    x: npt.NDArray[np.float64]
    x_unit: str
    y: npt.NDArray[np.float64]
    y_error: npt.NDArray[np.float64]
    y_unit: str

    def __eq__(self, other: object) -> bool:
        """Compare all values; NaN equals NaN."""
        return isinstance(other, Line) and self.as_json() == other.as_json()

    def __hash__(self) -> int:
        return hash((self.id, self.detector))

    def as_json(self) -> dict[str, Any]:
        """Return the line as `summary.json` has it."""
        return {
            "id": self.id, "detector": self.detector, "x": _numbers(self.x), "x_unit": self.x_unit,
            "y": _numbers(self.y), "y_error": _numbers(self.y_error), "y_unit": self.y_unit,
        }  # fmt: skip


def shown(unit: str) -> str:
    """Return a unit as figures and reports write it."""
    return unit.replace("um", "µm")


def write_csv(path: Path, columns: Mapping[str, Sequence[Any] | npt.NDArray[Any]]) -> None:
    """Write columns under headers that carry the unit, such as ``sigma_p (MeV/c)``."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow(f"{value:.7g}" if isinstance(value, float) else value for value in row)


def _numbers(values: npt.NDArray[np.float64]) -> list[float | None]:
    """Return numbers that JSON can hold: what is not finite becomes null."""
    return [float(value) if np.isfinite(value) else None for value in values]
