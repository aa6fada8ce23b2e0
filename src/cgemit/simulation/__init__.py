"""Simulation: from particles to digis and wire hits, with their truth."""
