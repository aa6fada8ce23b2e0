"""The paper's numbers, and titles and captions of its figures."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Literal

Group = Literal["paper", "beyond", "display"]


@dataclass(frozen=True)
class PaperValue:
    """A quantity of the paper.

    Attributes
    ----------
    title, unit : str
    statistic : str
        How the paper got its number, or that it gives none.
    value : float or None
        As published.
    """

    title: str
    unit: str
    statistic: str
    value: float | None = None


@cache
def paper_values() -> Mapping[str, PaperValue]:
    """Return the quantities of arXiv:1504.02570 by result id (`paper_values.toml`)."""
    text = resources.files("cgemit.study.paper").joinpath("paper_values.toml").read_text(encoding="utf-8")
    return {name: PaperValue(**entry) for name, entry in tomllib.loads(text).items()}


@dataclass(frozen=True)
class PaperFigure:
    """One figure.

    Attributes
    ----------
    name : str
        File name without ending.
    group : "paper", "beyond" or "display"
        A figure of the paper, one that tells whether the errors are right, or the event that is drawn.
    title, caption : str
    tables : tuple of str
        Patterns of the files with the figure's data.
    """

    name: str
    group: Group
    title: str
    caption: str
    tables: tuple[str, ...] = ()


FIGURES: Mapping[str, PaperFigure] = {
    "layer": PaperFigure(
        "figure1_layer",
        "paper",
        "Figure 1: one CGEM layer",
        "Drift gap, foils and anode of the innermost layer, across and along the beam, with a simulated track. Entry "
        "and exit of the drift gap are projected to the anode at unchanged φ and z; the strips in between fire. No "
        "Lorentz angle and no diffusion, as for all published numbers. Foils are drawn thicker than they are.",
    ),
    "chain": PaperFigure(
        "figure2_chain",
        "paper",
        "Figure 2: the chain",
        "Stages (rounded) and the tables in which they meet (square).",
    ),
    "cluster": PaperFigure(
        "figure3_cluster",
        "paper",
        "Figure 3: an XV cluster",
        "The same crossing on the unrolled anode: fired X and V strips, the projected crossing (entry: circle, exit: "
        "square), the true position at mid-gap and the reconstructed one.",
    ),
    "x_residual": PaperFigure(
        "figure4_x_residual",
        "paper",
        "Figure 4, X clusters",
        "Residual in X with its parts of one strip (a rectangle) and several strips; mu- of 1 GeV/c in "
        "besiii-cgem-design, all three layers.",
        ("figure4_x_residual.csv",),
    ),
    "x_tails": PaperFigure(
        "figure4_x_tails",
        "paper",
        "Figure 4, tails of X clusters",
        "The same on a logarithmic scale with the tails that delta electrons make, which the field turns to one side, "
        "and the windows in which the RMS was taken.",
        ("figure4_x_tails.csv",),
    ),
    "v_residual": PaperFigure(
        "figure4_v_residual",
        "paper",
        "Figure 4, V clusters",
        "Residual in V with an unbinned likelihood fit of a Gaussian to the entries within one pitch.",
        ("figure4_v_residual.csv",),
    ),
    "dr_dz": PaperFigure(
        "figure5_d_rho_d_z",
        "paper",
        "Figure 5: d_ρ and d_z at 1 GeV/c",
        "Fitted minus true values at the closest approach to the beam line. The line is the Gaussian core, fitted by "
        "likelihood within three of its own widths; the RMS is that of the shown range, five core widths to each side. "
        "The Gaussian lies below the peak because angles are mixed: tracks at cos θ = 0 are measured better than steep "
        "ones, and a sum of narrow and wide Gaussians is more peaked than a single one.",
        ("figure5_d_rho_d_z_*.csv",),
    ),
    "dr_dz_p": PaperFigure(
        "figure6_d_rho_d_z_vs_p",
        "paper",
        "Figure 6: σ(d_ρ) and σ(d_z) against momentum",
        "Core widths; cos θ is uniform in ±0.93 at each momentum. The star is the paper's number at 1 GeV/c.",
        ("figure6_d_rho_d_z_vs_p.csv",),
    ),
    "p": PaperFigure(
        "figure7_p",
        "paper",
        "Figure 7: momentum residual at 1 GeV/c",
        "Fitted minus true momentum; lines and numbers as in figure 5.",
        ("figure7_p_*.csv",),
    ),
    "p_p": PaperFigure(
        "figure8_p_vs_p",
        "paper",
        "Figure 8: σ(p) against momentum",
        "Core widths; as in figure 6.",
        ("figure8_p_vs_p.csv",),
    ),
    "pulls": PaperFigure(
        "pulls",
        "beyond",
        "Pulls at 1 GeV/c",
        "Residual divided by the fit's own error for the five helix parameters and p, with width and mean of the core; "
        "dashed: the unit Gaussian that right errors give.",
        ("pulls.csv",),
    ),
    "pulls_p": PaperFigure(
        "pulls_vs_p",
        "beyond",
        "Pulls against momentum",
        "Core widths of the pulls; 1 if the errors are right.",
        ("pulls_vs_p.csv",),
    ),
    "cos_theta": PaperFigure(
        "resolution_vs_cos_theta",
        "beyond",
        "Resolutions and pulls against cos θ at 1 GeV/c",
        "Core widths of the residuals (top) and of the pulls (bottom).",
        ("resolution_vs_cos_theta.csv",),
    ),
    "chi2": PaperFigure(
        "chi2_probability",
        "beyond",
        "χ² probability at 1 GeV/c",
        "Flat if the errors are right. The fit chooses the side of every wire, and choosing the smaller χ² lifts the "
        "probability a little; with the sides given (DigitizeSettings(reveal_sides=True)) it is flat.",
        ("chi2_probability.csv",),
    ),
    "event": PaperFigure(
        "event",
        "display",
        "The event of figures 1 and 3",
        "True crossings, clusters, drift circles, the fitted track through its smoothed states, and the fired strips "
        "on the unrolled anodes. Ghosts are X and V clusters of different crossings; other clusters beside the track "
        "are those of delta electrons.",
    ),
}
