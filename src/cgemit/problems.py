"""Errors that list everything that is wrong with an input at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

P = TypeVar("P")


class ProblemsError(ValueError, Generic[P]):
    """Bad input; the message has one line for each problem.

    Attributes
    ----------
    source : str
        What the problems are about.
    problems : tuple
        What is wrong with it.
    """

    def __init__(self, source: str, problems: Sequence[P]) -> None:
        self.source, self.problems = source, tuple(problems)
        count = f"{len(problems)} problem" + ("s" if len(problems) != 1 else "")
        super().__init__("\n  ".join([f"{source}: {count}", *map(str, self.problems)]))

    # Exceptions are pickled with their message alone, which is not what the constructor takes.
    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.source, self.problems)
