"""Why a resolution is what it is: the error budget against momentum, and the sensitivities to the design."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import numpy.typing as npt

from cgemit.covariance.budget import Budget, By
from cgemit.covariance.derivatives import Sensitivity
from cgemit.draw.style import COLORS, Picture, grid, mathematical, new_picture, plain, style

Floats = npt.NDArray[np.float64]

_SYMBOLS = {
    "dr": "d_ρ", "dz": "d_z", "pt": "$p_T$", "phi0": "φ₀", "theta": "θ", "tanl": "tan λ", "p": "p", "kappa": "κ",
}  # fmt: skip
_COLOURS = (COLORS["cgem"], COLORS["idc"], COLORS["truth"])
_OTHER = "other"


def draw_budget(budget: Budget, by: By = "part", *, most: int = 8) -> Picture:
    """Draw the share of each group in the variance as stacked areas against momentum.

    Parameters
    ----------
    budget : Budget
        At two momenta or more, in any order, and one cos(theta).
    by : str
        As for `Budget.grouped`.
    most : int
        Groups that are drawn: those with the largest mean share, the largest at the bottom. The rest is one group,
        ``other``.

    Returns
    -------
    Picture
        Momenta without a covariance are gaps.

    Raises
    ------
    ValueError
        If `by` is not known, or the points are not a line of momenta.
    """
    if budget.p.ndim != 1 or len(np.unique(budget.p)) < 2 or np.ptp(budget.cos_theta) > 1e-12 or most < 1:
        raise ValueError(
            f"draw_budget: got momenta of shape {budget.p.shape}, cos(theta) {np.unique(budget.cos_theta)[:4]}, most "
            f"{most}; expected a list of two momenta or more at one cos(theta), and most of at least 1"
        )
    order = np.argsort(budget.p, kind="stable")
    p = budget.p[order]
    shares = _shares(budget, by, most)
    edges = np.cumsum([np.zeros(len(p)), *(share[order] for share in shares.values())], axis=0)
    colours = mpl.colormaps["tab20"](np.arange(20) % 20)[[0, 2, 4, 6, 8, 10, 12, 16, 18, 1, 3, 5, 7, 9, 11, 13, 17, 19]]
    with style():
        width = 6.2 + 0.085 * max(map(len, shares))  # room for the legend
        picture, (axes,) = new_picture(1, 1, (width, 4.6))
        for number, name in enumerate(shares):
            colour = COLORS["matter"] if name == _OTHER else colours[number % len(colours)]
            low, high = edges[number], edges[number + 1]
            axes.fill_between(p, low, high, color=colour, lw=0, alpha=0.85, label=plain(name))
            axes.plot(p, high, color="white", lw=0.6)
        axes.set(xlim=(p[0], p[-1]), ylim=(0, 100), xlabel="p  (GeV/c)")
        axes.set_ylabel(f"share of the variance of {mathematical(_SYMBOLS[budget.quantity])}  (%)")
        axes.set_title(plain(f"{budget.detector}, {budget.particle}, cos θ = {budget.cos_theta[0]:.3g}"), loc="left")
        handles, labels = axes.get_legend_handles_labels()
        # From top to bottom, as the areas lie.
        axes.legend(handles[::-1], labels[::-1], loc="center left", bbox_to_anchor=(1.01, 0.5), title=by)
        picture.subplots_adjust(left=0.7 / width, right=5.6 / width, top=0.92, bottom=0.12)
    return picture


def _shares(budget: Budget, by: By, most: int) -> dict[str, Floats]:
    """Return the shares in %, the largest group first; more groups than `most` are added up."""
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = {name: 100 * value / budget.total for name, value in budget.grouped(by).items()}
    means = {name: float(np.nanmean(share)) if np.isfinite(share).any() else 0.0 for name, share in shares.items()}
    names = sorted(shares, key=lambda name: -means[name])
    if len(names) <= most:
        return {name: shares[name] for name in names}
    rest = np.sum([shares[name] for name in names[most:]], axis=0)
    return {name: shares[name] for name in names[:most]} | {_OTHER: rest}


def draw_sensitivity(sensitivity: Sensitivity, *, point: int = 0, most: int = 15) -> Picture:
    """Draw what 1 % more of each number of the design does to the resolutions, as horizontal bars.

    Parameters
    ----------
    sensitivity : Sensitivity
    point : int
        Which of its points, counted through the flattened array.
    most : int
        Numbers of the design that are drawn: those with the largest effect on any of the quantities, the largest on
        top. Those that cannot be changed are left out.

    Returns
    -------
    Picture

    Raises
    ------
    ValueError
        If there is no such point, or nothing to draw.
    """
    points = sensitivity.p.size
    if not 0 <= point < points or most < 1:
        raise ValueError(
            f"draw_sensitivity: got point {point}, most {most}; "
            f"expected a point from 0 to {points - 1}, and most of at least 1"
        )
    values = sensitivity.values.reshape(len(sensitivity.keys), len(sensitivity.quantities), points)[..., point]
    known = np.flatnonzero(np.isfinite(values).any(axis=1))
    if not len(known):
        raise ValueError("draw_sensitivity: got no derivative; expected at least one number that can be changed")
    size = np.nanmax(np.abs(values[known]), axis=1)
    rows = known[np.argsort(-size, kind="stable")][:most]
    count = len(sensitivity.quantities)
    height = 0.8 / count
    with style():
        picture, (axes,) = new_picture(1, 1, (7.4, 1.3 + max(1.2, (0.16 + 0.13 * count) * len(rows))))
        for number, name in enumerate(sensitivity.quantities):
            place = np.arange(len(rows)) + (number - 0.5 * (count - 1)) * height
            label = f"σ({mathematical(_SYMBOLS[name])})"
            colour, hatch = _COLOURS[number % len(_COLOURS)], "//" * (number // len(_COLOURS))
            axes.barh(place, values[rows, number], height, color=colour, hatch=hatch, edgecolor="white", lw=0.3,
                      label=label)  # fmt: skip
        axes.axvline(0, color=COLORS["data"], lw=0.8)
        axes.set_yticks(np.arange(len(rows)), [plain(sensitivity.keys[row]) for row in rows])
        axes.set(ylim=(len(rows) - 0.4, -0.6), xlabel="change of the resolution for 1 % more  (%)")
        p, cosine = float(sensitivity.p.ravel()[point]), float(sensitivity.cos_theta.ravel()[point])
        title = f"{sensitivity.detector}, {sensitivity.particle}, p = {p:.4g} GeV/c, cos θ = {cosine:.3g}"
        axes.set_title(plain(title), loc="left", x=-0.45)
        axes.tick_params(axis="y", length=0)
        axes.legend(loc="lower right")  # the shortest bars are below
        grid(axes)
        tall = picture.get_size_inches()[1]
        picture.subplots_adjust(left=0.33, right=0.97, top=1 - 0.35 / tall, bottom=0.55 / tall)
    return picture
