"""Find and fit the tracks of public events of the BESIII software, and check that we agree with it.

The source distribution of pybes3 holds them (MIT licence, simulated events of the software 7.2.0):

    pip download --no-binary pybes3 --no-deps pybes3==0.5.6 && tar xf pybes3-0.5.6.tar.gz
    python tools/refit_public.py pybes3-0.5.6/tests/data
"""

from __future__ import annotations

import sys
from pathlib import Path

import cgemit as cg
from cgemit.bes3 import wires as bes3_wires
from cgemit.bes3.events import read_events
from cgemit.bes3.refit import refit

#: File, detector, particle.
SAMPLES = (("test_full_mc_evt_1.rec", "besiii-idc", "pi"), ("test_cgem.rec", "besiii-cgem", "mu"))


def problems(folder: Path) -> list[str]:
    """Print both fits of every file, and return where they do not agree.

    Without matter both do the same to the same hits: the errors agree within 2 %, the parameters within half an error
    in the median. What remains are the field map, of which we have a model, and the iteration.
    """
    found = []
    for name, detector, particle in SAMPLES:
        events = read_events(folder / name, cg.load(detector).with_field("besiii"))
        print(events)
        for kind in ("kal", "mdc"):
            result = refit(events, kind, cg.FitSettings(hypothesis=particle))
            print(result)
            if not result.good.all():
                found.append(f"{name}, {kind}: {int((~result.good).sum())} tracks not fitted")
            for parameter, row in result.summary().items() if kind == "mdc" else ():
                if abs(row["error_ratio"] - 1) > 0.02 or abs(row["pull"]) > 0.5:
                    found.append(f"{name}: {parameter}: {row}")
    return found + _lost(folder)


def _lost(folder: Path) -> list[str]:
    """Print tracks found among all hits, with the noise of real events, and say if one is lost."""
    found = []
    how = cg.RefineSettings(drift_times="raw", start_time="fitted")
    for name, detector, particle in SAMPLES:
        events = read_events(folder / name, cg.load(detector).with_field("besiii"))
        for start in (None, bes3_wires.find_start_times(events)):
            wires = bes3_wires.all_wire_hits(events, start)
            hits = events.detector, events.clusters, wires
            settings = cg.FitSettings(hypothesis=particle)
            made = cg.reconstruct(*hits, cg.find_tracks, settings, refinements=cg.refinements(how))
            ours, theirs = (bes3_wires.match_wires(events, wires, tracks) for tracks in (made, None))
            for whose, matches in (("ours", ours), ("BOSS", theirs)):
                means = (f"{of} {matches[of].mean():.4f}" for of in ("purity", "efficiency"))
                print(f"{name}, {whose}: {len(matches)} tracks, {', '.join(means)}")
            if len(ours) != len(theirs) or (ours["particle"] < 0).any():
                found.append(f"{name}: {len(ours)} tracks, BOSS {len(theirs)}")
    return found


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    wrong = problems(Path(sys.argv[1]))
    print("\n".join(wrong) or "both agree")
    sys.exit(1 if wrong else 0)
