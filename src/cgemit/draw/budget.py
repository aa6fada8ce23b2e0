"""Why a resolution is what it is: the error budget against momentum, and the sensitivities to the design."""

from __future__ import annotations

from collections.abc import Mapping

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
_AREAS = mpl.colormaps["tab20"](np.arange(20))[[0, 2, 4, 6, 8, 10, 12, 16, 18, 1, 3, 5, 7, 9, 11, 13, 17, 19]]


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
    with style():
        width = 6.2 + 0.085 * max(map(len, shares))  # room for the legend
        picture, (axes,) = new_picture(1, 1, (width, 4.6))
        for number, name in enumerate(shares):
            colour = COLORS["matter"] if name == _OTHER else _AREAS[number % len(_AREAS)]
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


def draw_budgets(budgets: Mapping[str, Budget], by: By = "part", *, most: int = 8, scale: float = 1.0) -> Picture:
    """Draw what the variance of each variant of a detector is made of, as stacked bars.

    Parameters
    ----------
    budgets : mapping of str to Budget
        By the name of the variant, from top to bottom; of the same quantity at one point.
    by : str
        As for `Budget.grouped`.
    most : int
        Groups that are drawn: those with the largest variance in any variant. The rest is one group, ``other``.
    scale : float
        1 for variances in the unit of the budgets; 1000 for those of lengths in µm, of momenta in MeV/c.

    Returns
    -------
    Picture
        The length of a bar is the variance; the number beside it is its root.

    Raises
    ------
    ValueError
        If there is no budget, or one of several points.
    """
    if not budgets or most < 1 or any(one.p.size != 1 for one in budgets.values()):
        sizes = [one.p.size for one in budgets.values()]
        raise ValueError(f"draw_budgets: got {sizes} points, most {most}; expected budgets of one point, and most > 0")
    first = next(iter(budgets.values()))
    pieces = _pieces(budgets, by, most)
    unit = {"mm": "µm", "GeV/c": "MeV/c", "rad": "mrad"}.get(first.unit, first.unit) if scale == 1000 else first.unit
    names = [plain(name).replace("+", "\n+") for name in budgets]
    with style():
        tall = 1.5 + sum(0.2 + 0.17 * (1 + name.count("\n")) for name in names)
        before = 0.3 + 0.075 * max(len(line) for name in names for line in name.split("\n"))  # inches for the names
        width = before + 7.2
        picture, (axes,) = new_picture(1, 1, (width, tall))
        left = np.zeros(len(budgets))
        for number, (key, piece) in enumerate(pieces.items()):
            colour = COLORS["matter"] if key == _OTHER else _AREAS[number % len(_AREAS)]
            axes.barh(np.arange(len(names)), scale**2 * piece, 0.72, left, color=colour, edgecolor="white", lw=0.5,
                      label=plain(key))  # fmt: skip
            left = left + scale**2 * piece
        for row, total in enumerate(left):
            axes.text(total * 1.01, row, f"RMS {total**0.5:.4g} {unit}", va="center", fontsize=8.4)
        axes.set_yticks(np.arange(len(names)), names)
        axes.set(ylim=(len(names) - 0.4, -0.6), xlim=(0, 1.22 * left.max()))
        axes.set_xlabel(f"variance of {mathematical(_SYMBOLS[first.quantity])}" + (f"  ({unit}²)" if unit else ""))
        p, cosine = float(first.p.ravel()[0]), float(first.cos_theta.ravel()[0])
        axes.set_title(
            plain(f"{first.detector}, {first.particle}, p = {p:.4g} GeV/c, cos θ = {cosine:.3g}"), loc="left"
        )
        axes.tick_params(axis="y", length=0)
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), title=by)
        right = 1 - 1.4 / width
        picture.subplots_adjust(left=before / width, right=right, top=1 - 0.35 / tall, bottom=0.55 / tall)
    return picture


def _pieces(budgets: Mapping[str, Budget], by: By, most: int) -> dict[str, Floats]:
    """Return the variances of each group, (variants,), the largest first; more groups than `most` are added up."""
    every = [{key: float(value.ravel()[0]) for key, value in one.grouped(by).items()} for one in budgets.values()]
    keys = dict.fromkeys(key for groups in every for key in groups)
    found = {key: np.array([groups.get(key, 0.0) for groups in every]) for key in keys}
    names = sorted(found, key=lambda key: -float(found[key].max()))
    if len(names) <= most:
        return {name: found[name] for name in names}
    rest = np.sum([found[name] for name in names[most:]], axis=0)
    return {name: found[name] for name in names[:most]} | {_OTHER: rest}


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
