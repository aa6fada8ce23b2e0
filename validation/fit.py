"""Validate the fit: ``python validation/fit.py`` (twenty minutes; ``--quick``: five).

Simulates and fits tracks over the grid of momentum, angle, charge, particle and detector; compares their pulls,
chi-square, residuals and widths with what they have to be; writes fit_*.csv in validation/results and the pictures, and
renews docs/validation.md. With -o everything goes to another folder.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl

from fit_pictures import draw_choices, draw_pulls, draw_residuals
from fit_results import DETECTORS, Chi2, Pull, Width, failures, read_fit_results
from fit_samples import grid, measure_losses, measure_point, measure_sides
from program import options, places, save_pictures, say, verdict
from results import versions, write_rows
from whole_page import whole_page


def _measure_grid(
    folder: Path, tracks: int, others: int, optima: int, threads: int | None, about: dict[str, str]
) -> None:
    """Measure every point of the grid: `tracks` a point where all is Gaussian, `others` elsewhere."""
    pulls: list[Pull] = []
    chi2: list[Chi2] = []
    residuals: list[Pull] = []
    widths: list[Width] = []
    for point in grid():
        n = tracks if (point.mode, point.detector) == ("gaussian", DETECTORS[0]) else others
        found = measure_point(point, n, threads, optima)
        pulls += found[0]
        chi2.append(found[1])
        # A file of all layers of all points is too long: the page shows those of the reference.
        residuals += found[2] if point.detector == DETECTORS[0] else []
        widths += found[3]
        off = sum(not row.agrees for row in (*found[0], found[1], *found[2], *found[3]))
        say(f"{point.label()}: {n} tracks" + (f", {off} numbers off" if off else ""))
    write_rows(folder / "fit_pulls.csv", pulls, about, ("agrees",))
    write_rows(folder / "fit_chi2.csv", chi2, about, ("agrees",))
    write_rows(folder / "fit_residuals.csv", residuals, about, ("agrees",))
    write_rows(folder / "fit_widths.csv", widths, about, ("ratio", "ratio_error", "agrees"))


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
    parser.add_argument("--page", action="store_true", help="write page and pictures from the results there are")
    given = parser.parse_args()
    folder, images, page = places(given.output)
    tracks, others, choices = (2000,) * 3 if given.quick else (given.tracks, given.others, given.choices)
    if not given.page:
        _measure_choices(folder, choices, given.threads)
        events = f"{tracks:,} tracks a point where all is Gaussian in {DETECTORS[0]}, {others:,} elsewhere"
        _measure_grid(folder, tracks, others, given.optima, given.threads, {"versions": versions(), "events": events})
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
