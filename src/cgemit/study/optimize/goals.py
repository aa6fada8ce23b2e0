"""Objectives and limits of an optimization: their values and errors for one detector."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cgemit.analysis.quantities import NAMES, QUANTITIES
from cgemit.analysis.widths import GROUPS, jackknife
from cgemit.base.arrays import Floats
from cgemit.base.errors import DetectorError, Problems, WrongValueError, did_you_mean
from cgemit.base.validate import is_whole
from cgemit.covariance.result import core_widths
from cgemit.detector import Detector
from cgemit.detector.inventory import GEOMETRY, Background, occupancy, wire_occupancy
from cgemit.detector.variants import values_at
from cgemit.study.sweep.evaluate import UNSEEN, Evaluation, identity, unseen_matter
from cgemit.study.sweep.space import Changes, own_text, own_value, split_range
from cgemit.units import NATIVE, QuantityError, parse_quantity

#: A user's goal: a number of a detector.
Numbered = Callable[[Detector], float]
#: Goals that need a `Background`, in %.
OCCUPANCIES = {"occupancy": occupancy, "wire_occupancy": wire_occupancy}
#: Goal that needs prices.
COST = "cost"


@dataclass(frozen=True)
class Goal:
    """One number of a design.

    Attributes
    ----------
    text : str
        As it was given, such as ``"dr @ 0.3 GeV/c"``.
    name : str
        A resolution (of `QUANTITIES`), or a number of `GEOMETRY`, one of `OCCUPANCIES`, ``"cost"`` or ``"unseen_x0"``;
        name of a function.
    p : float or None, GeV/c
        Of a resolution: at this momentum only; None: the geometric mean of all points.
    function : callable or None
        The user's function of a `Detector`, which returns a number.
    """

    text: str
    name: str
    p: float | None = None
    function: Numbered | None = None

    @property
    def resolution(self) -> bool:
        """Whether it is a resolution."""
        return self.function is None and self.name in QUANTITIES

    @property
    def header(self) -> str:
        """Name of its column, such as ``sigma_dr at 0.3 GeV/c (um)``."""
        if self.resolution:
            at = "" if self.p is None else f" at {self.p:g} GeV/c"
            return QUANTITIES[self.name].column(end=at)
        if self.function is not None or self.name == COST:
            return self.name
        unit = "%" if self.name in (*OCCUPANCIES, UNSEEN) else GEOMETRY[self.name][0]
        return f"{self.name} ({unit})" if unit else self.name

    @property
    def error_header(self) -> str:
        """Name of the column of its error."""
        name, bracket, unit = self.header.partition(" (")
        return f"{name}_error{bracket}{unit}"


def goal_of(path: str, text: Any, momenta: Sequence[Any], problems: Problems) -> Goal | None:
    """Return the goal that a text stands for; None with a problem if there is none.

    Parameters
    ----------
    path : str
        Where the text stands.
    text : str or callable
        ``"dr"``, ``"dr @ 0.3 GeV/c"``, ``"channels"`` ..., or a function of a `Detector`.
    momenta : sequence of float, GeV/c
        At which resolutions are computed.
    problems : Problems
    """
    known = (*QUANTITIES, *GEOMETRY, *OCCUPANCIES, COST, UNSEEN)
    if callable(text):
        name = str(getattr(text, "__name__", type(text).__name__))
        if name in known:
            problems.note(path, f"a function of the name {name}", "a name that is no goal of its own")
            return None
        return Goal(name, name, function=text)
    if not isinstance(text, str):
        problems.note(path, repr(text), f"a function, or one of {', '.join(known)}")
        return None
    name, at, where = (part.strip() for part in text.partition("@"))
    name = NAMES.get(name, name)
    if name not in known:
        problems.note(path, repr(text), f"one of {', '.join(known)}", did_you_mean(name, known))
        return None
    if not at:
        return Goal(text, name)
    try:
        p = float(where) if where.replace(".", "", 1).isdecimal() else float(parse_quantity(where, "momentum"))
    except QuantityError as error:
        problems.take(error, path)
        return None
    fixed = [one for one in momenta if not isinstance(one, tuple)]
    near = [one for one in fixed if math.isclose(one, p, rel_tol=1e-9)]
    if name not in QUANTITIES or not near:
        listed = ", ".join(f"{one:g}" for one in fixed)
        choice = f"one of p: {listed}" if fixed else "no momentum: p has no fixed values"
        expected = choice if name in QUANTITIES else "no momentum"
        problems.note(path, repr(text), expected)
        return None
    return Goal(text, name, near[0])


def rows_of(goal: Goal, evaluation: Evaluation) -> list[int]:
    """Return the points of an evaluation that count in a goal."""
    return [i for i, gun in enumerate(evaluation.guns) if goal.p in (None, gun.p)]


@dataclass(frozen=True)
class Goals:
    """All goals and limits of an optimization, and how resolutions among them are computed.

    Attributes
    ----------
    goals : tuple of Goal
    evaluation : Evaluation
        Of the resolutions that they name.
    background : Background or None
    prices : tuple of (str, float)
        Numbers of `GEOMETRY` and what one unit of each costs.
    """

    goals: tuple[Goal, ...]
    evaluation: Evaluation
    background: Background | None
    prices: tuple[tuple[str, float], ...] = ()

    @property
    def quantities(self) -> tuple[str, ...]:
        """Resolutions among the goals."""
        return tuple(dict.fromkeys(one.name for one in self.goals if one.resolution))

    def described(self) -> dict[str, Any]:
        """Return all that values depend on, beside the detector, as JSON."""
        description: dict[str, Any] = {"goals": [[one.name, one.p] for one in self.goals]}
        description["background"] = asdict(self.background) if self.background else None
        if self.prices:
            description["prices"] = dict(self.prices)
        if functions := [identity(one.function) for one in self.goals if one.function]:
            description["functions"] = functions
        tracks = self.quantities or any(one.name == UNSEEN for one in self.goals)
        return description | ({"evaluation": self.evaluation.described()} if tracks else {})

    def __call__(self, detector: Detector) -> dict[str, Any]:
        """Return values, errors and the values without each of `GROUPS` groups of tracks, by header.

        Raises
        ------
        ValueError
            If no track reaches the wires or layers that it needs.
        """
        names = self.quantities
        resolutions = self._simulated(detector) if self.evaluation.method == "mc" and names else {}
        if self.evaluation.method == "analytic" and names:
            resolutions = self._analytic(detector)
        values: dict[str, float] = {}
        errors: dict[str, float] = {}
        replicas: dict[str, list[float]] = {}
        for goal in self.goals:
            if not goal.resolution:
                values[goal.header] = self.number(goal, detector)
                continue
            all_points = resolutions[goal.name]
            rows = rows_of(goal, self.evaluation)
            # The first column is the value, the others leave out one group each.
            mean = np.exp(np.log(all_points[rows]).mean(axis=0))
            if not np.isfinite(mean).all():
                raise ValueError(f"{goal.header}: got no covariance, expected momenta that reach the readout")
            values[goal.header], replicas[goal.header] = float(mean[0]), [float(one) for one in mean[1:]]
            errors[goal.header] = jackknife(mean[1:])
        return {"values": values, "errors": errors, "replicas": replicas}

    def results(self, found: Sequence[Any]) -> list[dict[str, Any]]:
        """Return what was found for each detector."""
        return list(found)

    def number(self, goal: Goal, detector: Detector, *, smooth: bool = False) -> float:
        """Return a goal that is no resolution; `smooth`: without rounding to whole strips."""
        if goal.function is not None:
            answer = goal.function(detector)
            if isinstance(answer, bool) or not isinstance(answer, int | float | np.number) or not math.isfinite(answer):
                raise TypeError(f"{goal.name}: got {answer!r:.60}, expected a finite number")
            return float(answer)
        if goal.name in OCCUPANCIES:
            assert self.background is not None  # checked when the goals are made
            return OCCUPANCIES[goal.name](detector, self.background)
        if goal.name == COST:
            return sum(price * _geometry(name, detector, smooth) for name, price in self.prices)
        if goal.name == UNSEEN:
            return float(np.mean(unseen_matter(detector, self.evaluation)))
        return _geometry(goal.name, detector, smooth)

    def _analytic(self, detector: Detector) -> dict[str, Floats]:
        """Return (points, 1 + GROUPS) widths of each resolution in quoted units."""
        expectation = self.evaluation.expectation
        found = expectation.covariance(detector)
        (widths,) = core_widths([found.entries(expectation.mixed)], self.quantities)
        resolutions = {}
        for name, sigma in widths.sigma.items():
            variances = found.variances(name).reshape(len(sigma), -1)
            resolutions[name] = np.array([_replicas(*pair) for pair in zip(sigma, variances, strict=True)])
        return resolutions

    def _simulated(self, detector: Detector) -> dict[str, Floats]:
        simulated = self.evaluation(detector)
        resolutions = {}
        for name in self.quantities:
            pairs = zip(simulated["columns"][QUANTITIES[name].column()], simulated["replicas"], strict=True)
            resolutions[name] = np.array([[sigma, *replicas[name]] for sigma, replicas in pairs])
        return resolutions


def _geometry(name: str, detector: Detector, smooth: bool) -> float:
    _, whole, real = GEOMETRY[name]
    return (real if smooth else whole)(detector)


def _replicas(sigma: float, variances: Floats) -> Floats:
    """Return a core width and its value without each of `GROUPS` groups of samples.

    The change of the RMS stands for the change of the core. Samples are more regular than independent ones, so that
    errors from these groups are upper limits.
    """
    group = np.arange(len(variances)) % GROUPS
    good = np.isfinite(variances)
    total, count = np.bincount(group, np.where(good, variances, 0.0), GROUPS), np.bincount(group, good, GROUPS)
    with np.errstate(invalid="ignore", divide="ignore"):
        left = (total.sum() - total) / (count.sum() - count) / (total.sum() / count.sum())
    left = left if len(variances) >= 2 * GROUPS else np.ones(GROUPS)
    return np.concatenate([[sigma], sigma * np.sqrt(left)])


@dataclass(frozen=True)
class Limit:
    """The range that a number of the design must lie in; a number within 1e-6 of its limit is allowed."""

    goal: Goal
    low: float | None
    high: float | None

    def missed(self, value: float) -> str:
        """Return the text about a value outside."""
        below = self.low is not None and value < self.low
        end = self.low if below else self.high
        side = "below" if below else "above"
        return f"{self.goal.header} {value:.5g}, {100 * self.violation(value):.3g} % {side} its limit {end:.5g}"

    def violation(self, value: float) -> float:
        """Return by how much a value is outside, relative to the limit; negative inside."""
        excesses = []
        if self.high is not None:
            excesses.append((value - self.high) / (abs(self.high) or 1.0))
        if self.low is not None:
            excesses.append((self.low - value) / (abs(self.low) or 1.0))
        return max(excesses)


TOLERANCE = 1e-6


def limits_of(given: Mapping[str, Any], momenta: Sequence[float], problems: Problems) -> tuple[Limit, ...]:
    """Return the limits of constraints; see `optimize`."""
    if not isinstance(given, Mapping):
        problems.note("constraints", repr(given), "a dict of (low, high) by name")
        return ()
    limits = []
    for key, ends in given.items():
        name = getattr(key, "__name__", key)
        goal = goal_of(f"constraints.{name}", key, momenta, problems)
        right = isinstance(ends, tuple | list) and len(ends) == 2 and any(end is not None for end in ends)
        right = right and all(end is None or _is_number(end) for end in ends)
        if right and None not in ends and ends[0] > ends[1]:
            problems.note(f"constraints.{name}", repr(ends), "the lower limit first")
        elif not right:
            problems.note(f"constraints.{name}", repr(ends), "(low, high), numbers in the unit of the quantity or None")
        elif goal is not None:
            limits.append(Limit(goal, ends[0], ends[1]))
    return tuple(limits)


def prices_of(given: Any, problems: Problems) -> tuple[tuple[str, float], ...]:
    """Return the prices of units of `GEOMETRY`, sorted; see `optimize`."""
    if not isinstance(given, Mapping):
        problems.note("prices", repr(given), "a dict of prices by name")
        return ()
    for name, price in given.items():
        if name not in GEOMETRY:
            problems.note(f"prices.{name}", repr(price), f"prices of {', '.join(GEOMETRY)}")
        elif not _is_number(price):
            problems.note(f"prices.{name}", repr(price), "a number, the price of one unit")
    return tuple(sorted((str(name), price) for name, price in given.items()))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


#: Text that stands for the allowed range of a number.
BOUNDS = "bounds"
_EXPECTED = f"(low, high) of one dimension, a list to choose from, or {BOUNDS!r}"


@dataclass(frozen=True)
class Variable:
    """One key of the detector file that is varied.

    Attributes
    ----------
    key : str
        Dotted key, which may be a pattern.
    low, high : float
        Its range in `unit`.
    before : str
        ``"x"``: a factor; ``"%"``: a change in percent; else an absolute value.
    unit : str
    whole : bool
        Whether it is a whole number.
    choices : tuple
        Values to choose from, instead of a range.
    """

    key: str
    low: float = 0.0
    high: float = 0.0
    before: str = ""
    unit: str = ""
    whole: bool = False
    choices: tuple[Any, ...] = ()

    @property
    def header(self) -> str:
        """Return the name of its column, such as ``cgem.L2.pitch_x (um)``."""
        unit = {"x": "times", "%": "change in %"}.get(self.before, self.unit)
        return f"{self.key} ({unit})" if unit else self.key

    @property
    def continuous(self) -> bool:
        """Whether it has a derivative."""
        return not self.whole and not self.choices

    def change(self, value: Any) -> Any:
        """Return a value as the detector file takes it."""
        if not self.continuous:
            return int(value) if self.whole else value
        if self.before == "%":
            return f"{value:+.8g} %"
        # Eight digits: enough for any design, short enough for a name.
        return f"{self.before}{value:.8g} {self.unit}".strip() if self.before or self.unit else float(f"{value:.8g}")

    def relative(self, value: float) -> float:
        """Return the derivative of the logarithm of the detector's number by the variable."""
        return 1 / (100 + value) if self.before == "%" else 1 / value

    def own(self, base: Detector) -> Any:
        """Return the base's own value, among numbers NaN and among texts an empty one if it has several or none."""
        if self.choices:
            numbers = all(isinstance(one, int | float) for one in self.choices)
            other = own_value(self.key, base, "") if numbers else own_text(self.key, base)
            return next((one for one in self.choices if _keeps(base, {self.key: one})), other)
        own = {"x": 1.0, "%": 0.0}[self.before] if self.before else own_value(self.key, base, self.unit)
        return round(own) if self.whole and math.isfinite(own) else own

    def start(self, base: Detector) -> Any:
        """Return the base's own value if it is allowed, else the middle of the range or the first choice."""
        own = self.own(base)
        if self.choices:
            return own if own in self.choices else self.choices[0]
        value = own if self.low <= own <= self.high else 0.5 * (self.low + self.high)
        return round(value) if self.whole else float(value)


def _keeps(base: Detector, changes: Changes) -> bool:
    """Return whether changes leave a detector as it is."""
    try:
        return base.with_overrides(dict(changes)).content_hash == base.content_hash
    except DetectorError:
        return False


def changes_of(variables: Sequence[Variable], values: Sequence[Any]) -> Changes:
    """Return what the variables change with some values."""
    return {one.key: one.change(value) for one, value in zip(variables, values, strict=True)}


def variables_of(base: Detector, space: Mapping[str, Any], problems: Problems) -> tuple[Variable, ...]:
    """Return the variables of a space.

    Parameters
    ----------
    base : Detector
    space : mapping of str to (low, high), list or "bounds"
        By dotted key of the detector file.
    problems : Problems
        Receives every problem.
    """
    if not isinstance(space, Mapping) or not space:
        problems.note("space", repr(space), f"keys of the detector file with {_EXPECTED}")
        return ()
    found = [_variable(base, key, given, problems) for key, given in space.items()]
    return tuple(one for one in found if one is not None)


def _variable(base: Detector, key: str, given: Any, problems: Problems) -> Variable | None:
    try:
        variable = _parsed(base, key, given)
        if variable is None:
            problems.note(key, repr(given), _EXPECTED)
            return None
        base.with_overrides({key: variable.change(variable.start(base))})
        # Several absolute values become one when they are varied; elsewhere a wrong value only shows at the ends.
        return variable
    except DetectorError as error:
        problems.take(error)
    except WrongValueError as error:
        problems.take(error, key)
    return None


def _parsed(base: Detector, key: str, given: Any) -> Variable | None:
    if given == BOUNDS:
        low, high = base.bounds(key)
        kind = next(one[1].kind for one in values_at(base, key, []) if one is not None)
        return Variable(key, low, high, unit=NATIVE.get(kind, ""), whole=kind == "integer")
    if isinstance(given, list) and given:
        return Variable(key, choices=tuple(given))
    if not isinstance(given, tuple) or len(given) != 2:
        return None
    ends = split_range(*given)
    if ends is None:
        return None
    if ends[1] >= ends[2]:
        expected = "two different ends" if ends[1] == ends[2] else "the lower end first"
        raise WrongValueError(repr(given), expected)
    before, low, high, unit = ends
    whole = all(is_whole(end, -(10**9), 10**9) for end in given) and _is_integer(base, key)
    return Variable(key, low, high, before, unit, whole)


def _is_integer(base: Detector, key: str) -> bool:
    return all(one is not None and one[1].kind == "integer" for one in values_at(base, key, []))
