"""Cost per track of each stage against the number of events: ``python benchmarks/stages.py`` (a minute or two).

One thread, chunks of 1000 events as in `cgemit.run`, the sample of `bench.py`. Between the runs a product of two
matrices is timed: times divided by it can be compared between machines and between days. Writes `stages.csv`.
"""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path

import numpy as np

from bench import DETECTOR, GUN, SEED, machine
from cgemit.chain.run import run_chunk
from cgemit.chain.settings import Settings
from cgemit.detector import load
from cgemit.particles.gun import generate
from cgemit.reconstruction.fit import FitSettings

HERE = Path(__file__).resolve().parent
COUNTS = (100, 1000, 10_000, 100_000, 1_000_000)
CHUNK = 1000
STAGES = ("simulate", "digitize", "cluster", "find", "fit", "match")


def product_us() -> float:
    """Return the time of a product of two 64 by 64 matrices, us; best of many."""
    a = np.random.default_rng(1).normal(size=(64, 64))
    best = np.inf
    for _ in range(300):
        start = time.perf_counter()
        a @ a
        best = min(best, time.perf_counter() - start)
    return 1e6 * best


def cost(events: int) -> dict[str, float]:
    """Return us per track of each stage and of all, for so many events; tables are dropped chunk by chunk."""
    detector, settings = load(DETECTOR), Settings(fit=FitSettings(residuals=True))
    seconds = dict.fromkeys((*STAGES, "all"), 0.0)
    start = time.perf_counter()
    for first in range(0, events, CHUNK):
        particles = generate(GUN, min(CHUNK, events - first), SEED, first)
        for stage, spent in run_chunk(detector, detector, particles, settings, SEED)[1].items():
            seconds[stage] += spent
    seconds["all"] = time.perf_counter() - start
    return {stage: 1e6 * value / events for stage, value in seconds.items()}


def main() -> None:
    """Measure, write and print."""
    cost(CHUNK)  # the first run builds the compiled detector and the table of cluster errors
    rows = []
    for events in COUNTS:
        before = product_us()
        row = {"events": events, **cost(events)}
        row["product"] = min(before, product_us())
        rows.append(row)
        print(f"{events:>7} events: {row['all']:.1f} us per track", file=sys.stderr)
    with (HERE / "stages.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["events", *(f"{name} (us)" for name in (*STAGES, "all", "product"))])
        writer.writerows([[row["events"], *(f"{row[n]:.3f}" for n in (*STAGES, "all", "product"))] for row in rows])
    print(f"{machine()}\n\n| events | {' | '.join(STAGES)} | all | all / product |\n|{'---|' * (len(STAGES) + 3)}")
    for row in rows:
        numbers = " | ".join(f"{row[name]:.1f}" for name in (*STAGES, "all"))
        print(f"| {row['events']:,} | {numbers} | {row['all'] / row['product']:.1f} |")


if __name__ == "__main__":
    main()
