"""The work of a sweep: chunks of variants computed by an executor, each kept as soon as it is complete."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

from cgemit.detector import Detector, DetectorError
from cgemit.study.samples import ShowProgress
from cgemit.study.sweeps.chunks import address, clean, read_chunk, rows_of_text, text_of_rows, write_chunk
from cgemit.study.sweeps.space import Changes


class Evaluates(Protocol):
    """What is computed for a detector; it can be pickled."""

    def described(self) -> dict[str, Any]:
        """Return all that results depend on, beside the detector, as JSON."""

    def __call__(self, detector: Detector) -> Any:
        """Return what the results of a detector follow from."""

    def results(self, found: Sequence[Any]) -> list[dict[str, Any]]:
        """Return the results of some detectors as JSON, from what was found for each."""


@dataclass(frozen=True)
class Task:
    """Neighbouring variants of a sweep, and what is computed for each."""

    detectors: tuple[Detector, ...]
    changes: tuple[Changes, ...]
    evaluation: Evaluates

    @property
    def address(self) -> str:
        """Name of the file with the results."""
        pairs = zip(self.detectors, self.changes, strict=True)
        return address(self.evaluation.described(), [(base.content_hash, changes) for base, changes in pairs])


def work(task: Task) -> str:
    """Build and evaluate the variants of a task; return a row of each as text, its problems if it cannot be."""
    bases = {number: _first(base) for number, base in {id(base): base for base in task.detectors}.items()}
    pairs = zip(task.detectors, task.changes, strict=True)
    rows = [_row(bases[id(base)], changes, task.evaluation) for base, changes in pairs]
    good = [row for row in rows if row["status"] == "ok"]
    found = [row.pop("found") for row in good]
    try:
        for row, results in zip(good, task.evaluation.results(found), strict=True):
            row |= results
    except Exception as error:
        for row in good:
            row |= _failed(error)
    return text_of_rows(rows)


@lru_cache(maxsize=16)
def _first(base: Detector) -> Detector:
    """Return the first detector that was equal: a process that is sent many tasks computes its parts' numbers once."""
    return base


def _row(base: Detector, changes: Changes, evaluation: Evaluates) -> dict[str, Any]:
    """Return the row of a variant with what was `found` instead of the results, unless it could not be evaluated."""
    try:
        detector = base.with_overrides(dict(changes)) if changes else base
    except DetectorError as error:
        return {"status": "impossible", "problems": [str(problem) for problem in error.problems]}
    row: dict[str, Any] = {"status": "ok", "problems": [], "hash": detector.content_hash}
    try:
        return row | {"found": evaluation(detector)}
    except Exception as error:  # the sweep goes on: the row says what happened
        return row | _failed(error)


def _failed(error: Exception) -> dict[str, Any]:
    return {"status": "failed", "problems": [f"{type(error).__name__}: {error}"]}


def compute_rows(
    tasks: Sequence[Task],
    folder: Path | None,
    executor: Executor | None,
    part: tuple[int, int] | None,
    progress: ShowProgress | None,
) -> list[list[dict[str, Any]]]:
    """Return the rows of every task: those on disk, and those that are computed now and written as they come."""
    names = [task.address if folder else "" for task in tasks]
    counts = [len(task.changes) for task in tasks]
    pairs = zip(names, counts, strict=True)
    rows = [read_chunk(folder, name, count) if folder else None for name, count in pairs]
    mine = range(len(tasks)) if part is None else range(len(tasks))[part[0] :: part[1]] if part[1] else range(0)
    waiting = [i for i in mine if rows[i] is None]
    show = _remaining(progress, len(mine), len(waiting))
    futures: dict[Future[str], int] = {}

    def keep(future: Future[str]) -> None:
        i, text = futures.pop(future), future.result()
        found = rows_of_text(text)
        if folder and all(row["status"] != "failed" for row in found):
            write_chunk(folder, names[i], text)
        rows[i] = found

    try:
        with _pool(executor, len(waiting)) as pool:
            for i in waiting:
                futures[pool.submit(work, tasks[i])] = i
            lost = []
            for future in as_completed(list(futures)):
                # `work` tells errors in its rows: with one here, the executor lost the task, as when a worker dies.
                if isinstance(future.exception(), Exception):
                    again = pool.submit(work, tasks[futures[future]])
                    futures[again] = futures.pop(future)
                    lost.append(again)
                else:
                    keep(future)
                    show()
            for future in as_completed(lost):
                keep(future)
                show()
    finally:  # interrupted: keep what is complete
        for future in [one for one in futures if not one.cancel() and one.done() and not one.exception()]:
            keep(future)
    if folder and all(row is not None for row in rows):
        clean(folder, names)
    missing: dict[str, Any] = {"status": "missing", "problems": []}
    return [[missing] * count if found is None else found for found, count in zip(rows, counts, strict=True)]


@contextmanager
def _pool(executor: Executor | None, tasks: int) -> Iterator[Executor]:
    if executor is not None:
        yield executor
        return
    with ThreadPoolExecutor(max(1, min(tasks, os.cpu_count() or 1))) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _remaining(progress: ShowProgress | None, total: int, left: int) -> Callable[[], None]:
    """Return a function that counts finished tasks and shows the remaining time."""
    start, before = time.monotonic(), total - left
    done = before

    def show() -> None:
        nonlocal done
        done += 1
        if progress:
            seconds = (time.monotonic() - start) / (done - before) * (total - done)
            progress(done / total, f"sweep, {done} of {total} chunks, {_duration(seconds)} left")

    return show


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
