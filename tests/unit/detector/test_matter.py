"""Scattering and mean loss by their formulas however matter is cut; holes of foils against brute force."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from cgemit import _core
from cgemit.detector import Detector, DetectorError, compiled, load, slab_table, slabs
from cgemit.detector.core import layer_table, wire_table
from cgemit.detector.matter import hole_table
from cgemit.particles.gun import Gun, generate
from cgemit.simulation.transport import SimulateSettings, simulate
from cgemit.tables import Table
from cores import core_of
from coulomb import core_angle, exact_quantiles, screening_squared, strength
from slabs import (
    ALPHA,
    BERYLLIUM,
    CARBON,
    COPPER,
    ELECTRON,
    KAPTON,
    MUON,
    PION,
    PROTON,
    WATER,
    bethe,
    composition,
    slab_detector,
)
from stats import assert_within, fraction_error, mean_error
from tracks import hits_on

PASSAGES = [
    pytest.param(BERYLLIUM, 1.4, 1.0, MUON, id="1 GeV/c muon, 1.4 mm Be"),
    pytest.param(COPPER, 0.014, 1.0, MUON, id="1 GeV/c muon, 14 um Cu"),
    pytest.param(KAPTON, 0.3, 1.0, MUON, id="1 GeV/c muon, 0.3 mm Kapton"),
    pytest.param(BERYLLIUM, 1.4, 0.15, MUON, id="0.15 GeV/c muon, 1.4 mm Be"),
    pytest.param(KAPTON, 0.3, 0.2, PION, id="0.2 GeV/c pion, 0.3 mm Kapton"),
    pytest.param(COPPER, 0.014, 0.5, PROTON, id="0.5 GeV/c proton, 14 um Cu"),
    pytest.param(BERYLLIUM, 1.4, 30.0, PION, id="30 GeV/c pion, 1.4 mm Be"),
]
each_passage = pytest.mark.parametrize(("matter", "thickness", "p", "mass"), PASSAGES)


def chi_c2(parts):
    """Return (chi_c p beta)^2 of parts (matter, thickness mm), GeV^2."""
    return sum(sum(strength(z)) * moles for matter, thickness in parts for z, _, moles in matter.moles(thickness))


def test_core_angle_by_hand():
    """1.4 mm of beryllium, 0.0287 mol/cm2, turn the core of 1 GeV/c muons by 0.648 mrad, as Lynch and Dahl."""
    # chi_c^2 = 0.157 MeV^2 Z(Z + 1) x 0.0287 mol/cm2 /(beta p)^2 = (0.3018 mrad)^2; chi_a^2, Moliere: 2.007e-5 4^(2/3)
    # (1 + 3.34 (4/137)^2) MeV^2/p^2 = (7.12 urad)^2, twice that for "wentzel"; v = 25 chi_c^2/chi_a^2.
    chi_c = 0.157e-6 * 20 * 0.028708 / 0.98896
    chi_a = 2.007e-11 * 4 ** (2 / 3) * (1 + 3.34 * (4 / 137) ** 2)
    for screening, times, angle in (("moliere", 1.0, 6.72e-4), ("wentzel", 1 + math.exp(-0.016), 6.48e-4)):
        v = 25 * chi_c / (times * chi_a)
        by_hand = math.sqrt(chi_c / (1 + 0.98**2) * ((1 + v) / v * math.log(1 + v) - 1))
        core = slab_detector([(BERYLLIUM, 1.4, 50.0)], screening=screening)
        total = _core.matter.total_matter(core, 0.0)[2]
        assert total == pytest.approx(chi_c * 0.98896, rel=2e-3)
        found = _core.matter.scattering_angle(core, 0, path=1.0, p=1.0, mass=MUON, track_chi_c2=total)
        assert found == pytest.approx(by_hand, rel=1e-3)
        assert found == pytest.approx(angle, rel=2e-3)


@each_passage
@pytest.mark.parametrize("screening", ["wentzel", "moliere"])
def test_core_angle(matter, thickness, p, mass, screening):
    """The angle is that of Lynch and Dahl with the elements' chi_c and chi_a, alone or as a share of a whole track."""
    core = slab_detector([(matter, thickness, 50.0)], screening=screening)
    for times in (1, 40):
        found = _core.matter.scattering_angle(
            core, 0, path=1.0, p=p, mass=mass, track_chi_c2=times * chi_c2([(matter, thickness)])
        )
        expected = core_angle([(matter, thickness)], p, mass, screening, total=[(matter, times * thickness)])
        assert found == pytest.approx(expected, rel=5e-4)
    other = core_angle([(matter, thickness)], p, mass, "wentzel" if screening == "moliere" else "moliere")
    assert abs(other / expected - 1) > 5e-3  # the gate sees the other screening


def test_alpha_angle_by_hand():
    """1.4 mm of beryllium turn the core of alphas of 2 GeV/c by 1.54 mrad: chi_c and chi_a with the charge."""
    # E = 4.2300 GeV, beta^2 = 4/17.893 = 0.22355, p beta = 0.94562 GeV; chi_c^2 = 0.157 MeV^2 z^2 Z(Z + 1) x 0.0287 /
    # (p beta)^2, z = 2; chi_a^2 = 2.007e-5 4^(2/3) (1 + 3.34 (4 x 2/137)^2/0.22355) MeV^2/p^2; v = 25 chi_c^2/chi_a^2.
    chi_c = 0.157e-6 * 4 * 20 * 0.028708 / 0.94562**2
    chi_a = 2.007e-11 * 4 ** (2 / 3) * (1 + 3.34 * (8 / 137) ** 2 / 0.22355) / 2**2
    # Electrons, a fifth of chi_c^2, take at most 2 m_e W_max = 2 x 0.511 MeV x 0.2942 MeV.
    variance = 0.8 * (math.log(25 * chi_c / chi_a) - 1)
    variance += 0.2 * (math.log(min(25 * chi_c, 2 * 0.511e-3 * 0.2942e-3 / 4) / chi_a) - 1)
    by_hand = math.sqrt(chi_c / (1 + 0.98**2) * variance)
    core = slab_detector([(BERYLLIUM, 1.4, 50.0)], screening="moliere")
    total = _core.matter.total_matter(core, 0.0)[2]
    found = {
        charge: _core.matter.scattering_angle(core, 0, path=1.0, p=2.0, mass=ALPHA, charge=charge, track_chi_c2=total)
        for charge in (1, 2, -2)
    }
    assert found[2] == found[-2] == pytest.approx(by_hand, rel=1e-3)
    assert by_hand == pytest.approx(1.54e-3, rel=2e-3)
    # Highland's formula, PDG 2024 eq. 34.16, to its 11 %: x/X0 = 0.14 cm x 1.848 g/cm3/65.19 g/cm2.
    x = 0.14 * 1.848 / 65.19
    highland = 13.6e-3 * 2 / 0.94562 * math.sqrt(x) * (1 + 0.038 * math.log(x * 4 / 0.22355))
    assert found[2] == pytest.approx(highland, rel=0.11)
    assert found[2] > 2.05 * found[1]  # the logarithm grows, too


@pytest.mark.parametrize("charge", [2, 6])
@pytest.mark.parametrize("screening", ["wentzel", "moliere"])
def test_core_angle_of_charges(charge, screening):
    """The angle of nuclei is that of Lynch and Dahl with z^2 in chi_c^2 and (Z z alpha/beta)^2 in chi_a^2."""
    for matter, thickness, p in ((BERYLLIUM, 1.4, 3.0), (COPPER, 0.014, 8.0), (KAPTON, 0.3, 30.0)):
        total = chi_c2([(matter, thickness)])
        core = slab_detector([(matter, thickness, 50.0)], screening=screening)
        found = _core.matter.scattering_angle(core, 0, path=1.0, p=p, mass=ALPHA, charge=charge, track_chi_c2=total)
        assert found == pytest.approx(core_angle([(matter, thickness)], p, ALPHA, screening, charge=charge), rel=1e-3)


@pytest.mark.parametrize("charge", [1, 2])
def test_drawn_angles_of_alphas(charge):
    """Half widths of simulated angles are those of single scatters with the charge, and twice those of unit charge."""
    fractions = np.array([0.6827, 0.98])
    core = slab_detector([(COPPER, 0.1, 50.0)])
    out = _core.simulation.through_slabs(core, p=3.0, mass=ALPHA, charge=charge, n=40_000, seed=1)
    found = np.quantile(np.abs(np.concatenate([out["angle_1"], out["angle_2"]])), fractions)
    exact = [exact_quantiles(COPPER.moles(0.1), 3.0, ALPHA, "wentzel", fractions, charge=z) for z in (1, 2)]
    assert found == pytest.approx(exact[charge - 1], rel=0.015)
    assert np.all(exact[1] > 2.02 * exact[0])


def test_core_angle_of_a_mixture_is_that_of_its_elements():
    """Sheets of several matters, one after the other, add up to the core of the whole."""
    parts = [(BERYLLIUM, 1.4, 30.0), (KAPTON, 0.3, 60.0), (COPPER, 0.03, 90.0)]
    core = slab_detector(parts)
    whole = [part[:2] for part in parts]
    total = _core.matter.total_matter(core, 0.0)[2]
    assert total == pytest.approx(chi_c2(whole), rel=1e-9)
    found = [_core.matter.scattering_angle(core, i, path=1.0, p=0.3, mass=PION, track_chi_c2=total) for i in range(3)]
    assert math.hypot(*found) == pytest.approx(core_angle(whole, 0.3, PION), rel=5e-4)


def test_electrons_turn_slow_protons_less():
    """Where the recoil of electrons ends inside the core, they count up to there: a fifth of beryllium's matter."""
    core, p = slab_detector([(BERYLLIUM, 1.4, 50.0)]), 0.1
    total = _core.matter.total_matter(core, 0.0)[2]
    found = _core.matter.scattering_angle(core, 0, path=1.0, p=p, mass=PROTON, track_chi_c2=total)
    assert found == pytest.approx(core_angle([(BERYLLIUM, 1.4)], p, PROTON), rel=1e-3)
    per_beta2 = 1 + (PROTON / p) ** 2
    v = 25 * total * per_beta2 / screening_squared(4, 1 / per_beta2, "wentzel")
    assert found < 0.97 * math.sqrt(total * per_beta2 / (1 + 0.98**2) * (math.log(v) - 1)) / p


@pytest.mark.parametrize("pieces", [2, 10, 100])
def test_scattering_is_additive(pieces):
    """The variance of a whole is the sum over its pieces; with a logarithm for each piece it would not be."""
    whole, piece = slab_detector([(KAPTON, 5.0, 50.0)]), slab_detector([(KAPTON, 5.0 / pieces, 50.0)])
    total, part = _core.matter.total_matter(whole, 0.0)[2], _core.matter.total_matter(piece, 0.0)[2]

    def angle(core, track):
        return _core.matter.scattering_angle(core, 0, path=1.0, p=0.5, mass=MUON, track_chi_c2=track)

    assert pieces * angle(piece, total) ** 2 == pytest.approx(angle(whole, total) ** 2, rel=1e-12)
    assert pieces * angle(piece, part) ** 2 < 0.95 * angle(whole, total) ** 2


THREE = [(BERYLLIUM, 1.4, 30.0), (KAPTON, 0.3, 60.0), (COPPER, 0.03, 90.0)]


def shared(weights, hits=0.0):
    """Return three slabs for a parameter that is the sum of their angles with these weights.

    `hits`: variance by hits over that by scattering, at 1 GeV/c.
    """
    core, parts = slab_detector(THREE), np.zeros((3, 5))
    parts[:, 4] = np.square(weights) * [chi_c2([part[:2]]) for part in THREE]
    whole = parts[:, 4].sum()
    variances, measured = [1, 1, 1, 1, whole * (1 + hits)], [0, 0, 0, 0, whole * hits]
    return core.with_shared_scattering(parts=parts, variances=variances, hits=measured, p=1.0, mass=MUON)


def angles(core, track=None):
    """Return the angles of three slabs for a muon of 1 GeV/c."""
    track = track or _core.matter.total_matter(core, 0.0)[2]
    return np.array([
        _core.matter.scattering_angle(core, i, path=1.0, p=1.0, mass=MUON, track_chi_c2=track) for i in range(3)
    ])  # fmt: skip


def test_slabs_of_equal_weight_act_together():
    np.testing.assert_allclose(angles(shared([2.0, 2.0, 2.0])), angles(slab_detector(THREE)), rtol=1e-12)


def test_the_matter_that_acts_with_a_slab():
    """It is chi_c^2 of the slab times the variance of the parameter over the slab's part."""
    weights, each = np.array([1.0, 0.3, 0.0]), [chi_c2([part[:2]]) for part in THREE]
    plain, found = slab_detector(THREE), angles(shared(weights))
    matter = weights**2 @ each / weights[0] ** 2
    assert matter < 0.9 * sum(each[:2])
    assert found[0] == pytest.approx(angles(plain, matter)[0], rel=1e-12)
    # The angle of the second slab counts less, that of the third one not at all: with them acts all matter at most.
    assert weights**2 @ each / weights[1] ** 2 > sum(each)
    np.testing.assert_allclose(found[1:], angles(plain)[1:], rtol=1e-12)


def test_a_track_that_misses_other_matter() -> None:
    """What acts is not more than the track crosses, and not less than the slab itself."""
    each, plain, core = [chi_c2([part[:2]]) for part in THREE], slab_detector(THREE), shared([1.0, 0.5, 0.0])
    acting = core.acting
    assert each[0] < acting[0] < sum(each)
    for track in (0.3 * each[0], 1.1 * each[0], 0.99 * sum(each)):
        matter = max(min(acting[0], track), each[0])
        assert angles(core, track)[0] == pytest.approx(angles(plain, matter)[0], rel=1e-12)


def test_the_mean_over_parameters():
    """Each has the slab's part in its variance as weight: what hits alone decide does not count."""
    each = np.array([chi_c2([part[:2]]) for part in THREE])
    parts = np.zeros((3, 5))
    parts[:, 0], parts[:, 3] = each, np.array([1.0, 0.01, 0.0]) * each
    for hits in (0.0, 1.0, 1e9):
        core, variances = slab_detector(THREE), np.array([each.sum(), 1, 1, parts[:, 3].sum() * (1 + hits), 1])
        core = core.with_shared_scattering(parts=parts, variances=variances, hits=np.zeros(5), p=1.0, mass=MUON)
        ratios = parts[0, [0, 3]] / parts[:, [0, 3]].sum(axis=0)
        share = parts[0, [0, 3]] / variances[[0, 3]]
        matter = each[0] * np.exp(-(share @ np.log(ratios)) / share.sum())
        assert angles(core)[0] == pytest.approx(angles(slab_detector(THREE), matter)[0], rel=1e-12)
    assert matter == pytest.approx(each.sum(), rel=1e-6)


def test_hits_let_larger_scatters_count():
    """The matter that acts is larger by the whole variance over that by scattering, which falls as (p beta)^2."""
    core, ratio = shared([1.0, 1.0, 1.0], hits=3.0), 3.0
    each = [chi_c2([part[:2]]) for part in THREE]
    for p in (1.0, 0.3):
        ratio *= p * p * (p * p / (p * p + MUON**2)) / (1 / (1 + MUON**2)) if p < 1 else 1
        found, expected = (
            _core.matter.scattering_angle(one, 0, path=1.0, p=p, mass=MUON, track_chi_c2=matter)
            for one, matter in ((core, sum(each)), (slab_detector(THREE), sum(each) * (1 + ratio)))
        )
        assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("hits", [0.5, 2.0, 6.0])
def test_the_core_with_hits_is_that_of_single_scatters(hits):
    """Angles of single scatters with a Gaussian error have a core within 3 sigmas as expected, to 1 %."""
    n = 100_000
    plain, with_hits = (math.hypot(*angles(shared([1.0, 1.0, 1.0], more))) for more in (0.0, hits))
    error = math.sqrt(hits) * plain
    sums = error * np.random.default_rng(8).normal(size=2 * n)
    for number, part in enumerate(THREE):
        out = _core.simulation.through_slabs(slab_detector([part]), p=1.0, mass=MUON, charge=-1, n=n, seed=number)
        sums += np.concatenate([out["angle_1"], out["angle_2"]])
    found = core_of(sums, 3.0)
    expected = math.hypot(error, with_hits)
    assert_within(found.width, expected, math.hypot(found.error / 1.6, 0.01 / 4 * expected))
    assert found.width > 1.01 * math.hypot(error, plain)  # what scattering alone would have


@pytest.mark.parametrize("weights", [(1.0, 1.0, 1.0), (1.0, 0.3, 0.1), (0.1, 1.0, 0.1), (0.05, 0.2, 1.0)])
def test_the_core_of_a_parameter_is_that_of_single_scatters(weights):
    """Half of the central 68 % of a sum of simulated angles is as expected to 1 %."""
    n, sums = 60_000, 0.0
    for number, (weight, part) in enumerate(zip(weights, THREE, strict=True)):
        out = _core.simulation.through_slabs(slab_detector([part]), p=1.0, mass=MUON, charge=-1, n=n, seed=number)
        sums += weight * np.concatenate([out["angle_1"], out["angle_2"]])
    found = np.quantile(np.abs(sums), 0.6827)
    expected = math.hypot(*(weights * angles(shared(weights))))
    assert_within(found, expected, math.hypot(expected / math.sqrt(2 * n), 0.01 / 4 * expected))
    if min(weights) < 1:  # the gate sees all matter with every slab
        assert found < 0.98 * math.hypot(*(weights * angles(slab_detector(THREE))))


@each_passage
def test_bethe(matter, thickness, p, mass):
    """The mean loss of all collisions is Bethe's with density effect, and has a slope of 1 in the path."""
    core = slab_detector([(matter, thickness, 50.0)])
    expected, xi, w_max = bethe(matter, thickness, p, mass)
    for path in (1.0, 2.5):
        found = _core.matter.restricted_loss(core, 0, path=path, p=p, mass=mass, cut=1e3)
        assert found == pytest.approx(path * expected, rel=1e-3)  # the density effect is read from a table
    cut = 0.05 * w_max
    restricted = _core.matter.restricted_loss(core, 0, path=1.0, p=p, mass=mass, cut=cut)
    assert restricted == pytest.approx(bethe(matter, thickness, p, mass, cut)[0], rel=1e-3)
    beta2 = p * p / (p * p + mass * mass)
    harder = xi * (math.log(w_max / cut) - beta2 * (1 - cut / w_max))  # integral of E times the spectrum
    if mass != PION:
        harder += xi * 0.25 * (w_max**2 - cut**2) / (p * p + mass * mass)
    whole = _core.matter.restricted_loss(core, 0, path=1.0, p=p, mass=mass, cut=w_max)
    assert whole - restricted == pytest.approx(harder, rel=1e-9)


def test_alpha_loss_by_hand():
    """An alpha of 2 GeV/c loses 5.18 MeV in 1.4 mm of beryllium, four times a particle of unit charge."""
    # xi = 4 x 0.1535 MeV x 0.44384 x 1.848 x 0.14 / 0.22355; (beta gamma)^2 = 4/13.8934; W_max = 2 x 0.511 MeV x
    # 0.28791 / (1 + 2 x 1.1349 x 1.371e-4) = 0.2941 MeV; no density effect below x0; spin 0.
    xi = 4 * 0.153537 * 0.44384 * 1.848 * 0.14 / 0.22355
    by_hand = xi * (math.log(2 * 0.510999 * 0.28791 * 0.2941 / 63.7e-6**2) - 2 * 0.22355)
    core = slab_detector([(BERYLLIUM, 1.4, 50.0)])
    found = {z: _core.matter.restricted_loss(core, 0, path=1, p=2, mass=ALPHA, charge=z, cut=1) for z in (1, -2, 2)}
    assert found[2] == found[-2] == pytest.approx(1e-3 * by_hand, rel=2e-3)
    assert found[2] == pytest.approx(4 * found[1], rel=1e-12)
    assert by_hand == pytest.approx(5.18, abs=0.01)


def test_alpha_loss_is_that_of_four_protons():
    """NIST's PSTAR has 7.289 MeV cm2/g for protons of 100 MeV in water: four times as much for alphas as fast."""
    gamma = 1 + 0.1 / PROTON
    core = slab_detector([(WATER, 1.0, 50.0)])
    p = ALPHA * math.sqrt(gamma**2 - 1)
    found = _core.matter.restricted_loss(core, 0, path=10.0, p=p, mass=ALPHA, charge=2, cut=1)  # 1 g/cm2
    assert 1e3 * found == pytest.approx(4 * 7.289, rel=0.01)


def test_loss_moments_of_alphas():
    """Mean and variance of drawn losses are Bethe's and xi W_max (1 - beta^2/2) with z^2, and the fit has the mean."""
    core, n = slab_detector([(CARBON, 0.5, 50.0)], loss="mean"), 20_000
    mean, xi, w_max = bethe(CARBON, 0.5, 3.0, ALPHA)
    beta2 = 9 / (9 + ALPHA**2)
    drawn = _core.simulation.through_slabs(core, p=3.0, mass=ALPHA, charge=2, n=n, seed=3)["loss"]
    assert drawn.mean() == pytest.approx(4 * mean, rel=2e-3)
    assert drawn.var() == pytest.approx(4 * xi * w_max * (1 - 0.5 * beta2), rel=0.05)
    fitted = _core._testing.core_loss(core, 0, path=1.0, p=3.0, mass=ALPHA, charge=2, track_xi=CARBON.xi(0.5))
    assert fitted[0] == pytest.approx(4 * mean, rel=2e-3)
    assert fitted[1] == pytest.approx(drawn.var(), rel=0.05)


@pytest.mark.parametrize("matter", [BERYLLIUM, COPPER, KAPTON])
def test_minimum_ionisation(matter):
    """The smallest loss over all momenta is the PDG's tabulated minimum ionisation, to half a per cent."""
    core = slab_detector([(matter, 1.0, 50.0)])
    losses = [
        _core.matter.restricted_loss(core, 0, path=1.0, p=p, mass=MUON, cut=1e3) for p in np.linspace(0.2, 0.8, 121)
    ]
    assert min(losses) / (0.1 * matter.density) * 1e3 == pytest.approx(matter.minimum, rel=5e-3)


def test_bethe_by_hand():
    """A 1 GeV/c muon loses 0.43 MeV in 1.4 mm of beryllium."""
    # xi = 0.1535 MeV x 0.44384 x 1.848 x 0.14 / 0.98896 = 17.83 keV; beta gamma = 9.4645; W_max = 83.4 MeV
    # ln(2 x 0.511 MeV x 89.58 x 83.4 MeV / (63.7 eV)^2) - 2 x 0.98896 - delta, delta = 2 ln 9.4645 - 2.7847 + 0.317
    by_hand = 0.01783 * (math.log(2 * 0.510999 * 89.577 * 83.4 / 63.7e-6**2) - 2 * 0.98896 - 2.0269)
    core = slab_detector([(BERYLLIUM, 1.4, 50.0)])
    assert _core.matter.restricted_loss(core, 0, path=1.0, p=1.0, mass=MUON, cut=1e3) == pytest.approx(
        1e-3 * by_hand, rel=5e-3
    )
    assert by_hand == pytest.approx(0.43, abs=0.01)


@each_passage
@pytest.mark.parametrize("times", [1, 30])
def test_core_moments(matter, thickness, p, mass, times):
    """Core loss and its variance are moments of the collisions below 2.4 errors, of 0.3 % of p beta and straggling."""
    core = slab_detector([(matter, thickness, 50.0)])
    track_xi = times * matter.xi(thickness)
    beta2 = p * p / (p * p + mass * mass)
    error, whole = 0.003 * p * math.sqrt(beta2), track_xi / beta2
    cut = brentq(lambda w: w - 2.4 * math.sqrt(error**2 + whole * w), 0, 100 * (whole + error), xtol=1e-15, rtol=1e-14)
    expected, xi, w_max = bethe(matter, thickness, p, mass, cut)
    loss, variance, _ = _core._testing.core_loss(core, 0, path=1.0, p=p, mass=mass, track_xi=track_xi)
    assert loss == pytest.approx(expected, rel=1e-3)
    cut = min(cut, w_max)
    # Integral of E^2 xi/E^2 (1 - beta^2 E/W_max).
    energy = np.linspace(0, cut, 2001)
    assert variance == pytest.approx(np.trapezoid(xi * (1 - beta2 * energy / w_max), energy), rel=1e-9)


@each_passage
@pytest.mark.parametrize("times", [1, 30])
def test_core_slope(matter, thickness, p, mass, times):
    """The slope of the core loss is its derivative by momentum, to 1e-3 of loss over momentum."""
    core = slab_detector([(matter, thickness, 50.0)])
    track_xi = times * matter.xi(thickness)

    def loss(momentum):
        return _core._testing.core_loss(core, 0, path=1.0, p=momentum, mass=mass, track_xi=track_xi)

    # Half a bin of the table of the density effect away from its nodes, where the slope jumps.
    nodes = (
        np.exp(
            _core.detector.LOSS_GRID_FIRST
            + _core.detector.LOSS_GRID_STEP * (np.arange(_core.detector.LOSS_POINTS) + 0.5)
        )
        * mass
    )
    at = nodes[np.argmin(np.abs(nodes - p))]
    step = 1e-4 * at
    difference = (loss(at + step)[0] - loss(at - step)[0]) / (2 * step)
    assert loss(at)[2] == pytest.approx(difference, rel=1e-3, abs=1e-3 * loss(at)[0] / at)


@pytest.mark.parametrize("pieces", [2, 10, 100])
def test_core_loss_is_additive(pieces):
    """Loss and variance of a whole are the sums over its pieces."""
    whole = slab_detector([(BERYLLIUM, 2.0, 50.0)])
    piece = slab_detector([(BERYLLIUM, 2.0 / pieces, 50.0)])
    track_xi = _core.matter.total_matter(whole, 0.0)[1]
    full = _core._testing.core_loss(whole, 0, path=1.0, p=0.4, mass=MUON, track_xi=track_xi)
    part = _core._testing.core_loss(piece, 0, path=1.0, p=0.4, mass=MUON, track_xi=track_xi)
    np.testing.assert_allclose(pieces * np.array(part), full, rtol=1e-12)


@pytest.mark.parametrize("pieces", [2, 10, 100])
@pytest.mark.parametrize("pt", [0.2, 1.0])
@pytest.mark.parametrize("where", ["pipe", "chamber gas"])
def test_noise_of_a_track_does_not_depend_on_cuts(where, pieces, pt):
    """The fit's noise seen from the origin is the same if beam pipe or chamber gas is cut into neighbouring slabs."""
    design = load("besiii-cgem-design")
    hits = hits_on(design, [0.1, 0.5, -1 / pt, 2.0, 0.3])
    columns, log_terms, elements = slab_table(slabs(design))
    i = 0 if where == "pipe" else [slab.shells[0].group for slab in slabs(design)].index("gas")

    def noise(n):
        repeat = np.where(np.arange(len(columns["x0"])) == i, n, 1)
        cut = {k: np.repeat(v, repeat) for k, v in columns.items()}
        for name in ("x0", "xi"):
            cut[name][i : i + n] /= n
        cut["spread"][:] = 0  # a thin piece may stay below the limit where shifts are followed
        rows = list(zip(elements["z"], elements["a"], elements["moles"], strict=True))
        parts = [rows[a:b] for a, b in itertools.pairwise(elements["first"])]
        pieces_of_it = [(z, a, moles / n) for z, a, moles in parts[i]]
        core = _core.detector.Detector(
            bz=-1.0, slabs=cut, log_terms=np.repeat(log_terms, repeat, axis=0),
            composition=composition(parts[:i] + [pieces_of_it] * n + parts[i + 1 :]), layers=layer_table(design.cgem),
            wires=wire_table(design.drift_chamber), screening=_core.matter.Screening.wentzel,
        )  # fmt: skip
        vectors = _core._testing.reference(core, np.array([0.1, 0.5, -1 / pt, 2.0, 0.3]), MUON, hits)["noise"]
        return vectors.T @ vectors

    whole, cut = noise(1), noise(pieces)
    scale = np.sqrt(np.outer(np.diag(whole), np.diag(whole)))
    # What is left: the pieces see the momentum on its way down, the whole sees its middle.
    np.testing.assert_allclose(cut / scale, whole / scale, rtol=0, atol=2e-3 if pt < 1 else 3e-4)


def test_total_matter():
    """The matter along a line is that of the slabs it meets within their lengths, over the cosine of its slope."""
    parts = [(BERYLLIUM, 1.0, 30.0), (KAPTON, 0.5, 80.0), (COPPER, 0.1, 120.0)]
    core = slab_detector(parts, half_length=100.0)
    x0 = [0.1 * t * m.density / m.x0 for m, t, _ in parts]
    xi = [m.xi(t) for m, t, _ in parts]
    chi = [chi_c2([part[:2]]) for part in parts]
    for tanl, met in ((0.0, 3), (-0.8, 3), (1.0, 2), (-2.0, 1)):
        expected = [sum(column[:met]) * math.hypot(1, tanl) for column in (x0, xi, chi)]
        np.testing.assert_allclose(_core.matter.total_matter(core, tanl), expected, rtol=1e-12)


@pytest.mark.parametrize(("name", "cuts"), [("besiii-cgem-design", 3), ("idea-like", 7), ("epic-like", 0)])
def test_total_matter_ends_with_the_parts_behind_the_chamber(name, cuts):
    """A line that leaves the chamber gas through its end meets no more gas, and air as far as parts lie outside."""
    detector = load(name)
    found, core = slabs(detector), compiled(detector)
    for tanl in (0.3, 0.99, 1.05, 1.13, 1.16, 1.4, 2.5, 4.0, -6.0):
        x0, left = 0.0, False
        for number, slab in enumerate(found):
            met = abs(tanl) * slab.radius <= slab.row.numbers[1]
            gas = slab.shells[0].group == "gas"
            left |= gas and not met
            x0 += slab.x0 if met and not (gas and left) else 0.0
            parts = [one for one in found[number + 1 :] if one.shells[0].group not in ("air", "gas")]
            if left and not any(abs(tanl) * one.radius <= one.row.numbers[1] for one in parts):
                cuts -= 1
                break
        assert _core.matter.total_matter(core, tanl)[0] == pytest.approx(x0 * math.hypot(1, tanl), rel=1e-12)
    assert cuts == 0


def test_largest_transfer():
    """Cuts above the largest transfer 2 m beta^2 gamma^2/(1 + 2 gamma m/M + (m/M)^2) change nothing, below they do."""
    core = slab_detector([(BERYLLIUM, 1.4, 50.0)])
    gamma = math.hypot(1.0, MUON) / MUON
    ratio = ELECTRON / MUON
    w_max = 2 * ELECTRON * (1 / MUON) ** 2 / (1 + 2 * gamma * ratio + ratio**2)
    losses = [_core.matter.restricted_loss(core, 0, path=1, p=1, mass=MUON, cut=f * w_max) for f in (0.99, 1, 1.01)]
    assert losses[0] < losses[1] == losses[2]


BUILT = load("besiii-cgem")  # 5 um copper, 50 um Kapton, 5 um copper
PITCH, CELL = 0.14, 0.5 * math.sqrt(3) * 0.14**2
COPPER_FOILS, KAPTON_FOILS, SECOND_COPPER = (i for i, slab in enumerate(slabs(BUILT, foil="lattice")) if slab.holes and
                                 slab.holes.foil == 0)  # fmt: skip
#: Solid part of a sub-layer: a cylinder of 70 um, a double cone of 70/50 um, one per cell of the lattice.
COVERAGE = {
    COPPER_FOILS: 1 - math.pi * 0.035**2 / CELL,
    KAPTON_FOILS: 1 - math.pi * (0.035**2 + 0.035 * 0.025 + 0.025**2) / 3 / CELL,
}


def lines(n: int, slope: float, seed: int) -> dict[str, np.ndarray]:
    """Return lines that cross the foil evenly at one slope in random azimuth."""
    i, j, turn = np.random.default_rng(seed).random((3, n))
    steep = {"slope_u": slope * np.cos(2 * np.pi * turn), "slope_v": slope * np.sin(2 * np.pi * turn)}
    return {"u": (i + j / 2) * PITCH, "v": j * PITCH * math.sqrt(3) / 2, **steep}


def fraction(slab: int, given: dict[str, np.ndarray], detector: Detector = BUILT) -> np.ndarray:
    return _core._testing.solid_fraction(compiled(detector, foil="lattice"), slab, **given)


def marched(slab: int, given: dict[str, np.ndarray], steps: int = 4000) -> np.ndarray:
    """Return the solid part of each line by looking at points along it, with every hole of a large piece of foil."""
    holes = slabs(BUILT, foil="lattice")[slab].holes
    reach = range(-40, 41)
    tree = cKDTree([((i + j / 2) * PITCH, j * PITCH * math.sqrt(3) / 2) for i in reach for j in reach])
    w = holes.begin + (np.arange(steps) + 0.5) / steps * (holes.end - holes.begin)
    at = [np.add.outer(given[x], 0 * w) + np.outer(given[f"slope_{x}"], w) for x in "uv"]
    distance, _ = tree.query(np.stack(at, axis=-1))
    radius = 0.035 if slab != KAPTON_FOILS else 0.025 + 0.01 * np.abs(w) / 0.025
    return np.mean(distance > radius, axis=1)


def test_coverage_of_the_standard_foil() -> None:
    assert COVERAGE[COPPER_FOILS] == pytest.approx(0.773, abs=5e-4)
    assert COVERAGE[KAPTON_FOILS] == pytest.approx(0.832, abs=5e-4)


@pytest.mark.parametrize("slab", [COPPER_FOILS, KAPTON_FOILS])
@pytest.mark.parametrize("slope", [0.0, 0.4, 2.5, 30.0, 3000.0])
def test_mean_over_a_foil_is_its_volume_at_any_slope(slab: int, slope: float) -> None:
    found = fraction(slab, lines(40_000, slope, seed=3))
    error = max(mean_error(found), 1e-12)  # the flattest lines all get the mean
    assert_within(found.mean(), COVERAGE[slab], error, what=f"solid part at slope {slope}")


def test_another_hole_is_seen() -> None:
    wide = BUILT.with_overrides({"cgem.L1.hole_outer": "73 um"})
    found = fraction(COPPER_FOILS, lines(40_000, 0.0, seed=3), wide)
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(found.mean(), COVERAGE[COPPER_FOILS], mean_error(found))


@pytest.mark.parametrize("slab", [COPPER_FOILS, KAPTON_FOILS, SECOND_COPPER])
@pytest.mark.parametrize("slope", [0.0, 0.3, 1.5, 6.0, 40.0])
def test_lines_agree_with_marching(slab: int, slope: float) -> None:
    given = lines(60, slope, seed=4)
    borders = 2 + 2 * slope * 0.05 / 0.07  # of holes, that a line crosses at most; each may be off by one step
    assert np.allclose(fraction(slab, given), marched(slab, given), atol=borders / 4000)


def test_marching_sees_a_wrong_cone() -> None:
    straight = BUILT.with_overrides({"cgem.L1.hole_inner": "70 um"})
    given = lines(60, 0.3, seed=4)
    assert not np.allclose(fraction(KAPTON_FOILS, given, straight), marched(KAPTON_FOILS, given), atol=0.01)


def test_a_track_at_normal_incidence_meets_all_copper_or_none() -> None:
    n = 40_000
    given = lines(n, 0.0, seed=5)
    first, kapton, second = (fraction(slab, given) for slab in (COPPER_FOILS, KAPTON_FOILS, SECOND_COPPER))
    assert set(np.unique(first)) == {0.0, 1.0}
    assert np.array_equal(first, second)
    # Kapton: none in the waist, all beside the hole, and between them a share that grows evenly with the distance.
    for found, area in ((kapton == 0, 0.025**2), (kapton < 0.5, 0.030**2), (kapton < 1, 0.035**2)):
        expected = math.pi * area / CELL
        assert_within(found.mean(), expected, fraction_error(expected, n), what=f"part below radius^2 {area}")
    assert np.all(kapton[first == 1] == 1)


def small(changes: dict[str, object] | None = None) -> Detector:
    """Return L1 and L2 alone."""
    bare = load({"base": "besiii-cgem", "remove": ["drift_chamber", "walls", "beam_pipe", "cgem.L3"]})
    return bare.with_overrides(changes or {})


def shoot(detector: Detector, settings: SimulateSettings, n: int = 10_000) -> Table:
    return simulate(detector, generate(Gun("proton", p=0.6, cos_theta=(-0.5, 0.5)), n, seed=2), settings, 7)["truths"]


def even(detector: Detector, copper: float, kapton: float) -> Detector:
    """Return a detector whose foils have these parts of their solid density."""

    def thin(part, share):
        full = part.material.solid()
        return dataclasses.replace(
            part, material=dataclasses.replace(full, density=full.density * share, x0=full.x0 / share)
        )

    layers = [
        dataclasses.replace(layer, foil=tuple(map(thin, layer.foil, (copper, kapton, copper))))
        for layer in detector.cgem
    ]
    return dataclasses.replace(detector, barrels=tuple(layers))


def lost(detector: Detector, settings: SimulateSettings) -> np.ndarray:
    """Return the energy (MeV) that protons lose between the gaps of the two layers."""
    truths = shoot(detector, settings)
    energy = np.sqrt(truths["px"] ** 2 + truths["py"] ** 2 + truths["pz"] ** 2 + 0.938272**2)
    both = np.intersect1d(truths["event"][truths["layer"] == 0], truths["event"][truths["layer"] == 1])
    before, after = (energy[(truths["layer"] == i) & np.isin(truths["event"], both)] for i in (0, 1))
    return 1e3 * (before - after)


def test_mean_loss_is_that_of_the_matter_spread_evenly() -> None:
    lattice = lost(small(), SimulateSettings(foil="lattice"))
    spread = lost(even(small(), COVERAGE[COPPER_FOILS], COVERAGE[KAPTON_FOILS]), SimulateSettings())
    error = math.hypot(mean_error(lattice), mean_error(spread))
    assert_within(lattice.mean(), spread.mean(), error, what="mean loss")
    solid = lost(even(small(), 1.0, 1.0), SimulateSettings())
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(lattice.mean(), solid.mean(), error)


def test_holes_spread_the_loss() -> None:
    lattice = lost(small(), SimulateSettings(foil="lattice"))
    spread = lost(even(small(), COVERAGE[COPPER_FOILS], COVERAGE[KAPTON_FOILS]), SimulateSettings())
    widths = [np.diff(np.quantile(x, [0.16, 0.84]))[0] for x in (lattice, spread)]
    assert widths[0] > 1.02 * widths[1]


def test_foils_without_holes_give_the_same_as_even_ones() -> None:
    # Holes of 1 um are met by one track in ten thousand.
    changes = {f"cgem.{label}.hole_{side}": "1 um" for label in ("L1", "L2") for side in ("outer", "inner")}
    solid = even(small(changes), 1.0, 1.0)
    lattice, effective = (
        shoot(solid, SimulateSettings(sublayers=True, foil=foil), 500) for foil in ("lattice", "effective")
    )
    assert len(lattice) == len(effective)
    # Foils with holes are simulated one by one, even ones in lanes: equal but for rounding.
    assert np.mean(np.isclose(lattice["phi"], effective["phi"], rtol=0, atol=1e-12)) > 0.98


def test_other_slabs_keep_their_random_numbers() -> None:
    found = slabs(BUILT, foil="lattice")
    groups = [slab.shells[0].group for slab in found]
    place = hole_table([slab.holes for slab in found], groups, merge=True)["place"]
    merged = [slab.shells[0].group for slab in slabs(BUILT)]
    others = [(int(number), group) for number, group in zip(place, groups, strict=True) if group != "foils"]
    assert others == [(i, group) for i, group in enumerate(merged) if group != "foils"]
    assert len(set(place.tolist())) == len(found)


def test_foils_of_a_lattice_are_solid() -> None:
    found = [slab for slab in slabs(BUILT, foil="lattice") if slab.holes]
    assert len(found) == 3 * 3 * 3
    assert [slab.shells[0].material.density for slab in found[:3]] == pytest.approx([8.96, 1.42, 8.96])
    assert [slab.shells[0].material.x0 for slab in found[:3]] == pytest.approx([14.35, 284.1, 14.35])
    assert [slab.holes.foil for slab in found[::3]] == list(range(9))
    assert {round(slab.holes.end - slab.holes.begin, 9) for slab in found} == {0.005, 0.05}


def test_wrong_holes_are_reported_together() -> None:
    with pytest.raises(DetectorError) as caught:
        load({"base": "besiii-cgem", "cgem": {"L1": {"hole_outer": "140 um", "hole_inner": "150 um"}}})
    assert {problem.path for problem in caught.value.problems} == {"cgem.L1.hole_outer", "cgem.L1.hole_inner"}


def test_diluted_material_knows_its_solid_also_from_a_file(tmp_path) -> None:
    own = {"base": "besiii-cgem", "materials": {"Mesh": {"base": "CuFoil", "density": "2 g/cm3"}}}
    foil = [{"material": "Mesh", "thickness": "5 um"}, {"material": "KaptonFoil", "thickness": "50 um"}]
    detector = load(own | {"cgem": {"L1": {"foil": foil}}})
    path = tmp_path / "own.toml"
    path.write_text(detector.to_toml())
    assert load(path) == detector
    solid = load(path).cgem[0].foil[0].material.solid()
    assert (solid.density, solid.x0, solid.filling) == pytest.approx((8.96, 14.35, 1.0))


@pytest.mark.parametrize("wrong", [{"foil": "holes"}, {"foil": "lattice", "fluctuations": "gaussian"}])
def test_settings_that_do_not_exist(wrong: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="SimulateSettings: 1 problem\n  foil: "):
        SimulateSettings(**wrong)
