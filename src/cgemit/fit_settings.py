"""Settings of the track fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cgemit.detector import SCREENINGS
from cgemit.particles import HYPOTHESES
from cgemit.states import place_problems
from cgemit.values import POSITIVE, Fit, is_whole, number, setting_problems

ERRORS = ("track", "cluster")
LOSSES = ("truncated", "mean", "most_probable")

_MOST = 2**31 - 1  # iterations, of the core's whole number
_LEAST_PRIOR = 1e-12
_NUMBERS: dict[str, Fit] = {
    "tolerance": POSITIVE,
    "least_width": POSITIVE,
    "delta_strips": (lambda value: 0 <= value < 1, "0 or a probability below 1"),
    "outlier_pull": (lambda value: value == 0 or 2 <= value < math.inf, "0 or at least 2 standard deviations"),
}


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """How tracks are fitted.

    Attributes
    ----------
    cluster_errors : str
        ``"track"``: from the number of strips and the incidence of the track. ``"cluster"``: as in the clusters
        table, from the number of strips and the layer alone.
    screening : str or None
        Screening of nuclei in multiple scattering (``SimulateSettings.screening``). None: what was simulated, or
        ``"wentzel"`` where the fit does not know.
    loss : str
        Energy loss subtracted, with its variance (docs/methods/matter.md). ``"truncated"``: of the collisions that the
        core of a momentum measurement holds. ``"mean"``: of all. ``"most_probable"``: Landau's most probable loss, and
        the Gaussian as wide as his distribution at half maximum.
    residuals : bool
        Whether the residuals table is made: every hit against the track fitted without it, outliers too.
    states : tuple of float or str
        Where the states table gives track and covariance, in any field: radii in mm, ``"origin"``, ``"beam_line"``
        (closest approach), ``"beam_pipe"`` (inner surface), ``"hits"`` (every measurement). Empty: no such table.
    hypothesis : str, tuple of str or None
        Particles whose masses the fit assumes, ``"e"``, ``"mu"``, ``"pi"``, ``"K"``, ``"p"``, or ``"all"`` five: every
        candidate gets a track for each, in this order. None: one track, with the candidate's own mass.
    max_iterations : int
    tolerance : float
        The fit has converged when no parameter moves by more than this many of its standard deviations.
    least_width : float
        Least spread, in strip pitches, of the position that a cluster's size allows; it stands for the error of the
        track's incidence, so that a narrow allowed interval is not taken for a perfect measurement.
    delta_strips : float
        Probability that a delta electron adds one strip to a cluster; k strips are k times less probable. It says how
        much a cluster is worth that is longer than the track makes likely. 0: there are no delta electrons.
    kinks : bool
        Whether the reference about which a slow track is fitted is scattered at every layer as its hits show, instead
        of a helix that only loses energy. What is linear in the angles is then so about the track as it flew.
    outlier_pull : float
        A hit is left out where it lies this many standard deviations from the track fitted without it, the farthest
        first, and taken back where it does not any more. 0: every hit is used.
    prior_sigma : tuple of float
        Standard deviations of (dr mm, phi0 rad, kappa (GeV/c)^-1, dz mm, tanl) that the filter begins with.

    Raises
    ------
    ValueError
        Listing every value that makes no sense.
    """

    cluster_errors: str = "track"
    screening: str | None = None
    loss: str = "truncated"
    residuals: bool = False
    states: tuple[float | str, ...] = ()
    hypothesis: str | tuple[str, ...] | None = None
    max_iterations: int = 15
    tolerance: float = 0.1
    least_width: float = 0.1
    delta_strips: float = 0.008
    kinks: bool = True
    outlier_pull: float = 5.0
    prior_sigma: tuple[float, float, float, float, float] = (200.0, 0.5, 5.0, 1000.0, 2.0)

    def __post_init__(self) -> None:
        choices = {"cluster_errors": ERRORS, "screening": (None, *SCREENINGS), "loss": LOSSES}
        problems = setting_problems(self, choices, ("residuals", "kinks"), _NUMBERS)
        if not is_whole(self.max_iterations, 1, _MOST):
            problems.append(f"max_iterations: got {self.max_iterations!r}, expected a whole number from 1 to {_MOST}")
        given: object = self.prior_sigma
        listed = given.tolist() if isinstance(given, np.ndarray) else given
        values = tuple(map(number, listed)) if isinstance(listed, tuple | list) else ()
        if len(values) != 5 or not all(_LEAST_PRIOR <= value < math.inf for value in values):
            problems.append(f"prior_sigma: got {given!r}, expected five numbers, none below {_LEAST_PRIOR:g}")
        object.__setattr__(self, "prior_sigma", values)
        problems += place_problems(self.states)
        problems += _hypothesis_problems(self.hypothesis)
        if problems:
            raise ValueError("FitSettings:\n  " + "\n  ".join(problems))

    def hypotheses(self) -> tuple[str, ...]:
        """Return the names of the particles whose masses are assumed; none for that of each candidate itself."""
        given = () if self.hypothesis is None else self.hypothesis
        names = (given,) if isinstance(given, str) else tuple(given)
        return tuple(HYPOTHESES) if names == ("all",) else names


def _hypothesis_problems(given: object) -> list[str]:
    """Say what is wrong with a name, several names or None."""
    expected = ", ".join(map(repr, (*HYPOTHESES, "all")))
    if given is None:
        return []
    if not isinstance(given, str | tuple | list):
        return [f"hypothesis: got {given!r}, expected None, or one or several of {expected}"]
    names = [given] if isinstance(given, str) else list(given)
    known = (*HYPOTHESES, "all") if len(names) == 1 else tuple(HYPOTHESES)
    right = [name for name in names if isinstance(name, str) and name in known]
    problems = [f"hypothesis: got {name!r}, expected one of {expected}" for name in names if name not in right]
    if len(set(right)) < len(right):
        problems.append(f"hypothesis: got {given!r}, expected each name once")
    return problems
