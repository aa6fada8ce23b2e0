"""Pictures of a sweep's table: a scan of one key, a map of two, parallel coordinates of more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from cgemit.draw.style import COLORS, Picture, grid, legend_entries, mathematical, new_picture, style
from cgemit.statistics.formatting import shown

Columns = Mapping[str, Sequence[Any]]

_COLOURS = (COLORS["cgem"], COLORS["idc"], COLORS["truth"], COLORS["single"], COLORS["multi"], COLORS["data"])
_MARKERS = ("o", "s", "D", "^", "v", "P", "X")
_MAP = "viridis"
#: Symbols of the resolutions of a sweep.
GREEK = {"dr": "d_ρ", "dz": "d_z", "pt": r"$p_T$", "phi0": r"$\phi_0$", "theta": "θ", "tanl": "tan λ", "p": "p"}


def draw_sweep(columns: Columns, parameters: Sequence[str], quantity: str, *, kind: str | None = None) -> Picture:
    """Draw one result of a sweep.

    Parameters
    ----------
    columns : mapping of str to list
        The table of a sweep.
    parameters : sequence of str
        Its columns of what is varied.
    quantity : str
        The column to be drawn.
    kind : "scan", "map" or "parallel", optional
        Default: by the number of columns that are varied.

    Raises
    ------
    ValueError
        If there is no such kind, it does not fit the number of parameters, or nothing can be drawn.
    """
    drawers = {"scan": (_scan, 1), "map": (_map, 2), "parallel": (_parallel, None)}
    kind = kind or {1: "scan", 2: "map"}.get(len(parameters), "parallel")
    if kind not in drawers:
        raise ValueError(f"kind: got {kind!r}, expected one of {', '.join(drawers)}")
    draw, count = drawers[kind]
    if count is not None and len(parameters) != count:
        raise ValueError(f"kind: got {kind!r} for {len(parameters)} keys, expected {count}")
    values = np.array([value if isinstance(value, int | float) else np.nan for value in columns[quantity]], np.float64)
    drawn = np.isfinite(values) & (np.array(columns["status"]) == "ok")
    if not (drawn & (np.array(columns["variant"]) > 0)).any():  # the base alone shows no dependence
        raise ValueError(f"{quantity}: got no number to draw, expected at least one variant that could be evaluated")
    with style():
        return draw(columns, tuple(parameters), quantity, values, drawn)


def label(header: str) -> str:
    """Return the header of a column as an axis label: ``cgem.L2.pitch_x (um)`` as ``cgem.L2.pitch_x  (µm)``."""
    name, bracket, unit = header.partition(" (")
    for before in ("delta_sigma_", "sigma_"):
        if name.startswith(before) and name.removeprefix(before) in GREEK:
            inner = f"σ({GREEK[name.removeprefix(before)]})"
            name = mathematical(inner if before == "sigma_" else f"{inner} − base")
    return escaped(name) + (f"  ({shown(unit)}" if bracket else "")


def escaped(text: str) -> str:
    """Return a text in which dollar signs of names are no formula; labels of this module hold complete formulas."""
    return text if text.count("$") == 2 else text.replace("$", r"\$")


def points(columns: Columns) -> list[tuple[str, Any]]:
    """Return each point (momentum and angle) of a table as text with the rows that it has, (n,) bool."""
    names = [name for name in ("p (GeV/c)", "cos_theta") if name in columns]
    rows = list(zip(*(columns[name] for name in names), strict=True)) if names else [()] * len(columns["variant"])
    found = []
    for point in dict.fromkeys(rows):
        texts = {"p (GeV/c)": "p = {} GeV/c", "cos_theta": "cos θ = {}"}
        text = ", ".join(
            texts[name].format(one if isinstance(one, str) else f"{one:g}")
            for name, one in zip(names, point, strict=True)
        )
        found.append((text, np.array([row == point for row in rows])))
    return found


def _ticks(axes: Axes, values: Sequence[Any], axis: str) -> Any:
    """Return positions of a column's values: numbers as they are, words counted and named at the axis."""
    if all(isinstance(value, int | float) for value in values):
        return np.array(values, np.float64)
    words = list(dict.fromkeys(map(str, values)))
    getattr(axes, f"set_{axis}ticks")(range(len(words)), [escaped(word) for word in words])
    return np.array([words.index(str(value)) for value in values], np.float64)


def _scan(columns: Columns, parameters: tuple[str, ...], quantity: str, values: Any, drawn: Any) -> Picture:
    """Draw a quantity against one key, a line for each point; the base is an open marker."""
    picture, (axes,) = new_picture(1, 1, (6.2, 4.4))
    x = _ticks(axes, columns[parameters[0]], "x")
    errors = _errors(columns, quantity)
    variant = np.array(columns["variant"])
    for (text, here), marker, colour in zip(points(columns), cycle(_MARKERS), cycle(_COLOURS), strict=False):
        rows = np.flatnonzero(here & drawn & (variant > 0))
        rows = rows[np.argsort(x[rows], kind="stable")]
        bars = errors[rows] if errors is not None else None
        axes.errorbar(x[rows], values[rows], bars, fmt=f"{marker}-", ms=4.5, lw=1.2, color=colour, label=text or None)
        base = np.flatnonzero(here & drawn & (variant == 0) & np.isfinite(x))
        axes.plot(x[base], values[base], marker, ms=9, mfc="none", mec=colour, mew=1.3)
    axes.plot([], [], "o", ms=9, mfc="none", mec=COLORS["text"], label="base")
    axes.set(xlabel=label(parameters[0]), ylabel=label(quantity))
    grid(axes)
    axes.legend()
    picture.subplots_adjust(left=0.13, right=0.97, top=0.96, bottom=0.13)
    return picture


def _errors(columns: Columns, quantity: str) -> Any:
    name, _, unit = quantity.partition(" (")
    header = f"{name}_error" + (f" ({unit}" if unit else "")
    return np.array(columns[header], np.float64) if header in columns else None


def _map(columns: Columns, parameters: tuple[str, ...], quantity: str, values: Any, drawn: Any) -> Picture:
    """Draw a quantity over two keys, a panel for each point; variants that cannot be built are crosses."""
    panels = points(columns)
    across = min(3, len(panels))
    down = -(-len(panels) // across)
    picture, every = new_picture(down, across, (0.9 + 4.4 * across, 0.3 + 3.7 * down))
    picture.set_layout_engine("constrained")
    variant = np.array(columns["variant"])
    for axes, (text, here) in zip(every, panels, strict=False):
        x, y = (_ticks(axes, columns[name], axis) for name, axis in zip(parameters, "xy", strict=True))
        rows, wrong = here & drawn & (variant > 0), here & ~drawn & (variant > 0)
        _cells(axes, x[here & (variant > 0)], y[here & (variant > 0)], x[rows], y[rows], values[rows], label(quantity))
        axes.plot(x[wrong], y[wrong], "x", color=COLORS["wire"], ms=7, label="not possible" if wrong.any() else None)
        base = here & drawn & (variant == 0)
        axes.plot(x[base], y[base], "o", ms=10, mfc="none", mec=COLORS["fit"], mew=1.6, label="base")
        axes.set(xlabel=label(parameters[0]), ylabel=label(parameters[1]), title=text)
    for axes in every[len(panels) :]:
        axes.set_visible(False)
    entries = legend_entries(every[:1])
    picture.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=2)
    return picture


def _cells(axes: Axes, all_x: Any, all_y: Any, x: Any, y: Any, values: Any, text: str) -> None:
    """Fill the cells of a grid with colours; scattered points are drawn as such."""
    xs, ys = np.unique(all_x), np.unique(all_y)
    if len(xs) * len(ys) == len(all_x) and len(xs) > 1 and len(ys) > 1:
        cells = np.full((len(ys), len(xs)), np.nan)
        cells[np.searchsorted(ys, y), np.searchsorted(xs, x)] = values
        drawn: Any = axes.pcolormesh(xs, ys, cells, cmap=_MAP, shading="nearest")
    else:
        drawn = axes.scatter(x, y, c=values, cmap=_MAP, s=45)
    axes.figure.colorbar(drawn, ax=axes, label=text)


def _parallel(columns: Columns, parameters: tuple[str, ...], quantity: str, values: Any, drawn: Any) -> Picture:
    """Draw a line for each variant through an axis for each key and one for the quantity, at one point."""
    # The first point with a number of any variant.
    varied = drawn & (np.array(columns["variant"]) > 0)
    text, here = next(one for one in points(columns) if (one[1] & varied).any())
    rows = np.flatnonzero(here & varied)
    names = [*parameters, quantity]
    picture, (axes,) = new_picture(1, 1, (max(6.0, 1.9 * len(names)), 4.6))
    scaled, ends = zip(*(unit_scaled(columns[name], rows) for name in names), strict=True)
    shade = Normalize(float(values[rows].min()), float(values[rows].max()))
    colours = mpl.colormaps[_MAP](shade(values[rows]))
    for line, colour in zip(np.array(scaled).T, colours, strict=True):
        axes.plot(range(len(names)), line, color=colour, lw=1.0, alpha=0.75)
    for i, (low, high) in enumerate(ends):
        axes.axvline(i, color=COLORS["wire"], lw=0.9)
        for height, end, side in ((0, low, "top"), (1, high, "bottom")):
            axes.text(i, height + (0.03 if height else -0.03), escaped(end), ha="center", va=side, fontsize=8.4)
    axes.set_xticks(range(len(names)), [label(name).replace("  (", "\n(") for name in names], fontsize=8.4)
    axes.set(ylim=(-0.12, 1.12), xlim=(-0.4, len(names) - 0.6), yticks=[], title=text)
    axes.tick_params(top=False, bottom=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    picture.subplots_adjust(left=0.03, right=0.97, top=0.91, bottom=0.15)
    return picture


def unit_scaled(column: Sequence[Any], rows: Any) -> tuple[Any, tuple[str, str]]:
    """Return a column scaled to 0 to 1, and the texts of its ends; words are counted."""
    chosen = [column[i] for i in rows]
    if not all(isinstance(value, int | float) for value in chosen):
        words = list(dict.fromkeys(map(str, chosen)))
        position = np.array([words.index(str(value)) for value in chosen], np.float64)
        return position / max(1, len(words) - 1), (words[0], words[-1])
    numbers = np.array(chosen, np.float64)
    low, high = float(numbers.min()), float(numbers.max())
    width = high - low
    return ((numbers - low) / width if width else np.full(len(numbers), 0.5)), (f"{low:.5g}", f"{high:.5g}")
