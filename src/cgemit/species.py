"""The particles that cgemit knows, by their many spellings."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np

from cgemit.problems import did_you_mean


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
    """Read ``data/particles.csv``, which ``tools/make_particles.py`` writes."""
    text = (resources.files("cgemit.data") / "particles.csv").read_text(encoding="utf-8")
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
    ValueError
        If there is no such particle; says which name is close.
    """
    given = particle
    if isinstance(particle, str):
        word = _plain(particle)
        if word in _BOTH_CHARGES:
            raise ValueError(f"got {given!r}; expected a charge too: {_BOTH_CHARGES[word]}")
        number = particle.strip()
        particle = int(number) if number.removeprefix("-").isdecimal() else _BY_SPELLING.get(word, 0)
    known = isinstance(particle, int | np.integer) and not isinstance(particle, bool) and int(particle) in KNOWN
    if known:
        return KNOWN[int(particle)]
    names = ", ".join(f"{KNOWN[pdg].name} ({pdg})" for pdg in _SPELLINGS)
    names += f", or another of the {len(KNOWN)} in cgemit/data/particles.csv"
    hint = did_you_mean(_plain(given), _BY_SPELLING, "; ") if isinstance(given, str) else ""
    raise ValueError(f"got {given!r}; expected one of {names}{hint}")
