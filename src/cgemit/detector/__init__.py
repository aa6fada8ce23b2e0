"""Detector descriptions: presets, files, variants, and the form in which the compiled core sees them."""

from .build import load
from .files import detectors
from .material import Material
from .model import CgemLayer, Cylinder, Detector, DriftChamber, Field, Shell, SubLayer, WireLayer
from .problems import DetectorError, Problem
from .schema import schema
from .slabs import Slab, compiled, slab_table, slabs

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
    "Slab",
    "SubLayer",
    "WireLayer",
    "compiled",
    "detectors",
    "load",
    "schema",
    "slab_table",
    "slabs",
]
