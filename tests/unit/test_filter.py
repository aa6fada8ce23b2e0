"""The Kalman filter and its smoother equal a global least-squares fit with the full covariance of the scatterers."""

import math
from functools import cache

import numpy as np
import pytest

from cgemit import _core
from cgemit.detector import compiled, load
from cgemit.reconstruction.fit import FitSettings
from tracks import MUON, hits_of, on_helix, order_of_matter, transport

PRIOR = np.array(FitSettings().prior_sigma)
# dr mm, phi0, kappa (GeV/c)^-1, dz mm, tanl
HELICES = {
    "1 GeV/c": (0.1, 0.7, -1.0, 3.0, 0.1),
    "0.3 GeV/c": (-0.4, -2.0, 1 / 0.3, -6.0, 0.6),
    "0.18 GeV/c": (0.2, 2.9, -1 / 0.18, 10.0, -0.3),
    "displaced": (20.0, 1.5, 1 / 0.8, 15.0, 0.3),
}
every_track = pytest.mark.parametrize(
    ("name", "which"), [(name, which) for name in ("besiii-cgem-design", "besiii-idc") for which in HELICES]
)


def settings(**changes):
    """Return settings that iterate until nothing moves."""
    values = {
        "max_iterations": 50,
        "tolerance": 1e-7,
        "errors_from_track": False,
        "least_width": 0.1,
        "delta_strips": 0.0,
        "kinks": False,
        "outlier_pull": 0.0,
    }
    return values | {"prior_sigma": tuple(PRIOR)} | changes


def settled(core, hits, helix):
    """Fit one track until nothing moves, one iteration at a time, so that the prior is the one in the settings."""
    for _ in range(12):
        out = fitted(core, hits, helix, settings(max_iterations=1, tolerance=1e-4))
        helix = out["helix"][0]
    return out


def fitted(core, hits, start, which_settings):
    """Fit one track."""
    return _core.fit(
        core, hit_offsets=np.array([0, len(hits["kind"])]), hits=hits, mass=np.array([MUON]),
        start=np.atleast_2d(start), settings=which_settings, residuals=True,
    )  # fmt: skip


@cache
def smeared_track(name, which, seed=3):
    """Return detector, core, true helix and smeared hits of a scattered track."""
    detector = load(name)
    core, helix = compiled(detector), np.array(HELICES[which])
    hits = hits_of(detector, transport(core, on_helix(helix), "gaussian", seed))
    rng = np.random.default_rng(seed)
    noise = hits["sigma"] * rng.normal(size=len(hits["kind"]))
    hits["value"] = hits["value"] + np.where(hits["side"] < 0, -noise, noise)
    return detector, core, helix, hits


def linear_model(detector, core, helix, hits, prior=PRIOR):
    """Return residuals, rows and covariance of all measurements on a reference, the prior's five included.

    A noise vector changes what a measurement beyond it sees by row . vector, so two measurements share the noise of
    all matter inside both. The prior describes the track beyond all matter.
    """
    reference = _core._testing.reference(core, helix, MUON, hits)
    n = len(hits["kind"])
    assert reference["reached"] == n
    inside = order_of_matter(detector, hits, len(reference["noise"]))
    seen = reference["rows"] @ reference["noise"].T
    seen[np.arange(len(reference["noise"])) >= inside[:, None]] = 0
    seen = np.concatenate([seen, reference["noise"].T])
    covariance = seen @ seen.T + np.diag(np.concatenate([hits["sigma"] ** 2, prior**2]))
    measured = np.where(hits["kind"] == 2, hits["value"] * hits["side"], hits["value"])
    residual = np.concatenate([measured - reference["predicted"], np.zeros(5)])
    return residual, np.concatenate([reference["rows"], np.eye(5)]), covariance


def least_squares(residual, rows, covariance):
    """Return estimate, covariance and chi-square of generalised least squares."""
    factor = np.linalg.cholesky(covariance)
    white_rows, white = np.linalg.solve(factor, rows), np.linalg.solve(factor, residual)
    estimate = np.linalg.lstsq(white_rows, white, rcond=None)[0]
    inverse = np.linalg.inv(np.linalg.qr(white_rows)[1])
    return estimate, inverse @ inverse.T, float(np.sum((white - white_rows @ estimate) ** 2))


@every_track
def test_filter_is_least_squares(name, which):
    """At the converged helix least squares moves nothing, and finds the filter's covariance and chi-square."""
    detector, core, helix, hits = smeared_track(name, which)
    out = settled(core, hits, helix)
    assert out["status"][0] == _core.FitStatus.ok
    sigma = np.sqrt(np.diag(out["cov"][0]))
    estimate, covariance, chi2 = least_squares(*linear_model(detector, core, out["helix"][0], hits))
    assert np.all(np.abs(estimate) < 1e-6 * sigma)
    np.testing.assert_allclose(out["cov"][0] / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-6)
    assert out["chi2"][0] == pytest.approx(chi2, rel=1e-6)
    assert out["ndf"][0] == len(hits["kind"]) - 5
    assert out["n_clusters"][0] == np.count_nonzero(hits["kind"] < 2)
    assert out["n_wires"][0] == np.count_nonzero(hits["kind"] == 2)


@every_track
def test_one_step_is_the_least_squares_step(name, which):
    """From a helix off by some standard deviations, one iteration moves to where least squares moves."""
    detector, core, helix, hits = smeared_track(name, which)
    sigma = np.sqrt(np.diag(fitted(core, hits, helix, settings())["cov"][0]))
    start = helix + sigma * [3, -2, 2, -3, 1]
    out = fitted(core, hits, start, settings(max_iterations=1))
    assert out["status"][0] == _core.FitStatus.not_converged
    estimate, _, _ = least_squares(*linear_model(detector, core, start, hits))
    np.testing.assert_allclose((out["helix"][0] - start) / sigma, estimate / sigma, atol=2e-6)


@every_track
def test_residuals_leave_the_hit_out(name, which):
    """Each residual and its error are those of the hit against the prediction from all others."""
    detector, core, helix, hits = smeared_track(name, which)
    out = settled(core, hits, helix)
    residual, rows, covariance = linear_model(detector, core, out["helix"][0], hits)
    n = len(hits["kind"])
    for i in range(n):
        others = np.arange(n + 5) != i
        estimate, of_estimate, _ = least_squares(residual[others], rows[others], covariance[np.ix_(others, others)])
        # The hit shares the noise of the matter with the others: best linear prediction of what is left.
        weights = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, i])
        seen = rows[i] - weights @ rows[others]
        predicted = rows[i] @ estimate + weights @ (residual[others] - rows[others] @ estimate)
        variance = covariance[i, i] - weights @ covariance[others, i] + seen @ of_estimate @ seen
        assert out["err"][i] == pytest.approx(math.sqrt(variance), rel=1e-6)
        assert out["residual"][i] == pytest.approx(residual[i] - predicted, abs=1e-6 * out["err"][i])
        assert out["side"][i] == (hits["side"][i] if hits["kind"][i] == 2 else 0)


@every_track
def test_residual_of_the_innermost_hit_is_that_of_a_refit(name, which):
    """Refitting without the innermost hit predicts it: no matter lies between it and the others' common noise."""
    _, core, helix, hits = smeared_track(name, which)
    out = fitted(core, hits, helix, settings())
    without = fitted(core, {k: v[1:] for k, v in hits.items()}, helix, settings())
    predicted = _core._testing.reference(core, without["helix"][0], MUON, hits)["predicted"][0]
    measured = hits["value"][0] * (hits["side"][0] if hits["kind"][0] == 2 else 1)
    # The two fits are linearised about different helices.
    assert measured - predicted == pytest.approx(out["residual"][0], abs=0.02 * out["err"][0])


@every_track
def test_prior_is_weak_and_counted_once(name, which):
    """Priors ten times as wide move nothing by more than 1e-3 standard deviations, and widen nothing by 1e-3."""
    _, core, helix, hits = smeared_track(name, which)
    narrow = fitted(core, hits, helix, settings())
    wide = fitted(core, hits, helix, settings(prior_sigma=tuple(10 * PRIOR)))
    sigma = np.sqrt(np.diag(narrow["cov"][0]))
    assert np.all(np.abs(wide["helix"][0] - narrow["helix"][0]) < 1e-3 * sigma)
    np.testing.assert_allclose(np.sqrt(np.diag(wide["cov"][0])), sigma, rtol=1e-3)


def test_gate_sees_a_seed_that_counts():
    """A prior as narrow as the fit itself, which counts the seed as a measurement, is seen by the test above."""
    _, core, helix, hits = smeared_track("besiii-cgem-design", "1 GeV/c")
    free = fitted(core, hits, helix, settings())
    sigma = np.sqrt(np.diag(free["cov"][0]))
    tied = fitted(core, hits, helix, settings(prior_sigma=tuple(sigma)))
    assert np.any(np.sqrt(np.diag(tied["cov"][0])) < 0.9 * sigma)


@every_track
def test_every_seed_leads_to_the_same_helix(name, which):
    """Starts scattered around the truth, and the start from the hits themselves, end at one helix."""
    _, core, helix, hits = smeared_track(name, which)
    best = fitted(core, hits, helix, settings())
    sigma = np.sqrt(np.diag(best["cov"][0]))
    rng = np.random.default_rng(8)
    smearing = np.array([2.0, 0.01, 0.04 * abs(helix[2]), 10.0, 0.02])
    starts = [helix + smearing * rng.normal(size=5) for _ in range(6)] + [np.empty((0, 5))]
    for start in starts:
        out = fitted(core, hits, start, settings())
        assert out["status"][0] == _core.FitStatus.ok
        assert np.all(np.abs(out["helix"][0] - best["helix"][0]) < 1e-5 * sigma)


@every_track
def test_hidden_sides_are_found(name, which):
    """With hidden sides and true distances the fit finds the sides and stays within a fraction of its error."""
    _, core, helix, hits = smeared_track(name, which)
    known = fitted(core, hits, helix, settings())
    hidden = fitted(core, hits | {"side": np.zeros_like(hits["side"])}, helix, settings(tolerance=1e-3))
    assert hidden["status"][0] == _core.FitStatus.ok
    far = (hits["kind"] == 2) & (hits["value"] > 1.0)
    np.testing.assert_array_equal(hidden["side"][far], hits["side"][far])
    sigma = np.sqrt(np.diag(known["cov"][0]))
    assert np.all(np.abs(hidden["helix"][0] - known["helix"][0]) < sigma)


def test_few_hits():
    """Fewer measurements than parameters end with a status; a dozen without the outer chamber are fitted."""
    _, core, helix, hits = smeared_track("besiii-cgem-design", "1 GeV/c")
    few = {k: v[:4] for k, v in hits.items()}
    assert fitted(core, few, helix, settings())["status"][0] == _core.FitStatus.too_few_hits
    enough = {k: v[:12] for k, v in hits.items()}
    out = fitted(core, enough, helix, settings())
    assert out["status"][0] == _core.FitStatus.ok
    assert out["ndf"][0] == 7
    assert np.all(np.linalg.eigvalsh(out["cov"][0]) > 0)


def test_gates_see_the_matter():
    """Leaving out the matter between measurements changes covariance and chi-square by much more than the gates."""
    detector, core, helix, hits = smeared_track("besiii-cgem-design", "0.18 GeV/c")
    out = fitted(core, hits, helix, settings())
    residual, rows, covariance = linear_model(detector, core, out["helix"][0], hits)
    bare = np.diag(np.concatenate([hits["sigma"] ** 2, PRIOR**2]))
    _, with_matter, chi2 = least_squares(residual, rows, covariance)
    _, without, chi2_without = least_squares(residual, rows, bare)
    assert with_matter[0, 0] > 2 * without[0, 0]
    assert chi2_without > 1.02 * chi2
