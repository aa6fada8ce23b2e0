"""Particles in a field map: hits where scipy's integration of the motion has them, and what happens at its edge."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

import cgemit as cg
from cgemit import helix
from cgemit.detector import Detector, compiled, write_field_map
from cgemit.simulation.transport import TransportStatus
from fields import harmonic_by_hand
from oracles import LIGHT
from tracks import particles, transport, without_matter

UNEVEN = {"kind": "harmonic", "bz": "-0.98 T", "b": "0.175 /m2", "q": "-0.251 /m4", "tolerance": "1e-6 mm"}


@pytest.fixture(scope="module")
def detector() -> Detector:
    return cg.load("besiii-cgem-design").with_field(UNEVEN)


def gun(n=40, seed=3, p=(0.15, 1.5), vertex=40.0):
    """Return particles of both charges that start beside the beam line."""
    rng = np.random.default_rng(seed)
    flight = np.stack([rng.normal(size=n), rng.normal(size=n), rng.uniform(-0.8, 0.8, n)], axis=1)
    flight *= (rng.uniform(*p, n) / np.linalg.norm(flight, axis=1))[:, None]
    return particles(rng.uniform(-vertex, vertex, (n, 3)), flight, rng.choice([-13, 13], n))


def flown(table, i, path):
    """Return a particle's place (mm) and direction of flight as a function of its path."""
    momentum = np.array([table[name][i] for name in ("px", "py", "pz")])
    total = np.linalg.norm(momentum)
    force = LIGHT * table["charge"][i] / total

    def motion(_, state):
        return np.concatenate([state[3:], force * np.cross(state[3:], harmonic_by_hand(*state[:3]))])

    start = np.concatenate([[table[name][i] for name in "xyz"], momentum / total])
    return solve_ivp(motion, (0, path), start, "DOP853", rtol=1e-12, atol=1e-10, dense_output=True).sol


def crossing(track, radius, longest):
    """Return the path to where a track first leaves a cylinder."""
    path = np.linspace(0, longest, 2000)
    outside = np.hypot(*track(path)[:2]) > radius
    last = int(np.flatnonzero(outside[1:] & ~outside[:-1])[0])
    return brentq(lambda at: np.hypot(*track(at)[:2]) - radius, path[last], path[last + 1], xtol=1e-12)


@pytest.fixture(scope="module")
def flights():
    """Particles, and their tracks in the field alone."""
    table = gun(p=(0.3, 1.5))
    return table, [flown(table, i, 1500.0) for i in range(len(table))]


def test_crossings_of_gaps(detector, flights):
    """A gap where nothing is lost has no row: there is a thousandth of the matter, which moves points by 0.1 um."""
    table, tracks = flights
    truths = transport(without_matter(detector, density=1e-3), table)["truths"]
    assert len(truths["event"]) > 60
    for k, (i, number) in enumerate(zip(truths["event"], truths["layer"], strict=True)):
        layer, track = detector.cgem[number], tracks[i]
        edges = (layer.r_gap_in, layer.r_mid, layer.r_gap_out)
        entry, middle, exit_ = (crossing(track, radius, 400.0) for radius in edges)
        for name, at in (("entry", entry), ("exit", exit_)):
            found = [truths[f"{name}_{axis}"][k] for axis in "xyz"]
            assert found == pytest.approx(track(at)[:3], abs=2e-4)
        x, y, z, *flight = track(middle)
        phi, total = truths["phi"][k], np.linalg.norm([table[name][i] for name in ("px", "py", "pz")])
        assert [layer.r_mid * np.cos(phi), layer.r_mid * np.sin(phi), truths["z"][k]] == pytest.approx(
            [x, y, z], abs=2e-4
        )
        assert [truths[name][k] for name in ("px", "py", "pz")] == pytest.approx(total * np.array(flight), abs=1e-5)
        # The path in the gap counts with the slope that the track has in its middle.
        assert truths["path"][k] == pytest.approx(exit_ - entry, rel=2e-3)
        speed = 299.792458 * total / np.hypot(total, table["mass"][i])
        assert truths["time"][k] == pytest.approx(middle / speed, rel=1e-5)


def test_distances_from_wires(detector, flights):
    table, tracks = flights
    wires, chamber = transport(without_matter(detector), table)["wire_truths"], detector.drift_chamber
    layers = {layer.number: layer for layer in chamber.layers}
    rows = np.random.default_rng(1).choice(len(wires["event"]), 150, replace=False)
    for k in rows:
        east, west = map(np.array, layers[wires["layer"][k]].end_points(wires["wire"][k]))
        along, track = (east - west) / np.linalg.norm(east - west), tracks[wires["event"][k]]
        place = np.array([wires[axis][k] for axis in "xyz"])

        def distance(path, along=along, east=east, track=track):
            return np.linalg.norm(np.cross(track(path)[:3] - east, along))

        paths = np.linspace(0, 1500, 3001)
        near = paths[np.argmin(np.linalg.norm(track(paths)[:3] - place[:, None], axis=0))]
        best = minimize_scalar(distance, bounds=(near - 2, near + 2), method="bounded", options={"xatol": 1e-9})
        assert abs(wires["doca"][k]) == pytest.approx(best.fun, abs=1e-5)
        assert place == pytest.approx(track(best.x)[:3], abs=1e-3)  # along the track a minimum is known less well
        side = np.dot(track(best.x)[:3] - east, np.cross(track(best.x)[3:], along))
        assert np.sign(side) == wires["side"][k]


def test_another_field_moves_the_hits(flights, detector):
    """One part in a thousand of the field is seen in the same comparison, well above its tolerance."""
    weaker = detector.with_overrides({"field.bz": "-0.979 T"})
    one, other = (transport(without_matter(det, density=1e-3), flights[0])["truths"] for det in (detector, weaker))
    assert np.abs(one["exit_x"] - other["exit_x"]).max() > 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("p", [(0.05, 0.15), (0.3, 2.0)])
def test_constant_map_simulates_what_the_uniform_field_does(p):
    """Loopers, scatters and losses included: the same rows, within what steps cost."""
    uniform = cg.load("besiii-cgem-design")
    even = uniform.with_field({"kind": "harmonic", "bz": "-1 T", "b": "0 /m2", "tolerance": "1e-8 mm"})
    table = gun(n=300, p=p)
    one, other = (transport(compiled(det), table, "gaussian") for det in (uniform, even))
    assert (one["status"] == other["status"]).all()
    for name in ("truths", "wire_truths"):
        assert one[name]["event"].tolist() == other[name]["event"].tolist()
        assert one[name]["layer"].tolist() == other[name]["layer"].tolist()
        for column, values in one[name].items():
            assert other[name][column] == pytest.approx(values, rel=1e-7, abs=1e-6)


def test_true_helix_of_a_displaced_vertex(detector):
    """Tracked back through the map: closest to the beam line, across the radius, momentum kept."""
    table = gun(n=30, vertex=80.0, p=(0.1, 1.0))
    found = helix.at_origin_in(table, compiled(detector).field)
    for i, (dr, phi0, kappa, dz, tanl) in enumerate(found):
        place = np.array([dr * np.cos(phi0), dr * np.sin(phi0), dz])
        flight = np.array([-np.sin(phi0), np.cos(phi0), tanl])
        pt = 1 / abs(kappa)
        assert np.sign(kappa) == table["charge"][i]
        total = np.linalg.norm([table[name][i] for name in ("px", "py", "pz")])
        assert pt * np.hypot(1, tanl) == pytest.approx(total, rel=1e-9)
        # From there the particle flies to its vertex, or came from it.
        vertex = np.array([table[name][i] for name in "xyz"])
        back = particles(place, pt * flight, -13 * int(table["charge"][i]))
        inward = np.dot(vertex - place, flight) < 0
        if inward:
            back = particles(place, -pt * flight, 13 * int(table["charge"][i]))
        track = flown(back, 0, 300.0)
        best = minimize_scalar(
            lambda path, track=track, vertex=vertex: np.linalg.norm(track(path)[:3] - vertex),
            bounds=(0, 299), method="bounded", options={"xatol": 1e-8},
        )  # fmt: skip
        assert best.fun < 1e-5
    straight = helix.at_origin(table, -0.98)
    assert np.abs(found[:, 0] - straight[:, 0]).max() > 1e-3  # what the uniform field would say


def test_outside_a_map_the_true_helix_is_that_of_the_nominal_field(tmp_path, detector):
    small = detector.with_field(write_small_map(tmp_path, detector))
    table = particles([[0, 0, 0], [500, 0, 0]], [0.3, 0.1, 0.1])
    found, nominal = helix.at_origin_in(table, compiled(small).field), helix.at_origin(table, -0.98)
    assert found[1] == pytest.approx(nominal[1])


def write_small_map(folder, detector):
    """Write the field within r = 400 mm, |z| = 300 mm to a file."""
    r, z = np.linspace(0, 400, 21), np.linspace(-300, 300, 31)
    values = harmonic_by_hand(r[:, None], 0.0, z[None, :])
    return write_field_map(folder / "small.npz", {"r": r, "z": z, "br": values[..., 0], "bz": values[..., 2]})


def test_tracks_that_leave_the_map_have_a_status(tmp_path, detector):
    small = detector.with_field(write_small_map(tmp_path, detector))
    table = gun(n=100, vertex=5.0)
    out, whole = (transport(compiled(det), table) for det in (small, detector))
    assert (out["status"] == TransportStatus.left_field).sum() > 90
    assert set(out["status"]) <= {TransportStatus.left_field, TransportStatus.curled, TransportStatus.end}
    assert np.hypot(out["wire_truths"]["x"], out["wire_truths"]["y"]).max() < 400.1
    assert np.abs(out["wire_truths"]["z"]).max() < 300.1
    # Inside, nothing changes beyond what the points of the grid leave open.
    n = len(out["truths"]["event"])
    assert n > 200
    rows = {(e, k): i for i, (e, k) in enumerate(zip(whole["truths"]["event"], whole["truths"]["layer"], strict=True))}
    same = [rows[e, k] for e, k in zip(out["truths"]["event"], out["truths"]["layer"], strict=True)]
    assert out["truths"]["exit_x"] == pytest.approx(whole["truths"]["exit_x"][same], abs=1e-4)


def test_a_particle_from_outside_the_map(tmp_path, detector):
    small = detector.with_field(write_small_map(tmp_path, detector))
    table = particles([[0, 0, 310.0], [450, 0, 0], [0, 0, 0]], [0.3, 0.1, 0.05])
    assert transport(compiled(small), table)["status"].tolist() == [TransportStatus.left_field] * 3


def test_chain_and_results_carry_the_field(detector):
    result = cg.run(detector, cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5), vertex=(0, 20, 0)), n=20, seed=1)
    truth = helix.at_origin_in(result.particles, compiled(detector).field)
    assert result.tracks["truth_dr"] == pytest.approx(truth[:, 0])
    again = dataclasses.replace(detector, field=detector.field)
    assert again == detector
