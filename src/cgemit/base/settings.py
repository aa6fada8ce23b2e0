"""Settings as frozen dataclasses: annotations define the allowed values; TOML, JSON and `--set` follow."""

from __future__ import annotations

import functools
import json
import math
import os
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from html import escape
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    Protocol,
    Self,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
import numpy.typing as npt

from cgemit.base.errors import ProblemsError, did_you_mean
from cgemit.base.files import flat, nested, new_file, parse_toml, read_text, toml_text
from cgemit.units import QuantityError, parse_quantity


def number(given: object) -> float:
    """Return a number of Python or numpy as a float; NaN, which no range holds, for anything else."""
    if not isinstance(given, int | float | np.integer | np.floating) or isinstance(given, bool):
        return math.nan
    try:
        return float(given)
    except OverflowError:  # a whole number of hundreds of digits
        return math.inf


def is_whole(given: object, least: int, most: int) -> bool:
    """Tell whether something is a whole number, of Python or numpy, within limits."""
    return isinstance(given, int | np.integer) and not isinstance(given, bool) and bool(least <= given <= most)


def check_numbers(where: str, seed: int, threads: int | None, **others: tuple[int | None, int, int]) -> None:
    """Check whole numbers; None is allowed.

    Parameters
    ----------
    where : str
        The beginning of the message.
    seed : int
    threads : int or None
    **others : (int or None, int, int)
        More numbers by name, each with its least and most.

    Raises
    ------
    ValueError
        Listing every problem.
    """
    numbers = {**others, "seed": (seed, 0, 2**64 - 1), "threads": (threads, 1, 2**15)}
    problems = [
        f"{name}: {value!r}, expected a whole number from {least} to {most}"
        for name, (value, least, most) in numbers.items()
        if value is not None and not (isinstance(value, int | np.integer) and least <= value <= most)
    ]
    if problems:
        raise ValueError(f"{where}:\n  " + "\n  ".join(problems))


@dataclass(frozen=True)
class InTurn:
    """Values used one after the other: event number `i` gets the value at position ``i modulo their number``."""

    values: tuple[float, ...]

    def __repr__(self) -> str:
        return repr(list(self.values))


#: A quantity in native units, as it is kept.
Value = float | tuple[float, float] | InTurn
#: What is accepted for it; strings carry a unit.
ValueLike = Value | str | tuple[str, str] | Sequence[float | str] | npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Limit:
    """What a quantity may be: its dimension, whether a number fits, and how to say so."""

    dimension: str
    fits: Callable[[float], bool]
    expected: str


def parse_value(path: str, given: Any, limit: Limit, problems: list[str]) -> Value:
    """Return a quantity in the form it is kept in; add what is wrong with it to `problems`.

    Parameters
    ----------
    path : str
        Name of the quantity in messages.
    given : ValueLike
    limit : Limit
    problems : list of str
        Added to.
    """
    if isinstance(given, InTurn):
        given = list(given.values)
    if isinstance(given, np.ndarray):
        given = given.tolist()
    if isinstance(given, tuple):
        return _range(path, given, limit, problems)
    if isinstance(given, list):
        if not given:
            problems.append(f"{path}: got an empty list; expected a list of at least one number")
            return 0.0
        return InTurn(tuple(_number(f"{path}[{i}]", one, limit, problems) for i, one in enumerate(given)))
    return _number(path, given, limit, problems)


def _range(path: str, given: tuple[Any, ...], limit: Limit, problems: list[str]) -> Value:
    if len(given) != 2:
        problems.append(f"{path}: got {given!r}; expected (low, high), or a list for values to use in turn")
        return 0.0
    before = len(problems)
    low, high = (_number(f"{path}[{i}]", one, limit, problems) for i, one in enumerate(given))
    if low > high and len(problems) == before:
        problems.append(f"{path}: got ({low}, {high}); expected a range from low to high")
    return low, high


def _number(path: str, given: Any, limit: Limit, problems: list[str]) -> float:
    """Return one number in native units; 0, with a problem added, if it is not a number in the limits."""
    if isinstance(given, str):
        try:
            value = parse_quantity(given, limit.dimension)
        except QuantityError as error:
            problems.append(f"{path}: got {error}")
            return 0.0
    else:
        value = number(given)
    if math.isfinite(value) and limit.fits(value):
        return value
    degrees = limit.dimension == "angle" and not isinstance(given, str) and limit.fits(math.radians(value))
    hint = f' (did you mean "{given:g} deg"?)' if degrees and math.isfinite(value) else ""
    problems.append(f"{path}: got {given!r}; expected {limit.expected}{hint}")
    return 0.0


def parse_three(path: str, given: Any, limit: Limit, problems: list[str]) -> tuple[Value, Value, Value]:
    """Return quantities along x, y and z; add what is wrong with them to `problems`."""
    if not isinstance(given, tuple | list | np.ndarray) or len(given) != 3:
        problems.append(f"{path}: got {given!r}; expected three, along x, y and z")
        return 0.0, 0.0, 0.0
    x, y, z = (parse_value(f"{path}.{axis}", one, limit, problems) for axis, one in zip("xyz", given, strict=True))
    return x, y, z


class Check(NamedTuple):
    """The condition on a value beyond its type, for ``Annotated[float, Check(...)]``, a name of its own in a module.

    Inside a class the annotation is a text, and names defined there are not found when `fits` is called.
    """

    fits: Callable[[Any], bool]
    expected: str


Positive = Annotated[float, Check(lambda value: 0 < value < math.inf, "a positive number")]
NotNegative = Annotated[float, Check(lambda value: 0 <= value < math.inf, "zero or a positive number")]


class Named(Protocol):
    """A class of settings that is one of several choices, told apart by its name."""

    name: ClassVar[str]


class Choice(NamedTuple):
    """A field that holds an instance of one of several classes, by their names."""

    classes: Mapping[str, type[Any]]
    register: str = ""  # the function that adds a class, for messages


def one_of(classes: Mapping[str, type[Any]], register: str = "") -> dict[str, Choice]:
    """Return the metadata of a dataclass field that holds an instance of one of some classes.

    Without it, the classes are those of the annotation. The mapping is read when a value is checked, so classes may be
    added to it later.

    Parameters
    ----------
    classes : mapping of str to type
        Dataclasses by their names.
    register : str
        The function that adds a class, for the message about one that is not in the mapping.
    """
    return {"choice": Choice(classes, register)}


class _No:
    """Stands for a value that is not of a kind."""


NO = _No()


def kinds_of(cls: type[Any]) -> Mapping[str, Any]:
    """Return the kind of every field of a dataclass: its annotation, or the choice that its metadata names."""
    key: Any = cls  # mypy takes a class for unhashable
    return _kinds_of(key)


@functools.cache
def _kinds_of(cls: type[Any]) -> Mapping[str, Any]:
    hints = get_type_hints(cls, include_extras=True)
    return {f.name: f.metadata.get("choice") or _with_choice(hints[f.name]) for f in fields(cls)}


def _with_choice(kind: Any) -> Any:
    """Return a union of named dataclasses as a choice, anything else as it is."""
    classes: list[Any] = [one for one in _members(kind) if is_dataclass(one)]
    if len(classes) > 1 and len(classes) == len(_members(kind)):
        return Choice({one.name: one for one in classes})
    return kind


def _members(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if _is_union(kind) else (kind,)


def _is_union(kind: Any) -> bool:
    return get_origin(kind) in (Union, types.UnionType)


def allows_none(kind: Any) -> bool:
    """Tell whether a value of a kind may be None."""
    return type(None) in _members(kind)


def classes_in(kind: Any) -> Mapping[str, type[Any]]:
    """Return the dataclasses that a value of a kind may be an instance of, by name; the name is empty for a single."""
    if isinstance(kind, Choice):
        return kind.classes
    return {"": kind} if isinstance(kind, type) and is_dataclass(kind) else {}


def matched(kind: Any, given: object) -> Any:
    """Return a value as it is kept if it is of a kind, else `NO`.

    Values of numpy become those of Python, lists and arrays tuples, and whole numbers floats where floats are kept. The
    name of a choice becomes an instance with all defaults.
    """
    if isinstance(kind, Choice):
        if isinstance(given, str) and given in kind.classes:
            return kind.classes[given]()
        return given if type(given) in kind.classes.values() else NO
    if get_origin(kind) is Annotated:
        base, *checks = get_args(kind)
        value = matched(base, given)
        return value if value is not NO and all(check.fits(value) for check in checks) else NO
    if get_origin(kind) is Literal:
        return next((text for text in get_args(kind) if isinstance(given, str) and given == text), NO)
    if _is_union(kind):
        return next((value for one in get_args(kind) if (value := matched(one, given)) is not NO), NO)
    if get_origin(kind) is tuple:
        return _matched_tuple(get_args(kind), given)
    return _matched_plain(kind, given)


def _matched_tuple(kinds: tuple[Any, ...], given: object) -> Any:
    listed = given.tolist() if isinstance(given, np.ndarray) else given
    if not isinstance(listed, tuple | list):
        return NO
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(listed)
    values = tuple(map(matched, kinds, listed)) if len(kinds) == len(listed) else (NO,)
    return NO if NO in values else values


def _matched_plain(kind: Any, given: object) -> Any:
    if kind is bool:
        return bool(given) if isinstance(given, bool | np.bool_) else NO
    if kind is int:
        return int(given) if isinstance(given, int | np.integer) and not isinstance(given, bool) else NO
    if kind is float:
        value = number(given)
        return NO if math.isnan(value) else value
    if kind is str:
        return str(given) if isinstance(given, str) else NO
    if kind is type(None):
        return None if given is None else NO
    return given if isinstance(given, kind) else NO


def problems_of(kind: Any, given: object) -> list[str]:
    """Return the problems of a value that is not of a kind; for a list of any length, those of each wrong entry."""
    if isinstance(given, tuple | list):
        for one in _members(kind):
            if get_origin(one) is tuple and get_args(one)[-1] is Ellipsis:
                entry = get_args(one)[0]
                return [_problem(entry, value) for value in given if matched(entry, value) is NO]
    return [_problem(kind, given)]


def _problem(kind: Any, given: object) -> str:
    shown = f"{type(given).__name__}(...)" if is_dataclass(given) else repr(given)
    hint = did_you_mean(given, texts_of(kind), "; ")
    if isinstance(kind, Choice) and kind.register and is_dataclass(given):
        hint = f"; {kind.register}({type(given).__name__}, ...) registers it"
    return f"got {shown}, expected {expected(kind)}{hint}"


def texts_of(kind: Any) -> tuple[str, ...]:
    """Return the texts among the values of a kind."""
    if isinstance(kind, Choice):
        return tuple(kind.classes)
    if get_origin(kind) is Literal:
        return get_args(kind)
    return tuple(text for one in get_args(kind) for text in texts_of(one)) if _is_union(kind) else ()


def expected(kind: Any) -> str:
    """Return the values of a kind as text."""
    if isinstance(kind, Choice):
        return "one of " + ", ".join(map(repr, kind.classes))
    if get_origin(kind) is Annotated:
        return str(get_args(kind)[1].expected)
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(map(repr, get_args(kind)))
    if _is_union(kind):
        return ", or ".join(expected(one) for one in get_args(kind))
    if get_origin(kind) is tuple:
        first, *rest = get_args(kind)
        count = "a list" if rest == [Ellipsis] else f"a list of {1 + len(rest)}"
        return f"{count}, each {expected(first)}"
    plain = {bool: "True or False", int: "a whole number", float: "a number", str: "text", type(None): "None"}
    return plain.get(kind) or f"{kind.__name__}(...)"


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
