"""What the parts of the simulation, and field maps, cost per muon: ``python benchmarks/simulation.py`` (a minute).

One thread, the sample of `bench.py`, the smallest of several runs in processor time. A product of two 64 by 64
matrices (numpy), timed in the same process, makes the numbers comparable between machines. Writes `simulation.csv` and
`simulation_fields.csv`, with a row for each instruction set, and prints the tables of docs/performance.md.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np

from bench import DETECTOR, GUN, SEED, instruction_set, machine
from cgemit import isa
from cgemit.detector import Detector, load
from cgemit.particles.gun import generate
from cgemit.simulation.transport import SimulateSettings, simulate
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
FIELDS = ("uniform", "besiii", "finite-solenoid")  # the last one on a grid in (r, z)


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


def costs_us(calls: dict[str, tuple[Detector, SimulateSettings]]) -> dict[str, float]:
    """Return us per muon of each; they take turns, so that a machine whose speed changes does not matter."""
    particles = generate(GUN, EVENTS, SEED)
    best = dict.fromkeys(calls, np.inf)
    for _ in range(RUNS):
        for name, (detector, settings) in calls.items():
            start = time.process_time()
            simulate(detector, particles, settings, SEED)
            best[name] = min(best[name], 1e6 * (time.process_time() - start) / EVENTS)
    return best


def field_rows() -> list[dict[str, Any]]:
    """Return us per muon in every field and the ratio to the uniform one, for each instruction set."""
    calls = {field: (load(DETECTOR).with_field(field), SimulateSettings()) for field in FIELDS}
    rows = []
    for code in isa.available():
        with instruction_set(code):
            costs = costs_us(calls)
        rows += [{"isa": code, "field": field, "us": round(us, 2), "ratio": round(us / costs["uniform"], 2)}
                 for field, us in costs.items()]  # fmt: skip
    return rows


def main() -> int:
    """Measure, write and print."""
    unit = product_us()
    costs = costs_us({name: (load(DETECTOR), settings) for name, settings in CASES.items()})
    rows = [{"case": name, "us": round(cost, 2), "products": round(cost / unit, 2)} for name, cost in costs.items()]
    write_rows("simulation.csv", rows)
    fields = field_rows()
    write_rows("simulation_fields.csv", fields)
    print(f"{machine()}; one product {unit:.1f} us\n")
    print("| simulated | us per muon | in products of matrices |\n|---|---|---|")
    for row in rows:
        print(f"| {row['case']} | {row['us']:.1f} | {row['products']:.2f} |")
    print("\n| code | field | us per muon | over uniform |\n|---|---|---|---|")
    for field in fields:
        print(f"| {field['isa']} | {field['field']} | {field['us']:.1f} | {field['ratio']:.2f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
