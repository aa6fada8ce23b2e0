"""Optimization of one objective: scipy's searches on variables scaled to 0 to 1."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.errors import DetectorError, Problem, ProblemsError
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Quantity, Whole
from cgemit.chain.executor import Workers
from cgemit.covariance.result import Covariance
from cgemit.covariance.sensitivity import SurfacesError, logarithmic_slopes, varied
from cgemit.detector import Detector
from cgemit.detector.inventory import gaps
from cgemit.detector.layers import CgemLayer
from cgemit.detector.variants import matching, value_at
from cgemit.study.optimize.goals import TOLERANCE, Goal, Goals, Limit, Variable, changes_of
from cgemit.study.sweep.evaluate import Seed, covariances
from cgemit.study.sweep.run import Task, compute_rows
from cgemit.study.sweep.space import Changes, sobol

#: Designs of one task: analytic ones take milliseconds.
CHUNK = {"analytic": 5, "mc": 1}


#: SLSQP with gradients, COBYLA without, NSGA-II.
Method = Literal["gradient", "cobyla", "nsga2"]

Count = Annotated[int, Whole(1, 1_000_000)]
Population = Annotated[int, Whole(4, 1_000_000)]
Calls = Annotated[int, Whole(0, 1_000_000)]
Starts = Annotated[int, Whole(1, 1000)]
Tolerance = Annotated[float, Quantity(low=0, high=1, above=True, below=True)]


@dataclass(frozen=True, kw_only=True)
class Search(SettingsData):
    """Method and length of a search; the table ``[search]`` of a plan.

    Attributes
    ----------
    method : "gradient", "cobyla", "nsga2" or None
        SLSQP with the gradients of the covariance; COBYLA, without gradients; NSGA-II (Optuna, extra ``[opt]``).
        None: "gradient" for one objective of continuous numbers, else "nsga2".
    tolerance : float or None
        Relative change of the objective ("gradient", 1e-4) or change of the variables in units of their ranges
        ("cobyla", 1e-3) at which the search ends.
    steps : int
        Most iterations of "gradient", most designs of "cobyla".
    population, offspring, calls : int
        Of "nsga2": designs of the first population and parents of each call, new designs of each call, and calls.
    starts : int
        Of "gradient" and "cobyla": searches, one from the base's own values and others from possible designs of a Sobol
        sequence in all ranges; the best one counts.
    seed : int
        Of "nsga2", and of the starts.

    Examples
    --------
    >>> search = cg.study.Search(method="cobyla", calls=50)
    >>> search.method, search.calls, search.seed
    ('cobyla', 50, 1)
    """

    method: Method | None = None
    tolerance: Tolerance | None = None
    steps: Count = 200
    population: Population = 100
    offspring: Count = 30
    calls: Calls = 200
    starts: Starts = 1
    seed: Seed = 1


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
    workers : Workers
    """

    base: Detector
    goals: Goals
    limits: tuple[Limit, ...]
    folder: Path | None
    workers: Workers

    def rows(self, designs: Sequence[Changes]) -> list[dict[str, Any]]:
        """Return the row of each design: `status`, `problems`, and of possible ones `hash`, `values`, `errors`."""
        size = CHUNK[self.goals.evaluation.kind]
        parts = [designs[i : i + size] for i in range(0, len(designs), size)]
        tasks = [Task((self.base,) * len(part), tuple(part), self.goals) for part in parts]
        return [row for rows in compute_rows(tasks, self.folder, self.workers, None, None) for row in rows]

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


#: Step of differences of the geometry, in units of a variable's range.
_STEP = 1e-4
_MM = 10.0  # scale of the free space between parts
#: The search keeps this distance from limits, relative to them: resolutions, other quantities. The first covers what
#: a resolution changes by when its hits are renewed.
_KEPT = (3e-4, 1e-5)
#: Parts of a step that are tried in turn if the whole one is impossible.
_CUTS = (1.0, 0.75, 0.5, 0.25, 0.1, 0.03, 0.0)


class NoStartError(ProblemsError):
    """A start from which nothing can be varied."""


@dataclass
class Descent:
    """One search.

    With `fixed_hits`, resolutions are those of the same tracks with the same hits in every design (`varied`), so that
    they are smooth functions of the design and have gradients; without, every design has its own hits. Strip counts
    are real numbers in limits, never smaller than the whole ones. A step onto an impossible design is cut until the
    design is possible, and costs what was cut. So is a step onto a design that cannot have the same hits, since its
    slabs and wires are in another order; these designs are kept for `beyond`.

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
    _hits: _Anchored = field(default_factory=lambda: _Anchored())
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
            raise NoStartError("start", error.problems) from None
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
            raise NoStartError("start", [Problem("", one, "") for one in row["problems"]])
        fixed = self.fixed_hits and self.evaluator.goals.quantities
        self._hits = _Anchored(
            covariances(self.detector(u), self.evaluator.goals.evaluation) if fixed else [], np.array(u)
        )
        return row

    def beyond(self, row: dict[str, Any], refused: Sequence[Floats]) -> Floats | None:
        """Return the best of the designs that could not have the same hits, with their own; None if `row` is better.

        Parameters
        ----------
        row : dict
            Of the design where the search with these hits ended.
        refused : sequence of ndarray
        """
        rows = [(u, self._row(u)) for u in refused]
        best = min(rows, key=lambda one: self._merit(one[1]), default=None)
        return best[0] if best and self._merit(best[1]) < self._merit(row) else None

    def refused(self, u: Floats) -> list[Floats]:
        """Return some designs, near and far from u, that could not have its hits."""
        far = sorted(self._hits.refused, key=lambda one: float(np.linalg.norm(one - u)))
        return far[:: -max(1, len(far) // _MOST_REFUSED)]

    def _merit(self, row: dict[str, Any]) -> tuple[float, float]:
        """Return by how much a design misses its limits, and its objective."""
        if row["status"] != "ok":
            return math.inf, math.inf
        missed = max((one for one in self.evaluator.violations(row).values() if one > TOLERANCE), default=0.0)
        return missed, float(row["values"][self.objective.header])

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
        if name not in self._hits.points:
            u = np.clip(np.array(name), 0, 1)
            start = u if self._hits.last is None else self._hits.last
            for part in _CUTS:
                here = start + part * (u - start)
                values = self._values(here)
                if values is not None:
                    break
            else:
                raise NoStartError(
                    "start", [Problem("", f"an impossible design {self.numbers(u)}", "a possible start")]
                )
            self._hits.last = here
            self._hits.points[name] = _Point(
                here, self.detector(here), values, (1 - part) * float(np.linalg.norm(u - start))
            )
        return self._hits.points[name]

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
            found = [varied(one, [detector])[0] for one in self._hits.covariances]
        except SurfacesError:
            self._hits.refused.append(u)
            return None
        except DetectorError as error:
            problems = [str(one) for one in error.problems]
            self._keep("step", self.numbers(u), {"status": "impossible", "problems": problems})
            return None
        goals = self.evaluator.goals
        values = {one.header: goals.number(one, detector) for one in goals.goals if not one.resolution}
        for goal in goals.goals:
            if goal.resolution:
                logs = [np.log(one.sigma(goal.name)[self._points(goal)]) for one in found]
                values[goal.header] = math.exp(float(np.mean(logs)))
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
        if name not in self._hits.slopes:
            point = self._at(u)
            self._hits.slopes[name] = self._resolution_slopes(point) | {
                one.header: self._geometry_slope(one, point) for one in self._goals() if not one.resolution
            }
            self.gradients += 1
        return self._hits.slopes[name]

    def _resolution_slopes(self, point: _Point) -> dict[str, Floats]:
        goals = [one for one in self._goals() if one.resolution]
        if not goals:
            return {}
        names = tuple(dict.fromkeys(one.name for one in goals))
        keys = [one.key for one in self.variables]
        found = [logarithmic_slopes(one, point.detector, keys, names)[0] for one in self._hits.covariances]
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


@dataclass
class _Anchored:
    """What a search keeps as long as it has the same hits."""

    covariances: list[Covariance] = field(default_factory=list)
    last: Floats | None = None  # the last possible design
    points: dict[tuple[float, ...], _Point] = field(default_factory=dict)
    slopes: dict[tuple[float, ...], dict[str, Floats]] = field(default_factory=dict)
    refused: list[Floats] = field(default_factory=list)


@dataclass(frozen=True)
class _Point:
    """Where a step ends: its design, the values of all goals, and how much of the step was cut."""

    u: Floats
    detector: Detector
    values: dict[str, float]
    cut: float


#: Most times that hits are renewed, and the step, in units of the ranges, below which they need not be.
_ROUNDS, _MOVED = 6, 2e-3
#: Most times that a search goes on where slabs and wires are in another order, and about how many designs it tries.
_MOST_CROSSINGS, _MOST_REFUSED = 30, 12


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes
    ----------
    designs : tuple of Design
        All that were evaluated, in order; the last one is the optimum if `kind` says so.
    gradients : int
        Number of gradients.
    message : str
        How the search ended.
    """

    designs: tuple[Design, ...]
    gradients: int
    message: str

    def optimum(self, objective: Goal) -> float:
        """Return the objective of the optimum; infinite without one."""
        last = self.designs[-1]
        return float(last.row["values"][objective.header]) if last.kind == "optimum" else math.inf


def descend(
    evaluator: Evaluator,
    variables: tuple[Variable, ...],
    objective: Goal,
    *,
    method: Literal["gradient", "cobyla"],
    tolerance: float,
    how: Search,
    progress: Callable[[float, str], None] | None,
) -> Found:
    """Return the designs of the searches from all starts; the last one is the best of their optima.

    Parameters
    ----------
    evaluator : Evaluator
    variables : tuple of Variable
        All continuous.
    objective : Goal
    method : "gradient" or "cobyla"
    tolerance : float
        Relative change of the objective at which "gradient" ends, and of the variables, in units of their ranges, at
        which "cobyla" ends.
    how : Search
        `steps`, `starts` and `seed`.
    progress : callable or None

    Raises
    ------
    NoStartError
        If the first start, the base, is impossible.
    """
    own = [one.start(evaluator.base) for one in variables]
    pairs = zip(own, variables, strict=True)
    first = np.array([(value - one.low) / (one.high - one.low) for value, one in pairs])
    found: list[Found] = []
    for u in (first, *_other_starts(evaluator, variables, how)):
        descent = Descent(evaluator, variables, objective, fixed_hits=method == "gradient", progress=progress)
        try:
            found.append(_descended(descent, u, method, tolerance, how.steps))
        except NoStartError:
            if u is first:
                raise
    best = min(found, key=lambda one: one.optimum(objective))
    designs = [one for other in found if other is not best for one in other.designs] + list(best.designs)
    kinds = ["value" if one.kind == "optimum" and one is not designs[-1] else one.kind for one in designs]
    numbered = [replace(one, call=i + 1, kind=kind) for i, (one, kind) in enumerate(zip(designs, kinds, strict=True))]
    several = f"the best of {len(found)} starts: " if how.starts > 1 else ""
    message = several + best.message
    return Found(tuple(numbered), sum(one.gradients for one in found), message)


def _other_starts(evaluator: Evaluator, variables: tuple[Variable, ...], how: Search) -> list[Floats]:
    """Return possible designs of a Sobol sequence, up to the number of starts beside the first."""
    if how.starts == 1:
        return []
    points = sobol({one.key: (0.0, 1.0) for one in variables}, 64 * how.starts, seed=how.seed).variants
    found: list[Floats] = []
    for point in points:
        u = np.array(list(point.values()))
        values = [one.low + x * (one.high - one.low) for one, x in zip(variables, u, strict=True)]
        if len(found) < how.starts - 1 and _is_possible(evaluator.base, changes_of(variables, values)):
            found.append(u)
    return found


def _is_possible(base: Detector, changes: Changes) -> bool:
    try:
        base.with_overrides(dict(changes))
    except DetectorError:
        return False
    return True


def _descended(
    descent: Descent, first: Floats, method: Literal["gradient", "cobyla"], tolerance: float, steps: int
) -> Found:
    """Return the designs of a search from one start."""
    evaluator, variables = descent.evaluator, descent.variables
    descent.start(first)
    message = (_with_gradients if method == "gradient" else _without)(descent, first, tolerance, steps)
    best = _best(descent)
    if best is None:
        message = with_failures(f"{message}; {no_allowed(evaluator, descent.designs)}", descent.designs)
        return Found(tuple(descent.designs), descent.gradients, message)
    values = rounded(evaluator.base, variables, best.values)
    row = evaluator.rows([changes_of(variables, values)])[0]
    if not evaluator.allowed(row):  # filling the sheet went over a limit
        values, row = best.values, best.row
    designs = (*descent.designs, Design(len(descent.designs) + 1, "optimum", values, row))
    return Found(designs, descent.gradients, with_failures(message, designs))


def no_allowed(evaluator: Evaluator, designs: Sequence[Design]) -> str:
    """Return that no design with its own hits keeps all limits, and by how much the nearest one misses which."""
    rows = [one.row for one in designs if one.kind != "step" and one.row["status"] == "ok" and "values" in one.row]
    if not rows:
        return "no design could be evaluated"
    nearest = min(rows, key=lambda row: max(evaluator.violations(row).values(), default=0.0))
    values = {one: nearest["values"][one.goal.header] for one in evaluator.limits}
    missed = [one.missed(value) for one, value in values.items() if one.violation(value) > TOLERANCE]
    return f"no design that was tried keeps all limits; the nearest one has {', '.join(missed)}"


def with_failures(message: str, designs: Sequence[Design]) -> str:
    """Return how a search ended: if evaluations failed, how many and why the first one did, and no success.

    Parameters
    ----------
    message : str
        Of the search.
    designs : sequence of Design
    """
    failed = [one.row for one in designs if one.row["status"] == "failed"]
    if not failed:
        return message
    ended = message.replace(" successfully", "")
    return f"{ended}; {len(failed)} of {len(designs)} evaluations failed, the first with {failed[0]['problems'][0]}"


def _with_gradients(descent: Descent, u: Any, tolerance: float, steps: int) -> str:
    """Minimize with fixed hits, renew the hits at the minimum, and repeat until this changes nothing.

    Where slabs and wires change their order, the search ends; it goes on beyond, if the designs there are better.
    """
    from scipy.optimize import minimize

    limits = {"type": "ineq", "fun": descent.margins, "jac": descent.margin_slopes}
    descent.renew(u)
    message, rounds, crossings = "", 0, 0
    while rounds < _ROUNDS:
        found: Any = minimize(
            descent.value, u, jac=descent.slope, method="SLSQP", bounds=[(0.0, 1.0)] * len(u), constraints=[limits],
            options={"ftol": tolerance, "maxiter": steps},
        )  # fmt: skip
        new = np.clip(found.x, 0, 1)
        moved, message, refused = float(np.abs(new - u).max()), str(found.message), descent.refused(u)
        try:
            row = descent.renew(new)
        except NoStartError as error:  # the last step touched another part
            return f"{message}; {error}"
        u, beyond = new, descent.beyond(row, refused)
        if beyond is None:
            rounds += 1
            if moved < _MOVED:
                break
        elif crossings == _MOST_CROSSINGS:
            return "slabs and wires change their order too often; method cobyla needs no fixed order"
        else:
            u, crossings = beyond, crossings + 1
            descent.renew(u)
    return message


def _without(descent: Descent, u: Any, tolerance: float, steps: int) -> str:
    from scipy.optimize import minimize

    limits = {"type": "ineq", "fun": descent.margins}
    found: Any = minimize(
        descent.value, u, method="COBYLA", bounds=[(0.0, 1.0)] * len(u), constraints=[limits],
        options={"rhobeg": 0.2, "tol": tolerance, "maxiter": steps},
    )  # fmt: skip
    return str(found.message)


def _best(descent: Descent) -> Design | None:
    """Return the allowed design with the lowest objective, of those with their own hits."""
    header = descent.objective.header
    allowed = [one for one in descent.designs if one.kind == "value" and descent.evaluator.allowed(one.row)]
    return min(allowed, key=lambda one: float(one.row["values"][header]), default=None)


def rounded(base: Detector, variables: tuple[Variable, ...], values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return values in which a pitch of one layer is such that whole strips fill the sheet.

    The number of strips stays. X strips fill the sheet around the layer, V strips the sheet across them, where they are
    counted: from the first X strip to the last, unless their number is a variable, too. A pitch that several layers
    share, and one that would leave its range, stay as they are.

    Parameters
    ----------
    base : Detector
    variables : tuple of Variable
    values : tuple
        Of the variables.
    """
    found = list(values)
    given = {path for one in variables for key in one.key.split(",") for path in matching(base, key.strip(), [])}
    for view in "xv":  # V strips cross the X strips: these come first
        detector = base.with_overrides(dict(changes_of(variables, found)))
        for i, one in enumerate(variables):
            paths = list(matching(base, one.key, [])) if "," not in one.key else []
            if len(paths) != 1 or not paths[0].endswith(f".pitch_{view}") or one.before:
                continue
            layer = next(layer for layer in detector.cgem if paths[0] == f"cgem.{layer.label}.pitch_{view}")
            now = value_at(detector, paths[0])
            wanted = found[i] * _filling(layer, view, given) / now[0] if now else found[i]
            # Downward in the last of the eight digits, so that the last strip still fits.
            wanted = math.floor(wanted * 10 ** (7 - _digits(wanted))) / 10 ** (7 - _digits(wanted))
            found[i] = wanted if one.low <= wanted <= one.high else found[i]
    return tuple(found)


def _digits(value: float) -> int:
    return math.floor(math.log10(value))


def _filling(layer: CgemLayer, view: str, given: Collection[str]) -> float:
    """Return the pitch with which the strips of a view fill the sheet; `given` keys do not follow from it."""
    width = 2 * math.pi * layer.r_readout / layer.sheets
    if view == "x":
        return width / layer.strips_x
    across = layer.strips_x * layer.pitch_x * math.cos(layer.stereo) + layer.length * math.sin(abs(layer.stereo))
    counted = across - layer.pitch_x * math.cos(layer.stereo)
    pitch = math.inf if f"cgem.{layer.label}.strips_v" in given else counted / layer.strips_v
    # An offset that is no variable is 0, or changes with the pitch.
    offset = layer.offset_v if f"cgem.{layer.label}.offset_v" in given else 0.0
    return min(pitch, across / (layer.strips_v + offset))
