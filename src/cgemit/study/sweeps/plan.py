"""A sweep as a TOML file: what is varied, what is evaluated."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cgemit.problems import did_you_mean
from cgemit.settings import SettingsError
from cgemit.stages import Settings
from cgemit.study.sweeps.evaluate import QUANTITIES, result_columns
from cgemit.study.sweeps.plan_file import PlanError, PlanFile, base_problems, read_tables
from cgemit.study.sweeps.result import Sweep
from cgemit.study.sweeps.run import sweep
from cgemit.study.sweeps.space import space_of
from cgemit.units import QuantityError, parse_quantity

#: Keys of each table of a plan, with what they mean; docs/sweeps.md shows them.
KEYS: dict[str, dict[str, str]] = {
    "": {
        "base": "preset or detector file that the variants change",
        "vary": "keys of the detector file and their values, or { from, to } of samples",
        "variants": "a list of variants, instead of vary",
        "sample": "how values of vary are combined",
        "evaluate": "what is computed for each variant",
        "settings": "settings of the stages, as in a file of settings",
        "draw": "what is drawn",
    },
    "sample": {
        "kind": '"grid" (default), "sobol" or "latin_hypercube"',
        "n": "number of variants of a sample",
        "seed": "seed of a sample (default 1)",
    },
    "evaluate": {
        "method": '"analytic" (default), "mc" or "FILE.py:FUNCTION", relative to the plan',
        "particle": 'name or PDG number (default "mu-")',
        "p": "momentum or list of momenta, GeV/c or with a unit (default 1)",
        "cos_theta": 'number, "LOW:HIGH" for a uniform range, or a list of these (default 0)',
        "events": "simulated events for each variant, momentum and angle (default 2000)",
        "seed": "seed of the simulation (default 1)",
        "quantities": "resolutions to be computed (default: p, pt, dr, dz, phi0, theta, tanl)",
        "samples": "analytic: tracks that are averaged at each point",
        "chunk": "variants in one chunk",
    },
    "draw": {
        "quantity": "column of the results (default: the first resolution)",
        "kind": '"scan", "map", "parallel" or "budget"',
    },
}


@dataclass(frozen=True)
class Plan(PlanFile):
    """The plan of a sweep.

    Attributes
    ----------
    draw : mapping
        Arguments of `Sweep.draw`.
    """

    draw: Mapping[str, Any]

    def run(self, **how: Any) -> Sweep:
        """Run the sweep with further arguments of `sweep`: `output`, `executor`, `part`, `progress` ..."""
        return sweep(**self.arguments, **how)


def read_plan(path: str | os.PathLike[str], changes: Mapping[str, Any] | None = None) -> Plan:
    """Return the plan of a TOML file.

    Parameters
    ----------
    path : path
    changes : mapping of str to object, optional
        Values that replace those of the file, by dotted key such as ``evaluate.events`` or ``vary.cgem.*.pitch_x``.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    PlanError
        With every problem of the plan.
    """
    problems: list[str] = []
    tables = read_tables(path, changes or {}, KEYS, ("vary", "settings"), problems)
    if ("vary" in tables) == ("variants" in tables):
        given = "both" if "vary" in tables else "none"
        raise PlanError(str(path), [*problems, f"vary, variants: got {given}, expected one of them"])
    arguments = {"base": tables.get("base"), **_evaluate(tables.get("evaluate", {}), problems)}
    arguments["space"] = space_of(tables, problems)
    arguments["settings"] = settings_of(tables.get("settings"), problems)
    problems += _draw_problems(tables.get("draw", {}), arguments)
    problems += base_problems(tables)
    if problems:
        raise PlanError(str(path), problems)
    return Plan(tables, arguments, tables.get("draw", {}))


def _evaluate(table: Mapping[str, Any], problems: list[str]) -> dict[str, Any]:
    plain = ("particle", "events", "seed", "chunk", "quantities", "samples")
    found = {key: table[key] for key in plain if key in table}
    if "method" in table:
        found["evaluate"] = _method(table["method"], problems)
    if "p" in table:
        found["p"] = numbers("evaluate.p", table["p"], "momentum", problems)
    if "cos_theta" in table:
        found["cos_theta"] = numbers("evaluate.cos_theta", table["cos_theta"], "dimensionless", problems)
    return found


def numbers(path: str, given: Any, dimension: str, problems: list[str]) -> Any:
    """Return numbers, numbers with units and ranges ``LOW:HIGH`` of a plan as `sweep` takes them."""
    if isinstance(given, list):
        return [numbers(f"{path}[{i}]", one, dimension, problems) for i, one in enumerate(given)]
    if not isinstance(given, str):
        return given
    try:
        ends = [float(text) if _is_number(text) else parse_quantity(text, dimension) for text in given.split(":")]
    except QuantityError as error:
        problems.append(f"{path}: got {error}")
        return 0.0
    return ends[0] if len(ends) == 1 else tuple(ends)


def _draw_problems(table: Mapping[str, Any], arguments: Mapping[str, Any]) -> list[str]:
    """Return the problem of a quantity that is no column; columns of a function are not known before it runs."""
    method, names = arguments.get("evaluate", "analytic"), arguments.get("quantities", tuple(QUANTITIES))
    if "quantity" not in table or method not in ("analytic", "mc") or not isinstance(names, Sequence):
        return []
    quantity, known = table["quantity"], result_columns(method, [one for one in names if one in QUANTITIES])
    if quantity in known:
        return []
    return [f"draw.quantity: got {quantity!r}, expected one of {', '.join(known)}{did_you_mean(quantity, known, '; ')}"]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _method(method: Any, problems: list[str]) -> Any:
    if not isinstance(method, str) or ":" not in method:
        return method
    file, _, name = method.rpartition(":")
    spec = importlib.util.spec_from_file_location(Path(file).stem, file)
    if spec is None or spec.loader is None or not Path(file).is_file():
        problems.append(f"evaluate.method: got {method!r}, expected FILE.py:FUNCTION with a file that exists")
        return method
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    function = getattr(module, name, None)
    if not callable(function):
        problems.append(f"evaluate.method: got {method!r}, expected a function of that file")
    return function


def settings_of(table: Mapping[str, Any] | None, problems: list[str]) -> Settings | None:
    """Return the settings of a plan, None if it has none; every problem is added to `problems`."""
    if table is None:
        return None
    try:
        return Settings.from_dict(table)
    except SettingsError as error:
        problems += [f"settings.{text}" for text in error.problems]
    return None
