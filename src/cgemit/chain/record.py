"""The record of a run: all inputs of its results, as one JSON file beside them."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from cgemit.base.errors import Problem, Problems, ProblemsError, reason
from cgemit.base.files import RECORD, parse_toml, read_json, read_text
from cgemit.base.settings import SettingsData, SettingsError
from cgemit.base.validate import InTurn
from cgemit.base.version import __version__
from cgemit.detector import Detector, load
from cgemit.detector.export import stored_toml, write_files
from cgemit.detector.files import place_map
from cgemit.particles.gun import Gun, Guns, Source
from cgemit.particles.samples import EventSample
from cgemit.tables import Table
from cgemit.tables.store import StoredTables, about_of


def gun_data(gun: Source | Guns | None) -> list[dict[str, Any]] | None:
    """Return the particle source as JSON: one object per gun, a range as ``{"from": low, "to": high}``.

    None stands for given particles.
    """
    if gun is None:
        return None
    guns = gun.guns if isinstance(gun, Guns) else (gun,)
    return [_data_of(one) for one in guns]


def _data_of(source: Source) -> dict[str, Any]:
    """Return one source as JSON; the key ``sample`` tells samples from guns."""
    named = (
        {"sample": source.name, **source.options()}
        if isinstance(source, EventSample)
        else {n: getattr(source, n) for n in _GUN}
    )
    return {name: _value_data(name, value) for name, value in named.items()}


def gun_from(data: Any, problems: Problems) -> Source | Guns | None:
    """Return the source that `gun_data` was made from; None, with problems added, if there are any."""
    if data is None:
        return None
    try:
        guns = [_source_from({name: _value(name, value) for name, value in one.items()}) for one in data]
        return guns[0] if len(guns) == 1 else Guns(tuple(guns))
    except ValueError as error:
        problems.take(error, f"{RECORD}: source")
    except (TypeError, KeyError, IndexError, AttributeError) as error:
        problems.note(f"{RECORD}: source", str(error), "a source of particles")
    return None


def _source_from(given: dict[str, Any]) -> Source:
    return EventSample(given.pop("sample"), **given) if "sample" in given else Gun(**given)


_GUN = [f.name for f in fields(Gun)]
_TRIPLES = ("vertex", "vertex_sigma")


def _value_data(name: str, value: Any) -> Any:
    if name in _TRIPLES:
        return [_value_data("", one) for one in value]
    if isinstance(value, InTurn):
        return list(value.values)
    return {"from": value[0], "to": value[1]} if isinstance(value, tuple) else value


def _value(name: str, data: Any) -> Any:
    if name in _TRIPLES:
        return tuple(_value("", one) for one in data)
    return (data["from"], data["to"]) if isinstance(data, dict) else data


FORMAT = "cgemit-run-1"

S = TypeVar("S", bound=SettingsData)

#: The detector of a run, for other commands; the record holds it, too.
DETECTOR = "detector.toml"

_KINDS = {
    "versions": dict, "configuration": str, "seed": int, "events": int, "first_event": int, "timings": dict,
    "settings": dict, "detectors": dict,
}  # fmt: skip


def _numbers(raw: object) -> bool:
    """Return whether something maps names to numbers that are not negative."""
    return isinstance(raw, dict) and all(type(value) in (int, float) and value >= 0 for value in raw.values())


#: What entries hold beside their type: a check, and what it expects.
_VALUES: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "timings": (lambda given: _numbers(given) and "wall" in given, "seconds by stage, with 'wall' for all"),
    "transported": (_numbers, "numbers of particles by status"),
    "tables": (lambda given: isinstance(given, list) and set(map(type, given)) <= {str}, "a list of names"),
}


class RecordError(ProblemsError):
    """A folder of results that is damaged or mixes several runs; `problems` lists every problem."""


def versions() -> dict[str, str]:
    """Return the versions that results depend on."""
    return {"cgemit": __version__, "python": platform.python_version(), "numpy": np.__version__}


def configuration_of(detectors: Mapping[str, str], settings: Mapping[str, Any], source: object) -> str:
    """Return the hash of what a run was configured with: the same after writing and reading.

    Parameters
    ----------
    detectors : mapping of str to str
        The complete TOML files by the role of the detectors.
    settings : mapping
        Settings of all stages, as `to_dict` returns them.
    source : object
        The particle source as JSON.

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    text = json.dumps([dict(detectors), dict(settings), source], sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def record(
    *, detectors: Mapping[str, Detector], settings: SettingsData, seed: int, source: object, command: str = "",
    **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """Return what `run.json` holds.

    Parameters
    ----------
    detectors : mapping of str to Detector
        By their role.
    settings : Settings
        Of all stages.
    seed : int
    source : object
        The particle source as JSON (`gun_data`).
    command : str
        Command line that made the results; empty from Python.
    **more
        Further entries.
    """
    texts = {name: stored_toml(detector) for name, detector in detectors.items()}
    return {
        "format": FORMAT, "command": command or None, "versions": versions(),
        "configuration": configuration_of(texts, settings.to_dict(), source), "seed": int(seed), **more,
        "source": source, "settings": settings.to_dict(), "detectors": texts,
    }  # fmt: skip


def write_record(entries: Mapping[str, Any], folder: Path) -> Path:
    """Write `run.json` and return its path."""
    path = folder / RECORD
    path.write_text(json.dumps(entries, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return path


def write_about(folder: Path, detectors: Mapping[str, Detector], entries: Mapping[str, Any]) -> list[Path]:
    """Write the detectors of a run, by their role, and its record beside its tables; return the files."""
    files = {DETECTOR if role == "detector" else f"{role}.toml": one for role, one in detectors.items()}
    return [*write_files(folder, files), write_record(entries, folder)]


class Run(NamedTuple, Generic[S]):
    """The content of a run's folder: entries of the record, and the objects that they describe."""

    entries: Mapping[str, Any]
    detectors: Mapping[str, Detector]
    gun: Source | Guns | None
    settings: S
    tables: Mapping[str, Table]


def read_run(
    folder: Path, kind: type[S], names: Collection[str], required: Collection[str], *, lazy: bool = False
) -> Run[S]:
    """Read what `Result.save` or `run` wrote.

    Parameters
    ----------
    folder : Path
    kind : type
        The class of the settings of all stages.
    names, required : collection of str
        Tables that a run may hold, and those that it must if the record does not list its tables.
    lazy : bool
        Whether tables are read and checked when they are asked for only.

    Raises
    ------
    FileNotFoundError
        If the folder holds no run.
    RecordError
        Listing everything that is damaged or does not belong together.
    """
    problems = Problems()
    entries = _read_record(folder, problems)
    tables = _read_tables(folder, names, entries.get("tables", required), problems, lazy=lazy)
    detectors, gun, settings = _read_entries(folder, entries, kind, problems)
    if entries:
        problems += _strangers(tables, entries)
        copy = folder / DETECTOR
        if copy.is_file() and read_text(copy) != entries["detectors"].get("detector"):
            problems.note(DETECTOR, "another detector", f"that of {RECORD}")
    problems.report(str(folder), RecordError)
    return Run(entries, detectors, gun, settings, tables)


def recorded_settings(path: str | os.PathLike[str]) -> Mapping[str, Any]:
    """Return the tables of settings that the record of a run, ``run.json``, holds.

    Raises
    ------
    SettingsError
        If it is no such file.
    """
    try:
        tables = read_json(path)
        if tables["format"] == FORMAT and isinstance(tables["settings"], Mapping):
            return tables["settings"]
        got = f"format {tables['format']!r:.50}"
    except (OSError, ValueError, KeyError, TypeError) as error:
        got = reason(error)
    raise SettingsError(str(path), [Problem("", got, f"a TOML file of settings, or the {RECORD} of a run")])


def _read_record(folder: Path, problems: Problems) -> dict[str, Any]:
    """Return what `run.json` of a folder holds; empty, with problems added, if it is damaged."""
    path = folder / RECORD
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no complete run ({RECORD} is missing)")
    try:
        entries = read_json(path)
    except ValueError as error:
        problems.note(RECORD, str(error), "a JSON file")
        return {}
    if not isinstance(entries, dict) or entries.get("format") != FORMAT:
        given = entries.get("format") if isinstance(entries, dict) else entries
        problems.note(RECORD, f"format {given!r:.50}", repr(FORMAT))
        return {}
    wrong = [name for name, kind in _KINDS.items() if not isinstance(entries.get(name), kind)]
    if wrong or "source" not in entries:
        problems.note(RECORD, f"no entry, or a wrong one, for {', '.join(wrong or ['source'])}", "a complete record")
        return {}
    wrong_values = [
        Problem(f"{RECORD}: {name}", f"{entries[name]!r:.60}", expected)
        for name, (good, expected) in _VALUES.items()
        if name in entries and not good(entries[name])
    ]
    problems += wrong_values
    return {} if wrong_values else entries


def _read_entries(
    folder: Path, entries: Mapping[str, Any], kind: type[S], problems: Problems
) -> tuple[dict[str, Detector], Source | Guns | None, S]:
    """Return what the entries of a record describe; problems are added."""
    if not entries:
        return {}, None, kind()
    hashed = configuration_of(entries["detectors"], entries["settings"], entries["source"])
    if entries["configuration"] != hashed:
        expected = f"{hashed!r}, the hash of its detectors, settings and source"
        problems.note(f"{RECORD}: configuration", repr(entries["configuration"]), expected)
    if "detector" not in entries["detectors"]:
        problems.note(f"{RECORD}: detectors.detector", "nothing", "the detector of the run")
    read = {name: _detector(str(text), name, folder, problems) for name, text in entries["detectors"].items()}
    detectors = {name: detector for name, detector in read.items() if detector is not None}
    try:
        settings = kind.from_dict(entries["settings"])
    except SettingsError as error:
        problems.take(error, f"{RECORD}: settings")
        settings = kind()
    return detectors, gun_from(entries["source"], problems), settings


def _read_tables(
    folder: Path, names: Collection[str], required: Collection[str], problems: Problems, *, lazy: bool
) -> Mapping[str, Table]:
    """Return the tables of a folder; problems are added."""
    try:
        stored = StoredTables(folder)
    except (ValueError, FileNotFoundError) as error:
        problems.note("", str(error), "")
        return {}
    known = ", ".join(names)
    problems += [Problem(stored.file(name), "a table that no run has", known) for name in stored if name not in names]
    problems += [Problem(f"{name}.npz", "nothing", "this table") for name in required if name not in stored]
    if lazy:
        problems += [Problem("", text, "") for text in stored.problems()]
        return stored if not problems else {}
    tables = {}
    for name in (name for name in stored if name in names):
        try:
            tables[name] = stored.read(name, check=False)
        except (ValueError, FileNotFoundError) as error:
            problems.note(stored.file(name), str(error), "")
    return tables


def _strangers(tables: Mapping[str, Table], entries: Mapping[str, Any]) -> Problems:
    """Return which tables are not of the run that the record describes."""
    expected = {
        "events": entries["events"], "first_event": entries["first_event"], "seed": entries["seed"],
        "configuration": entries["configuration"], "version": entries["versions"].get("cgemit"),
    }  # fmt: skip
    problems = Problems()
    for name in tables:
        described = about_of(tables, name)
        meta = described["meta"] if isinstance(described.get("meta"), dict) else {}
        stated = {"events": described["n_events"], "first_event": described["first_event"], **meta}
        wrong = [key for key, value in expected.items() if stated.get(key) != value]
        for key in wrong:
            problems.note(f"{name}.npz: {key}", repr(stated.get(key)), f"{expected[key]!r}, as {RECORD} says")
        if described["kind"] != name:
            problems.note(f"{name}.npz", f"a table of kind {described['kind']!r}", repr(name))
    return problems


def _detector(text: str, name: str, folder: Path, problems: Problems) -> Detector | None:
    """Return the detector of a complete TOML file in a folder; None, with problems added, if there are any."""
    try:
        return load(place_map(parse_toml(text), folder))
    except ValueError as error:
        problems.take(error, f"{RECORD}: detectors.{name}")
    return None


def table_meta(
    detectors: Mapping[str, Detector], settings: SettingsData, seed: int, source: Source | Guns | None
) -> dict[str, Any]:
    """Return what every table of a run says about it.

    Parameters
    ----------
    detectors : mapping of str to Detector
        By their role: ``detector``, and ``fit_detector`` if that is another one.
    settings : SettingsData
    seed : int
    source : Source, Guns or None
        None: the particles were given.
    """
    texts = {name: stored_toml(one) for name, one in detectors.items()}
    return {
        "version": __version__,
        "configuration": configuration_of(texts, settings.to_dict(), gun_data(source)),
        "detector": detectors["detector"].name,
        "seed": seed,
    }
