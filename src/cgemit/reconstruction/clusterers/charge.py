"""Clusters of strips with charge, or with charge and time, and calibrated errors (docs/methods/readout.md)."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.core import strip_gains, strip_lists
from cgemit.detector.gas import drift_columns
from cgemit.detector.readouts import AnalogReadout, CalibratedReadout, Chip, Estimator, ProjectionReadout
from cgemit.reconstruction.cluster_errors import (
    CHARGES,
    DISTANCES,
    PATH_KNOTS,
    SIZES,
    SLOPE_EDGES,
    SLOPE_KNOTS,
    Calibration,
    calibration_of,
    neutral,
)
from cgemit.reconstruction.clusterers.clusterer import Clusterer, ClusterSettings, Floats
from cgemit.tables import Table

_SPEED_OF_LIGHT = 299.792458  # mm/ns


class CalibratedClusterer(Clusterer):
    """Makes clusters whose positions and errors come from a calibration.

    Attributes
    ----------
    estimators : tuple of str
        Positions that a cluster can have.
    """

    estimators: ClassVar[tuple[Estimator, ...]]

    readout: CalibratedReadout

    @property
    def lorentz(self) -> bool:
        """Whether electrons drift at the Lorentz angle."""
        return False

    @abstractmethod
    def strip_rules(self, detector: Detector) -> dict[str, Any]:
        """Return how strips with charge and time become clusters, as arguments of the core.

        Parameters
        ----------
        detector : Detector

        Returns
        -------
        dict
            ``timing``: velocity (mm/ns), tan_lorentz, shift (rad) and delay (ns), each (layers,) float64.
            ``delay_charge`` and ``delay``: measured charge (fC, growing) and delay of the chip (ns), each (2 layers, n)
            float64, by layer and view. ``missing``, ``edge``, ``margin`` (ns): see `AnalogReadout`.
        """

    def check(self, detector: Detector) -> None:
        """Raise an error if there is no calibration for a detector.

        Raises
        ------
        CalibrationError
            Listing every problem.
        """
        calibration_of(detector, self.readout)

    def cluster(
        self, detector: Detector, digis: Table, settings: ClusterSettings, directions: Floats | None = None
    ) -> Table:
        """Return the clusters, see `Clusterer.cluster`; of the settings only `bridge` applies.

        Raises
        ------
        CalibrationError
            If there is no calibration for this detector, field and read-out.
        """
        calibration = calibration_of(detector, self.readout)
        return self.cluster_with(detector, digis, calibration, bridge=settings.bridge, directions=directions)

    def cluster_with(
        self,
        detector: Detector,
        digis: Table,
        calibration: Calibration | None = None,
        *,
        estimator: Estimator | None = None,
        bridge: int = 0,
        directions: Floats | None = None,
    ) -> Table:
        """Return clusters with the errors of a calibration; without one, errors of 1 mm.

        Parameters
        ----------
        detector : Detector
        digis : Table
        calibration : Calibration or None
        estimator : str or None
            None: as the read-out says.
        bridge : int
            See `ClusterSettings`.
        directions : (clusters, 2) float64 or None
            See `Clusterer.cluster`.
        """
        calibration = calibration or neutral(len(detector.cgem))
        estimator = estimator or self.readout.estimator
        tracks = np.empty((0, 2)) if directions is None else directions
        found = _core.find_charge_time_clusters(
            compiled(detector), dict(digis.columns), **self.strip_rules(detector),
            errors=calibration.errors.reshape(-1, SIZES), shares=calibration.shares.reshape(-1, SIZES),
            depth=calibration.depth.reshape(-1, CHARGES), height=calibration.height.reshape(-1, CHARGES),
            edges=calibration.edges.reshape(-1, CHARGES - 1), estimator=estimator,
            masked=strip_lists(detector).masked, bridge=bridge, gain=strip_gains(detector), valley=self.readout.valley,
            pairs=calibration.pairs.ravel(), slope_errors=calibration.slope_errors.ravel(),
            slope_shares=calibration.slope_shares.ravel(), slope_edges=SLOPE_EDGES,
            charge_factors=calibration.charge_factors.ravel(),
            distance_edges=calibration.distance_edges.reshape(-1, DISTANCES - 2),
            distance_factors=calibration.distance_factors.reshape(-1, DISTANCES),
            direction_slopes=SLOPE_KNOTS, direction_paths=PATH_KNOTS,
            direction_depths=calibration.direction_depths.ravel(),
            direction_factors=calibration.direction_factors.ravel(), slopes=tracks[:, 0], paths=tracks[:, 1],
        )  # fmt: skip
        # X and V of a crossing come from the same electrons.
        layer = found["layer"]
        alone, tracked = (calibration.mean_correlation(estimator, of_track)[layer] for of_track in (False, True))
        along = np.zeros(len(alone), np.bool_)
        along[: len(tracks)] = np.isfinite(tracks[: len(along), 0])
        found["corr_xv"] = np.where(along, tracked, alone)
        return Table("clusters", found, **digis.cover)

    def expected_errors(self, detector: Detector) -> tuple[Floats, Floats]:
        """Return the errors of clusters of all sizes by cos(theta), see `Clusterer.expected_errors`.

        Raises
        ------
        CalibrationError
            If there is no calibration for this detector, field and read-out.
        """
        return calibration_of(detector, self.readout).typical(self.readout.estimator, self.follows_tracks)

    def expected_correlations(self, detector: Detector) -> Floats:
        """Return the correlation of the errors of X and V by cos(theta), see `Clusterer.expected_correlations`."""
        return calibration_of(detector, self.readout).correlation(self.readout.estimator, self.follows_tracks)


class ProjectionClusterer(CalibratedClusterer):
    """Takes the centroid of the charge: there is no time, and no drift."""

    estimators = ("centroid",)

    readout: ProjectionReadout

    def strip_rules(self, detector: Detector) -> dict[str, Any]:
        """Return rules that leave time out, with the shift that layers state, see `CalibratedClusterer.strip_rules`."""
        layers = len(detector.cgem)
        shift = np.array([(layer.lorentz_shift or 0.0) / layer.r_readout for layer in detector.cgem])
        return {
            "timing": {name: np.zeros(layers) for name in ("tan_lorentz", "delay")}
            | {"velocity": np.ones(layers), "shift": shift},
            "delay_charge": np.zeros((2 * layers, 1)),
            "delay": np.zeros((2 * layers, 1)),
            "missing": 0,
            "edge": 0.0,
            "margin": math.inf,
        }


class ChargeTimeClusterer(CalibratedClusterer):
    """Takes the centroid of the charge, the line through the places in the gap that times give, or both merged."""

    estimators = ("centroid", "micro-tpc", "merged")

    readout: AnalogReadout

    @property
    def follows_tracks(self) -> bool:
        """Whether the read-out asks for a second pass."""
        return self.readout.second_pass

    @property
    def lorentz(self) -> bool:
        """Whether electrons drift at the Lorentz angle."""
        return self.readout.lorentz

    def strip_rules(self, detector: Detector) -> dict[str, Any]:
        """Return the drift of the gas and the delays of the chip, see `CalibratedClusterer.strip_rules`.

        Raises
        ------
        ValueError
            If a layer's gas or field has no table of electron transport.
        """
        drift = drift_columns(detector)
        flight = np.array([layer.r_mid for layer in detector.cgem]) / _SPEED_OF_LIGHT
        bend = 1.0 if self.readout.lorentz else 0.0
        charge, delay = self.delays(drift["induction"])
        return {
            "timing": {
                "velocity": drift["velocity"],
                "tan_lorentz": bend * drift["tan_lorentz"],
                "shift": bend * drift["shift"],
                "delay": drift["delay"] + flight,
            },
            "delay_charge": charge,
            "delay": delay,
            "missing": self.readout.missing,
            "edge": self.readout.edge,
            "margin": self.readout.time_margin,
        }

    def delays(self, induction: Floats) -> tuple[Floats, Floats]:
        """Return measured charge (fC) and delay of the chip (ns) by layer and view, each (2 layers, n) float64.

        Parameters
        ----------
        induction : (layers,) float64, ns
            Duration of the current of an electron.
        """
        chip, thresholds = self.readout.chip, (self.readout.threshold_x, self.readout.threshold_v)
        if chip.kind == "apv25":
            rows = [half_height(chip, float(duration)) for duration in induction for _ in thresholds]
            found = np.array(rows).reshape(-1, 2, 2)
        else:
            rows = [leading_edges(chip, float(duration), one) for duration in induction for one in thresholds]
            found = np.array(rows).reshape(-1, 2, _POINTS)
        charge, delay = found.swapaxes(0, 1).copy()
        return charge, delay


_POINTS = 64  # of the table of a leading edge
_LARGEST = 200.0  # fC, of the table
_STEP = 0.1  # ns, in which leading edges are searched


def leading_edges(chip: Chip, duration: float, threshold: float) -> tuple[Floats, Floats]:
    """Return charge and delay that a chip like TIGER measures of charges that flow in evenly (time walk).

    Parameters
    ----------
    chip : Chip
    duration : float
        ns, of the current.
    threshold : float
        fC.

    Returns
    -------
    charge : ndarray, (64,) float64, fC, growing
    delay : ndarray, (64,) float64, ns
        Of the leading edge, after the beginning of the current.
    """
    times = np.arange(0.0, 400.0, _STEP)
    edge = chip.timing.pulse(times, duration)
    rise = slice(0, int(edge.argmax()) + 1)
    charge = np.geomspace(1.01 * threshold / edge.max(), _LARGEST, _POINTS)
    delay = np.interp(threshold / charge, edge[rise], times[rise])
    return charge * chip.charge.pulse(delay + chip.sample_delay, duration), delay


def half_height(chip: Chip, duration: float) -> tuple[Floats, Floats]:
    """Return charge and delay that a chip like APV25 measures of charges that flow in evenly, the same at any charge.

    Parameters
    ----------
    chip : Chip
    duration : float
        ns, of the current.

    Returns
    -------
    charge : ndarray, (2,) float64, fC
    delay : ndarray, (2,) float64, ns
        Mean time after the beginning of the current at which samples reach half of the largest one.
    """
    times = chip.clock * np.arange(chip.samples, dtype=np.float64)
    found = []
    for phase in np.arange(0.5, chip.clock, dtype=np.float64):  # ns, of the arrival after a sample
        arrival = 4 * chip.clock + float(phase)
        samples = chip.timing.pulse(times - arrival, duration)
        top = int(samples.argmax())
        first = int(np.flatnonzero(samples[: top + 1] <= 0.5 * samples[top])[-1])
        rise = samples[first + 1] - samples[first]
        at = times[first] + chip.clock * (0.5 * samples[top] - samples[first]) / rise
        found.append(at - arrival)
    return np.array([0.0, 1.0]), np.full(2, np.mean(found))
