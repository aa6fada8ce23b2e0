"""Optimization of one objective: searches on variables scaled to 0 to 1."""

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
from cgemit.covariance.sensitivity import logarithmic_slopes
from cgemit.detector import Detector
from cgemit.detector.inventory import gaps
from cgemit.detector.layers import CgemLayer
from cgemit.detector.variants import matching, value_at
from cgemit.study.optimize.goals import TOLERANCE, Goal, Goals, Limit, Variable, changes_of, rows_of
from cgemit.study.sweep.evaluate import Seed
from cgemit.study.sweep.run import Task, compute_rows
from cgemit.study.sweep.space import Changes, sobol

#: Designs of one task: analytic ones take milliseconds.
CHUNK = {"analytic": 5, "mc": 1}


#: Linear programs with gradients, COBYLA without, NSGA-II.
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
        Linear programs with the gradients of the covariance; COBYLA, without gradients; NSGA-II (Optuna, extra
        ``[opt]``).
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
#: The search keeps this distance from limits, relative to them: resolutions, other quantities. The first covers steps
#: of a resolution where tracks cross other cells or fire other strips.
_KEPT = (3e-4, 1e-5)
#: Parts of a step that are tried in turn if the whole one is impossible.
_CUTS = (1.0, 0.75, 0.5, 0.25, 0.1, 0.03, 0.0)


class NoStartError(ProblemsError):
    """A start from which nothing can be varied."""


@dataclass
class Descent:
    """The designs of one search: their goals, how far they are within limits, and the gradients of both.

    Every value is that of the design itself, with its own hits. Strip counts are real numbers in limits, never smaller
    than the whole ones.

    Attributes
    ----------
    evaluator : Evaluator
    variables : tuple of Variable
    objective : Goal
    progress : callable or None
    designs : list of Design
        All that were evaluated, in order.
    gradients : int
        Number of gradients that were computed.
    """

    evaluator: Evaluator
    variables: tuple[Variable, ...]
    objective: Goal
    progress: Callable[[float, str], None] | None = None
    designs: list[Design] = field(default_factory=list)
    gradients: int = 0
    _points: dict[tuple[float, ...], Point | None] = field(default_factory=dict)

    def numbers(self, u: Floats) -> list[float]:
        """Return the values of the variables."""
        return [one.low + float(x) * (one.high - one.low) for one, x in zip(self.variables, u, strict=True)]

    def detector(self, u: Floats) -> Detector:
        """Return a design."""
        return self.evaluator.base.with_overrides(dict(changes_of(self.variables, self.numbers(u))))

    def point(self, u: Floats) -> Point | None:
        """Return the design at u; None if it is impossible or no track has a covariance."""
        u = np.clip(u, 0, 1)
        name = tuple(float(x) for x in u)
        if name not in self._points:
            self._points[name] = self._evaluated(u)
        return self._points[name]

    def start(self, u: Floats) -> Point:
        """Return the design where a search starts.

        Raises
        ------
        NoStartError
            With the problems of the detector there.
        """
        try:
            self.detector(u)
        except DetectorError as error:
            raise NoStartError("start", error.problems) from None
        point = self.point(u)
        if point is None:
            raise NoStartError("start", [Problem("", one, "") for one in self.designs[-1].row["problems"]])
        return point

    def slopes(self, point: Point) -> tuple[Floats, Floats]:
        """Return the derivatives of the logarithm of the objective, (variables,), and of the margins.

        Resolutions are those of the same tracks with the hits of this design in all of its neighbours, so
        that they are smooth.
        """
        self.gradients += 1
        limits, u = self._limits(), point.u
        goals = list(dict.fromkeys([self.objective, *(one.goal for one in limits)]))
        smooth = [one for one in goals if not one.resolution]

        def geometry(detector: Detector) -> list[float]:
            return [*self._smooth(smooth, detector), *gaps(detector)]

        # Radii and thicknesses enter free spaces linearly, so that one difference is exact.
        differences = np.array([self._difference(u, i, geometry) for i in range(len(u))]).T
        scale = np.array([point.values[one.header] or 1.0 for one in smooth])[:, None]
        relative = dict(zip((one.header for one in smooth), differences[: len(smooth)] / scale, strict=True))
        relative |= self._resolution_slopes(u, [one for one in goals if one.resolution])
        rows = []
        for limit in limits:
            value = point.values[limit.goal.header]
            step = 1e-6 * (abs(value) or 1.0)
            outward = (limit.violation(value + step) - limit.violation(value - step)) / (2 * step)
            rows.append(-outward * (value or 1.0) * relative[limit.goal.header])
        spaces = differences[len(smooth) :] / _MM
        return relative[self.objective.header], np.array([*rows, *spaces]).reshape(-1, len(u))

    def _evaluated(self, u: Floats) -> Point | None:
        values = self.numbers(u)
        row = self.evaluator.rows([changes_of(self.variables, values)])[0]
        self.designs.append(Design(len(self.designs) + 1, "value", tuple(values), row))
        if self.progress:
            self.progress(min(0.99, len(self.designs) / 200), f"optimize, {len(self.designs)} designs")
        if row["status"] != "ok":
            return None
        detector, goals = self.detector(u), self.evaluator.goals
        smooth = [one for one in goals.goals if not one.resolution]
        numbers = dict(zip((one.header for one in smooth), self._smooth(smooth, detector), strict=True))
        by_header = row["values"] | numbers
        ends = [one.low for one in self.evaluator.limits if one.goal.name == "gap"]
        need = max((end * (1 + _KEPT[1]) for end in ends if end is not None), default=0.0)
        kept = [-one.violation(by_header[one.goal.header]) - _KEPT[not one.goal.resolution] for one in self._limits()]
        margins = np.array([*kept, *((one - need) / _MM for one in gaps(detector))])
        value = float(by_header[self.objective.header])
        missed = 0.0 if self.evaluator.allowed(row) else -float(margins.min())
        return Point(u, row, by_header, math.log(value) if value > 0 else -math.inf, margins, missed)

    def _smooth(self, goals: Sequence[Goal], detector: Detector) -> list[float]:
        return [self.evaluator.goals.number(one, detector, smooth=True) for one in goals]

    def _limits(self) -> list[Limit]:
        return [one for one in self.evaluator.limits if one.goal.name != "gap"]

    def _resolution_slopes(self, u: Floats, goals: Sequence[Goal]) -> dict[str, Floats]:
        if not goals:
            return {}
        detector, evaluation = self.detector(u), self.evaluator.goals.evaluation
        names = tuple(dict.fromkeys(one.name for one in goals))
        keys = [one.key for one in self.variables]
        values, _ = logarithmic_slopes(evaluation.expectation.covariance(detector), detector, keys, names)
        values = values.reshape(len(keys), len(names), -1)
        pairs = zip(self.variables, self.numbers(u), strict=True)
        chain = np.array([(one.high - one.low) * one.relative(number) for one, number in pairs])
        at = {one.header: rows_of(one, evaluation) for one in goals}
        means = {one.header: values[:, names.index(one.name), at[one.header]].mean(axis=1) for one in goals}
        return {header: chain * np.nan_to_num(mean) for header, mean in means.items()}

    def _difference(self, u: Floats, i: int, function: Callable[[Detector], list[float]]) -> Floats:
        """Return the derivative of some numbers of a design by one variable, between possible neighbours."""
        for step in (_STEP, 0.1 * _STEP):
            sides = []
            for side in (1, 0, -1):
                moved = u.copy()
                moved[i] += side * step
                try:
                    sides.append((moved[i], function(self.detector(moved))))
                except DetectorError:
                    continue
            if len(sides) > 1:
                (first, above), (last, below) = sides[0], sides[-1]
                return np.asarray((np.array(above) - np.array(below)) / (first - last))
        return np.zeros(len(function(self.detector(u))))


@dataclass(frozen=True)
class Point:
    """One design of a search.

    Attributes
    ----------
    u : (variables,) float64
        In units of the ranges.
    row : dict
        Of `Evaluator.rows`.
    values : dict of str to float
        Of all goals, without rounding to whole strips.
    value : float
        Logarithm of the objective.
    margins : (margins,) float64
        By how much each limit is kept, relative to it, and the free space between parts; less `_KEPT`.
    missed : float
        By how much the worst limit is violated; 0 of an allowed design.
    """

    u: Floats
    row: dict[str, Any]
    values: dict[str, float]
    value: float
    margins: Floats
    missed: float


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
    descents: list[Found] = []
    for u in (first, *_other_starts(evaluator, variables, how)):
        descent = Descent(evaluator, variables, objective, progress)
        try:
            descents.append(_descended(descent, u, method, tolerance, how.steps))
        except NoStartError:
            if u is first:
                raise
    best = min(descents, key=lambda one: one.optimum(objective))
    designs = [one for other in descents if other is not best for one in other.designs] + list(best.designs)
    kinds = ["value" if one.kind == "optimum" and one is not designs[-1] else one.kind for one in designs]
    numbered = [replace(one, call=i + 1, kind=kind) for i, (one, kind) in enumerate(zip(designs, kinds, strict=True))]
    several = f"the best of {len(descents)} starts: " if how.starts > 1 else ""
    message = several + best.message
    return Found(tuple(numbered), sum(one.gradients for one in descents), message)


def _other_starts(evaluator: Evaluator, variables: tuple[Variable, ...], how: Search) -> list[Floats]:
    """Return possible designs of a Sobol sequence, up to the number of starts beside the first."""
    if how.starts == 1:
        return []
    points = sobol({one.key: (0.0, 1.0) for one in variables}, 64 * how.starts, seed=how.seed).variants
    starts: list[Floats] = []
    for point in points:
        u = np.array(list(point.values()))
        values = [one.low + x * (one.high - one.low) for one, x in zip(variables, u, strict=True)]
        if len(starts) < how.starts - 1 and _is_possible(evaluator.base, changes_of(variables, values)):
            starts.append(u)
    return starts


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
    start = descent.start(first)
    message = (_with_gradients if method == "gradient" else _without)(descent, start, tolerance, steps)
    best = _best(descent)
    if best is None:
        message = with_failures(f"{message}; {no_allowed(evaluator, descent.designs)}", descent.designs)
        return Found(tuple(descent.designs), descent.gradients, message)
    if start.missed:
        number = next(one.call for one in descent.designs if evaluator.allowed(one.row))
        message = f"the start misses a limit, the first allowed design is number {number}; {message}"
    values = rounded(evaluator.base, variables, best.values)
    row = evaluator.rows([changes_of(variables, values)])[0]
    if not evaluator.allowed(row):  # filling the sheet went over a limit
        values, row = best.values, best.row
    designs = (*descent.designs, Design(len(descent.designs) + 1, "optimum", values, row))
    return Found(designs, descent.gradients, with_failures(message, designs))


def no_allowed(evaluator: Evaluator, designs: Sequence[Design]) -> str:
    """Return that no design keeps all limits, and by how much the nearest one misses which."""
    rows = [one.row for one in designs if one.row["status"] == "ok" and "values" in one.row]
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


#: First, largest and smallest size of a step, in units of the ranges.
_FIRST, _LARGEST, _SMALLEST = 0.2, 0.4, 1e-3
#: A step is taken if the objective falls, or the violation, by this part of what the gradients expect.
_EXPECTED = 0.1
#: Violations of the last designs, of which a step must be below the worst: hits that come and go make single designs
#: better than all around them (L. Grippo et al., SIAM J. Numer. Anal. 23 (1986) 707).
_LAST = 3
#: Weight of a violation against the logarithm of the objective: first an allowed design, then a better one.
_WEIGHT = 1e3


def _with_gradients(descent: Descent, here: Point, tolerance: float, steps: int) -> str:
    """Minimize by linear programs within a box that grows and shrinks; every step is a design with its own hits.

    While the design violates a limit, steps reduce the worst violation, below the largest of the last three designs;
    later ones keep all limits and reduce the objective. R. Fletcher and E. Sainz de la Maza, Math. Program. 43 (1989)
    235, without second derivatives.
    """
    size, missed = _FIRST, [here.missed]
    for step in range(1, steps + 1):
        slope, matrix = descent.slopes(here)
        while True:
            move, left = _move(slope, matrix, here.margins, here.u, size)
            gain = here.missed - left if here.missed else -float(slope @ move)
            if gain < (_KEPT[1] if here.missed else tolerance):
                if size >= _LARGEST or not here.missed:
                    return _ended(here, step, gain, tolerance)
                size = _LARGEST  # the limits may be kept farther away
                continue
            new = _taken(descent, here, move, gain, max(missed[-_LAST:]))
            if new is None and not here.missed:  # limits bend: once more with what the first try missed
                tried = descent.point(here.u + move)
                if tried is not None and tried.missed:
                    bent = tried.margins - matrix @ move
                    move, _ = _move(slope, matrix, bent, here.u, size)
                    new = _taken(descent, here, move, -float(slope @ move), 0.0)
            if new is not None:
                break
            size = 0.4 * min(size, float(np.abs(move).max()))
            if size < _SMALLEST:
                return _ended(here, step, gain, tolerance)
        fell = here.missed - new.missed if here.missed else here.value - new.value
        size = min(_LARGEST, 1.6 * size) if fell > 0.5 * gain else size
        missed.append(new.missed)
        here = new
    return f"{steps} steps, their limit"


def _ended(here: Point, step: int, gain: float, tolerance: float) -> str:
    if here.missed:
        return f"ended after {step - 1} steps: no small step comes closer to the limits"
    if gain < tolerance:
        return f"converged in {step - 1} steps"
    return f"ended after {step - 1} steps: no step is better, down to {_SMALLEST:g} of the ranges"


def _move(slope: Floats, matrix: Floats, margins: Floats, u: Floats, size: float) -> tuple[Floats, float]:
    """Return the best step of linear goals and margins within a box, and the violation that it leaves."""
    from scipy.optimize import linprog

    box = [(max(-size, -x), min(size, 1 - x)) for x in u.tolist()]
    solution = linprog(
        [*slope, _WEIGHT], A_ub=np.column_stack([-matrix, -np.ones(len(matrix))]) if len(matrix) else None,
        b_ub=margins if len(matrix) else None, bounds=[*box, (0, None)],
    )  # fmt: skip
    return np.asarray(solution.x[:-1]), float(solution.x[-1])


def _taken(descent: Descent, here: Point, move: Floats, gain: float, worst: float) -> Point | None:
    """Return the design after a step; None if the step is not good enough, its violation beside the worst one."""
    new = descent.point(here.u + move)
    if new is None or (new.missed and not here.missed):
        return None
    if here.missed:
        return new if worst - new.missed >= _EXPECTED * gain else None
    return new if here.value - new.value >= _EXPECTED * gain > 0 else None


def _without(descent: Descent, start: Point, tolerance: float, steps: int) -> str:
    """Minimize without gradients; a step onto an impossible design is cut until it is possible, which costs."""
    from scipy.optimize import minimize

    last, found = start, {tuple(start.u.tolist()): (start, 0.0)}

    def at(u: Floats) -> tuple[Point, float]:
        nonlocal last
        name, u = tuple(u.tolist()), np.clip(u, 0, 1)
        if name not in found:
            points = ((descent.point(last.u + part * (u - last.u)), part) for part in _CUTS)
            point, part = next((one, part) for one, part in points if one is not None)
            found[name], last = (point, (1 - part) * float(np.linalg.norm(u - last.u))), point
        return found[name]

    def value(u: Floats) -> float:
        point, cut = at(u)
        return point.value + 10 * cut

    limits = {"type": "ineq", "fun": lambda u: at(u)[0].margins}
    ended: Any = minimize(
        value, start.u, method="COBYLA", bounds=[(0.0, 1.0)] * len(start.u), constraints=[limits],
        options={"rhobeg": 0.2, "tol": tolerance, "maxiter": steps},
    )  # fmt: skip
    return str(ended.message)


def _best(descent: Descent) -> Design | None:
    """Return the allowed design with the lowest objective, of those with their own hits."""
    header = descent.objective.header
    allowed = [one for one in descent.designs if descent.evaluator.allowed(one.row)]
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
    whole = list(values)
    stated = {path for one in variables for key in one.key.split(",") for path in matching(base, key.strip(), [])}
    for view in "xv":  # V strips cross the X strips: these come first
        detector = base.with_overrides(dict(changes_of(variables, whole)))
        for i, variable in enumerate(variables):
            paths = list(matching(base, variable.key, [])) if "," not in variable.key else []
            if len(paths) != 1 or not paths[0].endswith(f".pitch_{view}") or variable.before:
                continue
            layer = next(layer for layer in detector.cgem if paths[0] == f"cgem.{layer.label}.pitch_{view}")
            now = value_at(detector, paths[0])
            wanted = whole[i] * _filling(layer, view, stated) / now[0] if now else whole[i]
            # Downward in the last of the eight digits, so that the last strip still fits.
            wanted = math.floor(wanted * 10 ** (7 - _digits(wanted))) / 10 ** (7 - _digits(wanted))
            whole[i] = wanted if variable.low <= wanted <= variable.high else whole[i]
    return tuple(whole)


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
