"""Validation: annotations of frozen dataclasses define the allowed values; one reader walks values and tables by path.

Settings, guns, plans of studies and detector files are read with it. A field's annotation is a type, a `Literal`, a
type with constraints (``Annotated[float, Check(...)]``, ``Annotated[ValueLike, Spread(...)]``), or a dataclass.
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


def number(given: object) -> float:
    """Return a number of Python or numpy as a float; NaN, which no range holds, for anything else."""
    if not isinstance(given, _NUMBER) or isinstance(given, bool):
        return math.nan
    try:
        return float(given)
    except OverflowError:  # a whole number of hundreds of digits
        return math.inf


def is_whole(given: object, least: int, most: int) -> bool:
    """Tell whether something is a whole number, of Python or numpy, within limits."""
    return isinstance(given, int | np.integer) and not isinstance(given, bool) and bool(least <= given <= most)


def check_whole(path: str, given: object, least: int, most: int, problems: Problems) -> None:
    """Note a value that is not a whole number within limits."""
    if not is_whole(given, least, most):
        problems.note(path, f"{given!r:.80}", f"a whole number from {least} to {most}")


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
class Quantity:
    """Constraint of a number in native units within limits; text with a unit is accepted, too.

    Attributes
    ----------
    kind : str
        Dimension, one of the keys of `cgemit.units.NATIVE`.
    low, high : float
        Limits in the native unit.
    above : bool
        Whether `low` itself is excluded.
    """

    kind: str
    low: float = -math.inf
    high: float = math.inf
    above: bool = False

    def admits(self, value: float) -> bool:
        """Return whether a number is finite and within the limits."""
        return self.low <= value <= self.high and abs(value) < math.inf and not (self.above and value == self.low)

    def expected(self) -> str:
        """Return the allowed values as text."""
        unit = NATIVE[self.kind]
        name = f"{_article(self.kind)} in {unit}" if unit else "a number"
        if self.low == -math.inf:
            return name if unit else "a finite number"
        if self.low == -self.high:
            return f"{name} within +-{self.high:g}"
        if self.above:
            return f"{name} above {self.low:g}, up to {self.high:g}"
        return f"{name} from {self.low:g} to {self.high:g}"

    def read(self, path: str, given: Any, problems: Problems) -> Any:
        """Return one number in native units; NO, with the problem noted, if it is none within the limits."""
        try:
            value = self.value(given)
        except QuantityError as error:
            problems.take(error, path)
            return NO
        if self.admits(value):
            return value
        text = isinstance(given, str)
        unit = NATIVE[self.kind]
        native = f" = {value:.6g} {unit}" if text and unit not in given else ""
        hint = f'did you mean "{given:g} deg"?' if self._in_degrees(given, value) else ""
        problems.note(path, f"{shown(given)}{native}", self.expected(), hint)
        return NO

    def value(self, given: Any) -> float:
        """Return a value in native units; NaN if it is neither a number nor text."""
        return parse_quantity(given, self.kind) if isinstance(given, str) else number(given)

    def _in_degrees(self, given: Any, value: float) -> bool:
        return self.kind == "angle" and not isinstance(given, str) and self.admits(math.radians(value))


def _article(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"


@dataclass(frozen=True)
class Spread(Quantity):
    """Constraint of a quantity: one number, (low, high) for a uniform range, or a list of values to use in turn."""

    def read(self, path: str, given: Any, problems: Problems) -> Any:
        """Return a number, a pair, or the values in turn; NO, with problems noted, if there are any."""
        if isinstance(given, InTurn):
            given = list(given.values)
        if isinstance(given, np.ndarray):
            given = given.tolist()
        if not isinstance(given, tuple | list):
            return super().read(path, given, problems)
        if isinstance(given, tuple) and len(given) != 2:
            problems.note(path, f"{given!r:.80}", "(low, high), or a list for values to use in turn")
            return NO
        if not given:
            problems.note(path, "an empty list", "a list of at least one number")
            return NO
        values = tuple(super(Spread, self).read(f"{path}[{i}]", one, problems) for i, one in enumerate(given))
        if NO in values:
            return NO
        if isinstance(given, list):
            return InTurn(values)
        if values[0] > values[1]:
            problems.note(path, f"({values[0]}, {values[1]})", "a range from low to high")
            return NO
        return values


@dataclass(frozen=True)
class Axes(Spread):
    """Constraint of three quantities along x, y and z, each as for `Spread`."""

    def read(self, path: str, given: Any, problems: Problems) -> Any:
        """Return three values; NO, with problems noted, if there are any."""
        if not isinstance(given, tuple | list | np.ndarray) or len(given) != 3:
            problems.note(path, f"{given!r:.80}", "three, along x, y and z")
            return NO
        values = tuple(
            super(Axes, self).read(joined(path, axis), one, problems) for axis, one in zip("xyz", given, strict=True)
        )
        return NO if NO in values else values


class Check(NamedTuple):
    """The condition on a value beyond its type, for ``Annotated[float, Check(...)]``, a name of its own in a module.

    Inside a class the annotation is a text, and names defined there are not found when `fits` is called.
    """

    fits: Callable[[Any], bool]
    expected: str


Positive = Annotated[float, Check(lambda value: 0 < value < math.inf, "a positive number")]
NotNegative = Annotated[float, Check(lambda value: 0 <= value < math.inf, "zero or a positive number")]


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


def _read_matched(kind: Any, match: Callable[[object], Any], path: str, given: object, problems: Problems) -> Any:
    value = match(given)
    if value is NO:
        _note(kind, given, path, problems)
    return value


def _read_optional(read: Reader, path: str, given: object, problems: Problems) -> Any:
    return None if given is None else read(path, given, problems)


def constraint_of(kind: Any) -> Quantity | None:
    """Return the constraint that reads the values of a kind itself, if it has one."""
    for one in _members(kind):
        found = get_args(one)[1] if get_origin(one) is Annotated else one
        if isinstance(found, Quantity):
            return found
    return None


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
    if isinstance(checks[0], Quantity):
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


def _note(kind: Any, given: object, path: str, problems: Problems) -> None:
    """Note a value that is not of a kind; of a list of any length, each wrong entry."""
    if isinstance(given, tuple | list):
        for one in _members(kind):
            if get_origin(one) is tuple and get_args(one)[-1] is Ellipsis:
                entry = get_args(one)[0]
                for i, value in enumerate(given):
                    if matcher(entry)(value) is NO:
                        _note(entry, value, f"{path}[{i}]", problems)
                return
    text = f"{type(given).__name__}(...)" if is_dataclass(given) else f"{given!r:.80}"
    hint = did_you_mean(given, texts_of(kind))
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
        return str(constraint.expected() if isinstance(constraint, Quantity) else constraint.expected)
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

    In files a pair is ``"LOW:HIGH"``.
    """

    ranges: bool = False

    def expected(self) -> str:
        """Return the allowed values as text."""
        return super().expected() + (', or "LOW:HIGH"' if self.ranges else "")

    def read(self, path: str, given: Any, problems: Problems) -> Any:
        """Return a tuple of numbers and pairs; NO, with problems noted, if there are any."""
        given = given.tolist() if isinstance(given, np.ndarray | np.generic) else given
        listed = isinstance(given, list | Values) or (isinstance(given, tuple) and not self.ranges)
        if listed and not given:
            problems.note(path, "an empty list", "a list of at least one number")
        values = Values(
            self._one(f"{path}[{i}]" if listed else path, one, problems)
            for i, one in enumerate(given if listed else [given])
        )
        return NO if NO in values or not values else values

    def _one(self, path: str, given: Any, problems: Problems) -> Any:
        if not self.ranges:
            return super().read(path, given, problems)
        pair = given
        if isinstance(given, str) and given.count(":") == 1:
            pair = tuple(_number_of(text) for text in given.split(":"))
        if isinstance(pair, list):
            problems.note(path, shown(pair), self.expected())
            return NO
        return Spread(self.kind, self.low, self.high).read(path, pair, problems)


def _number_of(text: str) -> Any:
    """Return the number of a text; the text itself, which may have a unit, if it is none."""
    try:
        return float(text)
    except ValueError:
        return text


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


def build(cls: type[T], given: object, path: str, problems: Problems) -> T | None:
    """Return an instance of a dataclass made of a table; None, with problems added, if there are any."""
    kinds, values, before = kinds_of(cls), {}, len(problems)
    defaults = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    for name, raw in entries(given, path, kinds, problems).items():
        count = len(problems)
        value = _read_field(kinds[name], raw, joined(path, name), problems)
        if len(problems) == count:
            values[name] = value
    missing = [
        name
        for name, one in defaults.items()
        if (not isinstance(given, Mapping) or name not in given) and default_of(one) is MISSING
    ]
    if missing:
        if isinstance(given, Mapping):
            problems.note(path, "only " + ", ".join(given) if given else "nothing", "also " + ", ".join(missing))
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
