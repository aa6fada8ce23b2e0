"""Closure in fields that are not uniform: errors of the fit are errors, and a wrong field is seen."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2, kstest

import cgemit as cg
from cgemit.detector import load
from cgemit.digitize import DigitizeSettings
from cgemit.fit import PARAMETERS
from cgemit.result import Result, Settings
from cgemit.simulate import SimulateSettings
from stats import assert_within

N = 3000
EXACT = Settings(
    simulate=SimulateSettings(fluctuations="gaussian"),
    digitize=DigitizeSettings(readout="gaussian", reveal_sides=True),
)
POINTS = [
    ("besiii-harmonic", "mu-", 0.2, 0.3),
    ("besiii-harmonic", "mu+", 1.0, -0.5),
    ("finite-solenoid", "pi+", 0.5, 0.7),
]


@cache
def exact_sample(field: str, particle: str, p: float, cos_theta: float) -> Result:
    """Tracks in the mode in which everything is Gaussian and known."""
    detector = load("besiii-cgem-design").with_field(field)
    return cg.run(detector, cg.Gun(particle, p=p, cos_theta=cos_theta), N, seed=11, settings=EXACT)


@pytest.mark.parametrize(("field", "particle", "p", "cos_theta"), POINTS)
def test_pulls_are_standard_normal(field: str, particle: str, p: float, cos_theta: float) -> None:
    result = exact_sample(field, particle, p, cos_theta)
    assert result.removed() == {}
    for name in PARAMETERS:
        pull = result.tracks[f"pull_{name}"]
        assert_within(pull.mean(), 0, 1 / np.sqrt(N), what=f"mean pull of {name}")
        assert_within(pull.std(), 1, 1 / np.sqrt(2 * N), what=f"width of the pull of {name}")
    assert kstest(chi2.sf(result.tracks["chi2"], result.tracks["ndf"]), "uniform").pvalue > 1 / 16_000


def test_pulls_of_displaced_vertices() -> None:
    """The truth is tracked back through the map, and the fit is where it says."""
    detector = load("besiii-cgem-design").with_field("besiii-harmonic")
    gun = cg.Gun("mu-", p=0.5, cos_theta=(-0.5, 0.5), vertex=(8, 25, 10))
    pulls = cg.run(detector, gun, N, seed=12, settings=EXACT).tracks
    for name in PARAMETERS:
        assert_within(pulls[f"pull_{name}"].mean(), 0, 1 / np.sqrt(N), what=f"mean pull of {name}")


@pytest.mark.parametrize("believed", ["uniform", "a thousandth more"])
def test_pull_gate_sees_a_wrong_field(believed: str) -> None:
    detector = load("besiii-cgem-design").with_field("besiii-harmonic")
    wrong = {"uniform": {"field.kind": "uniform"}, "a thousandth more": {"field.bz": "-0.98098 T"}}[believed]
    result = cg.run(
        detector, cg.Gun("mu-", p=1.0, cos_theta=-0.5), N, seed=11, settings=EXACT,
        fit_detector=detector.with_overrides(wrong),
    )  # fmt: skip
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(result.tracks["pull_kappa"].mean(), 0, 1 / np.sqrt(N), what="mean pull of kappa")
