"""Values of the field: Maxwell's equations, the solenoid from its current, splines through maps."""

import numpy as np
import pytest

import cgemit as cg
from cgemit.detector import Detector, field_at, fields
from cgemit.detector.core import compiled_field, solenoid_field
from fields import HARMONIC, box_grid, harmonic_by_hand, on_core

RNG = np.random.default_rng(1)
POINTS = np.stack([RNG.uniform(-600, 600, 200), RNG.uniform(-500, 500, 200), RNG.uniform(-1000, 1000, 200)], axis=1)


@pytest.fixture(scope="module")
def design() -> Detector:
    return cg.load("besiii-cgem-design")


def test_harmonic_field(design):
    assert field_at(design.with_field(HARMONIC), POINTS) == pytest.approx(harmonic_by_hand(*POINTS.T), abs=1e-14)


@pytest.mark.parametrize("name", [HARMONIC, "finite-solenoid", "box"])
def test_gradients_are_derivatives_and_obey_maxwell(design, name):
    core = on_core(box_grid(harmonic_by_hand)) if name == "box" else compiled_field(design.with_field(name))
    assert core is not None
    points = np.concatenate([POINTS, [[0, 0, 300.0], [1e-4, 0, 300.0], [2e-3, -1e-3, 300.0]]])
    _, gradient, inside = core.values(points)
    assert inside.all()
    for axis in range(3):
        step = np.where(np.arange(3) == axis, 1e-2, 0.0)
        difference = (core.values(points + step)[0] - core.values(points - step)[0]) / 2e-2
        assert gradient[:, :, axis] == pytest.approx(difference, abs=2e-10)
    steepest = np.abs(gradient).max()
    assert np.abs(np.trace(gradient, axis1=1, axis2=2)).max() < 1e-4 * steepest
    assert np.abs(gradient - np.swapaxes(gradient, 1, 2)).max() < 1e-4 * steepest


def loop_sum(radius, half_length, r, z, points=150):
    """Return the field of a coil by Biot and Savart: current elements around, integrated along the coil."""
    at, weight = np.polynomial.legendre.leggauss(points)
    phi = (np.arange(points) + 0.5) * 2 * np.pi / points
    along, around = np.meshgrid(half_length * at, phi, indexing="ij")
    dx, dy, dz = r - radius * np.cos(around), -radius * np.sin(around), z - along
    cube = (dx**2 + dy**2 + dz**2) ** 1.5
    br, bz = (radius * np.cos(around) * dz / cube), radius * (radius - r * np.cos(around)) / cube
    mean = weight[:, None] * np.full((1, points), 1 / points)
    return (br * mean).sum(), (bz * mean).sum()


def test_solenoid_is_the_field_of_its_current():
    middle = loop_sum(1490, 1770, 0.0, 0.0)[1]
    for r, z in ((0.0, 0.0), (0.0, 900.0), (300.0, -500.0), (800.0, 1200.0), (-800.0, 1200.0)):
        expected = np.array(loop_sum(1490, 1770, r, z)) / middle
        assert np.array(solenoid_field(1490, 1770, r, z)) == pytest.approx(expected, abs=1e-10)


def test_field_on_the_axis_of_a_solenoid():
    """(z + b)/sqrt((z + b)^2 + a^2) on either side; J. D. Jackson, Classical Electrodynamics, problem 5.3."""
    z = np.linspace(-3000, 3000, 7)
    ends = [(z + b) / np.hypot(z + b, 1490) * np.sign(b) for b in (1770, -1770)]
    expected = sum(ends) / (2 * 1770 / np.hypot(1770, 1490))
    assert solenoid_field(1490, 1770, 0.0, z)[1] == pytest.approx(expected, abs=1e-12)


def test_solenoid_grid_follows_the_formula(design):
    detector = design.with_field("finite-solenoid")
    r, z = np.hypot(POINTS[:, 0], POINTS[:, 1]), POINTS[:, 2]
    br, bz = solenoid_field(1490.15, 1770, r, z)
    expected = -np.stack([br * POINTS[:, 0] / r, br * POINTS[:, 1] / r, bz], axis=1)
    assert field_at(detector, POINTS) == pytest.approx(expected, abs=1e-7)
    moved = detector.with_overrides({"field.z_offset": "100 mm"})
    shifted = field_at(moved, POINTS + np.array([0, 0, 100])) / field_at(moved, [[0, 0, 100]])[0, 2]
    assert shifted == pytest.approx(-expected, abs=2e-7)
    assert field_at(moved, [[0, 0, 0]])[0] == pytest.approx([0, 0, -1], abs=1e-12)


def test_splines_go_through_their_points_and_converge():
    """Halving the distance of the points lowers the error by sixteen, as cubic splines do."""
    errors = []
    for step in (100.0, 50.0):
        grid = box_grid(
            lambda x, y, z: np.stack([np.sin(x / 300), np.cos(y / 300), np.sin((x + z) / 300)], -1), step=step
        )
        core, axes = on_core(grid), grid.axes
        corner = [(a.first, a.last) for a in axes]
        at = np.stack(np.meshgrid(*corner, indexing="ij"), axis=-1).reshape(-1, 3)
        assert core.values(at)[0] == pytest.approx(
            grid.values[np.ix_([0, -1], [0, -1], [0, -1])].reshape(-1, 3), abs=1e-12
        )
        x, y, z = POINTS.T
        expected = np.stack([np.sin(x / 300), np.cos(y / 300), np.sin((x + z) / 300)], axis=-1)
        inner = (np.abs(POINTS) < [400, 400, 800]).all(axis=1)
        errors.append(np.abs(core.values(POINTS)[0] - expected)[inner].max())
    assert errors[0] / errors[1] > 12
    # C. A. Hall, J. Approx. Theory 1 (1968) 209: h^4/384 times the fourth derivative, here along x and along z.
    assert errors[1] < 1.1 * 2 * (50 / 300) ** 4 / 384


def test_outside_of_a_map_there_is_no_field(design):
    detector = design.with_field("finite-solenoid")
    assert np.isnan(field_at(detector, [[0, 0, 2300.0], [0, 900, 0], [np.nan, 0, 0]])).all()
    assert field_at(design, [[0, 0, 1e6]]) == pytest.approx(np.array([[0, 0, -1.0]]))


def test_presets():
    assert fields() == ("besiii", "besiii-harmonic", "finite-solenoid", "uniform")
    for name in fields():
        detector = cg.load("besiii-idc").with_field(name)
        assert cg.load(detector) is detector
        assert field_at(detector, [[0, 0, 0]])[0] == pytest.approx([0, 0, detector.field.bz], abs=1e-12)


def test_flux_through_a_cylinder_vanishes(design):
    """Independent of the gradients: what enters at the middle leaves through the side and at the top."""
    core, radius, half = compiled_field(design.with_field("finite-solenoid")), 500.0, 800.0
    assert core is not None
    at, weight = np.polynomial.legendre.leggauss(40)
    at, weight = (at + 1) / 2, weight / 2
    zero, one = np.zeros_like(at), np.ones_like(at)

    def through(z):
        values = core.values(np.stack([radius * at, zero, z * one], axis=1))[0]
        return 2 * np.pi * radius**2 * (weight * at * values[:, 2]).sum()

    side = core.values(np.stack([radius * one, zero, half * at], axis=1))[0][:, 0]
    assert through(half) + 2 * np.pi * radius * half * (weight * side).sum() == pytest.approx(through(0.0), rel=1e-7)
