"""The tracks of a grid of points, and their covariances from the core."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.detector import Detector
from cgemit.fit import FitSettings, compiled_for_fit
from cgemit.helix import PARAMETERS

Floats = npt.NDArray[np.float64]

#: What has a resolution, with its unit.
QUANTITIES = {
    "dr": "mm",
    "phi0": "rad",
    "kappa": "1/(GeV/c)",
    "dz": "mm",
    "tanl": "",
    "theta": "rad",
    "p": "GeV/c",
    "pt": "GeV/c",
}

_CHUNK = 4096  # tracks of one task

#: Places of the core's 15 entries in a covariance.
UPPER = np.triu_indices(5)
_DIAGONAL = np.equal(*UPPER)


@dataclass(frozen=True, eq=False)
class Tracks:
    """The tracks of all points and samples, and how their covariances are computed."""

    detector: Detector
    fit: FitSettings
    model: _core.HitModel
    phi: Floats  # azimuth of the momentum at the origin; this and the following (tracks,)
    kappa: Floats
    tanl: Floats
    mass: Floats
    scatters: Floats  # 1 for trajectories that scatter, with the angles of their sample; 0 for the expected trajectory
    samples: int
    phases: Floats
    threads: int | None

    def run(
        self, budget: bool, variants: Sequence[_core.Detector] = (), hits: bool = False
    ) -> dict[str, npt.NDArray[Any]]:
        """Return the columns of the core, computed in chunks on all cores; those of variants as the first axis.

        Parameters
        ----------
        budget : bool
            Whether to return the sums of the budget's terms.
        variants : sequence of _core.Detector
            Detectors that get the hits of the first; then every column has a first axis of 1 + their number.
        hits : bool
            Whether to return the expected hits of all tracks, without variants: ``hit_kind``, ``hit_layer``,
            ``hit_channel``, ``hit_value`` (mm) and ``hit_variance`` (mm2), ordered by track.
        """
        core = compiled_for_fit(self.detector, self.fit)
        n = len(self.phi)
        step = max(1, _CHUNK // self.samples) * self.samples

        def part(first: int) -> dict[str, npt.NDArray[Any]]:
            rows = slice(first, min(first + step, n))
            found: dict[str, Any] = _core.covariances(
                core, phi=self.phi[rows], kappa=self.kappa[rows], tanl=self.tanl[rows], mass=self.mass[rows],
                scatters=self.scatters[rows],
                samples=self.samples, phases=self.phases, model=self.model, budget=budget, hits=hits,
                variants=list(variants),
            )  # fmt: skip
            if hits:
                found |= {f"hit_{name}": column for name, column in found.pop("hits").items()}
            if not variants:
                return found
            return {name: column.reshape(1 + len(variants), -1, *column.shape[1:]) for name, column in found.items()}

        starts = range(0, n, step)
        if len(starts) == 1:
            return part(0)
        with ThreadPoolExecutor(self.threads or os.cpu_count()) as pool:
            parts = list(pool.map(part, starts))
        axis = 1 if variants else 0
        return {name: np.concatenate([one[name] for one in parts], axis=axis) for name in parts[0]}

    def gradients(self, quantity: str) -> Floats:
        """Return the derivatives of a quantity by (dr, phi0, kappa, dz, tanl), (tracks, 5)."""
        return gradients(self.kappa, self.tanl, quantity)


def gradients(kappa: Floats, tanl: Floats, quantity: str) -> Floats:
    """Return the derivatives of a quantity of tracks by (dr, phi0, kappa, dz, tanl), (tracks, 5)."""
    rows = np.zeros((len(kappa), 5))
    square = 1 + tanl * tanl
    pt = 1 / np.abs(kappa)
    if quantity in PARAMETERS:
        rows[:, PARAMETERS.index(quantity)] = 1
    elif quantity == "theta":
        rows[:, 4] = -1 / square
    elif quantity == "pt":
        rows[:, 2] = -pt / kappa
    elif quantity == "p":
        p = pt * np.sqrt(square)
        rows[:, 2], rows[:, 4] = -p / kappa, p * tanl / square
    else:
        raise ValueError(f"quantity: got {quantity!r}; expected one of {', '.join(QUANTITIES)}")
    return rows


def variances(entries: Floats, kappa: Floats, tanl: Floats, quantity: str) -> Floats:
    """Return the variance of a quantity for each covariance.

    Parameters
    ----------
    entries : ndarray, (..., tracks, 15) float64
        Upper triangles of covariances of (dr, phi0, kappa, dz, tanl); further axes are those of detectors.
    kappa, tanl : ndarray, (tracks,) float64, (GeV/c)^-1 and 1
    quantity : str

    Returns
    -------
    ndarray, (..., tracks) float64
    """
    if quantity in PARAMETERS:
        return entries[..., int(np.flatnonzero(_DIAGONAL)[PARAMETERS.index(quantity)])].copy()
    weights = gradients(kappa, tanl, quantity)
    used = np.any(weights != 0, axis=0)  # one to three of the five parameters
    found = np.zeros(entries.shape[:-1])
    for entry, (i, j) in enumerate(zip(*UPPER, strict=True)):
        if used[i] and used[j]:  # entries beside the diagonal stand for two
            found += (1 if i == j else 2) * weights[:, i] * weights[:, j] * entries[..., entry]
    return found
