"""Validate the fit: ``python validation/fit.py`` (twenty minutes; ``--quick``: five).

Simulates and fits tracks over the grid of momentum, angle, charge, particle and detector; compares their pulls,
chi-square, residuals and widths with what they have to be; writes fit_*.csv in validation/results and the pictures, and
renews docs/validation.md. ``--only`` renews some points and keeps what else is on file. With -o everything goes to
another folder.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl

from fit_pictures import draw_choices, draw_pulls, draw_residuals
from fit_results import DETECTORS, KINDS, Point, Pull, failures, point_of, read_fit_results
from fit_samples import grid, measure_losses, measure_point, measure_sides
from program import options, places, save_pictures, say, verdict
from results import read_rows, versions, write_rows
from whole_page import whole_page

Found = dict[str, list[Any]]  # rows by the name of their file


@dataclass(frozen=True)
class _Sizes:
    """Tracks of a point: all Gaussian in the reference detector, every other, and those whose optimum is found."""

    tracks: int
    others: int
    optima: int

    def at(self, point: Point) -> int:
        """Return the number of tracks of a point."""
        return self.tracks if (point.mode, point.detector) == ("gaussian", DETECTORS[0]) else self.others

    def __str__(self) -> str:
        return f"{self.tracks:,} tracks a point where all is Gaussian in {DETECTORS[0]}, {self.others:,} elsewhere"


def _measure_grid(points: Sequence[Point], sizes: _Sizes, threads: int | None) -> Found:
    """Measure points of the grid and return the rows of each file."""
    rows: Found = {"pulls": [], "chi2": [], "residuals": [], "widths": []}
    for point in points:
        pulls, chi2, residuals, widths = measure_point(point, sizes.at(point), threads, sizes.optima)
        # A file of all layers of all points is too long: the page shows those of the reference.
        kept = residuals if point.detector == DETECTORS[0] else []
        for name, found in zip(rows, (pulls, [chi2], kept, widths), strict=True):
            rows[name] += found
        off = sum(not row.agrees for row in (*pulls, chi2, *residuals, *widths))
        say(f"{point.label()}: {sizes.at(point)} tracks" + (f", {off} numbers off" if off else ""))
    return rows


def _write_grid(folder: Path, rows: Found, about: dict[str, str]) -> None:
    for name, found in rows.items():
        derived = ("ratio", "ratio_error", "agrees") if name == "widths" else ("agrees",)
        write_rows(folder / f"fit_{name}.csv", found, about, derived)


def _renewed(folder: Path, new: Found, points: Sequence[Point]) -> Found:
    """Return the rows on file with those of some points replaced, in the order of the grid."""
    order = {point: i for i, point in enumerate(grid())}
    merged: Found = {}
    for name, rows in new.items():
        kept = [row for row in read_rows(folder / f"fit_{name}.csv", KINDS[name])[0] if point_of(row) in order]
        kept = [row for row in kept if point_of(row) not in points]
        merged[name] = sorted([*kept, *rows], key=lambda row: order[point_of(row)])
    return merged


def _measure_choices(folder: Path, n: int, threads: int | None) -> None:
    """Compare choices of the loss, and sides that are found with those that are known."""
    about = {"versions": versions(), "events": f"{n:,} mu- a momentum, cos(theta) uniform in ±0.93"}
    write_rows(folder / "fit_losses.csv", measure_losses(n, threads), about)
    say("losses")
    sides, known = measure_sides(n, threads)
    write_rows(folder / "fit_sides.csv", sides, about)
    write_rows(folder / "fit_known.csv", known, about)
    say("sides")


def main() -> int:
    """Simulate, fit, write, draw; 1 if a number that has to agree does not."""
    parser = options(__doc__)
    parser.add_argument("--tracks", type=int, default=50_000, help="tracks a point, all Gaussian (default 50000)")
    parser.add_argument("--others", type=int, default=25_000, help="tracks of every other point (default 25000)")
    parser.add_argument("--choices", type=int, default=20_000, help="tracks for losses and sides (default 20000)")
    parser.add_argument("--optima", type=int, default=10, help="tracks a point whose optimum is found (default 10)")
    parser.add_argument("--threads", type=int, help="threads (default: all cores)")
    parser.add_argument("--quick", action="store_true", help="2000 tracks of everything")
    parser.add_argument(
        "--only", nargs="+", help="renew points with one of these texts, as 'default, K-', in the label"
    )
    parser.add_argument("--page", action="store_true", help="write page and pictures from the results there are")
    given = parser.parse_args()
    folder, images, page = places(given.output)
    tracks, others, choices = (2000,) * 3 if given.quick else (given.tracks, given.others, given.choices)
    sizes = _Sizes(tracks, others, given.optima)
    points = [point for point in grid() if any(text in point.label() for text in given.only or [""])]
    if given.only and not given.page:
        # What else is on file stays.
        about = read_rows(folder / "fit_pulls.csv", Pull)[1]
        rows = _renewed(folder, _measure_grid(points, sizes, given.threads), points)
        _write_grid(
            folder, rows, about | {"events": f"{about['events']}; of {', '.join(given.only)}: {others:,} tracks"}
        )
    elif not given.page:
        _measure_choices(folder, choices, given.threads)
        about = {"versions": versions(), "events": str(sizes)}
        _write_grid(folder, _measure_grid(points, sizes, given.threads), about)
    results = read_fit_results(folder)
    mpl.use("agg")
    pictures = {
        "fit-pulls": draw_pulls(results), "fit-residuals": draw_residuals(results),
        "fit-choices": draw_choices(results),
    }  # fmt: skip
    save_pictures(images, pictures)
    page.write_text(whole_page(fit=results), encoding="utf-8")
    return verdict(failures(results))


if __name__ == "__main__":
    sys.exit(main())
