"""Clusters of fired strips, and their errors from geometry (docs/methods/cluster.md)."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.detector import Detector, ReadoutGroup, compiled
from cgemit.detector.core import layer_table, strip_lists
from cgemit.detector.parts import cgem_layers
from cgemit.detector.readouts import BinaryReadout
from cgemit.helix import path_to
from cgemit.reconstruction.clusterers.clusterer import Clusterer, ClusterSettings
from cgemit.tables import Table

MAX_SIZE = 64
"""Cluster sizes in the table of errors; larger clusters have the error of this size."""

_POINTS = 2000  # of the reference sample in cos(theta); ten times as many move no error by more than 0.2 %


class BinaryClusterer(Clusterer):
    """Joins neighbouring strips to X and V clusters, and intersecting X and V clusters to XV clusters."""

    readout: BinaryReadout

    def cluster(
        self, group: ReadoutGroup, digis: Table, settings: ClusterSettings, directions: Floats | None = None
    ) -> Table:
        """Return the clusters, see `Clusterer.cluster`.

        Raises
        ------
        ValueError
            If a strip is not in the detector.
        """
        err_x, err_v = map(group.among_all, cluster_errors(group.detector, settings, group.numbers))
        columns = _core.reconstruction.find_clusters(
            compiled(group.detector), dict(digis.columns), err_x=err_x, err_v=err_v,
            by_charge=settings.position == "charge", masked=strip_lists(group.detector).masked, bridge=settings.bridge,
        )  # fmt: skip
        return Table("clusters", columns, **digis.cover)

    def expected_errors(self, group: ReadoutGroup) -> tuple[Floats, Floats]:
        """Return zeros: errors follow from the number of strips, see `Clusterer.expected_errors`."""
        none = np.zeros(len(group.layers))
        return none, none


@functools.lru_cache(maxsize=32)
def cluster_errors(
    detector: Detector, settings: ClusterSettings, cgem: tuple[int, ...] | None = None
) -> tuple[Floats, Floats]:
    """Return the position errors of clusters by layer and number of strips.

    Parameters
    ----------
    detector : Detector
    settings : ClusterSettings
    cgem : tuple of int or None
        See `cgem_layers`.

    Returns
    -------
    err_x, err_v : ndarray, (layers, MAX_SIZE) float64, mm
        Column n - 1 holds for n strips, the last one for all larger clusters, too.
    """
    return error_table(layer_table(cgem_layers(detector, cgem)), detector.field.bz, settings)


def error_table(cgem: dict[str, Any], bz: float, settings: ClusterSettings) -> tuple[Floats, Floats]:
    """Return the errors of `cluster_errors` for CGEM layers given as columns.

    Parameters
    ----------
    cgem : dict of str to ndarray
        Columns of `layer_table`.
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
        err_x[i] = _core.reconstruction.size_errors(width_x, layer["pitch_x"], MAX_SIZE)
        err_v[i] = _core.reconstruction.size_errors(width_v, layer["pitch_v"], MAX_SIZE)
    for table in (err_x, err_v):
        table.flags.writeable = False
    return err_x, err_v


def reference_widths(layer: dict[str, Any], bz: float, settings: ClusterSettings) -> tuple[Floats, Floats]:
    """Return how far tracks of the reference sample extend across the strips of a layer.

    Parameters
    ----------
    layer : dict of str to float
        One row of `layer_table`.
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
    radii = np.array([layer["r_gap_in"], 0.5 * (layer["r_gap_in"] + layer["r_gap_out"]), layer["r_gap_out"]])
    turned, arc = path_to(radii[:, None], 1 / (settings.reference_p * sin_theta), bz)
    z = arc * cos_theta / sin_theta
    crosses = (turned[2] < 0.5 * np.pi) & (z[1] >= layer["z_min"]) & (z[1] <= layer["z_max"])
    dx = layer["r_readout"] * (turned[2] - turned[0])
    dv = dx * np.cos(layer["stereo"]) - (z[2] - z[0]) * np.sin(layer["stereo"])
    return dx[crosses], np.abs(dv[crosses])
