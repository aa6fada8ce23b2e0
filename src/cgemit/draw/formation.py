"""How the charge of one track reaches the strips."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.collections import LineCollection

from cgemit.draw.style import COLORS, Picture, new_picture, style

Floats = npt.NDArray[np.float64]

_COPPER = "#B87333"
_DEPTH = 3.0  # mm of the picture for the largest charge
_MARGIN = 2.0  # mm on either side


class FormationPanel(NamedTuple):
    """One track with one set of switches; lengths in mm, X from the crossing of mid-gap, depth from the cathode."""

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
