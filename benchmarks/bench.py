"""Wall time of each stage per track, for the programs of this folder."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.base import isa as kernels
from cgemit.detector import Detector, compiled, load
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.find import truth
from cgemit.reconstruction.fit import FitSettings, fit
from cgemit.reconstruction.fit import core_arguments as fit_arguments
from cgemit.simulation.digitize import DigitizeSettings, digitize
from cgemit.simulation.transport import SimulateSettings, simulate
from cgemit.simulation.transport import core_arguments as simulate_arguments
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

DETECTOR = "besiii-cgem-design"
GUN = Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
SEED = 1

#: The timed stages in the order of the chain; `_kernel`: the compiled core alone, on prepared arrays.
STAGES = (
    "simulate", "digitize", "cluster", "find", "fit", "fit_lr", "simulate_kernel", "fit_kernel", "fit_lr_kernel"
)  # fmt: skip
SMEARING = (1.0, 0.005, 0.02, 5.0, 0.005)
"""Smearing of a given starting helix: dr mm, phi0 rad, kappa relative, dz mm, tanl."""

_FIT = FitSettings(residuals=True)
_TWO_ITERATIONS = FitSettings(residuals=True, max_iterations=2, tolerance=1e-12)


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Wall time per track of each stage, us.

    Attributes
    ----------
    isa : str
        Instruction set of the kernels.
    threads : int
    simulate_us, digitize_us, cluster_us, find_us : float
    fit_us, fit_lr_us : float
        Fit with smoother, with the sides of the wires known and unknown; the hits provide the starting helix.
    simulate_kernel_us : float
        The compiled simulation alone.
    fit_kernel_us, fit_lr_kernel_us : float
        The compiled fit alone with residuals, started from the smeared true helix: two iterations with the sides known,
        as many as needed with the sides unknown.
    """

    isa: str
    threads: int
    simulate_us: float
    digitize_us: float
    cluster_us: float
    fit_us: float
    fit_lr_us: float
    find_us: float
    simulate_kernel_us: float
    fit_kernel_us: float
    fit_lr_kernel_us: float

    def to_dict(self) -> dict[str, Any]:
        """Return the fields by name, times rounded to 0.01 us."""
        return {name: round(value, 2) if name.endswith("_us") else value for name, value in asdict(self).items()}


@contextmanager
def instruction_set(name: str | None) -> Iterator[str]:
    """Use the kernels of an instruction set inside the block.

    Parameters
    ----------
    name : str or None
        One of `cgemit.isa.available`; None: the set in use.

    Yields
    ------
    str
        The name of the set in use.

    Raises
    ------
    ValueError
        If it is not available here.
    """
    before = kernels.name()
    kernels.use(name or before)
    try:
        yield kernels.name()
    finally:
        kernels.use(before)


def measure(
    detector: Detector | str | Mapping[str, Any] = DETECTOR,
    *,
    events: int = 2000,
    threads: int = 1,
    repeat: int = 5,
    gun: Gun = GUN,
    isa: str | None = None,
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
        Number of timed runs, after one that is not counted. The fastest one counts.
    gun : Gun
    isa : str or None
        Instruction set of the kernels, one of `cgemit.isa.available`; None: the one in use.

    Returns
    -------
    Cost

    Raises
    ------
    ValueError
        If a number is below 1, or the instruction set cannot be used here.
    """
    wrong = [f"{n}: {v}, expected at least 1" for n, v in _numbers(events, threads, repeat) if v < 1]
    if isa is not None and isa not in kernels.available():
        wrong.append(f"isa: {isa!r}, expected one of {', '.join(kernels.available())}")
    if wrong:
        raise ValueError("bench:\n  " + "\n  ".join(wrong))
    loaded = load(detector)
    with instruction_set(isa) as used, ThreadPoolExecutor(threads) as pool:
        chunks = list(pool.map(lambda i: stage_calls(loaded, gun, events, i * events), range(threads)))
        best = {stage: _fastest([calls[stage] for calls in chunks], pool, repeat) for stage in STAGES}
    per_track = {f"{stage}_us": 1e6 * seconds / (events * threads) for stage, seconds in best.items()}
    return Cost(isa=used, threads=threads, **per_track)


def stage_calls(detector: Detector, gun: Gun, events: int, first_event: int = 0) -> dict[str, Callable[[], Any]]:
    """Return a function for each stage that runs it on the tables of the stage before.

    Parameters
    ----------
    detector : Detector
    gun : Gun
    events, first_event : int

    Returns
    -------
    dict of str to callable
        One for each of `STAGES`: ``fit`` with the sides known, ``fit_lr`` with the sides hidden.
    """
    particles = generate(gun, events, SEED, first_event)
    simulated = simulate(detector, particles, seed=SEED)
    truths, steps, wire_truths = (simulated[name] for name in ("truths", "steps", "wire_truths"))
    shown, hidden = DigitizeSettings(reveal_sides=True), DigitizeSettings()
    digis = digitize(detector, truths, wire_truths, hidden, SEED, steps=steps)["digis"]
    clusters = cluster(detector, digis)
    wire_hits = {
        sides: digitize(detector, truths, wire_truths, sides, SEED, steps=steps)["wire_hits"]
        for sides in (shown, hidden)
    }

    def candidates() -> dict[str, Table]:
        return truth.by_truth(detector, particles, clusters, wire_hits[hidden], truths, wire_truths)

    found = candidates()
    chosen = found["candidates"], found["candidate_hits"]

    def whole(sides: DigitizeSettings) -> Callable[[], Any]:
        return lambda: fit(detector, clusters, wire_hits[sides], *chosen, _FIT)

    def kernel(sides: DigitizeSettings, settings: FitSettings) -> Callable[[], Any]:
        start = smeared(helix.at_origin_in(particles, compiled(detector).field), particles, SEED)
        hits = collect_hits(detector, *chosen, clusters, wire_hits[sides])
        arguments = fit_arguments(detector, hits, particles["mass"], start, settings)
        return lambda: _core.fit(**arguments)

    transport = simulate_arguments(detector, particles, SimulateSettings(), SEED)
    return {
        "simulate": lambda: simulate(detector, particles, seed=SEED),
        "digitize": lambda: digitize(detector, truths, wire_truths, hidden, SEED, steps=steps),
        "cluster": lambda: cluster(detector, digis),
        "find": candidates,
        "fit": whole(shown),
        "fit_lr": whole(hidden),
        "simulate_kernel": lambda: _core.simulate(**transport),
        "fit_kernel": kernel(shown, _TWO_ITERATIONS),
        "fit_lr_kernel": kernel(hidden, _FIT),
    }


def smeared(truth: Floats, particles: Table, seed: int, sigma: Sequence[float] = SMEARING) -> Floats:
    """Return smeared true helices as starting helices of fits.

    Parameters
    ----------
    truth : ndarray, (n, 5) float64
    particles : Table of kind "particles"
        Whose random streams are used.
    seed : int
    sigma : sequence of float
        Standard deviations: dr mm, phi0 rad, kappa relative, dz mm, tanl.

    Returns
    -------
    ndarray, (n, 5) float64
    """
    purpose = _core.Purpose.fit_seed
    draws = [_core.normals(seed, particles["event"], particles["particle"], purpose, place) for place in (0, 1)]
    scale = np.array(sigma) * np.where(np.arange(5) == 2, np.abs(truth[:, 2:3]), 1.0)
    return truth + scale * np.concatenate(draws, axis=1)[:, :5]


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
