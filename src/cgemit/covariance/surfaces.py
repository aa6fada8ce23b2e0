"""Covariances where tracks leave a cylinder, from the states of the fit."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.candidates import HIT_WIRE
from cgemit.covariance.tracks import Tracks
from cgemit.fit import FitStatus, compiled_for_fit
from cgemit.states import StateStatus, Surface, shares_inside

Floats = npt.NDArray[np.float64]
Columns = dict[str, npt.NDArray[Any]]

_UPPER = np.triu_indices(5)
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
    for one in np.unique(radius):
        rows = np.flatnonzero((radius == one) & (out["status"] == FitStatus.ok))
        found = _states(tracks, hits, offsets, rows, float(one))
        kappa[rows], tanl[rows] = found["helix"][:, 2], found["helix"][:, 4]
        entries[rows] = found["cov"][:, _UPPER[0], _UPPER[1]]
        for lost, instead in _LOST.items():
            status[rows[found["status"] == lost]] = instead
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
    states: Columns = _core.states(
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
        prior=np.tile(np.diag(np.square(tracks.fit.prior_sigma)).ravel(), (n, 1)),
        mass=tracks.mass[rows],
        fitted=np.ones(n, np.uint8),
        targets={
            "surface": np.array([Surface.cylinder], np.int8), "radius": np.array([radius]),
            "share": shares_inside(tracks.detector, np.array([radius])),
        },
    )  # fmt: skip
    return states
