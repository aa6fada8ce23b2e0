"""Samples have the kinematics of their decays, whatever the chunks, and list every mistake."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest

import cgemit as cg
from cgemit.chain.record import gun_data, gun_from
from cgemit.cli.main import main
from cgemit.detector.matter import slabs
from cgemit.particles.decay_chains import (
    ATTEMPTS,
    DEFINITIONS,
    MODE,
    NAMES,
    RESONANCES,
    SHAPE,
    Draws,
    Mode,
    Particles,
    boost,
    breakup_momentum,
    decay_all,
    largest_weight,
    phase_space,
)
from cgemit.particles.gun import generate
from cgemit.particles.records import ParticleError
from cgemit.particles.species import species
from stats import assert_within, fraction_error, mean_error

N = 4000


def uniforms(rows: int, n: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(rows, 3 * n - 4))


def mass(momenta: np.ndarray) -> np.ndarray:
    return np.sqrt(momenta[..., 3] ** 2 - np.sum(momenta[..., :3] ** 2, axis=-1))


def four_momenta(particles: cg.Table) -> np.ndarray:
    p = np.stack([particles[name] for name in ("px", "py", "pz")], axis=1)
    energy = np.sqrt(np.sum(p * p, axis=1) + particles["mass"] ** 2)
    return np.concatenate([p, energy[:, None]], axis=1)


def event_sums(particles: cg.Table, values: np.ndarray) -> np.ndarray:
    total = np.zeros((particles.n_events, *values.shape[1:]))
    np.add.at(total, particles["event"] - particles.first_event, values)
    return total


def test_two_bodies_have_the_momentum_of_the_closed_form() -> None:
    """E1 = (M^2 + m1^2 - m2^2) / 2M, back to back, isotropic."""
    found, weight = phase_space(1.115683, [0.93827208943, 0.13957039], uniforms(5000, 2))
    first = (1.115683**2 + 0.93827208943**2 - 0.13957039**2) / (2 * 1.115683)
    assert np.allclose(found[:, 0, 3], first, rtol=0, atol=1e-14)
    assert np.allclose(np.sum(found[..., :3], axis=1), 0, atol=1e-15)
    p = math.sqrt(first**2 - 0.93827208943**2)
    assert np.allclose(weight, p)
    assert float(breakup_momentum(1.115683, 0.93827208943, 0.13957039)) == pytest.approx(p, rel=1e-13)
    cos = found[:, 1, 2] / p
    assert_within(np.mean(cos**2), 1 / 3, mean_error(cos**2))


def dalitz(parent: float, masses: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return m12, the mean of m23^2 there, and the share of the area, on a fine grid (PDG, Kinematics)."""
    x = np.linspace((masses[0] + masses[1]) ** 2, (parent - masses[2]) ** 2, 2001)
    m12 = np.sqrt(0.5 * (x[1:] + x[:-1]))
    e2 = (m12**2 - masses[0] ** 2 + masses[1] ** 2) / (2 * m12)
    e3 = (parent**2 - m12**2 - masses[2] ** 2) / (2 * m12)
    p2, p3 = np.sqrt(e2**2 - masses[1] ** 2), np.sqrt(e3**2 - masses[2] ** 2)
    width = 4 * p2 * p3
    return m12, masses[1] ** 2 + masses[2] ** 2 + 2 * e2 * e3, width / width.sum()


def test_decays_are_unweighted_events() -> None:
    """Events of a chain fill the Dalitz plot of the moving parent evenly, and the parent's lifetime is exponential."""
    n = 6000
    flight = np.tile([0.3, -0.4, 1.2], (n, 1))
    momentum = np.concatenate([flight, np.full((n, 1), math.sqrt(1.69 + 1.86484**2))], axis=1)
    parents = Particles(np.arange(n), 1, np.full(n, 1.86484), momentum, np.zeros((n, 3)))
    found = decay_all([("D0", parents)], {"D0": (Mode(1, ("K-", "pi+", "pi0")),)}, Draws(2, 0))
    (kaon,), (pion,), (neutral,) = (found[name] for name in ("K-", "pi+", "pi0"))
    assert np.allclose(kaon.momentum + pion.momentum + neutral.momentum, momentum)
    m12, middle, area = dalitz(1.86484, (0.493677, 0.13957039, 0.1349768))
    s12, s23 = mass(kaon.momentum + pion.momentum) ** 2, mass(pion.momentum + neutral.momentum) ** 2
    for value, expected in ((s12, m12**2), (s23, middle), (s12**2, m12**4)):
        assert_within(value.mean(), np.sum(area * expected), mean_error(value))
    length = np.linalg.norm(pion.vertex, axis=1)
    expected_length = species("D0").lifetime * 299.792458 * 1.3 / 1.86484
    assert_within(length.mean(), expected_length, expected_length / math.sqrt(n))


def test_the_dalitz_plot_is_flat() -> None:
    """Weighted three-body events fill the Dalitz plot in proportion to its area: moments of the invariant masses."""
    parent, masses = 1.86484, (0.493677, 0.13957039, 0.1349768)
    found, weight = phase_space(parent, masses, uniforms(60_000, 3, seed=2))
    s12, s23 = (mass(found[:, i] + found[:, i + 1]) ** 2 for i in (0, 1))
    m12, middle, area = dalitz(parent, masses)
    for power in (1, 2):
        expected = np.sum(area * m12 ** (2 * power))
        error = math.sqrt(np.sum(weight**2 * (s12**power - expected) ** 2)) / weight.sum()
        assert_within(np.sum(weight * s12**power) / weight.sum(), expected, error, what=f"s12^{power}")
    expected = np.sum(area * middle)
    error = math.sqrt(np.sum(weight**2 * (s23 - expected) ** 2)) / weight.sum()
    assert_within(np.sum(weight * s23) / weight.sum(), expected, error, what="s23")
    # Without the weight the plot is not flat.
    assert abs(np.mean(s12) - np.sum(area * m12**2)) > 5 * mean_error(s12)


@pytest.mark.parametrize("n", [3, 4, 5])
def test_groups_have_the_mean_mass_of_symmetric_phase_space(n: int) -> None:
    """Sum of all pairs' masses squared is fixed by energy and momentum, and equal masses share it equally."""
    masses = [0.14] * n
    found, weight = phase_space(1.9, masses, uniforms(40_000, n, seed=n))
    total = 1.9**2 + n * (n - 2) * 0.14**2
    pairs = np.stack([mass(found[:, i] + found[:, j]) ** 2 for j in range(n) for i in range(j)], axis=1)
    assert np.allclose(pairs.sum(axis=1), total)
    share = total / pairs.shape[1]
    error = np.sqrt(np.sum(weight[:, None] ** 2 * (pairs - share) ** 2, axis=0)) / weight.sum()
    assert_within(np.sum(weight[:, None] * pairs, axis=0) / weight.sum(), share, error)
    assert weight.max() <= largest_weight(1.9, tuple(masses))
    assert weight.max() > 0.98 * largest_weight(1.9, tuple(masses))


def test_a_boost_there_and_back_changes_nothing() -> None:
    parent = np.array([0.3, -0.2, 1.5, 2.1])
    one = np.array([0.1, 0.5, -0.3, 0.9])
    back = parent * [-1, -1, -1, 1]
    assert np.allclose(boost(boost(one, parent), back), one, atol=1e-14)
    assert mass(boost(one, parent)) == pytest.approx(mass(one))


@pytest.mark.parametrize(
    ("name", "parent", "charged"), [("jpsi-rhopi", 3.0969, 2), ("pipi-jpsi", 3.6861, 4), ("d0-d0bar", 3.7737, None)]
)
def test_collisions_have_energy_momentum_and_charge_of_the_beams(name: str, parent: float, charged: int | None) -> None:
    particles = generate(cg.sample(name), N, seed=3)
    total = event_sums(particles, four_momenta(particles))
    assert np.allclose(mass(total), parent)
    assert np.allclose(total[:, 0], parent * math.tan(0.011))
    assert np.allclose(total[:, 1:3], 0, atol=1e-12)
    assert not event_sums(particles, particles["charge"].astype(float)).any()
    number = event_sums(particles, (particles["charge"] != 0).astype(float))
    assert set(number) == ({charged} if charged else {2, 4, 6, 8})
    for event in range(3):
        mine = particles["particle"][particles["event"] == event]
        assert list(mine) == list(range(len(mine)))


def test_the_rho_has_its_line_and_its_angle() -> None:
    """The mass has a Breit-Wigner line in s times the momentum of the rho; J/psi -> V P has 1 + cos^2(theta)."""
    n = 3 * N
    rest = np.tile([0, 0, 0, 3.0969], (n, 1))
    parents = Particles(np.arange(n), 1, np.full(n, 3.0969), rest, np.zeros((n, 3)))
    found = decay_all([("J/psi", parents)], {"J/psi": (Mode(1, ("rho0", "pi0"), 1.0),)}, Draws(4, 0))
    (rho,), (pion,) = found["rho0"], found["pi0"]
    assert np.allclose(mass(rho.momentum), rho.mass)
    m = np.linspace(2 * 0.13957039, 3.0969 - 0.1349768, 20_001)
    line = 2 * m / ((m**2 - 0.77526**2) ** 2 + (0.77526 * 0.1491) ** 2) * breakup_momentum(3.0969, m, 0.1349768)
    assert_within(rho.mass.mean(), np.sum(line * m) / line.sum(), mean_error(rho.mass))
    cos2 = pion.momentum[:, 2] ** 2 / np.sum(pion.momentum[:, :3] ** 2, axis=1)
    assert_within(cos2.mean(), 0.4, mean_error(cos2))
    charged = generate(cg.sample("jpsi-rhopi"), n, seed=4)
    assert sorted(np.unique(charged["pdg"])) == [-211, 111, 211]


@pytest.mark.parametrize(
    ("name", "parent", "first", "cos2"),
    [("jpsi-rhopi", "J/psi", "pi", 2 / 5), ("pipi-jpsi", "J/psi", "mu", 2 / 5), ("d0-d0bar", "psi(3770)", "D0", 1 / 5)],
)
def test_angles_of_a_vector_meson(name: str, parent: str, first: str, cos2: float) -> None:
    """From e+ e-: 1 + cos^2(theta) to a vector and a pseudoscalar and to leptons, sin^2(theta) to two pseudoscalars."""
    modes = DEFINITIONS[name].modes[parent]
    total = species(parent).mass if parent not in RESONANCES else RESONANCES[parent][0]
    parents = Particles(np.arange(N), 1, np.full(N, total), np.tile([0, 0, 0, total], (N, 1)), np.zeros((N, 3)))
    found = decay_all([(parent, parents)], {parent: modes}, Draws(6, 0))
    momenta = np.concatenate([one.momentum for key, parts in found.items() if key.startswith(first) for one in parts])
    values = momenta[:, 2] ** 2 / np.sum(momenta[:, :3] ** 2, axis=1)
    assert len(values) in (N, 2 * N)
    assert_within(values.mean(), cos2, mean_error(values) * math.sqrt(len(values) / N))


def test_the_muons_have_the_mass_of_the_jpsi() -> None:
    particles = generate(cg.sample("pipi-jpsi"), 300, seed=5)
    muons = four_momenta(particles)[np.abs(particles["pdg"]) == 13].reshape(-1, 2, 4)
    assert np.allclose(mass(muons.sum(axis=1)), 3.0969)


@pytest.mark.parametrize(("name", "parent"), [("ks-pipi", "K0_S"), ("lambda-ppi", "Lambda")])
def test_decays_are_displaced_by_the_lifetime(name: str, parent: str) -> None:
    """Flight over p/m is exponential with c tau of the particle table, along the momentum of the pair."""
    particles = generate(cg.sample(name, vertex=(1, 2, 3)), N, seed=6)
    pair = four_momenta(particles).reshape(-1, 2, 4).sum(axis=1)
    kind = species(parent)
    assert np.allclose(mass(pair), kind.mass)
    places = np.stack([particles[axis] for axis in "xyz"], axis=1).reshape(-1, 2, 3)
    assert np.array_equal(places[:, 0], places[:, 1])
    flight = places[:, 0] - [1, 2, 3]
    p = np.linalg.norm(pair[:, :3], axis=1)
    length = np.linalg.norm(flight, axis=1)
    assert np.allclose(np.sum(flight * pair[:, :3], axis=1), length * p)
    proper = length * kind.mass / p
    ctau = kind.lifetime * 299.792458
    assert_within(proper.mean(), ctau, ctau / math.sqrt(N))
    assert_within(np.mean(proper > ctau), math.exp(-1), fraction_error(math.exp(-1), N))


def test_cosmic_muons_come_from_above_in_two_halves() -> None:
    """Halves are the same muon flown both ways; y is up, and the zenith angle has the density cos^2."""
    particles = generate(cg.sample("cosmic"), N, seed=7)
    p = four_momenta(particles)[:, :3].reshape(-1, 2, 3)
    assert np.array_equal(p[:, 0], -p[:, 1])
    assert np.all(p[:, 0, 1] > 0)  # the first half is the upper one
    charge = particles["charge"].reshape(-1, 2)
    assert np.all(charge.sum(axis=1) == 0)
    cos = p[:, 0, 1] / np.linalg.norm(p[:, 0], axis=1)
    assert_within(cos.mean(), 0.75, mean_error(cos))
    share = np.mean(charge[:, 1] > 0)
    assert_within(share, 0.561, fraction_error(0.561, N))
    z = particles["z"].reshape(-1, 2)
    assert np.array_equal(z[:, 0], z[:, 1])
    assert_within(z[:, 0].std(), 100, 100 / math.sqrt(2 * N))


def paths(rows: cg.Table, particles: cg.Table, x: np.ndarray, y: np.ndarray, field: float) -> np.ndarray:
    """Return the path from the origin along a helix to points at (x, y) over beta c, ns; negative in the upper half."""
    place = np.searchsorted(particles["event"] * 2 + particles["particle"], rows["event"] * 2 + rows["particle"])
    px, py, pz = (particles[name][place] for name in ("px", "py", "pz"))
    across, p = np.hypot(px, py), np.sqrt(px**2 + py**2 + pz**2)
    radius = across / (0.299792458e-3 * field)  # mm
    path = 2 * radius * np.arcsin(np.hypot(x, y) / (2 * radius)) * p / across
    beta = p / np.hypot(p, particles["mass"][place])
    return np.where(py > 0, -1, 1) * path / (beta * 299.792458)


def test_cosmic_muons_fly_in_through_the_upper_half() -> None:
    """Hits above are before the halves meet, those below after it, by path/(beta c); strips follow."""
    muons = cg.sample("cosmic", p=20.0, vertex_sigma=(0, 0, 0))
    result = cg.run("besiii-cgem", muons, 50, 5, readout="analog-projection", until="digitize")
    crossings, wires = result.truths, result.wire_truths
    for rows, x, y in (
        (wires, wires["x"], wires["y"]),
        (crossings, *(0.5 * (crossings[f"entry_{i}"] + crossings[f"exit_{i}"]) for i in "xy")),
    ):
        by_hand = paths(rows, result.particles, x, y, 1.0)
        assert {-1, 1} == set(np.sign(by_hand))
        np.testing.assert_allclose(rows["time"], by_hand, atol=1e-3)
    # Electrons of both halves drift alike, so that arrival times differ by twice the flight to the layer.
    digis = result.digis[(result.digis["layer"] == 2) & (result.digis["n_truths"] == 1)]
    above = crossings["entry_y"][digis["truth"]] > 0
    up, down = digis["time"][above], digis["time"][~above]
    flown = np.abs(crossings["time"][crossings["layer"] == 2]).mean()
    assert_within(down.mean() - up.mean(), 2 * flown, float(np.hypot(mean_error(up), mean_error(down))))


def test_particles_flown_backward_in_tables_and_with_guns() -> None:
    """The column `backward` is 0 or 1; guns beside a sample have 0."""
    both = generate(cg.sample("cosmic") + cg.Gun("mu-", p=1.0, cos_theta=0.0), 3, seed=1)
    assert both["backward"].tolist() == [1, 0, 0] * 3
    assert "backward" not in generate(cg.Gun("mu-", p=1.0, cos_theta=0.0), 3, seed=1)
    one = {"event": [0, 1], "pdg": [13, 13], "px": [0.5, 0.5], "py": [0.0, 0.0], "pz": [0.1, 0.1], "backward": [0, 1]}
    times = cg.run("besiii-cgem", one, until="simulate").wire_truths
    first = times["event"] == 0
    assert np.all(times["time"][first] > 0)
    assert np.all(times["time"][~first] < 0)
    with pytest.raises(ParticleError, match=r"backward: .*is not 0 or 1"):
        cg.run("besiii-cgem", one | {"backward": [0, 2]}, until="simulate")


@pytest.mark.parametrize("name", ["besiii-cgem", "besiii-idc", "kloe2-like"])
def test_electrons_start_in_matter(name: str) -> None:
    """In the shells of the detector, in proportion to X/X0, length, and radius to the power -1.2; isotropic."""
    n, detector = 500, cg.load(name)
    electrons = generate(cg.sample("electrons"), n, seed=1, detector=detector)
    assert len(electrons) == 20 * n
    r, z = np.hypot(electrons["x"], electrons["y"]), electrons["z"]
    shells = [shell for slab in slabs(detector, merge=False) for shell in slab.shells]
    inside = [
        (shell.r_in - 1e-9 <= r) & (r <= shell.r_out + 1e-9) & (np.abs(z) <= min(shell.ends[1], 400))
        for shell in shells
    ]
    assert np.all(np.any(inside, axis=0))
    middle = np.array([0.5 * (shell.r_in + shell.r_out) for shell in shells])
    weight = np.array([shell.x0 * min(shell.ends[1], 400) for shell in shells]) * middle**-1.2
    wall = detector.walls[0]
    for low, high in ((0, detector.beam_pipe[-1].r_out), (wall.r_in, wall.r_out), (wall.r_out, 1000)):
        share = weight[(low < middle) & (middle < high)].sum() / weight.sum()
        assert_within(np.mean((low <= r) & (r <= high)), share, fraction_error(share, len(r)))
    p = np.linalg.norm(four_momenta(electrons)[:, :3], axis=1)
    assert p.min() >= 0.001
    assert p.max() <= 0.03
    assert_within(p.mean(), 0.0155, mean_error(p))
    turn = np.arctan2(electrons["y"], electrons["x"])
    assert_within(np.mean(np.cos(turn)), 0, mean_error(np.cos(turn)))
    assert len(np.unique(electrons["x"])) == 20 * n

    run = cg.run(detector, cg.sample("electrons"), 3, until="simulate")
    assert np.array_equal(run.particles["x"], electrons["x"][:60])
    saved = gun_from(gun_data(run.gun), [])
    assert repr(saved) == "sample('electrons')"


def test_electrons_need_a_detector() -> None:
    with pytest.raises(ParticleError, match="detector: got none, expected one, since its particles start in matter"):
        generate(cg.sample("electrons"), 1, seed=1)
    with pytest.raises(ParticleError, match="radius: got 30, expected none, this sample has p, cos_theta"):
        cg.sample("electrons", radius=30)


def test_background_particles_start_where_they_should() -> None:
    """Beam-gas tracks from one point, z uniform in 600 mm."""
    n = 200
    gas = generate(cg.sample("beam-gas"), n, seed=1)
    z = gas["z"].reshape(-1, 2)
    assert np.array_equal(z[:, 0], z[:, 1])
    assert_within(z[:, 0].std(), 600 / np.sqrt(12), 0.03 * 600 / np.sqrt(12))
    assert set(gas["pdg"]) == {2212, -211}
    result = cg.run("besiii-cgem", cg.sample("ks-pipi") + cg.sample("electrons") + cg.sample("touschek"), 10)
    assert len(result.particles) == 230


def test_every_place_of_a_chain_has_random_numbers_of_its_own() -> None:
    """Nodes, purposes, attempts and sources never share a stream; guns neither."""
    one, empty = np.array([7]), np.zeros((1, 4))
    found = [
        Draws(3, number).uniforms(Particles(one, node, one, empty, empty[:, :3]), place, 17, attempt)
        for node in range(0, 4000, 7)
        for place, attempt, number in ((MODE, 0, 0), (SHAPE, 0, 0), (SHAPE, ATTEMPTS - 1, 0), (SHAPE, 0, 2))
    ]
    assert len(np.unique(found)) > 0.9999 * np.size(found)  # 32 bits: equal by chance in one of a hundred thousand
    assert 17 / 4 * ATTEMPTS < 4096


@pytest.mark.parametrize("name", NAMES)
def test_events_do_not_depend_on_chunks_or_on_the_guns_before(name: str) -> None:
    one = cg.sample(name)
    detector = cg.load("besiii-cgem")
    whole = generate(one, 60, seed=8, detector=detector)
    part = generate(one, 7, seed=8, first_event=41, detector=detector)
    assert whole.select_events(41, 48) == part
    behind = generate(cg.Gun("mu-", p=1, theta=1) + one + cg.Gun("e-", p=1, theta=1), 20, seed=8, detector=detector)
    assert np.bincount(behind["event"]).min() >= 2
    assert behind["particle"].max() == 1 + one.multiplicity
    assert not np.array_equal(generate(one, 60, seed=9, detector=detector)["px"], whole["px"])


def test_a_pair_of_samples_is_not_the_same_twice() -> None:
    twice = generate(cg.sample("ks-pipi") + cg.sample("ks-pipi"), 50, seed=1)
    px = twice["px"].reshape(-1, 4)
    assert not np.any(px[:, :2] == px[:, 2:])


def test_options_shift_the_events() -> None:
    particles = generate(cg.sample("ks-pipi", p=[0.5, 1.0], cos_theta=0, vertex_sigma=("1 mm", 0, 0)), 6, seed=1)
    pair = four_momenta(particles).reshape(-1, 2, 4).sum(axis=1)
    assert np.allclose(np.linalg.norm(pair[:, :3], axis=1), [0.5, 1.0] * 3)
    assert np.allclose(pair[:, 2], 0, atol=1e-15)


@pytest.mark.parametrize("name", NAMES)
def test_samples_are_shown_copied_and_recorded(name: str) -> None:
    one = cg.sample(name)
    assert repr(one) == f"sample({name!r})"
    assert name in one._repr_html_()
    assert pickle.loads(pickle.dumps(one)) == one
    moved = cg.sample(name, vertex=(0, (1, 2), [3, 4])) + cg.Gun("mu-", p=1, theta=1)
    problems: list[str] = []
    assert gun_from(gun_data(moved), problems) == moved
    assert not problems
    assert DEFINITIONS[name].text == one.text


def test_mistakes_are_listed_together() -> None:
    with pytest.raises(ParticleError, match='"jpsi-rhopi"'):
        cg.sample("jpsi-rhop")
    with pytest.raises(ParticleError) as error:
        cg.sample("jpsi-rhopi", p=1, cos_theta=0, crossing="1 mm")
    assert len(error.value.problems) == 3
    with pytest.raises(ParticleError, match="mass: got an unknown key"):
        cg.sample("ks-pipi", mass=1)


@pytest.mark.usefixtures("undrawn")
def test_samples_run_through_the_chain(tmp_path, capsys) -> None:
    """From Python and the command line, with the same tables; a saved run is read back equal."""
    result = cg.run("besiii-cgem-design", cg.sample("pipi-jpsi"), 20, seed=2, finder="ckf")
    assert len(result.tracks) > 60
    result.save(tmp_path / "python")
    assert cg.Result.load(tmp_path / "python") == result
    assert "pipi-jpsi" in repr(result)
    command = ["--sample", "pipi-jpsi", "-n", "20", "--seed", "2", "--finder", "ckf", "--quiet"]
    assert main(["simulate", "-d", "besiii-cgem-design", *command, "-o", str(tmp_path / "command")]) == 0
    assert cg.Result.load(tmp_path / "command") == result
    capsys.readouterr()
    assert main(["find", "-d", "besiii-cgem-design", *command]) == 0
    assert "efficiency" in capsys.readouterr().out
    command = ["--sample", "cosmic", "--event", "3", "--quiet", "-o", str(tmp_path / "event")]
    assert main(["display", "-d", "besiii-cgem-design", *command]) == 0
    assert "gun       sample('cosmic')" in capsys.readouterr().out
    assert (tmp_path / "event" / "event.png").is_file()
    assert main(["find", "-d", "besiii-cgem-design", "--sample", "nothing", "-n", "3"]) == 2
    assert "jpsi-rhopi" in capsys.readouterr().err
