"""Detector descriptions: presets, files, variants, and the form in which the compiled core sees them."""

from .build import load
from .files import detectors
from .material import Material
from .model import CgemLayer, Cylinder, Detector, DriftChamber, Field, Shell, SubLayer, WireLayer
from .problems import DetectorError, Problem
from .slabs import compiled, slab_table

__all__ = [
    "CgemLayer",
    "Cylinder",
    "Detector",
    "DetectorError",
    "DriftChamber",
    "Field",
    "Material",
    "Problem",
    "Shell",
    "SubLayer",
    "WireLayer",
    "compiled",
    "detectors",
    "load",
    "slab_table",
]
