"""Materials: radiation length, mean excitation energy and density effect from what a file states."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib import resources
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit.detector.keys import Key, Part, key

FINE_STRUCTURE = 1 / 137.035999084
K = 0.307075e-3  # GeV cm2/mol, 4 pi N_A r_e^2 m_e c^2 (PDG 2024, "Passage of particles through matter")
GAS_TABLES = ("ar-ic4h10-90-10", "ar-co2-70-30")  # of `gases`
CARBON_IN_COMPOUNDS = 81.0  # eV, mean excitation energy (ICRU Report 37)


class Element(NamedTuple):
    """Atomic number, atomic weight (g/mol) and mean excitation energy (eV) of an element."""

    z: float
    a: float
    excitation: float


class DensityEffect(NamedTuple):
    """Sternheimer's parameters of the density effect (dimensionless)."""

    c: float
    x0: float
    x1: float
    a: float
    k: float

    def delta(self, ln_betagamma: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return delta(beta gamma), (n,) float64, for ln(beta gamma), (n,) float64.

        PDG 2024, "Passage of particles through matter", eq. 34.7; the small delta of conductors below x0 is
        neglected.
        """
        x = ln_betagamma / math.log(10)
        high = 2 * ln_betagamma - self.c
        middle = high + self.a * np.abs(self.x1 - x) ** self.k
        return np.where(x >= self.x1, high, np.where(x >= self.x0, middle, 0.0))


@dataclass(frozen=True)
class Material(Part):
    """A homogeneous material.

    `composition` holds (element, mass fraction) pairs; it is empty where only bulk properties are known.

    Examples
    --------
    >>> gas = cg.load("besiii-cgem-design").cgem["L1"].gas
    >>> gas.name, gas.gas, round(gas.x0 / 1000)  # m
    ('CgemGas', True, 122)
    """

    extra_keys = MappingProxyType({"base": Key("text", doc="the material that this one is, at another density")})

    name: str
    density: float = field(metadata=key("density", "density", 1e-6, 25.0))  # g/cm3
    x0: float = field(metadata=key("length", "radiation length", 0.5, 1e10, derived=True))  # mm
    z_over_a: float = field(metadata=key("dimensionless", "mean Z/A, mol/g", 0.3, 1.0, derived=True))
    excitation_energy: float = field(
        metadata=key("energy", "mean excitation energy I", 1e-8, 2e-6, derived=True)
    )  # GeV
    gas: bool = field(
        metadata=key("boolean", "true for a gas (default false); enters the density effect", derived=True)
    )
    composition: tuple[tuple[str, float], ...] = field(
        metadata=key("composition", "chemical formula, or mass fractions of the elements", derived=True)
    )
    density_effect: DensityEffect = field(
        metadata=key("numbers", "Sternheimer's parameters c, x0, x1, a, k of the density effect", derived=True)
    )
    filling: float = field(
        metadata=key("dimensionless", "part of the volume that is solid, the rest being holes", 1e-9, 1.0), default=1.0
    )
    ionization: str = field(
        default="",
        metadata=key("text", "table of primary ionization of a gas", choices=GAS_TABLES, derived=True),
    )

    def __hash__(self) -> int:
        # Caches look up materials often; the hash of all fields would slow this down.
        return hash((self.name, self.density, self.x0))

    def solid(self) -> Material:
        """Return the matter between the holes: the same material undiluted."""
        if self.filling == 1:
            return self
        name, density, x0 = f"solid {self.name}", self.density / self.filling, self.x0 * self.filling
        return replace(self, name=name, density=density, x0=x0, filling=1.0)

    def xi(self, thickness: float) -> float:
        """Return (K/2) (Z/A) density thickness, GeV, for a thickness in mm."""
        return self.xi_per_mm * thickness

    @cached_property
    def xi_per_mm(self) -> float:
        """(K/2) (Z/A) density, GeV/mm."""
        return 0.5 * K * self.z_over_a * self.density * 0.1

    def log_term(self, ln_betagamma: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return -2 ln(I/GeV) - delta - 2 C/Z, (n,) float64: the material's part of the Bethe logarithm."""
        shells = np.zeros_like(ln_betagamma)
        total = sum(moles * element.z for element, moles in self.elements())
        for element, moles in self.elements():
            shells += moles / total * shell_correction(element.excitation, ln_betagamma)
        return -2 * math.log(self.excitation_energy) - self.density_effect.delta(ln_betagamma) - 2 * shells

    def elements(self) -> list[tuple[Element, float]]:
        """Return the elements with their moles per gram; one equivalent element where only bulk properties are known.

        Its Z solves the radiation length of PDG 2024, "Passage of particles through matter" (fit by O.I. Dahl, 2.5 %).
        """
        if self.composition:
            return [(elements()[name], part / elements()[name].a) for name, part in self.composition]
        z = np.linspace(1.0, 100.0, 9901)
        fitted = 716.4 * (z / self.z_over_a) / (z * (z + 1) * np.log(287 / np.sqrt(z)))
        best = float(z[np.argmin(np.abs(fitted - 0.1 * self.x0 * self.density))])
        equivalent = Element(best, best / self.z_over_a, self.excitation_energy * 1e9)
        return [(equivalent, 1 / equivalent.a)]


@cache
def elements() -> dict[str, Element]:
    """Return the known elements by symbol."""
    return {row["symbol"]: Element(int(row["Z"]), float(row["A"]), float(row["I"])) for row in element_rows()}


@cache
def element_rows() -> tuple[dict[str, str], ...]:
    """Return the rows of elements.csv as text."""
    text = (resources.files("cgemit.detector") / "presets" / "elements.csv").read_text(encoding="utf-8")
    return tuple(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


def fractions_of_formula(formula: str) -> dict[str, float]:
    """Return the mass fractions of a chemical formula such as ``"C22H10N2O5"``.

    Raises
    ------
    KeyError
        With an unknown element symbol.
    ValueError
        If the text is not a formula.

    """
    if not re.fullmatch(r"(?:[A-Z][a-z]?(?:[1-9]\d*)?)+", formula):
        raise ValueError(formula)
    mass: dict[str, float] = {}
    for symbol, count in re.findall(r"([A-Z][a-z]?)(\d*)", formula):
        mass[symbol] = mass.get(symbol, 0.0) + int(count or 1) * elements()[symbol].a
    total = sum(mass.values())
    return {symbol: value / total for symbol, value in mass.items()}


def radiation_length(element: Element) -> float:
    """Return the radiation length of an element in g/cm2.

    Y.S. Tsai, Rev. Mod. Phys. 46 (1974) 815, as in PDG 2024, "Passage of particles through matter", "Radiation
    length" and table 34.2; agrees with the PDG tables to 0.2 %.
    """
    light = {1: (5.31, 6.144), 2: (4.79, 5.621), 3: (4.74, 5.805), 4: (4.71, 5.924)}
    heavy = (math.log(184.15) - math.log(element.z) / 3, math.log(1194) - 2 * math.log(element.z) / 3)
    l_rad, l_inelastic = light.get(round(element.z), heavy)
    a2 = (FINE_STRUCTURE * element.z) ** 2
    coulomb = a2 * (1 / (1 + a2) + 0.20206 - 0.0369 * a2 + 0.0083 * a2**2 - 0.002 * a2**3)
    return 716.408 * element.a / (element.z**2 * (l_rad - coulomb) + element.z * l_inelastic)


def x0_of_fractions(fractions: dict[str, float], density: float) -> float:
    """Return the radiation length of a mixture in mm: 1/X0 is the sum of mass fraction/X0."""
    return 10 / density / sum(part / radiation_length(elements()[name]) for name, part in fractions.items())


def shell_correction(excitation: float, ln_betagamma: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return C, (n,) float64, of an element (divide by Z) for ln(beta gamma), (n,) float64, and I in eV.

    W.H. Barkas and M.J. Berger, NASA SP-3013 (1964); valid for beta gamma > 0.13, held constant below. W.R. Leo,
    Techniques for Nuclear and Particle Physics Experiments (1994), eq. 2.33, prints 3.850190 for 3.858019.
    """
    per_square = np.exp(-2 * np.maximum(ln_betagamma, math.log(0.13)))
    first = per_square * (0.422377 + per_square * (0.0304043 - per_square * 0.00038106))
    second = per_square * (3.858019 + per_square * (-0.1667989 + per_square * 0.00157955))
    return np.asarray(first * 1e-6 * excitation**2 + second * 1e-9 * excitation**3)


def z_over_a_of_fractions(fractions: dict[str, float]) -> float:
    """Return the mean Z/A of a mixture, mol/g."""
    return sum(part * elements()[name].z / elements()[name].a for name, part in fractions.items())


def excitation_of_fractions(fractions: dict[str, float]) -> float:
    """Return the mean excitation energy of a mixture in GeV.

    Bragg additivity: ln I is the mean of ln I of the elements weighted with their electrons (PDG 2024, "Passage of
    particles through matter", "Energy loss in mixtures and compounds").
    """
    total, weight = 0.0, 0.0
    for name, fraction in fractions.items():
        element = elements()[name]
        compound_carbon = name == "C" and len(fractions) > 1
        electrons = fraction * element.z / element.a
        total += electrons * math.log(CARBON_IN_COMPOUNDS if compound_carbon else element.excitation)
        weight += electrons
    return math.exp(total / weight) * 1e-9


def general_density_effect(excitation_energy: float, z_over_a: float, density: float, gas: bool) -> DensityEffect:
    """Return the density effect by the general form of R.M. Sternheimer and R.F. Peierls, Phys. Rev. B 3 (1971) 3681.

    Parameters are the mean excitation energy (GeV), Z/A (mol/g) and density (g/cm3); plasma energy
    28.816 eV sqrt(density Z/A) as in PDG 2024, "Passage of particles through matter", table 34.1. Gases near
    1 atm.
    """
    excitation = excitation_energy * 1e9
    c = 2 * math.log(excitation / (28.816 * math.sqrt(density * z_over_a))) + 1
    if gas:
        steps = [
            (10.0, 1.6, 4.0),
            (10.5, 1.7, 4.0),
            (11.0, 1.8, 4.0),
            (11.5, 1.9, 4.0),
            (12.25, 2.0, 4.0),
            (13.804, 2.0, 5.0),
        ]
        x0, x1 = next(((x0, x1) for limit, x0, x1 in steps if c < limit), (0.326 * c - 2.5, 5.0))
    elif excitation < 100:
        x0, x1 = (0.2 if c < 3.681 else 0.326 * c - 1.0), 2.0
    else:
        x0, x1 = (0.2 if c < 5.215 else 0.326 * c - 1.5), 3.0
    return DensityEffect(c, x0, x1, (c - 2 * math.log(10) * x0) / (x1 - x0) ** 3, 3.0)
