"""Background: cells and strips that fire without a particle of the event (docs/methods/background.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector
from cgemit.detector.parts import CgemLayer
from cgemit.detector.strip_maps import strip_lists
from cgemit.detector.strips import local_v, strips_of_v
from cgemit.digitize import XT_DISTANCE, XT_TIME, without_dead
from cgemit.kinds import Check
from cgemit.settings import SettingsData
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]
Level = Literal["off", "bes2009", "bes2026"]
Factor = Annotated[float, Check(lambda value: 0 <= value <= 100, "a number from 0 to 100")]
Share = Annotated[float, Check(lambda value: 0 <= value <= 0.6, "a share from 0 to 0.6")]

#: Hits of wires against radius (mm, kHz/cm^2): random triggers of BESIII in 2009, of events published with pybes3,
#: with a time in the read-out window.
WIRE_RADIUS = np.array([79, 91, 103, 115, 127, 139, 150, 162, 197, 213, 262, 327, 393, 458, 531, 597, 661, 726, 758.0])
WIRE_RATE = np.array(
    [1.86, 1.26, 0.85, 0.66, 0.56, 0.40, 0.30, 0.36, 0.10, 0.18, 0.08, 0.09, 0.09, 0.06, 0.03, 0.01, 0.02, 0.02, 0.02]
)
#: Fired cells in a row, of the same events, and how often: most background is in clumps.
RUNS = np.array([646, 167, 52, 39, 25, 21, 51.0])
#: Clusters in the CGEM: kHz/cm^2 at 76 mm, and the power of the radius.
CLUSTER_RATE, CLUSTER_POWER = 1.9, -2.2
#: Noise of single strips, kHz: (X, V) of the innermost layer in 2026; the others are quiet.
STRIP_RATE = (0.0, 3.6)
WIRE_WINDOW, STRIP_WINDOW = 2000.0, 1000.0  # ns, read-out windows
STRESS_WINDOW = 400.0  # ns, of a given share of cells: all of them look like hits of tracks
MOST_STRIPS = 6  # of a cluster; from 1, as probable as each other
CHARGE = (10.0, 50.0)  # fC, of a strip

_CELLS, _STRIPS, _HOT = 1, 2, 3  # purposes of random numbers


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings(SettingsData):
    """Background that is added to the digis and wire hits of every event.

    Attributes
    ----------
    level : str
        ``"off"``, or the rates measured at BESIII: ``"bes2009"``, cells of the drift chamber from random triggers, and
        clusters of the CGEM at rates extrapolated from them; ``"bes2026"``, with noise of single strips as well.
    factor : float
        All rates are multiplied by it, up to 100. Times `cells` it is a share, up to 0.6.
    cells : float
        If above 0: share of the cells of every layer that fire within the drift time, instead of the level's rates.
    clumps : bool
        Whether cells fire in clumps of neighbours, as measured, or each for itself.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    level: Level = "off"
    factor: Factor = 1.0
    cells: Share = 0.0
    clumps: bool = True

    def contradictions(self) -> list[str]:
        """Return what does not go together."""
        numbers = [value for value in (self.factor, self.cells) if isinstance(value, int | float)]
        if len(numbers) == 2 and self.cells * self.factor > 0.6:
            return [f"cells: got {self.cells:g}, times factor {self.factor:g}, expected a product up to 0.6"]
        return []

    @property
    def is_off(self) -> bool:
        """Whether nothing is added."""
        return (self.level == "off" and self.cells == 0) or self.factor == 0


def add_background(
    detector: Detector, digis: Table, wire_hits: Table, settings: BackgroundSettings, seed: int
) -> dict[str, Table]:
    """Return digis and wire hits with background; of several hits of a cell, the earliest is kept.

    Hot strips of the detector file fire in every event, whatever the settings. A strip that has fired already stays as
    it is. Read-outs without strips get background on wires only.

    Parameters
    ----------
    detector : Detector
    digis, wire_hits : Table
        Of the same events.
    settings : BackgroundSettings
    seed : int
        Key of the random numbers. They depend on seed and event only.

    Returns
    -------
    dict of str to Table
        ``digis`` and ``wire_hits``; rows of the background link to no truth.
    """
    has_strips = not len(digis) or bool((digis["strip"] >= 0).all())
    if has_strips and len(strip_lists(detector).hot):
        hot = [_hot(detector, seed, int(event)) for event in digis.events]
        digis = _joined(digis, hot, ("layer", "sheet", "view", "strip"), keep="given")
    if settings.is_off:
        return {"digis": digis, "wire_hits": wire_hits}
    cells, strips = [], []
    for event in wire_hits.events:
        cells.append(_cells(detector, settings, seed, int(event)))
        if has_strips and settings.level != "off":
            strips.append(_strips(detector, settings, seed, int(event)))
    return {
        "digis": without_dead(detector, _joined(digis, strips, ("layer", "sheet", "view", "strip"), keep="given"))
        if strips
        else digis,
        "wire_hits": _joined(wire_hits, cells, ("layer", "wire"), keep="earliest"),
    }


class _Random:
    """Random numbers of one event and purpose."""

    def __init__(self, seed: int, event: int, purpose: int) -> None:
        self._words = np.random.Philox(key=[seed % 2**64, event], counter=[0, 0, 0, purpose])

    def uniform(self, n: int) -> Floats:
        """Return the next n numbers from 0 to 1, excluded."""
        return np.asarray((self._words.random_raw(n) >> np.uint64(11)) * 2.0**-53)


def _cells(detector: Detector, settings: BackgroundSettings, seed: int, event: int) -> dict[str, Any]:
    """Return the cells of one event that fire, as columns of wire hits."""
    chamber = detector.drift_chamber
    layers = chamber.layers if chamber else ()
    total = sum(layer.cells for layer in layers)
    random = _Random(seed, event, _CELLS).uniform(3 * total).reshape(3, total)
    window = STRESS_WINDOW if settings.cells > 0 else WIRE_WINDOW
    found: dict[str, list[Any]] = {name: [] for name in ("layer", "wire", "gid", "drift_time", "slope", "noise")}
    begin = 0
    for layer, gid in zip(layers, chamber.gid_first if chamber else (), strict=True):
        fire, length, time = random[:, begin : begin + layer.cells]
        begin += layer.cells
        wire = _fired(_share(layer.r_mid, layer.half_length, layer.cells, settings), fire, length, settings.clumps)
        found["layer"].append(np.full(len(wire), layer.number))
        found["wire"].append(wire)
        found["gid"].append(gid + wire)
        found["drift_time"].append(time[wire] * window)
        found["noise"].append(np.full(len(wire), layer.sigma))
        found["slope"].append(np.full(len(wire), layer.sigma_slope))
    columns = {name: np.concatenate([*parts, np.empty(0)]) for name, parts in found.items()}
    n = len(columns["wire"])
    late = (XT_DISTANCE[-1] - XT_DISTANCE[-2]) / (XT_TIME[-1] - XT_TIME[-2])
    drift = np.interp(columns["drift_time"], XT_TIME, XT_DISTANCE)
    drift += late * np.maximum(columns["drift_time"] - XT_TIME[-1], 0)
    sigma = columns.pop("noise") + columns.pop("slope") * drift
    return columns | {
        "event": np.full(n, event), "drift": drift, "sigma": np.maximum(sigma, 1e-3),
        "side": np.zeros(n), "wire_truth": np.full(n, -1),
    }  # fmt: skip


def _share(radius: float, half_length: float, cells: int, settings: BackgroundSettings) -> float:
    """Return the share of the cells of a layer that fire."""
    if settings.cells > 0:
        return settings.cells * settings.factor
    area = 2 * np.pi * radius / cells * 2 * half_length / 100  # cm^2
    hits = float(np.interp(radius, WIRE_RADIUS, WIRE_RATE)) * area * WIRE_WINDOW * 1e-6 * settings.factor
    return 1 - float(np.exp(-hits))


def _fired(share: float, fire: Floats, length: Floats, clumps: bool) -> Rows:
    """Return the numbers of the cells of a layer that fire; with clumps, each begins a run of neighbours."""
    cells = len(fire)
    if not clumps:
        return np.flatnonzero(fire < share)
    runs = np.cumsum(RUNS) / RUNS.sum()
    mean = float(np.sum(RUNS * np.arange(1, len(RUNS) + 1)) / RUNS.sum())
    # Runs overlap: a cell stays silent if no run that would reach it begins.
    first = np.flatnonzero(fire < 1 - (1 - min(share, 0.95)) ** (1 / mean))
    size = 1 + np.searchsorted(runs, length[first])
    wire = np.repeat(first, size) + np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
    return np.unique(wire % cells)


def _strips(detector: Detector, settings: BackgroundSettings, seed: int, event: int) -> dict[str, Any]:
    """Return the strips of one event that fire, as columns of digis."""
    found: dict[str, list[Any]] = {name: [] for name in ("layer", "sheet", "view", "strip", "gid")}
    random, gid = _Random(seed, event, _STRIPS), 0
    for number, layer in enumerate(detector.cgem):
        for sheet, view, strip in _layer_strips(layer, number, settings, random):
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
        "charge": CHARGE[0] + charge * (CHARGE[1] - CHARGE[0]), "time": time * STRIP_WINDOW,
        "truth": np.full(n, -1), "n_truths": np.zeros(n),
    }  # fmt: skip


def _hot(detector: Detector, seed: int, event: int) -> dict[str, Any]:
    """Return the hot strips as columns of digis of one event."""
    gid = strip_lists(detector).hot
    found = _addresses(detector, gid)
    charge, time = _Random(seed, event, _HOT).uniform(2 * len(gid)).reshape(2, len(gid))
    return found | {
        "event": np.full(len(gid), event), "gid": gid, "position": np.full(len(gid), np.nan),
        "charge": CHARGE[0] + charge * (CHARGE[1] - CHARGE[0]), "time": time * STRIP_WINDOW,
        "truth": np.full(len(gid), -1), "n_truths": np.zeros(len(gid)),
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


def _layer_strips(
    layer: CgemLayer, number: int, settings: BackgroundSettings, random: _Random
) -> list[tuple[int, int, Rows]]:
    """Return (sheet, view, strips) of clusters and of noise in a layer; strips may lie beyond the sheet's edges."""
    width = layer.strips_x * layer.pitch_x
    area = width * layer.sheets * 2 * layer.half_length / 100  # cm^2
    rate = CLUSTER_RATE * (layer.r_readout / 76) ** CLUSTER_POWER * area  # kHz
    parts = []
    n = _poisson(rate * STRIP_WINDOW * 1e-6 * settings.factor, float(random.uniform(1)[0]))
    for across, along, size_x, size_v in random.uniform(4 * n).reshape(n, 4).tolist():
        sheet = int(across * layer.sheets)
        x = (across * layer.sheets - sheet) * width
        v = float(strips_of_v(layer, local_v(layer, x, (2 * along - 1) * layer.half_length)))
        for view, middle, size in ((0, x / layer.pitch_x, size_x), (1, v, size_v)):
            strips = 1 + int(size * MOST_STRIPS)
            parts.append((sheet, view, np.arange(strips) + int(np.floor(middle - 0.5 * (strips - 1)))))
    if settings.level == "bes2026" and number == 0:
        for sheet in range(layer.sheets):
            for view, strips in ((0, layer.strips_x), (1, layer.strips_v)):
                share = 1 - np.exp(-STRIP_RATE[view] * STRIP_WINDOW * 1e-6 * settings.factor)
                parts.append((sheet, view, np.flatnonzero(random.uniform(strips) < share)))
    return parts


def _poisson(mean: float, uniform: float) -> int:
    """Return a Poisson number by inversion, at most 1000."""
    term = total = float(np.exp(-mean))
    n = 0
    while uniform > total and n < 1000:
        n += 1
        term *= mean / n
        total += term
    return n


def _joined(table: Table, parts: list[dict[str, Any]], place: tuple[str, ...], keep: str) -> Table:
    """Return a table with more rows, ordered by event and place, one row a place."""
    columns = {
        name: np.concatenate([table[name], *(part[name] for part in parts)]).astype(table[name].dtype) for name in table
    }
    added = np.arange(len(columns["event"])) >= len(table)
    last = columns["drift_time"] if keep == "earliest" else added
    order = np.lexsort((added, last, *(columns[name] for name in reversed(place)), columns["event"]))
    keys = np.stack([columns[name][order] for name in ("event", *place)])
    first = np.ones(len(order), np.bool_)
    first[1:] = np.any(keys[:, 1:] != keys[:, :-1], axis=0)
    # Hits of particles in one place are the digitization's own affair: only background is removed or removes.
    rows = order[first] if keep == "earliest" else order[first | ~added[order]]
    return Table(table.kind, {name: column[rows] for name, column in columns.items()}, meta=table.meta, **table.cover)
