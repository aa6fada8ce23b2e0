"""Normal equations of constants from fitted tracks, or from tracks that are expected (docs/methods/alignment.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.base.arrays import Floats, Ints
from cgemit.calibration.blocks import Blocks
from cgemit.calibration.constants import Constant, columns_of, neighbours, of_single_wires
from cgemit.calibration.constraints import Quantities, known_tracks, quantities
from cgemit.calibration.settings import AlignmentSettings
from cgemit.covariance.analytic import expected_hits
from cgemit.covariance.tracks import draws, efficiencies_of
from cgemit.detector import Detector
from cgemit.particles.gun import Guns, Source, generate
from cgemit.particles.species import usual_mass
from cgemit.reconstruction.fit import FitSettings, compiled_for_fit, fit_columns
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.tables import Table
from cgemit.tables.schema import HIT_WIRE, FitStatus, has_momentum

#: Of the prior of a fit. The fit's own would hold displacements that all tracks follow: 1e4 tracks with an error of
#: 200 mm of d_rho would tell a common shift to 2 mm.
WIDER = 20.0
_BLOCK = 2048  # tracks of one task
#: Of the sums of single wires, each of which has a matrix; the order of their sum does not depend on threads.
_TASKS = 2
_COLUMNS = 512  # constants of a block of their matrix
_WILD = 10.0  # times the median, from which on tracks are not joined before any alignment
_KNOWN = 3.0  # errors of a drift distance, from which on the side of a hit is known


@dataclass(frozen=True, eq=False)
class Rows:
    """Independent measurements of constants: a residual with its error, and what constants do to it.

    The sums are those over the rows of derivative derivative'/error^2 and derivative residual/error^2.

    Attributes
    ----------
    event : ndarray, (n,) int64
    residual, error : ndarray, (n,) float64
    ends : ndarray, (n,) int64
        Of the derivatives of each row.
    column : ndarray, (m,) int32
        Constant of each derivative.
    derivative : ndarray, (m,) float64
    """

    event: npt.NDArray[np.int64]
    residual: Floats
    error: Floats
    ends: npt.NDArray[np.int64]
    column: npt.NDArray[np.int32]
    derivative: Floats


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over tracks.

    Attributes
    ----------
    normal : ndarray, (n, n) float64, or Blocks
        Information of the data on constants, each in mm, rad or 1; of single wires in blocks.
    right : ndarray, (n,) float64
        The constants are ``normal^-1 right``.
    measured : ndarray, (n,) float64
        Information of each constant alone if the tracks were known.
    tracks, hits, pairs : int
        Numbers of tracks and hits, and of pairs of tracks that were constrained to agree.
    left_out : int
        Number of pairs that were not, since they are too far apart.
    chi2 : float
        Of all tracks and pairs.
    rows : tuple of Rows
        What they are sums of, if asked for.
    """

    normal: Floats | Blocks
    right: Floats
    measured: Floats
    tracks: int = 0
    hits: int = 0
    pairs: int = 0
    left_out: int = 0
    chi2: float = 0.0
    rows: tuple[Rows, ...] = ()

    @classmethod
    def none(cls, detector: Detector, constants: Sequence[Constant]) -> Sums:
        """Return the sums of no tracks."""
        n = len(constants)
        normal: Floats | Blocks
        if of_single_wires(constants):
            normal = Blocks(neighbours(detector, constants), _first_columns(constants), {}, np.zeros(n, np.int64))
        else:
            normal = np.zeros((n, n))
        return cls(normal, np.zeros(n), np.zeros(n))

    def __add__(self, other: Sums) -> Sums:
        return Sums(**{name: getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__})

    def scaled(self, factor: float) -> Sums:
        """Return the sums of `factor` times as many tracks of the same kind."""
        numbers = {name: round(factor * getattr(self, name)) for name in ("tracks", "hits", "pairs", "left_out")}
        others = {name: factor * getattr(self, name) for name in ("normal", "right", "measured", "chi2")}
        return Sums(**others, **numbers)


def _first_columns(constants: Sequence[Constant]) -> Ints:
    """Return where blocks of constants of single wires begin, and the number of constants."""
    n = len(constants)
    return np.linspace(0, n, max(n // _COLUMNS, 1) + 1).astype(np.int32)


def fitted_sums(
    detector: Detector, tables: Mapping[str, Table], constants: Sequence[Constant], fit: FitSettings, *,
    settings: AlignmentSettings | None = None, pool: Executor | None = None, rows: bool = False,
) -> Sums:  # fmt: skip
    """Fit the candidates of tables and return the sums over their tracks.

    Parameters
    ----------
    detector : Detector
    tables : mapping of str to Table
        ``clusters``, ``wire_hits``, ``candidates`` and ``candidate_hits``; ``reference``, if any: tracks of these
        candidates that are known otherwise.
    constants : sequence of Constant
    fit : FitSettings
    settings : AlignmentSettings or None
        Which tracks are joined, and whether matter scatters. None: it does, and none.
    pool : Executor or None
    rows : bool
        Whether the sums keep the rows that they are of.
    """
    clusters, wire_hits, candidates, candidate_hits = (
        tables[name] for name in ("clusters", "wire_hits", "candidates", "candidate_hits")
    )
    how = replace(fit, states=("origin",), residuals=True)
    fitted = fit_columns(detector, clusters, wire_hits, candidates, candidate_hits, how)
    out, hits = fitted.out, fitted.hits
    good = np.flatnonzero(np.isin(out["status"], (FitStatus.ok, FitStatus.unconstrained)))
    columns = {**hits.columns(), **{name: out[name] for name in ("used", "used_value", "used_variance")}}
    # Sides are known of hits that are far from their wire by the track without them; a choice by what they measure
    # would favour large distances. The core takes a value below its distance as one between both sides.
    wire, distance = hits.kind == HIT_WIRE, np.abs(out["used_value"] - out["residual"])
    known, size = distance > _KNOWN * hits.sigma, np.abs(out["used_value"])
    columns["value"] = np.where(wire, np.where(known, size, 2 * size + 1), hits.value)
    counts = np.diff(hits.hit_offsets)
    of_tracks = {
        "reference": out["reference"], "mass": fitted.mass, "matter_p": out["matter_p"],
        "kinks": out["kinks"].reshape(len(counts), -1), "start_radius": fitted.radii,
        "charge": np.asarray(fitted.charge, np.float64),
    }  # fmt: skip
    event = tables["candidates"]["event"][fitted.candidate]
    return track_sums(
        fitted.core, detector, constants, hits.hit_offsets, columns, of_tracks, good, event, fit,
        settings=settings, pool=pool, rows=rows,
        reference=_known_tracks(tables["reference"], fitted.candidate, fitted.mass) if "reference" in tables else None,
    )  # fmt: skip


def _known_tracks(known: Table, candidate: npt.NDArray[np.int64], mass: Floats) -> tuple[Floats, Floats]:
    """Return helices and covariances of known tracks for candidates, (n, 5) and (n, 5, 5), NaN for those without.

    Of the tracks of a candidate with several masses, the one with the mass nearest to that of our fit counts.
    """
    values = np.full((len(candidate), 5), np.nan), np.full((len(candidate), 5, 5), np.nan)
    rows = np.flatnonzero(has_momentum(known) & (known["candidate"] >= 0))
    masses = np.array([usual_mass(int(pdg)) if pdg else np.nan for pdg in known["hypothesis"][rows]])
    for i, one in enumerate(candidate):
        own_rows = np.flatnonzero(known["candidate"][rows] == one)
        if len(own_rows):
            row = rows[own_rows[np.argmin(np.nan_to_num(np.abs(masses[own_rows] - mass[i])))]]
            values[0][i] = [known[name][row] for name in helix.PARAMETERS]
            values[1][i] = known["cov"][row]
    return values


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
    means = {}
    for layer_number, layer in enumerate(detector.layers):
        for view, name in enumerate("XV"):
            rows = good & (hits.kind == view) & (hits.layer == layer_number)
            weight = 1 / out["err"][rows] ** 2
            if len(weight):
                mean = float(np.sum(weight * out["residual"][rows]) / np.sum(weight))
                means[f"{layer.label} {name}"] = mean, float(1 / np.sqrt(np.sum(weight)))
    return means


def expected_sums(
    detector: Detector, source: Source | Guns, tracks: int, constants: Sequence[Constant], fit: FitSettings, *,
    seed: int = 1, reveal_sides: bool = False, settings: AlignmentSettings | None = None, pool: Executor | None = None,
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
    settings : AlignmentSettings or None
        As of `fitted_sums`.
    pool : Executor or None
    """
    particles = generate(source, tracks, seed, detector=detector)
    helices = helix.at_origin(particles, detector.field.bz)
    rows = np.flatnonzero(np.isfinite(helices).all(axis=1))
    helices, event = helices[rows], particles["event"][rows]
    mass, charge = (np.asarray(particles[name], np.float64)[rows] for name in ("mass", "charge"))
    expected = expected_tracks(detector, helices, mass, np.abs(charge), fit, reveal_sides=reveal_sides)
    return track_sums(
        compiled_for_fit(detector, fit), detector, constants, *expected[:3], expected[3], event, fit, settings=settings,
        pool=pool,
    )  # fmt: skip


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
        block = slice(first, min(first + _BLOCK, n))
        count = block.stop - first
        parts.append(
            _core.covariance.covariances(
                core, phi=psi[block], kappa=kappa[block], tanl=tanl[block], mass=mass[block], charge=charge[block],
                scatters=np.zeros(count), samples=count,
                phases=draws(count, 1 + views)[:, 1:] if views else np.zeros((count, 0)),
                efficiencies=efficiencies_of(detector, kappa[block], tanl[block], mass[block], charge[block]),
                model=model | {"seed": first}, budget=False, hits=True, dr=dr[block], dz=helices[block, 3],
            )
        )  # fmt: skip
    if not parts:
        return np.zeros(1, np.int64), {}, {}, np.zeros(0, np.intp)
    hits = {f"hit_{name}": np.concatenate([part["hits"][name] for part in parts]) for name in parts[0]["hits"]}
    of_tracks = {name: np.concatenate([part[name] for part in parts]) for name in ("status", "n_clusters", "n_wires")}
    return as_fitted(core, hits | of_tracks, helices, mass, charge)


def as_fitted(
    core: _core.detector.Detector,
    expected: Mapping[str, npt.NDArray[Any]],
    helices: Floats,
    mass: Floats,
    charge: Floats,
) -> tuple[npt.NDArray[np.int64], dict[str, Any], dict[str, Any], npt.NDArray[np.intp]]:
    """Return expected hits as `track_sums` takes them; see `expected_tracks`.

    Parameters
    ----------
    core : _core.detector.Detector
    expected : mapping of str to ndarray
        As of `Tracks.run` with hits.
    helices : ndarray, (n, 5) float64
    mass, charge : ndarray, (n,) float64, GeV/c2 and e
    """
    n, status = len(helices), expected["status"]
    counts = expected["n_clusters"].astype(np.int64) + expected["n_wires"]
    expected = {name.removeprefix("hit_"): one for name, one in expected.items() if name.startswith("hit_")}
    wire = expected["kind"] == HIT_WIRE
    hits = {
        **{name: expected[name] for name in ("kind", "layer", "channel", "k", "x")},
        "size": np.zeros(len(wire), np.int32), "value": np.where(wire, np.abs(expected["value"]), expected["value"]),
        "sigma": np.sqrt(expected["variance"]), "used": np.ones(len(wire), np.uint8),
        "used_value": expected["value"], "used_variance": expected["variance"],
    }  # fmt: skip
    of_tracks = {
        "reference": helices + np.array([0, 0.5 * np.pi, 0, 0, 0]), "mass": mass, "charge": charge,
        "matter_p": np.zeros(n), "kinks": np.zeros((n, 2 * core.n_slabs)), "start_radius": np.zeros(n),
    }  # fmt: skip
    return np.concatenate([[0], np.cumsum(counts)]), hits, of_tracks, np.flatnonzero(status == FitStatus.ok)


def track_sums(
    core: _core.detector.Detector, detector: Detector, constants: Sequence[Constant], offsets: npt.NDArray[np.int64],
    hits: Mapping[str, npt.NDArray[Any]], of_tracks: Mapping[str, npt.NDArray[Any]], good: npt.NDArray[np.intp],
    event: npt.NDArray[np.int64], fit: FitSettings, *, settings: AlignmentSettings | None = None,
    pool: Executor | None = None, rows: bool = False, reference: tuple[Floats, Floats] | None = None,
) -> Sums:  # fmt: skip
    """Return the sums over tracks.

    Parameters
    ----------
    core, detector : _core.detector.Detector, Detector
    constants : sequence of Constant
    offsets : ndarray, (n + 1,) int64
    hits, of_tracks : mapping of str to ndarray
        Of the hits, and of the tracks.
    good : ndarray, int
        Rows of the tracks that are summed.
    event : ndarray, (n,) int64
    fit : FitSettings
    settings : AlignmentSettings or None
    pool : Executor or None
    rows : bool
        As of `fitted_sums`.
    reference : (ndarray, (n, 5), and ndarray, (n, 5, 5)), or None
        Helices and covariances that are known otherwise; NaN: not.
    """
    settings = settings or AlignmentSettings(pairs=())
    single = of_single_wires(constants)
    if single and (rows or reference is not None or settings.pairs):
        raise ValueError("single wires: expected neither records, nor known tracks, nor joined ones (pairs=())")
    columns, none = columns_of(detector, constants), Sums.none(detector, constants)
    prior = [WIDER * sigma for sigma in fit.prior_in(detector)]

    def part(tracks: npt.NDArray[np.intp]) -> Sums:
        out = core_sums(
            core, columns, offsets, hits, of_tracks, tracks, prior, bias=bool(settings.pairs) or reference is not None,
            scattering=settings.scattering, innovations=rows, blocks=_first_columns(constants) if single else (),
        )  # fmt: skip
        used = out["used"] == 1
        counted = int(used.sum()), int(out["hits"][used].sum())
        if single:
            return _of_single(none, out, counted)
        sums = Sums(
            out["normal"], out["right"], out["measured"], *counted,
            chi2=float(out["chi2"][used].sum()), rows=_rows_of(out, event[tracks]) if rows else (),
        )  # fmt: skip
        joined = quantities(out, event[tracks], of_tracks["mass"][tracks], of_tracks["charge"][tracks], settings)
        if reference is not None:
            joined = chain(joined, known_tracks(out, event[tracks], *(one[tracks] for one in reference)))
        for one in joined:
            sums = sums + constrained(one, fit.outlier_pull, rows=rows)
        return sums

    borders = _TASKS if single else _borders(good, event)
    blocks = np.array_split(good, borders) if len(good) else []
    total = none
    for one in map(part, blocks) if pool is None else pool.map(part, blocks):
        total = total + one
    return total


def _of_single(none: Sums, out: Mapping[str, Any], counted: tuple[int, int]) -> Sums:
    """Return the sums of single wires, whose columns are in the order of neighbours in the core."""
    assert isinstance(none.normal, Blocks)
    order = none.normal.order
    right, measured, hits = np.zeros(len(order)), np.zeros(len(order)), np.zeros(len(order), np.int64)
    right[order], measured[order], hits[order] = out["right"], out["measured"], out["column_hits"]
    normal = replace(none.normal, entries=out["blocks"], hits=hits)
    return Sums(normal, right, measured, *counted, chi2=float(out["chi2"][out["used"] == 1].sum()))


def _borders(good: npt.NDArray[np.intp], event: npt.NDArray[np.int64]) -> list[int]:
    """Return where blocks of tracks end, none within an event."""
    borders, last = [], 0
    starts = np.flatnonzero(np.diff(event[good])) + 1
    for start in starts.tolist():
        if start - last >= _BLOCK:
            borders.append(start)
            last = start
    return borders


def core_sums(
    core: _core.detector.Detector, columns: dict[str, Any], offsets: npt.NDArray[np.int64],
    hits: Mapping[str, npt.NDArray[Any]], tracks: Mapping[str, npt.NDArray[Any]], rows: npt.NDArray[np.intp],
    prior: Sequence[float], *, bias: bool = False, scattering: bool = True, innovations: bool = False,
    blocks: Sequence[int] | Ints = (),
) -> dict[str, Any]:  # fmt: skip
    """Return what the core makes of some tracks.

    Parameters
    ----------
    core : _core.detector.Detector
    columns : dict
        Of `columns_of`.
    offsets : ndarray, (n + 1,) int64
    hits, tracks : mapping of str to ndarray
    rows : ndarray, int
    prior : sequence of float
    bias, scattering, innovations : bool
    blocks : sequence of int
        Of the matrix of single wires.
    """
    of_tracks: dict[str, Any] = {name: column[rows] for name, column in tracks.items()}
    counts = np.diff(offsets)[rows]
    begin = np.concatenate([[0], np.cumsum(counts)])
    at = np.repeat(offsets[rows] - begin[:-1], counts) + np.arange(begin[-1])
    out: dict[str, Any] = _core.calibration.sums(
        core, columns=columns, hit_offsets=begin, hits={name: column[at] for name, column in hits.items()},
        **of_tracks, prior_sigma=list(prior), bias=bias,
        scattering=scattering, innovations=innovations, blocks=list(blocks),
    )  # fmt: skip
    return out


def _rows_of(of_core: Mapping[str, Any], event: npt.NDArray[np.int64]) -> tuple[Rows, ...]:
    rows = of_core["innovations"]
    return (
        Rows(
            event[rows["track"]], rows["residual"], np.sqrt(rows["variance"]), rows["ends"], rows["column"],
            rows["derivative"],
        ),
    )  # fmt: skip


def constrained(measured: Quantities, pull: float, *, rows: bool = False) -> Sums:
    """Return the sums over quantities that are 0 but for errors and constants.

    Parameters
    ----------
    measured : Quantities
    pull : float
        Cut on the independent combinations of each; 0: as many times their median as `_WILD`, which displaced parts
        raise for all alike.
    rows : bool
    """
    values, slope = measured.whitened()
    largest = np.abs(values).max(axis=1, initial=0.0)
    near = largest <= (pull or _WILD * max(1.0, float(np.median(largest)) if len(largest) else 1.0))
    values, slope, left_out = values[near], slope[near], int(np.sum(~near))
    n, constants, k = slope.shape
    flat = slope.transpose(0, 2, 1).reshape(n * k, constants)
    kept_rows: tuple[Rows, ...] = ()
    if rows:
        row, column = np.nonzero(flat)
        ends = np.cumsum(np.bincount(row, minlength=n * k))
        event, one = np.repeat(measured.event[near], k), np.ones(n * k)
        kept_rows = (Rows(event, values.ravel(), one, ends, column.astype(np.int32), flat[row, column]),)
    return Sums(
        flat.T @ flat, flat.T @ values.ravel(), np.zeros(constants), pairs=n, left_out=left_out,
        chi2=float(np.sum(values**2)), rows=kept_rows,
    )  # fmt: skip
