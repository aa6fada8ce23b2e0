"""Vertex fit of pairs of tracks with full covariances, and the mass of the pair (docs/methods/vertex.md)."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import helix
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Check
from cgemit.detector import Detector, compiled, load
from cgemit.particles.species import HYPOTHESES, Species
from cgemit.tables import Table
from cgemit.tables.table import kind_problems


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
    problems = kind_problems(candidates=candidates, tracks=tracks, vertices=vertices)
    if problems:
        raise ValueError("begin_at_vertices:\n  " + "\n  ".join(problems))
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


Rows = npt.NDArray[np.intp]

Length = Annotated[float, Check(lambda value: abs(value) <= 1e6, "a length in mm, within +-1e6")]
Spread = Annotated[float, Check(lambda value: 0 < value <= 1e9, "a length in mm above 0, up to 1e9")]


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


def pair_tracks(tracks: Table, particles: tuple[str, str] | None = None) -> Rows:
    """Return all pairs of fitted tracks of opposite charge of each event.

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
    good = (tracks["status"] == 0) & np.isfinite(tracks["kappa"])
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
        pairs = pair_tracks(tracks, particles if several else None)
    given = np.asarray(pairs)
    given = given.reshape(0, 2) if given.size == 0 else given
    if not known:
        problems.append(f"particles: got {particles!r}, expected two of {', '.join(map(repr, HYPOTHESES))}")
    if not isinstance(beam_spot, BeamSpot | None):
        problems.append(f"beam_spot: got {type(beam_spot).__name__}, expected BeamSpot or None")
    if given.ndim != 2 or given.shape[1] != 2 or (given.size and given.dtype.kind not in "iu"):
        problems.append(f"pairs: got shape {given.shape} of {given.dtype}, expected (n, 2) whole numbers")
    elif given.size and (given.min() < 0 or given.max() >= len(tracks)):
        problems.append(f"pairs: got rows {given.min()} to {given.max()}, expected 0 to {len(tracks)} (excluded)")
    elif given.size:
        event = tracks["event"][given]
        for text, wrong in (
            ("two events", event[:, 0] != event[:, 1]),
            ("one track twice", given[:, 0] == given[:, 1]),
        ):
            if wrong.any():
                problems.append(f"pairs: row {np.argmax(wrong)}: got {text}, expected two tracks of one event")
    if problems:
        raise ValueError("fit_vertices:\n  " + "\n  ".join(problems))
    return given.astype(np.intp)


def _are_hypotheses(given: object) -> bool:
    return isinstance(given, tuple | list) and len(given) == 2 and all(one in [*HYPOTHESES] for one in given)


def _several(tracks: Table) -> bool:
    """Tell whether some candidate was fitted with several hypotheses."""
    own = np.stack([tracks["event"], tracks["candidate"]])
    return bool(np.any(np.all(own[:, 1:] == own[:, :-1], axis=0)))


def _of(tracks: Table, name: str) -> npt.NDArray[np.bool_]:
    """Mark the tracks of a hypothesis."""
    return np.asarray(tracks["hypothesis"] == abs(HYPOTHESES[name].pdg))


Floats = npt.NDArray[np.float64]


def starting_points(parameters: Floats, bz: float) -> Floats:
    """Return the point across the beam where two circles cross or come closest, at the mean z of the helices there.

    Of two crossings the one is taken at which the helices are closer in z.

    Parameters
    ----------
    parameters : ndarray, (n, 2, 5) float64
        Helices about the origin.
    bz : float
        T; without a field, circles are straight lines but for 1e-6 of the bending in 1 T.

    Returns
    -------
    ndarray, (n, 3) float64, mm
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
    best = np.argmin(np.abs(z[..., 0] - z[..., 1]), axis=1)
    rows = np.arange(len(best))
    return np.concatenate([options[rows, best], z[rows, best].mean(axis=-1)[:, None]], axis=1)


def _heights(parameters: Floats, points: Floats, bz: float) -> Floats:
    """Return z of both helices of each pair where they are closest to a point across the beam, (n, 2) mm."""
    flat = parameters.reshape(-1, 5)
    pivots = np.concatenate([np.repeat(points, 2, axis=0), np.zeros((len(flat), 1))], axis=1)
    moved, _ = helix.change_pivot(flat, np.zeros((len(flat), 5, 5)), np.zeros(3), pivots, bz)
    return np.asarray(np.where(np.isfinite(moved[:, 3]), moved[:, 3], 0.0).reshape(-1, 2))


_ITERATIONS = 30
_SETTLED = 1e-8  # of the chi-square by which the last step moved the vertex
_SINGULAR = 1e-14  # ratio of the eigenvalues of the inverse covariance


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
    """Helices about the origin of both tracks of each pair: (n, 2, 5), (n, 2, 5, 5); masses (2,) GeV/c2; field, T."""

    parameters: Floats
    cov: Floats
    masses: Floats
    bz: float


class _Linear(NamedTuple):
    """The tracks of pairs about a pivot.

    `measured` (n, 2, 2) is (dr, dz) there, `weight` its inverse covariance, `to_vertex` (n, 2, 2, 3) its derivative by
    the vertex; `direction` (n, 2, 3) is (flight azimuth, kappa, tanl), `gain` (n, 2, 3, 2) how it follows `measured`,
    `rest` (n, 2, 3, 3) its covariance for given `measured`, and `turn` (n, 2, 3, 3) its derivative by the vertex.
    """

    measured: Floats
    weight: Floats
    to_vertex: Floats
    direction: Floats
    gain: Floats
    rest: Floats
    turn: Floats


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
    tracks. The helices are linearised about the vertex, which is repeated until it stays.

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
        One row per pair, ordered by event. Rows whose `status` is not ok hold NaN.

    Raises
    ------
    ValueError
        Listing every problem of the arguments.

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
    good = np.all((tracks["status"] == 0)[rows], axis=1) & np.isfinite(parameters).all(axis=(1, 2))
    good &= np.isfinite(tracks["cov"][rows]).all(axis=(1, 2, 3))
    impact = tracks["cov"][rows][..., [[0], [3]], [0, 3]]  # which has an inverse
    good &= ((np.linalg.det(np.where(np.isfinite(impact), impact, 0.0)) > 0) & (impact[..., 0, 0] > 0)).all(axis=1)
    bz = compiled(load(detector)).field.bz
    masses = np.array([kind.mass for kind in kinds])
    some = _Pairs(parameters[good], tracks["cov"][rows[good]], masses, bz)
    found, status, iterations = _solved(some, beam_spot)
    columns = {name: np.full((len(rows), *value.shape[1:]), np.nan) for name, value in found.items()}
    for name, value in found.items():
        columns[name][good] = np.where((status == 0).reshape(-1, *[1] * (value.ndim - 1)), value, np.nan)
    ends = {"status": np.full(len(rows), int(VertexStatus.no_track)), "iterations": np.zeros(len(rows), np.int64)}
    ends["status"][good], ends["iterations"][good] = status, iterations
    return _table(tracks, rows, kinds, columns | ends, 1 if beam_spot is None else 4)


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
    vertex = starting_points(pairs.parameters, pairs.bz)
    status = np.full(n, int(VertexStatus.not_converged), np.int8)
    iterations = np.zeros(n, np.int32)
    cov = np.tile(np.eye(3), (n, 1, 1))
    going = np.arange(n)
    for _ in range(_ITERATIONS):
        if not len(going):
            break
        some = pairs._replace(parameters=pairs.parameters[going], cov=pairs.cov[going])
        step, cov[going], fine = _step(_linear(some, vertex[going]), vertex[going], beam_spot)
        iterations[going] += 1
        status[going[~fine]] = VertexStatus.singular
        vertex[going[fine]] += step[fine]
        distance = np.einsum("ni,nij,nj->n", step[fine], np.linalg.inv(cov[going[fine]]), step[fine])
        going, settled = going[fine][distance >= _SETTLED], going[fine][distance < _SETTLED]
        status[settled] = VertexStatus.ok
    ok = (status == VertexStatus.ok)[:, None]
    return _results(pairs, np.where(ok, vertex, 0.0), cov, beam_spot), status, iterations


def _linear(pairs: _Pairs, pivot: Floats) -> _Linear:
    """Return the tracks about a pivot for each pair, (n, 3) mm."""
    n = len(pivot)
    each = np.repeat(pivot, 2, axis=0)
    flat, cov = pairs.parameters.reshape(-1, 5), pairs.cov.reshape(-1, 5, 5)
    parameters, cov = helix.change_pivot(flat, cov, np.zeros(3), each, pairs.bz)
    dr, phi0, kappa, dz, tanl = parameters.T
    ex, ey = np.cos(phi0), np.sin(phi0)
    ux, uy = -ey, ex
    zero, one = np.zeros(2 * n), np.ones(2 * n)
    to_vertex = np.stack([ex, ey, zero, -tanl * ux, -tanl * uy, one], axis=1).reshape(-1, 2, 3)
    weight = np.linalg.inv(cov[:, [[0], [3]], [0, 3]])
    others = [[1], [2], [4]]
    across = cov[:, others, [0, 3]]
    gain = across @ weight
    rest = cov[:, others, [1, 2, 4]] - gain @ np.swapaxes(across, 1, 2)
    # The flight turns by w for each mm of arc; along it the vertex lies by u x beside the pivot.
    w = -pairs.bz * kappa / helix.RADIUS_PER_KAPPA
    turn = np.zeros((2 * n, 3, 3))
    turn[:, 0, 0], turn[:, 0, 1] = w * ux, w * uy
    direction = np.stack([phi0 + 0.5 * np.pi, kappa, tanl], axis=1)
    parts = (np.stack([dr, dz], axis=1), weight, to_vertex, direction, gain, rest, turn)
    return _Linear(*(np.asarray(part, np.float64).reshape(n, 2, *part.shape[1:]) for part in parts))


def _step(of: _Linear, pivot: Floats, beam_spot: BeamSpot | None) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """Return the vertex from the pivot, its covariance, and whether it is determined."""
    inverse = np.einsum("npai,npab,npbj->nij", of.to_vertex, of.weight, of.to_vertex)
    right = np.einsum("npai,npab,npb->ni", of.to_vertex, of.weight, of.measured)
    if beam_spot is not None:
        weight = 1 / np.square(beam_spot.sigma)
        inverse = inverse + np.diag(weight)
        right = right + weight * (np.array(beam_spot.position) - pivot)
    finite = np.isfinite(inverse).all(axis=(1, 2)) & np.isfinite(right).all(axis=1)
    inverse = np.where(finite[:, None, None], inverse, np.eye(3))
    eigenvalues = np.linalg.eigvalsh(inverse)
    fine = finite & (eigenvalues[:, 0] > _SINGULAR * eigenvalues[:, 2])
    cov = np.linalg.inv(np.where(fine[:, None, None], inverse, np.eye(3)))
    step = np.einsum("nij,nj->ni", cov, np.where(fine[:, None], right, 0.0))
    return step, cov, fine


def _results(pairs: _Pairs, vertex: Floats, cov: Floats, beam_spot: BeamSpot | None) -> dict[str, Floats]:
    """Return chi-square, momentum and mass of pairs at their vertices."""
    of = _linear(pairs, vertex)
    chi2 = np.einsum("npa,npab,npb->n", of.measured, of.weight, of.measured)
    if beam_spot is not None:
        chi2 = chi2 + np.sum(np.square((vertex - beam_spot.position) / beam_spot.sigma), axis=1)
    # At the vertex: direction and curvature, conditional on the tracks' passing through it.
    azimuth, kappa, tanl = np.moveaxis(of.direction - np.einsum("npia,npa->npi", of.gain, of.measured), -1, 0)
    pt = 1 / np.abs(kappa)
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
