"""Efficiency, resolution and failures of the fit of difficult tracks (docs/methods/robustness.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cgemit import chain
from cgemit.candidates import HIT_V
from cgemit.detector import Detector, compiled, load
from cgemit.fit import FitStatus, fit
from cgemit.match import compare
from cgemit.result import Result
from cgemit.simulate import SimulateSettings
from cgemit.stages import Settings, fit_settings
from cgemit.statistics.estimate import Resolution, measure
from cgemit.study.hits import Hits, Mask
from cgemit.study.scenarios import Scenario
from cgemit.tables import Table

#: Of the page on difficult tracks: kaons that decay early have few hits, which is not a matter of the fit.
WITHOUT_DECAYS = Settings(simulate=SimulateSettings(decays=False))

#: What a track needs to be fitted: this many own hits, of which so many along z and across, over this length in mm.
HITS, ALONG, ACROSS, LEVER = 6, 2, 3, 80.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """The tracks of one scenario.

    Attributes
    ----------
    scenario : Scenario
    tracks : Table
        As fitted, with the hits as the scenario leaves them.
    enough : ndarray, (tracks,) bool
        Which have `HITS` hits of their own that measure the whole helix over a length of `LEVER`.
    """

    scenario: Scenario
    tracks: Table
    enough: Mask

    @property
    def good(self) -> Table:
        """The fitted ones of the tracks with enough hits."""
        picked: Table = self.tracks[self.enough & (self.tracks["status"] == FitStatus.ok)]
        return picked

    @property
    def efficiency(self) -> float:
        """Share of the tracks with enough hits that are fitted, with those whose momentum the hits do not constrain."""
        settled = np.isin(self.tracks["status"][self.enough], (FitStatus.ok, FitStatus.unconstrained))
        return int(np.count_nonzero(settled)) / max(len(settled), 1)

    @property
    def removed(self) -> Mapping[str, int]:
        """Tracks with enough hits that are not fitted, by status."""
        status = self.tracks["status"][self.enough]
        return {s.name: n for s in FitStatus if s != FitStatus.ok and (n := int((status == s).sum()))}

    def resolution(self, parameter: str) -> Resolution:
        """Return the widths of fitted minus true values; of p relative to the true one.

        Parameters
        ----------
        parameter : str
            A name of `cgemit.tables.PARAMETERS`.
        """
        tracks = self.good
        scale = tracks["truth_p"] if parameter == "p" else 1.0
        return measure(tracks[f"res_{parameter}"] / scale, parameter=parameter)

    def pull(self, parameter: str) -> Resolution:
        """Return the widths of the pull.

        Parameters
        ----------
        parameter : str
            A name of `cgemit.tables.PARAMETERS`.
        """
        return measure(self.good[f"pull_{parameter}"], parameter=f"pull of {parameter}")


def run_scenario(
    scenario: Scenario,
    n_events: int,
    seed: int = 1,
    *,
    detector: Detector | str = "besiii-cgem-design",
    settings: Settings | None = None,
) -> Outcome:
    """Simulate, spoil and fit the tracks of one scenario.

    Parameters
    ----------
    scenario : Scenario
    n_events, seed : int
    detector : Detector or str
        With CGEM layers and a drift chamber.
    settings : Settings or None
        None: `WITHOUT_DECAYS`.

    Returns
    -------
    Outcome
    """
    detector, settings = load(detector), settings or WITHOUT_DECAYS
    result = chain.run(detector, scenario.particles(n_events, seed), seed=seed, settings=settings)
    hits = Hits(result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
    if scenario.spoil is None:
        return Outcome(scenario, result.tracks, has_enough(detector, hits, result))
    hits = scenario.spoil(detector, hits, np.random.default_rng(seed))
    tables = (hits.clusters, hits.wire_hits, hits.candidates, hits.candidate_hits)
    tracks = fit(detector, *tables, fit_settings(settings))["tracks"]
    # Whatever hits a candidate has been given, it is compared with the particle that it was made of.
    comparison = compare(tracks, result.particles, tracks["candidate"], compiled(detector).field)
    return Outcome(scenario, tracks.with_columns(**comparison), has_enough(detector, hits, result))


def has_enough(detector: Detector, hits: Hits, result: Result) -> Mask:
    """Return which candidates have enough hits of their own particle to measure a helix.

    Parameters
    ----------
    detector : Detector
    hits : Hits
        As given to the fit.
    result : Result
        The run that they come from.

    Returns
    -------
    ndarray, (candidates,) bool
    """
    n, own, track = len(result.particles), own_hits(hits, result), hits.track
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    radii, tilted = (
        {layer.number: layer.r_mid for layer in layers},
        {layer.number: layer.twist != 0 for layer in layers},
    )
    places = list(zip(hits.on_wire, hits.layer, strict=True))
    radius = np.array([radii[number] if wire else detector.cgem[number].r_mid for wire, number in places])
    along = np.array([wire and tilted[number] for wire, number in places], np.bool_) | (hits.view == HIT_V)
    lowest, highest = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(lowest, track[own], radius[own])
    np.maximum.at(highest, track[own], radius[own])
    n_own, n_along = (np.bincount(track[mask], minlength=n) for mask in (own, own & along))
    enough = (n_own >= HITS) & (n_along >= ALONG) & (n_own - n_along >= ACROSS) & (highest - lowest >= LEVER)
    return np.asarray(enough, np.bool_)


def own_hits(hits: Hits, result: Result) -> Mask:
    """Return which hits the particle of their candidate left itself."""
    own = np.zeros(len(hits.track), np.bool_)
    tables = (
        (hits.on_wire, hits.wire_hits["wire_truth"], result.wire_truths),
        (~hits.on_wire, hits.clusters["truth"], result.truths),
    )
    for mask, links, truths in tables:
        link, track = links[hits.row[mask]], hits.track[mask]
        same = link >= 0
        for name in ("event", "particle"):
            same[same] = truths[name][link[same]] == result.particles[name][track[same]]
        same[same] = truths["daughter"][link[same]] == 0
        own[mask] = same
    return own
