"""The picture of resolution scans: a panel for each quantity, a curve for each detector, particle and method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from cgemit.draw.curves import draw_curves
from cgemit.draw.style import Picture, legend_entries, new_picture, plain, style
from cgemit.statistics.curves import SYMBOLS, Line

#: Quantities in the order of the panels, with the label of the axis.
PANELS = {
    "dr": f"σ({SYMBOLS['dr']})", "dz": f"σ({SYMBOLS['dz']})", "p": "σ(p)",
    "p_rel": "σ(p)/p", "pt_rel": "σ($p_T$)/$p_T$", "pt": "σ($p_T$)",
    "phi0": "σ(φ₀)", "theta": "σ(θ)", "tanl": "σ(tan λ)",
}  # fmt: skip


def resolutions(scans: Sequence[Any]) -> Picture:
    """Draw the core resolutions of scans against momentum.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
        Results of `cgemit.study.scan` and `cgemit.study.scan_analytic`: simulated ones are points, analytic ones lines.

    Returns
    -------
    Picture
        d_rho, d_z, p; relative p and pT, pT; phi0, theta, tan(lambda).
    """
    scans = [scans] if hasattr(scans, "all_lines") else list(scans)
    named = _named([scan.all_lines for scan in scans])
    transverse = scans[0].orders[0].gun.p is None
    with style():
        picture, axes = new_picture(3, 3, (13.2, 11.2))
        for plot, (name, label) in zip(axes, PANELS.items(), strict=True):
            curves = [line for lines in named for line in lines if line.id == f"sigma_{name}"]
            draw_curves(plot, curves, label, "$p_T$" if transverse else "p")
        entries = legend_entries(axes)
        if entries:
            picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=min(4, len(entries)))
        picture.suptitle(plain(about(scans)), x=0.06, ha="left", fontsize=11)
        picture.subplots_adjust(left=0.06, right=0.99, top=0.95, bottom=0.1, wspace=0.24, hspace=0.24)
    return picture


def about(scans: Sequence[Any]) -> str:
    """Return particles, angle, number of events, read-out and finder of some scans as text."""
    particles = ", ".join(dict.fromkeys(str(scan.orders[0].gun.particle) for scan in scans))
    parts = [f"{particles}, {scans[0].angle}"]
    events = dict.fromkeys(scan.orders[0].n_events for scan in scans if scan.method == "mc")
    parts += [f"{n:,} simulated events at each momentum" for n in events]
    readouts = ", ".join(dict.fromkeys(scan.readout for scan in scans if scan.readout))
    parts += [f"read-out {readouts}"] if readouts else []
    parts += [f"hits {hits}" for hits in dict.fromkeys(scan.hits for scan in scans if scan.hits)]
    return "core widths: " + ", ".join(parts)


def _named(groups: Sequence[Sequence[Line]]) -> list[list[Line]]:
    """Return the lines with what tells them apart as the detector: its name, the particle, or both."""
    lines = [line for group in groups for line in group]
    detectors, particles = ({getattr(line, name) for line in lines} for name in ("detector", "particle"))
    if len(particles) == 1:
        return [list(group) for group in groups]
    both = len(detectors) > 1
    return [
        [replace(line, detector=f"{line.detector}, {line.particle}" if both else line.particle) for line in group]
        for group in groups
    ]
