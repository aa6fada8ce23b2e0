"""Errors of slow kaons and protons, which scattering in the chamber gas decides, and of alphas are right."""

from __future__ import annotations

import pytest

from cgemit.analysis.quantities import median_error
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.covariance.analytic import analytic
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import FitSettings
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


@pytest.mark.parametrize(
    ("detector", "particle", "p"),
    [("besiii-cgem", "alpha", (2.0, 5.0)), ("besiii-cgem", "He3", (1.5, 4.0)), ("epic-like", "alpha", (2.0, 5.0))],
)
def test_pulls_of_helium(detector: str, particle: str, p: tuple[float, float]) -> None:
    """All five parameters and p have pulls of width 1, within 5 %."""
    found = pulls(run(detector, Gun(particle, p=p, cos_theta=(-0.7, 0.7)), N, seed=17).tracks)
    for name in ("dr", "phi0", "kappa", "dz", "tanl", "p"):
        assert abs(found[name].core - 1) < 0.05, name
        assert abs(found[name].core_mean) < WIDTH, name


def test_helium_fitted_as_protons_fails() -> None:
    """With the mass and charge of a proton, scattering and loss are too small and the momentum is half as large."""
    settings = Settings(fit=FitSettings(hypothesis="p"))
    result = run("besiii-cgem", Gun("alpha", p=(2.0, 5.0), cos_theta=(-0.7, 0.7)), 1000, seed=17, settings=settings)
    found = pulls(result.tracks)
    assert found["dr"].core > 1.2
    assert found["p"].core_mean < -10  # half of the momentum


def test_expected_errors_of_alphas() -> None:
    """The analytic covariance has the errors of the fit."""
    expected = analytic("besiii-cgem", "alpha", p=2.5, cos_theta=0.3, readout="gaussian")
    result = run("besiii-cgem", Gun("alpha", p=2.5, cos_theta=0.3), 1000, seed=17, readout="gaussian")
    for name in ("dr", "dz", "p", "phi0", "tanl"):
        assert median_error(result.tracks, name) == pytest.approx(float(expected.sigma(name)), rel=0.03), name
