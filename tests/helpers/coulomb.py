"""Coulomb scattering worked out anew: single scatters one by one, exact distributions, and Lynch and Dahl's core."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.special import j0

from slabs import ELECTRON

K = 0.307075e-3  # GeV cm2/mol, 4 pi N_A r_e^2 m_e c^2 (PDG 2024)
FINE_STRUCTURE = 1 / 137.035999084
HBAR_C = 0.1973269804  # GeV fm
MASS_LIMIT = 0.01  # GeV, lighter projectiles are electrons


def strength(z):
    """Return chi_c^2 (p beta)^2 per mol/cm2 of an element and of its electrons alone, GeV^2 cm2/mol.

    From Rutherford's cross-section: 4 pi N_A (Z alpha hbar c)^2 = K m_e Z^2, as r_e m_e c^2 = alpha hbar c.
    """
    return K * ELECTRON * z * z, K * ELECTRON * z


def screening_squared(z, beta2, screening, charge=1):
    """Return the squared screening momentum, GeV^2: Moliere's 1.13 + 3.76 (Z z alpha/beta)^2, Thomas-Fermi radius.

    chi_0 p = alpha m_e Z^(1/3)/0.885 (G. Moliere, Z. Naturforsch. 2a (1947) 133; H.A. Bethe, Phys. Rev. 89 (1953)
    1256); "wentzel" multiplies by 1 + exp(-Z^2/1000), hydrogen by 1, as Geant4's G4WentzelOKandVIxSection.
    """
    thomas_fermi = FINE_STRUCTURE * ELECTRON * z ** (1 / 3) / 0.885
    born = 1.13 + 3.76 * (z * charge * FINE_STRUCTURE) ** 2 / beta2
    return thomas_fermi**2 * born * (1 + np.exp(-z * z / 1000) if screening == "wentzel" and z >= 2 else 1)


def recoil(p, mass):
    """Return the largest squared momentum transfer to an electron, GeV^2: 2 m_e W_max."""
    energy = np.hypot(p, mass)
    if mass < MASS_LIMIT:
        return ELECTRON * (energy - mass)  # of two electrons the faster one counts as the projectile
    return 4 * ELECTRON**2 * (p / mass) ** 2 / (1 + 2 * energy / mass * ELECTRON / mass + (ELECTRON / mass) ** 2)


def species(elements, p, mass, screening, charge=1):
    """Return kinds of scatterers as (strength/beta^2 GeV^2, screening GeV^2, nuclear size GeV^-2, limit GeV^2)."""
    beta2 = p * p / (p * p + mass * mass)
    found = []
    for z, a, moles in elements:
        nucleus, electrons = (charge**2 * one for one in strength(z))
        a2 = screening_squared(z, beta2, screening, charge)
        size = (1.27 * a**0.27 / HBAR_C) ** 2 / 12  # Butkevich et al., Nucl. Instrum. Methods A 488 (2002) 282
        found.append((nucleus * moles / beta2, a2, size, 4 * p * p))
        found.append((electrons * moles / beta2, a2, 0.0, min(recoil(p, mass), 4 * p * p)))
    return found


def single_scatters(rng, m, a2, size, limit, p):
    """Return m plane angles (2, m) of single scatters, 0 where a nucleus is too large or a recoil too hard."""
    u = rng.random(m, np.float32)
    q2 = np.float32(a2) * u / (1 - u)
    angle = np.sqrt(q2) / np.float32(p)
    hard = np.flatnonzero(q2 > 1e-3 * min(limit, 1 / size if size else np.inf))
    q2 = q2[hard]
    kept = (rng.random(len(hard)) < (1 + size * q2) ** -4.0) & (q2 < limit)
    angle[hard] = np.where(kept, 2 * np.arcsin(np.minimum(np.sqrt(q2) / (2 * p), 1)), 0)
    azimuth = np.float32(2 * np.pi) * rng.random(m, np.float32)
    return angle * np.cos(azimuth), angle * np.sin(azimuth)


def scattered(elements, p, mass, screening, n, seed=1, chunk=1_000_000):
    """Return plane angles (2, n) of n particles, every single scatter drawn.

    Transfers by inversion of (c/beta^2)/(q^2 + a^2)^2; nuclei beyond their size and electrons beyond their recoil are
    left out again. Angles of a track are added as plane angles.
    """
    rng = np.random.default_rng(seed)
    total = np.zeros((2, n))
    for c, a2, size, limit in species(elements, p, mass, screening):
        per_chunk = max(int(chunk * a2 / c), 1)
        for begin in range(0, n, per_chunk):
            counts = rng.poisson(c / a2, min(per_chunk, n - begin))
            first = np.cumsum(counts) - counts
            for plane, part in enumerate(single_scatters(rng, int(counts.sum()) + 1, a2, size, limit, p)):
                total[plane, begin : begin + len(counts)] += np.add.reduceat(part, first) * (counts > 0)
    return total


def exact_quantiles(elements, p, mass, screening, fractions, charge=1):
    """Return central half widths of the plane angle, rad: no samples, the characteristic function itself.

    Independent scatters of density f(q^2) at random azimuth: ln phi(k) = integral of (J0(k q/p) - 1) f dq^2 for each
    projection; the probability of |angle| < t is (2/pi) integral of phi(k) sin(k t)/k dk. Small angles.
    """
    kinds = species(elements, p, mass, screening, charge)
    width = np.sqrt(sum(c * np.log(c / a2 + 3) for c, a2, _, _ in kinds)) / p
    k = np.linspace(0, 12, 901)[1:] / width
    log_phi = np.zeros_like(k)
    for c, a2, size, limit in kinds:
        log_q2 = np.linspace(np.log(a2 * 1e-4), np.log(limit), 250)
        q2 = np.exp(log_q2)
        density = c * q2 / (q2 + a2) ** 2 / (1 + size * q2) ** 4
        log_phi += np.trapezoid((j0(np.outer(k, np.sqrt(q2) / p)) - 1) * density, log_q2, axis=1)
    phi, step = np.exp(log_phi), k[0]

    def inside(t):
        return (
            2 / np.pi * step * (0.5 * t + np.sum(phi * np.sin(k * t) / k) - 0.5 * phi[-1] * np.sin(k[-1] * t) / k[-1])
        )

    return np.array(
        [brentq(lambda t, f=f: inside(t) - f, 1e-3 * width, 20 * width, xtol=1e-6 * width) for f in fractions]
    )


def core_angle(parts, p, mass, screening="wentzel", total=None, charge=1):
    """Return the plane angle that the fit takes for parts (matter, thickness mm) of a track that crosses `total`.

    G.R. Lynch and O.I. Dahl, Nucl. Instrum. Methods B 58 (1991) 6, with F = 0.98 and v >> 1:
    chi_c^2/(1 + F^2) [ln(v) - 1], v = chi_c^2/(2 (1 - F) chi_a^2); chi_c of the whole track in v, and electrons no
    further than their recoil.
    """
    beta2 = p * p / (p * p + mass * mass)

    def all_elements(which):
        return [row for matter, thickness in which for row in matter.moles(thickness)]

    whole = charge**2 * sum(sum(strength(z)) * moles for z, _, moles in all_elements(total or parts))
    end = whole / beta2 / (2 * (1 - 0.98))
    variance = 0.0
    for z, _, moles in all_elements(parts):
        nucleus, electrons = (charge**2 * one for one in strength(z))
        a2 = screening_squared(z, beta2, screening, charge)
        variance += moles * nucleus * (np.log(end / a2) - 1)
        variance += moles * electrons * (np.log(min(end, recoil(p, mass)) / a2) - 1)
    return np.sqrt(variance / (1 + 0.98**2) / beta2) / p
