"""Designs evaluated by the machinery of sweeps: by any executor, kept in files, each with its problems."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cgemit.detector import Detector
from cgemit.study.optimizer.goals import TOLERANCE, Goals, Limit
from cgemit.study.sweeps.compute import Task, compute_rows
from cgemit.study.sweeps.space import Changes

#: Designs of one task: analytic ones take milliseconds.
CHUNK = {"analytic": 5, "mc": 1}


@dataclass(frozen=True)
class Evaluator:
    """Evaluates designs; what a folder holds is not computed again.

    Attributes
    ----------
    base : Detector
    goals : Goals
    limits : tuple of Limit
    folder : Path or None
        Of the chunks.
    executor : Executor or None
    """

    base: Detector
    goals: Goals
    limits: tuple[Limit, ...]
    folder: Path | None
    executor: Executor | None

    def rows(self, designs: Sequence[Changes]) -> list[dict[str, Any]]:
        """Return the row of each design: `status`, `problems`, and of possible ones `hash`, `values`, `errors`."""
        size = CHUNK[self.goals.evaluation.method]
        parts = [designs[i : i + size] for i in range(0, len(designs), size)]
        tasks = [Task((self.base,) * len(part), tuple(part), self.goals) for part in parts]
        return [row for rows in compute_rows(tasks, self.folder, self.executor, None, None) for row in rows]

    def violations(self, row: dict[str, Any]) -> dict[str, float]:
        """Return by how much a possible design violates each limit, relative to it; negative within."""
        return {one.goal.header: one.violation(row["values"][one.goal.header]) for one in self.limits}

    def allowed(self, row: dict[str, Any]) -> bool:
        """Return whether a design is possible and within all limits."""
        return row["status"] == "ok" and all(one <= TOLERANCE for one in self.violations(row).values())


@dataclass(frozen=True)
class Design:
    """One evaluated design.

    Attributes
    ----------
    call : int
        Number of the step, or of the group of designs, that it belongs to; 0 is the base or the first population.
    kind : str
        ``"base"``, ``"value"`` or ``"optimum"``.
    values : tuple
        Of the variables.
    row : dict
        Of `Evaluator.rows`.
    """

    call: int
    kind: str
    values: tuple[Any, ...]
    row: dict[str, Any]
