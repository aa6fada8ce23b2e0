"""When events began in the times of their strips: against the times that were given, with pile-up and without."""

import numpy as np
import pytest

import cgemit as cg
from cgemit.reconstruction import strip_times as module
from cgemit.reconstruction.strip_times import LEAST_STRIPS, StripTimeStatus, arrivals_of
from stats import assert_within, mean_error

EVENTS, OFFSET = 300, -8645.0  # ns
CGEM = cg.load("besiii-cgem").with_readout("tiger")
GUN = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))


def delayed(digis, by):
    """Digis whose times count from elsewhere: later by a number of each event."""
    return digis.with_columns(time=digis["time"] + by[np.searchsorted(digis.events, digis["event"])])


@pytest.fixture(scope="module")
def clean():
    return cg.run(CGEM, GUN, n=EVENTS, seed=5, until="digitize").digis


@pytest.fixture(scope="module")
def start():
    return np.random.default_rng(1).uniform(0, 1000, EVENTS)


def test_each_event_tells_its_own_time(clean, start):
    found = cg.strip_times(CGEM, delayed(clean, start))
    good = found["status"] == StripTimeStatus.ok
    assert good.mean() > 0.95
    away = (found["strip_time"] - start)[good]
    assert np.std(away) < 10.5  # ns: without the delay of the chip it is 13
    assert_within(away.mean(), 0.0, mean_error(away), 3.0)
    pull = away / found["err_strip_time"][good]
    assert 0.8 < np.std(pull) < 1.05  # the constant density of other strips, of which there are none, adds to the error
    assert not found["n_outside"].any()


def test_start_times_of_wires_give_one_constant(clean, start):
    found = cg.strip_times(CGEM, delayed(clean, start + OFFSET), start=start)
    offset, err = found.meta["offset"], found.meta["err_offset"]
    assert err < 1.0
    assert_within(offset, OFFSET, err, 3.0)
    np.testing.assert_allclose(found["strip_time"], start + offset)
    assert (found["err_strip_time"] == err).all()


def test_events_do_not_depend_on_each_other(clean, start):
    late = delayed(clean, start)
    alone = cg.strip_times(CGEM, late.select_events(7, 8))
    of_all = cg.strip_times(CGEM, late)
    assert alone["strip_time"][0] == of_all["strip_time"][7]


def test_another_particle_deceives_an_event_alone_but_not_with_its_wires(clean, start):
    """A second particle, 150 to 500 ns later, fires as many strips: many events take its time."""
    digis = cg.run(CGEM, GUN, n=EVENTS, seed=6, until="digitize").digis
    wires = cg.run(CGEM, GUN, n=EVENTS, seed=5, until="digitize").wire_hits
    both = cg.mix_events(CGEM, clean, wires, {"digis": digis, "wire_hits": wires}, offset=(150.0, 500.0))["digis"]
    late = delayed(both, start + OFFSET)
    alone = cg.strip_times(CGEM, late)
    wrong = np.abs(alone["strip_time"] - start - OFFSET) > 100
    assert 0.2 < wrong.mean() < 0.8
    assert (alone["status"][wrong] == StripTimeStatus.ambiguous).mean() > 0.1
    known = cg.strip_times(CGEM, late, start=start)
    assert_within(known.meta["offset"], OFFSET, known.meta["err_offset"], 3.0)
    outside = known["n_outside"].sum() / len(both)
    assert 0.3 < outside < 0.6  # the strips of the other particle


def test_events_without_start_or_strips(clean, start):
    late, given = delayed(clean, start), start.copy()
    given[[3, 4]] = np.nan
    few = late[(late["event"] != 4) | (np.arange(len(late)) % 40 == 0)]
    found = cg.strip_times(CGEM, few, start=given)
    assert found["status"][3] == StripTimeStatus.ok
    assert abs(found["strip_time"][3] - start[3]) < 4 * found["err_strip_time"][3] < 80
    assert found["n_strips"][4] < LEAST_STRIPS
    assert found["status"][4] == StripTimeStatus.no_strips
    assert np.isnan(found["strip_time"][4])
    assert np.isnan(found["err_strip_time"][4])
    kept = cg.from_start(few, found)
    assert 4 not in kept["event"]
    assert len(kept) == np.count_nonzero(few["event"] != 4)


def test_clusters_of_late_strips_are_those_of_true_times(clean, start):
    late = delayed(clean, start + OFFSET)
    with pytest.warns(UserWarning, match=rf"{len(late)} of {len(late)} strips are in no cluster: .*strip_times"):
        assert not len(cg.cluster(CGEM, late))
    found = cg.strip_times(CGEM, late, start=start)
    exact = found.with_columns(strip_time=start + OFFSET)
    made, true = cg.cluster(CGEM, cg.from_start(late, exact)), cg.cluster(CGEM, clean)
    for name in ("event", "first", "last", "view"):
        np.testing.assert_array_equal(made[name], true[name])
    np.testing.assert_allclose(made["x"], true["x"], atol=1e-9)
    again = cg.cluster(CGEM, cg.from_start(late, found))
    assert abs(len(again) - len(true)) < 0.01 * len(true)


def test_arrivals_are_even_over_the_drift_time(clean):
    """The gap of 5 mm takes 144 to 150 ns at 34 um/ns; with the chip's delays, the middle is at half of it."""
    arrivals = arrivals_of(CGEM, clean)
    inside = (arrivals.time > -30) & (arrivals.time < arrivals.longest + 30)
    assert inside.mean() > 0.99
    assert set(np.round(np.unique(arrivals.longest))) == {144.0, 149.0, 150.0}
    assert abs(np.mean((arrivals.time / arrivals.longest)[arrivals.paired]) - 0.5) < 0.05
    assert set(np.unique(arrivals.margin)) == {50.0}


def test_pairs_by_brute_force(clean):
    names = ("event", "layer", "sheet", "view", "strip")
    keys = list(zip(*(clean[name].tolist() for name in names), strict=True))
    known = set(keys)
    brute = [(*key[:4], key[4] + 1) in known or (*key[:4], key[4] - 1) in known for key in keys]
    np.testing.assert_array_equal(module._paired(clean), brute)


def test_wrong_input(clean, start):
    with pytest.raises(ValueError, match="no readout with times"):
        cg.strip_times("besiii-cgem-design", clean[:0])
    with pytest.raises(ValueError, match=r"got shape \(3,\), expected one for each of 300 events"):
        cg.strip_times(CGEM, clean, start=[1.0, 2.0, 3.0])
    found = cg.strip_times(CGEM, clean.select_events(0, 2))
    with pytest.raises(ValueError, match="other events"):
        cg.from_start(clean, found)
