"""The table of an optimization: designs, their goals with errors, and the front among them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cgemit.detector import Detector
from cgemit.detector.variants import variant_name
from cgemit.study.optimizer.evaluator import Design, Evaluator
from cgemit.study.optimizer.front import by_noise, nondominated, within_errors
from cgemit.study.optimizer.goals import Goal
from cgemit.study.optimizer.variables import Variable, changes_of
from cgemit.study.sweeps.evaluate import GROUPS

#: What a design is: of the front, of the front by less than errors, dominated by less than errors.
FRONT, LOOSE, TIED = "front", "front within errors", "within errors"


def columns_of(evaluator: Evaluator, variables: Sequence[Variable], designs: Sequence[Design]) -> dict[str, list[Any]]:
    """Return the table of some designs, without the front."""
    rows = [one.row for one in designs]
    columns: dict[str, list[Any]] = {
        "design": list(range(len(designs))),
        "call": [one.call for one in designs],
        "kind": [one.kind for one in designs],
        "name": [_name(evaluator.base, variables, one) for one in designs],
        "hash": [row.get("hash", "") for row in rows],
        "status": [row["status"] for row in rows],
        "problems": ["; ".join(row["problems"]) for row in rows],
        "allowed": [evaluator.allowed(row) for row in rows],
    }
    for i, variable in enumerate(variables):
        columns[variable.header] = [one.values[i] for one in designs]
    for goal in evaluator.goals.goals:
        columns[goal.header] = [row.get("values", {}).get(goal.header, math.nan) for row in rows]
        if goal.resolution:
            columns[goal.error_header] = [row.get("errors", {}).get(goal.header, math.nan) for row in rows]
    return columns


def _name(base: Detector, variables: Sequence[Variable], design: Design) -> str:
    return base.name if design.kind == "base" else variant_name(base.name, changes_of(variables, design.values))


def replicas_of(designs: Sequence[Design], objectives: Sequence[Goal], values: Any) -> Any:
    """Return (designs, objectives, GROUPS) values without each group of tracks."""
    found = np.repeat(values[:, :, None], GROUPS, axis=2)
    for i, design in enumerate(designs):
        for k, goal in enumerate(objectives):
            replicas = design.row.get("replicas", {}).get(goal.header)
            if replicas is not None:
                found[i, k] = replicas
    return found


def front_of(values: Any, replicas: Any) -> list[str]:
    """Return what each design is: on the front, within errors of it, or neither (an empty text)."""
    texts = np.full(len(values), "", dtype=object)
    allowed = np.flatnonzero(np.isfinite(values).all(axis=1))
    if len(allowed):
        front = nondominated(values[allowed])
        texts[allowed[front]] = FRONT
        texts[allowed[by_noise(values[allowed], replicas[allowed], front)]] = LOOSE
        texts[allowed[within_errors(values[allowed], replicas[allowed], front)]] = TIED
    return [str(one) for one in texts]
