"""The functions that scipy calls: an objective, limits and their gradients, of variables scaled to 0 to 1."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cgemit.covariance import Covariance
from cgemit.covariance.derivatives import logarithmic_slopes
from cgemit.covariance.kept_hits import SurfacesError, varied
from cgemit.detector import Detector, DetectorError
from cgemit.statistics.estimate import Floats
from cgemit.study.optimizer.evaluator import Design, Evaluator
from cgemit.study.optimizer.geometry import gaps
from cgemit.study.optimizer.goals import Goal, Limit
from cgemit.study.optimizer.variables import Variable, changes_of
from cgemit.study.sweeps.evaluate import QUANTITIES, covariances

#: Step of differences of the geometry, in units of a variable's range.
_STEP = 1e-4
_MM = 10.0  # scale of the free space between parts
#: The search keeps this distance from limits, relative to them: resolutions, other quantities. The first covers what
#: a resolution changes by when its hits are renewed.
_KEPT = (3e-4, 1e-5)
#: Parts of a step that are tried in turn if the whole one is impossible.
_CUTS = (1.0, 0.75, 0.5, 0.25, 0.1, 0.03, 0.0)


class NoStartError(ValueError):
    """A start from which nothing can be varied."""


@dataclass
class Descent:
    """One search.

    With `fixed_hits`, resolutions are those of the same tracks with the same hits in every design (`varied`), so that
    they are smooth functions of the design and have gradients; without, every design has its own hits. Strip counts
    are real numbers in limits, never smaller than the whole ones. A step onto an impossible design, or onto one whose
    slabs and wires are in another order so that it cannot have the same hits, is cut until the design is possible, and
    costs what was cut.

    Attributes
    ----------
    evaluator : Evaluator
    variables : tuple of Variable
    objective : Goal
    fixed_hits : bool
    progress : callable or None
    designs : list of Design
        All that were evaluated, in order: of kind "value" with their own hits, "step" with the hits of another one.
    gradients : int
        Number of gradients that were computed.
    """

    evaluator: Evaluator
    variables: tuple[Variable, ...]
    objective: Goal
    fixed_hits: bool = False
    progress: Callable[[float, str], None] | None = None
    designs: list[Design] = field(default_factory=list)
    gradients: int = 0
    _anchors: list[Covariance] = field(default_factory=list)
    _found: dict[tuple[float, ...], _Point] = field(default_factory=dict)
    _slopes: dict[tuple[float, ...], dict[str, Floats]] = field(default_factory=dict)
    _good: Floats | None = None
    _lines: tuple[Floats, Floats] = (np.empty((0, 0)), np.empty(0))

    def start(self, u: Floats) -> None:
        """Prepare the search from a start.

        Raises
        ------
        NoStartError
            With the problems of the detector there.
        """
        try:
            first = gaps(self.detector(u))
        except DetectorError as error:
            raise NoStartError("\n".join(map(str, error.problems))) from None
        # Radii and thicknesses enter linearly, so that one difference is exact everywhere.
        columns = [self._difference(u, i, gaps) for i in range(len(u))]
        ends = [one.low for one in self.evaluator.limits if one.goal.name == "gap"]
        need = max((end * (1 + _KEPT[1]) for end in ends if end is not None), default=0.0)
        matrix = np.array(columns).T.reshape(-1, len(u))
        moved = np.abs(matrix).max(axis=1, initial=0) > 0
        self._lines = matrix[moved] / _MM, (np.array(first) - need - matrix @ u)[moved] / _MM

    def renew(self, u: Floats) -> dict[str, Any]:
        """Evaluate a design with its own hits, keep these for the next steps, and return its row.

        Raises
        ------
        NoStartError
            If it is impossible, or no track has a covariance.
        """
        row = self._row(u)
        if row["status"] != "ok":
            raise NoStartError("\n".join(row["problems"]))
        self._found, self._slopes, self._good = {}, {}, np.array(u)
        if self.fixed_hits and self.evaluator.goals.evaluation.quantities:
            self._anchors = covariances(self.detector(u), self.evaluator.goals.evaluation)
        return row

    def numbers(self, u: Floats) -> list[float]:
        """Return the values of the variables."""
        return [one.low + float(x) * (one.high - one.low) for one, x in zip(self.variables, u, strict=True)]

    def detector(self, u: Floats) -> Detector:
        """Return a design."""
        return self.evaluator.base.with_overrides(dict(changes_of(self.variables, self.numbers(u))))

    def value(self, u: Floats) -> float:
        """Return the logarithm of the objective."""
        point = self._at(u)
        return math.log(point.values[self.objective.header]) + 10 * point.cut

    def slope(self, u: Floats) -> Floats:
        """Return the gradient of `value`."""
        return self._slopes_at(u)[self.objective.header]

    def margins(self, u: Floats) -> Floats:
        """Return by how much each limit is kept, relative to it, and the free space between parts."""
        values = self._at(u).values
        matrix, constant = self._lines
        kept = [-one.violation(values[one.goal.header]) - _KEPT[not one.goal.resolution] for one in self._limits()]
        return np.array([*kept, *(matrix @ u + constant)])

    def margin_slopes(self, u: Floats) -> Floats:
        """Return the derivatives of `margins`, (margins, variables)."""
        values, slopes = self._at(u).values, self._slopes_at(u)
        rows = []
        for one in self._limits():
            value = values[one.goal.header]
            step = 1e-6 * abs(value)
            outward = (one.violation(value + step) - one.violation(value - step)) / (2 * step)
            rows.append(-outward * value * slopes[one.goal.header])
        return np.array([*rows, *self._lines[0]]).reshape(-1, len(self.variables))

    def _limits(self) -> list[Limit]:
        return [one for one in self.evaluator.limits if one.goal.name != "gap"]

    def _goals(self) -> list[Goal]:
        return list(dict.fromkeys([self.objective, *(one.goal for one in self._limits())]))

    def _at(self, u: Floats) -> _Point:
        """Return the design at u, or where the step from the last possible one has to end."""
        name = tuple(float(x) for x in u)
        if name not in self._found:
            u = np.clip(np.array(name), 0, 1)
            start = u if self._good is None else self._good
            for part in _CUTS:
                here = start + part * (u - start)
                values = self._values(here)
                if values is not None:
                    break
            else:
                raise NoStartError(f"{self.numbers(u)}: got an impossible design, expected a possible start")
            self._good = here
            self._found[name] = _Point(here, self.detector(here), values, (1 - part) * float(np.linalg.norm(u - start)))
        return self._found[name]

    def _values(self, u: Floats) -> dict[str, float] | None:
        """Return the goals of a design; None if it is impossible."""
        values = self._with_fixed_hits(u) if self.fixed_hits else self._row(u).get("values")
        if values is None:
            return None
        detector, goals = self.detector(u), self.evaluator.goals
        real = {one.header: goals.number(one, detector, smooth=True) for one in self._goals() if not one.resolution}
        return values | real

    def _with_fixed_hits(self, u: Floats) -> dict[str, float] | None:
        try:
            detector = self.detector(u)
            found = [varied(one, [detector])[0] for one in self._anchors]
        except (DetectorError, SurfacesError) as error:
            problems = [str(one) for one in getattr(error, "problems", [error])]
            self._keep("step", self.numbers(u), {"status": "impossible", "problems": problems})
            return None
        goals = self.evaluator.goals
        values = {one.header: goals.number(one, detector) for one in goals.goals if not one.resolution}
        for goal in goals.goals:
            if goal.resolution:
                logs = [np.log(one.sigma(goal.name)[self._points(goal)]) for one in found]
                values[goal.header] = QUANTITIES[goal.name][1] * math.exp(float(np.mean(logs)))
        row = {"status": "ok", "problems": [], "hash": detector.content_hash}
        self._keep("step", self.numbers(u), row | {"values": values})
        return values if all(map(math.isfinite, values.values())) else None

    def _points(self, goal: Goal) -> list[int]:
        return [i for i, p in enumerate(self.evaluator.goals.evaluation.p) if goal.p in (None, p)]

    def _row(self, u: Floats) -> dict[str, Any]:
        values = self.numbers(u)
        row = self.evaluator.rows([changes_of(self.variables, values)])[0]
        self._keep("value", values, row)
        return row

    def _keep(self, kind: str, values: Sequence[float], row: dict[str, Any]) -> None:
        self.designs.append(Design(len(self.designs) + 1, kind, tuple(values), row))
        if self.progress:
            self.progress(min(0.99, len(self.designs) / 200), f"optimize, {len(self.designs)} designs")

    def _slopes_at(self, u: Floats) -> dict[str, Floats]:
        """Return the derivatives of the logarithm of every goal by the scaled variables."""
        name = tuple(float(x) for x in u)
        if name not in self._slopes:
            point = self._at(u)
            self._slopes[name] = self._resolution_slopes(point) | {
                one.header: self._geometry_slope(one, point) for one in self._goals() if not one.resolution
            }
            self.gradients += 1
        return self._slopes[name]

    def _resolution_slopes(self, point: _Point) -> dict[str, Floats]:
        goals = [one for one in self._goals() if one.resolution]
        if not goals:
            return {}
        names = tuple(dict.fromkeys(one.name for one in goals))
        keys = [one.key for one in self.variables]
        found = [logarithmic_slopes(one, point.detector, keys, names)[0] for one in self._anchors]
        values = np.mean(found, axis=0)  # (keys, quantities, p)
        pairs = zip(self.variables, self.numbers(point.u), strict=True)
        chain = np.array([(one.high - one.low) * one.relative(number) for one, number in pairs])
        means = {one.header: values[:, names.index(one.name), self._points(one)].mean(axis=1) for one in goals}
        return {header: chain * np.nan_to_num(mean) for header, mean in means.items()}

    def _geometry_slope(self, goal: Goal, point: _Point) -> Floats:
        def number(one: Detector) -> list[float]:
            return [self.evaluator.goals.number(goal, one, smooth=True)]

        slope = [self._difference(point.u, i, number)[0] for i in range(len(point.u))]
        return np.array(slope) / point.values[goal.header]

    def _difference(self, u: Floats, i: int, function: Callable[[Detector], list[float]]) -> Floats:
        """Return the derivative of some numbers of a design by one variable, between possible neighbours."""
        for step in (_STEP, 0.1 * _STEP):
            found = []
            for side in (1, 0, -1):
                moved = u.copy()
                moved[i] += side * step
                try:
                    found.append((moved[i], function(self.detector(moved))))
                except DetectorError:
                    continue
            if len(found) > 1:
                (first, above), (last, below) = found[0], found[-1]
                return np.asarray((np.array(above) - np.array(below)) / (first - last))
        return np.zeros(len(function(self.detector(u))))


@dataclass(frozen=True)
class _Point:
    """Where a step ends: its design, the values of all goals, and how much of the step was cut."""

    u: Floats
    detector: Detector
    values: dict[str, float]
    cut: float
