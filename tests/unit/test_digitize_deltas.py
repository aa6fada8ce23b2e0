"""Binary read-out of delta electrons: what they deposit goes where they went, and stays with their crossing."""

import numpy as np
import pytest

import gem_toy
from cgemit.detector import load
from cgemit.detector.readouts import BinaryReadout
from cgemit.simulation.digitize import DigitizeSettings, digitize
from cgemit.tables import Table

DETECTOR = load("besiii-cgem-design")
LAYERS = gem_toy.design_layers()
PER_KEV = 12_000 / 0.0259 * 1.602176634e-4  # fC
PITCH = 0.65


def read_out(truths, steps=None, n_events=1, **settings):
    """Digis of bare columns."""
    tables = Table("truths", truths, n_events), Table.empty("wire_truths", n_events)
    steps = None if steps is None else Table("steps", steps, n_events)
    return digitize(DETECTOR, *tables, DigitizeSettings(readout=BinaryReadout(**settings)), steps=steps)["digis"]


def on_cylinder(layer, phi, z):
    """Points at mid-gap."""
    r = 0.5 * (LAYERS["r_gap_in"][layer] + LAYERS["r_gap_out"][layer])
    return np.column_stack(np.broadcast_arrays(r * np.cos(phi), r * np.sin(phi), z))


def radial(phi, z=12.0, layer=1, energy=3.0, event=0):
    """A truth straight outward: one X strip and one V strip."""
    ends = [np.array([r * np.cos(phi), r * np.sin(phi), z]) for r in (121.338, 126.338)]
    return gem_toy.truth_columns(event, layer, *ends, energy=energy)


def by_strip(digis, view=None):
    """Charge by (event, gid)."""
    rows = range(len(digis)) if view is None else np.flatnonzero(digis["view"] == view)
    return {(int(digis["event"][i]), int(digis["gid"][i])): float(digis["charge"][i]) for i in rows}


def test_charge_goes_where_the_delta_went():
    """2 keV stay on the track's strip; 1 keV lies on the X strips from 3.0 to 4.6 mm beside it."""
    phi = np.pi + (200.5 * PITCH) / 132.5  # in the middle of X strip 200 of sheet 0
    truth = radial(phi)
    ends = on_cylinder(1, phi + np.array([3.0, 4.6]) / 132.5, 12.0)
    steps = gem_toy.step_columns(truth, 0, 0.5 * (ends[0] + ends[1]), ends[1] - ends[0], energy=1.0)
    x = read_out(truth, steps)
    x = x[x["view"] == 0]
    assert x["strip"].tolist() == [200, 205, 206, 207]
    np.testing.assert_allclose(x["charge"], 0.5 * PER_KEV * np.array([2.0, 1 / 3, 1 / 3, 1 / 3]))
    assert set(x["truth"]) == {0}
    assert set(x["n_truths"]) == {1}
    without = read_out(truth)
    assert without["strip"][without["view"] == 0].tolist() == [200]


def test_every_step_is_read_out_like_a_segment_of_its_own():
    """Random deltas of random tracks: charge by strip is that of truths put in their places."""
    n, rng = 60, np.random.default_rng(8)
    truths = gem_toy.muons_through(LAYERS, n, seed=2, limit=0.8)
    link = np.sort(rng.integers(0, 3 * n, 500))
    layer = truths["layer"][link]
    phi = truths["phi"][link] + rng.normal(0, 3, 500) / LAYERS["r_readout"][layer]
    middle = np.concatenate([on_cylinder(k, p, z) for k, p, z in zip(layer, phi, rng.normal(0, 30, 500), strict=True)])
    vector = rng.normal(0, 0.5, (500, 3))
    truths["energy"][:] = 10.0
    steps = gem_toy.step_columns(truths, link, middle, vector, energy=0.1)
    alone = gem_toy.truth_columns(
        truths["event"][link], layer, middle - 0.5 * vector, middle + 0.5 * vector, energy=0.1
    )
    rest = truths | {"energy": 10.0 - 0.1 * np.bincount(link, minlength=3 * n)}
    both = {name: np.concatenate([rest[name], alone[name]]) for name in rest}
    order = np.argsort(both["event"], kind="stable")
    expected = by_strip(read_out({name: values[order] for name, values in both.items()}, n_events=n, threshold=0.0))
    found = by_strip(read_out(truths, steps, n_events=n))
    assert found.keys() == expected.keys()
    np.testing.assert_allclose([found[k] for k in expected], list(expected.values()))
    assert len(found) > len(read_out(truths, n_events=n)) + 500


def test_steps_of_the_particle_itself_change_nothing():
    """Ionization clusters of the track are part of what lies between entry and exit."""
    truth = radial(1.0)
    clusters = gem_toy.step_columns(truth, [0, 0], on_cylinder(1, [1.01, 1.02], 12.0), np.zeros((2, 3)), parent=0)
    assert read_out(truth, clusters) == read_out(truth)


def test_deposits_off_the_active_area_are_lost():
    """Beyond the end of the layer nothing fires, and the rest keeps its charge."""
    truth = radial(1.0, z=344.0)
    steps = gem_toy.step_columns(truth, [0, 0], on_cylinder(1, 1.0, [346.0, 350.0]), np.zeros((2, 3)), energy=1.0)
    digis = read_out(truth, steps)
    assert np.count_nonzero(digis["view"] == 0) == 1
    np.testing.assert_allclose(digis["charge"][digis["view"] == 0], 0.5 * PER_KEV)


def test_deltas_cross_to_the_other_sheet():
    """A track at the end of sheet 0 whose delta went over the seam: strips on both sheets, one crossing."""
    width = LAYERS["strips_x"][1] * PITCH
    phi = np.pi + (width - 0.1) / 132.5
    truth = radial(phi)
    steps = gem_toy.step_columns(truth, 0, on_cylinder(1, phi + 4.0 / 132.5, 12.0), np.zeros(3), energy=1.0)
    x = read_out(truth, steps)
    x = x[x["view"] == 0]
    assert x["sheet"].tolist() == [0, 1]
    assert x["strip"].tolist()[0] == LAYERS["strips_x"][1] - 1
    np.testing.assert_allclose(x["charge"], 0.5 * PER_KEV * np.array([2.0, 1.0]))


def test_threshold_is_on_the_whole_deposit():
    """A truth that passes the threshold only with its delta fires all strips; below it none, the delta's included."""
    at_threshold = 1.7 / PER_KEV
    for factor, fired in ((1.001, 4), (0.999, 0)):
        truth = radial(1.0, energy=factor * at_threshold)
        steps = gem_toy.step_columns(truth, 0, on_cylinder(1, 1.1, 12.0), np.zeros(3), energy=0.9 * at_threshold)
        assert len(read_out(truth, steps)) == fired


def test_steps_that_do_not_belong_are_refused():
    """Row, and what is wrong with it: order, link, event, layer, values, more energy than there was."""
    two = {k: np.concatenate([a, b]) for (k, a), b in zip(radial(1.0).items(), radial(2.0).values(), strict=True)}
    two["event"] = np.array([0, 1])
    good = gem_toy.step_columns(two, [0, 1], on_cylinder(1, [1.0, 2.0], 12.0), np.zeros((2, 3)))
    assert len(read_out(two, good, 2))
    wrong = [
        ({"truth": np.array([1, 0])}, r"steps row 0: event, particle and layer are not those of its truth, row 1"),
        ({"truth": np.array([0, 2])}, r"steps row 1: truth 2, expected 0 to 1"),
        ({"event": np.array([0, 0])}, r"steps row 1: event, particle and layer"),
        ({"layer": np.array([0, 1], "i4")}, r"steps row 0: event, particle and layer"),
        ({"particle": np.array([0, 1], "i4")}, r"steps row 1: event, particle and layer"),
        ({"parent": np.array([1, 2], "i1")}, r"steps row 1: parent 2, expected 0 or 1"),
        ({"parent": np.array([-1, 1], "i1")}, r"steps row 0: parent -1, expected 0 or 1"),
        ({"n_electrons": np.array([0, -3], "i4")}, r"steps row 1: n_electrons -3, expected 0 to 1000000"),
        ({"x": np.array([500.0, 500.0])}, r"steps row 0: radius 5\d\d\.\d+ mm, expected 121\.\d+ to 126\.\d+ mm"),
        ({name: (1 - 5.01 / 123.838) * good[name] for name in "xy"}, r"steps row 0: radius 118\."),
        ({"dz": np.array([0.0, np.nan])}, r"steps row 1: a value is not finite"),
        ({"energy": np.array([-1.0, 1.0])}, r"steps row 0: .*negative"),
        ({"energy": np.array([1.0, 3.5])}, r"truths row 1: its delta electrons deposit 0\.5\d* keV more"),
    ]
    for columns, message in wrong:
        with pytest.raises(ValueError, match=message):
            read_out(two, good | columns, 2)
    # The chord of 2 mm between points of the inner face dips 4 um below it.
    dip = LAYERS["r_gap_in"][1] * np.cos(1 / LAYERS["r_gap_in"][1])
    chord = gem_toy.step_columns(radial(0.0), 0, [dip, 0.0, 12.0], [0.0, 2.0, 0.0])
    assert len(read_out(radial(0.0), chord))
    with pytest.raises(ValueError, match="radius"):
        read_out(radial(0.0), chord | {"dy": np.zeros(1)})
    one = gem_toy.step_columns(radial(1.0), [0, 0], on_cylinder(1, [1.0, 1.1], 12.0), np.zeros((2, 3)))
    both = {name: np.concatenate([radial(1.0)[name]] * 2) for name in radial(1.0)}
    with pytest.raises(ValueError, match=r"steps row 1: truth 0, expected 1 to 1"):
        read_out(both, one | {"truth": np.array([1, 0])})
