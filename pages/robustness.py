"""The page docs/methods/robustness.md: `python validation/robustness_page.py 10000 > docs/methods/robustness.md`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

import numpy as np

import begins
from cgemit.analysis.widths import share_error
from cgemit.tables import PARAMETERS
from cgemit.tables.show import with_error
from robustness import ACROSS, ALONG, HITS, LEVER, SCENARIOS, Outcome, run_scenario

HEAD = ("tracks", "what is difficult", "fitted %", "not fitted", "p %", "dr um", "dz mm", "pulls", "iterations")

_INTRODUCTION = """# Difficult tracks

This page shows how the fit performs on tracks that are slow, steep, displaced or curling, or that have too few hits,
wrong hits or noise. The detector is the design CGEM with the outer drift chamber. The page is written by
`python validation/robustness_page.py {n} > docs/methods/robustness.md`, with {n} events of two tracks each. Hits are
assigned by truth and then changed as the table says; the fit gets no information about the changes.
`validation/robustness.py` lists the scenarios. Particles do not decay in flight here.

A track counts if it has at least {hits} hits of its own, {along} of them stereo or V and {across} axial or X, over
{lever:g} mm of radius. A helix cannot be measured with less. *fitted* is the fraction of these tracks with status `ok`
and its standard error. *not fitted* lists the statuses of the others. *p*, *dr* and *dz* are the core widths of fitted
minus true values; p is relative to the true p. *pulls* are core widths for dr, phi0, kappa, dz, tanl (1 if the errors
are right).

"""

_CLOSING = """
The method is described in [fit.md](fit.md), "Iteration" and "Outliers". Known limitations:

- Pions below 65 MeV/c lose half of their energy in the beam pipe and more further out. If the loss assumed by the fit
  would stop them before their last hits, hits are given up. If fewer than six are left, the status is
  `does_not_reach` or `stopped`.
- With the CGEM alone, the sagitta of 0.3 mm at 1 GeV/c is comparable to the error of one strip, 0.2 mm. kappa is
  measured, but p is hardly constrained.
- By default the fit assumes that all matter between the innermost hit and the origin is crossed. Pions of K_S decays
  outside the beam pipe have not had this energy loss; the next section tells the fit so. The states table
  (`FitSettings(states=...)`) has their helix at any radius.
- Electrons radiate in jumps that no Gaussian describes. Their pulls have narrow cores and long tails.
"""

_BEGINS = """## Tracks that begin beside the beam line

A particle that begins outside of the beam pipe and flies outward has not crossed it; one that flies inward crosses
it twice. The fit cannot tell from the hits. By default it corrects the energy for one crossing, so that slow tracks are
many errors off in kappa, with a good chi-square. Where the vertex is known, the candidates' column `start_radius` says
where a track begins, or the setting `FitSettings(start_radius=...)` for all: matter inside is left out, or counts twice
after a flight inward (negative radius). `cgemit.helix.start_radius` makes the column from fitted helices and vertices:

    begin = helix.start_radius(helices, vertices, bz)
    candidates = candidates.with_columns(start_radius=begin)
    tracks = fit(detector, clusters, wire_hits, candidates, candidate_hits)["tracks"]

The helix at the origin is then the flight at the vertex, continued in vacuum, as truth is. Pions with pT of 0.065 to
0.1 GeV/c, directions at random, from `python validation/begins.py 4000`:

"""

_END = """
Tracks from inside the beam pipe do not change. After a flight inward, the second crossing is treated as if it happened
at the first one, on the outward arc: its scattering acts at another place, so that the tail is reduced less.

A vertex is often not known before the fit. The tracks' column `displaced` is 1 if the closest approach to the beam
line, |dr|, is more than five of its errors, and more than a tenth of the radius of the innermost matter (3.1 mm in
the BESIII presets, more than the size of the beam). Such a track begins beside the beam line, or is the muon of a
kink, and matter inside may have been corrected for though it was not crossed: fit it to a vertex, then again with
`start_radius`. The fit itself does not change. Of the slow pions above with a pull beyond 8, 94 % are marked at 35
and 50 mm, 91 % at 70 and 79 % at 100 mm. The others fly along the radius: their helix misses the beam line by less
than five errors. Pions from within the beam pipe (20 mm) are marked as well, whose correction is right. Marked
although they begin at the origin:

| sample at the origin | marked, % |
| --- | --- |
| slow pions as above | 0.5, of which one in two has a pull beyond 8 |
| mu 0.2–2 GeV/c, `besiii-cgem`, also with a beam of 0.4 mm | 0.15 |
| mu 0.2–2 GeV/c, `besiii-idc`, `kloe2-like` | 0.04 |
| pi 0.1–1 GeV/c with decays, `besiii-cgem` | 0.2 |
| K 0.2–1 GeV/c with decays, `besiii-cgem` | 0.3 |
| the same, found without truth | 34 of those that decayed, 0.5 of the others |
| e 0.1–1 GeV/c, `besiii-cgem` | 1.1 |

Invalid input does no harm. `tests/fuzz.py` gives the fit tracks with hits lost, added, exchanged, repeated and out of
order, and hits of any position, size and error. No exception is raised, and if a value is NaN the status of the row
gives the reason. `PYTHONPATH=benchmarks:validation python tests/fuzz.py 1000000` repeats this for a million tracks and
counts the statuses.
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
    return text + "".join(f"| {' | '.join(row)} |\n" for row in rows) + _CLOSING + _END


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
    text = page((run_scenario(scenario, n_events) for scenario in wanted), n_events)
    return text.replace(_END, "\n" + _BEGINS + begins.table(4000) + _END)


if __name__ == "__main__":
    sys.stdout.write(main(sys.argv[1:]))
