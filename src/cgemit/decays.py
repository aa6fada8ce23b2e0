"""The decays in flight that the simulation knows: modes, branching fractions and products."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np

from cgemit import _core
from cgemit.species import KNOWN, Species

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
    """Read ``data/decays.csv``; both charges of each particle."""
    text = (resources.files("cgemit.data") / "decays.csv").read_text(encoding="utf-8")
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
    """Return `DECAYS`, with the lifetimes of ``data/particles.csv``, for the compiled simulation."""
    return decay_table(DECAYS, {pdg: KNOWN[pdg].lifetime for pdg in DECAYS})
