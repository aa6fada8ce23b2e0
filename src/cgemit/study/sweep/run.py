"""`sweep`: variants built and evaluated in chunks on any executor, kept in files, joined to one table."""

from __future__ import annotations

import hashlib
import json
import os
import time
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal, Protocol

from cgemit.base.errors import DetectorError, Problem, Problems
from cgemit.base.files import keep_folder, new_file, read_json, remove_left
from cgemit.base.validate import build, is_whole
from cgemit.base.version import PHYSICS
from cgemit.chain.executor import Workers, pool_of
from cgemit.chain.run import Output
from cgemit.detector import Detector, load
from cgemit.detector.variants import variant_name
from cgemit.study.evaluation import ShowProgress
from cgemit.study.sweep.evaluate import Evaluation, Function
from cgemit.study.sweep.result import Sweep, columns_before
from cgemit.study.sweep.space import (
    NAMES_FILES,
    Changes,
    PlanError,
    Space,
    grid,
    key_problems,
    listed,
    value_problems,
    with_files,
)

FORMAT = "cgemit-sweep-3"
#: Folder of the chunks in the output of a sweep.
CHUNKS = "chunks"
_LARGEST_CHUNK = 1_000_000_000  # bytes; a chunk may have thousands of variants


def address(evaluation: Mapping[str, Any], variants: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """Return the name of a chunk: a hash of all that its results depend on.

    Parameters
    ----------
    evaluation : mapping
        Method, seed and the rest of what is evaluated, as JSON.
    variants : sequence of (str, mapping)
        Fingerprint of the detector that each variant changes, and its changes.
    """
    text = json.dumps([FORMAT, PHYSICS, evaluation, [list(one) for one in variants]], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def write_chunk(folder: Path, name: str, payload: str) -> None:
    """Write rows (`text_of_rows`) of a chunk under a temporary name, which becomes the chunk's when all is written."""
    record = {"format": FORMAT, "chunk": name, "sha256": _checksum(payload), "rows": payload}
    path = folder / f"{name}.json"
    if path.is_symlink() or not path.is_file():
        path.unlink(missing_ok=True)  # a link or a pipe in the place of a chunk
    with new_file(path, overwrite=True) as temporary:
        temporary.write_text(json.dumps(record) + "\n", encoding="utf-8")


def read_chunk(folder: Path, name: str, count: int) -> list[dict[str, Any]] | None:
    """Return the rows of a chunk with `count` variants; None if there is none, with a warning if it is damaged."""
    path = folder / f"{name}.json"
    try:
        record = read_json(path, _LARGEST_CHUNK)
        payload = record["rows"]
        if record["format"] != FORMAT or record["chunk"] != name or record["sha256"] != _checksum(payload):
            raise ValueError("another chunk, or a wrong checksum")
        rows = rows_of_text(payload)
        if len(rows) != count or not all(row["status"] and isinstance(row["problems"], list) for row in rows):
            raise ValueError(f"expected the rows of {count} variants")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        text = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        warnings.warn(f"{path} cannot be read ({text:.200}); its variants are computed anew", stacklevel=2)
        return None
    return rows


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def text_of_rows(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as JSON: how workers send them and files hold them, so that results do not depend on files.

    Numbers that JSON does not have are written as ``NaN`` and ``Infinity``.
    """
    return json.dumps(rows)


def rows_of_text(text: str) -> list[dict[str, Any]]:
    """Return the rows of `text_of_rows`. Raises ValueError if it is none."""
    try:
        return json.loads(text)  # type: ignore[no-any-return]
    except RecursionError:
        raise ValueError("too many levels of nesting") from None


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

    @cached_property
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
    workers: Workers,
    part: tuple[int, int] | None,
    progress: ShowProgress | None,
    check: Callable[[Sequence[Mapping[str, Any]]], None] = lambda rows: None,
) -> list[list[dict[str, Any]]]:
    """Return the rows of every task: those on disk, and those that are computed now and written as they come.

    `check` is called with the rows of a task as soon as they are there, before they are written; it may raise an error.
    """
    names = [task.address if folder else "" for task in tasks]
    counts = [len(task.changes) for task in tasks]
    pairs = zip(names, counts, strict=True)
    rows = [read_chunk(folder, name, count) if folder else None for name, count in pairs]
    mine = range(len(tasks)) if part is None else range(len(tasks))[part[0] :: part[1]] if part[1] else range(0)
    waiting = [i for i in mine if rows[i] is None]
    for old in filter(None, rows):
        check(old)
    show = _remaining(progress, len(mine), len(waiting))
    futures: dict[Future[str], int] = {}

    def keep(future: Future[str]) -> None:
        i, text = futures.pop(future), future.result()
        chunk_rows = rows_of_text(text)
        check(chunk_rows)
        if folder and all(row["status"] != "failed" for row in chunk_rows):
            write_chunk(folder, names[i], text)
        rows[i] = chunk_rows

    try:
        with pool_of(workers, len(waiting)) as pool:
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
        remove_left(folder)
    missing: dict[str, Any] = {"status": "missing", "problems": []}
    return [[missing] * count if found is None else found for found, count in zip(rows, counts, strict=True)]


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


#: Variants in one chunk: simulated ones and functions take long, analytic ones do not.
CHUNK = {"analytic": 50, "mc": 1, "function": 1}


def sweep(
    base: Detector | str | Mapping[str, Any],
    space: Space | Mapping[str, Sequence[Any]] | Sequence[Changes],
    evaluate: Evaluation | Mapping[str, Any] | Literal["analytic", "mc"] | Function = "analytic",
    *,
    output: Output | str | os.PathLike[str] | None = None,
    workers: Workers | Executor | int | None = None,
    part: tuple[int, int] | None = None,
    compute: bool = True,
    progress: ShowProgress | None = None,
    started: Callable[[], object] | None = None,
) -> Sweep:
    """Evaluate variants of a detector.

    Parameters
    ----------
    base : Detector, or what `load` accepts
    space : Space, dict of lists (a grid), or list of dicts
        Changes by dotted key of the detector file, as `Detector.with_overrides` takes them; `base` and `field` take
        names of presets or files. See `grid`, `sobol` and `latin_hypercube`.
    evaluate : Evaluation, a dict of its arguments, or its method
    output : Output or path, optional
        Folder for the chunks, the table and its record. A folder that holds chunks of this plan alone is continued;
        with `Output.overwrite` its results are replaced, with `part` those of this part.
    workers : Workers, concurrent.futures.Executor or int, optional
        Where chunks are computed; a number is of threads. Default: threads on all cores. Dask:
        ``client.get_executor()``.
    part : (int, int), optional
        (i, n): compute part i (0 to n - 1) of n parts of the chunks and write no table; a later call without `part`
        joins them.
    compute : bool
        Whether to compute the chunks that the folder does not hold; otherwise their rows are of status "missing".
    progress : callable, optional
        Called with the share that is done and a text with the remaining time.
    started : callable, optional
        Called when the arguments are right and the folder is there, before anything is computed.

    Returns
    -------
    Sweep
        One row for each variant, momentum and angle; variant 0 is the base. With `part`, the rows of other parts are
        of status "missing". A table with such rows is not written.

    Raises
    ------
    PlanError
        Listing every problem of the arguments, among them keys that name nothing in the base and values without unit;
        or names of a function's results that are columns of the table.
    OutputExistsError
        If the folder holds something else, results of another plan without `Output.overwrite`, or files that were
        changed after they were written.

    Examples
    --------
    >>> evaluation = cg.study.Evaluation(p=1.0, quantities=["dr", "p"])
    >>> cg.study.sweep("besiii-cgem-design", {"cgem.*.pitch_x": ["400 um", "500 um"]}, evaluation)
    besiii-cgem-design: 2 variants, 3 rows
    variant  status  cgem.*.pitch_x (um)  p (GeV/c)  cos_theta  sigma_dr (um)  sigma_p (MeV/c)  reached  tracks
          0  ok                      650          1          0         169.79           4.7752        1  ok
          1  ok                      400          1          0         134.45           4.4971        1  ok
          2  ok                      500          1          0          150.7           4.6184        1  ok
    """
    wrong = Problems()
    evaluation: Any = evaluation_of(evaluate, wrong)
    if part is not None and not _is_part(part):
        wrong.note("part", repr(part), "(i, n) with i from 0 to n - 1")
    start: Any = wrong.collect(load, base)
    chosen: Any = wrong.collect(_space, space)
    bases = bases_of(start, chosen, wrong)
    wrong.report("sweep", PlanError)
    size = evaluation.chunk or CHUNK[evaluation.kind]
    tasks = [_task(bases[i : i + size], evaluation) for i in range(0, len(bases), size)]
    place, where = output_of(output), workers_of(workers)
    plan = tuple(task.address for task in tasks)
    folder = chunk_folder(place, Sweep.work, plan, plan[part[0] :: part[1]] if part else plan)
    if started:
        started()
    detectors = [detector for detector, _ in bases]
    refuse = _taken_names(chosen, evaluation, detectors)
    rows = compute_rows(tasks, folder, where, part if compute else (0, 0), progress, refuse)
    found = [row for task_rows in rows for row in task_rows]
    result = Sweep.joined(chosen, evaluation, detectors, found, plan)
    if place and part is None and not result.missing():
        result.write(place.folder)
    return result


def _is_part(given: Any) -> bool:
    pair = isinstance(given, tuple | list) and len(given) == 2
    return pair and is_whole(given[1], 1, 1_000_000) and is_whole(given[0], 0, given[1] - 1)


def evaluation_of(given: Any, problems: Problems) -> Evaluation | None:
    """Return an evaluation as it is, or made of a table or a method; None, with problems noted, if it is wrong."""
    if isinstance(given, Evaluation):
        return given
    return build(Evaluation, given if isinstance(given, Mapping) else {"method": given}, "evaluate", problems)


def _space(space: Any) -> Space:
    if isinstance(space, Space):
        return space
    return grid(space) if isinstance(space, Mapping) else listed(space)


def bases_of(base: Detector | None, space: Space | None, problems: Problems) -> list[tuple[Detector, Changes]]:
    """Return what each variant changes, the base as the first one, and how; note wrong bases, keys and values."""
    named = problems.collect(_with_bases, base, space) if base is not None and space is not None else None
    pairs = [(base, {}), *named] if base is not None and named is not None else []
    problems += key_problems(pairs) + value_problems(pairs)
    return pairs


def _with_bases(base: Detector, space: Space) -> list[tuple[Detector, Changes]]:
    """Return the detector that each variant changes, in its field, and the rest of the changes."""
    made: dict[str, Detector] = {}

    def path_of(key: str, name: str) -> str:
        return str(space.files.get((key, name), name))

    def detector_of(own: Changes) -> Detector:
        if (name := repr(own)) not in made:
            placed = {key: with_files(key, value, path_of) for key, value in own.items()}
            detector = load(placed["base"]) if "base" in own else base
            if "field" in own:
                detector = _named(detector.with_field(placed["field"]), detector, "field", own)
            if "field.file" in own:
                detector = _named(
                    detector.with_overrides({"field.file": placed["field.file"]}), detector, "field.file", own
                )
            made[name] = detector
        return made[name]

    pairs: list[tuple[Detector, Changes]] = []
    for changes in space.variants:
        own = {key: changes[key] for key in NAMES_FILES if key in changes}
        pairs.append((detector_of(own), {key: value for key, value in changes.items() if key not in own}))
    return pairs


def _named(detector: Detector, before: Detector, key: str, changes: Changes) -> Detector:
    """Return the detector under the name that follows from the change as it was given, wherever its file is."""
    value = changes[key]
    text = value if isinstance(value, Mapping) or key != "field" else Path(value).stem
    return replace(detector, name=variant_name(before.name, {key: text}))


def _task(pairs: Sequence[tuple[Detector, Changes]], evaluation: Evaluation) -> Task:
    return Task(tuple(detector for detector, _ in pairs), tuple(changes for _, changes in pairs), evaluation)


def output_of(given: Output | str | os.PathLike[str] | None) -> Output | None:
    """Return where results are written, given as such or as a path."""
    if isinstance(given, str | os.PathLike):
        return Output(given)
    if given is None or isinstance(given, Output):
        return given
    raise TypeError(f"output: got {given!r:.60}, expected a path or Output")


def workers_of(given: Workers | Executor | int | None) -> Workers:
    """Return where chunks are computed, given as such, as an executor or as a number of threads."""
    workers = Workers.of(given)
    if workers.threads is not None and not is_whole(workers.threads, 1, 2**15):
        raise ValueError(f"workers: got {workers.threads!r:.60} threads, expected a whole number from 1 to {2**15}")
    return workers


def chunk_folder(output: Output | None, work: str, plan: Sequence[str], mine: Collection[str]) -> Path | None:
    """Return the folder of the chunks of a plan, made if it is missing; None without an output.

    With `Output.overwrite`, chunks of the plan that are not `mine` stay: they are the results of other jobs.
    """
    if output is None:
        return None
    others = {f"{name}.json" for name in set(plan) - set(mine)}
    whole = keep_folder(output.folder, work, plan, overwrite=output.overwrite, kept=others)
    folder = whole / CHUNKS
    folder.mkdir(exist_ok=True)
    return folder


def _taken_names(
    space: Space, evaluation: Evaluation, bases: Sequence[Detector]
) -> Callable[[Sequence[Mapping[str, Any]]], None]:
    """Return a function that raises an error if results have names of other columns of the table."""
    taken = columns_before(space, evaluation, bases[0])

    def refuse(rows: Sequence[Mapping[str, Any]]) -> None:
        wrong = [name for name in dict.fromkeys(n for row in rows for n in row.get("columns", ())) if name in taken]
        if wrong:
            expected = f"a name that the table does not have ({', '.join(taken)})"
            raise PlanError(
                "sweep", [Problem("evaluate.method", f"a result named {name!r}", expected) for name in wrong]
            )

    return refuse
