"""XV points with correlated errors: two scalars, one of them decorrelated, are the measurement of two at once."""

from __future__ import annotations

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.reconstruction.candidates import HIT_WIRE, HIT_XV, collect_hits
from cgemit.reconstruction.fit import PARAMETERS, FitSettings, core_arguments, fit
from cgemit.tables import Table
from exact import EXACT
from tracks import order_of_matter, true_views

DETECTOR = cg.load("besiii-cgem-design")
FIT = FitSettings(residuals=True, states=("origin",), tolerance=1e-9, max_iterations=40, outlier_pull=0, kinks=False)
ERR_X, ERR_V, RHO = 0.2, 0.3, 0.8


@pytest.fixture(scope="module")
def points():
    """Return a run of muons, and clusters whose XV rows have correlated errors, as which they are smeared."""
    gun = cg.Gun("mu-", p=(0.6, 1.5), cos_theta=(-0.7, 0.7))
    result = cg.run(DETECTOR, gun, 60, seed=6, settings=EXACT)
    clusters, random = result.clusters, np.random.default_rng(1)
    n = len(clusters)
    a, b = random.standard_normal((2, n))
    xv = clusters["view"] == 2
    truth = clusters["truth"]
    x, v = true_views(
        DETECTOR, clusters["layer"], clusters["sheet"], result.truths["phi"][truth], result.truths["z"][truth]
    )
    smeared = clusters.with_columns(
        x=np.where(xv, x + ERR_X * a, clusters["x"]),
        v=np.where(xv, v + ERR_V * (RHO * a + np.sqrt(1 - RHO**2) * b), clusters["v"]),
        err_x=np.where(xv, ERR_X, clusters["err_x"]),
        err_v=np.where(xv, ERR_V, clusters["err_v"]),
        cov_xv=np.where(xv, RHO * ERR_X * ERR_V, 0.0),
    )
    hits = result.candidate_hits
    on_wire = hits["view"] == HIT_WIRE
    rows = np.flatnonzero(xv)
    event = np.concatenate([hits["event"][on_wire], clusters["event"][rows]])
    order = np.argsort(event, kind="stable")
    columns = {
        "event": event,
        "candidate": np.concatenate([hits["candidate"][on_wire], clusters["event"][rows]]),
        "view": np.concatenate([hits["view"][on_wire], np.full(len(rows), HIT_XV)]),
        "row": np.concatenate([hits["row"][on_wire], rows]),
    }
    found = Table("candidate_hits", {name: column[order] for name, column in columns.items()}, 60)
    return result, smeared, found


def test_points_are_fitted_as_the_information_filter_does(points):
    """Information form with the full 2x2 covariance of each point, about the fitted helix: it is the optimum.

    The matter is that of the fit: noise vectors in the coordinates of the origin, which every measurement beyond sees.
    """
    result, clusters, found = points
    hits = collect_hits(DETECTOR, result.candidates, found, clusters, result.wire_hits)
    arguments = core_arguments(DETECTOR, hits, result.particles["mass"], np.empty((0, 5)), FIT)
    fitted = _core.fit(**arguments)
    assert np.all(fitted["status"] == 0)
    assert np.mean(fitted["n_clusters"] == 6) > 0.95
    wrong = []
    for track in range(20):
        rows = slice(*hits.hit_offsets[track : track + 2])
        mine = {name: column[rows] for name, column in hits.columns().items()}
        helix, prior = fitted["helix"][track], fitted["prior"][track].reshape(5, 5)
        given = (arguments["detector"], helix, result.particles["mass"][track], mine, prior)
        move, cov = information(*given, RHO)
        sigma = np.sqrt(np.diag(fitted["cov"][track]))
        assert np.all(np.abs(move) < 2e-5 * sigma)
        unit = np.outer(sigma, sigma)
        np.testing.assert_allclose(cov / unit, fitted["cov"][track] / unit, atol=2e-6)
        uncorrelated = information(*given, 0.0)[0]
        wrong.append(np.abs(uncorrelated / sigma).max())
    assert np.median(wrong) > 0.1, "without the correlation it is another one"


def information(core, helix, mass, mine, prior, rho):
    """Return how far the least-squares estimate is from a helix, and its covariance, from X and V as they are.

    The weak prior is a measurement of the helix behind all matter.
    """
    plain = dict(mine)
    strips = np.flatnonzero(mine["kind"] != 2)
    v = strips[mine["kind"][strips] == 1]
    plain["value"] = mine["value"] + mine["k"] * mine["x"]  # V as measured
    plain["sigma"] = np.where(np.isin(np.arange(len(mine["kind"])), v), ERR_V, mine["sigma"])
    plain["k"], plain["x"] = np.zeros_like(mine["k"]), np.zeros_like(mine["x"])
    reference = _core._testing.reference(core, helix, mass, plain)
    h, g = reference["rows"], reference["noise"]
    measured = np.where(plain["kind"] == 2, plain["value"] * plain["side"], plain["value"])
    n = len(h)
    covariance = np.zeros((n + 5, n + 5))
    covariance[:n, :n], covariance[n:, n:] = np.diag(plain["sigma"] ** 2), prior
    for i in v:
        covariance[i, i - 1] = covariance[i - 1, i] = rho * ERR_X * ERR_V
    seen = h @ g.T
    seen[np.arange(len(g)) >= order_of_matter(DETECTOR, mine, len(g))[:, None]] = 0
    seen, h = np.concatenate([seen, g.T]), np.concatenate([h, np.eye(5)])
    weight = np.linalg.inv(covariance + seen @ seen.T)
    cov = np.linalg.inv(h.T @ weight @ h)
    residual = np.append(measured - reference["predicted"], np.zeros(5))
    return cov @ h.T @ weight @ residual, cov


def test_decorrelated_columns(points):
    """X as it is, and V - k X with k the covariance over the variance of X; independent of one another."""
    result, clusters, found = points
    hits = collect_hits(DETECTOR, result.candidates, found, clusters, result.wire_hits)
    x, v = (np.flatnonzero(hits.kind == kind) for kind in (0, 1))
    np.testing.assert_array_equal(v, x + 1)
    k = RHO * ERR_V / ERR_X
    np.testing.assert_allclose(hits.k[v], k)
    np.testing.assert_array_equal(hits.x[v], hits.value[x])
    np.testing.assert_allclose(hits.value[v], clusters["v"][hits.row[v]] - k * clusters["x"][hits.row[x]])
    np.testing.assert_allclose(hits.sigma[v], ERR_V * np.sqrt(1 - RHO**2))


def test_pulls_of_points_are_standard_normal(points):
    """Residuals of both scalars against the track fitted without them."""
    result, clusters, found = points
    residuals = fit(DETECTOR, clusters, result.wire_hits, result.candidates, found, FIT)["residuals"]
    for view in (0, 1):
        pull = residuals["pull"][residuals["view"] == view]
        assert abs(pull.std() - 1) < 4 / np.sqrt(2 * len(pull))
        assert abs(pull.mean()) < 4 / np.sqrt(len(pull))


def test_points_without_correlation_are_x_and_v(points):
    """The joined rows of a read-out are the same as their X and V clusters."""
    result, _, found = points
    fits = [
        fit(DETECTOR, result.clusters, result.wire_hits, result.candidates, hits, FIT)["tracks"]
        for hits in (found, result.candidate_hits)
    ]
    for name in PARAMETERS:
        np.testing.assert_array_equal(fits[0][name], fits[1][name])


def test_impossible_correlations_are_refused(points):
    """The covariance is below the product of the errors."""
    result, clusters, found = points
    row = np.flatnonzero(clusters["view"] == 2)[5]
    cov = clusters["cov_xv"].copy()
    cov[row] = 0.07
    with pytest.raises(ValueError, match=rf"clusters row {row}: cov_xv: got 0\.07, expected less in size"):
        fit(DETECTOR, clusters.with_columns(cov_xv=cov), result.wire_hits, result.candidates, found)
