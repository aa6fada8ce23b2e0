"""Detectors of a few slabs of known matter, and the passage of particles through matter written out by hand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cgemit import _core

ELECTRON, MUON, PION, PROTON = 0.51099895e-3, 0.1056583755, 0.13957039, 0.93827208816  # GeV


class Matter(NamedTuple):
    """A material of the PDG's tables of atomic and nuclear properties."""

    z_over_a: float  # mol/g
    density: float  # g/cm3
    excitation: float  # eV
    x0: float  # g/cm2
    density_effect: tuple[float, float, float, float, float]  # Cbar, x0, x1, a, k
    minimum: float  # MeV cm2/g, minimum ionisation


BERYLLIUM = Matter(4 / 9.0121831, 1.848, 63.7, 65.19, (2.7847, 0.0592, 1.6922, 0.80392, 2.4339), 1.595)
COPPER = Matter(29 / 63.546, 8.960, 322.0, 12.86, (4.4190, -0.0254, 3.2792, 0.14339, 2.9044), 1.403)
KAPTON = Matter(0.51264, 1.420, 79.6, 40.58, (3.3497, 0.1509, 2.5631, 0.15971, 3.1921), 1.820)


def delta(matter, betagamma):
    """Return the density effect, Sternheimer's form (PDG 2024, eq. 34.7)."""
    c, x0, x1, a, k = matter.density_effect
    x = np.log10(betagamma)
    middle = 2 * np.log(10) * x - c + np.where(x < x1, a * np.abs(x1 - x) ** k, 0.0)
    return np.where(x < x0, 0.0, middle)


def bethe(matter, thickness, p, mass, cut=np.inf):
    """Return the mean loss in a thickness (mm) by collisions below a cut, xi and W_max, GeV (eqs. 34.5, 34.11)."""
    energy = np.hypot(p, mass)
    beta2, gamma = (p / energy) ** 2, energy / mass
    ratio = ELECTRON / mass
    w_max = 2 * ELECTRON * beta2 * gamma**2 / (1 + 2 * gamma * ratio + ratio**2)
    xi = 0.5 * 0.307075e-3 * matter.z_over_a * matter.density * 0.1 * thickness / beta2
    upper = np.minimum(cut, w_max)
    logarithm = np.log(2 * ELECTRON * beta2 * gamma**2 * upper / (matter.excitation * 1e-9) ** 2)
    return xi * (logarithm - beta2 * (1 + upper / w_max) - delta(matter, p / mass)), xi, w_max


def highland(x, p, mass):
    """Return the plane angle behind x radiation lengths, PDG 2024, eq. 34.16."""
    beta = p / np.hypot(p, mass)
    return 13.6e-3 / (beta * p) * np.sqrt(x) * (1 + 0.038 * np.log(x / beta**2))


def slab_detector(parts, bz=0.0, gap_radius=None, half_length=1e4):
    """Return a compiled detector of slabs: (matter, thickness mm, radius mm), from inside; no wires.

    With `gap_radius` a drift gap there, where nothing scatters and half a keV is lost, records the particles.
    """
    grid = np.exp(_core.LOSS_GRID_FIRST + _core.LOSS_GRID_STEP * np.arange(_core.LOSS_POINTS))
    rows, terms = [], []
    for matter, thickness, radius in parts:
        x0 = thickness * 0.1 * matter.density / matter.x0
        xi = 0.5 * 0.307075e-3 * matter.z_over_a * matter.density * 0.1 * thickness
        ends = radius - thickness / 2, radius + thickness / 2
        rows.append((*ends, radius, thickness / np.sqrt(12), half_length, x0, xi, -1))
        terms.append(-2 * np.log(matter.excitation * 1e-9) - delta(matter, grid))
    n_gaps = 0 if gap_radius is None else 1
    if gap_radius is not None:
        rows.append((gap_radius - 2.5, gap_radius + 2.5, gap_radius, 1.0, half_length, 1e-15, 3e-8, 0))
        terms.append(np.full(len(grid), 31.0))
    names = ("r_in", "r_out", "radius", "spread", "half_length", "x0", "xi", "gap")
    columns = dict(zip(names, np.array(rows).T.copy(), strict=True))
    columns |= {"gap": columns["gap"].astype(np.int32), "ends": np.zeros(len(rows), np.uint8)}
    layer = {"r_gap_in": -2.5, "r_gap_out": 2.5, "r_readout": 9.0, "half_length": half_length, "pitch_x": 0.65,
             "pitch_v": 0.65, "stereo": 0.8}  # fmt: skip
    cgem = {k: np.full(n_gaps, v + (gap_radius or 0) * k.startswith("r_")) for k, v in layer.items()}
    cgem |= {k: np.full(n_gaps, v, np.int32) for k, v in (("sheets", 1), ("strips_x", 800), ("strips_v", 900))}
    cgem |= {"gid_first": np.zeros(n_gaps, np.int32), "phi_first": np.zeros((n_gaps, 2))}
    real = ("r_end", "half_length", "twist", "phi_east", "sigma", "sigma_slope", "efficiency")
    wires = {k: np.zeros(0) for k in real} | {k: np.zeros(0, np.int32) for k in ("number", "cells", "gid_first")}
    return _core.Detector(bz=bz, slabs=columns, log_terms=np.array(terms), cgem=cgem, wires=wires)
