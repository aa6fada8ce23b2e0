"""Detectors of a few slabs of known matter, and the passage of particles through matter written out by hand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

import gem_toy
from cgemit import _core

ELECTRON, MUON, PION, KAON, PROTON = 0.51099895e-3, 0.1056583755, 0.13957039, 0.493677, 0.93827208816  # GeV
ALPHA = 3.7273794118


class Matter(NamedTuple):
    """A material of the PDG's tables of atomic and nuclear properties."""

    z_over_a: float  # mol/g
    density: float  # g/cm3
    excitation: float  # eV
    x0: float  # g/cm2
    density_effect: tuple[float, float, float, float, float]  # Cbar, x0, x1, a, k
    minimum: float  # MeV cm2/g, minimum ionisation
    elements: tuple[tuple[float, float, float], ...]  # Z, A (g/mol), mass fraction

    def moles(self, thickness):
        """Return Z, A and mol/cm2 of each element of a thickness in mm."""
        return [(z, a, part / a * self.density * 0.1 * thickness) for z, a, part in self.elements]

    def xi(self, thickness):
        """Return Landau's xi times beta^2, GeV, of a thickness in mm."""
        return 0.5 * 0.307075e-3 * self.z_over_a * self.density * 0.1 * thickness


BERYLLIUM = Matter(
    4 / 9.0121831, 1.848, 63.7, 65.19, (2.7847, 0.0592, 1.6922, 0.80392, 2.4339), 1.595, ((4, 9.0122, 1),)
)
CARBON = Matter(6 / 12.011, 2.0, 78.0, 42.70, (2.9925, -0.0351, 2.4860, 0.20240, 3.0036), 1.742, ((6, 12.011, 1),))
COPPER = Matter(29 / 63.546, 8.960, 322.0, 12.86, (4.4190, -0.0254, 3.2792, 0.14339, 2.9044), 1.403, ((29, 63.546, 1),))
ARGON = Matter(18 / 39.95, 1.662e-3, 188.0, 19.55, (11.948, 1.7635, 4.4855, 0.19714, 2.9618), 1.519, ((18, 39.95, 1),))
KAPTON = Matter(
    0.51264, 1.420, 79.6, 40.58, (3.3497, 0.1509, 2.5631, 0.15971, 3.1921), 1.820,
    ((1, 1.008, 0.026362), (6, 12.011, 0.691133), (7, 14.007, 0.073270), (8, 15.999, 0.209235)),
)  # fmt: skip
WATER = Matter(
    0.55509,
    1.0,
    75.0,
    36.08,
    (3.5017, 0.2400, 2.8004, 0.09116, 3.4773),
    1.992,
    ((1, 1.008, 0.1119), (8, 15.999, 0.8881)),
)
# Helium and propane, 60 to 40 by volume; of its density effect nothing is asked.
HELIUM_PROPANE = Matter(
    0.564, 8.5144e-4, 50.0, 47.3, (10.2, 2.0, 4.0, 0.13, 3.5), 2.1,
    ((2, 4.0026, 0.1173), (6, 12.011, 0.7210), (1, 1.008, 0.1617)),
)  # fmt: skip


def delta(matter, betagamma):
    """Return the density effect, Sternheimer's form (PDG 2024, eq. 34.7)."""
    c, x0, x1, a, k = matter.density_effect
    x = np.log10(betagamma)
    middle = 2 * np.log(10) * x - c + np.where(x < x1, a * np.abs(x1 - x) ** k, 0.0)
    return np.where(x < x0, 0.0, middle)


def bethe(matter, thickness, p, mass, cut=np.inf):
    """Return the mean loss in a thickness (mm) by collisions below a cut, xi and W_max, GeV (eqs. 34.5, 34.11).

    Muons and protons have the term of spin 1/2 (Rossi, High Energy Particles, 1952, section 2.3). No shell correction.
    """
    energy = np.hypot(p, mass)
    beta2, gamma = (p / energy) ** 2, energy / mass
    ratio = ELECTRON / mass
    w_max = 2 * ELECTRON * beta2 * gamma**2 / (1 + 2 * gamma * ratio + ratio**2)
    xi = matter.xi(thickness) / beta2
    upper = np.minimum(cut, w_max)
    spin = 0.0 if mass in (PION, KAON) else 0.25 * (upper / energy) ** 2
    logarithm = np.log(2 * ELECTRON * beta2 * gamma**2 * upper / (matter.excitation * 1e-9) ** 2)
    return xi * (logarithm - beta2 * (1 + upper / w_max) + spin - delta(matter, p / mass)), xi, w_max


def composition(per_slab):
    """Return the composition columns of slabs from lists of (Z, A, mol/cm2)."""
    first = np.cumsum([0, *map(len, per_slab)]).astype(np.int32)
    z, a, moles = np.array([row for rows in per_slab for row in rows], np.float64).reshape(-1, 3).T
    return {"first": first, "z": z.copy(), "a": a.copy(), "moles": moles.copy()}


def slab_detector(parts, bz=0.0, gap_radius=None, half_length=1e4, screening="wentzel", loss="truncated"):
    """Return a compiled detector of slabs: (matter, thickness mm, radius mm), from inside; no wires.

    With `gap_radius` a drift gap there, where nothing scatters and half a keV is lost, records the particles.
    """
    grid = np.exp(
        _core.detector.LOSS_GRID_FIRST + _core.detector.LOSS_GRID_STEP * np.arange(_core.detector.LOSS_POINTS)
    )
    rows, terms, elements = [], [], []
    for matter, thickness, radius in parts:
        x0 = thickness * 0.1 * matter.density / matter.x0
        ends = radius - thickness / 2, radius + thickness / 2
        rows.append((*ends, radius, thickness / np.sqrt(12), -half_length, half_length, x0, matter.xi(thickness), -1))
        terms.append(-2 * np.log(matter.excitation * 1e-9) - delta(matter, grid))
        elements.append(matter.moles(thickness))
    n_gaps = 0 if gap_radius is None else 1
    if gap_radius is not None:
        rows.append((gap_radius - 2.5, gap_radius + 2.5, gap_radius, 1.0, -half_length, half_length, 1e-15, 3e-8, 0))
        terms.append(np.full(len(grid), 31.0))
        elements.append([])
    names = ("r_in", "r_out", "radius", "spread", "z_min", "z_max", "x0", "xi", "gap")
    columns = dict(zip(names, np.array(rows).T.copy(), strict=True))
    columns |= {"gap": columns["gap"].astype(np.int32), "filler": np.zeros(len(rows), np.uint8)}
    layer = {"r_gap_in": -2.5, "r_gap_out": 2.5, "r_readout": 9.0, "z_min": -half_length, "z_max": half_length,
             "pitch_x": 0.65, "pitch_v": 0.65, "stereo": 0.8, "offset_v": 0.0, "dead_seam": 0.0, "dead_ends": 0.0,
             "ladder_gap": 0.0, "ladder_first": 0.0,
             "lorentz_shift": 0.0, "z_scale": 0.0, "slope": 0.0}  # fmt: skip
    cgem = {k: np.full(n_gaps, v + (gap_radius or 0) * k.startswith("r_")) for k, v in layer.items()}
    cgem |= {
        k: np.full(n_gaps, v, np.int32)
        for k, v in (("sheets", 1), ("strips_x", 800), ("strips_v", 900), ("ladders", 0))
    }
    cgem |= {"has_x": np.ones(n_gaps, bool), "has_v": np.ones(n_gaps, bool)}
    cgem |= {"gid_first": np.zeros(n_gaps, np.int32), "phi_first": np.zeros((n_gaps, _core.detector.MOST_SHEETS))}
    cgem |= gem_toy.in_place("placement", n_gaps)
    wires = {name: column[:0] for name, column in gem_toy.wire_layers().items() if not name.startswith("chamber")}
    wires |= gem_toy.in_place("chamber", 1)
    core = _core.detector.Detector(
        bz=bz, slabs=columns, log_terms=np.array(terms), composition=composition(elements), layers=cgem, wires=wires,
        screening=getattr(_core.matter.Screening, screening),
    )  # fmt: skip
    choice = getattr(_core.matter.CoreLoss, loss)
    return core.with_loss(loss=choice, radiation=True, momentum_error=_core.matter.USUAL_MOMENTUM_ERROR)
