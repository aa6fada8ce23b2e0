"""Densities of the momenta of electrons, against sums of normal distributions by scipy; the beam spot as constraint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

import cgemit as cg
from cgemit.reconstruction.fit import momentum_limits, with_wider_momenta

SHARES = {"p_low95": 0.025, "p_low": 0.16, "p_high": 0.84, "p_high95": 0.975}
GUN = cg.Gun("e-", p=0.5, cos_theta=(-0.8, 0.8))


@pytest.fixture(scope="module")
def electrons() -> cg.Result:
    return cg.run("besiii-cgem", GUN, 60, seed=3, settings=cg.Settings(fit=cg.FitSettings(components=True)))


def below(parts: cg.Table, track: int, change: float) -> float:
    mine = parts["track"] == track
    return float(np.sum(parts["weight"][mine] * norm.cdf((change - parts["change"][mine]) / parts["spread"][mine])))


def test_limits_are_quantiles_of_the_components(electrons):
    """Each limit is the quantile of its track's components, to 2 % of the probability beyond, and weights sum to 1."""
    tracks, parts = electrons.fitted, electrons.components
    sums = np.bincount(parts["track"], parts["weight"], len(tracks))
    np.testing.assert_allclose(sums[tracks["status"] == cg.FitStatus.ok], 1, atol=1e-12)
    for track in range(0, 60, 6):
        p = float(tracks["p"][track])
        for name, share in SHARES.items():
            found = below(parts, track, np.log(tracks[name][track] / p))
            assert abs(found - share) < 0.02 * min(share, 1 - share), name
        upper = p * np.exp(brentq(lambda x, track=track: below(parts, track, x) - 0.84, -1, 3))
        assert tracks["p_high"][track] == pytest.approx(upper, rel=2e-4)


def test_the_mode_is_the_maximum_of_the_density(electrons):
    tracks, parts = electrons.fitted, electrons.components
    for track in range(0, 60, 6):
        mine = parts["track"] == track
        sigma = parts["spread"][mine].min()
        x = np.linspace(-4, 4, 4001)[:, None] * sigma
        density = np.sum(parts["weight"][mine] * norm.pdf(x, parts["change"][mine], parts["spread"][mine]), axis=1)
        mode = float(x[density.argmax(), 0])
        assert np.log(tracks["p_mode"][track] / tracks["p"][track]) == pytest.approx(mode, abs=0.05 * sigma)


def test_quantiles_of_the_truth_are_those_of_the_components(electrons):
    truth, p = electrons.matches["truth_p"], electrons.fitted["p"]
    for track in range(0, 60, 6):
        expected = below(electrons.components, track, np.log(truth[track] / p[track]))
        assert electrons.matches["quantile_p"][track] == pytest.approx(expected, abs=2e-7)


def test_quantiles_need_the_components(electrons):
    """Without its components the density of an electron is not known; muons need none."""
    r = electrons
    truth = (r.particles, r.truths, r.wire_truths)
    made = (r.fitted, r.candidates, r.candidate_hits, r.clusters, r.wire_hits, *truth)
    assert np.isnan(cg.match(*made, detector=r.detector)["matches"]["quantile_p"]).all()
    again = cg.match(*made, detector=r.detector, components=r.components)["matches"]["quantile_p"]
    np.testing.assert_array_equal(again, r.matches["quantile_p"])


def test_components_are_made_on_request():
    result = cg.run("besiii-cgem", GUN, 5, seed=3)
    assert "components" not in result.tables
    assert np.isfinite(result.matches["quantile_p"]).all()


def test_inverse_momenta_of_others_are_normal():
    """Muons have the limits of a normal 1/p, the mode p, no break, and the quantile of 1/p."""
    result = cg.run("besiii-cgem", cg.Gun("mu-", p=0.5, cos_theta=0.0), 5, seed=3)
    tracks, matches = result.fitted, result.matches
    inverse, error = 1 / tracks["p"], tracks["err_p"] / tracks["p"] ** 2
    np.testing.assert_array_equal(tracks["p_mode"], tracks["p"])
    np.testing.assert_allclose(1 / tracks["p_low95"], inverse + norm.ppf(0.975) * error)
    np.testing.assert_allclose(1 / tracks["p_high"], inverse + norm.ppf(0.16) * error)
    np.testing.assert_allclose(matches["quantile_p"], norm.sf((1 / matches["truth_p"] - inverse) / error), atol=2e-7)
    assert not tracks["radiated"].any()


def test_there_may_be_no_upper_limit():
    """The inverse momentum may be 0 within two errors."""
    limits = momentum_limits(np.array([1.0]), np.array([0.6]))
    assert np.isfinite(limits["p_high"]).all()
    assert np.isnan(limits["p_high95"]).all()


@pytest.mark.parametrize("changes", [{"radiation": False}, {"loss": "mean"}])
def test_without_cut_radiation_the_density_is_normal(electrons, changes):
    r = electrons
    fit = cg.FitSettings(components=True, **changes)
    made = cg.fit(r.detector, r.clusters, r.wire_hits, r.candidates, r.candidate_hits, fit)
    np.testing.assert_array_equal(made["tracks"]["p_mode"], made["tracks"]["p"])
    assert len(made["components"]) == 0


def test_added_errors_widen_the_limits(electrons):
    """An error of 3 in quadrature to 4 makes limits 5/4 as wide, of a normal density."""
    tracks = electrons.fitted
    p, error = tracks["p"], tracks["err_p"]
    narrow = np.exp(np.abs(np.log(tracks["p_low"] / tracks["p_mode"])))
    wider = with_wider_momenta(tracks, 1.25 * error)
    expected = np.hypot(np.log(narrow), 0.75 * error / p * norm.ppf(0.84))
    np.testing.assert_allclose(np.log(wider["p_mode"] / wider["p_low"]), expected, rtol=1e-4)
    np.testing.assert_array_equal(wider["p_mode"], tracks["p_mode"])


SPOT = (0.2, 3.0)


def test_the_beam_spot_is_two_measurements():
    """Helix and covariance are those of the fit without, updated by dr = 0 and dz = 0 with their errors."""
    settings = cg.Settings(digitize=cg.DigitizeSettings(reveal_sides=True))
    r = cg.run("besiii-cgem", cg.Gun("mu-", p=0.5, cos_theta=(-0.8, 0.8)), 60, seed=3, settings=settings)
    how = {"tolerance": 1e-4, "cluster_errors": "cluster"}
    made = [
        cg.fit(r.detector, r.clusters, r.wire_hits, r.candidates, r.candidate_hits, fit)["tracks"]
        for fit in (cg.FitSettings(**how), cg.FitSettings(**how, beam=SPOT))
    ]
    free, bound = made
    h = np.zeros((2, 5))
    h[0, 0] = h[1, 3] = 1
    compared = 0
    for i in range(60):
        if free["status"][i] or free["n_outliers"][i] or bound["n_outliers"][i]:
            continue
        x, c = np.array([free[name][i] for name in cg.helix.PARAMETERS]), free["cov"][i]
        total = h @ c @ h.T + np.diag(np.square(SPOT))
        gain = c @ h.T @ np.linalg.inv(total)
        sigma = np.sqrt(np.diag(c))
        np.testing.assert_allclose(
            [bound[name][i] for name in cg.helix.PARAMETERS] / sigma, (x - gain @ h @ x) / sigma, atol=0.01
        )
        np.testing.assert_allclose(
            bound["cov"][i] / np.outer(sigma, sigma), (c - gain @ h @ c) / np.outer(sigma, sigma), atol=0.005
        )
        assert bound["chi2"][i] == pytest.approx(free["chi2"][i] + h @ x @ np.linalg.inv(total) @ h @ x, abs=0.05)
        assert bound["ndf"][i] == free["ndf"][i] + 2
        compared += 1
    assert compared > 40


def test_the_beam_spot_goes_without_states_and_expectations():
    with pytest.raises(ValueError, match=r"beam: .* expected None with states"):
        cg.FitSettings(beam=SPOT, states=("origin",))
    with pytest.raises(ValueError, match=r"fit.beam: got .* expected None"):
        cg.analytic("besiii-cgem", "mu-", fit=cg.FitSettings(beam=SPOT))
    with pytest.raises(ValueError, match="beam"):
        replace(cg.FitSettings(), beam=(0.0, 1.0))
