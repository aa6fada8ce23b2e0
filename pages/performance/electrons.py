"""Electrons in ACTS' Kalman filter and Gaussian-sum filter, and in cgemit, on the layouts of `peers`; needs `pyacts`.

All in one process and one thread, electrons from the origin across the beam
(|cos(theta)| < 0.1), hits assigned by truth; ACTS simulates
its own (Fatras, bremsstrahlung included), since its layout is another one. The wheel of ACTS has no mixture for the
Gaussian-sum filter. It gets the PDG's spectrum of photons (eq. 34.28) in bins of the energy that is lost.
"""

from __future__ import annotations

import csv
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import quad

import cgemit as cg
from cgemit import isa as kernels
from cgemit.base.arrays import Floats
from cgemit.detector import Detector, load
from cgemit.study import measure as width_of
from cgemit.tables.schema import has_momentum
from pages.page import Numbers
from pages.performance.peers import (
    acts_field,
    at_perigee,
    cylinders,
    geometry,
    sequencer,
    smeared_starts,
    versions,
)
from pages.performance.timing import DETECTOR, SEED, machine

MOMENTA = (0.3, 1.0)  # GeV/c
EVENTS, ELECTRONS, TURNS = 20, 100, 3  # of a run: events, electrons of each, and how many runs
COMPONENTS = 12  # of the Gaussian-sum filter
EDGES = (0.003, 0.02, 0.08, 0.25, 0.6, 0.999)  # shares of the energy that a photon of each component takes
SHARES = (0.01, 0.02, 0.05)
COS_THETA = 0.1  # at most: ACTS loses tracks that fly along the middle of its cylinders
LEAST = 25  # measurements or more; the Gaussian-sum filter of ACTS ends slow tracks early


@dataclass(frozen=True)
class Electrons:
    """What a fit makes of electrons: p/p_true - 1 in %, coverage of its limits in %, and its time, us a track.

    `core` and `centre` are those of a Gaussian within two widths; `within_1` and others shares of the tracks, %; `q95`
    the 95 % quantile of the absolute value; `muon_us` the same fit of muons.
    """

    p: float
    program: str
    isa: str
    tracks: int
    core: float
    core_error: float
    centre: float
    within_1: float
    within_2: float
    within_5: float
    q95: float
    in_68: float
    in_95: float
    us: float
    muon_us: float


def mixture() -> dict[str, Any]:
    """Return the energy that is left behind thin matter as a mixture that ACTS reads: polynomials in X/X0."""

    def spectrum(y: float) -> float:
        return (4 / 3 * (1 - y) + y * y) / y

    def moment(n: int, low: float, high: float) -> float:
        return float(quad(lambda y: y**n * spectrum(y), low, high)[0])

    parts = []
    for low, high in pairwise(EDGES):
        number, mean = moment(0, low, high), moment(1, low, high) / moment(0, low, high)
        variance = moment(2, low, high) / number - mean**2
        parts.append({"weight_coeffs": [number, 0], "mean_coeffs": [0, 1 - mean], "var_coeffs": [0, variance]})
    soft = {
        "weight_coeffs": [-sum(part["weight_coeffs"][0] for part in parts), 1],
        "mean_coeffs": [-moment(1, 0, EDGES[0]), 1],
        "var_coeffs": [moment(2, 0, EDGES[0]), 1e-9],
    }
    return {"ranges": [{"low_x0": 0.0, "high_x0": 0.1, "transform": False, "components": [soft, *parts]}]}


def run_acts(built: Any, folder: Path, p: float, seed: int, particle: str) -> dict[str, tuple[Floats, Floats, float]]:
    """Return p/p_true - 1, its error and the time of a fit, us, for each fit of ACTS; of muons no sum of Gaussians."""
    import acts
    import acts.examples
    from acts.examples import reconstruction

    quiet, field = acts.logging.FATAL, acts_field("uniform", folder)
    s = sequencer(built, folder, EVENTS, ELECTRONS, p, COS_THETA, seed, field, particle)
    smeared_starts(s, seed, acts.ParticleHypothesis.muon if particle == "eMuon" else acts.ParticleHypothesis.electron)
    reconstruction.addKalmanTracks(s, built, field)
    kept = {"Kalman filter": at_perigee(s, built, field, "kf_tracks")}
    if particle != "eMuon":
        (folder / "mixture.json").write_text(json.dumps(mixture()))
        fit = acts.examples.makeGsfFitterFunction(
            built, field,
            betheHeitlerApprox=acts.examples.loadBetheHeitlerApproxFromJson(
                str(folder / "mixture.json"), clamp_to_range=True, no_change_limit=1e-6, single_gaussian_limit=1e-6
            ),
            maxComponents=COMPONENTS, weightCutoff=1e-4,
            componentMergeMethod=acts.examples.ComponentMergeMethod.maxWeight,
            mixtureReductionAlgorithm=acts.examples.MixtureReductionAlgorithm.KLDistance,
            reverseFilteringCovarianceScaling=100.0, level=quiet,
        )  # fmt: skip
        s.addAlgorithm(
            acts.examples.TrackFittingAlgorithm(
                level=quiet, inputMeasurements="measurements", inputProtoTracks="truth_particle_tracks",
                inputInitialTrackParameters="estimatedparameters", outputTracks="gsf_tracks", pickTrack=-1, fit=fit,
                calibrator=acts.examples.makePassThroughCalibrator(),
            )
        )  # fmt: skip
        kept["Gaussian-sum filter"] = at_perigee(s, built, field, "gsf_tracks")
    s.run()
    with (folder / "timing.csv").open() as file:
        seconds = [float(row["time_total_s"]) for row in csv.DictReader(file) if "TrackFitting" in row["identifier"]]
    fits = [1e6 * total / (EVENTS * ELECTRONS) for total in seconds]
    found = {}
    for (name, tracks), us in zip(kept.items(), fits, strict=True):
        q_over_p, error, measurements = (np.concatenate(column) for column in zip(*tracks, strict=True))
        good = (q_over_p != 0) & (measurements >= LEAST)
        found[name] = (1 / (p * np.abs(q_over_p[good])) - 1, error[good] * p, us)
    return found


def run_cgemit(detector: Detector, p: float, seed: int, particle: str) -> tuple[Any, float]:
    """Return the fitted tracks, and the time of a fit, us."""
    n = EVENTS * ELECTRONS
    made = cg.run(detector, cg.Gun(particle, p=p, cos_theta=(-COS_THETA, COS_THETA)), n, seed, until="fit", workers=1)
    start = time.perf_counter()
    tracks = cg.fit(detector, made.clusters, made.wire_hits, made.candidates, made.candidate_hits)["tracks"]
    return tracks[has_momentum(tracks)], 1e6 * (time.perf_counter() - start) / n


def covered(low: Floats, high: Floats) -> float:
    """Return the percentage of intervals that have 0 in them."""
    return float(100 * np.mean((low < 0) & ~(high < 0)))


def row(p: float, program: str, isa: str, off: Floats, limits: Sequence[float], us: float, muon_us: float) -> Electrons:
    """Return what is shown of a fit, from p/p_true - 1 of its tracks."""
    width = width_of(off)
    within = [float(100 * np.mean(np.abs(off) < share)) for share in SHARES]
    return Electrons(
        p, program, isa, len(off), 100 * width.core, 100 * width.core_error, 100 * width.core_mean, *within,
        float(100 * np.quantile(np.abs(off), 0.95)), *limits, us, muon_us,
    )  # fmt: skip


def measure(share: float) -> Numbers:
    """Measure all fits at each momentum, in turns; the time of a fit is the best of them."""
    about, detector, rows = versions(), load(DETECTOR).with_field("uniform"), []
    turns = max(1, round(share * TURNS))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        built = geometry(cylinders(detector), folder)
        for p in MOMENTA:
            theirs, muons, ours, own_muons = [], [], [], []
            for seed in range(SEED, SEED + turns):
                theirs.append(run_acts(built, folder, p, seed, "eElectron"))
                muons.append(run_acts(built, folder, p, seed, "eMuon")["Kalman filter"][2])
                ours.append(run_cgemit(detector, p, seed, "e-"))
                own_muons.append(run_cgemit(detector, p, seed, "mu-")[1])
            for fit in theirs[0]:
                off, error = (np.concatenate([run[fit][i] for run in theirs]) for i in range(2))
                limits = [covered(off - k * error, off + k * error) for k in (1.0, 1.96)]
                rows.append(row(p, f"ACTS, {fit}", "", off, limits, min(run[fit][2] for run in theirs), min(muons)))
            off, low, high, low95, high95 = (
                np.concatenate([tracks[name] for tracks, _ in ours]) / p - 1
                for name in ("p", "p_low", "p_high", "p_low95", "p_high95")
            )
            limits = [covered(low, high), covered(low95, high95)]
            rows.append(row(p, "cgemit", kernels.name(), off, limits, min(us for _, us in ours), min(own_muons)))
    return Numbers(rows, about | {"machine": machine()})
