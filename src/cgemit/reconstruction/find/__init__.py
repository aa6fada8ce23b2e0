"""Track finding: by truth, or from the hits alone (docs/methods/find.md)."""

from cgemit.reconstruction.find.ckf import FindSettings, find_tracks
from cgemit.reconstruction.find.loops import link_loops
from cgemit.reconstruction.find.truth import by_truth, link_problems, own_clusters, particle_rows, residuals

__all__ = [
    "FindSettings",
    "by_truth",
    "find_tracks",
    "link_loops",
    "link_problems",
    "own_clusters",
    "particle_rows",
    "residuals",
]
