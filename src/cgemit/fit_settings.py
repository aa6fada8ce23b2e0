"""Settings of the track fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from cgemit.detector import Screening
from cgemit.kinds import Check, Positive
from cgemit.settings import SettingsData
from cgemit.species import HYPOTHESES, Hypothesis
from cgemit.states import SurfaceName

MassHypothesis = Literal[Hypothesis, "all"]
ClusterErrors = Literal["track", "cluster"]
Loss = Literal["truncated", "mean", "most_probable"]
LOSSES: tuple[Loss, ...] = get_args(Loss)

_MOST = 2**31 - 1  # iterations, of the core's whole number

Iterations = Annotated[int, Check(lambda value: 1 <= value <= _MOST, f"a whole number from 1 to {_MOST}")]
Share = Annotated[float, Check(lambda value: 0 <= value < 1, "0 or a probability below 1")]
Pull = Annotated[float, Check(lambda value: value == 0 or 2 <= value < math.inf, "0 or at least 2 standard deviations")]
Spread = Annotated[float, Check(lambda value: 1e-12 <= value < math.inf, "a number not below 1e-12")]
FiveSpreads = tuple[Spread, Spread, Spread, Spread, Spread]
TimeError = Annotated[float, Check(lambda value: 1e-3 <= value <= 1e3, "a time in ns from 0.001 to 1000")]
_FARTHEST = 1e5  # mm
Start = Annotated[float, Check(lambda value: abs(value) <= _FARTHEST, f"a radius in mm, within +-{_FARTHEST:g}")]
Radius = Annotated[float, Check(lambda value: 0 < value < math.inf, "a positive radius in mm")]


@dataclass(frozen=True, kw_only=True)
class FitSettings(SettingsData):
    """How tracks are fitted.

    Attributes
    ----------
    cluster_errors : str
        ``"track"``: from the number of strips and the incidence of the track. ``"cluster"``: as in the clusters
        table, from the number of strips and the layer alone.
    screening : str or None
        Screening of nuclei in multiple scattering (``SimulateSettings.screening``). None: the simulated one, or
        ``"wentzel"`` without a simulation.
    loss : str
        Energy loss subtracted, with its variance (docs/methods/matter.md). ``"truncated"``: of the collisions within
        the core of a momentum measurement. ``"mean"``: of all collisions. ``"most_probable"``: Landau's most probable
        loss, and the Gaussian as wide as his distribution at half maximum.
    radiation : bool
        Whether the energy loss of electrons and positrons includes bremsstrahlung, mean and variance. False: collisions
        only, as in fits with the electron hypothesis elsewhere (docs/methods/matter.md).
    matter : bool
        Whether tracks scatter and lose energy in the fit. False: helices or tracks in the field alone, as the first
        fits of many experiments assume (BES3's MdcTrack).
    start_radius : float
        Distance from the beam line, mm, at which the particles begin: they have not crossed the matter inside of it,
        unless they flew inward first, which a negative value says; it then counts twice. The helix at the origin
        describes the flight at the begin, continued in vacuum. A column `start_radius` of the candidates, where there
        is one, comes before (`cgemit.helix.start_radius` makes it from vertices; docs/methods/robustness.md).
    residuals : bool
        Whether the fit makes the residuals table: every hit, outliers included, against the track fitted without it.
    states : tuple of float or str
        Surfaces at which the states table gives track and covariance, in any field: radii in mm, ``"origin"``,
        ``"beam_line"`` (closest approach), ``"beam_pipe"`` (inner surface), ``"hits"`` (every measurement). Empty: no
        such table.
    hypothesis : str, tuple of str or None
        Particles whose masses the fit assumes, ``"e"``, ``"mu"``, ``"pi"``, ``"K"``, ``"p"``, or ``"all"`` five: every
        candidate gets a track for each, in this order. None: one track, with the candidate's own mass.
    max_iterations : int
        A fit that has not converged after this many iterations stops.
    tolerance : float
        The fit has converged when no parameter moves by more than this many of its standard deviations.
    least_width : float
        Least spread, in strip pitches, of the position that a cluster's size allows; it accounts for the error of the
        track's incidence. Without it, a narrow allowed interval would count as a perfect measurement.
    delta_strips : float
        Probability that a delta electron adds one strip to a cluster; k strips are k times less probable. Sets the
        weight of clusters that are longer than the incidence predicts. 0: there are no delta electrons.
    kinks : bool
        Whether the reference trajectory of a slow track is scattered at every layer as its hits show, instead of a
        helix that only loses energy. The linearisation then holds around the scattered path.
    outlier_pull : float
        A hit this many standard deviations from the track fitted without it is left out, the farthest first, and taken
        back once it is closer. 0: every hit is used.
    prior_sigma : tuple of float
        Standard deviations of (dr mm, phi0 rad, kappa (GeV/c)^-1, dz mm, tanl) of the filter's prior.
    start_time : str
        ``"given"``: drift times count from the start of the event. ``"fitted"``: they are wrong by one number for each
        event, which its tracks give; the fit then makes the table ``start_times`` (docs/methods/fit.md).
    start_time_error : float or None
        ns, standard deviation of the given start time, which a fitted one takes into account. None: it counts nothing.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    cluster_errors: ClusterErrors = "track"
    screening: Screening | None = None
    loss: Loss = "truncated"
    radiation: bool = True
    matter: bool = True
    start_radius: Start = 0.0
    residuals: bool = False
    states: tuple[Radius | SurfaceName, ...] = ()
    hypothesis: MassHypothesis | tuple[MassHypothesis, ...] | None = None
    max_iterations: Iterations = 15
    tolerance: Positive = 0.1
    least_width: Positive = 0.1
    delta_strips: Share = 0.008
    kinks: bool = True
    outlier_pull: Pull = 5.0
    prior_sigma: FiveSpreads = (200.0, 0.5, 5.0, 1000.0, 2.0)
    start_time: Literal["given", "fitted"] = "given"
    start_time_error: TimeError | None = None

    def contradictions(self) -> list[str]:
        """Return what is wrong with several hypotheses together, and with an error of the start time."""
        return self._of_hypotheses() + self._of_start_time()

    def _of_start_time(self) -> list[str]:
        if not isinstance(self.start_time_error, int | float) or self.start_time != "given":
            return []
        return [f"start_time_error: got {self.start_time_error}, expected none unless start_time is 'fitted'"]

    def _of_hypotheses(self) -> list[str]:
        given = self.hypothesis
        if not isinstance(given, tuple) or len(given) == 1:
            return []
        if "all" in given:
            return [f"hypothesis: got {given!r}, expected 'all' alone"]
        once = len(set(map(str, given))) == len(given)
        return [] if once else [f"hypothesis: got {given!r}, expected each name once"]

    def hypotheses(self) -> tuple[str, ...]:
        """Return the names of the particles whose masses are assumed; none for that of each candidate itself."""
        given = () if self.hypothesis is None else self.hypothesis
        names = given if isinstance(given, tuple) else (given,)
        return tuple(HYPOTHESES) if names == ("all",) else names
