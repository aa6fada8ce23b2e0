"""Pulls, residuals and choices of the fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from cgemit.draw.style import COLORS, Picture, grid, legend_entries, new_picture, style
from cgemit.reconstruction.fit import LOSSES
from fit_results import ANGLES, DETECTORS, MOMENTA, PARTICLES, FitResults, Pull
from optimal import QUANTITIES

_ANGLE_COLOURS = dict(zip(ANGLES, (COLORS["x"], COLORS["single"], COLORS["fit"]), strict=True))
_MARKERS = {"mu-": "o", "mu+": "s", "pi-": "^", "pi+": "v", "K-": "P", "proton": "D"}
_LOSS_COLOURS = dict(zip(LOSSES, (COLORS["fit"], COLORS["x"], COLORS["truth"]), strict=True))


def draw_pulls(results: FitResults) -> Picture:
    """Draw widths and means of the pulls of the reference detector against momentum; grey is what is allowed."""
    rows = [row for row in results.pulls if row.detector == DETECTORS[0]]
    with style():
        picture, axes = new_picture(4, 6, (16.8, 9.4))
        panels = [("gaussian", "width"), ("gaussian", "mean"), ("default", "width"), ("default", "mean")]
        plots = iter(axes)
        for mode, quantity in panels:
            for name in QUANTITIES:
                plot = next(plots)
                _points(plot, [row for row in rows if (row.mode, row.parameter) == (mode, name)], quantity)
                low, high = (0.85, 1.15) if quantity == "width" else (-0.2, 0.2)  # what fails by far is in the table
                plot.set(title=f"{name}, {mode}", ylabel=f"{quantity} of the pull", ylim=(low, high))
        entries = legend_entries(axes)
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=6)
        picture.subplots_adjust(left=0.05, right=0.99, top=0.96, bottom=0.11, wspace=0.38, hspace=0.45)
    return picture


def _points(plot: Axes, rows: Sequence[Pull], quantity: str) -> None:
    which = ("width", "mean").index(quantity)
    centre = 1.0 - which
    for row in rows:
        shift = 0.16 * ANGLES.index(row.cos_theta) - 0.22 + 0.025 * list(_MARKERS).index(row.particle)
        x = MOMENTA.index(row.p) + shift
        allowed = row.tolerances[which]
        plot.fill_between((x - 0.02, x + 0.02), centre - allowed, centre + allowed, color=COLORS["matter"], lw=0)
        value, error = getattr(row, quantity), getattr(row, f"{quantity}_error")
        colour = _ANGLE_COLOURS[row.cos_theta]
        label = f"{row.particle}, cos θ = {row.cos_theta:g}"
        plot.errorbar(x, value, error, fmt=_MARKERS[row.particle], color=colour, ms=2.5, lw=0.8, label=label)
    plot.axhline(centre, color=COLORS["data"], lw=0.8)
    plot.set_xticks(range(len(MOMENTA)), [f"{p:g}" for p in MOMENTA])
    plot.set_xlabel("p  (GeV/c)")
    grid(plot)


def draw_residuals(results: FitResults) -> Picture:
    """Draw width and mean of the pull of every hit against the track without it, layer by layer, mu-."""
    rows = [row for row in results.residuals if row.particle == "mu-" and row.cos_theta == 0 and row.p > 0.15]
    names = list(dict.fromkeys(row.parameter for row in rows))
    names.sort(key=lambda name: ("xvw".index(name[0]) == 2, int(name[1:]), name[0]))
    with style():
        picture, axes = new_picture(2, 1, (13.0, 6.0))
        for plot, quantity in zip(axes, ("width", "mean"), strict=True):
            for number, p in enumerate(PARTICLES["mu-"][1:]):
                found = {row.parameter: row for row in rows if row.p == p}
                x = [i + 0.15 * number - 0.22 for i, name in enumerate(names) if name in found]
                y = [getattr(found[name], quantity) for name in names if name in found]
                error = [getattr(found[name], f"{quantity}_error") for name in names if name in found]
                colour = list(COLORS.values())[number]
                plot.errorbar(x, y, error, fmt="o", ms=2.5, lw=0.8, color=colour, label=f"{p:g} GeV/c")
            centre = 1.0 if quantity == "width" else 0.0
            plot.axhspan(centre - 0.02, centre + 0.02, color=COLORS["matter"], lw=0, zorder=0)
            plot.set(ylabel=f"{quantity} of the residual's pull", xlim=(-0.7, len(names) - 0.3))
            plot.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
            grid(plot)
        axes[0].set_title(f"{DETECTORS[0]}, mu-, cos θ = 0, all Gaussian: each hit against the track without it")
        axes[1].set_xlabel("layer: X and V of the CGEM, wires")
        axes[0].legend(ncols=4, loc="upper right")
        picture.subplots_adjust(left=0.06, right=0.99, top=0.95, bottom=0.11, hspace=0.25)
    return picture


def draw_choices(results: FitResults) -> Picture:
    """Draw the core of the pull of kappa for each loss, wrong sides, and widths over the optimum."""
    with style():
        picture, axes = new_picture(1, 4, (14.0, 4.0))
        _draw_losses(axes[0], axes[1], results)
        _draw_sides(axes[2], results)
        _draw_widths(axes[3], results)
        picture.subplots_adjust(left=0.05, right=0.99, top=0.92, bottom=0.14, wspace=0.3)
    return picture


def _draw_losses(left: Axes, right: Axes, results: FitResults) -> None:
    for plot, quantity in ((left, "width"), (right, "mean")):
        for loss, colour in _LOSS_COLOURS.items():
            rows = [row for row in results.losses if row.loss == loss]
            y, error = ([getattr(row, name) for row in rows] for name in (quantity, f"{quantity}_error"))
            plot.errorbar([row.p for row in rows], y, error, fmt="o-", ms=4, lw=1, color=colour, label=loss)
        plot.axhline(1 if quantity == "width" else 0, color=COLORS["data"], lw=0.8)
        plot.set(
            xscale="log", xlabel="p  (GeV/c)", ylabel=f"core {quantity} of the pull of kappa", title="loss subtracted"
        )
        grid(plot)
    left.legend()


def _draw_sides(plot: Axes, results: FitResults) -> None:
    for p, colour in zip(dict.fromkeys(row.p for row in results.sides), (COLORS["x"], COLORS["fit"]), strict=False):
        rows = [row for row in results.sides if row.p == p and row.wrong > 0]
        middle = [0.5 * (row.first + row.last) for row in rows]
        share = np.array([row.wrong / row.n for row in rows])
        error = np.sqrt([row.wrong for row in rows]) / [row.n for row in rows]
        plot.errorbar(middle, share, error, fmt="o", ms=4, lw=1, color=colour, label=f"{p:g} GeV/c")
    plot.axhline(1e-3, color=COLORS["data"], lw=0.8, ls="--", xmin=0.35)
    plot.set(xscale="log", yscale="log", ylim=(1e-6, 1), xlabel="drift distance  (mm)", ylabel="wrong sides")
    plot.set_title("sides found by the fit")
    plot.legend()
    grid(plot)


def _draw_widths(plot: Axes, results: FitResults) -> None:
    for name, colour in (("dr", COLORS["x"]), ("dz", COLORS["single"]), ("p", COLORS["fit"])):
        rows = [row for row in results.widths if row.quantity == name]
        plot.errorbar(range(len(rows)), [row.ratio for row in rows], [row.ratio_error for row in rows], fmt="o", ms=2.5,
                      lw=0.7, color=colour, label=name)  # fmt: skip
    plot.axhspan(0.97, 1.03, color=COLORS["matter"], lw=0, zorder=0)
    plot.axhline(1, color=COLORS["data"], lw=0.8)
    plot.set(xlabel="point of the grid", ylabel="core width over optimum", title="against the optimal estimate")
    plot.set_ylim(0.94, 1.06)
    plot.legend(ncols=3)
    grid(plot)
