"""The finders of a run: by truth, and those of `HIT_FINDERS`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from cgemit.chain.settings import Settings, find_settings, fit_settings
from cgemit.detector import Detector
from cgemit.particles.gun import Guns, Source
from cgemit.reconstruction.candidates import Finder
from cgemit.reconstruction.finders import HIT_FINDERS
from cgemit.tables import Table
from cgemit.truth.finder import by_truth

#: Names of finders.
FINDERS = ("truth", *HIT_FINDERS)


class Truths(NamedTuple):
    """What a finder by truth needs: the simulated detector, and the tables to which hits are linked."""

    detector: Detector
    particles: Table
    truths: Table
    wire_truths: Table


def truth_finder(truths: Truths) -> Finder:
    """Return the finder that gives each charged particle its own hits."""

    def truth(detector: Detector, clusters: Table, wire_hits: Table) -> Mapping[str, Table]:
        # Clusters may be those of another detector than the simulated one.
        function = by_truth.unchecked if detector == truths.detector else by_truth
        return function(truths.detector, truths.particles, clusters, wire_hits, truths.truths, truths.wire_truths)

    return truth


def finder_by_name(
    name: str, settings: Settings, source: Source | Guns | None = None, given: Table | None = None
) -> Finder:
    """Return a finder of `HIT_FINDERS` with the settings of a run, for tables of the package.

    Parameters
    ----------
    name : str
    settings : Settings
    source : Source, Guns or None
        What shoots the particles.
    given : Table of kind "particles", or None
        All particles of the run, if nothing shoots them.
    """
    named = HIT_FINDERS[name]
    own = find_settings(settings, source, given, named.stage)
    return named.of(own, fit_settings(settings, source), check=False)


def seedless_layers(finder: str | None, detector: Detector, settings: Settings) -> str:
    """Return in which layers no track of a finder can begin, as text; empty if it says nothing of them.

    Parameters
    ----------
    finder : str or None
        Its name, also of a function.
    detector : Detector
        Of the reconstruction.
    settings : Settings
    """
    if finder not in HIT_FINDERS:
        return ""
    named = HIT_FINDERS[finder]
    return named.seedless(detector, getattr(settings, named.stage))
