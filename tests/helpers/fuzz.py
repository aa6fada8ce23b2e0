"""Tracks and garbage of every kind for the fit.

`PYTHONPATH=. python tests/helpers/fuzz.py 1000000` fits a million and counts statuses. Whatever comes in,
the fit must not raise, must not warn, and every number that it gives out is one or its row's status says why it is
none.
"""

from __future__ import annotations

import sys
import warnings
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from cgemit import helix
from cgemit.detector import load
from cgemit.particles.table import particles_from
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.fit import PARAMETERS, FitSettings, fit, has_cov
from cgemit.simulation import transport
from cgemit.simulation.digitize import DigitizeSettings, digitize
from cgemit.tables import SCHEMAS, Table
from cgemit.tables.schema import HIT_WIRE, FitStatus
from cgemit.truth import finder
from pages.performance.stages import SMEARING, smeared
from pages.scenarios import Hits, add_noise, exchange_clusters, keep, lose_layers

PRESETS = ("besiii-cgem-design", "besiii-cgem", "besiii-idc", "besiii-idc-boss")
FAR = (50.0, 0.5, 1.0, 300.0, 1.0)
PDG = (11, -11, 13, -13, 211, -211, 321, -321, 2212, -2212)


@dataclass(frozen=True)
class Input:
    """What a fit gets."""

    detector: object
    particles: Table
    hits: Hits


def random_particles(n, random):
    """Return particles of any kind, momentum, direction and vertex: one event each."""
    p = np.exp(random.uniform(np.log(0.02), np.log(10), n))
    cos, phi = random.uniform(-0.97, 0.97, n), random.uniform(-np.pi, np.pi, n)
    sin = np.sqrt(1 - cos**2)
    spread = random.choice([0.0, 1.0, 30.0, 100.0], n)
    vertex = {axis: spread * random.uniform(-1, 1, n) for axis in "xyz"}
    momentum = {"px": p * sin * np.cos(phi), "py": p * sin * np.sin(phi), "pz": p * cos}
    return particles_from({"event": np.arange(n), "pdg": random.choice(PDG, n), **vertex, **momentum}, n_events=n)


def tracks(n, random):
    """Return simulated tracks with hits that are lost, added, exchanged or out of order."""
    detector = load(random.choice(PRESETS))
    tables = transport.simulate(detector, random_particles(n, random), seed=int(random.integers(2**32)))
    settings = DigitizeSettings(reveal_sides=bool(random.integers(2)))
    tables |= digitize(detector, tables["truths"], tables["wire_truths"], settings, 1, steps=tables["steps"])
    tables["clusters"] = cluster(detector, tables["digis"])
    names = ("particles", "clusters", "wire_hits", "truths", "wire_truths")
    found = finder.by_truth(detector, *(tables[name] for name in names))
    hits = Hits(*found.values(), tables["clusters"], tables["wire_hits"])
    hits = lose_layers(hits, random.choice([0.0, 0.0, 0.3, 0.8]), random)
    hits = add_noise(detector, hits, random.choice([0.0, 0.1, 0.5]), random)
    for layer in range(len(detector.cgem)):
        hits = exchange_clusters(hits, layer, random.random(n) < 0.1)
    kinds = random.choice(4, n)[hits.track]  # all hits, wires or clusters alone, or one layer
    one_layer = hits.layer == random.integers(0, 43)
    hits = keep(hits, (kinds == 0) | ((kinds == 1) == hits.on_wire) & (kinds < 3) | (kinds == 3) & one_layer)
    return Input(detector, tables["particles"], disordered(hits) if random.random() < 0.1 else hits)


def disordered(hits):
    """Return the candidates with their hits from the outside inward."""
    track = hits.track
    return replace(hits, candidate_hits=hits.candidate_hits[np.lexsort((-np.arange(len(track)), track))])


def garbage(n, random):
    """Return candidates of numbers that mean nothing: any place, any size, any error."""
    detector = load(random.choice(PRESETS))
    particles = random_particles(n, random)
    counts = random.choice([0, 1, 5, 6, 7, 12, 40, 200], n)
    track = np.repeat(np.arange(n), counts)
    layers = detector.drift_chamber.layers
    wires = random.random(len(track)) < (0.7 if detector.cgem else 1.0)
    clusters = random_clusters(detector, track[~wires], n, random)
    wire_hits = random_wire_hits(layers, track[wires], n, random)
    row = np.empty(len(track), np.int64)
    row[wires], row[~wires] = np.arange(len(wire_hits)), np.arange(len(clusters))
    view = np.full(len(track), HIT_WIRE, np.int8)
    view[~wires] = clusters["view"]
    candidates = {"event": np.arange(n), "candidate": np.zeros(n, int), "pdg": np.abs(particles["pdg"])}
    columns = {"event": track, "candidate": track, "view": view, "hit": row}
    tables = (
        Table("candidates", candidates | {"mass": particles["mass"], "charge": np.abs(particles["charge"])}, n),
        Table("candidate_hits", columns, n),
    )
    return Input(detector, particles, Hits(*tables, clusters, wire_hits))


def any_size(n, random):
    """Return lengths of either sign and any size that a number may have in a file."""
    return random.choice([-1.0, 1.0], n) * 10.0 ** random.choice([-9.0, -1.0, 0.5, 1.0, 2.0, 2.5, 4.0, 9.0], n)


def random_clusters(detector, event, n_events, random):
    """Return rows of the clusters table, one per entry of `event`."""
    n = len(event)
    columns = {c.name: np.zeros((n, *c.shape), c.dtype) for c in SCHEMAS["clusters"]}
    columns |= {
        "event": event,
        "view": random.integers(0, 2, n).astype(np.int8),
        "layer": random.integers(0, max(len(detector.cgem), 1), n).astype(np.int32),
        "size": random.choice([0, 1, 2, 50, 10**6], n).astype(np.int32),
        "x": any_size(n, random),
        "v": any_size(n, random),
        "err_x": np.abs(any_size(n, random)),
        "err_v": np.abs(any_size(n, random)),
    }
    return Table("clusters", columns, n_events)


def random_wire_hits(layers, event, n_events, random):
    """Return rows of the wire_hits table, one per entry of `event`, in few layers or in all."""
    n = len(event)
    some = random.choice([1, 3, len(layers)], n_events)[event]
    chosen = (random.random(n) * some).astype(np.int64)
    columns = {c.name: np.zeros((n, *c.shape), c.dtype) for c in SCHEMAS["wire_hits"]}
    drift = np.where(random.random(n) < 0.5, random.uniform(0, 8, n), any_size(n, random))
    columns |= {
        "event": event,
        "layer": np.array([layer.number for layer in layers], np.int32)[chosen],
        "wire": (random.random(n) * np.array([layer.cells for layer in layers])[chosen]).astype(np.int32),
        "drift": drift,
        "sigma": np.where(random.random(n) < 0.5, 0.13, np.abs(any_size(n, random))),
        "side": np.where(drift < 0, 0, random.integers(-1, 2, n)).astype(np.int8),
    }
    return Table("wire_hits", columns, n_events)


def random_settings(random):
    """Return settings of the fit."""
    return FitSettings(
        cluster_errors=str(random.choice(["track", "cluster"])),
        residuals=True,
        max_iterations=int(random.choice([1, 5, 15])),
        outlier_pull=float(random.choice([0.0, 3.0, 5.0])),
    )


def random_start(given, random, seed):
    """Return first helices near the truth or far from it, or none."""
    far = random.choice([0, 0, 0, 0, 1, 2])
    truth = helix.at_origin(given.particles, given.detector.field.bz)
    return None if not far else smeared(truth, given.particles, seed, SMEARING if far == 1 else FAR)


def run(given, settings, start=None):
    """Fit; a warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hits = given.hits
        tables = (hits.clusters, hits.wire_hits, hits.candidates, hits.candidate_hits)
        return fit.unchecked(given.detector, *tables, settings, start=start)


def problems(tables):
    """List what is wrong with the tables of a fit."""
    rows, found = tables["tracks"], []
    status = rows["status"]
    ok, fitted = status == FitStatus.ok, has_cov(status)
    if not np.isin(status, list(FitStatus)).all():
        found.append("a status that is none")
    none = np.isin(status, (FitStatus.too_few_hits, FitStatus.seed_failed))
    helix = np.stack([rows[name] for name in PARAMETERS], axis=1)
    if not np.isfinite(helix[ok]).all() or not np.isnan(helix[none]).all():
        found.append("a helix that is no number, or one where there is none")
    cov = rows["cov"]
    if np.isfinite(cov[~fitted]).any() or not np.isfinite(rows["chi2"][ok]).all():
        found.append("a covariance of a track without, or no chi-square")
    found += covariance_problems(cov[ok])
    if (rows["ndf"][ok] < 1).any() or (rows["chi2"][ok] < 0).any():
        found.append("chi-square or degrees of freedom")
    residuals = tables["residuals"]
    if not all(np.isfinite(residuals[name]).all() for name in ("residual", "err", "pull")):
        found.append("a residual that is no number")
    return found


def covariance_problems(cov):
    """List what is wrong with covariances of good tracks."""
    if not np.isfinite(cov).all():
        return ["a covariance that is no number"]
    if not len(cov):
        return []
    diagonal = np.diagonal(cov, axis1=1, axis2=2)
    if (diagonal <= 0).any() or not np.array_equal(cov, np.swapaxes(cov, 1, 2)):
        return ["variances that are not positive, or not symmetric"]
    scale = 1 / np.sqrt(diagonal)
    try:
        np.linalg.cholesky(cov * scale[:, :, None] * scale[:, None, :])
    except np.linalg.LinAlgError:
        return ["a covariance that is not positive definite"]
    return []


def fuzz(n, seed, chunk=1000):
    """Fit `n` tracks, every second chunk garbage; return how many of each kind and status, and what is wrong."""
    counts, found = Counter(), []
    for number in range(max(n // chunk, 1)):
        random = np.random.default_rng([seed, number])
        make = garbage if number % 2 else tracks
        given, settings = make(chunk, random), random_settings(random)
        tables = run(given, settings, random_start(given, random, number))
        counts.update((make.__name__, FitStatus(int(s)).name) for s in tables["tracks"]["status"])
        found += [f"chunk {number} of seed {seed} ({make.__name__}): {text}" for text in problems(tables)]
    return counts, found


if __name__ == "__main__":
    counts, found = fuzz(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    for (kind, status), number in sorted(counts.items()):
        print(f"{kind:10s}{status:24s}{number:10d}")
    print(*found, sep="\n")
    sys.exit(1 if found else 0)
