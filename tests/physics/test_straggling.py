"""Energy loss against the exact convolution of single collisions, and restricted losses against Bethe's formula."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import sici

from cgemit import _core
from slabs import BERYLLIUM, CARBON, COPPER, KAON, KAPTON, MUON, PION, PROTON, bethe, slab_detector
from stats import assert_within, mean_error

pytestmark = pytest.mark.slow

FRACTIONS = np.array([0.01, 0.16, 0.5, 0.84, 0.99])


def vavilov_quantiles(mean, xi, w_max, beta2, fractions=FRACTIONS):
    """Return quantiles of the sum of Poisson-distributed collisions xi/E^2 (1 - beta^2 E/W_max), E up to W_max, GeV.

    P.V. Vavilov, Sov. Phys. JETP 5 (1957) 749: ln phi(k) = i k mean + integral of (e^ikE - 1 - ikE) times the spectrum,
    in closed form by sine and cosine integrals. The mean is given, so that distant collisions below the binding
    energies are in it.
    """
    k = np.arange(5e-4, 12, 1e-3) / xi
    x = k * w_max
    sine, cosine = sici(x)
    entire = -(np.euler_gamma + np.log(x) - cosine) + 1j * sine  # integral of (e^iu - 1)/u
    first = -(np.exp(1j * x) - 1 - 1j * x) / x + 1j * entire  # of (e^iu - 1 - iu)/u^2
    phi = np.exp(xi * k * first - xi * beta2 / w_max * (entire - 1j * x))

    def below(loss):
        return 0.5 - np.sum(np.imag(phi * np.exp(-1j * k * (loss - mean))) / k) * (k[1] - k[0]) / np.pi

    edges = mean - xi * (20 + np.log(w_max / xi)), mean + 300 * xi
    return np.array([brentq(lambda t, f=f: below(t) - f, *edges, xtol=1e-4 * xi) for f in fractions])


def straggling(matter, thickness, p, mass):
    """Return mean loss, xi, W_max (GeV) and beta^2."""
    return *bethe(matter, thickness, p, mass), p * p / (p * p + mass * mass)


def losses(matter, thickness, p, mass, n=200_000, seed=3, pieces=1):
    """Return losses behind a sheet, cut in pieces, GeV."""
    parts = [(matter, thickness / pieces, 10 + thickness * (i + 0.5) / pieces) for i in range(pieces)]
    return _core.simulation.through_slabs(slab_detector(parts), p=p, mass=mass, charge=1, n=n, seed=seed)["loss"]


def test_the_convolution_is_landaus():
    """For small xi the median is Landau's."""
    xi, w_max, beta2 = 1e-6, 1.0, 0.98
    found = vavilov_quantiles(0.0, xi, w_max, beta2, [0.5])
    # lambda = loss/xi - (1 - 0.57722) - beta^2 - ln(xi/W_max), its median is 1.35578.
    assert found[0] / xi - (1 - np.euler_gamma) - beta2 - np.log(xi / w_max) == pytest.approx(1.35578, abs=1e-3)


def test_the_convolution_is_a_collision_sum():
    """Single collisions above xi/30 drawn one by one, softer ones by their variance, have the same quantiles."""
    mean, xi, w_max, beta2 = straggling(BERYLLIUM, 0.2, 0.15, KAON)
    rng, n, cut = np.random.default_rng(1), 100_000, xi / 30
    counts = rng.poisson(xi * (1 / cut - 1 / w_max), n)
    energy = 1 / (1 / cut - rng.random(counts.sum()) * (1 / cut - 1 / w_max))
    energy[rng.random(len(energy)) > 1 - beta2 * energy / w_max] = 0
    hard = np.bincount(np.repeat(np.arange(n), counts), energy, n)
    hard_mean = xi * (np.log(w_max / cut) - beta2 * (1 - cut / w_max))
    total = mean - hard_mean + np.sqrt(xi * cut) * rng.normal(size=n) + hard
    assert np.quantile(total, FRACTIONS) == pytest.approx(vavilov_quantiles(mean, xi, w_max, beta2), rel=5e-3)


@pytest.mark.parametrize(
    ("matter", "thickness", "p", "mass"),
    [
        pytest.param(COPPER, 0.014, 1.0, MUON, id="1 GeV/c muon, 14 um Cu"),
        pytest.param(COPPER, 0.014, 0.2, MUON, id="0.2 GeV/c muon, 14 um Cu"),
        pytest.param(CARBON, 0.2135, 1.0, MUON, id="1 GeV/c muon, C 0.1 % X0"),
        pytest.param(KAPTON, 0.3, 0.2, PION, id="0.2 GeV/c pion, 0.3 mm Kapton"),
        pytest.param(BERYLLIUM, 0.2, 0.15, KAON, id="0.15 GeV/c kaon, 0.2 mm Be"),
        pytest.param(COPPER, 0.014, 0.3, PROTON, id="0.3 GeV/c proton, 14 um Cu"),
    ],
)
@pytest.mark.parametrize("pieces", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_quantiles_of_the_loss(matter, thickness, p, mass, pieces):
    """The median is within 1 % and the 99 % quantile within 5 % of the convolution, in one piece or ten."""
    expected = vavilov_quantiles(*straggling(matter, thickness, p, mass))
    found = np.quantile(
        losses(matter, thickness, p, mass, n=100_000 if pieces == 1 else 50_000, pieces=pieces), FRACTIONS
    )
    # In pieces, slow particles slow down on the way: 0.8 % for the kaon.
    assert found[:4] == pytest.approx(expected[:4], rel=0.01)
    assert found[4] == pytest.approx(expected[4], rel=0.05)
    # The gate sees three per cent more matter.
    more = vavilov_quantiles(*straggling(matter, 1.03 * thickness, p, mass), [0.5])
    assert found[2] != pytest.approx(more[0], rel=0.01)


@pytest.mark.parametrize("pieces", [2, 10, 100])
def test_cutting_changes_nothing(pieces):
    """All quantiles of the loss in 14 um of copper are the same in 2, 10 or 100 pieces, within errors and 1 %."""
    n = 100_000 if pieces < 100 else 15_000
    whole = np.quantile(losses(COPPER, 0.014, 1.0, MUON), FRACTIONS)
    cut = losses(COPPER, 0.014, 1.0, MUON, n=n, seed=4, pieces=pieces)
    found = np.quantile(cut, FRACTIONS)
    step = 0.2 * np.minimum(FRACTIONS, 1 - FRACTIONS)
    density = 2 * step / (np.quantile(cut, FRACTIONS + step) - np.quantile(cut, FRACTIONS - step))
    error = np.sqrt(FRACTIONS * (1 - FRACTIONS) * (1 / n + 1 / 200_000)) / density
    assert_within(found, whole, np.hypot(error, 0.01 / 4 * whole), what="quantiles")


@pytest.mark.parametrize(("matter", "thickness"), [(CARBON, 0.002), (COPPER, 0.0005), (BERYLLIUM, 0.005)])
@pytest.mark.parametrize("p", [0.2, 1.0])
def test_mean_below_100_kev(matter, thickness, p):
    """The mean loss by collisions below 100 keV is the restricted Bethe formula's to 1 %.

    In sheets so thin that all softer collisions together lose about 1 keV, a loss above 100 keV is one collision.
    """
    n, cut = 1_500_000, 100e-6
    expected, xi, _ = bethe(matter, thickness, p, MUON, cut)
    assert expected < 2e-6
    core = slab_detector([(matter, thickness, 50.0)])
    sample = _core._testing.sample_loss(core, 0, path=1.0, p=p, mass=MUON, seed=1, n=n)
    # The others' `expected` carries collisions of a little less than 100 keV over the border.
    soft = np.where(sample < cut + expected, sample, 0.0)
    assert soft.mean() == pytest.approx(expected, rel=0.01)
    assert_within(soft.mean(), expected, np.hypot(np.sqrt(xi * cut / n), 2e-3 / 4 * expected), what="restricted mean")
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(soft.mean(), bethe(matter, thickness, p, MUON, 0.8 * cut)[0], np.sqrt(xi * cut / n))


@pytest.mark.parametrize(("p", "mass"), [(0.15, KAON), (0.28, PROTON), (0.032, MUON)])
def test_slow_particles_lose_what_bethe_says(p, mass):
    """At beta gamma = 0.3 the mean over many passages is the formula's, and its spread Vavilov's."""
    mean, xi, w_max, beta2 = straggling(BERYLLIUM, 0.01, p, mass)
    sample = losses(BERYLLIUM, 0.01, p, mass, n=100_000)
    assert 0.29 < p / mass < 0.31
    # 1e-3: the table of the density effect, and what slowing down adds.
    assert_within(sample.mean(), mean, np.hypot(mean_error(sample), 3e-3 / 4 * mean), what="mean")
    assert sample.std() == pytest.approx(np.sqrt(xi * w_max * (1 - 0.5 * beta2)), rel=0.02)


def test_stopping_is_a_status():
    """Protons that cannot cross stop and leave all their energy; of faster ones none does."""
    core = slab_detector([(BERYLLIUM, 2.0, 50.0 + 2 * i) for i in range(5)])
    out = _core.simulation.through_slabs(core, p=0.15, mass=PROTON, charge=1, n=200, seed=1)
    assert np.all(out["status"] == _core.common.TransportStatus.stopped)
    np.testing.assert_allclose(out["loss"], np.hypot(0.15, PROTON) - PROTON, rtol=1e-12)
    assert np.all(np.isfinite(out["angle_1"]) & np.isfinite(out["shift_1"]))
    fast = _core.simulation.through_slabs(core, p=1.0, mass=PROTON, charge=1, n=200, seed=1)
    assert np.all(fast["status"] == _core.common.TransportStatus.outside)
