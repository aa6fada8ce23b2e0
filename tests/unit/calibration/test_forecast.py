"""Forecast of alignment: against alignments, its modes, what its errors do to tracks, input that is refused."""

from __future__ import annotations

import time

import numpy as np
import pytest

import cgemit as cg
from cgemit.calibration.modes import solve
from cgemit.calibration.settings import plan_of

NOMINAL = cg.load("besiii-cgem-design").with_readout("gaussian")
MUONS = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))


@pytest.fixture(scope="module")
def forecast() -> cg.AlignmentForecast:
    return cg.alignment_forecast(NOMINAL, [(MUONS, 1000)])


def test_errors_are_those_of_alignment(forecast: cg.AlignmentForecast) -> None:
    run = cg.run(NOMINAL, MUONS, n=1000, seed=1, settings=cg.Settings(simulate=cg.SimulateSettings(deltas=False)))
    found = cg.align(run)
    np.testing.assert_allclose(forecast.table.err, found.table.err, rtol=0.03)


def test_errors_fall_with_the_root_of_the_number_of_tracks(forecast: cg.AlignmentForecast) -> None:
    more = cg.alignment_forecast(NOMINAL, [(MUONS, 400_000)])
    np.testing.assert_allclose(np.array(forecast.table.err) / more.table.err, 20, rtol=0.05)


def test_cosmic_muons_come_from_above() -> None:
    """Vertical tracks measure shifts along x better than those along y, which gun tracks measure alike."""
    forecast = cg.alignment_forecast(NOMINAL, [(cg.sample("cosmic"), 2000)])
    err = dict(zip(forecast.table.name, forecast.table.err, strict=True))
    assert err["cgem.L2.shift_y"] > 1.5 * err["cgem.L2.shift_x"]
    gun = cg.alignment_forecast(NOMINAL, [(MUONS, 2000)])
    err = dict(zip(gun.table.name, gun.table.err, strict=True))
    assert err["cgem.L2.shift_y"] == pytest.approx(err["cgem.L2.shift_x"], rel=0.05)


def test_joined_halves_add_information() -> None:
    cosmics = [(cg.sample("cosmic"), 1000)]
    joined = cg.alignment_forecast(NOMINAL, cosmics)
    apart = cg.alignment_forecast(NOMINAL, cosmics, cg.AlignmentSettings(pairs=()))
    assert joined.sums.pairs > 500
    assert apart.sums.pairs == 0
    gain = np.array(joined.table.err) / apart.table.err
    assert (gain < 1 + 1e-9).all()
    assert gain.min() < 0.8


def test_weak_modes_have_names() -> None:
    settings = cg.AlignmentSettings(free=("cgem.*", "drift_chamber"))
    modes = cg.alignment_forecast(NOMINAL, [(MUONS, 1000)], settings).modes(6)
    assert set(modes.names[:4]) == {"common shift_x", "common shift_y", "common shift_z", "common rotation"}
    assert np.isinf(modes.sizes[:4]).all()
    assert np.isfinite(modes.sizes[4:]).all()
    assert modes.shapes.shape == (6, 24)


def test_budget_has_a_row_for_alignment(forecast: cg.AlignmentForecast) -> None:
    """The row is the variance that `induced` returns, and the resolutions grow by it."""
    before = cg.analytic(NOMINAL, "mu-", p=1.0)
    after = cg.analytic(NOMINAL, "mu-", p=1.0, alignment=forecast)
    induced = forecast.induced("mu-", p=1.0)
    for name, unit in (("dr", 1e3), ("dz", 1.0), ("p", 1e3)):
        budget = after.budget(name)
        row = budget.grouped()["alignment"]
        assert float(row) == pytest.approx((unit * induced[name]) ** 2, rel=1e-6)
        assert float(budget.total - row) == pytest.approx(float(before.budget(name).total), rel=1e-9)
        assert after.rms(name) ** 2 - before.rms(name) ** 2 == pytest.approx(float(row), rel=1e-6)
    with pytest.raises(ValueError, match="at the origin"):
        cg.analytic(NOMINAL, "mu-", p=1.0, radius=100.0, alignment=forecast)


def test_induced_errors_are_those_of_displaced_detectors(forecast: cg.AlignmentForecast) -> None:
    """Fits with descriptions drawn from the covariance: the spread of their mean d_rho at one azimuth.

    The same hits are fitted with each description, so that nothing but the constants changes.
    """
    random = np.random.default_rng(3)
    track = cg.Gun("mu-", p=1.0, cos_theta=0.0, phi=0.4)
    run = cg.run(NOMINAL, track, n=20, seed=3, settings=cg.Settings(fit=cg.FitSettings(outlier_pull=0)))
    draws = random.multivariate_normal(np.zeros(18), forecast.cov, size=40)
    means = []
    for draw in draws:
        values = dict(zip(forecast.solution.names, map(float, draw), strict=True))
        wrong = NOMINAL.with_alignment(values)
        tables = cg.fit(wrong, run.clusters, run.wire_hits, run.candidates, run.candidate_hits, run.settings.fit)
        means.append(tables["tracks"]["dr"].mean() - run.fitted["dr"].mean())
    expected = cg.analytic(NOMINAL, "mu-", p=1.0, phi=0.4, alignment=forecast).rms("dr") ** 2
    expected = np.sqrt(expected - cg.analytic(NOMINAL, "mu-", p=1.0, phi=0.4).rms("dr") ** 2) * 1e-3
    assert abs(np.std(means) / float(expected) - 1) < 4 / np.sqrt(2 * len(means))


def test_algebra_takes_milliseconds() -> None:
    """54 constants of layers and end plates, with the sums at hand: the quickest of five solutions within 50 ms."""
    settings = cg.AlignmentSettings(
        free=("cgem.*", "drift_chamber.plates.*"), plates=(2, 2, 2, 2, 2, 2, 23), fixed=("drift_chamber.plates.20-42",)
    )
    constants, _, _ = plan_of(NOMINAL, settings)
    assert len(constants) == 54
    sums = cg.alignment_forecast(NOMINAL, [(MUONS, 300)], settings).sums
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        found = solve(NOMINAL, constants, sums, {})
        times.append(time.perf_counter() - begin)
    assert set(found.status) == {"free"}
    assert min(times) < 0.05


@pytest.mark.parametrize(
    ("samples", "expected"),
    [
        ([], "pairs of a gun"),
        ([MUONS], r"samples\[0\]"),
        ([(MUONS, 0)], "at least 1"),
        ([(MUONS, 10), ("cosmic", 10)], r"samples\[1\]"),
    ],
)
def test_wrong_samples_are_listed(samples: list[object], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        cg.alignment_forecast(NOMINAL, samples)  # type: ignore[arg-type]
