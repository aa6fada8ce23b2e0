"""Simulate, reconstruct and design trackers made of cylindrical GEM layers and drift chambers.

Stages are modules, each with one function and its settings: `cgemit.simulate`, `cgemit.digitize`, `cgemit.cluster`,
`cgemit.find`, `cgemit.fit`. `run` calls them in order.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from cgemit.version import VERSION as __version__

if TYPE_CHECKING:
    from cgemit import draw, isa, study
    from cgemit.background import BackgroundSettings, mix_events
    from cgemit.candidates import label_candidates
    from cgemit.chain import run
    from cgemit.cluster import ClusterSettings
    from cgemit.covariance import analytic, sensitivity
    from cgemit.detector import Detector, DetectorError, detectors, like, load
    from cgemit.digitize import (
        Apv25Readout,
        BinaryReadout,
        DigitizeSettings,
        GaussianReadout,
        ProjectionReadout,
        TigerReadout,
    )
    from cgemit.find import FindSettings, find_tracks
    from cgemit.fit import FitSettings, FitStatus
    from cgemit.gun import Gun
    from cgemit.matter import slab
    from cgemit.own_hits import fit_hits
    from cgemit.progress import ProgressBar
    from cgemit.result import Result
    from cgemit.samples import EventSample, sample
    from cgemit.simulate import SimulateSettings, TransportStatus
    from cgemit.stages import Settings
    from cgemit.start_times import StartTimeStatus
    from cgemit.states import StateStatus, Surface, extrapolate
    from cgemit.statistics.resolutions import resolution
    from cgemit.stored_run import open
    from cgemit.tables import Table
    from cgemit.vertex import BeamSpot, VertexStatus, fit_vertices, pair_tracks

__all__ = [
    "Apv25Readout",
    "BackgroundSettings",
    "BeamSpot",
    "BinaryReadout",
    "ClusterSettings",
    "Detector",
    "DetectorError",
    "DigitizeSettings",
    "EventSample",
    "FindSettings",
    "FitSettings",
    "FitStatus",
    "GaussianReadout",
    "Gun",
    "ProgressBar",
    "ProjectionReadout",
    "Result",
    "Settings",
    "SimulateSettings",
    "StartTimeStatus",
    "StateStatus",
    "Surface",
    "Table",
    "TigerReadout",
    "TransportStatus",
    "VertexStatus",
    "__version__",
    "analytic",
    "detectors",
    "draw",
    "extrapolate",
    "find_tracks",
    "fit_hits",
    "fit_vertices",
    "isa",
    "label_candidates",
    "like",
    "load",
    "mix_events",
    "open",
    "pair_tracks",
    "resolution",
    "run",
    "sample",
    "sensitivity",
    "slab",
    "study",
]

# The modules of the public names. They are imported when first used: numpy, scipy and matplotlib take half a second,
# in which Ctrl-C would end the command line with a traceback.
_MODULES = {
    "Apv25Readout": "digitize",
    "BackgroundSettings": "background",
    "BeamSpot": "vertex",
    "BinaryReadout": "digitize",
    "ClusterSettings": "cluster",
    "Detector": "detector",
    "DetectorError": "detector",
    "DigitizeSettings": "digitize",
    "EventSample": "samples",
    "FindSettings": "find",
    "FitSettings": "fit",
    "FitStatus": "fit",
    "GaussianReadout": "digitize",
    "ProjectionReadout": "digitize",
    "Gun": "gun",
    "ProgressBar": "progress",
    "Result": "result",
    "Settings": "stages",
    "SimulateSettings": "simulate",
    "StartTimeStatus": "start_times",
    "StateStatus": "states",
    "Surface": "states",
    "Table": "tables",
    "TigerReadout": "digitize",
    "TransportStatus": "simulate",
    "VertexStatus": "vertex",
    "analytic": "covariance",
    "detectors": "detector",
    "extrapolate": "states",
    "find_tracks": "find",
    "fit_hits": "own_hits",
    "fit_vertices": "vertex",
    "label_candidates": "candidates",
    "like": "detector",
    "load": "detector",
    "mix_events": "background",
    "open": "stored_run",
    "pair_tracks": "vertex",
    "resolution": "statistics.resolutions",
    "run": "chain",
    "sample": "samples",
    "sensitivity": "covariance",
    "slab": "matter",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(f"cgemit.{_MODULES[name]}"), name)
    missing = f"cgemit.{name}"
    try:
        if not name.startswith("_"):
            return importlib.import_module(missing)
    except ModuleNotFoundError as error:
        if error.name != missing:
            raise
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
