"""The quantities whose resolutions are quoted: units, axis labels, residuals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from cgemit.analysis.widths import FEWEST, Floats, Resolution, measure
from cgemit.reconstruction.fit import FitStatus
from cgemit.tables import Table

#: Unit in which each resolution is quoted, and how many of them make the native unit.
SCALES = {
    "p": ("MeV/c", 1000.0),
    "pt": ("MeV/c", 1000.0),
    "dr": ("um", 1000.0),
    "dz": ("mm", 1.0),
    "phi0": ("mrad", 1000.0),
    "theta": ("mrad", 1000.0),
    "tanl": ("1e-3", 1000.0),
}


#: Parts of a sample that are left out in turn; the spread of what is left gives the error of a difference.
GROUPS = 20


def header(name: str, quantity: str) -> str:
    """Return the header of a column, such as ``sigma_p (MeV/c)``."""
    return f"{name} ({SCALES[quantity][0]})"


def residuals(tracks: Table, good: Any) -> dict[str, Floats]:
    """Return fitted minus true values of each of `QUANTITIES`, (n,) in quoted units, of the chosen tracks."""
    pt = 1 / np.abs(tracks["kappa"][good]) - 1 / np.abs(tracks["truth_kappa"][good])
    theta = np.arctan2(1, tracks["tanl"][good]) - np.arctan2(1, tracks["truth_tanl"][good])
    found = {name: tracks[f"res_{name}"][good] for name in SCALES if name not in ("pt", "theta")}
    return {name: scale * (found | {"pt": pt, "theta": theta})[name] for name, (_, scale) in SCALES.items()}


def error_of_difference(one: list[float], other: list[float]) -> float:
    """Return the error of a difference of two widths of the same events, from both without each group (jackknife).

    B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans (1982), ch. 3.
    """
    difference = np.array(one) - np.array(other)
    spread = float(np.sum((difference - difference.mean()) ** 2))
    return math.sqrt((GROUPS - 1) / GROUPS * spread)


#: Unit of each quantity, and what stands on the axis of its resolution. `p_rel` and `pt_rel` are sigma(p)/p and
#: sigma(pT)/pT.
QUANTITIES: Mapping[str, tuple[str, str]] = {
    "dr": (SCALES["dr"][0], "σ(d_ρ)"),
    "dz": (SCALES["dz"][0], "σ(d_z)"),
    "p": (SCALES["p"][0], "σ(p)"),
    "pt": (SCALES["pt"][0], "σ(p_T)"),
    "p_rel": ("%", "σ(p)/p"),
    "pt_rel": ("%", "σ(p_T)/p_T"),
    "phi0": (SCALES["phi0"][0], "σ(φ₀)"),
    "theta": (SCALES["theta"][0], "σ(θ)"),
    "tanl": (SCALES["tanl"][0], "σ(tan λ)"),
}


def column(kind: str, quantity: str, end: str = "") -> str:
    """Return the header of a column, such as ``sigma_p (MeV/c)``, or ``sigma_p_error (MeV/c)`` with an end."""
    return f"{kind}_{quantity}{end} ({QUANTITIES[quantity][0]})"


def sample_of(tracks: Table, quantity: str) -> Floats:
    """Return fitted minus true values of a quantity of the fitted tracks, (n,) float64 in its unit."""
    good = tracks["status"] == FitStatus.ok
    if quantity in SCALES:
        return residuals(tracks, good)[quantity]
    if quantity == "p_rel":
        return np.asarray(100 * tracks["res_p"][good] / tracks["truth_p"][good])
    return np.asarray(100 * (np.abs(tracks["truth_kappa"][good] / tracks["kappa"][good]) - 1))


def width(tracks: Table, quantity: str) -> Resolution:
    """Return the widths of the residuals of a quantity, in its unit."""
    sample = sample_of(tracks, quantity)
    return measure(sample[np.isfinite(sample)], parameter=quantity, unit=QUANTITIES[quantity][0])


def median_error(tracks: Table, quantity: str) -> float:
    """Return the median of the fit's own errors of a quantity, in its unit; NaN for fewer than 10 tracks.

    It scatters much less than the core width, but it is right only where the pulls have the width 1.
    """
    good = tracks["status"] == FitStatus.ok
    if np.count_nonzero(good) < FEWEST:
        return float("nan")
    kappa, err_kappa = np.abs(tracks["kappa"][good]), tracks["err_kappa"][good]
    made = {
        "pt": lambda: err_kappa / kappa**2,
        "pt_rel": lambda: 100 * err_kappa / kappa,
        "p_rel": lambda: 100 * tracks["err_p"][good] / tracks["p"][good],
        "theta": lambda: tracks["err_tanl"][good] / (1 + tracks["tanl"][good] ** 2),
    }
    errors = made[quantity]() if quantity in made else tracks[f"err_{quantity}"][good]
    scale = SCALES[quantity][1] if quantity in SCALES else 1.0
    return float(scale * np.median(errors))
