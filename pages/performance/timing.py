"""How the benchmarks measure time: fastest of several runs in turns, for one instruction set, beside a product."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from cgemit.base import isa as kernels
from cgemit.particles.gun import Gun

DETECTOR = "besiii-cgem-design"
GUN = Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
SEED = 1


def fastest(
    calls: Mapping[str, Callable[[], object]], runs: int, clock: Callable[[], float] = time.process_time
) -> dict[str, float]:
    """Return the seconds of the fastest run of each call.

    The calls take turns, so that a machine whose speed changes does not matter.
    """
    best = dict.fromkeys(calls, np.inf)
    for _ in range(runs):
        for name, call in calls.items():
            start = clock()
            call()
            best[name] = min(best[name], clock() - start)
    return best


def product_us(clock: Callable[[], float] = time.process_time) -> float:
    """Return the time of a product of two 64 by 64 matrices, us; a unit in which machines can be compared."""
    a = np.random.default_rng(1).normal(size=(64, 64))

    def ten() -> None:
        for _ in range(10):
            a @ a

    return 1e5 * fastest({"product": ten}, 300, clock)["product"]


@contextmanager
def instruction_set(name: str) -> Iterator[None]:
    """Use the kernels of an instruction set (`cgemit.isa.available`) inside the block."""
    before = kernels.name()
    kernels.use(name)
    try:
        yield
    finally:
        kernels.use(before)


def machine() -> str:
    """Describe the processor, the number of its cores, and the system."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        models = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        name = models[0] if models else name
    return f"{name}, {os.cpu_count()} cores, {platform.system()}, {' '.join(platform.libc_ver())}"
