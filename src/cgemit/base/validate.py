"""Validation: annotations of frozen dataclasses define the allowed values; one reader walks values and tables by path.

Settings, guns, plans of studies and detector files are read with it. A field's annotation is a type, a `Literal`, a
type with a constraint (``Annotated[int, Whole(1, 50)]``, ``Annotated[float, Quantity("length", 0, 2000)]``), or a
dataclass. A constraint writes the text that tells what is allowed.
"""

from __future__ import annotations

import collections.abc
import functools
import math
import types
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
import numpy.typing as npt

from cgemit.base.errors import Problems, did_you_mean, joined, shown
from cgemit.units import NATIVE, QuantityError, parse_quantity

T = TypeVar("T")


_NUMBER = (int, float, np.integer, np.floating)


def number(raw: object) -> float:
    """Return a number of Python or numpy as a float; NaN, which no range holds, for anything else."""
    if not isinstance(raw, _NUMBER) or isinstance(raw, bool):
        return math.nan
    try:
        return float(raw)
    except OverflowError:  # a whole number of hundreds of digits
        return math.inf


def is_whole(raw: object, least: int, most: int) -> bool:
    """Tell whether something is a whole number, of Python or numpy, within limits."""
    return isinstance(raw, int | np.integer) and not isinstance(raw, bool) and bool(least <= raw <= most)


def check_whole(path: str, raw: object, least: int, most: int, problems: Problems) -> None:
    """Note a value that is not a whole number within limits."""
    Whole(least, most).read(path, raw, problems)


def check_seed(seed: object, problems: Problems) -> None:
    """Note a seed of random numbers that is none."""
    check_whole("seed", seed, 0, 2**64 - 1, problems)


def check_numbers(where: str, seed: int, threads: int | None = None, **others: tuple[int | None, int, int]) -> None:
    """Check a seed and other whole numbers, of which None is allowed.

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
    ProblemsError
        Listing every problem.
    """
    problems = Problems()
    for name, (value, least, most) in {**others, "threads": (threads, 1, 2**15)}.items():
        if value is not None:
            check_whole(name, value, least, most, problems)
    check_seed(seed, problems)
    problems.report(where)


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


class _No:
    """Stands for a value that is not of a kind."""


NO: Any = _No()


@dataclass(frozen=True)
class Whole:
    """Constraint of a whole number within limits, ends included."""

    low: int
    high: int

    def expected(self) -> str:
        """Return the allowed values as text."""
        return f"a whole number from {self.low} to {self.high}"

    def read(self, path: str, raw: Any, problems: Problems) -> Any:
        """Return a whole number of Python; NO, with the problem noted, if it is none within the limits."""
        if is_whole(raw, self.low, self.high):
            return int(raw)
        problems.note(path, f"{raw!r:.80}", self.expected())
        return NO

    def read_text(self, path: str, text: str, problems: Problems) -> Any:
        """Return the whole number that a text such as ``12`` or ``1e4`` stands for; NO as in `read`."""
        digits = text.strip().lstrip("+-").isdecimal()
        try:
            value = int(text) if digits else float(text)
        except ValueError:
            value = math.nan
        if isinstance(value, float) and value.is_integer() and abs(value) <= 2**53:  # beyond, a float is not exact
            value = int(value)
        return self.read(path, value if is_whole(value, self.low, self.high) else text, problems)


@dataclass(frozen=True)
class Quantity:
    """Constraint of a number in native units within limits; text is accepted, too, without a unit in the native one.

    Attributes
    ----------
    kind : str
        Dimension, one of the keys of `cgemit.units.NATIVE`.
    low, high : float
        Limits in the native unit.
    above, below : bool
        Whether `low` or `high` itself is excluded.
    """

    kind: str = "dimensionless"
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    below: bool = False

    def admits(self, value: float) -> bool:
        """Return whether a number is finite and within the limits."""
        within = self.low <= value <= self.high and abs(value) < math.inf
        return within and not (self.above and value == self.low) and not (self.below and value == self.high)

    def limits(self) -> str:
        """Return the limits as text, such as ``from 0 to 1``; nothing without any."""
        low, high = f"{self.low:g}", f"{self.high:g}"
        if self.low == -math.inf:
            return ""
        if self.high == math.inf:
            return f"above {low}" if self.above else f"of at least {low}"
        if self.above and self.below:
            return f"between {low} and {high}"
        if self.low == -self.high:
            return f"within +-{high}"
        if self.above:
            return f"above {low}, up to {high}"
        return f"from {low} to below {high}" if self.below else f"from {low} to {high}"

    def expected(self) -> str:
        """Return the allowed values as text."""
        unit = NATIVE[self.kind]
        if not unit and self.high == math.inf and self.low in (0, -math.inf):
            signs = "a positive number" if self.above else "zero or a positive number"
            return "a finite number" if self.low else signs
        return f"{f'{_article(self.kind)} in {unit}' if unit else 'a number'} {self.limits()}".rstrip()

    def read(self, path: str, raw: Any, problems: Problems) -> Any:
        """Return one number in native units; NO, with the problem noted, if it is none within the limits."""
        try:
            value = self.value(raw)
        except QuantityError as error:
            problems.take(error, path)
            return NO
        if self.admits(value):
            return value
        text = isinstance(raw, str)
        unit = NATIVE[self.kind]
        native = f" = {value:.6g} {unit}" if text and unit not in raw else ""
        hint = f'did you mean "{raw:g} deg"?' if self._in_degrees(raw, value) else ""
        problems.note(path, f"{shown(raw)}{native}", self.expected(), hint)
        return NO

    def value(self, raw: Any) -> float:
        """Return a value in native units; NaN if it is neither a number nor text."""
        if not isinstance(raw, str):
            return number(raw)
        return number_of(raw, self.kind)

    def _in_degrees(self, given: Any, value: float) -> bool:
        return self.kind == "angle" and not isinstance(given, str) and self.admits(math.radians(value))


def _article(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"


def number_of(text: str, kind: str) -> float:
    """Return the number in native units that a text stands for; one without a unit is in the native one.

    Raises
    ------
    QuantityError
    """
    try:
        value = float(text)
    except ValueError:
        return parse_quantity(text, kind)
    if not math.isfinite(value):
        raise QuantityError(f"{shown(text)} (not finite)", "a finite number")
    return value


#: Values of A:B:COUNT; more are a mistake.
MOST_STEPS = 10_000
#: Forms of the text of several values.
LIST_FORMS = "a number, A,B,C or A:B:COUNT"
FORMS = "a number, A:B, A,B,C or A:B:COUNT"


def split_values(path: str, text: str, each: Quantity, problems: Problems) -> Any:
    """Return the text of several values as Python has them; NO, with problems noted, if there are any.

    ``A,B,C`` becomes a list of texts, ``A:B`` a pair of texts, and ``A:B:COUNT`` a list of numbers from A to B, ends
    included. Any other text stays.
    """
    if "," in text:
        return text.split(",")
    parts = text.split(":")
    if len(parts) <= 2:
        return tuple(parts) if len(parts) == 2 else text
    if len(parts) > 3:
        problems.note(path, shown(text), FORMS)
        return NO
    start, stop = (Quantity.read(each, path, part, problems) for part in parts[:2])
    count = Whole(1, MOST_STEPS).read_text(path, parts[2], problems)
    if NO in (start, stop, count):
        return NO
    # Rounded, so that 0.2:2.0:10 is 0.2, 0.4, 0.6 and not 0.6000000000000001.
    return [round(start + (stop - start) * i / (count - 1), 12) for i in range(count)] if count > 1 else [start]


@dataclass(frozen=True)
class Spread(Quantity):
    """Constraint of a quantity: one number, (low, high) for a uniform range, or a list of values to use in turn.

    Text has the forms of the command line: ``A:B`` is a range, ``A,B,C`` and ``A:B:COUNT`` are values in turn.
    """

    def read(self, path: str, raw: Any, problems: Problems) -> Any:
        """Return a number, a pair, or the values in turn; NO, with problems noted, if there are any."""
        if isinstance(raw, InTurn):
            raw = list(raw.values)
        if isinstance(raw, np.ndarray):
            raw = raw.tolist()
        if isinstance(raw, str) and (raw := split_values(path, raw, self, problems)) is NO:
            return NO
        if not isinstance(raw, tuple | list):
            return super().read(path, raw, problems)
        if isinstance(raw, tuple) and len(raw) != 2:
            problems.note(path, f"{raw!r:.80}", "(low, high), or a list for values to use in turn")
            return NO
        if not raw:
            problems.note(path, "an empty list", "a list of at least one number")
            return NO
        values = tuple(super(Spread, self).read(f"{path}[{i}]", value, problems) for i, value in enumerate(raw))
        if NO in values:
            return NO
        if isinstance(raw, list):
            return InTurn(values)
        if values[0] > values[1]:
            problems.note(path, f"({values[0]}, {values[1]})", "a range from low to high")
            return NO
        return values


@dataclass(frozen=True)
class Axes(Spread):
    """Constraint of three quantities along x, y and z, each as for `Spread`, or the text ``X,Y,Z``."""

    def read(self, path: str, raw: Any, problems: Problems) -> Any:
        """Return three values; NO, with problems noted, if there are any."""
        axes = raw.split(",") if isinstance(raw, str) else raw
        if not isinstance(axes, tuple | list | np.ndarray) or len(axes) != 3:
            problems.note(path, f"{raw!r:.80}", "three, along x, y and z")
            return NO
        values = tuple(
            super(Axes, self).read(joined(path, axis), value, problems) for axis, value in zip("xyz", axes, strict=True)
        )
        return NO if NO in values else values


class Check(NamedTuple):
    """A condition that no other constraint has, for ``Annotated[str, Check(...)]``, a name of its own in a module.

    Inside a class the annotation is a text, and names defined there are not found when `fits` is called.
    """

    fits: Callable[[Any], bool]
    expected: str


Positive = Annotated[float, Quantity(low=0, above=True)]
NotNegative = Annotated[float, Quantity(low=0)]
Momentum = Annotated[float, Quantity("momentum", 0, above=True)]


def kinds_of(cls: type[Any]) -> Mapping[str, Any]:
    """Return the kind of every field of a dataclass: its annotation."""
    key: Any = cls  # mypy takes a class for unhashable
    return _kinds_of(key)


@functools.cache
def _kinds_of(cls: type[Any]) -> Mapping[str, Any]:
    hints = get_type_hints(cls, include_extras=True)
    return {f.name: hints[f.name] for f in fields(cls)}


def _members(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if _is_union(kind) else (kind,)


def _is_union(kind: Any) -> bool:
    return get_origin(kind) in (Union, types.UnionType)


def allows_none(kind: Any) -> bool:
    """Tell whether a value of a kind may be None."""
    return type(None) in _members(kind)


def is_settings(kind: Any) -> bool:
    """Tell whether a value of a kind is an instance of one dataclass, a table in files."""
    return isinstance(kind, type) and is_dataclass(kind)


#: Function of the path to a value, the value and problems: the value as it is kept, or `NO` with its problems noted.
Reader = Callable[[str, Any, Problems], Any]


def reader(kind: Any) -> Reader:
    """Return what reads values of a kind.

    Values of numpy become those of Python, lists and arrays tuples, and whole numbers floats where floats are kept.
    """
    constraint = constraint_of(kind)
    if constraint is None:
        return functools.partial(_read_matched, kind, matcher(kind))
    return functools.partial(_read_optional, constraint.read) if allows_none(kind) else constraint.read


def _read_matched(kind: Any, match: Callable[[object], Any], path: str, raw: object, problems: Problems) -> Any:
    value = match(raw)
    if value is NO:
        _note(kind, raw, path, problems)
    return value


def _read_optional(read: Reader, path: str, given: object, problems: Problems) -> Any:
    return None if given is None else read(path, given, problems)


def constraint_of(kind: Any) -> Quantity | Whole | None:
    """Return the constraint that reads the values of a kind itself, but for None, if it has one."""
    members = [member for member in _members(kind) if member is not type(None)]
    found = get_args(members[0])[1] if len(members) == 1 and get_origin(members[0]) is Annotated else None
    return found if isinstance(found, Quantity | Whole) else None


def matcher(kind: Any) -> Callable[[object], Any]:
    """Return the function that returns a value as it is kept if it is of a kind, else `NO`; see `reader`."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _annotated(*arguments)
    if origin is Literal:
        texts = dict(zip(arguments, arguments, strict=True))
        return lambda given: texts.get(given, NO) if isinstance(given, str) else NO
    if _is_union(kind):
        members = [matcher(one) for one in arguments]
        return lambda given: next((value for one in members if (value := one(given)) is not NO), NO)
    if origin is tuple:
        many = arguments[-1] is Ellipsis
        return functools.partial(_listed, [matcher(one) for one in arguments[: 1 if many else None]], many)
    return _PLAIN.get(kind) or functools.partial(_instance, origin or kind)


def _annotated(base: Any, *checks: Any) -> Callable[[object], Any]:
    if isinstance(checks[0], Quantity | Whole):
        return lambda given: checks[0].read("", given, Problems())
    match = matcher(base)

    def checked(given: object) -> Any:
        value = match(given)
        return value if value is not NO and all(check.fits(value) for check in checks) else NO

    return checked


def _listed(entries: list[Callable[[object], Any]], many: bool, given: object) -> Any:
    listed = given.tolist() if isinstance(given, np.ndarray) else given
    if not isinstance(listed, tuple | list) or not (many or len(entries) == len(listed)):
        return NO
    values = tuple(match(one) for match, one in zip(entries * len(listed) if many else entries, listed, strict=True))
    return NO if NO in values else values


def _number(given: object) -> Any:
    value = number(given)
    return NO if math.isnan(value) else value


def _instance(kind: type[Any], given: object) -> Any:
    return given if isinstance(given, kind) else NO


_PLAIN: Mapping[Any, Callable[[object], Any]] = {
    bool: lambda given: bool(given) if isinstance(given, bool | np.bool_) else NO,
    int: lambda given: int(given) if isinstance(given, int | np.integer) and not isinstance(given, bool) else NO,
    float: _number,
    str: lambda given: str(given) if isinstance(given, str) else NO,
    type(None): lambda given: None if given is None else NO,
}


def _note(kind: Any, raw: object, path: str, problems: Problems) -> None:
    """Note a value that is not of a kind; of a list of any length, each wrong entry."""
    if isinstance(raw, tuple | list):
        for member in _members(kind):
            if get_origin(member) is tuple and get_args(member)[-1] is Ellipsis:
                entry = get_args(member)[0]
                for i, value in enumerate(raw):
                    if matcher(entry)(value) is NO:
                        _note(entry, value, f"{path}[{i}]", problems)
                return
    text = f"{type(raw).__name__}(...)" if is_dataclass(raw) else f"{raw!r:.80}"
    hint = did_you_mean(raw, texts_of(kind))
    problems.note(path, text, expected(kind), hint)


def texts_of(kind: Any) -> tuple[str, ...]:
    """Return the texts among the values of a kind."""
    if get_origin(kind) is Literal:
        return get_args(kind)
    return tuple(text for one in get_args(kind) for text in texts_of(one)) if _is_union(kind) else ()


def expected(kind: Any) -> str:
    """Return the values of a kind as text."""
    if get_origin(kind) is Annotated:
        constraint = get_args(kind)[1]
        return str(constraint.expected if isinstance(constraint, Check) else constraint.expected())
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(map(repr, get_args(kind)))
    if _is_union(kind):
        return ", or ".join(expected(one) for one in get_args(kind))
    if get_origin(kind) is tuple:
        first, *rest = get_args(kind)
        count = "a list" if rest == [Ellipsis] else f"a list of {1 + len(rest)}"
        return f"{count}, each {expected(first)}"
    if get_origin(kind) is collections.abc.Callable:
        return "a function"
    plain = {bool: "true or false", int: "a whole number", float: "a number", str: "text", type(None): "None"}
    return plain.get(kind) or f"{kind.__name__}(...)"


#: Text that stands for None in files.
NONE = "none"


class Values(tuple[Any, ...]):
    """Several values, as `Listed` keeps them; another tuple may be a range."""


@dataclass(frozen=True)
class Listed(Quantity):
    """Constraint of one number or a list of numbers, kept as a tuple; with `ranges`, pairs (low, high) among them.

    Text has the forms of the command line: a pair is ``A:B``, a list ``A,B,C`` or ``A:B:COUNT``.
    """

    ranges: bool = False

    def expected(self) -> str:
        """Return the allowed values as text."""
        return super().expected() + (', or "A:B"' if self.ranges else "")

    def read(self, path: str, raw: Any, problems: Problems) -> Any:
        """Return a tuple of numbers and pairs; NO, with problems noted, if there are any."""
        raw = raw.tolist() if isinstance(raw, np.ndarray | np.generic) else raw
        if isinstance(raw, str):
            text = raw
            raw = split_values(path, text, self, problems)
            if raw is NO:
                return NO
            if isinstance(raw, tuple) and not self.ranges:
                problems.note(path, f"{shown(text)}, a range", LIST_FORMS)
                return NO
        listed = isinstance(raw, list | Values) or (isinstance(raw, tuple) and not self.ranges)
        if listed and not raw:
            problems.note(path, "an empty list", "a list of at least one number")
        values = Values(
            self._one(f"{path}[{i}]" if listed else path, value, problems)
            for i, value in enumerate(raw if listed else [raw])
        )
        return NO if NO in values or not values else values

    def _one(self, path: str, raw: Any, problems: Problems) -> Any:
        if not self.ranges:
            return super().read(path, raw, problems)
        pair = split_values(path, raw, self, problems) if isinstance(raw, str) else raw
        if isinstance(pair, list):
            problems.note(path, shown(raw), self.expected())
            return NO
        each = Spread(self.kind, self.low, self.high, self.above, self.below)
        return NO if pair is NO else each.read(path, pair, problems)


def check_fields(instance: Any, problems: Problems) -> None:
    """Read every field of a new frozen dataclass, and keep it as it was read; note what is wrong."""
    for name, read in _readers_of(instance.__class__).items():
        value = read(name, getattr(instance, name), problems)
        if value is not NO:
            object.__setattr__(instance, name, value)


@functools.cache
def _readers_of(cls: type[Any]) -> Mapping[str, Reader]:
    return {name: reader(kind) for name, kind in kinds_of(cls).items()}


def entries(
    raw: object, path: str, known: Collection[str], problems: Problems, hint: Callable[[str], str] | None = None
) -> Mapping[str, Any]:
    """Return the entries of a table with known names; note another value than a table, and each unknown name.

    `hint` may know more about an unknown name than which known one is near.
    """
    if not isinstance(raw, Mapping):
        problems.note(path, shown(raw), f"a table [{path}]" if path else "tables")
        return {}
    unknown = [name for name in raw if name not in known]
    for name in unknown:
        near = (hint(name) if hint else "") or did_you_mean(name, known)
        problems.note(joined(path, str(name)), "an unknown key", "one of " + ", ".join(known), near, unknown=True)
    return {name: value for name, value in raw.items() if name in known} if unknown else raw


def build(cls: type[T], table: object, path: str, problems: Problems) -> T | None:
    """Return an instance of a dataclass made of a table; None, with problems added, if there are any."""
    kinds, values, before = kinds_of(cls), {}, len(problems)
    defaults = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    for name, raw in entries(table, path, kinds, problems).items():
        count = len(problems)
        value = _read_field(kinds[name], raw, joined(path, name), problems)
        if len(problems) == count:
            values[name] = value
    missing = [
        name
        for name, one in defaults.items()
        if (not isinstance(table, Mapping) or name not in table) and default_of(one) is MISSING
    ]
    if missing:
        if isinstance(table, Mapping):
            problems.note(path, "only " + ", ".join(table) if table else "nothing", "also " + ", ".join(missing))
        return None
    try:
        built = cls(**values)
    except ValueError as error:  # of a class from elsewhere, too
        problems.take(error, path)
    return built if len(problems) == before else None


def _read_field(kind: Any, raw: object, path: str, problems: Problems) -> Any:
    """Return a value of a file in the form that the dataclass takes; it checks the value itself."""
    if is_settings(kind):
        return build(kind, raw, path, problems)
    return None if raw == NONE and allows_none(kind) else raw


def default_of(field: Field[Any]) -> Any:
    """Return the default of a field of a dataclass."""
    return field.default_factory() if field.default_factory is not MISSING else field.default
