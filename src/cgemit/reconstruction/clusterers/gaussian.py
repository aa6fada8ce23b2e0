"""Clusters of measured positions."""

from __future__ import annotations

import numpy as np

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.readouts import GaussianReadout
from cgemit.reconstruction.clusterers.clusterer import Clusterer, ClusterSettings, Floats
from cgemit.tables import Table


class GaussianClusterer(Clusterer):
    """Makes a cluster of every position, with the error that it was smeared with."""

    readout: GaussianReadout

    def cluster(
        self, detector: Detector, digis: Table, settings: ClusterSettings, directions: Floats | None = None
    ) -> Table:
        """Return the clusters, see `Clusterer.cluster`; none of the settings applies.

        Raises
        ------
        ValueError
            If a sheet has not as many X as V positions: the n-th of both belong together.
        """
        errors = np.ones((len(detector.layers), 2)) * (self.readout.sigma_x, self.readout.sigma_v)
        return clusters_of_positions(detector, digis, errors)

    def expected_errors(self, detector: Detector) -> tuple[Floats, Floats]:
        """Return the given errors, the same for all layers, see `Clusterer.expected_errors`."""
        layers = len(detector.layers)
        return np.full(layers, self.readout.sigma_x), np.full(layers, self.readout.sigma_v)


def clusters_of_positions(detector: Detector, digis: Table, errors: Floats) -> Table:
    """Return a cluster for each position.

    Parameters
    ----------
    detector : Detector
    digis : Table
    errors : ndarray, (layers, 2) float64, mm
        Of X and V.
    """
    x, v = np.ascontiguousarray(errors.T)
    return Table(
        "clusters",
        _core.clusters_of_positions(compiled(detector), dict(digis.columns), err_x=x, err_v=v),
        **digis.cover,
    )
