"""Helix parameters of BES3 software: dr, phi0, kappa, dz, tanl with the pivot at the origin (docs/conventions.md)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.tables import Table
from cgemit.tables.check import refuse_wrong
from cgemit.units import GEV_PER_T_MM

#: Names of the parameters in the order of arrays.
PARAMETERS = ("dr", "phi0", "kappa", "dz", "tanl")

#: mm T / (GeV/c): radius of curvature is RADIUS_PER_KAPPA / (B_z kappa). Exact.
RADIUS_PER_KAPPA = 1 / GEV_PER_T_MM


def at_origin(particles: Table, bz: float) -> Floats:
    """Helix of each particle at its closest approach to the beam line, in vacuum.

    Circle of centre vertex + R (sin psi, -cos psi), R = RADIUS_PER_KAPPA / (bz kappa); the arc to the closest point
    is the one shorter than half a turn.

    Parameters
    ----------
    particles : Table of kind "particles"
        Charged; rows without charge or transverse momentum are NaN.
    bz : float
        T, signed.

    Returns
    -------
    ndarray, (n, 5) float64
        dr mm, phi0 rad in (-pi, pi], kappa (GeV/c)^-1, dz mm, tanl.

    Raises
    ------
    ValueError
        If the table has wrong values.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=2, until="simulate")
    >>> cg.helix.at_origin(r.particles, bz=-1.0)[:, 2].round(6)  # kappa, 1/(GeV/c)
    array([-1., -1.])
    """
    refuse_wrong("at_origin", particles=particles)
    return _at_origin(particles, bz)


def _at_origin(particles: Table, bz: float) -> Floats:
    px, py = particles["px"], particles["py"]
    pt = np.hypot(px, py)
    with np.errstate(divide="ignore", invalid="ignore"):
        kappa = np.where((particles["charge"] != 0) & (pt > 0), particles["charge"] / pt, np.nan)
        ux, uy, tanl = px / pt, py / pt, np.where(np.isnan(kappa), np.nan, particles["pz"] / pt)
    x, y = particles["x"], particles["y"]
    w = -bz * kappa / RADIUS_PER_KAPPA
    sideways, outward = x * uy - y * ux, x * ux + y * uy
    # Back to the closest point the flight turns by theta: P cos(theta) + (1/w - S) sin(theta) = 0, without 1/w.
    theta = -np.arctan2(w * outward, 1 - w * sideways)
    with np.errstate(divide="ignore", invalid="ignore"):
        arc = np.where(w == 0, -outward, theta / w)
    # S^2 at the perigee is r^2 there: d = S + (change of S) follows from the circle, written without cancellation.
    reach = np.hypot(1 - w * sideways, w * outward)
    dr = (2 * sideways - w * (x * x + y * y)) / (1 + reach)
    phi0 = wrap_angle(np.arctan2(uy, ux) + theta - 0.5 * np.pi)
    return np.stack([dr, phi0, kappa, particles["z"] + arc * tanl, tanl], axis=1)


def at_origin_in(particles: Table, field: _core.detector.Field) -> Floats:
    """Helix of each particle where it was closest to the beam line, tracked back through any field in vacuum.

    Parameters
    ----------
    particles : Table of kind "particles"
        Charged; rows without charge or transverse momentum are NaN.
    field : _core.detector.Field
        Where the backward track leaves the map, the field at the origin is used.

    Returns
    -------
    ndarray, (n, 5) float64
        dr mm, phi0 rad in (-pi, pi], kappa (GeV/c)^-1, dz mm, tanl of the helix that touches the track there.

    Examples
    --------
    >>> from cgemit.detector import compiled
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=2, until="simulate")
    >>> cg.helix.at_origin_in(r.particles, compiled(r.detector).field)[:, 2].round(6)  # kappa, 1/(GeV/c)
    array([-1., -1.])
    """
    nominal = _at_origin(particles, field.bz)
    if field.is_uniform:
        return nominal
    px, py, pz = (particles[name] for name in ("px", "py", "pz"))
    pt = np.hypot(px, py)
    bent = (particles["charge"] != 0) & (pt > 0)
    per_pt = 1 / np.where(bent, pt, 1.0)
    places = [particles[name] for name in "xyz"]
    flights = [px * per_pt, py * per_pt, pz * per_pt, particles["charge"] * per_pt]
    points, reached = field.to_perigee(np.stack([*places, *flights], axis=1))
    x, y, z, ux, uy, tanl = points.T
    sec_lambda = np.hypot(1, pz * per_pt)
    # p is conserved, pT is not.
    kappa = particles["charge"] * per_pt / sec_lambda * np.hypot(1, tanl)
    phi0 = wrap_angle(np.arctan2(-ux, uy))
    parameters = np.stack([x * uy - y * ux, phi0, kappa, z, tanl], axis=1)
    return np.asarray(np.where((bent & (reached == 1))[:, None], parameters, nominal))


def wrap_angle(angle: npt.ArrayLike) -> Floats:
    """Return the same angles in (-pi, pi]; those that lie there already keep every bit.

    Parameters
    ----------
    angle : array_like, rad

    Returns
    -------
    ndarray, as `angle`, float64, rad

    Examples
    --------
    >>> print(cg.helix.wrap_angle([0.1, 3.5, -np.pi]).round(3))  # rad
    [ 0.1   -2.783  3.142]
    """
    angle = np.asarray(angle, np.float64)
    wrapped = angle - 2 * np.pi * np.rint(angle / (2 * np.pi))
    return np.where(wrapped <= -np.pi, wrapped + 2 * np.pi, wrapped)


def _parameters(given: npt.ArrayLike) -> Floats:
    """Return helix parameters as an array, (5,) or (n, 5) float64.

    Raises
    ------
    ValueError
        If they have another shape.
    """
    array = np.asarray(given, np.float64)
    if array.ndim not in (1, 2) or array.shape[-1] != 5:
        raise ValueError(f"parameters: got shape {array.shape}, expected (5,) or (n, 5): {', '.join(PARAMETERS)}")
    return array


def _with_covariance(parameters: npt.ArrayLike, cov: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Return parameters and covariance of one helix, (5,) and (5, 5), or of many, (n, 5) and (n, 5, 5) float64.

    Raises
    ------
    ValueError
        If the shapes do not belong to each other.
    """
    array, covariance = _parameters(parameters), np.asarray(cov, np.float64)
    if covariance.shape != (*array.shape, 5):
        raise ValueError(f"cov: got shape {covariance.shape}, expected {(*array.shape, 5)}, as parameters have it")
    return array, covariance


def momentum(parameters: npt.ArrayLike, charge: npt.ArrayLike = 1) -> Floats:
    """Momentum of helices.

    Parameters
    ----------
    parameters : array_like, (n, 5) or (5,) float64
    charge : array_like, (n,) or (), e
        Its sign is that of kappa.

    Returns
    -------
    ndarray, (n,) or () float64, GeV/c
        |charge| sqrt(1 + tanl^2) / |kappa|.

    Examples
    --------
    >>> print(cg.helix.momentum([0.0, 0.0, -2.0, 0.0, 0.75]))  # GeV/c
    0.625
    """
    _, _, kappa, _, tanl = np.moveaxis(_parameters(parameters), -1, 0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.abs(charge) * (np.sqrt(1 + tanl**2) / np.abs(kappa)))


def momentum_vector(parameters: npt.ArrayLike, charge: npt.ArrayLike = 1) -> Floats:
    """Momentum of helices at the point that is closest to their pivot.

    Parameters
    ----------
    parameters : array_like, (n, 5) or (5,) float64
    charge : array_like, (n,) or (), e
        Its sign is that of kappa.

    Returns
    -------
    ndarray, (n, 3) or (3,) float64, GeV/c
        |charge| (-sin phi0, cos phi0, tanl) / |kappa|.

    Examples
    --------
    >>> print(cg.helix.momentum_vector([0.0, 0.0, -2.0, 0.0, 0.75]) + 0.0)  # GeV/c
    [0.    0.5   0.375]
    """
    _, phi0, kappa, _, tanl = np.moveaxis(_parameters(parameters), -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        direction = np.stack([-np.sin(phi0), np.cos(phi0), tanl], axis=-1)
        return np.asarray(np.abs(charge)[..., None] * (direction / np.abs(kappa)[..., None]))


def change_pivot(
    parameters: npt.ArrayLike,
    cov: npt.ArrayLike,
    pivot_from: npt.ArrayLike,
    pivot_to: npt.ArrayLike,
    bz: npt.ArrayLike,
) -> tuple[Floats, Floats]:
    """Return the same helices with respect to another pivot, as defined in BES3 software.

    The circle's centre stays: (dr' + R) e(phi0') + pivot_to = (dr + R) e(phi0) + pivot_from, e(phi) = (cos phi,
    sin phi), R = RADIUS_PER_KAPPA / (bz kappa) with its sign; dz' = dz - R tanl (phi0' - phi0) and the difference of
    the pivots in z, |phi0' - phi0| < pi. kappa and tanl stay.

    Parameters
    ----------
    parameters : array_like, (n, 5) or (5,) float64
        dr mm, phi0 rad, kappa (GeV/c)^-1, dz mm, tanl.
    cov : array_like, (n, 5, 5) or (5, 5) float64
        Their covariance.
    pivot_from, pivot_to : array_like, (3,) or (n, 3) float64
        x, y, z, mm.
    bz : array_like, () or (n,) float64
        T, signed. In a field map, the field that bends the track there (docs/methods/states.md), for pivots near each
        other.

    Returns
    -------
    parameters : ndarray, (n, 5) or (5,) float64
        NaN where the pivot is the centre of the circle, to which no point is closest.
    cov : ndarray, (n, 5, 5) or (5, 5) float64
        Their covariance, with the exact Jacobian.

    Raises
    ------
    ValueError
        If shapes do not fit.

    Examples
    --------
    >>> track, zero = [1.0, 0.0, -1.0, 5.0, 0.5], [0.0, 0.0, 0.0]
    >>> moved, cov = cg.helix.change_pivot(track, np.eye(5), zero, [1.0, 0.0, 0.0], bz=-1.0)
    >>> print(moved.round(3))
    [ 0.   0.  -1.   5.   0.5]
    """
    start, covariance = _with_covariance(parameters, cov)
    rows = start.size // 5
    step = np.ascontiguousarray(np.broadcast_to(np.subtract(pivot_to, pivot_from, dtype=np.float64), (rows, 3)))
    field = np.ascontiguousarray(np.broadcast_to(np.asarray(bz, np.float64), rows))
    helices = np.ascontiguousarray(start).reshape(-1, 5), np.ascontiguousarray(covariance).reshape(-1, 25)
    moved, with_errors = _core.kalman.change_pivot(*helices, step, field)
    return moved.reshape(start.shape), with_errors.reshape(covariance.shape)


def start_radius(parameters: npt.ArrayLike, vertex: npt.ArrayLike, bz: npt.ArrayLike) -> Floats:
    """Return where helices begin, for fits that leave out matter not crossed (`FitSettings.start_radius`).

    Parameters
    ----------
    parameters : array_like, (n, 5) or (5,) float64
        dr mm, phi0 rad, kappa (GeV/c)^-1, dz mm, tanl, pivot at the origin.
    vertex : array_like, (n, 3) or (3,) float64
        Point where each begins, x, y, z, mm.
    bz : array_like, () or (n,) float64
        T, signed.

    Returns
    -------
    ndarray, (n,) or () float64, mm
        Distance of the vertex from the beam line; negative where the particle flew towards the beam line first.

    Examples
    --------
    >>> track = [0.0, 0.0, -1.0, 0.0, 0.5]
    >>> print(cg.helix.start_radius(track, [0.0, 20.0, 10.0], bz=-1.0))  # mm
    20.0
    """
    start, point = _parameters(parameters), np.asarray(vertex, np.float64)
    if point.shape[-1:] != (3,) or point.ndim > start.ndim:
        raise ValueError(f"vertex: got shape {point.shape}, expected (3,) or {(*start.shape[:-1], 3)}")
    there, _ = change_pivot(start, np.zeros((*start.shape, 5)), np.zeros(3), point, bz)
    turn = wrap_angle(there[..., 1] - start[..., 1])
    field, phi0 = np.asarray(bz, np.float64), start[..., 1]
    ahead = point[..., 1] * np.cos(phi0) - point[..., 0] * np.sin(phi0) > 0  # along a straight flight
    # The azimuth changes by -s/R along the flight.
    outward = np.where(field == 0, ahead, field * start[..., 2] * turn < 0)
    return np.where(outward, 1.0, -1.0) * np.hypot(point[..., 0], point[..., 1])


def path_to(radius: npt.ArrayLike, kappa: npt.ArrayLike, bz: float) -> tuple[Floats, Floats]:
    """Turn and length of tracks from the beam line to a cylinder about it.

    A circle of radius R through the origin meets the radius r where its azimuth has turned by asin(r/2R), the direction
    by twice that.

    Parameters
    ----------
    radius : array_like, mm
    kappa : array_like, (GeV/c)^-1
    bz : float
        T, of either sign.

    Returns
    -------
    turned : ndarray, rad
        Change of the azimuth in size; pi/2 for tracks that turn back before.
    arc : ndarray, mm
        Length in the transverse plane; that to the farthest point times r/2R for tracks that turn back before.

    Examples
    --------
    >>> turned, arc = cg.helix.path_to(100.0, [0.0, 1.0], bz=-1.0)
    >>> print(turned.round(5), arc.round(3))  # rad, mm
    [0.      0.01499] [100.    100.004]
    """
    reach = 0.5 * np.abs(np.multiply(radius, np.multiply(bz, kappa))) / RADIUS_PER_KAPPA
    turned = np.arcsin(np.minimum(reach, 1.0))
    return turned, np.asarray(np.divide(radius, np.sinc(turned / np.pi)))


def momentum_error(parameters: npt.ArrayLike, cov: npt.ArrayLike, charge: npt.ArrayLike = 1) -> Floats:
    """Standard deviation of the momentum.

    Parameters
    ----------
    parameters : array_like, (n, 5) or (5,) float64
    cov : array_like, (n, 5, 5) or (5, 5) float64
    charge : array_like, (n,) or (), e
        Its sign is that of kappa.

    Returns
    -------
    ndarray, (n,) or () float64, GeV/c
        First order in kappa and tanl, with their covariance.

    Examples
    --------
    >>> tracks = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=2).tracks
    >>> parameters = np.stack([tracks[name] for name in cg.helix.PARAMETERS], axis=1)
    >>> bool(np.allclose(cg.helix.momentum_error(parameters, tracks["cov"]), tracks["err_p"]))
    True
    """
    parameters, cov = _with_covariance(parameters, cov)
    p, kappa, tanl = momentum(parameters, charge), parameters[..., 2], parameters[..., 4]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_kappa, by_tanl = -p / kappa, p * tanl / (1 + tanl * tanl)
        both = 2 * by_kappa * by_tanl * cov[..., 2, 4]
        error = np.sqrt(by_kappa**2 * cov[..., 2, 2] + both + by_tanl**2 * cov[..., 4, 4])
    # The sign of a NaN depends on the vector instructions, and these on a row's place in the array.
    return np.asarray(np.where(np.isnan(error), np.nan, error))


def to_perigee(parameters: npt.ArrayLike, cov: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Perigee parameters (d0, z0, phi, theta, q/p) of helices, as defined in other tracking programs.

    d0 = -dr, z0 = dz, phi = phi0 + pi/2, theta = pi/2 - atan(tanl), q/p = kappa / sqrt(1 + tanl^2); same pivot.

    Parameters
    ----------
    parameters : array_like, (n, 5) or (5,) float64
        dr mm, phi0 rad, kappa (GeV/c)^-1, dz mm, tanl.
    cov : array_like, (n, 5, 5) or (5, 5) float64
        Their covariance.

    Returns
    -------
    perigee : ndarray, (n, 5) or (5,) float64
        d0 mm, z0 mm, phi rad in (-pi, pi], theta rad in (0, pi), q/p (GeV/c)^-1.
    cov : ndarray, (n, 5, 5) or (5, 5) float64
        Their covariance, to first order.

    Examples
    --------
    >>> perigee, cov = cg.helix.to_perigee([0.1, 0.0, -1.0, 5.0, 0.75], np.eye(5))
    >>> print(perigee.round(3))  # d0, z0, phi, theta, q/p
    [-0.1    5.     1.571  0.927 -0.8  ]
    """
    parameters, cov = _with_covariance(parameters, cov)
    dr, phi0, kappa, dz, tanl = np.moveaxis(parameters, -1, 0)
    cos2 = 1 / (1 + tanl * tanl)
    cosine = np.sqrt(cos2)
    phi = wrap_angle(phi0 + 0.5 * np.pi)
    perigee = np.stack([-dr, dz, phi, np.arctan2(1, tanl), kappa * cosine], axis=-1)
    jacobian = np.zeros((*perigee.shape, 5))
    jacobian[..., 0, 0], jacobian[..., 1, 3], jacobian[..., 2, 1] = -1, 1, 1
    jacobian[..., 3, 4] = -cos2
    jacobian[..., 4, 2], jacobian[..., 4, 4] = cosine, -kappa * tanl * cos2 * cosine
    return perigee, jacobian @ cov @ np.swapaxes(jacobian, -1, -2)
