"""The best that any estimate can do: least squares with the noise of matter, worked out without the fit.

A track is followed through detector and matter in plain numpy, without the compiled core; formulas of loss and
scattering are written anew from their papers. Only the weights of matter that acts together are the fit's. What the
track measures is differentiated by the helix parameters, and by one scattering angle or loss after the other, through
differences. With A and B these derivatives (B in standard deviations) and R the variances of the measurements, the
covariance of generalised least squares is (A^T V^-1 A)^-1, V = R + B B^T.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

import cgemit as cg
from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.detector import Slab, slabs
from cgemit.detector.layers import CgemLayer
from cgemit.detector.layers.wires import WireLayer
from cgemit.fit_matter import tuned
from cgemit.reconstruction.fit import PARAMETERS

LIGHT = 0.299792458e-3  # GeV/c per (T mm)
ELECTRON = 0.51099895e-3  # GeV
FINE_STRUCTURE = 1 / 137.035999084
BETHE = 0.307075e-3  # GeV cm2/mol
X, V, WIRE = 0, 1, 2
SIGMAS = 2.4  # losses count below so many standard deviations of the energy
_THICK = 5e-3  # mm, sideways shifts at 1 GeV/c below this are neither simulated nor fitted


@dataclass(frozen=True)
class Hit:
    """A measurement: kind (X, V, WIRE), layer as in the tables, sheet or wire, and its error, mm.

    X is unrolled about the azimuth `about`, rad; None: about the first of the tracks that are followed. Tracks on both
    sides of the edge of a sheet differ by a circumference if `about` crosses it.
    """

    kind: int
    layer: int
    channel: int
    sigma: float
    about: float | None = None


class TurnsBackError(Exception):
    """Some tracks reach matter where others have turned back: their differences say nothing."""


@dataclass
class Flight:
    """Tracks side by side: position (3, n) mm and momentum (3, n) GeV/c, of one charge and mass in a field along z."""

    at: Floats
    p: Floats
    charge: float
    mass: float
    bz: float

    def turning(self) -> Floats:
        """Change of azimuth per transverse length, 1/mm."""
        return -LIGHT * self.charge * self.bz / np.hypot(self.p[0], self.p[1])

    def advance(self, arc: Floats) -> None:
        """Move along the helix by a transverse arc, mm."""
        pt, w = np.hypot(self.p[0], self.p[1]), self.turning()
        turn = w * arc
        cos, sin = np.cos(turn), np.sin(turn)
        ux, uy = self.p[0] / pt, self.p[1] / pt
        self.at = self.at + np.stack(
            [(ux * sin - uy * (1 - cos)) / w, (uy * sin + ux * (1 - cos)) / w, arc * self.p[2] / pt]
        )
        self.p = np.stack([pt * (ux * cos - uy * sin), pt * (uy * cos + ux * sin), self.p[2]])

    def go_to(self, radius: float) -> npt.NDArray[np.bool_]:
        """Move to where the two circles meet on the way outward; a wire may have been behind that place.

        Tracks that turn back before go to their outermost point; returns which do not.
        """
        pt, w = np.hypot(self.p[0], self.p[1]), self.turning()
        cx, cy = self.at[0] - self.p[1] / pt / w, self.at[1] + self.p[0] / pt / w
        ax, ay = self.at[0] - cx, self.at[1] - cy
        along, across = cx * ax + cy * ay, cy * ax - cx * ay
        reach = (radius**2 - cx**2 - cy**2 - 1 / w**2) / 2 / np.hypot(along, across)
        turn = np.arctan2(across, along) - np.sign(w) * np.arccos(np.clip(reach, -1, 1))
        self.advance((np.remainder(turn + np.pi, 2 * np.pi) - np.pi) / w)
        return np.asarray(np.abs(reach) <= 1)

    def axes(self) -> tuple[Floats, Floats]:
        """Unit vectors across the flight: horizontal, and the one that completes a right-handed set."""
        pt, p = np.hypot(self.p[0], self.p[1]), np.linalg.norm(self.p, axis=0)
        first = np.stack([-self.p[1] / pt, self.p[0] / pt, 0 * pt])
        return first, np.cross(self.p / p, first, axis=0)


def follow(
    detector: cg.Detector,
    hits: Sequence[Hit],
    helix: Floats,
    mass: float,
    kicks: dict[int, Floats],
    stop: list[TracedSlab],
) -> Floats:
    """Return what the tracks measure, (hits, n) mm; `kicks` per slab: two angles, energy (GeV), two shifts, (5, n).

    Raises TurnsBackError where only some of them reach the next slab.
    """
    dr, phi0, kappa, dz, tanl = helix
    pt = 1 / np.abs(kappa)
    flight = Flight(
        np.stack([dr * np.cos(phi0), dr * np.sin(phi0), dz]),
        np.stack([-pt * np.sin(phi0), pt * np.cos(phi0), pt * tanl]),
        float(np.sign(kappa[0])), mass, detector.field.bz,
    )  # fmt: skip
    seen: list[Floats] = []
    wires = {layer.number: layer for layer in (detector.drift_chamber.layers if detector.drift_chamber else ())}
    for number, slab in enumerate(stop):
        while len(seen) < len(hits) and hits[len(seen)].kind == WIRE:
            layer = wires[hits[len(seen)].layer]
            if layer.r_mid > slab.radius:
                break
            seen.append(_distance(flight, layer, hits[len(seen)].channel))
        if len(seen) == len(hits):
            break
        reached = flight.go_to(slab.radius)
        if not reached.all():
            if reached.any():
                raise TurnsBackError
            break
        while len(seen) < len(hits) and hits[len(seen)].kind != WIRE and hits[len(seen)].layer == slab.gap:
            seen.append(_strip(flight, detector.cgem[slab.gap], hits[len(seen)]))
        if abs(flight.at[2, 0]) <= slab.half_length:
            slab.cross(flight, kicks.get(number))
    while len(seen) < len(hits):
        seen.append(_distance(flight, wires[hits[len(seen)].layer], hits[len(seen)].channel))
    return np.array(seen)


def _strip(flight: Flight, layer: CgemLayer, hit: Hit) -> Floats:
    """X or V where the track is in the middle of a drift gap."""
    azimuth = np.arctan2(flight.at[1], flight.at[0])
    about = azimuth[0] if hit.about is None else hit.about
    first = (about - layer.sheet_phi[hit.channel]) % (2 * np.pi)
    x = layer.r_readout * (first + np.remainder(azimuth - about + np.pi, 2 * np.pi) - np.pi)
    if hit.kind == X:
        return np.asarray(x, np.float64)
    v = x * np.cos(layer.stereo) + (layer.z_ref - flight.at[2]) * np.sin(layer.stereo)
    return np.asarray(v, np.float64)


def _distance(flight: Flight, layer: WireLayer, wire: int) -> Floats:
    """Signed distance to a wire, with the track moved there: Newton's method for the right angle between them."""
    east, west = (np.array(end) for end in layer.end_points(wire))
    along = ((east - west) / np.linalg.norm(east - west))[:, None]
    flight.go_to(layer.r_mid)
    for _ in range(6):
        pt = np.hypot(flight.p[0], flight.p[1])
        tangent = flight.p / pt  # per transverse arc
        bend = flight.turning() * np.stack([-tangent[1], tangent[0], 0 * pt])
        offset = flight.at - west[:, None]
        offset = offset - np.sum(offset * along, axis=0) * along
        tilted = tangent - np.sum(tangent * along, axis=0) * along
        slope = np.sum(tilted * tilted, axis=0) + np.sum(offset * bend, axis=0)
        flight.advance(-np.sum(offset * tangent, axis=0) / slope)
    normal = np.cross(flight.p, np.broadcast_to(along, flight.p.shape), axis=0)
    distance = np.sum((flight.at - west[:, None]) * normal, axis=0) / np.linalg.norm(normal, axis=0)
    return np.asarray(distance, np.float64)


class TracedSlab:
    """Matter at one radius, and what it does to a track.

    On the track all matter has the sum xi, each slab's times the share of its losses that the fit does not see, and the
    matter that acts with the slab has chi_c^2. Of the parameters that it acts on, hits have `by_hits` (p beta)^2 times
    the variance of scattering. The cut of the loss is that for an `error` of the momentum, scaled by `per_unseen`.
    """

    def __init__(
        self, slab: Slab, whole_xi: float, acting_chi_c2: float, error: float, per_unseen: float = 1.0,
        by_hits: float = 0.0,
    ) -> None:  # fmt: skip
        self.slab, self.radius, self.gap, self.spread = slab, slab.radius, slab.gap, slab.spread
        self.half_length = max(shell.ends[1] for shell in slab.shells)
        self.whole_xi, self.acting_chi_c2, self.error, self.per_unseen = whole_xi, acting_chi_c2, error, per_unseen
        self.by_hits = by_hits
        self.shifts = slab.spread * 13.6e-3 * np.sqrt(slab.x0) > _THICK
        self.sigma = np.zeros(5)

    def cross(self, flight: Flight, kick: Floats | None) -> None:
        """Scatter and slow down."""
        p = np.linalg.norm(flight.p, axis=0)
        pt, r = np.hypot(flight.p[0], flight.p[1]), self.radius
        path = p / pt * r / np.abs((flight.at[0] * flight.p[0] + flight.at[1] * flight.p[1]) / pt)
        energy = np.hypot(p, flight.mass)
        loss, spread = self.loss(p, flight.mass, path)
        after = np.sqrt((energy - loss) ** 2 - flight.mass**2)
        angle = self.angle(p[0], after[0], flight.mass, path[0])
        shift = angle * self.spread * path[0] if self.shifts else 0.0
        self.sigma = np.array([angle, angle, spread[0], shift, shift])
        if kick is None:
            kick = np.zeros((5, len(p)))
        after = np.sqrt((energy - loss - kick[2]) ** 2 - flight.mass**2)
        first, second = flight.axes()
        flight.at = flight.at + kick[3] * first + kick[4] * second
        direction = flight.p / p + kick[0] * first + kick[1] * second
        flight.p = direction / np.linalg.norm(direction, axis=0) * after

    def loss(self, p: Floats, mass: float, path: Floats) -> tuple[Floats, Floats]:
        """Mean (PDG 2024, eq. 34.11) and root of the variance of collisions below the cut, GeV."""
        beta2 = p * p / (p * p + mass * mass)
        w_max, xi = _w_max(p, mass), self.slab.xi * path / beta2
        below, resolved = SIGMAS**2 * self.whole_xi / beta2, SIGMAS * self.error * p * np.sqrt(beta2)
        cut = np.minimum(0.5 * (below + np.sqrt(below**2 + 4 * resolved**2)) * self.per_unseen, w_max)
        bracket = np.log(2 * ELECTRON * (p / mass) ** 2 * cut) - beta2 * (1 + cut / w_max)
        bracket = bracket + self.slab.log_term(np.log(p / mass))
        return xi * bracket, np.sqrt(xi * cut * (1 - beta2 * cut / w_max / 2))

    def angle(self, p: float, after: float, mass: float, path: float) -> float:
        """Plane angle: Lynch and Dahl, Nucl. Instrum. Methods B 58 (1991) 6, F = 0.98, with the matter that acts."""
        beta2, beta2_after = (q * q / (q * q + mass * mass) for q in (p, after))
        end = self.acting_chi_c2 * (1 / beta2 + self.by_hits * p * p) / (2 * (1 - 0.98))
        recoil = 2 * ELECTRON * float(_w_max(np.array([p]), mass)[0])
        total = 0.0
        for z, chi_c2, electrons in _elements(self.slab):
            thomas_fermi = FINE_STRUCTURE * ELECTRON * z ** (1 / 3) / 0.885
            geant = 1 + np.exp(-z * z / 1000) if z >= 2 else 1.0
            screening = thomas_fermi**2 * (1.13 + 3.76 * (z * FINE_STRUCTURE) ** 2 / beta2) * geant
            total += chi_c2 * (np.log(end / screening) - 1) - electrons * np.log(max(end / recoil, 1.0))
        return float(np.sqrt(total * path / (1 + 0.98**2) / np.sqrt(beta2 * beta2_after) / (p * after)))


def _w_max(p: Floats, mass: float) -> Floats:
    """Largest transfer to an electron at rest, GeV; PDG 2024, eq. 34.4."""
    ratio = ELECTRON / mass
    return 2 * ELECTRON * (p / mass) ** 2 / (1 + 2 * np.hypot(1, p / mass) * ratio + ratio**2)


def _elements(slab: Slab) -> list[tuple[float, float, float]]:
    """Z and (chi_c p beta)^2 of all and of the electrons, GeV^2, at normal incidence."""
    found = []
    for shell in slab.shells:
        for element, per_gram in shell.material.elements():
            electrons = BETHE * ELECTRON * element.z * per_gram * shell.material.density * 0.1 * shell.thickness
            found.append((element.z, electrons * (element.z + 1), electrons))
    return found


def stack_of(detector: cg.Detector, tanl: float, error: float) -> list[TracedSlab]:
    """The slabs of a detector, with the sums along a straight line from the origin.

    `error`: of the momentum without straggling, relative.
    """
    found, crossed = slabs(detector), []
    for slab in found:
        if abs(tanl) * slab.radius <= max(shell.ends[1] for shell in slab.shells):
            crossed.append(slab)
        elif slab.ends:
            break
    stretch = float(np.hypot(1, tanl))
    compact = tuned(detector)
    unseen = compact.unseen
    per_unseen = np.where(unseen > 0.01, 1 / np.maximum(unseen, 0.1), 1.0)
    xi = stretch * sum(slab.xi * share for slab, share in zip(found, unseen, strict=True) if slab in crossed)
    chi_c2 = stretch * sum(row[1] for slab in crossed for row in _elements(slab))
    own = [stretch * sum(row[1] for row in _elements(slab)) for slab in found]
    acting = np.maximum(np.minimum(stretch * compact.acting, chi_c2), own)
    return [
        TracedSlab(slab, xi, float(one), error, float(scale), float(hits))
        for slab, one, scale, hits in zip(found, acting, per_unseen, compact.by_hits, strict=True)
    ]


Stack = Callable[[cg.Detector, float, float], list[TracedSlab]]


def error_of(detector: cg.Detector, helix: Floats, mass: float) -> float:
    """The relative error of the momentum that the fit counts losses for."""
    p = float(np.hypot(1, helix[4]) / abs(helix[2]))
    return _core.matter.momentum_error(tuned(detector), p=p, mass=mass, tanl=float(helix[4]))


#: What the optimum is worked out for: the helix parameters, and p.
QUANTITIES = (*PARAMETERS, "p")

_PART = 0.3  # of a standard deviation, the steps of noise
_STEP = np.array([1e-2, 1e-5, 1e-5, 1e-2, 1e-5])  # of the helix parameters; kappa relative


@dataclass(frozen=True)
class Optimum:
    """The optimal estimate of a helix from some hits, in the order of `PARAMETERS`.

    Attributes
    ----------
    cov : ndarray, (5, 5) float64
        Its covariance, where all is linear.
    bias : ndarray, (6,) float64
        Mean error of `QUANTITIES`, in standard deviations, because what is measured is not linear in helix, angles and
        losses: to second order, as M. J. Box, J. R. Stat. Soc. B 33 (1971) 171, but with angles and losses that are
        random.
    linear_bias : ndarray, (5,) float64
        That of the helix for an estimate that takes what is measured as linear in angles and losses.
    pull : ndarray, (6,) float64
        Mean of the pulls of `QUANTITIES` where the error is worked out at the estimate, as it has to be: the bias, less
        the covariance of the estimate and the logarithm of its error. NaN where it was not asked for.
    """

    cov: Floats
    bias: Floats
    linear_bias: Floats
    pull: Floats


@dataclass(frozen=True)
class _Track:
    """Hits, and the helix about which they are looked at."""

    detector: cg.Detector
    hits: Sequence[Hit]
    helix: Floats
    mass: float
    matter: Stack

    def stack(self) -> list[TracedSlab]:
        """Return the matter that it meets."""
        return self.matter(self.detector, self.helix[4], error_of(self.detector, self.helix, self.mass))


@dataclass(frozen=True)
class _Linear:
    """What is seen about a helix: how it changes with helix and noise, the noise, and its second derivatives by that.

    `gain` is that of the linear estimate; `noise` are slab, which of its five kicks, and the standard deviation;
    `by_kicks` is half the sum of second derivatives.
    """

    cov: Floats
    gain: Floats
    by_helix: Floats
    by_noise: Floats
    noise: list[tuple[int, int, float]]
    by_kicks: Floats
    centre: Floats


def optimum(
    detector: cg.Detector,
    hits: Sequence[Hit],
    helix: npt.ArrayLike,
    mass: float,
    *,
    pulls: bool = False,
    matter: Stack = stack_of,
) -> Optimum:
    """Return covariance, bias and mean pulls of the optimal estimate.

    Parameters
    ----------
    detector : Detector
    hits : sequence of Hit
        Ordered outward.
    helix : (5,) array_like
        mm, rad, (GeV/c)^-1; about which it is linearised.
    mass : float
        GeV.
    pulls : bool
        Whether the mean of the pulls is worked out, which takes ten times as long.
    matter : callable
        Makes the slabs that the track meets from detector, tan(lambda) and the error of the momentum.
    """
    helix = np.asarray(helix, np.float64)
    hits = [replace(hit, about=float(helix[1]) + np.pi / 2) for hit in hits]  # its direction at the origin
    track = _Track(detector, hits, helix, mass, matter)
    found = _linear(track)
    sigma, axes = np.sqrt(np.diag(found.cov)), np.linalg.cholesky(found.cov)
    by_estimate = _curved(track, found, axes, np.zeros((len(found.noise), 5)))
    linear_bias = found.gain @ (found.by_kicks - by_estimate) / sigma
    bias = _bias_with_kinks(track, found, by_estimate)
    bias = np.append(bias, _bias_of_p(track.helix, found.cov, bias * sigma))
    pull = bias - _pull_of_errors(track, found) if pulls else np.full(6, np.nan)
    return Optimum(found.cov, bias, linear_bias, pull)


def unseen(detector: cg.Detector, hits: Sequence[Hit], helix: npt.ArrayLike, mass: float) -> Floats:
    """Return how much the optimal estimate of kappa changes by a loss in each slab, over the change of kappa there.

    Parameters
    ----------
    detector, hits, helix, mass
        As of `optimum`.
    """
    helix = np.asarray(helix, np.float64)
    hits = [replace(hit, about=float(helix[1]) + np.pi / 2) for hit in hits]
    track = _Track(detector, hits, helix, mass, stack_of)
    found = _linear(track)
    p = float(np.hypot(1, helix[4]) / abs(helix[2]))
    shares = np.zeros(len(track.stack()))
    for (slab, which, sigma), change in zip(found.noise, (found.gain @ found.by_noise)[2], strict=True):
        if which == 2:  # energy that is lost
            shares[slab] = change / (helix[2] * sigma * np.hypot(p, mass) / p**2)
    return shares


def _bias_of_p(helix: Floats, cov: Floats, bias: Floats) -> float:
    """Return the mean error of p in its standard deviations, to second order, from that of the helix."""
    _, _, kappa, _, tanl = helix
    p, stretch2 = np.hypot(1, tanl) / abs(kappa), 1 + tanl**2
    by_kappa2, by_tanl2, mixed = 2 * p / kappa**2, p / stretch2**2, -p * tanl / (kappa * stretch2)
    curved = by_kappa2 * cov[2, 2] / 2 + by_tanl2 * cov[4, 4] / 2 + mixed * cov[2, 4]
    return float((_by_helix(helix) @ bias + curved) / errors(helix, cov)["p"])


def _bias_with_kinks(track: _Track, found: _Linear, by_estimate: Floats) -> Floats:
    """Return the bias of the estimate about the angles and losses that the hits show, in standard deviations.

    Second derivatives by angles and losses count as far as these stay unknown; and first derivatives change with what
    is found of them, which goes with the residuals of the hits.
    """
    sigma, n = np.sqrt(np.diag(found.cov)), len(track.hits)
    variance = found.by_noise @ found.by_noise.T + np.diag([hit.sigma**2 for hit in track.hits])
    weighted = np.linalg.solve(variance, found.by_noise)
    residual = variance - found.by_helix @ found.cov @ found.by_helix.T  # covariance of hits about the linear estimate
    unknown = np.eye(len(found.noise)) - weighted.T @ residual @ weighted
    by_unknown = _curved(track, found, np.zeros((5, len(unknown))), np.linalg.cholesky(unknown))
    # Mixed derivatives of every hit: by each parameter's error, and by what is found of the noise when that hit lies
    # beside the track by its weighted residual.
    with_residual = np.linalg.solve(variance, residual @ weighted).T  # (noise, hits)
    size = np.linalg.norm(with_residual, axis=0)
    helix_steps = np.repeat(found.cov / sigma, n, axis=1)
    noise_errors = np.repeat(-(found.gain @ found.by_noise).T / sigma, n, axis=1)
    changes = np.zeros(5)
    for sign in (1, -1):
        noise_steps = noise_errors + sign * np.tile(with_residual / size, 5)
        moved = _seen(track, found, _PART * helix_steps, _PART * noise_steps)
        sums = (moved[:, 0::2] + moved[:, 1::2]).reshape(n, 5, n)[np.arange(n), :, np.arange(n)]
        changes += sign * (sums * size[:, None]).sum(axis=0) / (4 * _PART**2)
    return np.asarray(found.gain @ (by_unknown - by_estimate) / sigma + changes)


def _pull_of_errors(track: _Track, found: _Linear) -> Floats:
    """Return covariance of the estimate and the logarithm of its error, in standard deviations of the estimate."""
    axes = np.linalg.cholesky(found.cov)
    near = [_linear(replace(track, helix=helix)) for helix in _pairs(track.helix, _PART * axes).T]
    helices = _pairs(track.helix, _PART * axes).T
    sigmas = [_sigmas(helix, one.cov) for helix, one in zip(helices, near, strict=True)]
    slope = (np.log(sigmas[0::2]) - np.log(sigmas[1::2])).T / (2 * _PART)  # along each principal axis
    changes = np.vstack([axes, _by_helix(track.helix) @ axes])
    return np.asarray((slope * changes).sum(axis=1) / _sigmas(track.helix, found.cov))


def _sigmas(helix: Floats, cov: Floats) -> Floats:
    """Return the standard deviations of `QUANTITIES`."""
    return np.append(np.sqrt(np.diag(cov)), errors(helix, cov)["p"])


def _seen(track: _Track, found: _Linear, by_helix: Floats, by_noise: Floats) -> Floats:
    """Return what is seen after steps of helix and noise (columns), added and subtracted in turn."""
    kicks = {i: np.zeros((5, 2 * by_helix.shape[1])) for i, _, _ in found.noise}
    for (slab, which, spread), row in zip(found.noise, by_noise, strict=True):
        kicks[slab][which] = spread * np.stack([row, -row], axis=1).ravel()
    return follow(track.detector, track.hits, _pairs(track.helix, by_helix), track.mass, kicks, track.stack())


def _curved(track: _Track, found: _Linear, by_helix: Floats, by_noise: Floats) -> Floats:
    """Return half the second derivatives of what is seen, summed over steps."""
    moved = _seen(track, found, _PART * by_helix, _PART * by_noise)
    return np.asarray(((moved[:, 0::2] + moved[:, 1::2]) / 2 - found.centre).sum(axis=1) / _PART**2)


def _linear(track: _Track) -> _Linear:
    detector, hits, helix, mass, stack = track.detector, track.hits, track.helix, track.mass, track.stack()
    centre = follow(detector, hits, helix[:, None], mass, {}, stack)  # fills in the noise
    noise = [(i, k, s.sigma[k]) for i, s in enumerate(stack) for k in range(5) if s.sigma[k] > 0]
    n = 5 + len(noise)
    steps = _STEP * [1, 1, abs(helix[2]), 1, 1]
    kicks = {i: np.zeros((5, 2 * n)) for i, _, _ in noise}
    for j, (slab, which, sigma) in enumerate(noise, start=5):
        kicks[slab][which, [2 * j, 2 * j + 1]] = _PART * sigma, -_PART * sigma
    tracks = _pairs(helix, np.concatenate([np.diag(steps), np.zeros((5, len(noise)))], axis=1))
    seen = follow(detector, hits, tracks, mass, kicks, stack)
    change = (seen[:, 0::2] - seen[:, 1::2]) / 2
    by_helix, by_noise = change[:, :5] / steps, change[:, 5:] / _PART
    variance = by_noise @ by_noise.T + np.diag([hit.sigma**2 for hit in hits])
    weighted = np.linalg.solve(variance, by_helix)
    cov = np.linalg.inv(by_helix.T @ weighted)
    by_kicks = ((seen[:, 10::2] + seen[:, 11::2] - 2 * centre) / 2).sum(axis=1) / _PART**2
    return _Linear(cov, cov @ weighted.T, by_helix, by_noise, noise, by_kicks, centre)


def _pairs(helix: Floats, steps: Floats) -> Floats:
    """Return the helix with each step (columns) added and subtracted in turn, (5, 2 n)."""
    return np.asarray(helix[:, None] + np.stack([steps, -steps], axis=2).reshape(5, -1), np.float64)


def errors(helix: npt.ArrayLike, cov: Floats) -> dict[str, float]:
    """Return standard deviations of dr, dz (mm) and p (GeV/c) from helix and covariance."""
    by = _by_helix(np.asarray(helix, np.float64))
    sigma = dict(zip(PARAMETERS, np.sqrt(np.diag(cov)), strict=True))
    return {"dr": float(sigma["dr"]), "dz": float(sigma["dz"]), "p": float(np.sqrt(by @ cov @ by))}


def _by_helix(helix: Floats) -> Floats:
    """Return the derivatives of p by the helix parameters."""
    _, _, kappa, _, tanl = helix
    p = np.hypot(1, tanl) / abs(kappa)
    return np.array([0, 0, -p / kappa, 0, p * tanl / (1 + tanl**2)])
