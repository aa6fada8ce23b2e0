"""Pictures of alignment: errors by part, weak modes, residuals before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from cgemit.base.arrays import Floats
from cgemit.calibration.align import Alignment
from cgemit.detector.alignment import rigid_parts
from cgemit.detector.layers.layer import PLACEMENT
from cgemit.draw.style import COLORS, SERIES, Picture, grid, new_picture, style

if TYPE_CHECKING:
    from cgemit.calibration.forecast import AlignmentForecast

_SHORT = {"mm": (1e3, "µm"), "rad": (1e6, "µrad"), "ns": (1.0, "ns"), "": (1.0, "1")}


_MOST_LABELS = 10  # of parts


def draw_constants(alignment: Alignment | AlignmentForecast) -> Picture:
    """Draw the errors of all constants by part, logarithmically; of an alignment also the convergence.

    Of the single wires of a layer it is the median.

    Parameters
    ----------
    alignment : Alignment or AlignmentForecast

    Returns
    -------
    Picture

    Examples
    --------
    >>> muons = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    >>> picture = cg.draw.draw_constants(cg.alignment_forecast("besiii-cgem", [(muons, 1000)]))
    >>> picture.axes[0].get_ylabel()
    'error  (µm, µrad)'
    """
    with style():
        aligned = isinstance(alignment, Alignment)
        picture, axes = new_picture(1, 2 if aligned else 1, (11.4 if aligned else 7.6, 4.8))
        _errors(axes[0], alignment)
        if isinstance(alignment, Alignment):
            _convergence(axes[1], alignment)
        picture.subplots_adjust(left=0.08, right=0.98, top=0.92, bottom=0.2, wspace=0.22)
    return picture


def _errors(axes: Axes, found: Alignment | AlignmentForecast) -> None:
    table = found.table
    names = [_part_and_key(name) for name in table.name]
    parts, keys = (list(dict.fromkeys(one[i] for one in names)) for i in (0, 1))
    width = 0.8 / len(keys)
    for i, key in enumerate(keys):
        errors = dict[str, list[float]]()
        for (part, own), unit, err in zip(names, table.unit, table.err, strict=True):
            if own == key and np.isfinite(err):
                errors.setdefault(part, []).append(_SHORT[unit][0] * err)
        at = [parts.index(part) + (i - 0.5 * (len(keys) - 1)) * width for part in errors]
        axes.bar(
            at, [float(np.median(one)) for one in errors.values()], width, color=SERIES[i % len(SERIES)], label=key
        )
    units = [_SHORT[unit][1] for unit in ("mm", "rad", "ns", "") if unit in table.unit]
    every = 1 + (len(parts) - 1) // _MOST_LABELS
    axes.set(yscale="log", ylabel=f"error  ({', '.join(units)})", xticks=range(0, len(parts), every))
    axes.set_xticklabels(parts[::every], rotation=20, ha="right")
    axes.set_ylim(top=2 * axes.get_ylim()[1])  # below the legend
    axes.legend(ncol=3, fontsize=7.5)
    grid(axes)


def _part_and_key(name: str) -> tuple[str, str]:
    """Return the part and the key of a constant; points of a relation are parts, and the wires of a layer are one."""
    part, _, key = name.rpartition(".")
    if ".wires." in part:
        part = part.partition(".wires.")[0]
    return (name, "time") if part.endswith("drift_relation") else (part, key)


def _convergence(axes: Axes, found: Alignment) -> None:
    steps = [max(one.step, 1e-6) for one in found.history]
    axes.plot(range(1, len(steps) + 1), steps, "o-", color=COLORS["cgem"])
    axes.set(yscale="log", xlabel="iteration", ylabel="largest step  (standard deviations)")
    axes.set_xticks(range(1, len(steps) + 1))
    grid(axes)


def draw_modes(alignment: Alignment | AlignmentForecast, number: int = 4) -> Picture:
    """Draw the weakest modes as arrows, seen along the beam and from the side.

    Parameters
    ----------
    alignment : Alignment or AlignmentForecast
    number : int
        Of modes; zero modes come first.

    Returns
    -------
    Picture

    Examples
    --------
    >>> muons = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    >>> picture = cg.draw.draw_modes(cg.alignment_forecast("besiii-cgem", [(muons, 1000)]), number=2)
    >>> len(picture.axes)
    4
    """
    modes = alignment.modes(number)
    shown = len(modes.names)
    with style():
        picture, axes = new_picture(2, shown, (3.0 * shown + 0.6, 5.8))
        for i in range(shown):
            values = dict(zip(modes.constants, modes.shapes[i], strict=True))
            _arrows(axes[i], axes[shown + i], alignment, values)
            size = "not determined" if not np.isfinite(modes.sizes[i]) else f"{1e3 * modes.sizes[i]:.3g} µm"
            axes[i].set_title(f"{modes.names[i]}\n{size}", fontsize=8.5)
        axes[0].set_ylabel("y  (mm)")
        picture.subplots_adjust(left=0.09, right=0.98, top=0.9, bottom=0.09, wspace=0.4, hspace=0.25)
    return picture


def _arrows(along: Axes, side: Axes, alignment: Alignment | AlignmentForecast, values: dict[str, float]) -> None:
    """Draw a mode along the beam, and from the side in the plane, x or y over z, in which it moves more."""
    parts = []
    for path, (points, pivot) in rigid_parts(alignment.solution.detector).items():
        constants = np.array([values.get(f"{path}.{key}", 0.0) for key in PLACEMENT])
        parts.append((points, constants[:3] + np.cross(constants[3:], points - pivot)))
    far = [np.abs(np.concatenate([moved[:, axis] for _, moved in parts])).max() for axis in (0, 1)]
    up = int(far[1] > far[0])
    reach = np.zeros(2)  # r and z of the parts that move
    for points, moved in parts:
        r = np.hypot(points[:, 0], points[:, 1])
        if moved.any():
            reach = np.maximum(reach, (r.max(), np.abs(points[:, 2]).max()))
        outer = np.isclose(r, r.max())
        middle = outer & np.isclose(points[:, 2], np.median(points[outer, 2]))
        plane = outer & (np.abs(points[:, 1 - up]) < 1e-6)
        for axes, rows, columns in ((along, middle, (0, 1)), (side, plane, (2, up))):
            _quiver(axes, points[rows][:, columns], moved[rows][:, columns])
    if not reach.any():  # a mode of sheets, wires or drift times
        every = np.concatenate([points for points, _ in parts])
        reach = np.array([np.hypot(every[:, 0], every[:, 1]).max(), np.abs(every[:, 2]).max()])
        along.text(0, 0, "no whole part moves", ha="center", va="center", fontsize=8)
    across, beam = 1.4 * reach
    along.set(xlabel="x  (mm)", aspect="equal", xlim=(-across, across), ylim=(-across, across))
    side.set(xlabel="z  (mm)", ylabel=f"{'xy'[up]}  (mm)", xlim=(-beam, beam), ylim=(-across, across))
    for axes in (along, side):
        grid(axes)


def _quiver(axes: Axes, at: Floats, moved: Floats) -> None:
    axes.plot(*at.T, ".", ms=2, color=COLORS["wire"])
    axes.quiver(*at.T, *moved.T, color=COLORS["fit"], angles="uv", scale=12, width=6e-3)


def draw_residual_means(alignment: Alignment) -> Picture:
    """Draw the mean residuals of the views of layers before and after an alignment.

    Parameters
    ----------
    alignment : Alignment

    Returns
    -------
    Picture

    Examples
    --------
    >>> run = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), n=100, readout="gaussian")
    >>> picture = cg.draw.draw_residual_means(cg.align(run, cg.AlignmentSettings(free=("cgem.*.shift_z",))))
    >>> picture.axes[0].get_ylabel()
    'mean residual  (µm)'
    """
    with style():
        picture, (axes,) = new_picture(1, 1, (7.0, 4.4))
        names = list(alignment.residuals[0])
        for i, (label, colour) in enumerate((("before", COLORS["idc"]), ("after", COLORS["cgem"]))):
            numbers = np.array([alignment.residuals[i].get(name, (np.nan, np.nan)) for name in names]) * 1e3
            at = np.arange(len(names)) + 0.15 * (2 * i - 1)
            axes.errorbar(at, numbers[:, 0], numbers[:, 1], fmt="o", ms=4, color=colour, label=label)
        axes.axhline(0, color=COLORS["text"], lw=0.8)
        axes.set(xticks=range(len(names)), ylabel="mean residual  (µm)")
        axes.set_xticklabels(names)
        axes.legend()
        grid(axes)
        picture.subplots_adjust(left=0.11, right=0.98, top=0.96, bottom=0.1)
    return picture
