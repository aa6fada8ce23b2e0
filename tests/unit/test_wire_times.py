"""Flight and propagation in drift times: by hand, against integrated paths, and against runs without them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cgemit as cg
import gem_toy
from cgemit.detector.drift import distance_at, propagation_time, shifted, velocity_at
from cgemit.reconstruction.fit import fit
from cgemit.reconstruction.refine import expected
from cgemit.reconstruction.refine import times_along_tracks as along_tracks
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
        **{k: more.pop(k) for k in ("fit", "background") if k in more},
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


def path(dr, phi0, kappa, dz, tanl, layer):
    """Length of the path from the perigee to the wires of a layer, and z there, from the equation of motion in -1 T."""
    direction = np.array([-np.sin(phi0), np.cos(phi0), tanl]) / np.hypot(1, tanl)
    p = np.hypot(1, tanl) / abs(kappa)
    turn = np.sign(kappa) * LIGHT * 1e-6 / p  # 1/(mm T) per GeV/c: 0.2998 GeV/c in 1 T is a radius of 1 m

    def motion(_, state):
        return np.concatenate([state[3:], turn * np.cross(state[3:], [0, 0, -1.0])])

    def outside(_, state):
        (ex, ey, h), (wx, wy, _) = layer.end_points(0)
        share = 0.5 * (1 + state[2] / h)
        return np.hypot(*state[:2]) - np.hypot(wx + share * (ex - wx), wy + share * (ey - wy))

    outside.terminal = True
    begin = np.concatenate([[dr * np.cos(phi0), dr * np.sin(phi0), dz], direction])
    found = solve_ivp(motion, (0, 5000), begin, events=outside, rtol=1e-10, atol=1e-9)
    return found.t_events[0][0], found.y_events[0][0][2]


@pytest.mark.parametrize(
    "helix",
    [(0.0, 0.3, 1e-9, 0.0, 0.4), (1.5, 2.0, 1.2, -8.0, -0.9), (-3.0, -1.0, -2.4, 12.0, 0.7)],
    ids=["straight", "positive", "negative"],
)
@pytest.mark.parametrize("number", [1, 6, 12, 25, 42])
def test_delay_on_a_track_is_that_of_its_path(plain, helix, number):
    layer = IDC.drift_chamber.layers[number]
    row = np.flatnonzero((plain.candidate_hits["view"] == 2) & (plain.candidate_hits["candidate"] == 0))[0]
    hits = plain.candidate_hits[row : row + 1]
    wires = plain.wire_hits.with_columns(layer=np.full(len(plain.wire_hits), number, np.int32))
    names = ("dr", "phi0", "kappa", "dz", "tanl")
    p = np.hypot(1, helix[4]) / abs(helix[2])
    columns = {name: np.full(len(plain.fitted), value) for name, value in zip(names, helix, strict=True)}
    tracks = plain.fitted.with_columns(p=np.full(len(plain.fitted), p), **columns)
    found = along_tracks(IDC, wires, plain.candidates, hits, tracks)
    length, z = path(*helix, layer)
    speed = 220 if number < 8 else 240
    end = layer.half_length * (1 if number % 2 else -1)
    delay = length * np.hypot(p, MUON) / p / LIGHT + abs(z - end) / speed
    wire = hits["row"][0]
    assert wires["drift_time"][wire] - found["drift_time"][wire] == pytest.approx(delay, abs=2e-3)
    assert found["sigma"][wire] == wires["sigma"][wire]


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
    hits, late = found.wire_hits, true_delay(IDC, found.wire_truths)
    time = raw.wire_hits["drift_time"] - late[hits["wire_truth"]]
    off = np.abs(hits["drift_time"] - time)[row]
    assert np.quantile(off, 0.99) < 0.15  # ns
    assert np.median(off) < 0.02
    good = found.tracks["status"] == 0
    assert good.mean() > 0.99
    assert np.median(found.tracks["chi2"][good] / found.tracks["ndf"][good]) < 1.05


def test_hits_on_no_good_track_keep_the_expectation(plain, raw):
    tracks = plain.fitted.with_columns(status=np.ones(len(plain.fitted), np.int8))
    found = along_tracks(IDC, raw.wire_hits, plain.candidates, plain.candidate_hits, tracks)
    wanted = expected(IDC, raw.wire_hits)
    assert all(np.array_equal(found[name], wanted[name]) for name in wanted)


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
    other = run(n=30, finder=finder, chunk=7, threads=2)
    for name, table in one.tables.items():
        assert all(table[c].tobytes() == other.tables[name][c].tobytes() for c in table), name


def test_order_of_the_hits_of_candidates_does_not_matter(plain, raw):
    hits = plain.candidate_hits
    other = hits[np.lexsort((-np.arange(len(hits)), hits["event"]))]
    found = [along_tracks(IDC, raw.wire_hits, plain.candidates, one, plain.fitted) for one in (hits, other)]
    assert all(np.array_equal(found[0][name], found[1][name]) for name in found[0])


@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_start_times_are_fitted_from_raw_times(finder):
    """Without the right correction along the tracks, the start time would be wrong by nanoseconds."""
    background = cg.BackgroundSettings(start_time=5.0)
    found = run(n=200, finder=finder, fit=cg.FitSettings(start_time="fitted"), background=background)
    times = found.start_times
    good = times["status"] == 0
    assert good.mean() > 0.97
    pull = ((times["start_time"] - start_times(times["event"], 5.0, 1)) / times["err_start_time"])[good]
    assert_within(pull.mean(), 0.0, mean_error(pull), what="mean")
    assert np.median(np.abs(pull)) < 0.8


def test_by_hand_as_in_the_chain(raw):
    """What docs/own_hits.md shows gives the same tracks as a run, hits by truth."""
    whole = run()
    made = run(until="find")
    hits = (made.candidates, made.candidate_hits)
    first = fit(IDC, made.clusters, expected(IDC, raw.wire_hits), *hits)
    corrected = along_tracks(IDC, raw.wire_hits, *hits, first["tracks"])
    assert all(np.array_equal(corrected[name], whole.wire_hits[name]) for name in corrected)
    assert np.array_equal(fit(IDC, made.clusters, corrected, *hits)["tracks"]["kappa"], whole.fitted["kappa"])


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
    assert np.all(np.isfinite(curls.wire_hits["drift_time"]))
