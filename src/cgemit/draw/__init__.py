"""Pictures; the only part of the package that knows matplotlib."""

from cgemit.draw.alignment import draw_constants, draw_modes, draw_residual_means
from cgemit.draw.chain_diagram import draw_chain
from cgemit.draw.cluster import FormationPanel, draw_cluster, draw_formation, draw_projection
from cgemit.draw.curves import ViewCurves, draw_finding, draw_readout, draw_refit, residual, resolutions
from cgemit.draw.design import draw_budget, draw_budgets, draw_maps, draw_sensitivity
from cgemit.draw.detector import draw_detector, draw_material, draw_sides
from cgemit.draw.display import event, event_3d, save_page
from cgemit.draw.monitor import (
    draw_efficiencies,
    draw_hit_residuals,
    draw_layer_maps,
    draw_residual_profiles,
    draw_strip_signals,
    draw_strips,
    draw_tracks,
)
from cgemit.draw.slab import draw_slab
from cgemit.draw.style import Picture

__all__ = [
    "FormationPanel",
    "Picture",
    "ViewCurves",
    "draw_budget",
    "draw_budgets",
    "draw_chain",
    "draw_cluster",
    "draw_constants",
    "draw_detector",
    "draw_efficiencies",
    "draw_finding",
    "draw_formation",
    "draw_hit_residuals",
    "draw_layer_maps",
    "draw_maps",
    "draw_material",
    "draw_modes",
    "draw_projection",
    "draw_readout",
    "draw_refit",
    "draw_residual_means",
    "draw_residual_profiles",
    "draw_sensitivity",
    "draw_sides",
    "draw_slab",
    "draw_strip_signals",
    "draw_strips",
    "draw_tracks",
    "event",
    "event_3d",
    "residual",
    "resolutions",
    "save_page",
]
