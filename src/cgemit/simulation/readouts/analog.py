"""Analog read-outs: ionization electrons drift and multiply, a chip measures charge and time of each strip."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.settings import Check, NotNegative, Positive, SettingsData
from cgemit.detector import Detector, compiled
from cgemit.detector.core import gain_table
from cgemit.detector.gas import drift_columns, w_values
from cgemit.reconstruction.cluster import ClusterSettings
from cgemit.reconstruction.cluster_errors import Calibration, Estimator, calibration_of, find_clusters, neutral
from cgemit.simulation.readouts.readout import GAIN, Jitter, Noise, Share
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

_FINE = 0.01  # ns, step in which peaks are searched


@dataclass(frozen=True)
class Shaper:
    """Response of an amplifier to a charge.

    Attributes
    ----------
    terms : tuple of (float, float, float)
        a, b (1/ns) and rate (1/ns) of each term, of any scale.
    delay : float
        ns.
    """

    terms: tuple[tuple[float, float, float], ...]
    delay: float = 0.0

    @cached_property
    def normalised(self) -> Floats:
        """The terms, (n, 3) float64, scaled so that the peak is 1."""
        terms = np.array(self.terms)
        terms[:, :2] /= _sum(terms, np.arange(0.0, 500.0, _FINE)).max()
        return terms

    def response(self, t: Floats) -> Floats:
        """Return the amplitude, (n,) float64, at times t, (n,) float64 ns, after a charge of 1."""
        u = np.asarray(t, np.float64) - self.delay
        return np.where(u > 0, _sum(self.normalised, np.maximum(u, 0.0)), 0.0)

    def pulse(self, t: Floats, duration: float) -> Floats:
        """Return the amplitude, (n,), at times t, (n,) ns, for a charge of 1 that flows in evenly for `duration` ns."""
        u = np.asarray(t, np.float64) - self.delay
        return (self._step(u) - self._step(u - duration)) / duration

    def _step(self, u: Floats) -> Floats:
        """Return the integral of the response up to u, (n,), in ns."""
        a, b, rate = (column[:, None] for column in self.normalised.T)
        at = np.maximum(u, 0.0)[None, :]
        level = a / rate + b / rate**2
        return np.asarray(np.sum(level - np.exp(-rate * at) * (level + b * at / rate), axis=0))


def _sum(terms: Floats, u: Floats) -> Floats:
    a, b, rate = (column[:, None] for column in terms.T)
    return np.asarray(np.sum((a + b * u) * np.exp(-rate * u), axis=0))


#: CR-RC with 50 ns: (t/tau) exp(1 - t/tau); PARSIFAL (github.com/Hilldar/PARSIFAL).
APV25 = Shaper(((0.0, math.e / 50, 1 / 50),))
#: Branch T of TIGER, for the time: PARSIFAL. Peak 53.6 ns after the charge, 13.3 mV/fC.
TIGER_T = Shaper(((0.00181928, 0.0, 1 / 3), (-0.0147059, 0.0, 1 / 20), (0.0128866, 0.0, 1 / 100)), delay=10.0)
#: Branch E of TIGER, for the charge: PARSIFAL. Peak 154.7 ns after the charge, 12.3 mV/fC.
TIGER_E = Shaper(((100164.0, 1358.7, 0.0385647), (-100164.0, 1358.7, 0.0114353)), delay=5.0)


SURVIVAL = 0.957 * 0.962
"""An electron enters a hole of the first foil, and its gain is not zero (PARSIFAL, at the nominal voltage)."""

Probability = Annotated[float, Check(lambda value: 0 < value <= 1, "a number above 0 and up to 1")]
Factor = Annotated[float, Check(lambda value: 0 <= value <= 10, "a number from 0 to 10")]
Missing = Annotated[int, Check(lambda value: 0 <= value <= 10, "a whole number from 0 to 10")]


@dataclass(frozen=True, kw_only=True)
class AnalogReadout(SettingsData):
    """What both chips have in common: the avalanche and the strips. Gas and fields belong to the detector.

    Attributes
    ----------
    gain : float
        Mean number of electrons on the anode per electron of ionization whose avalanche reaches it.
    polya : float
        Parameter theta of the Polya distribution of the gain; its relative variance is 1/(1 + theta).
    gain_fluctuation : bool
        Whether the gain fluctuates.
    survival : float
        Probability that an electron enters a hole and its avalanche reaches the anode.
    first_gain : float
        Electrons behind the first foil per electron that entered it.
    diffusion : float
        Factor on all diffusion widths, up to 10; 0 switches diffusion off.
    lorentz : bool
        Whether the Lorentz angle acts.
    holes : bool
        Whether electrons move to the centre of the nearest hole of the first foil.
    share_spread : float
        Standard deviation of ln(charge on X / charge on V) from crossing to crossing; both views have half on average.
    neighbour, second_neighbour : float
        Share of a strip's current that its neighbours see, and those beyond them (capacitive coupling).
    threshold_x, threshold_v : float
        fC.
    noise : float
        fC, of an amplitude.
    jitter : float
        ns, of the time, beside what noise makes.
    missing : int
        Strips that may be missing within a cluster.
    edge : float
        Outermost strips with a smaller share of their neighbour's charge do not enter line fits.
    valley : float
        A strip with less than this share of the charge of both maxima beside it divides a cluster; 0: none does.
    time_margin : float
        ns; strips whose drift time is below 0 or above that of the drift gap by more than this are left out.
    estimator : str
        Position of a cluster: ``"centroid"`` of the charge, ``"micro-tpc"``, a line fit through the drift gap (clusters
        without one have their centroid), or ``"merged"``, the mean of both with the weights of their errors.
    second_pass : bool
        Whether clusters on fitted tracks are made again with the angle of the track, and the tracks are fitted again.
    calibration : str
        File that ``cgemit readout`` has written; empty: the one that comes with the program.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    needs_clusters: ClassVar[bool] = True
    estimators: ClassVar[tuple[Estimator, ...]] = ("centroid", "micro-tpc", "merged")

    gain: Positive = GAIN
    polya: NotNegative = 0.36
    gain_fluctuation: bool = True
    survival: Probability = SURVIVAL
    first_gain: Positive = 15.0
    diffusion: Factor = 1.0
    lorentz: bool = True
    holes: bool = True
    share_spread: NotNegative = 0.1
    neighbour: Share = 0.0
    second_neighbour: Share = 0.0
    threshold_x: Positive = 2.0
    threshold_v: Positive = 2.0
    noise: Noise = 0.5
    jitter: Jitter = 2.0
    missing: Missing = 1
    edge: Share = 0.1
    valley: Share = 0.2
    time_margin: Positive = 50.0
    estimator: Estimator = "merged"
    second_pass: bool = False
    calibration: str = ""

    def digitize(self, detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
        """Return the strips above threshold with charge and time, see `Readout.digitize`.

        Parameters
        ----------
        detector : Detector
        truths, steps : Table
            Steps with the ionization clusters (``SimulateSettings(steps=True)``).
        seed : int
            Key of the random numbers.
        """
        digis = _core.read_out_analog(
            compiled(detector), dict(truths.columns), dict(steps.columns), **self.core_arguments(detector), seed=seed,
            gains=gain_table(detector),
        )  # fmt: skip
        return Table("digis", digis, **truths.cover)

    def core_arguments(self, detector: Detector) -> dict[str, Any]:
        """Return the arguments of the compiled digitization by name, except tables and seed.

        Parameters
        ----------
        detector : Detector

        Raises
        ------
        ValueError
            If a layer's gas or field has no table of electron transport.
        """
        layers = {
            "hole_pitch": np.array([layer.hole_pitch if self.holes else 0.0 for layer in detector.cgem]),
            "w_value": w_values(detector),
        }
        return {
            "drift": drift_columns(detector) | layers,
            "physics": {
                "survival": self.survival,
                "gain": self.gain,
                "polya": self.polya if self.gain_fluctuation else np.inf,
                "diffusion": self.diffusion,
                "first_gain": self.first_gain,
                "lorentz": self.lorentz,
                "correlated": True,
            },
            "chip": self.chip(),
            "share_spread": self.share_spread,
            "neighbour": self.neighbour,
            "second_neighbour": self.second_neighbour,
        }

    def cluster(self, detector: Detector, digis: Table, settings: ClusterSettings) -> Table:
        """Return clusters with positions at mid-gap and calibrated errors, see `Readout.cluster`.

        Parameters
        ----------
        detector : Detector
        digis : Table
        settings : ClusterSettings
            Only `bridge` is used: positions and errors are those of the read-out.

        Raises
        ------
        CalibrationError
            If there is no calibration for this detector, field and read-out.
        """
        return self.cluster_with(detector, digis, calibration_of(detector, self), bridge=settings.bridge)

    def cluster_along(self, detector: Detector, digis: Table, settings: ClusterSettings, directions: Floats) -> Table:
        """Return the clusters of `cluster`, those with a direction with positions and errors for it.

        Parameters
        ----------
        detector : Detector
        digis : Table
        settings : ClusterSettings
        directions : (clusters, 2) float64
            See `cgemit.reconstruction.cluster_errors.find_clusters`.
        """
        calibration = calibration_of(detector, self)
        return self.cluster_with(detector, digis, calibration, bridge=settings.bridge, directions=directions)

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
        return find_clusters(
            detector, digis, self.delays, calibration=calibration or neutral(len(detector.cgem)),
            estimator=self.estimator, lorentz=self.lorentz, missing=self.missing, edge=self.edge, valley=self.valley,
            margin=self.time_margin, bridge=bridge, directions=directions,
        )  # fmt: skip

    def expected_errors(self, detector: Detector) -> tuple[Floats, Floats]:
        """Return the errors of clusters of all sizes by cos(theta), see `Readout.expected_errors`.

        Parameters
        ----------
        detector : Detector

        Raises
        ------
        CalibrationError
            If there is no calibration for this detector, field and read-out.
        """
        return calibration_of(detector, self).typical(self.estimator, self.second_pass)

    def expected_correlations(self, detector: Detector) -> Floats:
        """Return the correlation of the errors of X and V of one crossing, in the shape of `expected_errors`.

        Parameters
        ----------
        detector : Detector
        """
        return calibration_of(detector, self).correlation(self.estimator, self.second_pass)

    def delays(self, induction: Floats) -> tuple[Floats, Floats]:
        """Return measured charge and delay of the chip by layer and view, see `find_clusters`.

        Parameters
        ----------
        induction : (layers,) float64, ns
        """
        raise NotImplementedError

    def chip(self) -> dict[str, Any]:
        """Return the chip as the core takes it."""
        raise NotImplementedError

    def _chip(self, kind: str, timing: Shaper, charge: Shaper, **values: float) -> dict[str, Any]:
        """Return a chip with what both chips have in common."""
        common = {"threshold_x": self.threshold_x, "threshold_v": self.threshold_v, "noise": self.noise}
        shapers = {"timing": (timing.normalised, timing.delay), "charge": (charge.normalised, charge.delay)}
        return {"kind": kind, **shapers, **common, "jitter": self.jitter, **values}
