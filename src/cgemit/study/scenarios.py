"""Tracks that are hard to fit: few hits, wrong hits, slow, curling, steep and displaced ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgemit.candidates import HIT_V
from cgemit.detector import Detector
from cgemit.gun import Gun, Guns, Source, generate
from cgemit.particles import particles_from
from cgemit.species import species
from cgemit.study.hits import Hits, add_noise, exchange_clusters, keep, lose_layers
from cgemit.tables import Table

Spoil = Callable[[Detector, Hits, np.random.Generator], Hits]


@dataclass(frozen=True)
class Scenario:
    """One kind of difficult track.

    Attributes
    ----------
    name : str
    text : str
        What is difficult, for the reader of a table.
    source : Gun, Guns or callable
        Particles, or a function of (number of events, seed) that returns their table.
    spoil : callable or None
        Function of (detector, hits, numpy random generator) that returns the hits as the fit gets them; None: as they
        are.
    """

    name: str
    text: str
    source: Source | Guns | Callable[[int, int], Table]
    spoil: Spoil | None = None

    def particles(self, n_events: int, seed: int) -> Table:
        """Return the particles of some events.

        Parameters
        ----------
        n_events : int
        seed : int
        """
        return (
            generate(self.source, n_events, seed)
            if isinstance(self.source, Source | Guns)
            else self.source(n_events, seed)
        )


def both_charges(name: str, **what: Any) -> Guns:
    """Return guns that shoot a particle and its antiparticle together.

    Parameters
    ----------
    name : str
        Particle.
    what : Any
        As of `Gun`.
    """
    return Gun(name, **what) + Gun(-species(name).pdg, **what)


# PDG, Phys. Rev. D 110, 030001 (2024): mass in GeV/c2, c tau in mm.
_KAON_MASS, _KAON_CTAU = 0.497611, 26.844


def kaon_decays(n_events: int, seed: int) -> Table:
    """Return the pions of K_S mesons from the origin that decay at radii up to 100 mm.

    Momenta are uniform from 0.2 to 1.2 GeV/c, cos(theta) within 0.8, decay lengths exponential; the pions fly apart
    isotropically in the rest frame.

    Parameters
    ----------
    n_events, seed : int
    """
    random = np.random.default_rng(seed)
    p = random.uniform(0.2, 1.2, n_events)
    direction = _directions(random, n_events, 0.8)
    sin = np.hypot(direction[:, 0], direction[:, 1])
    mean = p / _KAON_MASS * _KAON_CTAU
    farthest = -np.expm1(-100.0 / sin / mean)  # share of the mesons that decay within 100 mm
    length = -mean * np.log1p(-farthest * random.random(n_events))
    vertex = length[:, None] * direction
    mass = species("pi+").mass
    rest = np.sqrt(0.25 * _KAON_MASS**2 - mass**2)
    star = rest * _directions(random, n_events, 1.0)
    gamma, boost = np.hypot(p, _KAON_MASS) / _KAON_MASS, p / _KAON_MASS
    along = np.sum(star * direction, axis=1)
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("x", "y", "z", "px", "py", "pz")}
    for sign in (1, -1):
        shift = (gamma - 1) * sign * along + boost * 0.5 * _KAON_MASS
        momentum = sign * star + shift[:, None] * direction
        for i, axis in enumerate("xyz"):
            columns[axis].append(vertex[:, i])
            columns["p" + axis].append(momentum[:, i])
    event = np.tile(np.arange(n_events), 2)
    pdg = np.repeat([211, -211], n_events)
    flat = {name: np.concatenate(parts) for name, parts in columns.items()}
    return particles_from({"event": event, "pdg": pdg, **flat}, n_events=n_events, first_event=0)


def _directions(random: np.random.Generator, n: int, most: float) -> np.ndarray:
    cos, phi = random.uniform(-most, most, n), random.uniform(-np.pi, np.pi, n)
    sin = np.sqrt(1 - cos**2)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], axis=1)


def only_layers(*layers: int) -> Spoil:
    """Return a function that keeps only the wires and the given CGEM layers."""
    return lambda detector, hits, random: keep(hits, hits.on_wire | np.isin(hits.layer, layers))


def _wires_only(detector: Detector, hits: Hits, random: np.random.Generator) -> Hits:
    return keep(hits, hits.on_wire)


def _clusters_only(detector: Detector, hits: Hits, random: np.random.Generator) -> Hits:
    return keep(hits, ~hits.on_wire)


def _lose(share: float) -> Spoil:
    return lambda detector, hits, random: lose_layers(hits, share, random)


def _noise(share: float) -> Spoil:
    return lambda detector, hits, random: add_noise(detector, hits, share, random)


def _wrong_cluster(detector: Detector, hits: Hits, random: np.random.Generator) -> Hits:
    layer = random.integers(0, max(len(detector.cgem), 1), len(hits.candidates))
    for number in range(len(detector.cgem)):
        hits = exchange_clusters(hits, number, layer == number)
    return hits


def _x_only(detector: Detector, hits: Hits, random: np.random.Generator) -> Hits:
    return keep(hits, hits.view != HIT_V)


_PLAIN = both_charges("mu-", p=(0.3, 1.5), cos_theta=(-0.8, 0.8))
_SLOW = {"cos_theta": (-0.8, 0.8)}

#: What `docs/methods/robustness.md` shows.
SCENARIOS = (
    Scenario("plain", "muons of 0.3 to 1.5 GeV/c, cos(theta) within 0.8, all hits", _PLAIN),
    Scenario(
        "wide",
        "muons of 0.3 to 1.5 GeV/c, cos(theta) within 0.93",
        both_charges("mu-", p=(0.3, 1.5), cos_theta=(-0.93, 0.93)),
    ),
    Scenario(
        "end plates",
        "the same, cos(theta) 0.83 to 0.93: out through an end plate",
        both_charges("mu-", p=(0.3, 1.5), cos_theta=(0.83, 0.93)),
    ),
    Scenario("layers missing", "each layer lost with probability 0.3", _PLAIN, _lose(0.3)),
    Scenario("one CGEM layer, inner", "wires and CGEM layer 0", _PLAIN, only_layers(0)),
    Scenario("one CGEM layer, outer", "wires and CGEM layer 2", _PLAIN, only_layers(2)),
    Scenario("two CGEM layers", "wires and CGEM layers 0 and 1", _PLAIN, only_layers(0, 1)),
    Scenario("drift chamber only", "no clusters", _PLAIN, _wires_only),
    Scenario("CGEM only", "no wires", _PLAIN, _clusters_only),
    Scenario("X only", "no V clusters", _PLAIN, _x_only),
    Scenario("noise", "noise beside 10 % of the hits", _PLAIN, _noise(0.1)),
    Scenario("much noise", "noise beside 30 % of the hits", _PLAIN, _noise(0.3)),
    Scenario("wrong cluster", "one CGEM layer has another track's X and V", _PLAIN, _wrong_cluster),
    Scenario("noise and missing layers", "both", _PLAIN, lambda d, h, r: lose_layers(add_noise(d, h, 0.1, r), 0.2, r)),
    Scenario(
        "loopers",
        "muons that turn back in the drift chamber, pT 0.06 to 0.12 GeV/c, outward arc",
        both_charges("mu-", pt=(0.06, 0.12), **_SLOW),
    ),
    Scenario("loopers with noise", "the same with noise", both_charges("mu-", pt=(0.06, 0.12), **_SLOW), _noise(0.1)),
    Scenario("slow muons", "pT 0.05 to 0.06 GeV/c", both_charges("mu-", pt=(0.05, 0.06), **_SLOW)),
    Scenario("slow pions 50", "pT 0.050 to 0.065 GeV/c", both_charges("pi+", pt=(0.05, 0.065), **_SLOW)),
    Scenario("slow pions 65", "pT 0.065 to 0.1 GeV/c", both_charges("pi+", pt=(0.065, 0.1), **_SLOW)),
    Scenario("muons 0.1 GeV/c", "p = 0.1 GeV/c", both_charges("mu-", p=0.1, **_SLOW)),
    Scenario("K_S pions", "decays at radii up to 100 mm", kaon_decays),
    Scenario("electrons", "pT 0.05 to 1 GeV/c", both_charges("e-", pt=(0.05, 1.0), **_SLOW)),
    Scenario("pions", "pT 0.1 to 1 GeV/c", both_charges("pi+", pt=(0.1, 1.0), **_SLOW)),
    Scenario("kaons", "p 0.25 to 1 GeV/c", both_charges("K+", p=(0.25, 1.0), **_SLOW)),
    Scenario("protons", "p 0.35 to 1 GeV/c", both_charges("p", p=(0.35, 1.0), **_SLOW)),
    Scenario("10 GeV/c", "muons of 10 GeV/c", both_charges("mu-", p=10.0, **_SLOW)),
)
