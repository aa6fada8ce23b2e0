"""What an optimization varies: numbers of the detector file with ranges, and choices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cgemit.covariance.kept_hits import calibrated_apart, errors_do_not_follow
from cgemit.detector import Detector, DetectorError
from cgemit.detector.variants import matching, value_at
from cgemit.digitize import Readout
from cgemit.study.sweeps.axes import own_value
from cgemit.study.sweeps.space import Changes, split_range
from cgemit.units import NATIVE
from cgemit.values import is_whole

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

    def start(self, base: Detector) -> Any:
        """Return the base's own value if it lies in the range, else the middle of the range."""
        if self.choices:
            now = own_value(self.key, base, "")
            return next((one for one in self.choices if one == now), self.choices[0])
        own = {"x": 1.0, "%": 0.0}[self.before] if self.before else own_value(self.key, base, self.unit)
        inside = self.low <= own <= self.high
        value = own if inside else 0.5 * (self.low + self.high)
        return round(value) if self.whole else float(value)


def changes_of(variables: Sequence[Variable], values: Sequence[Any]) -> Changes:
    """Return what the variables change with some values."""
    return {one.key: one.change(value) for one, value in zip(variables, values, strict=True)}


def variables_of(base: Detector, space: Mapping[str, Any], problems: list[str]) -> tuple[Variable, ...]:
    """Return the variables of a space.

    Parameters
    ----------
    base : Detector
    space : mapping of str to (low, high), list or "bounds"
        By dotted key of the detector file.
    problems : list of str
        Receives every problem.
    """
    if not isinstance(space, Mapping) or not space:
        problems.append(f"space: got {space!r}, expected keys of the detector file with {_EXPECTED}")
        return ()
    found = [_variable(base, key, given, problems) for key, given in space.items()]
    return tuple(one for one in found if one is not None)


def _variable(base: Detector, key: str, given: Any, problems: list[str]) -> Variable | None:
    try:
        one = _parsed(base, key, given)
        if one is None:
            problems.append(f"{key}: got {given!r}, expected {_EXPECTED}")
            return None
        base.with_overrides({key: one.change(one.start(base))})
        # Several absolute values become one when they are varied; elsewhere a wrong value only shows at the ends.
        return one
    except DetectorError as error:
        problems += [str(problem) for problem in error.problems]
        return None


def _parsed(base: Detector, key: str, given: Any) -> Variable | None:
    if given == BOUNDS:
        low, high = base.bounds(key)
        path = next(iter(matching(base, key, [])))
        found = value_at(base, path)
        kind = found[1].kind if found else ""
        return Variable(key, low, high, unit=NATIVE.get(kind, ""), whole=kind == "integer")
    if isinstance(given, list) and given:
        return Variable(key, choices=tuple(given))
    if not isinstance(given, tuple) or len(given) != 2:
        return None
    ends = split_range(*given)
    if ends is None or ends[1] >= ends[2]:
        return None
    before, low, high, unit = ends
    whole = all(is_whole(end, -(10**9), 10**9) for end in given) and _is_integer(base, key)
    return Variable(key, low, high, before, unit, whole)


def calibration_problems(base: Detector, variables: Sequence[Variable], readout: Readout) -> list[str]:
    """Return the problem of a read-out whose calibrated errors do not follow what is varied, if there is one.

    Parameters
    ----------
    base : Detector
    variables : sequence of Variable
    readout : Readout
    """
    keys = [one.key for one in variables if calibrated_apart(readout, base, _sample(base, one))]
    if not keys:
        return []
    expected = "expected 'binary' or 'gaussian', or evaluate 'mc' with own calibrations"
    return [f"settings.digitize.readout: {errors_do_not_follow(readout, keys)}; {expected}"]


def _sample(base: Detector, one: Variable) -> Iterator[Detector]:
    """Yield some possible designs with different values of a variable."""
    values = one.choices or (one.low, 0.5 * (one.low + one.high), one.high, one.start(base))
    for value in values:
        try:
            yield base.with_overrides({one.key: one.change(value)})
        except DetectorError:
            continue


def _is_integer(base: Detector, key: str) -> bool:
    paths = [path for part in key.split(",") for path in matching(base, part.strip(), [])]
    found = [value_at(base, path) for path in paths]
    return all(one is not None and one[1].kind == "integer" for one in found)
