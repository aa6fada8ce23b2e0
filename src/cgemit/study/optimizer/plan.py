"""An optimization as a TOML file: what is varied, minimized and limited."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from cgemit.study.optimizer.result import Optimization
from cgemit.study.optimizer.run import optimize
from cgemit.study.sweeps.plan import numbers, settings_of
from cgemit.study.sweeps.plan_file import PlanError, PlanFile, base_problems, read_tables
from cgemit.study.sweeps.space import range_of

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
