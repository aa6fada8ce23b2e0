"""Problems of an input as objects: path to the value, what was given, what was expected, and a hint.

Checks add them to a list of `Problems`, which is raised as one error. The text is made when the error is shown.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn, TypeVar

R = TypeVar("R")


class Problem(NamedTuple):
    """One mistake in an input.

    Attributes
    ----------
    path : str
        Path to the value, such as ``cgem.L2.pitch_x`` or ``evaluate.p[1]``; empty for the input as a whole.
    given, expected : str
        The value in short form, and the allowed values; `expected` is empty where `given` says it all.
    hint : str
        May be empty.
    unknown : bool
        Whether the key is wrong, whatever its value: it names nothing, or changes what another key changes.

    Examples
    --------
    >>> from cgemit.detector import Problem
    >>> problem = Problem("cgem.L1.pitch_x", '"65"', "a length with its unit")
    >>> print(problem)
    cgem.L1.pitch_x: got "65", expected a length with its unit
    """

    path: str
    given: str
    expected: str
    hint: str = ""
    unknown: bool = False

    def __str__(self) -> str:
        return (f"{self.path}: " if self.path else "") + wrong(self.given, self.expected, self.hint)

    def below(self, path: str) -> Problem:
        """Return the problem of the same value with a path that begins one level higher."""
        return self._replace(path=joined(path, self.path))


def wrong(given: str, expected: str, hint: str = "") -> str:
    """Return the text about a wrong value."""
    return (f"got {given}, expected {expected}" if expected else given) + (f"; {hint}" if hint else "")


#: Characters of a value that messages show.
LONGEST_SHOWN = 80


def shown(raw: object) -> str:
    """Return a value of a file in short form, as TOML would write it."""
    if isinstance(raw, Mapping):
        return "a table"
    if isinstance(raw, list):
        return f"a list of {len(raw)}"
    if isinstance(raw, bool):
        return str(raw).lower()
    try:
        text = json.dumps(raw, ensure_ascii=False) if isinstance(raw, str) else repr(raw)
    except ValueError:  # a whole number of thousands of digits
        return "a number too large to write"
    return text if len(text) <= LONGEST_SHOWN else text[:LONGEST_SHOWN] + "..."


def joined(path: str, name: str) -> str:
    """Return the path to a value in the table at `path`; `name` may be an index such as ``[1]``, or empty."""
    return f"{path}.{name}" if path and name and not name.startswith("[") else path + name


def reason(error: Exception) -> str:
    """Return why a file could not be read, without the number of the system's error and the path."""
    return error.strerror.lower() if isinstance(error, OSError) and error.filename and error.strerror else str(error)


class WrongValueError(ValueError):
    """A value that cannot be used, refused by a function that does not know the path to it."""

    def __init__(self, given: str, expected: str, hint: str = "") -> None:
        self.given, self.expected, self.hint = given, expected, hint
        super().__init__(wrong(given, expected, hint))

    def __reduce__(self) -> tuple[type[WrongValueError], tuple[str, str, str]]:
        return type(self), (self.given, self.expected, self.hint)


class ProblemsError(ValueError):
    """Bad input; the message has one line for each problem.

    Attributes
    ----------
    source : str
        The input with the problems.
    problems : tuple of Problem
    """

    def __init__(self, source: str, problems: Sequence[Problem]) -> None:
        self.source, self.problems = source, tuple(problems)
        count = f"{len(problems)} problem" + ("s" if len(problems) != 1 else "")
        super().__init__("\n  ".join([f"{source}: {count}", *map(str, self.problems)]))

    # Exceptions are pickled with their message alone, which is not what the constructor takes.
    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.source, self.problems)


class Problems(list[Problem]):
    """The problems that several checks found."""

    def __init__(self, problems: Iterable[Problem] = ()) -> None:
        super().__init__(problems)
        self._errors: list[ValueError] = []

    def note(self, path: str, given: str, expected: str, hint: str = "", *, unknown: bool = False) -> None:
        """Add a problem."""
        self.append(Problem(path, given, expected, hint, unknown))

    def take(self, error: ValueError, path: str = "") -> None:
        """Add the problems of an error; their paths begin at `path`."""
        if isinstance(error, ProblemsError):
            self.extend(one.below(path) for one in error.problems)
        elif isinstance(error, WrongValueError):
            self.note(path, error.given, error.expected, error.hint)
        else:
            self.note(path, str(error), "")

    def collect(self, check: Callable[..., R], *given: Any, path: str = "", **named: Any) -> R | None:
        """Return what a check returns; None, with the problems added below a path, if it raises a ValueError."""
        try:
            return check(*given, **named)
        except ValueError as error:
            self.take(error, path)
            self._errors.append(error)
        return None

    def report(self, source: str, kind: type[ProblemsError] = ProblemsError) -> None:
        """Raise an error if there are problems, each once; the error of the only check that failed as it is."""
        if len(self._errors) == 1 and len(self) == len(getattr(self._errors[0], "problems", [0])):
            raise self._errors[0]
        if self:
            raise kind(source, list(dict.fromkeys(self)))


def report(source: str, texts: Iterable[str]) -> None:
    """Raise an error with one line for each text about a problem, if there are any."""
    Problems(Problem("", text, "") for text in texts).report(source)


def refuse(source: str, path: str, given: str, expected: str, hint: str = "") -> NoReturn:
    """Raise the error of a single problem."""
    raise ProblemsError(source, [Problem(path, given, expected, hint)])


class DetectorError(ProblemsError):
    """A detector description with mistakes; `problems` lists them all, `source` is the file or preset.

    Examples
    --------
    >>> try:
    ...     cg.load({"base": "besiii-cgem", "cgem": {"L1": {"drift_gap": "500 mm"}, "L2": {"pitch_x": 0.5}}})
    ... except cg.DetectorError as error:
    ...     for problem in error.problems:
    ...         print(problem.path, "is", problem.given)
    cgem.L1.drift_gap is "500 mm"
    cgem.L2.pitch_x is 0.5 (no unit)
    """


def did_you_mean(word: object, known: Iterable[object], before: str = "", *, near: float = 0.6) -> str:
    """Return ``did you mean "pitch_x"?`` for the nearest known word, after `before`; an empty text if none is near.

    Case counts first (GeV is not Gev), but a word in the wrong case is recognised, too. A value that is not a text is
    near none. `near` is the least similarity, 0 to 1.
    """
    if not isinstance(word, str):
        return ""
    names = [name for name in known if isinstance(name, str)]
    by_lower = {name.lower(): name for name in names}
    close = difflib.get_close_matches(word, names, n=1, cutoff=near)
    close = close or [by_lower[name] for name in difflib.get_close_matches(word.lower(), by_lower, n=1, cutoff=near)]
    return f'{before}did you mean "{close[0]}"?' if close else ""
