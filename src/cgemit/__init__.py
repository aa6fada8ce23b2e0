"""Simulate, reconstruct and design trackers made of cylindrical GEM layers and drift chambers."""
