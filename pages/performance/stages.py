"""Cost per track of each stage: by instruction set and threads, by number of events; and its memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgemit import _core, helix
from cgemit.base.arrays import Floats
from cgemit.base.isa import available
from cgemit.chain.executor import PARTICLES
from cgemit.chain.run import Job, run_chunk
from cgemit.chain.settings import Settings
from cgemit.detector import Detector, compiled, load
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.fit import FitSettings, fit
from cgemit.reconstruction.fit import core_arguments as fit_arguments
from cgemit.simulation.digitize import DigitizeSettings, digitize
from cgemit.simulation.transport import SimulateSettings, simulate
from cgemit.simulation.transport import core_arguments as simulate_arguments
from cgemit.tables import Table
from cgemit.truth import finder
from pages.page import Numbers
from pages.performance.timing import DETECTOR, GUN, SEED, fastest, instruction_set, machine, product_us

#: The timed stages in the order of the chain; `_kernel`: the compiled core alone, on prepared arrays.
STAGES = (
    "simulate", "digitize", "cluster", "find", "fit", "fit_lr", "simulate_kernel", "fit_kernel", "fit_lr_kernel"
)  # fmt: skip
CHAIN = ("simulate", "digitize", "cluster", "find", "fit", "match")
SMEARING = (1.0, 0.005, 0.02, 5.0, 0.005)
"""Smearing of a given starting helix: dr mm, phi0 rad, kappa relative, dz mm, tanl."""
EVENTS, RUNS, THREADS = 2000, 30, (1, 2)
COUNTS = (100, 1000, 10_000, 100_000, 1_000_000)
MEMORY_COUNTS = (10_000, 40_000)
MEMORY_CASES = {"tables of all stages": False, "and residuals of all hits": True}

ALL_HITS = FitSettings(residuals=True)
TWO_ITERATIONS = FitSettings(residuals=True, max_iterations=2, tolerance=1e-12)


@dataclass(frozen=True)
class Cost:
    """Wall time per track of each of `STAGES`, us.

    `fit` includes the smoother, with the sides of the wires known (`fit_lr`: unknown); the hits provide the starting
    helix. The kernels are the compiled core alone, the fit started from the smeared true helix: two iterations with the
    sides known, as many as needed with the sides unknown.
    """

    isa: str
    threads: int
    simulate_us: float
    digitize_us: float
    cluster_us: float
    find_us: float
    fit_us: float
    fit_lr_us: float
    simulate_kernel_us: float
    fit_kernel_us: float
    fit_lr_kernel_us: float


@dataclass(frozen=True)
class Chain:
    """Wall time per track of each stage of the chain for a number of events, and of a product of matrices; us."""

    events: int
    simulate: float
    digitize: float
    cluster: float
    find: float
    fit: float
    match: float
    all: float
    product: float


def stage_times(threads: int, events: int = EVENTS, runs: int = RUNS) -> dict[str, float]:
    """Return the us per track of each stage; each thread runs it on events of its own."""
    detector = load(DETECTOR)
    with ThreadPoolExecutor(threads) as pool:
        chunks = list(pool.map(lambda i: stage_calls(detector, GUN, events, i * events), range(threads)))

        def together(stage: str) -> Callable[[], object]:
            return lambda: [done.result() for done in [pool.submit(calls[stage]) for calls in chunks]]

        best: dict[str, float] = {}
        for stage in STAGES:
            together(stage)()
            best |= fastest({stage: together(stage)}, runs, time.perf_counter)
    return {f"{stage}_us": 1e6 * seconds / (events * threads) for stage, seconds in best.items()}


def measure_stages(_share: float) -> Numbers:
    """Measure the stages for every instruction set and number of threads."""
    rows = []
    for isa in available():
        with instruction_set(isa):
            rows += [Cost(isa, threads, **stage_times(threads)) for threads in THREADS]
    return Numbers(rows, {"machine": machine()})


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
        return finder.by_truth(detector, particles, clusters, wire_hits[hidden], truths, wire_truths)

    found = candidates()
    chosen = found["candidates"], found["candidate_hits"]

    def whole(sides: DigitizeSettings) -> Callable[[], Any]:
        return lambda: fit(detector, clusters, wire_hits[sides], *chosen, ALL_HITS)

    def kernel(sides: DigitizeSettings, settings: FitSettings) -> Callable[[], Any]:
        start = smeared(helix.at_origin_in(particles, compiled(detector).field), particles, SEED)
        hits = collect_hits(detector, *chosen, clusters, wire_hits[sides])
        arguments = fit_arguments(detector, hits, particles["mass"], start, settings)
        return lambda: _core.reconstruction.fit(**arguments)

    transport = simulate_arguments(detector, particles, SimulateSettings(), SEED)
    return {
        "simulate": lambda: simulate(detector, particles, seed=SEED),
        "digitize": lambda: digitize(detector, truths, wire_truths, hidden, SEED, steps=steps),
        "cluster": lambda: cluster(detector, digis),
        "find": candidates,
        "fit": whole(shown),
        "fit_lr": whole(hidden),
        "simulate_kernel": lambda: _core.simulation.simulate(**transport),
        "fit_kernel": kernel(shown, TWO_ITERATIONS),
        "fit_lr_kernel": kernel(hidden, ALL_HITS),
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
    purpose = _core.common.Purpose.fit_seed
    draws = [_core.common.normals(seed, particles["event"], particles["particle"], purpose, place) for place in (0, 1)]
    scale = np.array(sigma) * np.where(np.arange(5) == 2, np.abs(truth[:, 2:3]), 1.0)
    return truth + scale * np.concatenate(draws, axis=1)[:, :5]


def chain_times(events: int) -> dict[str, float]:
    """Return us per track of each stage and of all, for so many events; tables of a chunk are dropped."""
    detector, settings = load(DETECTOR), Settings(fit=ALL_HITS)
    job = Job(detector, detector, GUN, None, None, settings, SEED, "truth", "fit", None)
    seconds = dict.fromkeys((*CHAIN, "all"), 0.0)
    start = time.perf_counter()
    for first in range(0, events, PARTICLES):
        particles = generate(GUN, min(PARTICLES, events - first), SEED, first)
        for stage, spent in run_chunk(job, particles)[1].items():
            seconds[stage] += spent
    seconds["all"] = time.perf_counter() - start
    return {stage: 1e6 * value / events for stage, value in seconds.items()}


def measure_chain(_share: float) -> Numbers:
    """Measure the chain for all numbers of events; the first run builds what is then kept."""
    chain_times(PARTICLES)
    rows = []
    for events in COUNTS:
        before = product_us(time.perf_counter)
        times = chain_times(events)
        rows.append(Chain(events, **times, product=min(before, product_us(time.perf_counter))))
    return Numbers(rows)
