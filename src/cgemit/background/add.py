"""The background stage: digis and wire hits with background, dead channels removed."""

from __future__ import annotations

from typing import Any

import numpy as np

from cgemit.background.cells import background_cells, cell_numbers, dead_cells
from cgemit.background.efficiency import read_out
from cgemit.background.level import BackgroundSettings, level_of
from cgemit.background.mix import mix_events
from cgemit.background.start_time import with_start_time
from cgemit.background.strips import background_strips, dead_strips, listed_hot_strips
from cgemit.detector import Detector
from cgemit.detector.background import BackgroundLevel
from cgemit.detector.strip_maps import strip_lists
from cgemit.digitize import without_dead
from cgemit.tables import Table

_STRIP = ("layer", "sheet", "view", "strip")


def add_background(
    detector: Detector, digis: Table, wire_hits: Table, settings: BackgroundSettings, seed: int
) -> dict[str, Table]:
    """Return digis and wire hits with background and other events; of several hits of a cell, the earliest is kept.

    Hot strips that the layers of the detector file list fire in every event, whatever the settings. A strip that has
    fired already stays as it is. Dead channels have no hit. Read-outs without strips get background on wires only.

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

    Raises
    ------
    ValueError
        If the detector has no such level, or the mixed events are of another detector.
    """
    level = level_of(detector, settings)
    if settings.events:
        mixed = mix_events(detector, digis, wire_hits, settings.events, offset=settings.offset, seed=seed)
        digis, wire_hits = mixed["digis"], mixed["wire_hits"]
    if _has_strips(digis) and len(strip_lists(detector).hot):
        hot = [listed_hot_strips(detector, level, seed, int(event)) for event in digis.events]
        digis = joined(digis, hot, _STRIP, keep="given")
    if not settings.is_off:
        digis, wire_hits = _with_level(detector, level, digis, wire_hits, settings, seed)
    if settings.start_time > 0:
        wire_hits = with_start_time(wire_hits, settings.start_time, seed)
    return {"digis": digis, "wire_hits": wire_hits}


def _has_strips(digis: Table) -> bool:
    return not len(digis) or bool((digis["strip"] >= 0).all())


def _with_level(
    detector: Detector, level: BackgroundLevel | None, digis: Table, wire_hits: Table, settings: BackgroundSettings,
    seed: int,
) -> tuple[Table, Table]:  # fmt: skip
    """Return digis and wire hits with the cells and strips of a level, without dead channels."""
    has_strips = _has_strips(digis)
    if level is not None:
        digis, wire_hits = read_out(detector, level, digis, wire_hits, seed)
    cells, strips = [], []
    for event in wire_hits.events:
        cells.append(background_cells(detector, level, settings, seed, int(event)))
        if has_strips and level is not None:
            strips.append(background_strips(detector, level, settings, seed, int(event)))
    wire_hits = joined(wire_hits, cells, ("layer", "wire"), keep="earliest")
    if strips:
        digis = without_dead(detector, joined(digis, strips, _STRIP, keep="given"))
    if level is not None and level.dead_wires > 0:
        dead = dead_cells(detector, level)[cell_numbers(detector, wire_hits["layer"], wire_hits["wire"])]
        wire_hits = wire_hits[~dead]
    if level is not None and level.dead_strips > 0 and has_strips:
        digis = digis[~dead_strips(detector, level)[digis["gid"]]]
    return digis, wire_hits


def joined(table: Table, parts: list[dict[str, Any]], place: tuple[str, ...], keep: str) -> Table:
    """Return a table with more rows, ordered by event and place, one row a place.

    Parameters
    ----------
    table : Table
    parts : list of dict
        Columns of further rows.
    place : tuple of str
        Columns that tell places apart.
    keep : str
        ``"earliest"``: the row with the smallest `drift_time`; ``"given"``: the rows of `table`.
    """
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
