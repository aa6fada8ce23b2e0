"""Drift chamber times: drift distance against drift time, and signal propagation along wires."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.detector.detector import Detector

Floats = npt.NDArray[np.float64]

#: Drift distance (mm) against drift time (ns) of the outer drift chamber's cells: medians of reconstructed hits of
#: BESIII (BOSS 7.2.0 files published with pybes3), with the wire itself put at time 0. Straight lines between the
#: points; the outermost ones are continued.
XT_DISTANCE = np.array([0.0, 0.5, 1.2, 2.0, 2.8, 3.45, 4.7, 5.75, 6.9, 7.9, 8.3])
XT_TIME = np.array([0.0, 10.0, 25.0, 50.0, 75.0, 100.0, 150.0, 200.0, 250.0, 300.0, 350.0])
_VELOCITY = np.diff(XT_DISTANCE) / np.diff(XT_TIME)


def distance_at(time: npt.ArrayLike) -> Floats:
    """Return the drift distance of a time, mm; beyond both ends of the table along its last slope.

    Parameters
    ----------
    time : array_like, (n,) float64, ns
    """
    time = np.asarray(time, np.float64)
    outside = _VELOCITY[0] * np.minimum(time - XT_TIME[0], 0) + _VELOCITY[-1] * np.maximum(time - XT_TIME[-1], 0)
    return np.asarray(np.interp(time, XT_TIME, XT_DISTANCE) + outside, np.float64)


def velocity_at(distance: npt.ArrayLike) -> Floats:
    """Return the drift velocity at a distance from the wire, mm/ns, (n,) float64.

    Parameters
    ----------
    distance : array_like, (n,) float64, mm
    """
    return np.asarray(_VELOCITY[np.searchsorted(XT_DISTANCE[1:-1], distance, side="right")])


def shifted(drift: Floats, time: Floats, shift: npt.ArrayLike) -> Floats:
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
    return np.asarray(drift + distance_at(time + np.asarray(shift)) - distance_at(time))


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
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
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
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    numbers = np.array([one.number for one in layers], np.int64)
    wrong = np.setdiff1d(layer, numbers)
    if len(wrong):
        raise ValueError(f"wire_hits: the detector has no wire layer {wrong[0]}")
    place = np.searchsorted(numbers, layer)
    return tuple(np.array([getattr(one, name) for one in layers], np.float64)[place] for name in names)
