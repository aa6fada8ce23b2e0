"""Slow tracks: the fit finds what least squares finds where nothing is taken as linear."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2, kstest

import cgemit as cg
from cgemit.reconstruction.fit import PARAMETERS, FitSettings
from cgemit.tables.schema import has_momentum
from exact import exact
from fields import HARMONIC
from pages.optimal import Hit, Optimum, error_of, follow, optimum, stack_of
from tracks import hits_of_result

GUN = cg.Gun("mu+", p=0.1, cos_theta=(-0.3, 0.3))


@cache
def sample(kinks: bool, gun: cg.Gun = GUN, n: int = 4) -> cg.Result:
    """Fit with or without kinks; the same tracks."""
    fit = FitSettings(tolerance=1e-4, max_iterations=30, outlier_pull=0, kinks=kinks)
    return cg.run("besiii-cgem-design", gun, n, seed=5, **exact(fit=fit))


def helices(result: cg.Result) -> np.ndarray:
    """Return the fitted helices, (n, 5)."""
    return np.stack([result.tracks[name] for name in PARAMETERS], axis=1)


def hits_of(result: cg.Result, track: int) -> tuple[list[Hit], np.ndarray]:
    """Return the hits of a track and what they measured, mm."""
    found = hits_of_result(result)
    rows = range(found.hit_offsets[track], found.hit_offsets[track + 1])
    hits = [Hit(*(getattr(found, name)[i].item() for name in ("kind", "layer", "channel", "sigma"))) for i in rows]
    sign = np.array([found.side[i] if found.kind[i] == 2 else 1 for i in rows])
    return hits, sign * np.array([found.value[i] for i in rows])


def optimal_estimate(result: cg.Result, track: int) -> Optimum:
    """Return what the optimal estimate of a track is, worked out without the fit."""
    mass = float(result.particles["mass"][track])
    return optimum(result.detector, hits_of(result, track)[0], helices(result)[track], mass)


def best(result: cg.Result, track: int) -> tuple[np.ndarray, float]:
    """Return helix and chi-square of the best track: helix, angles, losses and shifts free, in plain numpy.

    `pages.optimal` follows every track anew; the spreads of angles and losses are those on the fitted helix.
    """
    hits, measured = hits_of(result, track)
    errors = np.array([hit.sigma for hit in hits])
    mass, helix = float(result.particles["mass"][track]), helices(result)[track]
    stack = stack_of(result.detector, helix[4], error_of(result.detector, helix, mass))
    follow(result.detector, hits, helix[:, None], mass, {}, stack)  # fills in the spreads
    noise = [(i, k, s.sigma[k]) for i, s in enumerate(stack) for k in range(5) if s.sigma[k] > 0]
    unit = np.sqrt(np.diag(result.tracks["cov"][track]))

    def residuals(x: np.ndarray) -> np.ndarray:
        """One column for each of the tracks x, (5 + noise, n), in standard deviations."""
        kicks = {i: np.zeros((5, x.shape[1])) for i, _, _ in noise}
        for (slab, which, sigma), pulls in zip(noise, x[5:], strict=True):
            kicks[slab][which] = sigma * pulls
        seen = follow(result.detector, hits, helix[:, None] + unit[:, None] * x[:5], mass, kicks, stack)
        return np.concatenate([(seen - measured[:, None]) / errors[:, None], x[5:]])

    def jacobian(x: np.ndarray) -> np.ndarray:
        steps = 1e-3 * np.eye(len(x))
        return (residuals(x[:, None] + steps) - residuals(x[:, None] - steps)) / 2e-3

    start = np.zeros(5 + len(noise))
    done = least_squares(lambda x: residuals(x[:, None])[:, 0], start, jac=jacobian, xtol=1e-6, ftol=1e-10)
    return helix + unit * done.x[:5], 2 * done.cost


@pytest.mark.slow
def test_fit_is_the_best_track() -> None:
    """With kinks kappa is within 0.03 sigma of it (RMS), chi-square within 0.1; without, three times as far."""
    with_kinks, without = sample(True), sample(False)
    assert (with_kinks.tracks["status"] == 0).all()
    away: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for track in range(4):
        helix, chi_square = best(with_kinks, track)
        sigma = np.sqrt(np.diag(with_kinks.tracks["cov"][track]))
        for kinks, result in ((True, with_kinks), (False, without)):
            more = result.tracks["chi2"][track] - chi_square
            away[kinks].append(np.append((helices(result)[track] - helix) / sigma, more))
    near, far = (np.sqrt(np.mean(np.square(away[kinks]), axis=0)) for kinks in (True, False))
    assert np.all(near[[0, 1, 3, 4]] < 0.005)
    assert near[2] < 0.03
    assert near[5] < 0.1
    assert far[2] > 3 * near[2]
    assert far[5] > 3 * near[5]


def test_chi_square_is_flat_where_tracks_turn_back() -> None:
    """Pions of 0.1 GeV/c and pT 0.06 GeV/c; taken as linear their tracks do not fit."""
    gun = cg.Gun("pi-", p=0.1, cos_theta=0.8)
    flat = {}
    for kinks in (True, False):
        tracks = sample(kinks, gun, 4000).tracks
        good = has_momentum(tracks)
        assert good.mean() > 0.99
        flat[kinks] = kstest(chi2.sf(tracks["chi2"][good], tracks["ndf"][good]), "uniform").pvalue
    assert flat[True] > 1e-4
    assert flat[False] < 1e-12


@pytest.mark.slow
def test_bias_of_kappa() -> None:
    """Scattered tracks come less far than straight ones: taken as linear they look bent more, by 0.16 sigma.

    Both estimates have the bias that second derivatives in plain numpy let expect.
    """
    gun = cg.Gun("pi+", p=0.1, cos_theta=0.0)
    expected = optimal_estimate(sample(True, gun, 20_000), 0)
    for kinks, best_bias in ((True, expected.bias[2]), (False, expected.linear_bias[2])):
        tracks = sample(kinks, gun, 20_000).tracks
        good = has_momentum(tracks)
        bias = np.mean(tracks["res_kappa"][good]) / np.sqrt(np.mean(tracks["err_kappa"][good] ** 2))
        assert bias == pytest.approx(best_bias, abs=4 / math.sqrt(20_000))
    assert expected.bias[2] < 0.08 < 0.14 < expected.linear_bias[2]


def test_fast_tracks_have_no_kinks() -> None:
    """From 0.5 GeV/c on nothing changes, to the last bit."""
    gun = cg.Gun("mu-", p=(0.5, 2.0), cos_theta=(-0.9, 0.9))
    np.testing.assert_array_equal(helices(sample(True, gun, 200)), helices(sample(False, gun, 200)))


@pytest.mark.parametrize("field", ["uniform", HARMONIC])
def test_states_are_those_of_the_fit(field: str) -> None:
    """The smoothed state at the origin is the helix, and every residual that of the hit against the smoothed track."""
    detector = cg.load("besiii-cgem-design")
    detector = detector if field == "uniform" else detector.with_field(field)
    fit = FitSettings(tolerance=1e-6, max_iterations=40, residuals=True, states=("origin", "hits"))
    result = cg.run(detector, cg.Gun("mu+", p=0.12, cos_theta=(-0.5, 0.5)), 30, seed=5, **exact(fit=fit))
    assert result.states is not None
    states, tracks = result.states, result.tracks
    origin = states["surface"] == 0
    sigma = np.sqrt(np.diagonal(tracks["cov"], axis1=1, axis2=2))
    # In a map the fit passes wires on spans, where the states stop at each of them.
    limit = 1e-4 if field == "uniform" else 2e-3
    for i, name in enumerate(PARAMETERS):
        away = states[name][origin] - tracks[name]
        np.testing.assert_allclose(np.remainder(away + np.pi, 2 * np.pi) - np.pi if name == "phi0" else away,
                                   0, atol=limit * sigma[:, i].min())  # fmt: skip
    pull = states["pull"][~origin]
    assert np.isfinite(pull).mean() > 0.99
    assert np.nanstd(pull) == pytest.approx(1, abs=0.05)
