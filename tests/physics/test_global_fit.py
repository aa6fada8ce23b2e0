"""Filter and smoother equal a least-squares fit of everything at once: helix, every scattering angle, every loss."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.reconstruction.fit import PARAMETERS, FitSettings, core_arguments
from exact import exact
from tracks import hits_of_result, order_of_matter

FIT = FitSettings(residuals=True, tolerance=1e-7, max_iterations=50, outlier_pull=0, states=("origin",))
GUN = cg.Gun("pi+", p=[0.12, 0.2, 0.4, 1.0, 2.5], cos_theta=(-0.8, 0.8), vertex_sigma=(1.0, 1.0, 5.0))
PRESETS = ("besiii-cgem-design", "besiii-idc")
N = 100


@cache
def sample(name: str):
    """Return detector, core, hits of simulated tracks, and what the core makes of them."""
    result = cg.run(name, GUN, N, seed=17, workers=1, **exact())
    hits = hits_of_result(result)
    start = np.stack([result.tracks[name] for name in PARAMETERS], axis=1)
    arguments = core_arguments(result.detector, hits, result.particles["mass"], start, FIT)
    fitted = _core.reconstruction.fit(**arguments)
    assert np.all(fitted["status"] == 0)
    return result.detector, arguments["detector"], hits, result.particles["mass"], fitted


def everything_at_once(name, track, forget_matter=False):
    """Return (helix, covariance, chi2, residuals to all other hits, their errors, unknowns, kinks).

    The unknowns are the helix at the origin and, in standard deviations, every angle, loss and shift of the matter on
    the way: each is a measurement of 0 with error 1. Everything is linear about the reference of the fit's last
    iteration, kinks included: of those the measurement is that they are as large as they are. What a hit says of the
    others is e/(1 - H) with the residual e and the diagonal H of the hat matrix.
    """
    detector, core, hits, mass, fitted = sample(name)
    rows = slice(hits.hit_offsets[track], hits.hit_offsets[track + 1])
    fields = {f.name: getattr(hits, f.name)[rows] for f in dataclasses.fields(hits) if f.name != "hit_offsets"}
    helix = fitted["reference"][track] - np.array([0, np.pi / 2, 0, 0, 0])  # from the azimuth of flight
    kinks = fitted["kinks"].reshape(N, -1, 2)[track]
    reference = _core._testing.reference(core, helix, mass[track], fields, kinks)
    n, noise = len(fields["kind"]), reference["noise"]
    assert reference["reached"] == n
    seen = reference["rows"] @ noise.T
    turns_back = abs(helix[2]) > 1 / 0.13  # inside 0.8 m
    seen[np.arange(len(noise)) >= order_of_matter(detector, fields, len(noise), turns_back)[:, None]] = 0
    if forget_matter:
        seen[:] = 0
    measured = np.where(fields["kind"] == 2, fields["value"] * fields["side"], fields["value"])
    # The weak prior is that of the track behind all matter, helix plus the sum of the noise.
    prior = np.linalg.inv(np.linalg.cholesky(fitted["prior"][track].reshape(5, 5)))
    jacobian = np.block([
        [reference["rows"] / fields["sigma"][:, None], seen / fields["sigma"][:, None]],
        [np.zeros((len(noise), 5)), np.eye(len(noise))],
        [prior, prior @ noise.T],
    ])  # fmt: skip
    residual = (measured - reference["predicted"]) / fields["sigma"]
    white = np.concatenate([residual, -reference["noise_units"], np.zeros(5)])
    units = 1 / np.linalg.norm(jacobian, axis=0)
    q, r = np.linalg.qr(jacobian * units)
    estimate = units * np.linalg.solve(r, q.T @ white)
    inverse = units[:, None] * np.linalg.inv(r)
    left = white - jacobian @ estimate
    without = 1 - np.sum(q[:n] ** 2, axis=1)
    sigma = fields["sigma"]
    return (
        helix + estimate[:5], (inverse @ inverse.T)[:5, :5], float(left @ left), sigma * left[:n] / without,
        sigma / np.sqrt(without), len(estimate), kinks,
    )  # fmt: skip


@pytest.mark.parametrize("name", PRESETS)
def test_filter_and_smoother_are_the_global_fit(name: str) -> None:
    """State, covariance, chi-square and the residual of every hit agree to a millionth of a standard deviation."""
    _, _, hits, _, fitted = sample(name)
    kinked = 0
    for track in range(N):
        helix, covariance, chi2, residual, error, unknowns, kinks = everything_at_once(name, track)
        assert unknowns > 60
        kinked += bool(np.any(kinks))
        sigma = np.sqrt(np.diag(fitted["cov"][track]))
        difference = helix - fitted["helix"][track]
        difference[1] = np.remainder(difference[1] + np.pi, 2 * np.pi) - np.pi
        assert np.all(np.abs(difference) < 1e-6 * sigma)
        np.testing.assert_allclose(
            fitted["cov"][track] / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-6
        )
        assert fitted["chi2"][track] == pytest.approx(chi2, rel=1e-6)
        rows = slice(hits.hit_offsets[track], hits.hit_offsets[track + 1])
        np.testing.assert_allclose(fitted["residual"][rows] / error, residual / error, atol=1e-6)
        np.testing.assert_allclose(fitted["err"][rows], error, rtol=1e-6)
    assert 20 < kinked < 60  # below 0.3 GeV/c


def test_gate_sees_missing_matter() -> None:
    """Without the angles and losses among its unknowns the global fit is another one."""
    _, _, hits, _, fitted = sample(PRESETS[0])
    track = int(np.flatnonzero(np.abs(fitted["helix"][:, 2]) < 1)[0])
    helix, covariance, chi2, residual, error, *_ = everything_at_once(PRESETS[0], track, forget_matter=True)
    sigma = np.sqrt(np.diag(fitted["cov"][track]))
    assert np.any(np.abs(helix - fitted["helix"][track])[[0, 2, 3, 4]] > 0.01 * sigma[[0, 2, 3, 4]])
    assert covariance[0, 0] < 0.9 * sigma[0] ** 2
    assert chi2 > 1.001 * fitted["chi2"][track]
    rows = slice(hits.hit_offsets[track], hits.hit_offsets[track + 1])
    assert np.any(np.abs(residual - fitted["residual"][rows]) > 0.01 * error)
