"""Runs: the chain (`run_chunk`) on all chunks of events."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, Literal

from cgemit.chunks import MANY, Answer, Totals, answers, workers_of
from cgemit.detector import Detector, load
from cgemit.digitize import Readout
from cgemit.gun import Guns, Source, generate, source_of
from cgemit.io.folders import new_folder
from cgemit.memory import PROBE, PROBED, check_chunk, check_disk
from cgemit.problems import Problems
from cgemit.record import table_meta, write_about
from cgemit.result import Result
from cgemit.run_checks import check_calibration, check_raw_times, check_stages
from cgemit.run_chunk import run_chunk
from cgemit.simulate import transport_counts
from cgemit.stages import (
    TABLES,
    FinderLike,
    Settings,
    detectors_of,
    expected_settings,
    with_readout,
)
from cgemit.stored_run import open as open_run
from cgemit.tables import Table, concatenate
from cgemit.tables.formats import check_format
from cgemit.tables.links import without_links
from cgemit.tables.stored import PartsWriter, StoredTables
from cgemit.values import check_numbers


def run(
    detector: Detector | str | Mapping[str, Any],
    gun: Source | Guns | Any,
    n: int | None = None,
    seed: int = 1,
    *,
    settings: Settings | None = None,
    readout: Readout | str | None = None,
    fit_detector: Detector | str | Mapping[str, Any] | None = None,
    finder: FinderLike = "truth",
    until: Literal["simulate", "digitize", "cluster", "find", "fit"] = "fit",
    threads: int | None = None,
    executor: Executor | None = None,
    chunk: int = 1000,
    progress: Callable[[float], None] | None = None,
    keep: Sequence[str] | None = None,
    output: str | os.PathLike[str] | None = None,
    format: str = "npz",
    overwrite: bool = False,
    command: str = "",
) -> Result:
    """Simulate, digitize, cluster, find and fit events, and match the tracks with the particles.

    Results depend on detector, gun, settings, finder and seed, not on threads or chunks. With `output` the memory
    does not depend on the number of events.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    gun : Gun, sample, or particles in any form that `cgemit.particles.particles_from` takes
        A sample is what `cgemit.sample` returns. Particles are a table, data frame, dict of arrays, structured or
        awkward array, or the path of a file, such as ``"events.hepmc"``.
    n : int or None
        Number of events; 1000 for a gun if not given. Must be left out when `gun` is no gun.
    seed : int
        0 to 2**64 - 1.
    settings : Settings or None
        Of all stages; defaults if None.
    readout : Readout, str or None
        Read-out of the CGEM layers, instead of that of the settings. A read-out that starts from ionization clusters
        makes them rows of ``steps``.
    fit_detector : Detector or None
        Detector that finder and fit assume. None: the simulated one.
    finder : "truth", "ckf" or callable
        ``"truth"`` gives each charged particle its own hits. ``"ckf"`` finds tracks from the hits alone, with
        ``settings.find``. A function of (detector, clusters, wire_hits) returns a
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
    keep : sequence of str or None
        Names of the tables in the result; None: all. ``tracks`` brings ``matches``. Links to tables that are not kept
        are -1.
    output : path or None
        Folder to which the tables are written in parts while the run goes on. It appears when all is complete.
        The result is that of `cgemit.open`: it reads its tables when they are asked for.
    format : str
        Of the files in `output`, as for `Result.save`.
    overwrite : bool
        Whether `output` may hold files already.
    command : str
        Command line for run.json in `output`, if there was one.

    Returns
    -------
    Result

    Raises
    ------
    OutputExistsError
        If `output` holds files and `overwrite` is false.
    ValueError
        Listing every problem of detector, gun, numbers, finder, `until` or `keep`, or if the run needs more memory,
        or space on disk, than there is.
    TypeError
        If `settings` are not of all stages, or the finder cannot be sent to other processes.
    """
    start = time.perf_counter()
    if not isinstance(settings, Settings | None):
        raise TypeError(f"settings: got {type(settings).__name__}, expected {expected_settings(settings)}")
    found = Problems("run")
    simulated: Any = found.collect(load, detector)
    given: Any = found.collect(with_readout, settings or Settings(), readout)
    assumed: Any = simulated if fit_detector is None else found.collect(load, fit_detector)
    most = 2**31 - 1
    found.collect(check_numbers, "run", seed, threads, n=(n, 0, most), chunk=(chunk, 1, most))
    kept = found.collect(check_stages, finder, until, executor, keep, given)
    found.collect(check_calibration, simulated, given, until)
    for one in (simulated, assumed) if assumed is not simulated else (simulated,):
        found.collect(check_raw_times, one, given, until)
    source: Any = found.collect(source_of, gun, n)
    if output is not None:
        found.collect(check_format, format)
    found.report()
    other = None if assumed == simulated else assumed
    shooter, n_events, table = source

    def task(first: int) -> tuple[Any, ...]:
        count = min(chunk, n_events - first)
        return (simulated, assumed, shooter, table, first, count, given, seed, finder, until, kept)

    tasks = [task(first) for first in range(0, n_events, chunk)] or [task(0)]
    meta = table_meta(detectors_of(simulated, other), given, seed, shooter)

    def result(tables: Mapping[str, Table], totals: Totals) -> Result:
        transported = None if "particles" in tables else dict(totals.transport)
        timings = {**totals.timings, "wall": time.perf_counter() - start}
        return Result(
            detector=simulated, fit_detector=other, gun=shooter, seed=seed, settings=given, tables=tables,
            timings=timings, transported=transported,
        )  # fmt: skip

    if min(chunk, n_events) > PROBED:
        sample = _work(simulated, assumed, shooter, table, 0, PROBE, given, seed, finder, until, kept)
        check_chunk(sample.sizes, sample.events, min(chunk, n_events), min(len(tasks), workers_of(threads, executor)))
    totals = Totals(progress, len(tasks))
    if output is None:
        parts = answers(_work, tasks, threads, executor, None if len(tasks) <= MANY else n_events)
        joined = concatenate([totals.add(answer) for answer in parts], gaps=table is not None)
        return result({name: joined[name].with_meta(**meta) for name in TABLES if name in joined}, totals)
    with new_folder(output, overwrite=overwrite) as folder:
        writer = PartsWriter(folder, format, gaps=table is not None)
        for answer in answers(_work, tasks, threads, executor, None, pending=True):
            tables = totals.add(answer)
            if writer.add({name: tables[name].with_meta(**meta) for name in TABLES if name in tables}):
                check_disk(folder, writer.size, writer.events, n_events)
        writer.close()
        write_about(folder, result(StoredTables(folder), totals).entries(command))
    return open_run(output)


def _work(
    detector: Detector,
    believed: Detector,
    gun: Source | Guns | None,
    table: Table | None,
    first: int,
    count: int,
    settings: Settings,
    seed: int,
    finder: FinderLike,
    until: str,
    keep: tuple[str, ...] | None,
) -> Answer:
    if gun is not None:
        particles = generate(gun, count, seed, first, detector)
    else:
        assert table is not None
        numbers = table.events[first : first + count]
        particles = table.select_events(int(numbers[0]), int(numbers[-1]) + 1) if count else table
    tables, seconds = run_chunk(detector, believed, particles, settings, seed, finder, until)
    transport = transport_counts(tables["particles"]["status"])
    sizes = {name: sum(column.nbytes for column in one.columns.values()) for name, one in tables.items()}
    if keep is not None:
        kept = {name: tables[name] for name in TABLES if name in tables and name in keep}
        tables = {name: one.with_columns(**without_links(one, kept)) for name, one in kept.items()}
    return Answer(tables, seconds, transport, count, sizes)
