"""The event display: one event in r-phi, magnified around the CGEM, and in r-z."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.patches import Rectangle, Wedge

from cgemit.draw.geometry import helix_points, wire_layers, wire_positions, wire_profile
from cgemit.draw.style import COLORS, Picture, legend_entries, new_picture, plain, style
from cgemit.tables import Table

if TYPE_CHECKING:
    from cgemit.detector import Detector
    from cgemit.result import Result

_TRACK_COLORS = ("#CC3311", "#7A3E9D", "#117733", "#AA7700", "#0077BB")
_FALLBACK_SIZE = 200.0  # mm, of a detector without cylinders


def draw_event(result: Result, event: int = 0) -> Picture:
    """Draw one event of a result: detector, true crossings, clusters, drift circles and fitted tracks.

    A track is drawn as the helix it has at the beam line; slow ones lose energy and bend more further out.

    Parameters
    ----------
    result : Result
    event : int
        Number of the event.

    Returns
    -------
    Picture
        r-phi, r-phi around the CGEM, r-z.

    Raises
    ------
    ValueError
        If the result has no such event.
    """
    view = _rows_of(result, event)
    detector = result.detector
    with style():
        picture, axes = new_picture(1, 3, (13.2, 4.9))
        reach = _reach(detector)
        for plot in axes[:2]:
            _transverse_detector(plot, detector)
            _transverse_hits(plot, view, magnified=plot is axes[1])
            _drift_circles(plot, detector, view)
            _frame(plot, "x  (mm)", "y  (mm)")
        _limit(axes[0], *_window(view, reach.r))
        _limit(axes[1], (0.0, 0.0), 1.1 * max((layer.r_out for layer in detector.cgem), default=0.3 * reach.r))
        _longitudinal_detector(axes[2], detector)
        _longitudinal_hits(axes[2], view)
        _frame(axes[2], "z  (mm)", "r  (mm)")
        axes[2].set(xlim=(-1.03 * reach.z, 1.03 * reach.z), ylim=(0, 1.03 * reach.r))
        _tracks(axes, detector, view, reach)
        titles = (f"{plain(detector.name)}, event {event}", "inner layers", "side view")
        for plot, title in zip(axes, titles, strict=True):
            plot.set_title(title, loc="left")
        _legend(picture, axes)
        picture.subplots_adjust(left=0.055, right=0.99, top=0.93, bottom=0.19, wspace=0.22)
    return picture


def _legend(picture: Picture, axes: Sequence[Axes]) -> None:
    entries = legend_entries(axes)
    picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=6)


def _limit(axes: Axes, centre: tuple[float, float], half: float) -> None:
    axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - half, centre[1] + half), aspect="equal")


def _window(view: _View, r_max: float) -> tuple[tuple[float, float], float]:
    """Return centre and half width of a square that holds the beam line and all hits, mm."""
    hits = [(0.0, 0.0), *zip(view.wire_truths["x"].tolist(), view.wire_truths["y"].tolist(), strict=True)]
    x, y = np.array(hits).T
    if len(hits) == 1:
        return (0.0, 0.0), 1.03 * r_max
    half = 0.56 * max(np.ptp(x), np.ptp(y))
    return (float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2), float(half)


class _View(NamedTuple):
    """The rows of one event."""

    truths: Table
    clusters: Table
    wire_hits: Table
    wire_truths: Table
    wire_truth_first: int  # row of the first of them in the whole table, which links count from
    tracks: Table


class _Reach(NamedTuple):
    r: float  # mm
    z: float  # mm


def _rows_of(result: Result, event: int) -> _View:
    first, n = result.first_event, result.n_events
    if not first <= event < first + n:
        raise ValueError(f"event: got {event}; expected a number from {first} to {first + n - 1}")
    truths, clusters, wire_hits, wire_truths, tracks = (
        result.tables.get(name, Table.empty(name, n, first)).select_events(event, event + 1)  # a run may end early
        for name in ("truths", "clusters", "wire_hits", "wire_truths", "tracks")
    )
    return _View(truths, clusters, wire_hits, wire_truths, int(result.wire_truths.offsets[event - first]), tracks)


def _reach(detector: Detector) -> _Reach:
    wires = wire_layers(detector)
    r = [part.r_out for part in (*detector.beam_pipe, *detector.walls)] + [layer.r_out for layer in detector.cgem]
    z = [layer.half_length for layer in detector.cgem] + [layer.half_length for layer in wires]
    r += [layer.r_end for layer in wires]
    return _Reach(max(r, default=_FALLBACK_SIZE), max(z, default=_FALLBACK_SIZE))


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
        axes.plot(x, y, ".", ms=1.7, color="#8A95A1", mew=0, zorder=0.5)


def _longitudinal_detector(axes: Axes, detector: Detector) -> None:
    for layer in detector.cgem:
        corner = (-layer.half_length, layer.r_in)
        axes.add_patch(Rectangle(corner, 2 * layer.half_length, layer.r_out - layer.r_in, color="#B7D5EF", lw=0))
    for part in (*detector.beam_pipe, *detector.walls):
        corner = (-part.half_length, part.r_in)
        axes.add_patch(Rectangle(corner, 2 * part.half_length, max(part.thickness, 0.8), color=COLORS["matter"], lw=0))
    lines = [np.column_stack(wire_profile(layer)) for layer in wire_layers(detector)]
    axes.add_collection(LineCollection(lines, colors="#E1E5EA", linewidths=0.6))


def _transverse_hits(axes: Axes, view: _View, *, magnified: bool) -> None:
    truths, clusters = view.truths, view.clusters
    if not len(truths) and not len(clusters):
        return
    axes.plot(
        truths["r"] * np.cos(truths["phi"]), truths["r"] * np.sin(truths["phi"]), "o", ms=9 if magnified else 5,
        mfc="none", mec=COLORS["truth"], mew=1.3, label="true crossing", zorder=4,
    )  # fmt: skip
    seen = np.isfinite(clusters["phi"]) & _best_view(clusters)
    r, phi = clusters["r"][seen], clusters["phi"][seen]
    axes.plot(
        r * np.cos(phi), r * np.sin(phi), "P", ms=7 if magnified else 4, color=COLORS["cgem"], mec="white", mew=0.5,
        label="CGEM cluster", zorder=5,
    )  # fmt: skip


def _best_view(clusters: Table) -> npt.NDArray[np.bool_]:
    """Return which clusters to draw: the XV ones, or those of one view where no XV cluster holds them."""
    used = np.concatenate([clusters["x_cluster"], clusters["v_cluster"]])
    rows = np.arange(len(clusters))
    # Links count rows of the whole table; within one event only their differences matter, and XV clusters come last.
    first = used[used >= 0].min() if (used >= 0).any() else 0
    held = np.isin(rows, used[used >= 0] - first)
    return np.asarray((clusters["view"] == 2) | ~held)


def _drift_circles(axes: Axes, detector: Detector, view: _View) -> None:
    hits = view.wire_hits
    if not len(hits):
        return
    layers = {layer.number: layer for layer in wire_layers(detector)}
    truth = hits["wire_truth"] - view.wire_truth_first
    z = view.wire_truths["z"][truth]
    centres = np.empty((len(hits), 2))
    for number in np.unique(hits["layer"]):
        rows = hits["layer"] == number
        centres[rows] = np.column_stack(wire_positions(layers[number], hits["wire"][rows], z[rows]))
    size = 2 * np.abs(hits["drift"])
    circles = EllipseCollection(
        size, size, np.zeros(len(hits)), units="xy", offsets=centres, offset_transform=axes.transData,
        facecolors="none", edgecolors=COLORS["idc"], linewidths=1.1, zorder=2.5,
    )  # fmt: skip
    axes.add_collection(circles)
    axes.plot([], [], "o", ms=8, mfc="none", mec=COLORS["idc"], label="drift circle")


def _longitudinal_hits(axes: Axes, view: _View) -> None:
    truths, clusters = view.truths, view.clusters
    axes.plot(truths["z"], truths["r"], "o", ms=7, mfc="none", mec=COLORS["truth"], mew=1.3, zorder=4)
    seen = np.isfinite(clusters["z"])
    axes.plot(clusters["z"][seen], clusters["r"][seen], "P", ms=6, color=COLORS["cgem"], mec="white", mew=0.5, zorder=5)
    passages = view.wire_truths
    axes.plot(passages["z"], np.hypot(passages["x"], passages["y"]), "o", ms=3.5, mfc="none", color=COLORS["idc"])


def _tracks(axes: Sequence[Axes], detector: Detector, view: _View, reach: _Reach) -> None:
    names = ("dr", "phi0", "kappa", "dz", "tanl")
    fitted = np.isfinite(view.tracks["kappa"]) & (view.tracks["status"] == 0)
    for number, row in enumerate(np.flatnonzero(fitted)):
        helix = np.array([view.tracks[name][row] for name in names])
        x, y, z = helix_points(helix, detector.field.bz, reach.r, reach.z)
        p = view.tracks["p"][row]
        line: dict[str, Any] = {"color": _TRACK_COLORS[number % len(_TRACK_COLORS)], "lw": 1.4, "zorder": 3}
        axes[0].plot(x, y, label=f"fitted helix, p = {p:.3f} GeV/c", **line)
        axes[1].plot(x, y, **line)
        axes[2].plot(z, np.hypot(x, y), **line)


def _frame(axes: Axes, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.tick_params(length=3)
