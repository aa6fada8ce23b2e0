"""Chains of decays: from the first particles of events to those that a detector sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.samples.catalogue import RESONANCES, Mode
from cgemit.samples.phase_space import boost, breakup_momentum, largest_weight, phase_space
from cgemit.species import species

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

#: Speed of light, mm/ns.
LIGHT = 299.792458
#: Attempts at one decay before it is an error; five bodies of the catalogue take 6 on average.
ATTEMPTS = 500

# What random numbers are for; part of every stream, so new ones go to the end. A gun's have the places 0 to 9.
MODE, FLIGHT, SHAPE, SHOT = 16, 17, 18, 32
_NODE = 256  # places of one node of the chain; a stream has 2^26 places and 4096 blocks
_MOST_PRODUCTS = 6


@dataclass(frozen=True)
class Particles:
    """Particles of one name, at one place of the chain of each event.

    Attributes
    ----------
    event : ndarray, (n,) int64
    node : int
        Their place in the chain: part of the random streams.
    mass : ndarray, (n,) float64, GeV/c2
    momentum : ndarray, (n, 4) float64, GeV/c
        px, py, pz, E.
    vertex : ndarray, (n, 3) float64, mm
    """

    event: Rows
    node: int
    mass: Floats
    momentum: Floats
    vertex: Floats

    def take(self, rows: npt.NDArray[np.intp]) -> Particles:
        """Return some of the particles."""
        return Particles(self.event[rows], self.node, self.mass[rows], self.momentum[rows], self.vertex[rows])


class Draws:
    """Random numbers of a source: functions of seed, event, source and place in the chain."""

    def __init__(self, seed: int, number: int) -> None:
        self._seed, self._number = seed, number

    def uniforms(self, of: Particles, place: int, n: int, attempt: int = 0) -> Floats:
        """Return n numbers in (0, 1) for each particle, (particles, n) float64."""
        particle = np.full(len(of.event), self._number, np.int32)
        place += _NODE * of.node
        blocks = -(-n // 4)
        words = [
            _core.uniforms(self._seed, of.event, particle, _core.Purpose.gun, place, blocks * attempt + block)
            for block in range(blocks)
        ]
        return np.concatenate(words, axis=1)[:, :n]


def mass_of(name: str) -> float:
    """Return the mass of a particle or the nominal one of a resonance, GeV/c2."""
    return RESONANCES[name][0] if name in RESONANCES else species(name).mass


def decay_all(
    first: Sequence[tuple[str, Particles]], modes: Mapping[str, tuple[Mode, ...]], draws: Draws
) -> dict[str, list[Particles]]:
    """Let particles decay until no mode is left; those that live long enough fly before.

    Parameters
    ----------
    first : sequence of (str, Particles)
        By name; several may have the same one.
    modes : mapping of str to tuple of Mode
    draws : Draws

    Returns
    -------
    dict of str to list of Particles
        Those that do not decay, by name.
    """
    waiting, last = list(first), dict[str, list[Particles]]()
    while waiting:
        name, particles = waiting.pop()
        if name in modes:
            waiting += _decay(name, particles, modes[name], draws)
        else:
            last.setdefault(name, []).append(particles)
    return last


def _decay(name: str, parents: Particles, modes: tuple[Mode, ...], draws: Draws) -> list[tuple[str, Particles]]:
    """Return the products of particles, by name."""
    shares = np.cumsum([mode.fraction for mode in modes])
    mode_of = np.searchsorted(shares / shares[-1], draws.uniforms(parents, MODE, 1)[:, 0])
    vertex = parents.vertex + _flight(name, parents, draws)
    found = []
    for number, mode in enumerate(modes):
        rows = np.flatnonzero(mode_of == number)
        mine = parents.take(rows)
        momenta, masses = _momenta(name, mine, mode, draws)
        momenta = boost(momenta, mine.momentum[:, None, :])
        for k, product in enumerate(mode.products):
            node = mine.node * _MOST_PRODUCTS + k + 1
            found.append((product, Particles(mine.event, node, masses[:, k], momenta[:, k], vertex[rows])))
    return found


def _flight(name: str, particles: Particles, draws: Draws) -> Floats:
    """Return how far particles fly before they decay, (n, 3) mm: c tau p/m times an exponential number."""
    if name in RESONANCES:
        return np.zeros((len(particles.event), 3))
    kind = species(name)
    lifetimes = -np.log(draws.uniforms(particles, FLIGHT, 1))
    return np.asarray(LIGHT * kind.lifetime / kind.mass * lifetimes * particles.momentum[:, :3])


def _momenta(name: str, parents: Particles, mode: Mode, draws: Draws) -> tuple[Floats, Floats]:
    """Return momenta of the products in the rest frames of their parents, (parents, products, 4) GeV/c, and masses.

    Accepted in proportion to phase space, to the line shape of resonances among the products, and to the angle of the
    mode. Attempts of one parent do not depend on the others.
    """
    n, mass = len(mode.products), parents.mass
    least = tuple(_least_mass(one) for one in mode.products)
    different, which = np.unique(mass, return_inverse=True)
    bound = np.array([_bound(one, least) for one in different.tolist()])[which] * (1 + max(mode.alpha, 0.0))
    momenta, drawn, waiting = np.zeros((len(mass), n, 4)), np.zeros((len(mass), n)), np.arange(len(mass))
    for attempt in range(ATTEMPTS):
        if not len(waiting):
            return momenta, drawn
        tried = parents.take(waiting)
        u = draws.uniforms(tried, SHAPE, 1 + n + 3 * n - 4, attempt)
        masses = np.stack([_masses(one, u[:, 1 + k]) for k, one in enumerate(mode.products)], axis=1)
        allowed = masses.sum(axis=1) < mass[waiting]
        masses = np.where(allowed[:, None], masses, least)
        found, weight = phase_space(mass[waiting], masses, u[:, 1 + n :])
        last = found[:, -1]
        weight *= 1 + mode.alpha * last[:, 2] ** 2 / np.maximum(np.sum(last[:, :3] ** 2, axis=1), 1e-300)
        good = allowed & (u[:, 0] * bound[waiting] < weight)
        momenta[waiting[good]], drawn[waiting[good]] = found[good], masses[good]
        waiting = waiting[~good]
    raise RuntimeError(f"{name} -> {' '.join(mode.products)}: no momenta after {ATTEMPTS} attempts")


def _bound(mass: float, least: tuple[float, ...]) -> float:
    """Return the largest weight; of two products it is their momentum, which many parents have each for itself."""
    return float(breakup_momentum(mass, *least)) if len(least) == 2 else largest_weight(mass, least)


def _least_mass(name: str) -> float:
    """Return the smallest mass of a product: two pions for a rho."""
    broad = name in RESONANCES and RESONANCES[name][1] > 0
    return 2 * species("pi+").mass if broad else mass_of(name)


def _masses(name: str, uniform: Floats) -> Floats:
    """Return masses of a product: fixed, or of a Breit-Wigner line in the mass squared above the threshold."""
    if name not in RESONANCES or RESONANCES[name][1] == 0:
        return np.full(len(uniform), mass_of(name))
    mass, width = RESONANCES[name]
    low = np.arctan((_least_mass(name) ** 2 - mass**2) / (mass * width))
    return np.asarray(np.sqrt(mass**2 + mass * width * np.tan(low + uniform * (0.5 * np.pi - low))))
