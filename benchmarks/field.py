"""What field maps cost: ``python benchmarks/field.py`` (a minute).

The compiled fit alone, one thread, sides of the wires to be found out: muons of 1 GeV/c simulated and fitted in the
uniform field, in the harmonic field and through two (r, z) maps, for each instruction set (``CGEMIT_ISA`` names
one). The fields take turns, so that a machine whose speed changes does not matter; smallest of several runs in
processor time. Writes `field.csv`.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import numpy as np

from bench import DETECTOR, SEED, instruction_set, smeared
from cgemit import FitSettings, Gun, _core, helix, isa, load, run
from cgemit.detector import compiled
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.fit import core_arguments
from rows import write_rows

GUN = Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
FIELDS = ("uniform", "besiii-harmonic", "besiii", "finite-solenoid")
EVENTS = 1000
RUNS = 7


def arguments(field: str) -> dict[str, Any]:
    """Return what the compiled fit takes."""
    result = run(load(DETECTOR).with_field(field), GUN, EVENTS, SEED)
    hits = collect_hits(result.detector, result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
    settings = FitSettings(residuals=True)
    truth = helix.at_origin_in(result.particles, compiled(result.detector).field)
    start = smeared(truth, result.particles, SEED)
    return core_arguments(result.detector, hits, result.particles["mass"], start, settings)


def costs_us(calls: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Return us per track in each field."""
    best = dict.fromkeys(calls, np.inf)
    for _ in range(RUNS):
        for field, call in calls.items():
            start = time.process_time()
            _core.fit(**call)
            best[field] = min(best[field], 1e6 * (time.process_time() - start) / EVENTS)
    return best


def main() -> int:
    """Measure, write and print."""
    calls = {field: arguments(field) for field in FIELDS}
    chosen = os.environ.get(isa.VARIABLE)
    rows = []
    for code in (chosen,) if chosen else isa.available():
        with instruction_set(code):
            cost = costs_us(calls)
        row: dict[str, Any] = {"isa": code}
        for field in FIELDS:
            row[f"{field}_us"] = round(cost[field], 2)
        for field in FIELDS[1:]:
            row[f"{field}_ratio"] = round(cost[field] / cost["uniform"], 2)
        rows.append(row)
        print(row)
    if not chosen:
        write_rows("field.csv", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
