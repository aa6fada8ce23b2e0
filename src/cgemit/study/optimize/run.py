"""`optimize`: variables, objectives and limits, checked and handed to a search."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from cgemit.base.errors import ProblemsError, did_you_mean
from cgemit.base.files import SUMMARY, OutputExistsError, check_free
from cgemit.base.settings import is_whole
from cgemit.base.version import PHYSICS
from cgemit.chain.settings import Settings
from cgemit.detector import Detector, load
from cgemit.detector.inventory import Background
from cgemit.study.optimize.goals import (
    OCCUPANCY,
    Goal,
    Goals,
    Limit,
    Variable,
    calibration_problems,
    goal_of,
    limits_of,
    variables_of,
)
from cgemit.study.optimize.pareto import MissingPackageError, evolve, optuna
from cgemit.study.optimize.result import Optimization
from cgemit.study.optimize.search import Design, Evaluator, Found, NoStartError, search, with_failures
from cgemit.study.samples import ShowProgress
from cgemit.study.sweep.evaluate import CosTheta, Evaluation
from cgemit.study.sweep.plan import PlanError, PlanFile, base_problems, numbers, read_tables, settings_of
from cgemit.study.sweep.run import as_tuple, chunk_folder, number_problems
from cgemit.study.sweep.space import range_of
from cgemit.units import QuantityError, parse_quantity

#: SLSQP with gradients, COBYLA without, NSGA-II.
Method = Literal["gradient", "cobyla", "nsga2"]
_TOLERANCE = {"gradient": 1e-4, "cobyla": 1e-3, "nsga2": 1.0}


class OptimizeError(ProblemsError[str]):
    """Arguments of an optimization with mistakes; `problems` lists them all."""


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
    *,
    minimize: str | Sequence[str] = "dr",
    constraints: Mapping[str, tuple[float | None, float | None]] | None = None,
    p: float | Sequence[float] = 1.0,
    cos_theta: CosTheta | Sequence[CosTheta] = 0.0,
    particle: str | int = "mu-",
    evaluate: Literal["analytic", "mc"] = "analytic",
    method: Method | None = None,
    tolerance: float | None = None,
    steps: int = 200,
    population: int = 100,
    offspring: int = 30,
    calls: int = 200,
    seed: int = 1,
    events: int = 2000,
    samples: int | None = None,
    settings: Settings | None = None,
    background: Background | Mapping[str, float] | None = None,
    executor: Executor | None = None,
    output: str | os.PathLike[str] | None = None,
    resume: bool = True,
    overwrite: bool = False,
    progress: ShowProgress | None = None,
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
        ``"inner_radius"``, ``"gap"`` mm (free space between parts); ``"pt_threshold"`` MeV/c; ``"occupancy"`` %.
    constraints : mapping of str to (low, high)
        Limits of the same quantities in the unit of their column; None: no limit on this side.
    p, cos_theta, particle, evaluate, events, samples, settings
        As for `sweep`. All designs have the same tracks.
    method : "gradient", "cobyla" or "nsga2"
        SLSQP with the gradients of the covariance; COBYLA, without gradients; NSGA-II (Optuna, extra ``[opt]``).
        Default: "gradient" for one objective of continuous numbers, else "nsga2".
    tolerance : float, optional
        Relative change of the objective ("gradient", 1e-4) or change of the variables in units of their ranges
        ("cobyla", 1e-3) at which the search ends.
    steps : int
        Most iterations of "gradient", most designs of "cobyla".
    population, offspring, calls : int
        Of "nsga2": designs of the first population and parents of each call, new designs of each call, and calls.
    seed : int
        Of "nsga2", and of simulated tracks.
    background : Background or mapping, optional
        What "occupancy" needs: rate in kHz/cm2 at a radius ...
    executor, output, resume, overwrite, progress
        As for `sweep`.

    Returns
    -------
    Optimization
        With one row for each design; row 0 is the base.

    Raises
    ------
    OptimizeError
        Listing every problem of the arguments.
    OutputExistsError
        If the folder holds files that are none of an optimization.
    """
    problems: list[str] = []
    evaluation = Evaluation(
        method=evaluate, particle=particle, p=_momenta(p, problems), cos_theta=as_tuple(_list(cos_theta)),
        events=events, seed=seed, settings=settings, function=None, quantities=(), samples=samples,
    )  # fmt: skip
    numbers = {"steps": steps, "population": population, "offspring": offspring, "calls": calls, "seed": seed}
    start = load(base)
    task = _checked(
        start, space, minimize, constraints or {}, evaluation, background, method, tolerance, numbers, problems
    )  # fmt: skip
    folder, journal = _places(task, output, resume=resume, overwrite=overwrite, numbers=numbers)
    with ExitStack() as stack:
        evaluator = Evaluator(start, task.goals, task.limits, folder, executor or _pool(stack))
        first = Design(0, "base", tuple(one.start(start) for one in task.variables), evaluator.rows([{}])[0])
        found = _searched(evaluator, task, tolerance, numbers, journal, progress)
    result = Optimization.of(evaluator, task.variables, task.objectives, task.method, (first, *found.designs), found)
    if output is not None:
        result.write(Path(output))
    return result


def _searched(
    evaluator: Evaluator, task: _Task, tolerance: float | None, numbers: Mapping[str, int], journal: Path | None,
    progress: ShowProgress | None,
) -> Found:  # fmt: skip
    """Return what the search of a task finds."""
    if task.method == "nsga2":
        sizes = {name: value for name, value in numbers.items() if name != "steps"}
        designs = evolve(evaluator, task.variables, task.objectives, journal=journal, progress=progress, **sizes)
        return Found(designs, 0, with_failures(f"{numbers['calls']} calls", designs))
    how: Any = {"method": task.method, "tolerance": tolerance or _TOLERANCE[task.method], "steps": numbers["steps"]}
    try:
        return search(evaluator, task.variables, task.objectives[0], progress=progress, **how)
    except NoStartError as error:
        raise OptimizeError("optimize", [f"start: {one}" for one in str(error).split("\n")]) from None


def _momenta(given: Any, problems: list[str]) -> tuple[float, ...]:
    """Return momenta in GeV/c; each may have a unit."""
    found = []
    for one in list(given) if hasattr(given, "__iter__") and not isinstance(given, str) else [given]:
        try:
            found.append(float(parse_quantity(one, "momentum")) if isinstance(one, str) else float(one))
        except (QuantityError, TypeError, ValueError):
            problems.append(f"p: got {one!r}, expected a momentum in GeV/c, such as 0.3 or '300 MeV/c'")
    return tuple(found) or (1.0,)


def _list(given: Any) -> Any:
    """Return a sequence of numbers as a list; a pair of cos(theta) is a range and stays one."""
    return list(given) if hasattr(given, "__iter__") and not isinstance(given, str | tuple) else given


def _pool(stack: ExitStack) -> Executor:
    from concurrent.futures import ThreadPoolExecutor

    return stack.enter_context(ThreadPoolExecutor(os.cpu_count() or 1))


def _checked(
    base: Detector, space: Mapping[str, Any], minimize: Any, constraints: Mapping[str, Any], evaluation: Evaluation,
    background: Any, method: Any, tolerance: Any, numbers: Mapping[str, Any], problems: list[str],
) -> _Task:  # fmt: skip
    """Return the arguments in their final form, or raise OptimizeError with every problem, those given among them."""
    variables = variables_of(base, space, problems)
    texts = [minimize] if isinstance(minimize, str) else minimize
    if not isinstance(texts, Sequence) or not texts or len(set(map(str, texts))) < len(texts):
        problems.append(f"minimize: got {minimize!r}, expected one or several different objectives")
        texts = []
    found = [goal_of("minimize", text, evaluation.p, problems) for text in texts]
    objectives = tuple(one for one in found if one is not None)
    limits = limits_of(constraints, evaluation.p, problems)
    goals = tuple(dict.fromkeys([*objectives, *(one.goal for one in limits)]))
    hits = _background(background, problems)
    if hits is None and background is None and any(one.name == OCCUPANCY for one in goals):
        problems.append("background: got none, expected the rate of hits that occupancy needs")
    if not base.cgem:
        problems.append("base: got a detector without CGEM layers, expected at least one")
    chosen: Any = method or ("gradient" if len(texts) == 1 and all(one.continuous for one in variables) else "nsga2")
    problems += _method_problems(chosen, variables, texts, evaluation)
    if evaluation.method not in ("analytic", "mc"):
        problems.append(f"evaluate: got {evaluation.method!r}, expected 'analytic' or 'mc'")
    if tolerance is not None and not (isinstance(tolerance, int | float) and 0 < tolerance < 1):
        problems.append(f"tolerance: got {tolerance!r}, expected a number between 0 and 1")
    least = {"steps": 1, "population": 4, "offspring": 1, "calls": 0, "seed": 0}
    for name, value in numbers.items():
        if name != "seed" and not is_whole(value, least[name], 1_000_000):
            problems.append(f"{name}: got {value!r}, expected a whole number from {least[name]} to 1000000")
    names = tuple(dict.fromkeys(one.name for one in goals if one.resolution))
    if names and evaluation.method == "analytic":
        readout = (evaluation.settings or Settings()).digitize.readout
        problems += calibration_problems(base, variables, readout)
    full = Evaluation(**{one.name: getattr(evaluation, one.name) for one in fields(evaluation)} | {"quantities": names})
    problems += number_problems("optimize", full)
    if problems:
        raise OptimizeError("optimize", list(dict.fromkeys(problems)))
    return _Task(base, variables, objectives, limits, Goals(goals, full, hits), chosen)


def _method_problems(method: Any, variables: Sequence[Variable], texts: Any, evaluation: Evaluation) -> list[str]:
    known = get_args(Method)
    if method not in known:
        hint = did_you_mean(method, known, "; ")
        return [f"method: got {method!r}, expected one of {', '.join(known)}{hint}"]
    if method == "nsga2":
        try:
            optuna()
        except MissingPackageError as error:
            return [f"method: got 'nsga2', {error}"]
        return []
    problems = [
        f"method: got {method!r} for {one.key}, which is a choice or a whole number; expected 'nsga2'"
        for one in variables
        if not one.continuous
    ]
    if len(texts) > 1:
        problems.append(f"method: got {method!r} for {len(texts)} objectives, expected 'nsga2'")
    if method == "gradient":
        if evaluation.method == "mc":
            problems.append("method: got 'gradient' for evaluate 'mc', expected 'cobyla' or 'nsga2'")
        problems += [
            f"method: got 'gradient' for {one.key} from {one.low:g} to {one.high:g} {one.unit}".rstrip()
            + ", expected a range without zero"
            for one in variables
            if one.continuous and one.before != "%" and one.low <= 0 <= one.high
        ]
    return problems


def _background(given: Any, problems: list[str]) -> Background | None:
    if given is None or isinstance(given, Background):
        problems += given.problems() if given else []
        return given
    known = {one.name for one in fields(Background)}
    if not isinstance(given, Mapping) or not given.keys() <= known or "rate" not in given:
        problems.append(f"background: got {given!r}, expected rate and perhaps {', '.join(sorted(known - {'rate'}))}")
        return None
    found = Background(**given)
    problems += found.problems()
    return found


def _places(
    task: _Task, output: Any, *, resume: bool, overwrite: bool, numbers: Mapping[str, Any]
) -> tuple[Path | None, Path | None]:
    """Return the folder of the chunks and the journal of this very search."""
    if output is not None and not overwrite and (Path(output) / SUMMARY).exists() and not _is_ours(Path(output)):
        check_free(output)
    folder = chunk_folder(output, resume=resume, overwrite=overwrite)
    if folder is None:
        return None, None
    journals = Path(output) / "journals"
    journals.mkdir(exist_ok=True)
    if overwrite:
        for old in journals.glob("*.log"):
            old.unlink()
    # The number of calls is no part of the name: a search can be continued with more of them.
    text = json.dumps(
        [PHYSICS, task.base.content_hash, [repr(one) for one in task.variables], task.goals.described(),
         [one.header for one in task.objectives], [repr(one) for one in task.limits],
         {name: value for name, value in numbers.items() if name in ("population", "offspring", "seed")}],
        sort_keys=True, default=str,
    )  # fmt: skip
    return folder, journals / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.log"


def _is_ours(folder: Path) -> bool:
    try:
        return "minimize" in json.loads((folder / SUMMARY).read_text(encoding="utf-8")).get("inputs", {})
    except (OSError, ValueError, AttributeError):
        raise OutputExistsError(f"{folder} already holds files; choose another folder or overwrite it") from None


#: Keys of each table of a plan, with what they mean; docs/optimize.md shows them.
KEYS: dict[str, dict[str, str]] = {
    "": {
        "base": "preset or detector file that the designs change",
        "minimize": "an objective, or a list of them",
        "vary": 'keys of the detector file: { from, to }, "bounds", or a list to choose from',
        "constraints": "limits of quantities: { min, max }, either may be missing",
        "evaluate": "how resolutions are computed",
        "search": "method and length of the search",
        "background": "hits that do not belong to tracks, for the occupancy",
        "settings": "settings of the stages, as in a file of settings",
    },
    "evaluate": {
        "method": '"analytic" (default) or "mc"',
        "particle": 'name or PDG number (default "mu-")',
        "p": "momentum or list of momenta, GeV/c or with a unit (default 1)",
        "cos_theta": 'number, "LOW:HIGH" for a uniform range, or a list of these (default 0)',
        "events": '"mc": simulated events for each design, momentum and angle (default 2000)',
        "samples": '"analytic": tracks that are averaged at each point',
    },
    "search": {
        "method": '"gradient", "cobyla" or "nsga2" (default: by the number of objectives)',
        "tolerance": "where gradient and cobyla end",
        "steps": "most iterations of gradient, most designs of cobyla",
        "population": "nsga2: designs of the first population, and parents of each call",
        "offspring": "nsga2: new designs of each call",
        "calls": "nsga2: number of calls",
        "seed": "of nsga2 and of simulated tracks (default 1)",
    },
    "background": {
        "rate": "hits per area and time, kHz/cm2, at `radius`",
        "radius": "mm (default 100)",
        "power": "the rate falls with this power of the radius (default 2)",
        "window": "ns in which a strip counts hits (default 1000)",
        "strips": "fired strips of a hit in each view (default 3)",
    },
}


class OptimizePlan(PlanFile):
    """The plan of an optimization."""

    def run(self, **how: Any) -> Optimization:
        """Run the optimization with further arguments of `optimize`: `output`, `executor`, `progress` ..."""
        return optimize(**self.arguments, **how)


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
        With every problem of the plan's form; `optimize` lists those of its values.
    """
    problems: list[str] = []
    tables = read_tables(path, changes or {}, KEYS, ("vary", "constraints", "settings"), problems)
    if "vary" not in tables:
        problems.append("vary: missing, expected a table of keys of the detector file")
    evaluate, search = dict(tables.get("evaluate", {})), dict(tables.get("search", {}))
    arguments: dict[str, Any] = {"base": tables.get("base"), "minimize": tables.get("minimize", "dr")}
    if "method" in evaluate:
        arguments["evaluate"] = evaluate.pop("method")
    for name, dimension in (("p", "momentum"), ("cos_theta", "dimensionless")):
        if name in evaluate:
            arguments[name] = numbers(f"evaluate.{name}", evaluate.pop(name), dimension, problems)
    arguments |= evaluate | search
    arguments["space"] = {key: range_of(value) for key, value in tables.get("vary", {}).items()}
    arguments["constraints"] = _limits(tables.get("constraints", {}), problems)
    arguments["background"] = tables.get("background")
    arguments["settings"] = settings_of(tables.get("settings"), problems)
    problems += base_problems(tables)
    if problems:
        raise PlanError(str(path), problems)
    return OptimizePlan(tables, arguments)


def _limits(tables: Mapping[str, Any], problems: list[str]) -> dict[str, tuple[Any, Any]]:
    found = {}
    for name, ends in tables.items():
        if not isinstance(ends, Mapping) or not ends or not ends.keys() <= {"min", "max"}:
            problems.append(f"constraints.{name}: got {ends!r}, expected {{ min = ..., max = ... }}, or one of them")
        else:
            found[name] = (ends.get("min"), ends.get("max"))
    return found
