"""Widths, tails and their errors of samples whose answers are known."""

import math

import numpy as np
import pytest
from scipy import integrate, optimize
from scipy import stats as scipy_stats

from cgemit.study import gaussian_fit, measure
from fitted import N, rng
from stats import assert_within, fraction_error

GAUSSIAN_TAIL = math.erfc(3 / math.sqrt(2))


def population_core(density):
    """Return the core sigma of a symmetric density: the fixed point of its truncated variance, by quadrature."""
    second = scipy_stats.truncnorm(-3, 3).var()

    def excess(sigma):
        inside = integrate.quad(density, 0, 3 * sigma, limit=200)[0]
        variance = integrate.quad(lambda x: x**2 * density(x), 0, 3 * sigma, limit=200)[0] / inside
        return variance - second * sigma**2

    return optimize.brentq(excess, 0.5, 3)


def test_gaussian_sample():
    """All widths of a Gaussian are its sigma, and the tail is 0.27 %."""
    found = measure(rng().normal(5, 2, N), parameter="x", unit="um")
    assert_within(found.core, 2, found.core_error, what="core")
    assert_within(found.q68, 2, found.q68_error, what="q68")
    assert_within(found.rms, 2, found.rms_error, what="rms")
    assert_within([found.core_mean, found.mean], 5, [found.core_mean_error, found.mean_error], what="mean")
    assert_within(found.tail, GAUSSIAN_TAIL, fraction_error(GAUSSIAN_TAIL, N), what="tail")
    assert (found.n, found.outside, found.removed) == (N, 0, ())
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(found.core, 2 * 1.05, found.core_error)


def test_core_is_the_maximum_of_the_truncated_likelihood():
    """In the window where it stops, no other mean and sigma are more likely."""
    x = np.concatenate([rng().normal(0, 1, 5000), rng(2).normal(0, 6, 500)])
    found = measure(x)
    low, high = found.core_mean - 3 * found.core, found.core_mean + 3 * found.core
    inside = x[(x >= low) & (x <= high)]

    def minus_log_likelihood(parameters):
        mean, sigma = parameters
        norm = scipy_stats.norm.cdf(high, mean, sigma) - scipy_stats.norm.cdf(low, mean, sigma)
        return -np.sum(scipy_stats.norm.logpdf(inside, mean, sigma)) + len(inside) * math.log(norm)

    best = optimize.minimize(minus_log_likelihood, (0.1, 1.2), method="Nelder-Mead", options={"xatol": 1e-7})
    np.testing.assert_allclose(best.x, [found.core_mean, found.core], atol=2e-5)


def test_core_error_of_a_gaussian():
    """It is the information on sigma of the rows within a window of 3 sigma: 1.728/sigma^2 a row, by quadrature."""
    cut = scipy_stats.truncnorm(-3, 3)
    information = (cut.moment(4) - cut.moment(2) ** 2) * math.erf(3 / math.sqrt(2))
    assert information == pytest.approx(1.728, abs=0.001)
    found = measure(rng().normal(0, 2, 100_000))
    assert found.core_error == pytest.approx(2 / math.sqrt(100_000 * information), rel=0.02)
    assert found.core_mean_error == pytest.approx(2 / math.sqrt(100_000 * 0.9707), rel=0.02)


def test_gaussian_with_tails():
    """The core nearly ignores tails that the RMS follows; both meet their exact values."""
    share, wide = 0.1, 5.0
    x = rng(3).standard_normal(N) * np.where(rng(4).random(N) < share, wide, 1.0)

    def density(t):
        return (1 - share) * scipy_stats.norm.pdf(t) + share * scipy_stats.norm.pdf(t, scale=wide)

    found, expected = measure(x), population_core(density)
    assert_within(found.core, expected, found.core_error, what="core")
    assert_within(found.rms, math.sqrt(1 - share + share * wide**2), found.rms_error, what="rms")
    q68 = optimize.brentq(lambda t: 2 * integrate.quad(density, 0, t)[0] - math.erf(1 / math.sqrt(2)), 0.5, 2)
    assert_within(found.q68, q68, found.q68_error, what="q68")
    tail = 1 - 2 * integrate.quad(density, 0, 3 * expected)[0]
    assert_within(found.tail, tail, fraction_error(tail, N), what="tail")
    assert expected < 1.1
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(found.core, 1.0, found.core_error)


@pytest.mark.parametrize(("share", "wide", "gaussian"), [(0.1, 5.0, True), (0.2, 3.0, True), (0.3, 8.0, False)])
def test_the_word_where_the_core_is_that_of_some_rows(share: float, wide: float, gaussian: bool) -> None:
    """Tails of usual size are no reason; q68 half as large again, or of a rectangle, is; electrons have their own."""
    x = rng(6).standard_normal(N) * np.where(rng(7).random(N) < share, wide, 1.0)
    found = measure(x)
    assert (abs(found.q68 / found.core - 1) < 0.1) == gaussian == found.is_gaussian()
    assert ("core not Gaussian" in str(found)) == (not gaussian)
    assert not measure(rng(8).uniform(-1, 1, N)).is_gaussian()
    assert measure(x[:30]).is_gaussian()  # too few rows to tell
    assert measure([]).is_gaussian()
    assert "not Gaussian" not in str(measure(x, electrons=N))


def test_uniform_sample():
    """A rectangle is no Gaussian: its core is its standard deviation / sqrt(0.9733), its q68 0.3413 of its width."""
    x = rng(5).uniform(-0.5, 0.5, N)
    found = measure(x)
    assert found.core == pytest.approx(x.std() / math.sqrt(scipy_stats.truncnorm(-3, 3).var()), rel=1e-9)
    assert found.tail == 0
    assert found.tail_error > 0
    central = math.erf(1 / math.sqrt(2))
    assert_within(found.q68, central / 2, found.q68_error)
    # Exact: half the range between two order statistics of a uniform sample.
    assert found.q68_error == pytest.approx(math.sqrt(central * (1 - central) / N) / 2, rel=0.05)
    assert_within(found.rms, 1 / math.sqrt(12), found.rms_error)
    assert found.rms_error == pytest.approx(math.sqrt((1 / 80 - 1 / 144) / N) * math.sqrt(12) / 2, rel=0.05)


@pytest.mark.parametrize(
    "draw",
    [
        lambda r: r.standard_normal(1000),
        lambda r: r.standard_normal(1000) * np.where(r.random(1000) < 0.05, 4, 1),
        lambda r: r.random(1000),
    ],
    ids=["gaussian", "tails", "uniform"],
)
def test_quoted_errors_are_the_scatter_of_repeated_samples(draw):
    """Over 600 samples of any shape the estimates scatter as much as their errors say."""
    repeats = 600
    found = [measure(draw(rng(seed))) for seed in range(repeats)]
    for name in ("core", "core_mean", "q68", "rms", "mean", "tail"):
        values = np.array([getattr(one, name) for one in found])
        if name == "tail" and not values.any():
            continue  # the rectangle has none
        error = math.sqrt(np.mean([getattr(one, f"{name}_error") ** 2 for one in found]))
        # The scatter of a sample's standard deviation follows from its kurtosis.
        kurtosis = 3 + scipy_stats.kurtosis(values)
        assert_within(values.std(ddof=1) / error, 1, math.sqrt((kurtosis - 1) / (4 * repeats)), what=name)


@pytest.mark.parametrize(
    ("rows", "wide", "factor"), [(50, 0.0, 1.2), (100, 0.0, 1.07), (30, 0.1, 1.5), (60, 0.1, 1.3), (200, 0.1, 1.08)]
)
def test_errors_of_few_rows(rows: int, wide: float, factor: float) -> None:
    """Cores of small samples, a part of them three times as wide, scatter as the docstring of `Resolution` says."""
    random = rng()
    found = [measure(random.normal(size=rows) * np.where(random.random(rows) < wide, 3, 1)) for _ in range(1000)]
    cores, errors = np.array([(one.core, one.core_error) for one in found]).T
    assert np.std((cores - np.median(cores)) / errors) == pytest.approx(factor, abs=0.15)


def test_window_of_the_rms():
    """The RMS looks within its window, which is stated with the number of rows outside."""
    x = np.concatenate([rng().standard_normal(1000), [50.0, -60.0]])
    found = measure(x, window=(-10, 10))
    assert found.outside == 2
    assert found.rms == pytest.approx(np.std(x[:1000], ddof=1))
    assert found.core == measure(x).core
    assert "within -10 to 10, 2 rows outside" in repr(found)


def test_scale_and_shift():
    """Widths scale with the sample and do not notice a large offset."""
    x = rng().standard_normal(5000)
    one, other = measure(x), measure(1e6 + 3 * x)
    for name in ("core", "core_error", "q68", "q68_error", "rms", "rms_error"):
        assert getattr(other, name) == pytest.approx(3 * getattr(one, name), rel=1e-6)
    assert other.core_mean == pytest.approx(1e6 + 3 * one.core_mean, rel=1e-12)


def test_few_and_equal_rows():
    """Fewer than ten rows have no width; equal rows have width 0."""
    assert math.isnan(measure([1.0] * 9).core)
    assert measure([1.0] * 9).n == 9
    assert math.isnan(measure([]).q68)
    same = measure([2.0] * 50)
    assert (same.core, same.q68, same.rms, same.core_mean) == (0, 0, 0, 2)


@pytest.mark.parametrize("sample", [[1.0, math.nan] * 10, [[1.0, 2.0]], 3.0])
def test_bad_samples(sample):
    """What is not a list of finite numbers is refused."""
    with pytest.raises(ValueError, match="finite numbers"):
        measure(sample)
    with pytest.raises(ValueError, match="finite numbers"):
        gaussian_fit(sample)


def test_gaussian_fit_of_a_triangle():
    """The likelihood fit of a triangular sample, the shape of V residuals, is its standard deviation."""
    x = rng(6).triangular(-1, 0, 1, N)
    fit = gaussian_fit(x)
    assert fit.sigma == pytest.approx(x.std())
    assert fit.mean == pytest.approx(x.mean())
    assert_within(fit.sigma, 1 / math.sqrt(6), fit.sigma_error)
    assert_within(fit.mean, 0, fit.mean_error)
    # Fourth moment of this triangle is 1/15.
    assert fit.sigma_error == pytest.approx(math.sqrt((1 / 15 - 1 / 36) / N) * math.sqrt(6) / 2, rel=0.05)
    assert math.isnan(gaussian_fit([]).sigma)
