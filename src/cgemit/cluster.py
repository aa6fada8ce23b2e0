"""Clusters of fired strips, and their errors from the geometry (docs/methods/cluster.md)."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.slabs import cgem_table
from cgemit.helix import RADIUS_PER_KAPPA
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

MAX_SIZE = 64
"""Cluster sizes in the table of errors; larger clusters have the error of a size that the reference never makes."""

RARE = 1e-3
"""Sizes that fewer clusters of the reference have count as never made: what else makes them decides their error."""

_POINTS = 2000  # of the reference sample in cos(theta); ten times as many move no error by more than 0.2 %


@dataclass(frozen=True, kw_only=True)
class ClusterSettings:
    """Reference sample from which cluster errors follow: tracks from the origin, uniform in cos(theta).

    Attributes
    ----------
    reference_p : float
        GeV/c.
    reference_cos_theta : float
        The sample covers cos(theta) from minus to plus this.

    Raises
    ------
    ValueError
        Listing every value that makes no sense.
    """

    reference_p: float = 1.0
    reference_cos_theta: float = 0.93

    def __post_init__(self) -> None:
        problems = []
        if not (math.isfinite(self.reference_p) and self.reference_p > 0):
            problems.append(f"reference_p: got {self.reference_p!r}, expected a positive number")
        if not 0 < self.reference_cos_theta < 1:
            problems.append(f"reference_cos_theta: got {self.reference_cos_theta!r}, expected between 0 and 1")
        if problems:
            raise ValueError("ClusterSettings:\n  " + "\n  ".join(problems))


def cluster(detector: Detector, digis: Table, settings: ClusterSettings | None = None) -> Table:
    """Join neighbouring strips to X and V clusters, and intersecting X and V clusters to XV clusters.

    Parameters
    ----------
    detector : Detector
    digis : Table
        Of kind ``digis``.
    settings : ClusterSettings or None

    Returns
    -------
    Table
        Of kind ``clusters``; within an event by layer and sheet, there X, V and XV clusters.

    Raises
    ------
    ValueError
        If a strip is not in the detector.
    """
    err_x, err_v = cluster_errors(detector, settings or ClusterSettings())
    found = _core.find_clusters(compiled(detector), dict(digis.columns), err_x=err_x, err_v=err_v)
    return Table("clusters", found, digis.n_events, digis.first_event)


@functools.lru_cache(maxsize=32)
def cluster_errors(detector: Detector, settings: ClusterSettings) -> tuple[Floats, Floats]:
    """Return the position errors of clusters by layer and number of strips.

    Parameters
    ----------
    detector : Detector
    settings : ClusterSettings

    Returns
    -------
    err_x, err_v : ndarray, (layers, MAX_SIZE) float64, mm
        Column n - 1 holds for n strips, the last one for all larger clusters, too.
    """
    return error_table(cgem_table(detector.cgem), detector.field.bz, settings)


def error_table(cgem: dict[str, Any], bz: float, settings: ClusterSettings) -> tuple[Floats, Floats]:
    """Return the errors of `cluster_errors` for CGEM layers given as columns.

    Parameters
    ----------
    cgem : dict of str to ndarray
        Columns of `cgem_table`.
    bz : float
        T, of either sign.
    settings : ClusterSettings

    Returns
    -------
    err_x, err_v : ndarray, (layers, MAX_SIZE) float64, mm
    """
    layers = len(cgem["r_readout"])
    err_x, err_v = np.empty((layers, MAX_SIZE)), np.empty((layers, MAX_SIZE))
    for i in range(layers):
        layer = {name: column[i] for name, column in cgem.items()}
        width_x, width_v = reference_widths(layer, bz, settings)
        err_x[i] = size_errors(width_x, layer["pitch_x"])
        err_v[i] = size_errors(width_v, layer["pitch_v"])
    for table in (err_x, err_v):
        table.flags.writeable = False
    return err_x, err_v


def reference_widths(layer: dict[str, Any], bz: float, settings: ClusterSettings) -> tuple[Floats, Floats]:
    """Return how far tracks of the reference sample extend across the strips of a layer.

    A helix from the origin of radius R has turned by asin(r/2R) in azimuth at radius r.

    Parameters
    ----------
    layer : dict of str to float
        One row of `cgem_table`.
    bz : float
        T.
    settings : ClusterSettings

    Returns
    -------
    width_x, width_v : ndarray, (n,) float64, mm
        Of the tracks of the sample that cross the gap inside the active length.
    """
    limit = settings.reference_cos_theta
    cos_theta = (np.arange(_POINTS) + 0.5) / _POINTS * 2 * limit - limit
    sin_theta = np.sqrt(1 - cos_theta**2)
    curvature = 0.5 * abs(bz) / (RADIUS_PER_KAPPA * settings.reference_p * sin_theta)  # 1/2R, 1/mm
    radii = np.array([layer["r_gap_in"], 0.5 * (layer["r_gap_in"] + layer["r_gap_out"]), layer["r_gap_out"]])
    reach = radii[:, None] * curvature
    crosses = reach[2] < 1
    turned = np.arcsin(np.minimum(reach, 1))
    # Transverse path from the origin; r itself for a straight track.
    path = np.divide(turned, curvature, out=np.broadcast_to(radii[:, None], turned.shape).copy(), where=curvature > 0)
    z = path * cos_theta / sin_theta
    crosses &= np.abs(z[1]) <= layer["half_length"]
    dx = layer["r_readout"] * (turned[2] - turned[0])
    dv = dx * np.cos(layer["stereo"]) - (z[2] - z[0]) * np.sin(layer["stereo"])
    return dx[crosses], np.abs(dv[crosses])


def size_errors(widths: Floats, pitch: float) -> Floats:
    """Return the RMS of the position error by number of fired strips.

    A segment that extends over w fires n strips if its centre lies in an interval of length
    min(n p - w, w - (n - 2) p) about the centre of these strips, p being the pitch. With the position uniform
    against the strips the error is uniform in that interval: RMS length/sqrt(12).

    Parameters
    ----------
    widths : ndarray, (k,) float64, mm
        Extents of a sample of segments, equally weighted.
    pitch : float
        mm.

    Returns
    -------
    ndarray, (MAX_SIZE,) float64, mm
        ``pitch/sqrt(12)``, the largest possible, for sizes that the sample never or hardly (`RARE`) makes, and in the
        last entry.
    """
    errors = np.full(MAX_SIZE, pitch / np.sqrt(12))
    largest = min(MAX_SIZE - 1, int(np.max(widths, initial=0.0) / pitch) + 2)
    n = np.arange(1, largest + 1)[:, None]
    length = np.maximum(np.minimum(n * pitch - widths, widths - (n - 2) * pitch), 0.0)
    often = length.sum(axis=1)
    made = np.flatnonzero(often > RARE * pitch * len(widths))
    errors[made] = np.sqrt((length[made] ** 3).sum(axis=1) / often[made] / 12)
    return errors
