"""Interface of a read-out of CGEM layers."""

from __future__ import annotations

from typing import Annotated, ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from cgemit.base.settings import Check
from cgemit.detector import Detector
from cgemit.reconstruction.cluster import ClusterSettings
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

Share = Annotated[float, Check(lambda value: 0 <= value < 1, "a number from 0 to 1, 1 excluded")]
# Of a strip and of a time, to far beyond any chip.
Noise = Annotated[float, Check(lambda value: 0 <= value <= 1000, "0 to 1000 fC")]
Jitter = Annotated[float, Check(lambda value: 0 <= value <= 10_000, "0 to 10000 ns")]

#: Electrons on the anode per electron of ionization: effective gain of a triple GEM.
GAIN = 12_000.0


class Readout(Protocol):
    """A frozen dataclass of settings with these methods; `cgemit.simulation.digitize.READOUTS` finds it by its name."""

    name: ClassVar[str]

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the table ``digis`` of the crossings, by event, layer, sheet and view.

        Parameters
        ----------
        detector : Detector
        truths, steps : Table
            Steps are linked to the truths and in their order.
        seed : int
            Key of the random numbers.
        """
        ...

    def cluster(self, detector: Detector, digis: Table, settings: ClusterSettings) -> Table:
        """Return the table ``clusters``: the measured positions with their errors.

        Parameters
        ----------
        detector : Detector
        digis : Table
            Its columns `truth` and `n_truths` may only be passed on.
        settings : ClusterSettings
        """
        ...

    def expected_errors(self, detector: Detector) -> tuple[Floats, Floats]:
        """Return the errors of X and V that `cgemit.covariance` expects.

        Parameters
        ----------
        detector : Detector

        Returns
        -------
        sigma_x, sigma_v : ndarray, (layers,) or (layers, 17) float64, mm
            For all tracks, or for those of `COS_THETA`. 0 for all: strips fire where the projected path touches them,
            so that the error follows from their number.

        Notes
        -----
        A method ``expected_correlations(detector)`` may give the correlation of both in the same shapes; else it is 0.
        """
        ...
