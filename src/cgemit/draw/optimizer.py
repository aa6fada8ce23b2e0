"""Pictures of an optimization's table: convergence, fronts of pairs of objectives, parallel coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import Normalize

from cgemit.draw.style import COLORS, Picture, grid, legend_entries, mathematical, new_picture, style
from cgemit.draw.sweeps import GREEK, Columns, escaped, unit_scaled
from cgemit.statistics.formatting import shown

_MAP = "viridis"
_NAMES = {
    "x0": "X/X₀ of the CGEM", "area": "read-out area", "gap": "smallest gap", "pt_threshold": "threshold in $p_T$",
    "outer_radius": "outer radius", "inner_radius": "inner radius",
}  # fmt: skip
#: Most lines of parallel coordinates that can be told apart.
_LINES = 300


def label(header: str) -> str:
    """Return the header of a column as an axis label: ``sigma_dr at 1 GeV/c (um)`` as ``σ(d_ρ) at 1 GeV/c  (µm)``."""
    name, bracket, unit = header.partition(" (")
    quantity, at, point = name.partition(" at ")
    symbol = quantity.removeprefix("sigma_")
    if quantity.startswith("sigma_") and symbol in GREEK:
        text = mathematical(f"σ({GREEK[symbol]})") + at + point
    else:
        text = _NAMES.get(name) or escaped(name)
    return text + (f"  ({shown(unit)}" if bracket else "")


def draw_convergence(columns: Columns, objective: str, error: str | None, title: str) -> Picture:
    """Draw the objective of every design and the best one so far.

    Parameters
    ----------
    columns : mapping of str to list
        The table of an optimization.
    objective : str
        Its column.
    error : str or None
        The column of its errors.
    title : str
    """
    values, allowed = np.array(columns[objective], np.float64), np.array(columns["allowed"], bool)
    number = np.array(columns["design"])
    good, wrong = allowed & np.isfinite(values), ~allowed & np.isfinite(values)
    if not (good | wrong).any():
        raise ValueError(f"{objective}: got no design that could be evaluated, expected at least one")
    with style():
        picture, (axes,) = new_picture(1, 1, (6.6, 4.4))
        if wrong.any():
            axes.plot(number[wrong], values[wrong], "x", color=COLORS["wire"], ms=6, label="outside of limits")
        fixed = good & (np.array(columns["kind"]) == "step")
        own = good & ~fixed
        bars = np.array(columns[error], np.float64)[own] if error else None
        axes.errorbar(number[own], values[own], bars, fmt="o", ms=4.5, color=COLORS["cgem"], label="allowed")
        if fixed.any():
            axes.plot(number[fixed], values[fixed], "o", ms=4.5, mfc="white", mec=COLORS["cgem"],
                      label="allowed, with the hits of another design")  # fmt: skip
        best = np.fmin.accumulate(np.where(good, values, np.nan))
        axes.step(number, best, where="post", color=COLORS["idc"], lw=1.4, label="best allowed design so far")
        axes.set(xlabel="evaluated designs (0: base)", ylabel=label(objective))
        axes.set_title(escaped(title), loc="left", fontsize=9.5)
        grid(axes)
        axes.legend()
        picture.subplots_adjust(left=0.13, right=0.97, top=0.92, bottom=0.12)
    return picture


def draw_hypervolume(growth: Sequence[tuple[int, int, float]], error: float, title: str) -> Picture:
    """Draw the hypervolume of the front against the number of designs.

    Parameters
    ----------
    growth : sequence of (int, int, float)
        Call, number of designs, hypervolume.
    error : float
        Of the last hypervolume.
    title : str
    """
    designs, volumes = np.array([one[1] for one in growth]), np.array([one[2] for one in growth])
    last = volumes[-1] or 1.0
    with style():
        picture, (axes,) = new_picture(1, 1, (6.6, 4.4))
        axes.plot(designs, volumes / last, "-", color=COLORS["cgem"], lw=1.5, label="front of all designs so far")
        axes.errorbar(designs[-1:], volumes[-1:] / last, [error / last], fmt="o", ms=5, capsize=3, color=COLORS["cgem"],
                      label="error from the sample of tracks")  # fmt: skip
        axes.set(xlabel="evaluated designs", ylabel="hypervolume / its last value", ylim=(0, 1.08))
        axes.set_title(escaped(title), loc="left", fontsize=9.5)
        grid(axes)
        axes.legend(loc="lower right")
        picture.subplots_adjust(left=0.12, right=0.97, top=0.92, bottom=0.12)
    return picture


def draw_front(columns: Columns, objectives: Sequence[str], errors: Sequence[str | None], title: str) -> Picture:
    """Draw designs in the plane of each pair of objectives; the front is coloured by the third one.

    Parameters
    ----------
    columns : mapping of str to list
        The table of an optimization.
    objectives, errors : sequence of str
        Its columns of the objectives and their errors (None: no error).
    title : str

    Raises
    ------
    ValueError
        If there is only one objective, or no design is allowed.
    """
    kind = np.array(columns["front"], dtype=object)
    loose, tied = kind == "front within errors", kind == "within errors"
    front = (kind == "front") | loose
    allowed = np.array(columns["allowed"], bool)
    if len(objectives) < 2 or not front.any():
        raise ValueError("front: got one objective or no allowed design, expected several objectives and a design")
    values = [np.array(columns[name], np.float64) for name in objectives]
    pairs = list(combinations(range(len(objectives)), 2))
    with style():
        picture, every = new_picture(1, len(pairs), (0.6 + 4.7 * len(pairs), 4.9))
        picture.set_layout_engine("constrained")
        for axes, (i, k) in zip(every, pairs, strict=True):
            x, y = values[i], values[k]
            rest = allowed & ~front & ~tied
            axes.plot(x[rest], y[rest], ".", ms=2.5, color=COLORS["matter"], label="other allowed designs")
            if tied.any():
                axes.plot(x[tied], y[tied], ".", ms=5, color=COLORS["multi"], label="dominated by less than errors")
            across, up = (_errors(columns, errors[one], front) for one in (i, k))
            axes.errorbar(x[front], y[front], up, across, fmt="none", ecolor=COLORS["wire"], lw=0.7, zorder=2)
            others = [m for m in range(len(values)) if m not in (i, k)]
            if others:
                colour: Any = {"c": values[others[0]][front], "cmap": _MAP}
            else:
                colour = {"color": COLORS["cgem"]}
            drawn = axes.scatter(x[front], y[front], s=17, zorder=3, label="front", **colour)
            if others:
                picture.colorbar(drawn, ax=axes, label=label(objectives[others[0]]))
            if loose.any():
                axes.plot(x[loose], y[loose], "o", ms=6.5, mfc="none", mec=COLORS["wire"], mew=0.6, zorder=2.5,
                          label="of the front by less than errors")  # fmt: skip
            axes.plot(x[:1], y[:1], "*", ms=12, mfc="white", mec=COLORS["fit"], mew=1.4, zorder=4, label="base")
            _near(axes, x, y, front | tied)
            axes.set(xlabel=label(objectives[i]), ylabel=label(objectives[k]))
            grid(axes)
        entries = legend_entries(every[:1])
        picture.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=4, markerscale=1.3)
        picture.suptitle(escaped(title), fontsize=9.5)
    return picture


def _errors(columns: Columns, name: str | None, rows: Any) -> Any:
    return np.array(columns[name], np.float64)[rows] if name else None


def _near(axes: Any, x: Any, y: Any, rows: Any) -> None:
    """Show the front and the base with some space around them; bad designs are far away."""
    chosen = rows.copy()
    chosen[0] = np.isfinite(x[0] + y[0])
    for values, limits in ((x[chosen], axes.set_xlim), (y[chosen], axes.set_ylim)):
        low, high = float(values.min()), float(values.max())
        space = 0.12 * (high - low) or 0.05 * abs(high) or 1.0
        limits(low - space, high + 1.5 * space)


def draw_parallel(
    columns: Columns, names: Sequence[str], title: str, *, colour_by: str, best: Sequence[int]
) -> Picture:
    """Draw a line for each of the best designs through an axis for each variable and objective.

    Parameters
    ----------
    columns : mapping of str to list
        The table of an optimization.
    names : sequence of str
        Columns, from left to right.
    title : str
    colour_by : str
        The column that gives the colours.
    best : sequence of int
        Rows.

    Raises
    ------
    ValueError
        If there are no rows.
    """
    if not best:
        raise ValueError("parallel: got no allowed design, expected at least one")
    rows = np.array(best)[np.linspace(0, len(best) - 1, min(len(best), _LINES)).round().astype(int)]
    values = np.array([columns[colour_by][i] for i in rows], np.float64)
    with style():
        picture, (axes,) = new_picture(1, 1, (max(6.4, 0.8 + 1.35 * len(names)), 4.9))
        scaled, ends = zip(*(unit_scaled(columns[name], rows) for name in names), strict=True)
        colours = mpl.colormaps[_MAP](Normalize(values.min(), values.max())(values))
        for line, colour in zip(np.array(scaled).T, colours, strict=True):
            axes.plot(range(len(names)), line, color=colour, lw=1.1, alpha=0.8)
        for i, (low, high) in enumerate(ends):
            axes.plot([i, i], [0, 1], color=COLORS["wire"], lw=0.9)
            for height, end, side in ((-0.03, low, "top"), (1.03, high, "bottom")):
                axes.text(i, height, escaped(end), ha="center", va=side, fontsize=8.4)
        ticks = [_broken(label(name)) for name in names]
        axes.set_xticks(range(len(names)), ticks, fontsize=8.0)
        axes.set(ylim=(-0.12, 1.12), xlim=(-0.5, len(names) - 0.5), yticks=[])
        axes.set_title(escaped(title), loc="left", fontsize=9.5)
        axes.tick_params(top=False, bottom=False)
        for spine in axes.spines.values():
            spine.set_visible(False)
        picture.subplots_adjust(left=0.02, right=0.98, top=0.92, bottom=0.17)
    return picture


def _broken(text: str) -> str:
    """Return a label on several lines: keys break at their last dot, units and points of a resolution follow below."""
    name, bracket, unit = text.partition("  (")
    if "." in name and "$" not in name:
        first, _, last = name.rpartition(".")
        name = f"{first}.\n{last}"
    return name.replace(" at ", "\nat ") + (f"\n({unit}" if bracket else "")
