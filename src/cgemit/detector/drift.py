"""Drift chamber times: drift distance against drift time, and signal propagation along wires."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats, Rows
from cgemit.detector.keys import once
from cgemit.detector.layers.wires import WireLayer
from cgemit.detector.parts import Contents
from cgemit.tables import Table


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
    >>> relation = relation_of(cg.load("besiii-cgem").drift_chamber.layers[0])
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


@once
def relation_of(layer: WireLayer) -> DriftRelation:
    """Return the relation of drift distance and time of a wire layer.

    Parameters
    ----------
    layer : WireLayer
        With a table `drift_relation`, a constant `drift_velocity`, or neither: then the relation of BESIII; `t0` is
        added to its times.
    """
    points = layer.drift_relation
    if layer.drift_velocity:
        relation = DriftRelation(np.array([0.0, layer.drift_velocity]), np.array([0.0, 1.0]))
    elif points:
        relation = DriftRelation(np.array([one.distance for one in points]), np.array([one.time for one in points]))
    else:
        relation = BESIII
    return DriftRelation(relation.distance, relation.time + layer.t0) if layer.t0 else relation


class DriftRelations:
    """Relations of drift distance and time of the wire layers of a detector, which the experiment numbers.

    Parameters
    ----------
    layers : sequence of WireLayer

    Examples
    --------
    >>> from cgemit.detector.drift import relations_of
    >>> slower = cg.load("besiii-cgem").with_overrides({"drift_chamber.layers.9.drift_velocity": "20 um/ns"})
    >>> print(relations_of(slower).distance_at([8, 9, 10], [50.0, 50.0, 50.0]))  # mm
    [2. 1. 2.]
    """

    def __init__(self, layers: Sequence[WireLayer]) -> None:
        distinct: dict[tuple[bytes, bytes], DriftRelation] = {}
        keys = []
        for layer in layers:
            relation = relation_of(layer)
            keys.append((relation.distance.tobytes(), relation.time.tobytes()))
            distinct.setdefault(keys[-1], relation)
        self._distinct = list(distinct.values()) or [BESIII]
        places = {key: place for place, key in enumerate(distinct)}
        self._place = np.full(max((layer.number for layer in layers), default=0) + 1, -1)
        for layer, key in zip(layers, keys, strict=True):
            self._place[layer.number] = places[key]

    def distance_at(self, layer: npt.ArrayLike, time: npt.ArrayLike) -> Floats:
        """Return the drift distances of times, (n,) float64, mm, as `DriftRelation.distance_at`.

        Parameters
        ----------
        layer : array_like, (n,) int
        time : array_like, (n,) float64, ns
        """
        return self._each(DriftRelation.distance_at, layer, time)

    def velocity_at(self, layer: npt.ArrayLike, distance: npt.ArrayLike) -> Floats:
        """Return the drift velocities at distances from the wires, (n,) float64, mm/ns.

        Parameters
        ----------
        layer : array_like, (n,) int
        distance : array_like, (n,) float64, mm
        """
        return self._each(DriftRelation.velocity_at, layer, distance)

    def shifted(self, wire_hits: Mapping[str, npt.NDArray[Any]] | Table, shift: npt.ArrayLike) -> Floats:
        """Return the drift distances of wire hits after a shift of their drift times, (n,) float64, mm.

        Parameters
        ----------
        wire_hits : Table
            With `layer`, `drift` and `drift_time`.
        shift : float or ndarray, (n,) float64, ns
            Added to the times.
        """
        drift, time = wire_hits["drift"], wire_hits["drift_time"]
        return self._each(DriftRelation.shifted, wire_hits["layer"], drift, time, shift)

    def _each(self, value: Callable[..., Floats], layer: npt.ArrayLike, *columns: npt.ArrayLike) -> Floats:
        """Return a function of a relation and columns, for the relation of each row."""
        if len(self._distinct) == 1:
            return value(self._distinct[0], *columns)
        layer = np.asarray(layer, np.int64)
        known = (layer >= 0) & (layer < len(self._place))
        relation_row = np.where(known, self._place[np.where(known, layer, 0)], -1)
        if len(wrong := layer[relation_row < 0]):
            raise ValueError(f"wire_hits: the detector has no wire layer {wrong[0]}")
        rows = [np.broadcast_to(np.asarray(column, np.float64), layer.shape) for column in columns]
        out = np.empty(layer.shape)
        for number, relation in enumerate(self._distinct):
            mine = relation_row == number
            out[mine] = value(relation, *(row[mine] for row in rows))
        return out


@once
def relations_of(detector: Contents) -> DriftRelations:
    """Return the relations of drift distance and time of a detector's wire layers.

    Parameters
    ----------
    detector : Detector
        One without a chamber has the relation of BESIII for every layer.
    """
    return DriftRelations(detector.drift_chamber.layers if detector.drift_chamber else ())


def read_by(detector: Contents, simulated: Contents, wire_hits: Table) -> Table:
    """Return wire hits with the drift distances and errors that a detector makes of the times of another one's hits.

    Parameters
    ----------
    detector : Detector
        That the reconstruction assumes.
    simulated : Detector
        Of the hits. Layers with the same relation and error keep their values.
    wire_hits : Table
    """
    chambers = [one.drift_chamber for one in (detector, simulated)]
    layers, old_layers = ({layer.number: layer for layer in one.layers} if one else {} for one in chambers)
    drift, sigma = wire_hits["drift"].copy(), wire_hits["sigma"].copy()
    for layer_number in layers.keys() & old_layers.keys():
        new, old = layers[layer_number], old_layers[layer_number]
        if new is old or (_relation_key(new) == _relation_key(old) and _error_key(new) == _error_key(old)):
            continue
        rows = wire_hits["layer"] == layer_number
        if _relation_key(new) != _relation_key(old):
            time = wire_hits["drift_time"][rows]
            drift[rows] += relation_of(new).distance_at(time) - relation_of(old).distance_at(time)
        sigma[rows] = new.error_at(np.maximum(drift[rows], 0.0))
    changed = not (np.array_equal(drift, wire_hits["drift"]) and np.array_equal(sigma, wire_hits["sigma"]))
    return wire_hits.with_columns(drift=drift, sigma=sigma) if changed else wire_hits


def _relation_key(layer: WireLayer) -> tuple[Any, ...]:
    return layer.drift_relation, layer.drift_velocity, layer.t0


def _error_key(layer: WireLayer) -> tuple[Any, ...]:
    return layer.sigma, layer.sigma_slope, layer.sigma_points, layer.diffusion


def check_wire_times(detector: Contents) -> None:
    """Raise an error if a detector does not say how signals run along its wires.

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


def propagation_time(detector: Contents, layer: Rows, z: Floats | float) -> Floats:
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


def _of_layers(detector: Contents, layer: Rows, *names: str) -> tuple[Floats, ...]:
    """Return values of the wire layers with these numbers, (n,) float64 each."""
    check_wire_times(detector)
    layers = detector.wires
    numbers = np.array([one.number for one in layers], np.int64)
    wrong = np.setdiff1d(layer, numbers)
    if len(wrong):
        raise ValueError(f"wire_hits: the detector has no wire layer {wrong[0]}")
    place = np.searchsorted(numbers, layer)
    return tuple(np.array([getattr(one, name) for one in layers], np.float64)[place] for name in names)
