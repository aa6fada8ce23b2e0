"""Cells of the drift chamber that fire without a particle."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.background.level import BackgroundSettings
from cgemit.background.random import CELLS, HOT_CELLS, WIRE_CHANNELS, Floats, Random, channels
from cgemit.detector import Detector
from cgemit.detector.background import BackgroundLevel
from cgemit.detector.parts import WireLayer
from cgemit.drift_times import XT_DISTANCE, XT_TIME

Rows = npt.NDArray[np.int64]

STRESS_WINDOW = 400.0  # ns, of a given share of cells: all of them look like hits of tracks
#: Fired cells in a row for a given share of cells, and how often: as measured at BESIII, where most are in clumps.
STRESS_RUNS = (646, 167, 52, 39, 25, 21, 51)


def background_cells(
    detector: Detector, level: BackgroundLevel | None, settings: BackgroundSettings, seed: int, event: int
) -> dict[str, Any]:
    """Return the cells of one event that fire, as columns of wire hits; a cell may be there twice.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel or None
    settings : BackgroundSettings
    seed, event : int
    """
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    total = sum(layer.cells for layer in layers)
    random = Random(seed, event, CELLS).uniform(3 * total).reshape(3, total)
    stress = settings.cells > 0
    window = STRESS_WINDOW if stress or level is None else level.wire_window
    runs = STRESS_RUNS if stress or level is None else level.wire_runs
    fired, begin = [np.empty(0, np.int64)], 0
    for layer in layers:
        fire, length = random[:2, begin : begin + layer.cells]
        share = settings.cells * settings.factor if stress else _share(layer, level, settings.factor)
        fired.append(begin + _fired(share, fire, length, runs if settings.clumps else ()))
        begin += layer.cells
    cell = np.concatenate(fired)
    time = random[2][cell] * window
    if level is not None and not stress and level.hot_wires > 0:
        hot, hot_time = _hot(level, settings.factor, total, seed, event)
        cell, time = np.concatenate([cell, hot]), np.concatenate([time, hot_time])
    return _columns(detector, cell, time, event)


def dead_cells(detector: Detector, level: BackgroundLevel) -> npt.NDArray[np.bool_]:
    """Return which cells never fire, in the order of layers and wires, (cells,) bool.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel
    """
    total = sum(layer.cells for layer in detector.drift_chamber.layers) if detector.drift_chamber else 0
    return channels(WIRE_CHANNELS, total) < level.dead_wires


def cell_numbers(detector: Detector, layer: npt.NDArray[Any], wire: npt.NDArray[Any]) -> Rows:
    """Return the number of each cell in the order of layers and wires, (n,) int64.

    Parameters
    ----------
    detector : Detector
    layer, wire : ndarray, (n,) int
    """
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    first = np.zeros(max((one.number for one in layers), default=0) + 1, np.int64)
    first[[one.number for one in layers]] = np.cumsum([0, *(one.cells for one in layers)])[:-1]
    return np.asarray(first[layer] + wire, np.int64)


def _share(layer: WireLayer, level: BackgroundLevel | None, factor: float) -> float:
    """Return the share of the cells of a layer that fire in the window."""
    if level is None or not level.wire_rate:
        return 0.0
    area = 2 * np.pi * layer.r_mid / layer.cells * 2 * layer.half_length / 100  # cm^2
    rate = np.interp(layer.r_mid, [one.r for one in level.wire_rate], [one.rate for one in level.wire_rate])
    return 1 - float(np.exp(-float(rate) * area * level.wire_window * 1e-6 * factor))


def _fired(share: float, fire: Floats, length: Floats, how_often: tuple[float, ...]) -> Rows:
    """Return the numbers of the cells of a layer that fire; with clumps, each begins a run of neighbours."""
    cells = len(fire)
    if not how_often:
        return np.flatnonzero(fire < share)
    often = np.array(how_often, np.float64)
    runs = np.cumsum(often) / often.sum()
    mean = float(np.sum(often * np.arange(1, len(often) + 1)) / often.sum())
    # Runs overlap: a cell stays silent if no run that would reach it begins.
    first = np.flatnonzero(fire < 1 - (1 - min(share, 0.95)) ** (1 / mean))
    size = 1 + np.searchsorted(runs, length[first])
    wire = np.repeat(first, size) + np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
    return np.unique(wire % cells)


def _hot(level: BackgroundLevel, factor: float, total: int, seed: int, event: int) -> tuple[Rows, Floats]:
    """Return the hot cells that fire in one event, and their times, ns."""
    fire, time = Random(seed, event, HOT_CELLS).uniform(2 * total).reshape(2, total)
    share = 1 - np.exp(-level.hot_wire_rate * level.wire_window * 1e-6 * factor)
    hot = np.flatnonzero((channels(WIRE_CHANNELS, total) >= 1 - level.hot_wires) & (fire < share))
    return hot, time[hot] * level.wire_window


def _columns(detector: Detector, cell: Rows, time: Floats, event: int) -> dict[str, Any]:
    """Return the columns of wire hits of cells, numbered in the order of layers and wires."""
    chamber = detector.drift_chamber
    layers = chamber.layers if chamber else ()
    begin = np.cumsum([0, *(layer.cells for layer in layers)])
    row = np.searchsorted(begin, cell, side="right") - 1
    wire = cell - begin[row]

    def of_layer(values: list[Any]) -> npt.NDArray[Any]:
        return np.array(values or [0])[row]

    late = (XT_DISTANCE[-1] - XT_DISTANCE[-2]) / (XT_TIME[-1] - XT_TIME[-2])
    drift = np.interp(time, XT_TIME, XT_DISTANCE) + late * np.maximum(time - XT_TIME[-1], 0)
    sigma = of_layer([one.sigma for one in layers]) + of_layer([one.sigma_slope for one in layers]) * drift
    n = len(cell)
    return {
        "layer": of_layer([one.number for one in layers]), "wire": wire,
        "gid": of_layer(list(chamber.gid_first) if chamber else []) + wire, "drift_time": time,
        "event": np.full(n, event), "drift": drift, "sigma": np.maximum(sigma, 1e-3),
        "side": np.zeros(n), "wire_truth": np.full(n, -1),
    }  # fmt: skip
