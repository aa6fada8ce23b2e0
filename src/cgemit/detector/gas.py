"""Gas of the drift gaps: ionization, electrodes around it, and transport of electrons.

The tables that do not depend on the particle are computed here, once per detector (docs/methods/deltas.md).
Positions w are mm outward from the inner edge of the gap; energies keV.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.base.errors import Problems, refuse
from cgemit.base.files import read_text
from cgemit.detector.detector import Detector
from cgemit.detector.keys import once
from cgemit.detector.layers import CgemLayer, Layer
from cgemit.detector.material import Material
from cgemit.detector.parts import Contents, cgem_layers
from cgemit.detector.shells import Shell
from cgemit.units import LIGHT

REST_ENERGY = 510.99895  # keV, of the electron (PDG 2024)
AVOGADRO = 6.02214076e23  # 1/mol
K_KEV = 307.075  # keV cm2/mol, 4 pi N_A r_e^2 m_e c^2 (PDG 2024)
LEAST_ENERGY = 1.0  # keV, of electrons that leave a solid
SLICE_RATIO = 1.15  # least energies of neighbouring slices
JOY_LUO_LIMIT = 10.0  # keV
EVEN_DEPTH = 2e-3  # g/cm2, what 30 keV electrons cross: farther from the gap, neighbouring solids count as one
EVEN_DENSITY = 0.5  # g/cm3: neither gas nor foam


class Ionization(NamedTuple):
    """Primary ionization of a gas, as in ``gases``."""

    electron_density: float  # mol/cm3, density times Z/A
    w_value: float  # keV per electron
    betagamma: Floats  # (n,)
    clusters: Floats  # (n,), ionizations per mm at `betagamma`
    sizes: Floats  # (m,), share of the ionizations with up to 1, 2, ... electrons, then up to each of `tail[1:]`
    tail: Floats  # (k,), borders of the ranges over which the number of electrons n falls as 1/n^2


@cache
def ionization(name: str) -> Ionization:
    """Return a table of ``gases`` by name."""
    text = (resources.files("cgemit.detector") / "gases" / f"{name}.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    single = {row["quantity"]: float(row["value"]) for row in rows if not row["at"]}
    if "w_value" not in single:
        raise ValueError(f"gases/{name}.csv: got no w_value, expected the mean energy per electron in eV")
    columns = {}
    for quantity in ("clusters", "size", "more_than"):
        found = [(float(row["at"]), float(row["value"])) for row in rows if row["quantity"] == quantity]
        columns[quantity] = np.array(found).T
    sizes, tail = _sizes(columns["size"], columns["more_than"])
    return Ionization(
        electron_density=single["density"] * single["z_over_a"],
        w_value=single["w_value"] * 1e-3,
        betagamma=columns["clusters"][0],
        clusters=0.1 * columns["clusters"][1],
        sizes=sizes,
        tail=tail,
    )


def cluster_sizes(table: Ionization, uniform: Floats) -> Floats:
    """Return numbers of electrons, (n,), of ionizations for uniform random numbers, (2, n).

    The first ones choose the size or a range of the tail, the second ones the place within it.

    Parameters
    ----------
    table : Ionization
    uniform : (2, n) float64
        From 0 to 1.
    """
    listed = len(table.sizes) - len(table.tail) + 1
    row = np.searchsorted(table.sizes, uniform[0])
    low, high = table.tail[:-1], table.tail[1:]
    part = np.clip(row - listed, 0, len(low) - 1)
    beyond = 1 / (1 / low[part] - uniform[1] * (1 / low[part] - 1 / high[part]))
    return np.asarray(np.where(row < listed, row + 1.0, np.floor(beyond)), np.float64)


#: Where the size table ends, electrons: beyond, electrons are free ones struck by the particle.
LARGEST_SIZE = 2000


def _sizes(listed: Floats, beyond: Floats) -> tuple[Floats, Floats]:
    """Return cumulative shares of sizes and ranges, and the borders of the ranges.

    Between listed sizes the logarithm of the share is linear. Beyond the last range border the shares continue as
    1/n^2; sizes above `LARGEST_SIZE` are left out.
    """
    every = np.arange(1, round(listed[0, -1]) + 1)
    shares = np.exp(np.interp(every, listed[0], np.log(listed[1])))
    borders = np.append(beyond[0], LARGEST_SIZE) + 0.5
    last = beyond[1, -1] * (1 - borders[-2] / borders[-1])
    ranges = np.append(-np.diff(beyond[1]), last)
    shares *= (100 - beyond[1, 0]) / shares.sum()
    cumulative = np.cumsum(np.concatenate([shares, ranges]))
    return cumulative / cumulative[-1], borders


def clusters_per_mm(gas: Material, ln_betagamma: Floats) -> Floats:
    """Return the ionizations per mm, (n,), of a gas for ln(beta gamma), (n,).

    Linear in ln(beta gamma) between the tabulated points, constant above (the plateau of the density effect),
    1/beta^2 below. In proportion to the density of electrons if that is not the one of the table.
    """
    table = ionization_of(gas)
    inside = np.interp(ln_betagamma, np.log(table.betagamma), table.clusters)
    lowest = table.betagamma[0]
    per_beta2 = (1 + np.exp(-2 * ln_betagamma)) / (1 + lowest**-2)
    return inside * np.where(ln_betagamma < math.log(lowest), per_beta2, 1.0) * _ratio(gas, table)


def enough_electrons(gas: Material, ionizations: Floats, least: int) -> Floats:
    """Return the probability, shape of `ionizations`, that a particle sets free some number of electrons or more.

    The number of ionizations is a Poisson number, that of electrons of each has the sizes of the gas's table. The
    distribution of the sum follows by recursion: P(j) = n/j sum_i i s(i) P(j - i) (Panjer, ASTIN Bull. 12 (1981) 22).

    Parameters
    ----------
    gas : Material
    ionizations : ndarray, float64
        Their mean number n.
    least : int
        Larger ones than the sizes that the table lists count as one more than these.
    """
    table = ionization_of(gas)
    listed = len(table.sizes) - len(table.tail) + 1
    single = np.diff(table.sizes[:listed], prepend=0.0)
    fewer = [np.exp(-ionizations)]
    for j in range(1, min(least, listed + 1)):
        fewer.append(ionizations / j * sum(i * single[i - 1] * fewer[j - i] for i in range(1, j + 1)))
    return np.asarray(1 - sum(fewer)) if least > 0 else np.ones_like(ionizations)


class ClusterShares(NamedTuple):
    """Sums of squares of the shares of ionization clusters in the electrons of a crossing, and the electrons' number.

    The number of clusters is a Poisson number. Of n electrons the expected sum of squares of the clusters' sizes is
    ``mean sum_i i^2 s(i) P(n - i)/P(n)`` (J. Mecke, Z. Wahrscheinlichkeitstheorie 9 (1967) 36), with the distribution
    P of the sum as in `enough_electrons`.

    Attributes
    ----------
    log_means : (means,) float64
        Logarithm of the mean number of clusters.
    squares : (means, most) float64
        Sum of squares for 0, 1, 2, ... electrons, over the square of their number.
    electrons : (means, 8) float64
        Numbers of electrons in the middle of eight equal steps of their distribution.
    """

    log_means: Floats
    squares: Floats
    electrons: Floats

    def shares(self, mean: float, numbers: Floats, variance: float) -> Floats:
        """Return the expected sum of squares of the clusters' shares of the charge, shape of `numbers`.

        Parameters
        ----------
        mean : float
            Of the number of clusters.
        numbers : ndarray, float64
            Of electrons.
        variance : float
            Relative, of the charge of an electron.
        """
        squares = numbers**2 * np.interp(numbers, np.arange(self.squares.shape[1]), self._at(self.squares, mean))
        return np.asarray((np.maximum(squares, numbers) + variance * numbers) / (numbers**2 + variance * numbers))

    def quantiles(self, mean: float) -> Floats:
        """Return the numbers of electrons of eight equal parts of all crossings, (8,) float64."""
        return self._at(self.electrons, mean)

    def _at(self, table: Floats, mean: float) -> Floats:
        """Return a row of a table, linear between its means."""
        step = self.log_means[1] - self.log_means[0]
        nth = float(np.clip((math.log(mean) - self.log_means[0]) / step, 0, len(self.log_means) - 1.001))
        low = int(nth)
        return np.asarray(table[low] + (nth - low) * (table[low + 1] - table[low]))


_MOST = 501  # electrons, of `ClusterShares`
_PARTS = 8


@cache
def cluster_shares(name: str) -> ClusterShares:
    """Return the sums of squares of the clusters of a gas.

    Parameters
    ----------
    name : str
        Of an ionization table; empty: the default one.
    """
    table = ionization(name or DEFAULT_IONIZATION)
    listed = len(table.sizes) - len(table.tail) + 1
    single = np.zeros(_MOST)
    single[1 : listed + 1] = np.diff(table.sizes[:listed], prepend=0.0)
    for first, last, share in zip(table.tail, table.tail[1:], np.diff(table.sizes[listed - 1 :]), strict=False):
        inside = np.arange(math.ceil(first), math.ceil(last))  # as 1/n^2 within a range
        part = share / inside.astype(np.float64) ** 2 / np.sum(1 / inside.astype(np.float64) ** 2)
        single[inside[inside < _MOST]] = part[: np.count_nonzero(inside < _MOST)]
    size = np.arange(_MOST, dtype=np.float64)
    log_means = np.linspace(math.log(0.5), math.log(400.0), 41)
    squares, electrons = np.zeros((len(log_means), _MOST)), np.zeros((len(log_means), _PARTS))
    parts = (np.arange(_PARTS) + 0.5) / _PARTS
    for row, (mean, square) in enumerate(zip(np.exp(log_means), squares, strict=True)):
        chance = np.zeros(_MOST)
        chance[0] = math.exp(-mean)
        for n in range(1, _MOST):
            chance[n] = mean / n * (size[1 : n + 1] * single[1 : n + 1]) @ chance[n - 1 :: -1][:n]
        summed = mean * np.convolve(size**2 * single, chance)[:_MOST]
        square[1:] = np.clip(summed[1:] / np.maximum(chance[1:], 1e-300) / size[1:] ** 2, 1 / size[1:], 1.0)
        cumulative = np.cumsum(chance[1:])  # crossings without electrons have no cluster
        electrons[row] = np.interp(parts * (1 - chance[0]), cumulative, size[1:], left=1.0)
    return ClusterShares(log_means, squares, electrons)


@once
def most_lost(layer: Layer) -> float:
    """Return the probability that a minimum ionizing particle straight across a layer frees too few electrons.

    Parameters
    ----------
    layer : Layer
        Of which `Readout.least_electrons` counts; without gas, none are lost.
    """
    if layer.gas is None:
        return 0.0
    ionizations = np.array(_fewest_per_mm(layer.gas) * layer.drift_gap)
    return 1 - float(enough_electrons(layer.gas, ionizations, layer.readout.least_electrons))


@once
def _fewest_per_mm(gas: Material) -> float:
    """Return the ionizations per mm of a minimum ionizing particle."""
    return float(clusters_per_mm(gas, np.log(ionization_of(gas).betagamma)).min())


DEFAULT_IONIZATION = "ar-ic4h10-90-10"


def ionization_of(gas: Material) -> Ionization:
    """Return the table that a gas names, or the default one."""
    return ionization(gas.ionization or DEFAULT_IONIZATION)


def w_values(detector: Contents) -> Floats:
    """Return the mean energy per electron of ionization in the gas of each layer, (layers,), keV; 1 without gas."""
    return np.array([ionization_of(layer.gas).w_value if layer.gas else 1.0 for layer in detector.layers])


def _ratio(gas: Material, table: Ionization) -> float:
    return gas.density * gas.z_over_a / table.electron_density


def practical_range(energy: Floats) -> Floats:
    """Return the practical range, g/cm2, of electrons of some keV; Kobetich and Katz, Phys. Rev. 170 (1968) 391."""
    return 5.37e-4 * energy * (1 - 0.9815 / (1 + 3.123e-3 * energy))


def stopping_power(material: Material, energy: Floats) -> Floats:
    """Return the collision stopping power of electrons, keV/mm, (n,), for kinetic energies in keV, (n,).

    Above 10 keV M.J. Berger and S.M. Seltzer, NBSIR 82-2550 (ICRU Report 37, eq. 2.11 and 2.12), with the material's
    density effect; below D.C. Joy and S. Luo, Scanning 11 (1989) 176, whose mean excitation energy falls with the
    energy.
    """
    excitation = material.excitation_energy * 1e6
    tau = energy / REST_ENERGY
    beta2 = tau * (tau + 2) / (tau + 1) ** 2
    delta = material.density_effect.delta(0.5 * np.log(tau * (tau + 2)))
    high = np.log(tau**2 * (tau + 2) / 2 * (REST_ENERGY / excitation) ** 2) + 1 - beta2 - delta
    high += (tau**2 / 8 - (2 * tau + 1) * math.log(2)) / (tau + 1) ** 2
    low = 2 * np.log(1.166 * (energy / excitation + 0.85))
    per_gram = 0.5 * K_KEV * material.z_over_a * np.where(energy < JOY_LUO_LIMIT, low, high) / beta2
    return np.asarray(0.1 * material.density * per_gram)


def elastic(material: Material, energy: Floats) -> tuple[Floats, Floats]:
    """Return K (1/mm) and a of the rate of elastic scatters K/(mu + a)^2 d(mu), mu = (1 - cos(angle))/2; (n,) each.

    Screened Rutherford cross-section as in D.C. Joy, Monte Carlo Modeling for Electron Microscopy and Microanalysis
    (1995), ch. 3: 5.21e-21 cm2 Z^2/E^2 ((E + 511)/(E + 1024))^2 4 pi/(a(1 + a)), a = 3.4e-3 Z^0.67/E, E in keV.
    In a, E is replaced by p^2/2m. Elements of a mixture share one a: ln(a) is the mean with K.
    """
    reduced = energy * (1 + energy / (2 * REST_ENERGY))
    strength, logarithm = 0.0, 0.0
    for element, moles in material.elements():
        weight = AVOGADRO * material.density * moles * element.z**2
        strength += weight
        logarithm += weight * math.log(3.4e-3 * element.z**0.67)
    per_cm = 4 * math.pi * 5.21e-21 * strength * ((energy + 511) / (energy + 1024) / energy) ** 2
    return 0.1 * per_cm, math.exp(logarithm / strength) / reduced


def electron_energies() -> Floats:
    """Return the core's grid of electron energies, (ELECTRON_POINTS,), keV."""
    octave, part = np.divmod(np.arange(_core.detector.ELECTRON_POINTS), _core.detector.ELECTRON_STEPS)
    return np.asarray(_core.detector.ELECTRON_GRID_FIRST * 2.0**octave * (1 + part / _core.detector.ELECTRON_STEPS))


def step_share(energy: Floats) -> Floats:
    """Return the path between hard scatters over transport mean free path or remaining path, (n,); keV, (n,).

    The share is smaller for faster electrons, which go farther. Half of it changes the displacements by less than 2 %.
    """
    return np.clip(0.1 * np.sqrt(200 / energy), 0.1, 0.5)


def electron_table(shells: Sequence[Shell]) -> Floats:
    """Return the electron table of sub-layers as one uniform matter, (ELECTRON_POINTS, 6) float64.

    Columns: stopping (keV/mm), mean free path of hard scatters (mm), the mu above which a scatter is hard, screening,
    mean of mu per mm by soft scatters, 1/momentum ((GeV/c)^-1). The mean free path of hard scatters is
    `step_share` times the smaller of transport mean free path and energy/stopping; where that of all scatters is
    longer, all are hard (F. Salvat et al., PENELOPE, class-II simulation).
    """
    energy = electron_energies()
    share = np.array([shell.thickness for shell in shells]) / sum(shell.thickness for shell in shells)
    stopping = share @ np.array([stopping_power(shell.material, energy) for shell in shells])
    strengths, screenings = np.swapaxes([elastic(shell.material, energy) for shell in shells], 0, 1)
    strength = share @ strengths
    a = np.exp(share @ (strengths * np.log(screenings)) / strength)
    transport = 2 * strength * (np.log1p(1 / a) - 1 / (1 + a))
    longest = step_share(energy) * np.minimum(1 / transport, energy / stopping)
    path = np.maximum(a * (1 + a) / strength, longest)
    cut = np.maximum(1 / (1 / (path * strength) + 1 / (1 + a)) - a, 0.0)
    cut[cut < 1e-9 * a] = 0.0
    soft = strength * (np.log1p(cut / a) - cut / (cut + a))
    momentum = 1e-6 * np.sqrt(energy * (energy + 2 * REST_ENERGY))  # GeV/c
    return np.column_stack([stopping, path, cut, a, soft, 1 / momentum])


def _electron_columns(groups: Sequence[Sequence[Shell]]) -> dict[str, Floats]:
    """Return the electron tables of groups of sub-layers by the names of their columns, (n, ELECTRON_POINTS) each."""
    columns = np.moveaxis(np.array([electron_table(group) for group in groups]), -1, 0)
    return {name: column.copy() for name, column in zip(_ELECTRON_COLUMNS, columns, strict=True)}


_ELECTRON_COLUMNS = ("stopping", "path", "cut", "screening", "soft", "per_momentum")


def _groups(shells: Sequence[Shell], gap: int) -> list[list[Shell]]:
    """Return the sub-layers in groups of uniform matter for electrons: solids side by side far from the gap."""
    groups: list[list[Shell]] = []
    dense = [depth > EVEN_DEPTH and shell.material.density > EVEN_DENSITY for shell, depth in
             zip(shells, _depths([[shell] for shell in shells], gap), strict=True)]  # fmt: skip
    for i, shell in enumerate(shells):
        if i > 0 and dense[i - 1] and dense[i]:
            groups[-1].append(shell)
        else:
            groups.append([shell])
    return groups


def _depths(groups: Sequence[Sequence[Shell]], gap: int) -> list[float]:
    """Return the mass thickness, g/cm2, between each group's near face and the gap."""
    mass = [sum(0.1 * shell.material.density * shell.thickness for shell in group) for group in groups]
    return [sum(mass[i + 1 : gap]) if i < gap else sum(mass[gap + 1 : i]) for i in range(len(groups))]


def slices(layer: Layer) -> NDArray[np.float64]:
    """Return the matter around a gap cut into slices, one row each from the gap inward, then outward.

    Returns
    -------
    (n, 4) float64
        w of both faces, mm; least energy, keV, of an electron whose practical range brings it from the near face to
        the gap, at least `LEAST_ENERGY`; (K/2) (Z/A) times mass thickness, keV. Neighbouring slices of a sub-layer
        differ by a factor `SLICE_RATIO` in the least energy.

    """
    shells = list(layer.shells())
    gap = [shell.group for shell in shells].index(layer.sensitive)
    energy = np.asarray(LEAST_ENERGY * SLICE_RATIO ** np.arange(120.0), np.float64)
    borders = practical_range(energy)
    rows = []
    for i, depth in enumerate(_depths([[shell] for shell in shells], gap)):
        if i == gap:
            continue
        shell, density = shells[i], 0.1 * shells[i].material.density
        deepest = depth + density * shell.thickness
        cuts = [depth, *borders[(borders > depth) & (borders < deepest)], deepest]
        for near, far in pairwise(cuts):
            away = (near - depth) / density, (far - depth) / density
            face = shell.r_out if i < gap else shell.r_in
            w = sorted(face + (-1 if i < gap else 1) * distance - layer.r_gap_in for distance in away)
            least = max(LEAST_ENERGY, float(np.interp(near, borders, energy)))
            rows.append((*w, least, 1e6 * shell.material.xi(away[1] - away[0])))
    return np.array(rows)


@lru_cache(maxsize=64)
def gap_columns(layer: Layer) -> dict[str, Any]:
    """Return a gap as the core takes it: dicts of columns (float64) and numbers, see ``detector/gap.hpp``.

    Equal layers share one result, which must not be changed. It is empty for a layer without gas.
    """
    if layer.gas is None:
        return {}
    shells = list(layer.shells())
    groups = _groups(shells, [shell.group for shell in shells].index(layer.sensitive))
    gap = [group[0].group for group in groups].index(layer.sensitive)
    density = [sum(s.material.density * s.thickness for s in g) / sum(s.thickness for s in g) for g in groups]
    table = ionization_of(layer.gas)
    cut = slices(layer)
    grid = _core.detector.LOSS_GRID_FIRST + _core.detector.LOSS_GRID_STEP * np.arange(
        _core.detector.LOSS_POINTS, dtype=np.float64
    )
    return {
        "layers": {
            "w_in": np.array([group[0].r_in - layer.r_gap_in for group in groups]),
            "w_out": np.array([group[-1].r_out - layer.r_gap_in for group in groups]),
            "density": 0.1 * np.array(density),
            "depth": np.array(_depths(groups, gap)),
            **_electron_columns(groups),
        },
        "gap": gap,
        "z_min": layer.ends[0],
        "z_max": layer.ends[1],
        "slices": {
            "w_in": cut[:, 0].copy(),
            "w_out": cut[:, 1].copy(),
            "least_energy": cut[:, 2].copy(),
            "rate": np.cumsum(cut[:, 3] / cut[:, 2]),
        },
        "xi": 1e6 * layer.gas.xi(1.0),
        "w_value": table.w_value,
        "clusters": clusters_per_mm(layer.gas, grid),
        "sizes": table.sizes,
        "tail": table.tail,
    }


def gap_table(detector: Contents) -> list[dict[str, Any]]:
    """Return the gaps of a detector, one per layer, as the core takes them; an empty one without gas."""
    return [gap_columns(layer) for layer in detector.layers]


#: Largest magnetic field of the tables, T: the line through 0 and 1 T is continued that far.
MAX_B = 1.2

_COLUMNS = ("velocity", "tan_lorentz", "sigma_x", "sigma_par", "sigma_l")
#: Units of the tables in those of the program: um/ns to mm/ns, um/sqrt(cm) to mm/sqrt(mm).
_NATIVE = np.array([1e-3, 1.0, 1e-3 / math.sqrt(10), 1e-3 / math.sqrt(10), 1e-3 / math.sqrt(10)])


class Transport(NamedTuple):
    """Transport of electrons at one electric and magnetic field at right angles."""

    velocity: float  # mm/ns, along the electric field
    tan_lorentz: float  # not negative
    sigma_x: float  # mm/sqrt(mm), across both fields
    sigma_par: float  # mm/sqrt(mm), along the magnetic field
    sigma_l: float  # mm/sqrt(mm), along the drift


@cache
def table(gas: str) -> dict[float, Floats]:
    """Return the table of a gas by magnetic field (T): rows of electric field (kV/cm) and the columns as in the file.

    Parameters
    ----------
    gas : str
        ``"ar-ic4h10-90-10"``, ``"ar-co2-70-30"``, or without magnetic field ``"he-c3h8-60-40"``, ``"he-ic4h10-80-20"``,
        ``"he-ic4h10-90-10"``, ``"he-c2h6-50-50"``.

    Returns
    -------
    dict of float to ndarray, (n, 6) float64
    """
    text = (resources.files("cgemit.detector") / "gases" / f"transport-{gas}.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    rows_of: dict[float, list[list[float]]] = {}
    for row in rows:
        rows_of.setdefault(float(row["b_field"]), []).append([float(row[name]) for name in ("e_field", *_COLUMNS)])
    return {b: np.array(sorted(values)) for b, values in rows_of.items()}


@lru_cache(maxsize=256)
def transport(gas: str, e_field: float, b_field: float) -> Transport:
    """Return the transport in a gas.

    Parameters
    ----------
    gas : str
        Name of a `table`.
    e_field : float
        kV/cm.
    b_field : float
        T, of either sign.

    Raises
    ------
    ValueError
        If a field is outside the tables; of the electric field the rows of every magnetic field that is needed count.
    """
    b = abs(b_field)
    if not b <= MAX_B:
        raise ValueError(f"magnetic field: got {b:g} T, expected 0 to {MAX_B:g} T, where {gas} is tabulated")
    rows = table(gas)
    if b > max(rows) == 0:
        raise ValueError(f"magnetic field: got {b:g} T, expected 0 T, where {gas} is tabulated")
    needed = (0.0,) if b == 0 else (1.0,) if b == 1 else (0.0, 1.0)
    low, high = (f(side[0] for side in (rows[i][:, 0][[0, -1]][::s] for i in needed)) for f, s in ((max, 1), (min, -1)))
    if not low <= e_field <= high:
        raise ValueError(
            f"electric field: got {e_field:g} kV/cm, expected {low:g} to {high:g} kV/cm, where {gas} is tabulated "
            f"at {b:g} T"
        )
    at = [[np.interp(e_field, rows[i][:, 0], column) for column in rows[i][:, 1:].T] for i in needed]
    values = np.array(at[0]) if len(at) == 1 else np.array(at[0]) + b * (np.array(at[1]) - np.array(at[0]))
    return Transport(*(float(value) for value in values * _NATIVE))


_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][+-]?\d+)?")
_TABLES, _FOOTER = "The gas tables follow:", re.compile("H Extr|Thresholds")  # early versions have no H Extr
_LARGEST_GAS_FILE = 200_000_000  # bytes
_MOST_TORR = 1e5
_WIDEST = 1e3  # sqrt(cm Torr), of diffusion


@dataclass(frozen=True, eq=False)
class GasFile:
    """Electron transport in a gas, as Magboltz computed it for Garfield.

    Attributes
    ----------
    gas : str
        Name in the file, such as ``"Ar 90%, iC4H10 10%, T=293.15 K, p=1 atm"``.
    e_field : ndarray, (fields,) float64, kV/cm
    b_field : ndarray, (magnetic fields,) float64, T
        At the angle to the electric field that is closest to a right angle.
    velocity, tan_lorentz, sigma_t, sigma_l : ndarray, (fields, magnetic fields) float64
        Drift velocity along the electric field, mm/ns; tangent of the angle between drift and electric field;
        diffusion across and along the drift, mm/sqrt(mm).

    Examples
    --------
    >>> from cgemit.detector import GasFile
    >>> columns = [np.full((2, 1), value) for value in (0.025, 0.0, 0.07, 0.05)]
    >>> gas = GasFile("He 90%, iC4H10 10%", np.array([0.5, 1.5]), np.array([0.0]), *columns)
    >>> gas.transport(1.0).velocity  # mm/ns
    0.025
    """

    gas: str
    e_field: Floats
    b_field: Floats
    velocity: Floats
    tan_lorentz: Floats
    sigma_t: Floats
    sigma_l: Floats

    def transport(self, e_field: float, b_field: float = 0.0) -> Transport:
        """Return the transport at fields between the tabulated ones, linear in both.

        Parameters
        ----------
        e_field : float
            kV/cm.
        b_field : float
            T, of either sign.

        Raises
        ------
        ValueError
            If a field is outside of the file.

        """
        problems, b = Problems(), abs(b_field)
        for name, value, unit, grid in (("e_field", e_field, "kV/cm", self.e_field), ("b_field", b, "T", self.b_field)):
            if not grid[0] - 1e-6 * grid[-1] <= value <= grid[-1] * (1 + 1e-6):  # the file has eight digits
                problems.note(name, f"{value:g} {unit}", f"{grid[0]:g} to {grid[-1]:g} {unit}, as in the file")
        problems.report("electron transport")
        at_b = []
        for values in (self.velocity, self.tan_lorentz, self.sigma_t, self.sigma_l):
            at_e = [float(np.interp(e_field, self.e_field, column)) for column in values.T]
            at_b.append(float(np.interp(b, self.b_field, at_e)))
        velocity, tan_lorentz, sigma_t, sigma_l = at_b
        return Transport(velocity, tan_lorentz, sigma_t, sigma_t, sigma_l)


def read_gas_file(path: str | Path) -> GasFile:
    r"""Return the electron transport of a gas file of Garfield or Garfield++ (``.gas``).

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    ValueError
        If the file has another format, or misses numbers.

    Examples
    --------
    >>> from pathlib import Path
    >>> from cgemit.detector import read_gas_file
    >>> head = " Dimension : T 2 1 1 0 0\n E fields\n 1.0 2.0\n E-B angles\n 1.57\n B fields\n 0.0\n Mixture:\n"
    >>> row = "2.0 0.0 0.0 1.2 1.8" + 12 * " 0.0" + "\n"
    >>> tables = f" The gas tables follow:\n{row}{row} H Extr: 1\n PGAS : 7.6E+02\n"
    >>> written = Path("helium.gas").write_text(head + tables)
    >>> found = read_gas_file("helium.gas").transport(1.0)
    >>> found.velocity  # mm/ns
    0.02
    >>> det = cg.load("idea-like").with_overrides({"drift_chamber.drift_velocity": f"{found.velocity} mm/ns"})
    >>> det.drift_chamber.drift_text()
    'of 20 um/ns'
    """
    problems = Problems()
    text = _gas_text(path, problems)
    grids, plain, rows = _gas_rows(text, problems)
    problems.report(str(path))
    right = int(np.argmin(np.abs(grids["E-B angles"] - math.pi / 2)))
    along, across, aside, long, wide = (rows[:, right, :, i] for i in ((0, 1, 2, 3, 4) if plain else (0, 2, 4, 6, 8)))
    fastest = LIGHT * 100.0  # cm/us
    _check_transport("velocity", along, fastest, grids, problems)
    _check_transport("longitudinal diffusion", long, _WIDEST, grids, problems)
    _check_transport("transverse diffusion", wide, _WIDEST, grids, problems)
    problems.report(str(path))
    # Electric fields are divided by the pressure in Torr, magnetic fields are in 0.01 T, velocities in cm/us. Widths in
    # sqrt(cm) are multiplied by the root of the pressure.
    native = math.sqrt(10 / text.torr)
    name_of = re.search(r"Identifier\s*:\s*(.*)", text.head)
    return GasFile(
        gas=name_of[1].strip() if name_of else "",
        e_field=grids["E fields"] * text.torr * 1e-3,
        b_field=grids["B fields"] * 1e-2,
        velocity=along * 1e-2,
        tan_lorentz=np.hypot(across, aside) / np.where(along > 0, along, 1.0),
        sigma_t=wide * native,
        sigma_l=long * native,
    )


class _GasText(NamedTuple):
    """Parts of a gas file: before the tables, and the tables; the line Dimension, and the pressure."""

    head: str
    tables: str
    size: re.Match[str]
    torr: float


def _gas_text(path: str | Path, problems: Problems) -> _GasText:
    """Return the parts of a gas file, or raise an error if one is missing."""
    try:
        text = read_text(Path(path), _LARGEST_GAS_FILE)
    except UnicodeDecodeError as error:
        refuse(str(path), f"line {1 + error.object.count(10, 0, error.start)}", "bytes that are no text", "UTF-8")
    head, marker, tail = text.partition(_TABLES)
    tables, *rest = _FOOTER.split(tail, maxsplit=1)
    size = re.search(r"Dimension\s*:\s*([TF])((?:\s+\d+){5})", head)
    pressure = re.search(rf"PGAS\s*[:=]\s*({_NUMBER.pattern})", "".join(rest))
    for name, text_there, expected in (
        (_TABLES, marker, "this line, as in gas files of Garfield"),
        ("Dimension", size, "T or F and five whole numbers"),
        ("PGAS", pressure, "the pressure, behind the tables"),
    ):
        if not text_there:
            problems.note(name, "nothing", expected)
    if text.count(_TABLES) > 1:
        problems.note(_TABLES, "this line twice", "one gas a file")
    torr = float(_numbers_of(pressure[1])[0]) if pressure else 0.0
    if pressure and not 0 < torr < _MOST_TORR:
        problems.note("PGAS", f"{torr:g} Torr", f"a pressure above 0 and below {_MOST_TORR:g} Torr")
    problems.report(str(path))
    assert size
    return _GasText(head, tables, size, torr)


def _gas_rows(text: _GasText, problems: Problems) -> tuple[dict[str, Floats], bool, Floats]:
    """Return fields and angles of a gas file, whether its rows have no splines, and the rows (E, angle, B, number)."""
    fields, angles, magnetic, excited, ionized = map(int, text.size[2].split())
    grids = {}
    for name, count, after in (
        ("E fields", fields, "E-B angles"), ("E-B angles", angles, "B fields"), ("B fields", magnetic, "Mixture"),
    ):  # fmt: skip
        grids[name] = _numbers_of(text.head.partition(name)[2].partition(after)[0])
        if len(grids[name]) != count or not count:
            problems.note(name, f"{len(grids[name])} numbers", f"{max(count, 1)}, as in the line Dimension")
        elif grids[name][0] < 0 or (np.diff(grids[name]) <= 0).any() or (name == "E fields" and not grids[name][0]):
            least = "above 0, and each above the one before" if name == "E fields" else "0 or more, in rising order"
            problems.note(name, ", ".join(f"{one:g}" for one in grids[name][:8]), f"numbers {least}")
    plain = text.size[1] == "T"  # else each value has the coefficient of a spline behind it, except one
    width = 17 + excited + ionized if plain else 33 + 2 * (excited + ionized)
    numbers = _numbers_of(text.tables)
    shape = fields, angles, magnetic, width
    if len(numbers) != math.prod(shape):
        expected = f"{fields} x {angles} x {magnetic} rows of {width}, as in the line Dimension"
        problems.note("gas tables", f"{len(numbers)} numbers", expected)
        numbers = np.zeros(shape)
    return grids, plain, numbers.reshape(shape)


def _check_transport(name: str, values: Floats, most: float, grids: Mapping[str, Floats], problems: Problems) -> None:
    """Note a table of zeros, or the first value, (E, B), that is not between 0 and the largest."""
    wrong = np.argwhere(~((values > 0) & (values < most)))
    if not values.any():
        problems.note("gas tables", f"only zeros of the {name}", "a file with this table")
    elif len(wrong):
        at = f"{grids['E fields'][wrong[0][0]]:g} V/cm/Torr and {grids['B fields'][wrong[0][1]] * 1e-2:g} T"
        problems.note(f"gas tables, {name}", f"{values[tuple(wrong[0])]:g} at {at}", f"above 0 and below {most:g}")


def _numbers_of(text: str) -> Floats:
    return np.array([one.upper().replace("D", "E") for one in _NUMBER.findall(text)], np.float64)


class LayerDrift(NamedTuple):
    """Drift through one CGEM layer as the core takes it: electrons start in the drift gap and end on the anode."""

    velocity: float  # mm/ns, in the drift gap
    tan_lorentz: float  # in the drift gap, positive towards larger phi
    sigma_x: float  # mm/sqrt(mm), diffusion in the drift gap along phi
    sigma_par: float  # mm/sqrt(mm), along z
    sigma_l: float  # mm/sqrt(mm), along the drift
    shift: float  # rad, azimuth that the transfer and induction gaps add
    delay: float  # ns, from the first foil to the last one
    induction: float  # ns, of the induction gap
    lean: float  # rad, azimuth that the induction gap adds
    first_phi: float  # rad, diffusion of one electron in the first transfer gap along phi
    first_z: float  # mm, along z
    cloud_phi: float  # rad, width of the avalanche of one electron at the anode along phi
    cloud_z: float  # mm, along z


class _Gap(NamedTuple):
    r_in: float  # mm
    r_out: float  # mm
    transport: Transport

    def width_phi(self) -> float:
        """Return the diffusion along phi, rad: the radii at which it arises are averaged."""
        return self.transport.sigma_x * math.sqrt((self.r_out - self.r_in) / (self.r_in * self.r_out))

    def width_z(self) -> float:
        """Return the diffusion along z, mm."""
        return self.transport.sigma_par * math.sqrt(self.r_out - self.r_in)


def layer_drift(layer: CgemLayer, bz: float) -> LayerDrift:
    """Return the drift in a layer.

    In a cylinder the azimuth grows by tan(alpha) ln(r2/r1) over a gap, with the angle at the nominal field. Electrons
    drift outward; in a field along +z they are bent towards larger phi. A `lorentz_shift` of the layer replaces the
    shift from mid-gap to the anode: `shift` changes, the angle in the drift gap stays. A `lorentz_angle` replaces that
    of the drift gap alone.

    Parameters
    ----------
    layer : CgemLayer
    bz : float
        T, signed.

    Raises
    ------
    ValueError
        Listing every field that is outside the tables, or that the gas has no table.
    """
    gas = layer.gas.ionization
    if not gas:
        expected = 'a gas with ionization = "ar-ic4h10-90-10" or "ar-co2-70-30"'
        refuse("electron transport", "gas", f"{layer.gas.name} without a table of electron transport", expected)
    problems = Problems()
    transports = []
    for name in ("drift_field", "transfer_field", "induction_field"):
        try:
            transports.append(transport(gas, getattr(layer, name), bz))
        except ValueError as error:
            problems.take(error, name)
    problems.report("electron transport")
    drift, transfer, induction = transports
    gaps = _gaps_behind(layer, transfer, induction)
    sign = math.copysign(1.0, bz)
    tangent = sign * (drift.tan_lorentz if layer.lorentz_angle is None else math.tan(layer.lorentz_angle))
    shifts = [sign * gap.transport.tan_lorentz * math.log(gap.r_out / gap.r_in) for gap in gaps]
    shift = sum(shifts)
    if layer.lorentz_shift is not None:
        shift = layer.lorentz_shift / layer.r_readout - tangent * math.log(layer.r_gap_out / layer.r_mid)
    return LayerDrift(
        velocity=drift.velocity,
        tan_lorentz=tangent,
        sigma_x=drift.sigma_x,
        sigma_par=drift.sigma_par,
        sigma_l=drift.sigma_l,
        shift=shift,
        delay=sum((gap.r_out - gap.r_in) / gap.transport.velocity for gap in gaps[:-1]),
        induction=layer.induction_gap / induction.velocity,
        lean=shifts[-1],
        first_phi=gaps[0].width_phi(),
        first_z=gaps[0].width_z(),
        cloud_phi=math.sqrt(sum(gap.width_phi() ** 2 for gap in gaps)),
        cloud_z=math.sqrt(sum(gap.width_z() ** 2 for gap in gaps)),
    )


def _gaps_behind(layer: CgemLayer, transfer: Transport, induction: Transport) -> list[_Gap]:
    """Return the gaps behind the first foil, from inside."""
    foil = sum(part.thickness for part in layer.foil)
    radius, gaps = layer.r_gap_out, []
    for _ in range(layer.foils - 1):
        radius += foil
        gaps.append(_Gap(radius, radius + layer.transfer_gap, transfer))
        radius += layer.transfer_gap
    return [*gaps, _Gap(layer.anode_radius - layer.induction_gap, layer.anode_radius, induction)]


@lru_cache(maxsize=64)
def drift_columns(detector: Detector, cgem: tuple[int, ...] | None = None) -> dict[str, Floats]:
    """Return the drift of CGEM layers as columns, each (layers,) float64, see `LayerDrift`.

    Parameters
    ----------
    detector : Detector
    cgem : tuple of int or None
        See `cgem_layers`.

    Raises
    ------
    ValueError
        Listing the problems of all layers.
    """
    problems, drifts = Problems(), []
    for layer in cgem_layers(detector, cgem):
        try:
            drifts.append(layer_drift(layer, detector.field.bz))
        except ValueError as error:
            problems.take(error, f"cgem.{layer.label}")
    problems.report(f"{detector.name}: no electron transport for the readout")
    columns = np.array(drifts, np.float64).reshape(-1, len(LayerDrift._fields)).T
    return dict(zip(LayerDrift._fields, columns.copy(), strict=True))
