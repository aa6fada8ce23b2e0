"""Clusters of fired strips, and their errors from geometry (docs/methods/cluster.md)."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.settings import Check, Positive, SettingsData
from cgemit.detector import Detector, compiled, load
from cgemit.detector.core import cgem_table, strip_lists
from cgemit.helix import RADIUS_PER_KAPPA
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

MAX_SIZE = 64
"""Cluster sizes in the table of errors; larger clusters have the error of this size."""

Position = Literal["centre", "charge"]
Fraction = Annotated[float, Check(lambda value: 0 < value < 1, "a number between 0 and 1")]

Bridge = Annotated[int, Check(lambda value: 0 <= value <= 10, "a whole number from 0 to 10")]

_POINTS = 2000  # of the reference sample in cos(theta); ten times as many move no error by more than 0.2 %


@dataclass(frozen=True, kw_only=True)
class ClusterSettings(SettingsData):
    """Position of clusters, and the reference sample of tracks from the origin that gives their errors.

    Attributes
    ----------
    position : str
        ``"centre"``: geometric centre of the fired strips, for a binary read-out. ``"charge"``: mean of the strip
        centres weighted by charge, for a read-out whose charges measure the position.
    bridge : int
        Dead and hot strips in a row that a cluster may bridge; the error of its position grows.
    reference_p : float
        GeV/c.
    reference_cos_theta : float
        The sample covers cos(theta) from minus to plus this, uniformly.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    position: Position = "centre"
    bridge: Bridge = 1
    reference_p: Positive = 1.0
    reference_cos_theta: Fraction = 0.93


def cluster(
    detector: Detector | str | Mapping[str, Any], digis: Table, settings: ClusterSettings | None = None
) -> Table:
    """Join neighbouring strips to X and V clusters, and intersecting X and V clusters to XV clusters.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
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
    detector, settings = load(detector), settings or ClusterSettings()
    err_x, err_v = cluster_errors(detector, settings)
    by_charge = settings.position == "charge"
    found = _core.find_clusters(
        compiled(detector), dict(digis.columns), err_x=err_x, err_v=err_v, by_charge=by_charge,
        masked=strip_lists(detector).masked, bridge=settings.bridge,
    )  # fmt: skip
    return Table("clusters", found, **digis.cover)


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
        err_x[i] = _core.size_errors(width_x, layer["pitch_x"], MAX_SIZE)
        err_v[i] = _core.size_errors(width_v, layer["pitch_v"], MAX_SIZE)
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
