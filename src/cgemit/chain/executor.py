"""Chunks of events on the workers of an executor, and the memory that they need."""

from __future__ import annotations

import math
import os
import shutil
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from cgemit import _core
from cgemit.base.isa import cores
from cgemit.tables import Table


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Where the chunks of a run are computed. Results do not depend on it.

    Attributes
    ----------
    threads : int or None
        Threads of a pool; None: one for each core that the process may use. Ignored with `executor`.
    executor : concurrent.futures.Executor or None
        Runs the chunks instead of a pool of threads: of processes, Dask, Parsl, MPI.
    chunk : int or None
        Events of a chunk, at most; None: those with 4000 particles. All threads have equally many chunks.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> result = cg.run("besiii-cgem", gun, n=20, workers=cg.Workers(threads=2, chunk=10))
    >>> result.tracks == cg.run("besiii-cgem", gun, n=20).tracks
    True
    """

    threads: int | None = None
    executor: Executor | None = None
    chunk: int | None = None

    @classmethod
    def of(cls, given: Workers | Executor | int | None) -> Workers:
        """Return workers given as such, as an executor or as a number of threads.

        Parameters
        ----------
        given : Workers, concurrent.futures.Executor, int or None

        Raises
        ------
        TypeError
            If it is something else.
        """
        if given is None or (isinstance(given, int) and not isinstance(given, bool)):
            return cls(threads=given)
        if isinstance(given, Executor):
            return cls(executor=given)
        if isinstance(given, Workers):
            return given
        raise TypeError(
            f"workers: got {given!r:.50}, expected a number of threads, an executor, or Workers(threads=, chunk=)"
        )


#: Chunks are held until they are joined: the tables of a run stand in memory twice.
COPIES = 2


def available() -> int:
    """Return the bytes of memory that are free for new data, or all where the system does not tell."""
    try:
        with open("/proc/meminfo", encoding="ascii") as stream:  # noqa: PTH123
            lines = dict(line.split(":", 1) for line in stream)
        return 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def check_memory(sizes: Mapping[str, int], kept: Collection[str], done: int, n_events: int) -> None:
    """Raise an error if a run does not fit into memory, judged by its first events.

    Parameters
    ----------
    sizes : mapping of str to int, bytes
        Of all tables of the first events.
    kept : collection of str
        The tables that the run keeps.
    done, n_events : int
        Number of these events, and of all.

    Raises
    ------
    ValueError
        With what the run needs, what there is, and how it would fit.
    """
    size = sum(sizes[name] for name in kept) / done
    tracks = sum(sizes.get(name, 0) for name in _TRACKS) / done
    needed, free = COPIES * size * n_events, available()
    if needed <= free:
        return
    ways = []
    if set(kept) > set(_TRACKS) <= sizes.keys() and COPIES * tracks * n_events <= free:
        ways.append(f"keep=('tracks',) needs {_gigabytes(COPIES * tracks * n_events)}")
    disk = f"{_gigabytes(size * n_events)} on disk"
    if set(kept) > set(_TRACKS) <= sizes.keys():
        disk += f", or {_gigabytes(tracks * n_events)} with keep=('tracks',)"
    ways.append(f"output=FOLDER (on the command line --keep) needs no more memory than a few chunks, and {disk}")
    raise ValueError(
        f"n: {n_events} events need about {_gigabytes(needed)} of memory ({size / 1000:.1f} kB an event, "
        f"{COPIES} times), and {_gigabytes(free)} are free; expected at most {int(free / needed * n_events):,} "
        f"events at a time, or less of each: {'; '.join(ways)}"
    )


#: Runs of more events than this begin with as many as `PROBE`, which tell how much memory all of them need.
PROBED = 10_000
PROBE = 250


def check_chunk(sizes: Mapping[str, int], done: int, chunk: int, workers: int) -> None:
    """Raise an error if the chunks that run at a time do not fit into memory, judged by some events.

    Parameters
    ----------
    sizes : mapping of str to int, bytes
        Of all tables of these events: a chunk holds each of them until it is complete.
    done : int
        Number of these events.
    chunk, workers : int
        Events of a chunk, and chunks at a time.

    Raises
    ------
    ValueError
        With what the chunks need, what there is, and a chunk that fits.
    """
    size = sum(sizes.values()) / done
    needed, free = size * chunk * workers, available()
    if needed > free:
        most = max(1, int(free / size / workers))
        raise ValueError(
            f"chunk: {workers} of {chunk} events at a time need about {_gigabytes(needed)} of memory "
            f"({size / 1000:.1f} kB an event), and {_gigabytes(free)} are free; expected at most {most:,} events"
        )


#: What ``keep=("tracks",)`` keeps.
_TRACKS = ("tracks", "matches")


def check_disk(folder: Path, size: int, done: int, n_events: int) -> None:
    """Raise an error if the rest of a run does not fit on the disk, judged by what is written.

    Parameters
    ----------
    folder : Path
        Where the run is written.
    size : int, bytes
        Of the files of the first events.
    done, n_events : int
        Number of these events, and of all.

    Raises
    ------
    ValueError
        With what the run needs and what there is.
    """
    needed, free = size * n_events / done, size + shutil.disk_usage(folder).free
    if needed > free:
        raise ValueError(
            f"n: {n_events} events need about {_gigabytes(needed)} on disk ({size / done / 1000:.2f} kB an event), and "
            f"{_gigabytes(free)} are free there; expected at most {int(free / needed * n_events):,} "
            "events, or fewer tables, or a smaller format such as parquet"
        )


def _gigabytes(size: float) -> str:
    return f"{size / 1e9:,.0f} GB" if size >= 1e10 else f"{size / 1e9:.2g} GB"


#: Particles of a chunk: with 1000, the calls of all stages take a tenth of the time.
PARTICLES = 4000
#: Fewest events of a chunk that is smaller than asked for.
LEAST_CHUNK = 250


class Answer(NamedTuple):
    """What a chunk returns: the tables that are kept, seconds of each stage, counts, and bytes of all its tables."""

    tables: dict[str, Table]
    timings: dict[str, float]
    transport: dict[str, int]
    events: int
    sizes: dict[str, int]


class Totals:
    """Sums over the chunks of a run: seconds of each stage, particles of each transport status.

    Parameters
    ----------
    progress : callable or None
        Called with the fraction done after every chunk.
    chunks : int
        Number of chunks.
    """

    def __init__(self, progress: Callable[[float], None] | None, chunks: int) -> None:
        self.timings: Counter[str] = Counter()
        self.transport: Counter[str] = Counter()
        self._progress, self._chunks, self._done = progress, chunks, 0

    def add(self, answer: Answer) -> dict[str, Table]:
        """Add a chunk and return its tables."""
        self.timings.update(answer.timings)
        self.transport.update(answer.transport)
        self._done += 1
        if self._progress is not None:
            self._progress(self._done / self._chunks)
        return answer.tables


def at_a_time(workers: Workers) -> int:
    """Return how many chunks run at a time."""
    threads = workers.threads or cores()
    return int(max(threads, getattr(workers.executor, "_max_workers", threads)))


def chunk_for(n_events: int, workers: Workers, particles: float = 1.0) -> int:
    """Return the events of a chunk: at most `workers.chunk`, with equally many chunks for each that run at a time.

    Chunks of fewer than `LEAST_CHUNK` events cost more than an idle thread.

    Parameters
    ----------
    n_events : int
    workers : Workers
    particles : float
        In an event.
    """
    most = workers.chunk or max(LEAST_CHUNK, int(PARTICLES / max(particles, 1.0)))
    rounds = math.ceil(n_events / (most * at_a_time(workers)))
    even = math.ceil(n_events / (max(rounds, 1) * at_a_time(workers)))
    return min(most, max(even, LEAST_CHUNK))


def answers(
    work: Callable[..., Answer],
    tasks: list[tuple[Any, ...]],
    workers: Workers,
    *,
    pending: bool = False,
) -> Iterator[Answer]:
    """Run the tasks on the executor and yield the answers in order; an interrupt leaves nothing running.

    With `pending`, no more chunks are begun than the executor needs to stay busy, so that answers do not pile up.
    """
    most = 2 * at_a_time(workers) if pending else len(tasks)
    futures: deque[Future[Answer]] = deque()
    with pool_of(workers) as pool:
        try:
            for task in tasks:
                futures.append(pool.submit(work, *task))
                if len(futures) >= most:
                    yield futures.popleft().result()
            while futures:
                yield futures.popleft().result()
        finally:
            for future in futures:
                future.cancel()


@contextmanager
def pool_of(workers: Workers, tasks: int | None = None) -> Iterator[Executor]:
    """Yield the executor of workers, or a pool of threads, not more than tasks, whose waiting tasks end with it.

    Ctrl-C ends the tasks that threads of the pool are at work on, too, wherever they are in the core.
    """
    if workers.executor is not None:
        yield workers.executor
        return
    threads = workers.threads or cores()
    with ThreadPoolExecutor(threads if tasks is None else max(1, min(tasks, threads))) as pool:
        try:
            yield pool
        except KeyboardInterrupt:
            _core.common.stop_stages(True)
            try:
                pool.shutdown(wait=True, cancel_futures=True)
            finally:
                _core.common.stop_stages(False)
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
