"""Widths, pulls and flatness of samples whose answers are known."""

import math
import pickle
import time

import numpy as np
import pytest
from scipy import integrate, optimize
from scipy import stats as scipy_stats

from cgemit._core import FitStatus
from cgemit.study import (
    chi2_flatness,
    chi2_probability,
    gaussian_fit,
    measure,
    pulls,
    resolution,
    resolution_against,
)
from cgemit.tables import PARAMETERS, SCHEMAS, Table
from stats import assert_within, fraction_error

N = 20_000
GAUSSIAN_TAIL = math.erfc(3 / math.sqrt(2))


def rng(seed=1):
    """Return a generator of random numbers."""
    return np.random.default_rng(seed)


def make_tracks(n=N, seed=1, **columns):
    """Return well fitted tracks whose pulls are standard normal and whose chi-square is right."""
    random = rng(seed)
    zeros = {c.name: np.zeros((n, *c.shape), c.dtype) for c in SCHEMAS["tracks"]}
    values = {"event": np.arange(n), "ndf": np.full(n, 20), "chi2": random.chisquare(20, n)}
    for name in PARAMETERS:
        values[f"pull_{name}"] = random.standard_normal(n)
        values[f"res_{name}"] = 0.001 * values[f"pull_{name}"]
    tanl, charge = random.uniform(-2, 2, n), np.where(np.arange(n) % 2, 1.0, -1.0)
    values |= {"truth_tanl": tanl, "truth_p": np.full(n, 1.0), "truth_kappa": charge * np.sqrt(1 + tanl**2)}
    return Table("tracks", zeros | values | columns, n)


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


@pytest.mark.parametrize(
    ("parameter", "unit", "scale"),
    [("dr", "um", 1e3), ("phi0", "mrad", 1e3), ("kappa", "1/(GeV/c)", 1), ("dz", "mm", 1), ("tanl", "1e-3", 1e3),
     ("p", "MeV/c", 1e3)],
)  # fmt: skip
def test_quoted_units(parameter, unit, scale):
    """Residuals in native units are quoted in the units of the reports."""
    tracks = make_tracks(1000)
    found = resolution(tracks, parameter)
    assert found.unit == unit
    assert found.core == pytest.approx(scale * measure(tracks[f"res_{parameter}"]).core)


def test_removed_rows_are_counted_by_name():
    """Only tracks that ended well count; the others are listed by status, and values that are missing too."""
    status = np.zeros(N, np.int8)
    status[:30], status[30:35] = FitStatus.not_converged, FitStatus.too_few_hits
    residual = np.full(N, 1e9)
    residual[35:] = rng().normal(0, 0.2, N - 35)
    residual[40] = np.nan
    found = resolution(make_tracks(status=status, res_dr=residual), "dr")
    assert found.removed == (("too_few_hits", 5), ("not_converged", 30), ("without a value", 1))
    assert found.n == N - 36
    assert found.rms < 1000
    assert "30 not_converged" in repr(found)


def test_misspelt_names_get_a_hint():
    """Unknown parameters, quantities and empty windows are refused."""
    tracks = make_tracks(100)
    with pytest.raises(ValueError, match='did you mean "kappa"'):
        resolution(tracks, "kapa")
    with pytest.raises(ValueError, match='did you mean "cos_theta"'):
        resolution_against(tracks, "dr", by="costheta")
    with pytest.raises(ValueError, match="kind"):
        resolution_against(tracks, "dr", kind="res")
    with pytest.raises(ValueError, match="window"):
        resolution(tracks, "dr", window=(1, 1))
    for bins in (0, [1], [0, 0], [[0, 1]]):
        with pytest.raises(ValueError, match="bins"):
            resolution_against(tracks, "dr", bins=bins)


def test_pulls_of_right_and_wrong_errors():
    """Right pulls have mean 0 and width 1 in every parameter; errors wrong by 5 % or a bias of 0.05 are seen."""
    wrong = 1.05 * rng(9).standard_normal(N)
    found = pulls(make_tracks(pull_dz=wrong, pull_tanl=0.05 + rng(8).standard_normal(N)))
    assert [one.parameter for one in found] == list(PARAMETERS)
    for name in ("dr", "phi0", "kappa", "p"):
        one = found[name]
        assert_within([one.core, one.rms], 1, [one.core_error, one.rms_error], what=name)
        assert_within([one.core_mean, one.mean], 0, [one.core_mean_error, one.mean_error], what=name)
    with pytest.raises(AssertionError):
        assert_within(found["dz"].core, 1, found["dz"].core_error)
    with pytest.raises(AssertionError):
        assert_within(found["tanl"].mean, 0, found["tanl"].mean_error)


def test_resolution_against_cos_theta_and_charge():
    """Each bin holds its rows: a width that grows with |cos(theta)| comes out bin by bin."""
    tracks = make_tracks()
    cos = tracks["truth_tanl"] / np.sqrt(1 + tracks["truth_tanl"] ** 2)
    tracks = tracks.with_columns(res_dr=(0.1 + 0.2 * (np.abs(cos) > 0.4)) * tracks["pull_dr"])
    edges = [-0.8, -0.4, 0.4, 0.8]
    curve = resolution_against(tracks, "dr", "cos_theta", edges)
    assert_within(curve.column("core"), [300, 100, 300], curve.column("core_error"))
    assert curve.column("n").sum() + curve.outside == N
    assert curve.outside == np.count_nonzero(np.abs(cos) > 0.8)
    for x, low, high in zip(curve.x, edges[:-1], edges[1:], strict=True):
        assert x == pytest.approx(cos[(cos >= low) & (cos < high)].mean())
    by_charge = resolution_against(tracks, "dr", "charge", [-1.5, 0, 1.5])
    assert by_charge.column("n").tolist() == [N / 2, N / 2]
    pull = resolution_against(tracks, "dr", "p", 1, kind="pull")
    assert pull.values[0].core == pulls(tracks)["dr"].core
    assert pull.values[0].unit == ""


def test_bins_hold_their_limits_once():
    """A row on a limit belongs to the upper bin, on the last limit to the last one."""
    tracks = make_tracks(5, truth_p=[0.0, 1.0, 2.0, 3.0, np.nan])
    assert resolution_against(tracks, "p", "p", [0, 1, 2]).column("n").tolist() == [1, 2]
    assert resolution_against(tracks, "p", "p", [0, 1, 2]).outside == 2


def test_chi2_probability_is_flat_only_if_the_errors_are_right():
    """A right chi-square is flat, also against scipy; errors 2 % too small are seen in 20 000 tracks."""
    tracks = make_tracks()
    probability = chi2_probability(tracks)
    np.testing.assert_allclose(probability, scipy_stats.chi2.sf(tracks["chi2"], 20), rtol=1e-10)
    flat = chi2_flatness(tracks)
    assert flat.kolmogorov == pytest.approx(scipy_stats.kstest(probability, "uniform").pvalue, abs=0.002)
    counts = np.histogram(probability, 20, (0, 1))[0]
    assert flat.binned == pytest.approx(scipy_stats.chisquare(counts).pvalue)
    assert min(flat.kolmogorov, flat.binned) > 0.001
    assert_within(flat.mean, 0.5, flat.mean_error)
    wrong = chi2_flatness(make_tracks(chi2=tracks["chi2"] * 1.02**2))
    assert max(wrong.kolmogorov, wrong.binned) < 1e-6
    with pytest.raises(ValueError, match="bins"):
        chi2_flatness(make_tracks(50))


def test_chi2_probability_leaves_out_what_has_none():
    """Failed fits and fits without degrees of freedom are counted, not used."""
    status, ndf = np.zeros(N, np.int8), np.full(N, 20)
    status[0], ndf[1] = FitStatus.seed_failed, 0
    flat = chi2_flatness(make_tracks(status=status, ndf=ndf))
    assert flat.n == N - 2
    assert flat.removed == (("seed_failed", 1), ("without a value", 1))


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


def test_results_compare_pickle_and_print():
    """Results survive pickling, NaN included, and print numbers with units in text and HTML."""
    tracks = make_tracks(2000)
    curve = resolution_against(tracks, "dr", "p", [0, 0.5, 2])
    assert math.isnan(curve.values[0].core)
    for one in (resolution(tracks, "dr"), pulls(tracks), curve, chi2_flatness(tracks), gaussian_fit([1.0] * 20)):
        again = pickle.loads(pickle.dumps(one))
        assert again == one
        assert hash(again) == hash(one)
        assert one != resolution(tracks, "dz")
        assert "±" in repr(one) or "Gaussian" in repr(one)
    assert "dr [um]" in resolution(tracks, "dr")._repr_html_()
    assert repr(pulls(tracks)).count("\n") == 1 + len(PARAMETERS)
    assert "kappa" in pulls(tracks)._repr_html_()
    assert "p [GeV/c]" in repr(curve)
    assert "0.5 to 2" in curve._repr_html_()
    with pytest.raises(AttributeError):
        resolution(tracks, "dr").core = 1


def test_a_study_of_20000_tracks_takes_milliseconds():
    """One resolution takes a few milliseconds (the best of five: other programs may be running)."""
    tracks = make_tracks()
    times = []
    for _ in range(5):
        start = time.perf_counter()
        resolution(tracks, "dr")
        times.append(time.perf_counter() - start)
    assert min(times) < 0.02
