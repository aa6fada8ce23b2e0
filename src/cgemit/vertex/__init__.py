"""Vertices of two tracks and invariant masses (docs/methods/vertex.md)."""

from cgemit.vertex.begin import begin_at_vertices
from cgemit.vertex.fit import VertexStatus, fit_vertices
from cgemit.vertex.pairs import BeamSpot, pair_tracks
from cgemit.vertex.truth import with_truth

__all__ = ["BeamSpot", "VertexStatus", "begin_at_vertices", "fit_vertices", "pair_tracks", "with_truth"]
