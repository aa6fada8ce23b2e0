"""Errors and correlations of clusters by polar angle in covariances without events."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

import cgemit as cg
from cgemit import isa
from cgemit.reconstruction.cluster import clusterer_of
from cgemit.reconstruction.cluster_errors import COS_THETA, expected_errors
from cgemit.tables.schema import HIT_WIRE
from clusterers import expect

Floats = npt.NDArray[np.float64]

DESIGN = cg.load("besiii-cgem-design")
TRACK = ("besiii-cgem-design", "mu-", 1.0)
ANGLES = np.array([-0.97, -0.9, -0.8, -0.3, 0.0, 0.07, 0.45, 0.6, 0.85, 0.93])


@pytest.fixture
def angular(monkeypatch: pytest.MonkeyPatch) -> dict[str, Floats]:
    """Make the Gaussian readout's errors and correlations depend on the angle; return them."""
    random = np.random.default_rng(5)
    x, v = random.uniform(0.08, 0.3, (2, 3, 17))
    given = {"x": x, "v": v, "xv": random.uniform(-0.6, 0.6, (3, 17))}
    expect(monkeypatch, cg.GaussianReadout, (given["x"], given["v"]), given["xv"])
    return given


def at(given: dict[str, Floats], cos_theta: float) -> dict[str, Floats]:
    return {name: np.array([np.interp(cos_theta, COS_THETA, one) for one in rows]) for name, rows in given.items()}


@pytest.mark.parametrize(
    "where", [{"phi": 0.3}, {"phi": 0.3, "radius": 121.0}, {}, {"samples": 16}], ids=["phi", "radius", "all", "samples"]
)
def test_covariance_takes_the_errors_of_the_angle(
    where: dict[str, float], angular: dict[str, Floats], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At every angle of one call it is the covariance with the errors of that angle for all tracks."""
    how = {"readout": "gaussian", **where}
    found = cg.analytic(*TRACK, ANGLES, **how).cov
    ends = cg.analytic(*TRACK, ANGLES[[0, -1]], **how).cov
    for number, cos_theta in enumerate(ANGLES):
        one = at(angular, cos_theta)
        expect(monkeypatch, cg.GaussianReadout, (one["x"], one["v"]), one["xv"])
        expected = cg.analytic(*TRACK, cos_theta, **how).cov
        scale = np.sqrt(np.diagonal(np.squeeze(expected)))
        np.testing.assert_allclose(
            np.squeeze(found[number]) / np.outer(scale, scale), np.squeeze(expected) / np.outer(scale, scale), atol=1e-9
        )
    np.testing.assert_allclose(np.squeeze(ends), np.squeeze(found)[[0, -1]], rtol=1e-12)


@pytest.mark.usefixtures("angular")
def test_scalar_code_takes_the_errors_of_the_angle() -> None:
    found, before = {}, isa.name()
    for name in isa.available():
        isa.use(name)
        try:
            found[name] = cg.analytic(*TRACK, ANGLES, readout="gaussian", phi=0.3)
        finally:
            isa.use(before)
    for other in found.values():
        for quantity in ("dr", "dz", "p"):
            np.testing.assert_allclose(other.sigma(quantity), found["scalar"].sigma(quantity), rtol=1e-8)


@pytest.mark.usefixtures("angular")
def test_budget_adds_up() -> None:
    found = cg.analytic(*TRACK, ANGLES, phi=0.3, readout="gaussian")
    np.testing.assert_allclose(found.budget("dz").total, found.sigma_dz**2, rtol=1e-10)


@pytest.mark.usefixtures("angular")
def test_variants_take_the_errors_of_the_angle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Derivatives, for which hits are kept, are those with the errors of the angle for all tracks."""
    (group,) = cg.load(TRACK[0]).with_readout("gaussian").groups
    clusterer = clusterer_of(group.readout)
    given = dict(zip("xv", clusterer.expected_errors(group), strict=True))
    given["xv"] = clusterer.expected_correlations(group)

    def derivatives() -> Floats:
        found = cg.sensitivity(*TRACK, 0.5, readout="gaussian", keys=["cgem.L1.anode_radius"], quantities=["dr", "dz"])
        return np.asarray(found.values, np.float64).ravel()

    found, one = derivatives(), at(given, 0.5)
    expect(monkeypatch, cg.GaussianReadout, (one["x"], one["v"]), one["xv"])
    np.testing.assert_allclose(found, derivatives(), rtol=1e-6)
    assert np.abs(found).max() > 0


@pytest.mark.parametrize("rho", [1.0, -1.2, np.nan])
def test_impossible_correlations(rho: float, monkeypatch: pytest.MonkeyPatch) -> None:
    expect(monkeypatch, cg.GaussianReadout, correlations=np.full(3, rho))
    with pytest.raises(ValueError, match="readout gaussian: correlations: expected numbers between -1 and 1"):
        cg.analytic(*TRACK, 0.2, readout="gaussian")


def test_a_correlation_needs_both_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where only V has a given error, it has no part of X."""
    expect(monkeypatch, cg.GaussianReadout, (np.zeros(3), np.full(3, 0.1)))
    expected = cg.analytic(*TRACK, 0.2, readout="gaussian").cov
    expect(monkeypatch, cg.GaussianReadout, correlations=np.full(3, 0.5))
    np.testing.assert_array_equal(cg.analytic(*TRACK, 0.2, readout="gaussian").cov, expected)


@pytest.mark.parametrize(
    ("errors", "message"),
    [
        (np.full((3, 5), 0.1), r"sigma_v: got shape \(3, 5\), expected \(3,\) or \(3, 17\)"),
        (np.full(2, 0.1), r"sigma_v: got shape \(2,\), expected"),
        (np.array([0.1, -0.1, 0.1]), "sigma_v: expected errors above 0, or 0 for all of a layer"),
        (np.array([0.1, np.nan, 0.1]), "sigma_v: expected errors above 0"),
        (np.array([0.1, np.inf, 0.1]), "sigma_v: expected errors above 0"),
        (np.repeat([[0.1], [0.1], [0.1]], 17, axis=1) * (np.arange(17) > 3), "sigma_v: expected errors above 0"),
    ],
)
def test_impossible_errors(errors: Floats, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expect(monkeypatch, cg.GaussianReadout, (np.full(3, 0.1), errors))
    with pytest.raises(ValueError, match=f"readout gaussian: {message}"):
        cg.analytic(*TRACK, 0.2, readout="gaussian")


@pytest.mark.parametrize("second_pass", [False, True])
def test_clusters_of_a_chip_have_its_correlation(second_pass: bool) -> None:
    """Of the mean over cos(theta), with the angle of the track for clusters on one."""
    readout = cg.TigerReadout(second_pass=second_pass)
    result = cg.run(DESIGN, cg.Gun("mu-", p=1.0, cos_theta=0.3), 20, readout=readout)
    clusters, hits = result.fitted_hits[0], result.candidate_hits
    used = np.zeros(len(clusters), np.bool_)
    used[hits["hit"][hits["view"] < HIT_WIRE]] = True
    by_angle = [expected_errors(DESIGN, readout, "merged", of_track).correlation for of_track in (False, True)]
    angles = np.linspace(COS_THETA[0], COS_THETA[-1], 20_001)
    alone, tracked = (
        np.array([np.interp(angles, COS_THETA, layer).mean() for layer in of_pass]) for of_pass in by_angle
    )
    np.testing.assert_allclose(clusters["corr_xv"][~used], alone[clusters["layer"][~used]], atol=1e-5)
    expected = tracked if second_pass else alone
    np.testing.assert_allclose(clusters["corr_xv"][used], expected[clusters["layer"][used]], atol=1e-5)
    (group,) = DESIGN.with_readout(readout).groups
    np.testing.assert_array_equal(clusterer_of(readout).expected_correlations(group), by_angle[int(second_pass)])
    assert (expected > 0.02).all()
