"""docs/methods/digitize.md: crossings of a thin gap that free no electron."""

from __future__ import annotations

import cgemit as cg
from cgemit.detector.gas import most_lost
from pages.page import Found, Page

GAPS = (0.1, 0.3, 1.0)  # mm


def blocks(found: Found) -> dict[str, str]:
    """Return the shares of crossings."""
    design = cg.load("besiii-cgem-design")
    layers = [design.with_overrides({"cgem.*.drift_gap": f"{gap} mm"}).cgem[0] for gap in GAPS]
    return {
        "lost": ", ".join(
            f"{100 * most_lost(layer):.0f} % at {gap:g} mm" for gap, layer in zip(GAPS, layers, strict=True)
        )
    }


PAGE = Page("digitize", "docs/methods/digitize.md", "no time", blocks=blocks)
