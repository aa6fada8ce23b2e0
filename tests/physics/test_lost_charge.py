"""Clusters that lost charge, at the seam of a sheet or on dead strips, are as good as their errors say."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

import cgemit as cg
from cgemit.truth.assign import own_clusters, residuals
from stats import fraction_error

DESIGN = cg.load("besiii-cgem-design")
READOUTS = ("analog-projection", "tiger", "apv25")
N, AWAY = 1200, 0.7  # tracks; rad, from the seam
BEND = 2 * 3335.64  # mm, of 1 GeV/c in 1 T


class Width(NamedTuple):
    """Half-width of the central 68 %, median and share beyond 4 of pulls, and their number."""

    width: float
    median: float
    tail: float
    n: int


def width_of(pulls: np.ndarray) -> Width:
    low, middle, high = np.quantile(pulls, [0.16, 0.5, 0.84])
    return Width((high - low) / 2, middle, float(np.mean(np.abs(pulls) > 4)), len(pulls))


def muons(layer: int, offset: float, until: str = "fit", **how) -> cg.Result:
    """Return a run of muons of 1 GeV/c that cross a layer within 1.5 mm of the edge of its first sheet, or beside."""
    detector = how.pop("detector", DESIGN)
    plane = detector.cgem[layer]
    rng = np.random.default_rng(5)
    at = rng.uniform(-1.5, 1.5, N) / plane.r_readout
    phi = plane.phi_first + offset + at + np.arcsin(plane.r_readout / BEND)
    momenta = {"px": np.cos(phi), "py": np.sin(phi), "pz": rng.uniform(-0.4, 0.4, N)}
    particles = {"event": np.arange(N), "pdg": np.full(N, 13), **momenta}
    return cg.run(detector, particles, seed=3, until=until, workers=1, **how)


def cluster_pulls(result: cg.Result, layer: int, view: int) -> np.ndarray:
    """Return the pulls of the clusters of the crossings of a layer."""
    clusters = result.clusters
    rows = own_clusters(result.detector, clusters, result.truths)
    mine = (clusters["layer"][rows] == layer) & (clusters["view"][rows] == view)
    found = residuals(result.detector, clusters, result.truths, rows)[mine]
    return found / clusters[("err_x", "err_v")[view]][rows][mine]


@pytest.mark.slow
@pytest.mark.parametrize("layer", [0, 1, 2])
@pytest.mark.parametrize("readout", READOUTS)
def test_pulls_of_clusters_at_the_seam(readout: str, layer: int) -> None:
    """Width, median and tail as elsewhere: a strip at the seam sees a part of the charge, V strips end there."""
    runs = [muons(layer, offset, "cluster", readout=readout) for offset in (0.0, AWAY)]
    for view in (0, 1):
        seam, away = (width_of(cluster_pulls(run, layer, view)) for run in runs)
        assert seam.n > 0.8 * N  # some cross where no strip fits
        assert 0.8 < seam.width < max(1.1, away.width + 4 * seam.width / np.sqrt(seam.n)), (view, seam, away)
        assert abs(seam.median) < 0.15, (view, seam, away)
        # Paths that end at the seam of the projection are shorter there by an unknown part.
        more = 0.02 if (readout, view) == ("analog-projection", 1) else 0.0
        error = np.hypot(fraction_error(seam.tail, seam.n), fraction_error(away.tail, away.n))
        assert seam.tail < away.tail + more + 4 * error, (view, seam, away)


@pytest.mark.slow
@pytest.mark.parametrize("layer", [0, 2])
@pytest.mark.parametrize("readout", READOUTS)
def test_pulls_of_tracks_at_the_seam(readout: str, layer: int) -> None:
    """Pulls of d_rho, and hits left out, as those of tracks elsewhere."""
    found = []
    for offset in (0.0, AWAY):
        tracks = muons(layer, offset, readout=readout).tracks
        good = tracks["status"] == 0
        found.append((width_of(tracks["pull_dr"][good]), float(tracks["n_outliers"][good].mean())))
    (seam, out), (away, out_away) = found
    assert abs(seam.width - away.width) < 4 * np.sqrt(2 / seam.n), (seam, away)
    assert abs(seam.median) < 0.2
    assert seam.tail < 0.02
    assert out < out_away + 4 * np.sqrt((out + out_away) / N) + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("readout", "best"), [("analog-projection", 0.06), ("tiger", 0.16), ("apv25", 0.16)])
def test_clusters_beside_dead_strips(readout: str, best: float) -> None:
    """A dead strip within a cluster or beside it takes charge: position and error follow from the other strips."""
    plane = DESIGN.cgem[1]
    detector = DESIGN.with_overrides(
        {"cgem.L2.dead_x": ["0:100"], "cgem.L2.dead_v": [f"0:{k}" for k in range(3, 900, 9)]}
    )
    result = muons(1, 100.5 * plane.pitch_x / plane.r_readout, "cluster", readout=readout, detector=detector)
    for view in (0, 1):
        pulls = width_of(cluster_pulls(result, 1, view))
        assert pulls.n > 0.95 * N
        assert 0.7 < pulls.width < 1.1, (view, pulls)
        assert abs(pulls.median) < 0.2, (view, pulls)
        assert pulls.tail < 0.02, (view, pulls)
    clusters = result.clusters
    x = clusters[(clusters["layer"] == 1) & (clusters["view"] == 0)]
    # A position anywhere on a dead strip has an error of 0.19 mm.
    assert np.median(x["err_x"]) < best
