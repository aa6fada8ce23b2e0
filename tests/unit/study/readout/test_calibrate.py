"""Typical errors of clusters by layer and angle, from samples and in covariances without events."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt
import pytest

import cgemit as cg
from cgemit import isa
from cgemit.analysis.widths import measure
from cgemit.reconstruction.candidates import HIT_WIRE
from cgemit.reconstruction.cluster import calibrated_clusterer, clusterer_of
from cgemit.reconstruction.cluster_errors import COS_THETA, ESTIMATORS, calibration_of, neutral
from cgemit.reconstruction.clusterers.gaussian import GaussianClusterer
from cgemit.study.readout import calibrate
from cgemit.study.readout.calibrate import (
    Measurements,
    Tracks,
    _muons,
    measurements,
    nearest_cos_theta,
    rest_of_tracks,
    set_correlations,
    set_typical,
    tracks_of,
    true_directions,
    variance_at_origin,
)
from cgemit.study.readout.scan import beam_detector
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

RADII = np.array([80.0, 120.0, 160.0])
TRACK = ("besiii-cgem-design", "mu-", 1.0)
ANGLES = np.array([-0.97, -0.9, -0.8, -0.3, 0.0, 0.07, 0.45, 0.6, 0.85, 0.93])


def line_rest() -> Floats:
    """Return the covariance of hardly known straight lines at radius 0 and in the layers, (4, 4) mm2."""
    radii = np.append(0.0, RADII)
    return 100.0 + 0.01 * np.outer(radii, radii) + 1e-6 * np.eye(4)


REST = np.broadcast_to(line_rest(), (2, 17, 4, 4))


def typical_of(
    residual: Floats,
    error: Floats,
    cos_theta: Floats | float = 0.0,
    crossed: npt.NDArray[np.bool_] | None = None,
    rest: Floats | None = None,
) -> Floats:
    """Return the typical errors of X clusters of tracks, (tracks, 3) each; NaN: no cluster."""
    n = len(residual)
    layer, event = np.tile(np.arange(3), n), np.repeat(np.arange(n), 3)
    there = np.isfinite(residual.ravel())
    flat = np.zeros(np.count_nonzero(there), np.int64)
    sample = Measurements(
        residual.ravel()[there], error.ravel()[there], flat.astype(float), flat, flat.astype(float), flat, layer[there],
        np.arange(len(flat)), flat,
    )  # fmt: skip
    found = neutral(3)
    whole = np.ones((n, 3), np.bool_) if crossed is None else crossed
    set_typical(
        found, 0, 0, sample, Tracks(np.broadcast_to(cos_theta, n), event[there], whole), REST if rest is None else rest
    )
    assert (found.typical_errors[0, 0, 1] == 1).all()  # no V clusters
    assert (found.typical_errors[1] == 1).all()
    errors: Floats = found.typical_errors[0, 0, 0]
    return errors


def test_of_samples() -> None:
    """Of equal Gaussian clusters they are their errors; tails add to them, known errors that differ take away."""
    random = np.random.default_rng(1)
    unit = random.normal(size=(40_000, 3))
    error = np.broadcast_to([0.1, 0.2, 0.15], unit.shape)
    np.testing.assert_allclose(typical_of(unit * error, error), np.tile(error[0], (17, 1)).T, rtol=0.02)
    tails = unit * np.where(random.random(unit.shape) < 0.05, 3.5, 1)
    core = measure(tails[:, 0]).core
    assert (typical_of(tails * error, error) > 1.02 * core * error[0][:, None]).all()
    differ = np.where(random.random(unit.shape) < 0.5, 0.1, 0.2)
    known, unknown = (typical_of(unit * differ, one) for one in (differ, np.full(unit.shape, 0.15)))
    assert (known < 0.97 * unknown).all()


def test_clusters_that_are_left_out_count() -> None:
    """Tracks without a cluster of a layer know less; so do those with one beyond five errors."""
    random = np.random.default_rng(2)
    residual = 0.1 * random.normal(size=(40_000, 3))
    error = np.full(residual.shape, 0.1)
    inner = np.arange(3) == 0
    none = np.where((random.random(len(residual)) < 0.3)[:, None] & inner, np.nan, residual)
    assert (typical_of(none, error) > 1.05 * typical_of(residual, error)).all()
    rare = (random.random(len(residual)) < 0.03)[:, None] & inner
    far = np.where(rare, random.uniform(3, 8, residual.shape), residual)
    expected = typical_of(np.where(rare, np.nan, residual), error)
    np.testing.assert_allclose(typical_of(far, error), expected, rtol=0.02)


def test_by_angle() -> None:
    """Each range of cos(theta) has its own errors, not symmetric; one with few tracks has those between others."""
    random = np.random.default_rng(3)
    cos_theta = random.uniform(-0.93, 0.93, 100_000)
    near = nearest_cos_theta(cos_theta)
    np.testing.assert_array_equal(near, np.abs(cos_theta[:, None] - COS_THETA).argmin(axis=1))
    true = 0.1 + 0.05 * np.arange(17) / 16
    error = np.repeat(true[near][:, None], 3, axis=1)
    residual = error * random.normal(size=error.shape)
    np.testing.assert_allclose(typical_of(residual, error, cos_theta), np.tile(true, (3, 1)), rtol=0.05)
    few = near != 4
    few[np.flatnonzero(~few)[:150]] = True
    found = typical_of(residual[few], error[few], cos_theta[few])
    between = np.interp(COS_THETA[4], COS_THETA[[3, 5]], [0.0, 1.0])
    np.testing.assert_allclose(found[:, 4], found[:, 3] + between * (found[:, 5] - found[:, 3]), rtol=1e-12)


def test_layers_that_end() -> None:
    """Beyond the end of a layer the others keep their factor, and its own errors are those of the last range."""
    random = np.random.default_rng(6)
    cos_theta = random.uniform(-0.93, 0.93, 100_000)
    short = np.abs(cos_theta) < 0.7  # within the range of 0.69
    residual = 0.1 * random.normal(size=(len(cos_theta), 3))
    residual *= np.where(random.random(residual.shape) < 0.05, 3.5, 1)  # factors above 1
    error = np.full(residual.shape, 0.1)
    crossed = np.column_stack([np.ones((len(short), 2), np.bool_), short])
    there = np.where(crossed, residual, np.nan)
    found, whole = typical_of(there, error, cos_theta, crossed), typical_of(residual, error, cos_theta)
    inside = np.abs(COS_THETA) < 0.65
    np.testing.assert_array_equal(found[:, inside], whole[:, inside])
    np.testing.assert_allclose(found[:2], whole[:2], rtol=0.05)
    np.testing.assert_allclose(found[2, -3:], found[2, -4], rtol=1e-12)
    counted = typical_of(there, error, cos_theta)  # as if they had lost their clusters
    edge = np.flatnonzero(COS_THETA == 0.69)[0]
    assert (counted[:, edge] > 1.1 * found[:, edge]).all()


def test_correlations_by_angle() -> None:
    random = np.random.default_rng(4)
    n = 60_000
    cos_theta = random.uniform(-0.93, 0.93, n)
    rho = np.linspace(-0.5, 0.7, 17)
    mine = rho[nearest_cos_theta(cos_theta)]
    x, other = random.standard_normal((2, n))
    residual = np.concatenate([x, mine * x + np.sqrt(1 - mine**2) * other])
    flat, truth = np.zeros(2 * n, np.int64), np.tile(np.arange(n), 2)
    view = np.repeat([0, 1], n)
    sample = Measurements(residual, np.ones(2 * n), flat.astype(float), flat, np.ones(2 * n), view, flat, truth, flat)
    found = neutral(1)
    set_correlations(found, 1, 2, sample, Tracks(cos_theta, np.arange(n), np.ones((n, 1), np.bool_)))
    np.testing.assert_allclose(found.correlations[1, 2, 0], rho, atol=0.06)
    assert not found.correlations[0].any()


@pytest.mark.parametrize("name", ["besiii-cgem-design", "kloe2-like"])
def test_rest_of_tracks_gives_covariances(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the errors of all clusters it has the variances of the covariance without events."""
    detector = cg.load(name)
    layers = len(detector.cgem)
    x, v = 0.05 + 0.03 * np.arange(layers), 0.25 - 0.04 * np.arange(layers)
    rest = rest_of_tracks(detector, 0.7, np.array([x, v]))
    monkeypatch.setattr(GaussianClusterer, "expected_errors", lambda *_: (x, v))
    expected = cg.analytic(detector, "mu-", 0.7, COS_THETA, phi=0.3, readout="gaussian")
    for view, (errors, sigma) in enumerate([(x, expected.sigma_dr / 1000), (v, expected.sigma_dz)]):
        found = [variance_at_origin(one, errors[None])[0] for one in rest[view]]
        np.testing.assert_allclose(np.sqrt(found), np.ravel(sigma), rtol=1e-6)


def test_tracks_of_clusters_alone_have_no_rest() -> None:
    """A track needs hits beside the clusters of one view; without, typical errors are core widths."""
    assert np.isnan(rest_of_tracks(beam_detector(1.0), 1.0, np.full((2, 1), 0.1))).all()
    random = np.random.default_rng(7)
    residual = random.normal(size=(9000, 3)) * [0.1, 0.2, 0.15]
    found = typical_of(residual, np.full(residual.shape, 0.3), rest=np.full(REST.shape, np.nan))
    cores = np.array([measure(one).core for one in residual.T])
    np.testing.assert_allclose(found, np.repeat(cores[:, None], 17, axis=1), rtol=1e-12)


def fit_one(rest: Floats, place: Floats, error: Floats, used: list[int]) -> tuple[float, Floats, Floats]:
    """Return what some clusters tell: the place at the origin, those in all layers and their variances."""
    at = [1 + one for one in used]
    gain = rest[:, at] @ np.linalg.inv(rest[np.ix_(at, at)] + np.diag(error[used] ** 2))
    fitted, variance = gain @ place[used], np.diag(rest - gain @ rest[at])
    return float(fitted[0]), fitted[1:], variance[1:]


def test_misses_are_those_of_tracks_fitted_one_by_one() -> None:
    """Each cluster against a fit without it; the farthest is left out until none is far."""
    random = np.random.default_rng(8)
    rest = rest_of_tracks(cg.load(TRACK[0]), 1.0, np.full((2, 3), 0.1))[1, 4]
    n, lost = 200, 0
    error = random.uniform(0.03, 0.2, (n, 3))
    residual = error * random.standard_t(1.5, size=(n, 3))
    residual[random.random((n, 3)) < 0.1] = np.nan
    found = calibrate.misses(residual, error, rest)
    states = calibrate.drawn(rest, len(found))
    for number, (miss, state) in enumerate(zip(found, states, strict=True)):
        own, errors = residual[number % n], error[number % n]
        place, used = state[1:] + np.nan_to_num(own), list(np.flatnonzero(np.isfinite(own)))
        while used:
            pulls = []
            for one in used:
                _, fitted, variance = fit_one(rest, place, errors, [other for other in used if other != one])
                pulls.append(abs(place[one] - fitted[one]) / np.sqrt(variance[one] + errors[one] ** 2))
            if max(pulls) <= 5:
                break
            del used[int(np.argmax(pulls))]
            lost += 1
        assert miss == pytest.approx(fit_one(rest, place, errors, used)[0] - state[0], abs=1e-6)
    assert 20 < lost < len(found)


@pytest.mark.parametrize("name", ["besiii-cgem-design", "kloe2-like"])
def test_misses_of_equal_gaussian_clusters(name: str) -> None:
    detector = cg.load(name)
    errors = np.array([0.1, 0.2, 0.05, 0.15])[: len(detector.cgem)]
    rest = rest_of_tracks(detector, 1.0, np.full((2, len(errors)), 0.1))
    random = np.random.default_rng(9)
    for one in (*rest[0][::4], *rest[1][::4]):
        found = calibrate.misses(errors * random.normal(size=(20_000, len(errors))), np.tile(errors, (20_000, 1)), one)
        assert found.std() == pytest.approx(np.sqrt(variance_at_origin(one, errors[None])[0]), rel=0.02)


@pytest.fixture
def angular(monkeypatch: pytest.MonkeyPatch) -> dict[str, Floats]:
    """Make the Gaussian read-out's errors and correlations depend on the angle; return them."""
    random = np.random.default_rng(5)
    x, v = random.uniform(0.08, 0.3, (2, 3, 17))
    given = {"x": x, "v": v, "xv": random.uniform(-0.6, 0.6, (3, 17))}
    monkeypatch.setattr(GaussianClusterer, "expected_errors", lambda *_: (given["x"], given["v"]))
    monkeypatch.setattr(GaussianClusterer, "expected_correlations", lambda *_: given["xv"])
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
        monkeypatch.setattr(GaussianClusterer, "expected_errors", lambda *_, one=one: (one["x"], one["v"]))
        monkeypatch.setattr(GaussianClusterer, "expected_correlations", lambda *_, one=one: one["xv"])
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
    clusterer = GaussianClusterer(cg.GaussianReadout())
    given = dict(zip("xv", clusterer.expected_errors(cg.load(TRACK[0])), strict=True))
    given["xv"] = clusterer.expected_correlations(cg.load(TRACK[0]))

    def derivatives() -> Floats:
        found = cg.sensitivity(*TRACK, 0.5, readout="gaussian", keys=["cgem.L1.anode_radius"], quantities=["dr", "dz"])
        return np.asarray(found.values, np.float64).ravel()

    found, one = derivatives(), at(given, 0.5)
    monkeypatch.setattr(GaussianClusterer, "expected_errors", lambda *_: (one["x"], one["v"]))
    monkeypatch.setattr(GaussianClusterer, "expected_correlations", lambda *_: one["xv"])
    np.testing.assert_allclose(found, derivatives(), rtol=1e-6)
    assert np.abs(found).max() > 0


def test_particles_of_one_event_have_one_track() -> None:
    result = cg.run(TRACK[0], cg.Gun("mu-", p=1.0, cos_theta=0.2), 3, until="simulate")
    particles = result.particles
    columns = {name: np.repeat(particles[name], 2) for name in particles.columns}
    with pytest.raises(ValueError, match="events with several particles"):
        tracks_of(Table("particles", columns, 3), result.truths, 3)


@pytest.mark.parametrize("rho", [1.0, -1.2, np.nan])
def test_impossible_correlations(rho: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GaussianClusterer, "expected_correlations", lambda *_: np.full(3, rho))
    with pytest.raises(ValueError, match="read-out gaussian: correlations: expected numbers between -1 and 1"):
        cg.analytic(*TRACK, 0.2, readout="gaussian")


def test_a_correlation_needs_both_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where only V has a given error, it has no part of X."""
    monkeypatch.setattr(GaussianClusterer, "expected_errors", lambda *_: (np.zeros(3), np.full(3, 0.1)))
    expected = cg.analytic(*TRACK, 0.2, readout="gaussian").cov
    monkeypatch.setattr(GaussianClusterer, "expected_correlations", lambda *_: np.full(3, 0.5))
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
    monkeypatch.setattr(GaussianClusterer, "expected_errors", lambda *_: (np.full(3, 0.1), errors))
    with pytest.raises(ValueError, match=f"read-out gaussian: {message}"):
        cg.analytic(*TRACK, 0.2, readout="gaussian")


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
    clusters, hits = result.fitted_hits[0], result.candidate_hits
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
