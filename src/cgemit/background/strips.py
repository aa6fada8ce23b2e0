"""Strips of the CGEM that fire without a particle."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.background.level import BackgroundSettings
from cgemit.background.random import HOT_STRIPS, LISTED_STRIPS, STRIP_CHANNELS, STRIPS, Random, channels, poisson
from cgemit.detector import Detector
from cgemit.detector.background import BackgroundLevel
from cgemit.detector.parts import CgemLayer
from cgemit.detector.strip_maps import in_dead_area, strip_lists
from cgemit.detector.strips import local_v, strips_of_v

Rows = npt.NDArray[np.int64]


def background_strips(
    detector: Detector, level: BackgroundLevel, settings: BackgroundSettings, seed: int, event: int
) -> dict[str, Any]:
    """Return the strips of one event that fire, as columns of digis; a strip may be there twice.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel
    settings : BackgroundSettings
    seed, event : int
    """
    found: dict[str, list[Any]] = {name: [] for name in ("layer", "sheet", "view", "strip", "gid")}
    random, gid = Random(seed, event, STRIPS), 0
    hot = _hot(detector, level, settings, seed, event)
    for number, layer in enumerate(detector.cgem):
        for sheet, view, strip in [*_of_layer(layer, number, level, settings, random), *hot.get(number, [])]:
            on = np.unique(strip[(strip >= 0) & (strip < (layer.strips_x, layer.strips_v)[view])])
            for name, value in (("layer", number), ("sheet", sheet), ("view", view)):
                found[name].append(np.full(len(on), value))
            found["strip"].append(on)
            found["gid"].append(gid + sheet * (layer.strips_x + layer.strips_v) + view * layer.strips_x + on)
        gid += layer.sheets * (layer.strips_x + layer.strips_v)
    columns = {name: np.concatenate([*parts, np.empty(0)]).astype(np.int64) for name, parts in found.items()}
    n = len(columns["strip"])
    charge, time = random.uniform(2 * n).reshape(2, n)
    return columns | {
        "event": np.full(n, event), "position": np.full(n, np.nan),
        "charge": level.charge_low + charge * (level.charge_high - level.charge_low),
        "time": time * level.strip_window, "truth": np.full(n, -1), "n_truths": np.zeros(n),
    }  # fmt: skip


def listed_hot_strips(detector: Detector, level: BackgroundLevel | None, seed: int, event: int) -> dict[str, Any]:
    """Return the hot strips that the layers list as columns of digis of one event: all of them fire.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel or None
        Charges and read-out window; those of an empty level if None.
    seed, event : int
    """
    level = level or BackgroundLevel(label="")
    gid = strip_lists(detector).hot
    n = len(gid)
    charge, time = Random(seed, event, LISTED_STRIPS).uniform(2 * n).reshape(2, n)
    return _addresses(detector, gid) | {
        "event": np.full(n, event), "gid": gid, "position": np.full(n, np.nan),
        "charge": level.charge_low + charge * (level.charge_high - level.charge_low),
        "time": time * level.strip_window, "truth": np.full(n, -1), "n_truths": np.zeros(n),
    }  # fmt: skip


def _addresses(detector: Detector, gid: npt.NDArray[np.int32]) -> dict[str, Any]:
    """Return layer, sheet, view and strip of running numbers."""
    per_sheet = np.array([layer.strips_x + layer.strips_v for layer in detector.cgem])
    strips_x = np.array([layer.strips_x for layer in detector.cgem])
    first = np.cumsum([0, *(per_sheet * [layer.sheets for layer in detector.cgem])])
    layer = np.searchsorted(first, gid, side="right") - 1
    sheet, in_sheet = np.divmod(gid - first[layer], per_sheet[layer])
    view = (in_sheet >= strips_x[layer]).astype(np.int64)
    return {"layer": layer, "sheet": sheet, "view": view, "strip": in_sheet - view * strips_x[layer]}


def dead_strips(detector: Detector, level: BackgroundLevel) -> npt.NDArray[np.bool_]:
    """Return which strips never fire, by their `gid`, (strips,) bool.

    Parameters
    ----------
    detector : Detector
    level : BackgroundLevel
    """
    return channels(STRIP_CHANNELS, _total(detector)) < level.dead_strips


def _total(detector: Detector) -> int:
    return sum(layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem)


def _hot(
    detector: Detector, level: BackgroundLevel, settings: BackgroundSettings, seed: int, event: int
) -> dict[int, list[tuple[int, int, Rows]]]:
    """Return (sheet, view, strips) of the hot strips that fire in one event, by layer."""
    if level.hot_strips == 0:
        return {}
    total = _total(detector)
    share = 1 - np.exp(-level.hot_strip_rate * level.strip_window * 1e-6 * settings.factor)
    fires = Random(seed, event, HOT_STRIPS).uniform(total) < share
    fires &= channels(STRIP_CHANNELS, total) >= 1 - level.hot_strips
    found: dict[int, list[tuple[int, int, Rows]]] = {}
    begin = 0
    for number, layer in enumerate(detector.cgem):
        for sheet in range(layer.sheets):
            for view, strips in ((0, layer.strips_x), (1, layer.strips_v)):
                found.setdefault(number, []).append((sheet, view, np.flatnonzero(fires[begin : begin + strips])))
                begin += strips
    return found


def _of_layer(
    layer: CgemLayer, number: int, level: BackgroundLevel, settings: BackgroundSettings, random: Random
) -> list[tuple[int, int, Rows]]:
    """Return (sheet, view, strips) of clusters and of noise in a layer; strips may lie beyond the sheet's edges."""
    width = layer.strips_x * layer.pitch_x
    area = width * layer.sheets * 2 * layer.half_length / 100  # cm^2
    rate = level.cluster_rate * (layer.r_readout / level.cluster_radius) ** level.cluster_power * area  # kHz
    window = level.strip_window * 1e-6 * settings.factor  # 1/kHz
    parts = []
    n = poisson(rate * window, float(random.uniform(1)[0]))
    for across, along, size_x, size_v in random.uniform(4 * n).reshape(n, 4).tolist():
        sheet = int(across * layer.sheets)
        x, z = (across * layer.sheets - sheet) * width, (2 * along - 1) * layer.half_length
        if in_dead_area(layer, np.array(x), np.array(z)):
            continue
        v = float(strips_of_v(layer, local_v(layer, x, z)))
        for view, middle, size in ((0, x / layer.pitch_x, size_x), (1, v, size_v)):
            strips = 1 + int(size * level.cluster_strips)
            parts.append((sheet, view, np.arange(strips) + int(np.floor(middle - 0.5 * (strips - 1)))))
    noise = (level.noise_x, level.noise_v)
    if number == 0 and any(noise):
        for sheet in range(layer.sheets):
            for view, strips in ((0, layer.strips_x), (1, layer.strips_v)):
                parts.append((sheet, view, np.flatnonzero(random.uniform(strips) < 1 - np.exp(-noise[view] * window))))
    return parts
