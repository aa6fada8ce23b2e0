"""The quantities whose resolutions a scan quotes: those of sweeps, and the relative ones."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cgemit.fit import FitStatus
from cgemit.statistics.estimate import FEWEST, Floats, Resolution, measure
from cgemit.study.sweeps.evaluate import QUANTITIES as OF_SWEEPS
from cgemit.study.sweeps.evaluate import residuals
from cgemit.tables import Table

#: Unit of each quantity, and what stands on the axis of its resolution. `p_rel` and `pt_rel` are sigma(p)/p and
#: sigma(pT)/pT.
QUANTITIES: Mapping[str, tuple[str, str]] = {
    "dr": (OF_SWEEPS["dr"][0], "σ(d_ρ)"),
    "dz": (OF_SWEEPS["dz"][0], "σ(d_z)"),
    "p": (OF_SWEEPS["p"][0], "σ(p)"),
    "pt": (OF_SWEEPS["pt"][0], "σ(p_T)"),
    "p_rel": ("%", "σ(p)/p"),
    "pt_rel": ("%", "σ(p_T)/p_T"),
    "phi0": (OF_SWEEPS["phi0"][0], "σ(φ₀)"),
    "theta": (OF_SWEEPS["theta"][0], "σ(θ)"),
    "tanl": (OF_SWEEPS["tanl"][0], "σ(tan λ)"),
}


def column(kind: str, quantity: str, end: str = "") -> str:
    """Return the header of a column, such as ``sigma_p (MeV/c)``, or ``sigma_p_error (MeV/c)`` with an end."""
    return f"{kind}_{quantity}{end} ({QUANTITIES[quantity][0]})"


def sample_of(tracks: Table, quantity: str) -> Floats:
    """Return fitted minus true values of a quantity of the fitted tracks, (n,) float64 in its unit."""
    good = tracks["status"] == FitStatus.ok
    if quantity in OF_SWEEPS:
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
    scale = OF_SWEEPS[quantity][1] if quantity in OF_SWEEPS else 1.0
    return float(scale * np.median(errors))
