"""Plans of sweeps as TOML files; what plans of other studies share with them."""

from __future__ import annotations

import importlib.util
import os
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from cgemit.base.errors import Problem, Problems, did_you_mean
from cgemit.base.files import SUMMARY, add_files, parse_toml, read_text, toml_text
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Whole, build, entries
from cgemit.chain.settings import Settings
from cgemit.detector import load
from cgemit.detector.export import write_files
from cgemit.detector.files import MAPS, is_field, is_file, is_preset
from cgemit.study.sweep.evaluate import SWEPT, Evaluated, Evaluation, Seed, identity, result_columns
from cgemit.study.sweep.result import Sweep
from cgemit.study.sweep.run import bases_of, sweep
from cgemit.study.sweep.space import (
    NAMES_FILES,
    PlanError,
    Space,
    grid,
    latin_hypercube,
    listed,
    sobol,
    with_files,
)

PLAN, BASE = "plan.toml", "detector.toml"
#: Key of [evaluate] in a plan that was written beside results: the identity of the function that made them.
FUNCTION = "function"

#: Tables of a plan that hold keys of the detector file, or settings: any key may stand there.
_FREE = ("vary", "constraints")


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

    def write(self, folder: str | os.PathLike[str]) -> None:
        """Write the plan to the folder of its output, from where it can be read again, also if that is moved.

        A detector file comes along as detector.toml, files that variants name come along under their names. The path to
        the file of a function is relative to the folder; the function's identity serves to read its results without
        that file. Raises OutputExistsError if one of the files is there that cgemit did not write, or that was changed.
        """
        tables, base = dict(self.tables), load(self.tables["base"])
        detectors = {}
        if not is_preset(tables["base"]):
            detectors[BASE] = base
            tables["base"] = BASE
        evaluation = self.arguments["evaluate"]
        if evaluation.function is not None:
            method = os.path.relpath(tables["evaluate"]["method"], Path(folder).resolve())
            tables["evaluate"] = {**tables["evaluate"], "method": method, FUNCTION: identity(evaluation.function)}
        tables = self.beside(tables, Path(folder).resolve())
        with add_files(folder) as place:
            for (key, name), path in getattr(self.arguments["space"], "files", {}).items():
                (place / name).parent.mkdir(parents=True, exist_ok=True)
                if path.suffix in MAPS:
                    shutil.copyfile(path, place / name)
                else:
                    detectors[name] = load(path) if key == "base" else base.with_field(path)
            write_files(place, detectors)
            # Ranges in place, since TOML has tables last: the order of the keys is that of columns and of searches.
            ranges = {key for name in _FREE for key in tables.get(name, ())}
            (place / PLAN).write_text(toml_text(tables, in_place=ranges), encoding="utf-8")

    def beside(self, tables: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Return the tables with further paths as they are seen from a folder."""
        return tables


def read_tables(
    path: str | os.PathLike[str], changes: Mapping[str, Any], known: Collection[str], problems: Problems
) -> dict[str, Any]:
    """Return the tables of the file of a plan, with changes and with paths of files beside it made absolute.

    Parameters
    ----------
    path : path
    changes : mapping of str to object
        Values by dotted key.
    known : names
        What the file may hold.
    problems : Problems
        Receives problems of changes, keys and the base.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    PlanError
        If it is no TOML file, or one that is too large or too deeply nested.
    """
    try:
        tables = parse_toml(read_text(path))
    except ValueError as error:
        raise PlanError(str(path), [Problem("", f"not a TOML file: {error}", "")]) from error
    for key, value in changes.items():
        _change(tables, key, value, problems)
    tables = dict(entries(tables, "", known, problems))
    for name in _FREE:
        if not isinstance(tables.get(name, {}), Mapping):
            entries(tables.pop(name), name, (), problems)
    folder = Path(path).resolve().parent
    base, evaluate = tables.get("base"), tables.get("evaluate")
    if not isinstance(base, str):
        problems.note("base", repr(base), "a preset or a detector file")
    elif (folder / base).is_file():
        tables["base"] = str(folder / base)
    method = evaluate.get("method") if isinstance(evaluate, Mapping) else None
    if isinstance(method, str) and ":" in method:
        tables["evaluate"] = {**tables["evaluate"], "method": str(folder / method)}
    return tables


def _change(tables: dict[str, Any], key: str, value: Any, problems: Problems) -> None:
    """Replace one value of a plan's tables, by dotted key."""
    first, _, below = key.partition(".")
    if not below:
        tables[first] = value
    elif not isinstance(tables.setdefault(first, {}), dict):
        problems.note(key, repr(value), f"a value of a table; {first} is none")
    elif first == "settings":
        stage, _, name = below.partition(".")
        tables[first].setdefault(stage, {})[name] = value
    else:
        tables[first][below] = value


def read_evaluation(
    tables: Mapping[str, Any], without: Collection[str], problems: Problems, *, evaluated: bool = False
) -> Evaluation | None:
    """Return the evaluation of the tables [evaluate] and [settings]; None, with problems noted, if it is wrong.

    `without` names keys of `Evaluation` that the plan does not have. With `evaluated`, no file is run: the identity of
    a function stands for it.
    """
    settings = build(Settings, tables["settings"], "settings", problems) if "settings" in tables else None
    known = [one.name for one in fields(Evaluation) if one.name not in ("settings", *without)]
    stated = tables.get("evaluate", {})
    stored = stated.get(FUNCTION) if isinstance(stated, Mapping) else None
    if stored is not None:
        stated = {name: value for name, value in stated.items() if name != FUNCTION}
    table = dict(entries(stated, "evaluate", known, problems))
    if isinstance(table.get("method"), str) and ":" in table["method"]:
        table["method"] = (
            Evaluated(str(stored)) if evaluated else function_of("evaluate.method", table["method"], problems)
        )
    found = build(Evaluation, table, "evaluate", problems)
    return replace(found, settings=settings) if found is not None else None


def function_of(path: str, text: str, problems: Problems) -> Any:
    """Return the function of ``FILE.py:FUNCTION``; a placeholder, with a problem noted at a path, if there is none."""
    file, _, name = text.rpartition(":")
    spec = importlib.util.spec_from_file_location(Path(file).stem, file)
    if spec is None or spec.loader is None or not Path(file).is_file():
        problems.note(path, repr(text), "FILE.py:FUNCTION with a file that exists")
        return dict
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    function = getattr(module, name, None)
    if not callable(function):
        problems.note(path, repr(text), "a function of that file")
        return dict
    return function


@dataclass(frozen=True)
class Sample(SettingsData):
    """How the values of ``[vary]`` are combined; the table ``[sample]`` of a plan.

    Attributes
    ----------
    kind : "grid", "sobol" or "latin_hypercube"
        Every combination of listed values, or a sample of ranges.
    n : int or None
        Number of variants of a sample.
    seed : int
        Seed of a sample.
    """

    kind: Literal["grid", "sobol", "latin_hypercube"] = "grid"
    n: Annotated[int, Whole(1, 10_000_000)] | None = None
    seed: Seed = 1

    def contradictions(self, problems: Problems) -> None:
        """Note a sample without a number of variants."""
        if self.kind != "grid" and self.n is None:
            problems.note("n", "nothing", f"the number of variants of {self.kind!r}")

    def space(self, vary: Mapping[str, Any]) -> Space:
        """Return the variants of the keys and values of ``[vary]``."""
        if self.kind == "grid":
            return grid(vary)
        ranges = {key: range_of(value) for key, value in vary.items()}
        return (sobol if self.kind == "sobol" else latin_hypercube)(ranges, self.n or 0, seed=self.seed)


def range_of(value: Any) -> Any:
    """Return ``{ from, to }`` of a plan as (low, high); other values as they are."""
    return (value["from"], value["to"]) if isinstance(value, Mapping) and value.keys() == {"from", "to"} else value


@dataclass(frozen=True)
class Draw(SettingsData):
    """What is drawn of a sweep; the table ``[draw]`` of a plan.

    Attributes
    ----------
    quantity : str or None
        Column of the results; None: the first resolution.
    kind : "scan", "map", "parallel", "budget" or None
    """

    quantity: str | None = None
    kind: Literal["scan", "map", "parallel", "budget"] | None = None


#: What the plan of a sweep may hold.
KEYS = ("base", "vary", "variants", "sample", "evaluate", "settings", "draw")


@dataclass(frozen=True)
class SweepPlan(PlanFile):
    """The plan of a sweep.

    Attributes
    ----------
    draw : Draw
    """

    draw: Draw

    def run(self, **how: Any) -> Sweep:
        """Run the sweep with further arguments of `sweep`: `output`, `workers`, `part`, `progress` ..."""
        return sweep(**self.arguments, **how)


def read_plan(
    path: str | os.PathLike[str], changes: Mapping[str, Any] | None = None, *, evaluated: bool = False
) -> SweepPlan:
    """Return the plan of a TOML file.

    Parameters
    ----------
    path : path
    changes : mapping of str to object, optional
        Values that replace those of the file, by dotted key such as ``evaluate.events`` or ``vary.cgem.*.pitch_x``.
    evaluated : bool
        Whether its results are only read, of a plan beside them: then the file of a function is not run.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    PlanError
        With every problem of the plan.
    """
    problems = Problems()
    tables = read_tables(path, changes or {}, KEYS, problems)
    evaluate = read_evaluation(tables, (), problems, evaluated=evaluated)
    sample = build(Sample, tables.get("sample", {}), "sample", problems)
    draw = build(Draw, tables.get("draw", {}), "draw", problems)
    files = _named_files(tables, Path(path).resolve().parent)
    space = _space(tables, sample, problems)
    known = _columns(evaluate)
    if draw and draw.quantity and known and draw.quantity not in known:
        hint = did_you_mean(draw.quantity, known)
        problems.note("draw.quantity", repr(draw.quantity), f"one of {', '.join(known)}", hint)
    space = space and replace(space, files=files)
    if problems and isinstance(tables.get("base"), str):  # else `sweep` finds the others
        bases_of(problems.collect(load, tables["base"], path="base"), space, problems)
    problems.report(str(path), PlanError)
    assert draw is not None
    assert space is not None
    arguments = {"base": tables["base"], "space": space, "evaluate": evaluate}
    return SweepPlan(tables, arguments, draw)


def _columns(evaluate: Evaluation | None) -> tuple[str, ...]:
    """Return the columns of numbers that a sweep may have; none for a function, whose are not known before it runs."""
    if evaluate is None:  # it has problems of its own
        return (*result_columns("mc", SWEPT), "reached")
    return () if evaluate.function else result_columns(evaluate.kind, evaluate.quantities, evaluate.counts_radiation)


def _named_files(tables: dict[str, Any], folder: Path) -> dict[tuple[str, str], Path]:
    """Name the files that variants name as they are stored beside the plan; return where they are, by key and name.

    A name is relative to the plan, else to the working directory. One that would leave the folder loses its folders.
    """
    files: dict[tuple[str, str], Path] = {}
    taken: dict[str, Path | None] = dict.fromkeys((PLAN, BASE, "sweep.csv", SUMMARY))

    def name_of(key: str, given: str) -> str:
        path = next((one.resolve() for one in (folder / given, Path(given)) if is_file(one)), None)
        if path is None or (is_preset if key == "base" else is_field)(given):
            return given
        inside = not Path(given).is_absolute() and ".." not in Path(given).parts
        name = first = Path(given) if inside else Path(path.name)
        number = 0
        while taken.setdefault(str(name), path) != path:
            number += 1
            name = first.with_stem(f"{first.stem}-{number}")
        files[key, str(name)] = path
        return str(name)

    def named(key: str, value: Any) -> Any:
        if key not in NAMES_FILES:
            return value
        return (
            [with_files(key, v, name_of) for v in value] if isinstance(value, list) else with_files(key, value, name_of)
        )

    def changed(variant: Any) -> Any:
        return {key: named(key, v) for key, v in variant.items()} if isinstance(variant, Mapping) else variant

    for group in tables.keys() & {"vary", "variants"}:
        given = tables[group]
        tables[group] = [changed(one) for one in given] if isinstance(given, list) else changed(given)
    return files


def _space(tables: Mapping[str, Any], sample: Sample | None, problems: Problems) -> Space | None:
    stated = [name for name in ("vary", "variants") if name in tables]
    if len(stated) != 1:
        problems.note("vary, variants", "both" if stated else "none", "one of them")
    elif stated == ["vary"]:
        return problems.collect(sample.space, tables["vary"]) if sample else None
    elif isinstance(tables["variants"], list):
        return problems.collect(listed, tables["variants"])
    else:
        problems.note("variants", repr(tables["variants"]), "tables [[variants]]")
    return None
