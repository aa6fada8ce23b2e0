"""GEM foils with holes against even ones, on every observable of the study.

``python validation/foils.py [--batches N] [--events N]`` renews the table of docs/methods/foils.md; 20 batches of 2000
events at each of three momenta take a few minutes. Three detectors differ in their foils only: ``effective`` has the
densities of the preset, ``even`` the mean density of the lattice, ``lattice`` the holes. They share their random
numbers, and the fit always assumes the preset. Differences are taken batch by batch; the scatter over batches is their
error.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import cgemit as cg
from cgemit.analysis.clusters import cluster_residuals, v_fit, x_widths
from cgemit.analysis.curves import windowed_resolution
from cgemit.chain.settings import Settings
from cgemit.detector import CgemLayer, Detector, SubLayer, slabs
from cgemit.detector.matter import Holes
from cgemit.simulation.transport import SimulateSettings
from cgemit.study.paper import COS_THETA
from cgemit.study.samples import seed_of

PAGE = Path(__file__).resolve().parents[1] / "docs" / "methods" / "foils.md"
PRESET = "besiii-cgem-design"
MOMENTA = (0.2, 0.5, 1.0)  # GeV/c
UNITS = {"dr": "um", "dz": "mm", "p": "MeV/c"}


def main() -> None:
    """Measure, print the table and write it into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, default=20)
    parser.add_argument("--events", type=int, default=2000, help="of each batch and momentum")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    preset = cg.load(PRESET)
    even = evened(preset)
    cases = [(preset, "effective"), (even, "effective"), (preset, "lattice")]
    lines = []
    for p in MOMENTA:
        seeds = [seed_of(given.seed, batch) for batch in range(given.batches)]
        found = [[observables(d, foil, preset, p, given.events, seed) for seed in seeds] for d, foil in cases]
        names = list(found[0][0])
        values = np.array([[list(batch.values()) for batch in case] for case in found])  # (case, batch, observable)
        lines += [row(p, name, values[:, :, i]) for i, name in enumerate(names)]
    table = [
        f"`{PRESET}`, mu-, |cos θ| < {COS_THETA[1]}, {given.batches} × {given.events} events at each momentum,",
        f"seed {given.seed}, cgemit {cg.__version__}:",
        "",
        "| p (GeV/c) | observable | effective | even − effective | lattice − even | lattice − effective |",
        "|---|---|---|---|---|---|",
        *lines,
    ]
    text = "\n".join(table)
    print(text)
    pattern = re.compile(r"(<!-- begin table -->\n).*(\n<!-- end table -->)", re.DOTALL)
    PAGE.write_text(pattern.sub(lambda m: m[1] + text + m[2], PAGE.read_text(encoding="utf-8")), encoding="utf-8")


def observables(
    detector: Detector, foil: str, believed: Detector, p: float, events: int, seed: int
) -> dict[str, float]:
    """Return the study's numbers of one batch; those of clusters at 1 GeV/c only, as in the study."""
    settings = Settings(simulate=SimulateSettings(foil=foil))
    gun = cg.Gun("mu-", p=p, cos_theta=COS_THETA)
    result = cg.run(detector, gun, events, seed, settings=settings, fit_detector=believed)
    found = {}
    if p == 1.0:
        clusters = cluster_residuals(result)
        found = {
            "X residual, RMS within 3 mm (um)": x_widths(clusters, 3.0).rms,
            "X clusters of one strip": clusters.single_strip_fraction[0],
            "V residual, Gaussian (um)": v_fit(clusters).sigma,
        }
    for name, unit in UNITS.items():
        found[f"sigma({name}) ({unit})"] = windowed_resolution(result.tracks, name).core
    return found


def row(p: float, name: str, values: np.ndarray) -> str:
    """Return a line of the table from values (case, batch)."""
    effective, even, lattice = values
    mean, n = effective.mean(), values.shape[1]
    changes = (even - effective, lattice - even, lattice - effective)
    cells = [f"{mean:.4g} ± {effective.std(ddof=1) / math.sqrt(n):.2g}"]
    cells += [f"{100 * c.mean() / mean:+.2f} ± {100 * c.std(ddof=1) / math.sqrt(n) / mean:.2f} %" for c in changes]
    return f"| {p:g} | {name} | " + " | ".join(cells) + " |"


def evened(detector: Detector) -> Detector:
    """Return a detector whose foils have the lattice's matter, spread evenly."""
    solid = iter([coverage(slab.holes) for slab in slabs(detector, foil="lattice") if slab.holes])
    return replace(detector, cgem=tuple(replace(layer, foil=tuple(_evened(layer, solid))) for layer in detector.cgem))


def _evened(layer: CgemLayer, solid: Iterator[float]) -> list[SubLayer]:
    parts = []
    for part, share in zip(layer.foil, [next(solid) for _ in range(layer.foils * len(layer.foil))], strict=False):
        full = part.material.solid()
        even = replace(full, name=f"{full.name}, even", density=full.density * share, x0=full.x0 / share)
        parts.append(replace(part, material=even))
    return parts


def coverage(holes: Holes) -> float:
    """Return which part of a sub-layer is solid: one minus the volume of a hole over that of its cell."""
    ends = sorted(abs(w) for w in (holes.begin, holes.end))
    edges = [(0.0, ends[0]), (0.0, ends[1])] if holes.begin < 0 < holes.end else [(ends[0], ends[1])]
    volume = 0.0
    for low, high in edges:
        a, b = (holes.waist + holes.widening * w for w in (low, high))
        volume += math.pi * (high - low) * (a * a + a * b + b * b) / 3
    return 1 - volume / ((holes.end - holes.begin) * math.sqrt(3) / 2 * holes.pitch**2)


if __name__ == "__main__":
    main()
