"""The closest approach to a stereo wire is the one that minimisation finds, with the documented sign."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from cgemit import _core
from cgemit.detector import compiled, load
from oracles import LIGHT, helix_point, integrate

IDC = load("besiii-idc")
CORE = compiled(IDC)
LAYERS = IDC.drift_chamber.layers
azimuth = st.floats(-math.pi, math.pi)
signs = st.sampled_from([-1, 1])


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
