"""How many difficult tracks are fitted, how well, and what becomes of the others (docs/methods/robustness.md).

``python -m cgemit.study.robustness 10000 > docs/methods/robustness.md`` writes that page.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cgemit import chain, find
from cgemit.candidates import HIT_V
from cgemit.detector import Detector, load
from cgemit.fit import FitStatus, fit
from cgemit.result import Result, Settings
from cgemit.study.estimate import Resolution, measure, share_error
from cgemit.study.hits import Hits, Mask
from cgemit.study.present import with_error
from cgemit.study.scenarios import SCENARIOS, Scenario
from cgemit.tables import PARAMETERS, Table

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
        """Share of the tracks with enough hits that are fitted."""
        return len(self.good) / max(int(np.count_nonzero(self.enough)), 1)

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

    Returns
    -------
    Outcome
    """
    detector, settings = load(detector), settings or Settings()
    result = chain.run(detector, scenario.particles(n_events, seed), seed=seed, settings=settings)
    names = ("particles", "clusters", "wire_hits", "truths", "wire_truths")
    candidates = find.by_truth(detector, *(result.tables[name] for name in names))
    hits = Hits(candidates, result.clusters, result.wire_hits)
    if scenario.spoil is None:
        return Outcome(scenario, result.tracks, has_enough(detector, hits, result))
    hits = scenario.spoil(detector, hits, np.random.default_rng(seed))
    of_fit = replace(settings.fit, screening=settings.fit.screening or settings.simulate.screening)
    tables = fit(detector, result.particles, hits.clusters, hits.wire_hits, hits.candidates, of_fit, seed)
    return Outcome(scenario, tables["tracks"], has_enough(detector, hits, result))


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
    along = np.array([wire and tilted[number] for wire, number in places], np.bool_) | (hits.candidates.kind == HIT_V)
    lowest, highest = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(lowest, track[own], radius[own])
    np.maximum.at(highest, track[own], radius[own])
    n_own, n_along = (np.bincount(track[mask], minlength=n) for mask in (own, own & along))
    enough = (n_own >= HITS) & (n_along >= ALONG) & (n_own - n_along >= ACROSS) & (highest - lowest >= LEVER)
    return np.asarray(enough, np.bool_)


def own_hits(hits: Hits, result: Result) -> Mask:
    """Return which hits come from the particle of their candidate."""
    own = np.zeros(len(hits.track), np.bool_)
    tables = (
        (hits.on_wire, hits.wire_hits["wire_truth"], result.wire_truths),
        (~hits.on_wire, hits.clusters["truth"], result.truths),
    )
    for mask, links, truths in tables:
        link, track = links[hits.candidates.row[mask]], hits.track[mask]
        same = link >= 0
        for name in ("event", "particle"):
            same[same] = truths[name][link[same]] == result.particles[name][track[same]]
        own[mask] = same
    return own


HEAD = ("tracks", "what is difficult", "fitted %", "not fitted", "p %", "dr um", "dz mm", "pulls", "iterations")

_INTRODUCTION = """# Difficult tracks

Tracks that are slow, steep, displaced or curling, with too few hits, wrong hits or noise, in the design CGEM with the
outer drift chamber. Written by `python -m cgemit.study.robustness {n} > docs/methods/robustness.md` ({n} events, two
tracks each). Hits are assigned by truth and then spoilt as the table says; the fit is told nothing of that.
`cgemit.study.scenarios.SCENARIOS` has the list, `cgemit.study.robustness.run_scenario` runs one.

A track counts if it has at least {hits} hits of its own, {along} of them stereo or V and {across} axial or X, over
{lever:g} mm of radius: a helix cannot be measured with less. *fitted*: share of those with status `ok`, with its
standard error; *not fitted*: the statuses of the others. *p*, *dr*, *dz*: core widths of fitted minus true values, p
relative to the true one. *pulls*: core widths for dr, phi0, kappa, dz, tanl (1 if the errors are right).

"""

_CLOSING = """
How the fit gets there: [fit.md](fit.md), "Iteration" and "Outliers". What remains:

- Pions below 65 MeV/c lose half of their energy in the beam pipe and more on the way. Where the loss that the fit
  reckons with would stop them before their last hits, hits are given up, and where fewer than six are left the status
  is `does_not_reach` or `stopped`.
- With the CGEM alone the sagitta is no larger than its error from 0.5 GeV/c on: kappa is known, p is not.
- The fit takes all matter between the innermost hit and the origin as crossed. Pions of K_S decays outside the beam
  pipe have not lost what it takes; `FitSettings.states` gives their helix at any radius.
- Electrons radiate in jumps that no Gaussian describes: pulls with narrow cores and long tails.

Nor does nonsense do harm: `tests/fuzz.py` gives the fit tracks with hits lost, added, exchanged, repeated and out of
order, and hits of any place, size and error. Nothing raises, and where a number is none the row's status says why.
`python tests/fuzz.py 1000000` repeats that for a million tracks and counts the statuses.
"""


def page(outcomes: Iterable[Outcome], n_events: int) -> str:
    """Return the page of a list of outcomes as Markdown.

    Parameters
    ----------
    outcomes : iterable of Outcome
    n_events : int
        Events of each.
    """
    text = _INTRODUCTION.format(n=n_events, hits=HITS, along=ALONG, across=ACROSS, lever=LEVER)
    rows = [HEAD, tuple("---" for _ in HEAD), *(cells(outcome) for outcome in outcomes)]
    return text + "".join(f"| {' | '.join(row)} |\n" for row in rows) + _CLOSING


def cells(outcome: Outcome) -> tuple[str, ...]:
    """Return what the table says of one scenario, in the order of `HEAD`."""
    share, total = outcome.efficiency, int(np.count_nonzero(outcome.enough))
    removed = ", ".join(f"{n} {status}" for status, n in outcome.removed.items()) or "none"
    widths = [
        with_error(factor * width.core, factor * width.core_error)
        for name, factor in (("p", 100.0), ("dr", 1000.0), ("dz", 1.0))
        for width in (outcome.resolution(name),)
    ]
    pulls = " ".join(f"{outcome.pull(name).core:.2f}" for name in PARAMETERS if name != "p")
    fitted = with_error(100 * share, 100 * share_error(share, total))
    iterations = f"{np.mean(outcome.good['iterations']):.1f}"
    return outcome.scenario.name, outcome.scenario.text, fitted, removed, *widths, pulls, iterations


def main(arguments: Sequence[str]) -> str:
    """Return the page for a number of events, and names of scenarios if not all are wanted."""
    n_events = int(arguments[0]) if arguments else 1000
    wanted = [s for s in SCENARIOS if not arguments[1:] or s.name in arguments[1:]]
    return page((run_scenario(scenario, n_events) for scenario in wanted), n_events)


if __name__ == "__main__":
    sys.stdout.write(main(sys.argv[1:]))
