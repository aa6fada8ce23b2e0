"""`optimize`: variables, objectives and limits, checked and handed to a search."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from cgemit.base.errors import Problems
from cgemit.base.files import MissingPackageError
from cgemit.base.validate import build
from cgemit.base.version import PHYSICS
from cgemit.chain.executor import Workers, pool_of
from cgemit.chain.run import Output
from cgemit.detector import Detector, load
from cgemit.detector.inventory import Background
from cgemit.particles.species import species
from cgemit.study.evaluation import ShowProgress
from cgemit.study.optimize.goals import (
    COST,
    OCCUPANCIES,
    Goal,
    Goals,
    Limit,
    Numbered,
    Variable,
    goal_of,
    limits_of,
    prices_of,
    variables_of,
)
from cgemit.study.optimize.pareto import evolve, optuna
from cgemit.study.optimize.result import Optimization
from cgemit.study.optimize.search import (
    Design,
    Evaluator,
    Found,
    Method,
    NoStartError,
    Search,
    descend,
    no_allowed,
    with_failures,
)
from cgemit.study.sweep.evaluate import UNSEEN, Evaluation
from cgemit.study.sweep.plan import PlanFile, function_of, range_of, read_evaluation, read_tables
from cgemit.study.sweep.run import chunk_folder, evaluation_of, output_of, workers_of
from cgemit.study.sweep.space import PlanError

_TOLERANCE = {"gradient": 1e-4, "cobyla": 1e-3, "nsga2": 1.0}
#: What an optimization sets itself.
_OWN = ("quantities", "chunk")


@dataclass(frozen=True)
class _Task:
    """Checked arguments."""

    base: Detector
    variables: tuple[Variable, ...]
    objectives: tuple[Goal, ...]
    limits: tuple[Limit, ...]
    goals: Goals
    method: Method


def optimize(
    base: Detector | str | Mapping[str, Any],
    space: Mapping[str, Any],
    minimize: str | Numbered | Sequence[str | Numbered] = "dr",
    constraints: Mapping[Any, tuple[float | None, float | None]] | None = None,
    evaluate: Evaluation | Mapping[str, Any] | Literal["analytic", "mc"] = "analytic",
    search: Search | Mapping[str, Any] | Method | None = None,
    background: Background | Mapping[str, float] | None = None,
    prices: Mapping[str, float] | None = None,
    *,
    output: Output | str | os.PathLike[str] | None = None,
    workers: Workers | Executor | int | None = None,
    progress: ShowProgress | None = None,
    started: Callable[[], object] | None = None,
) -> Optimization:
    """Find the best variants of a detector.

    Parameters
    ----------
    base : Detector, or what `load` accepts
    space : mapping of str to (low, high), "bounds" or list
        By dotted key of the detector file, which may be a pattern: a range (``("105 mm", "155 mm")``,
        ``("x0.8", "x1.2")``), the allowed range, or values to choose from.
    minimize : str or sequence of str
        Objectives: resolutions (p, pt, dr, dz, phi0, theta, tanl), as the geometric mean of all points or at one
        momentum (``"dr @ 0.3 GeV/c"``); ``"channels"``; ``"area"`` m2; ``"x0"`` %; ``"outer_radius"``,
        ``"inner_radius"``, ``"gap"`` mm (free space between parts); ``"pt_threshold"`` MeV/c; ``"wires"``;
        ``"occupancy"``, ``"wire_occupancy"`` %; ``"cost"``; or a function of a `Detector` that returns a number.
    constraints : mapping of str or callable to (low, high)
        Limits of the same quantities in the unit of their column; None: no limit on this side.
    evaluate : Evaluation, a dict of its arguments, or its method
        How resolutions are computed. All designs have the same tracks; the objectives name the quantities.
    search : Search, a dict of its arguments, or its method, optional
    background : Background or mapping, optional
        What "occupancy" and "wire_occupancy" need: rate in kHz/cm2 at a radius ...
    prices : mapping of str to float, optional
        What "cost" needs: prices of one unit of quantities of the geometry, such as ``{"channels": 20, "area": 5e4}``.
    output, workers, progress, started
        As for `sweep`.

    Returns
    -------
    Optimization
        With one row for each design; row 0 is the base.

    Raises
    ------
    PlanError
        Listing every problem of the arguments.
    OutputExistsError
        If the folder holds something else, results of another optimization without `Output.overwrite`, or files that
        were changed after they were written.

    Examples
    --------
    >>> space = {"cgem.L2.anode_radius": ("120 mm", "140 mm")}
    >>> best = cg.study.optimize("besiii-cgem-design", space, "dr", evaluate={"p": 0.5, "samples": 4})
    >>> best
    besiii-cgem-design, readout binary, gradient: 16 designs, 7 gradients; converged in 6 steps
    design  cgem.L2.anode_radius (mm)  sigma_dr (um)
    base                        132.5         224.67
    16                         122.41         221.95
    """
    problems = Problems()
    start = load(base)
    evaluation: Any = evaluation_of(evaluate, problems)
    how: Any = _search(search, problems)
    task = _checked(start, space, minimize, constraints or {}, evaluation, (background, prices or {}), how, problems)
    place, where = output_of(output), workers_of(workers)
    plan = _names(task, how)
    folder = chunk_folder(place, Optimization.work, plan[1:], plan[1:])
    journal = folder.with_name("journals") / f"{plan[0]}.log" if folder else None
    if started:
        started()
    with pool_of(where) as executor:
        evaluator = Evaluator(start, task.goals, task.limits, folder, Workers(executor=executor))
        first = Design(0, "base", tuple(one.own(start) for one in task.variables), evaluator.rows([{}])[0])
        found = _searched(evaluator, task, how, journal, progress)
    result = Optimization.of(
        evaluator, task.variables, task.objectives, task.method, (first, *found.designs), found, plan[1:]
    )
    if place:
        result.write(place.folder)
    return result


def _search(given: Any, problems: Problems) -> Search | None:
    if isinstance(given, Search):
        return given
    return build(Search, given if isinstance(given, Mapping) else {"method": given}, "search", problems)


def _searched(
    evaluator: Evaluator, task: _Task, how: Search, journal: Path | None, progress: ShowProgress | None
) -> Found:
    """Return what the search of a task finds."""
    if task.method == "nsga2":
        designs = evolve(evaluator, task.variables, task.objectives, how, journal=journal, progress=progress)
        none = not any(evaluator.allowed(one.row) for one in designs)
        message = f"{how.calls} calls" + (f"; {no_allowed(evaluator, designs)}" if none else "")
        return Found(designs, 0, with_failures(message, designs))
    tolerance = how.tolerance or _TOLERANCE[task.method]
    try:
        return descend(
            evaluator, task.variables, task.objectives[0], method=task.method, tolerance=tolerance, how=how,
            progress=progress,
        )  # fmt: skip
    except NoStartError as error:
        raise PlanError("optimize", [one.below("start") for one in error.problems]) from None


def _checked(
    base: Detector, space: Mapping[str, Any], minimize: Any, constraints: Mapping[str, Any],
    evaluation: Evaluation | None, more: tuple[Any, Any], search: Search | None, problems: Problems,
) -> _Task:  # fmt: skip
    """Return the arguments in their final form, or raise PlanError with every problem, those given among them."""
    variables = variables_of(base, space, problems)
    background, given = more
    prices = prices_of(given, problems)
    texts = [minimize] if isinstance(minimize, str) or callable(minimize) else minimize
    if not isinstance(texts, Sequence) or not texts or len(set(map(str, texts))) < len(texts):
        problems.note("minimize", repr(minimize), "one or several different objectives")
        texts = []
    momenta = evaluation.p or () if evaluation else ()
    found = [goal_of("minimize", text, momenta, problems) for text in texts]
    objectives = tuple(one for one in found if one is not None)
    limits = limits_of(constraints, momenta, problems)
    goals = tuple(dict.fromkeys([*objectives, *(one.goal for one in limits)]))
    hits = build(Background, background, "background", problems) if isinstance(background, Mapping) else background
    if hits is not None and not isinstance(hits, Background):
        problems.note("background", repr(background), "rate and more of Background")
    if background is None and any(one.name in OCCUPANCIES for one in goals):
        problems.note("background", "none", "the rate of hits that occupancy needs")
    if not prices and any(one.name == COST for one in goals):
        problems.note("prices", "none", "prices of units of the geometry, which cost needs")
    if len({one.header for one in goals}) < len(goals):
        problems.note("minimize, constraints", "two functions of one name", "names that differ")
    if evaluation and not evaluation.function and any(one.name == UNSEEN for one in goals):
        if abs(species(evaluation.particle).pdg) != 11:
            problems.note("evaluate.particle", repr(evaluation.particle), "'e-' or 'e+', whose losses unseen_x0 counts")
        if evaluation.has_ranges:
            problems.note("evaluate.cos_theta", repr(evaluation.cos_theta), "fixed angles for unseen_x0")
    if not base.layers:
        problems.note("base", "a detector without CGEM layers", "at least one")
    chosen: Any = search.method if search else None
    chosen = chosen or ("gradient" if len(texts) == 1 and all(one.continuous for one in variables) else "nsga2")
    if evaluation and search:
        _check_method(chosen, variables, texts, evaluation, problems)
    if evaluation and evaluation.function:
        problems.note("evaluate.method", "a function", "'analytic' or 'mc'")
    names: Any = tuple(dict.fromkeys(one.name for one in goals if one.resolution))
    problems.report("optimize", PlanError)
    assert evaluation is not None
    full = replace(evaluation, quantities=names) if names else evaluation
    return _Task(base, variables, objectives, limits, Goals(goals, full, hits, prices), chosen)


def _check_method(
    method: Method, variables: Sequence[Variable], texts: Any, evaluation: Evaluation, problems: Problems
) -> None:
    """Note what a method of search cannot do."""
    if method == "nsga2":
        try:
            optuna()
        except MissingPackageError as error:
            problems.note("search.method", "'nsga2'", f"a package that is installed ({error})")
        return
    for variable in variables:
        if not variable.continuous:
            problems.note(
                "search.method", f"{method!r} for {variable.key}, which is a choice or a whole number", "'nsga2'"
            )
    if len(texts) > 1:
        problems.note("search.method", f"{method!r} for {len(texts)} objectives", "'nsga2'")
    if method == "gradient" and evaluation.kind == "mc":
        problems.note("search.method", "'gradient' for evaluate 'mc'", "'cobyla' or 'nsga2'")
    if method == "gradient" and evaluation.kind == "analytic" and evaluation.expectation.mixed > 1:
        problems.note("search.method", "'gradient' with a range of theta or eta, or with pT", "a range of cos_theta")
    for variable in variables if method == "gradient" else ():
        if variable.continuous and variable.before != "%" and variable.low <= 0 <= variable.high:
            given = f"'gradient' for {variable.key} from {variable.low:g} to {variable.high:g} {variable.unit}".rstrip()
            problems.note("search.method", given, "a range without zero")


def _names(task: _Task, search: Search) -> tuple[str, str]:
    """Return the names of the journal of a search, and of the whole optimization.

    The number of calls is no part of either: a search can be continued with more of them.
    """
    content = [
        PHYSICS, task.base.content_hash, [repr(one) for one in task.variables], task.goals.described(),
        [one.header for one in task.objectives], [repr(one) for one in task.limits],
        {name: getattr(search, name) for name in ("population", "offspring", "seed")},
    ]  # fmt: skip
    more = [task.method, *(getattr(search, name) for name in ("tolerance", "steps", "starts"))]
    journal, whole = (json.dumps(one, sort_keys=True, default=str).encode() for one in (content, [*content, more]))
    return hashlib.sha256(journal).hexdigest()[:16], hashlib.sha256(whole).hexdigest()[:32]


#: What the plan of an optimization may hold.
KEYS = ("base", "minimize", "vary", "constraints", "evaluate", "search", "background", "prices", "settings")


class OptimizePlan(PlanFile):
    """The plan of an optimization."""

    def run(self, **how: Any) -> Optimization:
        """Run the optimization with further arguments of `optimize`: `output`, `workers`, `progress` ..."""
        return optimize(**self.arguments, **how)

    def beside(self, tables: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Return the tables with the files of functions as they are seen from a folder."""
        return _with_goals(tables, lambda path, text: os.path.relpath(text, folder))


def _with_goals(tables: dict[str, Any], change: Callable[[str, str], Any]) -> dict[str, Any]:
    """Return tables in which ``FILE.py:FUNCTION`` among objectives and limits was changed, given its path and text."""

    def changed(path: str, text: Any) -> Any:
        return change(path, text) if isinstance(text, str) and ":" in text else text

    renamed, goals, limits = dict(tables), tables.get("minimize"), tables.get("constraints")
    if goals is not None:
        renamed["minimize"] = (
            [changed("minimize", one) for one in goals] if isinstance(goals, list) else changed("minimize", goals)
        )
    if isinstance(limits, Mapping):
        renamed["constraints"] = {changed(f"constraints.{key}", key): ends for key, ends in limits.items()}
    return renamed


def read_optimize_plan(path: str | os.PathLike[str], changes: Mapping[str, Any] | None = None) -> OptimizePlan:
    """Return the plan of a TOML file.

    Parameters
    ----------
    path : path
    changes : mapping of str to object, optional
        Values that replace those of the file, by dotted key such as ``search.calls`` or ``vary.cgem.*.pitch_x``.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    PlanError
        With every problem of the plan's form; `optimize` lists problems of its values.
    """
    problems = Problems()
    tables = read_tables(path, changes or {}, KEYS, problems)
    if "vary" not in tables:
        problems.note("vary", "nothing", "a table of keys of the detector file")
    folder = Path(path).resolve().parent
    tables = _with_goals(tables, lambda _, text: str(folder / text))
    goals = _with_goals(tables, lambda where, text: function_of(where, text, problems))
    arguments: dict[str, Any] = {"base": tables.get("base"), "minimize": goals.get("minimize", "dr")}
    arguments["space"] = {key: range_of(value) for key, value in tables.get("vary", {}).items()}
    arguments["constraints"] = _limits(goals.get("constraints", {}), problems)
    arguments["evaluate"] = read_evaluation(tables, _OWN, problems)
    arguments["search"] = build(Search, tables.get("search", {}), "search", problems)
    if "prices" in tables:
        arguments["prices"] = tables["prices"]
    if "background" in tables:
        arguments["background"] = build(Background, tables["background"], "background", problems)
    problems.report(str(path), PlanError)
    return OptimizePlan(tables, arguments)


def _limits(tables: Mapping[str, Any], problems: Problems) -> dict[str, tuple[Any, Any]]:
    by_name = {}
    for name, ends in tables.items():
        if not isinstance(ends, Mapping) or not ends or not ends.keys() <= {"min", "max"}:
            problems.note(f"constraints.{name}", repr(ends), "{ min = ..., max = ... }, or one of them")
        else:
            by_name[name] = (ends.get("min"), ends.get("max"))
    return by_name
