"""Charge and time of the strips of clusters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from cgemit.detector.strips import v_of_strips
from cgemit.draw.event_view import EventView
from cgemit.draw.geometry import Array
from cgemit.draw.style import COLORS, plain, statistics_box
from cgemit.find.truth import residuals

_BESIDE = 6  # strips shown on either side of a cluster
_TIMES = "viridis"
_WIDEST = 2.8  # points, of the line of the strip with the largest charge


@dataclass(frozen=True, eq=False)
class ClusterStrips:
    """The cluster of a particle with the largest charge in a layer and view, and the fired strips about it."""

    name: str
    """"X" or "V"."""
    across: Array
    """(n,) float64, mm: middles of the strips, from the position of the cluster."""
    charge: Array
    """(n,) float64, fC."""
    time: Array
    """(n,) float64, ns."""
    pitch: float
    """mm."""
    truth: float
    """The true crossing, mm from the position of the cluster; NaN if the cluster has none."""
    whole: float
    """Charge of the cluster, fC."""
    size: int
    """Strips of the cluster."""


def cluster_strips(view: EventView, number: int) -> list[ClusterStrips]:
    """Return the strips of the largest X and V cluster of a layer; noise counts where there is nothing else.

    Parameters
    ----------
    view : EventView
    number : int
        Layer, from 0.
    """
    return [one for code in (0, 1) if (one := _of_view(view, number, code)) is not None]


def _of_view(view: EventView, number: int, code: int) -> ClusterStrips | None:
    clusters, digis, layer = view.clusters, view.digis, view.detector.cgem[number]
    rows = np.flatnonzero((clusters["layer"] == number) & (clusters["view"] == code) & (clusters["first"] >= 0))
    if not len(rows):
        return None
    true = rows[clusters["truth"][rows] >= 0]
    rows = true if len(true) else rows
    row = rows[[int(np.argmax(clusters["charge"][rows]))]]
    first, last, sheet = (int(clusters[name][row[0]]) for name in ("first", "last", "sheet"))
    near = (digis["layer"] == number) & (digis["view"] == code) & (digis["sheet"] == sheet)
    near &= (digis["strip"] >= first - _BESIDE) & (digis["strip"] <= last + _BESIDE)
    strips = digis["strip"][near] + 0.5
    pitch = (layer.pitch_x, layer.pitch_v)[code]
    position = float(clusters["xv"[code]][row[0]])
    truth = (
        -float(residuals(view.detector, clusters, view.truths, row)[0]) if clusters["truth"][row[0]] >= 0 else np.nan
    )
    return ClusterStrips(
        "XV"[code], (strips * pitch if code == 0 else v_of_strips(layer, strips)) - position,
        digis["charge"][near], digis["time"][near], pitch, truth,
        float(clusters["charge"][row[0]]), int(clusters["size"][row[0]]),
    )  # fmt: skip


def line_widths(view: EventView, fired: npt.NDArray[np.bool_]) -> Array:
    """Return the widths of lines for fired strips, (n,) float64 in points: more with more charge.

    Parameters
    ----------
    view : EventView
    fired : (digis,) bool
    """
    largest = float(view.digis["charge"].max(initial=0.0))
    share = view.digis["charge"][fired] / largest if largest > 0 else np.zeros(int(fired.sum()))
    return np.asarray(0.4 + (_WIDEST - 0.4) * share)


def draw_cluster_strips(axes: list[Axes], view: EventView) -> None:
    """Draw charge and time of the strips of the largest clusters, X upwards and V downwards, one plot a layer.

    Parameters
    ----------
    axes : list of Axes
        For each layer; the last one gets the scale of the times.
    view : EventView
    """
    layers = [cluster_strips(view, number) for number in range(len(axes))]
    times = np.concatenate([np.empty(0), *(one.time for layer in layers for one in layer)])
    low, high = (float(times.min()), float(times.max())) if len(times) else (0.0, 1.0)
    colours = ScalarMappable(Normalize(low, high if high > low else low + 1.0), _TIMES)
    most = max((float(one.charge.max(initial=0.0)) for layer in layers for one in layer), default=0.0) or 1.0
    reach = max((float(np.abs(one.across).max(initial=0.0)) for layer in layers for one in layer), default=0.0) + 1.0
    for plot, strips, layer in zip(axes, layers, view.detector.cgem, strict=True):
        for one in strips:
            _draw_view(plot, one, colours, 1.0 if one.name == "X" else -1.0)
        plot.axhline(0, color=COLORS["text"], lw=0.8)
        plot.axvline(0, color=COLORS["cgem"], lw=1.2, ls="--", label="position of the cluster")
        plot.set(xlim=(-reach, reach), ylim=(-1.45 * most, 1.45 * most), xlabel="across the strips  (mm)")
        plot.set_title(f"strips of the largest clusters, {plain(layer.label)}", loc="left")
        plot.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
        plot.tick_params(length=3)
    axes[0].set_ylabel("V  ←  charge (fC)  →  X")
    scale = axes[-1].inset_axes((1.04, 0.0, 0.05, 1.0))
    axes[-1].figure.colorbar(colours, cax=scale, label="time of the strip  (ns)")


def _draw_view(axes: Axes, strips: ClusterStrips, colours: ScalarMappable, sign: float) -> None:
    bars = axes.bar(
        strips.across, sign * strips.charge, width=0.86 * strips.pitch, color=colours.to_rgba(strips.time), lw=0
    )
    bars.set_label(f"_{strips.name}")
    if np.isfinite(strips.truth):
        tip = sign * 0.5 * float(strips.charge.max())
        axes.plot([strips.truth] * 2, [0, tip], "-o", color=COLORS["truth"], mfc="none", ms=5, markevery=[1], lw=1.2)
    many = f"{strips.size} strip{'s' * (strips.size != 1)}"
    off = f", residual {-1000 * strips.truth:+.0f} µm" if np.isfinite(strips.truth) else ""
    statistics_box(axes, [f"{strips.name}: {strips.whole:.1f} fC, {many}{off}"], right=False,
                   top=0.97 if sign > 0 else 0.12)  # fmt: skip
