"""Drift chamber times: drift distance against drift time, and signal propagation along wires."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats
from cgemit.detector.detector import Detector
from cgemit.detector.keys import once
from cgemit.detector.layers.wires import DriftChamber
from cgemit.detector.parts import Contents


@dataclass(frozen=True, eq=False)
class DriftRelation:
    """Drift distance against drift time: straight lines between points, of which the outermost ones are continued.

    Attributes
    ----------
    distance : ndarray, (n,) float64, mm
        From 0 on, rising.
    time : ndarray, (n,) float64, ns
        Rising.

    Examples
    --------
    >>> from cgemit.detector.drift import relation_of
    >>> relation = relation_of(cg.load("besiii-cgem"))
    >>> print(relation.distance_at([25.0, 50.0]))  # mm
    [1.2 2. ]
    """

    distance: Floats
    time: Floats

    def distance_at(self, time: npt.ArrayLike) -> Floats:
        """Return the drift distance of a time, mm; beyond both ends of the table along its last slope.

        Parameters
        ----------
        time : array_like, (n,) float64, ns
        """
        time = np.asarray(time, np.float64)
        first, last = self._velocity[[0, -1]]
        outside = first * np.minimum(time - self.time[0], 0) + last * np.maximum(time - self.time[-1], 0)
        return np.asarray(np.interp(time, self.time, self.distance) + outside, np.float64)

    def velocity_at(self, distance: npt.ArrayLike) -> Floats:
        """Return the drift velocity at a distance from the wire, mm/ns, (n,) float64.

        Parameters
        ----------
        distance : array_like, (n,) float64, mm
        """
        return np.asarray(self._velocity[np.searchsorted(self.distance[1:-1], distance, side="right")])

    def shifted(self, drift: Floats, time: Floats, shift: npt.ArrayLike) -> Floats:
        """Return measured drift distances after a shift of their drift times, (n,) float64, mm.

        The resolution of the cell stays: the deviation of the distance from the distance that the time gives.

        Parameters
        ----------
        drift : ndarray, (n,) float64, mm
        time : ndarray, (n,) float64, ns
        shift : float or ndarray, (n,) float64, ns
            Added to the times.
        """
        # This order keeps the last digit of runs with a start time given.
        return np.asarray(drift + self.distance_at(time + np.asarray(shift)) - self.distance_at(time))

    @cached_property
    def _velocity(self) -> Floats:
        return np.diff(self.distance) / np.diff(self.time)


#: Outer drift chamber of BESIII: medians of reconstructed hits (BOSS 7.2.0 files published with pybes3), with the wire
#: itself put at time 0. Chambers without a relation of their own have it.
BESIII = DriftRelation(
    np.array([0.0, 0.5, 1.2, 2.0, 2.8, 3.45, 4.7, 5.75, 6.9, 7.9, 8.3]),
    np.array([0.0, 10.0, 25.0, 50.0, 75.0, 100.0, 150.0, 200.0, 250.0, 300.0, 350.0]),
)


def relation_of(detector: Contents) -> DriftRelation:
    """Return the relation of drift distance and time of a detector's chamber.

    Parameters
    ----------
    detector : Detector
        Its chamber has a table `drift_relation`, a constant `drift_velocity`, or neither: then the relation of BESIII.
    """
    return _relation(detector.drift_chamber) if detector.drift_chamber else BESIII


@once
def _relation(chamber: DriftChamber) -> DriftRelation:
    if chamber.drift_velocity:
        return DriftRelation(np.array([0.0, chamber.drift_velocity]), np.array([0.0, 1.0]))
    points = chamber.drift_relation
    if not points:
        return BESIII
    return DriftRelation(np.array([one.distance for one in points]), np.array([one.time for one in points]))


Rows = npt.NDArray[np.integer[Any]]


def check_wire_times(detector: Detector) -> None:
    """Raise an error if a detector does not say how signals run along its wires.

    Parameters
    ----------
    detector : Detector

    Raises
    ------
    ValueError
        Naming the missing keys of the detector file and their layers.
    """
    layers = detector.wires
    missing = {
        "signal_speed": [str(layer.number) for layer in layers if layer.signal_speed == 0],
        "readout_end": [str(layer.number) for layer in layers if np.isnan(layer.z_readout)],
    }
    texts = [
        f"drift_chamber.{key} (layers {', '.join(numbers[:3])}{f' and {more} more' if more > 0 else ''})"
        for key, numbers in missing.items()
        if (more := len(numbers) - 3) > -3
    ]
    if texts:
        raise ValueError(
            f"wire_times: got 'raw' and {detector.name} without {' and '.join(texts)}, expected both for every layer"
        )


def propagation_time(detector: Detector, layer: Rows, z: Floats | float) -> Floats:
    """Return the time of signals from a place on the wire to the end that is read out, |z - z_end|/v, (n,) float64, ns.

    Parameters
    ----------
    detector : Detector
    layer : ndarray, (n,) int
        Layers as the experiment numbers them.
    z : float or ndarray, (n,) float64, mm

    Raises
    ------
    ValueError
        If the detector has no such layer, or does not say how signals run along its wires.
    """
    end, speed = _of_layers(detector, layer, "z_readout", "signal_speed")
    return np.asarray(np.abs(z - end) / speed, np.float64)


def _of_layers(detector: Detector, layer: Rows, *names: str) -> tuple[Floats, ...]:
    """Return values of the wire layers with these numbers, (n,) float64 each."""
    check_wire_times(detector)
    layers = detector.wires
    numbers = np.array([one.number for one in layers], np.int64)
    wrong = np.setdiff1d(layer, numbers)
    if len(wrong):
        raise ValueError(f"wire_hits: the detector has no wire layer {wrong[0]}")
    place = np.searchsorted(numbers, layer)
    return tuple(np.array([getattr(one, name) for one in layers], np.float64)[place] for name in names)
