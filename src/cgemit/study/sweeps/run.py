"""A sweep: variants built and evaluated in chunks by any executor, kept in files, joined to one table."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, Literal

from cgemit.detector import Detector, load
from cgemit.gun import Gun
from cgemit.io.folders import OutputExistsError, check_free
from cgemit.problems import Problems
from cgemit.species import species
from cgemit.stages import Settings
from cgemit.study.samples import ShowProgress
from cgemit.study.sweeps.chunks import CHUNKS
from cgemit.study.sweeps.compute import Task, compute_rows
from cgemit.study.sweeps.evaluate import QUANTITIES, CosTheta, Evaluation, Function
from cgemit.study.sweeps.keys import key_problems
from cgemit.study.sweeps.result import Sweep
from cgemit.study.sweeps.space import Changes, Space, SpaceError, grid, listed
from cgemit.values import check_numbers, is_whole

#: Variants in one chunk: simulated ones and functions take long, analytic ones do not.
CHUNK = {"analytic": 50, "mc": 1, "function": 1}


def sweep(
    base: Detector | str | Mapping[str, Any],
    space: Space | Mapping[str, Sequence[Any]] | Sequence[Changes],
    *,
    evaluate: Literal["analytic", "mc"] | Function = "analytic",
    particle: str | int = "mu-",
    p: float | Sequence[float] = 1.0,
    cos_theta: CosTheta | Sequence[CosTheta] = 0.0,
    events: int = 2000,
    seed: int = 1,
    settings: Settings | None = None,
    quantities: Sequence[str] = tuple(QUANTITIES),
    samples: int | None = None,
    executor: Executor | None = None,
    output: str | os.PathLike[str] | None = None,
    resume: bool = True,
    overwrite: bool = False,
    part: tuple[int, int] | None = None,
    compute: bool = True,
    chunk: int | None = None,
    progress: ShowProgress | None = None,
) -> Sweep:
    """Evaluate variants of a detector.

    Parameters
    ----------
    base : Detector, or what `load` accepts
    space : Space, dict of lists (a grid), or list of dicts
        Changes by dotted key of the detector file, as `Detector.with_overrides` takes them; `base` and `field` take
        names of presets or files. See `grid`, `sobol` and `latin_hypercube`.
    evaluate : "analytic", "mc" or callable
        Resolutions from the covariance; resolutions of simulated tracks, with the same random numbers for every
        variant and the paired error of the difference to the base; or a function of a `Detector` that returns a dict
        of numbers.
    particle : str or int
    p : float or list of float, GeV/c
    cos_theta : float, (float, float), or list of these
        A pair is a uniform range.
    events, seed : int
        Of "mc", for each variant, momentum and angle.
    settings : Settings, optional
        Of all stages; "analytic" uses read-out and fit.
    quantities : sequence of str
        Resolutions to be computed: p, pt, dr, dz, phi0, theta, tanl.
    samples : int, optional
        Of "analytic": tracks that are averaged at each point (`cgemit.analytic`).
    executor : concurrent.futures.Executor, optional
        Default: a thread pool of all cores. Dask: ``client.get_executor()``.
    output : path, optional
        Folder for the chunks, the table and its record.
    resume : bool
        Whether to use the chunks that the folder holds; otherwise a folder with files is an error.
    overwrite : bool
        Whether to remove the chunks that the folder holds.
    part : (int, int), optional
        (i, n): compute part i (0 to n - 1) of n parts of the chunks and write no table; a later call without `part`
        joins them.
    compute : bool
        Whether to compute the chunks that the folder does not hold; otherwise their rows are of status "missing".
    chunk : int, optional
        Variants in one chunk.
    progress : callable, optional
        Called with the share that is done and a text with the remaining time.

    Returns
    -------
    Sweep
        One row for each variant, momentum and angle; variant 0 is the base. With `part`, the rows of other parts are
        of status "missing". A table with such rows is not written.

    Raises
    ------
    ValueError
        Listing every problem of the arguments, among them keys that name nothing in the base.
    OutputExistsError
        If the folder holds files that are none of a sweep.
    """
    evaluation = _evaluation(
        evaluate, particle=particle, p=as_tuple(p), cos_theta=as_tuple(cos_theta), events=events, seed=seed,
        settings=settings, quantities=tuple(quantities), samples=samples,
    )  # fmt: skip
    wrong = Problems("sweep")
    wrong.collect(_check, evaluation, part, chunk)
    start = wrong.collect(load, base)
    chosen = wrong.collect(_space, space)
    named = wrong.collect(_named, start, chosen.variants) if start is not None and chosen is not None else None
    wrong.report()
    assert chosen is not None
    assert named is not None
    bases = named
    size = chunk or CHUNK[evaluation.method]
    tasks = [_task(bases[i : i + size], evaluation) for i in range(0, len(bases), size)]
    folder = chunk_folder(output, resume=resume, overwrite=overwrite)
    rows = compute_rows(tasks, folder, executor, part if compute else (0, 0), progress)
    found = [row for task_rows in rows for row in task_rows]
    result = Sweep.joined(chosen, evaluation, [detector for detector, _ in bases], found)
    if output is not None and part is None and not result.missing():
        result.write(Path(output))
    return result


def _named(start: Detector, variants: Sequence[Changes]) -> list[tuple[Detector, Changes]]:
    """Return base and variants with the detector that each changes; raise an error for keys that name nothing."""
    bases = [(start, {}), *_with_bases(start, variants)]
    problems = key_problems(bases)
    if problems:
        raise SpaceError(problems)
    return bases


def _evaluation(evaluate: Any, **how: Any) -> Evaluation:
    function = evaluate if callable(evaluate) else None
    method: Any = "function" if function else evaluate
    return Evaluation(method=method, function=function, **how)


def as_tuple(given: Any) -> tuple[Any, ...]:
    """Return numbers and (low, high) ranges of a list, or a single one, as a tuple."""
    if hasattr(given, "tolist"):
        given = given.tolist()
    values = given if isinstance(given, list) else [given]
    return tuple(tuple(map(float, one)) if isinstance(one, tuple) else one for one in values)


def _check(evaluation: Evaluation, part: tuple[int, int] | None, chunk: int | None) -> None:
    """Raise ValueError with every problem of what is to be evaluated."""
    problems = []
    if evaluation.method not in CHUNK:
        problems.append(f"evaluate: got {evaluation.method!r}, expected 'analytic', 'mc' or a function")
    if not evaluation.quantities or set(evaluation.quantities) - QUANTITIES.keys():
        expected = ", ".join(QUANTITIES)
        problems.append(f"quantities: got {', '.join(map(str, evaluation.quantities)) or 'none'}, expected {expected}")
    if chunk is not None and not is_whole(chunk, 1, 1_000_000):
        problems.append(f"chunk: got {chunk!r}, expected a whole number from 1 to 1000000")
    if part is not None and not (is_whole(part[1], 1, 1_000_000) and is_whole(part[0], 0, part[1] - 1)):
        problems.append(f"part: got {part!r}, expected (i, n) with i from 0 to n - 1")
    problems += number_problems("sweep", evaluation)
    if problems:
        raise ValueError("\n  ".join(["wrong sweep", *dict.fromkeys(problems)]))


def number_problems(name: str, evaluation: Evaluation) -> list[str]:
    """Return what is wrong with samples, events, seed and gun of an evaluation."""
    problems = []
    if evaluation.samples is not None and not is_whole(evaluation.samples, 1, 2**20):
        problems.append(f"samples: got {evaluation.samples!r}, expected a whole number from 1 to {2**20}")
    try:
        check_numbers(name, evaluation.seed, None, events=(evaluation.events, 1, 2**31 - 1))
    except ValueError as error:
        problems.append(str(error))
    return problems + _gun_problems(evaluation)


def _gun_problems(evaluation: Evaluation) -> list[str]:
    try:
        guns = [Gun(evaluation.particle, p=list(evaluation.p), cos_theta=one) for one in evaluation.cos_theta]
    except ValueError as error:
        return [str(error)]
    if species(guns[0].particle).charge == 0:
        return [f"particle: got {evaluation.particle!r}; expected a charged particle"]
    return []


def _space(space: Any) -> Space:
    if isinstance(space, Space):
        return space
    return grid(space) if isinstance(space, Mapping) else listed(space)


def _with_bases(base: Detector, variants: Sequence[Changes]) -> list[tuple[Detector, Changes]]:
    """Return the detector that each variant changes, in its field, and the rest of the changes."""
    made: dict[str, Detector] = {}

    def detector_of(source: Any, field: Any) -> Detector:
        name = repr((source, field))
        if name not in made:
            found = base if source is None else load(source)
            made[name] = found if field is None else found.with_field(field)
        return made[name]

    pairs: list[tuple[Detector, Changes]] = []
    for changes in variants:
        rest = {key: value for key, value in changes.items() if key not in ("base", "field")}
        pairs.append((detector_of(changes.get("base"), changes.get("field")), rest))
    return pairs


def _task(pairs: Sequence[tuple[Detector, Changes]], evaluation: Evaluation) -> Task:
    return Task(tuple(detector for detector, _ in pairs), tuple(changes for _, changes in pairs), evaluation)


def chunk_folder(output: str | os.PathLike[str] | None, *, resume: bool, overwrite: bool) -> Path | None:
    """Return the folder of the chunks, made if it is missing; None without an output."""
    if output is None:
        return None
    folder = Path(output) / CHUNKS
    if folder.is_dir() and not resume and not overwrite:
        raise OutputExistsError(f"{output} already holds a sweep; choose another folder, or resume or overwrite it")
    if not folder.is_dir():
        check_free(output, overwrite=overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    if overwrite:
        for old in folder.glob("*.json"):
            old.unlink()
    return folder
