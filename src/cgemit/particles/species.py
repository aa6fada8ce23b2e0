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
    1000020030: "he3 helium3 3he",
    1000020040: "alpha he4 helium4 4he α",
}
_BOTH_CHARGES = {"pi": "pi+ or pi-", "pion": "pi+ or pi-", "π": "pi+ or pi-", "k": "K+ or K-", "kaon": "K+ or K-"}


def _plain(name: str) -> str:
    word = name.strip().lower().replace("_", "").replace(" ", "")
    return word[:-1].replace("-", "") + word[-1:]


_BY_SPELLING = {_plain(one.name): one.pdg for one in KNOWN.values()}
_BY_SPELLING |= {word: pdg for pdg, words in _SPELLINGS.items() for word in words.split()}


def species(particle: str | int) -> Species:
    """Return the particle of a name or a PDG number: ``"mu-"``, ``"proton"``, ``"anti_proton"``, ``-211``, ``"13"``.

    Raises
    ------
    WrongValueError
        If there is no such particle; says which name is close.
    """
    name = particle
    if isinstance(particle, str):
        word = _plain(particle)
        if word in _BOTH_CHARGES:
            raise WrongValueError(repr(name), f"a charge too: {_BOTH_CHARGES[word]}")
        number = particle.strip()
        particle = int(number) if number.removeprefix("-").isdecimal() else _BY_SPELLING.get(word, 0)
    known = isinstance(particle, int | np.integer) and not isinstance(particle, bool) and int(particle) in KNOWN
    if known:
        return KNOWN[int(particle)]
    names = ", ".join(f"{KNOWN[pdg].name} ({pdg})" for pdg in _SPELLINGS)
    names += f", or another of the {len(KNOWN)} in cgemit/particles/particles.csv"
    hint = did_you_mean(_plain(name), _BY_SPELLING) if isinstance(name, str) else ""
    raise WrongValueError(f"{name!r:.80}", f"one of {names}", hint)


def hypothesis_of(name: str) -> Species:
    """Return the particle of a mass hypothesis: a name of `HYPOTHESES`, or of another charged particle.

    Raises
    ------
    WrongValueError
        If there is no such particle, or it is neutral.
    """
    kind = HYPOTHESES.get(name) or species(name)
    if not kind.charge:
        raise WrongValueError(repr(name), "a charged particle")
    return kind


def is_hypothesis(name: str) -> bool:
    """Return whether `hypothesis_of` knows a name."""
    try:
        hypothesis_of(name)
    except WrongValueError:
        return False
    return True


def hypothesis_name(pdg: int) -> str:
    """Return the name of the hypothesis of a PDG number, unsigned or not; the number itself of unknown particles."""
    names = {kind.pdg: name for name, kind in HYPOTHESES.items()}
    number = abs(pdg)
    return names.get(number) or (KNOWN[number].name if number in KNOWN else str(number))


# Charges in thirds of e of the quarks 1 to 8, and of the other fundamental particles.
_QUARKS = {flavour: (2, -1)[flavour % 2] for flavour in range(1, 9)}
_FUNDAMENTAL = (
    {flavour: 3 * (0, -1)[flavour % 2] for flavour in range(11, 19)}
    | dict.fromkeys((21, 22, 23, 25, 32, 33, 35, 36, 39, 41), 0)
    | {24: 3, 34: 3, 37: 3, 38: 6}
)
#: Right-handed neutrinos, W and Z, and doubly charged scalars of left-right models, in thirds of e.
_LEFT_RIGHT = {9900012: 0, 9900014: 0, 9900016: 0, 9900023: 0, 9900024: 3, 9900041: 6, 9900042: 6}
#: First two of seven digits of supersymmetric particles and excited fermions.
_PARTNERS = (10, 20, 40)


def is_nucleus(pdg: int) -> bool:
    """Return whether a number is one of nuclei, 10LZZZAAAI with up to A units of charge and strangeness."""
    text = str(abs(pdg))
    return len(text) == 10 and text.startswith("10") and int(text[2]) + int(text[3:6]) <= int(text[6:9])


def charge_of(pdg: int) -> int | None:
    """Return the charge in e that follows from a PDG number, or None if none follows.

    The numbering scheme of the Particle Data Group ("Monte Carlo Particle Numbering Scheme", Phys. Rev. D 110, 030001
    (2024)) tells the charge of nuclei, of mesons and baryons by their quarks, of fundamental particles and of their
    supersymmetric and excited partners. Quarks and diquarks have none that is whole.
    """
    if pdg in KNOWN:
        return KNOWN[pdg].charge
    unsigned, sign = abs(pdg), 1 if pdg > 0 else -1
    if is_nucleus(pdg):
        return sign * (unsigned // 10_000 % 1000)
    thirds = _LEFT_RIGHT.get(unsigned)
    if thirds is None and unsigned < 100:
        thirds = _FUNDAMENTAL.get(unsigned)
    elif thirds is None and unsigned // 100_000 in _PARTNERS and unsigned % 100_000 < 100:
        partner = unsigned % 100_000
        thirds = _QUARKS.get(partner, _FUNDAMENTAL.get(partner))
    elif thirds is None and (unsigned < 1_000_000 or 9_000_000 <= unsigned < 9_900_000):
        thirds = _thirds_of_hadron(unsigned)
    return sign * thirds // 3 if thirds is not None and thirds % 3 == 0 else None


def _thirds_of_hadron(unsigned: int) -> int | None:
    """Return the charge of a meson or baryon in thirds of e by the digits of its quarks; None for other numbers."""
    first, second, third, spin = (unsigned // 10**k % 10 for k in (3, 2, 1, 0))
    if (third == 0 or spin == 0) and unsigned not in (130, 310):
        return None
    if first == 0:  # a quark and an antiquark; the heavier one is the antiquark if it is of the lower type
        if second not in _QUARKS or third not in _QUARKS:
            return None
        thirds = _QUARKS[second] - _QUARKS[third]
        return thirds if second % 2 == 0 else -thirds
    if unsigned >= 9_000_000 or not {first, second, third} <= _QUARKS.keys():
        return None  # nine and three quarks: a pentaquark
    return _QUARKS[first] + _QUARKS[second] + _QUARKS[third]


_NUCLEON = (0.93956542194, 0.93827208943)  # GeV/c2; CODATA 2022


def nuclear_mass(pdg: int) -> float:
    """Return the mass of a nucleus in GeV/c2 by its number 10LZZZAAAI.

    Hydrogen and listed nuclei have their measured masses, others that of Weizsaecker's formula (within 0.1 % from
    A = 12 on; the binding of hyperons is left out).
    """
    unsigned = abs(pdg)
    if unsigned in KNOWN:
        return KNOWN[unsigned].mass
    a, z, hyperons = unsigned // 10 % 1000, unsigned // 10_000 % 1000, unsigned // 10_000_000 % 10
    if not hyperons and (z, a) == (1, 1):
        return _NUCLEON[1]
    n = a - z - hyperons
    sum_of_masses = z * _NUCLEON[1] + n * _NUCLEON[0] + hyperons * KNOWN[3122].mass
    # Coefficients in GeV: J. W. Rohlf, Modern Physics from alpha to Z0 (1994).
    pairing = 0.01118 / math.sqrt(a) * (1 - z % 2 - n % 2)
    binding = 0.01575 * a - 0.0178 * a ** (2 / 3) - 0.000711 * z**2 / a ** (1 / 3) - 0.0237 * (n - z) ** 2 / a + pairing
    return float(sum_of_masses - max(binding, 0.0))


def usual_mass(pdg: int) -> float:
    """Return the mass of a listed particle or a nucleus, GeV/c2; NaN of other numbers."""
    if pdg in KNOWN:
        return KNOWN[pdg].mass
    return nuclear_mass(pdg) if is_nucleus(pdg) else math.nan


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
    modes: dict[int, tuple[DecayMode, ...]] = {}
    for pdg in dict.fromkeys(int(row["pdg"]) for row in rows):
        own_rows = [row for row in rows if int(row["pdg"]) == pdg]
        total = sum(float(row["fraction"]) for row in own_rows)
        for sign in (1, -1):
            modes[sign * pdg] = tuple(
                DecayMode(float(row["fraction"]) / total, _spectrum(row["spectrum"]), _products(row["products"], sign))
                for row in own_rows
            )
    return modes


def _spectrum(name: str) -> Spectrum:
    return next(one for one in get_args(Spectrum) if one == name)


def _products(numbers: str, sign: int) -> tuple[Species, ...]:
    pdg = [int(number) for number in numbers.split()]
    # A neutral pion is its own antiparticle.
    return tuple(KNOWN.get(sign * one, KNOWN[one]) for one in pdg)


#: Modes of each particle that decays in flight, by its number of the Particle Data Group. The column `mode` of the
#: table of decays counts them.
DECAYS: Mapping[int, tuple[DecayMode, ...]] = MappingProxyType(_modes())


def decay_table(decays: Mapping[int, tuple[DecayMode, ...]], lifetimes: Mapping[int, float]) -> _core.matter.DecayTable:
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
    return _core.matter.DecayTable(
        species={
            "pdg": np.array(parents, np.int32),
            "mass": np.array([KNOWN[pdg].mass for pdg in parents]),
            "lifetime": np.array([lifetimes[pdg] for pdg in parents]),
        },
        modes={
            "species": np.array([i for i, _ in modes], np.int32),
            "fraction": np.array([mode.fraction for _, mode in modes]),
            "spectrum": np.array([getattr(_core.matter.DecaySpectrum, mode.spectrum) for _, mode in modes], np.int32),
        },
        products={
            "mode": np.array([i for i, _ in products], np.int32),
            "pdg": np.array([one.pdg for _, one in products], np.int32),
            "charge": np.array([one.charge for _, one in products], np.int32),
            "mass": np.array([one.mass for _, one in products]),
        },
    )


@lru_cache(maxsize=1)
def compiled_decays() -> _core.matter.DecayTable:
    """Return `DECAYS`, with the lifetimes of ``particles.csv``, for the compiled simulation."""
    return decay_table(DECAYS, {pdg: KNOWN[pdg].lifetime for pdg in DECAYS})
