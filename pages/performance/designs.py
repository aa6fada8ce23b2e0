"""Cost of a variant of a detector, and of a design of an analytic sweep."""

from __future__ import annotations

import resource
import time
import tomllib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

import cgemit as cg
from cgemit.detector import Detector, compiled
from cgemit.fit_matter import tuned
from cgemit.study import Evaluation, sobol, sweep
from pages.page import Numbers
from pages.performance.timing import DETECTOR

CHANGES: dict[str, Callable[[int], dict[str, object]]] = {
    "pitch of one layer": lambda i: {"cgem.L2.pitch_x": f"{500 + i} um"},
    "radius of one layer": lambda i: {"cgem.L2.anode_radius": f"{130 + 0.01 * i} mm"},
    "error of all wires": lambda i: {"drift_chamber.sigma": f"{100 + i} um"},
    "gaps of all layers": lambda i: {"cgem.*.drift_gap": f"{3 + 0.01 * i} mm"},
    "foils of all layers": lambda i: {"cgem.*.foil.Kapton.thickness": f"{30 + 0.1 * i} um"},
}
REPEATS = 30
RANGES = {
    "cgem.*.pitch_x": ("300 um", "900 um"),
    "cgem.L2.anode_radius": ("115 mm", "150 mm"),
    "cgem.*.foil.Kapton.thickness": ("30 um", "70 um"),
}
SAMPLES, DESIGNS, SWEEPS = (16, 32, 64, 128), 1000, 3


@dataclass(frozen=True)
class VariantCost:
    """Building a variant, beside reading its complete file and compiling it with the tables of its gaps; ms."""

    change: str
    variant_ms: float
    file_ms: float


@dataclass(frozen=True)
class SweepCost:
    """A design of a sweep of three numbers at ten momenta on two processes: wall and processor time, ms."""

    samples: int
    wall_ms: float
    processor_ms: float


def seconds(work: Callable[[], object]) -> float:
    """Return the wall time of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def complete(variant: Detector) -> object:
    """Read a variant from its file and compile it with everything that the simulation needs."""
    return compiled(cg.load(tomllib.loads(variant.to_toml())))


def measure_variants(_share: float) -> Numbers:
    """Measure each kind of change; both ways alternate, the fastest of some repeats counts."""
    base, rows = cg.load(DETECTOR), []
    tuned(base)
    for name, change in CHANGES.items():
        fast, whole = [], []
        for i in range(REPEATS):
            changes = change(i)
            fast.append(seconds(lambda changes=changes: tuned(base.with_overrides(changes))))
            whole.append(seconds(lambda changes=changes: complete(base.with_overrides(changes))))
        rows.append(VariantCost(name, 1000 * min(fast), 1000 * min(whole)))
    return Numbers(rows)


def processor_time() -> float:
    """Return user and system time of this process and of those that it has waited for, s."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def times(designs: int, samples: int) -> tuple[float, float]:
    """Return wall time and processor time of a sweep, s."""
    begin, used = time.perf_counter(), processor_time()
    with ProcessPoolExecutor(2) as pool:
        evaluate = Evaluation(p=np.geomspace(0.2, 2, 10), samples=samples, quantities=("p", "dr", "dz"))
        sweep(DETECTOR, sobol(RANGES, designs), evaluate, workers=pool)
    return time.perf_counter() - begin, processor_time() - used


def measure_sweeps(_share: float) -> Numbers:
    """Measure sweeps with several numbers of samples."""
    rows = []
    for samples in SAMPLES:
        found = [times(DESIGNS, samples) for _ in range(SWEEPS)]
        rows.append(SweepCost(samples, *(1000 * min(column) / DESIGNS for column in zip(*found, strict=True))))
    return Numbers(rows)
