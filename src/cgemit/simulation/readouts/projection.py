"""Analog read-out without drift physics: charge profiles of the projected path (second model of arXiv:1504.02570)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from cgemit import _core
from cgemit.base.settings import Positive, SettingsData
from cgemit.detector import Detector, compiled
from cgemit.detector.core import gain_table
from cgemit.detector.gas import w_values
from cgemit.reconstruction.cluster import ClusterSettings
from cgemit.reconstruction.cluster_errors import Calibration, Estimator, calibration_of, clusters_at, neutral
from cgemit.simulation.readouts.readout import GAIN, Floats, Noise, Share
from cgemit.tables import Table


@dataclass(frozen=True, kw_only=True)
class ProjectionReadout(SettingsData):
    """Each strip integrates its part of a charge profile along the projected path; position is the charge centroid.

    Attributes
    ----------
    gain : float
        Electrons on the anode per electron of ionization.
    sigma : float
        mm, width of the profile across the path: avalanche and diffusion.
    threshold : float
        fC, of a strip.
    noise : float
        fC, of a strip.
    valley : float
        A strip with less than this share of the charge of both maxima beside it divides a cluster; 0: none does.
    estimator : str
        Position of a cluster, always ``"centroid"``.
    calibration : str
        File that ``cgemit readout`` has written; empty: the one that comes with the program.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    name: ClassVar[str] = "analog-projection"
    estimators: ClassVar[tuple[Estimator, ...]] = ("centroid",)
    lorentz: ClassVar[bool] = False

    gain: Positive = GAIN
    sigma: Positive = 0.29
    threshold: Positive = 1.7
    noise: Noise = 0.5
    valley: Share = 0.4
    estimator: Literal["centroid"] = "centroid"
    calibration: str = ""

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the strips above threshold, see `Readout.digitize`.

        Parameters
        ----------
        detector : Detector
        truths, steps : Table
        seed : int
            Key of the noise.
        """
        digis = _core.read_out_profiles(
            compiled(detector), dict(truths.columns), dict(steps.columns), gain=self.gain, w_values=w_values(detector),
            sigma=self.sigma, threshold=self.threshold, noise=self.noise, seed=seed, gains=gain_table(detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)

    def cluster(self, detector: Detector, digis: Table, settings: ClusterSettings) -> Table:
        """Return clusters with calibrated errors, see `Readout.cluster`.

        Parameters
        ----------
        detector : Detector
        digis : Table
        settings : ClusterSettings
            Only `bridge` is used: positions and errors are those of the read-out.
        """
        return self.cluster_with(detector, digis, calibration_of(detector, self), bridge=settings.bridge)

    def cluster_with(
        self,
        detector: Detector,
        digis: Table,
        calibration: Calibration | None = None,
        *,
        bridge: int = 0,
        directions: Floats | None = None,
    ) -> Table:
        """Return clusters with the errors of a calibration; without one, errors of 1 mm.

        Parameters
        ----------
        detector : Detector
        digis : Table
        calibration : Calibration or None
        bridge : int
            See `ClusterSettings`.
        directions : (clusters, 2) float64 or None
            See `find_clusters`.
        """
        layers = len(detector.cgem)
        return clusters_at(
            detector, digis, {name: np.zeros(layers) for name in ("tan_lorentz", "shift", "delay")}
            | {"velocity": np.ones(layers)}, (np.zeros((2 * layers, 1)), np.zeros((2 * layers, 1))),
            calibration=calibration or neutral(layers), estimator="centroid", missing=0, edge=0.0, valley=self.valley,
            bridge=bridge, directions=directions,
        )  # fmt: skip

    def expected_errors(self, detector: Detector) -> tuple[Floats, Floats]:
        """Return the errors of clusters of all sizes by cos(theta), see `Readout.expected_errors`.

        Parameters
        ----------
        detector : Detector
        """
        return calibration_of(detector, self).typical(self.estimator)

    def expected_correlations(self, detector: Detector) -> Floats:
        """Return the correlation of the errors of X and V of one crossing, in the shape of `expected_errors`.

        Parameters
        ----------
        detector : Detector
        """
        return calibration_of(detector, self).correlation(self.estimator)
