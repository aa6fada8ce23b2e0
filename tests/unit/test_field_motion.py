"""Runge-Kutta-Nystrom steps: against scipy, against the helix, and their derivatives."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cgemit import _core
from fields import box_grid, harmonic_by_hand, on_core
from oracles import LIGHT, helix_point

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


def integrated(field, row, path):
    """Return the end of a track by scipy's integrator of eighth order."""

    def motion(_, state):
        return np.concatenate([state[3:], LIGHT * row[6] * np.cross(state[3:], field(*state[:3]))])

    return solve_ivp(motion, (0, path), row[:6], "DOP853", rtol=1e-13, atol=1e-12).y[:, -1]


@pytest.mark.parametrize(("p", "path"), [(0.06, 400.0), (0.2, 800.0), (1.0, 900.0), (0.5, -700.0)])
def test_steps_agree_with_scipy(p, path):
    points = starts(5, p)
    expected = np.array([integrated(harmonic_by_hand, row, path) for row in points])
    tight, _ = advance(_core.Field(**HARMONIC, tolerance=TIGHTEST), points, path)
    usual, _ = advance(_core.Field(**HARMONIC, tolerance=DEFAULT), points, path)
    assert np.abs(tight[:, :3] - expected[:, :3]).max() < 1e-9
    assert np.abs(usual[:, :3] - expected[:, :3]).max() < 2e-4
    # Seen from the origin: the change of direction times the way.
    assert np.abs(usual[:, 3:] - expected[:, 3:]).max() * abs(path) < 1e-3


def test_another_field_is_seen():
    points = starts(5, 0.5)
    expected = np.array([integrated(harmonic_by_hand, row, 700.0) for row in points])
    other, _ = advance(_core.Field(**HARMONIC | {"b": 0.176e-6}, tolerance=TIGHTEST), points, 700.0)
    assert np.abs(other[:, :3] - expected[:, :3]).max() > 1e-3


@pytest.mark.parametrize("kind", ["harmonic", "grid"])
@pytest.mark.parametrize("p", [0.06, 0.3, 2.0])
def test_constant_map_is_a_helix(kind, p):
    constant = box_grid(
        lambda x, y, z: np.broadcast_to([0, 0, -1.0], (*x.shape, 3)), half=900.0, step=300.0, half_z=900.0
    )
    field = {
        "harmonic": _core.Field(bz=-1.0, b=0.0, q=0.0, tolerance=TIGHTEST),
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
        "harmonic": lambda: _core.Field(**steep, tolerance=TIGHTEST),
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
    _, by = advance(_core.Field(**HARMONIC, tolerance=TIGHTEST), points, 500.0, start)
    assert np.linalg.norm(by[0, [0, 3], 0] - [0, 1]) > 1e-3


def test_a_track_that_leaves_the_map_says_so():
    field = on_core(box_grid(harmonic_by_hand))
    points = starts(4, 1.0)
    _, _, inside = field.advance(points, np.array([100.0, 2000.0, -2000.0, 0.0]), NO_DERIVATIVES)
    assert inside.tolist() == [1, 0, 0, 1]
    points[0, 0] = 5000.0
    assert field.advance(points[:1], np.array([10.0]), NO_DERIVATIVES)[2].tolist() == [0]
