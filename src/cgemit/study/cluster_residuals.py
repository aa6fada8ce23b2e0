"""Residuals of X and V clusters against the true crossing, on the unrolled anode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cgemit import find

if TYPE_CHECKING:
    from cgemit.result import Result

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True)
class ClusterResiduals:
    """Measured minus true position of the cluster of each crossing and view, and the number of its strips.

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
    beside : int
        Clusters left out since the crossing has one that is nearer to it: those of delta electrons away from the
        track, and those on the other side of a seam.
    """

    x: Floats
    x_size: Ints
    v: Floats
    v_size: Ints
    without_truth: int
    beside: int

    @property
    def single_strip_fraction(self) -> tuple[float, float]:
        """Fraction of X clusters with one strip, and its binomial error."""
        n = len(self.x_size)
        share = float(np.mean(self.x_size == 1)) if n else float("nan")
        return share, float(np.sqrt(share * (1 - share) / n)) if n else float("nan")


def cluster_residuals(result: Result) -> ClusterResiduals:
    """Return the residuals of the clusters that the fit gets (`cgemit.find.own_clusters`).

    Parameters
    ----------
    result : Result

    Returns
    -------
    ClusterResiduals
        Empty arrays for a detector without CGEM layers.
    """
    clusters, truths, detector = result.clusters, result.truths, result.detector
    own = find.own_clusters(detector, clusters, truths)
    residual, size, view = find.residuals(detector, clusters, truths, own), clusters["size"][own], clusters["view"][own]
    in_view = clusters["view"] < 2
    without_truth = int(np.count_nonzero(in_view & (clusters["truth"] < 0)))
    return ClusterResiduals(
        residual[view == 0],
        size[view == 0],
        residual[view == 1],
        size[view == 1],
        without_truth,
        int(np.count_nonzero(in_view)) - without_truth - len(own),
    )
