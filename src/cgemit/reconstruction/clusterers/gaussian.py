"""Clusters of measured positions."""

from __future__ import annotations

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.detector import ReadoutGroup, compiled
from cgemit.detector.readouts import PositionReadout
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
        err_x, err_v = (group.among_all(column) for column in self._errors(group))
        columns = _core.reconstruction.clusters_of_positions(
            compiled(group.detector), dict(digis.columns), err_x=err_x, err_v=err_v
        )
        return Table("clusters", columns, **digis.cover)

    def expected_errors(self, group: ReadoutGroup) -> tuple[Floats, Floats]:
        """Return the errors of the readout, see `Clusterer.expected_errors`."""
        # Where a coordinate is not measured, its error is not asked for; 0 would stand for that of a number of strips.
        x, v = (np.where(column > 0, column, 1.0) for column in self._errors(group))
        return x, v

    def _errors(self, group: ReadoutGroup) -> tuple[Floats, Floats]:
        """Return the errors of X and V, (layers,), mm; 0 where a layer does not measure."""
        found = [self.readout.precision(layer.precision).errors(layer.pitch_x, layer.pitch_v) for layer in group.layers]
        x, v = np.array(found, np.float64).reshape(-1, 2).T.copy()
        return x, v
