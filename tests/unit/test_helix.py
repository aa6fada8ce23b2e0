"""Helix parameters mean what docs/conventions.md says, and another pivot leaves the helix where it is."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cgemit import helix
from oracles import integrate
from tracks import on_helix, particles

CHARGES = {1: -13, -1: 13}  # mu+, mu-
azimuth = st.floats(-math.pi, math.pi)


@pytest.mark.parametrize(
    ("charge", "bz", "centre_y"),
    # A positive charge in a field along +z turns clockwise: flying along +x its circle lies below.
    [(1, 1.0, -1), (1, -1.0, 1), (-1, 1.0, 1), (-1, -1.0, -1)],
)
def test_by_hand(charge, bz, centre_y):
    """A 1 GeV/c particle that passes (0, 50 mm) along +x: circle, parameters and signs worked out by hand."""
    radius = 1.0 / 0.299792458e-3  # mm, at 1 T
    found = helix.at_origin(particles([0, 50.0, 7.0], [1.0, 0, 0.5], CHARGES[charge]), bz)[0]
    # Flight azimuth 0, so phi0 = -90 degrees; the closest point is dr (cos phi0, sin phi0) = (0, 50).
    np.testing.assert_allclose(found, [-50.0, -math.pi / 2, charge, 7.0, 0.5], rtol=1e-12, atol=1e-12)
    signed = 3335.640952 / (bz * found[2])
    centre = (found[0] + signed) * np.array([math.cos(found[1]), math.sin(found[1])])
    np.testing.assert_allclose(centre, [0, 50 + centre_y * radius], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("bz", [-1.0, 1.0, -3.0])
@pytest.mark.parametrize("pt", [0.05, 0.3, 1.0, 1e3])
def test_circle_and_momentum_formulas(pt, bz, charge):
    """The circle's centre and the momentum at the closest point are those of the conventions page."""
    position, momentum = np.array([25.0, -14.0, 3.0]), pt * np.array([math.cos(2.1), math.sin(2.1), -0.8])
    dr, phi0, kappa, dz, tanl = helix.at_origin(particles(position, momentum, CHARGES[charge]), bz)[0]
    centre = (dr + 3335.6409519815204 / (bz * kappa)) * np.array([math.cos(phi0), math.sin(phi0)])
    # The force q v x B points to the centre: (v_y, -v_x) for q bz > 0.
    force = charge * bz * np.array([momentum[1], -momentum[0]]) / (abs(bz) * pt)
    expected = position[:2] + force * pt / (0.299792458e-3 * abs(bz))
    np.testing.assert_allclose(centre, expected, rtol=1e-10)
    assert kappa == pytest.approx(charge / pt, rel=1e-12)
    assert tanl == pytest.approx(-0.8, rel=1e-12)
    # The arc from the closest point to the vertex, from the closest point's own direction.
    start = np.array([dr * math.cos(phi0), dr * math.sin(phi0), dz])
    flight = pt * np.array([-math.sin(phi0), math.cos(phi0), tanl])
    turned = (math.atan2(momentum[1], momentum[0]) - phi0 - math.pi / 2 + math.pi) % (2 * math.pi) - math.pi
    arc = -turned * pt / (0.299792458e-3 * charge * bz)
    length = arc * math.hypot(1, 0.8)
    path = integrate(start, flight, charge, bz, length)
    np.testing.assert_allclose(path.y[:3, -1], position, atol=1e-8)
    np.testing.assert_allclose(path.y[3:, -1], momentum, atol=1e-10 * pt)


@settings(max_examples=100)
@given(
    st.floats(0, 100), azimuth, azimuth, st.floats(math.log(0.05), math.log(100)),
    st.floats(-2, 2), st.sampled_from([-1, 1]), st.sampled_from([-1.0, 1.0]),
)  # fmt: skip
def test_closest_point(r, at, direction, log_pt, tanl, charge, bz):
    """The parameters are those of the point where the integrated path comes closest to the beam line."""
    pt = math.exp(log_pt)
    position = np.array([r * math.cos(at), r * math.sin(at), 5.0])
    momentum = pt * np.array([math.cos(direction), math.sin(direction), tanl])
    dr, phi0, _, dz, found_tanl = helix.at_origin(particles(position, momentum, CHARGES[charge]), bz)[0]
    # Not a circle around the beam line, where every point is the closest.
    radius = pt / 0.299792458e-3
    assume(abs(abs(dr) - radius) > 1 or abs(dr) < radius / 2)

    def radial(_, state):
        return state[0] * state[3] + state[1] * state[4]

    half_turn = math.pi * radius * math.hypot(1, tanl)
    candidates = [[*position, *momentum]]
    for sign in (1, -1):
        path = integrate(position, sign * momentum, sign * charge, bz, min(half_turn, 300.0), events=radial)
        candidates += [[*state[:3], *(sign * state[3:])] for state in path.y_events[0]]
    best = min(candidates, key=lambda state: math.hypot(state[0], state[1]))
    np.testing.assert_allclose([dr * math.cos(phi0), dr * math.sin(phi0), dz], best[:3], atol=2e-6)
    np.testing.assert_allclose([-math.sin(phi0), math.cos(phi0)], np.array(best[3:5]) / pt, atol=1e-8)
    assert found_tanl == pytest.approx(tanl)


@settings(max_examples=200)
@given(
    st.floats(-100, 100), azimuth, st.floats(-20, 20), st.floats(-300, 300), st.floats(-2, 2),
    st.sampled_from([-1.0, 1.0]),
)  # fmt: skip
def test_round_trip(dr, phi0, kappa, dz, tanl, bz):
    """A particle started at the closest point of a helix gets that helix's parameters back."""
    assume(abs(kappa) > 1e-6)
    radius = 3335.64 / (bz * kappa)
    assume((dr + radius) * radius > 0.01 * radius**2)  # dr does not reach across the circle's centre
    given_helix = np.array([dr, phi0, kappa, dz, tanl])
    found = helix.at_origin(on_helix(given_helix, CHARGES[int(math.copysign(1, kappa))]), bz)[0]
    found[1] = phi0 + (found[1] - phi0 + math.pi) % (2 * math.pi) - math.pi
    np.testing.assert_allclose(found, given_helix, rtol=1e-11, atol=1e-9)


def test_almost_straight():
    """At 1e9 GeV/c the parameters are those of the straight line."""
    position, flight = np.array([20.0, 30.0, 4.0]), np.array([math.cos(0.4), math.sin(0.4), 1.5])
    found = helix.at_origin(particles(position, 1e9 * flight), 1.0)[0]
    back = -(position[:2] @ flight[:2])
    closest = position + back * flight
    expected = [math.hypot(closest[0], closest[1]), math.atan2(closest[1], closest[0])]
    sign = 1 if abs(math.remainder(expected[1] + math.pi / 2 - 0.4, 2 * math.pi)) < 1 else -1
    np.testing.assert_allclose(found[0], sign * expected[0], rtol=1e-9)
    np.testing.assert_allclose(found[1], 0.4 - math.pi / 2, atol=1e-10)
    np.testing.assert_allclose(found[3], closest[2], rtol=1e-9)


def test_phi0_range():
    """phi0 lies in (-pi, pi] whatever the direction of flight."""
    psi = np.linspace(-math.pi, math.pi, 1001)
    table = particles([0.0, 0, 0], np.stack([np.cos(psi), np.sin(psi), 0 * psi], axis=1))
    phi0 = helix.at_origin(table, -1.0)[:, 1]
    assert phi0.min() > -math.pi
    assert phi0.max() <= math.pi
    np.testing.assert_allclose(np.cos(phi0 + math.pi / 2), np.cos(psi), atol=1e-12)
    np.testing.assert_allclose(np.sin(phi0 + math.pi / 2), np.sin(psi), atol=1e-12)


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 7])
def test_angles_of_a_turn_are_in_a_half_open_range(turns: int) -> None:
    angles = np.array([-3.1, -1e-9, 0.0, 1e-17, 0.5, 3.14])
    wrapped = helix.wrap_angle(angles + 2 * np.pi * turns)
    np.testing.assert_allclose(wrapped, angles, rtol=0, atol=4e-15)
    assert turns or wrapped.tobytes() == angles.tobytes()


def test_the_end_of_the_range_of_angles_is_pi() -> None:
    assert helix.wrap_angle([np.pi, -np.pi, 3 * np.pi, -3 * np.pi]).tolist() == [np.pi] * 4
    assert np.isnan(helix.wrap_angle(np.nan))


def test_rows_without_a_helix_are_nan():
    """Neutral particles and particles along the beam have no kappa."""
    found = helix.at_origin(particles([0.0, 0, 0], [[1.0, 0, 0], [0, 0, 1.0]], [22, 13]), -1.0)
    assert np.all(np.isnan(found[:, 2]))


def test_momentum_and_its_error():
    """Momentum is sqrt(1 + tanl^2)/|kappa|; its error is that of a sample drawn from the covariance."""
    from stats import assert_within

    rng = np.random.default_rng(5)
    parameters = np.array([[0.1, 0.3, -1.25, 2.0, 0.75]])
    factor = rng.normal(size=(5, 5)) * [[0.1], [1e-3], [5e-3], [0.2], [2e-3]]
    cov = factor @ factor.T
    sample = rng.multivariate_normal(parameters[0], cov, size=40_000)
    assert helix.momentum(parameters)[0] == pytest.approx(1.0, rel=1e-14)
    spread = np.std(helix.momentum(sample))
    assert_within(helix.momentum_error(parameters, cov[None])[0], spread, spread / np.sqrt(2 * len(sample)))


@pytest.mark.parametrize(("charge", "bz"), [(1, 1.0), (1, -1.0), (-1, 1.0), (-1, -1.0)])
def test_particles_begin_outward_or_inward(charge, bz):
    """A vertex 50 mm from the beam line; a particle that flies towards it passes it later."""
    for flight, sign in ((0.4, 1.0), (0.4 + np.pi, -1.0)):
        momentum = [0.5 * np.cos(flight), 0.5 * np.sin(flight), 0.2]
        one = particles([40.0, 30.0, 5.0], momentum, pdg=-13 * charge)
        given = helix.at_origin(one, bz)
        assert helix.start_radius(given, [[40.0, 30.0, 5.0]], bz) == pytest.approx(sign * 50.0, rel=1e-9)


def test_perigee_parameters_by_hand() -> None:
    """Perigee parameters that are plain to see: flight along +x, 1 mm to the right of the origin, 45 degrees up."""
    parameters = np.array([[1.0, -0.5 * np.pi, -2.0, 7.0, 1.0]])
    perigee, _ = helix.to_perigee(parameters, np.zeros((1, 5, 5)))
    assert perigee[0] == pytest.approx([-1.0, 7.0, 0.0, 0.25 * np.pi, -np.sqrt(2.0)])


def test_perigee_covariance_against_differences() -> None:
    """The covariance is that of numerical derivatives, and azimuths stay in (-pi, pi]."""
    rng = np.random.default_rng(4)
    parameters = rng.normal(size=(50, 5)) * [10, 1.5, 3, 100, 1]
    root = rng.normal(size=(50, 5, 5))
    cov = root @ np.swapaxes(root, 1, 2)
    perigee, result = helix.to_perigee(parameters, cov)
    assert np.all(np.abs(perigee[:, 2]) <= np.pi)
    columns = []
    for i in range(5):
        step = np.zeros(5)
        step[i] = 1e-6
        change = helix.to_perigee(parameters + step, cov)[0] - helix.to_perigee(parameters - step, cov)[0]
        change[:, 2] = np.remainder(change[:, 2] + np.pi, 2 * np.pi) - np.pi
        columns.append(change / 2e-6)
    jacobian = np.stack(columns, axis=2)
    assert result == pytest.approx(jacobian @ cov @ np.swapaxes(jacobian, 1, 2), rel=1e-6, abs=1e-6)


def test_one_helix_is_a_row_of_many() -> None:
    """One helix, shape (5,), gives what it gives among others."""
    many = np.array([[0.1, 0.2, -1.5, 3.0, 0.4], [1.0, -2.0, 0.7, -30.0, -1.1]])
    cov = np.stack([np.diag([1e-2, 1e-6, 1e-4, 1e-1, 1e-5]), np.diag([2e-2, 3e-6, 4e-4, 5e-1, 6e-5]) + 1e-7])
    one, error = many[1], cov[1]
    assert helix.momentum(one) == helix.momentum(many)[1]
    assert helix.momentum(one.tolist()).shape == ()
    assert helix.momentum_error(one, error) == helix.momentum_error(many, cov)[1]
    np.testing.assert_array_equal(helix.momentum_vector(one), helix.momentum_vector(many)[1])
    calls = [
        lambda *given: helix.to_perigee(*given),
        lambda *given: helix.change_pivot(*given, [0.0, 0, 0], [1.0, 2, 3], -1.0),
    ]
    for call in calls:
        for found, rows in zip(call(one, error), call(many, cov), strict=True):
            np.testing.assert_array_equal(found, rows[1])
    for call in calls:
        with pytest.raises(ValueError, match=r"parameters: got shape \(4,\), expected \(5,\) or \(n, 5\)"):
            call(one[:4], error)
        with pytest.raises(ValueError, match=r"cov: got shape \(2, 5, 5\), expected \(5, 5\)"):
            call(one, cov)


SIGNS = pytest.mark.parametrize(("charge", "bz"), list(itertools.product((-1, 1), (-1.0, 1.0))))
# dr mm, phi0, pT GeV/c, dz mm, tanl; arc to the new closest point in mm, its distance from the new pivot in mm
SHAPES = [
    ((0.3, 0.4, 1.0, 5.0, 0.1), 300.0, 2.0),
    ((-20.0, -2.9, 0.2, -20.0, 1.1), 900.0, -40.0),
    ((30.0, 3.0, 0.06, 10.0, -0.6), -250.0, 15.0),
    ((-100.0, 1.0, 0.1, 0.0, 0.3), 1.0, 0.0),
    ((5.0, -1.5, 40.0, 300.0, 2.0), -700.0, -3.0),
]
FROM = np.array([12.0, -7.0, 3.0])


def point_and_momentum(parameters, pivot):
    """Return where a helix is closest to its pivot, and its momentum there, by the formulas of docs/conventions.md."""
    dr, phi0, kappa, dz, tanl = parameters
    point = np.add(pivot, [dr * np.cos(phi0), dr * np.sin(phi0), dz])
    return point, np.array([-np.sin(phi0), np.cos(phi0), tanl]) / abs(kappa)


def covariance(seed=1):
    """Return a covariance whose parameters have errors of the usual sizes."""
    root = np.random.default_rng(seed).normal(size=(5, 5)) * [[0.1], [1e-3], [3e-3], [0.2], [1e-3]]
    return root @ root.T


def moved(parameters, pivot_to, bz, cov=None, pivot_from=FROM):
    """Change the pivot of one helix."""
    cov = covariance() if cov is None else cov
    found, carried = helix.change_pivot([parameters], cov[None], pivot_from, pivot_to, bz)
    return found[0], carried[0]


def case(shape, charge, bz):
    """Return a helix, another pivot, and the helix there from the integrated path."""
    (dr, phi0, pt, dz, tanl), arc, distance = shape
    parameters = np.array([dr, phi0, charge / pt, dz, tanl])
    point, momentum = point_and_momentum(parameters, FROM)
    turn = np.sign(arc)  # backwards: the opposite charge with the opposite momentum
    path = integrate(point, turn * momentum, turn * charge, bz, abs(arc) * np.hypot(1, tanl))
    end, flight = path.y[:3, -1], turn * path.y[3:, -1]
    azimuth = np.arctan2(-flight[0], flight[1])
    pivot = end - [distance * np.cos(azimuth), distance * np.sin(azimuth), 4.0]
    return parameters, pivot, np.array([distance, azimuth, charge / pt, 4.0, tanl])


@SIGNS
@pytest.mark.parametrize("shape", SHAPES)
def test_helix_stays_on_the_integrated_path(shape, charge, bz):
    """Seen from a pivot beside another point of the path, the helix is closest at that point and flies as there."""
    parameters, pivot, expected = case(shape, charge, bz)
    np.testing.assert_allclose(moved(parameters, pivot, bz)[0], expected, rtol=0, atol=1e-6)


@SIGNS
@pytest.mark.parametrize("shape", SHAPES)
def test_there_and_back(shape, charge, bz):
    """Back at the first pivot helix and covariance are what they were."""
    parameters, pivot, _ = case(shape, charge, bz)
    there, carried = moved(parameters, pivot, bz)
    back, again = moved(there, FROM, bz, carried, pivot)
    np.testing.assert_allclose(back, parameters, rtol=1e-9, atol=1e-9)
    scale = np.sqrt(np.diag(covariance()))
    np.testing.assert_allclose(again / np.outer(scale, scale), covariance() / np.outer(scale, scale), atol=1e-6)


@SIGNS
@pytest.mark.parametrize("shape", SHAPES)
def test_covariance_is_carried_by_the_derivatives(shape, charge, bz):
    """What the derivatives leave of a small change falls with the square of its size (Taylor)."""
    parameters, pivot, _ = case(shape, charge, bz)
    direction = np.array([0.5, 4e-3, 0.004 * abs(parameters[2]), 1.0, 3e-3])
    start, carried = moved(parameters, pivot, bz, np.outer(direction, direction))
    largest = np.argmax(np.diag(carried))
    linear = carried[largest] / np.sqrt(carried[largest, largest])
    left = []
    for size in (1.0, 0.5, 0.25):
        change = moved(parameters + size * direction, pivot, bz)[0] - start
        change[1] = np.remainder(change[1] + np.pi, 2 * np.pi) - np.pi
        left.append(np.linalg.norm(change - size * linear * np.sign(change @ linear)))
    assert left[0] < 0.2 * np.linalg.norm(linear)
    np.testing.assert_allclose(left[1:] / np.array(left[:-1]), 0.25, rtol=0.12)


@SIGNS
def test_unsigned_radius_would_be_seen(charge, bz):
    """A change of pivot that takes the circle to be on the other side, as an unsigned radius does, is far off."""
    parameters, pivot, expected = case(SHAPES[0], charge, bz)
    assert abs(moved(parameters, pivot, -bz)[0][0] - expected[0]) > 10


def test_straight_line_and_no_field():
    """Without curvature or field the closest point is that of a line, and nothing is lost to rounding."""
    for kappa, bz in ((1e-13, 1.0), (1.0, 0.0)):
        found, _ = moved(np.array([2.0, -0.5 * np.pi, kappa, 1.0, 0.5]), [100.0, 3.0, 0.0], bz, pivot_from=np.zeros(3))
        np.testing.assert_allclose(found, [5.0, -0.5 * np.pi, kappa, 51.0, 0.5], atol=1e-8)


def test_many_pivots_at_once_and_the_centre():
    """Pivots may differ from row to row; the centre of a circle has no closest point."""
    parameters = np.repeat([[0.0, 0.0, 1.0, 0.0, 0.0]], 3, axis=0)
    radius = helix.RADIUS_PER_KAPPA
    pivots = [[0.0, 0, 0], [1.0, 0, 2.0], [radius, 0, 0]]
    found, cov = helix.change_pivot(parameters, np.repeat(covariance()[None], 3, axis=0), [0.0, 0, 0], pivots, 1.0)
    np.testing.assert_allclose(found[0], parameters[0], atol=1e-15)
    np.testing.assert_allclose(found[1], [-1.0, 0, 1.0, -2.0, 0], atol=1e-12)
    assert np.isnan(found[2]).all()
    assert np.isnan(cov[2]).all()
    with pytest.raises(ValueError, match=r"cov: got shape \(1, 5, 5\), expected \(3, 5, 5\)"):
        helix.change_pivot(parameters, covariance()[None], [0.0, 0, 0], pivots, 1.0)
    with pytest.raises(ValueError, match="broadcast"):
        helix.change_pivot(parameters, cov, [0.0, 0, 0], [[0.0, 0], [1, 1]], 1.0)


def test_path_to_a_cylinder():
    """A quarter of a circle of radius R ends at r = R sqrt 2, where the azimuth has turned by half as much."""
    size = helix.RADIUS_PER_KAPPA / 0.5
    turned, arc = helix.path_to([0.5 * size, size * math.sqrt(2), 2 * size, 3 * size], [-1.0] * 4, 0.5)
    np.testing.assert_allclose(turned, [math.asin(0.25), 0.25 * math.pi, 0.5 * math.pi, 0.5 * math.pi], rtol=1e-7)
    np.testing.assert_allclose(arc[:3], [2 * size * math.asin(0.25), 0.5 * math.pi * size, math.pi * size], rtol=1e-7)
    straight = helix.path_to(150.0, [0.0, 1e-12], 1.0)
    np.testing.assert_allclose(straight, [[0.0, 0.0], [150.0, 150.0]], atol=1e-10)
