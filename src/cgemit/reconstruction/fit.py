"""Track fit: Kalman filter from the outermost hit inward to the origin (docs/methods/fit.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.base.arrays import Column, Columns, Floats
from cgemit.base.errors import Problems, report
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Check, Momentum, Positive, Quantity, Whole
from cgemit.detector import SCREENINGS, Detector, Screening, load, slabs
from cgemit.detector.channels import checked
from cgemit.fit_matter import tuned
from cgemit.particles.species import HYPOTHESES, Hypothesis, species
from cgemit.reconstruction.candidates import FitHits, collect_hits
from cgemit.reconstruction.states import USUAL_MOMENTUM, SurfaceName, state_columns
from cgemit.tables import Table
from cgemit.tables.schema import FitStatus, is_fitted

MassHypothesis = Literal[Hypothesis, "all"]
ClusterErrors = Literal["track", "cluster"]
Loss = Literal["truncated", "mean", "most_probable"]
LOSSES: tuple[Loss, ...] = get_args(Loss)

_MOST = 2**31 - 1  # iterations, of the core's whole number

Iterations = Annotated[int, Whole(1, _MOST)]
Share = Annotated[float, Quantity(low=0, high=1, below=True)]
Pull = Annotated[float, Check(lambda value: value == 0 or 2 <= value < math.inf, "0 or at least 2 standard deviations")]
Spread = Annotated[float, Quantity(low=1e-12)]
FiveSpreads = tuple[Spread, Spread, Spread, Spread, Spread]
_FARTHEST = 1e5  # mm
Start = Annotated[float, Quantity("length", -_FARTHEST, _FARTHEST)]
Radius = Annotated[float, Quantity("length", 0, above=True)]
Chi2Limit = Annotated[float, Check(lambda value: value == 0 or 1 < value < math.inf, "0 or a finite number above 1")]


@dataclass(frozen=True, kw_only=True)
class FitSettings(SettingsData):
    """How tracks are fitted.

    Attributes
    ----------
    cluster_errors : str
        ``"track"``: from the number of strips and the incidence of the track. ``"cluster"``: as in the clusters table.
    screening : str or None
        Screening of nuclei. None: as simulated, or ``"wentzel"`` without a simulation.
    loss : str
        Energy loss that is subtracted: ``"truncated"`` for the core of a momentum measurement, ``"mean"`` of all
        collisions, or Landau's ``"most_probable"`` one (docs/methods/matter.md).
    momentum_error : float or None
        Expected sigma(p)/p of a track by hits and scattering, for ``loss="truncated"``: losses of more than 2.4
        sigma(p), 2.6 of electrons, count as tails (docs/methods/matter.md). None: that of each track.
    radiation : bool
        Whether the energy loss of electrons and positrons includes bremsstrahlung, cut as `loss` says like collisions
        (docs/methods/matter.md).
    matter : bool
        Whether tracks scatter and lose energy in the fit (not in BES3's MdcTrack).
    start_radius : float
        Radius, mm, where the particle was born; the fit leaves out the matter inside it. Negative: it first flew inward
        and crossed that matter twice. A column `start_radius` of the candidates has precedence
        (docs/methods/robustness.md).
    residuals : bool
        Whether the fit makes the residuals table: every hit against the track fitted without it.
    states : tuple of float or str
        Surfaces of the states table (docs/methods/states.md). Empty: no such table.
    components : bool
        Whether the fit makes the components table: the density of the momentum of electrons and positrons, a sum of
        normal distributions (docs/methods/fit.md).
    hypothesis : str, tuple of str or None
        Particles whose masses the fit assumes; every candidate gets a track for each. None: the candidate's own mass
        and charge.
    max_iterations : int
        Largest number of iterations.
    tolerance : float
        The fit has converged when no parameter moves by more, in standard deviations.
    least_width : float
        Least spread, in strip pitches, of the position that a cluster's size allows.
    delta_strips : float
        Probability that a delta electron of a particle of unit charge adds one strip to a cluster; k strips are k times
        less probable. It grows with the square of the charge, and sets the weight of clusters that are longer than the
        incidence predicts.
    kinks : bool
        Whether a slow track is linearised about its scattered path.
    outlier_pull : float
        A hit this many standard deviations from the track fitted without it is left out. 0: every hit is used.
    chi2_limit : float
        Tracks whose chi-square per degree of freedom is larger have the status `large_chi2`, unless chance makes it as
        large once in 10^6 tracks. 0: none has.
    prior_sigma : tuple of float
        Standard deviations of (dr mm, phi0 rad, kappa (GeV/c)^-1, dz mm, tanl) of the filter's prior. That of kappa
        grows in fields below 0.1 T, so that it stays far above the error of the curvature (docs/methods/fit.md).
    beam : (float, float) or None
        Standard deviations of dr and dz, mm, of particles from a beam spot at the origin: measurements of tracks that
        come from there. None: the beam spot is no measurement.
    momentum : float or None
        GeV/c, with which tracks scatter and lose energy whose curvature does not measure their momentum
        (docs/methods/fit.md). None: that of the gun in `run`, else 1 GeV/c.

    Raises
    ------
    ValueError
        Listing every invalid value.

    Examples
    --------
    >>> settings = cg.Settings(fit=cg.FitSettings(hypothesis="pi", states=("beam_pipe",)))
    >>> result = cg.run("besiii-cgem", cg.Gun("pi-", p=0.5, cos_theta=0.0), n=5, settings=settings)
    >>> result.tracks["hypothesis"].tolist(), len(result.states)
    ([211, 211, 211, 211, 211], 5)
    """

    cluster_errors: ClusterErrors = "track"
    screening: Screening | None = None
    loss: Loss = "truncated"
    momentum_error: Share | None = None
    radiation: bool = True
    matter: bool = True
    start_radius: Start = 0.0
    residuals: bool = False
    states: tuple[Radius | SurfaceName, ...] = ()
    components: bool = False
    hypothesis: MassHypothesis | tuple[MassHypothesis, ...] | None = None
    max_iterations: Iterations = 15
    tolerance: Positive = 0.1
    least_width: Positive = 0.1
    delta_strips: Share = 0.008
    kinks: bool = True
    outlier_pull: Pull = 5.0
    chi2_limit: Chi2Limit = 6.0
    prior_sigma: FiveSpreads = (200.0, 0.5, 5.0, 1000.0, 2.0)
    beam: tuple[Spread, Spread] | None = None
    momentum: Momentum | None = None

    def contradictions(self, problems: Problems) -> None:
        """Note several hypotheses that do not go together."""
        names = self.hypothesis
        if isinstance(names, tuple) and len(names) > 1 and "all" in names:
            problems.note("hypothesis", repr(names), "'all' alone")
        elif isinstance(names, tuple) and len(set(map(str, names))) < len(names):
            problems.note("hypothesis", repr(names), "each name once")
        if self.beam is not None and self.states:
            problems.note("beam", repr(self.beam), "None with states, which do without the beam spot")

    def prior_in(self, detector: Detector) -> tuple[float, ...]:
        """Return the prior's standard deviations in the field of a detector, as `prior_sigma`."""
        bz = abs(detector.field.bz)
        wider = _FIELD_OF_PRIOR / bz if _core.kalman.STRAIGHT_FIELD <= bz < _FIELD_OF_PRIOR else 1.0
        return tuple(one * wider if i == _KAPPA else one for i, one in enumerate(self.prior_sigma))

    def hypotheses(self) -> tuple[str, ...]:
        """Return the names of the particles whose masses are assumed; none for that of each candidate itself."""
        given = () if self.hypothesis is None else self.hypothesis
        names = given if isinstance(given, tuple) else (given,)
        return tuple(HYPOTHESES) if names == ("all",) else names


#: Fields that the core's settings have, too.
CORE_SETTINGS = ("max_iterations", "tolerance", "least_width", "delta_strips", "kinks", "outlier_pull")

_LIGHT = 2 * species("e-").mass  # as the core tells electrons apart
_KAPPA = helix.PARAMETERS.index("kappa")
#: T. The prior of kappa is that of the settings above this field; below, it is constant in curvature.
_FIELD_OF_PRIOR = 0.1

#: Column of the candidates that comes before the setting of this name.
BEGIN = "start_radius"

#: A track is displaced if |dr| is more than this number of its errors, and than this share of the radius of the
#: innermost matter: for fast tracks the size of the beam counts, not their errors.
FAR, SHARE = 5.0, 0.1


def displaced(dr: Floats, err_dr: Floats, detector: Detector) -> npt.NDArray[np.int8]:
    """Return whether tracks begin beside the beam line, (n,) int8; 0 without an error.

    Parameters
    ----------
    dr, err_dr : ndarray, (n,) float64, mm
        Closest approach to the beam line, and its standard deviation.
    detector : Detector
    """
    inner = slabs(detector)[0].shells[0].r_in
    return np.asarray(np.abs(dr) > np.maximum(FAR * err_dr, SHARE * inner), np.int8)


#: Limits of normal distributions with the central 68 and 95 %, in standard deviations.
NORMAL_68, NORMAL_95 = 0.9944578832, 1.9599639845


def momentum_limits(p: Floats, err_p: Floats) -> dict[str, Floats]:
    """Return mode and limits of momenta whose inverse is normal: columns p_mode, p_low, p_high, p_low95, p_high95.

    The upper limit is NaN where the inverse may be 0: there is none.

    Parameters
    ----------
    p, err_p : ndarray, (n,) float64, GeV/c
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        error = err_p / p
        limits = {"p_mode": np.array(p)}
        for name, sigmas in (("", NORMAL_68), ("95", NORMAL_95)):
            limits[f"p_low{name}"] = p / (1 + sigmas * error)
            limits[f"p_high{name}"] = np.where(sigmas * error < 1, p / (1 - sigmas * error), np.nan)
    return limits


def added_error(tracks: Table, before: Floats) -> Floats:
    """Return the relative error of momenta that an error was added by, in quadrature, (n,) float64.

    Parameters
    ----------
    tracks : Table
    before : ndarray, (n,) float64, GeV/c
        Errors without it.
    """
    added = np.sqrt(np.maximum(tracks["err_p"] ** 2 - before**2, 0)) / tracks["p"]
    return np.where(np.isfinite(added), added, 0.0)


def with_wider_momenta(tracks: Table, err_p: Floats) -> Table:
    """Return tracks with larger errors of the momentum, and limits as much farther from the mode, in quadrature.

    Parameters
    ----------
    tracks : Table
    err_p : ndarray, (n,) float64, GeV/c
    """
    before, tracks = tracks["err_p"], tracks.with_columns(err_p=err_p)
    limits, added = momentum_limits(tracks["p"], err_p), added_error(tracks, before)
    moved = tracks["p_mode"] != tracks["p"]
    for name in list(limits):
        sigmas = 0.0 if name == "p_mode" else NORMAL_95 if name.endswith("95") else NORMAL_68
        change = np.log(tracks[name] / tracks["p_mode"])
        wider = tracks["p_mode"] * np.exp(np.copysign(np.hypot(change, sigmas * added), change))
        limits[name] = np.where(moved, wider, limits[name])
    return tracks.with_columns(**limits)


def start_radii(candidates: Table, settings: FitSettings) -> Floats:
    """Return the radii at which candidates begin, (n,) float64, mm: of their column, or of the settings.

    Raises
    ------
    ValueError
        Listing each one that is no finite number.
    """
    if BEGIN not in candidates:
        return np.full(len(candidates), settings.start_radius)
    radii = np.asarray(candidates[BEGIN], np.float64)
    wrong = np.flatnonzero(~np.isfinite(radii))
    report("fit", (f"candidates row {row}: {BEGIN}: got {radii[row]}, expected a radius in mm" for row in wrong))
    return radii


Out = dict[str, npt.NDArray[np.generic]]  # what the compiled fit returns

PARAMETERS = helix.PARAMETERS


@checked("clusters", "wire_hits", "candidates", "candidate_hits", ignore=("gid",))
def fit(
    detector: Detector | str | Mapping[str, Any],
    clusters: Table,
    wire_hits: Table,
    candidates: Table,
    candidate_hits: Table,
    settings: FitSettings | None = None,
    *,
    start: npt.ArrayLike | None = None,
) -> dict[str, Table]:
    """Fit one helix to the hits of every candidate.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
        Field and material that the fit assumes.
    clusters, wire_hits : Table
    candidates, candidate_hits : Table
        Hits in any order: the fit takes them from the beam line outward. A column `start_radius`, mm, of the candidates
        comes before the setting.
    settings : FitSettings or None
    start : array_like or None
        Starting helices, (candidates, 5) float64: dr mm, phi0 rad, kappa (GeV/c)^-1, dz mm, tanl. None: the hits
        provide them.

    Returns
    -------
    dict of str to Table
        ``tracks``, one row per candidate and mass hypothesis, with ``settings.residuals`` also ``residuals``, with
        ``settings.states`` also ``states``, and with ``settings.components`` also ``components``. Rows whose `status`
        is not ok hold the last helix tried, and NaN where there is no helix, covariance or chi-square.

    Raises
    ------
    TypeError
        If the settings are something else.
    ValueError
        Listing every problem of the hits or the start.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    >>> tracks = cg.fit(r.detector, r.clusters, r.wire_hits, r.candidates, r.candidate_hits)["tracks"]
    >>> print(tracks["p"].round(1), [cg.FitStatus(status).name for status in tracks["status"][:1]])
    [1. 1. 1. 1. 1.] ['ok']
    """
    detector, settings = load(detector), FitSettings.of(settings)
    fitted = fit_columns(detector, clusters, wire_hits, candidates, candidate_hits, settings, start)
    core, hits, candidate, pdg, mass, charge, radii, out = fitted
    names = settings.hypotheses()
    event = candidates["event"].take(candidate)
    cover = candidates.cover | {
        "meta": {name: candidates.meta[name] for name in ("finder", "hypothesis") if name in candidates.meta}
        | ({"hypothesis": ", ".join(names)} if names else {})
        | {"momentum": settings.momentum or USUAL_MOMENTUM}
        | ({} if settings.prior_sigma == FitSettings().prior_sigma else {"prior_sigma": list(settings.prior_sigma)})
    }
    columns = _track_columns(out, event, candidate, pdg, charge)
    columns["status"] = _with_large_chi2(columns, settings.chi2_limit)
    columns["displaced"] = displaced(out["helix"][:, 0], np.asarray(columns["err_dr"]), detector)
    tables = {"tracks": Table("tracks", columns, **cover)}
    if settings.residuals:
        tables["residuals"] = Table("residuals", _residual_columns(out, hits, event), **cover)
    if settings.components:
        tables["components"] = Table("components", _component_columns(out, event), **cover)
    if settings.states:
        settled = is_fitted(tables["tracks"])
        columns = state_columns(detector, core, settings.states, tables["tracks"], mass, radii, hits, out, settled)
        tables["states"] = Table("states", columns, **cover)
    return tables


class FittedColumns(NamedTuple):
    """Tracks as the core has fitted them, row by row.

    Attributes
    ----------
    core : _core.detector.Detector
        Detector with the matter that the fit assumed.
    hits : FitHits
    candidate : ndarray, (n,) int64
        Row of the candidate.
    pdg, mass, charge : ndarray, (n,) int, float64 GeV/c2 and int e
        That were assumed.
    radii : ndarray, (n,) float64, mm
        Where the tracks begin.
    out : dict of str to ndarray
        Columns of the core's fit; with `FitSettings.states` also those of the last iteration, as `state_columns` takes
        them.
    """

    core: _core.detector.Detector
    hits: FitHits
    candidate: Column
    pdg: Column
    mass: Column
    charge: Column
    radii: Floats
    out: dict[str, npt.NDArray[Any]]


def fit_columns(
    detector: Detector, clusters: Table, wire_hits: Table, candidates: Table, candidate_hits: Table,
    settings: FitSettings, start: npt.ArrayLike | None = None,
) -> FittedColumns:  # fmt: skip
    """Return what the core makes of the hits of every candidate; see `fit`."""
    core = compiled_matter(detector, settings)
    hits = collect_hits(core, candidates, candidate_hits, clusters, wire_hits)
    names = settings.hypotheses()
    candidate, pdg, mass, charge = _with_hypotheses(candidates, names)
    begin = _start(start, len(candidates))
    if len(names) > 1:
        hits, begin = _repeated(hits, candidate), begin[candidate] if len(begin) else begin
    radii = start_radii(candidates, settings)[candidate]
    out = _core.reconstruction.fit(**core_arguments(detector, hits, mass, begin, settings, radii, charge))
    return FittedColumns(core, hits, candidate, pdg, mass, charge, radii, out)


def _start(helices: npt.ArrayLike | None, n: int) -> Floats:
    """Return the starting helices, (n, 5), or (0, 5) for none."""
    if helices is None:
        return np.empty((0, 5))
    start = np.ascontiguousarray(helices, np.float64)
    if start.shape != (n, 5):
        raise ValueError(f"start: got shape {start.shape}, expected ({n}, 5), a helix for each candidate")
    wrong = np.flatnonzero(~np.isfinite(start).all(axis=1))
    if len(wrong):
        raise ValueError(f"start: got {start[wrong[0]]} in row {wrong[0]}, expected finite numbers")
    return start


def compiled_for_fit(
    detector: Detector, settings: FitSettings, full: Detector | None = None
) -> _core.detector.Detector:
    """Return the compiled detector with the matter that the fit assumes for tracks from the radius of the settings.

    Parameters
    ----------
    detector : Detector
    settings : FitSettings
    full : Detector or None
        Of which this one is a variant with the same hits (`hits_of` of `tuned`).
    """
    core = compiled_matter(detector, settings, full)
    return core.beginning_at(settings.start_radius) if settings.start_radius else core


def compiled_matter(detector: Detector, settings: FitSettings, full: Detector | None = None) -> _core.detector.Detector:
    """Return the compiled detector with the matter that the fit assumes for tracks from the beam line."""
    return tuned(
        detector, settings.screening or SCREENINGS[0], settings.loss, settings.radiation, matter=settings.matter,
        momentum_error=settings.momentum_error, hits_of=full,
    )  # fmt: skip


def core_arguments(
    detector: Detector, hits: FitHits, mass: Floats, start: Floats, settings: FitSettings, radii: Floats | None = None,
    charge: npt.ArrayLike = 1,
) -> dict[str, Any]:  # fmt: skip
    """Return the arguments of the compiled fit.

    Parameters
    ----------
    detector : Detector
    hits : FitHits
    mass : ndarray, (n,) float64, GeV/c2
    start : ndarray, (n, 5) float64
        Starting helices; (0, 5): the hits provide them.
    settings : FitSettings
    radii : ndarray or None, (n,) float64, mm
        Where the tracks begin. None: as in the settings.
    charge : array_like, (n,) or (), e

    Returns
    -------
    dict of str to object
        Arguments of ``_core.reconstruction.fit`` by name.
    """
    return {
        "detector": compiled_matter(detector, settings),
        "hit_offsets": hits.hit_offsets,
        "hits": hits.columns(),
        "mass": mass,
        "charge": np.ones(len(mass)) * np.asarray(charge, np.float64),
        "start": start,
        "start_radius": np.full(len(mass), settings.start_radius) if radii is None else radii,
        "settings": {name: getattr(settings, name) for name in CORE_SETTINGS}
        | {
            "errors_from_track": settings.cluster_errors == "track",
            "prior_sigma": settings.prior_in(detector),
            "beam": settings.beam or (0.0, 0.0),
            "momentum": settings.momentum or USUAL_MOMENTUM,
        },
        "residuals": settings.residuals,
        "states": bool(settings.states),
        "densities": settings.components and bool(np.any(mass < _LIGHT)),
    }


def has_cov(status: npt.NDArray[np.generic]) -> npt.NDArray[np.bool_]:
    """Return whether fits with these statuses have a covariance and a chi-square.

    Parameters
    ----------
    status : ndarray, (n,) int8

    Returns
    -------
    ndarray, (n,) bool
    """
    fitted = (FitStatus.ok, FitStatus.not_converged, FitStatus.unconstrained, FitStatus.hits_left_out)
    return np.isin(status, (*fitted, FitStatus.large_chi2))


#: Probability with which chance may make a chi-square that counts as too large: of few degrees of freedom, one in 10^3
#: is beyond any ratio that many have.
_CHANCE = 1e-6


def _with_large_chi2(tracks: Columns, limit: float) -> Column:
    """Return the statuses of tracks, of which good fits with a large chi-square are `large_chi2`, (n,) int8."""
    status, chi2, ndf = (np.asarray(tracks[name]) for name in ("status", "chi2", "ndf"))
    if limit == 0:
        return status
    large = np.flatnonzero((status == FitStatus.ok) & (ndf > 0) & (chi2 > limit * ndf))
    if not len(large):
        return status
    from scipy.special import chdtrc

    status = status.copy()
    status[large[chdtrc(ndf[large], chi2[large]) < _CHANCE]] = FitStatus.large_chi2
    return status


def _track_columns(out: Out, event: Column, candidate: Column, pdg: Column, charge: Column) -> Columns:
    """Return the columns of the tracks table; `event`, `candidate` (row), and the `pdg` and `charge` assumed."""
    no_helix = np.isin(out["status"], (_core.common.FitStatus.too_few_hits, _core.common.FitStatus.seed_failed))
    fitted = np.where(no_helix[:, None], np.nan, out["helix"])
    known = has_cov(out["status"])
    cov = np.where(known[:, None, None], out["cov"], np.nan)
    columns: Columns = {"event": event, "candidate": candidate, "hypothesis": pdg, "charge": charge}
    columns |= {name: fitted[:, i] for i, name in enumerate(helix.PARAMETERS)}
    columns |= {"cov": cov, "p": helix.momentum(fitted, charge)}
    columns |= {name: out[name] for name in ("ndf", "n_clusters", "n_wires", "n_outliers", "iterations", "status")}
    columns["chi2"] = np.where(known, out["chi2"], np.nan)
    error = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    columns |= {f"err_{name}": error[:, i] for i, name in enumerate(helix.PARAMETERS)}
    columns["err_p"] = helix.momentum_error(fitted, cov, charge)
    limits = momentum_limits(np.asarray(columns["p"]), np.asarray(columns["err_p"]))
    widths = np.asarray(out["limits"], np.float64)
    has_density = known & widths.any(axis=1)
    for i, (name, normal) in enumerate(limits.items()):
        limits[name] = np.where(has_density, columns["p"] * np.exp(widths[:, i]), normal)
    return columns | limits | {name: out[name] for name in ("radiated", "radius_radiated")}


def _component_columns(out: Out, event: Column) -> Columns:
    """Return the columns of the components table; `event` of each track."""
    if "density_weight" not in out:
        return {"event": event[:0], **dict.fromkeys(("track", "weight", "change", "spread"), np.empty(0))}
    weight = np.asarray(out["density_weight"], np.float64)
    track, component = np.nonzero((weight > 0) & has_cov(out["status"])[:, None])
    columns: Columns = {"event": event[track], "track": track, "weight": weight[track, component]}
    return columns | {
        "change": out["density_mean"][track, component], "spread": out["density_sigma"][track, component],
    }  # fmt: skip


def _residual_columns(out: Out, hits: FitHits, event: Column) -> Columns:
    """Return the columns of the residuals table: hits that the tracks meet; `event` of each track."""
    met = np.flatnonzero(np.asarray(out["err"], np.float64) > 0)

    def pick(column: Column) -> Column:  # several times faster than column[met], or a mask
        return column.take(met)

    track = pick(np.repeat(np.arange(len(event)), np.diff(hits.hit_offsets)))
    residual, err = pick(out["residual"]), pick(out["err"])
    return {
        "event": event.take(track),
        "track": track,
        "view": pick(hits.kind),
        "layer": pick(hits.layer),
        "hit": pick(hits.hit),
        "residual": residual,
        "err": err,
        "pull": residual / err,
        "side": pick(out["side"]),
        "used": pick(out["used"]),
    }


def _with_hypotheses(candidates: Table, names: tuple[str, ...]) -> tuple[Column, Column, Column, Column]:
    """Return the tracks to fit: each candidate once per mass hypothesis.

    Parameters
    ----------
    candidates : Table of kind "candidates"
    names : tuple of str
        Names of `HYPOTHESES`; none: the candidates' own masses.

    Returns
    -------
    candidate : ndarray, (n,) int64
        Row of the candidate.
    pdg : ndarray, (n,) int
        Number of the Particle Data Group, unsigned.
    mass : ndarray, (n,) float64, GeV/c2
    charge : ndarray, (n,) int, e
        Unsigned.
    """
    n = len(candidates)
    if not names:
        return np.arange(n), candidates["pdg"], candidates["mass"], candidates["charge"]
    kinds = [HYPOTHESES[name] for name in names]
    numbers = ([kind.pdg for kind in kinds], [kind.mass for kind in kinds], [abs(kind.charge) for kind in kinds])
    pdg, mass, charge = (np.tile(of_kinds, n) for of_kinds in numbers)
    return np.repeat(np.arange(n), len(kinds)), pdg, mass, charge


def _repeated(hits: FitHits, candidate: Column) -> FitHits:
    """Return the hits of candidates picked by row, each as often as it is picked.

    Parameters
    ----------
    hits : FitHits
    candidate : ndarray, (n,) int64
    """
    counts = np.diff(hits.hit_offsets)[candidate]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    # Hit j of a repeated candidate has the same distance to the candidate's first hit as in the original.
    at = np.arange(offsets[-1]) + np.repeat(hits.hit_offsets[:-1][candidate] - offsets[:-1], counts)
    return FitHits(offsets, **{name: column[at] for name, column in hits.columns().items()})
