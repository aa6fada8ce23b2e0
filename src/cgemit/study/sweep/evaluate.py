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

from cgemit.analysis.quantities import ABSOLUTE, KINEMATICS, NAMES, QUANTITIES, REPORTED
from cgemit.analysis.widths import GROUPS
from cgemit.base.errors import Problems, WrongValueError
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Values, Whole, is_whole
from cgemit.chain.settings import Settings
from cgemit.covariance.result import Budget, Entries, core_widths
from cgemit.covariance.tracks import MOST_SAMPLES
from cgemit.detector import Detector
from cgemit.particles.gun import Gun
from cgemit.particles.species import species
from cgemit.study.evaluation import (
    MOMENTA,
    POLAR,
    READERS,
    Expectation,
    Row,
    guns_of,
    kinematic_columns,
    points_at,
    simulated,
)
from cgemit.tables.schema import FitStatus

#: Resolutions that are computed by default.
SWEPT = tuple(name for name in ABSOLUTE if name in REPORTED)

#: Matter whose radiation the fit of electrons does not see, %: sum of `Losses.effective`.
UNSEEN = "unseen_x0"
_UNSEEN = f"{UNSEEN} (%)"  # the column
_ELECTRON = 11  # PDG number

#: What the user's own function is.
Function = Callable[[Detector], Mapping[str, Any]]

Momenta = Annotated[Any, READERS["p"]] | None
Cosines = Annotated[Any, READERS["cos_theta"]] | None
Polar = Annotated[Any, READERS["theta"]] | None
Rapidities = Annotated[Any, READERS["eta"]] | None
Azimuths = Annotated[Any, READERS["phi"]] | None
Distances = Annotated[Any, READERS["d"]] | None
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
    p, pt : float, (float, float), or list of these, GeV/c
        Momenta or transverse momenta, one of them; a pair is a uniform range. In text, as on the command line,
        ``"A,B,C"`` or ``"A:B:COUNT"``, and a range ``"A:B"``. Default: p of 1 GeV/c.
    cos_theta, theta, eta : float, (float, float), or list of these
        Cosine of the polar angle, polar angle (rad) or pseudorapidity, one of them, likewise. Default: a cosine of 0.
    phi : float, (float, float), or list of these, rad
        Azimuth of the momentum. Default: all.
    d : float, (float, float), or list of these, mm
        Tracks begin at (d, 0, 0). "mc" only, as ranges of `pt` and `phi`.
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
    p: Momenta = None
    pt: Momenta = None
    cos_theta: Cosines = None
    theta: Polar = None
    eta: Rapidities = None
    phi: Azimuths = None
    d: Distances = None
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
        for names, usual in ((MOMENTA, 1.0), (POLAR, 0.0)):
            given = [name for name in names if getattr(self, name) is not None]
            if len(given) > 1:
                problems.note(", ".join(names), " and ".join(given), "one of them")
            elif not given:
                object.__setattr__(self, names[0], Values([usual]))
        if not problems and not callable(self.method):
            problems.collect(self._tried)

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

    @cached_property
    def guns(self) -> list[Gun]:
        """What is shot at every point: momenta change slowest, then angles."""
        given = {name: getattr(self, name) for name in KINEMATICS}
        return guns_of(self.particle, {name: values for name, values in given.items() if values is not None})

    def points(self) -> list[dict[str, Any]]:
        """Return momentum and angle of every point; one point without them for a function."""
        if callable(self.method):
            return [{}]
        columns = kinematic_columns(self.guns)
        return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]

    @cached_property
    def expectation(self) -> Expectation:
        """All points as "analytic" expects them."""
        return Expectation.of(self.guns, self.settings or Settings(), self.samples)

    def _tried(self) -> None:
        """Raise an error where guns, or the analytic method, cannot have what is given."""
        _ = self.expectation if self.method == "analytic" else self.guns

    @property
    def has_ranges(self) -> bool:
        """Whether tracks of a point have several momenta or polar angles."""
        given = [getattr(self, name) or () for name in (*MOMENTA, *POLAR)]
        return any(isinstance(one, tuple) for values in given for one in values)

    @cached_property
    def counts_radiation(self) -> bool:
        """Whether `UNSEEN` is among the results: of electrons at fixed angles, with "analytic"."""
        fit = (self.settings or Settings()).fit
        return (
            self.method == "analytic"
            and abs(species(self.particle).pdg) == _ELECTRON
            and not self.has_ranges
            and (fit.loss, fit.radiation, fit.matter, fit.start_radius) == ("truncated", True, True, 0.0)
        )

    def __call__(self, detector: Detector) -> Any:
        """Return what `results` takes: of "analytic" the covariances at all points, else the results."""
        if self.function is not None:
            return {"columns": {name: [value] for name, value in numbers_of(self.function(detector)).items()}}
        if self.method == "analytic":
            unseen = unseen_matter(detector, self) if self.counts_radiation else None
            return _Expected(self.expectation.entries(detector), unseen)
        how: dict[str, Any] = {"events": self.events, "seed": self.seed, "settings": self.settings}
        points = points_at([detector] * len(self.guns), self.guns, **how)
        return _simulated([Row(**simulated(point, threads=1)[1]) for point in points], self.quantities)

    def results(self, found: Sequence[Any]) -> list[dict[str, Any]]:
        """Return `columns` with a value for every point, and of "mc" what errors of differences follow from."""
        return _expected(found, self.quantities) if self.method == "analytic" else list(found)


class _Expected(NamedTuple):
    """Covariances of a detector at all points, and its unseen matter there, %."""

    entries: Entries
    unseen: npt.NDArray[np.float64] | None


def unseen_matter(detector: Detector, evaluation: Evaluation) -> npt.NDArray[np.float64]:
    """Return the radiation lengths whose losses the fit does not see, %, at all points."""
    return np.asarray(100 * evaluation.expectation.covariance(detector).losses().effective.sum(axis=1))


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


def _expected(found: Sequence[_Expected], quantities: Sequence[str]) -> list[dict[str, Any]]:
    """Return the core resolutions of every point from the covariances of each detector, without events.

    `reached` is the fraction of tracks with a covariance; `tracks` says how most of the others ended.
    """
    results = []
    for widths, one in zip(core_widths([one.entries for one in found], quantities), found, strict=True):
        columns: dict[str, list[Any]] = {QUANTITIES[name].column(): widths.sigma[name].tolist() for name in quantities}
        if one.unseen is not None:
            columns[_UNSEEN] = one.unseen.tolist()
        columns |= {"reached": widths.reached.tolist()}
        results.append({"columns": columns | {"tracks": [FitStatus(status).name for status in widths.status]}})
    return results


def _simulated(rows: Sequence[Row], quantities: Sequence[str]) -> dict[str, Any]:
    """Return resolutions of every point, and each without one of `GROUPS` groups of events."""
    columns: dict[str, list[Any]] = {"fitted": [row.fitted for row in rows], "events": [row.n_events for row in rows]}
    every = [row.columns_of(quantities, ("sigma",)) for row in rows]
    columns |= {name: [one[name] for one in every] for name in every[0]}
    replicas = [{name: row.without_groups(name)[1].tolist() for name in quantities} for row in rows]
    return {"columns": columns, "replicas": replicas}


def budgets(evaluation: Evaluation, detectors: Mapping[str, Detector], quantity: str, point: int) -> dict[str, Budget]:
    """Return the error budget of a resolution for each of some detectors at one point of an evaluation.

    Raises
    ------
    ValueError
        If the evaluation was a function, or there is no such point or quantity.
    """
    points = len(evaluation.guns)
    if evaluation.function or not is_whole(point, 0, points - 1) or quantity not in NAMES:
        raise ValueError(
            f"budgets: got {quantity!r} at point {point} of evaluation {evaluation.kind!r}; expected one of "
            f"{', '.join(QUANTITIES)}, a point below {points}, and an evaluation of resolutions"
        )
    expectation = Expectation.of([evaluation.guns[point]], evaluation.settings or Settings(), evaluation.samples)
    return {name: expectation.covariance(one).budget(quantity) for name, one in detectors.items()}


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
