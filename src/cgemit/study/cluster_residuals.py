"""Residuals of X and V clusters against the true crossing, on the unrolled anode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cgemit.detector.strip_plane import local_v

if TYPE_CHECKING:
    from cgemit.detector import Detector
    from cgemit.result import Result
    from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True)
class ClusterResiduals:
    """Measured minus true position of every cluster of one view and the number of its strips.

    Attributes
    ----------
    x : (n,) float64, mm
        R_readout times the difference in azimuth at mid-gap.
    x_size : (n,) int32
    v : (m,) float64, mm
        V of the cluster minus V of the crossing's phi and z at mid-gap.
    v_size : (m,) int32
    without_truth : int
        Clusters left out since no true crossing belongs to them.
    """

    x: Floats
    x_size: Ints
    v: Floats
    v_size: Ints
    without_truth: int

    @property
    def single_strip_fraction(self) -> tuple[float, float]:
        """Fraction of X clusters with one strip, and its binomial error."""
        n = len(self.x_size)
        share = float(np.mean(self.x_size == 1)) if n else float("nan")
        return share, float(np.sqrt(share * (1 - share) / n)) if n else float("nan")


def cluster_residuals(result: Result) -> ClusterResiduals:
    """Return the residuals of the X and V clusters of a result.

    Parameters
    ----------
    result : Result

    Returns
    -------
    ClusterResiduals
        Empty arrays for a detector without CGEM layers.
    """
    clusters, truths, detector = result.clusters, result.truths, result.detector
    known = clusters["truth"] >= 0
    x_rows = np.flatnonzero((clusters["view"] == 0) & known)
    v_rows = np.flatnonzero((clusters["view"] == 1) & known)
    return ClusterResiduals(
        _x_residuals(detector, clusters, truths, x_rows),
        clusters["size"][x_rows],
        _v_residuals(detector, clusters, truths, v_rows),
        clusters["size"][v_rows],
        int(np.count_nonzero((clusters["view"] < 2) & ~known)),
    )


def _x_residuals(detector: Detector, clusters: Table, truths: Table, rows: npt.NDArray[np.intp]) -> Floats:
    radius = np.array([layer.r_readout for layer in detector.cgem])
    dphi = clusters["phi"][rows] - truths["phi"][clusters["truth"][rows]]
    dphi = (dphi + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(radius[clusters["layer"][rows]] * dphi) if len(rows) else np.empty(0)


def _v_residuals(detector: Detector, clusters: Table, truths: Table, rows: npt.NDArray[np.intp]) -> Floats:
    residual = np.empty(len(rows))
    truth = clusters["truth"][rows]
    for number, layer in enumerate(detector.cgem):
        for sheet, start in enumerate(layer.sheet_phi):
            mine = (clusters["layer"][rows] == number) & (clusters["sheet"][rows] == sheet)
            x = layer.r_readout * (truths["phi"][truth[mine]] - start)
            # A whole turn changes V by hundreds of mm: the nearest turn is the right one.
            turn = 2 * np.pi * layer.r_readout * np.cos(layer.stereo)
            difference = clusters["v"][rows[mine]] - local_v(layer, x, truths["z"][truth[mine]])
            residual[mine] = difference - turn * np.round(difference / turn)
    return residual
