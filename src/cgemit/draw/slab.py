"""Distributions of scattering angle and energy loss behind layers of matter."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from cgemit.base.arrays import Floats
from cgemit.draw.style import COLORS, Picture, grid, new_picture, plain, statistics_box, style

if TYPE_CHECKING:
    from cgemit.simulation.slab import SlabResult


def draw_slab(result: SlabResult) -> Picture:
    """Draw the plane angle with Highland's Gaussian and the fit's core, and the energy loss with its quantiles.

    Parameters
    ----------
    result : SlabResult
        As `cgemit.slab` returns it.

    Returns
    -------
    Picture

    Examples
    --------
    >>> picture = cg.draw.draw_slab(cg.slab("Kapton 300 um", "pi-", p=0.5, n=2000))
    >>> [axes.get_xlabel() for axes in picture.axes]
    ['plane angle  (mrad)', 'energy loss  (keV)']
    """
    with style():
        picture, (angles, losses) = new_picture(1, 2, (11.4, 4.8))
        draw_angles(angles, result)
        draw_losses(losses, result)
        picture.suptitle(plain(result.title()), fontsize=10, x=0.06, ha="left")
        picture.subplots_adjust(left=0.065, right=0.99, top=0.86, bottom=0.12, wspace=0.18)
    return picture


def draw_angles(axes: Axes, result: SlabResult) -> None:
    """Draw the density of the plane angles of both planes, logarithmically, beside Gaussians of both formulas."""
    angles = 1e3 * np.concatenate([result.angle_1[result.through], result.angle_2[result.through]])
    if not angles.size:
        axes.set(xticks=[], yticks=[], xlabel="plane angle  (mrad)")
        axes.text(0.5, 0.5, "no particle came through", transform=axes.transAxes, ha="center", color=COLORS["text"])
        return
    scale = result.q68_mrad or 1.0
    reach = min(8 * scale, 1e3 * math.pi / 2)
    edges = np.linspace(-reach, reach, 161)
    _density(axes, angles, edges, "simulated")
    x = np.linspace(-reach, reach, 801)
    highland = (result.highland_mrad, COLORS["single"], "--", "Highland")
    core = (result.core_mrad, COLORS["fit"], "-", "core, as the fit takes it")
    for sigma, colour, dashes, label in (highland, core):
        if not sigma:
            continue
        y = np.exp(-0.5 * (x / sigma) ** 2) / (math.sqrt(2 * math.pi) * sigma)
        axes.plot(x, y, dashes, color=colour, lw=1.5, label=f"{label}: {sigma:.4g} mrad")
    top = 1 / (math.sqrt(2 * math.pi) * scale)
    axes.set(xlabel="plane angle  (mrad)", ylabel="density  (1/mrad)", yscale="log", xlim=(-reach, reach))
    axes.set_ylim(max(0.3 / angles.size / (edges[1] - edges[0]), 1e-6 * top), 30 * top)
    axes.legend(loc="upper left")
    numbers = [_number(result, name, "mrad", name.removesuffix("_mrad")) for name in _ANGLES]
    statistics_box(axes, [f"{angles.size:,} angles", *numbers])
    grid(axes)


def draw_losses(axes: Axes, result: SlabResult) -> None:
    """Draw the density of the energy loss and its quantiles."""
    loss = result.loss[result.measured]
    low, high = result.loss_kev_q01, result.loss_kev_q84
    reach = high + 2 * max(high - low, 0.01 * high, 1e-9)
    edges = np.linspace(max(0.0, low - 0.3 * (high - low)), reach, 161)
    _density(axes, loss, edges, f"simulated ({np.mean(loss > reach):.2%} beyond)")
    for name, colour in (("q16", COLORS["multi"]), ("q50", COLORS["fit"]), ("q84", COLORS["multi"])):
        value = getattr(result, f"loss_kev_{name}")
        axes.axvline(value, color=colour, lw=1.2, ls="--", label=f"{_LOSSES[f'loss_kev_{name}']}: {value:.4g} keV")
    axes.set(xlabel="energy loss  (keV)", ylabel="density  (1/keV)", xlim=(edges[0], reach))
    axes.set_ylim(0, 1.1 * axes.get_ylim()[1])
    axes.legend(loc="upper right", bbox_to_anchor=(1, 0.56))
    numbers = [_number(result, name, "keV", label) for name, label in _LOSSES.items()]
    statistics_box(axes, [f"{len(loss):,} losses", *numbers])
    grid(axes)


_ANGLES = ("q68_mrad", "q98_mrad", "q999_mrad")
_LOSSES = {
    "loss_kev_mean": "mean",
    "loss_kev_mode": "most probable",
    "loss_kev_q01": "1 %",
    "loss_kev_q16": "16 %",
    "loss_kev_q50": "median",
    "loss_kev_q84": "84 %",
    "loss_kev_q99": "99 %",
}


def _density(axes: Axes, sample: Floats, edges: Floats, label: str) -> None:
    counts = np.histogram(sample, edges)[0]
    scale = 1 / (max(sample.size, 1) * (edges[1] - edges[0]))
    centres = 0.5 * (edges[1:] + edges[:-1])
    seen = counts > 0
    axes.errorbar(
        centres[seen], scale * counts[seen], scale * np.sqrt(counts[seen]), fmt="o", ms=2.4, lw=0.8,
        color=COLORS["data"], label=label, zorder=3,
    )  # fmt: skip


def _number(result: SlabResult, name: str, unit: str, label: str) -> str:
    value, error = result.number(name)
    return f"{label}: {value} ± {error} {unit}"
