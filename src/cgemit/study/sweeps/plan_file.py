"""The TOML file of a sweep or an optimization: read with changes, checked in its form, written again."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cgemit.io import new_file
from cgemit.io.toml import toml_text
from cgemit.problems import ProblemsError, did_you_mean

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
