"""Compare cgemit with Geant4: ``python validation/geant4.py`` (a minute or two).

Simulates the slabs, the drift gap and the paper's sample that Geant4's numbers are about; writes the files of
validation/results and the pictures, and renews docs/validation.md. With -o everything goes to another folder.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import matplotlib as mpl

import cgemit as cg
import delta_fractions
import x_residual
from cgemit.matter import Passage
from delta_pictures import draw_deltas
from geant4_page import read_results
from geant4_pictures import draw_distributions, draw_loss_ratios, draw_scattering_ratios
from geant4_reference import SLABS, Comparison, cases, compare
from results import FOLDER, IMAGES, PAGE, versions, write_rows
from whole_page import whole_page

SEED = 1
_START = time.perf_counter()


def _say(text: str) -> None:
    print(f"{time.perf_counter() - _START:4.0f} s  {text}", file=sys.stderr)


def _about(events: str) -> dict[str, str]:
    return {"versions": versions(), "events": f"{events}; seed {SEED}", "reference": "Geant4 11.4.1"}


def slabs(folder: Path, n: int) -> dict[tuple[str, float], Passage]:
    """Simulate the slabs with both screenings, write the comparisons, and return the passages with the default one."""
    rows: list[Comparison] = []
    passages = {}
    for slab, p in cases():
        for screening in ("wentzel", "moliere"):
            passage = cg.slab(SLABS[slab], "mu-", p, n, SEED, screening)
            found = compare(passage, slab)
            rows += [row for row in found if screening == "wentzel" or row.quantity.endswith("mrad")]
            if screening == "wentzel":
                passages[slab, p] = passage
        _say(f"{SLABS[slab]}, {p:g} GeV/c")
    about = _about(f"{n:,} mu- for each slab, momentum and screening")
    write_rows(folder / "slabs.csv", rows, about, ("ratio", "ratio_error", "allowed"))
    return passages


def deltas(folder: Path, n: int) -> None:
    """Simulate delta electrons in each arrangement and write their numbers."""
    rows = []
    for name, make in delta_fractions.ARRANGEMENTS.items():
        rows += delta_fractions.measure(make(), n, SEED, name)
    write_rows(folder / "fractions.csv", rows, _about(f"{n:,} mu- in each arrangement"), ("ratio", "allowed"))
    write_rows(folder / "spectrum.csv", delta_fractions.born(n, SEED), _about(f"{n:,} mu-"))
    _say("delta electrons")


def residuals(folder: Path, events: int) -> None:
    """Simulate the sample of the paper with and without delta electrons and write its X residual."""
    rows = [row for deltas in (True, False) for row in x_residual.measure(events, SEED, deltas=deltas)]
    write_rows(folder / "residuals.csv", rows, _about(f"{events:,} tracks with and without delta electrons"))
    _say("X residual")


def main() -> int:
    """Simulate, write, draw; 1 if a number that has to agree does not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, help="folder for everything (default: each its place)")
    parser.add_argument("--n", type=int, default=400_000, help="muons for each slab and momentum (default 400000)")
    parser.add_argument("--deltas", type=int, default=1_000_000, help="muons through the gap (default 1000000)")
    parser.add_argument("--tracks", type=int, default=200_000, help="tracks for the X residual (default 200000)")
    given = parser.parse_args()
    folder, images = given.output or FOLDER, given.output or IMAGES
    images.mkdir(parents=True, exist_ok=True)
    passages = slabs(folder, given.n)
    deltas(folder, given.deltas)
    residuals(folder, given.tracks)
    results = read_results(folder)  # what the files hold is what the page and the pictures show
    mpl.use("agg")
    pictures = {
        "scattering": draw_scattering_ratios(results.slabs),
        "loss": draw_loss_ratios(results.slabs),
        "distributions": draw_distributions(passages),
        "deltas": draw_deltas(results.fractions, results.spectrum, results.residuals),
    }
    for name, picture in pictures.items():
        picture.save(images / f"validation-{name}.png", overwrite=True)
    (given.output / PAGE.name if given.output else PAGE).write_text(whole_page(results), encoding="utf-8")
    wrong = [f"{row.slab}, {row.p:g} GeV/c, {row.quantity}: {row.ratio:.3f} of Geant4's" for row in results.slabs
             if row.gated and not row.agrees]  # fmt: skip
    wrong += delta_fractions.failures(results.fractions)
    print("\n".join(wrong), end="\n" if wrong else "", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
