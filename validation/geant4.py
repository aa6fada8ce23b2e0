"""Compare cgemit with Geant4: ``python validation/geant4.py`` (about a minute).

Simulates the slabs of validation/data, writes validation/results/geant4.csv and the pictures, and renews
docs/validation.md. With -o everything goes to another folder instead.
"""

from __future__ import annotations

import argparse
import platform
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np

import cgemit as cg
import deltas
from cgemit.matter import Passage
from geant4_page import page
from geant4_pictures import draw_distributions, draw_loss_ratios, draw_scattering_ratios
from geant4_reference import SLABS, Comparison, cases, compare
from geant4_results import RESULTS, read_results, write_results

ROOT = Path(__file__).resolve().parents[1]
SEED = 1


def simulate(n: int) -> tuple[list[Comparison], dict[tuple[str, float], Passage]]:
    """Return all comparisons, of both screenings, and the passages with the default one."""
    rows, passages = [], {}
    for slab, p in cases():
        for screening in ("wentzel", "moliere"):
            passage = cg.slab(SLABS[slab], "mu-", p, n, SEED, screening)
            found = compare(passage, slab)
            rows += [row for row in found if screening == "wentzel" or row.quantity.endswith("mrad")]
            if screening == "wentzel":
                passages[slab, p] = passage
        print(f"{SLABS[slab]}, {p:g} GeV/c", file=sys.stderr)
    return rows, passages


def main() -> int:
    """Simulate, write, draw; 1 if a number that has to agree does not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, help="folder for everything (default: each its place)")
    parser.add_argument("--n", type=int, default=400_000, help="muons for each slab and momentum (default 400000)")
    arguments = parser.parse_args()
    folder: Path | None = arguments.output
    images = folder or ROOT / "docs" / "images"
    images.mkdir(parents=True, exist_ok=True)
    results = folder / "geant4.csv" if folder else RESULTS
    rows, passages = simulate(arguments.n)
    versions = f"cgemit {cg.__version__}, Python {platform.python_version()}, numpy {np.__version__}"
    events = f"{arguments.n:,} mu- for each slab, momentum and screening; seed {SEED}"
    write_results(results, rows, {"versions": versions, "events": events, "reference": "Geant4 11.4.1"})
    rows, about = read_results(results)  # what the file holds is what the page and the pictures show
    mpl.use("agg")
    draw_scattering_ratios(rows).save(images / "validation-scattering.png", overwrite=True)
    draw_loss_ratios(rows).save(images / "validation-loss.png", overwrite=True)
    draw_distributions(passages).save(images / "validation-distributions.png", overwrite=True)
    text = page(rows, about, deltas.section(folder / "deltas.csv" if folder else deltas.RESULTS))
    (folder / "validation.md" if folder else ROOT / "docs" / "validation.md").write_text(text, encoding="utf-8")
    wrong = [row for row in rows if row.gated and not row.agrees]
    for row in wrong:
        print(f"{row.slab}, {row.p:g} GeV/c: {row.quantity} is {row.ratio:.3f} of Geant4's", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
