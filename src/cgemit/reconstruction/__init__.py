"""Reconstruction: from digis to tracks, without truth, for simulated and real events alike."""
