"""Background: cells and strips that fire without a particle of the event (docs/methods/background.md)."""

from cgemit.background.add import add_background
from cgemit.background.level import BackgroundSettings
from cgemit.background.mix import mix_events

__all__ = ["BackgroundSettings", "add_background", "mix_events"]
