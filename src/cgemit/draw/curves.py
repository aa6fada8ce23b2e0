"""Pictures of distributions, and of resolutions and efficiencies against momentum, angle or incidence."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, NullLocator

from cgemit.analysis.curves import Line, Spectrum, track_spectrum
from cgemit.analysis.quantities import QUANTITIES, REPORTED
from cgemit.base.arrays import Floats
from cgemit.bes3.refit import FITS, Refit
from cgemit.chain.result import Result, tracks_of
from cgemit.draw.style import (
    COLORS,
    Picture,
    grid,
    legend_below,
    legend_entries,
    looks,
    mathematical,
    new_picture,
    plain,
    shot_text,
    statistics_box,
    style,
)
from cgemit.tables import Table
from cgemit.tables.schema import PARAMETERS
from cgemit.tables.show import shown


def residual(result: Result | Table, quantity: str = "p") -> Picture:
    """Draw fitted minus true values of one track quantity with the fit of its core and the statistics.

    Parameters
    ----------
    result : Result or Table of kind "tracks"
    quantity : str
        Of `cgemit.analysis.quantities.QUANTITIES`.

    Returns
    -------
    Picture

    Raises
    ------
    ValueError
        If the quantity is unknown, or too few tracks were fitted.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> picture = cg.draw.residual(result, "p")
    >>> picture.axes[0].get_xlabel()
    'p: fitted − true  (MeV/c)'
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
    _label_spectrum(axes, spectrum, title)
    _statistics(axes, spectrum)


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
    _label_spectrum(axes, spectrum, title, headroom=1.12)
    axes.legend(loc="upper left")
    statistics_box(axes, spectrum.statistics())


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
    # All as an area behind its parts, whose lines it would cover.
    axes.stairs(spectrum.counts["all"], spectrum.edges, fill=True, color=COLORS["matter"], label="all", zorder=1)
    for name, (colour, text) in parts.items():
        axes.stairs(spectrum.counts[name], spectrum.edges, color=colour, lw=1.3, label=text, zorder=2)
    _label_spectrum(axes, spectrum, title)
    top = 3 * max(1, spectrum.counts["all"].max())
    axes.set(yscale="log", ylim=(0.5, top))
    for reach, text in windows:
        for side in (-reach, reach):
            axes.axvline(side, color=COLORS["wire"], lw=0.9, ls="--", zorder=0)
        beside: dict[str, Any] = {"xytext": (2, 0), "textcoords": "offset points", "rotation": 90, "fontsize": 8}
        axes.annotate(text, (reach, 0.7 * top), va="top", ha="left", color=COLORS["text"], **beside)
    axes.legend(loc="upper left", frameon=True, facecolor="white", edgecolor="none", framealpha=0.9)


def _statistics(axes: Axes, spectrum: Spectrum) -> None:
    """Write the statistics into both upper corners, beside the peak, and make room below them."""
    lines = spectrum.statistics()
    half = next(i for i, line in enumerate(lines) if line.startswith("n ="))
    for part, right in ((lines[half:], False), (lines[:half], True)):
        statistics_box(axes, [line.replace(": ", "\n") if len(line) > 28 else line for line in part], right=right)
    centres, n = 0.5 * (spectrum.edges[1:] + spectrum.edges[:-1]), spectrum.counts["all"]
    low, high = axes.get_xlim()
    for text in axes.texts:
        box = text.get_window_extent().transformed(axes.transAxes.inverted())
        below = (centres > low + (box.x0 - 0.03) * (high - low)) & (centres < low + (box.x1 + 0.03) * (high - low))
        tallest = float((n + np.sqrt(n))[below].max(initial=0.0))
        axes.set_ylim(top=max(axes.get_ylim()[1], 1.25 * tallest / max(box.y0, 0.3)))


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
    axes: Axes, curves: Sequence[Line], y_label: str, x_label: str, paper: tuple[float, float] | None = None,
    ticks: Floats | None = None,
) -> None:  # fmt: skip
    """Draw curves with errors into axes, in one colour per detector.

    Parameters
    ----------
    curves : sequence of Line
        All in the same units. Analytic ones are lines without points; simulated ones beside them are points without
        lines, named in the legend.
    y_label, x_label : str
        Without the unit.
    paper : (float, float), optional
        A published point.
    ticks : ndarray, (n,) float64, optional
        Where the axis has ticks, as far as their labels have room. Default: of momenta over a decade those of the
        curves, else round numbers.
    """
    look_of = dict(zip(dict.fromkeys(curve.detector for curve in curves), looks(), strict=False))
    methods = {curve.method for curve in curves}
    for curve in curves:
        if not np.isfinite(curve.y).any():
            continue  # a legend must not name a curve that is not there
        (marker, colour), label = look_of[curve.detector], plain(curve.detector)
        order = np.argsort(curve.x, kind="stable")  # rows are in the order asked for, lines never go back
        x, y, error = curve.x[order], curve.y[order], curve.y_error[order]
        if curve.method == "analytic":
            # A single momentum is no line.
            kind = "_" if len(x) == 1 else "-"
            axes.plot(x, y, kind, color=colour, lw=1.4, ms=16, mew=1.4, label=f"{label}, analytic")
            continue
        has_analytic = "analytic" in methods
        axes.errorbar(
            x, y, error, fmt=marker if has_analytic else f"{marker}-", color=colour, ms=5, lw=1.2,
            mec="white", mew=0.5, elinewidth=1, label=f"{label}, simulated" if has_analytic else label,
        )  # fmt: skip
    if paper:
        star: dict[str, Any] = {"ms": 13, "color": COLORS["single"], "mec": COLORS["data"], "mew": 0.7}
        axes.plot(*paper, "*", zorder=5, label="paper, CGEM", **star)
    x_unit, y_unit = (f"  ({shown(unit)})" if unit else "" for unit in (curves[0].x_unit, curves[0].y_unit))
    axes.set(xlabel=x_label + x_unit, ylabel=mathematical(y_label) + y_unit)
    _limit_curves(axes, curves, paper, ticks)
    grid(axes)


def _limit_curves(axes: Axes, curves: Sequence[Line], paper: tuple[float, float] | None, ticks: Floats | None) -> None:
    """Show every point with its error bar, and every x of the curves, also without a point."""
    x, y, error = (np.concatenate([getattr(curve, name) for curve in curves]) for name in ("x", "y", "y_error"))
    asked = x[np.isfinite(x)]
    axes.update_datalim(np.stack([asked, np.zeros(len(asked))], axis=1), updatey=False)
    axes.autoscale_view(scaley=False)
    if len(np.unique(asked)) == 1:  # around a single point the labels of the ticks would overlap
        axes.set_xticks(asked[:1])
    elif curves[0].x_unit == "GeV/c" and 0 < _DECADE * asked.min() <= asked.max():
        _scale_momenta(axes, curves, ticks)
    elif ticks is not None and len(ticks) <= _MOST_TICKS:
        _set_ticks(axes, ticks, _ROOM * (asked.max() - asked.min()))
    drawn = np.isfinite(y)
    tops = [*(y + np.nan_to_num(error))[drawn], *([paper[1]] if paper else [])]
    axes.set_ylim(0, 1.08 * max(tops, default=1.0))
    if not drawn.any():
        axes.set_yticks([])
        note = "no fitted track, or fewer than ten"
        axes.text(0.5, 0.5, note, transform=axes.transAxes, ha="center", color=COLORS["text"])


def _scale_momenta(axes: Axes, curves: Sequence[Line], ticks: Floats | None) -> None:
    """Make the axis of momenta logarithmic, with ticks where tracks were simulated as far as their labels have room."""
    points = [curve for curve in curves if curve.method != "analytic"] or curves
    x = np.unique(np.concatenate([curve.x for curve in points])) if ticks is None else ticks
    x = x[np.isfinite(x)]
    if len(x) > _MOST_TICKS:
        x = np.array([digit * 10.0**power for power in range(-3, 4) for digit in (1, 2, 5)])
        x = x[(x >= min(curve.x.min() for curve in curves)) & (x <= max(curve.x.max() for curve in curves))]
    axes.set_xscale("log")
    axes.autoscale_view(scaley=False)
    _set_ticks(axes, x, _ROOM * math.log(x[-1] / x[0]), math.log)
    axes.xaxis.set_minor_locator(NullLocator())


def _set_ticks(axes: Axes, x: Floats, room: float, scale: Callable[[float], float] = float) -> None:
    """Set ticks at values in increasing order, from the last one on, where they are so far apart on a scale.

    `room` is that of labels of up to four characters.
    """
    longest = max(len(f"{tick:.4g}") for tick in x)
    room *= longest / 3 if longest > 4 else 1
    ticks = [x[-1]]
    for tick in x[-2::-1]:
        if scale(ticks[-1]) - scale(tick) >= room * (1 - 1e-9):
            ticks.append(tick)
    axes.set_xticks(ticks, [f"{tick:.4g}" for tick in ticks])


#: Momenta that span this factor have a logarithmic axis; ticks at points, at most; share of the axis of a label.
_DECADE, _MOST_TICKS, _ROOM = 10.0, 15, 0.08


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


_LABELS = {
    "pt": r"$p_T$  (GeV/c)",
    "cos_theta": r"$\cos\theta$",
    "phi": r"$\phi$  (rad)",
    "distance": "vertex to beam line  (mm)",
    "tracks": "findable particles in the event",
    "occupancy": "occupancy of the event  (%)",
}


def draw_finding(curves: Mapping[str, Mapping[str, Any]], title: str, lines: Sequence[str] = ()) -> Picture:
    """Draw the efficiency in bins, one panel for each quantity.

    Parameters
    ----------
    curves : mapping of str to mapping
        By quantity, ``"pt"``, ``"cos_theta"``, ``"phi"``, ``"distance"``, ``"tracks"`` or ``"occupancy"``: columns low,
        high, findable, efficiency, efficiency_low and efficiency_high of the bins.
    title : str
    lines : sequence of str
        Numbers that are written below the panels.

    Returns
    -------
    Picture

    Examples
    --------
    >>> bins = {"low": [0.1, 0.5], "high": [0.5, 1.0], "findable": [10, 10]}  # GeV/c
    >>> bins |= {"efficiency": [0.9, 1.0], "efficiency_low": [0.8, 0.9], "efficiency_high": [0.95, 1.0]}
    >>> picture = cg.draw.draw_finding({"pt": bins}, "ckf")
    >>> picture.axes[0].get_ylabel()
    'efficiency  (%)'
    """
    with style():
        across, rows = min(len(curves), 3), -(-len(curves) // 3)
        picture, axes = new_picture(rows, across, (3.9 * across, 3.4 * rows + 0.8))
        for plot in axes[len(curves) :]:
            plot.remove()
        least = min(
            (np.nanmin(columns["efficiency_low"]) for columns in curves.values() if np.any(columns["findable"])),
            default=0.0,
        )
        for plot, (quantity, columns) in zip(axes, curves.items(), strict=False):
            filled = np.asarray(columns["findable"]) > 0
            low, high = (np.asarray(columns[name])[filled] for name in ("low", "high"))
            efficiency, below, above = (
                100 * np.asarray(columns[name])[filled] for name in ("efficiency", "efficiency_low", "efficiency_high")
            )
            plot.errorbar(
                0.5 * (low + high), efficiency, xerr=0.5 * (high - low), yerr=[efficiency - below, above - efficiency],
                fmt="o", markersize=3.5, linewidth=1.0, color=COLORS["cgem"],
            )  # fmt: skip
            plot.set_xlabel(_LABELS[quantity])
            plot.set_ylim(
                max(0.0, 100 * least - 0.25 * (100 - 100 * least) - 0.2), 100 + 0.06 * (100 - 100 * least) + 0.1
            )
            grid(plot)
        for plot in axes[::across]:
            plot.set_ylabel("efficiency  (%)")
        height = picture.get_figheight()
        picture.suptitle(plain(title), fontsize=10.5, y=1 - 0.08 / height)
        picture.text(0.5, 0.06 / height, plain("   ".join(lines)), ha="center", fontsize=9, color=COLORS["text"])
        picture.subplots_adjust(
            left=0.075, right=0.985, top=1 - 0.42 / height, bottom=0.92 / height, wspace=0.2, hspace=0.3
        )
    return picture


_LOOKS = {
    "centroid": ("charge centroid", COLORS["cgem"], "o"),
    "micro-tpc": ("micro-TPC", COLORS["idc"], "s"),
    "merged": ("merged", COLORS["truth"], "D"),
    "track": ("with the track's angle", COLORS["data"], "^"),
}


class ViewCurves(NamedTuple):
    """What is drawn of one view.

    Examples
    --------
    >>> one = np.ones(2)
    >>> curves = cg.draw.ViewCurves("X", {"centroid": (80 * one, 2 * one)}, size=3 * one, efficiency=one)
    >>> curves.name, list(curves.widths)
    ('X', ['centroid'])
    """

    name: str  # X or V
    widths: Mapping[str, tuple[Floats, Floats]]  # by estimator: core widths and their errors, (n,) um
    size: Floats  # (n,), mean number of strips
    efficiency: Floats  # (n,)


def draw_readout(values: Floats, label: str, views: Sequence[ViewCurves], title: str) -> Picture:
    """Draw core widths of the estimators, number of strips and efficiency, one column a view.

    Parameters
    ----------
    values : (n,) float64
    label : str
        Of the quantity on the horizontal axes, with its unit.
    views : sequence of ViewCurves
    title : str

    Examples
    --------
    >>> one = np.ones(2)
    >>> curves = cg.draw.ViewCurves("X", {"centroid": (80 * one, 2 * one)}, size=3 * one, efficiency=one)
    >>> picture = cg.draw.draw_readout(np.array([0.0, 30.0]), "angle (deg)", [curves], "tiger")
    >>> picture.axes[-1].get_xlabel()
    'angle (deg)'
    """
    with style():
        picture, flat = new_picture(3, len(views), (8.4, 7.0), sharex=True, height_ratios=(3, 1, 1))
        rows = [flat[k * len(views) : (k + 1) * len(views)] for k in range(3)]
        for column, view in enumerate(views):
            top, middle, bottom = (row[column] for row in rows)
            for name, (width, error) in view.widths.items():
                text, colour, marker = _LOOKS[name]
                top.errorbar(values, width, error, label=text, color=colour, marker=marker, ms=4, lw=1.2, capsize=2)
            top.set_ylabel(f"core width of the {view.name} residual  (µm)")
            top.set_ylim(0, 1.1 * float(np.nanmax(view.widths["centroid"][0])))  # line fits may be far worse
            middle.plot(values, view.size, color=COLORS["data"], marker="o", ms=4, lw=1.2)
            middle.set_ylim(0, 1.15 * float(view.size.max()))
            middle.set_ylabel(f"{view.name} strips")
            bottom.plot(values, 100 * view.efficiency, color=COLORS["data"], marker="o", ms=4, lw=1.2)
            bottom.set_ylim(min(95.0, 100 * float(view.efficiency.min()) - 1), 100.5)
            bottom.set_ylabel("efficiency  (%)")
            bottom.set_xlabel(label)
            for axes in (top, middle, bottom):
                grid(axes)
                axes.locator_params(axis="x", nbins=5)
        handles, labels = rows[0][0].get_legend_handles_labels()
        picture.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, 0.955), ncols=len(labels), fontsize=9)
        picture.suptitle(plain(title), fontsize=10)
        picture.tight_layout(rect=(0, 0, 1, 0.95))
    return picture


_BINS = 24
_EDGE = 4.0  # of the histograms, errors; what is farther counts in the last bins


def draw_refit(result: Refit) -> Picture:
    """Draw differences over the experiment's error, chi-square of both fits, and the ratio of the errors.

    Parameters
    ----------
    result : Refit
        With one or more tracks that both have fitted.

    Returns
    -------
    Picture

    Raises
    ------
    ValueError
        If no track was fitted by both.

    Examples
    --------
    >>> from cgemit.bes3.events import read_events
    >>> from cgemit.bes3.refit import refit
    >>> events = read_events("run.rec", "besiii-idc-boss")  # doctest: +SKIP
    >>> cg.draw.draw_refit(refit(events)).save("refit")  # doctest: +SKIP
    """
    good = result.good
    if not good.any():
        raise ValueError(f"refit: got no track that both have fitted, of {len(good)}; expected one or more")
    summary = result.summary()
    with style():
        picture, axes = new_picture(2, 4, (14.6, 7.2))
        for plot, name in zip(axes, PARAMETERS, strict=False):
            values = np.clip(result.columns[f"pull_{name}"][good], -_EDGE, _EDGE)
            plot.hist(values, bins=_BINS, range=(-_EDGE, _EDGE), color=COLORS["cgem"], histtype="stepfilled")
            row = summary[name]
            plot.set_title(f"median {row['pull']:.2f}, 68 % within ±{row['pull_width']:.2f}", loc="left")
            plot.set_xlabel(f"{mathematical(QUANTITIES[name].symbol)}: (ours − BOSS) / error of BOSS")
            plot.set_ylabel("tracks")
            plot.yaxis.set_major_locator(MaxNLocator(integer=True))
            plot.set_xlim(-_EDGE, _EDGE)
            plot.axvline(0, color=COLORS["text"], linewidth=0.8)
            grid(plot)
        _chi_square(axes[6], result)
        _errors(axes[7], summary)
        tracks = (
            f"{int(good.sum())} tracks of one mass each, ours with {result.detector}; last bins: all beyond ±{_EDGE:g}"
        )
        picture.suptitle(plain(f"{FITS[result.kind]}: {tracks}"), x=0.05, ha="left", fontsize=11)
        picture.subplots_adjust(left=0.05, right=0.99, top=0.9, bottom=0.09, wspace=0.26, hspace=0.36)
    return picture


def _chi_square(plot: Axes, result: Refit) -> None:
    """Draw chi-square over degrees of freedom, ours against theirs."""
    ours, boss = ((one["chi2"] / np.maximum(one["ndf"], 1))[result.good] for one in (result.ours, result.boss))
    top = 1.08 * max(ours.max(), boss.max())
    plot.plot([0, top], [0, top], color=COLORS["text"], linewidth=0.8)
    plot.plot(boss, ours, "o", markersize=3.5, color=COLORS["cgem"])
    plot.set(xlabel="χ²/ndf, BOSS", ylabel="χ²/ndf, ours", xlim=(0, top), ylim=(0, top))
    grid(plot)


def _errors(plot: Axes, summary: dict[str, dict[str, float]]) -> None:
    """Draw the median ratio of the errors, by parameter."""
    names = list(PARAMETERS)
    ratios = [summary[name]["error_ratio"] for name in names]
    plot.axhline(1, color=COLORS["text"], linewidth=0.8)
    plot.plot(range(len(names)), ratios, "o", color=COLORS["cgem"])
    plot.set_xticks(range(len(names)), [mathematical(QUANTITIES[name].symbol) for name in names])
    plot.set(
        ylabel="median of our error / error of BOSS", xlim=(-0.6, len(names) - 0.4), ylim=(0, 1.15 * max(1.0, *ratios))
    )
    grid(plot)


def resolutions(scans: Sequence[Any]) -> Picture:
    """Draw the core resolutions of scans against what their rows differ in.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
        Results of `cgemit.study.scan` and `cgemit.study.scan_analytic` against the same values, where the axis has its
        ticks: simulated ones are points, analytic ones lines.

    Returns
    -------
    Picture
        One panel for each of `REPORTED`.

    Examples
    --------
    >>> lines = cg.study.scan_analytic("besiii-cgem-design", [0.3, 1.0])
    >>> picture = cg.draw.resolutions([lines])
    >>> [axes.get_ylabel() for axes in picture.axes if "p" in axes.get_ylabel()][0]
    'σ(p)  (MeV/c)'
    """
    scans = [scans] if hasattr(scans, "all_lines") else list(scans)
    named = _named([scan.all_lines for scan in scans])
    against = scans[0].against
    symbol = "$p_T$" if against.name == "pt" else plain(against.symbol)
    ticks = np.unique(np.concatenate([scan.against.x for scan in scans]))
    with style():
        count = -(-len(REPORTED) // 3)
        picture, axes = new_picture(count, 3, (13.2, 3.6 * count + 0.4))
        for plot in axes[len(REPORTED) :]:
            plot.remove()
        for plot, name in zip(axes, REPORTED, strict=False):
            curves = [line for lines in named for line in lines if line.id == f"sigma_{name}"]
            draw_curves(plot, curves, QUANTITIES[name].sigma, symbol, ticks=ticks)
            if against.words:
                plot.set_xticks(against.x, [plain(word) for word in against.words])
        entries = legend_entries(axes)
        if entries:
            picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=min(4, len(entries)))
        picture.suptitle(plain(about(scans)), x=0.06, ha="left", fontsize=11)
        picture.subplots_adjust(left=0.06, right=0.99, top=0.95, bottom=0.1, wspace=0.24, hspace=0.24)
    return picture


def about(scans: Sequence[Any]) -> str:
    """Return particles, angle, number of events, readout and finder of some scans as text."""
    particles = ", ".join(dict.fromkeys(scan.particle for scan in scans))
    parts = [f"{particles}, {scans[0].fixed}"]
    events = dict.fromkeys(scan.orders[0].n_events for scan in scans if scan.method == "mc")
    each = "momentum" if scans[0].against.name in ("p", "pt") else "point"
    parts += [f"{n:,} simulated events at each {each}" for n in events]
    readouts = ", ".join(dict.fromkeys(scan.readout for scan in scans if scan.readout))
    parts += [f"readout {readouts}"] if readouts else []
    parts += [f"hits {hits}" for hits in dict.fromkeys(scan.hits for scan in scans if scan.hits)]
    return "core widths: " + ", ".join(parts)


def _named(groups: Sequence[Sequence[Line]]) -> list[list[Line]]:
    """Return the lines with what tells them apart as the detector: its name, the particle, or both."""
    lines = [line for group in groups for line in group]
    detectors, particles = ({getattr(line, name) for line in lines} for name in ("detector", "particle"))
    if len(particles) == 1:
        return [list(group) for group in groups]
    several_detectors = len(detectors) > 1
    return [
        [
            replace(line, detector=f"{line.detector}, {line.particle}" if several_detectors else line.particle)
            for line in group
        ]
        for group in groups
    ]
