"""Gaussian read-out: positions smeared with given errors, so that the exact result of the later stages is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from cgemit import _core
from cgemit.base.settings import Positive, SettingsData
from cgemit.detector import Detector, compiled
from cgemit.detector.gas import w_values
from cgemit.reconstruction.cluster import ClusterSettings
from cgemit.simulation.readouts.readout import GAIN, Floats
from cgemit.tables import Table


@dataclass(frozen=True, kw_only=True)
class GaussianReadout(SettingsData):
    """No strips: X and V at mid-gap are measured with independent Gaussian errors.

    Attributes
    ----------
    sigma_x : float
        mm, error of X = r_readout dphi. Default: RMS of the binary read-out for 1 GeV/c muons, 5 mm gap.
    sigma_v : float
        mm, error of V. Default: the same, pitch/sqrt(24) at 0.65 mm.
    gain : float
        Electrons on the anode per electron of ionization.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    name: ClassVar[str] = "gaussian"

    sigma_x: Positive = 0.1387
    sigma_v: Positive = 0.1327
    gain: Positive = GAIN

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return one X and one V position for each crossing, see `Readout.digitize`; steps move nothing.

        Parameters
        ----------
        detector : Detector
        truths, steps : Table
        seed : int
            Key of the random numbers.
        """
        digis = _core.smear_positions(
            compiled(detector), dict(truths.columns),
            gain=self.gain, w_values=w_values(detector), sigma_x=self.sigma_x, sigma_v=self.sigma_v, seed=seed,
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)

    def cluster(self, detector: Detector, digis: Table, settings: ClusterSettings) -> Table:
        """Return every position as a cluster, see `Readout.cluster`; none of the settings applies.

        Parameters
        ----------
        detector : Detector
        digis : Table
        settings : ClusterSettings

        Raises
        ------
        ValueError
            If a sheet has not as many X as V positions: the n-th of both belong together.
        """
        found = _core.clusters_of_positions(
            compiled(detector), dict(digis.columns), err_x=self.sigma_x, err_v=self.sigma_v
        )
        return Table("clusters", found, **digis.cover)

    def expected_errors(self, detector: Detector) -> tuple[Floats, Floats]:
        """Return the given errors, the same for all layers, see `Readout.expected_errors`.

        Parameters
        ----------
        detector : Detector
        """
        layers = len(detector.cgem)
        return np.full(layers, self.sigma_x), np.full(layers, self.sigma_v)
