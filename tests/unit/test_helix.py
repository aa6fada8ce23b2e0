"""Steps along a helix agree with the integrated equation of motion."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cgemit import _core
from oracles import helix_point, integrate

azimuth = st.floats(-math.pi, math.pi)
log_pt = st.floats(math.log(0.05), math.log(1e5))
signs = st.sampled_from([-1, 1])


@st.composite
def tracks(draw, largest_radius=150.0, log_pt=log_pt):
    """Draw position (mm), momentum (GeV/c), charge and field (T) of a particle."""
    r, at, direction = draw(st.floats(0, largest_radius)), draw(azimuth), draw(azimuth)
    pt = math.exp(draw(log_pt))
    position = np.array([r * math.cos(at), r * math.sin(at), draw(st.floats(-100, 100))])
    momentum = pt * np.array([math.cos(direction), math.sin(direction), draw(st.floats(-2.5, 2.5))])
    return position, momentum, draw(signs), draw(signs) * draw(st.sampled_from([0.5, 1.0, 3.0]))


def step(track, radius, outward=True):
    """Move one helix point to a cylinder: new point, transverse arc, whether reached."""
    points, arcs, reached = _core._testing.step_to_cylinder(helix_point(*track)[None], radius, outward=outward)
    return points[0], arcs[0], bool(reached[0])


def integrated(track, arc, n=2):
    """Return the helix points after transverse arcs up to `arc`, by integration."""
    position, momentum, charge, bz = track
    stretch = np.linalg.norm(momentum) / np.hypot(momentum[0], momentum[1])
    path = integrate(position, momentum, charge, bz, arc * stretch, n)
    return np.array([helix_point(state[:3], state[3:], charge, bz) for state in path.y.T])


def distances_from_centre(track):
    """Return the smallest and the largest distance of the track's circle from the beam line."""
    x, y, _, ux, uy, _, w = helix_point(*track)
    centre = math.hypot(x - uy / w, y + ux / w)
    return abs(centre - 1 / abs(w)), centre + 1 / abs(w)


def assert_same_point(found, expected, size):
    """Compare helix points: positions to 1e-11 of the way, directions to 1e-11."""
    np.testing.assert_allclose(found[:3], expected[:3], rtol=0, atol=1e-9 + 2e-11 * size)
    np.testing.assert_allclose(found[3:5], expected[3:5], rtol=0, atol=2e-11)
    np.testing.assert_allclose(found[5:], expected[5:], rtol=1e-9)


@settings(max_examples=200)
@given(tracks(), st.floats(0, 1))
def test_step_outward(track, fraction):
    """A step to a cylinder around the start ends where the integrated path first meets it."""
    outermost = distances_from_centre(track)[1]
    start = np.hypot(*track[0][:2])
    radius = start + 1 + fraction * (min(outermost, 1000) - start - 1)
    assume(start + 1 <= radius < outermost - 1e-3)
    point, arc, reached = step(track, radius)
    assert reached
    assert 0 < arc < 2 * math.pi / abs(point[6])
    path = integrated(track, arc, n=200)
    assert_same_point(point, path[-1], arc * math.hypot(1, point[5]))
    assert math.hypot(point[0], point[1]) == pytest.approx(radius, abs=1e-9)
    assert np.all(np.hypot(path[:-1, 0], path[:-1, 1]) < radius)


@settings(max_examples=80)
@given(tracks(largest_radius=300, log_pt=st.floats(math.log(0.05), math.log(2))), st.floats(0.001, 0.999))
def test_step_to_a_smaller_cylinder(track, fraction):
    """A smaller cylinder is met twice, moving inward and outward: ahead if the track moves inward, else behind."""
    closest = distances_from_centre(track)[0]
    start = np.hypot(*track[0][:2])
    radius = closest + fraction * (start - closest)
    assume(closest + 1e-3 < radius < start - 1e-3)
    ahead = track[0][:2] @ track[1][:2] < 0
    for outward in (False, True):
        point, arc, reached = step(track, radius, outward)
        assert reached
        assert 0 < (arc if ahead else -arc) < 2 * math.pi / abs(point[6])
        path = integrated(track, arc, n=1000)
        assert_same_point(point, path[-1], abs(arc) * math.hypot(1, point[5]))
        assert math.hypot(point[0], point[1]) == pytest.approx(radius, abs=1e-9)
        assert (point[0] * point[3] + point[1] * point[4] > 0) == outward
        # The second meeting lies behind the first one.
        below = np.hypot(path[1:-1, 0], path[1:-1, 1]) < radius
        assert np.count_nonzero(below[1:] != below[:-1]) <= (1 if outward == ahead else 0)


@settings(max_examples=200)
@given(tracks(), st.floats(1e-6, 100), st.booleans(), st.booleans())
def test_cylinders_out_of_reach(track, margin, beyond, outward):
    """Cylinders beyond the farthest and within the closest point of the circle are not reached; nothing moves."""
    closest, farthest = distances_from_centre(track)
    # Relative margin: for almost straight tracks the farthest point is known to rounding only.
    radius = farthest * (1 + 1e-9) + margin if beyond else closest * (1 - 1e-6) - margin
    assume(radius > 0)
    point, _, reached = step(track, radius, outward)
    assert not reached
    np.testing.assert_array_equal(point, helix_point(*track))


@pytest.mark.parametrize("kappa", [0.0, 1e-300, 1e-15, 1e-9])
def test_straight_line(kappa):
    """Without curvature, and with one too small to matter, steps are those of a straight line."""
    start = np.array([20.0, -30.0, 5.0, math.cos(2.0), math.sin(2.0), 0.7, 1e-3 * kappa])
    points, arcs, reached = _core._testing.step_to_cylinder(start[None], 800.0)
    along, across = start[:2] @ start[3:5], start[0] * start[4] - start[1] * start[3]
    arc = math.sqrt(800.0**2 - across**2) - along
    bend = 0.5 * start[6] * arc**2
    assert reached[0]
    assert arcs[0] == pytest.approx(arc, abs=1e-11 + abs(bend))
    expected = np.array([*(start[:2] + arc * start[3:5]), 5 + 0.7 * arc])
    np.testing.assert_allclose(points[0, :3], expected, rtol=0, atol=1e-11 + 2 * abs(bend))
    moved, apex = _core._testing.advance(start[None], np.array([arc]))
    np.testing.assert_allclose(moved[0, :3], expected, rtol=0, atol=1e-11 + abs(bend))
    assert apex[0] > 1e11


def test_straight_line_steps_back():
    """A straight line that has a cylinder behind it steps back to either side of it."""
    away = np.array([[0.0, 100.0, 0.0, 0.0, 1.0, 0.5, 0.0]])
    for outward, arc in ((True, -50.0), (False, -150.0)):
        points, arcs, reached = _core._testing.step_to_cylinder(away, 50.0, outward=outward)
        assert reached[0]
        assert arcs[0] == arc
        np.testing.assert_array_equal(points[0], [0, 100 + arc, 0.5 * arc, 0, 1, 0.5, 0])


def test_curvature_goes_to_zero_smoothly():
    """From bent to straight, the step differs from the straight one by the sagitta, to second order in curvature."""
    start = np.array([3.0, 4.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    straight = _core._testing.step_to_cylinder(start[None], 500.0)[0][0]
    length = straight[0] - start[0]
    for w in 10.0 ** np.arange(-14, -5):
        bent = _core._testing.step_to_cylinder(np.array([[*start[:6], w]]), 500.0)[0][0]
        assert bent[1] - straight[1] == pytest.approx(0.5 * w * length**2, rel=1e-2, abs=1e-12)


@settings(max_examples=200)
@given(tracks(), st.floats(-3, 3))
def test_advance(track, turn):
    """Moving by an arc, forward or back, agrees with integration."""
    point = helix_point(*track)
    arc = math.copysign(min(abs(turn / point[6]), 2000.0), turn)
    assume(arc != 0)
    moved, _ = _core._testing.advance(point[None], np.array([arc]))
    assert_same_point(moved[0], integrated(track, arc)[-1], abs(arc) * math.hypot(1, point[5]))


@settings(max_examples=200)
@given(tracks(log_pt=st.floats(math.log(0.05), math.log(5))))
def test_arc_to_apex(track):
    """The apex lies ahead, within one turn, at the largest distance of the circle from the beam line."""
    closest, farthest = distances_from_centre(track)
    assume(farthest - closest > 1e-3)
    point = helix_point(*track)
    apex = _core._testing.advance(point[None], np.zeros(1))[1]
    assert 0 <= apex[0] <= 2 * math.pi / abs(point[6]) * (1 + 1e-12)
    moved = _core._testing.advance(point[None], apex)[0][0]
    assert math.hypot(moved[0], moved[1]) == pytest.approx(farthest, rel=1e-11)
    assert moved[0] * moved[3] + moved[1] * moved[4] == pytest.approx(0, abs=1e-9 * farthest)


@settings(max_examples=200)
@given(tracks(), st.floats(10, 800))
def test_charge_and_field_turn_alike(track, radius):
    """Reversing charge and field together changes nothing; reversing one mirrors the turning."""
    position, momentum, charge, bz = track
    mirrored = (position * [1, -1, 1], momentum * [1, -1, 1], charge, -bz)
    both, one = step((position, momentum, -charge, -bz), radius), step(mirrored, radius)
    point, arc, reached = step(track, radius)
    assert (both[1], both[2]) == (arc, reached)
    assert one[2] == reached
    np.testing.assert_array_equal(both[0], point)
    np.testing.assert_allclose(one[0] * [1, -1, 1, 1, -1, 1, -1], point, rtol=1e-13, atol=1e-12)


def test_wrong_shape_is_refused():
    """Points with the wrong number of columns raise an error that says what was expected."""
    with pytest.raises(ValueError, match=r"points: expected shape \(2, 7\)"):
        _core._testing.advance(np.zeros((2, 6)), np.zeros(2))


def test_through_a_cylinder_from_a_point_on_it() -> None:
    """A point on a cylinder that heads in goes through to the other side: never stays, never takes an extra turn."""
    rng = np.random.default_rng(8)
    n = 2000
    azimuth, inward = rng.uniform(0, 2 * np.pi, n), np.pi + rng.uniform(-1.5, 1.5, n)
    radius, bend = rng.uniform(30, 100, n), rng.uniform(-1e-3, 1e-3, n)
    for phi, turn, r, w in zip(azimuth, inward, radius, bend, strict=True):
        flight = phi + turn
        start = np.array([[r * np.cos(phi), r * np.sin(phi), 0.0, np.cos(flight), np.sin(flight), 0.5, w]])
        on = float(np.hypot(start[0, 0], start[0, 1]))
        moved, arc, reached = _core._testing.step_to_cylinder(start, on)
        assert reached[0]
        # Half the turn is asin(w/2 times the chord), and the chord of a straight flight is 2 r cos(turn).
        chord = float(np.hypot(*(moved[0, :2] - start[0, :2])))
        assert arc[0] == pytest.approx(2 * np.arcsin(0.5 * abs(w) * chord) / abs(w), rel=1e-9)
        assert np.hypot(moved[0, 0], moved[0, 1]) == pytest.approx(on, rel=1e-12)
        assert moved[0, 0] * moved[0, 3] + moved[0, 1] * moved[0, 4] > 0
