"""Sampled energy losses have Bethe's mean, Landau's shape and Rutherford's tail, however matter is cut."""

import math

import numpy as np
import pytest
from scipy import stats as distributions

from cgemit import _core
from cgemit.detector import compiled, load, slab_table, slabs
from slabs import BERYLLIUM, COPPER, ELECTRON, KAON, KAPTON, MUON, PION, PROTON, bethe, slab_detector
from stats import assert_within

N = 200_000
PASSAGES = [
    pytest.param(BERYLLIUM, 1.4, 1.0, MUON, id="1 GeV/c muon, 1.4 mm Be"),
    pytest.param(COPPER, 0.014, 1.0, MUON, id="1 GeV/c muon, 14 um Cu"),
    pytest.param(BERYLLIUM, 1.4, 0.2, MUON, id="0.2 GeV/c muon, 1.4 mm Be"),
    pytest.param(KAPTON, 0.3, 0.2, PION, id="0.2 GeV/c pion, 0.3 mm Kapton"),
    pytest.param(BERYLLIUM, 1.4, 0.5, PROTON, id="0.5 GeV/c proton, 1.4 mm Be"),
    pytest.param(BERYLLIUM, 0.2, 0.15, KAON, id="0.15 GeV/c kaon, 0.2 mm Be"),
    pytest.param(COPPER, 0.014, 0.3, PROTON, id="0.3 GeV/c proton, 14 um Cu"),
]
each_passage = pytest.mark.parametrize(("matter", "thickness", "p", "mass"), PASSAGES)


def sample(matter, thickness, p, mass, seed=1, n=N, path=1.0):
    """Return losses in one slab, GeV."""
    core = slab_detector([(matter, thickness, 50.0)])
    return _core._testing.sample_loss(core, 0, path=path, p=p, mass=mass, seed=seed, n=n)


def beta2(p, mass):
    """Return the squared velocity."""
    return p * p / (p * p + mass * mass)


@each_passage
def test_mean_is_bethe(matter, thickness, p, mass):
    """The mean loss is Bethe's, within the error that the rare large transfers give it."""
    losses = sample(matter, thickness, p, mass)
    expected, xi, w_max = bethe(matter, thickness, p, mass)
    variance = xi * w_max * (1 - 0.5 * beta2(p, mass))
    # 1e-3: the density effect is read from a table.
    error = math.sqrt(variance / N + (1e-3 * expected / 4) ** 2)
    assert_within(losses.mean(), expected, error, what="mean loss")


@pytest.mark.parametrize(("matter", "thickness", "p", "mass"), PASSAGES[:4])  # where one collision stands out
def test_mean_of_soft_collisions(matter, thickness, p, mass):
    """Without the losses beyond a cut the mean has a small error, and is that of the restricted loss."""
    expected, xi, w_max = bethe(matter, thickness, p, mass)
    losses = sample(matter, thickness, p, mass)
    assert xi < 0.02 * w_max
    # Above T one collision dominates; those below are counted, those above replaced by their expectation.
    limit = expected + 100 * xi
    b2 = beta2(p, mass)
    capped = np.minimum(losses, limit)
    cut = 100 * xi
    # A collision of energy E > cut counts as about `cut` on top of the mean: integral of (E - cut) over the spectrum.
    energy = np.geomspace(cut, w_max, 20_001)
    beyond = np.trapezoid((energy - cut) * xi / energy**2 * (1 - b2 * energy / w_max), energy)
    error = capped.std() / math.sqrt(N)
    # The other collisions of such a loss spread by a few xi about their mean: 3 % of the correction.
    error = math.hypot(error, 0.01 * beyond)
    assert_within(capped.mean(), expected - beyond, error, what="capped mean")
    # The gate sees a loss that is wrong by three per cent.
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(capped.mean(), 1.03 * expected - beyond, error)


@each_passage
def test_tail_counts(matter, thickness, p, mass):
    """Far above the most probable loss the losses are single collisions, as many as the spectrum has above T."""
    _, xi, w_max = bethe(matter, thickness, p, mass)
    losses = sample(matter, thickness, p, mass)
    b2 = beta2(p, mass)
    soft = bethe(matter, thickness, p, mass, cut=10 * xi)[0]  # what the others lose
    tested = 0
    for transfer in (0.02 * w_max, 0.1 * w_max, 0.5 * w_max):
        number = N * xi * (1 / transfer - 1 / w_max - b2 / w_max * math.log(w_max / transfer))
        if transfer < 50 * xi or number < 20:
            continue
        tested += 1
        # The soft loss shifts the threshold by about xi: a fraction xi/T of the number.
        error = math.hypot(math.sqrt(number), 3 * xi / transfer * number)
        assert_within(np.count_nonzero(losses > transfer + soft), number, error, what=f"above {transfer / w_max} W_max")
    if xi < 1e-3 * w_max:
        assert tested > 0
        assert losses.max() < w_max + soft + 50 * xi


def landau_quantiles(xi, mean, w_max, b2, probabilities):
    """Return quantiles of Landau's distribution, GeV.

    lambda = (loss - mean)/xi - (1 - 0.57722) - beta^2 - ln(xi/W_max) (Landau 1944; Koelbig and Schorr, CPC 31 (1984)
    97); scipy's variable x is lambda = (pi/2) x + ln(pi/2).
    """
    variable = 0.5 * math.pi * distributions.landau.ppf(probabilities) + math.log(0.5 * math.pi)
    return mean + xi * (variable + 1 - np.euler_gamma + b2 + math.log(xi / w_max))


def test_scale_of_scipys_landau():
    """The median of Landau's distribution is lambda = 1.35578, its mode -0.22278: scipy's variable is understood."""
    grid = np.linspace(-1.5, 0.5, 20_001)
    mode = grid[np.argmax(distributions.landau.pdf(grid))]
    assert 0.5 * math.pi * distributions.landau.ppf(0.5) + math.log(0.5 * math.pi) == pytest.approx(1.35578, abs=2e-4)
    assert 0.5 * math.pi * mode + math.log(0.5 * math.pi) == pytest.approx(-0.22278, abs=2e-4)


def test_shape_is_landau():
    """For 1 GeV/c muons in the beam pipe the quantiles are Landau's within 2 %, the median within 1 %."""
    detector = load("besiii-cgem-design")
    core, columns = compiled(detector), slab_table(slabs(detector)).slabs
    b2, gamma = beta2(1.0, MUON), math.hypot(1, MUON) / MUON
    w_max = 2 * ELECTRON / MUON**2 / (1 + 2 * gamma * ELECTRON / MUON + (ELECTRON / MUON) ** 2)
    xi = columns["xi"][0] / b2
    assert xi < 1e-3 * w_max
    mean = _core.matter.restricted_loss(core, 0, path=1.0, p=1.0, mass=MUON, cut=w_max)
    losses = _core._testing.sample_loss(core, 0, path=1.0, p=1.0, mass=MUON, seed=5, n=N)
    probabilities = np.array([0.1, 0.25, 0.5, 0.75, 0.9, 0.95])
    expected = landau_quantiles(xi, mean, w_max, b2, probabilities)
    found = np.quantile(losses, probabilities)
    np.testing.assert_allclose(found, expected, rtol=0.02)
    assert found[2] == pytest.approx(expected[2], rel=0.01)


@each_passage
def test_cutting_changes_nothing(matter, thickness, p, mass):
    """The sum over ten thin slabs is distributed as the loss in the whole."""
    n = 40_000
    whole = sample(matter, thickness, p, mass, n=n)
    parts = sum(sample(matter, thickness / 10, p, mass, seed=100 + i, n=n) for i in range(10))
    probabilities = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
    _, xi, _ = bethe(matter, thickness, p, mass)
    first, second = np.quantile(whole, probabilities), np.quantile(parts, probabilities)
    # Errors of the quantiles from the density, estimated from the neighbouring quantiles.
    width = 0.02
    density = 2 * width / (np.quantile(whole, probabilities + width) - np.quantile(whole, probabilities - width))
    error = np.sqrt(2 * probabilities * (1 - probabilities) / n) / density
    # The soft part of a thin slab is less coarse: 0.05 xi.
    assert_within(second, first, np.hypot(error, 0.05 * xi / 4), what="quantiles")


def test_oblique_path_is_thicker_matter():
    """A path twice as long in a slab is the same as a slab twice as thick, draw by draw."""
    a = sample(KAPTON, 0.3, 0.5, PION, n=1000, path=2.0)
    b = sample(KAPTON, 0.6, 0.5, PION, n=1000)
    np.testing.assert_allclose(a, b, rtol=1e-9)


def test_losses_are_never_negative():
    """Thin gas, where soft collisions fluctuate as much as their mean, never gives energy back."""
    detector = load("besiii-cgem-design")
    core, columns = compiled(detector), slab_table(slabs(detector)).slabs
    gap = int(np.flatnonzero(columns["gap"] == 0)[0])
    losses = _core._testing.sample_loss(core, gap, path=1.0, p=1.0, mass=MUON, seed=2, n=N)
    assert losses.min() >= 0
    xi = columns["xi"][gap] / beta2(1.0, MUON)
    mean = _core.matter.restricted_loss(core, gap, path=1.0, p=1.0, mass=MUON, cut=1e3)
    w_max = 2 * ELECTRON / MUON**2 / (1 + 2 * math.hypot(1, MUON) / MUON * ELECTRON / MUON)
    assert_within(losses.mean(), mean, math.sqrt(xi * w_max * (1 - 0.5 * beta2(1.0, MUON)) / N))
