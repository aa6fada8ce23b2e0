"""Vertex fit of pairs of tracks with full covariances, and the mass of the pair (docs/methods/vertex.md)."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import helix
from cgemit.base.arrays import Floats, Rows
from cgemit.base.errors import report
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Quantity
from cgemit.detector import Detector, compiled, load
from cgemit.detector.channels import checked
from cgemit.detector.parts import extent
from cgemit.particles.species import HYPOTHESES, Species
from cgemit.tables import Table
from cgemit.tables.schema import FitStatus, has_momentum, is_fitted


@checked("candidates", "tracks", "vertices")
def begin_at_vertices(
    detector: Detector | str | Mapping[str, Any], candidates: Table, tracks: Table, vertices: Table
) -> Table:
    """Return candidates whose tracks begin at their vertex: a second `fit` of them leaves out the matter inside.

    The first fit takes all tracks to the origin. Tracks of a K_S that decays beyond the beam pipe never crossed the
    pipe; their loss in it is added, and its scattering counted.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    candidates : Table of kind "candidates"
    tracks : Table of kind "tracks"
        Of the first fit of these candidates.
    vertices : Table of kind "vertices"
        Of these tracks. A track of several vertices begins at the one with the smallest chi-square. Vertices whose
        `status` is not ok count for nothing.

    Returns
    -------
    Table of kind "candidates"
        With the column `start_radius` (`cgemit.helix.start_radius`); 0 for tracks without a vertex.

    Raises
    ------
    ValueError
        Listing the tables that are of another kind.
    """
    bz = compiled(load(detector)).field.bz
    good = np.flatnonzero(vertices["status"] == 0)
    rows = np.concatenate([vertices[side][good] for side in ("first", "second")])
    vertex = np.concatenate([good, good])
    order = np.argsort(-vertices["chi2"][vertex], kind="stable")  # the best of a track is written last
    rows, vertex = rows[order], vertex[order]
    parameters = np.stack([tracks[name] for name in helix.PARAMETERS], axis=1)
    points = np.stack([vertices[name] for name in "xyz"], axis=1)
    begin = np.zeros(len(candidates))
    begin[tracks["candidate"][rows]] = helix.start_radius(parameters[rows], points[vertex], bz)
    return candidates.with_columns(start_radius=begin)


Length = Annotated[float, Quantity("length", -1e6, 1e6)]
Spread = Annotated[float, Quantity("length", 0, 1e9, above=True)]


@dataclass(frozen=True, kw_only=True)
class BeamSpot(SettingsData):
    """Where the beams meet: a measurement of the vertex with uncorrelated Gaussian errors.

    Attributes
    ----------
    position : tuple of three float, mm
    sigma : tuple of three float, mm

    Raises
    ------
    ValueError
        Listing every invalid value.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.sample("jpsi-rhopi"), n=10)
    >>> spot = cg.BeamSpot(sigma=(0.4, 0.006, 12.0))  # mm
    >>> vertices = cg.fit_vertices(result.detector, result.fitted, beam_spot=spot)
    >>> bool((vertices["err_y"] < 0.0061).all())
    True
    """

    position: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)
    sigma: tuple[Spread, Spread, Spread]


@checked("tracks")
def pair_tracks(tracks: Table, particles: tuple[str, str] | None = None) -> Rows:
    """Return all pairs of fitted tracks of opposite charge of each event.

    Tracks of status `unconstrained` are in none: their charge is not measured.

    Parameters
    ----------
    tracks : Table of kind "tracks"
    particles : tuple of two str, or None
        Where tracks were fitted with several hypotheses: the hypotheses of the positive and the negative track.

    Returns
    -------
    ndarray, (n, 2) intp
        Rows of the positive and of the negative track.

    Raises
    ------
    ValueError
        If `particles` are not two of the hypotheses.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.sample("jpsi-rhopi"), n=3)
    >>> cg.pair_tracks(result.fitted).tolist()
    [[2, 3], [5, 4]]
    """
    if particles is not None and not _are_hypotheses(particles):
        raise ValueError(f"particles: got {particles!r:.60}, expected two of {', '.join(map(repr, HYPOTHESES))}")
    good = has_momentum(tracks) & np.isfinite(tracks["kappa"])
    fitted = [good, good] if particles is None else [good & _of(tracks, name) for name in particles]
    plus, minus = (
        np.flatnonzero(one & (sign * tracks["kappa"] > 0)) for one, sign in zip(fitted, (1, -1), strict=True)
    )
    event = tracks["event"]
    first = np.searchsorted(event[minus], event[plus], side="left")
    count = np.searchsorted(event[minus], event[plus], side="right") - first
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.stack([np.repeat(plus, count), minus[np.repeat(first, count) + within]], axis=1)


def checked_pairs(tracks: Table, pairs: npt.ArrayLike | None, particles: tuple[str, str], beam_spot: object) -> Rows:
    """Return the rows of pairs, (n, 2) intp.

    Parameters
    ----------
    tracks, pairs, particles, beam_spot
        As of `fit_vertices`.

    Raises
    ------
    ValueError
        Listing every problem of the arguments.
    """
    if not isinstance(tracks, Table) or tracks.kind != "tracks":
        raise ValueError(f"fit_vertices: tracks: got {type(tracks).__name__}, expected a table of kind 'tracks'")
    problems = []
    known = _are_hypotheses(particles)
    if pairs is None:
        several = known and len(np.unique(tracks["hypothesis"])) > 1 and _several(tracks)
        pairs = pair_tracks.unchecked(tracks, particles if several else None)
        unknown = int(np.count_nonzero(tracks["status"] == FitStatus.unconstrained))
        if unknown and not np.any(has_momentum(tracks)):
            problems.append(
                f"pairs: none given, and the curvature of no track measures its charge ({unknown} tracks of status "
                "unconstrained); expected the rows of pairs"
            )
    rows = np.asarray(pairs)
    rows = rows.reshape(0, 2) if rows.size == 0 else rows
    if not known:
        problems.append(f"particles: got {particles!r}, expected two of {', '.join(map(repr, HYPOTHESES))}")
    if not isinstance(beam_spot, BeamSpot | None):
        problems.append(f"beam_spot: got {type(beam_spot).__name__}, expected BeamSpot or None")
    if rows.ndim != 2 or rows.shape[1] != 2 or (rows.size and rows.dtype.kind not in "iu"):
        problems.append(f"pairs: got shape {rows.shape} of {rows.dtype}, expected (n, 2) whole numbers")
    elif rows.size and (rows.min() < 0 or rows.max() >= len(tracks)):
        problems.append(f"pairs: got rows {rows.min()} to {rows.max()}, expected 0 to {len(tracks)} (excluded)")
    elif rows.size:
        event = tracks["event"][rows]
        for text, wrong in (
            ("two events", event[:, 0] != event[:, 1]),
            ("one track twice", rows[:, 0] == rows[:, 1]),
        ):
            if wrong.any():
                problems.append(f"pairs: row {np.argmax(wrong)}: got {text}, expected two tracks of one event")
    report("fit_vertices", problems)
    return rows.astype(np.intp)


def _are_hypotheses(given: object) -> bool:
    return isinstance(given, tuple | list) and len(given) == 2 and all(one in [*HYPOTHESES] for one in given)


def _several(tracks: Table) -> bool:
    """Tell whether some candidate was fitted with several hypotheses."""
    own = np.stack([tracks["event"], tracks["candidate"]])
    return bool(np.any(np.all(own[:, 1:] == own[:, :-1], axis=0)))


def _of(tracks: Table, name: str) -> npt.NDArray[np.bool_]:
    """Mark the tracks of a hypothesis."""
    return np.asarray(tracks["hypothesis"] == abs(HYPOTHESES[name].pdg))


def starting_points(parameters: Floats, bz: float) -> Floats:
    """Return the points across the beam where two circles cross, at the mean z of the helices there.

    Circles that do not cross have one point, half way between them where they are closest.

    Parameters
    ----------
    parameters : ndarray, (n, 2, 5) float64
        Helices about the origin.
    bz : float
        T; without a field, circles are straight lines but for 1e-6 of the bending in 1 T.

    Returns
    -------
    ndarray, (n, 2, 3) float64, mm
        The first is the one at which the helices are closer in z. The second is NaN where there is one.
    """
    dr, phi0, kappa = (parameters[..., i] for i in range(3))
    radius = helix.RADIUS_PER_KAPPA / ((bz or 1e-6) * kappa)
    centre = (dr + radius)[..., None] * np.stack([np.cos(phi0), np.sin(phi0)], axis=-1)
    apart = centre[:, 1] - centre[:, 0]
    distance = np.maximum(np.hypot(*apart.T), 1e-9)
    along = apart / distance[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    first, second = np.abs(radius.T)
    # From the first centre along the line of centres to the chord. Differences of large numbers are factorised.
    foot = 0.5 * (distance + (first - second) * (first + second) / distance)
    half2 = (first - foot) * (first + foot)
    beside = np.sqrt(np.maximum(half2, 0.0))
    # Circles that do not cross are closest on the line of centres, half way between them.
    outside = distance > first + second
    gap = np.where(outside, 0.5 * (distance + first - second), np.sign(first - second) * 0.5 * (first + second))
    gap = np.where(outside, gap, gap + np.where(first > second, 0.5 * distance, -0.5 * distance))
    foot = np.where(half2 >= 0, foot, gap)
    middle = centre[:, 0] + foot[:, None] * along
    options = np.stack([middle + beside[:, None] * across, middle - beside[:, None] * across], axis=1)
    z = np.stack([_heights(parameters, options[:, k], bz) for k in range(2)], axis=1)
    points = np.concatenate([options, z.mean(axis=-1)[..., None]], axis=2)
    points[beside == 0, 1] = np.nan
    swap = (beside > 0) & (np.abs(z[:, 1, 0] - z[:, 1, 1]) < np.abs(z[:, 0, 0] - z[:, 0, 1]))
    points[swap] = points[swap][:, ::-1]
    return points


def _heights(parameters: Floats, points: Floats, bz: float) -> Floats:
    """Return z of both helices of each pair where they are closest to a point across the beam, (n, 2) mm."""
    flat = parameters.reshape(-1, 5)
    pivots = np.concatenate([np.repeat(points, 2, axis=0), np.zeros((len(flat), 1))], axis=1)
    moved, _ = helix.change_pivot(flat, np.zeros((len(flat), 5, 5)), np.zeros(3), pivots, bz)
    return np.asarray(np.where(np.isfinite(moved[:, 3]), moved[:, 3], 0.0).reshape(-1, 2))


_ITERATIONS, _EASY = 100, 12  # after the easy ones, second derivatives are exact
_DIFFERENCE = 1e-3  # mm
_SETTLED = 1e-8  # of the chi-square that the next step would gain
_ROUNDING = 1e-10  # of the chi-square
_SINGULAR = 1e-14  # ratio of the eigenvalues of the inverse covariance
_FIRST_DAMPING, _LEAST_DAMPING, _DAMPING_RATIO = 1e-3, 1e-6, 10.0
_LONGEST = 0.5  # step, in radii of the smaller circle
_ONE_VERTEX = 1e-3  # chi-square of the distance of two vertices that are told apart
_COMPETING = 25.0  # largest difference of the chi-squares of two vertices that compete


class VertexStatus(enum.IntEnum):
    """How a vertex fit ended; 0 is good.

    Examples
    --------
    >>> cg.VertexStatus.ok.value, [status.name for status in cg.VertexStatus]
    (0, ['ok', 'no_track', 'singular', 'not_converged'])
    """

    ok = 0
    no_track = 1
    singular = 2
    not_converged = 3


class _Pairs(NamedTuple):
    """Helices about the origin of both tracks of each pair: (n, 2, 5), (n, 2, 5, 5); masses (2,) GeV/c2; field, T.

    `charges` (n, 2), e, are unsigned. `reach` is the largest radius and abs(z) of a vertex, mm.
    """

    parameters: Floats
    cov: Floats
    charges: Floats
    masses: Floats
    bz: float
    reach: tuple[float, float]

    def inside(self, points: Floats) -> npt.NDArray[np.bool_]:
        """Return which points are within the detector, of (..., 3) mm."""
        radius, z = self.reach
        return np.asarray((np.hypot(points[..., 0], points[..., 1]) <= radius) & (np.abs(points[..., 2]) <= z))


class _Linear(NamedTuple):
    """The tracks of pairs about a pivot.

    `measured` (n, 2, 2) is (dr, dz) there, `weight` its inverse covariance, `to_vertex` (n, 2, 2, 3) minus its
    derivative by the vertex, for the track through the vertex; `bend` (n, 2, 3, 3) is the part of the second
    derivatives of half the chi-square that the curvature of the track makes, `radius` (n, 2) mm that of its circle;
    `direction` (n, 2, 3) is (flight azimuth, kappa, tanl), `gain` (n, 2, 3, 2) how it follows `measured`,
    `rest` (n, 2, 3, 3) its covariance for given `measured`, and `turn` (n, 2, 3, 3) its derivative by the vertex.
    """

    measured: Floats
    weight: Floats
    to_vertex: Floats
    bend: Floats
    radius: Floats
    direction: Floats
    gain: Floats
    rest: Floats
    turn: Floats


@checked("tracks")
def fit_vertices(
    detector: Detector | str | Mapping[str, Any],
    tracks: Table,
    pairs: npt.ArrayLike | None = None,
    *,
    particles: tuple[str, str] = ("pi", "pi"),
    beam_spot: BeamSpot | None = None,
) -> Table:
    """Fit the common vertex of pairs of tracks, and their mass.

    Least squares in the vertex and the directions and curvatures of both tracks there, with the full covariances of the
    tracks. The helices are linearised about the vertex, which is repeated until it stays; the chi-square of no step
    grows. The fit starts at both points where the circles of the tracks cross. The vertex has the smaller chi-square;
    if the other start leads to another vertex whose chi-square is less than 25 larger, `other_chi2` and
    `other_distance` tell of it. Outside of the detector, a vertex counts only where there is none inside.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
        Its field at the origin bends the tracks.
    tracks : Table of kind "tracks"
    pairs : array_like or None
        Rows of two tracks of an event, (n, 2) int. None: those of `pair_tracks`, of the hypotheses `particles` where
        tracks were fitted with several.
    particles : tuple of two str
        ``"e"``, ``"mu"``, ``"pi"``, ``"K"`` or ``"p"``: masses of the first and the second track.
    beam_spot : BeamSpot or None
        A constraint of the vertex.

    Returns
    -------
    Table of kind "vertices"
        One row per pair, ordered by event. Rows whose `status` is not ok hold NaN. So do momentum and mass of pairs
        with a track of status `unconstrained`.

    Raises
    ------
    ValueError
        Listing every problem of the arguments, or if no pairs are given and no track measures its charge.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.sample("ks-pipi"), n=20)
    >>> vertices = cg.fit_vertices(result.detector, result.fitted)
    >>> float(np.median(vertices["mass"]).round(2))  # of the K_S, GeV/c2
    0.5
    """
    rows = checked_pairs(tracks, pairs, particles, beam_spot)
    rows = rows[np.argsort(tracks["event"][rows[:, 0]], kind="stable")]
    kinds = [HYPOTHESES[name] for name in particles]
    parameters = np.stack([tracks[name] for name in helix.PARAMETERS], axis=1)[rows]
    fitted = is_fitted(tracks)
    good = np.all(fitted[rows], axis=1) & np.isfinite(parameters).all(axis=(1, 2))
    good &= np.isfinite(tracks["cov"][rows]).all(axis=(1, 2, 3))
    impact = tracks["cov"][rows][..., [[0], [3]], [0, 3]]  # which has an inverse
    good &= ((np.linalg.det(np.where(np.isfinite(impact), impact, 0.0)) > 0) & (impact[..., 0, 0] > 0)).all(axis=1)
    chamber = load(detector)
    bz = compiled(chamber).field.bz
    masses = np.array([kind.mass for kind in kinds])
    charges = np.asarray(tracks["charge"], np.float64)[rows[good]]
    some = _Pairs(parameters[good], tracks["cov"][rows[good]], charges, masses, bz, extent(chamber))
    solution, status, iterations = _solved(some, beam_spot)
    columns = {name: np.full((len(rows), *value.shape[1:]), np.nan) for name, value in solution.items()}
    for name, value in solution.items():
        columns[name][good] = np.where((status == 0).reshape(-1, *[1] * (value.ndim - 1)), value, np.nan)
    unknown = np.any((tracks["status"] == FitStatus.unconstrained)[rows], axis=1)
    for name in _OF_MOMENTA:
        columns[name][unknown] = np.nan
    ends = {"status": np.full(len(rows), int(VertexStatus.no_track)), "iterations": np.zeros(len(rows), np.int64)}
    ends["status"][good], ends["iterations"][good] = status, iterations
    return _table(tracks, rows, kinds, columns | ends, 1 if beam_spot is None else 4)


#: Columns that need the momenta of both tracks.
_OF_MOMENTA = ("px", "py", "pz", "mass", "err_mass")


def _table(tracks: Table, rows: Rows, kinds: list[Species], columns: Mapping[str, npt.NDArray[Any]], ndf: int) -> Table:
    n = len(rows)
    names = {"first": rows[:, 0], "second": rows[:, 1]}
    names |= {f"{name}_pdg": np.full(n, kind.pdg) for name, kind in zip(names, kinds, strict=True)}
    values = {"event": tracks["event"][rows[:, 0]], **names, **columns, "ndf": np.full(n, ndf)}
    return Table("vertices", values, meta=tracks.meta, **tracks.cover)


def _solved(
    pairs: _Pairs, beam_spot: BeamSpot | None
) -> tuple[dict[str, Floats], npt.NDArray[np.int8], npt.NDArray[np.int32]]:
    """Return the columns of the fit, and the status and iterations of each pair."""
    n = len(pairs.parameters)
    starts = starting_points(pairs.parameters, pairs.bz)
    inside = pairs.inside(starts)
    is_start = np.isfinite(starts).all(axis=2) & (inside | ~inside.any(axis=1, keepdims=True))
    first = np.where(is_start[:, 0], 0, 1)
    vertex, chi2, cov, status, iterations = _minimised(pairs, starts[np.arange(n), first], beam_spot)
    # The other crossing, which wins with a smaller chi-square.
    rows = np.flatnonzero(is_start.all(axis=1))
    best = np.where((status[rows] == VertexStatus.ok) & pairs.inside(vertex[rows]), chi2[rows], np.inf)
    second = _minimised(_some(pairs, rows), starts[rows, 1], beam_spot, worst=best + _COMPETING)
    good = (second[3] == VertexStatus.ok) & pairs.inside(second[0])
    better = good & (second[1] < best)
    iterations[rows] += second[4]
    apart = second[0] - vertex[rows]
    square = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(cov[rows]), apart)
    competing = good & np.isfinite(best) & (square > _ONE_VERTEX) & (np.abs(second[1] - best) < _COMPETING)
    other = {"other_chi2": np.full(n, np.nan), "other_distance": np.full(n, np.nan)}
    other["other_chi2"][rows[competing]] = np.maximum(second[1], best)[competing]
    other["other_distance"][rows[competing]] = np.linalg.norm(apart[competing], axis=1)
    wins = rows[better]
    vertex[wins], chi2[wins], cov[wins], status[wins] = (part[better] for part in second[:4])
    ok = (status == VertexStatus.ok)[:, None]
    return _results(pairs, np.where(ok, vertex, 0.0), cov, beam_spot) | other, status, iterations


def _minimised(
    pairs: _Pairs, start: Floats, beam_spot: BeamSpot | None, *, worst: Floats | None = None
) -> tuple[Floats, Floats, Floats, npt.NDArray[np.int8], npt.NDArray[np.int32]]:
    """Return vertices with the least chi-square from starting points, their chi-square, covariance, status, iterations.

    Newton's method with the damping of Levenberg and Marquardt. Fits whose chi-square stays above `worst` (n,) end
    early.
    """
    n, vertex = len(start), start.copy()
    status, iterations = np.full(n, int(VertexStatus.not_converged), np.int8), np.zeros(n, np.int32)
    cov, damping = np.tile(np.eye(3), (n, 1, 1)), np.zeros(n)
    of = _linear(pairs, vertex)
    chi2 = _chi2(of, vertex, beam_spot)
    going = np.flatnonzero(np.isfinite(chi2))
    status[np.isnan(chi2)] = VertexStatus.singular  # at the centre of a circle, as for tracks with the same one
    for iteration in range(_ITERATIONS):
        if iteration == _EASY and worst is not None:
            going = going[chi2[going] <= worst[going]]
        if not len(going):
            break
        iterations[going] += 1
        here, some = _Linear(*(part[going] for part in of)), _some(pairs, going)
        second, scale, right = _normal(here, vertex[going], beam_spot)
        if iteration >= _EASY:
            second = _differences(some, vertex[going], beam_spot)
        eigenvalues = np.linalg.eigvalsh(second)
        fine = eigenvalues[:, 0] > _SINGULAR * eigenvalues[:, 2]
        least = np.where(fine, 0.0, _LEAST_DAMPING)
        gain = np.einsum(
            "ni,ni->n", right, np.linalg.solve(second + least[:, None, None] * scale, right[..., None])[..., 0]
        )
        settled = (gain >= 0) & (gain < _SETTLED)
        status[going[settled]] = np.where(fine[settled], VertexStatus.ok, VertexStatus.singular)
        cov[going[settled & fine]] = np.linalg.inv(second[settled & fine])
        damped = second + np.maximum(damping[going], least)[:, None, None] * scale
        step = np.linalg.solve(damped, right[..., None])[..., 0]
        usable = np.linalg.eigvalsh(damped)[:, 0] > 0
        usable &= np.hypot(step[:, 0], step[:, 1]) <= _LONGEST * here.radius.min(axis=1)
        usable &= ~settled
        trial = vertex[going] + np.where(usable[:, None], step, 0.0)
        there = _linear(some, trial)
        trial_chi2 = _chi2(there, trial, beam_spot)
        better = usable & (trial_chi2 <= chi2[going] + _ROUNDING * (1 + chi2[going]))
        rows = going[better]
        vertex[rows], chi2[rows] = trial[better], trial_chi2[better]
        for part, new in zip(of, there, strict=True):
            part[rows] = new[better]
        grown = np.maximum(damping[going] * _DAMPING_RATIO, _FIRST_DAMPING)
        shrunk = np.where(damping[going] > _LEAST_DAMPING, damping[going] / _DAMPING_RATIO, 0.0)
        damping[going] = np.where(better, shrunk, grown)
        going = going[~settled]
    return vertex, chi2, cov, status, iterations


def _linear(pairs: _Pairs, pivot: Floats) -> _Linear:
    """Return the tracks about a pivot for each pair, (n, 3) mm."""
    n = len(pivot)
    each = np.repeat(pivot, 2, axis=0)
    flat, cov = pairs.parameters.reshape(-1, 5), pairs.cov.reshape(-1, 5, 5)
    parameters, cov = helix.change_pivot(flat, cov, np.zeros(3), each, pairs.bz)
    dr, phi0, kappa, dz, tanl = parameters.T
    ex, ey = np.cos(phi0), np.sin(phi0)
    zero, one = np.zeros(2 * n), np.ones(2 * n)
    e, u, z = (np.stack(axis, axis=1) for axis in ((ex, ey, zero), (-ey, ex, zero), (zero, zero, one)))
    weight = np.linalg.inv(cov[:, [[0], [3]], [0, 3]])
    measured = np.stack([dr, dz], axis=1)
    rest_of = [[1], [2], [4]]
    across = cov[:, rest_of, [0, 3]]
    gain = across @ weight
    remaining = cov[:, rest_of, [1, 2, 4]] - gain @ np.swapaxes(across, 1, 2)
    # Displaced by x from the pivot: dr - e x, dz - x_z + tanl share (u x), with e and u turning by -bend (u x).
    per_kappa = pairs.bz / helix.RADIUS_PER_KAPPA
    share = 1 / (1 + per_kappa * kappa * dr)
    bend = per_kappa * kappa * share
    # The chi-square changes as (dr, dz) of the track through the pivot do: other direction, curvature and dr.
    force = np.einsum("nab,nb->na", weight, measured)
    d_phi, d_kappa, d_tanl = np.einsum("nia,na->in", gain, measured)
    slope = tanl * share
    d_slope = share * d_tanl - slope * share * per_kappa * (kappa * dr + dr * d_kappa)
    by_dr = e - d_phi[:, None] * u
    by_dz = z - (slope - d_slope)[:, None] * u - (slope * d_phi)[:, None] * e
    to_vertex = np.stack([by_dr, by_dz], axis=1)
    both = u[:, :, None] * e[:, None, :]
    curved = (force[:, 0] * bend)[:, None, None] * u[:, :, None] * u[:, None, :]
    curved += (force[:, 1] * slope * bend)[:, None, None] * (both + np.swapaxes(both, 1, 2))
    # The flight turns by w for each mm of arc; along it the vertex lies by u x beside the pivot.
    w = -per_kappa * kappa
    turn = np.zeros((2 * n, 3, 3))
    turn[:, 0, :2] = w[:, None] * u[:, :2]
    direction = np.stack([phi0 + 0.5 * np.pi, kappa, tanl], axis=1)
    radius = 1 / np.maximum(np.abs(per_kappa * kappa), 1e-12)
    parts = (measured, weight, to_vertex, curved, radius, direction, gain, remaining, turn)
    return _Linear(*(np.asarray(part, np.float64).reshape(n, 2, *part.shape[1:]) for part in parts))


def _some(pairs: _Pairs, rows: Rows) -> _Pairs:
    return pairs._replace(parameters=pairs.parameters[rows], cov=pairs.cov[rows], charges=pairs.charges[rows])


def _differences(pairs: _Pairs, vertex: Floats, beam_spot: BeamSpot | None) -> Floats:
    """Return the second derivatives of half the chi-square by the vertex, by differences of the first ones."""
    columns = []
    for step in _DIFFERENCE * np.eye(3):
        up, down = (_normal(_linear(pairs, at), at, beam_spot)[2] for at in (vertex + step, vertex - step))
        columns.append((down - up) / (2 * _DIFFERENCE))
    second = np.stack(columns, axis=2)
    return np.asarray(0.5 * (second + np.swapaxes(second, 1, 2)))


def _chi2(of: _Linear, vertex: Floats, beam_spot: BeamSpot | None) -> Floats:
    chi2 = np.einsum("npa,npab,npb->n", of.measured, of.weight, of.measured)
    if beam_spot is not None:
        chi2 = chi2 + np.sum(np.square((vertex - beam_spot.position) / beam_spot.sigma), axis=1)
    return np.asarray(chi2)


def _normal(of: _Linear, vertex: Floats, beam_spot: BeamSpot | None) -> tuple[Floats, Floats, Floats]:
    """Return second derivatives of half the chi-square by the vertex, what damps them, and minus the first ones."""
    inverse = np.einsum("npai,npab,npbj->nij", of.to_vertex, of.weight, of.to_vertex)
    right = np.einsum("npai,npab,npb->ni", of.to_vertex, of.weight, of.measured)
    if beam_spot is not None:
        weight = 1 / np.square(beam_spot.sigma)
        inverse = inverse + np.diag(weight)
        right = right + weight * (np.array(beam_spot.position) - vertex)
    # Turns about the beam line change nothing: x and y are damped alike.
    across = 0.5 * (inverse[:, 0, 0] + inverse[:, 1, 1])
    scale = np.zeros_like(inverse)
    scale[:, 0, 0], scale[:, 1, 1], scale[:, 2, 2] = across, across, inverse[:, 2, 2]
    return inverse + of.bend.sum(axis=1), scale, right


def _results(pairs: _Pairs, vertex: Floats, cov: Floats, beam_spot: BeamSpot | None) -> dict[str, Floats]:
    """Return chi-square, momentum and mass of pairs at their vertices."""
    of = _linear(pairs, vertex)
    chi2 = _chi2(of, vertex, beam_spot)
    # At the vertex: direction and curvature, conditional on the tracks' passing through it.
    azimuth, kappa, tanl = np.moveaxis(of.direction - np.einsum("npia,npa->npi", of.gain, of.measured), -1, 0)
    pt = pairs.charges * (1 / np.abs(kappa))
    p = np.stack([pt * np.cos(azimuth), pt * np.sin(azimuth), pt * tanl], axis=-1)
    energy = np.sqrt(np.sum(p * p, axis=-1) + pairs.masses**2)
    total, whole = p.sum(axis=1), energy.sum(axis=1)
    mass = np.sqrt(np.maximum(whole**2 - np.sum(total * total, axis=1), 0.0))
    zero = np.zeros_like(pt)
    by_azimuth = np.stack([-p[..., 1], p[..., 0], zero], axis=-1)
    by_kappa = -p / kappa[..., None]
    by_tanl = np.stack([zero, zero, pt], axis=-1)
    jacobian = np.stack([by_azimuth, by_kappa, by_tanl], axis=-1)  # (n, 2, momentum, direction)
    by_p = (whole[:, None, None] * p / energy[..., None] - total[:, None, :]) / np.maximum(mass, 1e-12)[:, None, None]
    slope = np.einsum("npk,npki->npi", by_p, jacobian)
    follow = of.gain @ of.to_vertex + of.turn  # of the directions, when the vertex moves
    common = np.einsum("npi,npij->nj", slope, follow)
    own = np.einsum("npi,npij,npj->n", slope, of.rest, slope)
    variance = own + np.einsum("ni,nij,nj->n", common, cov, common)
    errors = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return {
        **{axis: vertex[:, i] for i, axis in enumerate("xyz")}, "cov": cov,
        **{f"err_{axis}": errors[:, i] for i, axis in enumerate("xyz")},
        **{f"p{axis}": total[:, i] for i, axis in enumerate("xyz")},
        "mass": mass, "err_mass": np.sqrt(np.maximum(variance, 0.0)), "chi2": chi2,
    }  # fmt: skip
