"""Errors that list all problems of an input at once, each with its path and a hint."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

P = TypeVar("P")
R = TypeVar("R")


class Problem(NamedTuple):
    """One mistake: path to the value, what was given, what was expected, and a hint (may be empty)."""

    path: str
    given: str
    expected: str
    hint: str = ""

    def __str__(self) -> str:
        hint = f" ({self.hint})" if self.hint else ""
        return f"{self.path or 'file'}: got {self.given}; expected {self.expected}{hint}"


class ProblemsError(ValueError, Generic[P]):
    """Bad input; the message has one line for each problem.

    Attributes
    ----------
    source : str
        The input with the problems.
    problems : tuple
        Its problems.
    """

    def __init__(self, source: str, problems: Sequence[P]) -> None:
        self.source, self.problems = source, tuple(problems)
        count = f"{len(problems)} problem" + ("s" if len(problems) != 1 else "")
        super().__init__("\n  ".join([f"{source}: {count}", *map(str, self.problems)]))

    # Exceptions are pickled with their message alone, which is not what the constructor takes.
    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.source, self.problems)


class Problems:
    """Errors of several checks, reported together.

    Parameters
    ----------
    where : str
        The beginning of the message.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._errors: list[ValueError] = []

    def collect(self, check: Callable[..., R], *given: Any, **named: Any) -> R | None:
        """Return what a check returns; keep its ValueError and return None."""
        try:
            return check(*given, **named)
        except ValueError as error:
            self._errors.append(error)
        return None

    def report(self) -> None:
        """Raise the error of the only check that failed as it is, or one that lists those of several."""
        if len(self._errors) == 1:
            raise self._errors[0]
        if self._errors:
            first = f"{self._where}:\n  "
            lines = [str(error).removeprefix(first) for error in self._errors]
            raise ValueError(first + "\n  ".join(lines))


class DetectorError(ProblemsError[Problem]):
    """A detector description with mistakes; `problems` lists them all.

    Attributes
    ----------
    source : str
        The file or preset that was read.
    problems : tuple of Problem
        Each with `path`, `given`, `expected`, `hint`.
    """


def did_you_mean(word: object, known: Iterable[object], before: str = "") -> str:
    """Return ``did you mean "pitch_x"?`` for the nearest known word, after `before`; an empty text if none is near.

    Case counts first (GeV is not Gev), but a word in the wrong case is recognised, too. A value that is not a text is
    near none.
    """
    if not isinstance(word, str):
        return ""
    names = [name for name in known if isinstance(name, str)]
    by_lower = {name.lower(): name for name in names}
    close = difflib.get_close_matches(word, names, n=1)
    close = close or [by_lower[name] for name in difflib.get_close_matches(word.lower(), by_lower, n=1)]
    return f'{before}did you mean "{close[0]}"?' if close else ""
