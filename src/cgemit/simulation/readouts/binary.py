"""Binary read-out: touched strips fire (arXiv:1504.02570)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cgemit import _core
from cgemit.base.settings import NotNegative, Positive, SettingsData
from cgemit.detector import Detector, compiled
from cgemit.detector.core import gain_table
from cgemit.detector.gas import w_values
from cgemit.reconstruction.cluster import ClusterSettings, cluster
from cgemit.simulation.readouts.readout import GAIN, Floats
from cgemit.tables import Table


@dataclass(frozen=True, kw_only=True)
class BinaryReadout(SettingsData):
    """Strips that the projected path touches fire; clusters are contiguous fired strips.

    Attributes
    ----------
    gain : float
        Electrons on the anode per electron of ionization.
    threshold : float
        fC; a truth whose total charge is smaller fires nothing.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    name: ClassVar[str] = "binary"

    gain: Positive = GAIN
    threshold: NotNegative = 1.7

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the fired strips, see `Readout.digitize`.

        Parameters
        ----------
        detector : Detector
        truths, steps : Table
        seed : int
            Not used: nothing is drawn.
        """
        digis = _core.read_out_strips(
            compiled(detector), dict(truths.columns), dict(steps.columns),
            gain=self.gain, w_values=w_values(detector), threshold=self.threshold, gains=gain_table(detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)

    def cluster(self, detector: Detector, digis: Table, settings: ClusterSettings) -> Table:
        """Return the clusters of contiguous strips, see `Readout.cluster`.

        Parameters
        ----------
        detector : Detector
        digis : Table
        settings : ClusterSettings
        """
        return cluster(detector, digis, settings)

    def expected_errors(self, detector: Detector) -> tuple[Floats, Floats]:
        """Return zeros: errors follow from the number of strips, see `Readout.expected_errors`.

        Parameters
        ----------
        detector : Detector
        """
        none = np.zeros(len(detector.cgem))
        return none, none
