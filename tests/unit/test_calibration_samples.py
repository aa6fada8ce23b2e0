"""Samples that calibrations of analog read-outs are made from, and what they say of X and V together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import cgemit as cg
from cgemit.reconstruction.candidates import HIT_WIRE
from cgemit.reconstruction.cluster import calibrated_clusterer, clusterer_of
from cgemit.reconstruction.cluster_errors import COS_THETA, ESTIMATORS, calibration_of, neutral
from cgemit.study.readout.calibrate import (
    Measurements,
    Tracks,
    _muons,
    measurements,
    set_correlations,
    true_directions,
)

DESIGN = cg.load("besiii-cgem-design")
RHO = np.array([0.6, -0.5, 0.7])


def test_correlation_of_a_sample() -> None:
    """It is found by layer, in spite of tails; pairs are those of one crossing."""
    random = np.random.default_rng(1)
    n = 30_000
    layer = random.integers(0, 3, n)
    a, b = random.standard_normal((2, n))
    x, v = 0.1 * a, 0.2 * (RHO[layer] * a + np.sqrt(1 - RHO[layer] ** 2) * b)
    x[:300] += 5
    v[:300] += 5
    order = random.permutation(n)
    view, truth = np.repeat([0, 1], n), np.concatenate([np.arange(n), order])
    residual, error = np.concatenate([x, v[order]]), np.repeat([0.1, 0.2], n)
    flat = np.zeros(2 * n, np.int64)
    sample = Measurements(residual, error, flat.astype(float), flat, error, view, layer[truth], truth, flat)
    found = neutral(3)
    tracks = Tracks(np.zeros(n), np.arange(n), np.ones((n, 3), np.bool_))
    set_correlations(found, 1, 2, sample, tracks)
    np.testing.assert_allclose(found.correlations[1, 2], np.tile(RHO[:, None], 17), atol=0.03)
    assert not found.correlations[0].any()


@pytest.mark.parametrize("second_pass", [False, True])
def test_clusters_of_a_chip_have_the_correlation_of_its_calibration(second_pass: bool) -> None:
    readout = cg.TigerReadout(second_pass=second_pass)
    calibration = calibration_of(DESIGN, readout)
    result = cg.run(DESIGN, cg.Gun("mu-", p=1.0, cos_theta=0.3), 20, readout=readout)
    clusters, hits = result.clusters, result.candidate_hits
    used = np.zeros(len(clusters), np.bool_)
    used[hits["row"][hits["view"] < HIT_WIRE]] = True
    by_angle = calibration.correlations[:, ESTIMATORS.index("merged")]
    angles = np.linspace(COS_THETA[0], COS_THETA[-1], 20_001)
    alone, tracked = (
        np.array([np.interp(angles, COS_THETA, layer).mean() for layer in of_pass]) for of_pass in by_angle
    )
    np.testing.assert_allclose(clusters["corr_xv"][~used], alone[clusters["layer"][~used]], atol=1e-5)
    expected = tracked if second_pass else alone
    np.testing.assert_allclose(clusters["corr_xv"][used], expected[clusters["layer"][used]], atol=1e-5)
    np.testing.assert_array_equal(clusterer_of(readout).expected_correlations(DESIGN), by_angle[int(second_pass)])
    assert (expected > 0.1).all()


def test_muons_of_a_calibration() -> None:
    """Charges take turns, and each has all momenta."""
    momenta = [0.5, 1.0, 2.0]
    muons = _muons(momenta, 12, 5, 0.8)
    assert muons["event"].tolist() == list(range(12))
    assert muons["pdg"].tolist() == [13, -13] * 6
    assert muons["charge"].tolist() == [-1, 1] * 6
    p = np.sqrt(muons["px"] ** 2 + muons["py"] ** 2 + muons["pz"] ** 2)
    for charge in (-1, 1):
        assert sorted(p[muons["charge"] == charge].round(9).tolist()) == sorted(momenta * 2)


@pytest.mark.slow
@pytest.mark.parametrize("particle", ["mu-", "mu+"])
@pytest.mark.parametrize("p", [0.25, 0.6])
def test_known_tracks_of_low_momentum(particle: str, p: float) -> None:
    """Clusters that know their track are right for both charges and at large curvature."""
    layers = dataclasses.replace(DESIGN, drift_chamber=None)
    readout = cg.TigerReadout()
    calibration = calibration_of(layers, readout)
    gun = cg.Gun(particle, p=p, cos_theta=(-0.9, 0.9))
    result = cg.run(layers, gun, 3000, 5, readout=readout, until="cluster")
    directions = true_directions(layers, result.clusters, result.truths)
    clusters = calibrated_clusterer(readout).cluster_with(layers, result.digis, calibration, directions=directions)
    sample = measurements(layers, clusters, result.truths)
    for view, layer in np.ndindex(2, 3):
        here = (sample.view == view) & (sample.layer == layer)
        pull = cg.study.measure(sample.residual[here] / sample.error[here])
        assert abs(pull.core - 1) < 0.08 + 2 * pull.core_error, (view, layer)
        assert abs(pull.core_mean) < 0.2 + 2 * pull.core_mean_error, (view, layer)
