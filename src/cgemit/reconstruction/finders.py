"""Finders by name, which see measurements only. `HIT_FINDERS` lists them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from cgemit.base.settings import SettingsData
from cgemit.detector import Detector
from cgemit.detector.channels import Checked
from cgemit.reconstruction.candidates import Finder
from cgemit.reconstruction.find.ckf import FindSettings, find_tracks, seedless, warn_of_no_seeds
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables import Table


class HitFinder(NamedTuple):
    """A finder and its settings.

    Attributes
    ----------
    name : str
        In tables, too.
    find : Checked
        Function of (detector, clusters, wire_hits), and `settings` and `fit` by their names, which returns the tables
        ``candidates`` and ``candidate_hits``.
    settings : type of SettingsData
        With a `hypothesis`, the name of the particle that it assumes, or None.
    stage : str
        Their field of `cgemit.chain.settings.Settings`.
    seedless : callable
        Function of detector and settings: in which layers no track can begin, as text.
    warn : callable
        Function of detector and settings that warns, before a run, if no track can be found.
    """

    name: str
    find: Checked[..., Mapping[str, Table]]
    settings: type[SettingsData]
    stage: str
    seedless: Callable[[Detector, Any], str] = lambda *_: ""
    warn: Callable[[Detector, Any], None] = lambda *_: None

    def of(self, settings: SettingsData, fit: FitSettings, *, check: bool = True) -> Finder:
        """Return the finder with settings of its own and of the fit; `check`: of tables from outside the package."""
        function = self.find if check else self.find.unchecked

        def finder(detector: Detector, clusters: Table, wire_hits: Table) -> Mapping[str, Table]:
            return function(detector, clusters, wire_hits, settings, fit=fit)

        finder.__name__ = self.name
        return finder


#: By name.
HIT_FINDERS = {
    one.name: one for one in (HitFinder("ckf", find_tracks, FindSettings, "find", seedless, warn_of_no_seeds),)
}
