"""Interface of a clusterer: the half of a readout that makes clusters of digis, without truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Momentum, Quantity, Whole
from cgemit.detector import ReadoutGroup
from cgemit.detector.readouts import Readout
from cgemit.tables import Table

Position = Literal["centre", "charge"]
Fraction = Annotated[float, Quantity(low=0, high=1, above=True, below=True)]
Bridge = Annotated[int, Whole(0, 10)]


@dataclass(frozen=True, kw_only=True)
class ClusterSettings(SettingsData):
    """Position of clusters, and the reference sample of tracks from the origin that gives their errors.

    Attributes
    ----------
    position : str
        ``"centre"``: geometric centre of the fired strips. ``"charge"``: mean of the strip centres weighted by charge.
    bridge : int
        Dead and hot strips in a row that a cluster may bridge.
    error_factors : str
        File of factors on the errors of clusters with charge, as `ErrorFactors.save` writes it; empty: none.
    reference_p : float
        GeV/c, momentum of the reference sample for the errors of clusters.
    reference_cos_theta : float
        The reference sample covers cos(theta) within plus and minus this.

    Raises
    ------
    ValueError
        Listing every invalid value.

    Examples
    --------
    >>> settings = cg.Settings(cluster=cg.ClusterSettings(position="charge"))
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5, readout="tiger", settings=settings)
    >>> result.settings.cluster.position
    'charge'
    """

    position: Position = "centre"
    bridge: Bridge = 1
    error_factors: str = ""
    reference_p: Momentum = 1.0
    reference_cos_theta: Fraction = 0.93


@dataclass(frozen=True)
class Clusterer(ABC):
    """Makes the clusters of a readout; `cgemit.reconstruction.cluster.CLUSTERERS` finds it by the readout's class.

    Attributes
    ----------
    readout : Readout
    """

    readout: Readout

    @property
    def follows_tracks(self) -> bool:
        """Whether clusters on fitted tracks are made again with the directions of the tracks."""
        return False

    def check(self, group: ReadoutGroup) -> None:  # noqa: B027, most have nothing to check
        """Raise an error if clusters of the layers cannot be made, before anything is simulated or read.

        Parameters
        ----------
        group : ReadoutGroup
        """

    @abstractmethod
    def cluster(
        self, group: ReadoutGroup, digis: Table, settings: ClusterSettings, directions: Floats | None = None
    ) -> Table:
        """Return the table ``clusters``: the measured positions with their errors.

        Clusters with `method` 1 keep their errors in the fit. With 0 the fit takes errors from the number of strips and
        the incidence.

        Parameters
        ----------
        group : ReadoutGroup
            Layers with this readout. Layers and strips (gid) have the numbers of the whole detector in all tables.
        digis : Table
            Of its layers. The columns `truth` and `n_truths` may only be passed on.
        settings : ClusterSettings
        directions : (clusters, 2) float64 or None
            Of the track, by row of the clusters without directions: dX/dr of X clusters and dV/dr of V clusters at the
            anode, and its path per radius; NaN where no track tells. Given only if the clusterer follows tracks.
        """

    @abstractmethod
    def expected_errors(self, group: ReadoutGroup) -> tuple[Floats, Floats]:
        """Return the errors of X and V that `cgemit.covariance` expects.

        Parameters
        ----------
        group : ReadoutGroup

        Returns
        -------
        sigma_x, sigma_v : ndarray, (layers,) or (layers, 17) float64, mm
            For all tracks, or for those of `COS_THETA`. 0 for all: strips fire where the projected path touches them,
            so that the error follows from their number.
        """

    def expected_correlations(self, group: ReadoutGroup) -> Floats:
        """Return the correlation of the errors of X and V of one crossing, in the shape of `expected_errors`.

        Parameters
        ----------
        group : ReadoutGroup
        """
        return np.zeros(len(group.layers))
