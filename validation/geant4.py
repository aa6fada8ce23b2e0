"""Compare cgemit with Geant4: ``python validation/geant4.py`` (a minute or two).

Simulates the slabs, the drift gap and the paper's sample that Geant4's numbers are about; writes the files of
validation/results and the pictures, and renews docs/validation.md. With -o everything goes to another folder.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl

import cgemit as cg
import delta_fractions
import x_residual
from cgemit.simulation.slab import SlabResult
from delta_pictures import draw_deltas
from geant4_page import read_results
from geant4_pictures import draw_distributions, draw_loss_ratios, draw_scattering_ratios
from geant4_reference import SLABS, Comparison, cases, compare
from program import options, places, save_pictures, say, verdict
from results import versions, write_rows
from whole_page import whole_page

SEED = 1


def _about(events: str) -> dict[str, str]:
    return {"versions": versions(), "events": f"{events}; seed {SEED}", "reference": "Geant4 11.4.1"}


def slabs(folder: Path, n: int) -> dict[tuple[str, float], SlabResult]:
    """Simulate the slabs with both screenings, write the comparisons, and return the results with the default one."""
    rows: list[Comparison] = []
    results = {}
    for slab, p in cases():
        for screening in ("wentzel", "moliere"):
            result = cg.slab(SLABS[slab], "mu-", p, n, SEED, screening)
            found = compare(result, slab)
            rows += [row for row in found if screening == "wentzel" or row.quantity.endswith("mrad")]
            if screening == "wentzel":
                results[slab, p] = result
        say(f"{SLABS[slab]}, {p:g} GeV/c")
    about = _about(f"{n:,} mu- for each slab, momentum and screening")
    write_rows(folder / "slabs.csv", rows, about, ("ratio", "ratio_error", "allowed"))
    return results


def deltas(folder: Path, n: int) -> None:
    """Simulate delta electrons in each arrangement and write their numbers."""
    rows = []
    for name, make in delta_fractions.ARRANGEMENTS.items():
        rows += delta_fractions.measure(make(), n, SEED, name)
    write_rows(folder / "fractions.csv", rows, _about(f"{n:,} mu- in each arrangement"), ("ratio", "allowed"))
    write_rows(folder / "spectrum.csv", delta_fractions.born(n, SEED), _about(f"{n:,} mu-"))
    say("delta electrons")


def residuals(folder: Path, events: int) -> None:
    """Simulate the sample of the paper with and without delta electrons and write its X residual."""
    rows = [row for deltas in (True, False) for row in x_residual.measure(events, SEED, deltas=deltas)]
    write_rows(folder / "residuals.csv", rows, _about(f"{events:,} tracks with and without delta electrons"))
    say("X residual")


def main() -> int:
    """Simulate, write, draw; 1 if a number that has to agree does not."""
    parser = options(__doc__)
    parser.add_argument("--n", type=int, default=400_000, help="muons for each slab and momentum (default 400000)")
    parser.add_argument("--deltas", type=int, default=1_000_000, help="muons through the gap (default 1000000)")
    parser.add_argument("--tracks", type=int, default=200_000, help="tracks for the X residual (default 200000)")
    given = parser.parse_args()
    folder, images, page = places(given.output)
    slab_results = slabs(folder, given.n)
    deltas(folder, given.deltas)
    residuals(folder, given.tracks)
    results = read_results(folder)  # what the files hold is what the page and the pictures show
    mpl.use("agg")
    pictures = {
        "scattering": draw_scattering_ratios(results.slabs),
        "loss": draw_loss_ratios(results.slabs),
        "distributions": draw_distributions(slab_results),
        "deltas": draw_deltas(results.fractions, results.spectrum, results.residuals),
    }
    save_pictures(images, pictures)
    page.write_text(whole_page(results), encoding="utf-8")
    wrong = [f"{row.slab}, {row.p:g} GeV/c, {row.quantity}: {row.ratio:.3f} of Geant4's" for row in results.slabs
             if row.gated and not row.agrees]  # fmt: skip
    wrong += delta_fractions.failures(results.fractions)
    return verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
