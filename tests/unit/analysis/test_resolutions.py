"""Resolutions, pulls and the forms of resolution curves on samples whose answers are known."""

import json
import math
import pickle

import numpy as np
import pytest
from scipy import stats as scipy_stats

import cgemit as cg
from cgemit._core.common import FitStatus
from cgemit.analysis.curves import track_spectrum
from cgemit.analysis.quantities import NAMES, QUANTITIES
from cgemit.analysis.resolutions import FORMS, fit_form, mean_sine
from cgemit.chain import run
from cgemit.particles.gun import Gun
from cgemit.particles.species import species
from cgemit.study import (
    chi2_flatness,
    chi2_probability,
    gaussian_fit,
    measure,
    pulls,
    resolution,
    resolution_against,
    resolutions,
)
from cgemit.tables import PARAMETERS
from fitted import N, make_tracks, rng
from stats import assert_within


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


@pytest.mark.parametrize("quantity", QUANTITIES.values(), ids=lambda one: one.name)
def test_every_name_that_is_shown_is_understood(quantity):
    """Names, symbols on axes and symbols of resolutions; p stands for the momentum, not for its relative resolution."""
    tracks = make_tracks(100)
    expected = resolution(tracks, quantity.name)
    shown = {quantity.name, quantity.sigma, *quantity.spellings, *([] if quantity.relative else [quantity.symbol])}
    for name in shown:
        assert resolution(tracks, name) == expected
        assert resolutions(tracks)[name] == expected
    covariance = cg.analytic("besiii-cgem-design")
    assert {covariance.sigma(name).tobytes() for name in shown} == {covariance.sigma(quantity.name).tobytes()}


def test_spellings_stand_for_one_quantity():
    texts = [
        [q.name, *q.spellings, q.sigma, *([] if q.relative else {q.symbol} - {q.name})] for q in QUANTITIES.values()
    ]
    assert sum(map(len, texts)) == len(NAMES)
    assert (NAMES["p"], NAMES["σ(p)"], NAMES["σ(p)/p"], NAMES["d_ρ"]) == ("p", "p", "p_rel", "dr")


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


def test_tracks_that_measure_no_first_half_turn_are_counted_by_class():
    """Clones, daughters, other half turns and fakes widen nothing; a class counts where the fit ended well."""
    match = np.zeros(N, np.int8)
    kinds = ("clone", "decay_daughter", "other_half_turn", "fake")
    match[:1], match[10:12], match[20:23], match[30:34] = (cg.MatchStatus[name] for name in kinds)
    status = np.zeros(N, np.int8)
    status[20] = FitStatus.not_converged
    residual = rng().normal(0, 0.2, N)
    residual[match != 0] = 1e9
    tracks = make_tracks(status=status, match=match, res_dr=residual, pull_dr=residual / 0.2)
    removed = (("not_converged", 1), ("clone", 1), ("decay_daughter", 2), ("other_half_turn", 2), ("fake", 4))
    for found in (
        resolution(tracks, "dr"), pulls(tracks)["dr"], resolution_against(tracks, "dr", "charge", [-2, 2]).values[0],
        track_spectrum(tracks, "dr").resolution,
    ):  # fmt: skip
        assert found.removed == removed
        assert (found.n, found.rms < 1000) == (N - 10, True)
    assert track_spectrum(tracks, "dr").counts["all"].sum() <= N - 10
    assert "2 other_half_turn, 4 fake" in repr(resolution(tracks, "dr"))


def test_misspelt_names_get_a_hint():
    """Unknown parameters, quantities and empty windows are refused."""
    tracks = make_tracks(100)
    with pytest.raises(ValueError, match='did you mean "kappa"'):
        resolution(tracks, "kapa")
    with pytest.raises(ValueError, match='did you mean "cos_theta"'):
        resolution_against(tracks, "dr", by="costheta")
    with pytest.raises(ValueError, match="parameter: got None; expected one of dr, "):
        resolution(tracks, None)
    with pytest.raises(ValueError, match="kind"):
        resolution_against(tracks, "dr", kind="res")
    with pytest.raises(ValueError, match="window"):
        resolution(tracks, "dr", window=(1, 1))
    for bins in (0, [1], [0, 0], [[0, 1]]):
        with pytest.raises(ValueError, match="bins"):
            resolution_against(tracks, "dr", bins=bins)


def test_tracks_are_those_of_a_result_or_of_a_table():
    """A result stands for its tracks; other tables and other things are refused in words."""
    result = run.run("besiii-cgem-design", Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), 120)
    for study in (pulls, chi2_flatness, lambda tracks: resolution(tracks, "p"), lambda t: resolution_against(t, "p")):
        assert study(result) == study(result.tracks)
        with pytest.raises(
            ValueError, match="tracks: got a table of kind 'clusters', expected a table of kind 'tracks'"
        ):
            study(result.clusters)
        with pytest.raises(TypeError, match="tracks: got NoneType, expected a table of kind 'tracks', or a Result"):
            study(None)


def test_tracks_without_truth_say_so():
    """Tracks that a fit alone made have neither residuals nor pulls."""
    r = cg.run("besiii-cgem", Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    fitted = cg.fit(r.detector, r.clusters, r.wire_hits, r.candidates, r.candidate_hits)["tracks"]
    for use in (pulls, lambda tracks: resolution(tracks, "dr"), resolutions):
        with pytest.raises(ValueError, match=r"got none with truth .*, expected those of a run"):
            use(fitted)


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
    columns = curve.columns()
    for row, (x, low, high) in enumerate(zip(curve.x, edges[:-1], edges[1:], strict=True)):
        assert x == pytest.approx(cos[(cos >= low) & (cos < high)].mean())
        assert [columns[name][row] for name in ("cos_theta_low", "cos_theta_high", "cos_theta")] == [low, high, x]
        assert all(columns[name][row] == getattr(curve.values[row], name) for name in ("n", "core", "q68_error", "rms"))
    by_charge = resolution_against(tracks, "dr", "charge", [-1.5, 0, 1.5])
    assert by_charge.column("n").tolist() == [N / 2, N / 2]
    pull = resolution_against(tracks, "dr", "p", 1, kind="pull")
    assert pull.values[0].core == pulls(tracks)["dr"].core
    assert pull.values[0].unit == ""


def test_columns_of_a_spectrum_are_counts_between_its_limits():
    tracks = make_tracks()
    found = track_spectrum(tracks, "dr", bins=12)
    window = found.resolution.window
    assert found.edges[0] <= window[0] < window[1] <= found.edges[-1]
    columns, values = found.columns(), 1000 * tracks["res_dr"][tracks["status"] == 0]
    assert list(columns) == ["low (um)", "high (um)", "all"]
    assert 6 <= len(columns["all"]) <= 20
    (width,) = {f"{high - low:.6g}" for low, high in zip(columns["low (um)"], columns["high (um)"], strict=True)}
    assert width.strip("0.")[0] in "125"
    assert len(width.strip("0.")) == 1 or width.strip("0.") == "25"
    for low, high, count in zip(*columns.values(), strict=True):
        assert low < high
        assert count == np.count_nonzero((values >= low) & (values < high))


def test_bins_hold_their_limits_once():
    """A row on a limit belongs to the upper bin, on the last limit to the last one."""
    tracks = make_tracks(5, truth_p=[0.0, 1.0, 2.0, 3.0, np.nan])
    assert resolution_against(tracks, "p", "p", [0, 1, 2]).column("n").tolist() == [1, 2]
    assert resolution_against(tracks, "p", "p", [0, 1, 2]).outside == 2


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


@pytest.mark.parametrize("by", ["p", "cos_theta", "pt"])
def test_tracks_of_one_angle_and_momentum_are_one_bin(by):
    result = run.run("besiii-cgem-design", Gun("mu-", p=1.0, theta=1), 40)
    curve = resolution_against(result, "p", by)
    assert curve.values == (resolution(result, "p"),)
    assert curve.outside == 0
    assert curve.edges[0] < curve.x[0] < curve.edges[1]
    assert len(resolution_against(result, "p", "cos_theta", [0, 0.5, 1]).values) == 2


@pytest.mark.parametrize("window", [5, (1,), (1, 2, 3), (2, 1), "ab", ("a", 1), (float("nan"), 1), 0])
def test_windows_are_two_numbers(window):
    with pytest.raises(ValueError, match=r"window: got .*; expected \(low, high\)"):
        measure(np.arange(20.0), window=window)
    assert measure(np.arange(20.0), window=[4.5, 14.5]).outside == 10


P = np.linspace(0.2, 2.0, 19)
COSINE = 0.6


def exact(quantity, a, b, particle="pi+"):
    """Return the form itself, written out."""
    sine = math.sqrt(1 - COSINE**2)
    beta = P / np.hypot(P, species(particle).mass)
    if quantity == "pt_rel":
        return np.hypot(a * P * sine, b / beta)
    return np.hypot(a, b / (P * beta * sine ** {"dr": 1.5, "dz": 2.5}[quantity]))


@pytest.mark.parametrize("quantity", list(FORMS))
@pytest.mark.parametrize(("a", "b"), [(0.7, 0.4), (120.0, 30.0), (0.3, 0.0), (0.0, 0.5)])
def test_known_parameters_come_back(quantity, a, b):
    y = exact(quantity, a, b)
    for error in (None, 0.02 * y):
        found = fit_form(quantity, P, y, error, particle="pi+", cos_theta=COSINE)
        # A parameter that is zero is found as the root of a square that is zero to rounding.
        np.testing.assert_allclose([found.a, found.b], [a, b], rtol=1e-5, atol=1e-3 * max(a, b))
        assert found.deviation < 1e-5
        assert found.points == 19


@pytest.mark.parametrize("quantity", list(FORMS))
def test_errors_cover_the_parameters(quantity):
    """Of 200 curves with Gaussian errors, a and b spread by their errors, and chi2 has its mean."""
    rng, n = np.random.default_rng(3), 200
    y = exact(quantity, 0.7, 0.4)
    error = 0.01 * y
    fits = [fit_form(quantity, P, rng.normal(y, error), error, particle="pi+", cos_theta=COSINE) for _ in range(n)]
    for name, true in (("a", 0.7), ("b", 0.4)):
        pull = np.array([(getattr(one, name) - true) / getattr(one, f"{name}_error") for one in fits])
        assert abs(pull.mean()) < 4 / math.sqrt(n)
        assert abs(pull.std() - 1) < 4 / math.sqrt(2 * n)
    assert abs(np.mean([one.chi2 for one in fits]) - 17) < 4 * math.sqrt(34 / n)


def test_the_form_of_pt_holds_for_slow_particles():
    """Scattering grows with 1/beta: of kaons down to 0.3 GeV/c a form without beta is off by 20 % and more."""
    p = np.linspace(0.3, 1.0, 8)
    sigma = cg.analytic("besiii-cgem-design", "K+", p=p).sigma("pt_rel")
    found = fit_form("pt_rel", p, sigma, particle="K+")
    assert found.formula == "sigma(pT)/pT = a pT (+) b/beta"
    assert found.deviation < 0.1
    without = fit_form("pt_rel", p, sigma, particle="e-")  # beta = 1
    assert without.deviation > 2 * found.deviation


def test_a_curve_without_errors_has_equal_relative_weights():
    y = exact("dr", 0.7, 0.4) * (1 + 0.05 * np.sin(7 * P))
    free, weighted = (fit_form("dr", P, y, error, particle="pi+", cos_theta=COSINE) for error in (None, 0.01 * y))
    np.testing.assert_allclose([free.a, free.b, free.deviation], [weighted.a, weighted.b, weighted.deviation])
    assert math.isnan(free.a_error)
    assert math.isnan(free.b_error)
    assert not free.statistical
    assert "no statistical error" in str(free)
    assert "±" not in str(free)
    assert json.loads(json.dumps(free.as_json(), allow_nan=False))["a_error"] is None
    assert weighted.statistical
    assert str(weighted).count("±") == 2
    model = exact("dr", free.a, free.b)
    assert free.deviation == pytest.approx(np.max(np.abs(model / y - 1)), rel=1e-9)


def test_points_without_resolution_are_left_out():
    y = exact("dz", 0.7, 0.4)
    y[:3] = np.nan
    assert fit_form("dz", P, y, particle="pi+", cos_theta=COSINE).points == 16
    assert fit_form("dz", P[:5], y[:5]) is None


def test_mean_powers_of_the_sine():
    assert mean_sine(0.6, 2.0) == pytest.approx(0.64)
    assert mean_sine((-0.5, 0.5), 2.0) == pytest.approx(1 - 0.25 / 3)
    assert mean_sine((-0.9, 0.9), -2.0) == pytest.approx(math.atanh(0.9) / 0.9)
    assert mean_sine([0.0, 0.6], 1.0) == pytest.approx(0.9)


def test_bad_arguments_are_listed_together():
    with pytest.raises(ValueError, match=r"(?s)quantity: got 'q'.*shapes \(2,\), \(1,\).*positive momenta"):
        fit_form("q", [0.0, 1.0], [1.0])


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


def test_a_term_of_nothing_is_zero():
    """A constant curve: what its rising term has left is rounding, and is not printed as 1.9e-159."""
    p = np.linspace(0.2, 2.0, 10)
    found = fit_form("dz", p, np.full(10, 0.3), particle="e-")
    assert (found.b, found.a) == (0.0, pytest.approx(0.3))
    assert "b = 0 mm GeV/c" in str(found)
    assert "e-1" not in str(found)
    small = fit_form("dz", p, np.hypot(0.3, 0.01 / p), particle="e-")  # 3 % of the constant
    assert small.b == pytest.approx(0.01, rel=1e-4)
    noisy = fit_form("dz", p, np.full(10, 0.3), np.full(10, 0.01), particle="e-")
    assert math.isfinite(noisy.b_error)
    assert noisy.b_error > 0


def test_errors_along_z_are_compared_with_the_prior_of_the_fit() -> None:
    """Of muons whose momentum is not measured, d_z is, unless it is no better than what the fit was given."""
    gun = cg.Gun("mu-", p=300.0, cos_theta=0.2)
    used = {}
    for sigma in (1000.0, 0.1):
        settings = cg.Settings(fit=cg.FitSettings(prior_sigma=(200.0, 0.5, 5.0, sigma, 2.0)))
        tracks = cg.run("besiii-cgem-design", gun, n=50, seed=3, settings=settings).tracks
        assert np.count_nonzero(tracks["status"] == cg.FitStatus.unconstrained) > 5
        used[sigma] = resolution(tracks, "dz").n
    assert used == {1000.0: 50, 0.1: 0}
