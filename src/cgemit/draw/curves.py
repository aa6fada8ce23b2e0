"""Distributions of residuals and pulls, and resolutions against momentum and angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from cgemit.draw.shots import shot_text
from cgemit.draw.style import (
    COLORS,
    Picture,
    grid,
    legend_below,
    looks,
    mathematical,
    new_picture,
    plain,
    statistics_box,
    style,
)
from cgemit.result import Result
from cgemit.statistics.curves import Line, Spectrum, track_spectrum
from cgemit.statistics.formatting import shown
from cgemit.stored_run import tracks_of
from cgemit.tables import Table


def residual(result: Result | Table, quantity: str = "p") -> Picture:
    """Draw fitted minus true values of one track quantity with the fit of its core and the statistics.

    Parameters
    ----------
    result : Result or Table of kind "tracks"
    quantity : str
        ``"dr"``, ``"phi0"``, ``"kappa"``, ``"dz"``, ``"tanl"`` or ``"p"``.

    Returns
    -------
    Picture

    Raises
    ------
    ValueError
        If the quantity is unknown, or too few tracks were fitted.
    """
    tracks = tracks_of(result)
    with style():
        picture, (axes,) = new_picture(1, 1, (6.4, 4.6))
        about = "" if isinstance(result, Table) else f"{result.detector.name}, {result.n_events:,} events"
        draw_spectrum(axes, track_spectrum(tracks, quantity), about)
        if not isinstance(result, Table):
            axes.set_title(f"{axes.get_title(loc='left')}\n{plain(shot_text(result.gun))}", loc="left", fontsize=9.5)
        picture.subplots_adjust(left=0.13, right=0.97, top=0.89, bottom=0.13)
    return picture


def draw_spectrum(axes: Axes, spectrum: Spectrum, title: str = "", colour: str = COLORS["data"]) -> None:
    """Draw a histogram with Poisson errors, the fitted core and the statistics into axes."""
    counts = spectrum.counts["all"]
    centres = 0.5 * (spectrum.edges[1:] + spectrum.edges[:-1])
    filled = counts > 0
    n = counts[filled]
    axes.errorbar(centres[filled], n, np.sqrt(n), fmt="o", ms=2.8, lw=0.9, color=colour, zorder=3)
    x, y = spectrum.fit_curve()
    axes.plot(x, y, color=COLORS["fit"], lw=1.8, zorder=4)
    _label_spectrum(axes, spectrum, title, headroom=1.65)  # the statistics reach to the middle of the axes
    statistics_box(axes, spectrum.statistics())


def draw_parts(axes: Axes, spectrum: Spectrum, parts: Mapping[str, tuple[str, str]], title: str = "") -> None:
    """Draw a histogram and parts of it, each with a colour and a legend text, and the statistics.

    Parameters
    ----------
    parts : mapping of str to (str, str)
        Name of the counts, its colour and its legend text.
    """
    for name, (colour, text) in parts.items():
        axes.stairs(spectrum.counts[name], spectrum.edges, fill=True, color=colour, alpha=0.75, label=text)
    axes.stairs(spectrum.counts["all"], spectrum.edges, color=COLORS["data"], lw=1.3, label="all")
    _label_spectrum(axes, spectrum, title)
    statistics_box(axes, spectrum.statistics())
    axes.legend(loc="upper left")


def draw_tails(
    axes: Axes,
    spectrum: Spectrum,
    parts: Mapping[str, tuple[str, str]],
    windows: Sequence[tuple[float, str]],
    title: str = "",
) -> None:
    """Draw a histogram and parts of it on a logarithmic scale, with the windows in which its RMS was taken.

    Parameters
    ----------
    parts : mapping of str to (str, str)
        Name of the counts, its colour and its legend text.
    windows : sequence of (float, str)
        Half-width in the spectrum's unit, and what is written beside it.
    """
    for name, (colour, text) in parts.items():
        axes.stairs(spectrum.counts[name], spectrum.edges, color=colour, lw=1.2, label=text)
    axes.stairs(spectrum.counts["all"], spectrum.edges, color=COLORS["data"], lw=1.3, label="all", zorder=1)
    _label_spectrum(axes, spectrum, title)
    top = 3 * max(1, spectrum.counts["all"].max())
    axes.set(yscale="log", ylim=(0.5, top))
    for reach, text in windows:
        for side in (-reach, reach):
            axes.axvline(side, color=COLORS["wire"], lw=0.9, ls="--", zorder=0)
        beside: dict[str, Any] = {"xytext": (2, 0), "textcoords": "offset points", "rotation": 90, "fontsize": 8}
        axes.annotate(text, (reach, 0.7 * top), va="top", ha="left", color=COLORS["text"], **beside)
    axes.legend(loc="upper left", frameon=True, facecolor="white", edgecolor="none", framealpha=0.9)


def _label_spectrum(axes: Axes, spectrum: Spectrum, title: str, headroom: float = 1.25) -> None:
    width = spectrum.edges[1] - spectrum.edges[0]
    unit = shown(spectrum.unit)
    axes.set(xlabel=f"{mathematical(spectrum.label)}  ({unit})", ylabel=f"entries / {width:.3g} {unit}")
    most = max(1, spectrum.counts["all"].max())
    axes.set(xlim=(spectrum.edges[0], spectrum.edges[-1]), ylim=(0, headroom * (most + np.sqrt(most))))
    if title:
        axes.set_title(plain(title), loc="left")
    grid(axes)


def draw_curves(
    axes: Axes, curves: Sequence[Line], y_label: str, x_label: str, paper: tuple[float, float] | None = None
) -> None:
    """Draw curves with errors into axes, in one colour per detector.

    Parameters
    ----------
    curves : sequence of Line
        All in the same units. Analytic ones are lines without points; simulated ones beside them are points without
        lines, and the legend tells which is which.
    y_label, x_label : str
        Without the unit.
    paper : (float, float), optional
        A published point.
    """
    look_of = dict(zip(dict.fromkeys(curve.detector for curve in curves), looks(), strict=False))
    methods = {curve.method for curve in curves}
    for curve in curves:
        if not np.isfinite(curve.y).any():
            continue  # a legend must not name a curve that is not there
        (marker, colour), label = look_of[curve.detector], plain(curve.detector)
        if curve.method == "analytic":
            # A single momentum is no line.
            kind = "_" if len(curve.x) == 1 else "-"
            axes.plot(curve.x, curve.y, kind, color=colour, lw=1.4, ms=16, mew=1.4, label=f"{label}, analytic")
            continue
        both = "analytic" in methods
        axes.errorbar(
            curve.x, curve.y, curve.y_error, fmt=marker if both else f"{marker}-", color=colour, ms=5, lw=1.2,
            mec="white", mew=0.5, elinewidth=1, label=f"{label}, simulated" if both else label,
        )  # fmt: skip
    if paper:
        star: dict[str, Any] = {"ms": 13, "color": COLORS["single"], "mec": COLORS["data"], "mew": 0.7}
        axes.plot(*paper, "*", zorder=5, label="paper, CGEM", **star)
    x_unit, y_unit = (f"  ({shown(unit)})" if unit else "" for unit in (curves[0].x_unit, curves[0].y_unit))
    axes.set(xlabel=x_label + x_unit, ylabel=mathematical(y_label) + y_unit)
    _limit_curves(axes, curves, paper)
    grid(axes)


def _limit_curves(axes: Axes, curves: Sequence[Line], paper: tuple[float, float] | None) -> None:
    """Show every point with its error bar, and every x of the curves, also without a point."""
    x, y, error = (np.concatenate([getattr(curve, name) for curve in curves]) for name in ("x", "y", "y_error"))
    asked = x[np.isfinite(x)]
    axes.update_datalim(np.stack([asked, np.zeros(len(asked))], axis=1), updatey=False)
    axes.autoscale_view(scaley=False)
    if len(np.unique(asked)) == 1:  # around a single point the labels of the ticks would overlap
        axes.set_xticks(asked[:1])
    drawn = np.isfinite(y)
    tops = [*(y + np.nan_to_num(error))[drawn], *([paper[1]] if paper else [])]
    axes.set_ylim(0, 1.08 * max(tops, default=1.0))
    if not drawn.any():
        axes.set_yticks([])
        note = "no fitted track, or fewer than ten"
        axes.text(0.5, 0.5, note, transform=axes.transAxes, ha="center", color=COLORS["text"])


def draw_resolutions(
    panels: Sequence[tuple[str, Sequence[Line]]], x_label: str, papers: Sequence[tuple[float, float] | None] = ()
) -> Picture:
    """Draw several quantities against the same variable, side by side.

    Parameters
    ----------
    panels : sequence of (str, sequence of Line)
        Axis label and curves of each panel.
    x_label : str
    papers : sequence of (float, float) or None
        A published point for each panel.
    """
    with style():
        width = 5.6 * len(panels) + 0.6
        picture, axes = new_picture(1, len(panels), (width, 4.4))
        points = [*papers, *[None] * (len(panels) - len(papers))]
        for plot, (label, curves), paper in zip(axes, panels, points, strict=True):
            draw_curves(plot, curves, label, x_label, paper)
        if axes[0].get_legend_handles_labels()[0]:
            axes[0].legend()
        picture.subplots_adjust(left=0.75 / width, right=1 - 0.15 / width, top=0.96, bottom=0.13, wspace=0.2)
    return picture


def draw_pulls(
    samples: Mapping[str, Mapping[str, npt.NDArray[np.float64]]], texts: Mapping[str, Mapping[str, str]]
) -> Picture:
    """Draw the pulls of the track parameters, one panel each, all detectors in it, with the unit Gaussian.

    Parameters
    ----------
    samples : mapping
        Detector -> symbol of the parameter -> pulls (n,).
    texts : mapping
        Detector -> symbol of the parameter -> what the legend says about them.
    """
    names = list(next(iter(samples.values())))
    edges = np.linspace(-5, 5, 51)
    centres = 0.5 * (edges[1:] + edges[:-1])
    with style():
        picture, axes = new_picture(2, 3, (13.0, 7.4))
        for plot, name in zip(axes, names, strict=True):
            for (detector, pulls), (marker, colour) in zip(samples.items(), looks(), strict=False):
                counts, _ = np.histogram(pulls[name], edges)
                density = counts / max(1, len(pulls[name])) / (edges[1] - edges[0])
                plot.plot(centres, density, marker, ms=3.6, color=colour, label=plain(texts[detector][name]))
            unit_gaussian = np.exp(-0.5 * centres**2) / np.sqrt(2 * np.pi)
            plot.plot(centres, unit_gaussian, color=COLORS["data"], lw=1, ls="--", zorder=1)
            plot.set(xlim=(-5, 5), ylim=(0, 0.62), xlabel=f"pull of {mathematical(name)}", ylabel="density")
            plot.legend(loc="upper center", fontsize=8.2, handletextpad=0.2)
            grid(plot)
        legend_below(picture, list(samples))
        picture.subplots_adjust(left=0.055, right=0.99, top=0.98, bottom=0.12, wspace=0.2, hspace=0.24)
    return picture


def draw_probabilities(samples: Mapping[str, npt.NDArray[np.float64]]) -> Picture:
    """Draw the chi-square probabilities of each detector's tracks, flat if the errors are right."""
    edges = np.linspace(0, 1, 41)
    with style():
        picture, (axes,) = new_picture(1, 1, (6.4, 4.4))
        for (detector, values), (_, colour) in zip(samples.items(), looks(), strict=False):
            counts, _ = np.histogram(values, edges)
            mean = max(1, len(values)) / (len(edges) - 1)
            text = f"{plain(detector)}: n = {len(values):,}, mean = {np.mean(values):.3f}"
            axes.stairs(counts / mean, edges, color=colour, lw=1.4, label=text)
        axes.axhline(1, color=COLORS["data"], lw=1, ls="--", label="right errors")
        axes.set(xlabel="χ² probability", ylabel="entries / expectation", xlim=(0, 1))
        axes.set_ylim(0, 1.35 * axes.get_ylim()[1])
        axes.legend(loc="upper right")
        grid(axes)
        picture.subplots_adjust(left=0.11, right=0.97, top=0.96, bottom=0.13)
    return picture


def draw_grid(
    rows: Sequence[Sequence[tuple[str, Sequence[Line]]]], x_label: str, unity_rows: Sequence[int] = ()
) -> Picture:
    """Draw a grid of panels against the same variable.

    Parameters
    ----------
    rows : rows of (axis label, curves)
    x_label : str
    unity_rows : sequence of int
        Rows that get a dashed line at 1 and a range around it.
    """
    with style():
        picture, axes = new_picture(len(rows), len(rows[0]), (4.4 * len(rows[0]), 3.4 * len(rows)))
        for number, plot in enumerate(axes):
            row, column = divmod(number, len(rows[0]))
            label, curves = rows[row][column]
            draw_curves(plot, curves, label, x_label)
            if row in unity_rows:
                plot.axhline(1, color=COLORS["data"], lw=1, ls="--", zorder=1)
                plot.set_ylim(*_around_one(curves))
        legend_below(picture, [curve.detector for curve in rows[0][0][1]])
        picture.subplots_adjust(left=0.06, right=0.99, top=0.975, bottom=0.135, wspace=0.23, hspace=0.23)
    return picture


def _around_one(curves: Sequence[Line]) -> tuple[float, float]:
    away = np.concatenate([np.abs(curve.y - 1) + np.nan_to_num(curve.y_error) for curve in curves])
    reach = max(0.25, 1.1 * float(np.max(away, initial=0.0, where=np.isfinite(away))))
    return max(0.0, 1 - reach), 1 + reach
