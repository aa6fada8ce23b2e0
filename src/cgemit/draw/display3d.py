"""The event display in three dimensions: a plotly figure, and a page that needs no network."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cgemit.draw.display import GHOST, TRACK_COLORS, track_label
from cgemit.draw.event_view import EventView, strip_line, view_of
from cgemit.draw.geometry import Array, wire_layers
from cgemit.draw.style import COLORS
from cgemit.io import new_file

if TYPE_CHECKING:
    from cgemit.result import Result

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
    """
    plotly = _plotly()
    view = view_of(result, number)
    figure = plotly.Figure([*_cylinders(plotly, view), *_lines(plotly, view), *_points(plotly, view)])
    axis = {"backgroundcolor": "#FFFFFF", "gridcolor": COLORS["grid"], "zerolinecolor": COLORS["grid"]}
    axes = {f"{name}axis": {"title": {"text": f"{name} (mm)"}, **axis} for name in "xyz"}
    figure.update_layout(
        title={"text": f"{view.detector.name}, event {number}: {view.shot()}"}, template="none", margin={"t": 50},
        scene={**axes, "aspectmode": "data", "camera": {"up": {"x": 0, "y": 1, "z": 0}}},
        legend={"itemsizing": "constant"},
    )  # fmt: skip
    return figure


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
    """
    title = figure.layout.title.text.replace("<", "&lt;")
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
    parts = [("beam pipe", part.r_out, part.half_length, "#8A95A1") for part in view.detector.beam_pipe[:1]]
    parts += [(layer.label, layer.r_mid, layer.half_length, "#7FB2DC") for layer in view.detector.cgem]
    found = []
    for name, radius, half, color in parts:
        z = np.array([[-half], [half]])
        x, y = (np.broadcast_to(radius * f(_TURN), (2, len(_TURN))) for f in (np.cos, np.sin))
        found.append(plotly.Surface(
            x=x, y=y, z=np.broadcast_to(z, x.shape), opacity=0.18, showscale=False, colorscale=[[0, color], [1, color]],
            name=name, showlegend=True, hoverinfo="skip",
        ))  # fmt: skip
    return found


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
    groups += [(track_label(path.p), path.points, TRACK_COLORS[path.row % len(TRACK_COLORS)], 5) for path in view.paths]
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
        layer = view.detector.cgem[digis["layer"][row]]
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
    groups = [
        ("true crossing", _around(truths["r"], truths["phi"], truths["z"]), COLORS["truth"], "circle-open", 6),
        ("CGEM cluster", _around(*(clusters[name][real] for name in ("r", "phi", "z"))), COLORS["cgem"], "cross", 4),
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
