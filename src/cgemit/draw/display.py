"""Event display: one event across the beam, along it, on the unrolled anodes, and in three dimensions."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.patches import Rectangle, Wedge

from cgemit.base.files import new_file
from cgemit.detector.layers import Layer
from cgemit.detector.parts import cgem_numbers
from cgemit.draw.event import (
    Array,
    EventView,
    chamber_begin,
    draw_cluster_strips,
    line_widths,
    matter_parts,
    strip_line,
    view_of,
    wire_layers,
    wire_positions,
    wire_profile,
)
from cgemit.draw.style import COLORS, Picture, legend_entries, plain, style

if TYPE_CHECKING:
    from cgemit.chain.result import Result
    from cgemit.detector import Detector


_TITLE_WIDTH = 98  # characters in the width of the picture


#: Colours of tracks, all different from those of drift circles, clusters and true crossings.
TRACK_COLORS = ("#7A3E9D", "#222222", "#CC3377", "#6B3E26", "#7F7F00")
_DASHES = ("-", "--", "-.", ":")  # a colour comes again with another dash
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

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=2)
    >>> picture = cg.draw.event(result, 0)
    >>> [axes.get_title(loc="left") for axes in picture.axes[:3]]
    ['across the beam', 'inner layers', 'side view']
    """
    view = view_of(result, number)
    detector = view.detector
    readout = f", readout {detector.readout_text}" if detector.cgem else ""
    finder = f", finder {result.finder}" if result.finder not in (None, "truth") else ""
    shot = "measured" if view.measured else view.shot()
    whole = f"{plain(detector.name)}{readout}{finder}, event {number}: {shot}"
    # Lines end behind a particle only.
    title = textwrap.fill(whole.replace(" ", "\u00a0").replace(";\u00a0", "; "), _TITLE_WIDTH).replace("\u00a0", " ")
    with style():
        picture, axes, anodes, charges = _layout(len(detector.cgem), title.count("\n"), wide=view.measured)
        for plot in axes[:2]:
            _transverse_detector(plot, detector)
            _transverse_hits(plot, view, magnified=plot is axes[1])
            _drift_circles(plot, view)
            _frame(plot, "x  (mm)", "y  (mm)")
        _limit(axes[0], *_window(view))
        inner = [layer.r_out for layer in detector.layers if layer.r_out < chamber_begin(detector)]
        _limit(axes[1], (0.0, 0.0), 1.1 * max(inner, default=0.3 * view.r))
        _longitudinal_detector(axes[2], detector)
        _longitudinal_hits(axes[2], view)
        _frame(axes[2], "z  (mm)", "r  (mm)")
        axes[2].set(xlim=(-1.03 * view.z, 1.03 * view.z), ylim=(0, 1.03 * view.r))
        _tracks(axes, view)
        for layer, plot in zip(cgem_numbers(detector), anodes, strict=True):
            _anode(plot, view, layer)
        if charges:
            draw_cluster_strips(charges, view)
        picture.suptitle(title, x=0.075, ha="left", fontsize=11.5)
        titles = ("across the beam", "inner layers", "side view")
        for plot, title in zip(axes, titles, strict=True):
            plot.set_title(title, loc="left")
        entries = legend_entries([*axes, *anodes, *charges])
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=4)
    return picture


def _layout(layers: int, more_lines: int, *, wide: bool) -> tuple[Picture, list[Axes], list[Axes], list[Axes]]:
    """Return a picture with axes across the beam, magnified, along it; for each unrolled anode; for charges of each.

    `wide`: times of strips have many digits.
    """
    heights = [4.1, 2.6, 3.0, 2.4] if layers else [4.1, 2.6]  # the first row: as wide as high, no band below
    above = 0.65 + 0.2 * more_lines  # inches, of the title
    height = sum(heights) + 0.75 * len(heights) + 0.35 + above
    picture = Picture(figsize=(10.0, height))
    edges = {
        "left": 0.075,
        "right": (0.895 if wide else 0.925) if layers else 0.985,
        "top": 1 - above / height,
        "bottom": 1.3 / height,
    }
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
    for part in matter_parts(detector):
        width = max(part.r_out - part.r_in, 0.4)
        axes.add_patch(Wedge((0, 0), part.r_out, 0, 360, width=width, color=COLORS["matter"], lw=0))
    for layer in detector.layers:
        axes.add_patch(Wedge((0, 0), layer.r_out, 0, 360, width=layer.r_out - layer.r_in, color="#E6ECF3", lw=0))
        gap = max(layer.r_gap_out - layer.r_gap_in, 0.8)  # a sensor of silicon stays visible
        axes.add_patch(Wedge((0, 0), layer.r_gap_out, 0, 360, width=gap, color="#B7D5EF", lw=0))
    layers = wire_layers(detector)
    if layers:
        points = [wire_positions(layer, np.arange(layer.cells), 0.0) for layer in layers]
        x, y = (np.concatenate(coordinate) for coordinate in zip(*points, strict=True))
        axes.plot(x, y, ".", ms=1.7, color="#8A95A1", mew=0, zorder=0.5, rasterized=True)


def _longitudinal_detector(axes: Axes, detector: Detector) -> None:
    for layer in detector.layers:
        _add_part(axes, layer, "#B7D5EF")
    for part in matter_parts(detector):
        _add_part(axes, part, COLORS["matter"])
    lines = [np.column_stack(wire_profile(layer)) for layer in wire_layers(detector)]
    axes.add_collection(LineCollection(lines, colors="#E1E5EA", linewidths=0.6))


def _add_part(axes: Axes, part: Any, color: str) -> None:
    low, high = part.ends
    axes.add_patch(Rectangle((low, part.r_in), high - low, max(part.r_out - part.r_in, 0.8), color=color, lw=0))


def _crossings(axes: Axes, x: Array, y: Array, size: float = 7) -> None:
    label = "true crossing" if len(x) else None
    axes.plot(x, y, "o", ms=size, mfc="none", mec=COLORS["truth"], mew=1.3, label=label, zorder=4)


def _clusters(axes: Axes, view: EventView, x: Array, y: Array, size: float) -> None:
    """Draw clusters and ghosts at x and y, (clusters,) float64; NaN where a view does not measure them."""
    seen = np.isfinite(x) & np.isfinite(y)
    real, ghosts = seen & view.shown_clusters(), seen & view.ghosts
    if view.measured:
        others = real & ~view.on_track[0]
        real &= view.on_track[0]
        if others.any():
            label = "cluster on no track"
            axes.plot(x[others], y[others], ".", color=GHOST, label=label, ms=size, zorder=4.4)
    if real.any():
        axes.plot(x[real], y[real], "P", color=COLORS["cgem"], mec="white", mew=0.5, label="cluster", ms=size, zorder=5)
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
    noise = ~view.on_track[1] if view.measured else view.wire_hits["wire_truth"] < 0
    of_none = "on no track" if view.measured else "of no particle"
    for rows, color, label in (
        (~noise, COLORS["idc"], "drift circle"),
        (noise, GHOST, f"drift circle {of_none}"),
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
        turn, which = divmod(path.row, len(TRACK_COLORS))
        line: dict[str, Any] = {
            "color": TRACK_COLORS[which],
            "ls": _DASHES[turn % len(_DASHES)],
            "lw": 1.4,
            "zorder": 3,
        }
        axes[0].plot(x, y, label=track_label(path.p, large_chi2=path.large_chi2), **line)
        axes[1].plot(x, y, **line)
        axes[2].plot(z, np.hypot(x, y), **line)


def track_label(p: float, *, large_chi2: bool = False) -> str:
    """Return what the legend says about a fitted track with a momentum in GeV/c."""
    return f"fitted track, p = {p:.3f} GeV/c" + (", large chi-square" if large_chi2 else "")


def _anode(axes: Axes, view: EventView, number: int) -> None:
    """Draw the unrolled anode of a layer: fired strips, true crossings, clusters and ghosts."""
    layer = view.detector.layers[number]
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
    _frame(axes, "φ  (deg)", "z  (mm)" if layer is view.detector.cgem[0] else "")
    axes.set(xlim=(-180, 180), ylim=layer.ends, xticks=(-180, -90, 0, 90, 180))
    axes.set_title(f"anode of {plain(layer.label)}, unrolled", loc="left")


def _unrolled(layer: Layer, sheet: int, view: int, strip: int) -> list[Array]:
    """Return the middle of a strip in degrees and mm, in parts that do not cross ±180 degrees."""
    phi, z = strip_line(layer, sheet, view, strip)
    degrees = (np.degrees(phi) + 180) % 360 - 180
    cuts = np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1
    return np.split(np.column_stack([degrees, z]), cuts)


def _frame(axes: Axes, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.tick_params(length=3)


_TURN = np.linspace(0, 2 * np.pi, 73)


def event_3d(result: Result, number: int = 0) -> Any:
    """Draw one event in three dimensions, to be turned with the mouse.

    Parameters
    ----------
    result : Result
    number : int
        Number of the event.

    Returns
    -------
    plotly.graph_objects.Figure
        CGEM layers and beam pipe as transparent cylinders, fired strips and sense wires as lines, true crossings,
        clusters and ghosts as points, tracks as curves.

    Raises
    ------
    ValueError
        If the result has no such event, or plotly is not installed.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=2)
    >>> figure = cg.draw.event_3d(result, 0)
    >>> [trace.name for trace in figure.data if trace.name][:3]
    ['beam pipe', 'L1', 'L2']
    """
    plotly = _plotly()
    view = view_of(result, number)
    figure = plotly.Figure([*_cylinders(plotly, view), *_lines(plotly, view), *_points(plotly, view)])
    axis = {"backgroundcolor": "#FFFFFF", "gridcolor": COLORS["grid"], "zerolinecolor": COLORS["grid"]}
    axes = {f"{name}axis": {"title": {"text": f"{name} (mm)"}, **axis} for name in "xyz"}
    figure.update_layout(
        title={"text": f"{view.detector.name}, event {number}:<br>{view.shot()}", "x": 0.02, "font": {"size": 14}},
        template="none", margin={"t": 60, "l": 0, "r": 0, "b": 0}, modebar={"orientation": "v"},
        scene={**axes, "aspectmode": "data", "camera": {"up": {"x": 0, "y": 1, "z": 0}, "eye": _EYE}},
        legend={"itemsizing": "constant", "orientation": "h", "font": {"size": 11}},
    )  # fmt: skip
    return figure


_EYE = {"x": 1.5, "y": 1.0, "z": 1.5}  # far enough for the ends of the wires


def save_page(figure: Any, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a plotly figure as one HTML file that needs no network.

    Parameters
    ----------
    figure : plotly.graph_objects.Figure
    path : path
    overwrite : bool

    Raises
    ------
    FileExistsError
        If the file exists and `overwrite` is false.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=2)
    >>> cg.draw.save_page(cg.draw.event_3d(result), "event.html").name
    'event.html'
    """
    title = figure.layout.title.text.replace("<br>", " ").replace("<", "&lt;")
    how = {"config": {"displaylogo": False, "responsive": True}, "default_height": "100%", "div_id": "event"}
    body = figure.to_html(include_plotlyjs=True, full_html=False, **how)
    page = f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>{_CSS}</head>\n<body>'
    with new_file(path, overwrite=overwrite) as temporary:
        temporary.write_text(f"{page}{body}</body></html>\n", encoding="utf-8")
    return Path(path)


_CSS = "<style>html, body, body > div { height: 100%; margin: 0; }</style>"


def _plotly() -> Any:
    try:
        import plotly.graph_objects
    except ImportError:
        raise ValueError(
            "event_3d: needs plotly, which is not installed; pip install 'cgemit[notebook]' installs it"
        ) from None
    return plotly.graph_objects


def _cylinders(plotly: Any, view: EventView) -> list[Any]:
    parts = [("beam pipe", part.r_out, part.ends, "#8A95A1") for part in view.detector.beam_pipe[:1]]
    parts += [(layer.label, layer.r_mid, layer.ends, "#7FB2DC") for layer in view.detector.layers]
    surfaces = []
    for name, radius, ends, color in parts:
        z = np.array(ends)[:, None]
        x, y = (np.broadcast_to(radius * f(_TURN), (2, len(_TURN))) for f in (np.cos, np.sin))
        surfaces.append(plotly.Surface(
            x=x, y=y, z=np.broadcast_to(z, x.shape), opacity=0.18, showscale=False, colorscale=[[0, color], [1, color]],
            name=name, showlegend=True, hoverinfo="skip",
        ))  # fmt: skip
    return surfaces


def _joined(lines: list[Array]) -> Array:
    """Return lines, (n, 3) float64 each, as one with NaN in between."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([part for line in lines for part in (line, gap)]) if lines else np.empty((0, 3))


def _lines(plotly: Any, view: EventView) -> list[Any]:
    groups = [
        ("fired X strips", _joined(_strips(view, 0)), COLORS["x"], 3),
        ("fired V strips", _joined(_strips(view, 1)), COLORS["v"], 3),
        ("hit sense wires", _joined(_wires(view)), "#B0A8A0", 1),
    ]
    groups += [
        (
            track_label(path.p, large_chi2=path.large_chi2),
            path.points,
            TRACK_COLORS[path.row % len(TRACK_COLORS)],
            5,
        )
        for path in view.paths
    ]
    return [
        plotly.Scatter3d(**_xyz(points), mode="lines", line={"color": color, "width": width}, name=name)
        for name, points, color, width in groups
        if len(points)
    ]


def _xyz(points: Array) -> dict[str, Array]:
    return dict(zip("xyz", points.T, strict=True))


def _strips(view: EventView, code: int) -> list[Array]:
    digis = view.digis
    lines = []
    for row in np.flatnonzero((digis["view"] == code) & (digis["strip"] >= 0)):
        layer = view.detector.layers[digis["layer"][row]]
        phi, z = strip_line(layer, int(digis["sheet"][row]), code, int(digis["strip"][row]))
        lines.append(np.stack([layer.r_readout * np.cos(phi), layer.r_readout * np.sin(phi), z], axis=1))
    return lines


def _wires(view: EventView) -> list[Array]:
    layers = {layer.number: layer for layer in wire_layers(view.detector)}
    pairs = zip(view.wire_hits["layer"].tolist(), view.wire_hits["wire"].tolist(), strict=True)
    return [np.array(layers[number].end_points(wire)) for number, wire in pairs]


def _points(plotly: Any, view: EventView) -> list[Any]:
    truths, clusters, crossed = view.truths, view.clusters, view.wire_truths
    seen = np.isfinite(clusters["phi"]) & np.isfinite(clusters["z"])
    real, ghosts = seen & view.shown_clusters(), seen & view.ghosts
    if view.measured:
        others = real & ~view.on_track[0]
        real &= view.on_track[0]
    else:
        others = np.zeros(len(real), np.bool_)
    groups = [
        ("true crossing", _around(truths["r"], truths["phi"], truths["z"]), COLORS["truth"], "circle-open", 6),
        ("cluster", _around(*(clusters[name][real] for name in ("r", "phi", "z"))), COLORS["cgem"], "cross", 4),
        ("cluster on no track", _around(*(clusters[name][others] for name in ("r", "phi", "z"))), GHOST, "circle", 2),
        ("ghost", _around(*(clusters[name][ghosts] for name in ("r", "phi", "z"))), GHOST, "x", 3),
        ("true crossing of a cell", np.stack([crossed[a] for a in "xyz"], 1), COLORS["truth"], "circle-open", 3),
    ]
    return [
        plotly.Scatter3d(
            **_xyz(points), mode="markers", marker={"color": color, "symbol": symbol, "size": size}, name=name
        )
        for name, points, color, symbol, size in groups
        if len(points)
    ]


def _around(r: Array, phi: Array, z: Array) -> Array:
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
