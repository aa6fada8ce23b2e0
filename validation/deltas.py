"""Displacement of delta electrons in a drift gap beside Geant4: ``python validation/deltas.py`` (seconds).

Writes validation/results/deltas.csv and the picture; `geant4.py` then has the section of docs/validation.md.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

import cgemit as cg
from cgemit import _core
from cgemit.detector import compiled
from cgemit.draw.style import COLORS, Picture, grid, new_picture, style
from geant4_reference import read

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "validation" / "results" / "deltas.csv"
PICTURE = "validation-deltas.png"

DETECTOR, LAYER, MUON, P = "besiii-cgem", 0, 0.1056583755, 1.0
N, SEED = 1_000_000, 1
GATED_CUT = "1 um"  # everything that can come out of the solids is followed
TOLERANCE = 0.20
_EVENTS = 100_000  # of the reference; not recorded
_DISTANCES = (0.2, 0.5, 1.0, 2.0, 5.0)  # mm
_CHUNK = 100_000
_ORIGINS = {"cathode": 1, "behind": 2}
_CUTS = {"1 um": ("-", COLORS["data"]), "30 um": ("--", COLORS["x"]), "0.7 mm": (":", COLORS["single"])}

_SECTION = """
## Delta electrons

Per cent of muons of 1 GeV/c, at normal incidence, with an electron in the 5 mm drift gap displaced from the track by
more than a distance; {n:,} crossings of the first layer of `{detector}` in 1 T. Geant4 followed electrons that reach
farther than its range cut; cgemit follows everything that can come out of the solids, which is the row of 1 um.
**These have to agree within 20 % or three standard errors** (100 000 muons assumed for Geant4).

![Fraction of muons with a delta electron beyond a distance](images/validation-deltas.png)

| view | origin | more than, mm | cgemit, % | Geant4, % | ratio |
|---|---|---|---|---|---|
"""


@dataclass(frozen=True)
class Fraction:
    """Per cent of muons with an electron beyond a distance (mm), beside Geant4's with one range cut."""

    cut: str
    view: str
    origin: str
    distance: float
    percent: float
    error: float
    reference: float

    @property
    def ratio(self) -> float:
        """Number of cgemit over that of Geant4."""
        return self.percent / self.reference

    @property
    def agrees(self) -> bool:
        """Whether the ratio is near enough to 1."""
        error = np.hypot(self.error, np.sqrt(self.reference * (100 - self.reference) / _EVENTS))
        return bool(abs(self.percent - self.reference) <= max(TOLERANCE * self.reference, 3 * error))


def measure(n: int = N, seed: int = SEED, detector: str = DETECTOR) -> list[Fraction]:
    """Return the fractions of every row of the reference."""
    core = compiled(cg.load(detector))
    beyond: dict[tuple[str, str], Any] = {}
    for chunk, first in enumerate(range(0, n, _CHUNK)):
        count = min(_CHUNK, n - first)
        columns = _core.ionize(
            core, LAYER, p=P, mass=MUON, n=count, seed=seed + chunk, deltas=True, keep_clusters=False
        )
        for key, found in _count(columns, count).items():
            beyond[key] = beyond.get(key, 0) + found
    rows = []
    for row in read("deltas.csv"):
        for distance, number in zip(_DISTANCES, beyond[row["view"], row["origin"]], strict=True):
            fraction = number / n
            error = np.sqrt(max(fraction, 1 / n) * (1 - fraction) / n)
            reference = float(row[f"mm_{distance:g}"])
            key = (row["cut"], row["view"], row["origin"], distance)
            rows.append(Fraction(*key, float(100 * fraction), float(100 * error), reference))
    return rows


def _count(columns: Mapping[str, Any], n: int) -> dict[tuple[str, str], Any]:
    """Return how many of n muons have an electron beyond each distance, by view and origin.

    The tracks go along the x axis: y is the displacement in r-phi, z that along the beam.
    """
    found = {}
    delta = columns["deposit_delta"] > 0
    for view, axis in (("r-phi", "y"), ("z", "z")):
        ends = np.abs(columns[f"deposit_{axis}"]) + 0.5 * np.abs(columns[f"deposit_d{axis}"])
        for origin in ("all", *_ORIGINS):
            wanted = delta & (True if origin == "all" else columns["deposit_origin"] == _ORIGINS[origin])
            farthest = np.zeros(n)
            np.maximum.at(farthest, columns["deposit_crossing"][wanted], ends[wanted])
            found[view, origin] = np.array([np.sum(farthest > distance) for distance in _DISTANCES])
    return found


def draw(rows: Sequence[Fraction]) -> Picture:
    """Draw the fractions against the distance, with Geant4's range cuts."""
    panels = [("r-phi", "all"), ("z", "all"), ("r-phi", "cathode"), ("r-phi", "behind")]
    with style():
        picture, axes = new_picture(1, 4, (15.0, 4.4))
        for plot, (view, origin) in zip(axes, panels, strict=True):
            for cut, (dashes, colour) in _CUTS.items():
                found = [r for r in rows if (r.cut, r.view, r.origin) == (cut, view, origin)]
                x = [r.distance for r in found]
                plot.plot(x, [r.reference for r in found], dashes, color=colour, label=f"Geant4, cut {cut}")
                if cut == GATED_CUT:
                    low, high = ([(1 + sign * TOLERANCE) * r.reference for r in found] for sign in (-1, 1))
                    plot.fill_between(x, low, high, color=COLORS["matter"], alpha=0.6, lw=0)
                    values, errors = [r.percent for r in found], [r.error for r in found]
                    plot.errorbar(x, values, errors, fmt="o", color=COLORS["fit"], ms=5, label="cgemit")
            what = "all" if origin == "all" else f"from {'the cathode' if origin == 'cathode' else 'behind'}"
            plot.set(title=f"{view}, {what}", xlabel="displaced by more than  (mm)", xscale="log", yscale="log")
            plot.set(ylim=(0.15, 5))
            grid(plot)
        axes[0].set_ylabel("muons  (%)")
        axes[0].legend(loc="lower left")
        picture.subplots_adjust(left=0.05, right=0.99, top=0.92, bottom=0.13, wspace=0.2)
    return picture


def section(path: Path = RESULTS) -> str:
    """Return the section of the page from the file of results; nothing if there is no such file."""
    if not path.exists():
        return ""
    rows = [_row(row) for row in csv.DictReader(path.read_text(encoding="utf-8").splitlines())]
    lines = [
        f"| {r.view} | {r.origin} | {r.distance:g} | {r.percent:.3f} ± {r.error:.3f} | {r.reference:g} | "
        f"{r.ratio:.2f}{'' if r.agrees else ' **(off)**'} |"
        for r in rows
        if r.cut == GATED_CUT
    ]
    return _SECTION.format(n=N, detector=DETECTOR) + "\n".join(lines) + "\n"


def _row(row: Mapping[str, str]) -> Fraction:
    texts = {name: row[name] for name in ("cut", "view", "origin")}
    return Fraction(**texts, **{name: float(row[name]) for name in ("distance", "percent", "error", "reference")})


def main(folder: Path | None = None) -> int:
    """Measure, write and draw; 1 if a number that has to agree does not."""
    rows = measure()
    results, images = (folder / "deltas.csv", folder) if folder else (RESULTS, ROOT / "docs" / "images")
    with results.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([field.name for field in fields(Fraction)])
        writer.writerows([[f"{v:.5g}" if isinstance(v, float) else v for v in astuple(row)] for row in rows])
    mpl.use("agg")
    draw(rows).save(images / PICTURE, overwrite=True)
    wrong = [row for row in rows if row.cut == GATED_CUT and not row.agrees]
    for row in wrong:
        print(f"{row.view}, {row.origin}, {row.distance:g} mm: {row.ratio:.3f} of Geant4's", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
