"""The chain: particles -> truths -> digis -> clusters -> candidates -> tracks, chunk by chunk, on one screen."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import fields, replace
from typing import Any, Literal

from cgemit import find
from cgemit.candidates import Finder, by_finder, finder_name
from cgemit.detector import Detector, load
from cgemit.digitize import DigitizeSettings, Readout, cluster_digis, digitize
from cgemit.fit import FitSettings, fit
from cgemit.gun import Gun, Guns, generate
from cgemit.match import match
from cgemit.memory import check_memory
from cgemit.particles import particles_from
from cgemit.record import configuration_of, gun_data
from cgemit.result import TABLES, Result, Settings, detectors_of
from cgemit.simulate import simulate
from cgemit.tables import Table, concatenate
from cgemit.values import check_numbers
from cgemit.version import VERSION

#: From this many chunks on, the first one tells whether all fit into memory before the others begin.
MANY = 64

STAGES = ("simulate", "digitize", "cluster", "find", "fit")  # where a run can end


def run_chunk(
    detector: Detector,
    fit_detector: Detector,
    particles: Table,
    settings: Settings,
    seed: int,
    finder: Finder | Literal["truth"] = "truth",
    until: str = "fit",
) -> tuple[dict[str, Table], dict[str, float]]:
    """Run the stages on the events of one table of particles.

    Parameters
    ----------
    detector, fit_detector : Detector
        The detector that is simulated and digitized, and the one that finder and fit assume.
    particles : Table of kind "particles"
    settings : Settings
    seed : int
    finder : "truth" or callable
    until : str
        The last stage, one of `STAGES`. After the fit, tracks are matched with particles.

    Returns
    -------
    tables : dict of str to Table
    timings : dict of str to float, s
        Wall time of each stage.
    """
    tables: dict[str, Table] = {}

    def pick(*names: str) -> tuple[Any, ...]:
        return tuple(tables[name] for name in names)

    hits, truth, found = ("clusters", "wire_hits"), ("truths", "wire_truths"), ("candidates", "candidate_hits")
    stages: dict[str, Callable[[], Mapping[str, Table]]] = {
        "simulate": lambda: simulate(detector, particles, settings.simulate, seed),
        "digitize": lambda: digitize(
            detector, tables["truths"], tables["wire_truths"], settings.digitize, seed, steps=tables["steps"]
        ),
        "cluster": lambda: {
            "clusters": cluster_digis(detector, tables["digis"], settings.digitize, settings.cluster)
        },
        "find": lambda: (
            by_finder(finder, fit_detector, tables["clusters"], tables["wire_hits"])
            if callable(finder)
            else find.by_truth(detector, *pick("particles", *hits, *truth))
        ),
        "fit": lambda: fit(
            fit_detector, tables["clusters"], tables["wire_hits"], tables["candidates"], tables["candidate_hits"],
            fit_settings(settings),
        ),
        "match": lambda: match(*pick("tracks", *found, *hits, "particles", *truth), detector=detector),
    }  # fmt: skip
    seconds = {}
    for stage, work in stages.items():
        start = time.perf_counter()
        tables |= work()
        seconds[stage] = time.perf_counter() - start
        if stage == until != "fit":
            break
    return tables, seconds


def fit_settings(settings: Settings) -> FitSettings:
    """Return the settings of the fit; a screening of None becomes the simulated one.

    Parameters
    ----------
    settings : Settings
    """
    return settings.fit if settings.fit.screening else replace(settings.fit, screening=settings.simulate.screening)


def run(
    detector: Detector | str | Mapping[str, Any],
    gun: Gun | Guns | Any,
    n: int | None = None,
    seed: int = 1,
    *,
    settings: Settings | None = None,
    readout: Readout | str | None = None,
    fit_detector: Detector | str | Mapping[str, Any] | None = None,
    finder: Finder | Literal["truth"] = "truth",
    until: Literal["simulate", "digitize", "cluster", "find", "fit"] = "fit",
    threads: int | None = None,
    executor: Executor | None = None,
    chunk: int = 1000,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Simulate, digitize, cluster, find and fit events, and match the tracks with the particles.

    Results depend on detector, gun, settings, finder and seed, not on threads or chunks.

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
    readout : Readout, str or None
        Read-out of the CGEM layers, instead of that of the settings. A read-out that starts from ionization clusters
        makes them rows of ``steps``.
    fit_detector : Detector or None
        Detector that finder and fit assume. None: the simulated one.
    finder : "truth" or callable
        ``"truth"`` gives each charged particle its own hits. A function of (detector, clusters, wire_hits) returns a
        mapping with the tables ``candidates`` and ``candidate_hits`` (`label_candidates` makes them). It is called for
        each chunk, in several threads at a time.
    until : str
        The last stage that runs. Tables of later stages are None in the result.
    threads : int or None
        Threads of the pool; all cores if None. Ignored with `executor`.
    executor : concurrent.futures.Executor or None
        Runs the chunks instead of a thread pool made here.
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
        Listing every problem of detector, gun, numbers, finder or `until`.
    TypeError
        If `settings` are not of all stages, or the finder cannot be sent to other processes.
    """
    start = time.perf_counter()
    if not isinstance(settings, Settings | None):
        raise TypeError(f"settings: got {type(settings).__name__}, expected {_expected(settings)}")
    detector, settings = load(detector), with_readout(settings or Settings(), readout)
    believed = detector if fit_detector is None else load(fit_detector)
    other = None if believed == detector else believed
    most = 2**31 - 1
    check_numbers("run", seed, threads, n=(n, 0, most), chunk=(chunk, 1, most))
    _check_stages(finder, until, executor)
    shooter, n_events, table = _source(gun, n)

    def task(first: int) -> tuple[Any, ...]:
        count = min(chunk, n_events - first)
        return (detector, believed, shooter, table, first, count, settings, seed, finder, until)

    tasks = [task(first) for first in range(0, n_events, chunk)] or [task(0)]
    parts = _map(tasks, threads, executor, progress, n_events)
    meta = _meta(detector, other, shooter, settings, seed)
    joined = concatenate([part[0] for part in parts], gaps=table is not None)
    tables = {name: joined[name].with_meta(**meta) for name in TABLES if name in joined}
    timings = {stage: sum(part[1][stage] for part in parts) for stage in parts[0][1]}
    timings["wall"] = time.perf_counter() - start
    return Result(
        detector=detector,
        fit_detector=other,
        gun=shooter,
        seed=seed,
        settings=settings,
        tables=tables,
        timings=timings,
    )


def with_readout(settings: Settings, readout: Readout | str | None) -> Settings:
    """Return settings with another read-out, and with the ionization clusters that it needs.

    Parameters
    ----------
    settings : Settings
    readout : Readout, str or None
        None: that of the settings.

    Raises
    ------
    ValueError
        If the read-out is unknown, or the simulation cannot make what it needs.
    """
    if readout is not None:
        digitized = DigitizeSettings(readout=readout, reveal_sides=settings.digitize.reveal_sides)
        settings = replace(settings, digitize=digitized)
    if getattr(settings.digitize.readout, "needs_clusters", False) and not settings.simulate.steps:
        settings = replace(settings, simulate=replace(settings.simulate, steps=True))
    return settings


def _check_stages(finder: object, until: object, executor: Executor | None) -> None:
    problems = []
    if not callable(finder) and finder != "truth":
        problems.append(f"finder: got {finder!r}, expected 'truth' or a function of (detector, clusters, wire_hits)")
    if until not in STAGES:
        problems.append(f"until: got {until!r}, expected one of {', '.join(map(repr, STAGES))}")
    if problems:
        raise ValueError("run:\n  " + "\n  ".join(problems))
    if callable(finder) and isinstance(executor, ProcessPoolExecutor):
        try:
            pickle.dumps(finder)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise TypeError(
                f"finder: got {finder_name(finder)}, which cannot be sent to other processes ({error}); "
                "expected a function of a module, or an executor of threads"
            ) from error


def _expected(given: object) -> str:
    """Return the expected form of settings; those of one stage go into `Settings`."""
    stage = next((f.name for f in fields(Settings) if type(given) is f.default_factory), "")
    return f"Settings({stage}=...)" if stage else "Settings(simulate=..., digitize=..., cluster=..., fit=...)"


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
    finder: Finder | Literal["truth"],
    until: str,
) -> tuple[dict[str, Table], dict[str, float]]:
    if gun is not None:
        particles = generate(gun, count, seed, first)
    else:
        assert table is not None
        numbers = table.events[first : first + count]
        particles = table.select_events(int(numbers[0]), int(numbers[-1]) + 1) if count else table
    return run_chunk(detector, believed, particles, settings, seed, finder, until)


def _map(
    tasks: list[tuple[Any, ...]],
    threads: int | None,
    executor: Executor | None,
    progress: Callable[[float], None] | None,
    n_events: int,
) -> list[tuple[dict[str, Table], dict[str, float]]]:
    """Run the tasks on the executor and return the answers in order; an interrupt leaves nothing running."""
    pool = executor or ThreadPoolExecutor(threads or os.cpu_count())
    futures: list[Future[tuple[dict[str, Table], dict[str, float]]]] = []
    try:
        if len(tasks) > MANY:
            futures = [pool.submit(_work, *tasks[0])]
            first = futures[0].result()[0]
            check_memory(first, first["particles"].n_events, n_events)
        futures += [pool.submit(_work, *task) for task in tasks[len(futures) :]]
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
    detector: Detector, fit_detector: Detector | None, gun: Gun | Guns | None, settings: Settings, seed: int
) -> dict[str, Any]:
    texts = {name: one.to_toml() for name, one in detectors_of(detector, fit_detector).items()}
    return {
        "version": VERSION,
        "configuration": configuration_of(texts, settings.to_dict(), gun_data(gun)),
        "detector": detector.name,
        "seed": seed,
    }
