"""Time of an analytic sweep of three numbers of the design at ten momenta, on two processes: writes sweep.csv.

``python benchmarks/sweep.py DESIGNS`` takes another number of designs than 1000 and writes nothing. Processor time is
user and system time of all processes; the fastest of the repeats counts.
"""

from __future__ import annotations

import csv
import resource
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from cgemit.study import sobol, sweep

RANGES = {
    "cgem.*.pitch_x": ("300 um", "900 um"),
    "cgem.L2.anode_radius": ("115 mm", "150 mm"),
    "cgem.*.foil.Kapton.thickness": ("30 um", "70 um"),
}
DESIGNS, REPEATS = 1000, 3


def processor_time() -> float:
    """Return user and system time of this process and of those that it has waited for, s."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def times(designs: int, samples: int) -> tuple[float, float]:
    """Return wall time and processor time of a sweep, s."""
    begin, used = time.perf_counter(), processor_time()
    with ProcessPoolExecutor(2) as pool:
        sweep("besiii-cgem-design", sobol(RANGES, designs), p=list(np.geomspace(0.2, 2, 10)), samples=samples,
              quantities=("p", "dr", "dz"), executor=pool)  # fmt: skip
    return time.perf_counter() - begin, processor_time() - used


def rows(designs: int, repeats: int) -> Iterator[list[str]]:
    """Yield samples, and wall and processor time of a design in ms."""
    for samples in (16, 32, 64, 128):
        found = [times(designs, samples) for _ in range(repeats)]
        wall, used = (min(column) for column in zip(*found, strict=True))
        yield [str(samples), f"{1000 * wall / designs:.2f}", f"{1000 * used / designs:.2f}"]


def main() -> None:
    """Write the table, or print it for another number of designs."""
    head = ["samples", "wall on 2 cores (ms/design)", "processor (ms/design)"]
    if len(sys.argv) > 1:
        print(*head, sep=", ")
        for row in rows(int(sys.argv[1]), 1):
            print(*row, sep=", ", flush=True)
        return
    with Path(__file__).with_suffix(".csv").open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerows([head, *rows(DESIGNS, REPEATS)])


if __name__ == "__main__":
    main()
