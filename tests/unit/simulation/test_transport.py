"""Simulated particles follow scipy's motion through gaps, cells, field maps, half turns and decays, in lanes too."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise
from time import process_time

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

import cgemit as cg
import gem_toy
from cgemit import _core, helix, isa
from cgemit.chain import run
from cgemit.chain.executor import Workers
from cgemit.detector import Detector, compiled, load, write_field_map
from cgemit.fit_matter import tuned
from cgemit.particles.gun import Gun, generate
from cgemit.particles.species import DECAYS, KNOWN, DecayMode, decay_table
from cgemit.simulation.digitize import digitize
from cgemit.simulation.transport import SimulateSettings, TransportStatus, simulate
from cgemit.tables import Table
from cgemit.truth import origins
from fields import HARMONIC, harmonic_by_hand, small_map
from oracles import LIGHT, integrate
from tracks import MUON, hits_on, on_helix, particles, transport, without_matter

DESIGN, IDC = load("besiii-cgem-design"), load("besiii-idc")
IDC_WITHOUT_MATTER = without_matter(IDC)
OFF = SimulateSettings(fluctuations="off")
BY_NAME = {"besiii-cgem-design": DESIGN, "besiii-idc": IDC}


def status_of(momentum, pdg=13, position=(0.0, 0, 0), detector=DESIGN):
    """Return the status of one particle."""
    return TransportStatus(simulate(detector, particles(position, momentum, pdg), OFF)["particles"]["status"][0])


@pytest.mark.parametrize("pdg", [13, -13, 211, 321, 2212])
def test_leaves_through_the_outermost_cylinder(pdg):
    """A particle of 1 GeV/c at 60 degrees crosses everything."""
    assert status_of([0.8, 0.3, 0.5], pdg) == TransportStatus.outside


@pytest.mark.parametrize("pt", [0.05, 0.08, 0.105])
def test_curls(pt):
    """Tracks whose circle ends inside the chamber curl, after the layers that they reach, and only those."""
    out = simulate(DESIGN, particles([0.0, 0, 0], [pt, 0, 0.1 * pt], -11), OFF)
    assert out["particles"]["status"][0] == TransportStatus.curled
    reach = 2 * pt / LIGHT
    wires = {layer.number: layer.r_mid for layer in DESIGN.drift_chamber.layers}
    crossed = [layer.r_gap_out < 0.97 * reach for layer in DESIGN.cgem]
    np.testing.assert_array_equal(out["truths"]["layer"], np.flatnonzero(crossed))
    radii = [wires[number] for number in out["wire_truths"]["layer"]]
    assert max(radii, default=0) < reach + 10
    assert len(set(radii)) >= sum(radius < 0.95 * reach for radius in wires.values())


def test_leaves_through_an_end():
    """At 25 degrees a track leaves the chamber through an end plate, at 4 degrees it misses the outer CGEM layers."""
    out = simulate(DESIGN, particles([0.0, 0, 0], [math.sin(0.44), 0, math.cos(0.44)]), OFF)
    assert out["particles"]["status"][0] == TransportStatus.end
    z_end = {layer.number: layer.half_length for layer in DESIGN.drift_chamber.layers}
    assert len(out["wire_truths"]) > 0
    assert all(abs(z) <= z_end[n] for z, n in zip(out["wire_truths"]["z"], out["wire_truths"]["layer"], strict=True))
    steep = simulate(DESIGN, particles([0.0, 0, 0], [math.sin(0.07), 0, math.cos(0.07)]), OFF)
    assert steep["particles"]["status"][0] == TransportStatus.end
    assert len(steep["truths"]) == 0


@pytest.mark.parametrize(("p", "expected"), [(0.12, "stopped"), (0.6, "outside")])
def test_slow_protons_stop(p, expected):
    """A proton of 0.12 GeV/c (8 MeV) stops in the beam pipe, one of 0.6 GeV/c leaves the chamber."""
    assert status_of([p, 0, 0.01], 2212).name == expected


def test_neutral_and_along_the_beam():
    """Neutral particles are not transported, particles without transverse momentum leave through an end."""
    assert status_of([1.0, 0, 0], 22) == TransportStatus.neutral
    assert status_of([0.0, 0, 1.0]) == TransportStatus.end


def test_rows_of_every_particle_are_kept():
    """Every particle keeps its row, whatever happened to it."""
    momenta = np.array([[1.0, 0, 0], [0.05, 0, 0], [0.1, 0, 1], [0, 0, 1.0], [1, 0, 0]])
    out = simulate(DESIGN, particles(np.zeros(3), momenta, [13, 13, 13, 13, 22]))
    assert len(out["particles"]) == 5
    names = [TransportStatus(s).name for s in out["particles"]["status"]]
    assert names == ["outside", "curled", "end", "end", "neutral"]


@pytest.mark.parametrize("bz", [-1, 1])
@pytest.mark.parametrize("charge", [-1, 1])
def test_truths_lie_on_the_integrated_path(charge, bz):
    """Without fluctuations, entry, middle and exit of the first gap lie on the path from the displaced vertex."""
    detector = DESIGN.with_overrides({"field.bz": f"{bz} T", "remove": ["beam_pipe"]})
    position, momentum = np.array([12.0, 16.0, -7.0]), np.array([0.5, 0.1, 0.3])
    truths = simulate(detector, particles(position, momentum, -13 * charge), OFF)["truths"]
    layer = detector.cgem[0]
    assert truths["r"][0] == pytest.approx(layer.r_mid, abs=1e-9)
    for prefix, radius in (("entry", layer.r_gap_in), ("exit", layer.r_gap_out)):
        x, y, z = (truths[f"{prefix}_{c}"][0] for c in "xyz")
        assert math.hypot(x, y) == pytest.approx(radius, abs=1e-9)
        length = (z - position[2]) * np.linalg.norm(momentum) / momentum[2]
        path = integrate(position, momentum, charge, bz, length)
        # The cathode and 40 mm of air take 0.15 MeV off, on the last 3 mm of the way.
        np.testing.assert_allclose([x, y], path.y[:2, -1], atol=2e-3)
    found = np.array([truths[c][0] for c in ("px", "py", "pz")])
    np.testing.assert_allclose(found, path.y[3:, -1], atol=2e-3)


def test_path_time_and_energy():
    """Path is the distance between entry and exit, time the flight over beta c, energy that of the gas."""
    out = simulate(DESIGN, particles([0.0, 0, 0], [0.4, 0.3, 0.4]), OFF)
    t = out["truths"]
    chord = np.sqrt(sum((t[f"exit_{c}"] - t[f"entry_{c}"]) ** 2 for c in "xyz"))
    np.testing.assert_allclose(t["path"], chord, rtol=1e-4)
    p = np.sqrt(t["px"] ** 2 + t["py"] ** 2 + t["pz"] ** 2)
    flown = np.sqrt(t["r"] ** 2 + t["z"] ** 2)  # the arc is longer than its chord by (r/2R)^2/6
    beta = p / np.hypot(p, MUON)
    np.testing.assert_allclose(t["time"], flown / (beta * 299.792458), rtol=3e-3)
    # 5 mm of gas at normal incidence: about 1.2 keV, seen 1/cos(lambda) thicker.
    np.testing.assert_allclose(t["energy"], 1.2 * math.hypot(1, 0.8), rtol=0.2)
    assert np.all(np.diff(out["wire_truths"]["time"][np.argsort(out["wire_truths"]["layer"], kind="stable")]) > -1)


@pytest.mark.parametrize("name", BY_NAME)
@pytest.mark.parametrize("bz", [-1, 1])
@pytest.mark.parametrize("helix", [(0.2, 0.3, -1.0, 5, 0.4), (-20.0, 2.5, 2.0, -9, -0.8), (0.1, -1.9, 6.0, 0, 0.2)])
def test_unsmeared_hits_fit_perfectly(name, bz, helix):
    """The hits of a particle without fluctuations are fitted with the true helix, residuals 0 and chi-square 0."""
    detector, helix = BY_NAME[name].with_overrides({"field.bz": f"{bz} T"}), np.array(helix)
    hits = hits_on(detector, helix)
    settings = {
        "max_iterations": 40, "tolerance": 1e-6, "errors_from_track": False, "least_width": 0.1, "delta_strips": 0.0,
        "kinks": False, "outlier_pull": 0.0, "momentum": 1.0, "prior_sigma": (200.0, 2, 5, 1000, 5),
        "beam": (0.0, 0.0),
    }  # fmt: skip
    start = helix + np.array([0.5, 0.004, 0.02 * helix[2], 3, 0.01])
    out = _core.reconstruction.fit(tuned(detector), hit_offsets=np.array([0, len(hits["kind"])]), hits=hits,
                    mass=np.array([MUON]), start=start[None], settings=settings, residuals=True)  # fmt: skip
    assert out["status"][0] == 0
    sigma = np.sqrt(np.diag(out["cov"][0]))
    np.testing.assert_allclose((out["helix"][0] - helix) / sigma, 0, atol=1e-4)
    np.testing.assert_allclose(out["residual"] / out["err"], 0, atol=1e-4)
    assert out["chi2"][0] < 1e-6


@pytest.mark.parametrize("number", range(40))
def test_every_cell_on_the_way(number):
    """The cells recorded are those in which points of the path lie: nearest wire, between the layers' borders."""
    rng = np.random.default_rng(number)
    kappa = (-1) ** number * rng.uniform(0.2, 6.0)
    helix = np.array([rng.uniform(-30, 30), rng.uniform(-math.pi, math.pi), kappa, 0.0, rng.uniform(-0.9, 0.9)])
    start = on_helix(helix)
    found = transport(IDC_WITHOUT_MATTER, start)["wire_truths"]
    recorded = set(zip(found["layer"].tolist(), found["wire"].tolist(), strict=True))
    assert len(recorded) == len(found["layer"]) >= 43
    pt, spacing = abs(1 / helix[2]), 0.05
    turning = -LIGHT * math.copysign(1, helix[2]) * IDC.field.bz / pt
    psi = helix[1] + math.pi / 2 + turning * np.arange(0, 1100, spacing)
    x = start["x"][0] + (np.sin(psi) - np.sin(psi[0])) / turning
    y = start["y"][0] - (np.cos(psi) - np.cos(psi[0])) / turning
    z = start["z"][0] + helix[4] * spacing * np.arange(len(psi))
    outgoing = np.cumsum(np.hypot(x, y) > 790) == 0
    x, y, z = x[outgoing], y[outgoing], z[outgoing]
    radii = []
    for layer in IDC.drift_chamber.layers:
        east, west = (np.array(end) for end in layer.end_points(0))
        on_wire = west[:, None] + (z / (2 * layer.half_length) + 0.5) * (east - west)[:, None]
        radii.append((np.hypot(on_wire[0], on_wire[1]), np.arctan2(on_wire[1], on_wire[0])))
    certain, possible = set(), set()
    for i, layer in enumerate(IDC.drift_chamber.layers[:-1]):
        inner = 0.5 * (radii[i - 1][0] + radii[i][0]) if i else radii[0][0] - (radii[1][0] - radii[0][0]) / 2
        outer = 0.5 * (radii[i][0] + radii[i + 1][0])
        r, cell = np.hypot(x, y), (np.arctan2(y, x) - radii[i][1]) * layer.cells / (2 * math.pi)
        # The borders are taken at one z for each layer: 0.5 mm of doubt, and as much to either side.
        doubt = 0.5 * layer.cells / (2 * math.pi * r)
        inside = (r > inner + 0.5) & (r < outer - 0.5) & (np.abs(cell - np.rint(cell)) < 0.5 - doubt)
        certain |= {(layer.number, int(c) % layer.cells) for c in np.rint(cell[inside])}
        near = (r > inner - 0.5) & (r < outer + 0.5)
        for shift in (-doubt, doubt):
            possible |= {(layer.number, int(c) % layer.cells) for c in np.rint(cell + shift)[near]}
    last = IDC.drift_chamber.layers[-1].number
    assert certain <= recorded
    assert {pair for pair in recorded if pair[0] != last} <= possible


def test_wire_truths_are_closest_points():
    """Point, distance and side of each row agree: the point is |doca| away from the wire, on the stated side."""
    out = simulate(IDC, particles([3.0, -2, 1], [[0.5, 0.2, 0.2], [-0.3, 0.1, -0.1]]))["wire_truths"]
    layers = {layer.number: layer for layer in IDC.drift_chamber.layers}
    for i in range(len(out)):
        east, west = map(np.array, layers[out["layer"][i]].end_points(out["wire"][i]))
        wire = (east - west) / np.linalg.norm(east - west)
        offset = np.array([out[c][i] for c in "xyz"]) - west
        across = offset - (offset @ wire) * wire
        assert abs(out["doca"][i]) == pytest.approx(np.linalg.norm(across), abs=1e-6)
        assert out["side"][i] == np.sign(out["doca"][i])


def test_field_and_charge_mirror():
    """Reversed field and charge give the same crossings, reversed field alone the mirrored ones."""
    other = DESIGN.with_overrides({"field.bz": "1 T"})
    momentum = np.array([0.5, 0.2, 0.3])
    plain = simulate(DESIGN, particles([0.0, 0, 0], momentum, 13), OFF)["truths"]
    both = simulate(other, particles([0.0, 0, 0], momentum, -13), OFF)["truths"]
    mirrored = simulate(other, particles([0.0, 0, 0], momentum * [1, -1, 1], 13), OFF)["truths"]
    for name in ("phi", "z", "px", "py", "pz", "time", "energy"):
        np.testing.assert_allclose(both[name], plain[name], rtol=1e-12)
        np.testing.assert_allclose(mirrored[name], both[name] * (-1 if name in ("phi", "py") else 1), rtol=1e-12)


def test_inward_moving_particle_meets_matter_twice():
    """A particle that starts outside the beam pipe and flies through it is seen on the way out only, and slower."""
    inward = simulate(DESIGN, particles([-100.0, 1, 0], [0.3, 0, 0.05]), OFF)["truths"]
    outward = simulate(DESIGN, particles([0.0, 0, 0], [0.3, 0, 0.05]), OFF)["truths"]
    assert inward["layer"].tolist() == outward["layer"].tolist() == [0, 1, 2]
    assert np.all(np.abs(inward["phi"]) < 0.3)
    p = [np.sqrt(t["px"] ** 2 + t["py"] ** 2 + t["pz"] ** 2)[0] for t in (inward, outward)]
    assert p[1] - p[0] > 0.5e-3  # 1.4 mm of beryllium and the first layer once more


@pytest.mark.parametrize("radius", [77.0, 78.5, 80.0])
def test_vertex_inside_a_drift_gap(radius):
    """A particle born in a drift gap leaves no row with a path that is negative or longer than a crossing's."""
    truths = simulate(DESIGN, particles([radius, 0, 0], [0.5, 0.02, 0.1]), OFF)["truths"]
    assert np.all((truths["path"] > 0) & (truths["path"] < 6))
    assert truths["layer"].tolist()[-2:] == [1, 2]


def test_fluctuations_of_sublayers():
    """Sub-layers scattering one by one, or merged to groups, lose the same energy and give the same crossings."""
    table = particles([0.0, 0, 0], [0.3, 0.1, 0.05])
    merged = simulate(DESIGN, table, OFF)["truths"]
    single = simulate(DESIGN, table, SimulateSettings(fluctuations="off", sublayers=True))["truths"]
    np.testing.assert_allclose(single["phi"], merged["phi"], atol=1e-6)
    np.testing.assert_allclose(single["px"], merged["px"], rtol=2e-5)


@pytest.mark.parametrize(("name", "value"), [("x", math.nan), ("z", 1e300), ("px", math.inf), ("mass", math.nan)])
def test_particles_that_are_nowhere_are_refused(name, value):
    """The same as `chain.run` says, before anything is simulated."""
    table = generate(Gun("mu-", p=1.0, cos_theta=0.2), 3, seed=1)
    column = table[name].copy()
    column[1] = value
    messages = []
    for stage in (simulate, run.run):
        with pytest.raises(ValueError, match=rf"{name}: is .* in row 1$") as error:
            stage(DESIGN, table.with_columns(**{name: column}))
        messages.append(str(error.value))
    assert messages[0] == messages[1]


def test_unknown_fluctuations():
    """A misspelt kind of fluctuations lists the choices."""
    with pytest.raises(ValueError, match="'full', 'gaussian', 'off'"):
        SimulateSettings(fluctuations="some")


def test_events_do_not_depend_on_chunks():
    """A table simulated in pieces, or one event alone, gives the rows it has in the whole."""
    table = generate(
        Gun("pi+", p=(0.1, 1.0), cos_theta=(-0.9, 0.9), vertex_sigma=(1, 1, 5), multiplicity=2), 40, seed=9
    )
    whole = simulate(DESIGN, table, seed=4)
    for first, last in ((0, 13), (13, 40), (7, 8)):
        part = simulate(DESIGN, table.select_events(first, last), seed=4)
        for name in ("particles", "truths", "wire_truths"):
            assert part[name] == whole[name].select_events(first, last)


@pytest.mark.parametrize("readout", ["binary", "gaussian"])
def test_chain_does_not_depend_on_threads_and_chunks(readout):
    """The same seed gives the same bytes for one and two threads, any chunk size, and for a table of one event."""
    gun = Gun("mu-", p=(0.2, 1.0), cos_theta=(-0.9, 0.9))
    results = [
        run.run(DESIGN, gun, 30, seed=6, readout=readout, workers=Workers(threads=threads, chunk=chunk))
        for threads, chunk in ((1, 1000), (2, 7), (2, 1))
    ]
    assert results[1] == results[0]
    assert results[2] == results[0]
    alone = run.run(DESIGN, results[0].particles.select_events(17, 18), seed=6, readout=readout)
    for name in ("dr", "phi0", "kappa", "dz", "tanl", "cov", "chi2"):
        np.testing.assert_array_equal(alone.tracks[name][0], results[0].tracks[name][17])
    other = run.run(DESIGN, gun, 30, seed=7, readout=readout)
    assert not np.any(other.tracks["dr"] == results[0].tracks["dr"])


@pytest.mark.parametrize("radius", [40.0, 60.0, 100.0])
def test_particles_that_start_inward_come_out_again(radius: float) -> None:
    """A 1 GeV/c muon from a displaced vertex never curls, whichever cylinders it grazes on its way in and out."""
    gun = Gun("mu-", p=1.0, theta=1.3, vertex=(radius, 0.0, 0.0), phi=(0.5 * np.pi, 1.5 * np.pi))
    found = simulate(DESIGN, generate(gun, 1000, seed=2), SimulateSettings(), seed=2)["particles"]
    assert np.all(found["status"] == TransportStatus.outside)


DESIGN_TURNS = load("besiii-cgem-design")
EMPTY = without_matter(DESIGN_TURNS)
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
    out = transport(without_matter(DESIGN_TURNS, 1e-9), ONE, half_turns=4)
    truths = out["truths"]
    rings = [layer for layer in DESIGN_TURNS.cgem if layer.r_gap_out < 2 * RADIUS]
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
    truths = simulate(DESIGN_TURNS, table, off)["truths"]
    momentum = np.stack([truths[f"p{axis}"] for axis in "xyz"], axis=1)
    size = np.linalg.norm(momentum, axis=1)
    assert np.all(np.diff(size) < 0)
    at = int(np.flatnonzero(truths["half_turn"] == 1)[0])  # the outermost gap
    middle = [truths["r"][at] * math.cos(truths["phi"][at]), truths["r"][at] * math.sin(truths["phi"][at])]
    place = np.array([*middle, truths["z"][at]]) - 1e-9 * momentum[at] / size[at]
    again = simulate(
        DESIGN_TURNS, particles(place, momentum[at], 211), SimulateSettings(fluctuations="off", decays=False)
    )
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
        simulate(DESIGN_TURNS, table, SimulateSettings(fluctuations=fluctuations, decays=False, half_turns=n), 2)
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
    truths = simulate(DESIGN_TURNS, table, SimulateSettings(deltas=False, half_turns=3), 2)["truths"]
    energy = np.full((300, 3), np.nan)
    mine = truths["layer"] == 2
    energy[truths["event"][mine], truths["half_turn"][mine]] = np.log(truths["energy"][mine])
    energy = energy[np.isfinite(energy).all(axis=1)]
    assert len(energy) > 200
    assert np.abs(np.corrcoef(energy.T)[np.triu_indices(3, 1)]).max() < 4 / math.sqrt(len(energy))


@pytest.mark.parametrize("name", cg.isa.available())
def test_slow_heavy_particles_beside_fast_ones_cost_no_time_and_change_nothing(name):
    """Lanes of particles that have turned back or stopped drew millions of hard scatters: ten took a minute."""
    before = cg.isa.name()
    cg.isa.use(name)
    try:
        momenta = np.zeros((10, 3))
        momenta[::2, 0], momenta[1::2, 0] = 1.1e-6, 9000.0
        momenta[2, 0] = 0.05  # stops in the beam pipe
        mixed = particles([0.0, 0, 0], momenta, [5132, 541] * 5)
        begin = process_time()
        both = simulate(DESIGN, mixed, seed=3)
        assert process_time() - begin < 30
        fast = mixed[mixed["pdg"] == 541]
        alone = simulate(DESIGN, fast, seed=3)
    finally:
        cg.isa.use(before)
    assert both["particles"]["status"].tolist()[:3] == [
        TransportStatus.curled, TransportStatus.outside, TransportStatus.stopped,
    ]  # fmt: skip
    for table in ("truths", "steps", "wire_truths"):
        assert len(alone[table]) > 0
        for column in ("event", "x", "y", "z"):
            if column in alone[table].columns:
                assert np.array_equal(both[table][column], alone[table][column]), (table, column)


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
    cells = transport(without_matter(DESIGN_TURNS.with_field(uneven)), table, half_turns=4)["wire_truths"]
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
    one, many = (simulate(DESIGN_TURNS, start, SimulateSettings(**settings, half_turns=n), 5) for n in (1, 3))
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
    out = simulate(DESIGN_TURNS, table, SimulateSettings(half_turns=8), 4)
    first = out["decays"][out["decays"]["daughter"] == 1]
    end = np.full(len(table), np.inf)
    end[origins.particle_rows(table, first)] = first["time"]
    np.testing.assert_array_equal(np.isfinite(end), out["particles"]["status"] == TransportStatus.decayed)
    late_decays = 0
    for kind in ("truths", "wire_truths"):
        rows, whose = out[kind], origins.particle_rows(table, out[kind])
        own = rows["daughter"] == 0
        assert np.all(rows["time"][own] <= end[whose[own]])
        assert np.all(rows["time"][~own] >= end[whose[~own]])
        late_decays += len(np.unique(whose[own & (rows["half_turn"] > 0) & np.isfinite(end[whose])]))
    assert late_decays > 10
    few = simulate(DESIGN_TURNS, table, SimulateSettings(), 4)["decays"]
    assert len(first) > np.count_nonzero(few["daughter"] == 1)


def test_the_finder_by_truth_takes_the_first_half_turn():
    settings = cg.Settings(simulate=SimulateSettings(half_turns=4, decays=False))
    result = cg.run("besiii-cgem", Gun("pi-", p=(0.06, 0.11), cos_theta=(-0.5, 0.5)), 40, seed=1, settings=settings)
    hits = result.candidate_hits
    wire = hits["view"] == 2
    of_wire = result.wire_truths["half_turn"][result.wire_hits["wire_truth"][hits["hit"][wire]]]
    of_cluster = result.truths["half_turn"][result.clusters["truth"][hits["hit"][~wire]]]
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
    hits = digitize(DESIGN_TURNS, none, Table("wire_truths", columns, 1))["wire_hits"]
    assert hits["wire_truth"].tolist() == [wins]


@pytest.mark.parametrize("given", [0, 16, 1.5])
def test_impossible_numbers_are_refused(given):
    with pytest.raises(ValueError, match=r"half_turns: got .*expected a whole number from 1 to 15"):
        SimulateSettings(half_turns=given)


def test_the_core_refuses_them_too():
    with pytest.raises(ValueError, match="half_turns: got 16, expected 1 to 15"):
        transport(tuned(DESIGN_TURNS), ONE, half_turns=16)


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
    # One error of the momentum: its table is traced through the map with steps of its own.
    one, other = (transport(tuned(det, momentum_error=0.003), table, "gaussian") for det in (uniform, even))
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
    # In the map muons have fewer hits, so that the fit would assume another loss.
    out, whole = (transport(tuned(det, momentum_error=0.003), table) for det in (small, detector))
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
    assert transport(tuned(small), table)["status"].tolist() == [TransportStatus.left_field] * 3


def test_chain_and_results_carry_the_field(detector):
    result = cg.run(detector, cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5), vertex=(0, 20, 0)), n=20, seed=1)
    truth = helix.at_origin_in(result.particles, compiled(detector).field)
    assert result.tracks["truth_dr"] == pytest.approx(truth[:, 0])
    again = dataclasses.replace(detector, field=detector.field)
    assert again == detector


DETECTOR = load("besiii-cgem-design")
GUN = Gun("K+", p=(0.2, 0.6), cos_theta=(-0.8, 0.8)) + Gun("pi-", p=(0.1, 0.4), cos_theta=(-0.8, 0.8))
N = 300


def simulated(**settings) -> dict[str, Table]:
    return simulate(DETECTOR, generate(GUN, N, seed=1), SimulateSettings(**settings), 2)


def own(table: Table) -> Table:
    return table[table["daughter"] == 0]


@pytest.fixture(params=cg.isa.available())
def kernels(request):
    """Use each instruction set in turn."""
    before = cg.isa.name()
    cg.isa.use(request.param)
    yield request.param
    cg.isa.use(before)


@pytest.mark.parametrize("fluctuations", ["full", "gaussian"])
def test_up_to_the_decay_nothing_changes(fluctuations, kernels):
    """Particles that do not decay are the same to the last bit; the others are until they decay.

    With lanes, particles that decay are those of scalar code, which rounds otherwise.
    """
    on, off = (simulated(fluctuations=fluctuations, decays=decays) for decays in (True, False))
    assert len(off["decays"]) == 0
    assert not off["truths"]["daughter"].any()
    gone = on["particles"]["status"] == TransportStatus.decayed
    assert 50 < np.count_nonzero(gone) < 400
    np.testing.assert_array_equal(on["particles"]["status"][~gone], off["particles"]["status"][~gone])

    def whose(table):
        return origins.particle_rows(on["particles"], table)

    def places(table):
        return (whose(table) * 100 + table["layer"]) * 1000 + table.columns.get("wire", 0)

    end = np.full(len(gone), np.inf)
    first = on["decays"][on["decays"]["daughter"] == 1]
    end[whose(first)] = first["time"]
    for kind in ("truths", "wire_truths"):
        mine, theirs = own(on[kind]), off[kind]
        before = theirs[theirs["time"] < end[whose(theirs)]]
        assert len(before) < len(theirs)
        # A decay close to a gap or cell may take its crossing away.
        before = before[np.isin(places(before), places(mine))]
        assert len(before) == len(mine) > np.count_nonzero(theirs["time"] < end[whose(theirs)]) - 4
        decays = gone[whose(mine)]
        for name in mine:
            np.testing.assert_array_equal(mine[name][~decays], before[name][~decays], err_msg=name)
            # Deposits are made of decisions, which fall otherwise if a number is rounded otherwise.
            if kernels == "scalar" or name not in ("energy", "secondaries"):
                near = {"rtol": 0 if kernels == "scalar" else 1e-9, "atol": 0 if kernels == "scalar" else 1e-9}
                np.testing.assert_allclose(mine[name][decays], before[name][decays], err_msg=name, **near)


def test_each_decay_is_told():
    """Every particle that decayed has a row for its first charged daughter, and no other particle has one."""
    out = simulated()
    first = out["decays"][out["decays"]["daughter"] == 1]
    assert not first["parent"].any()
    rows = origins.particle_rows(out["particles"], first)
    np.testing.assert_array_equal(rows, np.flatnonzero(out["particles"]["status"] == TransportStatus.decayed))
    for row, pdg, mode in zip(rows, first["pdg"], first["mode"], strict=True):
        assert DECAYS[int(out["particles"]["pdg"][row])][mode].charged[0].pdg == pdg


@pytest.mark.parametrize("kind", ["truths", "wire_truths"])
def test_hits_of_daughters_come_after_the_decay(kind):
    """Own hits come before the decay, those of a daughter after it; a particle with daughters' hits has decayed."""
    out = simulated()
    table, decays = out[kind], out["decays"]
    key = (table["event"] * 10 + table["particle"]) * 100 + table["daughter"]
    known = (decays["event"] * 10 + decays["particle"]) * 100 + decays["daughter"]
    late = table["daughter"] > 0
    assert np.count_nonzero(late) > 50
    assert np.isin(key[late], known).all()
    time = dict(zip(known.tolist(), decays["time"].tolist(), strict=True))
    assert all(t > time[k] for k, t in zip(key[late].tolist(), table["time"][late].tolist(), strict=True))
    mine = (~late) & np.isin(key + 1, known)
    assert np.count_nonzero(mine) > 200
    assert all(t < time[k + 1] for k, t in zip(key[mine].tolist(), table["time"][mine].tolist(), strict=True))


def test_daughters_start_where_the_parent_ends():
    """The nearest cells before and after a decay lie within a layer or two of it."""
    out = simulated()
    decays = out["decays"][out["decays"]["daughter"] == 1]
    decays = decays[np.hypot(decays["x"], decays["y"]) > 250]
    at = np.column_stack([decays[axis] for axis in "xyz"])
    found = []
    for event, particle, time, point in zip(decays["event"], decays["particle"], decays["time"], at, strict=True):
        cells = out["wire_truths"].select_events(event, event + 1)
        cells = cells[cells["particle"] == particle]
        where = np.column_stack([cells[axis] for axis in "xyz"])
        for after in (False, True):
            near = (cells["daughter"] == int(after)) & (np.abs(cells["time"] - time) < 0.5)
            distance = np.linalg.norm(where[near] - point, axis=1)
            # No faster than light.
            assert np.all(distance <= 299.8 * np.abs(cells["time"][near] - time) + 1e-6)
            found.append(near.any())
    assert len(found) > 40
    assert np.mean(found) > 0.7


def test_chunks_threads_and_neighbours(kernels):
    """The same bytes in one piece, in chunks and in threads, with every instruction set."""
    settings = cg.Settings(simulate=SimulateSettings(steps=True))
    whole, pieces = (
        cg.run(DETECTOR, GUN, 60, seed=5, settings=settings, workers=cg.Workers(threads=threads, chunk=chunk))
        for chunk, threads in ((60, 1), (7, 2))
    )
    assert len(whole.decays) > 10
    assert whole == pieces


def everything(detector, clusters, wire_hits):
    """Take all hits of an event as one track."""
    return cg.label_candidates(clusters, wire_hits, np.zeros(len(clusters), int), np.zeros(len(wire_hits), int))


def test_the_truth_finder_ends_at_the_decay():
    """Candidates hold the particle's own hits; they are pure and complete, and say that it decayed."""
    result = cg.run(DETECTOR, Gun("K+", p=0.4, cos_theta=(-0.5, 0.5)), 200, seed=3)
    hits = result.candidate_hits
    on_wire = hits["view"] == 2
    wires = result.wire_hits["wire_truth"][hits["hit"][on_wire]]
    crossings = result.clusters["truth"][hits["hit"][~on_wire]]
    assert not result.wire_truths["daughter"][wires].any()
    assert not result.truths["daughter"][crossings].any()
    gone = result.particles["status"] == TransportStatus.decayed
    assert 30 < np.count_nonzero(gone) < 80
    matched = result.tracks["particle"] >= 0
    assert np.all(gone[~matched])
    np.testing.assert_array_equal(result.tracks["decayed"], np.where(matched, gone, -1))
    assert np.all(result.tracks["purity"][matched] == 1)
    assert np.mean(result.tracks["efficiency"][matched]) > 0.99
    assert result.transport()["decayed"] == np.count_nonzero(gone)
    assert "decayed" in repr(result)


def test_a_candidate_across_the_kink_belongs_to_the_particle():
    """Hits of daughters count for whose track it is, not as hits of the particle itself."""
    result = cg.run(DETECTOR, Gun("K+", p=0.4, cos_theta=(-0.5, 0.5)), 200, seed=3, finder=everything)
    tracks, gone = result.tracks, result.tracks["decayed"] == 1
    left = np.bincount(result.wire_truths["event"], minlength=200) + np.bincount(result.truths["event"], minlength=200)
    assert np.all(tracks["particle"][left > 0] == 0)
    late = np.bincount(result.wire_truths["event"], result.wire_truths["daughter"] > 0, minlength=200)
    mixed = gone & (late > 5)
    assert np.count_nonzero(mixed) > 15
    assert np.all(tracks["purity"][mixed] < 1)
    assert np.all(tracks["purity"][~gone] == 1)
    assert np.all(tracks["efficiency"][tracks["purity"] > 0] == 1)
    assert np.all(tracks["efficiency"][tracks["purity"] == 0] == 0)


def test_studies_say_how_many_decayed():
    scan = cg.study.scan(DETECTOR, [0.3], particle="K-", cos_theta=(-0.5, 0.5), events=300, seed=4)
    gone = scan.samples[0].transport["decayed"]
    assert gone > np.count_nonzero(scan.samples[0].tracks["decayed"] == 1) > 50
    _, head, row, note = repr(scan).splitlines()
    assert f" {gone} " in row
    assert "decayed" in head
    assert note.startswith("at 0.3 GeV/c: over 5 % of the tracks are not fitted")


@pytest.mark.slow
def test_pictures_of_decays(tmp_path):
    """The event display draws events with kinks."""
    result = cg.run(DETECTOR, Gun("K+", p=0.3, cos_theta=0.0), 30, seed=6)
    event = int(result.decays["event"][0])
    cg.draw.event(result, event).save(tmp_path / "kink")
    assert list(tmp_path.iterdir())


def test_fractions_add_up():
    """Both charges of three particles; fractions are those of one whole, charges are conserved."""
    assert set(DECAYS) == {13, -13, 211, -211, 321, -321}
    for pdg, modes in DECAYS.items():
        assert sum(mode.fraction for mode in modes) == pytest.approx(1, abs=1e-12)
        for mode in modes:
            assert sum(one.charge for one in mode.products) == KNOWN[pdg].charge
            assert len(mode.charged) >= 1


@pytest.mark.parametrize(
    ("modes", "message"),
    [
        ((DecayMode(1.0, "phase_space", (KNOWN[321], KNOWN[14])),), "heavier than the particle"),
        ((DecayMode(0.5, "phase_space", (KNOWN[-13], KNOWN[14])),), "fractions with the sum 1"),
        ((DecayMode(1.0, "michel", (KNOWN[-11], KNOWN[12])),), "got 2 products"),
    ],
)
def test_impossible_decays_are_refused(modes, message):
    with pytest.raises(ValueError, match=message):
        decay_table({211: modes}, {211: 26.0})


def test_what_does_not_decay():
    """Protons, electrons, and what is too short-lived to be tracked, fly straight on."""
    guns = Gun("p", p=0.5, cos_theta=0.0) + Gun("e-", p=0.5, cos_theta=0.0) + Gun("Sigma-", p=0.5, cos_theta=0.0)
    out = simulate(DETECTOR, generate(guns, 20, seed=1), None, 1)
    assert len(out["decays"]) == 0
    assert _core.common.Purpose.decay == 11


DESIGN_LANES = load("besiii-cgem-design")
LANES = [name for name in isa.available() if name != "scalar"]
TABLES = ("truths", "steps", "wire_truths", "decays")
# A draw at the edge of a decision may fall to the other side by rounding; the rows that follow are then others.
FLIPS = 1e-5
# The fastest numbers in lanes are rounded otherwise: positions of 1 m to 1e-8 mm, delta electrons after some hundred
# scatters to 1e-6 of their pieces.
TOLERANCE = {"truths": 1e-9, "wire_truths": 1e-9, "steps": 1e-5, "decays": 1e-9}


def simulated_lanes(
    name: str, table: Table, settings: SimulateSettings | None = None, seed: int = 1, detector: Detector = DESIGN_LANES
):
    """Simulate with the kernels of one instruction set."""
    before = isa.name()
    isa.use(name)
    try:
        return simulate(detector, table, settings, seed)
    finally:
        isa.use(before)


def differing_events(one: Table, other: Table, n: int, relative: float) -> set[int]:
    """Return events whose rows differ by more than rounding, or are not the same in number."""
    rows = [np.bincount(table["event"], minlength=n) for table in (one, other)]
    differ = set(np.flatnonzero(rows[0] != rows[1]).tolist())
    same = [rows[0][table["event"]] == rows[1][table["event"]] for table in (one, other)]
    event = one["event"][same[0]]
    for column in one:
        if column == "truth":  # a row number, which moves with the rows before
            continue
        a, b = one[column][same[0]], other[column][same[1]]
        unlike = np.abs(a - b) > relative * (1 + np.abs(a)) if a.dtype.kind == "f" else a != b
        differ |= set(event[unlike].tolist())
    return differ


def mixture(n: int) -> Table:
    """Return muons, pions, protons and electrons from 50 MeV/c, some displaced and on their way in, some neutral."""
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(n, 3))
    momentum = direction / np.linalg.norm(direction, axis=1)[:, None] * 10 ** rng.uniform(-1.3, 0.3, n)[:, None]
    position = rng.normal(size=(n, 3)) * np.where(rng.random(n) < 0.3, 60.0, 1e-3)[:, None]
    return particles(position, momentum, rng.choice([13, -13, 211, -211, 2212, 11, 22], n, p=[0.4] + [0.1] * 6))


@pytest.mark.skipif(not LANES, reason="no kernels for lanes on this machine")
@pytest.mark.parametrize("name", LANES)
@pytest.mark.parametrize(
    ("gun", "settings"),
    [
        (Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93)), SimulateSettings()),
        (Gun("pi+", p=(0.05, 0.3), cos_theta=(-0.93, 0.93)), SimulateSettings(steps=True)),
        (Gun("mu+", p=0.2, cos_theta=(-0.5, 0.5)), SimulateSettings(fluctuations="gaussian")),
        (Gun("mu-", p=0.12, cos_theta=(-0.9, 0.9)), SimulateSettings(fluctuations="off")),
        (Gun("pi-", p=(0.1, 0.5), cos_theta=(-0.8, 0.8)), SimulateSettings(foil="lattice")),
    ],
    ids=["default", "slow and every cluster", "gaussian", "off", "foils with holes"],
)
def test_same_rows_as_scalar(name, gun, settings):
    """Every row is the scalar one but for rounding, and no more decisions flip than one row in 10^5."""
    n = 1000
    table = generate(gun, n, seed=3)
    scalar, lanes = (simulated_lanes(kernels, table, settings) for kernels in ("scalar", name))
    np.testing.assert_array_equal(scalar["particles"]["status"], lanes["particles"]["status"])
    for kind in TABLES:
        differ = differing_events(scalar[kind], lanes[kind], n, TOLERANCE[kind])
        assert len(differ) <= np.ceil(FLIPS * len(scalar[kind])), f"{kind}: events {sorted(differ)[:9]}"


@pytest.mark.skipif(not LANES, reason="no kernels for lanes on this machine")
@pytest.mark.parametrize("name", LANES)
def test_mixture_of_particles_comes_in_its_order(name):
    """Particles that lanes leave to scalar code stand where they stood, with their statuses."""
    n = 1500
    scalar, lanes = (simulated_lanes(kernels, mixture(n)) for kernels in ("scalar", name))
    np.testing.assert_array_equal(scalar["particles"]["status"], lanes["particles"]["status"])
    assert len(np.unique(scalar["particles"]["status"])) == 6
    for kind in TABLES:
        assert len(differing_events(scalar[kind], lanes[kind], n, TOLERANCE[kind])) <= 1
        assert np.all(np.diff(lanes[kind]["event"]) >= 0)


@pytest.fixture(scope="module")
def fields(tmp_path_factory):
    """The design in fields of every kind; tracks leave the maps before the outermost wires."""
    folder = tmp_path_factory.mktemp("fields")
    x, z = np.linspace(-450, 450, 19), np.linspace(-1300, 1300, 53)
    values = harmonic_by_hand(x[:, None, None], x[None, :, None], z[None, None, :])
    box = {"x": x, "y": x, "z": z} | {f"b{axis}": values[..., i] for i, axis in enumerate("xyz")}
    return {
        "uniform": DESIGN_LANES,
        "harmonic": DESIGN_LANES.with_field(HARMONIC),
        "cylinder": DESIGN_LANES.with_field(small_map(folder)),
        "box": DESIGN_LANES.with_field(write_field_map(folder / "box.npz", box)),
    }


@pytest.mark.skipif(not LANES, reason="no kernels for lanes on this machine")
@pytest.mark.parametrize("name", LANES)
@pytest.mark.parametrize("field", ["harmonic", "cylinder", "box"])
def test_same_rows_as_scalar_in_a_field_map(name, field, fields):
    """Steps through the field round otherwise, too; particles of all kinds, on their way in or out, leave the map."""
    n = 800
    scalar, lanes = (simulated_lanes(kernels, mixture(n), detector=fields[field]) for kernels in ("scalar", name))
    np.testing.assert_array_equal(scalar["particles"]["status"], lanes["particles"]["status"])
    leave = (lanes["particles"]["status"] == TransportStatus.left_field).sum()
    assert leave == 0 if field == "harmonic" else leave > n / 3
    for kind in TABLES:
        assert len(scalar[kind]["event"]) > (10 if kind == "decays" else n)
        assert len(differing_events(scalar[kind], lanes[kind], n, TOLERANCE[kind])) <= 1


@pytest.mark.skipif(not LANES, reason="no kernels for lanes on this machine")
@pytest.mark.parametrize("name", LANES)
@pytest.mark.parametrize("field", ["uniform", "harmonic", "cylinder"])
def test_companions_change_nothing(name, field, fields):
    """Alone, or with other neighbours, a particle is the same to the last bit."""
    table = mixture(200)
    detector, cuts = fields[field], pairwise([0, 1, 18, 75, 200])
    everything = simulated_lanes(name, table, detector=detector)
    parts = [simulated_lanes(name, table.select_events(*cut), detector=detector) for cut in cuts]
    for kind in TABLES:
        for column in everything[kind]:
            if column != "truth":
                joined = np.concatenate([part[kind][column] for part in parts])
                np.testing.assert_array_equal(everything[kind][column], joined, err_msg=f"{kind}.{column}")


@pytest.mark.skipif(not LANES, reason="no kernels for lanes on this machine")
def test_other_draws_are_seen():
    """The comparison fails for another seed, and for a momentum larger by a millionth."""
    table = generate(Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), 300, seed=3)
    one, other = (simulated_lanes("scalar", table, seed=seed) for seed in (1, 2))
    assert len(differing_events(one["wire_truths"], other["wire_truths"], 300, 1e-9)) > 290
    shifted = simulated_lanes("scalar", table.with_columns(px=table["px"] * (1 + 1e-6)))
    assert len(differing_events(one["truths"], shifted["truths"], 300, 1e-9)) > 290


@pytest.mark.parametrize(("particle", "decays"), [("mu-", False), ("mu-", True), ("p+", True)])
def test_slopes_whose_squares_are_infinite(particle: str, decays: bool) -> None:
    """Such a particle flies along the beam line: its flight time would be infinite, as the time of a decay is."""
    how = cg.Settings(simulate=SimulateSettings(half_turns=2, decays=decays))
    for name in isa.available():
        before = isa.name()
        isa.use(name)
        try:
            found = cg.run("besiii-cgem-design", cg.Gun(particle, p=1.0, theta=1e-155), n=3, settings=how)
        finally:
            isa.use(before)
        assert found.particles["status"].tolist() == 3 * [int(TransportStatus.end)]
        assert len(found.truths) == len(found.wire_truths) == 0


def thin_barrel(density: str, thickness: str, efficiency: float = 1.0) -> Detector:
    """Return six layers of hardly any matter around a beam pipe."""
    layer = {"length": "3 m", "sigma": "30 um", "thickness": thickness, "material": "Thin", "efficiency": efficiency}
    return load(
        {
            "name": "thin",
            "field": {"kind": "uniform", "bz": "1.3 T"},
            "beam_pipe": {"pipe": {"r_in": "25 mm", "r_out": "27 mm", "half_length": "2 m", "material": "Be"}},
            "layer": {f"L{r}": layer | {"radius": f"{r} mm"} for r in (40, 80, 160, 320, 480, 640)},
            "materials": {"Thin": {"density": density, "composition": "N2", "gas": True}},
        }
    )


@pytest.mark.parametrize(
    ("density", "thickness", "pdg", "p", "idle"),
    [("1e-6 g/cm3", "1 um", 13, 1.0, 0.3), ("1e-6 g/cm3", "1 mm", 2212, 0.9, 0.1), ("1e-4 g/cm3", "1 um", 11, 1.0, 0)],
)
def test_a_crossing_is_a_hit_whatever_it_deposits(density, thickness, pdg, p, idle, kernels):
    """Sensors in which many particles deposit nothing have one crossing of each particle, in later half turns, too."""
    detector, n = thin_barrel(density, thickness), 300
    columns = particles(np.zeros((n, 3)), np.tile([p, 0.0, 0.3 * p], (n, 1)), pdg)
    found = simulate(detector, columns)["truths"]
    np.testing.assert_array_equal(np.bincount(found["layer"]), np.full(6, n))
    assert (found["energy"] == 0).mean() >= idle
    slow = particles(np.zeros((20, 3)), np.tile([0.05, 0.0, 0.01], (20, 1)), 13)
    loops = simulate(detector, slow, SimulateSettings(half_turns=4, decays=False))["truths"]
    # The pipe takes so much energy that the third and fourth half turns reach a layer less.
    assert np.bincount(loops["half_turn"]).tolist() == [60, 60, 40, 40]


def test_the_efficiency_alone_decides_about_the_hit():
    """In sensors without deposits the share of crossings that are measured is the layer's efficiency, as expected."""
    n = 2000
    for efficiency in (1.0, 0.8):
        detector = thin_barrel("1e-6 g/cm3", "1 um", efficiency)
        result = run.run(detector, Gun("mu-", p=1.0, cos_theta=0.3), n=n, seed=3, workers=1, until="digitize")
        found = np.bincount(result.digis["layer"]) / (2 * n)
        np.testing.assert_allclose(found, efficiency, rtol=0, atol=4 * math.sqrt(efficiency * (1 - efficiency) / n))
    expected = cg.analytic(detector, "mu-", p=1.0, cos_theta=0.3, threads=1)
    assert float(expected.n_clusters) == pytest.approx(2 * 6 * efficiency, rel=0.1)
