"""What the parts of the simulation cost per muon: ``python benchmarks/simulation.py`` (half a minute).

One thread, the sample of `cgemit bench`, the smallest of several runs in processor time. A product of two 64 by 64
matrices (numpy), timed in the same process, makes the numbers comparable between machines. Writes `simulation.csv` and
prints the table of docs/performance.md.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from cgemit.bench import DETECTOR, GUN, SEED, machine
from cgemit.detector import load
from cgemit.gun import generate
from cgemit.simulate import SimulateSettings, simulate
from rows import write_rows

EVENTS = 4000
RUNS = 15
CASES = {
    "no fluctuations": SimulateSettings(fluctuations="off", deltas=False),
    "scattering, straggling and ionization": SimulateSettings(deltas=False),
    "and delta electrons (default)": SimulateSettings(),
    "and every ionization cluster kept": SimulateSettings(steps=True),
    "default, foils with holes": SimulateSettings(foil="lattice"),
    "default, every sub-layer by itself": SimulateSettings(sublayers=True),
}


def product_us() -> float:
    """Return the processor time of a product of two 64 by 64 matrices, us; best of many."""
    a = np.random.default_rng(1).normal(size=(64, 64))
    best = np.inf
    for _ in range(300):
        start = time.process_time()
        for _ in range(10):
            a @ a
        best = min(best, time.process_time() - start)
    return 1e5 * best


def cost_us(settings: SimulateSettings) -> float:
    """Return us per muon."""
    detector, particles = load(DETECTOR), generate(GUN, EVENTS, SEED)
    best = np.inf
    for _ in range(RUNS):
        start = time.process_time()
        simulate(detector, particles, settings, SEED)
        best = min(best, time.process_time() - start)
    return 1e6 * best / EVENTS


def main() -> int:
    """Measure, write and print."""
    unit = product_us()
    rows = [{"case": name, "us": round(cost := cost_us(settings), 2), "products": round(cost / unit, 2)}
            for name, settings in CASES.items()]  # fmt: skip
    write_rows("simulation.csv", rows)
    print(f"{machine()}; one product {unit:.1f} us\n")
    print("| simulated | us per muon | in products of matrices |\n|---|---|---|")
    for row in rows:
        print(f"| {row['case']} | {row['us']:.1f} | {row['products']:.2f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
