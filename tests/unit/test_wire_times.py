"""Flight and propagation in drift times: by hand, against integrated paths, and against runs without them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cgemit as cg
import gem_toy
from cgemit.detector.drift import distance_at, propagation_time, shifted, velocity_at
from cgemit.reconstruction.refine import DriftTimes, Hits, Turn, expected, flight
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
    back = shifted(drift, time, -late)
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
    found = expected(IDC, raw.wire_hits)
    for number, speed in ((4, 220), (30, 240)):
        layer = IDC.drift_chamber.layers[number]
        here = raw.wire_hits["layer"] == number
        late = (raw.wire_hits["drift_time"] - found["drift_time"])[here]
        np.testing.assert_allclose(late, layer.r_mid / LIGHT + layer.half_length / speed, rtol=1e-12)
        spread = velocity_at(found["drift"][here]) * 2 * layer.half_length / speed / np.sqrt(12)
        np.testing.assert_allclose(found["sigma"][here], np.hypot(0.13, spread))


@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_times_of_found_tracks_are_those_without_flight_and_propagation(raw, finder):
    found = run(finder=finder)
    assert np.array_equal(found.wire_hits["wire_truth"], raw.wire_hits["wire_truth"])
    row = found.candidate_hits["row"][found.candidate_hits["view"] == 2]
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
    wanted = expected(IDC, raw.wire_hits)
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
        expected(IDC, raw.wire_hits.with_columns(drift_time=time))
    layer = raw.wire_hits["layer"].copy()
    layer[3] = 77
    with pytest.raises(ValueError, match="no wire layer 77"):
        expected(IDC, raw.wire_hits.with_columns(layer=layer))


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
    found = run(n=200, finder=finder, refine=cg.RefineSettings(start_time="fitted"), background=background)
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
    """What docs/own_hits.md shows gives the same tracks as a run."""
    whole = run(finder="ckf")
    wires = {name: whole.wire_hits[name] for name in ("event", "layer", "wire", "drift", "drift_time", "sigma")}
    found = cg.fit_hits(IDC, None, wires, candidates=cg.find_tracks, refine=cg.RefineSettings(drift_times="raw"))
    np.testing.assert_allclose(found["tracks"]["kappa"], whole.fitted["kappa"], rtol=1e-12)
    assert np.array_equal(found["refined_wire_hits"]["drift"], whole.refined_wire_hits["drift"])


def test_distance_is_that_of_the_raw_time(raw):
    off = raw.wire_hits["drift"] - distance_at(raw.wire_hits["drift_time"])
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
