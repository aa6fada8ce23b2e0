"""Detector descriptions: presets, files, variants, and the form in which the compiled core sees them."""

from cgemit.base.errors import DetectorError, Problem
from cgemit.detector.core import SCREENINGS, Screening, compiled, field_at, slab_table
from cgemit.detector.detector import Detector, ReadoutGroup, load
from cgemit.detector.export import describe, schema
from cgemit.detector.field import Field, FieldGrid, HarmonicField, MapField, SolenoidField
from cgemit.detector.files import detectors, fields, read_field_map, write_field_map
from cgemit.detector.gas import GasFile, read_gas_file
from cgemit.detector.layers import CgemLayer, MeasurementLayer
from cgemit.detector.layers.layer import SubLayer
from cgemit.detector.layers.wires import CellWire, DriftChamber, DriftPoint, ErrorPoint, WireLayer
from cgemit.detector.material import Material
from cgemit.detector.matter import slabs
from cgemit.detector.parts import Cylinder
from cgemit.detector.shells import Shell, Slab
from cgemit.detector.variants import like

__all__ = [
    "SCREENINGS",
    "CellWire",
    "CgemLayer",
    "Cylinder",
    "Detector",
    "DetectorError",
    "DriftChamber",
    "DriftPoint",
    "ErrorPoint",
    "Field",
    "FieldGrid",
    "GasFile",
    "HarmonicField",
    "MapField",
    "Material",
    "MeasurementLayer",
    "Problem",
    "ReadoutGroup",
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
    "read_gas_file",
    "schema",
    "slab_table",
    "slabs",
    "write_field_map",
]
