"""Settings as data: dataclasses that check themselves by their annotations, and read and write TOML and JSON.

TOML has no null: None is left out where it is the default, and may be given as the text ``"none"``. A field that holds
one of several classes is a table with the key `name`, or that name alone for the defaults of the class.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields
from html import escape
from pathlib import Path
from typing import Any, Self

from cgemit.io.files import new_file, read_text
from cgemit.io.toml import flat, nested, parse_toml, toml_text
from cgemit.kinds import NO, Choice, allows_none, classes_in, expected, kinds_of, matched, problems_of
from cgemit.problems import ProblemsError, did_you_mean

_NONE = "none"


class SettingsError(ProblemsError[str]):
    """Settings with mistakes; `problems` lists them all, each beginning with the path to the value."""


class SettingsData:
    """Base of the frozen dataclasses that hold settings.

    Raises
    ------
    SettingsError
        A ValueError that lists every value that the annotation of its field does not allow, and values that do not go
        together.
    """

    def __post_init__(self) -> None:
        problems = []
        for name, kind in kinds_of(type(self)).items():
            given = getattr(self, name)
            value = matched(kind, given)
            if value is NO:
                problems += [f"{name}: {text}" for text in problems_of(kind, given)]
            else:
                object.__setattr__(self, name, value)
        problems += self.contradictions()
        if problems:
            raise SettingsError(type(self).__name__, problems)

    def contradictions(self) -> list[str]:
        """Return which values do not go together; also called where values are wrong by themselves."""
        return []

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as nested dict of what JSON can hold: all of them, None as None."""
        return {name: _plain(getattr(self, name), kind) for name, kind in kinds_of(type(self)).items()}

    @classmethod
    def from_dict(cls, given: Mapping[str, Any], source: str = "") -> Self:
        """Return the settings that nested tables hold; what is left out has its default.

        Parameters
        ----------
        given : mapping
            As `to_dict`, or a TOML or JSON file, gives it.
        source : str
            Name of the source, for messages.

        Raises
        ------
        SettingsError
            Listing every unknown key and every wrong value, with its path.
        """
        problems: list[str] = []
        built = _build(cls, given, "", problems)
        if problems:
            raise SettingsError(source or cls.__name__, problems)
        return built  # type: ignore[no-any-return]

    @classmethod
    def from_layers(cls, layers: Sequence[tuple[str, Mapping[str, Any]]]) -> Self:
        """Return the settings that several sources give together: each is laid over those before it.

        Parameters
        ----------
        layers : sequence of (str, mapping)
            Name of the source for messages, such as a file, and its nested tables.

        Raises
        ------
        SettingsError
            Listing all problems of all sources, each with the source of the value.
        """
        tree: dict[str, Any] = {}
        origins: dict[str, str] = {}
        for origin, tables in layers:
            _lay_over(tree, tables, "", origin, origins)
        try:
            return cls.from_dict(tree, "settings")
        except SettingsError as error:
            raise SettingsError(error.source, [_with_origin(text, origins) for text in error.problems]) from None

    def _repr_html_(self) -> str:
        left = 'style="text-align:left"'
        rows = "".join(
            f"<tr><th {left}>{escape(path)}</th><td {left}>{escape(str(value))}</td></tr>"
            for path, value in flat("", self.to_dict())
        )
        return f"<p><b>{type(self).__name__}</b></p><table>{rows}</table>"

    def with_overrides(self, overrides: Mapping[str, object]) -> Self:
        """Return the settings with some values changed, such as ``{"fit.loss": "mean"}`` of settings of all stages.

        Parameters
        ----------
        overrides : mapping of str to object
            Dotted keys and their values, in the form that files have.

        Raises
        ------
        SettingsError
            Listing every problem.
        """
        return type(self).from_layers([("", self.to_dict()), *(("", nested(*item)) for item in overrides.items())])

    def to_toml(self, *, comments: bool = False) -> str:
        """Return all settings as the text of a TOML file, with `comments` also what each may be, None as the text."""
        tables = _without_none(self, self.to_dict(), say_none=comments)
        return toml_text(tables, comment=(lambda path: _about(self, path)) if comments else None)

    @classmethod
    def from_toml(cls, text: str, source: str = "TOML text") -> Self:
        """Return the settings that the text of a TOML file holds; see `from_dict`."""
        return cls.from_dict(_parsed(text, "TOML", source), source)

    def to_json(self) -> str:
        """Return all settings as the text of a JSON file."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str, source: str = "JSON text") -> Self:
        """Return the settings that the text of a JSON file holds; see `from_dict`."""
        return cls.from_dict(_parsed(text, "JSON", source), source)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Return the settings of a file: JSON if its name ends in ``.json``, else TOML.

        Raises
        ------
        SettingsError
            Listing every problem, or that the file cannot be read.
        """
        return cls.from_dict(read_tables(path), str(path))

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write all settings to a file: JSON if its name ends in ``.json``, else TOML.

        Raises
        ------
        FileExistsError
            If the file exists and `overwrite` is false.
        """
        text = self.to_json() if Path(path).suffix == ".json" else self.to_toml()
        with new_file(path, overwrite=overwrite) as temporary:
            temporary.write_text(text, encoding="utf-8")


def read_tables(path: str | os.PathLike[str]) -> Mapping[str, Any]:
    """Return the nested tables of a TOML or JSON file.

    Raises
    ------
    SettingsError
        If it cannot be read.
    """
    try:
        text = read_text(path)
    except (OSError, ValueError) as error:
        raise SettingsError(str(path), [f"got {error}, expected a TOML or JSON file"]) from error
    return _parsed(text, "JSON" if Path(path).suffix == ".json" else "TOML", str(path))


def _parsed(text: str, form: str, source: str) -> Mapping[str, Any]:
    try:
        tables = parse_toml(text) if form == "TOML" else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SettingsError(source, [f"got {error}, expected a {form} file"]) from error
    if not isinstance(tables, Mapping):
        raise SettingsError(source, [f"got {tables!r:.50}, expected tables of settings"])
    return tables


def _build(
    cls: type[Any], given: object, path: str, problems: list[str], choices: Mapping[str, type[Any]] | None = None
) -> Any:
    """Return an instance of a dataclass made of a table; None, with problems added, if there are any.

    `choices` are the classes of which this one was chosen: a key of another one is told apart from a misspelt one.
    """
    if not isinstance(given, Mapping):
        problems.append(f"{path.removesuffix('.')}: got {given!r}, expected a table of settings")
        return None
    kinds, values, before = kinds_of(cls), {}, len(problems)
    defaults = {f.name: f for f in fields(cls)}
    for name, raw in given.items():
        if name not in kinds:
            hint = _owner(name, cls, choices or {}) or did_you_mean(name, kinds, "; ")
            problems.append(f"{path}{name}: got an unknown key, expected one of {', '.join(kinds)}{hint}")
            continue
        count = len(problems)
        value = _read(kinds[name], raw, f"{path}{name}", problems, defaults[name])
        if len(problems) == count:
            values[name] = value
    try:
        built = cls(**values)
    except ValueError as error:  # of a class from elsewhere, too
        problems += [f"{path}{text}" for text in getattr(error, "problems", [str(error)])]
    return built if len(problems) == before else None


def _read(kind: Any, raw: object, path: str, problems: list[str], field: Field[Any]) -> Any:
    """Return a value of a file in the form that the dataclass takes; it checks the value itself."""
    classes = classes_in(kind)
    if not classes:
        return None if raw == _NONE and allows_none(kind) else raw
    if not isinstance(kind, Choice):
        return _build(classes[""], raw, f"{path}.", problems)
    table = dict(raw) if isinstance(raw, Mapping) else {"name": raw}
    name = table.pop("name", _default(field).name)
    if not isinstance(name, str) or name not in classes:
        problems += [f"{path}: {text}" for text in problems_of(kind, name)]
        return None
    return _build(classes[name], table, f"{path}.", problems, classes)


def _owner(key: str, cls: type[Any], choices: Mapping[str, type[Any]]) -> str:
    """Return which other choices have a key; an empty text if none has."""
    owners = [name for name, one in choices.items() if one is not cls and key in kinds_of(one)]
    mine = next((name for name, one in choices.items() if one is cls), "")
    return f"; it is a key of name = {' or '.join(map(repr, owners))}, and name is {mine!r} here" if owners else ""


def _default(field: Field[Any]) -> Any:
    return field.default_factory() if field.default_factory is not MISSING else field.default


def _plain(value: Any, kind: Any) -> Any:
    """Return a value as JSON has it."""
    if classes_in(kind):
        named = {"name": value.name} if isinstance(kind, Choice) else {}
        return named | {name: _plain(getattr(value, name), inner) for name, inner in kinds_of(type(value)).items()}
    return list(value) if isinstance(value, tuple) else value


def _about(settings: Any, path: str) -> str:
    """Return what the value at a dotted path may be."""
    first, _, rest = path.partition(".")
    value, kind = getattr(settings, first), kinds_of(type(settings))[first]
    return _about(value, rest) if rest and not (rest == "name" and isinstance(kind, Choice)) else expected(kind)


def _without_none(settings: Any, tables: Mapping[str, Any], *, say_none: bool) -> dict[str, Any]:
    """Return tables without what is None by default, and the text where None is not the default, or always."""
    found = dict(tables)
    for field in fields(settings):
        value = getattr(settings, field.name)
        if classes_in(kinds_of(type(settings))[field.name]):
            found[field.name] = _without_none(value, tables[field.name], say_none=say_none)
        elif value is None and _default(field) is None and not say_none:
            del found[field.name]
        elif value is None:
            found[field.name] = _NONE
    return found


def _lay_over(tree: dict[str, Any], tables: Mapping[str, Any], path: str, origin: str, origins: dict[str, str]) -> None:
    """Lay tables over others; another choice, or its bare name, replaces the settings of the one before."""
    for name, value in tables.items():
        origins[f"{path}{name}"] = origin
        if not isinstance(value, Mapping):
            tree[name] = value
            continue
        old = tree.get(name)
        below = {"name": old} if isinstance(old, str) else dict(old) if isinstance(old, Mapping) else {}
        if "name" in value and value["name"] != below.get("name"):
            below = {}
        _lay_over(below, value, f"{path}{name}.", origin, origins)
        tree[name] = below


def _with_origin(text: str, origins: Mapping[str, str]) -> str:
    """Return a problem with the source of the value before it, if that is known."""
    path = text.partition(":")[0]
    while path and path not in origins:
        path = path.rpartition(".")[0]
    origin = origins.get(path)
    return f"{origin}: {text}" if origin else text
