"""Pictures of a detector: r-phi, r-z, matter against the angle, and the materials of one CGEM layer to scale."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Annulus, Patch, Rectangle

from cgemit.detector import CgemLayer, Detector, Shell, WireLayer, load
from cgemit.detector.inventory import MaterialScan, material_scan
from cgemit.draw.event import chamber_begin, wire_layers, wire_positions, wire_profile
from cgemit.draw.style import COLORS, Picture, fills, grid, new_picture, plain, style

_PARTS = {
    "beam pipe": "#B5651D",
    "wall": "#55606C",
    "CGEM electrodes and gaps": "#AEB9C6",
    "CGEM drift gap": "#8FC8EC",
    "layer": "#009E73",
}
_AXIAL, _POSITIVE, _NEGATIVE = "axial wires", "stereo wires, twist > 0", "stereo wires, twist < 0"
_WIRES = {_AXIAL: "#8A8A8A", _POSITIVE: "#D55E00", _NEGATIVE: "#0072B2"}
_MATERIALS = {
    "Cu": "#B8602A", "CuFoil": "#D98A4E", "CuStripV": "#F0B27A", "CuStripX": "#C9753D", "Kapton": "#E3B505",
    "KaptonFoil": "#F2D45C", "KaptonStripV": "#F8E9A1", "Epoxy": "#7FB77E", "Nomex": "#D9D2C5", "Rohacell31": "#E8D9E8",
    "CarbonFiber": "#3A3A3A",
}  # fmt: skip
_OTHERS = ("#8F6BB3", "#009E73", "#CC3311", "#4477AA", "#AA7799")
_GAS = "#EAF4FB"
_COSINES = (0.0, 0.5, 0.8, 0.93)  # of the polar angles drawn; the paper's tracks reach 0.93
_LABEL = 0.03  # height of a label, as a part of the view along the beam


class _Ring(NamedTuple):
    part: str
    r_in: float  # mm
    r_out: float  # mm
    ends: tuple[float, float]  # mm


def draw_detector(detector: Detector | str | Mapping[str, Any]) -> Picture:
    """Return a picture of the detector across the beam, whole and magnified; `draw_sides` draws it along the beam.

    Parameters
    ----------
    detector : Detector, or what `load` accepts

    Returns
    -------
    Picture

    Examples
    --------
    >>> picture = cg.draw.draw_detector("besiii-cgem")
    >>> [axes.get_xlabel() for axes in picture.axes]
    ['x (mm)', 'x (mm)']
    """
    detector = load(detector)
    with style():
        picture, axes = new_picture(1, 2, (12.6, 6.9))
        draw_xy(detector, axes[0])
        draw_xy(detector, axes[1], r_max=_inner_edge(detector))
        axes[1].set_title("inner part")
        picture.tight_layout()
    return picture


def draw_sides(detector: Detector | str | Mapping[str, Any]) -> Picture:
    """Return a picture of the detector along the beam, whole and magnified.

    Parameters
    ----------
    detector : Detector, or what `load` accepts

    Returns
    -------
    Picture

    Examples
    --------
    >>> picture = cg.draw.draw_sides("besiii-cgem")
    >>> picture.axes[0].get_xlabel(), picture.axes[0].get_ylabel()
    ('z (mm)', 'r (mm)')
    """
    detector = load(detector)
    with style():
        picture, axes = new_picture(2, 1, (9.6, 9.4), height_ratios=(1.5, 1))
        draw_rz(detector, axes[0])
        draw_rz(detector, axes[1], r_max=_inner_edge(detector))
        axes[1].set_title("inner part", pad=16)
        picture.tight_layout()
    return picture


Angle = Literal["cos_theta", "theta", "eta"]
#: Label and values of the polar angle on an axis.
ANGLES = {"cos_theta": ("cos θ", 1.0), "theta": ("θ  (deg)", 180 / math.pi), "eta": ("η", 1.0)}
_HITS = {"cgem": "CGEM layers", "layers": "other layers of positions", "wires": "wire layers"}


def draw_material(
    scan: MaterialScan | Detector | str | Mapping[str, Any], against: Angle = "cos_theta", *, most: int = 8
) -> Picture:
    """Draw X/X0 by part as stacked areas, and the crossed layers, against the polar angle.

    Parameters
    ----------
    scan : MaterialScan, or what `load` accepts
        Of a detector: by part, at the angles of `material_scan`.
    against : str
        ``"cos_theta"``, ``"theta"`` (degrees) or ``"eta"``.
    most : int
        Parts that are drawn: those with the largest mean X/X0. The rest is one area, ``other``.

    Returns
    -------
    Picture

    Raises
    ------
    ValueError
        If `against` is not known, `most` is less than 1, or there are fewer than two angles.

    Examples
    --------
    >>> picture = cg.draw.draw_material("besiii-cgem", "theta")
    >>> [axes.get_ylabel() for axes in picture.axes]
    ['X/X0  (%)', 'crossed layers']
    """
    scan = scan if isinstance(scan, MaterialScan) else material_scan(scan)
    if against not in ANGLES or most < 1 or len(scan.cos_theta) < 2:
        raise ValueError(
            f"draw_material: got against {against!r}, most {most!r} and {len(scan.cos_theta)} angles; expected "
            f"{', '.join(ANGLES)}, at least 1, and at least two angles"
        )
    text, factor = ANGLES[against]
    x = factor * np.asarray(getattr(scan, against))
    order = np.argsort(x, kind="stable")
    names = sorted(scan.x0, key=lambda name: -float(scan.x0[name].mean()))
    areas = {name: scan.x0[name] for name in names[:most]}
    if names[most:]:
        areas["other"] = np.sum([scan.x0[name] for name in names[most:]], axis=0)
    with style():
        width = 6.4 + 0.085 * max(map(len, [*areas, *_HITS.values()]))
        picture, (matter, hits) = new_picture(2, 1, (width, 6.4), sharex=True, height_ratios=(2.2, 1))
        low = np.zeros(len(x))
        for (name, values), (colour, hatch) in zip(areas.items(), fills(len(areas)), strict=True):
            colour, hatch = (COLORS["matter"], "") if name == "other" else (colour, hatch)
            high = low + values[order]
            matter.fill_between(x[order], low, high, fc=colour, hatch=hatch, ec="white", lw=0, label=plain(name))
            low = high
        matter.set(ylabel="X/X0  (%)", ylim=(0, None), xlim=(x.min(), x.max()))
        matter.set_title(plain(f"{scan.detector}, straight tracks from the origin"), loc="left")
        handles, labels = matter.get_legend_handles_labels()
        matter.legend(handles[::-1], labels[::-1], loc="center left", bbox_to_anchor=(1.01, 0.5), title=scan.by)
        for name, counts in scan.hits.items():
            hits.step(x[order], counts[order], where="mid", label=_HITS[name])
        hits.set(xlabel=text, ylabel="crossed layers", ylim=(0, None))
        hits.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        for axes in (matter, hits):
            grid(axes)
        picture.align_ylabels()
        picture.subplots_adjust(left=0.75 / width, right=5.7 / width, top=0.94, bottom=0.09, hspace=0.08)
    return picture


def draw_layers(detector: Detector | str | Mapping[str, Any]) -> Picture:
    """Return a picture of the materials of every CGEM layer."""
    detector = load(detector)
    with style():
        rows = len(detector.cgem)
        picture, axes = new_picture(rows, 1, (11.0, 2.9 * rows))
        for layer, ax in zip(detector.cgem, axes, strict=True):
            draw_layer(layer, ax)
        picture.tight_layout()
    return picture


def draw_xy(detector: Detector | str | Mapping[str, Any], ax: Axes | None = None, r_max: float | None = None) -> Axes:
    """Draw the detector in the plane across the beam, wires where they cross z = 0.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    ax : Axes, optional
        Where to draw; default: new axes.
    r_max : float, optional
        Outer edge of the view, mm; default: the whole detector.
    """
    detector = load(detector)
    with style():
        ax, edge, rings = _view(detector, ax, r_max, (6.6, 6.4))
        for ring in rings:
            # Thin cylinders stay visible: the edge line has a fixed width.
            width = ring.r_out - ring.r_in
            color = _PARTS[ring.part]
            ax.add_patch(Annulus((0, 0), ring.r_out, width, facecolor=color, edgecolor=color, linewidth=0.5))
        wires = _wires_xy(ax, detector, edge)
        marked = [_mark_layer(ax, layer) for layer in detector.cgem if layer.r_out > 0.3 * edge]
        ax.set(xlim=(-edge, edge), ylim=(-edge, edge), aspect="equal", xlabel="x (mm)", ylabel="y (mm)")
        ax.set_title(f"{plain(detector.name)}: r-phi" + (" at z = 0" if detector.drift_chamber else ""))
        handles = _handles(rings, wires) + marked[:1]
        ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3, fontsize=8)
    return ax


def draw_rz(detector: Detector | str | Mapping[str, Any], ax: Axes | None = None, r_max: float | None = None) -> Axes:
    """Draw one half of the detector along the beam, with lines of constant cos(theta).

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    ax : Axes, optional
        Where to draw; default: new axes.
    r_max : float, optional
        Outer edge of the view, mm; default: the whole detector.
    """
    detector = load(detector)
    with style():
        ax, edge, rings = _view(detector, ax, r_max, (9.6, 5.4))
        layers = [layer for layer in wire_layers(detector) if layer.r_mid < edge]
        ends = [ring.ends for ring in rings] + [layer.ends for layer in layers]
        reach = 1.12 * max(max(-low, high) for low, high in ends)
        for ring in rings:
            color, (low, high) = _PARTS[ring.part], ring.ends
            size = (high - low, ring.r_out - ring.r_in)
            ax.add_patch(Rectangle((low, ring.r_in), *size, facecolor=color, edgecolor=color, linewidth=0.5))
        for layer in layers:
            ax.plot(*wire_profile(layer), color=_WIRES[_kind(layer)], linewidth=0.6)
        seen = [layer for layer in detector.layers if layer.r_mid < edge]
        room = min(np.diff([layer.r_mid for layer in seen]), default=edge) > _LABEL * edge
        for measuring in seen if room else ():
            place = (measuring.ends[1] + 0.008 * reach, measuring.r_mid)
            ax.annotate(
                plain(measuring.label), place, va="center", fontsize=8.5, fontweight="bold", color=COLORS["text"]
            )
        _polar_angles(ax, edge, reach)
        ax.set(xlim=(-reach, reach), ylim=(0, edge), xlabel="z (mm)", ylabel="r (mm)")
        ax.set_title(f"{plain(detector.name)}: r-z", pad=16)
        handles = _handles(rings, {_kind(layer) for layer in layers})
        box = {"frameon": True, "framealpha": 0.93, "edgecolor": COLORS["grid"]}
        ax.legend(handles=handles, loc="lower left", fontsize=8, **box)
    return ax


def draw_layer(layer: CgemLayer, ax: Axes | None = None) -> Axes:
    """Draw the materials of one CGEM layer along the radius, to scale.

    Parameters
    ----------
    layer : CgemLayer
    ax : Axes, optional
        Where to draw; default: new axes.
    """
    with style():
        ax = ax or new_picture(size=(11.0, 2.9))[1][0]
        shells = list(layer.shells())
        colors = _material_colors(layer, shells)
        for shell in shells:
            # No outline: films of 3 um are drawn as thin as they are.
            color = colors[shell.material.name]
            ax.add_patch(Rectangle((shell.r_in, 0), shell.thickness, 1, facecolor=color, linewidth=0))
        for name, parts in _groups(shells):
            r_in, r_out, x0 = parts[0].r_in, parts[-1].r_out, sum(part.x0 for part in parts)
            ax.plot([r_in, r_out], [1.05, 1.05], "|-", color=COLORS["text"], linewidth=1.0, clip_on=False)
            text = f"{name}, {r_out - r_in:.3f} mm\n{100 * x0:.3f} % X$_0$"
            ax.text((r_in + r_out) / 2, 1.09, text, ha="center", va="bottom", fontsize=8, color=COLORS["text"])
        margin = 0.01 * (layer.r_out - layer.r_in)
        ax.set(xlim=(layer.r_in - margin, layer.r_out + margin), ylim=(0, 1), yticks=[], xlabel="r (mm)")
        ax.set_title(f"CGEM layer {plain(layer.label)}: materials along the radius, to scale", pad=38)
        handles = [Patch(facecolor=color, edgecolor="#999999", label=plain(name)) for name, color in colors.items()]
        ax.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    return ax


def _view(
    detector: Detector, ax: Axes | None, r_max: float | None, size: tuple[float, float]
) -> tuple[Axes, float, list[_Ring]]:
    """Return given axes or new ones of a size in inches, the outer edge of the view in mm, and the rings in it."""
    edge = r_max or _outer_edge(detector)
    return ax or new_picture(size=size)[1][0], edge, [ring for ring in _rings(detector) if ring.r_in < edge]


def _rings(detector: Detector) -> Iterator[_Ring]:
    for part in detector.beam_pipe:
        yield _Ring("beam pipe", part.r_in, part.r_out, part.ends)
    for part in detector.walls:
        yield _Ring("wall", part.r_in, part.r_out, part.ends)
    for _, layers in detector.by_kind():
        for layer in layers:
            yield from (_Ring(*ring, layer.ends) for ring in layer.rings())


def _kind(layer: WireLayer) -> str:
    return _AXIAL if layer.twist == 0 else _POSITIVE if layer.twist > 0 else _NEGATIVE


def _outer_edge(detector: Detector) -> float:
    """Return the radius of a view of everything, mm."""
    return 1.05 * max([ring.r_out for ring in _rings(detector)] + [layer.r_end for layer in wire_layers(detector)])


def _inner_edge(detector: Detector) -> float:
    """Return the radius of a view of the parts inside of the drift chamber, mm; of all without a chamber."""
    begin = chamber_begin(detector)
    rings = 1.2 * max([ring.r_out for ring in _rings(detector) if ring.r_out < begin], default=0.0)
    measured = any(layer.r_out < begin for layer in detector.layers)
    return min(rings if measured else max(rings, 0.28 * _outer_edge(detector)), _outer_edge(detector))


def _wires_xy(ax: Axes, detector: Detector, edge: float) -> set[str]:
    """Draw the wires at z = 0; return the kinds drawn."""
    points: dict[str, list[np.ndarray]] = {}
    for layer in wire_layers(detector):
        if layer.r_mid < 1.4 * edge:  # up to the corners of the square
            points.setdefault(_kind(layer), []).append(np.array(wire_positions(layer, np.arange(layer.cells), 0.0)))
    size = float(np.clip(700 / edge, 1.8, 3.5))
    for kind, found in points.items():
        x, y = np.concatenate(found, axis=1)
        # Rasterized: thousands of dots would make the PDF slow.
        ax.plot(x, y, ".", markersize=size, markeredgewidth=0, color=_WIRES[kind], rasterized=True)
    return set(points)


def _mark_layer(ax: Axes, layer: CgemLayer) -> Line2D:
    """Write the label of a layer and mark where its sheets begin; return what a legend shows for that."""
    for phi in layer.sheet_phi:
        ends = np.array([layer.r_gap_out, 1.02 * layer.r_out])
        ax.plot(ends * math.cos(phi), ends * math.sin(phi), color=COLORS["fit"], linewidth=1.6)
    phi = math.radians(50)  # seldom the edge of a sheet
    place = (layer.r_mid * math.cos(phi), layer.r_mid * math.sin(phi))
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    ax.text(*place, plain(layer.label), ha="center", va="center", fontsize=9, fontweight="bold", bbox=box)
    return Line2D([], [], color=COLORS["fit"], linewidth=1.6, label="edge of a readout sheet")


def _polar_angles(ax: Axes, edge: float, reach: float) -> None:
    """Draw lines from the origin at both signs of some cos(theta)."""
    for cosine in _COSINES:
        cotangent = cosine / math.sqrt(1 - cosine**2)
        z, r = (cotangent * edge, edge) if cotangent * edge < reach else (reach, reach / cotangent)
        for sign in (1, -1):
            ax.plot([0, sign * z], [0, r], color="#777777", linewidth=0.7, linestyle=(0, (5, 4)), zorder=1)
        text = f"{cosine:g}" if cosine else "cos θ = 0"
        offset, anchor = ((3, 0), ("left", "center")) if z == reach else ((0, 2), ("center", "bottom"))
        ax.annotate(
            text, (z, r), xytext=offset, ha=anchor[0], va=anchor[1], fontsize=8, textcoords="offset points",
            annotation_clip=False, color="#555555",
        )  # fmt: skip


def _handles(rings: Sequence[_Ring], wires: set[str]) -> list[Patch | Line2D]:
    """Return what a legend shows for the parts that are drawn."""
    seen = {ring.part for ring in rings}
    parts = [Patch(facecolor=color, label=part) for part, color in _PARTS.items() if part in seen]
    kinds = [kind for kind in _WIRES if kind in wires]
    return parts + [Line2D([], [], color=_WIRES[kind], marker=".", linestyle="", label=kind) for kind in kinds]


def _material_colors(layer: CgemLayer, shells: Sequence[Shell]) -> dict[str, str]:
    others = iter(_OTHERS * 4)
    colors = {layer.gas.name: _GAS}
    for shell in shells:
        name = shell.material.name
        if name not in colors:
            colors[name] = _MATERIALS.get(name) or next(others)
    return colors


def _groups(shells: Sequence[Shell]) -> Iterator[tuple[str, list[Shell]]]:
    """Yield cathode, drift gap, foils with the gaps behind them, and anode."""
    names = {"cathode": "cathode", "drift": "drift gap", "foils": "foils and gaps", "anode": "anode"}
    for group, name in names.items():
        yield name, [shell for shell in shells if shell.group == group]
