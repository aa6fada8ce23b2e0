"""cgemit and Geant4 on the same axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from cgemit.draw.style import COLORS, Picture, grid, legend_entries, new_picture, style
from cgemit.simulation.slab import SlabResult
from geant4_reference import ANGLES, TITLES, Comparison, references

_MOMENTA = {0.1: COLORS["single"], 0.2: COLORS["x"], 1.0: COLORS["fit"]}
_NAMES = {"q68_mrad": "q68", "q98_mrad": "q98 / 2.326", "q999_mrad": "q99.9 / 3.291"}
_INSIDE = {"q68_mrad": (0.6827, 1.0), "q98_mrad": (0.98, 2.326), "q999_mrad": (0.999, 3.291)}
_QUANTILES = {"q01": 0.01, "q16": 0.16, "q50": 0.5, "q84": 0.84, "q99": 0.99}
#: Geant4's other models, drawn as ratios to its single scattering: marker and colour.
_OTHERS = {
    "WVI 10 steps": ("v", COLORS["multi"]),
    "WVI 1 step": ("^", COLORS["x"]),
    "Urban 1 step": ("s", COLORS["wire"]),
}


def draw_scattering_ratios(rows: Sequence[Comparison]) -> Picture:
    """Draw widths of the plane angle over those of Geant4's single scattering; the band is what is allowed."""
    single = [row for row in rows if row.model == "SS"]
    places = list(dict.fromkeys((row.slab, row.p) for row in single))
    with style():
        picture, axes = new_picture(1, 3, (13.4, 5.0))
        for plot, name in zip(axes, ANGLES, strict=True):
            found = {(row.slab, row.p, row.screening): row for row in single if row.quantity == name}
            for i, (slab, p) in enumerate(places):
                row = found[slab, p, "wentzel"]
                _band(plot, i, row)
                _point(plot, i - 0.2, row, "o", COLORS["fit"], "cgemit, wentzel")
                _point(plot, i, found[slab, p, "moliere"], "D", COLORS["truth"], "cgemit, moliere")
            _others(plot, rows, name, places)
            plot.axhline(1, color=COLORS["data"], lw=0.9)
            plot.set(title=_NAMES[name], ylabel="ratio to Geant4 single scattering", xlim=(-0.6, len(places) - 0.4))
            labels = [f"{TITLES[slab]}, {p:g} GeV/c" for slab, p in places]
            plot.set_xticks(range(len(places)), labels, rotation=35, ha="right", fontsize=8)
            grid(plot)
        entries = legend_entries(axes)
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=5)
        picture.subplots_adjust(left=0.055, right=0.99, top=0.93, bottom=0.31, wspace=0.24)
    return picture


def _point(plot: Axes, x: float, row: Comparison, marker: str, colour: str, label: str) -> None:
    plot.errorbar(x, row.ratio, row.ratio_error, fmt=marker, color=colour, ms=5, lw=1.1, label=label, zorder=4)


def _band(plot: Axes, x: float, row: Comparison) -> None:
    """Draw what is allowed."""
    plot.fill_between((x - 0.42, x + 0.42), 1 - row.allowed, 1 + row.allowed, color=COLORS["matter"], lw=0)


def _others(plot: Axes, rows: Sequence[Comparison], name: str, places: Sequence[tuple[str, float]]) -> None:
    """Draw Geant4's other models; they have no errors on record."""
    single = {(r.slab, r.p): r.reference for r in rows if r.model == "SS" and r.quantity == name}
    for model, (marker, colour) in _OTHERS.items():
        found = {(r.slab, r.p): r.reference for r in rows if r.model == model and r.quantity == name}
        x = [i + 0.22 for i, place in enumerate(places) if place in found]
        y = [found[place] / single[place] for place in places if place in found]
        plot.plot(x, y, marker, color=colour, mfc="white", ms=5, label=f"Geant4, {model}", zorder=3)


def draw_loss_ratios(rows: Sequence[Comparison]) -> Picture:
    """Draw quantiles and mean of the energy loss over those of Geant4, one panel per slab."""
    names = [*_QUANTILES, "mean"]
    slabs = list(dict.fromkeys(row.slab for row in rows if row.model == "WVI"))
    with style():
        picture, axes = new_picture(2, 3, (13.0, 7.4))
        for plot, slab in zip(axes, slabs, strict=True):
            for number, (p, colour) in enumerate(_MOMENTA.items()):
                for row in rows:
                    name = row.quantity.removeprefix("loss_kev_")
                    if (row.slab, row.p, row.model) != (slab, p, "WVI") or name not in names:
                        continue
                    x = names.index(name) + 0.18 * (number - 1)
                    if row.gated:
                        _band(plot, names.index(name), row)
                    _point(plot, x, row, "o", colour, f"{p:g} GeV/c")
            plot.axhline(1, color=COLORS["data"], lw=0.9)
            plot.set_xticks(range(len(names)), ["1 %", "16 %", "median", "84 %", "99 %", "mean"])
            plot.set(title=TITLES[slab], ylabel="energy loss, ratio to Geant4")
            low, high = plot.get_ylim()
            plot.set_ylim(max(low, 0.7), min(high, 1.6))
            grid(plot)
        entries = legend_entries(axes)
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=3)
        picture.subplots_adjust(left=0.055, right=0.99, top=0.95, bottom=0.1, wspace=0.22, hspace=0.24)
    return picture


def draw_distributions(results: Mapping[tuple[str, float], SlabResult]) -> Picture:
    """Draw how many angles are beyond, and how many losses below a value; points are Geant4's quantiles."""
    slabs = ("C_0.1X0", "Cu_14um", "Ar_10mm", "CGEM_0.13")
    with style():
        picture, axes = new_picture(2, 4, (15.0, 7.4))
        for column, slab in enumerate(slabs):
            for p, colour in _MOMENTA.items():
                _survival(axes[column], results[slab, p], slab, colour)
                _cumulated(axes[4 + column], results[slab, p], slab, colour)
            axes[column].set(
                title=TITLES[slab], xscale="log", yscale="log", ylim=(3e-4, 1.2), xlabel="|plane angle|  (mrad)"
            )
            axes[4 + column].set(xscale="log", yscale="logit", ylim=(0.002, 0.998), xlabel="energy loss  (keV)")
            axes[4 + column].yaxis.set_minor_formatter(NullFormatter())
            axes[4 + column].xaxis.set_minor_formatter(NullFormatter())
        axes[0].set_ylabel("fraction beyond")
        axes[4].set_ylabel("fraction below", labelpad=0)
        for plot in axes:
            grid(plot)
        handles = [Line2D([], [], color=colour, label=f"cgemit, {p:g} GeV/c") for p, colour in _MOMENTA.items()]
        points = (("o", "SS + ionisation"), ("^", "WVI, one step"))
        handles += [
            Line2D([], [], ls="", marker=marker, mfc="white", color=COLORS["data"], label=f"Geant4, {label}")
            for marker, label in points
        ]
        picture.legend(handles=handles, loc="lower center", ncols=5)
        picture.subplots_adjust(left=0.06, right=0.99, top=0.95, bottom=0.12, wspace=0.22, hspace=0.28)
    return picture


def _survival(plot: Axes, result: SlabResult, slab: str, colour: str) -> None:
    both = np.sort(np.abs(1e3 * np.concatenate([result.angle_1, result.angle_2])[np.tile(result.through, 2)]))
    levels = np.geomspace(0.95, 3e-4, 300)
    plot.plot(np.quantile(both, 1 - levels), levels, color=colour, lw=1.3)
    for model, row in references():
        if row["slab"] == slab and float(row["p_gev"]) == result.p and model in ("SS", "WVI"):
            marker = "o" if model == "SS" else "^"
            for name, (inside, gaussian) in _INSIDE.items():
                plot.plot(float(row[name]) * gaussian, 1 - inside, marker, color=colour, mfc="white", ms=5.5)


def _cumulated(plot: Axes, result: SlabResult, slab: str, colour: str) -> None:
    levels = 1 / (1 + np.exp(-np.linspace(-6.2, 6.2, 300)))
    plot.plot(np.quantile(result.loss, levels), levels, color=colour, lw=1.3)
    for model, row in references():
        if row["slab"] == slab and float(row["p_gev"]) == result.p and model == "WVI":
            for name, level in _QUANTILES.items():
                plot.plot(float(row[f"loss_kev_{name}"]), level, "^", color=colour, mfc="white", ms=5.5)
