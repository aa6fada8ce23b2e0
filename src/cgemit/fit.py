"""Track fit: Kalman filter from the outermost hit inward to the origin (docs/methods/fit.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.candidates import Candidates, FitHits, fit_hits, with_masses
from cgemit.detector import SCREENINGS, Detector, compiled
from cgemit.particles import HYPOTHESES
from cgemit.states import place_problems, state_columns
from cgemit.tables import Table
from cgemit.tracks import residual_columns, track_columns

FitStatus = _core.FitStatus
Floats = npt.NDArray[np.float64]

SEEDS = ("hits", "truth")
ERRORS = ("track", "cluster")
LOSSES = ("truncated", "mean", "most_probable")

PARAMETERS = helix.PARAMETERS


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """How tracks are fitted.

    Attributes
    ----------
    seed : str
        Where the first helix comes from: ``"hits"``, a circle and a line through the drift-chamber hits, or
        ``"truth"``, the true helix smeared by `seed_smearing`.
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
        candidate gets a track for each, in this order. None: one track, with the particle's own mass.
    max_iterations : int
    tolerance : float
        The fit has converged when no parameter moves by more than this many of its standard deviations.
    least_width : float
        Least spread, in strip pitches, of the position that a cluster's size allows; it stands for the error of the
        track's incidence, so that a narrow allowed interval is not taken for a perfect measurement.
    delta_strips : float
        Probability that a delta electron adds one strip to a cluster; k strips are k times less probable. It says how
        much a cluster is worth that is longer than the track makes likely. 0: there are no delta electrons.
    outlier_pull : float
        A hit is left out where it lies this many standard deviations from the track fitted without it, the farthest
        first, and taken back where it does not any more. 0: every hit is used.
    prior_sigma : tuple of float
        Standard deviations of (dr mm, phi0 rad, kappa (GeV/c)^-1, dz mm, tanl) that the filter begins with.
    seed_smearing : tuple of float
        Standard deviations by which a true helix is smeared: (dr mm, phi0 rad, kappa relative, dz mm, tanl).

    Raises
    ------
    ValueError
        Listing every value that makes no sense.
    """

    seed: str = "hits"
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
    outlier_pull: float = 5.0
    prior_sigma: tuple[float, float, float, float, float] = (200.0, 0.5, 5.0, 1000.0, 2.0)
    seed_smearing: tuple[float, float, float, float, float] = (1.0, 0.005, 0.02, 5.0, 0.005)

    def __post_init__(self) -> None:
        problems = []
        named = (("seed", SEEDS), ("cluster_errors", ERRORS), ("screening", (None, *SCREENINGS)), ("loss", LOSSES))
        for name, choices in named:
            if getattr(self, name) not in choices:
                expected = ", ".join(map(repr, choices))
                problems.append(f"{name}: {getattr(self, name)!r}, expected one of {expected}")
        if self.max_iterations < 1:
            problems.append(f"max_iterations: {self.max_iterations}, expected at least 1")
        for name in ("tolerance", "least_width"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                problems.append(f"{name}: {value}, expected a positive number")
        if not 0 <= self.delta_strips < 1:
            problems.append(f"delta_strips: {self.delta_strips}, expected 0 or a probability below 1")
        if not (self.outlier_pull == 0 or 2 <= self.outlier_pull < math.inf):
            problems.append(f"outlier_pull: {self.outlier_pull}, expected 0 or at least 2 standard deviations")
        for name, least in (("prior_sigma", 1e-12), ("seed_smearing", 0.0)):
            values = getattr(self, name)
            if len(values) != 5 or not all(math.isfinite(value) and value >= least for value in values):
                problems.append(f"{name}: {values}, expected five numbers, none below {least:g}")
        problems += place_problems(self.states)
        expected = ", ".join(map(repr, (*HYPOTHESES, "all")))
        problems += [
            f"hypothesis: {name!r}, expected one of {expected}" for name in self.hypotheses() if name not in HYPOTHESES
        ]
        if len(set(self.hypotheses())) < len(self.hypotheses()):
            problems.append(f"hypothesis: {self.hypothesis!r}, expected each name once")
        if problems:
            raise ValueError("FitSettings:\n  " + "\n  ".join(problems))

    def hypotheses(self) -> tuple[str, ...]:
        """Return the names of the particles whose masses are assumed; none for that of each particle itself."""
        given = () if self.hypothesis is None else self.hypothesis
        names = (given,) if isinstance(given, str) else tuple(given)
        return tuple(HYPOTHESES) if names == ("all",) else names


def fit(
    detector: Detector,
    particles: Table,
    clusters: Table,
    wire_hits: Table,
    candidates: Candidates,
    settings: FitSettings | None = None,
    seed: int = 0,
    *,
    simulated: Detector | None = None,
) -> dict[str, Table]:
    """Fit one helix to the hits of every candidate.

    Parameters
    ----------
    detector : Detector
        Field and material that the fit assumes.
    particles : Table of kind "particles"
        The candidates' particles: mass hypothesis, and truth to compare with.
    clusters, wire_hits : Table
    candidates : Candidates
        One per row of `particles`.
    settings : FitSettings or None
    seed : int
        Key of the random streams; used by ``FitSettings(seed="truth")`` only.
    simulated : Detector or None
        What the particles really flew through, if that is not `detector`: its field bends the true helix.

    Returns
    -------
    dict of str to Table
        ``tracks``, one row per particle and mass hypothesis, with ``settings.residuals`` also ``residuals``, and with
        ``settings.states`` also ``states``. Rows whose `status` is not ok hold the last helix tried, and NaN where
        there is no helix, covariance or chi-square.
    """
    settings = settings or FitSettings()
    kinds = [HYPOTHESES[name] for name in settings.hypotheses()]
    particles, candidates = with_masses(particles, candidates, [(kind.pdg, kind.mass) for kind in kinds])
    hits = fit_hits(candidates, clusters, wire_hits)
    truth = helix.at_origin_in(particles, compiled(simulated or detector).field)
    start = smeared(truth, particles, settings, seed) if settings.seed == "truth" else np.empty((0, 5))
    arguments = core_arguments(detector, hits, particles["mass"], start, settings)
    out, span = _core.fit(**arguments), (particles.n_events, particles.first_event)
    tables = {"tracks": Table("tracks", track_columns(out, truth, particles), *span)}
    if settings.residuals:
        tables["residuals"] = Table("residuals", residual_columns(out, hits, particles), *span)
    if settings.states:
        core, settled = arguments["detector"], out["status"] == FitStatus.ok
        columns = state_columns(detector, core, settings.states, particles, hits, out, settled)
        tables["states"] = Table("states", columns, *span)
    return tables


def core_arguments(
    detector: Detector, hits: FitHits, mass: Floats, start: Floats, settings: FitSettings
) -> dict[str, Any]:
    """Return what the compiled fit takes.

    Parameters
    ----------
    detector : Detector
    hits : FitHits
    mass : ndarray, (n,) float64, GeV/c2
    start : ndarray, (n, 5) float64
        Helices to begin with; (0, 5): the hits provide them.
    settings : FitSettings

    Returns
    -------
    dict of str to object
        Arguments of ``_core.fit`` by name.
    """
    return {
        "detector": compiled(detector, screening=settings.screening or SCREENINGS[0], loss=settings.loss),
        "hit_offsets": hits.hit_offsets,
        "hits": {n: getattr(hits, n) for n in ("kind", "layer", "element", "size", "value", "sigma", "side")},
        "mass": mass,
        "start": start,
        "settings": _core.FitSettings(
            max_iterations=settings.max_iterations,
            tolerance=settings.tolerance,
            errors_from_track=settings.cluster_errors == "track",
            least_width=settings.least_width,
            delta_strips=settings.delta_strips,
            outlier_pull=settings.outlier_pull,
            prior_sigma=settings.prior_sigma,
        ),
        "residuals": settings.residuals,
        "states": bool(settings.states),
    }


def smeared(truth: Floats, particles: Table, settings: FitSettings, seed: int) -> Floats:
    """Return true helices smeared by `settings.seed_smearing`.

    Parameters
    ----------
    truth : ndarray, (n, 5) float64
    particles : Table of kind "particles"
        Whose random streams are used.
    settings : FitSettings
    seed : int

    Returns
    -------
    ndarray, (n, 5) float64
    """
    purpose = _core.Purpose.fit_seed
    draws = [_core.normals(seed, particles["event"], particles["particle"], purpose, place) for place in (0, 1)]
    sigma = np.array(settings.seed_smearing) * np.where(np.arange(5) == 2, np.abs(truth[:, 2:3]), 1.0)
    return truth + sigma * np.concatenate(draws, axis=1)[:, :5]
