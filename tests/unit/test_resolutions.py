"""Resolutions and pulls of tracks whose residuals are known."""

import math
import pickle

import numpy as np
import pytest

from cgemit._core import FitStatus
from cgemit.chain import run
from cgemit.particles.gun import Gun
from cgemit.study import chi2_flatness, gaussian_fit, measure, pulls, resolution, resolution_against
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
