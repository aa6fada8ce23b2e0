"""The event display: one event across the beam, along it, and on the unrolled anodes."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.patches import Rectangle, Wedge

from cgemit.draw.event_view import EventView, strip_line, view_of
from cgemit.draw.geometry import Array, wire_layers, wire_positions, wire_profile
from cgemit.draw.strips import draw_cluster_strips, line_widths
from cgemit.draw.style import COLORS, Picture, legend_entries, plain, style

_TITLE_WIDTH = 98  # characters in the width of the picture

if TYPE_CHECKING:
    from cgemit.detector import CgemLayer, Detector
    from cgemit.result import Result

#: Colours of tracks: none is that of a drift circle, a cluster or a true crossing.
TRACK_COLORS = ("#7A3E9D", "#222222", "#CC3377", "#6B3E26", "#7F7F00")
GHOST = "#8A8A8A"


def event(result: Result, number: int = 0) -> Picture:
    """Draw one event of a result: detector, true crossings, clusters, drift circles, strips and fitted tracks.

    A track is drawn through its smoothed states from the beam line to its last hit, so that slow tracks follow their
    energy loss. XV clusters whose X and V come from different crossings are drawn as ghosts.

    Parameters
    ----------
    result : Result
    number : int
        Number of the event.

    Returns
    -------
    Picture
        r-phi, r-phi around the CGEM, r-z; for every CGEM layer the unrolled anode with its fired strips, wider with
        more charge, and charge and time of the strips of the largest X and V cluster.

    Raises
    ------
    ValueError
        If the result has no such event.
    """
    view = view_of(result, number)
    detector = view.detector
    with style():
        picture, axes, anodes, charges = _layout(len(detector.cgem))
        for plot in axes[:2]:
            _transverse_detector(plot, detector)
            _transverse_hits(plot, view, magnified=plot is axes[1])
            _drift_circles(plot, view)
            _frame(plot, "x  (mm)", "y  (mm)")
        _limit(axes[0], *_window(view))
        _limit(axes[1], (0.0, 0.0), 1.1 * max((layer.r_out for layer in detector.cgem), default=0.3 * view.r))
        _longitudinal_detector(axes[2], detector)
        _longitudinal_hits(axes[2], view)
        _frame(axes[2], "z  (mm)", "r  (mm)")
        axes[2].set(xlim=(-1.03 * view.z, 1.03 * view.z), ylim=(0, 1.03 * view.r))
        _tracks(axes, view)
        for layer, plot in enumerate(anodes):
            _anode(plot, view, layer)
        if charges:
            draw_cluster_strips(charges, view)
        readout = f", read-out {result.settings.digitize.readout.name}" if charges else ""
        finder = f", finder {result.finder}" if result.finder not in (None, "truth") else ""
        whole = f"{plain(detector.name)}{readout}{finder}, event {number}: {view.shot()}"
        # Lines end behind a particle only.
        title = textwrap.fill(whole.replace(" ", "\u00a0").replace(";\u00a0", "; "), _TITLE_WIDTH).replace(
            "\u00a0", " "
        )
        picture.suptitle(title, x=0.075, ha="left", fontsize=11.5)
        titles = ("across the beam", "inner layers", "side view")
        for plot, title in zip(axes, titles, strict=True):
            plot.set_title(title, loc="left")
        entries = legend_entries([*axes, *anodes, *charges])
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=4)
    return picture


def _layout(layers: int) -> tuple[Picture, list[Axes], list[Axes], list[Axes]]:
    """Return a picture with axes across the beam, magnified, along it; for each unrolled anode; for charges of each."""
    heights = [4.7, 2.6, 3.0, 2.4] if layers else [4.7, 2.6]
    height = sum(heights) + 0.75 * len(heights) + 1.0
    picture = Picture(figsize=(10.0, height))
    edges = {"left": 0.075, "right": 0.925 if layers else 0.985, "top": 1 - 0.65 / height, "bottom": 1.3 / height}
    grid = picture.add_gridspec(len(heights), 1, height_ratios=heights, hspace=0.22, **edges)
    across = grid[0].subgridspec(1, 2, wspace=0.2)
    axes = [picture.add_subplot(place) for place in (across[0], across[1], grid[1])]
    rows = [grid[row].subgridspec(1, layers, wspace=0.28) for row in (2, 3)] if layers else []
    anodes, charges = ([picture.add_subplot(row[i]) for i in range(layers)] for row in rows) if rows else ([], [])
    return picture, axes, anodes, charges


def _limit(axes: Axes, centre: tuple[float, float], half: float) -> None:
    axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - half, centre[1] + half), aspect="equal")


def _window(view: EventView) -> tuple[tuple[float, float], float]:
    """Return centre and half width of a square that holds the beam line and all wire hits, mm."""
    if not len(view.centres):
        return (0.0, 0.0), 1.03 * view.r
    x, y = np.concatenate([np.zeros((1, 2)), view.centres]).T
    half = 0.56 * max(np.ptp(x), np.ptp(y))
    return (float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2), float(half)


def _transverse_detector(axes: Axes, detector: Detector) -> None:
    for part in (*detector.beam_pipe, *detector.walls):
        axes.add_patch(Wedge((0, 0), part.r_out, 0, 360, width=max(part.thickness, 0.4), color=COLORS["matter"], lw=0))
    for layer in detector.cgem:
        axes.add_patch(Wedge((0, 0), layer.r_out, 0, 360, width=layer.r_out - layer.r_in, color="#E6ECF3", lw=0))
        gap = layer.r_gap_out - layer.r_gap_in
        axes.add_patch(Wedge((0, 0), layer.r_gap_out, 0, 360, width=gap, color="#B7D5EF", lw=0))
    layers = wire_layers(detector)
    if layers:
        points = [wire_positions(layer, np.arange(layer.cells), 0.0) for layer in layers]
        x, y = (np.concatenate(coordinate) for coordinate in zip(*points, strict=True))
        axes.plot(x, y, ".", ms=1.7, color="#8A95A1", mew=0, zorder=0.5, rasterized=True)


def _longitudinal_detector(axes: Axes, detector: Detector) -> None:
    for layer in detector.cgem:
        corner = (-layer.half_length, layer.r_in)
        axes.add_patch(Rectangle(corner, 2 * layer.half_length, layer.r_out - layer.r_in, color="#B7D5EF", lw=0))
    for part in (*detector.beam_pipe, *detector.walls):
        corner = (-part.half_length, part.r_in)
        axes.add_patch(Rectangle(corner, 2 * part.half_length, max(part.thickness, 0.8), color=COLORS["matter"], lw=0))
    lines = [np.column_stack(wire_profile(layer)) for layer in wire_layers(detector)]
    axes.add_collection(LineCollection(lines, colors="#E1E5EA", linewidths=0.6))


def _crossings(axes: Axes, x: Array, y: Array, size: float = 7) -> None:
    label = "true crossing" if len(x) else None
    axes.plot(x, y, "o", ms=size, mfc="none", mec=COLORS["truth"], mew=1.3, label=label, zorder=4)


def _clusters(axes: Axes, view: EventView, x: Array, y: Array, size: float) -> None:
    """Draw clusters and ghosts at x and y, (clusters,) float64; NaN where a view does not measure them."""
    seen = np.isfinite(x) & np.isfinite(y)
    real, ghosts = seen & view.shown_clusters(), seen & view.ghosts
    if real.any():
        axes.plot(
            x[real], y[real], "P", color=COLORS["cgem"], mec="white", mew=0.5, label="CGEM cluster", ms=size, zorder=5
        )
    if ghosts.any():
        label = "ghost: X and V of different crossings"
        axes.plot(x[ghosts], y[ghosts], "X", mfc="white", mec=GHOST, mew=0.9, label=label, ms=size, zorder=4.5)


def _transverse_hits(axes: Axes, view: EventView, *, magnified: bool) -> None:
    truths, clusters = view.truths, view.clusters
    _crossings(axes, *_across(truths["r"], truths["phi"]), size=9 if magnified else 5)
    _clusters(axes, view, *_across(clusters["r"], clusters["phi"]), size=7 if magnified else 4)


def _across(r: Array, phi: Array) -> tuple[Array, Array]:
    return r * np.cos(phi), r * np.sin(phi)


def _drift_circles(axes: Axes, view: EventView) -> None:
    noise = view.wire_hits["wire_truth"] < 0
    for rows, color, label in (
        (~noise, COLORS["idc"], "drift circle"),
        (noise, GHOST, "drift circle of no particle"),
    ):
        if not rows.any():
            continue
        size = 2 * np.abs(view.wire_hits["drift"][rows])
        circles = EllipseCollection(
            size, size, np.zeros(len(size)), units="xy", offsets=view.centres[rows], offset_transform=axes.transData,
            facecolors="none", edgecolors=color, linewidths=1.1, zorder=2.5,
        )  # fmt: skip
        axes.add_collection(circles)
        axes.plot([], [], "o", ms=8, mfc="none", mec=color, label=label)


def _longitudinal_hits(axes: Axes, view: EventView) -> None:
    _crossings(axes, view.truths["z"], view.truths["r"])
    _clusters(axes, view, view.clusters["z"], view.clusters["r"], 6)
    crossed = view.wire_truths
    label = "true crossing of a cell" if len(crossed) else None
    r = np.hypot(crossed["x"], crossed["y"])
    axes.plot(crossed["z"], r, "o", ms=3.5, mfc="none", mec=COLORS["truth"], label=label)


def _tracks(axes: Sequence[Axes], view: EventView) -> None:
    for path in view.paths:
        x, y, z = path.points.T
        line: dict[str, Any] = {"color": TRACK_COLORS[path.row % len(TRACK_COLORS)], "lw": 1.4, "zorder": 3}
        axes[0].plot(x, y, label=track_label(path.p), **line)
        axes[1].plot(x, y, **line)
        axes[2].plot(z, np.hypot(x, y), **line)


def track_label(p: float) -> str:
    """Return what the legend says about a fitted track with a momentum in GeV/c."""
    return f"fitted track, p = {p:.3f} GeV/c"


def _anode(axes: Axes, view: EventView, number: int) -> None:
    """Draw the unrolled anode of a layer: fired strips, true crossings, clusters and ghosts."""
    layer = view.detector.cgem[number]
    digis = view.digis
    for name, code in (("x", 0), ("v", 1)):
        fired = (digis["layer"] == number) & (digis["view"] == code) & (digis["strip"] >= 0)
        pairs = zip(digis["sheet"][fired].tolist(), digis["strip"][fired].tolist(), strict=True)
        parts = [_unrolled(layer, sheet, code, strip) for sheet, strip in pairs]
        if parts:
            lines = [line for part in parts for line in part]
            widths = np.repeat(line_widths(view, fired), [len(part) for part in parts])
            color, label = COLORS[name], f"fired {name.upper()} strips (width: charge)"
            axes.add_collection(LineCollection(lines, colors=color, linewidths=widths, alpha=0.75, label=label))
    inside, truths = view.clusters["layer"] == number, view.truths["layer"] == number
    _crossings(axes, np.degrees(view.truths["phi"][truths]), view.truths["z"][truths], 9)
    phi, z = (np.where(inside, view.clusters[name], np.nan) for name in ("phi", "z"))
    _clusters(axes, view, np.degrees(phi), z, 6)
    for edge in layer.sheet_phi:
        axes.axvline(math.degrees(edge), color="#B9C1CA", lw=0.8, ls=":", zorder=0)
    _frame(axes, "φ  (deg)", "z  (mm)" if number == 0 else "")
    axes.set(xlim=(-180, 180), ylim=(-layer.half_length, layer.half_length), xticks=(-180, -90, 0, 90, 180))
    axes.set_title(f"anode of {plain(layer.label)}, unrolled", loc="left")


def _unrolled(layer: CgemLayer, sheet: int, view: int, strip: int) -> list[Array]:
    """Return the middle of a strip in degrees and mm, in parts that do not cross ±180 degrees."""
    phi, z = strip_line(layer, sheet, view, strip)
    degrees = (np.degrees(phi) + 180) % 360 - 180
    cuts = np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1
    return np.split(np.column_stack([degrees, z]), cuts)


def _frame(axes: Axes, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.tick_params(length=3)
