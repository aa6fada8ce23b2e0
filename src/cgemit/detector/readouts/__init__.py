"""Readouts of layers as hardware: what digitization and clustering both know of them (docs/methods/readout.md)."""

from __future__ import annotations

from collections.abc import Mapping
from types import UnionType
from typing import TypeVar

from cgemit.detector.readouts.analog import AnalogReadout, Chip, Shaper, chip_arguments
from cgemit.detector.readouts.apv25 import APV25, Apv25Readout
from cgemit.detector.readouts.binary import BinaryReadout
from cgemit.detector.readouts.gaussian import GaussianReadout
from cgemit.detector.readouts.positions import PositionReadout, Precision
from cgemit.detector.readouts.projection import ProjectionReadout
from cgemit.detector.readouts.readout import ELECTRON, GAIN, SURVIVAL, ChipErrors, Estimator, Readout
from cgemit.detector.readouts.tiger import TIGER, TigerReadout

__all__ = [
    "APV25",
    "ELECTRON",
    "GAIN",
    "READOUTS",
    "SURVIVAL",
    "TIGER",
    "AnalogReadout",
    "Apv25Readout",
    "BinaryReadout",
    "ChargeReadout",
    "Chip",
    "ChipErrors",
    "Estimator",
    "GaussianReadout",
    "PositionReadout",
    "Precision",
    "ProjectionReadout",
    "Readout",
    "Shaper",
    "TigerReadout",
    "chip_arguments",
    "names_of",
    "part_of",
]

#: Those that measure the charge of strips (`cgemit.reconstruction.cluster_errors`).
ChargeReadout = AnalogReadout | ProjectionReadout

#: Readouts of CGEM layers by name.
READOUTS: dict[str, type[Readout]] = {
    one.name: one for one in (BinaryReadout, GaussianReadout, TigerReadout, Apv25Readout, ProjectionReadout)
}

Part = TypeVar("Part")


def part_of(readout: Readout, parts: Mapping[type[Readout], Part]) -> Part:
    """Return the digitizer or clusterer of a readout: that of its class, or of the nearest class that it extends."""
    for kind in type(readout).__mro__:
        if kind in parts:
            return parts[kind]
    raise ValueError(f"readout: got {readout.name!r}, expected one of {names_of()}")


def names_of(kind: type[Readout] | UnionType = Readout) -> str:
    """Return the names of the readouts of a kind, for messages."""
    return ", ".join(name for name, one in READOUTS.items() if issubclass(one, kind))
