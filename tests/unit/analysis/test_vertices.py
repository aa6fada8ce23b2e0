"""True values of vertices: by hand, for particles of every number, and none where a track has no particle."""

from __future__ import annotations

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.vertices import with_truth

MUON = 0.1056583755  # GeV/c2, PDG 2024


@pytest.fixture(scope="module")
def run() -> cg.Result:
    """Two events of muons 0 and 1 that leave one point at right angles."""
    gun = {"p": 1.0, "cos_theta": 0.0, "vertex": (1.0, -2.0, 3.0)}
    return cg.run("besiii-cgem-design", cg.Gun("mu+", phi=0.0, **gun) + cg.Gun("mu-", phi="90 deg", **gun), n=2, seed=1)


def test_truth_by_hand(run: cg.Result) -> None:
    """The mass of two particles of energy E and momenta at right angles is sqrt(4 E^2 - 2 p^2)."""
    vertices = cg.fit_vertices(run.detector, run.fitted, particles=("mu", "mu"))
    assert vertices["status"].tolist() == [0, 0]
    found = with_truth(vertices, run.fitted, run.matches, run.particles)
    mass = np.sqrt(4 * (1 + MUON**2) - 2)
    for name, true in {"x": 1.0, "y": -2.0, "z": 3.0, "mass": mass}.items():
        np.testing.assert_allclose(found[f"truth_{name}"], true, rtol=1e-9)
        np.testing.assert_allclose(found[f"res_{name}"], vertices[name] - true, rtol=1e-9)
        np.testing.assert_allclose(found[f"pull_{name}"], found[f"res_{name}"] / vertices[f"err_{name}"], rtol=1e-9)


def test_no_truth_without_a_particle(run: cg.Result) -> None:
    """Particle -1 of the second event has not the number of the last one of the first event."""
    vertices = cg.fit_vertices(run.detector, run.fitted, particles=("mu", "mu"))
    particle = run.matches["particle"].copy()
    assert particle.tolist() == [0, 1, 0, 1]
    particle[2] = -1
    found = with_truth(vertices, run.fitted, run.matches.with_columns(particle=particle), run.particles)
    assert np.isfinite(found["truth_x"]).tolist() == [True, False]


@pytest.fixture(scope="module")
def electrons() -> tuple[cg.Result, cg.Table]:
    pair = cg.Gun("e+", p=(0.5, 1.6), cos_theta=(-0.7, 0.7)) + cg.Gun("e-", p=(0.5, 1.6), cos_theta=(-0.7, 0.7))
    run = cg.run("besiii-cgem", pair, n=1500, seed=3, settings=cg.Settings(fit=cg.FitSettings(components=True)))
    return run, cg.fit_vertices(run.detector, run.fitted, particles=("e", "e"))


def test_masses_of_electron_pairs_have_their_probabilities(electrons: tuple[cg.Result, cg.Table]) -> None:
    """The true mass is anywhere in its density; without the components, three in ten are outside of the 95 % limits."""
    run, vertices = electrons
    truth = with_truth(vertices, run.fitted, run.matches, run.particles)["truth_mass"]
    densities = cg.study.pair_masses(vertices, run.fitted, run.tables["components"])
    normal = cg.study.pair_masses(vertices, run.fitted)
    good = np.isfinite(truth) & np.isfinite(densities.mass) & (truth > 0.3)
    assert good.sum() > 1400

    def distance(masses: cg.study.PairMasses) -> float:
        below = np.sort(masses.below(truth)[good])
        return float(np.abs(below - (np.arange(len(below)) + 0.5) / len(below)).max())

    def inside(masses: cg.study.PairMasses, end: str) -> float:
        low, high = getattr(masses, f"low{end}"), getattr(masses, f"high{end}")
        return float(np.mean(((low < truth) & (truth < high))[good]))

    assert distance(densities) < 0.036  # 95 % of samples of 1450
    assert distance(normal) > 0.2
    assert abs(inside(densities, "") - 0.68) < 0.03
    assert abs(inside(densities, "95") - 0.95) < 0.015
    assert inside(normal, "95") < 0.75


def test_masses_are_those_of_momenta_drawn_from_the_components(electrons: tuple[cg.Result, cg.Table]) -> None:
    run, vertices = electrons
    vertices = vertices[vertices["mass"] > 1.0][:3]
    components = run.tables["components"]
    masses = cg.study.pair_masses(vertices, run.fitted, components)
    random = np.random.default_rng(5)
    for row, pair in enumerate(vertices.to_pandas().itertuples()):
        of_angles, log = (pair.err_mass / pair.mass) ** 2, np.zeros(400_000)
        for track in (pair.first, pair.second):
            own = components[components["track"] == track]
            which = random.choice(len(own), len(log), p=own["weight"] / own["weight"].sum())
            log += 0.5 * random.normal(own["change"][which], own["spread"][which])  # electrons have no mass to speak of
            of_angles -= (0.5 * run.fitted["err_p"][track] / run.fitted["p"][track]) ** 2
        drawn = pair.mass * np.exp(log + random.normal(0, np.sqrt(max(of_angles, 0)), len(log)))
        for name, share in (("low95", 0.025), ("low", 0.16), ("high", 0.84), ("high95", 0.975)):
            around = np.quantile(drawn, [share - 0.002, share + 0.002])  # eight standard errors of the share
            assert around[0] - 0.02 * pair.err_mass < getattr(masses, name)[row] < around[1] + 0.02 * pair.err_mass
        assert masses.below(np.median(drawn))[row] == pytest.approx(0.5, abs=0.02)


def test_masses_without_electrons_are_normal(run: cg.Result) -> None:
    vertices = cg.fit_vertices(run.detector, run.fitted, particles=("mu", "mu"))
    masses = cg.study.pair_masses(vertices, run.fitted)
    relative = vertices["err_mass"] / vertices["mass"]
    np.testing.assert_allclose(masses.low, vertices["mass"] * np.exp(-0.9944579 * relative), rtol=1e-6)
    np.testing.assert_allclose(masses.high95, vertices["mass"] * np.exp(1.959964 * relative), rtol=1e-6)
    np.testing.assert_allclose(masses.mass, vertices["mass"], rtol=1e-3)
    assert (masses.radiated == 0).all()
    assert np.isfinite(masses.below(1.0)).all()


def test_pairs_without_a_mass_have_no_density(run: cg.Result) -> None:
    vertices = cg.fit_vertices(run.detector, run.fitted, particles=("mu", "mu"))
    vertices = vertices.with_columns(status=np.array([0, 3], np.int8))
    masses = cg.study.pair_masses(vertices, run.fitted)
    assert np.isfinite(masses.mass).tolist() == np.isfinite(masses.below(1.4)).tolist() == [True, False]
    assert len(cg.study.pair_masses(vertices[:0], run.fitted).mass) == 0
