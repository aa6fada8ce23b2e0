"""The finders of a run. `FINDERS` lists them by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from cgemit.detector import Detector
from cgemit.reconstruction.candidates import Finder
from cgemit.reconstruction.find.ckf import FindSettings, find_tracks
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables import Table
from cgemit.truth.finder import by_truth


class Truths(NamedTuple):
    """What a finder by truth needs: the simulated detector, and the tables to which hits are linked."""

    detector: Detector
    particles: Table
    truths: Table
    wire_truths: Table


def _truth(settings: FindSettings, fit: FitSettings, truths: Truths) -> Finder:
    def truth(detector: Detector, clusters: Table, wire_hits: Table) -> Mapping[str, Table]:
        # Clusters may be those of another detector than the simulated one.
        function = by_truth.unchecked if detector == truths.detector else by_truth
        return function(truths.detector, truths.particles, clusters, wire_hits, truths.truths, truths.wire_truths)

    return truth


def _ckf(settings: FindSettings, fit: FitSettings, truths: Truths) -> Finder:
    def ckf(detector: Detector, clusters: Table, wire_hits: Table) -> Mapping[str, Table]:
        return find_tracks.unchecked(detector, clusters, wire_hits, settings, fit=fit)

    return ckf


#: Finders by name: functions that make one from the settings of finder and fit, and the truths of a run.
FINDERS: dict[str, Callable[[FindSettings, FitSettings, Truths], Finder]] = {"truth": _truth, "ckf": _ckf}
