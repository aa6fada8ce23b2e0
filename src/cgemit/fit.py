"""Track fit: Kalman filter from the outermost hit inward to the origin (docs/methods/fit.md)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.candidates import Candidates, FitHits, fit_hits, with_masses
from cgemit.detector import SCREENINGS, Detector, compiled
from cgemit.fit_settings import FitSettings as FitSettings
from cgemit.species import HYPOTHESES
from cgemit.states import state_columns
from cgemit.tables import Table
from cgemit.tracks import residual_columns, track_columns

FitStatus = _core.FitStatus
Floats = npt.NDArray[np.float64]

PARAMETERS = helix.PARAMETERS


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
            kinks=settings.kinks,
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
