"""Resolution of a read-out against the angle of incidence, or another quantity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit.draw.style import COLORS, Picture, grid, new_picture, plain, style

Floats = npt.NDArray[np.float64]

_LOOKS = {
    "centroid": ("charge centroid", COLORS["cgem"], "o"),
    "micro-tpc": ("micro-TPC", COLORS["idc"], "s"),
    "merged": ("merged", COLORS["truth"], "D"),
    "track": ("with the track's angle", COLORS["data"], "^"),
}


class ViewCurves(NamedTuple):
    """What is drawn of one view."""

    name: str  # X or V
    widths: Mapping[str, tuple[Floats, Floats]]  # by estimator: core widths and their errors, (n,) um
    size: Floats  # (n,), mean number of strips
    efficiency: Floats  # (n,)


def draw_readout(values: Floats, label: str, views: Sequence[ViewCurves], title: str) -> Picture:
    """Draw core widths of the estimators, number of strips and efficiency, one column a view.

    Parameters
    ----------
    values : (n,) float64
    label : str
        Of the quantity on the horizontal axes, with its unit.
    views : sequence of ViewCurves
    title : str
    """
    with style():
        picture, flat = new_picture(3, len(views), (8.4, 7.0), sharex=True, height_ratios=(3, 1, 1))
        rows = [flat[k * len(views) : (k + 1) * len(views)] for k in range(3)]
        for column, view in enumerate(views):
            top, middle, bottom = (row[column] for row in rows)
            for name, (width, error) in view.widths.items():
                text, colour, marker = _LOOKS[name]
                top.errorbar(values, width, error, label=text, color=colour, marker=marker, ms=4, lw=1.2, capsize=2)
            top.set_ylabel(f"core width of the {view.name} residual  (µm)")
            top.set_ylim(0, 1.1 * float(np.nanmax(view.widths["centroid"][0])))  # line fits may be far worse
            middle.plot(values, view.size, color=COLORS["data"], marker="o", ms=4, lw=1.2)
            middle.set_ylim(0, 1.15 * float(view.size.max()))
            middle.set_ylabel(f"{view.name} strips")
            bottom.plot(values, 100 * view.efficiency, color=COLORS["data"], marker="o", ms=4, lw=1.2)
            bottom.set_ylim(min(95.0, 100 * float(view.efficiency.min()) - 1), 100.5)
            bottom.set_ylabel("efficiency  (%)")
            bottom.set_xlabel(label)
            for axes in (top, middle, bottom):
                grid(axes)
                axes.locator_params(axis="x", nbins=5)
        handles, labels = rows[0][0].get_legend_handles_labels()
        picture.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, 0.955), ncols=len(labels), fontsize=9)
        picture.suptitle(plain(title), fontsize=10)
        picture.tight_layout(rect=(0, 0, 1, 0.95))
    return picture
