"""Samples of physics events, ready to be run (docs/methods/samples.md)."""

from cgemit.samples.catalogue import NAMES
from cgemit.samples.event_sample import EventSample, sample

__all__ = ["NAMES", "EventSample", "sample"]
