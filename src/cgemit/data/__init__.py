"""Detector presets and constants of matter; every number with its source."""
