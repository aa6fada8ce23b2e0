"""The paper's X residual by window, beside Geant4 (src/cgemit/analysis/geant4_x_residual.toml)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import cgemit as cg
from cgemit.analysis.clusters import X_WINDOWS, ClusterResiduals, cluster_residuals, x_beyond, x_widths
from cgemit.chain.settings import Settings
from cgemit.simulation.transport import SimulateSettings
from cgemit.study.paper import COS_THETA
from cgemit.study.samples import seed_of

DETECTOR = "besiii-cgem-design"
_BATCH = 20_000


@dataclass(frozen=True)
class Number:
    """A number of the X residual with its standard error.

    Attributes
    ----------
    deltas : bool
        Whether delta electrons were simulated.
    quantity : str
        Key of `X_WINDOWS` (RMS within this window, um), "beyond_3mm" or "single_strip" (fractions).
    value, error : float
    """

    deltas: bool
    quantity: str
    value: float
    error: float


def measure(events: int, seed: int, *, deltas: bool) -> list[Number]:
    """Return the numbers of mu- of 1 GeV/c at the angles of the paper."""
    settings = Settings(simulate=SimulateSettings(deltas=deltas))
    gun = cg.Gun("mu-", p=1.0, cos_theta=COS_THETA)
    parts = []
    for batch, first in enumerate(range(0, events, _BATCH)):
        count = min(_BATCH, events - first)
        parts.append(cluster_residuals(cg.run(DETECTOR, gun, count, seed_of(seed, batch), settings=settings)))
    residuals = _joined(parts)
    widths = {name: x_widths(residuals, window) for name, window in X_WINDOWS.items()}
    pairs = {name: (found.rms, found.rms_error) for name, found in widths.items()}
    pairs |= {"beyond_3mm": x_beyond(residuals, 3.0), "single_strip": residuals.single_strip_fraction}
    return [Number(deltas, name, float(value), float(error)) for name, (value, error) in pairs.items()]


def _joined(parts: Sequence[ClusterResiduals]) -> ClusterResiduals:
    columns = [np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "x_size", "v", "v_size")]
    return ClusterResiduals(*columns, sum(part.without_truth for part in parts), sum(part.beside for part in parts))
