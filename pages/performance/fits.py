"""Cost of one fit and of one covariance, the compiled core alone, one thread, processor time.

Muons of 1 GeV/c through all 35 wire layers of `besiii-cgem-design`, with one hit in every layer: 3 clusters in two
views and 35 wires, where a real one crosses 38 cells. That is what other fitters are quoted for. The fit starts from
the smeared true helix, with smoother, residuals and pulls.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import cgemit as cg
from cgemit import _core, helix, isa
from cgemit.detector import compiled
from cgemit.fit_matter import tuned
from cgemit.reconstruction.candidates import FitHits, collect_hits
from cgemit.reconstruction.fit import core_arguments
from pages.page import Numbers
from pages.performance.stages import ALL_HITS, TWO_ITERATIONS, smeared
from pages.performance.timing import DETECTOR, SEED, fastest, instruction_set

ONE_PER_LAYER = cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7))
GUN = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
EVENTS, RUNS = 2000, 60
FIELDS, FIELD_EVENTS, FIELD_RUNS = ("uniform", "besiii-harmonic", "besiii", "finite-solenoid"), 1000, 7
SAMPLES, COVARIANCE_RUNS = 2048, 40
DETECTORS = ("besiii-cgem-design", "besiii-idc")
#: Half of them enter the geometry, half of them errors and thicknesses.
KEYS = (
    "field.bz", "cgem.L1.anode_radius", "cgem.L3.anode_radius", "cgem.L2.stereo", "cgem.*.drift_gap",
    "drift_chamber.sigma", "cgem.*.pitch_x", "cgem.*.pitch_v", "cgem.*.foil.Kapton.thickness",
    "cgem.L1.anode.*.thickness",
)  # fmt: skip
CURVES = {"fixed azimuth, gaussian": {"phi": 0.0, "readout": "gaussian"}, "binary, averaged": {}}


@dataclass(frozen=True)
class OneCovariance:
    """One covariance, us: of a track alone without budget, of a track of a point with it; and the fit beside them.

    `gradient` is that by ten numbers of the design, in covariances of a point.
    """

    isa: str
    alone_us: float
    of_a_point_us: float
    gradient: float
    fit_us: float


@dataclass(frozen=True)
class CurveCost:
    """A curve of 60 momenta of both detectors, from Python, one after the other, ms."""

    curve: str
    ms: float


def one_per_layer(hits: FitHits) -> FitHits:
    """Return the hits without the second cells and clusters of a layer."""
    counts = np.diff(hits.hit_offsets)
    place = np.stack([np.repeat(np.arange(len(counts)), counts), hits.kind, hits.layer], axis=1)
    first = np.append(True, np.any(place[1:] != place[:-1], axis=1))
    kept = np.bincount(place[first, 0], minlength=len(counts))
    return replace(
        hits,
        hit_offsets=np.append(0, np.cumsum(kept)).astype(np.int64),
        **{name: column[first] for name, column in hits.columns().items()},
    )


def arguments(result: cg.Result, hits: FitHits, settings: cg.FitSettings) -> dict[str, Any]:
    """Return what the compiled fit takes."""
    truth = helix.at_origin_in(result.particles, compiled(result.detector).field)
    start = smeared(truth, result.particles, SEED)
    return core_arguments(result.detector, hits, result.particles["mass"], start, settings)


def hits_of(result: cg.Result) -> FitHits:
    """Return the hits of all candidates."""
    return collect_hits(
        result.detector, result.candidates, result.candidate_hits, result.clusters, result.wire_hits
    )  # fmt: skip


def design_muons(known: bool) -> dict[str, Any]:
    """Return what the compiled fit takes for tracks with one hit in every layer."""
    settings = cg.Settings(digitize=cg.DigitizeSettings(reveal_sides=known))
    result = cg.run(DETECTOR, ONE_PER_LAYER, EVENTS, SEED, settings=settings)
    return arguments(result, one_per_layer(hits_of(result)), TWO_ITERATIONS if known else ALL_HITS)


def measure_covariances(_share: float) -> Numbers:
    """Measure one covariance beside one fit for each instruction set."""
    fitted = design_muons(True)
    tracks = cg.analytic(DETECTOR, p=1.0, readout="gaussian", samples=SAMPLES, threads=1, reveal_sides=True)._tracks
    alone = dataclasses.replace(tracks, samples=1, phases=tracks.phases[:1])
    base = cg.load(DETECTOR)
    variants = [tuned(base.with_overrides({key: "x1.00002"})) for key in KEYS]
    calls = {
        "alone": lambda: alone.run(budget=False),
        "point": lambda: tracks.run(budget=True),
        "gradient": lambda: tracks.run(budget=False, variants=variants),
        "fit": lambda: _core.reconstruction.fit(**fitted),
    }
    rows = []
    for code in isa.available():
        with instruction_set(code):
            spent = fastest(calls, COVARIANCE_RUNS)
        single, point = (1e6 * spent[name] / SAMPLES for name in ("alone", "point"))
        fit = 1e6 * spent["fit"] / EVENTS
        rows.append(OneCovariance(code, single, point, spent["gradient"] / spent["point"], fit))
    return Numbers(rows)


def measure_curves(_share: float) -> Numbers:
    """Measure curves of 60 momenta."""
    p = np.linspace(0.2, 2.0, 60)

    def curve(how: dict[str, Any]) -> None:
        for detector in DETECTORS:
            _ = cg.analytic(detector, p=p, **how).sigma_p

    calls = {name: lambda how=how: curve(how) for name, how in CURVES.items()}
    return Numbers([CurveCost(name, 1e3 * spent) for name, spent in fastest(calls, COVARIANCE_RUNS).items()])
