"""Our fit beside the experiment's: differences of parameters, chi-square, errors."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from cgemit.draw.style import COLORS, Picture, grid, mathematical, new_picture, plain, style
from cgemit.refit import FITS, Refit
from cgemit.statistics.curves import SYMBOLS
from cgemit.tables.track_schemas import PARAMETERS

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
            plot.set_xlabel(f"{mathematical(SYMBOLS[name])}: (ours − BOSS) / error of BOSS")
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
    plot.set_xticks(range(len(names)), [mathematical(SYMBOLS[name]) for name in names])
    plot.set(
        ylabel="median of our error / error of BOSS", xlim=(-0.6, len(names) - 0.4), ylim=(0, 1.15 * max(1.0, *ratios))
    )
    grid(plot)
