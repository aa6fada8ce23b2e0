"""Constraints of the keys of a detector file, stated once on the dataclass field; cache of derived values."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, wraps
from types import MappingProxyType
from typing import Any, ClassVar, Concatenate, NamedTuple, ParamSpec, TypeVar

from cgemit.base.settings import SettingsData
from cgemit.base.validate import Quantity, Whole, constraint_of, expected, kinds_of
from cgemit.units import NATIVE, describe, parse_quantity

_P = TypeVar("_P", bound="Part")
_R = TypeVar("_R")
_A = ParamSpec("_A")

_KEPT = "_kept"


class Part:
    """An immutable dataclass that keeps what functions with `once` made of it; neither equality nor files see that.

    Attributes
    ----------
    extra_keys : mapping
        Keys that a file may hold beside those of the fields.
    """

    extra_keys: ClassVar[Mapping[str, Key]] = MappingProxyType({})

    def hint_of(self, name: str) -> str:
        """Return a hint for a value out of its range; nothing if there is none."""
        return ""

    def extra_value(self, name: str) -> float | None:
        """Return the value of one of `extra_keys`; None if it has none."""
        return None

    def stands_for(self, name: str) -> tuple[str, ...]:
        """Return the keys whose values a short form of a file stands for."""
        return ()

    def may_lack(self, name: str) -> bool:
        """Return whether 0 means that the part has no such number, so that relative changes leave it as it is."""
        return False

    def children(self) -> dict[str, Any]:
        """Return what may stand behind a dot and the path of this part, by name: values of keys, and parts by label."""
        kind: Any = type(self)
        return {name: getattr(self, name) for name in keys_of(kind)}

    def inner(self) -> Iterator[tuple[str, Part]]:
        """Yield the parts in this one with their paths from here: rows of stacks and of wires."""
        kind: Any = type(self)
        for name, one in keys_of(kind).items():
            if one.kind in ("stack", "wires"):
                yield from ((f"{name}[{i}]", row) for i, row in enumerate(getattr(self, name)))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != _KEPT}


def once(make: Callable[Concatenate[_P, _A], _R]) -> Callable[Concatenate[_P, _A], _R]:
    """Return the function of a part and arguments that calls `make` once for the same object and hashable arguments.

    Looking up an object is faster than hashing its values, as a cache of equal parts has to.
    """

    @wraps(make)
    def kept(part: _P, /, *args: _A.args, **named: _A.kwargs) -> _R:
        key = (make, args) if args else make
        values: dict[Any, _R] = part.__dict__.setdefault(_KEPT, {})
        try:
            return values[key]
        except KeyError:
            value = values[key] = make(part, *args, **named)
            return value
        except TypeError:  # an argument has no hash, such as a readout from outside the package with a list
            return make(part, *args, **named)

    return kept


#: A value whose problem has been noted. Arithmetic with it stays unusable and no check of it fails, so the rest of the
#: part can still be checked.
UNUSABLE: Any = math.nan

#: Name of an `offset_v` that follows from the other values of a layer.
CENTRED = "centred"


@dataclass(frozen=True)
class Key(Quantity):
    """One key: its kind is a dimension of `units.NATIVE`, or a name that the reader knows.

    `low` and `high` are the sensible range in native units, ends included; `derived` keys may be left out and are
    then computed from the others. `quiet` ones are in no file and no hash where they have their default.
    """

    doc: str = ""
    choices: tuple[str, ...] = ()
    quiet: bool = False
    derived: bool = False

    def value(self, raw: Any) -> float:
        """Return a value in native units; files must name the unit."""
        return parse_quantity(raw, self.kind)

    def expected(self) -> str:
        """Return the allowed values as text."""
        if self.choices:
            return "one of " + ", ".join(f'"{choice}"' for choice in self.choices)
        if self.kind == "setting":
            return self.doc
        if self.kind == "integer" and self.low > -math.inf:
            return Whole(int(self.low), int(self.high)).expected()
        texts = {
            "readout": "the name of a readout, or a table with name and what differs from its defaults",
            "integer": "a whole number",
            "boolean": "true or false",
            "sign": "1 or -1",
            "text": "text",
            "material": "the name of a material",
            "gas": "the name of a material with gas = true",
            "stack": "a list of { label, material, thickness }",
            "wires": "a list of { material, diameter, number, wall }",
            "composition": 'a formula such as "CO2" or a table of mass fractions such as { Ar = 0.7, C = 0.3 }',
            "numbers": "a table of numbers c, x0, x1, a, k",
            "offset": '"centred", or a number',
            "strips": 'a list such as ["0:17", "1:100-120"]: sheet, and strip or first and last strip, from 0',
            "channels": 'a list such as ["17", "100-120"]: wire, or first and last wire, from 0',
            "gains": "a list with a number for each sheet, or rows along z of numbers along X; numbers",
            "profile": "a list of { r, rate } with increasing r",
            "relation": "a list of at least two { distance, time }, the first at 0 mm, both rising",
            "errors": "a list of { distance, sigma } with rising distance, the first at 0 mm",
            "counts": "a list of at most 100 numbers from 0, not all 0",
            "cells": 'a whole number of cells, or their width such as "12 mm"',
            "angles": "an angle, or a list of angles to use in turn, in rad",
            "mirrors": "z, x or y, or a list of these",
            "lengths": "a length, or a list of lengths to use in turn, in mm",
            "shifts": "a list with a length for each wire of the layer, in mm",
        }
        text = texts.get(self.kind) or describe(self.kind)
        limits = self.limits()
        return f"{text} {limits} {NATIVE.get(self.kind, '')}".rstrip() if limits else text


def key(kind: str, doc: str, low: float = -float("inf"), high: float = float("inf"), **more: Any) -> dict[str, Key]:
    """Return the metadata of a dataclass field that is a key of the detector file."""
    return {"key": Key(kind, low, high, doc=doc, **more)}


#: Range of a value of the kind "cells": a number of cells, or their width.
CELLS = {int: Key("integer", 4, 10_000), float: Key("length", 0.5, 1000.0)}


class Known(NamedTuple):
    """A value of a part that was read before, in the tables of a variant: it needs neither parsing nor checking."""

    value: Any


def plain(value: Any) -> Any:
    """Return a value of a table without `Known` around it."""
    return value.value if isinstance(value, Known) else value


def opened(part: Any) -> Any:
    """Return a part that was read before as a table of `Known` values; anything else as it is."""
    return dict(_opened(part)) if isinstance(part, Part) else part


@once
def _opened(part: Part) -> dict[str, Known]:
    kind: Any = type(part)
    return {name: Known(getattr(part, name)) for name in keys_of(kind)}


def table_in(tree: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the table of a name among others; an empty one if there is none."""
    table = tree.get(name)
    return table if isinstance(table, dict) else {}


def open_table(tables: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a table of others, opened if it is a part that was read before; an empty one if there is none."""
    if name in tables:
        tables[name] = opened(tables[name])
    return table_in(tables, name)


@cache
def keys_of(kind: Any) -> dict[str, Key]:
    """Return the keys of a dataclass by name, as the classes first state them: those of settings by their annotations.

    A field that a class makes a key stands where this class has it, although a base may have the field before.
    """
    if issubclass(kind, SettingsData):
        return {name: _key_of(one) for name, one in kinds_of(kind).items()}
    stated: dict[str, None] = {}
    for base in filter(dataclasses.is_dataclass, reversed(kind.__mro__)):
        fields: Any = base.__dict__["__dataclass_fields__"]
        stated |= dict.fromkeys(name for name in base.__annotations__ if "key" in fields[name].metadata)
    found = {f.name: f.metadata["key"] for f in dataclasses.fields(kind) if f.name in stated}
    return {name: found[name] for name in stated}


@cache
def file_keys(kind: Any) -> dict[str, Key]:
    """Return the keys that the table of a part may have in a file."""
    return {**keys_of(kind), **getattr(kind, "extra_keys", {})}


def _key_of(kind: Any) -> Key:
    """Return the key of a setting: a quantity, or what only its class can check."""
    constraint = constraint_of(kind)
    if isinstance(constraint, Quantity):
        return Key(constraint.kind, constraint.low, constraint.high, constraint.above, constraint.below)
    return Key("setting", doc=expected(kind))


@cache
def default(kind: Any, name: str) -> Any:
    """Return the default of a field of a dataclass, by its name."""
    return {f.name: f.default for f in dataclasses.fields(kind)}[name]


@cache
def required_of(kind: Any) -> frozenset[str]:
    """Return the names of the keys that have neither a default nor a rule to derive them."""
    if issubclass(kind, SettingsData):
        return frozenset()  # whose class tells what it lacks
    missing = dataclasses.MISSING
    fields = [f for f in dataclasses.fields(kind) if "key" in f.metadata]
    return frozenset(f.name for f in fields if f.default is missing and not f.metadata["key"].derived)
