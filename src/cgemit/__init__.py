"""Simulate, reconstruct and design trackers made of cylindrical GEM layers and drift chambers.

Stages are modules, each with one function and its settings: `cgemit.simulate`, `cgemit.digitize`, `cgemit.cluster`,
`cgemit.find`, `cgemit.fit`. `run` calls them in order.

Everything is imported when first used: the command line answers at once, and is in charge of Ctrl-C before anything
takes long.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cgemit import draw, isa, study
    from cgemit.chain import run
    from cgemit.cluster import ClusterSettings
    from cgemit.detector import Detector, DetectorError, detectors, load
    from cgemit.digitize import DigitizeSettings
    from cgemit.fit import FitSettings, FitStatus
    from cgemit.gun import Gun
    from cgemit.matter import slab
    from cgemit.result import Result, Settings
    from cgemit.simulate import SimulateSettings, TransportStatus
    from cgemit.states import StateStatus, Surface, extrapolate
    from cgemit.study.resolutions import resolution
    from cgemit.tables import Table
    from cgemit.version import VERSION as __version__

__all__ = [
    "ClusterSettings",
    "Detector",
    "DetectorError",
    "DigitizeSettings",
    "FitSettings",
    "FitStatus",
    "Gun",
    "Result",
    "Settings",
    "SimulateSettings",
    "StateStatus",
    "Surface",
    "Table",
    "TransportStatus",
    "__version__",
    "detectors",
    "draw",
    "extrapolate",
    "isa",
    "load",
    "resolution",
    "run",
    "slab",
    "study",
]

# Where names are that are not modules.
_HOMES = {
    "ClusterSettings": "cluster",
    "Detector": "detector",
    "DetectorError": "detector",
    "DigitizeSettings": "digitize",
    "FitSettings": "fit",
    "FitStatus": "fit",
    "Gun": "gun",
    "Result": "result",
    "Settings": "result",
    "SimulateSettings": "simulate",
    "StateStatus": "states",
    "Surface": "states",
    "Table": "tables",
    "TransportStatus": "simulate",
    "detectors": "detector",
    "extrapolate": "states",
    "load": "detector",
    "resolution": "study.resolutions",
    "run": "chain",
    "slab": "matter",
}


def __getattr__(name: str) -> Any:
    """Return what `__all__` names, or a module of the package."""
    if name == "__version__":
        return importlib.import_module("cgemit.version").VERSION
    module = f"cgemit.{_HOMES.get(name, name)}"
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module:
            raise
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
    return getattr(found, name) if name in _HOMES else found


def __dir__() -> list[str]:
    return sorted(__all__)
