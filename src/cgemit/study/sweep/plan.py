"""Sweep plans as TOML files: variables and what is evaluated."""

from __future__ import annotations

import importlib.util
import os
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cgemit.analysis.quantities import NAMES
from cgemit.base.errors import ProblemsError, did_you_mean
from cgemit.base.files import new_file, toml_text
from cgemit.base.settings import SettingsError
from cgemit.chain.settings import Settings
from cgemit.study.sweep.evaluate import SWEPT, result_columns
from cgemit.study.sweep.result import Sweep
from cgemit.study.sweep.run import sweep
from cgemit.study.sweep.space import space_of
from cgemit.units import QuantityError, parse_quantity

PLAN = "plan.toml"


class PlanError(ProblemsError[str]):
    """A plan with mistakes; `problems` lists them all."""


@dataclass(frozen=True)
class PlanFile:
    """A plan that was read.

    Attributes
    ----------
    tables : mapping
        As in the file, with changes.
    arguments : mapping
        Of the function that the plan is for.
    """

    tables: Mapping[str, Any]
    arguments: Mapping[str, Any]

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write the plan to the folder of its output, from where it can be read again."""
        path = Path(folder) / PLAN
        with new_file(path, overwrite=True) as temporary:
            temporary.write_text(toml_text(self.tables), encoding="utf-8")
        return path


def read_tables(
    path: str | os.PathLike[str],
    changes: Mapping[str, Any],
    keys: Mapping[str, Collection[str]],
    free: Collection[str],
    problems: list[str],
) -> dict[str, Any]:
    """Return the tables of the file of a plan, with changes and with paths of files beside it made absolute.

    Parameters
    ----------
    path : path
    changes : mapping of str to object
        Values by dotted key.
    keys : mapping of str to names
        Known keys of each table, those of the file itself under an empty name. Others are left out.
    free : names
        Tables whose keys are checked elsewhere.
    problems : list of str
        Problems of changes and keys are added.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    PlanError
        If it is no TOML file, or something else stands where a table is expected: nothing more can be checked then.
    """
    tables = _changed(path, changes, problems)
    for name in (*filter(None, keys), *free):
        if not isinstance(tables.get(name, {}), Mapping):
            problems.append(f"{name}: got {tables[name]!r}, expected a table [{name}]")
    if "variants" in keys[""] and not isinstance(tables.get("variants", []), list):
        problems.append(f"variants: got {tables['variants']!r}, expected tables [[variants]]")
    if problems:
        raise PlanError(str(path), problems)
    return _placed(_without_unknown(tables, keys, problems), Path(path).resolve().parent)


def base_problems(tables: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with the base of a plan."""
    if isinstance(tables.get("base"), str):
        return []
    return [f"base: got {tables.get('base')!r}, expected a preset or a detector file"]


def _changed(path: str | os.PathLike[str], changes: Mapping[str, Any], problems: list[str]) -> dict[str, Any]:
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise PlanError(str(path), [f"got {error}; expected a TOML file"]) from error
    for key, value in changes.items():
        _change(tables, key, value, problems)
    return tables


def _change(tables: dict[str, Any], key: str, value: Any, problems: list[str]) -> None:
    """Replace one value of a plan's tables, by dotted key."""
    first, _, rest = key.partition(".")
    if not rest:
        tables[first] = value
    elif not isinstance(tables.setdefault(first, {}), dict):
        problems.append(f"{key}: got {value!r}, expected a value of a table; {first} is none")
    elif first == "settings":
        stage, _, name = rest.partition(".")
        tables[first].setdefault(stage, {})[name] = value
    else:
        tables[first][rest] = value


def _without_unknown(
    tables: Mapping[str, Any], keys: Mapping[str, Collection[str]], problems: list[str]
) -> dict[str, Any]:
    """Return the tables of a plan without keys that are not known; these are added to the problems."""
    found = dict(tables)
    for name, known in keys.items():
        table = tables.get(name, {}) if name else tables
        before = f"{name}." if name else ""
        for key in table:
            if key not in known:
                problems.append(
                    f"{before}{key}: an unknown key; expected one of {', '.join(known)}{did_you_mean(key, known, '; ')}"
                )
        if name in tables:
            found[name] = {key: value for key, value in table.items() if key in known}
    return {key: value for key, value in found.items() if key in keys[""]}


def _placed(tables: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the tables with paths of files beside the plan made absolute."""
    found = dict(tables)
    if isinstance(found.get("base"), str) and (folder / found["base"]).is_file():
        found["base"] = str(folder / found["base"])
    method = found.get("evaluate", {}).get("method")
    if isinstance(method, str) and ":" in method:
        found["evaluate"] = {**found["evaluate"], "method": str(folder / method)}
    return found


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
        "quantities": f"resolutions to be computed (default: {', '.join(SWEPT)})",
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
    method, names = arguments.get("evaluate", "analytic"), arguments.get("quantities", SWEPT)
    if "quantity" not in table or method not in ("analytic", "mc") or not isinstance(names, Sequence):
        return []
    quantity, known = table["quantity"], result_columns(method, [NAMES[one] for one in names if one in NAMES])
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
