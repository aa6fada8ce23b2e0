"""What is wrong with a detector description: all problems at once, each with its place."""

from collections.abc import Sequence
from typing import NamedTuple


class Problem(NamedTuple):
    """One mistake: path to the value, what was given, what was expected, and a hint (may be empty)."""

    path: str
    given: str
    expected: str
    hint: str = ""

    def __str__(self) -> str:
        hint = f" ({self.hint})" if self.hint else ""
        return f"{self.path or 'file'}: got {self.given}; expected {self.expected}{hint}"


class DetectorError(ValueError):
    """A detector description with mistakes; `problems` lists them all.

    Attributes
    ----------
    source : str
        The file or preset that was read.
    problems : tuple of Problem
        Each with `path`, `given`, `expected`, `hint`.

    """

    def __init__(self, source: str, problems: Sequence[Problem]) -> None:
        self.source, self.problems = source, tuple(problems)
        count = f"{len(problems)} problem" + ("s" if len(problems) != 1 else "")
        super().__init__("\n  ".join([f"{source}: {count}", *map(str, self.problems)]))

    def __reduce__(self) -> tuple[type["DetectorError"], tuple[str, tuple[Problem, ...]]]:
        return DetectorError, (self.source, self.problems)
