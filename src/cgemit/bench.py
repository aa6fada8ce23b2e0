"""What each stage costs per track (benchmarks/README.md)."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cgemit import find
from cgemit.cluster import cluster
from cgemit.detector import Detector, load
from cgemit.digitize import DigitizeSettings, digitize
from cgemit.fit import FitSettings, fit
from cgemit.gun import Gun, generate
from cgemit.simulate import simulate

ISAS = ("scalar",)
DETECTOR = "besiii-cgem-design"
GUN = Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
SEED = 1

_STAGES = ("simulate", "digitize", "cluster", "fit", "fit_lr")


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Wall time per track of each stage, us.

    Attributes
    ----------
    isa : str
        Instruction set of the kernels.
    threads : int
    simulate_us, digitize_us, cluster_us : float
    fit_us, fit_lr_us : float
        Fit with smoother, sides of the wires known, and to be found out.
    """

    isa: str
    threads: int
    simulate_us: float
    digitize_us: float
    cluster_us: float
    fit_us: float
    fit_lr_us: float

    def to_dict(self) -> dict[str, Any]:
        """Return the fields by name, times rounded to 0.01 us."""
        return {name: round(value, 2) if name.endswith("_us") else value for name, value in asdict(self).items()}


def measure(
    detector: Detector | str | Mapping[str, Any] = DETECTOR,
    *,
    events: int = 2000,
    threads: int = 1,
    repeat: int = 5,
    gun: Gun = GUN,
) -> Cost:
    """Time every stage on prepared tables, with one track an event.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    events : int
        Events that each thread handles in one call.
    threads : int
        Threads that run the same stage at the same time, each on events of its own.
    repeat : int
        The fastest of so many runs counts, after one that is not counted.
    gun : Gun

    Returns
    -------
    Cost

    Raises
    ------
    ValueError
        If a number is below 1.
    """
    wrong = [f"{n}: {v}, expected at least 1" for n, v in _numbers(events, threads, repeat) if v < 1]
    if wrong:
        raise ValueError("bench:\n  " + "\n  ".join(wrong))
    loaded = load(detector)
    with ThreadPoolExecutor(threads) as pool:
        chunks = list(pool.map(lambda i: stage_calls(loaded, gun, events, i * events), range(threads)))
        best = {stage: _fastest([calls[stage] for calls in chunks], pool, repeat) for stage in _STAGES}
    per_track = {f"{stage}_us": 1e6 * seconds / (events * threads) for stage, seconds in best.items()}
    return Cost(isa=ISAS[0], threads=threads, **per_track)


def stage_calls(detector: Detector, gun: Gun, events: int, first_event: int = 0) -> dict[str, Callable[[], object]]:
    """Return a function for each stage that runs it on the tables of the stage before.

    Parameters
    ----------
    detector : Detector
    gun : Gun
    events, first_event : int

    Returns
    -------
    dict of str to callable
        ``simulate``, ``digitize``, ``cluster``, ``fit`` (sides known), ``fit_lr`` (sides hidden).
    """
    particles = generate(gun, events, SEED, first_event)
    simulated = simulate(detector, particles, seed=SEED)
    truths, steps, wire_truths = (simulated[name] for name in ("truths", "steps", "wire_truths"))
    shown, hidden = DigitizeSettings(reveal_sides=True), DigitizeSettings()
    digis = digitize(detector, truths, wire_truths, hidden, SEED, steps=steps)["digis"]
    clusters = cluster(detector, digis)

    def fit_call(settings: DigitizeSettings) -> Callable[[], object]:
        wire_hits = digitize(detector, truths, wire_truths, settings, SEED, steps=steps)["wire_hits"]
        candidates = find.by_truth(detector, simulated["particles"], clusters, wire_hits, truths, wire_truths)
        smooth = FitSettings(residuals=True)
        return lambda: fit(detector, simulated["particles"], clusters, wire_hits, candidates, smooth, SEED)

    return {
        "simulate": lambda: simulate(detector, particles, seed=SEED),
        "digitize": lambda: digitize(detector, truths, wire_truths, hidden, SEED, steps=steps),
        "cluster": lambda: cluster(detector, digis),
        "fit": fit_call(shown),
        "fit_lr": fit_call(hidden),
    }


def machine() -> str:
    """Describe the processor and the number of its cores that this process may use."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        models = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        name = models[0] if models else name
    return f"{name}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


def _numbers(events: int, threads: int, repeat: int) -> list[tuple[str, int]]:
    return [("events", events), ("threads", threads), ("repeat", repeat)]


def _fastest(calls: list[Callable[[], object]], pool: ThreadPoolExecutor, repeat: int) -> float:
    """Seconds of the fastest of several runs of all calls at the same time."""
    seconds = []
    for _ in range(repeat + 1):
        start = time.perf_counter()
        for done in [pool.submit(call) for call in calls]:
            done.result()
        seconds.append(time.perf_counter() - start)
    return min(seconds[1:])
