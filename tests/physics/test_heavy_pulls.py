"""Errors of p and kappa of slow kaons and protons, which scattering in the chamber gas decides, are right."""

from __future__ import annotations

import pytest

from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.particles.gun import Gun
from cgemit.simulation.transport import SimulateSettings
from cgemit.study import Pulls, pulls

pytestmark = pytest.mark.slow

N = 4000  # a standard error of 0.011 of the width
WIDTH, MEAN = 0.06, 0.08  # as on the validation page


def pulls_of(detector: str, particle: str, p: float) -> Pulls:
    """Return the pulls of the default simulation without decays at 90 degrees."""
    settings = Settings(simulate=SimulateSettings(decays=False))
    return pulls(run(detector, Gun(particle, p=p, cos_theta=0.0), N, seed=17, settings=settings).tracks)


@pytest.mark.parametrize(("particle", "p"), [("K-", 0.35), ("K-", 0.5), ("proton", 0.35), ("proton", 0.5)])
@pytest.mark.parametrize("detector", ["besiii-cgem-design", "besiii-idc"])
def test_momentum_pulls(detector: str, particle: str, p: float) -> None:
    """The core has the width and the mean of the page, within its limits."""
    found = pulls_of(detector, particle, p)
    for name in ("p", "kappa"):
        assert abs(found[name].core - 1) < WIDTH, name
        assert abs(found[name].core_mean) < MEAN, name


@pytest.mark.usefixtures("equal_weights")
@pytest.mark.parametrize("particle", ["K-", "proton"])
def test_one_logarithm_for_all_matter_fails(particle: str) -> None:
    """With all matter of the track in the logarithm of the chamber gas the errors are 9 % too large."""
    found = pulls_of("besiii-cgem-design", particle, 0.5)
    assert found["p"].core < 1 - WIDTH
    assert found["kappa"].core < 1 - WIDTH
