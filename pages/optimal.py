"""Tracks through detector and matter in plain numpy, without the compiled core: measurements, and noise of matter.

Formulas of loss and scattering are written anew from their papers: this is what the fit's covariance is compared with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import cgemit as cg
from cgemit.detector import Slab, slabs
from cgemit.detector.parts import CgemLayer, WireLayer

Floats = npt.NDArray[np.float64]

LIGHT = 0.299792458e-3  # GeV/c per (T mm)
ELECTRON = 0.51099895e-3  # GeV
FINE_STRUCTURE = 1 / 137.035999084
BETHE = 0.307075e-3  # GeV cm2/mol
X, V, WIRE = 0, 1, 2
_THICK = 5e-3  # mm, sideways shifts at 1 GeV/c below this are neither simulated nor fitted


@dataclass(frozen=True)
class Hit:
    """A measurement: kind (X, V, WIRE), layer as in the tables, sheet or wire, and its error, mm."""

    kind: int
    layer: int
    channel: int
    sigma: float


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
    """X or V where the track is in the middle of a drift gap; unrolled about the first track."""
    azimuth = np.arctan2(flight.at[1], flight.at[0])
    first = (azimuth[0] - layer.sheet_phi[hit.channel]) % (2 * np.pi)
    x = layer.r_readout * (first + np.remainder(azimuth - azimuth[0] + np.pi, 2 * np.pi) - np.pi)
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

    On the track all matter has the sum xi, and the slab's group (gas of the drift chamber, or the rest) chi_c^2.
    """

    def __init__(self, slab: Slab, whole_xi: float, group_chi_c2: float, cut: tuple[float, float]) -> None:
        self.slab, self.radius, self.gap, self.spread = slab, slab.radius, slab.gap, slab.spread
        self.half_length = max(shell.half_length for shell in slab.shells)
        self.whole_xi, self.group_chi_c2, self.cut = whole_xi, group_chi_c2, cut
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
        multiple, share = self.cut
        cut = np.minimum(multiple * self.whole_xi / beta2 + share * p * np.sqrt(beta2), w_max)
        bracket = np.log(2 * ELECTRON * (p / mass) ** 2 * cut) - beta2 * (1 + cut / w_max)
        bracket = bracket + self.slab.log_term(np.log(p / mass))
        return xi * bracket, np.sqrt(xi * cut * (1 - beta2 * cut / w_max / 2))

    def angle(self, p: float, after: float, mass: float, path: float) -> float:
        """Plane angle: Lynch and Dahl, Nucl. Instrum. Methods B 58 (1991) 6, F = 0.98, one logarithm for the group."""
        beta2, beta2_after = (q * q / (q * q + mass * mass) for q in (p, after))
        end = self.group_chi_c2 / beta2 / (2 * (1 - 0.98))
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


def stack_of(detector: cg.Detector, tanl: float, cut: tuple[float, float]) -> list[TracedSlab]:
    """The slabs of a detector, with the sums along a straight line from the origin.

    `cut`: collisions count below this multiple of xi plus this share of p beta.
    """
    found, crossed = slabs(detector), []
    for slab in found:
        if abs(tanl) * slab.radius <= max(shell.half_length for shell in slab.shells):
            crossed.append(slab)
        elif slab.ends:
            break
    stretch = float(np.hypot(1, tanl))
    xi = stretch * sum(slab.xi for slab in crossed)
    chi_c2 = {
        gas: stretch * sum(row[1] for slab in crossed if slab.ends == gas for row in _elements(slab))
        for gas in (False, True)
    }
    return [TracedSlab(slab, xi, chi_c2[slab.ends], cut) for slab in found]
