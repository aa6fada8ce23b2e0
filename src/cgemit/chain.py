"""The chain: particles -> truths -> digis -> clusters -> tracks, chunk by chunk, on one screen."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from cgemit import find
from cgemit.cluster import ClusterSettings, cluster
from cgemit.detector import Detector, load
from cgemit.digitize import DigitizeSettings, digitize
from cgemit.fit import FitSettings, FitStatus, fit
from cgemit.gun import Gun, Guns, generate
from cgemit.particles import particles_from
from cgemit.simulate import SimulateSettings, TransportStatus, simulate
from cgemit.tables import Table, concatenate, save_tables

TABLES = ("particles", "truths", "wire_truths", "digis", "wire_hits", "clusters", "tracks", "residuals")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of all stages."""

    simulate: SimulateSettings = field(default_factory=SimulateSettings)
    digitize: DigitizeSettings = field(default_factory=DigitizeSettings)
    cluster: ClusterSettings = field(default_factory=ClusterSettings)
    fit: FitSettings = field(default_factory=FitSettings)


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
    tables |= digitize(detector, tables["truths"], tables["wire_truths"], settings.digitize, seed)
    clock.stop("digitize")
    if "clusters" not in tables:  # the gaussian read-out has no strips to cluster
        tables["clusters"] = cluster(detector, tables["digis"], settings.cluster)
    clock.stop("cluster")
    candidates = find.by_truth(
        *(tables[name] for name in ("particles", "clusters", "wire_hits", "truths", "wire_truths"))
    )
    clock.stop("find")
    tables |= fit(
        fit_detector, tables["particles"], tables["clusters"], tables["wire_hits"], candidates, settings.fit, seed
    )
    clock.stop("fit")
    return tables, clock.seconds


@dataclass(frozen=True, eq=False)
class Result:
    """All tables of a run, and what made them."""

    detector: Detector
    gun: Gun | Guns | None
    seed: int
    settings: Settings
    particles: Table
    truths: Table
    wire_truths: Table
    digis: Table
    wire_hits: Table
    clusters: Table
    tracks: Table
    residuals: Table | None
    timings: Mapping[str, float]
    """Seconds of each stage, summed over chunks, and `wall`, from start to end."""

    @property
    def tables(self) -> dict[str, Table]:
        """The tables by name."""
        return {name: getattr(self, name) for name in TABLES if getattr(self, name) is not None}

    def __eq__(self, other: object) -> bool:
        """Compare everything but the timings."""
        if not isinstance(other, Result):
            return NotImplemented
        mine, theirs = ((r.detector, r.gun, r.seed, r.settings, r.tables) for r in (self, other))
        return mine == theirs

    def removed(self) -> dict[str, int]:
        """Count the tracks of each status other than ok."""
        status = self.tracks["status"]
        return {s.name: n for s in FitStatus if s != FitStatus.ok and (n := int((status == s).sum()))}

    def transport(self) -> dict[str, int]:
        """Count the particles of each transport status."""
        status = self.particles["status"]
        return {s.name: n for s in TransportStatus if (n := int((status == s).sum()))}

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Write every table to a folder, as .npz with JSON beside it.

        Parameters
        ----------
        folder : path
        overwrite : bool
            Whether files of these names may be replaced.

        Returns
        -------
        list of Path
        """
        return save_tables(self.tables, folder, overwrite=overwrite)

    def _summary(self) -> list[tuple[str, str]]:
        shots = f"{self.gun!r}" if self.gun is not None else "given particles"
        rows = [("detector", self.detector.name), ("gun", shots), ("seed", str(self.seed))]
        rows.append(("events", f"{self.particles.n_events:,}"))
        rows.append(("transport", ", ".join(f"{n:,} {name}" for name, n in self.transport().items())))
        removed = ", ".join(f"{n:,} {name}" for name, n in self.removed().items()) or "none"
        rows.append(("tracks", f"{len(self.tracks):,} (not fitted: {removed})"))
        rows.append(("rows", ", ".join(f"{name} {len(table):,}" for name, table in self.tables.items())))
        rows.append(("hits", "assigned by truth"))
        rows.append(("time", f"{self.timings['wall']:.2f} s"))
        return rows

    def __repr__(self) -> str:
        return "\n".join(["Result", *(f"  {name:<10}{text}" for name, text in self._summary())])

    def _repr_html_(self) -> str:
        from html import escape

        rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self._summary())
        return f"<table>{rows}</table>"


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
    settings : Settings or None
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
    """
    start = time.perf_counter()
    detector, settings = load(detector), settings or Settings()
    believed = detector if fit_detector is None else load(fit_detector)
    shooter, n_events, table = _source(gun, n)
    for name, value in (("chunk", chunk), ("threads", threads)):
        if value is not None and value < 1:
            raise ValueError(f"{name}: {value}, expected at least 1")

    def task(first: int) -> tuple[Any, ...]:
        count = min(chunk, n_events - first)
        return (detector, believed, shooter, table, first, count, settings, seed)

    tasks = [task(first) for first in range(0, n_events, chunk)] or [task(0)]
    parts = _map(tasks, threads, executor, progress)
    tables = concatenate([part[0] for part in parts])
    meta = _meta(detector, believed, shooter, settings, seed)
    timings = {stage: sum(part[1][stage] for part in parts) for stage in parts[0][1]}
    tables = {name: t.with_meta(**meta) for name, t in tables.items()}
    timings["wall"] = time.perf_counter() - start
    return Result(
        detector=detector,
        gun=shooter,
        seed=seed,
        settings=settings,
        particles=tables["particles"],
        truths=tables["truths"],
        wire_truths=tables["wire_truths"],
        digis=tables["digis"],
        wire_hits=tables["wire_hits"],
        clusters=tables["clusters"],
        tracks=tables["tracks"],
        residuals=tables.get("residuals"),
        timings=timings,
    )


def _source(gun: Any, n: int | None) -> tuple[Gun | Guns | None, int, Table | None]:
    if isinstance(gun, Gun | Guns):
        count = 1000 if n is None else n
        if count < 0:
            raise ValueError(f"n: {n}, expected a number of events, 0 or more")
        return gun, count, None
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
        "version": version("cgemit"),
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
