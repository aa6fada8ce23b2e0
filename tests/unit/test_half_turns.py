"""Particles that turn back in the field and are followed: where they fly, what they meet, and whose hits they are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cgemit as cg
import gem_toy
from cgemit.detector import compiled, load
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.find import truth
from cgemit.simulation.digitize import digitize
from cgemit.simulation.transport import SimulateSettings, TransportStatus, simulate
from cgemit.tables import Table
from fields import harmonic_by_hand
from oracles import LIGHT
from tracks import particles, transport, without_matter

DESIGN = load("besiii-cgem-design")
EMPTY = without_matter(DESIGN)
PION = 0.13957039
P, TANL = 0.04, 0.1
PT = P / math.hypot(1, TANL)
RADIUS = PT / LIGHT
NANOSECOND = 299.792458 * P / math.hypot(P, PION)  # mm of path
ONE = particles([0.0, 0, 0], [PT * math.cos(0.3), PT * math.sin(0.3), PT * TANL], 211)
SLOW = Gun("pi+", p=(0.03, 0.11), cos_theta=(-0.9, 0.9)) + Gun("e-", p=(0.02, 0.1), cos_theta=(-0.9, 0.9))


def azimuth_turned(x, y):
    """Return the angle by which the flight of `ONE` has turned at points of its circle, 0 to 2 pi.

    The field along -z turns a positive charge to the left.
    """
    centre = RADIUS * np.array([-math.sin(0.3), math.cos(0.3)])
    return np.arctan2(y - centre[1], x - centre[0]) - (0.3 - math.pi / 2)


def test_hits_lie_on_one_helix():
    """Centre and radius stay, z advances by pi R tan(lambda) in a half turn, and the time is path over velocity."""
    out = transport(EMPTY, ONE, half_turns=5)
    assert out["status"][0] == TransportStatus.curled
    cells = out["wire_truths"]
    x, y, z, turn = (cells[name] for name in ("x", "y", "z", "half_turn"))
    centre = RADIUS * np.array([-math.sin(0.3), math.cos(0.3)])
    np.testing.assert_allclose(np.hypot(x - centre[0], y - centre[1]), RADIUS, atol=1e-6)
    psi = z / (RADIUS * TANL)
    off = np.remainder(psi - azimuth_turned(x, y) + math.pi, 2 * math.pi) - math.pi
    np.testing.assert_allclose(off, 0, atol=1e-6)
    np.testing.assert_allclose(cells["time"] * NANOSECOND, psi * RADIUS * math.hypot(1, TANL), atol=1e-6)
    # A cell at the apex belongs to the half turn in which it is first crossed.
    np.testing.assert_array_equal(np.unique(turn), range(5))
    early = np.abs(psi / math.pi - np.round(psi / math.pi)) < 0.05
    np.testing.assert_array_equal(turn[~early], np.floor(psi / math.pi)[~early])


def test_every_cell_of_the_way_back_fires_once():
    """Flown backward from its second closest approach, the antiparticle meets the same cells on the other side."""
    cells = transport(EMPTY, ONE, half_turns=3)["wire_truths"]
    back = particles([0.0, 0, 2 * math.pi * RADIUS * TANL], [[-ONE[f"p{axis}"][0] for axis in "xyz"]], -211)
    mirrored = transport(EMPTY, back)["wire_truths"]

    def doca(table, of):
        rows = np.flatnonzero(of)
        return {(int(table["layer"][i]), int(table["wire"][i])): float(table["doca"][i]) for i in rows}

    last, early = doca(mirrored, np.isfinite(mirrored["doca"])), doca(cells, cells["half_turn"] == 0)
    inward = doca(cells, cells["half_turn"] == 1)
    assert len(inward) == np.count_nonzero(cells["half_turn"] == 1) > 10
    # The cells that the antiparticle meets, too, are those that the outward half turn has taken.
    assert inward.keys() <= last.keys()
    assert last.keys() - inward.keys() <= early.keys()
    assert len(last) - len(inward) <= 4
    for place, value in inward.items():
        assert value == pytest.approx(-last[place], abs=1e-6)


def test_gaps_are_crossed_from_outside():
    """In next to no matter, each gap is crossed once a half turn, at equal distances from the apex."""
    out = transport(without_matter(DESIGN, 1e-9), ONE, half_turns=4)
    truths = out["truths"]
    rings = [layer for layer in DESIGN.cgem if layer.r_gap_out < 2 * RADIUS]
    n = len(rings)
    assert truths["half_turn"].tolist() == np.repeat(range(4), n).tolist()
    assert truths["layer"].tolist() == 2 * [*range(n), *reversed(range(n))]
    entry, exit_ = (np.hypot(truths[f"{name}_x"], truths[f"{name}_y"]) for name in ("entry", "exit"))
    low, high = (np.array([getattr(one, f"r_gap_{end}") for one in rings]) for end in ("in", "out"))
    np.testing.assert_allclose(entry, np.tile(np.concatenate([low, high[::-1]]), 2), atol=1e-9)
    np.testing.assert_allclose(exit_, np.tile(np.concatenate([high, low[::-1]]), 2), atol=1e-9)
    time = truths["time"].reshape(4, n)
    half = math.pi * RADIUS * math.hypot(1, TANL) / NANOSECOND
    np.testing.assert_allclose(time[0] + time[1, ::-1], 2 * half, atol=1e-5)
    np.testing.assert_allclose(time[2] - time[0], 2 * half, atol=1e-5)
    np.testing.assert_allclose(truths["path"].reshape(4, n)[1], truths["path"].reshape(4, n)[0, ::-1], atol=1e-6)


def test_matter_acts_on_the_way_back():
    """Started where it comes back, a particle crosses the same matter, by the code for its first half turn."""
    table = particles([0.0, 0, 0], [0.075, 0, 0.01], 211)
    off = SimulateSettings(fluctuations="off", decays=False, half_turns=3)
    truths = simulate(DESIGN, table, off)["truths"]
    momentum = np.stack([truths[f"p{axis}"] for axis in "xyz"], axis=1)
    size = np.linalg.norm(momentum, axis=1)
    assert np.all(np.diff(size) < 0)
    at = int(np.flatnonzero(truths["half_turn"] == 1)[0])  # the outermost gap
    middle = [truths["r"][at] * math.cos(truths["phi"][at]), truths["r"][at] * math.sin(truths["phi"][at])]
    place = np.array([*middle, truths["z"][at]]) - 1e-9 * momentum[at] / size[at]
    again = simulate(DESIGN, particles(place, momentum[at], 211), SimulateSettings(fluctuations="off", decays=False))
    first, later = again["truths"], truths[truths["half_turn"] == 2]
    assert len(first) == len(later) == 3
    for name in ("layer", "entry_x", "exit_y", "z", "px", "py", "pz", "energy"):
        np.testing.assert_allclose(first[name], later[name], rtol=1e-7, atol=1e-7, err_msg=name)
    np.testing.assert_allclose(first["time"] + truths["time"][at], later["time"], atol=1e-7)


@pytest.fixture
def scalar():
    """Compute with the scalar code; lanes fly these particles again with it."""
    before = cg.isa.name()
    cg.isa.use("scalar")
    yield
    cg.isa.use(before)


@pytest.mark.parametrize("fluctuations", ["full", "gaussian"])
def test_the_first_half_turn_does_not_depend_on_the_others(scalar, fluctuations):
    """To the last bit, also of the deposits."""
    table = generate(SLOW, 100, seed=1)
    few, many = (
        simulate(DESIGN, table, SimulateSettings(fluctuations=fluctuations, decays=False, half_turns=n), 2)
        for n in (1, 6)
    )
    for kind in ("truths", "wire_truths"):
        assert not few[kind]["half_turn"].any()
        first = many[kind][many[kind]["half_turn"] == 0]
        assert len(first) < 0.6 * len(many[kind])
        for name in first:
            np.testing.assert_array_equal(first[name], few[kind][name], err_msg=name)


def test_each_half_turn_draws_numbers_of_its_own():
    """The deposits of a particle in a gap on its way out, back and out again are independent, at equal paths."""
    table = generate(Gun("e-", p=0.06, cos_theta=(-0.2, 0.2)), 300, seed=1)
    truths = simulate(DESIGN, table, SimulateSettings(deltas=False, half_turns=3), 2)["truths"]
    energy = np.full((300, 3), np.nan)
    mine = truths["layer"] == 2
    energy[truths["event"][mine], truths["half_turn"][mine]] = np.log(truths["energy"][mine])
    energy = energy[np.isfinite(energy).all(axis=1)]
    assert len(energy) > 200
    assert np.abs(np.corrcoef(energy.T)[np.triu_indices(3, 1)]).max() < 4 / math.sqrt(len(energy))


@pytest.mark.parametrize("isa", cg.isa.available())
def test_chunks_give_the_same_bytes(isa):
    before = cg.isa.name()
    cg.isa.use(isa)
    try:
        settings = cg.Settings(simulate=SimulateSettings(half_turns=4))
        one, two = (
            cg.run(
                "besiii-cgem",
                SLOW,
                40,
                seed=7,
                settings=settings,
                until="find",
                workers=cg.Workers(threads=n, chunk=chunk),
            )
            for n, chunk in ((1, 40), (2, 7))
        )
    finally:
        cg.isa.use(before)
    for name, table in one.tables.items():
        assert table == two.tables[name], name


def test_through_a_field_map():
    """Every cell lies on scipy's integral of the motion at its time, over four half turns."""
    uneven = {"kind": "harmonic", "bz": "-0.98 T", "b": "0.175 /m2", "q": "-0.251 /m4", "tolerance": "1e-6 mm"}
    table = particles([3.0, -5, 10], [0.05, 0.02, 0.012], 211)
    cells = transport(without_matter(DESIGN.with_field(uneven)), table, half_turns=4)["wire_truths"]
    np.testing.assert_array_equal(np.unique(cells["half_turn"]), range(4))
    momentum = np.array([table[f"p{axis}"][0] for axis in "xyz"])
    total = np.linalg.norm(momentum)

    def motion(_, state):
        force = LIGHT / total * np.cross(state[3:], harmonic_by_hand(*state[:3]))
        return np.concatenate([state[3:], force])

    start = np.concatenate([[table[axis][0] for axis in "xyz"], momentum / total])
    path = cells["time"] * 299.792458 * total / math.hypot(total, PION)
    flown = solve_ivp(motion, (0, path.max()), start, "DOP853", rtol=1e-11, atol=1e-9, dense_output=True).sol(path)
    off = np.stack([cells[axis] for axis in "xyz"]) - flown[:3]
    along = np.sum(off * flown[3:], axis=0)  # the time holds to a picosecond, since the dip changes along a step
    assert np.abs(along).max() < 0.2
    np.testing.assert_allclose(off, along * flown[3:], atol=1e-4)


def test_a_particle_that_starts_inward_leaves_hits_there():
    """Its path to the closest approach is number -1, and the half turns that follow are counted as usual."""
    start = particles([0.0, -190, 20], [0.03, 0.09, 0.01], 211)
    settings = {"fluctuations": "gaussian", "decays": False}
    one, many = (simulate(DESIGN, start, SimulateSettings(**settings, half_turns=n), 5) for n in (1, 3))
    turn = many["truths"]["half_turn"]
    assert turn.tolist()[:6] == [-1, -1, -1, 0, 0, 0]
    assert many["truths"]["layer"].tolist()[:6] == [2, 1, 0, 0, 1, 2]
    assert set(many["wire_truths"]["half_turn"]) == {0, 1, 2}
    for kind in ("truths", "wire_truths"):
        first = many[kind][many[kind]["half_turn"] == 0]
        np.testing.assert_allclose(first["z"], one[kind]["z"], atol=1e-9)
        np.testing.assert_allclose(first["time"], one[kind]["time"], atol=1e-9)
    assert np.all(np.diff(many["truths"]["time"]) > 0)


def test_decays_of_later_half_turns():
    """A particle that decays after its apex leaves no hits later, and its daughters start where it ends."""
    table = generate(Gun("pi+", p=(0.05, 0.11), cos_theta=(-0.5, 0.5)), 300, seed=3)
    out = simulate(DESIGN, table, SimulateSettings(half_turns=8), 4)
    first = out["decays"][out["decays"]["daughter"] == 1]
    end = np.full(len(table), np.inf)
    end[truth.particle_rows(table, first)] = first["time"]
    np.testing.assert_array_equal(np.isfinite(end), out["particles"]["status"] == TransportStatus.decayed)
    late_decays = 0
    for kind in ("truths", "wire_truths"):
        rows, whose = out[kind], truth.particle_rows(table, out[kind])
        own = rows["daughter"] == 0
        assert np.all(rows["time"][own] <= end[whose[own]])
        assert np.all(rows["time"][~own] >= end[whose[~own]])
        late_decays += len(np.unique(whose[own & (rows["half_turn"] > 0) & np.isfinite(end[whose])]))
    assert late_decays > 10
    few = simulate(DESIGN, table, SimulateSettings(), 4)["decays"]
    assert len(first) > np.count_nonzero(few["daughter"] == 1)


def test_the_finder_by_truth_takes_the_first_half_turn():
    settings = cg.Settings(simulate=SimulateSettings(half_turns=4, decays=False))
    result = cg.run("besiii-cgem", Gun("pi-", p=(0.06, 0.11), cos_theta=(-0.5, 0.5)), 40, seed=1, settings=settings)
    hits = result.candidate_hits
    wire = hits["view"] == 2
    of_wire = result.wire_truths["half_turn"][result.wire_hits["wire_truth"][hits["row"][wire]]]
    of_cluster = result.truths["half_turn"][result.clusters["truth"][hits["row"][~wire]]]
    assert min(len(of_wire), len(of_cluster)) > 100
    assert not of_wire.any()
    assert not of_cluster.any()
    assert np.any(result.wire_truths["half_turn"][result.wire_hits["wire_truth"]] > 0)


@pytest.mark.parametrize(("late", "wins"), [(0.0, 1), (60.0, 0)])
def test_of_two_hits_of_a_cell_the_earliest_counts(late, wins):
    """On a later half turn the flight adds to the drift time: 2.8 mm need 75 ns, 1.2 mm need 25 ns."""
    columns = gem_toy.wire_truth_columns(0, 20, 7, [2.8, 1.2])
    columns |= {"half_turn": np.array([0, 2], np.int8), "time": np.array([1.0, late])}
    none = Table("truths", gem_toy.truth_columns(0, 0, np.zeros((0, 3)), np.zeros((0, 3))), 1)
    hits = digitize(DESIGN, none, Table("wire_truths", columns, 1))["wire_hits"]
    assert hits["wire_truth"].tolist() == [wins]


@pytest.mark.parametrize("given", [0, 16, 1.5])
def test_impossible_numbers_are_refused(given):
    with pytest.raises(ValueError, match=r"half_turns: got .*expected a whole number from 1 to 15"):
        SimulateSettings(half_turns=given)


def test_the_core_refuses_them_too():
    with pytest.raises(ValueError, match="half_turns: got 16, expected 1 to 15"):
        transport(compiled(DESIGN), ONE, half_turns=16)
