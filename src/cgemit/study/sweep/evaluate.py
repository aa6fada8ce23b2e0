"""What a sweep computes for one detector: analytic resolutions, simulated ones, or a function of the user."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit.analysis.quantities import ABSOLUTE, NAMES, QUANTITIES, REPORTED
from cgemit.analysis.widths import GROUPS, core_sigma, measure, without_groups
from cgemit.base.errors import Problems, WrongValueError
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Listed, Whole, is_whole
from cgemit.chain import run
from cgemit.chain.settings import Settings, fit_settings
from cgemit.covariance.analytic import covariance_at, entries_at
from cgemit.covariance.result import Budget, Covariance, Entries, Widths, core_widths
from cgemit.covariance.tracks import MOST_SAMPLES, Points, points_of
from cgemit.detector import Detector
from cgemit.particles.gun import Gun
from cgemit.particles.species import species
from cgemit.particles.table import FASTEST
from cgemit.reconstruction.fit import FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.study.samples import seed_of
from cgemit.tables.schema import FitStatus
from cgemit.truth.match import measuring

#: Resolutions that are computed by default.
SWEPT = tuple(name for name in ABSOLUTE if name in REPORTED)

#: Matter whose radiation the fit of electrons does not see, %: sum of `Losses.effective`.
UNSEEN = "unseen_x0"
_UNSEEN = f"{UNSEEN} (%)"  # the column
_ELECTRON = 11  # PDG number

#: What the user's own function is.
Function = Callable[[Detector], Mapping[str, Any]]

CosTheta = float | tuple[float, float]


Momenta = Annotated[Any, Listed("momentum", 0, FASTEST, above=True)]
Angles = Annotated[Any, Listed("dimensionless", -1, 1, ranges=True)]
Events = Annotated[int, Whole(1, 2**31 - 1)]
Seed = Annotated[int, Whole(0, 2**64 - 1)]
Samples = Annotated[int, Whole(1, MOST_SAMPLES)]
Variants = Annotated[int, Whole(1, 1_000_000)]
if TYPE_CHECKING:
    Resolution = str
else:
    Resolution = Literal[tuple(NAMES)]


@dataclass(frozen=True)
class Evaluation(SettingsData):
    """What is computed for every variant, the same for all; the table ``[evaluate]`` of a plan.

    Attributes
    ----------
    method : "analytic", "mc" or callable
        Resolutions from the covariance; resolutions of simulated tracks, with the same random numbers for every
        variant and the paired error of the difference to the base; or a function of a `Detector` that returns a dict
        of numbers (in a file ``"FILE.py:FUNCTION"``, relative to the plan).
    particle : str or int
        Name or PDG number.
    p : float or list of float, GeV/c
        Momenta; in text, as on the command line, ``"A,B,C"`` or ``"A:B:COUNT"``.
    cos_theta : float, (float, float), or list of these
        A pair is a uniform range, in text ``"A:B"``.
    events : int
        "mc": simulated events for each variant, momentum and angle.
    seed : int
        Seed of the simulation.
    quantities : list of str
        Resolutions to be computed: p, pt, dr, dz, phi0, theta, tanl.
    samples : int or None
        "analytic": tracks that are averaged at each point (`cgemit.analytic`).
    chunk : int or None
        Variants in one chunk.
    settings : Settings or None
        Settings of all stages, in a file the table ``[settings]``; "analytic" uses digitize and fit.

    Raises
    ------
    SettingsError
        Listing every problem.

    Examples
    --------
    >>> evaluation = cg.study.Evaluation(p=[0.3, 1.0], quantities=["d_rho", "p"])
    >>> evaluation.method, evaluation.quantities
    ('analytic', ('dr', 'p'))
    """

    method: Literal["analytic", "mc"] | Function = "analytic"
    _: KW_ONLY
    particle: str | int = "mu-"
    p: Momenta = 1.0
    cos_theta: Angles = 0.0
    events: Events = 2000
    seed: Seed = 1
    quantities: tuple[Resolution, ...] = SWEPT
    samples: Samples | None = None
    chunk: Variants | None = None
    settings: Settings | None = None

    def contradictions(self, problems: Problems) -> None:
        """Note a particle that leaves no track, and an evaluation of nothing."""
        if isinstance(self.particle, str | int):
            try:
                if species(self.particle).charge == 0:
                    problems.note("particle", repr(self.particle), "a charged particle")
            except WrongValueError as error:
                problems.take(error, "particle")
        if isinstance(self.quantities, tuple):
            names = tuple(NAMES.get(str(name), name) for name in self.quantities)
            object.__setattr__(self, "quantities", names)
        if self.quantities == ():
            problems.note("quantities", "none", f"some of {', '.join(QUANTITIES)}")

    @property
    def function(self) -> Function | None:
        """The function of a `Detector`, if that is the method."""
        return self.method if callable(self.method) else None

    @property
    def kind(self) -> str:
        """Name of the method; ``"function"`` for any function."""
        return "function" if callable(self.method) else self.method

    def described(self) -> dict[str, Any]:
        """Return all that results depend on, beside the detector, as JSON."""
        if self.function is not None:
            return {"method": "function", "function": identity(self.function)}
        description: dict[str, Any] = {"method": self.method, "particle": self.particle, "points": self.points()}
        description |= {"settings": (self.settings or Settings()).to_dict(), "quantities": self.quantities}
        simulated = {"events": self.events, "seed": self.seed, "groups": GROUPS}
        return description | (simulated if self.method == "mc" else {"samples": self.samples})

    def points(self) -> list[dict[str, Any]]:
        """Return momentum and angle of every point; one point without them for a function."""
        if callable(self.method):
            return [{}]
        as_text = any(isinstance(one, tuple) for one in self.cos_theta)
        angles = [_text(one) if as_text else float(one) for one in self.cos_theta]
        return [{"p (GeV/c)": float(p), "cos_theta": one} for p in self.p for one in angles]

    @cached_property
    def points_by_angle(self) -> list[Points]:
        """Return all momenta at each cos(theta), for `covariance_at`."""
        p = np.array(self.p, np.float64)
        return [points_of(self.particle, p, one, samples=self.samples) for one in self.cos_theta]

    @cached_property
    def digitize_and_fit(self) -> tuple[DigitizeSettings, FitSettings]:
        """Return the readout and what the fit assumes."""
        settings = self.settings or Settings()
        return settings.digitize, fit_settings(settings)

    @cached_property
    def counts_radiation(self) -> bool:
        """Whether `UNSEEN` is among the results: of electrons at fixed angles, with "analytic"."""
        fit = self.digitize_and_fit[1]
        return (
            self.method == "analytic"
            and abs(species(self.particle).pdg) == _ELECTRON
            and not any(isinstance(one, tuple) for one in self.cos_theta)
            and (fit.loss, fit.radiation, fit.matter, fit.start_radius) == ("truncated", True, True, 0.0)
        )

    def __call__(self, detector: Detector) -> Any:
        """Return what `results` takes: of "analytic" the covariances for each cos(theta), else the results."""
        if self.function is not None:
            return {"columns": {name: [value] for name, value in numbers_of(self.function(detector)).items()}}
        if self.method == "analytic":
            return _Expected(
                [entries_at(points, detector, *self.digitize_and_fit) for points in self.points_by_angle],
                unseen_matter(detector, self) if self.counts_radiation else None,
            )
        pairs = [(p, c) for p in self.p for c in self.cos_theta]
        found = [_simulated(detector, self, number, p, c) for number, (p, c) in enumerate(pairs, start=1)]
        columns = {name: [point[name] for point, _ in found] for name in found[0][0]}
        return {"columns": columns, "replicas": [replicas for _, replicas in found]}

    def results(self, found: Sequence[Any]) -> list[dict[str, Any]]:
        """Return `columns` with a value for every point, and of "mc" what errors of differences follow from."""
        return _analytic_results(found, self) if self.method == "analytic" else list(found)


def _text(cos_theta: CosTheta) -> str:
    return f"{cos_theta[0]:g}:{cos_theta[1]:g}" if isinstance(cos_theta, tuple) else f"{cos_theta:g}"


class _Expected(NamedTuple):
    """Covariances of a detector for each cos(theta), and its unseen matter there, %, (momenta,) each."""

    entries: list[Entries]
    unseen: list[npt.NDArray[np.float64]] | None


def unseen_matter(detector: Detector, evaluation: Evaluation) -> list[npt.NDArray[np.float64]]:
    """Return the radiation lengths whose losses the fit does not see, %, at all momenta for each cos(theta)."""
    return [100 * one.losses().effective.sum(axis=1) for one in covariances(detector, evaluation)]


def result_columns(method: str, quantities: Sequence[str], radiation: bool = False) -> tuple[str, ...]:
    """Return the columns of numbers that "analytic" or "mc" makes of some resolutions.

    `radiation`: whether `UNSEEN` is among them, `Evaluation.counts_radiation`.
    """
    known = [QUANTITIES[name] for name in quantities]
    sigmas = [one.column() for one in known]
    if method == "analytic":
        return (*sigmas, *((_UNSEEN,) if radiation else ()), "reached")
    ends = (("sigma", "_error"), ("delta_sigma", ""), ("delta_sigma", "_error"))
    more = [one.column(kind, end) for one in known for kind, end in ends]
    return ("fitted", "events", *sigmas, *more)


def covariances(detector: Detector, evaluation: Evaluation) -> list[Covariance]:
    """Return the covariances at all momenta for each cos(theta)."""
    digitize, fit = evaluation.digitize_and_fit
    return [covariance_at(points, detector, digitize, fit, threads=1) for points in evaluation.points_by_angle]


def _analytic_results(found: Sequence[_Expected], evaluation: Evaluation) -> list[dict[str, Any]]:
    """Return the core resolutions of every point from the covariances of each detector, without events.

    `reached` is the fraction of tracks with a covariance; `tracks` says how most of the others ended.
    """
    all_entries = zip(*[one.entries for one in found], strict=True)
    by_angle = [core_widths(at_angle, evaluation.quantities) for at_angle in all_entries]
    return [
        {"columns": _columns(widths, one.unseen, evaluation.quantities)}
        for widths, one in zip(zip(*by_angle, strict=True), found, strict=True)
    ]


def _columns(
    widths: Sequence[Widths], unseen: Sequence[npt.NDArray[np.float64]] | None, quantities: Sequence[str]
) -> dict[str, list[Any]]:
    """Return the columns of one detector from its resolutions and its unseen matter for each cos(theta)."""
    columns: dict[str, list[Any]] = {}
    for name in quantities:
        columns[QUANTITIES[name].column()] = _by_point([one.sigma[name] for one in widths])
    if unseen is not None:
        columns[_UNSEEN] = _by_point(unseen)
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
    if evaluation.function or not is_whole(point, 0, len(points) - 1) or quantity not in NAMES:
        raise ValueError(
            f"budgets: got {quantity!r} at point {point} of evaluation {evaluation.kind!r}; expected one of "
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
    point: dict[str, Any] = {"fitted": int(np.count_nonzero(measuring(tracks))), "events": evaluation.events}
    replicas: dict[str, list[float]] = {}
    for name in evaluation.quantities:
        known = QUANTITIES[name]
        good = known.counts(tracks)
        sample, event = known.residual(tracks)[good], tracks["event"][good]
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


@dataclass(frozen=True)
class Evaluated:
    """Stands for a function by its `identity`, to read what it returned before; it cannot be called."""

    identity: str

    def __call__(self, detector: Detector) -> Mapping[str, Any]:
        """Raise an error."""
        raise TypeError(f"{self.identity}: only results that are there can be read")


def identity(function: Callable[[Detector], Any]) -> str:
    """Return what tells a function from others: its module, its name and a hash of its source.

    Values that it refers to are not seen: a sweep is not redone when they change.
    """
    if isinstance(function, Evaluated):
        return function.identity
    try:
        source = inspect.getsource(function)
    except (OSError, TypeError):
        code = getattr(function, "__code__", None)
        source = repr((code.co_code, code.co_consts)) if code else repr(type(function))
    name = f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', type(function).__qualname__)}"
    return f"{name} {hashlib.sha256(source.encode()).hexdigest()[:16]}"
