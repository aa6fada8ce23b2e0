"""What a sweep computes for one detector: analytic resolutions, simulated ones, or a function of the user."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit.analysis.quantities import ABSOLUTE, NAMES, QUANTITIES, REPORTED
from cgemit.analysis.widths import GROUPS, core_sigma, measure, without_groups
from cgemit.chain import run
from cgemit.chain.settings import Settings, fit_settings
from cgemit.covariance.analytic import covariance_at, entries_at
from cgemit.covariance.result import Budget, Covariance, Entries, Widths, core_widths
from cgemit.covariance.tracks import Points, points_of
from cgemit.detector import Detector
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import FitSettings, FitStatus
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.study.samples import seed_of

#: Resolutions that are computed by default.
SWEPT = tuple(name for name in ABSOLUTE if name in REPORTED)

#: What the user's own function is.
Function = Callable[[Detector], Mapping[str, Any]]

CosTheta = float | tuple[float, float]


@dataclass(frozen=True)
class Evaluation:
    """What is computed for every variant, the same for all.

    Attributes
    ----------
    method : "analytic", "mc" or "function"
    particle : str or int
    p : tuple of float, GeV/c
    cos_theta : tuple of float or (float, float)
        Values or uniform ranges.
    events, seed : int
        Of "mc", for each point.
    settings : Settings or None
    function : callable or None
    quantities : tuple of str
        Resolutions, of `QUANTITIES`.
    samples : int or None
        Of "analytic": tracks that are averaged at each point.
    """

    method: Literal["analytic", "mc", "function"]
    particle: str | int
    p: tuple[float, ...]
    cos_theta: tuple[CosTheta, ...]
    events: int
    seed: int
    settings: Settings | None
    function: Function | None
    quantities: tuple[str, ...]
    samples: int | None

    def described(self) -> dict[str, Any]:
        """Return all that results depend on, beside the detector, as JSON."""
        if self.function is not None:
            return {"method": self.method, "function": identity(self.function)}
        found: dict[str, Any] = {"method": self.method, "particle": self.particle, "points": self.points()}
        found |= {"settings": (self.settings or Settings()).to_dict(), "quantities": self.quantities}
        simulated = {"events": self.events, "seed": self.seed, "groups": GROUPS}
        return found | (simulated if self.method == "mc" else {"samples": self.samples})

    def points(self) -> list[dict[str, Any]]:
        """Return momentum and angle of every point; one point without them for a function."""
        if self.method == "function":
            return [{}]
        as_text = any(isinstance(one, tuple) for one in self.cos_theta)
        angles = [_text(one) if as_text else float(one) for one in self.cos_theta]  # type: ignore[arg-type]
        return [{"p (GeV/c)": float(p), "cos_theta": one} for p in self.p for one in angles]

    @cached_property
    def points_by_angle(self) -> list[Points]:
        """Return all momenta at each cos(theta), for `covariance_at`."""
        p = np.array(self.p, np.float64)
        return [points_of(self.particle, p, one, samples=self.samples) for one in self.cos_theta]

    @cached_property
    def digitize_and_fit(self) -> tuple[DigitizeSettings, FitSettings]:
        """Return the read-out and what the fit assumes."""
        settings = self.settings or Settings()
        return settings.digitize, fit_settings(settings)

    def __call__(self, detector: Detector) -> Any:
        """Return what `results` takes: of "analytic" the covariances for each cos(theta), else the results."""
        if self.function is not None:
            return {"columns": {name: [value] for name, value in numbers_of(self.function(detector)).items()}}
        if self.method == "analytic":
            return [entries_at(points, detector, *self.digitize_and_fit) for points in self.points_by_angle]
        pairs = [(p, c) for p in self.p for c in self.cos_theta]
        found = [_simulated(detector, self, number, p, c) for number, (p, c) in enumerate(pairs, start=1)]
        columns = {name: [point[name] for point, _ in found] for name in found[0][0]}
        return {"columns": columns, "replicas": [replicas for _, replicas in found]}

    def results(self, found: Sequence[Any]) -> list[dict[str, Any]]:
        """Return `columns` with a value for every point, and of "mc" what errors of differences follow from."""
        return _analytic_results(found, self) if self.method == "analytic" else list(found)


def _text(cos_theta: CosTheta) -> str:
    return f"{cos_theta[0]:g}:{cos_theta[1]:g}" if isinstance(cos_theta, tuple) else f"{cos_theta:g}"


def result_columns(method: str, quantities: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of numbers that "analytic" or "mc" makes of some resolutions."""
    known = [QUANTITIES[name] for name in quantities]
    sigmas = [one.column() for one in known]
    if method == "analytic":
        return (*sigmas, "reached")
    ends = (("sigma", "_error"), ("delta_sigma", ""), ("delta_sigma", "_error"))
    more = [one.column(kind, end) for one in known for kind, end in ends]
    return ("fitted", "events", *sigmas, *more)


def covariances(detector: Detector, evaluation: Evaluation) -> list[Covariance]:
    """Return the covariances at all momenta for each cos(theta)."""
    digitize, fit = evaluation.digitize_and_fit
    return [covariance_at(points, detector, digitize, fit, threads=1) for points in evaluation.points_by_angle]


def _analytic_results(found: Sequence[Sequence[Entries]], evaluation: Evaluation) -> list[dict[str, Any]]:
    """Return the core resolutions of every point from the covariances of each detector, without events.

    `reached` is the fraction of tracks with a covariance; `tracks` says how most of the others ended.
    """
    by_angle = [core_widths(at_angle, evaluation.quantities) for at_angle in zip(*found, strict=True)]
    return [{"columns": _columns(widths, evaluation.quantities)} for widths in zip(*by_angle, strict=True)]


def _columns(widths: Sequence[Widths], quantities: Sequence[str]) -> dict[str, list[Any]]:
    """Return the columns of one detector from its resolutions for each cos(theta)."""
    columns: dict[str, list[Any]] = {}
    for name in quantities:
        columns[QUANTITIES[name].column()] = _by_point([one.sigma[name] for one in widths])
    columns["reached"] = _by_point([one.reached for one in widths])
    columns["tracks"] = [FitStatus(status).name for status in _by_point([one.status for one in widths])]
    return columns


def _by_point(by_angle: Sequence[npt.NDArray[Any]]) -> list[Any]:
    """Return values at all momenta for each angle, (momenta,) each, in the order of `Evaluation.points`."""
    return [value for values in zip(*[one.tolist() for one in by_angle], strict=True) for value in values]


def budgets(evaluation: Evaluation, detectors: Mapping[str, Detector], quantity: str, point: int) -> dict[str, Budget]:
    """Return the error budget of a resolution for each of some detectors at one point of an evaluation.

    Raises
    ------
    ValueError
        If the evaluation was a function, or there is no such point or quantity.
    """
    points = [(p, one) for p in evaluation.p for one in evaluation.cos_theta]
    if evaluation.method == "function" or not 0 <= point < len(points) or quantity not in NAMES:
        raise ValueError(
            f"budgets: got {quantity!r} at point {point} of evaluation {evaluation.method!r}; expected one of "
            f"{', '.join(QUANTITIES)}, a point below {len(points)}, and an evaluation of resolutions"
        )
    p, cos_theta = points[point]
    asked = points_of(evaluation.particle, p, cos_theta, samples=evaluation.samples)
    how = (*evaluation.digitize_and_fit, 1)
    return {name: covariance_at(asked, one, *how).budget(quantity) for name, one in detectors.items()}


def _simulated(
    detector: Detector, evaluation: Evaluation, number: int, p: float, cos_theta: CosTheta
) -> tuple[dict[str, Any], dict[str, list[float]]]:
    """Return resolutions of one point, and each without one of `GROUPS` groups of events.

    Point `number` has the same random numbers for every variant.
    """
    gun = Gun(evaluation.particle, p=p, cos_theta=cos_theta)
    seed = seed_of(evaluation.seed, number)
    tracks = run.run(detector, gun, evaluation.events, seed, settings=evaluation.settings, workers=1).tracks
    good = tracks["status"] == FitStatus.ok
    event = tracks["event"][good]
    point: dict[str, Any] = {"fitted": int(good.sum()), "events": evaluation.events}
    replicas: dict[str, list[float]] = {}
    for name in evaluation.quantities:
        known = QUANTITIES[name]
        sample = known.residual(tracks)[good]
        width = measure(sample)
        point[known.column()], point[known.column(end="_error")] = width.core, width.core_error
        replicas[name] = without_groups(sample, event, core_sigma).tolist()
    return point, replicas


def numbers_of(found: object) -> dict[str, Any]:
    """Return what a user's function returned as plain numbers.

    Raises
    ------
    TypeError
        If it is no mapping of names to numbers, truth values or texts.
    """
    if not isinstance(found, Mapping):
        raise TypeError(f"got {type(found).__name__}, expected a dict of numbers by name")
    plain = {str(key): value.item() if isinstance(value, np.generic) else value for key, value in found.items()}
    wrong = [f"{key}: {value!r:.40}" for key, value in plain.items() if not isinstance(value, bool | int | float | str)]
    if wrong:
        raise TypeError(f"got {', '.join(wrong)}, expected numbers")
    return plain


def identity(function: Function) -> str:
    """Return what tells a function from others: its module, its name and a hash of its source.

    Values that it refers to are not seen: a sweep is not redone when they change.
    """
    try:
        source = inspect.getsource(function)
    except (OSError, TypeError):
        code = getattr(function, "__code__", None)
        source = repr((code.co_code, code.co_consts)) if code else repr(type(function))
    name = f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', type(function).__qualname__)}"
    return f"{name} {hashlib.sha256(source.encode()).hexdigest()[:16]}"
