"""Pictures of the documentation that show no measured numbers: conventions, gallery."""

from __future__ import annotations

import runpy
import tempfile
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import cgemit as cg
from cgemit import helix
from cgemit.draw.event import helix_points
from cgemit.particles.table import particles_from
from pages.page import ROOT, Found, Page
from pages.readme import example, run_example

MUON = {1: -13, -1: 13}  # PDG number by charge
TRACK, AXIS, MARK, FAINT, LENGTH = "#0072B2", "#555555", "#CC3311", "#9AA3AD", "#009E73"


def helices(found: Found) -> Figure:
    """Draw a track past the origin for both charges in both fields, with what the parameters mean."""
    figure, axes = plt.subplots(2, 2, figsize=(10.2, 10.2), dpi=85)
    for plot, (charge, bz) in zip(axes.flat, [(-1, -1.0), (1, -1.0), (-1, 1.0), (1, 1.0)], strict=True):
        draw_helix(plot, charge, bz)
    figure.tight_layout()
    return figure


def draw_helix(plot: Axes, charge: int, bz: float) -> None:
    """Draw one case: pT = 60 MeV/c, for positive charges on the other side of the origin."""
    psi, pt = 1.3, 0.06
    start = {"event": [0], "pdg": [MUON[charge]], "x": [-110.0 * charge], "y": [0.0], "z": [0.0]}
    start |= {"px": [pt * np.cos(psi)], "py": [pt * np.sin(psi)], "pz": [0.0]}
    parameters = helix.at_origin(particles_from(start), bz)[0]
    dr, phi0, kappa = parameters[:3]
    radius = helix.RADIUS_PER_KAPPA / (bz * kappa)
    out, flight = np.array([np.cos(phi0), np.sin(phi0)]), np.array([-np.sin(phi0), np.cos(phi0)])
    perigee, centre = dr * out, (dr + radius) * out
    turn = np.linspace(0, 2 * np.pi, 400)
    plot.plot(centre[0] + radius * np.cos(turn), centre[1] + radius * np.sin(turn), ":", color=FAINT, lw=1)
    x, y, _ = helix_points(parameters, bz, r_max=330.0, z_max=1e3)
    plot.plot(x, y, color=TRACK, lw=2.4)
    plot.plot(*zip((0, 0), centre, strict=True), "--", color=FAINT, lw=1)
    arrow(plot, (0, 0), 175 * out, AXIS)
    note(plot, 215 * out + 36 * flight, "azimuth $\\phi_0$", AXIS)
    arrow(plot, perigee, perigee + 120 * flight, MARK)
    note(plot, perigee + 165 * flight - 80 * np.sign(radius) * out, "flight,\nazimuth $\\phi_0+\\pi/2$", MARK)
    plot.plot([0, perigee[0]], [0, perigee[1]], color=LENGTH, lw=3, solid_capstyle="butt")
    note(plot, 0.5 * perigee - 34 * flight, "$d_\\rho$", LENGTH)
    note(plot, centre - 32 * flight, "centre", AXIS)
    note(plot, -30 * flight - 12 * np.sign(dr) * out, "origin", "black")
    plot.plot(*centre, "+", color=AXIS, ms=10)
    plot.plot(*perigee, "o", color=MARK, ms=6, zorder=5)
    plot.plot(0, 0, "o", color="black", ms=6, zorder=5)
    plot.set_title(
        f"charge {charge:+d},  $B_z$ = {bz:+.0f} T\n"
        f"$d_\\rho$ = {dr:+.0f} mm,  $\\kappa$ = {kappa:+.1f} c/GeV,  R = {radius:+.0f} mm", fontsize=10.5,
    )  # fmt: skip
    plot.set(xlim=(-350, 350), ylim=(-330, 330), aspect="equal", xlabel="x (mm)", ylabel="y (mm)")


def arrow(plot: Axes, tail: Sequence[float], tip: Sequence[float], color: str) -> None:
    """Draw an arrow."""
    shape = {"arrowstyle": "-|>", "color": color, "lw": 1.9, "shrinkA": 0, "shrinkB": 0}
    plot.annotate("", tip, tail, arrowprops=shape, zorder=4)


def note(plot: Axes, at: Sequence[float], text: str, color: str) -> None:
    """Write centred on a point."""
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.6}
    plot.text(*at, text, ha="center", va="center", color=color, fontsize=9.5, bbox=box, zorder=6)


def strips(found: Found) -> Figure:
    """Draw two unrolled sheets with stereo angles of either sign: lines of constant X and V."""
    layers = cg.load("besiii-cgem-design").cgem[:2]
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 5.2), dpi=90)
    for plot, layer in zip(axes, layers, strict=True):
        width, half = layer.strips_x * layer.pitch_x, layer.half_length
        z_ref = half if layer.stereo > 0 else -half
        x, z = np.meshgrid(np.linspace(0, width, 300), np.linspace(-half, half, 300))
        v = x * np.cos(layer.stereo) + (z_ref - z) * np.sin(layer.stereo)
        plot.vlines(np.arange(0, width, 50 * layer.pitch_x), -half, half, color=TRACK, lw=0.7)
        plot.contour(x, z, v, levels=np.arange(0, v.max(), 50 * layer.pitch_v)[1:], colors=MARK, linewidths=0.9)
        plot.plot([0, width, width, 0, 0], [-half, -half, half, half, -half], color="black", lw=1.2)
        plot.plot(0, z_ref, "o", color=MARK, ms=7, clip_on=False, zorder=5)
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1}
        place = (12, -16 if z_ref > 0 else 10)
        plot.annotate("X = V = 0 at $z_{ref}$", (0, z_ref), place, textcoords="offset points", fontsize=9, bbox=box)
        plot.set(xlabel="X = $r_{readout}$ ($\\phi - \\phi_{first}$) (mm)", ylabel="z (mm)", aspect="equal")
        plot.set_title(
            f"{layer.label}, one sheet: $\\alpha$ = {np.degrees(layer.stereo):+.2f} deg", fontsize=10, loc="left"
        )
    figure.suptitle("edge of every 50th X strip (blue) and V strip (red)", fontsize=10, y=0.99)
    figure.tight_layout()
    return figure


def residual(found: Found) -> Figure:
    """Run the example of README.md as printed, and return the picture that it draws."""
    with tempfile.TemporaryDirectory() as folder:
        _, names = run_example(example(), Path(folder))
    return cg.draw.residual(names["result"], "p")


def masses(found: Found) -> Figure:
    """Return the K_S peak of the notebook on track finding."""
    made = runpy.run_path(str(ROOT / "notebooks" / "08_finding.py"))
    figure: Figure = made["spectrum"](made["mass"], made["peak"])
    figure.set_dpi(85)
    return figure


CONVENTIONS = Page("conventions", "docs/conventions.md", "5 s", pictures={"helix.png": helices, "strips.png": strips})
GALLERY = Page(
    "gallery", "docs/gallery.md", "1 min",
    pictures={"momentum.png": residual, "kshort-mass.png": masses},
)  # fmt: skip
