"""Clusters of measured positions."""

from __future__ import annotations

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.detector import ReadoutGroup, compiled
from cgemit.detector.readouts import PositionReadout, Precision
from cgemit.reconstruction.clusterers.clusterer import Clusterer, ClusterSettings
from cgemit.tables import Table


class PositionClusterer(Clusterer):
    """Makes a cluster of every position, with the error that it was measured with."""

    readout: PositionReadout

    def cluster(
        self, group: ReadoutGroup, digis: Table, settings: ClusterSettings, directions: Floats | None = None
    ) -> Table:
        """Return the clusters, see `Clusterer.cluster`; none of the settings applies.

        Raises
        ------
        ValueError
            If a sheet has not as many X as V positions: the n-th of both belong together.
        """
        errors = group.columns(Precision._fields, self._precisions(group))
        columns = _core.reconstruction.clusters_of_positions(
            compiled(group.detector), dict(digis.columns), errors=errors
        )
        return Table("clusters", columns, **digis.cover)

    def expected_errors(self, group: ReadoutGroup) -> tuple[Floats, Floats]:
        """Return the errors of the readout, see `Clusterer.expected_errors`."""
        # Where a coordinate is not measured, its error is not asked for; 0 would stand for that of a number of strips.
        rows = self._precisions(group)
        return np.array([row.sigma_x or 1.0 for row in rows]), np.array([row.sigma_v or 1.0 for row in rows])

    def _precisions(self, group: ReadoutGroup) -> list[Precision]:
        """Return how each layer measures, with errors of middles of strips; 0 where it does not measure."""
        rows = []
        for layer in group.layers:
            own = self.readout.precision(layer.precision)
            x, v = own.errors(layer.pitch_x, layer.pitch_v)
            rows.append(own._replace(sigma_x=x, sigma_v=v))
        return rows
