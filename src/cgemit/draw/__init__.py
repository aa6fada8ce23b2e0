"""Pictures; the only part of the package that knows matplotlib."""

from cgemit.draw.budget import draw_budget, draw_budgets, draw_sensitivity
from cgemit.draw.chain_diagram import draw_chain
from cgemit.draw.cluster import draw_cluster, draw_projection
from cgemit.draw.curves import residual
from cgemit.draw.detector import draw_detector, draw_sides
from cgemit.draw.display import event
from cgemit.draw.display3d import event_3d, save_page
from cgemit.draw.finding import draw_finding
from cgemit.draw.formation import FormationPanel, draw_formation
from cgemit.draw.matter import draw_slab
from cgemit.draw.readout import ViewCurves, draw_readout
from cgemit.draw.refit import draw_refit
from cgemit.draw.scans import resolutions
from cgemit.draw.style import Picture

draw_event = event  # its former name

__all__ = [
    "FormationPanel",
    "Picture",
    "ViewCurves",
    "draw_budget",
    "draw_budgets",
    "draw_chain",
    "draw_cluster",
    "draw_detector",
    "draw_event",
    "draw_finding",
    "draw_formation",
    "draw_projection",
    "draw_readout",
    "draw_refit",
    "draw_sensitivity",
    "draw_sides",
    "draw_slab",
    "event",
    "event_3d",
    "residual",
    "resolutions",
    "save_page",
]
