"""Another pivot leaves the helix where it is, for both charges and both fields, and carries the covariance along."""

import itertools

import numpy as np
import pytest

from cgemit import helix
from oracles import integrate

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
