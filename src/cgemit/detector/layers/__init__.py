"""Kinds of layers, one a file: keys of a detector file, what follows from them, checks, matter, texts."""

from cgemit.detector.layers.cgem import CgemLayer
from cgemit.detector.layers.layer import Layer
from cgemit.detector.layers.sensor import MeasurementLayer

__all__ = ["LAYER_KINDS", "CgemLayer", "Layer", "MeasurementLayer"]

#: Kinds of layers that make clusters, by their table in a detector file.
LAYER_KINDS: dict[str, type[Layer]] = {one.group: one for one in (CgemLayer, MeasurementLayer)}
