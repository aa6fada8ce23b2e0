"""Track fit: Kalman filter from the outermost hit inward to the origin (docs/methods/fit.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.candidates import FitHits, collect_hits
from cgemit.detector import SCREENINGS, Detector, compiled, load
from cgemit.fit_settings import FitSettings as FitSettings
from cgemit.states import state_columns
from cgemit.tables import Table
from cgemit.tracks import repeated, residual_columns, track_columns, with_hypotheses

FitStatus = _core.FitStatus
Floats = npt.NDArray[np.float64]

PARAMETERS = helix.PARAMETERS


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
        Hits in any order: the fit takes them from the beam line outward.
    settings : FitSettings or None
    start : array_like or None
        Helices to begin with, (candidates, 5) float64: dr mm, phi0 rad, kappa (GeV/c)^-1, dz mm, tanl. None: the hits
        provide them.

    Returns
    -------
    dict of str to Table
        ``tracks``, one row per candidate and mass hypothesis, with ``settings.residuals`` also ``residuals``, and with
        ``settings.states`` also ``states``. Rows whose `status` is not ok hold the last helix tried, and NaN where
        there is no helix, covariance or chi-square.

    Raises
    ------
    TypeError
        If the settings are something else.
    ValueError
        Listing everything that is wrong with the hits or the start.
    """
    detector, settings = load(detector), FitSettings() if settings is None else settings
    if not isinstance(settings, FitSettings):
        raise TypeError(f"settings: got {type(settings).__name__}, expected FitSettings")
    core = compiled_for_fit(detector, settings)
    hits = collect_hits(core, candidates, candidate_hits, clusters, wire_hits)
    names = settings.hypotheses()
    candidate, pdg, mass = with_hypotheses(candidates, names)
    begin = _start(start, len(candidates))
    if len(names) > 1:
        hits, begin = repeated(hits, candidate), begin[candidate] if len(begin) else begin
    out = _core.fit(**core_arguments(detector, hits, mass, begin, settings))
    event = candidates["event"].take(candidate)
    about = candidates.cover | {
        "meta": {name: candidates.meta[name] for name in ("finder",) if name in candidates.meta}
    }
    tables = {"tracks": Table("tracks", track_columns(out, event, candidate, pdg), **about)}
    if settings.residuals:
        tables["residuals"] = Table("residuals", residual_columns(out, hits, event), **about)
    if settings.states:
        settled = out["status"] == FitStatus.ok
        columns = state_columns(detector, core, settings.states, tables["tracks"], mass, hits, out, settled)
        tables["states"] = Table("states", columns, **about)
    return tables


def _start(given: npt.ArrayLike | None, n: int) -> Floats:
    """Return the helices to begin with, (n, 5), or (0, 5) for none."""
    if given is None:
        return np.empty((0, 5))
    start = np.ascontiguousarray(given, np.float64)
    if start.shape != (n, 5):
        raise ValueError(f"start: got shape {start.shape}, expected ({n}, 5), a helix for each candidate")
    wrong = np.flatnonzero(~np.isfinite(start).all(axis=1))
    if len(wrong):
        raise ValueError(f"start: got {start[wrong[0]]} in row {wrong[0]}, expected finite numbers")
    return start


def compiled_for_fit(detector: Detector, settings: FitSettings) -> _core.Detector:
    """Return the compiled detector with the matter that the fit assumes.

    Parameters
    ----------
    detector : Detector
    settings : FitSettings
    """
    return compiled(detector, screening=settings.screening or SCREENINGS[0], loss=settings.loss)


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
        "detector": compiled_for_fit(detector, settings),
        "hit_offsets": hits.hit_offsets,
        "hits": hits.columns(),
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
