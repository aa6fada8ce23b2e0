"""Cost per track of each stage for every instruction set, at 1 and 2 threads: ``python benchmarks/matrix.py``.

Also the rate of a product of two large matrices (numpy) on one core: the arithmetic that the machine is capable of.
Writes `matrix.csv`.
"""

from __future__ import annotations

import os
import subprocess
import sys

from bench import machine, measure
from cgemit.base.isa import available
from rows import write_rows

THREADS = (1, 2)
RUNS = 30
PRODUCT = """
import time
import numpy as np
n = 768
a = np.random.default_rng(1).normal(size=(n, n))
best = float("inf")
for _ in range(30):
    start = time.perf_counter()
    a @ a
    best = min(best, time.perf_counter() - start)
print(2e-9 * n**3 / best)
"""


def limit_gflops() -> float:
    """Return the floating-point operations per ns of a product of matrices on one core."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PRODUCT], check=True, capture_output=True, text=True, env=environment
    )  # fmt: skip
    return float(done.stdout)


def main() -> None:
    """Measure, write and print."""
    limit = limit_gflops()
    rows = []
    for isa in available():
        for threads in THREADS:
            cost = measure(threads=threads, isa=isa, repeat=RUNS)
            rows.append({**cost.to_dict(), "limit_gflops": round(limit, 2)})
    write_rows("matrix.csv", rows)
    print(f"{machine()}; one core multiplies matrices with {limit:.1f} operations per ns")
    for row in rows:
        print("  ".join(f"{name} {value}" for name, value in row.items()))


if __name__ == "__main__":
    main()
