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
        found = _core.clusters_of_positions(
            compiled(detector), dict(digis.columns), err_x=self.readout.sigma_x, err_v=self.readout.sigma_v
        )
        return Table("clusters", found, **digis.cover)

    def expected_errors(self, detector: Detector) -> tuple[Floats, Floats]:
        """Return the given errors, the same for all layers, see `Clusterer.expected_errors`."""
        layers = len(detector.cgem)
        return np.full(layers, self.readout.sigma_x), np.full(layers, self.readout.sigma_v)
