"""`run`: the chain from particles to matched tracks, on all chunks of events."""

from __future__ import annotations

import os
import pickle
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from cgemit.base.errors import Problems, did_you_mean
from cgemit.base.files import new_folder
from cgemit.base.validate import check_numbers
from cgemit.chain.executor import (
    PROBE,
    PROBED,
    Answer,
    Totals,
    Workers,
    answers,
    at_a_time,
    check_chunk,
    check_disk,
    check_memory,
    chunk_for,
)
from cgemit.chain.finders import FINDERS, Truths, finder_by_name, truth_finder
from cgemit.chain.record import table_meta, write_about
from cgemit.chain.result import Result
from cgemit.chain.result import open as open_run
from cgemit.chain.settings import (
    STAGES,
    TABLES,
    FinderLike,
    Settings,
    detectors_of,
    expected_settings,
    fit_settings,
    for_run,
    refinements_of,
    tables_made,
)
from cgemit.detector import Detector, load
from cgemit.detector.drift import check_wire_times, read_by
from cgemit.detector.reader import readout_of
from cgemit.detector.readouts import Readout
from cgemit.particles.gun import Guns, Source, generate, source_of
from cgemit.particles.samples import EventSample
from cgemit.reconstruction.candidates import Finder, finder_name
from cgemit.reconstruction.cluster import cluster, clusterer_of, warn_of_losses
from cgemit.reconstruction.finders import HIT_FINDERS
from cgemit.reconstruction.reconstruct import turns
from cgemit.reconstruction.refine import Hits
from cgemit.simulation.background import add_background
from cgemit.simulation.digitize import digitize
from cgemit.simulation.transport import transport, transport_counts
from cgemit.tables import Table
from cgemit.tables.formats import check_format
from cgemit.tables.store import JoinedTables, PartsWriter, StoredTables
from cgemit.tables.table import without_links
from cgemit.truth.match import match

Tables = dict[str, Table]


@dataclass(frozen=True)
class Output:
    """Where and how a run writes its tables while it goes on.

    Attributes
    ----------
    folder : path
        It appears when all is complete.
    format : str
        Of the files, as for `Result.save`.
    overwrite : bool
        Whether to replace the results in a folder that holds nothing else.
    command : str
        Command line for run.json, if there was one.

    Examples
    --------
    >>> gun, output = cg.Gun("mu-", p=1.0, cos_theta=0.0), cg.Output("muons", format="npz", overwrite=True)
    >>> result = cg.run("besiii-cgem", gun, n=20, keep=["tracks"], output=output)
    >>> len(cg.open("muons").tracks)
    20
    """

    folder: str | os.PathLike[str]
    format: str = "npz"
    overwrite: bool = False
    command: str = ""


class Job(NamedTuple):
    """What every chunk of a run has in common; `fit_detector` is the detector that the reconstruction assumes.

    `given` are particles that no source makes, and `events` the events of their record.
    """

    detector: Detector
    fit_detector: Detector
    source: Source | Guns | None
    given: Table | None
    events: Table | None
    settings: Settings
    seed: int
    finder: FinderLike
    until: str
    keep: tuple[str, ...] | None


def run(
    detector: Detector | str | Mapping[str, Any],
    gun: Source | Guns | Any,
    n: int | None = None,
    seed: int = 1,
    *,
    settings: Settings | None = None,
    readout: Readout | str | Mapping[str, Any] | None = None,
    fit_detector: Detector | str | Mapping[str, Any] | None = None,
    finder: FinderLike = "truth",
    until: Literal["simulate", "digitize", "cluster", "find", "fit"] = "fit",
    keep: Sequence[str] | None = None,
    charges: Mapping[int, int] | None = None,
    output: Output | str | os.PathLike[str] | None = None,
    workers: Workers | Any = None,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Simulate, digitize, cluster, find and fit events, and match the tracks with the particles.

    Results depend on detector, gun, settings, finder and seed, not on workers and chunks. With `output` the memory
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
    readout : Readout, str, mapping or None
        Of all CGEM layers, instead of those of `detector` and `fit_detector`. A readout that starts from ionization
        clusters makes them rows of ``steps``.
    fit_detector : Detector or None
        Detector that the reconstruction assumes: clusters, drift distances and their errors, finder and fit. None: the
        simulated one.
    finder : str or callable
        ``"truth"`` gives each charged particle its own hits. ``"ckf"`` finds tracks from the hits alone, with
        ``settings.find``. A function of (detector, clusters, wire_hits) returns a
        mapping with the tables ``candidates`` and ``candidate_hits`` (`label_candidates` makes them). It is called for
        each chunk, in several threads at a time.
    until : str
        The last stage that runs. Tables of later stages are None in the result.
    keep : sequence of str or None
        Names of the tables in the result; None: all. ``tracks`` brings ``matches``. Links to tables that are not kept
        are -1.
    charges : mapping of int to int, or None
        Charges in e of PDG numbers that tell none, for given particles, such as ``{4900211: 1}``.
    output : Output, path or None
        Folder to which the tables are written in parts while the run goes on. The result is then that of
        `cgemit.open`: it reads its tables when they are asked for.
    workers : Workers, concurrent.futures.Executor, int or None
        Where chunks of events are computed: an executor, or a number of threads; None: a thread for each core.
    progress : callable or None
        Called with the fraction done after every chunk.

    Returns
    -------
    Result

    Raises
    ------
    OutputExistsError
        If `output` holds files and may not be overwritten.
    ValueError
        Listing every problem of detector, gun, numbers, finder, `until` or `keep`, or if the run needs more memory,
        or space on disk, than there is.
    TypeError
        If `settings` are not of all stages, or the finder cannot be sent to other processes.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=100, seed=1)
    >>> [name for name, rows in result.rows.items() if rows == 100]
    ['particles', 'candidates', 'tracks', 'matches']
    >>> track = result.tracks[0]
    >>> print(track["p"].round(2), track["n_clusters"], track["n_wires"])
    1.0 6 38
    """
    start = time.perf_counter()
    workers = Workers.of(workers)
    out = Output(output) if isinstance(output, str | os.PathLike) else output
    job, n_events = _checked(
        detector, gun, n, seed, settings, readout, fit_detector, finder, until, keep, out, workers, charges
    )
    in_event = len(job.given or ()) / max(n_events, 1) if job.source is None else job.source.multiplicity
    chunk = chunk_for(n_events, workers, in_event)
    tasks = [(job, first, min(chunk, n_events - first)) for first in range(0, max(n_events, 1), chunk)]
    other = None if job.fit_detector == job.detector else job.fit_detector
    roles = detectors_of(job.detector, other)
    meta = table_meta(roles, job.settings, seed, job.source)
    totals = Totals(progress, len(tasks))

    def result(tables: Mapping[str, Table]) -> Result:
        transported = None if "particles" in tables else dict(totals.transport)
        timings = {**totals.timings, "wall": time.perf_counter() - start}
        return Result(
            detector=job.detector, fit_detector=other, gun=job.source, seed=seed, settings=job.settings, tables=tables,
            timings=timings, transported=transported,
        )  # fmt: skip

    if n_events > PROBED:
        sample = _chunk(job, 0, PROBE)
        check_chunk(sample.sizes, sample.events, min(chunk, n_events), min(len(tasks), at_a_time(workers)))
        if out is None:
            check_memory(sample.sizes, set(sample.tables), sample.events, n_events)
    if out is None:
        parts = answers(_chunk, tasks, workers)
        made = [totals.add(answer) for answer in parts]
        kept = [{name: tables[name] for name in TABLES if name in tables} for tables in made]
        return result(JoinedTables(kept, gaps=job.given is not None, meta=meta))
    with new_folder(out.folder, overwrite=out.overwrite) as folder:
        writer = PartsWriter(folder, out.format, gaps=job.given is not None)
        for answer in answers(_chunk, tasks, workers, pending=True):
            tables = totals.add(answer)
            if writer.add({name: tables[name].with_meta(**meta) for name in TABLES if name in tables}):
                check_disk(folder, writer.size, writer.events, n_events)
        writer.close()
        write_about(folder, roles, result(StoredTables(folder)).entries(out.command))
    return open_run(out.folder)


def stages(job: Job, particles: Table) -> Iterator[tuple[str, Mapping[str, Table]]]:
    """Yield the tables that each stage makes of one table of particles; who takes them stops where he likes."""
    settings = job.settings
    fit = fit_settings(settings, job.source, components=True)  # for `quantile_p`
    out: Tables = transport(job.detector, particles, settings.simulate, job.seed)
    yield "simulate", out
    particles, truths, wire_truths = out["particles"], out["truths"], out["wire_truths"]
    out = digitize.unchecked(job.detector, truths, wire_truths, settings.digitize, job.seed, steps=out["steps"])
    out = add_background.unchecked(job.detector, **out, settings=settings.background, seed=job.seed)
    if job.fit_detector is not job.detector:
        out["wire_hits"] = read_by(job.fit_detector, job.detector, out["wire_hits"])
    yield "digitize", out
    digis, wire_hits = out["digis"], out["wire_hits"]
    clusters = cluster.unchecked(job.fit_detector, digis, settings.cluster)
    yield "cluster", {"clusters": clusters}
    finder, hits = (
        finder_of_run(job, Truths(job.detector, particles, truths, wire_truths)),
        Hits(clusters, wire_hits, digis),
    )
    unsure = job.finder != "truth"
    how = {
        "find_again": settings.refine.find_again and unsure,
        "compete": settings.refine.points == "compete" and unsure,
    }
    fitted: Tables = {}
    refined = refinements_of(settings, job.fit_detector)
    for step, tables in turns(job.fit_detector, hits, finder, fit, refined, **how):
        fitted |= tables
        yield step, {name: table for name, table in tables.items() if name != "components" or settings.fit.components}
    tracks, candidates = fitted["tracks"], (fitted["candidates"], fitted["candidate_hits"])
    of_truth = (particles, truths, wire_truths)
    matches = match.unchecked(
        tracks, *candidates, clusters, wire_hits, *of_truth, detector=job.detector, components=fitted["components"]
    )
    yield "match", matches


def finder_of_run(job: Job, truths: Truths) -> Finder:
    """Return the finder of a run: a function, or the one of this name."""
    if callable(job.finder):
        return job.finder
    if job.finder == "truth":
        return truth_finder(truths)
    return finder_by_name(job.finder, job.settings, job.source, job.given)


def run_chunk(job: Job, particles: Table) -> tuple[Tables, dict[str, float]]:
    """Run the stages on one table of particles.

    Returns
    -------
    tables : dict of str to Table
    timings : dict of str to float, s
        Wall time of each stage.
    """
    tables: Tables = {}
    seconds: defaultdict[str, float] = defaultdict(float)
    start = time.perf_counter()
    for stage, made in stages(job, particles):
        tables |= made
        now = time.perf_counter()
        seconds[stage] += now - start
        start = now
        if stage == job.until != "fit":
            break
    return tables, dict(seconds)


def _chunk(job: Job, first: int, count: int) -> Answer:
    """Return the tables that are kept of some events."""
    if job.source is not None:
        particles = generate(job.source, count, job.seed, first, job.detector)
    else:
        assert job.given is not None
        numbers = job.given.events[first : first + count]
        particles = job.given.select_events(int(numbers[0]), int(numbers[-1]) + 1) if count else job.given
    tables, seconds = run_chunk(job, particles)
    if job.events is not None:
        tables["events"] = job.events.select_events(particles.first_event, particles.first_event + count)
    transport = transport_counts(tables["particles"]["status"])
    sizes = {name: sum(column.nbytes for column in one.columns.values()) for name, one in tables.items()}
    if job.keep is not None:
        kept = {name: tables[name] for name in TABLES if name in tables and name in job.keep}
        tables = {name: one.with_columns(**without_links(one, kept)) for name, one in kept.items()}
    return Answer(tables, seconds, transport, count, sizes)


def _checked(
    detector: Any, gun: Any, n: int | None, seed: int, settings: Settings | None, readout: Any, fit_detector: Any,
    finder: FinderLike, until: str, keep: Any, output: Output | None, workers: Workers, charges: Any,
) -> tuple[Job, int]:  # fmt: skip
    """Return the job of a run and its number of events; raise an error that lists every problem of the arguments."""
    if not isinstance(settings, Settings | None):
        raise TypeError(f"settings: got {type(settings).__name__}, expected {expected_settings(settings)}")
    problems = Problems()
    simulated: Any = problems.collect(load, detector)
    assumed: Any = simulated if fit_detector is None else problems.collect(load, fit_detector)
    if readout is not None:
        same = assumed is simulated
        simulated = _read_out(simulated, readout, problems)
        assumed = simulated if same or simulated is None else _read_out(assumed, readout, problems)
    wanted: Any = settings or Settings()
    if simulated is not None:
        wanted = problems.collect(for_run, wanted, simulated)
    most = 2**31 - 1
    problems.collect(check_numbers, "run", seed, workers.threads, n=(n, 0, most), chunk=(workers.chunk, 1, most))
    problems.collect(check_clusterer, assumed, until)
    problems.collect(check_digis, simulated, assumed, until)
    for one in (simulated, assumed) if assumed is not simulated else (simulated,):
        problems.collect(check_raw_times, one, wanted, until)
    source: Any = problems.collect(source_of, gun, n, charges)
    kept_tables = problems.collect(
        check_stages, finder, until, workers, keep, wanted, assumed, source is not None and source[3] is not None
    )
    if output is not None:
        problems.collect(check_format, output.format)
    problems.report("run")
    if until in STAGES[2:]:
        warn_of_losses(simulated)
    if until in STAGES[3:] and isinstance(finder, str) and finder in HIT_FINDERS:
        named = HIT_FINDERS[finder]
        named.warn(assumed, getattr(wanted, named.stage))
    shooter, n_events, table, events = source
    wanted = _with_flight(wanted, shooter, table)
    return Job(simulated, assumed, shooter, table, events, wanted, seed, finder, until, kept_tables), n_events


def _read_out(detector: Detector | None, readout: Any, problems: Problems) -> Detector | None:
    """Return a detector with a readout; None, with the problem noted, if there is no such readout."""
    readout = problems.collect(readout_of, readout)
    return None if detector is None or readout is None else detector.with_readout(readout)


def check_clusterer(detector: Detector | None, until: object) -> None:
    """Raise an error if clusters of a readout cannot be made, before anything is simulated."""
    if detector is not None and until in STAGES[2:]:
        for group in detector.groups:
            clusterer_of(group.readout).check(group)


def check_digis(detector: Detector | None, fit_detector: Detector | None, until: object) -> None:
    """Raise an error if a layer makes positions of which strips are expected, or the reverse; warn of other readouts.

    Layers are compared by their number; another number of layers is not for this check.
    """
    if detector is None or fit_detector is None or until not in STAGES[2:]:
        return
    pairs = list(zip(detector.layers, fit_detector.layers, strict=False))
    problems, readouts = Problems(), []
    for simulated, other in pairs:
        if simulated.readout.makes != other.readout.makes:
            got = f"readout {other.readout.name}, of {other.readout.makes}"
            makes, name = simulated.readout.makes, simulated.readout.name
            expected = f"one of {makes}: the simulated {simulated.label} has readout {name}"
            problems.note(f"fit_detector.{other.label}", got, expected)
        elif simulated.readout.name != other.readout.name:
            readouts.append(f"{other.label} {other.readout.name} instead of {simulated.readout.name}")
    problems.report("run")
    if readouts:
        warnings.warn(
            f"{fit_detector.name}: fit_detector has other readouts than the simulation: {', '.join(readouts)}; "
            "readout=... sets both",
            stacklevel=4,
        )


def _with_flight(settings: Settings, shooter: Source | Guns | None, table: Table | None) -> Settings:
    """Return settings that expect raw drift times of cosmic muons; warn if only some particles fly backward."""
    if table is None:
        sources = shooter.guns if isinstance(shooter, Guns) else (shooter,)
        cosmic = [isinstance(one, EventSample) and one.name == "cosmic" for one in sources]
        some, every = any(cosmic), all(cosmic)
    else:
        some = "backward" in table and bool(table["backward"].any())
        every = some and bool(np.all((table["backward"] == 1) == (table["py"] > 0)))
    if settings.refine.drift_times != "raw" or not some:
        return settings
    if every:
        return replace(settings, refine=replace(settings.refine, flight="cosmic"))
    if settings.refine.flight == "outward":
        warnings.warn(
            "some particles fly backward (cosmic muons); raw drift times are corrected as if all flew outward",
            stacklevel=4,
        )
    return settings


def check_raw_times(detector: Detector | None, settings: Settings | None, until: object) -> None:
    """Raise an error if drift times are raw and the detector does not say how signals run along its wires."""
    if detector is not None and settings is not None and settings.digitize.wire_times == "raw" and until in STAGES[1:]:
        check_wire_times(detector)


def check_stages(
    finder: object,
    until: object,
    workers: Workers,
    keep: Any,
    settings: Settings | None,
    detector: Detector | None,
    has_events: bool = False,
) -> tuple[str, ...] | None:
    """Raise an error if a run cannot be as asked for; return the tables to be kept, None for all."""
    problems = Problems()
    names = [keep] if isinstance(keep, str) else [] if keep is None else list(keep)
    for name in names:
        if name not in TABLES:
            hint = did_you_mean(str(name), TABLES)
            problems.note("keep", f"{name!r:.50}", f"some of {', '.join(TABLES)}", hint)
    if keep is not None and not names:
        problems.note("keep", "no table", "at least one")
    if not callable(finder) and finder not in FINDERS:
        known = ", ".join(map(repr, FINDERS))
        problems.note("finder", repr(finder), f"{known} or a function of (detector, clusters, wire_hits)")
    if until not in STAGES:
        problems.note("until", repr(until), f"one of {', '.join(map(repr, STAGES))}")
    elif settings is not None and detector is not None:
        makes = tables_made(str(until), settings, detector)
        if "candidates" in makes and finder != "truth":
            makes = (*makes, "searches")
        if has_events:
            makes = (*makes, "events")
        missing = [name for name in names if name in TABLES and name not in makes]
        if missing:
            problems.note("keep", f"{', '.join(missing)}, which this run does not make", f"some of {', '.join(makes)}")
    problems.report("run")
    if callable(finder) and isinstance(workers.executor, ProcessPoolExecutor):
        try:
            pickle.dumps(finder)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise TypeError(
                f"finder: got {finder_name(finder)}, which cannot be sent to other processes ({error}); "
                "expected a function of a module, or an executor of threads"
            ) from error
    return None if keep is None else (*names, *(["matches"] if "tracks" in names else []))
