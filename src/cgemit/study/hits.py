"""Lost, added and exchanged hits of track candidates, as in real events."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.candidates import HIT_V, HIT_WIRE, HIT_X
from cgemit.detector import Detector
from cgemit.tables import Table

Rows = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Columns = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Hits:
    """Candidates, their hits, and the tables that these point into.

    Attributes
    ----------
    candidates, candidate_hits : Table
    clusters, wire_hits : Table
    """

    candidates: Table
    candidate_hits: Table
    clusters: Table
    wire_hits: Table

    @property
    def track(self) -> Rows:
        """Candidate of each hit."""
        return np.asarray(self.candidate_hits["candidate"])

    @property
    def view(self) -> Rows:
        """View of each hit."""
        return np.asarray(self.candidate_hits["view"])

    @property
    def row(self) -> Rows:
        """Row of each hit in its table."""
        return np.asarray(self.candidate_hits["row"])

    @property
    def on_wire(self) -> Mask:
        """Whether each hit is one of a wire."""
        return np.asarray(self.view == HIT_WIRE)

    @property
    def layer(self) -> Rows:
        """CGEM layer or number of the wire layer of each hit."""
        return self._column("layer", "layer", self.row)

    def _column(self, of_cluster: str, of_wire: str, row: Rows) -> Rows:
        column = np.empty(len(row), np.int64)
        column[~self.on_wire] = self.clusters[of_cluster][row[~self.on_wire]]
        column[self.on_wire] = self.wire_hits[of_wire][row[self.on_wire]]
        return column


def keep(hits: Hits, kept: Mask) -> Hits:
    """Return the candidates without some of their hits.

    Parameters
    ----------
    hits : Hits
    kept : ndarray, (hits,) bool
    """
    return _times(hits, kept.astype(np.int64))


def lose_layers(hits: Hits, share: float, random: np.random.Generator) -> Hits:
    """Return the candidates of a detector in which each layer misses a track with probability `share`."""
    place = (hits.track * 2 + hits.on_wire) * 1000 + hits.layer
    _, index = np.unique(place, return_inverse=True)
    return keep(hits, (random.random(index.max(initial=-1) + 1) >= share)[index])


def _times(hits: Hits, times: Rows) -> Hits:
    """Return the candidates with each hit so many times, one behind the other."""
    return replace(hits, candidate_hits=hits.candidate_hits[np.repeat(np.arange(len(times)), times)])


def exchange_clusters(hits: Hits, layer: int, tracks: Mask) -> Hits:
    """Return the candidates with the X and V cluster of one layer taken from the track four rows on.

    Parameters
    ----------
    hits : Hits
    layer : int
        CGEM layer.
    tracks : ndarray, (candidates,) bool
        Which candidates are changed, where both tracks have the cluster.
    """
    row, taken = hits.row.copy(), [np.empty(0, np.int64)]
    for view in (HIT_X, HIT_V):
        mine = np.flatnonzero((hits.view == view) & (hits.layer == layer))
        hurt = tracks[hits.track[mine]]
        row[mine[hurt]] = np.roll(hits.row[mine], -4)[hurt]
        taken.append(mine[hurt])
    # The other track's event is another one, so that the cluster is copied.
    places = np.concatenate(taken)
    copies = {name: hits.clusters[name][row[places]] for name in hits.clusters}
    clusters, old, new = _merged(hits.clusters, copies | {"event": hits.candidate_hits["event"][places]})
    kept = np.setdiff1d(np.flatnonzero(~hits.on_wire), places)
    row[kept], row[places] = old[row[kept]], new
    return replace(hits, candidate_hits=hits.candidate_hits.with_columns(row=row), clusters=clusters)


def add_noise(detector: Detector, hits: Hits, share: float, random: np.random.Generator) -> Hits:
    """Return the candidates with noise: a false hit beside each of their hits with probability `share`.

    Noise on a wire lies in a cell at most 3 away, anywhere in it; in the hit's own cell the shorter drift is seen.
    Noise on strips is a cluster like the hit's own, shifted by a whole number of strips, at most 10 mm.

    Parameters
    ----------
    detector : Detector
    hits : Hits
    share : float
        Probability of noise for each hit that the track has.
    random : numpy.random.Generator
    """
    noisy = random.random(len(hits.track)) < share
    spoilt = _times(hits, 1 + noisy.astype(np.int64))
    second = np.flatnonzero(noisy) + 1 + np.arange(np.count_nonzero(noisy))
    wire, strip = (second[spoilt.on_wire[second] == is_wire] for is_wire in (True, False))
    row = spoilt.row.copy()
    new_wires = _wire_noise(detector, spoilt.wire_hits, row[wire], random)
    new_strips = _strip_noise(detector, spoilt.clusters, row[strip], random)
    same_cell = new_wires["gid"] == spoilt.wire_hits["gid"][row[wire]]
    wire_hits, old, new = _merged(spoilt.wire_hits, new_wires)
    row[spoilt.on_wire] = old[row[spoilt.on_wire]]
    row[wire] = new
    clusters, old, new = _merged(spoilt.clusters, new_strips)
    row[~spoilt.on_wire] = old[row[~spoilt.on_wire]]
    row[strip] = new
    kept = np.ones(len(row), np.bool_)
    kept[wire[same_cell] - 1] = False
    return keep(Hits(spoilt.candidates, spoilt.candidate_hits.with_columns(row=row), clusters, wire_hits), kept)


def _wire_noise(detector: Detector, wire_hits: Table, rows: Rows, random: np.random.Generator) -> Columns:
    """Return rows like those given, in a cell nearby and with any drift distance."""
    columns = {name: wire_hits[name][rows].copy() for name in wire_hits}
    layers = {layer.number: layer for layer in detector.drift_chamber.layers} if detector.drift_chamber else {}
    cells = np.array([layers[number].cells for number in columns["layer"]], np.int64)
    radius = np.array([layers[number].r_mid for number in columns["layer"]])
    shift = random.integers(-3, 4, len(rows))
    drift = random.random(len(rows)) * np.pi * radius / np.maximum(cells, 1)
    drift = np.where(shift == 0, np.minimum(drift, columns["drift"]), drift)
    wire = (columns["wire"] + shift) % np.maximum(cells, 1)
    columns["gid"] += (wire - columns["wire"]).astype(columns["gid"].dtype)
    columns["wire"] = wire.astype(columns["wire"].dtype)
    columns["wire_truth"][:] = -1
    return columns | {"drift": drift}


def _strip_noise(detector: Detector, clusters: Table, rows: Rows, random: np.random.Generator) -> Columns:
    """Return rows like those given, some strips to the left or right on the same sheet."""
    columns = {name: clusters[name][rows].copy() for name in clusters}
    is_x = columns["view"] == HIT_X
    layers = [(cgem.pitch_x, cgem.strips_x, cgem.pitch_v, cgem.strips_v) for cgem in detector.cgem]
    of_layer = np.array(layers).reshape(-1, 4)[columns["layer"]]
    pitch, strips = (np.where(is_x, of_layer[:, i], of_layer[:, i + 2]) for i in (0, 1))
    shift = np.ceil(random.random(len(rows)) * 10.0 / pitch)
    shift *= np.where(random.random(len(rows)) < 0.5, 1, -1)
    position = np.where(is_x, columns["x"], columns["v"]) / pitch + shift
    shift *= np.where((position < 0) | (position > strips), -1, 1)
    for name in ("first", "last"):
        columns[name] += np.where(columns["size"] > 0, shift, 0).astype(columns[name].dtype)
    columns["x"] += np.where(is_x, shift * pitch, 0.0)
    columns["v"] += np.where(is_x, 0.0, shift * pitch)
    columns["truth"][:] = -1
    return columns


def _merged(table: Table, extra: Columns) -> tuple[Table, Rows, Rows]:
    """Return the table with more rows, and where its own rows and the new ones are in it."""
    columns = {name: np.concatenate([table[name], extra[name]]) for name in table}
    order = np.argsort(columns["event"], kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    joined = {name: column[order] for name, column in columns.items()}
    return Table(table.kind, joined, **table.cover), place[: len(table)], place[len(table) :]
