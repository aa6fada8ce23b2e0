"""Kinds of settings by annotation: ``bool``, ``float``, ``Literal[...]``, tuples, ``None``, other settings.

The annotation is the only definition. Checks, messages, files, the command line and the documentation follow from it.
"""

from __future__ import annotations

import functools
import math
import types
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol, Union, get_args, get_origin, get_type_hints

import numpy as np

from cgemit.problems import did_you_mean
from cgemit.values import number


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
    registry: str = ""  # where the mapping is, for messages


def one_of(classes: Mapping[str, type[Any]], registry: str = "") -> dict[str, Choice]:
    """Return the metadata of a dataclass field that holds an instance of one of some classes.

    Without it, the classes are those of the annotation. The mapping is read when a value is checked, so classes may be
    added to it later.

    Parameters
    ----------
    classes : mapping of str to type
        Dataclasses by their names.
    registry : str
        Where the mapping is, for the message about a class that is not in it.
    """
    return {"choice": Choice(classes, registry)}


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
    if isinstance(kind, Choice) and kind.registry and is_dataclass(given):
        name = getattr(given, "name", "name")
        hint = f"; {kind.registry}[{name!r}] = {type(given).__name__} registers it"
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
