"""What one covariance costs beside one fit of the same track: ``python benchmarks/covariance.py`` (half a minute).

Muons of 1 GeV/c in `besiii-cgem-design`, azimuths all around, read-out with given errors: search for the cells,
reference trajectory, filter, and the exact budget, one thread, for each instruction set; the fit is that of
`design_muon.py`. The covariance is measured twice: with one reference for all tracks of the point, and, without the
terms of the budget, for points of one track each. Then a gradient by ten numbers of the design, in covariances, and
what a curve of 60 momenta costs from Python, of both detectors, one after the other. Smallest of several runs in
processor time. Writes `covariance.csv`.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable

import numpy as np

import cgemit as cg
from bench import SEED, instruction_set
from cgemit import isa
from cgemit.detector import compiled
from design_muon import EVENTS, GUN, TWO_ITERATIONS, arguments, cost_us
from rows import write_rows

TRACKS, RUNS = 2048, 40
DETECTORS = ("besiii-cgem-design", "besiii-idc")
#: Half of them enter the geometry, half of them errors and thicknesses.
KEYS = (
    "field.bz", "cgem.L1.anode_radius", "cgem.L3.anode_radius", "cgem.L2.stereo", "cgem.*.drift_gap",
    "drift_chamber.sigma", "cgem.*.pitch_x", "cgem.*.pitch_v", "cgem.*.foil.Kapton.thickness",
    "cgem.L1.anode.*.thickness",
)  # fmt: skip


def fastest(work: Callable[[], object]) -> float:
    """Return the processor time of one call, s."""
    best = np.inf
    for _ in range(RUNS):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def main() -> int:
    """Measure, write and print."""
    known = cg.Settings(digitize=cg.DigitizeSettings(reveal_sides=True))
    fitted = arguments(cg.run(DETECTORS[0], GUN, EVENTS, SEED, settings=known), TWO_ITERATIONS)
    tracks = cg.analytic(DETECTORS[0], p=1.0, readout="gaussian", samples=TRACKS, threads=1, reveal_sides=True)._tracks
    alone = dataclasses.replace(tracks, samples=1, phases=tracks.phases[:1])
    base = cg.load(DETECTORS[0])
    variants = [compiled(base.with_overrides({key: "x1.00002"}), gaps=False) for key in KEYS]
    rows = []
    for code in isa.available():
        with instruction_set(code):
            single = 1e6 * fastest(lambda: alone.run(budget=False)) / TRACKS
            split = 1e6 * fastest(lambda: tracks.run(budget=True)) / TRACKS
            gradient = 1e6 * fastest(lambda: tracks.run(budget=False, variants=variants)) / TRACKS
            fit = cost_us(fitted)
        rows.append({"isa": code, "alone_us": round(single, 2), "of_a_point_us": round(split, 2),
                     "gradient": round(gradient / split, 1), "fit_us": round(fit, 2),
                     "fit_over_covariance": round(fit / split, 2)})  # fmt: skip
        print(rows[-1])
    write_rows("covariance.csv", rows)
    p = np.linspace(0.2, 2.0, 60)
    for text, how in (("fixed azimuth, gaussian", {"phi": 0.0, "readout": "gaussian"}), ("binary, averaged", {})):
        milliseconds = 1e3 * fastest(lambda how=how: [cg.analytic(d, p=p, **how).sigma_p for d in DETECTORS])
        print(f"60 momenta, both detectors, {text}: {milliseconds:.1f} ms of processor time")
    return 0


if __name__ == "__main__":
    sys.exit(main())
