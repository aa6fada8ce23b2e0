"""Drift times along tracks and the start time: by hand, against integrated paths, and against chi-square."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cgemit as cg
import gem_toy
from cgemit.detector.drift import BESIII, DriftRelations, propagation_time
from cgemit.reconstruction.fit import fit
from cgemit.reconstruction.reconstruct import reconstruct
from cgemit.reconstruction.refine import DriftTimes, Hits, StartTimeStatus, Turn, flight, refinements, start_subtracted
from cgemit.reconstruction.refine import expected as expected_of_refine
from cgemit.simulation.background import start_times
from cgemit.simulation.digitize import digitize, true_delay
from stats import assert_within, mean_error

IDC = cg.load("besiii-idc")
LIGHT = 299.792458  # mm/ns
MUON = 0.1056583755
PAIR = cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)) + cg.Gun("mu+", p=0.4, cos_theta=(-0.9, 0.9))
RAW = cg.DigitizeSettings(wire_times="raw")


def run(detector=IDC, wire_times="raw", n=100, gun=PAIR, **more):
    settings = cg.Settings(
        digitize=cg.DigitizeSettings(wire_times=wire_times),
        **{k: more.pop(k) for k in ("fit", "refine", "background") if k in more},
    )
    return cg.run(detector, gun, n=n, settings=settings, **more)


@pytest.fixture(scope="module")
def raw():
    return run(until="digitize")


@pytest.fixture(scope="module")
def plain():
    return run(wire_times="corrected")


def test_propagation_by_hand():
    """Even layers are read out at -z, odd ones at +z; 220 mm/ns in the inner, 240 mm/ns in the outer chamber."""
    layer = np.array([2, 3, 8, 9])
    found = propagation_time(IDC, layer, np.array([100.0, 100.0, 100.0, 100.0]))
    by_hand = [(100 + 402) / 220, (408 - 100) / 220, (100 + 546) / 240, (546 - 100) / 240]
    np.testing.assert_allclose(found, by_hand, rtol=1e-14)


def test_raw_times_hold_flight_and_propagation(raw, plain):
    truths, row = raw.wire_truths, raw.wire_hits["wire_truth"]
    same = dict(zip(plain.wire_hits["wire_truth"], range(len(plain.wire_hits)), strict=True))
    kept = np.array([same.get(one, -1) for one in row])
    assert np.mean(kept < 0) < 1e-3  # in cells that both particles cross, the other one may be the first
    late = true_delay(IDC, truths)[row]
    time, drift = raw.wire_hits["drift_time"], raw.wire_hits["drift"]
    assert late.min() > 0.2
    assert late.max() < 20
    np.testing.assert_allclose(
        (time - late)[kept >= 0],
        run(until="digitize", wire_times="corrected").wire_hits["drift_time"][kept[kept >= 0]],
        atol=1e-9,
    )
    back = BESIII.shifted(drift, time, -late)
    np.testing.assert_allclose(back[kept >= 0], plain.wire_hits["drift"][kept[kept >= 0]], atol=1e-9)


def flown(dr, phi0, kappa, dz, tanl, steps, slope=0.0):
    """Positions and directions after lengths `steps`, mm, from the perigee, in a field of -(1 + slope z) T along z."""
    direction = np.array([-np.sin(phi0), np.cos(phi0), tanl]) / np.hypot(1, tanl)
    p = np.hypot(1, tanl) / abs(kappa)
    turn = np.sign(kappa) * LIGHT * 1e-6 / p  # 1/(mm T) per GeV/c: 0.2998 GeV/c in 1 T is a radius of 1 m

    def motion(_, state):
        return np.concatenate([state[3:], turn * np.cross(state[3:], [0, 0, -1.0 - slope * state[2]])])

    begin = np.concatenate([[dr * np.cos(phi0), dr * np.sin(phi0), dz], direction])
    found = solve_ivp(motion, (0, steps[-1]), begin, t_eval=steps, rtol=1e-10, atol=1e-9).y
    return found[:3], found[3:]


@pytest.mark.parametrize(
    "helix",
    [(0.0, 0.3, 1e-9, 0.0, 0.4), (1.5, 2.0, 1.2, -8.0, -0.9), (-3.0, -1.0, -2.4, 12.0, 0.7)],
    ids=["straight", "positive", "negative"],
)
@pytest.mark.parametrize("slope", [0.0, 3e-4], ids=["uniform", "map"])
def test_flight_to_states_is_that_of_the_path(plain, helix, slope):
    """In a field that falls by a third along the track, arcs between states 15 mm apart are good to a picosecond."""
    steps = np.concatenate([[0.0], np.sort(np.random.default_rng(1).uniform(80, 900, 55))])
    position, direction = flown(*helix, steps, slope)
    n, p = len(steps), np.hypot(1, helix[4]) / abs(helix[2])
    columns = {name: np.zeros((n, *plain_states()[name].shape[1:])) for name in plain_states()}
    columns |= dict(zip(("x", "y", "z", "px", "py", "pz"), [*position, *(p * direction)], strict=True))
    columns |= {"tanl": direction[2] / np.hypot(*direction[:2]), "track": np.zeros(n, np.int64)}
    states = cg.Table("states", {k: np.asarray(v, plain_states()[k].dtype) for k, v in columns.items()}, n_events=1)
    tracks = plain.fitted.with_columns(p=np.full(len(plain.fitted), p))
    found = flight(states, plain.candidates, tracks)
    np.testing.assert_allclose(found, steps * np.hypot(p, MUON) / p / LIGHT, atol=1e-3 if slope else 1e-9)


def plain_states():
    return cg.Table.empty("states", n_events=1)


def test_expectation_is_the_middle_of_the_wire(raw):
    found = expected_of_refine(IDC, raw.wire_hits)
    for number, speed in ((4, 220), (30, 240)):
        layer = IDC.drift_chamber.layers[number]
        here = raw.wire_hits["layer"] == number
        late = (raw.wire_hits["drift_time"] - found["drift_time"])[here]
        np.testing.assert_allclose(late, layer.r_mid / LIGHT + layer.half_length / speed, rtol=1e-12)
        spread = BESIII.velocity_at(found["drift"][here]) * 2 * layer.half_length / speed / np.sqrt(12)
        np.testing.assert_allclose(found["sigma"][here], np.hypot(0.13, spread))


@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_times_of_found_tracks_are_those_without_flight_and_propagation(raw, finder):
    found = run(finder=finder)
    assert np.array_equal(found.wire_hits["wire_truth"], raw.wire_hits["wire_truth"])
    row = found.candidate_hits["hit"][found.candidate_hits["view"] == 2]
    hits, late = found.refined_wire_hits, true_delay(IDC, found.wire_truths)
    time = raw.wire_hits["drift_time"] - late[hits["wire_truth"]]
    off = np.abs(hits["drift_time"] - time)[row]
    assert np.quantile(off, 0.99) < 0.15  # ns
    assert np.median(off) < 0.02
    good = found.tracks["status"] == 0
    assert good.mean() > 0.99
    assert np.median(found.tracks["chi2"][good] / found.tracks["ndf"][good]) < 1.05


def refined(raw, tables, states):
    turn = Turn(
        0, 2, Hits(raw.clusters, raw.wire_hits), tables.candidates, tables.candidate_hits, tables.fitted, None, states
    )
    return DriftTimes().refine(IDC, Hits(None, raw.wire_hits), turn).wire_hits


@pytest.fixture(scope="module")
def fitted():
    return run(wire_times="corrected", fit=cg.FitSettings(states=("origin", "hits")))


def test_hits_on_no_good_track_keep_the_expectation(fitted, raw):
    lost = fitted.states.with_columns(status=np.ones(len(fitted.states), np.int8))
    wanted = expected_of_refine(IDC, raw.wire_hits)
    found, moved = (refined(raw, fitted, states) for states in (lost, fitted.states))
    assert all(np.array_equal(found[name], wanted[name]) for name in wanted)
    assert np.mean(moved["drift_time"] != wanted["drift_time"]) > 0.9


@pytest.mark.parametrize(("z", "wins"), [((-500.0, 500.0), 0), ((500.0, -500.0), 1)])
def test_the_earliest_signal_of_a_cell_counts(z, wins):
    """Layer 20 is read out at -z: a signal from z = 500 mm comes 4.2 ns later than from -500 mm."""
    columns = gem_toy.wire_truth_columns(0, 20, 7, [2.8, 2.8])
    columns |= {"z": np.array(z), "time": np.array([1.0, 1.0]), "half_turn": np.zeros(2, np.int8)}
    none = cg.Table("truths", gem_toy.truth_columns(0, 0, np.zeros((0, 3)), np.zeros((0, 3))), 1)
    sharp = IDC.with_overrides({"drift_chamber.sigma": "1 um"})
    hits = digitize(sharp, none, cg.Table("wire_truths", columns, 1), RAW)["wire_hits"]
    assert hits["wire_truth"].tolist() == [wins]


def test_detectors_that_do_not_say_how_signals_run():
    text = r"wire_times: got 'raw' and stcf-like.* without drift_chamber.signal_speed \(layers .* and \d+ more\) and "
    with pytest.raises(ValueError, match=text + r"drift_chamber.readout_end"):
        run("stcf-like", n=1)
    assert len(run("stcf-like", n=1, until="simulate").wire_truths)
    known = {"drift_chamber.signal_speed": "24 cm/ns", "drift_chamber.readout_end": "+z"}
    assert run(cg.load("stcf-like").with_overrides(known), n=2).n_events == 2
    with pytest.raises(ValueError, match="one of "):
        IDC.with_overrides({"drift_chamber.readout_end": "west"})
    with pytest.raises(ValueError, match="wire_times: got 'late'"):
        cg.DigitizeSettings(wire_times="late")


def test_hits_without_drift_time_are_refused(raw):
    time = raw.wire_hits["drift_time"].copy()
    time[3] = np.nan
    with pytest.raises(ValueError, match=r"1 of .* have no drift_time"):
        expected_of_refine(IDC, raw.wire_hits.with_columns(drift_time=time))
    layer = raw.wire_hits["layer"].copy()
    layer[3] = 77
    with pytest.raises(ValueError, match="no wire layer 77"):
        expected_of_refine(IDC, raw.wire_hits.with_columns(layer=layer))


@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_results_do_not_depend_on_chunks_and_threads(finder):
    one = run(n=30, finder=finder)
    other = run(n=30, finder=finder, workers=cg.Workers(threads=2, chunk=7))
    for name, table in one.tables.items():
        assert all(table[c].tobytes() == other.tables[name][c].tobytes() for c in table), name


@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_start_times_are_fitted_from_raw_times(finder):
    """Without the right correction along the tracks, the start time would be wrong by nanoseconds."""
    background = cg.BackgroundSettings(start_time=5.0)
    found = run(n=100, finder=finder, refine=cg.RefineSettings(start_time="fitted"), background=background)
    times = found.start_times
    good = times["status"] == 0
    assert good.mean() > 0.97
    pull = ((times["start_time"] - start_times(times["event"], 5.0, 1)) / times["err_start_time"])[good]
    assert_within(pull.mean(), 0.0, mean_error(pull), what="mean")
    assert np.median(np.abs(pull)) < 0.8


@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_measured_hits_stay_as_they_are(finder):
    """A run that ends before the fit has the same wire hits; those corrected have a name of their own."""
    measured, whole = (run(finder=finder, until=until).wire_hits for until in ("digitize", "fit"))
    assert measured == whole
    assert np.all(run(finder=finder).refined_wire_hits["drift_time"] < measured["drift_time"])


def test_hits_of_other_programs_as_in_the_chain():
    """What docs/how-to/own_hits.md shows gives the same tracks as a run."""
    whole = run(finder="ckf")
    wires = {name: whole.wire_hits[name] for name in ("event", "layer", "wire", "drift", "drift_time", "sigma")}
    found = cg.fit_hits(IDC, None, wires, candidates=cg.find_tracks, refine=cg.RefineSettings(drift_times="raw"))
    np.testing.assert_allclose(found["tracks"]["kappa"], whole.fitted["kappa"], rtol=1e-12)
    assert np.array_equal(found["refined_wire_hits"]["drift"], whole.refined_wire_hits["drift"])


def test_distance_is_that_of_the_raw_time(raw):
    off = raw.wire_hits["drift"] - BESIII.distance_at(raw.wire_hits["drift_time"])
    assert np.abs(off).max() < 1e-9


def test_background_mixed_events_and_half_turns(tmp_path):
    """Particles of 80 MeV/c curl; the other hits of the events are noise and those of other events."""
    run(n=20, until="digitize").save(tmp_path / "other")
    background = cg.BackgroundSettings(level="bes2009", events=str(tmp_path / "other"), offset=(-100.0, 500.0))
    found = run(n=40, finder="ckf", background=background)
    own = (found.tracks["truth_p"] > 0.39) & (found.tracks["status"] == 0)
    assert np.count_nonzero(own) >= 76
    off = (found.tracks["p"] - found.tracks["truth_p"])[own]
    assert np.median(np.abs(off)) < 0.01
    settings = cg.Settings(digitize=RAW, simulate=cg.SimulateSettings(half_turns=4))
    curls = cg.run(IDC, cg.Gun("mu-", p=0.08, cos_theta=0.3), n=10, settings=settings, finder="ckf")
    turn = curls.wire_truths["half_turn"][curls.wire_hits["wire_truth"]]
    assert np.any(turn > 0)
    assert np.all(np.isfinite(curls.refined_wire_hits["drift_time"]))


PAIR_START = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)) + cg.Gun("mu+", p=0.5, cos_theta=(-0.8, 0.8))
EVENTS, SPREAD = 300, 10.0


def run_start(spread=SPREAD, gun=PAIR_START, n=EVENTS, **more):
    settings = cg.Settings(background=cg.BackgroundSettings(start_time=spread))
    return cg.run("besiii-idc", gun, n=n, settings=settings, **more)


@pytest.fixture(scope="module")
def pairs():
    return run_start()


@pytest.fixture(scope="module")
def fitted_start(pairs):
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
    return start_subtracted(DriftRelations(()), wire_hits, times["event"], times["start_time"])


def test_the_pull_of_the_start_time_has_width_one(fitted_start):
    times = fitted_start["start_times"]
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
        drift = BESIII.shifted(hits["drift"], hits["drift_time"], -at - step)
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


def test_tracks_are_as_good_as_with_the_exact_start_time(pairs, fitted_start):
    exact = run_start(spread=0.0)
    assert np.array_equal(exact.wire_hits["wire"], pairs.wire_hits["wire"])
    errors = []
    for tracks in (exact.fitted, fitted_start["tracks"], pairs.fitted):
        off = tracks["kappa"] - exact.tracks["truth_kappa"]
        errors.append(np.median(np.abs(off)))
    assert errors[1] < 1.1 * errors[0]
    assert errors[2] > 1.3 * errors[0]
    pull = (fitted_start["tracks"]["kappa"] - exact.tracks["truth_kappa"]) / fitted_start["tracks"]["err_kappa"]
    assert_within(np.median(np.abs(pull)), 0.6745, 1.17 / np.sqrt(2 * EVENTS), what="pull of kappa")


def test_errors_of_tracks_include_that_of_the_start_time(pairs, fitted_start):
    """The helix moves with the start time: cov = cov at a known time + slope slope^T err^2."""
    times = fitted_start["start_times"]
    known = refit(pairs, corrected(pairs.wire_hits, times), start_time="given")["tracks"]
    later = times.with_columns(start_time=times["start_time"] + 1.0)
    moved = refit(pairs, corrected(pairs.wire_hits, later), start_time="given")["tracks"]
    error = times["err_start_time"][known["event"]]
    expected = known["err_kappa"] ** 2 + ((moved["kappa"] - known["kappa"]) * error) ** 2
    ratio = fitted_start["tracks"]["err_kappa"] ** 2 / expected
    assert np.median(ratio) == pytest.approx(1.0, abs=1e-3)
    assert np.quantile(np.abs(ratio - 1), 0.9) < 0.05
    assert np.max(fitted_start["tracks"]["err_kappa"] / known["err_kappa"]) > 1.01
    assert np.array_equal(fitted_start["tracks"]["kappa"], known["kappa"])
    tracks, cov = fitted_start["tracks"], fitted_start["tracks"]["cov"]
    by_kappa = -tracks["p"] / tracks["kappa"]
    by_tanl = tracks["p"] * tracks["tanl"] / (1 + tracks["tanl"] ** 2)
    slope = np.stack([by_kappa, by_tanl], axis=1)
    of_p = np.einsum("ni,nij,nj->n", slope, cov[:, 2::2, 2::2], slope)
    assert np.allclose(tracks["err_p"], np.sqrt(of_p), rtol=1e-9)
    assert np.allclose(np.sqrt(cov[:, 2, 2]), fitted_start["tracks"]["err_kappa"], rtol=1e-12)


def test_the_error_falls_with_the_number_of_tracks():
    one = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    errors = [
        np.median(refit(run_start(gun=gun, n=100))["start_times"]["err_start_time"])
        for gun in (one, one + one + one + one)
    ]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.05)


def test_a_start_time_given_with_an_error_is_taken_into_account():
    near = run_start(spread=0.5)
    free, bound = (refit(near, start_time_error=error)["start_times"] for error in (None, 0.5))
    share = 0.5**2 / (0.5**2 + free["err_start_time"] ** 2)
    assert np.allclose(bound["err_start_time"], 0.5 * np.sqrt(1 - share), rtol=0.1)
    assert np.median(bound["start_time"] / (share * free["start_time"])) == pytest.approx(1.0, abs=0.02)
    wide = refit(near, start_time_error=1000.0)["start_times"]
    assert np.allclose(wide["start_time"], free["start_time"], atol=0.3)


def test_a_track_of_another_time_does_not_count():
    """Every third track comes 60 ns late: the other two give the start time."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    made = run_start(gun=gun + gun + gun, n=60)
    hits = made.wire_hits
    late = np.where(made.wire_truths["particle"][hits["wire_truth"]] == 2, 60.0, 0.0)
    time = hits["drift_time"]
    hits = hits.with_columns(drift_time=time + late, drift=BESIII.shifted(hits["drift"], time, late))
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
        all_events = refit(pairs, start_time_error=error)["start_times"]
        assert np.array_equal(np.delete(times["status"], 7), np.delete(all_events["status"], 7))
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
    found = cg.run(
        "besiii-cgem", PAIR_START, n=60, settings=settings, finder="ckf", workers=cg.Workers(threads=1, chunk=60)
    )
    parts = cg.run(
        "besiii-cgem", PAIR_START, n=60, settings=settings, finder="ckf", workers=cg.Workers(threads=1, chunk=17)
    )
    assert found.start_times == parts.start_times
    times = found.start_times
    pull = (times["start_time"] - start_times(np.arange(60), SPREAD, 1)) / times["err_start_time"]
    good = times["status"] == StartTimeStatus.ok
    assert good.sum() >= 58
    assert np.median(np.abs(pull[good])) < 1
    given = cg.Settings(background=cg.BackgroundSettings(start_time=SPREAD))
    before = cg.run("besiii-cgem", PAIR_START, n=60, settings=given, finder="ckf", workers=1)
    assert before.start_times is None
    assert found.fitted["n_wires"].sum() > before.fitted["n_wires"].sum() + 60
    found.save(tmp_path / "run")
    assert cg.open(tmp_path / "run").start_times == found.start_times


def test_distances_and_velocities_follow_the_table():
    assert np.allclose(BESIII.distance_at(BESIII.time), BESIII.distance)
    assert np.allclose(BESIII.distance_at([-10.0, 400.0]), [-0.5, 8.7])
    assert np.allclose(BESIII.velocity_at([-1.0, 0.2, 1.0, 8.0, 20.0]), [0.05, 0.05, 0.7 / 15, 0.008, 0.008])
    time = np.array([5.0, 60.0])
    assert np.allclose(BESIII.shifted(np.array([0.3, 2.4]), time, 5.0), [0.55, 2.56])


def test_raw_times_of_cosmic_muons():
    """The flight of the upper half is negative, with and without tracks; a run of cosmic muons takes that itself."""
    muons = cg.sample("cosmic", p=3.0)
    result = run(gun=muons, n=60)
    late = true_delay(IDC, result.wire_truths)[result.wire_hits["wire_truth"]]
    true = result.wire_hits["drift_time"] - late
    used = result.refined_wire_hits["drift_time"] - true
    upper = result.wire_truths["y"][result.wire_hits["wire_truth"]] > 0
    assert np.median(late[upper]) < np.median(late[~upper]) - 2
    for half in (upper, ~upper):  # vertices are spread by 8 mm across the beam, 0.03 ns
        assert abs(np.median(used[half])) < 0.02
        assert np.median(np.abs(used[half])) < 0.05
    flown = np.hypot(result.wire_truths["x"], result.wire_truths["y"])[result.wire_hits["wire_truth"]] / LIGHT
    guess = expected_of_refine(IDC, result.wire_hits, cosmic=True)["drift_time"] - true
    assert abs(np.median(guess[upper])) < 0.5
    outward = expected_of_refine(IDC, result.wire_hits)["drift_time"] - true
    assert np.median((outward - guess)[upper] / flown[upper]) == pytest.approx(-2, abs=0.05)
    with pytest.warns(UserWarning, match="some particles fly backward"):
        run(gun=muons + cg.Gun("mu-", p=1.0, cos_theta=0.0), n=1)
    again = run(gun=result.particles, n=60)
    assert np.array_equal(again.refined_wire_hits["drift_time"], result.refined_wire_hits["drift_time"])
