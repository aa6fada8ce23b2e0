"""The chain from particles to matched tracks, its settings, its result and its record."""
