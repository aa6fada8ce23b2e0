"""The loss that the fit subtracts is that of the core of what a momentum measurement sees (docs/methods/matter.md)."""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from cgemit import _core
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.detector import load
from cgemit.fit_matter import tuned
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import CORE_SETTINGS, FitSettings
from cgemit.study import pulls
from slabs import BERYLLIUM, bethe, slab_detector
from stats import assert_within
from straggling import core, folded
from tracks import MUON, hits_on

SIGMAS = _core.matter.CORE_SIGMAS
MOMENTA = (0.2, 0.3, 0.5, 0.7, 1.0, 2.0)


class Measured(NamedTuple):
    """A track's W_max, the cut of the fit and the error of the energy without straggling, in its xi; and beta^2."""

    w_max: float
    cut: float
    error: float
    beta2: float


@cache
def measured(p: float) -> Measured:
    """Return what the fit knows of a muon at 90 degrees."""
    detector = load("besiii-cgem-design")
    compact, helix = tuned(detector), np.array([0, 0.4, -1 / p, 0, 0])
    hits = hits_on(detector, helix)
    settings = dataclasses.asdict(FitSettings())
    chosen = {"errors_from_track": False, "momentum": p, "prior_sigma": settings["prior_sigma"], "beam": (0.0, 0.0)}
    chosen |= {name: settings[name] for name in CORE_SETTINGS}
    out = _core.reconstruction.fit(
        compact, hit_offsets=np.array([0, len(hits["kind"])]), hits=hits, mass=np.array([MUON]), start=helix[None],
        settings=chosen, residuals=False,
    )  # fmt: skip
    beta2 = p * p / (p * p + MUON**2)
    xi = _core.matter.total_matter(compact, 0.0)[1] / beta2
    error = math.sqrt(out["cov"][0, 2, 2] * beta2) * p * p / xi
    own = _core.matter.momentum_error(compact, p=p, mass=MUON) * p * math.sqrt(beta2) / xi
    ratio, gamma = 0.51099895e-3 / MUON, math.hypot(1, p / MUON)
    w_max = 2 * 0.51099895e-3 * (p / MUON) ** 2 / (1 + 2 * gamma * ratio + ratio**2) / xi
    cut = min(0.5 * (SIGMAS**2 + math.sqrt(SIGMAS**4 + 4 * (SIGMAS * own) ** 2)), w_max)
    return Measured(w_max, cut, math.sqrt(error**2 - cut * (1 - beta2 * cut / w_max / 2)), beta2)


def off(p: float, cut: float) -> tuple[float, float]:
    """Return by how much loss and error with the collisions below a cut miss the core, in sigmas of the core."""
    w_max, _, error, beta2 = measured(p)
    mean, sigma = core(*folded(w_max, beta2, error))
    cut = min(cut, w_max)
    loss = math.log(cut / w_max) + beta2 * (1 - cut / w_max)
    return (loss - mean) / sigma, math.sqrt(error**2 + cut * (1 - beta2 * cut / w_max / 2)) / sigma - 1


@pytest.mark.parametrize("p", MOMENTA)
def test_loss_is_that_of_the_core(p: float) -> None:
    """Vavilov's distribution, folded with the error of the measurement, has its core where the fit takes it."""
    loss, error = off(p, measured(p).cut)
    assert abs(loss) < 0.04
    assert abs(error) < (0.06 if p < 0.25 else 0.03)


def test_other_cuts_miss_the_core() -> None:
    """Landau's width alone is too small an error, all collisions too large a one; the most probable loss is off."""
    for p in (0.3, 0.5):
        assert abs(off(p, math.exp(0.2))[0]) > 0.15
        assert off(p, 5.0)[1] < -0.03
        assert off(p, math.inf)[1] > 0.08


def test_the_core_ends_in_proportion_to_the_error() -> None:
    """Mean and variance of the core are those of collisions below 2.4 to 2.7 of its sigmas, for any error."""
    for error in (0.05, 1.0, 3.0, 10.0, 30.0):
        mean, sigma = core(*folded(2000.0, 1.0, error, 2**18))
        mean_cut = 0.0
        for _ in range(20):  # mean = ln(cut/w_max) + 1 - cut/w_max
            mean_cut = 2000.0 * math.exp(mean - 1 + mean_cut / 2000.0)
        excess = sigma**2 - error**2
        variance_cut = 2000.0 * (1 - math.sqrt(1 - 2 * excess / 2000.0))
        assert 2.4 < mean_cut / sigma < 2.8
        assert variance_cut == pytest.approx(mean_cut, rel=0.07)


def test_choices_are_what_they_say() -> None:
    """The mean is Bethe's with Vavilov's variance, the most probable loss Landau's with his width."""
    p, thickness = 0.5, 2.0
    _, xi, w_max = bethe(BERYLLIUM, thickness, p, MUON, 1e9)
    beta2 = p * p / (p * p + MUON**2)

    def moments(choice: str) -> tuple[float, float, float]:
        detector = slab_detector([(BERYLLIUM, thickness, 50.0)], loss=choice)
        return _core._testing.core_loss(detector, 0, path=1.0, p=p, mass=MUON, track_xi=xi * beta2)

    loss, variance, _ = moments("mean")
    everything = slab_detector([(BERYLLIUM, thickness, 50.0)])
    assert loss == pytest.approx(
        _core.matter.restricted_loss(everything, 0, path=1.0, p=p, mass=MUON, charge=1.0, cut=1e9), rel=1e-3
    )
    assert variance == pytest.approx(xi * w_max * (1 - beta2 / 2), rel=1e-6)
    # PDG 2024, eq. 34.12: xi [ln(2 m_e (beta gamma)^2/I) + ln(xi/I) + 0.200 - beta^2 - delta]; below W_max by a
    # thousand, the restricted loss of that cut is the same.
    loss, variance, _ = moments("most_probable")
    below, _, _ = bethe(BERYLLIUM, thickness, p, MUON, math.exp(0.2) * xi)
    assert loss == pytest.approx(below, rel=1e-3)
    assert math.sqrt(variance) == pytest.approx(4.018 * xi / 2.3548, rel=1e-2)


@pytest.mark.parametrize("p", [0.1, 0.2, 0.5, 1.0])
def test_pulls_of_kappa(p: float) -> None:
    """In the default simulation the core of the pull of kappa has width 1 and mean 0 to the tolerances of the page."""
    n = 4000
    tracks = run("besiii-cgem-design", Gun("mu-", p=p, cos_theta=(-0.93, 0.93)), n, seed=41).tracks
    kappa = pulls(tracks)["kappa"]
    width, mean = (0.15, 0.2) if p < 0.25 else (0.06, 0.08)
    assert abs(kappa.core - 1) < width
    assert abs(kappa.core_mean) < mean


def test_pulls_see_another_loss() -> None:
    """With the most probable loss the mean of the pull of kappa is off, with the mean loss its width."""
    gun, n = Gun("mu-", p=0.3, cos_theta=0.0), 4000

    def kappa(loss: str):
        settings = Settings(fit=FitSettings(loss=loss))
        return pulls(run("besiii-cgem-design", gun, n, seed=41, settings=settings).tracks)["kappa"]

    wrong = kappa("most_probable")
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(wrong.core_mean, 0, wrong.core_mean_error)
    assert kappa("mean").core < 0.94
