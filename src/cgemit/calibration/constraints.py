"""Quantities of fitted tracks that must agree, as rows of the normal equations (docs/methods/alignment.md)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import helix
from cgemit.analysis.cosmics import BACKWARD, halves
from cgemit.base.arrays import Floats
from cgemit.calibration.settings import AlignmentSettings

Found = Mapping[str, npt.NDArray[Any]]

#: mm, of a vertex that is not known beforehand.
_ANYWHERE = 100.0


@dataclass(frozen=True, eq=False)
class Quantities:
    """Quantities that are 0 but for errors and constants.

    Attributes
    ----------
    apart : ndarray, (n, k) float64
        Their values.
    cov : ndarray, (n, k, k) float64
    slope : ndarray, (n, constants, k) float64
        Their derivatives by the constants.
    event : ndarray, (n,) int64
    """

    apart: Floats
    cov: Floats
    slope: Floats
    event: npt.NDArray[np.int64]

    def whitened(self) -> tuple[Floats, Floats]:
        """Return values and derivatives of independent combinations of error 1, (n, k) and (n, constants, k)."""
        # The errors of quantities differ by orders of magnitude.
        scale = 1 / np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))
        root = np.linalg.cholesky(self.cov * scale[:, :, None] * scale[:, None, :])
        values = np.linalg.solve(root, (self.apart * scale)[:, :, None])[:, :, 0]
        slope = np.linalg.solve(root, (self.slope * scale[:, None, :]).transpose(0, 2, 1)).transpose(0, 2, 1)
        return values, slope


def quantities(
    tracks: Found, event: npt.NDArray[np.int64], mass: Floats, charge: Floats, settings: AlignmentSettings
) -> Iterator[Quantities]:
    """Yield the quantities of tracks that settings join.

    Parameters
    ----------
    tracks : mapping of str to ndarray
        Of the core, with ``bias``.
    event : ndarray, (n,) int64
        Of each track.
    mass, charge : ndarray, (n,) float64, GeV/c2 and e
    settings : AlignmentSettings
    """
    if "cosmic" in settings.pairs:
        yield from _cosmic(tracks, event)
    if not {"vertex", "beam_line", "mass"} & set(settings.pairs):
        return
    used = np.flatnonzero(tracks["used"] == 1)
    used = used[np.argsort(event[used], kind="stable")]
    _, first, count = np.unique(event[used], return_index=True, return_counts=True)
    for number in np.unique(count):
        rows = used[first[count == number][:, None] + np.arange(number)]
        of_point = _from_one_point(tracks, rows, event[rows[:, 0]], mass, charge, settings)
        if of_point is not None:
            yield of_point


def _cosmic(tracks: Found, event: npt.NDArray[np.int64]) -> Iterator[Quantities]:
    """Yield the halves of muons that cross the detector: both are the same track."""
    upper, lower = halves(event, tracks["helix"][:, 1], tracks["used"] == 1)
    if not len(upper):
        return
    apart = tracks["helix"][lower] - tracks["helix"][upper] * BACKWARD
    apart[:, 1] = helix.wrap_angle(apart[:, 1] - np.pi)
    cov = tracks["cov"][lower] + BACKWARD[:, None] * tracks["cov"][upper] * BACKWARD
    slope = tracks["bias"][lower] - tracks["bias"][upper] * BACKWARD  # (pairs, constants, 5)
    yield Quantities(apart, cov, slope, event[lower])


def known_tracks(tracks: Found, event: npt.NDArray[np.int64], helices: Floats, cov: Floats) -> Iterator[Quantities]:
    """Yield the difference of tracks from helices that are known otherwise, by another program or detector.

    Parameters
    ----------
    tracks : mapping of str to ndarray
        Of the core, with ``bias``.
    event : ndarray, (n,) int64
    helices, cov : ndarray, (n, 5) and (n, 5, 5) float64
        NaN for tracks that are not known; errors are taken as independent of those of our fit.
    """
    rows = np.flatnonzero((tracks["used"] == 1) & np.isfinite(helices).all(axis=1))
    if not len(rows):
        return
    apart = tracks["helix"][rows] - helices[rows]
    apart[:, 1] = helix.wrap_angle(apart[:, 1])
    yield Quantities(apart, tracks["cov"][rows] + cov[rows], tracks["bias"][rows], event[rows])


def _from_one_point(
    of_tracks: Found, rows: npt.NDArray[np.intp], event: npt.NDArray[np.int64], mass: Floats, charge: Floats,
    settings: AlignmentSettings,
) -> Quantities | None:  # fmt: skip
    """Return the quantities of events with equally many tracks, rows (events, tracks): they leave one point.

    A track at a distance d_rho from the beam line passes a point v near it if d_rho = v n and d_z + tan(lambda) v u =
    v_z, with n = (cos phi_0, sin phi_0) and u along the flight. The point is eliminated: it adds its errors.
    """
    n, tracks = rows.shape
    joined, with_mass = "vertex" in settings.pairs and tracks > 1, "mass" in settings.pairs and tracks == 2
    lines = "beam_line" in settings.pairs
    if not (joined or with_mass or lines):
        return None
    x = of_tracks["helix"][rows]  # (events, tracks, 5)
    cosine, sine, tanl = np.cos(x[..., 1]), np.sin(x[..., 1]), x[..., 4]
    zero, unity = np.zeros((n, tracks)), np.ones((n, tracks))
    values, by_helix, by_point = [], [], []
    if joined or lines:
        values.append(x[..., 0])
        by_helix.append(np.eye(5)[0] * np.ones((n, tracks, 1)))
        by_point.append(np.stack([cosine, sine, zero], axis=-1))
    if joined:
        values.append(x[..., 3])
        by_helix.append(np.eye(5)[3] * np.ones((n, tracks, 1)))
        by_point.append(np.stack([tanl * sine, -tanl * cosine, unity], axis=-1))
    k = tracks * len(values) + with_mass
    apart, jacobian, spread = np.zeros((n, k)), np.zeros((n, k, tracks, 5)), np.zeros((n, k, 3))
    for i, (value, derivative, point) in enumerate(zip(values, by_helix, by_point, strict=True)):
        for track in range(tracks):
            row = i * tracks + track
            apart[:, row], jacobian[:, row, track], spread[:, row] = (
                value[:, track],
                derivative[:, track],
                point[:, track],
            )
    if with_mass:
        apart[:, -1], jacobian[:, -1] = _mass(x, mass[rows], charge[rows])
        apart[:, -1] -= settings.mass or 0.0
    across = settings.beam_width if lines else (_ANYWHERE, _ANYWHERE)
    cov = np.einsum("nip,p,njp->nij", spread, np.array([*across, _ANYWHERE]) ** 2, spread)
    cov += np.einsum("nita,ntab,njtb->nij", jacobian, of_tracks["cov"][rows], jacobian, optimize=True)
    if with_mass:
        cov[:, -1, -1] += settings.mass_width**2
    slope = np.einsum("nita,ntca->nci", jacobian, of_tracks["bias"][rows], optimize=True)
    return Quantities(apart, cov, slope, event)


def _mass(x: Floats, mass: Floats, charge: Floats) -> tuple[Floats, Floats]:
    """Return the invariant masses of two tracks, (n,) GeV/c2, and their derivatives by the helices, (n, 2, 5)."""
    across = charge / np.abs(x[..., 2])
    p = np.stack([-across * np.sin(x[..., 1]), across * np.cos(x[..., 1]), across * x[..., 4]], axis=-1)
    energy = np.sqrt(np.sum(p**2, axis=-1) + mass**2)
    total = np.sqrt(np.sum(energy, axis=1) ** 2 - np.sum(np.sum(p, axis=1) ** 2, axis=-1))
    other, other_energy = p[:, ::-1], energy[:, ::-1]
    by_p = (other_energy[..., None] * p / energy[..., None] - other) / total[:, None, None]
    zero = np.zeros_like(across)
    by_phi = np.stack([-p[..., 1], p[..., 0], zero], axis=-1)
    by_tanl = np.stack([zero, zero, across], axis=-1)
    by_helix = np.zeros((*x.shape[:2], 5))
    by_helix[..., 1] = np.sum(by_p * by_phi, axis=-1)
    by_helix[..., 2] = np.sum(by_p * -p, axis=-1) / x[..., 2]
    by_helix[..., 4] = np.sum(by_p * by_tanl, axis=-1)
    return total, by_helix
