"""A page of a run that tells how strips, layers and tracks do (docs/how-to/monitor.md)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cgemit.analysis.hits import (
    HitResiduals,
    LayerCrossings,
    LayerEfficiencies,
    hit_residuals,
    layer_crossings,
    strip_status,
)
from cgemit.base.arrays import Floats
from cgemit.calibration.clusters import LorentzAngles, lorentz_angles
from cgemit.chain.result import Result
from cgemit.detector.core import layer_table
from cgemit.detector.parts import cgem_numbers
from cgemit.detector.readouts import AnalogReadout
from cgemit.tables import Table
from cgemit.tables.schema import is_fitted
from cgemit.tables.show import Tabular, text_table

if TYPE_CHECKING:
    from cgemit.draw.style import Picture

#: Share of a saturated charge: strips above it, of the readout's `saturation`, count as saturated.
SATURATED = 0.95


@dataclass(frozen=True, eq=False, repr=False)
class RunMonitor:
    """Numbers of a run, each from its tables.

    Attributes
    ----------
    result : Result
    counts : dict of str to int
        Events, events with a start time, strips, strips outside of the drift time, clusters by view, wire hits, tracks
        that are fitted, and those with clusters.
    channels : list of dict
        Hot and dead strips: ``layer``, ``sheet``, ``view``, ``strip``, ``gid``, ``status`` (1 hot, -1 dead), ``fired``
        (events).
    strips : list of dict
        For each CGEM layer and view: ``layer``, ``view``, ``channels``, ``fired``, ``per_event``, ``negative``,
        ``saturated``, ``hot``, ``dead``.
    arrival, longest : ndarray, (digis,) float64, ns
        Times of strips after the first electrons; NaN where they are not known.
    residuals : HitResiduals
    crossings : LayerCrossings
    efficiencies : LayerEfficiencies
        Of the regions of `crossings`.
    angles : LorentzAngles or None
        None without a readout that measures time.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=20, readout="tiger")
    >>> page = cg.study.monitor(r)
    >>> [strips["layer"] for strips in page.strips[:2]]
    ['L1', 'L1']
    """

    result: Result
    counts: dict[str, int]
    channels: list[dict[str, Any]]
    strips: list[dict[str, Any]]
    arrival: Floats
    longest: Floats
    residuals: HitResiduals
    crossings: LayerCrossings
    efficiencies: LayerEfficiencies
    angles: LorentzAngles | None

    def pictures(self) -> Iterator[tuple[str, str, Picture]]:
        """Yield name, title and picture of each part of the page."""
        from cgemit.draw.monitor import (
            draw_efficiencies,
            draw_hit_residuals,
            draw_layer_maps,
            draw_residual_profiles,
            draw_strip_signals,
            draw_strips,
            draw_tracks,
        )

        detector, digis = self.result.detector, self.result.digis
        if len(digis):
            yield "strips", "Strips", draw_strips(detector, digis)
            yield "signals", "Times and charges", draw_strip_signals(detector, digis, self.arrival, self.longest)
        if len(self.residuals):
            yield "residuals", "Residuals", draw_hit_residuals(detector, self.residuals)
        if np.count_nonzero(self.residuals.view < 2):
            yield "profiles", "Residuals and pulls of clusters", draw_residual_profiles(self.residuals)
        if self.efficiencies.tracks.any():
            yield "efficiencies", "Efficiencies", draw_efficiencies(self.efficiencies)
        if len(self.crossings):
            yield "maps", "Maps of layers", draw_layer_maps(self.crossings, self.residuals)
        tracks = self.result.tracks[is_fitted(self.result.tracks)]
        if len(tracks):
            yield "tracks", "Tracks", draw_tracks(tracks)

    def to_dict(self) -> dict[str, Any]:
        """Return all numbers; those that are not known are left out."""
        tables: dict[str, Tabular] = {"efficiencies": self.efficiencies, "residuals": self.residuals.binned("layer")}
        if self.angles is not None:
            tables["lorentz_angles"] = self.angles
        if len(self.crossings):
            tables |= {
                f"efficiencies_by_{name}": self.crossings.binned(name) for name in ("z", "phi", "incidence", "event")
            }
        plain: dict[str, Any] = {"counts": self.counts, "strips": self.strips, "channels": self.channels}
        for name, table in tables.items():
            columns = table.columns()
            rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
            plain[name] = [{key: _plain(value) for key, value in row.items() if value == value} for row in rows]
        return plain

    def _of_strips(self) -> tuple[str, list[str], list[list[str]]]:
        head = ["layer", "view", "channels", "fired", "per event", "negative", "saturated", "hot", "dead"]
        rows = [
            [str(one["layer"]), one["view"], str(one["channels"]), str(one["fired"]), f"{one['per_event']:.2f}",
             *(str(one[name]) for name in ("negative", "saturated", "hot", "dead"))]
            for one in self.strips
        ]  # fmt: skip
        return "strips", head, rows

    def _of_channels(self) -> tuple[str, list[str], list[list[str]]]:
        head = ["layer", "sheet", "view", "strip", "gid", "status", "events fired"]
        kinds = {1: "hot", -1: "dead"}
        rows = [
            [one["layer"], str(one["sheet"]), one["view"], str(one["strip"]), str(one["gid"]), kinds[one["status"]],
             str(one["fired"])]
            for one in self.channels
        ]  # fmt: skip
        return "hot and dead strips", head, rows

    def __repr__(self) -> str:
        counts = ["counts", *(f"  {name.replace('_', ' ')}: {value}" for name, value in self.counts.items())]
        parts = ["\n".join(counts), text_table(*self._of_strips())]
        if self.channels:
            parts.append(text_table(*self._of_channels()))
        parts.append(repr(self.efficiencies))
        parts.append(repr(self.residuals.select(self.residuals.view < 2)))
        if self.angles is not None:
            parts.append(repr(self.angles))
        return "\n\n".join(parts)

    def write(self, folder: Path, title: str) -> None:
        """Write ``index.html``, ``monitor.json`` and the pictures into a folder.

        Parameters
        ----------
        folder : Path
        title : str
        """
        text = json.dumps(self.to_dict(), indent=2, allow_nan=False)
        (folder / "monitor.json").write_text(text + "\n", encoding="utf-8")
        parts = [f"<h1>{escape(title)}</h1>", f"<pre>{escape(repr(self))}</pre>"]
        for name, head, picture in self.pictures():
            picture.save(folder / f"{name}.png")
            parts.append(f'<h2>{escape(head)}</h2>\n<p><img src="{name}.png" alt="{escape(head)}" width="1100"></p>')
        page = "\n".join(parts)
        (folder / "index.html").write_text(
            f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title></head>\n'
            f'<body style="font-family: sans-serif; margin: 2em">\n{page}\n</body></html>\n',
            encoding="utf-8",
        )


def monitor(result: Result) -> RunMonitor:
    """Return the numbers and pictures of a run, measured or simulated; no truth is used.

    Parameters
    ----------
    result : Result
        With tracks, such as of `cgemit.bes3.reconstruct.reconstruct_events`.

    Raises
    ------
    ValueError
        If the result has no tracks.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=20, readout="tiger")
    >>> page = cg.study.monitor(r)
    >>> page.counts["events"], page.counts["tracks"]
    (20, 20)
    """
    residuals, crossings = hit_residuals(result), layer_crossings(result)
    has_times = any(isinstance(group.readout, AnalogReadout) for group in result.detector.groups)
    arrival, longest, outside = _arrivals(result) if has_times else (*np.full((2, len(result.digis)), np.nan), 0)
    tracks = result.tracks[is_fitted(result.tracks)]
    counts = {"events": result.n_events}
    if result.start_times is not None:
        counts["events_with_start_time"] = int(np.count_nonzero(result.start_times["status"] == 0))
    counts["strips"] = len(result.digis)
    if has_times:
        counts["strips_outside_of_drift_time"] = outside
    counts |= {f"clusters_{name}": int((result.clusters["view"] == i).sum()) for i, name in enumerate(("x", "v", "xv"))}
    counts |= {"wire_hits": len(result.wire_hits), "tracks": len(tracks)}
    counts["tracks_with_large_chi2"] = result.large_chi2()
    counts["tracks_with_clusters"] = int(np.count_nonzero(tracks["n_clusters"]))
    angles = lorentz_angles(result) if has_times else None
    return RunMonitor(
        result, counts, _channels(result), _strips(result), arrival, longest, residuals, crossings, crossings.regions(),
        angles,
    )  # fmt: skip


def _arrivals(result: Result) -> tuple[Floats, Floats, int]:
    """Return when charge arrived after the first electrons, ns, drift times of gaps, and how many strips are outside.

    Those in events without a start time are outside, those within the margin of the readout are not.
    """
    from cgemit.reconstruction.strip_times import arrivals_of

    digis: Table = result.digis
    arrivals = arrivals_of(result.detector, digis)
    times = result.strip_times
    begin = 0.0 if times is None else times["strip_time"][np.searchsorted(times["event"], digis["event"])]
    after = np.asarray(arrivals.time - begin)
    inside = (after >= -arrivals.margin) & (after <= arrivals.longest + arrivals.margin)
    return after, arrivals.longest, int(np.count_nonzero(np.isfinite(arrivals.time) & ~inside))


def _channels(result: Result) -> list[dict[str, Any]]:
    """Return the hot and dead strips."""
    detector, digis = result.detector, result.digis
    status, first = strip_status(detector, digis), layer_table(detector.layers)["gid_first"]
    fires = np.unique(np.stack([digis["event"], digis["gid"]])[:, digis["gid"] >= 0], axis=1)[1]
    rows = []
    for gid in np.flatnonzero(status).tolist():
        number = max(one for one in cgem_numbers(detector) if first[one] <= gid)
        layer = detector.layers[number]
        sheet, channel = divmod(gid - int(first[number]), layer.strips_x + layer.strips_v)
        view = int(channel >= layer.strips_x)
        rows.append(
            {
                "layer": layer.label, "sheet": sheet, "view": "XV"[view], "strip": channel - view * layer.strips_x,
                "gid": gid, "status": int(status[gid]), "fired": int(np.count_nonzero(fires == gid)),
            }
        )  # fmt: skip
    return rows


def _strips(result: Result) -> list[dict[str, Any]]:
    """Return the numbers of the strips of each layer and view."""
    detector, digis = result.detector, result.digis
    status, first = strip_status(detector, digis), layer_table(detector.layers)["gid_first"]
    rows = []
    for number in cgem_numbers(detector):
        layer = detector.layers[number]
        per_sheet = layer.strips_x + layer.strips_v
        own = status[int(first[number]) : int(first[number]) + layer.sheets * per_sheet].reshape(
            layer.sheets, per_sheet
        )
        largest = getattr(layer.readout, "saturation", np.inf)
        for view, name in enumerate("XV"):
            mine = digis[(digis["layer"] == number) & (digis["view"] == view)]
            kinds = own[:, : layer.strips_x] if view == 0 else own[:, layer.strips_x :]
            rows.append(
                {
                    "layer": layer.label, "view": name, "channels": int(kinds.size), "fired": len(mine),
                    "per_event": len(mine) / max(result.n_events, 1),
                    "negative": int(np.count_nonzero(mine["charge"] < 0)),
                    "saturated": int(np.count_nonzero(mine["charge"] >= SATURATED * largest)),
                    "hot": int(np.count_nonzero(kinds == 1)), "dead": int(np.count_nonzero(kinds == -1)),
                }
            )  # fmt: skip
    return rows


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
