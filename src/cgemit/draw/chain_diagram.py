"""Diagram of the chain: stages and their tables."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from cgemit.draw.style import COLORS, Picture, new_picture, style


class _Box(NamedTuple):
    x: float  # left edge
    y: float  # lower edge
    title: str
    lines: tuple[str, ...]
    stage: bool  # a stage, else a table


_WIDTH, _HEIGHT = 2.15, 1.05
_TABLE, _STAGE = "#F4F6F9", "#DCEBF8"

# Two rows, read like text: simulation above, reconstruction below.
_BOXES = (
    _Box(0.0, 2.6, "Gun", ("particle, p, angles, vertex", "or a table of particles"), True),
    _Box(2.75, 2.6, "particles", ("vertex, momentum",), False),
    _Box(5.5, 2.6, "simulate", ("helix, scattering, energy loss,", "ionization, delta electrons"), True),
    _Box(
        8.25,
        2.6,
        "truths, steps, wire_truths",
        ("crossings of gaps, deposits of", "delta electrons, drift cells"),
        False,
    ),
    _Box(11.0, 2.6, "digitize", ("projection to the anode,", "strips, drift distances"), True),
    _Box(11.0, 0.2, "digis, wire_hits", ("fired strips and cells", "with charge and time"), False),
    _Box(8.25, 0.2, "cluster", ("contiguous strips,", "X, V and XV positions"), True),
    _Box(5.5, 0.2, "clusters", ("phi and z at mid-gap", "with their errors"), False),
    _Box(2.75, 0.2, "find and fit", ("candidates; Kalman filter", "to the origin, smoother"), True),
    _Box(0.0, 0.2, "tracks", ("helix, covariance;", "matched with particles"), False),
)


def draw_chain() -> Picture:
    """Draw the stages of the chain and the tables between them.

    Returns
    -------
    Picture

    Examples
    --------
    >>> picture = cg.draw.draw_chain()
    >>> [file.name for file in picture.save("chain.png")]
    ['chain.png']
    """
    with style():
        picture, (axes,) = new_picture(1, 1, (12.0, 3.6))
        for box in _BOXES:
            _draw_box(axes, box)
        for start, end in itertools.pairwise(_BOXES):
            _draw_arrow(axes, start, end)
        _detector_bar(axes)
        axes.set(xlim=(-0.15, 13.3), ylim=(0.0, 3.85), aspect="equal")
        axes.axis("off")
        picture.subplots_adjust(left=0.01, right=0.99, top=0.99, bottom=0.01)
    return picture


def _draw_box(axes: Axes, box: _Box) -> None:
    colour = _STAGE if box.stage else _TABLE
    axes.add_patch(
        FancyBboxPatch(
            (box.x, box.y),
            _WIDTH,
            _HEIGHT,
            boxstyle=f"round,pad=0,rounding_size={0.25 if box.stage else 0.02}",
            facecolor=colour,
            edgecolor=COLORS["cgem"] if box.stage else "#8793A0",
            linewidth=1.2,
        )
    )
    x = box.x + _WIDTH / 2
    weight = "bold" if box.stage else "normal"
    size = 10.5 if len(box.title) < 22 else 9.5
    axes.text(x, box.y + 0.79, box.title, ha="center", va="center", fontsize=size, weight=weight)
    for number, line in enumerate(box.lines):
        axes.text(x, box.y + 0.48 - 0.25 * number, line, ha="center", va="center", fontsize=8.2, color="#555555")


def _draw_arrow(axes: Axes, start: _Box, end: _Box) -> None:
    middle = _HEIGHT / 2
    if start.y != end.y:
        tail, head = (start.x + _WIDTH / 2, start.y), (end.x + _WIDTH / 2, end.y + _HEIGHT)
    elif end.x > start.x:
        tail, head = (start.x + _WIDTH, start.y + middle), (end.x, end.y + middle)
    else:
        tail, head = (start.x, start.y + middle), (end.x + _WIDTH, end.y + middle)
    _arrow(axes, tail, head, "#555555")


def _detector_bar(axes: Axes) -> None:
    """Draw the one description that all stages read."""
    low, high, middle = 1.66, 2.19, 6.575
    box = FancyBboxPatch((2.75, low), 7.65, high - low, boxstyle="round,pad=0,rounding_size=0.1")
    box.set(facecolor="#FFF4E0", edgecolor=COLORS["single"], linewidth=1.2)
    axes.add_patch(box)
    text = "Detector: one immutable description (TOML), read by every stage"
    axes.text(middle, 0.5 * (low + high), text, ha="center", va="center", fontsize=9)
    _arrow(axes, (middle, high), (middle, 2.6), COLORS["single"])
    for x in (9.325, 3.825):
        _arrow(axes, (x, low), (x, 0.2 + _HEIGHT), COLORS["single"])
    _arrow(axes, (10.4, 1.925), (11.3, 2.6), COLORS["single"], bend=0.2)


def _arrow(axes: Axes, tail: tuple[float, float], head: tuple[float, float], colour: str, bend: float = 0.0) -> None:
    options: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 12, "connectionstyle": f"arc3,rad={bend}"}
    axes.add_patch(FancyArrowPatch(tail, head, color=colour, lw=1.2, shrinkA=1, shrinkB=1, **options))
