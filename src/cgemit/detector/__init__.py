"""Detector descriptions: presets, files, variants, and the form in which the compiled core sees them."""

from cgemit.detector.compile import SCREENINGS, Screening, compiled, slab_table
from cgemit.detector.describe import describe
from cgemit.detector.field import Field, HarmonicField, MapField, SolenoidField
from cgemit.detector.field.core import field_at
from cgemit.detector.field.files import read_field_map, write_field_map
from cgemit.detector.field.grid import FieldGrid
from cgemit.detector.files import detectors, fields
from cgemit.detector.material import Material
from cgemit.detector.model import Detector, load
from cgemit.detector.parts import CgemLayer, Cylinder, DriftChamber, SubLayer, WireLayer
from cgemit.detector.schema import schema
from cgemit.detector.shell import Shell
from cgemit.detector.slabs import Slab, slabs
from cgemit.detector.variants import like
from cgemit.problems import DetectorError, Problem

__all__ = [
    "SCREENINGS",
    "CgemLayer",
    "Cylinder",
    "Detector",
    "DetectorError",
    "DriftChamber",
    "Field",
    "FieldGrid",
    "HarmonicField",
    "MapField",
    "Material",
    "Problem",
    "Screening",
    "Shell",
    "Slab",
    "SolenoidField",
    "SubLayer",
    "WireLayer",
    "compiled",
    "describe",
    "detectors",
    "field_at",
    "fields",
    "like",
    "load",
    "read_field_map",
    "schema",
    "slab_table",
    "slabs",
    "write_field_map",
]
