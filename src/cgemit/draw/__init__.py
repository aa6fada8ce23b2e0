"""Pictures; the only part of the package that knows matplotlib."""

from cgemit.draw.budget import draw_budget, draw_sensitivity
from cgemit.draw.chain_diagram import draw_chain
from cgemit.draw.cluster import draw_cluster, draw_projection
from cgemit.draw.curves import residual
from cgemit.draw.detector import draw_detector, draw_sides
from cgemit.draw.event import draw_event
from cgemit.draw.matter import draw_slab
from cgemit.draw.readout import draw_readout
from cgemit.draw.style import Picture

__all__ = [
    "Picture",
    "draw_budget",
    "draw_chain",
    "draw_cluster",
    "draw_detector",
    "draw_event",
    "draw_projection",
    "draw_readout",
    "draw_sensitivity",
    "draw_sides",
    "draw_slab",
    "residual",
]
