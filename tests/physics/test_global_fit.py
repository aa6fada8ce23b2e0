"""Filter and smoother equal a least-squares fit of everything at once: helix, every scattering angle, every loss."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core, find
from cgemit.candidates import fit_hits
from cgemit.detector import compiled
from cgemit.fit import PARAMETERS, FitSettings
from exact import EXACT
from tracks import order_of_matter

SETTINGS = dataclasses.replace(
    EXACT, fit=FitSettings(residuals=True, tolerance=1e-7, max_iterations=50, outlier_pull=0)
)
GUN = cg.Gun("pi+", p=[0.2, 0.4, 1.0, 2.5], cos_theta=(-0.8, 0.8), vertex_sigma=(1.0, 1.0, 5.0))
PRESETS = ("besiii-cgem-design", "besiii-idc")
N = 100


@cache
def sample(name: str):
    """Return simulated and fitted tracks, and their hits as columns."""
    result = cg.run(name, GUN, N, seed=17, settings=SETTINGS, threads=1)
    assert result.removed() == {}
    tables = (result.particles, result.clusters, result.wire_hits, result.truths, result.wire_truths)
    return result, fit_hits(find.by_truth(result.detector, *tables), result.clusters, result.wire_hits)


def everything_at_once(result, hits, track, forget_matter=False):
    """Return (estimate, covariance, chi2, residuals to all other hits, their errors, unknowns).

    The unknowns are the helix at the origin and, in standard deviations, every angle, loss and shift of the matter on
    the way: each is a measurement of 0 with error 1. Everything is linear about the fitted helix, as in the fit. What a
    hit says of the others is e/(1 - H) with the residual e and the diagonal H of the hat matrix.
    """
    rows = slice(hits.hit_offsets[track], hits.hit_offsets[track + 1])
    fields = {f.name: getattr(hits, f.name)[rows] for f in dataclasses.fields(hits) if f.name != "hit_offsets"}
    helix = np.array([result.tracks[name][track] for name in PARAMETERS])
    core = compiled(result.detector, screening="wentzel")
    reference = _core.reference(core, helix, result.particles["mass"][track], fields)
    n, noise = len(fields["kind"]), reference["noise"]
    assert reference["reached"] == n
    seen = reference["rows"] @ noise.T
    seen[np.arange(len(noise)) >= order_of_matter(result.detector, fields, len(noise))[:, None]] = 0
    if forget_matter:
        seen[:] = 0
    measured = np.where(fields["kind"] == 2, fields["value"] * fields["side"], fields["value"])
    # The weak prior is that of the track behind all matter, helix plus the sum of the noise: 1000 times the covariance
    # of the iteration before where that is narrower than the widths in the settings.
    widths, before = np.array(SETTINGS.fit.prior_sigma), 1000 * result.tracks["cov"][track]
    covariance = before if np.all(np.diag(before) < widths**2) else np.diag(widths**2)
    prior = np.linalg.inv(np.linalg.cholesky(covariance))
    jacobian = np.block([
        [reference["rows"] / fields["sigma"][:, None], seen / fields["sigma"][:, None]],
        [np.zeros((len(noise), 5)), np.eye(len(noise))],
        [prior, prior @ noise.T],
    ])  # fmt: skip
    white = np.concatenate([(measured - reference["predicted"]) / fields["sigma"], np.zeros(len(noise) + 5)])
    units = 1 / np.linalg.norm(jacobian, axis=0)
    q, r = np.linalg.qr(jacobian * units)
    estimate = units * np.linalg.solve(r, q.T @ white)
    inverse = units[:, None] * np.linalg.inv(r)
    left = white - jacobian @ estimate
    without = 1 - np.sum(q[:n] ** 2, axis=1)
    sigma = fields["sigma"]
    return (
        estimate[:5], (inverse @ inverse.T)[:5, :5], float(left @ left), sigma * left[:n] / without,
        sigma / np.sqrt(without), len(estimate),
    )  # fmt: skip


@pytest.mark.parametrize("name", PRESETS)
def test_filter_and_smoother_are_the_global_fit(name: str) -> None:
    """State, covariance, chi-square and the residual of every hit agree to a millionth of a standard deviation."""
    result, hits = sample(name)
    tracks, residuals = result.tracks, result.residuals
    for track in range(N):
        estimate, covariance, chi2, residual, error, unknowns = everything_at_once(result, hits, track)
        assert unknowns > 60
        sigma = np.sqrt(np.diag(tracks["cov"][track]))
        assert np.all(np.abs(estimate) < 1e-6 * sigma)
        np.testing.assert_allclose(
            tracks["cov"][track] / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-6
        )
        assert tracks["chi2"][track] == pytest.approx(chi2, rel=1e-6)
        of_track = residuals["track"] == track
        np.testing.assert_allclose(residuals["residual"][of_track] / error, residual / error, atol=1e-6)
        np.testing.assert_allclose(residuals["err"][of_track], error, rtol=1e-6)


def test_gate_sees_missing_matter() -> None:
    """Without the angles and losses among its unknowns the global fit is another one."""
    result, hits = sample(PRESETS[0])
    estimate, covariance, chi2, residual, error, _ = everything_at_once(result, hits, 0, forget_matter=True)
    sigma = np.sqrt(np.diag(result.tracks["cov"][0]))
    assert np.any(np.abs(estimate) > 0.01 * sigma)
    assert covariance[0, 0] < 0.9 * sigma[0] ** 2
    assert chi2 > 1.001 * result.tracks["chi2"][0]
    assert np.any(np.abs(residual - result.residuals["residual"][result.residuals["track"] == 0]) > 0.01 * error)
