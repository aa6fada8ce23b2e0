"""Pictures of one crossing of a CGEM layer: projection to the anode, cluster, and its formation by a chip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection, PolyCollection
from matplotlib.patches import Rectangle

from cgemit.base.arrays import Floats
from cgemit.detector.layers.cgem import strips_of_v, v_of_strips
from cgemit.detector.layers.layer import crossing_z, local_v
from cgemit.draw.event import Array, near
from cgemit.draw.style import COLORS, Picture, legend_entries, new_picture, plain, statistics_box, style

if TYPE_CHECKING:
    from cgemit.chain.result import Result
    from cgemit.detector import CgemLayer


_COPPER = "#B87333"


@dataclass(frozen=True)
class Crossing:
    """One true crossing of a layer, its fired strips and its XV cluster; angles within half a turn of the crossing."""

    layer: CgemLayer
    r: Array  # mm, (3,): entry, mid-gap, exit
    phi: Array  # rad, (3,)
    z: Array  # mm, (3,)
    sheet: int
    strips_x: Array  # fired strips of the sheet
    strips_v: Array
    cluster_phi: float  # rad
    cluster_z: float  # mm

    def x(self, phi: Array | float) -> Array:
        """Return X on the unrolled sheet, mm."""
        return self.layer.r_readout * (near(phi, self.phi[1]) - self.phi_first)

    @property
    def phi_first(self) -> float:
        """Azimuth of X = 0 of the sheet, at most one turn before the crossing, rad."""
        start = self.layer.sheet_phi[self.sheet]
        return float(self.phi[1] - (self.phi[1] - start) % (2 * np.pi))

    def v(self, x: Array | float, z: Array | float) -> Array:
        """Return V of a point of the unrolled sheet, mm."""
        return local_v(self.layer, x, z)


def crossing(result: Result, event: int, layer: int) -> Crossing:
    """Collect what belongs to the first crossing of a layer in one event.

    Raises
    ------
    ValueError
        If the event has no XV cluster in that layer.
    """
    truths, digis, clusters = (
        table.select_events(event, event + 1) for table in (result.truths, result.digis, result.clusters)
    )
    pairs = np.flatnonzero((clusters["layer"] == layer) & (clusters["view"] == 2))
    part = result.detector.layers[layer] if 0 <= layer < len(result.detector.layers) else None
    if part is not None and part.measures_points:
        raise ValueError(f"layer {layer}, {part.label}, has no strips: its clusters are positions")
    rows = np.flatnonzero(truths["layer"] == layer)
    if part is None or not len(pairs) or not len(rows):
        raise ValueError(f"event {event} has no XV cluster in layer {layer}")
    row, pair = rows[0], pairs[0]
    x, y, z = (np.array([truths[f"{end}_{axis}"][row] for end in ("entry", "exit")]) for axis in "xyz")
    middle = float(truths["phi"][row])
    phi = near(np.arctan2(y, x), middle)
    sheet = int(clusters["sheet"][pair])
    fired = (digis["layer"] == layer) & (digis["sheet"] == sheet) & (digis["strip"] >= 0)
    return Crossing(
        result.detector.cgem[part.label],
        np.array([np.hypot(x[0], y[0]), truths["r"][row], np.hypot(x[1], y[1])]),
        np.array([phi[0], middle, phi[1]]),
        np.array([z[0], truths["z"][row], z[1]]),
        sheet,
        digis["strip"][fired & (digis["view"] == 0)],
        digis["strip"][fired & (digis["view"] == 1)],
        float(clusters["phi"][pair]),
        float(clusters["z"][pair]),
    )


def draw_cluster(result: Result, event: int, layer: int = 0) -> Picture:
    """Draw an XV cluster on the unrolled anode: strips, projected crossing, reconstructed position.

    Parameters
    ----------
    result : Result
    event, layer : int
        Event number, and CGEM layer counted from 0.

    Raises
    ------
    ValueError
        If the event has no XV cluster in that layer.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=2)
    >>> picture = cg.draw.draw_cluster(result, event=0, layer=1)
    >>> picture.axes[0].get_xlabel()
    "X = R (φ − φ of the sheet's edge)  (mm)"
    """
    hit = crossing(result, event, layer)
    with style():
        picture, (axes,) = new_picture(1, 1, (7.6, 5.0))
        x, z = hit.x(hit.phi), hit.z
        centre = (float(x[1]), float(z[1]))
        fired = max(abs((strip + edge) * hit.layer.pitch_x - centre[0]) for strip in hit.strips_x for edge in (0, 1))
        half = max(1.35 * max(abs(np.ptp(x)), abs(np.ptp(z)), 3.2 * hit.layer.pitch_x), 1.05 * fired)
        _draw_strips(axes, hit, centre, half)
        axes.plot(x[[0, 2]], z[[0, 2]], "-", color=COLORS["truth"], lw=2.2, label="drift-gap crossing, projected")
        axes.plot(x[0], z[0], "o", color=COLORS["truth"], ms=6, mec="white")
        axes.plot(x[2], z[2], "s", color=COLORS["truth"], ms=6, mec="white")
        axes.plot(*centre, "o", mfc="none", mec=COLORS["truth"], ms=11, mew=1.6, label="truth at mid-gap")
        cluster = (float(hit.x(hit.cluster_phi)), hit.cluster_z)
        axes.plot(*cluster, "X", color=COLORS["data"], ms=10, mec="white", label="XV cluster")
        axes.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - half, centre[1] + half), aspect="equal")
        axes.set(xlabel="X = R (φ − φ of the sheet's edge)  (mm)", ylabel="z  (mm)")
        axes.set_title(
            f"{plain(result.detector.name)}: {plain(hit.layer.label)}, sheet {hit.sheet}, event {event}", loc="left"
        )
        statistics_box(axes, _numbers(hit, centre, cluster))
        axes.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), handlelength=1.6)
        picture.subplots_adjust(left=0.09, right=0.66, top=0.94, bottom=0.1)
    return picture


def _numbers(hit: Crossing, truth: tuple[float, float], cluster: tuple[float, float]) -> list[str]:
    dv = float(hit.v(*cluster) - hit.v(*truth))
    return [
        f"strips: {len(hit.strips_x)} X, {len(hit.strips_v)} V",
        f"X residual: {1000 * (cluster[0] - truth[0]):+.0f} µm",
        f"V residual: {1000 * dv:+.0f} µm",
        f"z residual: {1000 * (cluster[1] - truth[1]):+.0f} µm",
    ]


def _draw_strips(axes: Axes, hit: Crossing, centre: tuple[float, float], half: float) -> None:
    """Draw the strips of both views in a window; fired ones are filled."""
    layer = hit.layer
    low, high = centre[1] - half, centre[1] + half
    edges = np.array([centre[0] - half, centre[0] + half])
    first, last = (edges // layer.pitch_x).astype(int)
    for strip in range(first, last + 1):
        fired = strip in hit.strips_x
        axes.add_patch(_strip_x(strip * layer.pitch_x, layer.pitch_x, low, high, fired))
        if fired:
            axes.text((strip + 0.5) * layer.pitch_x, low + 0.03 * half, f"X {strip}", rotation=90, ha="center",
                      va="bottom", fontsize=7.5, color=COLORS["x"])  # fmt: skip
    corners = hit.v(np.repeat(edges, 2), np.tile([low, high], 2))
    first, last = (int(np.floor(strips_of_v(layer, v))) for v in (corners.min(), corners.max()))
    shapes = [_strip_v(hit, strip, edges) for strip in range(first, last + 1)]
    fired_v = [strip in hit.strips_v for strip in range(first, last + 1)]
    axes.add_collection(
        PolyCollection(
            shapes,
            facecolors=[COLORS["v"] + ("55" if fired else "00") for fired in fired_v],
            edgecolors=COLORS["v"] + "55",
            linewidths=0.6,
            zorder=1.5,
        )
    )
    for handle, label in ((COLORS["x"], "fired X strip"), (COLORS["v"], "fired V strip")):
        axes.add_patch(Rectangle((0, 0), 0, 0, facecolor=handle + "55", edgecolor=handle, label=label))


def _strip_x(start: float, pitch: float, low: float, high: float, fired: bool) -> Rectangle:
    colour = COLORS["x"] + ("44" if fired else "00")
    return Rectangle((start, low), pitch, high - low, facecolor=colour, edgecolor=COLORS["x"] + "44", lw=0.6)


def _strip_v(hit: Crossing, strip: int, edges: Array) -> Array:
    """Return the corners (4, 2) in (X, z) of a V strip between two X; mm."""
    v = v_of_strips(hit.layer, np.array([strip, strip, strip + 1, strip + 1]))
    x = edges[[0, 1, 1, 0]]
    return np.column_stack([x, crossing_z(hit.layer, x, v)])


def draw_projection(result: Result, event: int, layer: int = 0) -> Picture:
    """Draw the structure of one CGEM layer with a true crossing and its projection to the anode.

    Parameters
    ----------
    result : Result
    event, layer : int
        Event number, and CGEM layer counted from 0.

    Returns
    -------
    Picture
        Across the beam (X strips) and along it (V strips), unrolled at the readout radius.

    Raises
    ------
    ValueError
        If the event has no XV cluster in that layer.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=2)
    >>> picture = cg.draw.draw_projection(result, event=0, layer=1)
    >>> picture.axes[0].get_xlabel()
    'R (φ − φ at mid-gap)  (mm)'
    """
    hit = crossing(result, event, layer)
    with style():
        picture, axes = new_picture(1, 2, (12.0, 5.2))
        x = hit.layer.r_readout * (hit.phi - hit.phi[1])
        start = hit.layer.r_readout * (hit.phi_first - hit.phi[1])
        edges_x = start + hit.layer.pitch_x * hit.strips_x
        step = hit.layer.pitch_v / np.sin(hit.layer.stereo)
        # Where the V strips meet the line of constant X through the middle of the crossing.
        offset = float(crossing_z(hit.layer, hit.x(hit.phi[1]), v_of_strips(hit.layer, 0.0)) - hit.z[1])
        _draw_section(axes[0], hit, x, edges_x, hit.layer.pitch_x, start, COLORS["x"])
        _draw_section(axes[1], hit, hit.z - hit.z[1], offset - step * hit.strips_v, -step, offset, COLORS["v"])
        axes[0].set(xlabel="R (φ − φ at mid-gap)  (mm)", ylabel="r  (mm)")
        axes[1].set(xlabel="z − z at mid-gap  (mm)")
        axes[0].set_title(f"{plain(hit.layer.label)} across the beam: X strips", loc="left")
        axes[1].set_title("along the beam: V strips at the crossing's X", loc="left")
        entries = legend_entries(axes)
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=5)
        picture.subplots_adjust(left=0.06, right=0.98, top=0.93, bottom=0.18, wspace=0.14)
    return picture


def _draw_section(
    axes: Axes, hit: Crossing, along: Array, fired: Array, pitch: float, first: float, colour: str
) -> None:
    """Draw the stack, the crossing (entry, mid-gap, exit at `along`, mm) and strips starting at `fired` (mm)."""
    layer = hit.layer
    half = 1.25 * max(float(np.abs(along).max()), 2.6 * abs(pitch))
    _draw_stack(axes, layer, half)
    anode = layer.anode_radius
    number = np.arange(np.floor((-half - first) / abs(pitch)) - 1, np.ceil((half - first) / abs(pitch)) + 2)
    edges = first + number * abs(pitch)
    strips = [Rectangle((edge + 0.06 * abs(pitch), anode), 0.88 * abs(pitch), 0.45) for edge in edges]
    axes.add_collection(PatchCollection(strips, facecolor="white", edgecolor=_COPPER, linewidth=0.7, zorder=2))
    low = np.minimum(fired, fired + pitch) + 0.06 * abs(pitch)
    hits = [Rectangle((edge, anode), 0.88 * abs(pitch), 0.45) for edge in low]
    axes.add_collection(PatchCollection(hits, facecolor=colour, edgecolor=colour, linewidth=0.7, zorder=3))
    _draw_path(axes, hit, along, anode)
    axes.plot([], [], "s", color=colour, ms=8, label=f"fired {'X' if colour == COLORS['x'] else 'V'} strips")
    axes.set(xlim=(-half, half), ylim=(layer.r_gap_in - 1.1, anode + 1.5))


def _draw_path(axes: Axes, hit: Crossing, along: Array, anode: float) -> None:
    slope = (along[2] - along[0]) / (hit.r[2] - hit.r[0])
    whole = np.array([hit.layer.r_gap_in - 1.1, anode + 1.5])
    axes.plot(along[1] + slope * (whole - hit.r[1]), whole, "--", color=COLORS["fit"], lw=1.2, label="track")
    axes.plot(along[[0, 2]], hit.r[[0, 2]], "-", color=COLORS["fit"], lw=2.4, label="crossing of the drift gap")
    for place, radius in zip(along[[0, 2]], hit.r[[0, 2]], strict=True):
        axes.plot([place, place], [radius, anode], ":", color=COLORS["truth"], lw=1.6)
        axes.plot(place, radius, "o", color=COLORS["fit"], ms=5)
    axes.fill_betweenx([anode - 0.22, anode - 0.04], along[[0, 2]].min(), along[[0, 2]].max(), color=COLORS["truth"],
                       label="projection at unchanged φ and z", lw=0, zorder=3)  # fmt: skip


def _draw_stack(axes: Axes, layer: CgemLayer, half: float) -> None:
    axes.axhspan(layer.r_gap_in, layer.r_gap_out, color="#DCEBF8", lw=0)
    axes.axhspan(layer.r_gap_in - 0.12, layer.r_gap_in, color="#6B7785", lw=0)
    foils = [shell for shell in layer.shells() if shell.group == "foils" and not shell.label.endswith("gap")]
    numbers = sorted({shell.label.split()[1] for shell in foils})
    text: dict[str, Any] = {"fontsize": 8, "color": "#555555", "va": "center", "ha": "left"}
    for number in numbers:
        parts = [shell for shell in foils if shell.label.split()[1] == number]
        low, high = parts[0].r_in, parts[-1].r_out
        # Dashes stand for the holes; a foil of 54 um would be thinner than a line.
        axes.plot([-half, half], [0.5 * (low + high)] * 2, color=_COPPER, lw=2.2, dashes=(2.2, 0.9))
        axes.text(-0.97 * half, high + 0.28, f"GEM {number}", **text)
    axes.text(-0.97 * half, layer.r_gap_in - 0.55, "cathode", **text)
    axes.text(-0.97 * half, layer.r_gap_in + 0.4, f"drift gap {layer.drift_gap:g} mm", **text)
    axes.text(-0.97 * half, layer.anode_radius + 1.0, "anode", **text)


_DEPTH = 3.0  # mm of the picture for the largest charge
_MARGIN = 2.0  # mm on either side


class FormationPanel(NamedTuple):
    """One track with one set of switches; lengths in mm, X from the crossing of mid-gap, depth from the cathode.

    Examples
    --------
    >>> from cgemit.study.readout.scan import formation
    >>> panels = formation(cg.TigerReadout(), angle=20.0, bz=1.0)
    >>> len(panels), panels[0].pitch  # mm
    (4, 0.65)
    """

    title: str
    track: Floats  # (2, 2), X and depth where it enters and leaves the drift gap
    drift: list[Floats]  # lines of electrons, each (m, 2)
    foils: Floats  # (n,), depth of the foils
    anode: float  # depth
    pitch: float
    strips: Floats  # (n,), X of the middles of fired strips
    charge: Floats  # (n,) fC


def draw_formation(panels: Sequence[FormationPanel]) -> Picture:
    """Draw the track, electrons through drift gap and foils, and the charges of the strips, one plot a panel.

    Parameters
    ----------
    panels : sequence of FormationPanel

    Examples
    --------
    >>> from cgemit.study.readout.scan import formation
    >>> picture = cg.draw.draw_formation(formation(cg.TigerReadout(), angle=20.0, bz=1.0))
    >>> len(picture.axes)
    4
    """
    low, high = _range(panels)
    most = max(float(panel.charge.max(initial=0.0)) for panel in panels)
    with style():
        picture, plots = new_picture((len(panels) + 1) // 2, 2, (9.6, 4.6 * ((len(panels) + 1) // 2)))
        for axes, panel in zip(plots, panels, strict=True):
            axes.add_collection(LineCollection(panel.drift, colors=COLORS["cgem"], lw=0.5, alpha=0.35))
            axes.plot(*panel.track.T, color=COLORS["truth"], lw=2.0, label="muon")
            axes.plot([], [], color=COLORS["cgem"], lw=1.0, label="electrons")
            for depth in panel.foils:
                axes.plot([low, high], [depth, depth], color=_COPPER, lw=2.0, ls=(0, (2, 1)))
            axes.axhline(0, color=_COPPER, lw=2.0)
            axes.axhline(panel.anode, color="black", lw=1.0)
            height = _DEPTH * panel.charge / most if most > 0 else panel.charge
            axes.bar(
                panel.strips, height, 0.85 * panel.pitch, bottom=panel.anode, color=COLORS["data"],
                label="charge of X strips",
            )  # fmt: skip
            axes.set(xlim=(low, high), ylim=(panel.anode + 1.15 * _DEPTH, -0.8), title=panel.title)
            axes.set(xlabel="X − X of the muon at mid-gap  (mm)", ylabel="depth from the cathode  (mm)")
            n = len(panel.charge)
            total = f"{panel.charge.sum():.0f} fC on {n} strip{'s' * (n != 1)}"
            axes.text(0.02, 0.02, total, transform=axes.transAxes, ha="left", va="bottom", fontsize=9)
            names = [(0, "cathode"), *((depth, f"GEM {i + 1}") for i, depth in enumerate(panel.foils))]
            for depth, name in [*names, (panel.anode, "anode")]:
                axes.text(low + 0.1, depth - 0.08, name, fontsize=8, va="bottom")
        handles, labels = plots[0].get_legend_handles_labels()
        picture.legend(handles, labels, loc="upper center", ncols=3)
        picture.tight_layout(rect=(0, 0, 1, 0.96))
    return picture


def _range(panels: Sequence[FormationPanel]) -> tuple[float, float]:
    """Return the range of X that shows nearly all electrons and all tracks."""
    ends = np.concatenate([[line[-1, 0] for line in panel.drift] for panel in panels if panel.drift])
    tracks = np.concatenate([panel.track[:, 0] for panel in panels])
    low, high = np.quantile(ends, (0.01, 0.99)) if len(ends) else (0.0, 0.0)
    return float(min(low, tracks.min()) - _MARGIN), float(max(high, tracks.max()) + _MARGIN)
