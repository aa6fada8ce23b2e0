"""`run`: the chain on all chunks of events, and `run_chunk`: the stages on one."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any, Literal

from cgemit.base.errors import Problems, did_you_mean
from cgemit.base.files import new_folder
from cgemit.base.settings import check_numbers
from cgemit.chain.executor import MANY, PROBE, PROBED, Answer, Totals, answers, check_chunk, check_disk, workers_of
from cgemit.chain.match import match
from cgemit.chain.record import table_meta, write_about
from cgemit.chain.result import Result
from cgemit.chain.result import open as open_run
from cgemit.chain.settings import (
    BY_STAGE,
    FINDERS,
    STAGES,
    TABLES,
    FinderLike,
    Settings,
    detectors_of,
    expected_settings,
    fit_settings,
    with_readout,
)
from cgemit.detector import Detector, load
from cgemit.detector.drift import check_wire_times
from cgemit.detector.readouts import Readout
from cgemit.particles.gun import Guns, Source, generate, source_of
from cgemit.reconstruction.candidates import by_finder, finder_name
from cgemit.reconstruction.cluster import cluster, clusterer_of
from cgemit.reconstruction.find.ckf import find_tracks
from cgemit.reconstruction.find.truth import by_truth
from cgemit.reconstruction.fit import corrected, fit
from cgemit.reconstruction.refine import along_tracks, expected, times_along_tracks
from cgemit.simulation.background import add_background
from cgemit.simulation.digitize import digitize
from cgemit.simulation.transport import simulate, transport_counts
from cgemit.tables import Table, concatenate
from cgemit.tables.formats import check_format
from cgemit.tables.store import PartsWriter, StoredTables
from cgemit.tables.table import without_links


def tables_made(until: str, settings: Settings) -> tuple[str, ...]:
    """Return the tables that a run makes.

    Parameters
    ----------
    until : str
        Its last stage.
    settings : Settings
    """
    made = {name for names in BY_STAGE[: STAGES.index(until) + 1] for name in names}
    if until == "fit":
        made |= {name for name in ("residuals", "states") if getattr(settings.fit, name)}
        made |= {"start_times"} if settings.fit.start_time == "fitted" else set()
    return tuple(name for name in TABLES if name in made)


def check_calibration(detector: Detector | None, settings: Settings | None, until: object) -> None:
    """Raise an error if the read-out needs a calibration that there is not, before anything is simulated."""
    if detector is not None and settings is not None and until in STAGES[2:]:
        clusterer_of(settings.digitize.readout).check(detector)


def check_raw_times(detector: Detector | None, settings: Settings | None, until: object) -> None:
    """Raise an error if raw drift times are asked for and the detector does not say how signals run along its wires."""
    if detector is not None and settings is not None and settings.digitize.wire_times == "raw" and until in STAGES[1:]:
        check_wire_times(detector)


def check_stages(
    finder: object, until: object, executor: Executor | None, keep: Any, settings: Settings | None
) -> tuple[str, ...] | None:
    """Raise an error if a run cannot be as asked for; return the tables to be kept, None for all."""
    problems = []
    names = [keep] if isinstance(keep, str) else [] if keep is None else list(keep)
    problems += [
        f"keep: got {name!r:.50}, expected some of {', '.join(TABLES)}{did_you_mean(str(name), TABLES, '; ')}"
        for name in names
        if name not in TABLES
    ]
    if keep is not None and not names:
        problems.append("keep: got no table, expected at least one")
    if not callable(finder) and finder not in FINDERS:
        problems.append(
            f"finder: got {finder!r}, expected 'truth', 'ckf' or a function of (detector, clusters, wire_hits)"
        )
    if until not in STAGES:
        problems.append(f"until: got {until!r}, expected one of {', '.join(map(repr, STAGES))}")
    elif settings is not None:
        made = tables_made(str(until), settings)
        missing = [name for name in names if name in TABLES and name not in made]
        if missing:
            problems.append(f"keep: got {', '.join(missing)}, which this run does not make, only {', '.join(made)}")
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
    return None if keep is None else (*names, *(["matches"] if "tracks" in names else []))


def run_chunk(
    detector: Detector,
    fit_detector: Detector,
    particles: Table,
    settings: Settings,
    seed: int,
    finder: FinderLike = "truth",
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
    finder : "truth", "ckf" or callable
    until : str
        The last stage, one of `cgemit.chain.settings.STAGES`. After the fit, tracks are matched with particles.

    Returns
    -------
    tables : dict of str to Table
    timings : dict of str to float, s
        Wall time of each stage.
    """
    tables: dict[str, Table] = {}
    raw_times = settings.digitize.wire_times == "raw"
    raw_hits: list[Table] = []  # before they are corrected

    def pick(*names: str) -> tuple[Any, ...]:
        return tuple(tables[name] for name in names)

    hits, truth, found = ("clusters", "wire_hits"), ("truths", "wire_truths"), ("candidates", "candidate_hits")

    def find_in(wire_hits: Table) -> Mapping[str, Table]:
        if callable(finder):
            return by_finder(finder, fit_detector, tables["clusters"], wire_hits)
        if finder == "ckf":
            return find_tracks(fit_detector, tables["clusters"], wire_hits, settings.find)
        return by_truth(detector, *pick("particles", *hits, *truth))

    def find_first() -> Mapping[str, Table]:
        if not raw_times:
            return find_in(tables["wire_hits"])
        raw_hits.append(tables["wire_hits"])
        wire_hits = expected(fit_detector, tables["wire_hits"])
        return {"wire_hits": wire_hits, **find_in(wire_hits)}

    def find_again() -> Mapping[str, Table]:
        fitted = fit_and_correct()
        if "start_times" in fitted:
            return find_in(corrected(tables["wire_hits"], fitted["start_times"]))
        return find_in(tables["wire_hits"])

    def fit_clusters(clusters: Table) -> Mapping[str, Table]:
        candidates, candidate_hits = pick(*found)
        return fit(fit_detector, clusters, tables["wire_hits"], candidates, candidate_hits, fit_settings(settings))

    def fit_and_correct() -> Mapping[str, Table]:
        fitted = fit_clusters(tables["clusters"])
        if raw_times:
            candidates, candidate_hits = pick(*found)
            tables["wire_hits"] = times_along_tracks(
                fit_detector, raw_hits[0], candidates, candidate_hits, fitted["tracks"]
            )
        return fitted

    def fit_last() -> Mapping[str, Table]:
        if raw_times:
            fit_and_correct()
        return fit_clusters(tables["clusters"])

    def second_pass() -> Mapping[str, Table]:
        readout, hits = settings.digitize.readout, tables["candidate_hits"]
        digis, clusters, tracks = pick("digis", "clusters", "tracks")
        again = along_tracks(detector, readout, digis, clusters, hits, tracks, settings.cluster)
        return {"clusters": again, **fit_clusters(again)}

    stages: dict[str, Callable[[], Mapping[str, Table]]] = {
        "simulate": lambda: simulate(detector, particles, settings.simulate, seed),
        "digitize": lambda: add_background(
            detector,
            **digitize(
                detector, tables["truths"], tables["wire_truths"], settings.digitize, seed, steps=tables["steps"]
            ),
            settings=settings.background,
            seed=seed,
        ),
        "cluster": lambda: {
            "clusters": cluster(detector, tables["digis"], settings.cluster, readout=settings.digitize.readout)
        },
        "find": find_first,
        "fit": fit_last,
        "match": lambda: match(*pick("tracks", *found, *hits, "particles", *truth), detector=detector),
    }  # fmt: skip
    if (raw_times or settings.fit.start_time == "fitted") and finder != "truth" and until == "fit":
        rest = {name: stages.pop(name) for name in ("fit", "match")}
        stages |= {"find again": find_again, **rest}
    if clusterer_of(settings.digitize.readout).follows_tracks:
        last = stages.pop("match")
        stages |= {"second pass": second_pass, "match": last}
    seconds = {}
    for stage, work in stages.items():
        start = time.perf_counter()
        tables |= work()
        seconds[stage] = time.perf_counter() - start
        if stage == until != "fit":
            break
    return tables, seconds


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
    gun : Gun, sample, or particles in any form that `cgemit.particles.table.particles_from` takes
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
