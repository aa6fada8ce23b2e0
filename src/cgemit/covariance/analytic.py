"""`analytic`: covariances at given momenta and angles, for one detector or many."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.analysis.quantities import UPPER
from cgemit.base.arrays import Columns, Floats
from cgemit.base.validate import is_whole
from cgemit.covariance.result import Covariance, Entries
from cgemit.covariance.tracks import (
    HitModel,
    Points,
    Quantity,
    Sample,
    Tracks,
    efficiencies_of,
    most_unseen,
    near_ends,
    points_of,
    sample_of,
    shot_of,
)
from cgemit.detector import Detector, ReadoutGroup, load
from cgemit.detector.keys import once
from cgemit.detector.layers.wires import DriftChamber
from cgemit.detector.readouts import Readout
from cgemit.reconstruction.cluster import clusterer_of, warn_of_losses
from cgemit.reconstruction.cluster_errors import COS_THETA
from cgemit.reconstruction.clusterers.clusterer import Clusterer
from cgemit.reconstruction.fit import FitSettings, compiled_for_fit
from cgemit.reconstruction.states import StateStatus, Surface, shares_inside
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.tables.schema import HIT_WIRE, FitStatus

#: The status of a track without state at the cylinder.
_LOST = {
    StateStatus.does_not_reach: FitStatus.does_not_reach,
    StateStatus.stopped: FitStatus.stopped,
    StateStatus.left_field: FitStatus.left_field,
}


def at_cylinders(tracks: Tracks, radius: Floats) -> tuple[Tracks, Columns]:
    """Return tracks and columns, as of `Tracks.run`, where the tracks leave cylinders.

    Parameters
    ----------
    tracks : Tracks
        From the origin.
    radius : ndarray, (tracks,) float64, mm
    """
    out = tracks.run(budget=False, hits=True)
    hits = {name: out.pop(f"hit_{name}") for name in ("kind", "layer", "channel", "value", "variance", "k", "x")}
    ends = np.cumsum(out["n_clusters"].astype(np.int64) + out["n_wires"])
    offsets = np.concatenate([[0], ends])
    kappa, tanl = np.full(len(radius), np.nan), np.full(len(radius), np.nan)
    status, entries = out["status"].copy(), np.full((len(radius), 15), np.nan)
    for cylinder in np.unique(radius):
        rows = np.flatnonzero((radius == cylinder) & (out["status"] == FitStatus.ok))
        states = _states(tracks, hits, offsets, rows, float(cylinder))
        kappa[rows], tanl[rows] = states["helix"][:, 2], states["helix"][:, 4]
        entries[rows] = states["cov"][:, UPPER[0], UPPER[1]]
        for lost, instead in _LOST.items():
            status[rows[states["status"] == lost]] = instead
    at = dataclasses.replace(tracks, kappa=kappa, tanl=tanl)
    return at, out | {"covariance": entries, "status": status}


def _states(
    tracks: Tracks, hits: Columns, offsets: npt.NDArray[np.int64], rows: npt.NDArray[np.intp], radius: float
) -> Columns:
    """Return the states of some tracks at a cylinder: smoothed as in the fit, with residuals 0."""
    counts = offsets[rows + 1] - offsets[rows]
    begin = np.concatenate([[0], np.cumsum(counts)])
    of_tracks = np.repeat(offsets[rows] - begin[:-1], counts) + np.arange(begin[-1])
    taken = {name: column[of_tracks] for name, column in hits.items()}
    wire = taken["kind"] == HIT_WIRE
    n = len(rows)
    zero = np.zeros(n)
    core = compiled_for_fit(tracks.detector, tracks.fit)
    states: Columns = _core.reconstruction.states(
        core,
        hit_offsets=begin,
        hits={
            "kind": taken["kind"], "layer": taken["layer"], "channel": taken["channel"],
            "size": np.zeros(len(wire), np.int32), "value": np.where(wire, np.abs(taken["value"]), taken["value"]),
            "sigma": np.sqrt(taken["variance"]), "used": np.ones(len(wire), np.uint8),
            "used_value": taken["value"], "used_variance": taken["variance"], "k": taken["k"], "x": taken["x"],
        },
        reference=np.stack([zero, tracks.phi[rows], tracks.kappa[rows], zero, tracks.tanl[rows]], axis=1),
        kinks=np.zeros((n, 2 * core.n_slabs)),
        prior=np.tile(np.diag(np.square(tracks.fit.prior_in(tracks.detector))).ravel(), (n, 1)),
        mass=tracks.mass[rows],
        charge=tracks.charge[rows],
        fitted=np.ones(n, np.uint8),
        targets={
            "surface": np.array([Surface.cylinder], np.int8), "radius": np.array([radius]),
            "share": shares_inside(tracks.detector, np.array([radius])),
        },
    )  # fmt: skip
    return states


_FIT = FitSettings()

#: Covariances that errors of constants add to those of tracks from the origin, (tracks, 15).
Alignment = Callable[[Tracks], Floats]


def analytic(
    detector: Detector | str | Mapping[str, Any],
    particle: str | int = "mu-",
    p: Quantity | None = None,
    cos_theta: Quantity | None = None,
    *,
    pt: Quantity | None = None,
    theta: Quantity | None = None,
    eta: Quantity | None = None,
    phi: Quantity | None = None,
    radius: Quantity | None = None,
    charge: npt.ArrayLike | None = None,
    mass: npt.ArrayLike | None = None,
    readout: Readout | str | Mapping[str, Any] | None = None,
    reveal_sides: bool = False,
    fit: FitSettings | None = None,
    alignment: Alignment | None = None,
    samples: int | None = None,
    threads: int | None = None,
) -> Covariance:
    """Return the covariance of a track's helix at the origin or at any radius, without events.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    particle : str or int
        Name or number of the Particle Data Group.
    p : float, str, array_like or tuple of two, GeV/c
        Momentum at the origin. A tuple is a range, over which each point is averaged uniformly; an array holds points.
        None: 1 GeV/c, unless `pt` is given.
    cos_theta : float, array_like or tuple of two
        Cosine of the polar angle, likewise. None: 0, unless `theta` or `eta` is given.
    pt : float, str or array_like, GeV/c
        Transverse momentum, in place of `p`; with fixed angles.
    theta, eta : float, str or array_like, rad and 1
        Polar angle or pseudorapidity, in place of `cos_theta`.
    phi : float, str, array_like or None, rad
        Azimuth of the momentum; None: averaged over the full circle.
    radius : float, str, array_like or None, mm
        Of the cylinder where the covariance is wanted: from all hits, inside and outside, after all matter inside the
        cylinder and before all outside. None: at the origin.
    charge, mass : array_like or None
        e, GeV/c2. None: those of the particle. `p`, `cos_theta`, `phi`, `radius`, `charge` and `mass` are broadcast.
    readout : Readout, str, mapping or None
        Of all CGEM layers, instead of those of the detector. Binary clusters have the error that follows from their
        number of strips; the positions of the strips under the track are sampled.
    reveal_sides : bool
        Whether wire hits tell their side. If not, hits close to their wire have the weights of the fit.
    fit : FitSettings or None
        Energy loss, screening, prior, and `least_width` and `delta_strips` of binary clusters, which always have the
        errors of ``cluster_errors="track"``. Matter acts at the momentum `p`, also where no field measures it: the
        assumed `momentum` plays no part.
    alignment : AlignmentForecast or None
        Errors of the constants of the detector, as `cgemit.alignment_forecast` forecasts them, which widen the
        resolutions and are a term of the budget. Only at the origin.
    samples : int or None
        Tracks that are averaged at each point, best a number without a common factor with the numbers of cells of the
        drift chamber. None: 127, or 1 if nothing varies.
    threads : int or None
        None: all cores.

    Returns
    -------
    Covariance

    Raises
    ------
    DetectorError
        If the detector is not valid.
    ValueError
        Listing every problem of the other arguments.

    Notes
    -----
    Scattering and straggling enter with the variances of the fit (docs/methods/matter.md), measurements with the errors
    of the readout, so that the result is that of a fit whose assumptions hold: simulation with
    ``fluctuations="gaussian"``. Near the ends of the layers, where scattering decides which hits a track has, the
    trajectories of the samples scatter (only at the origin, and if more than one track is averaged).

    Examples
    --------
    >>> muons = cg.analytic("besiii-cgem-design", "mu-", p=[0.3, 1.0])
    >>> muons
    <besiii-cgem-design, mu-, readout binary
      p 0.3 GeV/c, cos(theta) 0: sigma(d_rho) 306.9 um, sigma(d_z) 0.4313 mm, sigma(p) 0.8321 MeV/c
      p 1 GeV/c, cos(theta) 0: sigma(d_rho) 169.8 um, sigma(d_z) 0.2852 mm, sigma(p) 4.775 MeV/c>
    >>> print(muons.sigma("dr").round(), muons.sigma("p").round(2))  # um, MeV/c
    [307. 170.] [0.83 4.78]
    """
    detector, fit = load(detector), _FIT if fit is None else FitSettings.of(fit, "fit")
    if threads is not None and not is_whole(threads, 1, 2**15):
        raise ValueError(f"threads: got {threads!r:.60}, expected a whole number from 1 to {2**15}")
    if readout is not None:
        detector = detector.with_readout(readout)
    p, cos_theta = shot_of(p, pt, cos_theta, theta, eta)
    points = points_of(particle, p, cos_theta, phi, radius, charge, mass, samples)
    return covariance_at(points, detector, DigitizeSettings(reveal_sides=reveal_sides), fit, threads, alignment)


def covariance_at(
    points: Points,
    detector: Detector,
    digitize: DigitizeSettings,
    fit: FitSettings,
    threads: int | None = None,
    alignment: Alignment | None = None,
) -> Covariance:
    """Return the covariances of a detector at points, which serve any number of detectors; see `analytic`.

    Raises
    ------
    ValueError
        If the readout has no expected errors, or points at a radius have errors of constants.
    """
    warn_of_losses(detector)
    _, tracks = tracks_at(points, detector, digitize, fit, threads)
    if points.at_origin:
        columns = tracks.run(budget=False)
        if alignment is not None:
            tracks = dataclasses.replace(tracks, alignment=alignment(tracks))
            columns = columns | {"covariance": columns["covariance"] + tracks.alignment}
    elif alignment is not None:
        raise ValueError("alignment: got covariances at a radius; expected covariances at the origin")
    else:
        tracks, columns = at_cylinders(tracks, np.repeat(points.radius.ravel(), tracks.samples))
    p, cos_theta = (np.asarray(0.5 * (low + high)) for low, high in (points.p, points.cos_theta))
    # Other detectors share points: whoever changes these arrays changes copies.
    phi, radius = points.phi.copy(), points.radius.copy()
    return Covariance(detector, points.particle, p, cos_theta, phi, radius, points, tracks, columns)


def entries_at(
    points: Points, detector: Detector, digitize: DigitizeSettings, fit: FitSettings, mixed: int = 1
) -> Entries:
    """Return what `core_widths` needs of a detector at points at the origin, on one core; see `covariance_at`."""
    sample, tracks = tracks_at(points, detector, digitize, fit, 1)
    out = tracks.run(budget=False)
    return Entries(sample, out["covariance"], out["status"], mixed)


def tracks_at(
    points: Points, detector: Detector, digitize: DigitizeSettings, fit: FitSettings, threads: int | None = None
) -> tuple[Sample, Tracks]:
    """Return the sample of points, and its tracks in a detector."""
    if fit.beam is not None:
        raise ValueError(f"fit.beam: got {fit.beam}, expected None: expected resolutions do without the beam spot")
    hits = expected_hits(detector, digitize, fit)
    samples = points.samples or (_SAMPLES if hits.vary or points.vary else 1)
    sample = sample_of(points, samples, len(detector.layers))
    scatter = samples > 1 and points.at_origin
    scatters = near_ends(detector, sample.kappa, sample.tanl) if scatter else np.zeros(len(sample.kappa))
    tracks = Tracks(
        detector, fit, hits.model, sample.psi, sample.kappa, sample.tanl, sample.mass, sample.charge,
        scatters.astype(np.float64), samples, sample.phases, threads,
        efficiencies_of(detector, sample.kappa, sample.tanl, sample.mass, sample.charge),
    )  # fmt: skip
    return sample, tracks


#: Tracks of a point. With a number such as 128, which has factors in common with the numbers of cells, all tracks would
#: cross a layer at the same position in a cell, and σ(p) would be 14 times less accurate.
_SAMPLES = 127
#: Probability of no clusters above which tracks of the same direction are sampled.
_SAMPLED_LOSS = 1e-3


class ExpectedHits(NamedTuple):
    """How hits are expected.

    Attributes
    ----------
    model : dict
    vary : bool
        Whether they vary among tracks of the same direction.
    """

    model: HitModel
    vary: bool


def expected_hits(detector: Detector, digitize: DigitizeSettings, fit: FitSettings) -> ExpectedHits:
    """Return how hits of a detector are expected."""
    clusterers = tuple(clusterer_of(group.readout) for group in detector.groups)
    return _hit_model(detector, clusterers, digitize.reveal_sides, fit)


@once
def _hit_model(
    detector: Detector, clusterers: tuple[Clusterer, ...], sides_known: bool, fit: FitSettings
) -> ExpectedHits:
    """Return how hits are expected from the clusterers of the groups of layers, which may be registered anew."""
    model: HitModel = {
        "least_width": fit.least_width, "delta_strips": fit.delta_strips, "sides_known": sides_known, "seed": 0,
        "prior_sigma": fit.prior_in(detector),
    }  # fmt: skip
    model = with_errors_of(model, detector)
    gaps = any(layer.dead_seam > 0 or layer.ladder_gap > 0 for layer in detector.layers)
    lost = gaps or _inefficient(detector) or any(most_unseen(layer) > _SAMPLED_LOSS for layer in detector.layers)
    given = np.all(np.array(model["sigma_x"]) > 0) and np.all(np.array(model["sigma_v"]) > 0)
    return ExpectedHits(model, lost or not given)


def with_errors_of(model: HitModel, detector: Detector) -> HitModel:
    """Return a model with the errors that clusters have in a detector."""
    groups = detector.groups
    errors = [_errors(group, clusterer_of(group.readout)) for group in groups]
    angles = max(values.shape[1] for one in errors for values in one)
    columns = np.empty((3, len(detector.layers), angles))
    for group, one in zip(groups, errors, strict=True):
        for column, values in zip(columns, one, strict=True):
            column[list(group.numbers)] = values
    x, v, correlation = (column.ravel().tolist() for column in columns)
    cos_theta = COS_THETA if angles > 1 else np.zeros(1)
    return model | {"cos_theta": cos_theta.tolist(), "sigma_x": x, "sigma_v": v, "corr_xv": correlation}


def _errors(group: ReadoutGroup, clusterer: Clusterer) -> tuple[Floats, Floats, Floats]:
    """Return errors of X and V, mm, and their correlations, each (layers, 1) or (layers, len(COS_THETA))."""
    name, layers = group.readout.name, len(group.layers)
    sigma_x, sigma_v = clusterer.expected_errors(group)
    given = {"sigma_x": sigma_x, "sigma_v": sigma_v, "correlations": clusterer.expected_correlations(group)}
    x, v, xv = (_by_angle(f"readout {name}: {what}", one, layers) for what, one in given.items())
    for what, values in (("sigma_x", x), ("sigma_v", v)):
        if not (np.isfinite(values) & (values >= 0) & ((values > 0) == (values[:, :1] > 0))).all():
            raise ValueError(f"readout {name}: {what}: expected errors above 0, or 0 for all of a layer")
    if not (np.abs(xv) < 1).all():
        raise ValueError(f"readout {name}: correlations: expected numbers between -1 and 1")
    return x, v, np.where((x[:, :1] > 0) & (v[:, :1] > 0), xv, 0.0)  # others are not given


def _by_angle(name: str, given: npt.ArrayLike, layers: int) -> Floats:
    values = np.asarray(given, np.float64)
    if values.shape not in ((layers,), (layers, len(COS_THETA))):
        raise ValueError(f"{name}: got shape {values.shape}, expected ({layers},) or ({layers}, {len(COS_THETA)})")
    return values.reshape(layers, -1) if layers else np.zeros((0, 1))


def _inefficient(detector: Detector) -> bool:
    chamber = detector.drift_chamber
    return chamber is not None and _loses_hits(chamber)


@once
def _loses_hits(chamber: DriftChamber) -> bool:
    return any(layer.efficiency < 1 for layer in chamber.layers)
