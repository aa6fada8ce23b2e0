"""Pictures of a run: strips, their times and charges, residuals, efficiencies and tracks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from cgemit.analysis.hits import VIEWS, HitResiduals, LayerCrossings, LayerEfficiencies, strip_status
from cgemit.base.arrays import Floats
from cgemit.detector import Detector
from cgemit.detector.core import layer_table
from cgemit.detector.parts import cgem_numbers
from cgemit.draw.style import COLORS, SERIES, Picture, grid, new_picture, statistics_box, style
from cgemit.tables import Table

_OF_VIEW = {0: COLORS["x"], 1: COLORS["v"], 2: COLORS["wire"]}
#: Bins of histograms.
_BINS = 40


def draw_strips(detector: Detector, digis: Table) -> Picture:
    """Draw how often each strip fires, by layer and view; hot and dead strips are marked.

    Parameters
    ----------
    detector : Detector
    digis : Table
        Of kind ``digis``.

    Returns
    -------
    Picture

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=20, until="digitize")
    >>> cg.draw.draw_strips(r.detector, r.digis).axes[0].get_ylabel()
    'share of events (%)'
    """
    numbers = list(cgem_numbers(detector))
    first, status = layer_table(detector.layers)["gid_first"], strip_status(detector, digis)
    with style():
        picture, axes = new_picture(len(numbers), 2, (11.4, 2.6 * len(numbers) + 0.4))
        for row, number in enumerate(numbers):
            layer = detector.layers[number]
            for view, strips in enumerate((layer.strips_x, layer.strips_v)):
                plot = axes[2 * row + view]
                mine = digis[(digis["layer"] == number) & (digis["view"] == view) & (digis["strip"] >= 0)]
                at = mine["sheet"] * strips + mine["strip"]
                once = np.unique(np.stack([mine["event"], at]), axis=1)[1]  # a strip may fire twice in an event
                fires = np.bincount(once, minlength=layer.sheets * strips)
                begin = int(first[number]) + view * layer.strips_x
                gid = np.concatenate([
                    begin + sheet * (layer.strips_x + layer.strips_v) + np.arange(strips)
                    for sheet in range(layer.sheets)
                ])  # fmt: skip
                own = status[gid]
                share = 100 * fires / max(digis.n_events, 1)
                plot.vlines(np.flatnonzero(fires), 0, share[fires > 0], color=_OF_VIEW[view], lw=0.8)
                plot.plot(np.flatnonzero(own == 1), share[own == 1], "v", color=COLORS["fit"], ms=4, label="hot")
                plot.plot(np.flatnonzero(own == -1), share[own == -1], "x", color=COLORS["data"], ms=4, label="dead")
                plot.set(
                    xlim=(-1, layer.sheets * strips), ylim=(0, 1.35 * max(share.max(initial=0), 1e-9)),
                    ylabel="share of events (%)", title=f"{layer.label} {VIEWS[view]}",
                )  # fmt: skip
                lines = [
                    f"{len(mine)} strips in {digis.n_events} events",
                    f"hot {np.count_nonzero(own == 1)}, dead {np.count_nonzero(own == -1)}",
                ]
                statistics_box(plot, lines)
                grid(plot)
        for plot in axes[-2:]:
            plot.set_xlabel("strip (sheets side by side)")
        picture.subplots_adjust(left=0.06, right=0.99, top=0.95, bottom=0.09, hspace=0.42, wspace=0.14)
    return picture


def draw_strip_signals(detector: Detector, digis: Table, arrival: Floats, longest: Floats) -> Picture:
    """Draw times of strips after the start of their events, and charges.

    Parameters
    ----------
    detector : Detector
    digis : Table
    arrival, longest : ndarray, (digis,) float64, ns
        Time after the arrival of the first electrons, NaN where the event has no start, and the drift time of the gap.

    Returns
    -------
    Picture

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=20, readout="tiger")
    >>> page = cg.study.monitor(r)
    >>> cg.draw.draw_strip_signals(r.detector, r.digis, page.arrival, page.longest).axes[0].get_xlabel()
    'time after the first electrons (ns)'
    """
    with style():
        picture, axes = new_picture(1, 2, (11.4, 4.2))
        known = np.isfinite(arrival)
        for i, number in enumerate(cgem_numbers(detector)):
            mine = known & (digis["layer"] == number)
            label = f"{detector.layers[number].label}: {np.count_nonzero(mine)} strips"
            _histogram(axes[0], arrival[mine], _edges(arrival[known]), histtype="step", color=SERIES[i], label=label)
        if known.any():
            axes[0].axvspan(0, float(np.nanmax(longest)), color=COLORS["grid"], zorder=0, label="drift time of the gap")
            inside = known & (arrival >= 0) & (arrival <= longest)
            lines = [f"inside {np.count_nonzero(inside)} of {np.count_nonzero(known)}"]
            statistics_box(axes[0], [*lines, f"without start {np.count_nonzero(~known)}"], right=False)
        axes[0].set(xlabel="time after the first electrons (ns)", ylabel="strips")
        charge = digis["charge"]
        for view in (0, 1):
            mine = charge[digis["view"] == view]
            label = f"{VIEWS[view]}: median {np.median(mine):.1f} fC" if len(mine) else VIEWS[view]
            _histogram(axes[1], mine, _edges(charge), histtype="step", color=_OF_VIEW[view], label=label)
        negative = int(np.count_nonzero(charge < 0))
        statistics_box(axes[1], [f"strips {len(charge)}", f"negative {negative}"], top=0.72)
        axes[1].set(xlabel="charge (fC)", ylabel="strips")
        for plot in axes:
            plot.set_ylim(top=1.35 * plot.get_ylim()[1])
            plot.legend(fontsize=8, loc="upper right")
            grid(plot)
        picture.subplots_adjust(left=0.06, right=0.99, top=0.96, bottom=0.13, wspace=0.14)
    return picture


def draw_hit_residuals(detector: Detector, hits: HitResiduals) -> Picture:
    """Draw the residuals of X and V of each CGEM layer and those of the wires, with their statistics.

    Parameters
    ----------
    detector : Detector
    hits : HitResiduals

    Returns
    -------
    Picture

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=50, readout="tiger")
    >>> picture = cg.draw.draw_hit_residuals(r.detector, cg.study.hit_residuals(r))
    >>> picture.axes[0].get_xlabel()
    'residual (mm)'
    """
    numbers = list(cgem_numbers(detector))
    panels: list[tuple[str, int, npt.NDArray[np.bool_]]] = [
        (f"{detector.layers[number].label} {VIEWS[view]}", view, (hits.view == view) & (hits.layer == number))
        for view in (0, 1)
        for number in numbers
    ]
    panels.append(("wires", 2, hits.view == 2))
    columns = len(numbers) + 1 if numbers else 1
    with style():
        picture, axes = new_picture(2 if numbers else 1, columns, (3.6 * columns, 5.8))
        places = [*range(columns - 1), *range(columns, 2 * columns - 1), columns - 1] if numbers else [0]
        for place, (title, view, rows) in zip(places, panels, strict=True):
            _residual_panel(axes[place], title, hits.select(rows), _OF_VIEW[view])
        if numbers:
            _pull_panel(axes[2 * columns - 1], hits)
        picture.subplots_adjust(left=0.05, right=0.99, top=0.94, bottom=0.09, hspace=0.32, wspace=0.25)
    return picture


def _residual_panel(plot: Axes, title: str, hits: HitResiduals, colour: str) -> None:
    near = hits.select(hits.counts)
    _histogram(plot, near.residual, _edges(near.residual), histtype="stepfilled", color=colour, alpha=0.55)
    plot.set(title=title, xlabel="residual (mm)", ylabel="hits")
    plot.set_ylim(top=1.9 * plot.get_ylim()[1])
    lines = [f"hits {len(hits)}, far {len(hits) - len(near)}"]
    if len(near) > 1:
        rms = near.residual.std(ddof=1)
        mean, err = 1e3 * near.residual.mean(), 1e3 * rms / np.sqrt(len(near))
        lines += [f"mean {mean:.0f} ± {err:.0f} µm", f"RMS {1e3 * rms:.0f} µm"]
        lines.append(f"pull {np.sqrt(np.mean(near.pull**2)):.2f}")
    statistics_box(plot, lines)
    grid(plot)


def _pull_panel(plot: Axes, hits: HitResiduals) -> None:
    for view in (0, 1, 2):
        pull = hits.pull[(hits.view == view) & hits.counts]
        if len(pull) > 1:
            width = np.sqrt(np.mean(pull**2))
            label = f"{VIEWS[view]}: {width:.2f}"
            plot.hist(
                pull, np.linspace(-5, 5, 41).tolist(), density=True, histtype="step", color=_OF_VIEW[view], label=label
            )
    u = np.linspace(-5, 5, 201)
    plot.plot(u, np.exp(-(u**2) / 2) / np.sqrt(2 * np.pi), color=COLORS["data"], lw=0.8, label="width 1")
    plot.set(title="pulls", xlabel="residual / error", ylabel="density")
    plot.set_ylim(top=1.4 * plot.get_ylim()[1])
    plot.legend(fontsize=8, title="RMS", title_fontsize=8)
    grid(plot)


_LABELS = {
    "time": "time (ns)", "incidence": "incidence (rad)", "phi": "azimuth (rad)", "z": "z (mm)", "size": "strips",
    "charge": "charge (fC)", "layer": "layer", "sheet": "sheet",
}  # fmt: skip


def draw_residual_profiles(hits: HitResiduals, by: Sequence[str] = ("time", "incidence", "size", "phi")) -> Picture:
    """Draw means of residuals of X and V, and their pulls, against columns of the hits.

    Parameters
    ----------
    hits : HitResiduals
    by : sequence of str
        Columns, see `HitResiduals.binned`.

    Returns
    -------
    Picture

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=50, readout="tiger")
    >>> picture = cg.draw.draw_residual_profiles(cg.study.hit_residuals(r), by=["time"])
    >>> picture.axes[1].get_ylabel()
    'RMS of pulls'
    """
    points = hits.select(hits.view < 2)
    with style():
        picture, axes = new_picture(2, len(by), (3.4 * len(by) + 0.4, 5.8))
        for i, name in enumerate(by):
            table = points.binned(name)
            for view in (0, 1):
                rows = (table.view == view) & np.isfinite(table.mean)
                whole = name in ("size", "layer", "sheet")
                middle = table.low[rows] if whole else 0.5 * (table.low[rows] + table.high[rows])
                look: dict[str, Any] = {
                    "fmt": "osD"[view],
                    "color": _OF_VIEW[view],
                    "ms": 4,
                    "capsize": 2,
                    "label": VIEWS[view],
                }
                axes[i].errorbar(middle, 1e3 * table.mean[rows], 1e3 * table.err_mean[rows], **look)
                axes[len(by) + i].errorbar(middle, table.pull[rows], table.err_pull[rows], **look)
            axes[i].axhline(0, color=COLORS["data"], lw=0.7)
            axes[len(by) + i].axhline(1, color=COLORS["data"], lw=0.7)
            axes[len(by) + i].set_ylim(bottom=0)
            for plot in (axes[i], axes[len(by) + i]):
                plot.set_xlabel(_LABELS.get(name, name))
                grid(plot)
        axes[0].set_ylabel("mean residual  (µm)")
        axes[len(by)].set_ylabel("RMS of pulls")
        axes[0].legend(fontsize=8)
        picture.subplots_adjust(left=0.07, right=0.99, top=0.97, bottom=0.1, hspace=0.3, wspace=0.28)
    return picture


def draw_efficiencies(efficiencies: LayerEfficiencies) -> Picture:
    """Draw the efficiencies of layers and their regions, with 68 % intervals of Wilson, which end at 100 %.

    Parameters
    ----------
    efficiencies : LayerEfficiencies

    Returns
    -------
    Picture

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=50, readout="tiger")
    >>> cg.draw.draw_efficiencies(cg.study.layer_efficiencies(r)).axes[0].get_ylabel()
    'efficiency (%)'
    """
    with style():
        picture, (plot,) = new_picture(1, 1, (9.6, 4.2))
        at = np.arange(len(efficiencies.label), dtype=np.float64)
        looks = (("x", "X", COLORS["x"]), ("v", "V", COLORS["v"]), ("both", "X and V", COLORS["data"]))
        for i, (name, label, colour) in enumerate(looks):
            efficiency, low, high = (100 * getattr(efficiencies, key) for key in (name, f"{name}_low", f"{name}_high"))
            err = [efficiency - low, high - efficiency]
            plot.errorbar(at + 0.2 * (i - 1), efficiency, err, fmt="osD"[i], color=colour, ms=4, capsize=2, label=label)
        names = zip(efficiencies.label, efficiencies.region, efficiencies.tracks, strict=True)
        plot.set_xticks(at, [f"{label}\n{region}\n{n}" for label, region, n in names], fontsize=8)
        plot.set(ylabel="efficiency (%)", xlabel="layer, region, number of tracks")
        plot.axhline(100, color=COLORS["data"], lw=0.7)
        plot.legend(fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        grid(plot)
        picture.subplots_adjust(left=0.08, right=0.99, top=0.91, bottom=0.24)
    return picture


#: Bins of maps in azimuth and along the beam, and hits that a mean needs.
_MAP, _LEAST = (12, 8), 2


def draw_layer_maps(crossings: LayerCrossings, hits: HitResiduals) -> Picture:
    """Draw maps of the CGEM layers in azimuth and z: share of tracks with X and V, and mean residuals of X and V.

    Parameters
    ----------
    crossings : LayerCrossings
    hits : HitResiduals
        A mean needs two hits; bins with fewer are empty.

    Returns
    -------
    Picture

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=50, readout="tiger")
    >>> crossings = cg.study.layer_crossings(r)
    >>> cg.draw.draw_layer_maps(crossings, cg.study.hit_residuals(r)).axes[0].get_title()
    'L1: X and V, 50 tracks'
    """
    labels = crossings.labels
    with style():
        picture, axes = new_picture(3, len(labels), (3.9 * len(labels), 8.4))
        for column, (number, label) in enumerate(labels.items()):
            mine = crossings.select(crossings.layer == number)
            of_layer = hits.select((hits.layer == number) & (hits.view < 2) & hits.counts)
            most = max(np.abs([*mine.z, *of_layer.z]).max(initial=1.0), 1.0)
            edges = (np.linspace(-np.pi, np.pi, _MAP[0] + 1), np.linspace(-most, most, _MAP[1] + 1))
            shown = [(f"{label}: X and V", mine.phi, mine.z, 100.0 * (mine.has_x & mine.has_v), 1)]
            for view in (0, 1):
                own = of_layer.select(of_layer.view == view)
                shown.append((f"{label}: mean residual {VIEWS[view]}", own.phi, own.z, 1e3 * own.residual, _LEAST))
            for row, (title, phi, z, shades, least) in enumerate(shown):
                plot = axes[row * len(labels) + column]
                counts = np.histogram2d(phi, z, edges)[0]
                sums = np.histogram2d(phi, z, edges, weights=shades)[0]
                mean = np.where(counts >= least, sums / np.maximum(counts, 1), np.nan)
                limit = float(np.nanmax(np.abs(mean))) if np.isfinite(mean).any() else 1.0
                look: dict[str, Any] = {"cmap": "viridis", "vmin": 0, "vmax": 100}
                if row:
                    look = {"cmap": "coolwarm", "vmin": -limit, "vmax": limit}
                picture.colorbar(plot.pcolormesh(*edges, mean.T, **look), ax=plot, label="µm" if row else "%")
                number_of = f"{len(phi)} {'hits' if row else 'tracks'}"
                plot.set(title=f"{title}, {number_of}", xlabel="azimuth (rad)", ylabel="z (mm)")
        picture.subplots_adjust(left=0.06, right=0.96, top=0.96, bottom=0.07, hspace=0.42, wspace=0.36)
    return picture


def draw_tracks(tracks: Table) -> Picture:
    """Draw momentum, impact parameters and numbers of hits of fitted tracks.

    Parameters
    ----------
    tracks : Table
        Of kind ``tracks``, those that are fitted.

    Returns
    -------
    Picture

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=20)
    >>> cg.draw.draw_tracks(r.tracks).axes[0].get_xlabel()
    'p (GeV/c)'
    """
    labels = {
        "p": "p (GeV/c)", "dr": r"$d_\rho$ (mm)", "dz": r"$d_z$ (mm)", "n_clusters": "X and V clusters",
        "n_wires": "wire hits",
    }  # fmt: skip
    with style():
        picture, axes = new_picture(1, len(labels), (14.0, 3.4))
        for plot, (name, label) in zip(axes, labels.items(), strict=True):
            values = tracks[name][np.isfinite(tracks[name])]
            whole = values.dtype.kind in "iu"
            edges = np.arange(-0.5, values.max(initial=0) + 1.5) if whole else _edges(values)
            _histogram(plot, values, edges, histtype="stepfilled", color=COLORS["cgem"], alpha=0.55)
            plot.set(xlabel=label, ylabel="tracks")
            plot.set_ylim(top=1.35 * plot.get_ylim()[1])
            lines = [f"tracks {len(values)}"] + ([f"median {np.median(values):.3g}"] if len(values) else [])
            statistics_box(plot, lines)
            grid(plot)
        picture.subplots_adjust(left=0.045, right=0.99, top=0.95, bottom=0.16, wspace=0.3)
    return picture


def _histogram(plot: Axes, values: Floats, edges: Floats, **look: Any) -> None:
    """Draw a histogram whose outer bins hold what lies beyond, so that its sum is the number of values."""
    plot.hist(np.clip(values, edges[0], edges[-1]), edges.tolist(), **look)


def _edges(values: Floats) -> Floats:
    """Return edges of a histogram that hold 99 % of some values and a bit more."""
    if not len(values):
        return np.linspace(0, 1, 2)
    low, high = np.quantile(values, [0.005, 0.995])
    more = 0.05 * (high - low) + 1e-9
    return np.linspace(low - more, high + more, _BINS + 1)
