"""Particle species by their many spellings, and their decays."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np

from cgemit import _core
from cgemit.base.errors import WrongValueError, did_you_mean


@dataclass(frozen=True)
class Species:
    """A kind of particle.

    Attributes
    ----------
    name : str
    pdg : int
        Number of the Particle Data Group.
    charge : int, e
    mass : float, GeV/c2
    spin : float, hbar
    lifetime : float, ns
        Mean proper lifetime; infinite for stable particles.
    """

    name: str
    pdg: int
    charge: int
    mass: float
    spin: float
    lifetime: float


def _species() -> dict[int, Species]:
    """Read ``particles.csv``, which ``tools/make_particles.py`` writes."""
    text = (resources.files("cgemit.particles") / "particles.csv").read_text(encoding="utf-8")
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    return {
        int(row["pdg"]): Species(
            row["name"], int(row["pdg"]), int(row["charge"]),
            float(row["mass_gev"]), float(row["spin"]), float(row["lifetime_ns"]),
        )
        for row in rows
    }  # fmt: skip


#: By number of the Particle Data Group.
KNOWN: Mapping[int, Species] = MappingProxyType(_species())
#: Stands for every particle that is not listed.
UNKNOWN = Species("", 0, 0, 0.0, 0.0, math.inf)

#: The particles that BES3 files hold fits for, in their order; charge aside.
Hypothesis = Literal["e", "mu", "pi", "K", "p"]
HYPOTHESES: Mapping[str, Species] = MappingProxyType(
    {name: KNOWN[pdg] for name, pdg in zip(get_args(Hypothesis), (11, 13, 211, 321, 2212), strict=True)}
)

# Spellings after _plain(): lower case, no blanks, underscores or inner hyphens.
_SPELLINGS = {
    11: "e- e electron elec eminus",
    -11: "e+ positron antielectron antie ebar eplus antie-",
    13: "mu- mu muon muminus μ- μ µ- µ",
    -13: "mu+ antimuon antimu mubar muplus antimu- μ+ µ+",
    211: "pi+ pion+ piplus pionplus π+",
    -211: "pi- pion- piminus pionminus antipi+ π-",
    321: "k+ kaon+ kplus kaonplus",
    -321: "k- kaon- kminus kaonminus antik+",
    2212: "p p+ proton pplus prot",
    -2212: "antip p- pbar p~ pminus antiproton antip+ antip- protonbar",
    22: "gamma photon γ",
    2112: "n n0 neutron",
    -2112: "antin nbar n~ antineutron antin0",
    130: "k0l kl klong kl0",
}
_BOTH_CHARGES = {"pi": "pi+ or pi-", "pion": "pi+ or pi-", "π": "pi+ or pi-", "k": "K+ or K-", "kaon": "K+ or K-"}


def _plain(name: str) -> str:
    word = name.strip().lower().replace("_", "").replace(" ", "")
    return word[:-1].replace("-", "") + word[-1:]


_BY_SPELLING = {_plain(one.name): one.pdg for one in KNOWN.values()}
_BY_SPELLING |= {word: pdg for pdg, words in _SPELLINGS.items() for word in words.split()}


def species(particle: str | int) -> Species:
    """Return the particle of a name or a PDG number: ``"mu-"``, ``"proton"``, ``"anti_proton"``, ``-211``, ``"13"``.

    Parameters
    ----------
    particle : str or int

    Raises
    ------
    WrongValueError
        If there is no such particle; says which name is close.
    """
    given = particle
    if isinstance(particle, str):
        word = _plain(particle)
        if word in _BOTH_CHARGES:
            raise WrongValueError(repr(given), f"a charge too: {_BOTH_CHARGES[word]}")
        number = particle.strip()
        particle = int(number) if number.removeprefix("-").isdecimal() else _BY_SPELLING.get(word, 0)
    known = isinstance(particle, int | np.integer) and not isinstance(particle, bool) and int(particle) in KNOWN
    if known:
        return KNOWN[int(particle)]
    names = ", ".join(f"{KNOWN[pdg].name} ({pdg})" for pdg in _SPELLINGS)
    names += f", or another of the {len(KNOWN)} in cgemit/particles/particles.csv"
    hint = did_you_mean(_plain(given), _BY_SPELLING) if isinstance(given, str) else ""
    raise WrongValueError(f"{given!r:.80}", f"one of {names}", hint)


Spectrum = Literal["phase_space", "semileptonic", "michel"]


@dataclass(frozen=True)
class DecayMode:
    """One decay mode of a particle.

    Attributes
    ----------
    fraction : float
        Share of all decays of the particle; the fractions of its modes add up to 1.
    spectrum : str
        Distribution of the momenta in the rest frame of the particle.
    products : tuple of Species
    """

    fraction: float
    spectrum: Spectrum
    products: tuple[Species, ...]

    @property
    def charged(self) -> tuple[Species, ...]:
        """The products that the simulation follows, in the order of their rows in the table of decays."""
        return tuple(one for one in self.products if one.charge)


def _modes() -> dict[int, tuple[DecayMode, ...]]:
    """Read ``decays.csv``; both charges of each particle."""
    text = (resources.files("cgemit.particles") / "decays.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    found: dict[int, tuple[DecayMode, ...]] = {}
    for pdg in dict.fromkeys(int(row["pdg"]) for row in rows):
        mine = [row for row in rows if int(row["pdg"]) == pdg]
        total = sum(float(row["fraction"]) for row in mine)
        for sign in (1, -1):
            found[sign * pdg] = tuple(
                DecayMode(float(row["fraction"]) / total, _spectrum(row["spectrum"]), _products(row["products"], sign))
                for row in mine
            )
    return found


def _spectrum(name: str) -> Spectrum:
    return next(one for one in get_args(Spectrum) if one == name)


def _products(numbers: str, sign: int) -> tuple[Species, ...]:
    pdg = [int(number) for number in numbers.split()]
    # A neutral pion is its own antiparticle.
    return tuple(KNOWN.get(sign * one, KNOWN[one]) for one in pdg)


#: Modes of each particle that decays in flight, by its number of the Particle Data Group. The column `mode` of the
#: table of decays counts them.
DECAYS: Mapping[int, tuple[DecayMode, ...]] = MappingProxyType(_modes())


def decay_table(decays: Mapping[int, tuple[DecayMode, ...]], lifetimes: Mapping[int, float]) -> _core.DecayTable:
    """Return decays for the compiled simulation.

    Parameters
    ----------
    decays : mapping of int to tuple of DecayMode
    lifetimes : mapping of int to float, ns
        Proper lifetime of each of these particles.

    Raises
    ------
    ValueError
        If a particle cannot decay into the products of a mode.
    """
    parents = list(decays)
    modes = [(i, mode) for i, pdg in enumerate(parents) for mode in decays[pdg]]
    products = [(i, one) for i, (_, mode) in enumerate(modes) for one in mode.products]
    return _core.DecayTable(
        species={
            "pdg": np.array(parents, np.int32),
            "mass": np.array([KNOWN[pdg].mass for pdg in parents]),
            "lifetime": np.array([lifetimes[pdg] for pdg in parents]),
        },
        modes={
            "species": np.array([i for i, _ in modes], np.int32),
            "fraction": np.array([mode.fraction for _, mode in modes]),
            "spectrum": np.array([getattr(_core.DecaySpectrum, mode.spectrum) for _, mode in modes], np.int32),
        },
        products={
            "mode": np.array([i for i, _ in products], np.int32),
            "pdg": np.array([one.pdg for _, one in products], np.int32),
            "charge": np.array([one.charge for _, one in products], np.int32),
            "mass": np.array([one.mass for _, one in products]),
        },
    )


@lru_cache(maxsize=1)
def compiled_decays() -> _core.DecayTable:
    """Return `DECAYS`, with the lifetimes of ``particles.csv``, for the compiled simulation."""
    return decay_table(DECAYS, {pdg: KNOWN[pdg].lifetime for pdg in DECAYS})
