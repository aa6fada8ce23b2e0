"""Decays in flight: rates, branching fractions and spectra, against formulas of their own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chisquare, kstest

from cgemit.detector import load
from cgemit.particles.gun import Gun, generate
from cgemit.particles.species import DECAYS, KNOWN, decay_table
from cgemit.simulation.transport import SimulateSettings, TransportStatus, simulate
from cgemit.tables import Table
from stats import assert_within, fraction_error, mean_error
from tracks import transport, without_matter

# GeV and ns, typed in from the Particle Data Group's tables of 2024.
MASS = {"mu": 0.1056583755, "pi": 0.13957039, "K": 0.493677, "pi0": 0.1349768, "e": 0.00051099895}
LIFETIME = {"mu": 2196.98, "pi": 26.033, "K": 12.38}
C = 299.792458  # mm/ns
WITHIN = 600.0  # mm, a radius that all particles below reach
N = 20_000
WEAK = "1e-3 T"  # tracks are straight lines to 1e-6


def shot(particle: str, p: float, n: int = N) -> Table:
    """Return particles from the origin, across the beam."""
    return generate(Gun(particle, p=p, cos_theta=0.0), n, seed=3)


@cache
def vacuum(bz: str):
    """Return the design without matter, with the last wire layer alone: each crossing takes time, and tells nothing."""
    detector = load("besiii-cgem-design").with_overrides({"field.bz": bz})
    chamber = detector.drift_chamber
    return without_matter(replace(detector, drift_chamber=replace(chamber, layers=chamber.layers[-1:])))


def decays_in_vacuum(particle: str, p: float, bz: str = WEAK, longer: float = 1.0, n: int = N, modes=DECAYS):
    """Return the decays of particles that lose no energy, and the table of decays; `longer`: factor of lifetimes."""
    lifetimes = {pdg: longer * KNOWN[pdg].lifetime for pdg in modes}
    return transport(vacuum(bz), shot(particle, p, n), seed=4, decays=decay_table(modes, lifetimes))["decays"]


def assert_rate(particle: str, p: float, bz: str, longer: float = 1.0) -> None:
    """Fail unless as many particles decay within a radius as exp(-m L / (p c tau)) says, L along the circle."""
    decays = decays_in_vacuum(particle, p, bz, longer)
    first = decays["parent"] == 0
    _, which = np.unique(decays["event"][first], return_index=True)
    inside = np.count_nonzero(np.hypot(decays["x"], decays["y"])[first][which] < WITHIN)
    radius = 3335.641 * p / abs(float(bz.split()[0]))
    path = 2 * radius * np.arcsin(WITHIN / (2 * radius))
    kind = particle.rstrip("+-")
    expected = -np.expm1(-MASS[kind] * path / (p * C * LIFETIME[kind]))
    assert_within(inside / N, expected, fraction_error(expected, N), n_sigma=3, what=f"{particle} of {p} GeV/c")


@pytest.mark.parametrize("bz", [WEAK, "-1 T"])
@pytest.mark.parametrize("p", [0.1, *(pytest.param(p, marks=pytest.mark.slow) for p in (0.2, 0.5)), 1.0])
@pytest.mark.parametrize("particle", ["pi+", "pi-", "K+", "K-", "mu-"])
def test_rate(particle: str, p: float, bz: str) -> None:
    """Without energy loss the survivors fall exponentially with the path; particles that turn back are left out."""
    if p < 0.12 and bz != WEAK:
        p = 0.12  # reaches 720 mm
    assert_rate(particle, p, bz)


def test_wrong_lifetime_fails() -> None:
    """Lifetimes that are 10 % longer are found out."""
    with pytest.raises(AssertionError, match="standard errors"):
        assert_rate("K+", 0.2, WEAK, longer=1.1)


def test_decay_lengths_are_exponential() -> None:
    """In a weak field, decay point and time lie on the straight line, at exponential distances."""
    decays = decays_in_vacuum("K+", 0.3, longer=0.2)
    first = decays["daughter"] == 1
    r, time = np.hypot(decays["x"], decays["y"])[first], decays["time"][first]
    np.testing.assert_allclose(decays["z"][first], 0, atol=1e-9)
    np.testing.assert_allclose(r, 0.3 / np.hypot(0.3, MASS["K"]) * C * time, rtol=1e-6)
    inside = r[r < WITHIN]
    per_mm = MASS["K"] / (0.3 * C * 0.2 * LIFETIME["K"])
    assert kstest(inside, lambda x: np.expm1(-per_mm * x) / np.expm1(-per_mm * WITHIN)).pvalue > 1e-3
    assert kstest(inside, lambda x: np.expm1(-1.2 * per_mm * x) / np.expm1(-1.2 * per_mm * WITHIN)).pvalue < 1e-3


def test_decay_points_lie_on_the_circle() -> None:
    """In 1 T the decay points are at the distance of the radius from the centre of the circle."""
    decays, table = decays_in_vacuum("pi-", 0.15, "-1 T"), shot("pi-", 0.15)
    row = decays["event"][decays["parent"] == 0]
    radius = 3335.640951 * 0.15
    # Negative particles in a field along -z bend to the left of ... either side: one centre fits all.
    normal = np.stack([-table["py"], table["px"]])[:, row] / 0.15
    point = np.stack([decays[axis][decays["parent"] == 0] for axis in "xy"])
    distances = [np.linalg.norm(point - side * radius * normal, axis=0) for side in (1, -1)]
    best = min(distances, key=lambda d: np.abs(d - radius).max())
    np.testing.assert_allclose(best, radius, rtol=1e-6)


def test_lost_energy_shortens_lives() -> None:
    """Slow kaons between the first and the last gap: the momentum there decides, not that at the vertex."""
    table, n = shot("K+", 0.2, 4 * N), 4 * N
    quiet = SimulateSettings(fluctuations="off", decays=False)
    detector = load("besiii-cgem-design").with_overrides({"remove": ["drift_chamber"]})
    gaps = simulate(detector, shot("K+", 0.2, 1), quiet, 1)["truths"]
    p = np.sqrt(sum(gaps[f"p{axis}"] ** 2 for axis in "xyz"))
    gamma = np.hypot(p, MASS["K"]) / MASS["K"]
    # Momenta before each gap's gas; those in between change in thin walls, half and half.
    proper = np.sum(np.diff(gaps["time"]) * 0.5 * (1 / gamma[1:] + 1 / gamma[:-1]))
    out = simulate(detector, table, SimulateSettings(fluctuations="off"), 5)
    r_first, r_last = gaps["r"][0], gaps["r"][-1]
    decays = out["decays"][out["decays"]["daughter"] == 1]
    r = np.hypot(decays["x"], decays["y"])
    alive = n - np.count_nonzero(r < r_first)
    share = np.count_nonzero((r >= r_first) & (r < r_last)) / alive
    expected = -np.expm1(-proper / LIFETIME["K"])
    assert_within(share, expected, fraction_error(expected, alive), n_sigma=3, what="decays between the gaps")
    bg = 0.2 / MASS["K"]
    wrong = -np.expm1(-(r_last - r_first) / (bg * C * LIFETIME["K"]))
    assert abs(share - wrong) > 3 * fraction_error(wrong, alive)


@cache
def at_rest(particle: str, p: float = 0.3, n: int = N, mode: int | None = None):
    """Return decays and the daughters' energies (n,) and momenta (3, n) in the rest frame of the parent.

    Lifetimes are so short that most particles decay; with `mode` all decay in this way.
    """
    modes = DECAYS if mode is None else {321: (replace(DECAYS[321][mode], fraction=1.0),)}  # of the K+
    short = 0.1 * LIFETIME["K"] / LIFETIME[particle[:-1]]
    every = decays_in_vacuum(particle, p, longer=short, n=n, modes=modes)
    decays = {name: column[every["parent"] == 0] for name, column in every.items()}
    mass = MASS[particle.rstrip("+-")]
    own = np.array([KNOWN[int(pdg)].mass for pdg in decays["pdg"]])
    momentum = np.stack([decays[f"p{axis}"] for axis in "xyz"])
    parent = np.stack([decays[f"parent_p{axis}"] for axis in "xyz"])
    energy = np.sqrt(own**2 + (momentum**2).sum(axis=0))
    parent_energy = np.sqrt(mass**2 + (parent**2).sum(axis=0))
    np.testing.assert_allclose(np.linalg.norm(parent, axis=0), p, rtol=1e-9)
    along = (momentum * parent).sum(axis=0)
    rest_energy = (energy * parent_energy - along) / mass
    rest = momentum + parent / mass * (along / (parent_energy + mass) - energy)
    return decays, rest_energy, rest


def test_branching_fractions() -> None:
    """Kaon modes come as often as the Particle Data Group says, and not otherwise."""
    decays, _, _ = at_rest("K+", n=3 * N)
    counts = np.bincount(decays["mode"][decays["daughter"] == 1], minlength=6)
    percent = np.array([63.56, 20.67, 5.583, 5.07, 3.352, 1.760])
    assert chisquare(counts, percent / percent.sum() * counts.sum()).pvalue > 1e-3
    swapped = percent[[0, 1, 3, 2, 4, 5]]
    assert chisquare(counts, swapped / swapped.sum() * counts.sum()).pvalue < 1e-3
    pions, _, _ = at_rest("pi+", n=5 * N)
    assert_within(np.mean(pions["mode"] == 1), 1.23e-4, fraction_error(1.23e-4, len(pions["mode"])))


@pytest.mark.parametrize(
    ("particle", "mode", "daughter", "missing", "momentum"),
    [("pi+", 0, "mu", 0, 29.79), ("K-", 0, "mu", 0, 235.5), ("K-", 1, "pi", MASS["pi0"], 205.1)],
)
def test_two_bodies(particle: str, mode: int, daughter: str, missing: float, momentum: float) -> None:
    """One momentum in the rest frame, in all directions, and what is missing has the mass of the neutral product."""
    decays, energy, rest = at_rest(particle)
    mine = decays["mode"] == mode
    p = np.linalg.norm(rest, axis=0)[mine]
    np.testing.assert_allclose(1e3 * p, momentum, atol=0.06)
    assert np.ptp(p) < 1e-9
    sign = 1 if particle.endswith("+") else -1
    assert set(decays["pdg"][mine]) == {sign * {"mu": -13, "pi": 211}[daughter]}
    left = (MASS[particle[:-1]] - energy[mine]) ** 2 - p**2
    np.testing.assert_allclose(left, missing**2, atol=1e-9)
    parent = np.stack([decays[f"parent_p{axis}"] for axis in "xyz"])[:, mine]
    cosine = (rest[:, mine] * parent).sum(axis=0) / p / np.linalg.norm(parent, axis=0)
    assert kstest(cosine, "uniform", (-1, 2)).pvalue > 1e-3


def test_largest_kink() -> None:
    """Pions of 1 GeV/c turn by at most 39.4 mrad: sin = p* m_pi / (m_mu p), and many come close to it."""
    decays = decays_in_vacuum("pi+", 1.0, n=200_000)
    first = (decays["parent"] == 0) & (decays["mode"] == 0)
    one, other = (np.stack([decays[f"{which}p{axis}"][first] for axis in "xyz"]) for which in ("", "parent_"))
    kink = np.arctan2(np.linalg.norm(np.cross(one, other, axis=0), axis=0), (one * other).sum(axis=0))
    largest = np.arcsin(0.029792 * MASS["pi"] / (MASS["mu"] * 1.0))
    assert largest == pytest.approx(0.0394, abs=1e-4)
    assert 0.99 * largest < kink.max() < largest * (1 + 1e-4)


def test_three_charged_pions() -> None:
    """Their four-momenta add up to the kaon's; by symmetry each has a third of the kinetic energy in the mean."""
    decays, energy, rest = at_rest("K+", n=3 * N)
    mine = decays["mode"] == 2
    assert decays["pdg"][mine][:3].tolist() == [211, 211, -211]
    assert decays["daughter"][mine][:3].tolist() == [1, 2, 3]
    np.testing.assert_allclose(energy[mine].reshape(-1, 3).sum(axis=1), MASS["K"], rtol=1e-9)
    np.testing.assert_allclose(rest[:, mine].reshape(3, -1, 3).sum(axis=2), 0, atol=1e-9)
    kinetic = energy[mine].reshape(-1, 3) - MASS["pi"]
    for one in kinetic.T:
        assert_within(one.mean(), (MASS["K"] - 3 * MASS["pi"]) / 3, mean_error(one))


def test_pion_with_two_neutral_pions() -> None:
    """The largest energy of the charged pion is that opposite two neutral ones at rest to each other."""
    decays, energy, _ = at_rest("K+", n=3 * N)
    mine = energy[decays["mode"] == 5]
    largest = (MASS["K"] ** 2 + MASS["pi"] ** 2 - 4 * MASS["pi0"] ** 2) / (2 * MASS["K"])
    assert 0.98 * largest < mine.max() < largest + 1e-9


@pytest.mark.parametrize(("mode", "lepton"), [(3, "e"), (4, "mu")])
def test_semileptonic(mode: int, lepton: str) -> None:
    """The mean energy of the lepton is the integral of the V-A density over the Dalitz plot; that of space is not.

    The density is the contraction of both currents, 2 (H l)(H nu) - H^2 (l nu), with H the momenta of K and pi added.
    """
    _, found, _ = at_rest("K+", n=3 * N, mode=mode)
    assert len(found) > 2.5 * N
    m, mpi, ml = MASS["K"], MASS["pi0"], MASS[lepton]
    # Cells of the energies of pion and lepton, of which the neutrino's energy and angles must exist.
    e_pi = np.linspace(mpi, (m * m + mpi * mpi - ml * ml) / (2 * m), 1201)[:, None]
    e_l = np.linspace(ml, (m * m + ml * ml - mpi * mpi) / (2 * m), 1201)[None, :]
    e_nu = m - e_pi - e_l
    p_pi, p_l = np.sqrt(e_pi**2 - mpi**2), np.sqrt(e_l**2 - ml**2)
    allowed = (np.abs(p_pi - p_l) <= e_nu) & (e_nu <= p_pi + p_l)
    l_nu = (m * m + mpi * mpi - ml * ml) / 2 - m * e_pi  # products of four-vectors, from the masses of pairs
    pi_l = (m * m - mpi * mpi - ml * ml) / 2 - m * e_nu
    pi_nu = (m * m + ml * ml - mpi * mpi) / 2 - m * e_l
    h_l, h_nu, h_h = m * e_l + pi_l, m * e_nu + pi_nu, m * m + mpi * mpi + 2 * m * e_pi
    density = allowed * (2 * h_l * h_nu - h_h * l_nu)
    assert_within(found.mean(), (density * e_l).sum() / density.sum(), mean_error(found))
    flat = (allowed * e_l).sum() / allowed.sum()
    assert abs(found.mean() - flat) > 6 * mean_error(found)


def test_michel_spectrum() -> None:
    """Electrons have 7/10 of their largest energy in the mean, and the distribution is that of x^2 (3 - 2 x)."""
    _, energy, rest = at_rest("mu-")
    largest = (MASS["mu"] ** 2 + MASS["e"] ** 2) / (2 * MASS["mu"])
    assert largest == pytest.approx(0.05283, abs=1e-5)
    x = energy / largest
    assert len(x) > 0.5 * N
    assert_within(x.mean(), 0.7, mean_error(x))
    assert kstest(x, lambda x: 2 * x**3 - x**4).pvalue > 1e-3
    assert kstest(x, lambda x: x**3).pvalue < 1e-3
    assert abs(rest.mean()) < 4 * rest.std() / np.sqrt(rest.size)


def test_daughters_decay() -> None:
    """Pions of kaon decays decay, too, and later than the kaon."""
    out = simulate(load("besiii-cgem-design"), shot("K+", 0.2, 8000), None, 6)
    decays = out["decays"]
    later = np.flatnonzero(decays["parent"] > 0)
    assert len(later) > 100
    before = later - (decays["daughter"][later] - decays["parent"][later])
    np.testing.assert_array_equal(decays["event"][before], decays["event"][later])
    np.testing.assert_array_equal(decays["daughter"][before], decays["parent"][later])
    assert np.all(decays["time"][later] > decays["time"][before])
    assert np.all(decays["status"][before] == TransportStatus.decayed)
    at = [np.hypot(*(decays[f"parent_p{axis}"][later] for axis in "xy")), np.abs(decays["pdg"][before])]
    assert np.all(at[0] > 0)
    assert set(at[1]) <= {13, 211}
