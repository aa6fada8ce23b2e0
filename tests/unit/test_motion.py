"""Steps along a helix and in field maps, and the closest approach to a wire, against scipy."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

from cgemit import _core
from cgemit.detector import compiled, load
from fields import box_grid, harmonic_by_hand, on_core
from oracles import LIGHT, helix_point, integrate

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


@settings(max_examples=100)
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


@settings(max_examples=40)
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


@settings(max_examples=100)
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


@settings(max_examples=100)
@given(tracks(), st.floats(-3, 3))
def test_advance(track, turn):
    """Moving by an arc, forward or back, agrees with integration."""
    point = helix_point(*track)
    arc = math.copysign(min(abs(turn / point[6]), 2000.0), turn)
    assume(arc != 0)
    moved, _ = _core._testing.advance(point[None], np.array([arc]))
    assert_same_point(moved[0], integrated(track, arc)[-1], abs(arc) * math.hypot(1, point[5]))


@settings(max_examples=100)
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


@settings(max_examples=100)
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


IDC = load("besiii-idc")
CORE = compiled(IDC)
LAYERS = IDC.drift_chamber.layers


def wire_line(layer, wire):
    """Return the middle of a wire and its direction towards +z, from its ends."""
    east, west = (np.array(end) for end in LAYERS[layer].end_points(wire))
    along = east - west
    return 0.5 * (east + west), along / np.linalg.norm(along)


def helix_at(point, arc):
    """Return position and direction (dx/ds, dy/ds, dz/ds) after transverse arcs, from the circle's centre."""
    x, y, z, ux, uy, tanl, w = point
    psi = math.atan2(uy, ux) + w * arc
    position = [x + (np.sin(psi) - uy) / w, y - (np.cos(psi) - ux) / w, z + arc * tanl]
    return np.array(position), np.array([np.cos(psi), np.sin(psi), tanl + 0 * psi])


def brute_force(point, middle, along, farthest):
    """Return smallest distance, arc and z on the wire: scan over the arc, then minimise over both parameters."""
    arcs = np.linspace(-5, farthest, 4000)
    offset = helix_at(point, arcs)[0] - middle[:, None]
    across = offset - np.outer(along, along @ offset)
    best = arcs[np.argmin(np.sum(across**2, axis=0))]

    def squared(parameters):
        difference = helix_at(point, best + parameters[0])[0] - middle - parameters[1] * along
        return difference @ difference

    start = [0.0, along @ (helix_at(point, best)[0] - middle)]
    found = minimize(squared, start, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-16, "maxiter": 4000})
    return math.sqrt(found.fun), best + found.x[0], (middle + found.x[1] * along)[2]


@st.composite
def passages(draw):
    """Draw a track that reaches a layer, and a wire of that layer within 1.5 cells of it."""
    layer = draw(st.integers(0, len(LAYERS) - 1))
    radius = LAYERS[layer].r_mid
    bz, charge = draw(signs), draw(signs)
    # From pT whose circle reaches just beyond the layer to almost straight.
    least = 0.6 * LIGHT * radius
    pt = least * math.exp(draw(st.floats(0, math.log(1e5 / least))))
    r, at, direction = draw(st.floats(0, 40)), draw(azimuth), draw(azimuth)
    tanl = draw(st.floats(-1.2, 1.2))
    position = [r * math.cos(at), r * math.sin(at), draw(st.floats(-20, 20))]
    point = helix_point(position, [pt * math.cos(direction), pt * math.sin(direction), pt * tanl], charge, bz)
    moved, _, reached = _core._testing.step_to_cylinder(point[None], radius)
    assume(reached[0] and abs(moved[0, 2]) < LAYERS[layer].half_length)
    # Wires near the crossing: azimuth of wire 0 at this z from its ends.
    middle, along = wire_line(layer, 0)
    at_z = middle + (moved[0, 2] - middle[2]) / along[2] * along
    cell = (math.atan2(moved[0, 1], moved[0, 0]) - math.atan2(at_z[1], at_z[0])) * LAYERS[layer].cells / (2 * math.pi)
    wire = round(cell + draw(st.floats(-1.5, 1.5))) % LAYERS[layer].cells
    before = 40.0  # mm, where the search starts before the layer
    start = _core._testing.step_to_cylinder(point[None], max(radius - before, r + 1e-6))
    assume(start[2][0])
    return start[0][0], layer, wire


@pytest.mark.slow
@settings(max_examples=60)
@given(passages())
def test_distance_is_the_smallest(passage):
    """Distance, arc and point agree with minimisation over arc and place on the wire."""
    start, layer, wire = passage
    moved, doca, arcs, found = _core._testing.approach_wire(start[None], CORE, layer, wire)
    assume(abs(moved[0, 0] * moved[0, 3] + moved[0, 1] * moved[0, 4]) > 0.2 * LAYERS[layer].r_mid)
    middle, along = wire_line(layer, wire)
    distance, arc, _ = brute_force(start, middle, along, arcs[0] + 60)
    assert found[0]
    assert abs(doca[0]) == pytest.approx(distance, abs=2e-6)
    assert arcs[0] == pytest.approx(arc, abs=2e-3)
    np.testing.assert_allclose(moved[0, :3], helix_at(start, arcs[0])[0], rtol=0, atol=1e-6)


@pytest.mark.slow
@settings(max_examples=300)
@given(passages())
def test_sign_and_right_angles(passage):
    """The distance is that along flight x wire, to 1e-9 mm where the point is 10 nm from being the closest."""
    start, layer, wire = passage
    moved, doca, _, found = _core._testing.approach_wire(start[None], CORE, layer, wire)
    _, settled, rest, _ = _core._testing.approach_wire(moved, CORE, layer, wire)
    assert abs(rest[0]) < 1e-5
    assert doca[0] == pytest.approx(settled[0], abs=1e-9)
    middle, along = wire_line(layer, wire)
    flight = np.array([*moved[0, 3:5], moved[0, 5]])
    offset = moved[0, :3] - middle
    offset = offset - (offset @ along) * along
    normal = np.cross(flight, along)
    assert found[0]
    assert doca[0] == pytest.approx(offset @ normal / np.linalg.norm(normal), abs=1e-9)
    np.testing.assert_allclose(offset, doca[0] * normal / np.linalg.norm(normal), rtol=0, atol=2e-5)


@pytest.mark.parametrize("bz", [-1.0, 1.0])
@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("layer", [0, 5, 8, 42])
@pytest.mark.parametrize("pt", [0.15, 1.0, 50.0])
def test_against_integration(layer, pt, charge, bz):
    """From a displaced vertex, the distance to each wire near the track is that of the integrated path."""
    position, momentum = np.array([15.0, -12.0, 8.0]), pt * np.array([math.cos(0.9), math.sin(0.9), 0.25])
    point = helix_point(position, momentum, charge, bz)
    crossing, arcs, reached = _core._testing.step_to_cylinder(point[None], LAYERS[layer].r_mid)
    if not reached[0]:
        assert 2 * pt / LIGHT < LAYERS[layer].r_mid + 20
        return
    path = integrate(position, momentum, charge, bz, arcs[0] * math.hypot(1, point[5]))
    at = helix_point(path.y[:3, -1], path.y[3:, -1], charge, bz)
    around = integrate(at[:3], path.y[3:, -1], charge, bz, 25.0, n=1001)
    back = integrate(at[:3], -path.y[3:, -1], -charge, bz, 25.0, n=1001)
    points = np.concatenate([back.y[:3, :0:-1].T, around.y[:3].T])  # 25 um apart, the crossing in the middle
    ends = [wire_line(layer, wire) for wire in range(LAYERS[layer].cells)]
    offsets = [np.linalg.norm(np.cross(points[1000] - middle, along)) for middle, along in ends]
    for wire in np.argsort(offsets)[:2]:
        middle, along = ends[wire]
        distances = np.linalg.norm(np.cross(points - middle, along), axis=1)
        best = np.argmin(distances)
        _, doca, _, found = _core._testing.approach_wire(crossing, CORE, layer, int(wire))
        assert found[0]
        assert 0 < best < len(points) - 1
        assert abs(doca[0]) <= distances[best] + 1e-9
        assert abs(doca[0]) == pytest.approx(distances[best], abs=0.0125**2 / distances[best] + 1e-8)


def test_sides_by_hand():
    """A track along +x leaves a wire along +z on its left at a positive distance if it passes below the wire."""
    axial = next(i for i, layer in enumerate(LAYERS) if layer.twist == 0)
    middle, along = wire_line(axial, 0)
    np.testing.assert_allclose(along, [0, 0, 1], atol=1e-15)
    for offset, sign in ((-2.0, 1), (2.0, -1)):
        start = np.array([[middle[0] - 10, middle[1] + offset, 0, 1, 0, 0.3, 0.0]])
        moved, doca, arcs, found = _core._testing.approach_wire(start, CORE, axial, 0)
        assert found[0]
        assert doca[0] == pytest.approx(sign * 2.0, abs=1e-12)
        assert arcs[0] == pytest.approx(10.0, abs=1e-12)
        assert moved[0, 2] == pytest.approx(3.0, abs=1e-12)


TIGHTEST, DEFAULT = 1e-9, 1e-3  # mm
HARMONIC = {"bz": -0.98, "b": 0.175e-6, "q": -0.251e-12}
NO_DERIVATIVES = np.zeros((5, 5))


def starts(n, p, seed=1):
    """Return rows of (x y z, direction, charge/p): from near the origin, moderately steep."""
    rng = np.random.default_rng(seed)
    direction = np.stack([rng.normal(size=n), rng.normal(size=n), rng.uniform(-1, 1, n)], axis=1)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return np.concatenate([rng.uniform(-30, 30, (n, 3)), direction, rng.choice([-1, 1], (n, 1)) / p], axis=1)


def advance(field, points, path, derivatives=NO_DERIVATIVES):
    moved, by, inside = field.advance(points, np.full(len(points), path), derivatives)
    assert inside.all()
    return moved, by


def beside(row, change):
    """Return how neighbours lie beside a track (to the left, azimuth, charge/p, up, slope), from changes of its row.

    To first order in the plane across the transverse flight; only for changes without a part along the flight.
    """
    across = np.hypot(row[3], row[4])
    ux, uy, tanl = row[3] / across, row[4] / across, row[5] / across
    to_left = ux * change[1] - uy * change[0]
    azimuth = (ux * change[4] - uy * change[3]) / across
    return np.array(
        [to_left, azimuth, change[6], change[2], (change[5] - tanl * (ux * change[3] + uy * change[4])) / across]
    )


def integrated_field(field, row, path):
    """Return the end of a track by scipy's integrator of eighth order."""

    def motion(_, state):
        return np.concatenate([state[3:], LIGHT * row[6] * np.cross(state[3:], field(*state[:3]))])

    return solve_ivp(motion, (0, path), row[:6], "DOP853", rtol=1e-13, atol=1e-12).y[:, -1]


@pytest.mark.parametrize(("p", "path"), [(0.06, 400.0), (0.2, 800.0), (1.0, 900.0), (0.5, -700.0)])
def test_steps_agree_with_scipy(p, path):
    points = starts(5, p)
    expected = np.array([integrated_field(harmonic_by_hand, row, path) for row in points])
    tight, _ = advance(_core.detector.Field(**HARMONIC, tolerance=TIGHTEST), points, path)
    usual, _ = advance(_core.detector.Field(**HARMONIC, tolerance=DEFAULT), points, path)
    assert np.abs(tight[:, :3] - expected[:, :3]).max() < 1e-9
    assert np.abs(usual[:, :3] - expected[:, :3]).max() < 2e-4
    # Seen from the origin: the change of direction times the way.
    assert np.abs(usual[:, 3:] - expected[:, 3:]).max() * abs(path) < 1e-3


def test_another_field_is_seen():
    points = starts(5, 0.5)
    expected = np.array([integrated_field(harmonic_by_hand, row, 700.0) for row in points])
    other, _ = advance(_core.detector.Field(**HARMONIC | {"b": 0.176e-6}, tolerance=TIGHTEST), points, 700.0)
    assert np.abs(other[:, :3] - expected[:, :3]).max() > 1e-3


@pytest.mark.parametrize("kind", ["harmonic", "grid"])
@pytest.mark.parametrize("p", [0.06, 0.3, 2.0])
def test_constant_map_is_a_helix(kind, p):
    constant = box_grid(
        lambda x, y, z: np.broadcast_to([0, 0, -1.0], (*x.shape, 3)), half=900.0, step=300.0, half_z=900.0
    )
    field = {
        "harmonic": _core.detector.Field(bz=-1.0, b=0.0, q=0.0, tolerance=TIGHTEST),
        "grid": on_core(constant, TIGHTEST),
    }[kind]
    points, path = starts(20, p), 600.0
    moved, _ = advance(field, points, path)
    helices = np.array([helix_point(row[:3], row[3:6] * p, np.sign(row[6]), -1.0) for row in points])
    expected, _ = _core._testing.advance(helices, path / np.hypot(1, helices[:, 5]))
    assert np.abs(moved[:, :3] - expected[:, :3]).max() < 1e-9
    assert np.abs(moved[:, 3:5] / np.hypot(moved[:, 3], moved[:, 4])[:, None] - expected[:, 3:5]).max() < 1e-11


@pytest.mark.parametrize("field", ["harmonic", "grid"])
def test_derivatives_by_taylor_convergence(field):
    """What the derivatives leave of a displaced start falls by four where the displacement is halved."""
    steep = {**HARMONIC, "b": 1e-6}
    core = {
        "harmonic": lambda: _core.detector.Field(**steep, tolerance=TIGHTEST),
        "grid": lambda: on_core(box_grid(lambda *at: harmonic_by_hand(*at, **steep), half=700.0), TIGHTEST),
    }[field]()
    points, path, rng = starts(3, 0.4), 500.0, np.random.default_rng(2)
    for row in points:
        flight = row[3:5] / np.hypot(row[3], row[4])
        for _ in range(3):
            change = np.concatenate([rng.normal(size=3), 0.02 * rng.normal(size=3), rng.normal(size=1) * 0.02 * row[6]])
            change[:2] -= flight * (change[:2] @ flight)
            change[3:6] -= row[3:6] * (change[3:6] @ row[3:6])  # stays a unit vector to first order
            start = np.zeros((5, 5))
            start[:, 0] = beside(row, change)
            moved, by = advance(core, row[None], path, start)
            left = []
            for size in (0.5, 0.25, 0.125):
                displaced = row + size * change
                displaced[3:6] /= np.linalg.norm(displaced[3:6])
                other, _ = advance(core, displaced[None], path)
                left.append(np.linalg.norm(off_plane(moved[0], other[0]) - size * by[0, [0, 3], 0]))
            assert left[0] / left[1] == pytest.approx(4, rel=0.15)
            assert left[1] / left[2] == pytest.approx(4, rel=0.08)
            assert left[2] < 0.05 * size * np.linalg.norm(by[0, [0, 3], 0])


def off_plane(moved, other):
    """Return how far to the left and up another track is where it passes the plane across the flight of this one."""
    across = np.hypot(moved[3], moved[4])
    ux, uy, tanl = moved[3] / across, moved[4] / across, moved[5] / across
    dx, dy, dz = (other - moved)[:3]
    return np.array([ux * dy - uy * dx, dz - tanl * (ux * dx + uy * dy)])


def test_without_the_gradient_derivatives_would_be_wrong():
    """The field's change along a displacement is worth more than the test above lets pass."""
    start = np.zeros((5, 5))
    start[3, 0] = 1.0  # along the beam
    points = starts(1, 0.4)
    _, by = advance(_core.detector.Field(**HARMONIC, tolerance=TIGHTEST), points, 500.0, start)
    assert np.linalg.norm(by[0, [0, 3], 0] - [0, 1]) > 1e-3


def test_a_track_that_leaves_the_map_says_so():
    field = on_core(box_grid(harmonic_by_hand))
    points = starts(4, 1.0)
    _, _, inside = field.advance(points, np.array([100.0, 2000.0, -2000.0, 0.0]), NO_DERIVATIVES)
    assert inside.tolist() == [1, 0, 0, 1]
    points[0, 0] = 5000.0
    assert field.advance(points[:1], np.array([10.0]), NO_DERIVATIVES)[2].tolist() == [0]
