"""What is wrong with a detector description: all problems at once, each with its place."""

from typing import NamedTuple

from cgemit.problems import ProblemsError


class Problem(NamedTuple):
    """One mistake: path to the value, what was given, what was expected, and a hint (may be empty)."""

    path: str
    given: str
    expected: str
    hint: str = ""

    def __str__(self) -> str:
        hint = f" ({self.hint})" if self.hint else ""
        return f"{self.path or 'file'}: got {self.given}; expected {self.expected}{hint}"


class DetectorError(ProblemsError[Problem]):
    """A detector description with mistakes; `problems` lists them all.

    Attributes
    ----------
    source : str
        The file or preset that was read.
    problems : tuple of Problem
        Each with `path`, `given`, `expected`, `hint`.
    """
