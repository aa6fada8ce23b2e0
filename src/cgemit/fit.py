"""Track fit: Kalman filter from the outermost hit inward to the origin (docs/methods/fit.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.candidates import FitHits, collect_hits
from cgemit.detector import SCREENINGS, Detector, compiled, load
from cgemit.fit_begins import BEGIN, begins_of, displaced, fit_by_begin, slabs_inside
from cgemit.fit_settings import FitSettings as FitSettings
from cgemit.species import HYPOTHESES
from cgemit.start_times import fit_with_start_times
from cgemit.states import state_columns
from cgemit.tables import Table

FitStatus = _core.FitStatus
Floats = npt.NDArray[np.float64]
Column = npt.NDArray[Any]
Columns = dict[str, npt.ArrayLike]
Out = dict[str, npt.NDArray[np.generic]]  # what the compiled fit returns

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
        ``settings.states`` also ``states``, and with a fitted start time also ``start_times``. Rows whose `status` is
        not ok hold the last helix tried, and NaN where there is no helix, covariance or chi-square.

    Raises
    ------
    TypeError
        If the settings are something else.
    ValueError
        Listing every problem of the hits or the start.
    """
    detector, settings = load(detector), FitSettings() if settings is None else settings
    if not isinstance(settings, FitSettings):
        raise TypeError(f"settings: got {type(settings).__name__}, expected FitSettings")
    if settings.start_time == "fitted":

        def fit_shifted(hits: Table, some: Table, theirs: Table, how: FitSettings, begin: Floats) -> dict[str, Table]:
            return fit(detector, clusters, hits, some, theirs, how, start=begin if len(begin) else None)

        begin = _start(start, len(candidates))
        found = fit_with_start_times(fit_shifted, wire_hits, candidates, candidate_hits, settings, begin)
        tracks = found["tracks"]
        return found | {"tracks": tracks.with_columns(displaced=displaced(tracks["dr"], tracks["err_dr"], detector))}
    if BEGIN in candidates and len(candidates):
        given = _start(start, len(candidates))

        def fit_rows(some: Table, their_hits: Table, radius: FitSettings, rows: Column) -> dict[str, Table]:
            helices = given[rows] if len(given) else None
            return fit(detector, clusters, wire_hits, some, their_hits, radius, start=helices)

        return fit_by_begin(fit_rows, begins_of(candidates, detector), candidates, candidate_hits, settings)
    core = compiled_for_fit(detector, settings)
    hits = collect_hits(core, candidates, candidate_hits, clusters, wire_hits)
    names = settings.hypotheses()
    candidate, pdg, mass = _with_hypotheses(candidates, names)
    begin = _start(start, len(candidates))
    if len(names) > 1:
        hits, begin = _repeated(hits, candidate), begin[candidate] if len(begin) else begin
    out = _core.fit(**core_arguments(detector, hits, mass, begin, settings))
    event = candidates["event"].take(candidate)
    about = candidates.cover | {
        "meta": {name: candidates.meta[name] for name in ("finder",) if name in candidates.meta}
    }
    columns = _track_columns(out, event, candidate, pdg)
    columns["displaced"] = displaced(out["helix"][:, 0], np.asarray(columns["err_dr"]), detector)
    tables = {"tracks": Table("tracks", columns, **about)}
    if settings.residuals:
        tables["residuals"] = Table("residuals", _residual_columns(out, hits, event), **about)
    if settings.states:
        settled = out["status"] == FitStatus.ok
        columns = state_columns(detector, core, settings.states, tables["tracks"], mass, hits, out, settled)
        tables["states"] = Table("states", columns, **about)
    return tables


def _start(given: npt.ArrayLike | None, n: int) -> Floats:
    """Return the starting helices, (n, 5), or (0, 5) for none."""
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
    screening = settings.screening or SCREENINGS[0]
    return compiled(
        detector, screening=screening, loss=settings.loss, radiation=settings.radiation, gaps=False,
        matter=settings.matter, inside=slabs_inside(detector, settings.start_radius),
    )  # fmt: skip


def core_arguments(
    detector: Detector, hits: FitHits, mass: Floats, start: Floats, settings: FitSettings
) -> dict[str, Any]:
    """Return the arguments of the compiled fit.

    Parameters
    ----------
    detector : Detector
    hits : FitHits
    mass : ndarray, (n,) float64, GeV/c2
    start : ndarray, (n, 5) float64
        Starting helices; (0, 5): the hits provide them.
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


def has_cov(status: npt.NDArray[np.generic]) -> npt.NDArray[np.bool_]:
    """Return whether fits with these statuses have a covariance and a chi-square.

    Parameters
    ----------
    status : ndarray, (n,) int8

    Returns
    -------
    ndarray, (n,) bool
    """
    return np.isin(status, (FitStatus.ok, FitStatus.not_converged, FitStatus.unconstrained))


def _track_columns(out: Out, event: Column, candidate: Column, pdg: Column) -> Columns:
    """Return the columns of the tracks table; `event`, `candidate` (row) and `pdg` (of the mass) of each track."""
    no_helix = np.isin(out["status"], (_core.FitStatus.too_few_hits, _core.FitStatus.seed_failed))
    fitted = np.where(no_helix[:, None], np.nan, out["helix"])
    known = has_cov(out["status"])
    cov = np.where(known[:, None, None], out["cov"], np.nan)
    columns: Columns = {"event": event, "candidate": candidate, "hypothesis": pdg}
    columns |= {name: fitted[:, i] for i, name in enumerate(helix.PARAMETERS)}
    columns |= {"cov": cov, "p": helix.momentum(fitted)}
    columns |= {name: out[name] for name in ("ndf", "n_clusters", "n_wires", "n_outliers", "iterations", "status")}
    columns["chi2"] = np.where(known, out["chi2"], np.nan)
    error = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    columns |= {f"err_{name}": error[:, i] for i, name in enumerate(helix.PARAMETERS)}
    return columns | {"err_p": helix.momentum_error(fitted, cov)}


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
        "hit": pick(hits.row),
        "residual": residual,
        "err": err,
        "pull": residual / err,
        "side": pick(out["side"]),
        "used": pick(out["used"]),
    }


def _with_hypotheses(candidates: Table, names: tuple[str, ...]) -> tuple[Column, Column, Column]:
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
    """
    n = len(candidates)
    if not names:
        return np.arange(n), candidates["pdg"], candidates["mass"]
    kinds = [HYPOTHESES[name] for name in names]
    pdg, mass = ([kind.pdg for kind in kinds], [kind.mass for kind in kinds])
    return np.repeat(np.arange(n), len(kinds)), np.tile(pdg, n), np.tile(mass, n)


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
