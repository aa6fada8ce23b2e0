"""What one fit costs, of a track with one hit in every layer: ``python benchmarks/design_muon.py`` (ten seconds).

Muons of 1 GeV/c through all 35 wire layers of `besiii-cgem-design`, 3 clusters in two views and 35 wires, where a real
one crosses 38 cells: what other fitters are quoted for. The compiled fit alone, one thread, from the true helix
smeared, with smoother, residuals and pulls: two iterations with the sides known, as many as it takes to find them out.
Smallest of several runs in processor time. Writes `design_muon.csv`.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np

from bench import DETECTOR, SEED, instruction_set, smeared
from cgemit import FitSettings, Gun, Settings, _core, helix, isa, run
from cgemit.chain.result import Result
from cgemit.detector import compiled
from cgemit.reconstruction.candidates import FitHits, collect_hits
from cgemit.reconstruction.fit import core_arguments
from cgemit.simulation.digitize import DigitizeSettings
from rows import write_rows

GUN = Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7))
EVENTS = 2000
RUNS = 60
TWO_ITERATIONS = FitSettings(residuals=True, max_iterations=2, tolerance=1e-12)


def one_per_layer(hits: FitHits) -> FitHits:
    """Return the hits without the second cells and clusters of a layer."""
    counts = np.diff(hits.hit_offsets)
    place = np.stack([np.repeat(np.arange(len(counts)), counts), hits.kind, hits.layer], axis=1)
    first = np.append(True, np.any(place[1:] != place[:-1], axis=1))
    kept = np.bincount(place[first, 0], minlength=len(counts))
    return replace(
        hits,
        hit_offsets=np.append(0, np.cumsum(kept)).astype(np.int64),
        **{name: column[first] for name, column in hits.columns().items()},
    )


def arguments(result: Result, settings: FitSettings) -> dict[str, Any]:
    """Return what the compiled fit takes."""
    hits = one_per_layer(
        collect_hits(result.detector, result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
    )
    truth = helix.at_origin_in(result.particles, compiled(result.detector).field)
    start = smeared(truth, result.particles, SEED)
    return core_arguments(result.detector, hits, result.particles["mass"], start, settings)


def cost_us(call: dict[str, Any]) -> float:
    """Return us per track."""
    best = np.inf
    for _ in range(RUNS):
        start = time.process_time()
        _core.fit(**call)
        best = min(best, time.process_time() - start)
    return 1e6 * best / EVENTS


def main() -> int:
    """Measure, write and print."""
    calls, hits = {}, 0.0
    for name, known, settings in (("known", True, TWO_ITERATIONS), ("unknown", False, FitSettings(residuals=True))):
        digits = DigitizeSettings(reveal_sides=known)
        calls[name] = arguments(run(DETECTOR, GUN, EVENTS, SEED, settings=Settings(digitize=digits)), settings)
        hits = len(calls[name]["hits"]["kind"]) / EVENTS
    rows = []
    for code in isa.available():
        with instruction_set(code):
            known, unknown = (cost_us(calls[name]) for name in ("known", "unknown"))
        rows.append({"isa": code, "hits": round(hits, 2), "known_us": round(known, 2), "unknown_us": round(unknown, 2),
                     "ratio": round(unknown / known, 2)})  # fmt: skip
        print(rows[-1])
    write_rows("design_muon.csv", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
