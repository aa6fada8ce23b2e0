"""The gun draws what it is told to, whatever the chunks, and lists every mistake."""

import math
import pickle

import numpy as np
import pandas as pd
import pytest

from cgemit import run
from cgemit.particles.gun import Gun, Guns, generate, usual_momentum
from cgemit.particles.records import ParticleError
from cgemit.particles.samples import sample
from cgemit.particles.species import species
from cgemit.particles.table import particles_from
from stats import assert_within

PLAIN = Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
MIXED = PLAIN + Gun(
    "K+", pt=[0.2, 0.5], theta="60 deg", vertex=(0, (1, 2), [1, 2, 3]), vertex_sigma=(0.1, 0, 0), multiplicity=2
)


def momentum(particles):
    """Return p, pT, cos(theta) and phi of each particle."""
    pt = np.hypot(particles["px"], particles["py"])
    p = np.hypot(pt, particles["pz"])
    return p, pt, particles["pz"] / p, np.arctan2(particles["py"], particles["px"])


@pytest.mark.parametrize(
    ("spelling", "name", "pdg", "charge"),
    [
        ("e-", "e-", 11, -1), ("positron", "e+", -11, 1), ("mu", "mu-", 13, -1), ("muon", "mu-", 13, -1),
        ("anti_muon", "mu+", -13, 1), ("pi+", "pi+", 211, 1), ("PI-", "pi-", -211, -1), ("K_minus", "K-", -321, -1),
        ("k+", "K+", 321, 1), ("p", "p", 2212, 1), ("p+", "p", 2212, 1), ("proton", "p", 2212, 1),
        ("pbar", "anti-p", -2212, -1), ("p-", "anti-p", -2212, -1), ("anti_proton", "anti-p", -2212, -1),
        ("p~", "anti-p", -2212, -1), ("13", "mu-", 13, -1), ("-211", "pi-", -211, -1), (-11, "e+", -11, 1),
        (np.int32(321), "K+", 321, 1),
    ],
)  # fmt: skip
def test_spellings(spelling, name, pdg, charge):
    """Names in their common spellings and numbers, also as text, mean the same particle."""
    found = species(spelling)
    assert (found.name, found.pdg, found.charge) == (name, pdg, charge)


@pytest.mark.parametrize(
    ("pdg", "mass_mev"),
    [(11, 0.51099895069), (13, 105.6583755), (211, 139.57039), (321, 493.677), (2212, 938.27208943)],
)
def test_masses(pdg, mass_mev):
    """Masses are those of the PDG's 2025 tables, the same for the antiparticle."""
    assert species(pdg).mass == pytest.approx(mass_mev / 1000, rel=1e-12)
    assert species(-pdg).mass == species(pdg).mass
    assert species(-pdg).charge == -species(pdg).charge


@pytest.mark.parametrize(("given", "hint"), [("pi", "pi+ or pi-"), ("mun-", '"mu-"'), ("protn", '"proton"')])
def test_unknown_particle_is_told_what_is_close(given, hint):
    """A misspelt or ambiguous name says what could have been meant."""
    with pytest.raises(ValueError, match=repr(given)) as error:
        species(given)
    assert hint in str(error.value)


def test_ranges_are_uniform():
    """Mean and variance of p, cos(theta) and phi are those of uniform distributions, uncorrelated."""
    n = 20_000
    gun = Gun("pi+", p=(0.5, 1.5), cos_theta=(-0.8, 0.4), phi=(0, 1))
    p, _, cos, phi = momentum(generate(gun, n, seed=3))
    unit = np.column_stack([p - 0.5, (cos + 0.8) / 1.2, phi])
    assert unit.min() > 0
    assert unit.max() < 1
    assert_within(unit.mean(axis=0), 0.5, math.sqrt(1 / 12 / n), what="mean")
    assert_within(unit.var(axis=0), 1 / 12, math.sqrt(1 / 180 / n), what="variance")
    correlation = np.corrcoef(unit.T)[np.triu_indices(3, 1)]
    assert_within(correlation, 0.0, 1 / math.sqrt(n), what="correlation")


def test_ranges_of_pseudorapidity_are_uniform_in_it():
    n = 20_000
    _, pt, cos, _ = momentum(generate(Gun("pi+", pt=0.5, eta=(-1.0, 2.0)), n, seed=3))
    unit = (np.arctanh(cos) + 1) / 3
    np.testing.assert_allclose(pt, 0.5, rtol=1e-12)
    assert (unit.min() > 0) & (unit.max() < 1)
    assert_within(unit.mean(), 0.5, math.sqrt(1 / 12 / n), what="mean")
    assert_within(unit.var(), 1 / 12, math.sqrt(1 / 180 / n), what="variance")
    one = generate(Gun("pi+", p=1.0, eta=1.2), 5, seed=1)
    np.testing.assert_allclose(np.log(np.tan(np.arccos(one["pz"]) / 2)), -1.2, rtol=1e-12)
    assert usual_momentum(Gun("pi+", pt=0.5, eta=1.2)) == pytest.approx(0.5 * math.cosh(1.2))
    for wrong in ({"eta": 1.0, "cos_theta": 0.0}, {}):
        with pytest.raises(ParticleError, match="theta, cos_theta, eta: got"):
            Gun("pi+", p=1.0, **wrong)


def test_theta_range_is_uniform_in_theta():
    """A range of theta is uniform in theta, which is not uniform in cos(theta): the gate sees the difference."""
    n = 20_000
    _, _, cos, _ = momentum(generate(Gun("e-", p=1, theta=(0.5, 1.5)), n, seed=4))
    expected, error = (math.sin(1.5) - math.sin(0.5)) / 1.0, cos.std() / math.sqrt(n)
    assert_within(cos.mean(), expected, error)
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(cos.mean(), (math.cos(1.5) + math.cos(0.5)) / 2, error)


def test_fixed_values_and_pt():
    """Fixed numbers are met exactly; with pt the transverse momentum is the given one."""
    p, pt, cos, phi = momentum(generate(Gun("e+", pt=0.3, cos_theta=0.6, phi="90 deg"), 5, seed=1))
    np.testing.assert_allclose(pt, 0.3, rtol=1e-14)
    np.testing.assert_allclose(p, 0.3 / 0.8, rtol=1e-14)
    np.testing.assert_allclose(cos, 0.6, rtol=1e-14)
    np.testing.assert_allclose(phi, math.pi / 2, rtol=1e-14)


def test_vertex_spread():
    """The vertex is Gaussian about its position with the given width, along the given axes only."""
    n = 20_000
    table = generate(Gun("p", p=1, theta=1, vertex=(1, 2, 3), vertex_sigma=(0.5, 0, 10)), n, seed=5)
    assert np.all(table["y"] == 2)
    for axis, mean, sigma in (("x", 1, 0.5), ("z", 3, 10)):
        assert_within(table[axis].mean(), mean, sigma / math.sqrt(n), what=axis)
        assert_within(table[axis].std(), sigma, sigma / math.sqrt(2 * n), what=axis)


@pytest.mark.parametrize("spread", ["event", "particle"])
def test_particles_of_an_event_share_its_beam_spot(spread):
    """Of one gun and of several; the option gives each particle a spread of its own."""
    n, how = 4000, {"theta": 1, "vertex_sigma": (0.3, 0.1, 5), "vertex_spread": spread}
    for gun in (Gun("mu-", p=1, multiplicity=2, **how), Gun("mu-", p=1, **how) + Gun("pi+", pt=(0.2, 1), **how)):
        table = generate(gun, n, seed=3)
        for axis, sigma in zip("xyz", (0.3, 0.1, 5), strict=True):
            first, second = table[axis].reshape(-1, 2).T
            assert_within(second.std(), sigma, sigma / math.sqrt(2 * n), what=axis)
            if spread == "event":
                np.testing.assert_array_equal(first, second)
            else:
                assert_within(np.corrcoef(first, second)[0, 1], 0, 1 / math.sqrt(n), what=axis)
    wide = Gun("mu-", p=1, **how) + Gun("mu-", p=1, theta=1, vertex=(1, 0, 0), vertex_sigma=(0.6, 0, 0))
    x = generate(wide, n, seed=3)["x"].reshape(-1, 2)
    np.testing.assert_allclose(x[:, 1], 1 + 2 * generate(Gun("mu-", p=1, **how), n, seed=3)["x"], rtol=1e-12)


def test_the_spread_of_a_single_particle_is_its_own():
    """Draws of events with one particle do not depend on the option; those of the option are pinned."""
    how = {"p": 1, "theta": 1, "vertex_sigma": (0.5, 0, (5, 10))}
    alone = generate(Gun("mu-", **how), 50, seed=5)
    assert alone.columns.keys() == generate(Gun("mu-", vertex_spread="particle", **how), 50, seed=5).columns.keys()
    for name in alone:
        np.testing.assert_array_equal(
            alone[name], generate(Gun("mu-", vertex_spread="particle", **how), 50, seed=5)[name]
        )
    shared = generate(Gun("mu-", multiplicity=2, **how), 50, seed=5)
    for axis in "xyz":
        np.testing.assert_array_equal(shared[axis], np.repeat(alone[axis], 2))
    with pytest.raises(ParticleError, match="vertex_spread"):
        Gun("mu-", p=1, theta=1, vertex_spread="gun")


def test_values_in_turn_follow_the_event_number():
    """A list is used event by event, counted by event number and not by row."""
    table = generate(MIXED, 7, seed=1, first_event=10)
    kaons = table[table["pdg"] == 321]
    _, pt, _, _ = momentum(kaons)
    np.testing.assert_allclose(pt, np.array([0.2, 0.5])[kaons["event"] % 2])
    np.testing.assert_array_equal(kaons["z"], np.array([1.0, 2.0, 3.0])[kaons["event"] % 3])


def test_particles_do_not_depend_on_chunks_or_company():
    """Any chunk of events, and a gun alone, give the very same particles."""
    whole = generate(MIXED, 100, seed=7)
    assert np.array_equal(whole["particle"][:3], [0, 1, 2])
    for first, stop in ((0, 1), (37, 80), (99, 100)):
        assert generate(MIXED, stop - first, seed=7, first_event=first) == whole.select_events(first, stop)
    assert generate(PLAIN, 100, seed=7) == whole[whole["particle"] == 0]
    assert generate(PLAIN, 100, seed=8) != generate(PLAIN, 100, seed=7)


def test_particles_of_one_event_differ():
    """Equal particles of one event are drawn independently."""
    table = generate(Gun("mu-", p=1, theta=1, multiplicity=2), 2000, seed=2)
    phi = np.arctan2(table["py"], table["px"]).reshape(-1, 2)
    assert_within(np.corrcoef(phi.T)[0, 1], 0.0, 1 / math.sqrt(2000))


def test_guns_compare_pickle_and_repeat_from_their_repr():
    """Equal guns are equal and hash alike; what they print makes them again; a range is not two values in turn."""
    assert Gun("mu-", p="1000 MeV/c", cos_theta=(-0.93, 0.93)) == PLAIN
    assert hash(Gun("muon", p=1, cos_theta=(-0.93, 0.93))) == hash(PLAIN)
    assert Gun("mu-", p=(1, 2), theta=1) != Gun("mu-", p=[1, 2], theta=1)
    assert repr(PLAIN) == "Gun('mu-', p=1.0, cos_theta=(-0.93, 0.93))"
    assert pickle.loads(pickle.dumps(MIXED)) == MIXED
    assert eval(repr(MIXED)) == MIXED
    assert isinstance(MIXED + PLAIN, Guns)
    assert len((MIXED + PLAIN).guns) == 3
    assert len((PLAIN + MIXED).guns) == 3


def test_all_mistakes_of_a_gun_at_once():
    """Every mistake is listed with its place, what was given and what was expected."""
    with pytest.raises(ParticleError) as error:
        Gun("mun-", p=-1, pt=(2, 1), cos_theta="1.2", phi="3 mm", vertex=(1, 2), vertex_sigma=(-1, 0, []),
            multiplicity=0)  # fmt: skip
    places = [problem.path for problem in error.value.problems]
    assert places == ["particle", "p, pt", "p", "pt", "cos_theta", "phi", "vertex", "vertex_sigma.x",
                      "vertex_sigma.z", "multiplicity"]  # fmt: skip
    assert all(problem.given and problem.expected for problem in error.value.problems)
    assert pickle.loads(pickle.dumps(error.value)).problems == error.value.problems


@pytest.mark.parametrize(
    "arguments",
    [
        {"p": 0.0, "theta": 1}, {"p": math.nan, "theta": 1}, {"p": math.inf, "theta": 1}, {"p": True, "theta": 1},
        {"p": 1}, {"theta": 1}, {"p": 1, "theta": 1, "cos_theta": 0}, {"p": 1, "theta": 4}, {"pt": 1, "cos_theta": 1},
        {"p": (1, 2, 3), "theta": 1}, {"p": [[1, 2]], "theta": 1}, {"p": 1, "theta": 1, "phi": None},
    ],
)  # fmt: skip
def test_each_mistake_is_one(arguments):
    """No wrong value passes, and none is reported twice."""
    with pytest.raises(ParticleError) as error:
        Gun("mu-", **arguments)
    assert len(error.value.problems) == 1


@pytest.mark.parametrize("arguments", [(-1, 1), (1.5, 1), (1, -1), (1, 2**64), (1, 1, -1)])
def test_generate_checks_its_arguments(arguments):
    """Counts and seeds out of range are refused."""
    with pytest.raises(ParticleError, match="expected a whole number"):
        generate(PLAIN, *arguments)


@pytest.mark.parametrize(
    "form",
    [
        lambda table: table,
        lambda table: dict(table.columns),
        lambda table: table.to_pandas().sample(frac=1, random_state=1).sort_values("particle"),
        lambda table: table.to_pandas().to_records(index=False),
        lambda table: {name: table[name] for name in ("event", "pdg", "px", "py", "pz", "x", "y", "z")},
        lambda table: table.to_pandas().astype(float),
    ],
)
def test_particles_from_anywhere(form):
    """Mappings, data frames in any order, structured arrays and float columns make the same table."""
    table = generate(MIXED, 20, seed=1)
    assert particles_from(form(table)) == table


def test_particles_from_needs_little():
    """Vertex, numbers, charge and mass are filled in; events without particles may surround the given ones."""
    table = particles_from({"event": [7, 5, 7], "pdg": [13, -2212, 22], "px": [1, 2, 3], "py": [0, 0, 0],
                            "pz": [0, 1, 0]})  # fmt: skip
    assert (table.first_event, table.n_events) == (5, 3)
    assert table["particle"].tolist() == [0, 0, 1]
    assert table["px"].tolist() == [2, 1, 3]
    assert table["charge"].tolist() == [-1, -1, 0]
    assert table["mass"][1] == species("mu-").mass
    assert particles_from(table, first_event=0, n_events=10).n_events == 10
    other = {"event": [0], "pdg": [1000010020], "px": [1], "py": [0], "pz": [0], "charge": [1], "mass": [1.8756]}
    assert particles_from(other)["mass"][0] == 1.8756


def test_a_generator_may_list_what_leaves_no_hits():
    """Neutrinos, K_S, hyperons and light nuclei are known by their numbers, unknown neutral ones by their charge."""
    pdg = [12, 111, 310, 3122, 3222, 1000010020, 9000221]
    rows = {"event": range(7), "pdg": pdg, "px": [1] * 7, "py": [0] * 7, "pz": [0] * 7}
    table = particles_from(rows | {"charge": [0, 0, 0, 0, 1, 1, 0]})
    assert table["charge"].tolist() == [0, 0, 0, 0, 1, 1, 0]
    assert table["mass"][[2, 3, 4]] == pytest.approx([0.497611, 1.115683, 1.18937], rel=1e-6)
    assert run("besiii-idc", table).transport() == {"outside": 2, "neutral": 5}
    assert particles_from(rows)["charge"].tolist() == table["charge"].tolist()
    with pytest.raises(
        ParticleError, match=r"pdg: is unknown and does not tell the charge: give charges=.pdg: charge."
    ):
        particles_from(rows | {"pdg": [*pdg[:6], 4900022]})


@pytest.mark.parametrize(
    ("pdg", "spin", "lifetime_ns"),
    [
        (13, 0.5, 2196.98),
        (211, 0, 26.033),
        (321, 0, 12.379),
        (310, 0, 0.08954),
        (-3122, 0.5, 0.2617),
        (2212, 0.5, np.inf),
    ],
)
def test_lifetimes_and_spins(pdg, spin, lifetime_ns):
    """As in the PDG's 2025 tables."""
    found = species(pdg)
    assert found.spin == spin
    assert found.lifetime == pytest.approx(lifetime_ns, rel=1e-4)


def test_all_mistakes_of_a_table_at_once():
    """Missing columns are listed, then every column with a wrong value, with the row."""
    with pytest.raises(ParticleError) as error:
        particles_from(pd.DataFrame({"event": [0], "pgd": [13], "px": [1], "name": ["mu"]}))
    text = str(error.value)
    assert all(f"\n  {name}: " in text for name in ("pdg", "py", "pz", "name"))
    assert 'did you mean "pgd"' in text
    wrong = {"event": [1, 0.5, -1, 1], "particle": [0, 0, 0, 0], "pdg": [13, 13, 999, 13], "px": [0, 1, np.nan, 1],
             "py": [0, 0, 0, 0], "pz": [0, 0, 1, 1], "charge": [-1, 1, 1, -1]}  # fmt: skip
    with pytest.raises(ParticleError) as error:
        particles_from(wrong)
    for text in ("event: is not a whole number (0.5) in row 1", "event: is negative (-1.0) in row 2",
                 "px: is not finite (nan) in row 2", "pdg: is unknown, and there is no column mass (999) in row 2",
                 "charge: is not that of the pdg number (1) in row 1",
                 "particle: is there before in the same event (0) in row 3"):  # fmt: skip
        assert any(str(problem).startswith(text.split(" (")[0]) and text.split(") ")[1] in str(problem)
                   for problem in error.value.problems), text  # fmt: skip
    assert len(error.value.problems) == 6


def test_charged_particles_have_a_mass():
    """A charged particle without mass has no Lorentz factor."""
    rows = {"event": [0, 1], "pdg": [999, 998], "px": [1, 1], "py": [0, 0], "pz": [0, 0]}
    with pytest.raises(ParticleError, match=r"mass: is 0 for a charged particle .0. in row 0$"):
        particles_from(rows | {"charge": [1, 0], "mass": [0, 0]})
    with pytest.raises(ParticleError, match=r"charge: is beyond \+-127 .128. in row 1"):
        particles_from(rows | {"charge": [1, 128], "mass": [1, 1]})


@pytest.mark.parametrize(
    ("gun", "expected"),
    [
        (Gun("mu-", p=2.0, theta=1), 2.0),
        (Gun("mu-", p=(0.5, 2.0), theta=1), 1.0),
        (Gun("mu-", p=[0.1, 1.0, 10.0], theta=1), 1.0),
        (Gun("mu-", pt=1.0, cos_theta=(0.2, 0.8)), 1 / np.sqrt(0.75)),
        (Gun("mu-", p=1.0, theta=1) + Gun("pi-", p=4.0, theta=1), 2.0),
        (sample("cosmic"), None),
        (None, None),
    ],
)
def test_the_usual_momentum_is_a_geometric_mean(gun, expected):
    assert usual_momentum(gun) == (expected if expected is None else pytest.approx(expected))
