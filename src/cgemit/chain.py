"""The chain: particles -> truths -> digis -> clusters -> tracks, chunk by chunk, on one screen."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from dataclasses import fields, replace
from typing import Any

import numpy as np

from cgemit import find
from cgemit.detector import Detector, load
from cgemit.digitize import digitize
from cgemit.fit import fit
from cgemit.gun import Gun, Guns, generate
from cgemit.particles import particles_from
from cgemit.result import Result, Settings
from cgemit.simulate import simulate
from cgemit.tables import Table, concatenate
from cgemit.version import VERSION


def run_chunk(
    detector: Detector, fit_detector: Detector, particles: Table, settings: Settings, seed: int
) -> tuple[dict[str, Table], dict[str, float]]:
    """Run every stage on the events of one table of particles.

    Parameters
    ----------
    detector, fit_detector : Detector
        What is simulated and digitized, and what the fit believes.
    particles : Table of kind "particles"
    settings : Settings
    seed : int

    Returns
    -------
    tables : dict of str to Table
    timings : dict of str to float, s
        Wall time of each stage.
    """
    clock = _Clock()
    tables = simulate(detector, particles, settings.simulate, seed)
    clock.stop("simulate")
    tables |= digitize(
        detector, tables["truths"], tables["wire_truths"], settings.digitize, seed, steps=tables["steps"]
    )
    clock.stop("digitize")
    tables["clusters"] = settings.digitize.readout.cluster(detector, tables["digis"], settings.cluster)
    clock.stop("cluster")
    names = ("particles", "clusters", "wire_hits", "truths", "wire_truths")
    candidates = find.by_truth(detector, *(tables[name] for name in names))
    clock.stop("find")
    tables |= fit(
        fit_detector,
        tables["particles"],
        tables["clusters"],
        tables["wire_hits"],
        candidates,
        settings.fit if settings.fit.screening else replace(settings.fit, screening=settings.simulate.screening),
        seed,
        simulated=detector,
    )
    clock.stop("fit")
    return tables, clock.seconds


def run(
    detector: Detector | str | Mapping[str, Any],
    gun: Gun | Guns | Any,
    n: int | None = None,
    seed: int = 1,
    *,
    settings: Settings | None = None,
    fit_detector: Detector | str | Mapping[str, Any] | None = None,
    threads: int | None = None,
    executor: Executor | None = None,
    chunk: int = 1000,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Simulate, digitize, cluster and fit events; hits are assigned to tracks by truth.

    Results depend on detector, gun, settings and seed, not on threads or chunks.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    gun : Gun, or a table of particles (Table, DataFrame, dict of arrays, structured array)
    n : int or None
        Number of events; 1000 for a gun if not given. Must be left out when `gun` is a table.
    seed : int
        0 to 2**64 - 1.
    settings : Settings or None
        Of all stages; defaults if None.
    fit_detector : Detector or None
        What the fit assumes, if it shall differ from what is simulated.
    threads : int or None
        Threads of the pool; all cores if None. Ignored with `executor`.
    executor : concurrent.futures.Executor or None
        Where the chunks run, instead of an own thread pool.
    chunk : int
        Events per chunk.
    progress : callable or None
        Called with the fraction done after every chunk.

    Returns
    -------
    Result

    Raises
    ------
    ValueError
        Listing what is wrong with detector, gun or numbers.
    TypeError
        If `settings` are something else, such as those of one stage.
    """
    start = time.perf_counter()
    if not isinstance(settings, Settings | None):
        raise TypeError(f"settings: got {type(settings).__name__}, expected {_expected(settings)}")
    detector, settings = load(detector), settings or Settings()
    believed = detector if fit_detector is None else load(fit_detector)
    most = 2**31 - 1
    check_numbers("run", seed, threads, n=(n, 0, most), chunk=(chunk, 1, most))
    shooter, n_events, table = _source(gun, n)

    def task(first: int) -> tuple[Any, ...]:
        count = min(chunk, n_events - first)
        return (detector, believed, shooter, table, first, count, settings, seed)

    tasks = [task(first) for first in range(0, n_events, chunk)] or [task(0)]
    parts = _map(tasks, threads, executor, progress)
    meta = _meta(detector, believed, shooter, settings, seed)
    tables = {name: table.with_meta(**meta) for name, table in concatenate([part[0] for part in parts]).items()}
    timings = {stage: sum(part[1][stage] for part in parts) for stage in parts[0][1]}
    timings["wall"] = time.perf_counter() - start
    return Result(detector=detector, gun=shooter, seed=seed, settings=settings, timings=timings, **tables)


def _expected(given: object) -> str:
    """Return what settings should look like; those of one stage go into those of all."""
    stage = next((f.name for f in fields(Settings) if type(given) is f.default_factory), "")
    return f"Settings({stage}=...)" if stage else "Settings(simulate=..., digitize=..., cluster=..., fit=...)"


def check_numbers(where: str, seed: int, threads: int | None, **others: tuple[int | None, int, int]) -> None:
    """Check whole numbers; None is good.

    Parameters
    ----------
    where : str
        The first word of the message.
    seed : int
    threads : int or None
    **others : (int or None, int, int)
        More numbers by name, each with its least and most.

    Raises
    ------
    ValueError
        Listing what is wrong.
    """
    numbers = {**others, "seed": (seed, 0, 2**64 - 1), "threads": (threads, 1, 2**15)}
    problems = [
        f"{name}: {value!r}, expected a whole number from {least} to {most}"
        for name, (value, least, most) in numbers.items()
        if value is not None and not (isinstance(value, int | np.integer) and least <= value <= most)
    ]
    if problems:
        raise ValueError(f"{where}:\n  " + "\n  ".join(problems))


def _source(gun: Any, n: int | None) -> tuple[Gun | Guns | None, int, Table | None]:
    if isinstance(gun, Gun | Guns):
        return gun, 1000 if n is None else n, None
    table = particles_from(gun)
    if n is not None and n != table.n_events:
        raise ValueError(f"n: {n}, but the table of particles holds {table.n_events} events; leave n out")
    return None, table.n_events, table


def _work(
    detector: Detector,
    believed: Detector,
    gun: Gun | Guns | None,
    table: Table | None,
    first: int,
    count: int,
    settings: Settings,
    seed: int,
) -> tuple[dict[str, Table], dict[str, float]]:
    if gun is not None:
        particles = generate(gun, count, seed, first)
    else:
        assert table is not None
        begin = table.first_event + first
        particles = table.select_events(begin, begin + count)
    return run_chunk(detector, believed, particles, settings, seed)


def _map(
    tasks: list[tuple[Any, ...]],
    threads: int | None,
    executor: Executor | None,
    progress: Callable[[float], None] | None,
) -> list[tuple[dict[str, Table], dict[str, float]]]:
    """Run the tasks on the executor and return the answers in order; an interrupt leaves nothing running."""
    pool = executor or ThreadPoolExecutor(threads or os.cpu_count())
    futures: list[Future[tuple[dict[str, Table], dict[str, float]]]] = []
    try:
        futures = [pool.submit(_work, *task) for task in tasks]
        for done, _ in enumerate(as_completed(futures), start=1):
            if progress is not None:
                progress(done / len(futures))
        return [future.result() for future in futures]
    finally:
        for future in futures:
            future.cancel()
        if executor is None:
            pool.shutdown()


def _meta(
    detector: Detector, believed: Detector, gun: Gun | Guns | None, settings: Settings, seed: int
) -> dict[str, Any]:
    configuration = repr((detector.to_toml(), believed.to_toml(), gun, settings))
    return {
        "version": VERSION,
        "configuration": hashlib.sha256(configuration.encode()).hexdigest()[:16],
        "detector": detector.name,
        "seed": seed,
    }


class _Clock:
    """Seconds between stops."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def stop(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = now - self._last
        self._last = now
