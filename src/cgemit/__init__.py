"""Simulate, reconstruct and design trackers made of cylindrical GEM layers and drift chambers.

Stages are modules, each with one function and its settings: `cgemit.simulate`, `cgemit.digitize`, `cgemit.cluster`,
`cgemit.find`, `cgemit.fit`. `run` calls them in order.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from cgemit import isa
from cgemit.candidates import label_candidates
from cgemit.chain import run
from cgemit.cluster import ClusterSettings
from cgemit.detector import Detector, DetectorError, detectors, load
from cgemit.digitize import BinaryReadout, DigitizeSettings, GaussianReadout
from cgemit.fit import FitSettings, FitStatus
from cgemit.gun import Gun
from cgemit.matter import slab
from cgemit.own_hits import fit_hits
from cgemit.result import Result, Settings
from cgemit.simulate import SimulateSettings, TransportStatus
from cgemit.states import StateStatus, Surface, extrapolate
from cgemit.tables import Table
from cgemit.version import VERSION as __version__

if TYPE_CHECKING:
    from cgemit import draw, study
    from cgemit.covariance import analytic, sensitivity
    from cgemit.statistics.resolutions import resolution

__all__ = [
    "BinaryReadout",
    "ClusterSettings",
    "Detector",
    "DetectorError",
    "DigitizeSettings",
    "FitSettings",
    "FitStatus",
    "GaussianReadout",
    "Gun",
    "Result",
    "Settings",
    "SimulateSettings",
    "StateStatus",
    "Surface",
    "Table",
    "TransportStatus",
    "__version__",
    "analytic",
    "detectors",
    "draw",
    "extrapolate",
    "fit_hits",
    "isa",
    "label_candidates",
    "load",
    "resolution",
    "run",
    "sensitivity",
    "slab",
    "study",
]

# Loaded when first used: they bring scipy and matplotlib, which take longer to import than all the rest.
_LAZY = {
    "analytic": "cgemit.covariance",
    "draw": "cgemit.draw",
    "study": "cgemit.study",
    "resolution": "cgemit.statistics.resolutions",
    "sensitivity": "cgemit.covariance",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(_LAZY[name])
    return getattr(module, name) if name in ("analytic", "resolution", "sensitivity") else module


def __dir__() -> list[str]:
    return sorted(__all__)
