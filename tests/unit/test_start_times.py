"""The fitted start time of events: against the shift of their drift times, and against chi-square at other times."""

import numpy as np
import pytest

import cgemit as cg
from cgemit.detector.drift import XT_DISTANCE, XT_TIME, distance_at, shifted, velocity_at
from cgemit.reconstruction.fit import fit
from cgemit.reconstruction.reconstruct import reconstruct
from cgemit.reconstruction.refine import StartTimeStatus, refinements, start_subtracted
from cgemit.simulation.background import start_times
from stats import assert_within, mean_error

PAIR = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)) + cg.Gun("mu+", p=0.5, cos_theta=(-0.8, 0.8))
EVENTS, SPREAD = 300, 10.0


def run(spread=SPREAD, gun=PAIR, n=EVENTS, **more):
    settings = cg.Settings(background=cg.BackgroundSettings(start_time=spread))
    return cg.run("besiii-idc", gun, n=n, settings=settings, **more)


@pytest.fixture(scope="module")
def pairs():
    return run()


@pytest.fixture(scope="module")
def fitted(pairs):
    return refit(pairs)


def refit(made, wire_hits=None, start_time="fitted", start_time_error=None, candidates=None, hits=None, **settings):
    found = {"candidates": made.candidates, "candidate_hits": made.candidate_hits}
    found |= {} if candidates is None else {"candidates": candidates}
    found |= {} if hits is None else {"candidate_hits": hits}
    measured = (made.clusters, made.wire_hits if wire_hits is None else wire_hits)
    if start_time == "given":
        return fit(made.detector, *measured, *found.values(), cg.FitSettings(**settings))
    how = cg.RefineSettings(start_time=start_time, start_time_error=start_time_error)
    return reconstruct(
        made.detector, *measured, lambda *_: found, cg.FitSettings(**settings), refinements=refinements(how),
        find_again=False,
    )  # fmt: skip


def corrected(wire_hits, times):
    return start_subtracted(wire_hits, times["event"], times["start_time"])


def test_the_pull_of_the_start_time_has_width_one(fitted):
    times = fitted["start_times"]
    assert np.all(times["status"] == StartTimeStatus.ok)
    assert np.all(times["n_tracks"] == 2)
    off = times["start_time"] - start_times(times["event"], SPREAD, 1)
    pull = off / times["err_start_time"]
    assert_within(pull.mean(), 0.0, mean_error(pull), what="mean")
    assert_within(pull.std(), 1.0, 1 / np.sqrt(2 * EVENTS), what="width")
    assert np.median(times["err_start_time"]) < 0.7  # ns


def test_chi_square_is_least_at_the_fitted_time_and_grows_with_its_error(pairs, monkeypatch):
    """Sides known and nothing left out: chi2 is a parabola, which three other fits of the same hits give."""
    monkeypatch.setattr("cgemit.reconstruction.refine.CERTAIN", 0.0)
    sides = np.sign(pairs.wire_truths["doca"])[pairs.wire_hits["wire_truth"]].astype(np.int8)
    hits = pairs.wire_hits.with_columns(side=sides)
    plain = {"outlier_pull": 0.0, "kinks": False, "tolerance": 1e-4}
    found = refit(pairs, hits, **plain)
    at = found["start_times"]["start_time"][hits["event"]]
    chi2 = []
    for step in (-1.0, 0.0, 1.0):
        drift = shifted(hits["drift"], hits["drift_time"], -at - step)
        moved = hits.with_columns(drift=drift, drift_time=hits["drift_time"] - at - step)
        tracks = refit(pairs, moved, start_time="given", **plain)["tracks"]
        chi2.append(np.bincount(tracks["event"], tracks["chi2"], EVENTS))
    curvature, slope = 0.5 * (chi2[0] + chi2[2]) - chi2[1], 0.5 * (chi2[2] - chi2[0])
    error = found["start_times"]["err_start_time"]
    # The velocity changes at the points of its table, so that single events differ from a parabola.
    assert np.median(error * np.sqrt(curvature)) == pytest.approx(1.0, abs=0.01)
    assert np.std(error * np.sqrt(curvature)) < 0.05
    # The velocity at a measured time is anti-correlated with the error of the hit, moving the minimum by 0.1 ns. The
    # fit takes the velocity at the predicted distance, and has no such bias.
    least = -slope / (2 * curvature)
    assert np.mean(least) == pytest.approx(-0.1, abs=0.03)
    assert np.std(least / error) < 0.15


def test_tracks_are_as_good_as_with_the_exact_start_time(pairs, fitted):
    exact = run(spread=0.0)
    assert np.array_equal(exact.wire_hits["wire"], pairs.wire_hits["wire"])
    errors = []
    for tracks in (exact.fitted, fitted["tracks"], pairs.fitted):
        off = tracks["kappa"] - exact.tracks["truth_kappa"]
        errors.append(np.median(np.abs(off)))
    assert errors[1] < 1.1 * errors[0]
    assert errors[2] > 1.3 * errors[0]
    pull = (fitted["tracks"]["kappa"] - exact.tracks["truth_kappa"]) / fitted["tracks"]["err_kappa"]
    assert_within(np.median(np.abs(pull)), 0.6745, 1.17 / np.sqrt(2 * EVENTS), what="pull of kappa")


def test_errors_of_tracks_include_that_of_the_start_time(pairs, fitted):
    """The helix moves with the start time: cov = cov at a known time + slope slope^T err^2."""
    times = fitted["start_times"]
    known = refit(pairs, corrected(pairs.wire_hits, times), start_time="given")["tracks"]
    later = times.with_columns(start_time=times["start_time"] + 1.0)
    moved = refit(pairs, corrected(pairs.wire_hits, later), start_time="given")["tracks"]
    error = times["err_start_time"][known["event"]]
    expected = known["err_kappa"] ** 2 + ((moved["kappa"] - known["kappa"]) * error) ** 2
    ratio = fitted["tracks"]["err_kappa"] ** 2 / expected
    assert np.median(ratio) == pytest.approx(1.0, abs=1e-3)
    assert np.quantile(np.abs(ratio - 1), 0.9) < 0.05
    assert np.max(fitted["tracks"]["err_kappa"] / known["err_kappa"]) > 1.01
    assert np.array_equal(fitted["tracks"]["kappa"], known["kappa"])
    cov = fitted["tracks"]["cov"]
    assert np.allclose(np.sqrt(cov[:, 2, 2]), fitted["tracks"]["err_kappa"], rtol=1e-12)


def test_the_error_falls_with_the_number_of_tracks():
    one = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    errors = [
        np.median(refit(run(gun=gun, n=100))["start_times"]["err_start_time"]) for gun in (one, one + one + one + one)
    ]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.05)


def test_a_start_time_given_with_an_error_is_taken_into_account():
    near = run(spread=0.5)
    free, bound = (refit(near, start_time_error=error)["start_times"] for error in (None, 0.5))
    share = 0.5**2 / (0.5**2 + free["err_start_time"] ** 2)
    assert np.allclose(bound["err_start_time"], 0.5 * np.sqrt(1 - share), rtol=0.1)
    assert np.median(bound["start_time"] / (share * free["start_time"])) == pytest.approx(1.0, abs=0.02)
    wide = refit(near, start_time_error=1000.0)["start_times"]
    assert np.allclose(wide["start_time"], free["start_time"], atol=0.3)


def test_a_track_of_another_time_does_not_count():
    """Every third track comes 60 ns late: the other two give the start time."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    made = run(gun=gun + gun + gun, n=60)
    hits = made.wire_hits
    late = np.where(made.wire_truths["particle"][hits["wire_truth"]] == 2, 60.0, 0.0)
    time = hits["drift_time"]
    hits = hits.with_columns(drift_time=time + late, drift=shifted(hits["drift"], time, late))
    times = refit(made, hits)["start_times"]
    pull = (times["start_time"] - start_times(times["event"], SPREAD, 1)) / times["err_start_time"]
    assert np.mean(times["n_tracks"] == 2) > 0.9
    assert np.all(np.abs(pull) < 4.5)
    assert_within(pull.std(), 1.0, 1 / np.sqrt(2 * 60), what="width")


def test_an_event_without_a_good_track_keeps_its_start_time(pairs):
    few = pairs.candidate_hits[pairs.candidate_hits["event"] != 7]
    for error, expected in ((None, np.nan), (3.0, 3.0)):
        times = refit(pairs, hits=few, start_time_error=error)["start_times"]
        assert (times["status"][7], times["n_tracks"][7]) == (StartTimeStatus.no_track, 0)
        assert times["start_time"][7] == 0
        assert np.array_equal(times["err_start_time"][7], expected, equal_nan=True)
        assert times["status"].sum() == StartTimeStatus.no_track
    nothing = refit(pairs, candidates=pairs.candidates[:0], hits=few[:0])
    assert np.all(nothing["start_times"]["status"] == StartTimeStatus.no_track)
    assert len(nothing["tracks"]) == 0


def test_hits_without_drift_times_are_refused(pairs):
    hits = pairs.wire_hits.with_columns(drift_time=np.full(len(pairs.wire_hits), np.nan))
    with pytest.raises(ValueError, match=r"start_time: got 'fitted' and \d+ of \d+ wire hits without a drift_time"):
        refit(pairs, hits)
    with pytest.raises(ValueError, match=r"start_time_error: got 2\.0, expected none unless start_time is 'fitted'"):
        cg.RefineSettings(start_time_error=2.0)


def test_a_run_fits_start_times_if_asked_and_finds_again_with_them(tmp_path):
    settings = cg.Settings(
        background=cg.BackgroundSettings(start_time=SPREAD), refine=cg.RefineSettings(start_time="fitted")
    )
    found = cg.run("besiii-cgem", PAIR, n=60, settings=settings, finder="ckf", workers=cg.Workers(threads=1, chunk=60))
    parts = cg.run("besiii-cgem", PAIR, n=60, settings=settings, finder="ckf", workers=cg.Workers(threads=1, chunk=17))
    assert found.start_times == parts.start_times
    times = found.start_times
    pull = (times["start_time"] - start_times(np.arange(60), SPREAD, 1)) / times["err_start_time"]
    good = times["status"] == StartTimeStatus.ok
    assert good.sum() >= 58
    assert np.median(np.abs(pull[good])) < 1
    given = cg.Settings(background=cg.BackgroundSettings(start_time=SPREAD))
    before = cg.run("besiii-cgem", PAIR, n=60, settings=given, finder="ckf", workers=1)
    assert before.start_times is None
    assert found.fitted["n_wires"].sum() > before.fitted["n_wires"].sum() + 60
    found.save(tmp_path / "run")
    assert cg.open(tmp_path / "run").start_times == found.start_times


def test_distances_and_velocities_follow_the_table():
    assert np.allclose(distance_at(XT_TIME), XT_DISTANCE)
    assert np.allclose(distance_at([-10.0, 400.0]), [-0.5, 8.7])
    assert np.allclose(velocity_at([-1.0, 0.2, 1.0, 8.0, 20.0]), [0.05, 0.05, 0.7 / 15, 0.008, 0.008])
    time = np.array([5.0, 60.0])
    assert np.allclose(shifted(np.array([0.3, 2.4]), time, 5.0), [0.55, 2.56])
