"""docs/methods/cluster.md: errors of binary clusters by layer and number of strips."""

from __future__ import annotations

import cgemit as cg
from cgemit.reconstruction.clusterers.binary import cluster_errors
from pages.page import Found, Page, table


def blocks(found: Found) -> dict[str, str]:
    """Return the table of the design, in um."""
    design = cg.load("besiii-cgem-design")
    lines = []
    for layer, x, v in zip(design.cgem, *cluster_errors(design, cg.ClusterSettings()), strict=True):
        x, v = 1e3 * x, 1e3 * v[:9]
        wide = ", ".join(f"{error:.0f}" for error in x[2:5])
        lines.append([layer.label, f"{x[0]:.1f}", f"{x[1]:.1f}", wide, f"{v.min():.1f} to {v.max():.1f}"])
    return {"errors": table(["", "1 X strip", "2 X strips", "3, 4, 5 X strips", "V, 1 to 9 strips"], lines)}


PAGE = Page("cluster", "docs/methods/cluster.md", "no time", blocks=blocks)
