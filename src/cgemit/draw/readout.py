"""Resolution of a read-out against the angle of incidence."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from cgemit.draw.style import COLORS, Picture, grid, new_picture, plain, style

Floats = npt.NDArray[np.float64]

_LOOKS = {
    "centroid": ("charge centroid", COLORS["cgem"], "o"),
    "micro-tpc": ("micro-TPC", COLORS["idc"], "s"),
    "merged": ("merged", COLORS["truth"], "D"),
}


def draw_readout(angle: Floats, curves: Mapping[str, tuple[Floats, Floats]], size: Floats, title: str) -> Picture:
    """Draw core widths of the estimators against the angle, and the number of strips.

    Parameters
    ----------
    angle : (n,) float64, deg
    curves : mapping of str to (ndarray, ndarray)
        Widths and errors, each (n,) float64 um, by estimator.
    size : (n,) float64
        Mean number of strips.
    title : str
    """
    with style():
        picture, (top, bottom) = new_picture(2, 1, (6.0, 6.2), sharex=True, height_ratios=(3, 1))
        for name, (width, error) in curves.items():
            label, colour, marker = _LOOKS[name]
            top.errorbar(angle, width, error, label=label, color=colour, marker=marker, ms=4.5, lw=1.2, capsize=2)
        top.set_ylabel("core width of the X residual [µm]")
        widest = curves["centroid"][0]  # line fits at normal incidence may be far worse
        top.set_ylim(0, 1.1 * float(np.nanmax(widest)))
        top.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
        picture.suptitle(plain(title), fontsize=10)
        bottom.plot(angle, size, color=COLORS["data"], marker="o", ms=4.5, lw=1.2)
        bottom.set_ylim(0, 1.15 * float(size.max()))
        bottom.set_ylabel("X strips")
        bottom.set_xlabel("angle of incidence [deg]")
        for axes in (top, bottom):
            grid(axes)
        picture.tight_layout()
    return picture
