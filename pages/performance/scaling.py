"""How times grow with the tracks of an event, with wire layers and with threads."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

import cgemit as cg
from cgemit.base.isa import cores
from cgemit.detector import Detector
from cgemit.particles.gun import Guns
from pages.page import Numbers
from pages.performance.timing import DETECTOR, GUN, SEED, fastest

FINDER, TRACKS, IN_ALL, RUNS = "besiii-cgem", (1, 4, 16, 32, 64), 1280, 5
CHAMBER, LAYERS, MUONS = "idea-like", (12, 24, 48, 80, 112), 4000
THREADED = 40_000  # muons

#: What grows, as the page names it: the time, and against what.
TIMES = {
    "tracks": ("finding a track", "tracks of the event"),
    "layers": ("chain, a muon", "wire layers"),
    "events": ("chain, a muon", "events"),
    "threads": ("chain, a muon, wall time", "threads"),
}


@dataclass(frozen=True)
class Growth:
    """Time of a track, us, against a number of what is a key of `TIMES`."""

    what: str
    n: int
    us: float


def exponent(n: Sequence[float], us: Sequence[float]) -> tuple[float, float]:
    """Return exponent and time at n = 1 of the power law through the times, by least squares of their logarithms."""
    slope, start = np.polyfit(np.log(n), np.log(us), 1)
    return float(slope), float(np.exp(start))


def with_wire_layers(number: int) -> Detector:
    """Return the detector with so many of its wire layers, evenly chosen."""
    whole = cg.load(CHAMBER)
    assert whole.drift_chamber is not None
    layers = whole.drift_chamber.layers
    chosen = np.round(np.linspace(0, len(layers) - 1, number)).astype(int)
    return replace(whole, drift_chamber=replace(whole.drift_chamber, layers=tuple(layers[i] for i in chosen)))


def finders() -> dict[int, Callable[[], object]]:
    """Return the search of events with so many tracks, by number: `IN_ALL` tracks together."""
    calls: dict[int, Callable[[], object]] = {}
    for tracks in TRACKS:
        names = ("mu-", "mu+", "pi-", "pi+")[: min(tracks, 4)]
        each = tracks // len(names)
        source = Guns(tuple(cg.Gun(name, multiplicity=each, p=(0.2, 1.5), cos_theta=(-0.9, 0.9)) for name in names))
        made = cg.run(FINDER, source, IN_ALL // tracks, SEED, until="cluster", workers=1)
        calls[tracks] = lambda made=made: cg.find_tracks(made.detector, made.clusters, made.wire_hits)
    return calls


def chains() -> dict[int, Callable[[], object]]:
    """Return the chain in the detector with so many wire layers, by number."""
    gun = cg.Gun("mu-", p=5.0, cos_theta=(-0.7, 0.7))
    detectors = {number: with_wire_layers(number) for number in LAYERS}
    return {n: lambda own=own: cg.run(own, gun, MUONS, SEED, workers=1) for n, own in detectors.items()}


def measure(_share: float) -> Numbers:
    """Measure all of them; fastest of several runs, of processor time but for threads."""
    threads = {n: lambda n=n: cg.run(DETECTOR, GUN, THREADED, SEED, workers=n) for n in range(1, cores() + 1)}
    rows = []
    for what, calls, count, clock in (
        ("tracks", finders(), IN_ALL, time.process_time),
        ("layers", chains(), MUONS, time.process_time),
        ("threads", threads, THREADED, time.perf_counter),
    ):
        best = fastest({str(n): call for n, call in calls.items()}, RUNS, clock)
        rows += [Growth(what, n, 1e6 * best[str(n)] / count) for n in calls]
    return Numbers(rows)
