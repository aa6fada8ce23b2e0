"""Delta electrons and the X residual, cgemit and Geant4 on the same axes."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from cgemit.analysis.clusters import X_WINDOWS, geant4_runs
from cgemit.draw.style import COLORS, Picture, grid, new_picture, style
from cgemit.study.paper.published import paper_values
from delta_fractions import DISTANCES, GATED_CUT, Born, Fraction, reference_fractions
from x_residual import Number

_CUTS = {"0.7 mm": (":", COLORS["single"]), "30 um": ("--", COLORS["x"]), "1 um": ("-", COLORS["data"])}
_PANELS = {
    ("r-phi", "all"): "in r-phi",
    ("z", "all"): "in z",
    ("r-phi", "cathode"): "in r-phi, from the cathode",
    ("r-phi", "behind"): "in r-phi, from behind",
}
_PER_CENT = (0.2, 0.5, 1, 2, 5)
_MARKERS = {"reference": ("o", COLORS["fit"]), "whole layer": ("s", COLORS["truth"])}


def draw_deltas(fractions: Sequence[Fraction], spectrum: Sequence[Born], residuals: Sequence[Number]) -> Picture:
    """Draw fractions against the distance, electrons born in the gap, and the RMS of the X residual by window."""
    with style():
        picture, axes = new_picture(2, 3, (13.4, 8.4))
        for plot, (key, title) in zip(axes, _PANELS.items(), strict=False):
            _fractions(plot, fractions, *key)
            plot.set(title=title, xlabel="displaced by more than  (mm)", ylabel="muons  (%)", ylim=(0.2, 5))
        _spectrum(axes[4], spectrum)
        _residuals(axes[5], residuals)
        for plot in axes:
            grid(plot)
        picture.legend(handles=_handles(), loc="lower center", ncols=7)
        picture.subplots_adjust(left=0.055, right=0.99, top=0.95, bottom=0.125, wspace=0.22, hspace=0.3)
    return picture


def _fractions(plot: Axes, rows: Sequence[Fraction], view: str, origin: str) -> None:
    for cut, (dashes, colour) in _CUTS.items():
        known = {d: per_cent for (v, o, d), per_cent in reference_fractions(cut).items() if (v, o) == (view, origin)}
        plot.plot(list(known), list(known.values()), dashes, color=colour)
    for arrangement, (marker, colour) in _MARKERS.items():
        found = [row for row in rows if (row.arrangement, row.view, row.origin) == (arrangement, view, origin)]
        gated = [row for row in found if row.gated]
        edges = [[(1 + sign * row.allowed) * row.reference for row in gated] for sign in (-1, 1)]
        plot.fill_between([row.distance for row in gated], *edges, color=COLORS["matter"], alpha=0.6, lw=0)
        values = [row.percent for row in found], [row.error for row in found]
        plot.errorbar([row.distance for row in found], *values, fmt=marker, color=colour, ms=5)
    plot.set(xscale="log", yscale="log")
    plot.set_xticks(DISTANCES, [f"{distance:g}" for distance in DISTANCES])
    plot.set_yticks(_PER_CENT, [f"{value:g}" for value in _PER_CENT])
    plot.minorticks_off()


def _spectrum(plot: Axes, rows: Sequence[Born]) -> None:
    energy = [row.energy for row in rows]
    dashes, colour = _CUTS[GATED_CUT]
    plot.plot(energy, [row.universal for row in rows], dashes, color=colour)
    plot.plot(energy, [row.pai for row in rows], "-.", color=COLORS["multi"])
    values = [row.number for row in rows], [row.error for row in rows]
    plot.errorbar(energy, *values, fmt="o", color=COLORS["fit"], ms=5)
    plot.set(title="born in the gap", xlabel="above  (keV)", ylabel="electrons per muon", xscale="log", yscale="log")


def _residuals(plot: Axes, rows: Sequence[Number]) -> None:
    names = list(X_WINDOWS)
    for run, (dashes, colour) in zip(geant4_runs(), _CUTS.values(), strict=False):
        plot.plot(range(len(names)), [_middle(text) for text in run.rms], dashes, color=colour)
    for deltas in (True, False):
        found = {row.quantity: row for row in rows if row.deltas is deltas}
        values = [found[name].value for name in names], [found[name].error for name in names]
        face = COLORS["fit"] if deltas else "white"
        plot.errorbar(range(len(names)), *values, fmt="o", color=COLORS["fit"], mfc=face, ms=5)
    plot.axhline(paper_values()["x_residual_rms"].value, color=COLORS["wire"], lw=1.2)
    plot.set_xticks(range(len(names)), ["±1 mm", "±2 mm", "±3 mm", "±5 mm", "all"])
    plot.set(title="X residual", xlabel="within", ylabel="RMS  (um)", ylim=(0, None))


def _middle(text: str) -> float:
    """Return the middle of a number or a range."""
    ends = [float(part) for part in text.split("–")]
    return sum(ends) / len(ends)


def _handles() -> list[Line2D | Patch]:
    handles = [Line2D([], [], ls=ls, color=colour, label=f"Geant4, {cut}") for cut, (ls, colour) in _CUTS.items()]
    handles.append(Line2D([], [], ls="-.", color=COLORS["multi"], label="Geant4, PAI"))
    labels = {"reference": "cgemit", "whole layer": "whole layer"}
    handles += [
        Line2D([], [], ls="", marker=marker, color=colour, label=labels[name])
        for name, (marker, colour) in _MARKERS.items()
    ]
    handles.append(Line2D([], [], ls="", marker="o", color=COLORS["fit"], mfc="white", label="no deltas"))
    return [*handles, Line2D([], [], color=COLORS["wire"], label="paper"), Patch(fc=COLORS["matter"], label="allowed")]
