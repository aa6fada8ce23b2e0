"""Efficiency of track finding against true quantities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cgemit.draw.style import COLORS, Picture, grid, new_picture, plain, style

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
    """
    with style():
        across, rows = min(len(curves), 3), -(-len(curves) // 3)
        picture, axes = new_picture(rows, across, (3.9 * across, 3.4 * rows + 0.8))
        for one in axes[len(curves) :]:
            one.remove()
        least = min(
            (np.nanmin(columns["efficiency_low"]) for columns in curves.values() if np.any(columns["findable"])),
            default=0.0,
        )
        for one, (quantity, columns) in zip(axes, curves.items(), strict=False):
            filled = np.asarray(columns["findable"]) > 0
            low, high = (np.asarray(columns[name])[filled] for name in ("low", "high"))
            value, below, above = (
                100 * np.asarray(columns[name])[filled] for name in ("efficiency", "efficiency_low", "efficiency_high")
            )
            one.errorbar(
                0.5 * (low + high), value, xerr=0.5 * (high - low), yerr=[value - below, above - value],
                fmt="o", markersize=3.5, linewidth=1.0, color=COLORS["cgem"],
            )  # fmt: skip
            one.set_xlabel(_LABELS[quantity])
            one.set_ylim(
                max(0.0, 100 * least - 0.25 * (100 - 100 * least) - 0.2), 100 + 0.06 * (100 - 100 * least) + 0.1
            )
            grid(one)
        for one in axes[::across]:
            one.set_ylabel("efficiency  (%)")
        height = picture.get_figheight()
        picture.suptitle(plain(title), fontsize=10.5, y=1 - 0.08 / height)
        picture.text(0.5, 0.06 / height, plain("   ".join(lines)), ha="center", fontsize=9, color=COLORS["text"])
        picture.subplots_adjust(
            left=0.075, right=0.985, top=1 - 0.42 / height, bottom=0.92 / height, wspace=0.2, hspace=0.3
        )
    return picture
