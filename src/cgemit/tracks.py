"""Tracks for the fit to make, and what it found as columns of the tables tracks and residuals (docs/methods/fit.md)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.candidates import FitHits
from cgemit.species import HYPOTHESES
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Column = npt.NDArray[Any]
Columns = dict[str, npt.ArrayLike]
Out = dict[str, npt.NDArray[np.generic]]  # what the compiled fit returns


def has_cov(status: npt.NDArray[np.generic]) -> npt.NDArray[np.bool_]:
    """Return whether fits that ended so have a covariance and a chi-square."""
    return np.isin(status, (_core.FitStatus.ok, _core.FitStatus.not_converged, _core.FitStatus.unconstrained))


def track_columns(out: Out, event: Column, candidate: Column, pdg: Column) -> Columns:
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


def residual_columns(out: Out, hits: FitHits, event: Column) -> Columns:
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


def with_hypotheses(candidates: Table, names: tuple[str, ...]) -> tuple[Column, Column, Column]:
    """Return the tracks that the fit makes: each candidate once for every mass that it shall assume.

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


def repeated(hits: FitHits, candidate: Column) -> FitHits:
    """Return the hits of candidates picked by row, each as often as it is picked.

    Parameters
    ----------
    hits : FitHits
    candidate : ndarray, (n,) int64
    """
    counts = np.diff(hits.hit_offsets)[candidate]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    # Hit j of a repeated candidate is as far behind its first one as in the original.
    at = np.arange(offsets[-1]) + np.repeat(hits.hit_offsets[:-1][candidate] - offsets[:-1], counts)
    return FitHits(offsets, **{name: column[at] for name, column in hits.columns().items()})
