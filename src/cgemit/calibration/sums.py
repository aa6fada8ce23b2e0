"""Normal equations of constants from fitted tracks, or from tracks that are expected (docs/methods/alignment.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.analysis.cosmics import BACKWARD, halves
from cgemit.base.arrays import Floats
from cgemit.calibration.constants import Constant, columns_of
from cgemit.covariance.analytic import expected_hits
from cgemit.covariance.tracks import draws, efficiencies_of
from cgemit.detector import Detector
from cgemit.particles.gun import Guns, Source, generate
from cgemit.reconstruction.fit import FitSettings, compiled_for_fit, fit_columns
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.tables import Table
from cgemit.tables.schema import HIT_WIRE, FitStatus

#: Of the prior of a fit. The fit's own would hold displacements that all tracks follow: 1e4 tracks with an error of
#: 200 mm of d_rho would tell a common shift to 2 mm.
WIDER = 20.0
_BLOCK = 2048  # tracks of one task


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over tracks.

    Attributes
    ----------
    normal : ndarray, (n, n) float64
        Information of the data on constants, each in mm, rad or 1.
    right : ndarray, (n,) float64
        The constants are ``normal^-1 right``.
    measured : ndarray, (n,) float64
        Information of each constant alone if the tracks were known.
    tracks, hits, pairs : int
        Numbers of tracks and hits, and of pairs of tracks that were constrained to agree.
    chi2 : float
        Of all tracks and pairs.
    """

    normal: Floats
    right: Floats
    measured: Floats
    tracks: int = 0
    hits: int = 0
    pairs: int = 0
    chi2: float = 0.0

    @classmethod
    def none(cls, constants: int) -> Sums:
        """Return the sums of no tracks."""
        return cls(np.zeros((constants, constants)), np.zeros(constants), np.zeros(constants))

    def __add__(self, other: Sums) -> Sums:
        return Sums(**{name: getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__})

    def scaled(self, factor: float) -> Sums:
        """Return the sums of `factor` times as many tracks of the same kind."""
        found = {name: factor * getattr(self, name) for name in self.__dataclass_fields__}
        return Sums(**found | {name: round(found[name]) for name in ("tracks", "hits", "pairs")})


def fitted_sums(
    detector: Detector, tables: Mapping[str, Table], constants: Sequence[Constant], fit: FitSettings, *,
    cosmic: bool = False, scattering: bool = True, pool: Executor | None = None,
) -> Sums:  # fmt: skip
    """Fit the candidates of tables and return the sums over their tracks.

    Parameters
    ----------
    detector : Detector
    tables : mapping of str to Table
        ``clusters``, ``wire_hits``, ``candidates`` and ``candidate_hits``.
    constants : sequence of Constant
    fit : FitSettings
    cosmic : bool
        Whether an upward and a downward track of an event are halves of one muon.
    scattering : bool
        Whether matter scatters, in the sums.
    pool : Executor or None
    """
    clusters, wire_hits, candidates, candidate_hits = (
        tables[name] for name in ("clusters", "wire_hits", "candidates", "candidate_hits")
    )
    how = replace(fit, states=("origin",), residuals=True)
    fitted = fit_columns(detector, clusters, wire_hits, candidates, candidate_hits, how)
    out, hits = fitted.out, fitted.hits
    good = np.flatnonzero(np.isin(out["status"], (FitStatus.ok, FitStatus.unconstrained)))
    columns = {**hits.columns(), **{name: out[name] for name in ("used", "used_value", "used_variance")}}
    counts = np.diff(hits.hit_offsets)
    given = {
        "reference": out["reference"], "mass": fitted.mass, "matter_p": out["matter_p"],
        "kinks": out["kinks"].reshape(len(counts), -1), "start_radius": fitted.radii,
        "charge": np.asarray(fitted.charge, np.float64),
    }  # fmt: skip
    event = tables["candidates"]["event"][fitted.candidate]
    return track_sums(
        fitted.core, detector, constants, hits.hit_offsets, columns, given, good, event, fit,
        cosmic=cosmic, scattering=scattering, pool=pool,
    )  # fmt: skip


def residual_means(detector: Detector, tables: Mapping[str, Table], fit: FitSettings) -> dict[str, tuple[float, float]]:
    """Return mean residuals of the views of layers, and their errors, mm, by names such as ``"L1 X"``.

    Residuals are those to the tracks without the hit; a mean weights them by their errors.

    Parameters
    ----------
    detector : Detector
    tables : mapping of str to Table
        As of `fitted_sums`.
    fit : FitSettings
    """
    clusters, wire_hits, candidates, candidate_hits = (
        tables[name] for name in ("clusters", "wire_hits", "candidates", "candidate_hits")
    )
    fitted = fit_columns(detector, clusters, wire_hits, candidates, candidate_hits, replace(fit, residuals=True))
    out, hits = fitted.out, fitted.hits
    good = (out["used"] == 1) & (out["err"] > 0)
    found = {}
    for number, layer in enumerate(detector.layers):
        for view, name in enumerate("XV"):
            rows = good & (hits.kind == view) & (hits.layer == number)
            weight = 1 / out["err"][rows] ** 2
            if len(weight):
                mean = float(np.sum(weight * out["residual"][rows]) / np.sum(weight))
                found[f"{layer.label} {name}"] = mean, float(1 / np.sqrt(np.sum(weight)))
    return found


def expected_sums(
    detector: Detector, source: Source | Guns, tracks: int, constants: Sequence[Constant], fit: FitSettings, *,
    seed: int = 1, reveal_sides: bool = False, cosmic: bool = False, pool: Executor | None = None,
) -> Sums:  # fmt: skip
    """Return the sums over the tracks that some events of a source are expected to leave.

    Parameters
    ----------
    detector : Detector
    source : Source or Guns
    tracks : int
        Number of events.
    constants : sequence of Constant
    fit : FitSettings
    seed : int
        Of the events.
    reveal_sides : bool
        Whether wire hits tell their side.
    cosmic : bool
        As of `fitted_sums`.
    pool : Executor or None
    """
    particles = generate(source, tracks, seed, detector=detector)
    helices = helix.at_origin(particles, detector.field.bz)
    rows = np.flatnonzero(np.isfinite(helices).all(axis=1))
    helices, event = helices[rows], particles["event"][rows]
    mass, charge = (np.asarray(particles[name], np.float64)[rows] for name in ("mass", "charge"))
    given = expected_tracks(detector, helices, mass, np.abs(charge), fit, reveal_sides=reveal_sides)
    return track_sums(
        compiled_for_fit(detector, fit), detector, constants, *given[:3], given[3], event, fit, cosmic=cosmic, pool=pool
    )


def expected_tracks(
    detector: Detector, helices: Floats, mass: Floats, charge: Floats, fit: FitSettings, *, reveal_sides: bool = False
) -> tuple[npt.NDArray[np.int64], dict[str, Any], dict[str, Any], npt.NDArray[np.intp]]:
    """Return the hits that tracks are expected to leave, as `track_sums` takes them.

    Parameters
    ----------
    detector : Detector
    helices : ndarray, (n, 5) float64
    mass, charge : ndarray, (n,) float64, GeV/c2 and e
    fit : FitSettings
    reveal_sides : bool

    Returns
    -------
    offsets : ndarray, (n + 1,) int64
    hits, given : dict of str to ndarray
        Of the hits, and of the tracks.
    good : ndarray, int
        Rows of the tracks that were expected to be measured.
    """
    core = compiled_for_fit(detector, fit)
    model = expected_hits(detector, DigitizeSettings(reveal_sides=reveal_sides), fit).model
    n, dr, psi = len(helices), helices[:, 0], helices[:, 1] + 0.5 * np.pi
    kappa, tanl = np.ascontiguousarray(helices[:, 2]), np.ascontiguousarray(helices[:, 4])
    views, parts = 2 * len(detector.layers), list[dict[str, Any]]()
    for first in range(0, n, _BLOCK):
        one = slice(first, min(first + _BLOCK, n))
        count = one.stop - first
        parts.append(
            _core.covariance.covariances(
                core, phi=psi[one], kappa=kappa[one], tanl=tanl[one], mass=mass[one], charge=charge[one],
                scatters=np.zeros(count), samples=count,
                phases=draws(count, 1 + views)[:, 1:] if views else np.zeros((count, 0)),
                efficiencies=efficiencies_of(detector, kappa[one], tanl[one], mass[one], charge[one]),
                model=model | {"seed": first}, budget=False, hits=True, dr=dr[one], dz=helices[one, 3],
            )
        )  # fmt: skip
    if not parts:
        return np.zeros(1, np.int64), {}, {}, np.zeros(0, np.intp)
    hits = {f"hit_{name}": np.concatenate([part["hits"][name] for part in parts]) for name in parts[0]["hits"]}
    of_tracks = {name: np.concatenate([part[name] for part in parts]) for name in ("status", "n_clusters", "n_wires")}
    return as_fitted(core, hits | of_tracks, helices, mass, charge)


def as_fitted(
    core: _core.detector.Detector, found: Mapping[str, npt.NDArray[Any]], helices: Floats, mass: Floats, charge: Floats
) -> tuple[npt.NDArray[np.int64], dict[str, Any], dict[str, Any], npt.NDArray[np.intp]]:
    """Return expected hits as `track_sums` takes them; see `expected_tracks`.

    Parameters
    ----------
    core : _core.detector.Detector
    found : mapping of str to ndarray
        As of `Tracks.run` with hits.
    helices : ndarray, (n, 5) float64
    mass, charge : ndarray, (n,) float64, GeV/c2 and e
    """
    n, status = len(helices), found["status"]
    counts = found["n_clusters"].astype(np.int64) + found["n_wires"]
    found = {name.removeprefix("hit_"): one for name, one in found.items() if name.startswith("hit_")}
    wire = found["kind"] == HIT_WIRE
    hits = {
        **{name: found[name] for name in ("kind", "layer", "channel", "k", "x")},
        "size": np.zeros(len(wire), np.int32), "value": np.where(wire, np.abs(found["value"]), found["value"]),
        "sigma": np.sqrt(found["variance"]), "used": np.ones(len(wire), np.uint8),
        "used_value": found["value"], "used_variance": found["variance"],
    }  # fmt: skip
    given = {
        "reference": helices + np.array([0, 0.5 * np.pi, 0, 0, 0]), "mass": mass, "charge": charge,
        "matter_p": np.zeros(n), "kinks": np.zeros((n, 2 * core.n_slabs)), "start_radius": np.zeros(n),
    }  # fmt: skip
    return np.concatenate([[0], np.cumsum(counts)]), hits, given, np.flatnonzero(status == FitStatus.ok)


def track_sums(
    core: _core.detector.Detector, detector: Detector, constants: Sequence[Constant], offsets: npt.NDArray[np.int64],
    hits: Mapping[str, npt.NDArray[Any]], given: Mapping[str, npt.NDArray[Any]], good: npt.NDArray[np.intp],
    event: npt.NDArray[np.int64], fit: FitSettings, *, cosmic: bool = False, scattering: bool = True,
    pool: Executor | None = None,
) -> Sums:  # fmt: skip
    """Return the sums over tracks.

    Parameters
    ----------
    core, detector : _core.detector.Detector, Detector
    constants : sequence of Constant
    offsets : ndarray, (n + 1,) int64
    hits, given : mapping of str to ndarray
        Of the hits, and of the tracks.
    good : ndarray, int
        Rows of the tracks that are summed.
    event : ndarray, (n,) int64
    fit : FitSettings
    cosmic, scattering : bool
    pool : Executor or None
    """
    columns = columns_of(detector, constants)
    prior = [WIDER * sigma for sigma in fit.prior_in(detector)]

    def part(rows: npt.NDArray[np.intp]) -> Sums:
        found = core_sums(core, columns, offsets, hits, given, rows, prior, bias=cosmic, scattering=scattering)
        used = found["used"] == 1
        sums = Sums(
            found["normal"], found["right"], found["measured"], int(used.sum()), int(found["hits"][used].sum()), 0,
            float(found["chi2"][used].sum()),
        )  # fmt: skip
        return sums + cosmic_pairs(found, event[rows]) if cosmic else sums

    blocks = np.split(good, _borders(good, event)) if len(good) else []
    total = Sums.none(len(constants))
    for one in map(part, blocks) if pool is None else pool.map(part, blocks):
        total = total + one
    return total


def _borders(good: npt.NDArray[np.intp], event: npt.NDArray[np.int64]) -> list[int]:
    """Return where blocks of tracks end, none within an event."""
    found, last = [], 0
    starts = np.flatnonzero(np.diff(event[good])) + 1
    for start in starts.tolist():
        if start - last >= _BLOCK:
            found.append(start)
            last = start
    return found


def core_sums(
    core: _core.detector.Detector, columns: dict[str, Any], offsets: npt.NDArray[np.int64],
    hits: Mapping[str, npt.NDArray[Any]], given: Mapping[str, npt.NDArray[Any]], rows: npt.NDArray[np.intp],
    prior: Sequence[float], *, bias: bool = False, scattering: bool = True,
) -> dict[str, npt.NDArray[Any]]:  # fmt: skip
    """Return what the core makes of some tracks.

    Parameters
    ----------
    core : _core.detector.Detector
    columns : dict
        Of `columns_of`.
    offsets : ndarray, (n + 1,) int64
    hits, given : mapping of str to ndarray
    rows : ndarray, int
    prior : sequence of float
    bias, scattering : bool
    """
    of_tracks: dict[str, Any] = {name: column[rows] for name, column in given.items()}
    counts = np.diff(offsets)[rows]
    begin = np.concatenate([[0], np.cumsum(counts)])
    at = np.repeat(offsets[rows] - begin[:-1], counts) + np.arange(begin[-1])
    found: dict[str, npt.NDArray[Any]] = _core.calibration.sums(
        core, columns=columns, hit_offsets=begin, hits={name: column[at] for name, column in hits.items()},
        **of_tracks, prior_sigma=list(prior), bias=bias,
        scattering=scattering,
    )  # fmt: skip
    return found


def cosmic_pairs(found: Mapping[str, npt.NDArray[Any]], event: npt.NDArray[np.int64]) -> Sums:
    """Return the sums over the halves of muons that cross the detector: both are the same track.

    Parameters
    ----------
    found : mapping of str to ndarray
        Of the core, with ``bias``.
    event : ndarray, (n,) int64
    """
    upper, lower = halves(event, found["helix"][:, 1], found["used"] == 1)
    constants = len(found["right"])
    if not len(upper):
        return Sums.none(constants)
    apart = found["helix"][lower] - found["helix"][upper] * BACKWARD
    apart[:, 1] = helix.wrap_angle(apart[:, 1] - np.pi)
    cov = found["cov"][lower] + BACKWARD[:, None] * found["cov"][upper] * BACKWARD
    slope = found["bias"][lower] - found["bias"][upper] * BACKWARD  # (pairs, constants, 5)
    return constrained(apart, cov, slope)


def constrained(apart: Floats, cov: Floats, slope: Floats) -> Sums:
    """Return the sums over constraints between fitted tracks: quantities that are 0 but for errors and constants.

    Parameters
    ----------
    apart : ndarray, (n, k) float64
        Their values.
    cov : ndarray, (n, k, k) float64
    slope : ndarray, (n, constants, k) float64
        Their derivatives by the constants.
    """
    # The errors of quantities differ by orders of magnitude.
    scale = 1 / np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    weight = np.linalg.inv(cov * scale[:, :, None] * scale[:, None, :])
    apart, slope = apart * scale, slope * scale[:, None, :]
    weighted = np.einsum("nij,ncj->nci", weight, slope)
    k = slope.shape[1]
    normal = weighted.transpose(1, 0, 2).reshape(k, -1) @ slope.transpose(1, 0, 2).reshape(k, -1).T
    right = np.einsum("nci,ni->c", weighted, apart)
    chi2 = float(np.einsum("ni,nij,nj->", apart, weight, apart))
    return Sums(0.5 * (normal + normal.T), right, np.zeros(k), pairs=len(apart), chi2=chi2)
