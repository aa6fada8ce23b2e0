"""Detector descriptions: presets, files, variants, and the form in which the compiled core sees them."""

from cgemit.detector.build import load
from cgemit.detector.describe import describe
from cgemit.detector.files import detectors
from cgemit.detector.material import Material
from cgemit.detector.model import CgemLayer, Cylinder, Detector, DriftChamber, Field, Shell, SubLayer, WireLayer
from cgemit.detector.problems import DetectorError, Problem
from cgemit.detector.schema import schema
from cgemit.detector.slabs import SCREENINGS, Slab, compiled, slab_table, slabs

__all__ = [
    "SCREENINGS",
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
    "describe",
    "detectors",
    "load",
    "schema",
    "slab_table",
    "slabs",
]
