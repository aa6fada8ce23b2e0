"""Decay chains: from the first particles of an event to those that a detector sees."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Floats, Rows
from cgemit.particles.species import species
from cgemit.units import LIGHT


@dataclass(frozen=True)
class Mode:
    """One decay mode.

    Attributes
    ----------
    fraction : float
    products : tuple of str
    alpha : float
        Of 1 + alpha cos^2(theta), theta the polar angle of the last product in the rest frame of the parent.
    """

    fraction: float
    products: tuple[str, ...]
    alpha: float = 0.0


@dataclass(frozen=True)
class Definition:
    """A sample: one particle made at rest by the beams, or particles that are shot.

    Attributes
    ----------
    text : str
    first : tuple of str
        Particles that every event begins with.
    modes : mapping of str to tuple of Mode
        Of the particles that decay.
    multiplicity : int
        Most particles of an event.
    options : mapping of str to Any
        Options that the sample has, and their defaults.
    in_matter : bool
        Whether each particle starts in the matter of the detector.
    """

    text: str
    first: tuple[str, ...]
    modes: Mapping[str, tuple[Mode, ...]]
    multiplicity: int
    options: Mapping[str, Any] = field(default_factory=dict)
    in_matter: bool = False


#: Particles that do not fly: mass and width, GeV/c2.
RESONANCES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "J/psi": (3.0969, 0.0), "psi(2S)": (3.6861, 0.0), "psi(3770)": (3.7737, 0.0),
        "rho0": (0.77526, 0.1491), "rho+": (0.77526, 0.1491), "rho-": (0.77526, 0.1491),
    }
)  # fmt: skip

_VERTEX = {"vertex": (0.0, 0.0, 0.0), "vertex_sigma": (0.0, 0.0, 0.0)}
#: Beams that cross at an angle of 22 mrad (BEPCII, hep-ex/0701010).
_BEAMS = {**_VERTEX, "crossing": 0.022}


def _shot(p: tuple[float, float], cos_theta: float = 0.9) -> dict[str, Any]:
    return {"p": p, "cos_theta": (-cos_theta, cos_theta), "phi": (-math.pi, math.pi), **_VERTEX}


_RHO = {
    "rho0": (Mode(1, ("pi+", "pi-")),),
    "rho+": (Mode(1, ("pi+", "pi0")),),
    "rho-": (Mode(1, ("pi-", "pi0")),),
}
_KAONS = (Mode(0.692, ("pi+", "pi-")), Mode(0.3069, ("pi0", "pi0")))
# Ten large modes of the D0 with 56 % of its decays, resonances included in their products.
_D0 = {
    ("K-", "pi+"): 0.03945, ("K-", "pi+", "pi0"): 0.144, ("K-", "pi+", "pi+", "pi-"): 0.0822,
    ("K-", "pi+", "pi+", "pi-", "pi0"): 0.043, ("K-", "e+", "nu_e"): 0.03549, ("K-", "mu+", "nu_mu"): 0.0341,
    ("K0_S", "pi+", "pi-"): 0.028, ("K0_S", "pi+", "pi-", "pi0"): 0.052, ("K0_S", "pi0"): 0.0124,
    ("K-", "pi+", "pi0", "pi0"): 0.0886,
}  # fmt: skip
_BAR = {
    "K-": "K+", "pi+": "pi-", "pi-": "pi+", "e+": "e-", "nu_e": "anti-nu_e", "mu+": "mu-", "nu_mu": "anti-nu_mu",
}  # fmt: skip
_CHARM = {
    "D0": tuple(Mode(share, products) for products, share in _D0.items()),
    "anti-D0": tuple(Mode(share, tuple(_BAR.get(one, one) for one in products)) for products, share in _D0.items()),
    "K0_S": _KAONS,
}

DEFINITIONS: Mapping[str, Definition] = MappingProxyType(
    {
        "jpsi-rhopi": Definition(
            "J/psi -> rho pi -> pi+ pi- pi0, all charges of the rho, without interference",
            ("J/psi",),
            {"J/psi": tuple(Mode(1, (f"rho{a}", f"pi{b}"), 1.0) for a, b in ("00", "+-", "-+")), **_RHO},
            3,
            _BEAMS,
        ),
        "pipi-jpsi": Definition(
            "psi(2S) -> pi+ pi- J/psi, J/psi -> mu+ mu-",
            ("psi(2S)",),
            {"psi(2S)": (Mode(1, ("pi+", "pi-", "J/psi")),), "J/psi": (Mode(1, ("mu+", "mu-"), 1.0),)},
            4,
            _BEAMS,
        ),
        "d0-d0bar": Definition(
            "psi(3770) -> D0 anti-D0, each to one of its ten largest modes: 0 to 8 charged particles",
            ("psi(3770)",),
            {"psi(3770)": (Mode(1, ("D0", "anti-D0"), -1.0),), **_CHARM},
            10,
            _BEAMS,
        ),
        "ks-pipi": Definition(
            "K0_S -> pi+ pi- with flight", ("K0_S",), {"K0_S": (Mode(1, ("pi+", "pi-")),)}, 2, _shot((0.2, 1.2))
        ),
        "lambda-ppi": Definition(
            "Lambda -> p pi- with flight", ("Lambda",), {"Lambda": (Mode(1, ("p", "pi-")),)}, 2, _shot((0.3, 1.2))
        ),
        "slow-pions": Definition(
            "pi+ and pi- of 0.05 to 0.2 GeV/c, each in a direction of its own", ("pi+", "pi-"), {}, 2,
            _shot((0.05, 0.2)),
        ),
        "cosmic": Definition(
            "muons from above through the beam line, as two halves that leave the point nearest to it",
            ("mu-",), {}, 2, {"p": (1.0, 5.0), "vertex": (0.0, 0.0, 0.0), "vertex_sigma": (8.0, 8.0, 100.0)},
        ),
        "beam-gas": Definition(
            "p and pi- from one point on the beam line, of a nucleus of the rest gas", ("p", "pi-"), {}, 2,
            _shot((0.05, 1.0), 0.95) | {"vertex": (0.0, 0.0, (-300.0, 300.0))},
        ),
        "touschek": Definition(
            "an electron from the beam pipe, up to 30 mm from the beam line", ("e-",), {}, 1,
            _shot((0.05, 1.0), 0.95) | {"vertex": (0.0, 0.0, (-300.0, 300.0)), "radius": (0.0, 30.0)},
        ),
        "electrons": Definition(
            "20 electrons of 1 to 30 MeV/c from pipe, gas and walls, each from its own point", ("e-",) * 20, {}, 20,
            _shot((0.001, 0.03), 0.99), in_matter=True,
        ),
    }
)  # fmt: skip

#: Names of the samples.
NAMES = tuple(DEFINITIONS)


def breakup_momentum(mass: npt.ArrayLike, first: npt.ArrayLike, second: npt.ArrayLike) -> Floats:
    """Momentum of the products of a two-body decay in the rest frame.

    p* = sqrt((M^2 - (m1 + m2)^2)(M^2 - (m1 - m2)^2)) / 2M.

    Parameters
    ----------
    mass, first, second : array_like, float64, GeV/c2

    Returns
    -------
    ndarray, GeV/c
        0 where the decay is not possible.
    """
    m, a, b = (np.asarray(one, np.float64) for one in (mass, first, second))
    both = (m - a - b) * (m + a + b) * (m - a + b) * (m + a - b)
    return np.asarray(np.sqrt(np.maximum(np.where(m >= a + b, both, 0.0), 0.0)) / (2 * m))


@lru_cache(maxsize=1000)
def largest_weight(mass: float, masses: tuple[float, ...]) -> float:
    """Largest weight of `phase_space`, found by changing one group mass after the other.

    The logarithm of the weight is concave in each group mass, so that there is one maximum.

    Parameters
    ----------
    mass : float, GeV/c2
    masses : tuple of float, GeV/c2
        Of the products, two or more; their sum is below `mass`.
    """
    m = np.array(masses)
    group, free = np.cumsum(m), mass - m.sum()
    least = group.copy()
    group += free * np.arange(len(m)) / (len(m) - 1)
    before, weight = 0.0, _weight(group, m)
    while weight > before * (1 + 1e-9):
        before = weight
        for i in range(1, len(m) - 1):
            low, high = group[i - 1] + m[i], group[i + 1] - m[i + 1]
            tried = np.repeat(group[:, None], _GRID, axis=1)
            for _ in range(4):  # each time the range becomes a tenth
                tried[i] = np.linspace(max(low, least[i]), high, _GRID)
                best = int(np.argmax(_weight(tried, m)))
                low, high = tried[i, max(best - 1, 0)], tried[i, min(best + 1, _GRID - 1)]
            group[i] = tried[i, best]
        weight = _weight(group, m)
    return float(weight) * (1 + 1e-6)


_GRID = 21


def _weight(group: Floats, masses: Floats) -> Any:
    """Return the product of the momenta of two-body decays with some group masses, (n,) or (n, tries)."""
    weight: Any = 1.0
    for i in range(1, len(masses)):
        weight = weight * breakup_momentum(group[i], group[i - 1], masses[i])
    return weight


def phase_space(mass: npt.ArrayLike, masses: npt.ArrayLike, uniforms: Floats) -> tuple[Floats, Floats]:
    """Momenta of the products in the rest frame of the parent, with a weight that makes them phase space.

    The masses of the groups of the first 2, 3 ... n - 1 products are drawn uniformly in the order of their size, and
    each group decays isotropically. The weight is the product of the n - 1 momenta of these two-body decays.

    Parameters
    ----------
    mass : array_like, (rows,) or () float64, GeV/c2
        Of the parent, at least the sum of the products' masses.
    masses : array_like, (rows, n) or (n,) float64, GeV/c2
        Of n >= 2 products.
    uniforms : ndarray, (rows, 3 n - 4) float64
        In (0, 1): n - 2 masses, then cosine and azimuth of each two-body decay. The last pair is the direction of
        the last product, in the rest frame of the parent.

    Returns
    -------
    momenta : ndarray, (rows, n, 4) float64, GeV/c
        px, py, pz, E of each product.
    weight : ndarray, (rows,) float64, (GeV/c)^(n - 1)
    """
    rows = len(uniforms)
    m = np.broadcast_to(np.asarray(masses, np.float64), (rows, np.shape(masses)[-1]))
    n = m.shape[1]
    free = np.broadcast_to(np.asarray(mass, np.float64), rows) - m.sum(axis=1)
    shares = np.sort(uniforms[:, : n - 2], axis=1)
    group = np.cumsum(m, axis=1)  # smallest mass of the first 1, 2 ... n products
    group[:, 1:-1] += shares * free[:, None]
    group[:, -1] += free
    momenta, weight = np.zeros((rows, n, 4)), np.ones(rows)
    momenta[:, 0, 3] = m[:, 0]
    for i in range(1, n):
        p = breakup_momentum(group[:, i], group[:, i - 1], m[:, i])
        weight = weight * p
        cos, turn = uniforms[:, n - 2 + 2 * (i - 1) : n + 2 * (i - 1)].T
        flight = p[:, None] * directions(2 * cos - 1, 2 * np.pi * turn)
        recoil = np.concatenate([-flight, np.hypot(group[:, i - 1], p)[:, None]], axis=1)
        momenta[:, :i] = boost(momenta[:, :i], recoil[:, None, :])
        momenta[:, i] = np.concatenate([flight, np.hypot(m[:, i], p)[:, None]], axis=1)
    return momenta, weight


def directions(cos_theta: Floats, phi: Floats) -> Floats:
    """Return unit vectors, (n, 3), from the cosine of the polar angle and the azimuth (rad), (n,) each."""
    sin = np.sqrt(np.maximum((1 - cos_theta) * (1 + cos_theta), 0.0))
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), cos_theta], axis=-1)


def boost(momenta: Floats, parent: Floats) -> Floats:
    """Return four-momenta of the parent's rest frame in the frame where the parent has a four-momentum.

    Parameters
    ----------
    momenta, parent : ndarray, (..., 4) float64, GeV/c
        px, py, pz, E; shapes that broadcast.
    """
    p, energy = parent[..., :3], parent[..., 3]
    mass = np.sqrt(np.maximum(energy**2 - np.sum(p * p, axis=-1), 1e-300))
    along = np.sum(p * momenta[..., :3], axis=-1)
    factor = (along / (energy + mass) + momenta[..., 3]) / mass
    moved = momenta[..., :3] + factor[..., None] * p
    return np.concatenate([moved, ((energy * momenta[..., 3] + along) / mass)[..., None]], axis=-1)


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
            _core.common.uniforms(
                self._seed, of.event, particle, _core.common.Purpose.gun, place, blocks * attempt + block
            )
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
    products = []
    for number, mode in enumerate(modes):
        rows = np.flatnonzero(mode_of == number)
        decaying = parents.take(rows)
        momenta, masses = _momenta(name, decaying, mode, draws)
        momenta = boost(momenta, decaying.momentum[:, None, :])
        for k, product in enumerate(mode.products):
            node = decaying.node * _MOST_PRODUCTS + k + 1
            products.append((product, Particles(decaying.event, node, masses[:, k], momenta[:, k], vertex[rows])))
    return products


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
        trial, weight = phase_space(mass[waiting], masses, u[:, 1 + n :])
        last = trial[:, -1]
        weight *= 1 + mode.alpha * last[:, 2] ** 2 / np.maximum(np.sum(last[:, :3] ** 2, axis=1), 1e-300)
        good = allowed & (u[:, 0] * bound[waiting] < weight)
        momenta[waiting[good]], drawn[waiting[good]] = trial[good], masses[good]
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
