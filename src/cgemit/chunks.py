"""Chunks of a run on the workers of an executor, and sums over them."""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, NamedTuple

from cgemit.memory import check_memory
from cgemit.tables import Table

#: From this many chunks on, the first one tells whether all fit into memory before the others begin.
MANY = 64


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


def workers_of(threads: int | None, executor: Executor | None) -> int:
    """Return how many chunks run at a time.

    Parameters
    ----------
    threads : int or None
    executor : concurrent.futures.Executor or None
    """
    workers = threads or os.cpu_count() or 1
    return int(max(workers, getattr(executor, "_max_workers", workers)))


def answers(
    work: Callable[..., Answer],
    tasks: list[tuple[Any, ...]],
    threads: int | None,
    executor: Executor | None,
    n_events: int | None,
    *,
    pending: bool = False,
) -> Iterator[Answer]:
    """Run the tasks on the executor and yield the answers in order; an interrupt leaves nothing running.

    With `n_events`, the first chunk tells whether all fit into memory before the others begin. With `pending`, no
    more chunks are begun than the executor needs to stay busy, so that answers do not pile up.
    """
    pool = executor or ThreadPoolExecutor(threads or os.cpu_count())
    most = 2 * workers_of(threads, executor) if pending else len(tasks)
    futures: deque[Future[Answer]] = deque()
    try:
        if n_events is not None:
            futures.append(pool.submit(work, *tasks[0]))
            first = futures[0].result()
            check_memory(first.sizes, set(first.tables), first.events, n_events)
        for task in tasks[len(futures) :]:
            futures.append(pool.submit(work, *task))
            if len(futures) >= most:
                yield futures.popleft().result()
        while futures:
            yield futures.popleft().result()
    finally:
        for future in futures:
            future.cancel()
        if executor is None:
            pool.shutdown()
