"""Simulated particles follow the helix, meet every gap and cell on their way, and end with the right status."""

import math

import numpy as np
import pytest

from cgemit import _core
from cgemit.chain import run
from cgemit.chain.executor import Workers
from cgemit.chain.settings import Settings
from cgemit.detector import compiled, load
from cgemit.particles.gun import Gun, generate
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings, TransportStatus, simulate
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
        "kinks": False, "outlier_pull": 0.0, "prior_sigma": (200.0, 2, 5, 1000, 5),
    }  # fmt: skip
    start = helix + np.array([0.5, 0.004, 0.02 * helix[2], 3, 0.01])
    out = _core.fit(compiled(detector), hit_offsets=np.array([0, len(hits["kind"])]), hits=hits,
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
        np.testing.assert_array_equal(both[name], plain[name])
        np.testing.assert_allclose(mirrored[name], plain[name] * (-1 if name in ("phi", "py") else 1), rtol=1e-12)


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
    settings = Settings(digitize=DigitizeSettings(readout=readout))
    results = [
        run.run(DESIGN, gun, 30, seed=6, settings=settings, workers=Workers(threads=threads, chunk=chunk))
        for threads, chunk in ((1, 1000), (2, 7), (2, 1))
    ]
    assert results[1] == results[0]
    assert results[2] == results[0]
    alone = run.run(DESIGN, results[0].particles.select_events(17, 18), seed=6, settings=settings)
    for name in ("dr", "phi0", "kappa", "dz", "tanl", "cov", "chi2"):
        np.testing.assert_array_equal(alone.tracks[name][0], results[0].tracks[name][17])
    other = run.run(DESIGN, gun, 30, seed=7, settings=settings)
    assert not np.any(other.tracks["dr"] == results[0].tracks["dr"])


@pytest.mark.parametrize("radius", [40.0, 60.0, 100.0])
def test_particles_that_start_inward_come_out_again(radius: float) -> None:
    """A 1 GeV/c muon from a displaced vertex never curls, whichever cylinders it grazes on its way in and out."""
    gun = Gun("mu-", p=1.0, theta=1.3, vertex=(radius, 0.0, 0.0), phi=(0.5 * np.pi, 1.5 * np.pi))
    found = simulate(DESIGN, generate(gun, 1000, seed=2), SimulateSettings(), seed=2)["particles"]
    assert np.all(found["status"] == TransportStatus.outside)
