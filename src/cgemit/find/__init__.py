"""Which hits belong to one track: by truth, or from the hits alone (docs/methods/find.md)."""

from cgemit.find.loops import link_loops
from cgemit.find.settings import FindSettings
from cgemit.find.tracks import find_tracks
from cgemit.find.truth import by_truth, link_problems, own_clusters, particle_rows, residuals

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
