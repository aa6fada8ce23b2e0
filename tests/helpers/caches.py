"""Caches of the package, for tests that replace what cached values are made with."""

from __future__ import annotations

from cgemit.detector import core
from cgemit.detector.detector import preset
from cgemit.detector.gas import gap_columns


def forget() -> None:
    """Forget compiled detectors, their gaps, and presets with the momentum errors that they have kept."""
    core._shared.cache_clear()
    preset.cache_clear()
    gap_columns.cache_clear()
