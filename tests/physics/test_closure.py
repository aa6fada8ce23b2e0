"""Closure: where simulation and readout do exactly what the fit assumes, its errors are the errors."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from cgemit.chain.result import Result
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.detector import Detector, load
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import PARAMETERS
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.study import measure, pulls
from exact import assert_no_bias, assert_probability_is_flat, assert_pulls_are_standard_normal, exact
from stats import assert_within

N = 6000


def with_field(name: str, bz: float) -> Detector:
    """Return a preset in another field."""
    detector = load(name)
    return dataclasses.replace(detector, field=dataclasses.replace(detector.field, bz=bz))


@cache
def exact_sample(particle: str, p: float, bz: float, cos_theta: float) -> Result:
    """Tracks in the mode in which everything is Gaussian and known."""
    return run(with_field("besiii-cgem-design", bz), Gun(particle, p=p, cos_theta=cos_theta), N, seed=11, **exact())


# Each momentum with one charge and field by default; the other combinations are slow.
QUICK = {(0.2, "mu-", -1.0), (0.5, "mu+", 1.0), (1.0, "mu-", 1.0), (2.0, "mu+", -1.0)}
POINTS = [
    pytest.param(particle, p, bz, 0.0, marks=[] if (p, particle, bz) in QUICK else pytest.mark.slow)
    for p in (0.2, 0.5, 1.0, 2.0)
    for particle in ("mu-", "mu+")
    for bz in (-1.0, 1.0)
]
# Away from 90 degrees the terms with tan(lambda) count.
POINTS += [
    pytest.param("mu-", 0.5, -1.0, 0.5),
    pytest.param("mu-", 1.0, -1.0, -0.8),
    pytest.param("pi+", 0.5, -1.0, 0.8),
]


@pytest.mark.parametrize(("particle", "p", "bz", "cos_theta"), POINTS)
def test_pulls_are_standard_normal(particle: str, p: float, bz: float, cos_theta: float) -> None:
    """Pulls of the five parameters have mean 0 and width 1, and every track is fitted."""
    assert_pulls_are_standard_normal(exact_sample(particle, p, bz, cos_theta).tracks)


@pytest.mark.parametrize(("particle", "p", "bz", "cos_theta"), POINTS)
def test_chi_square_probability_is_flat(particle: str, p: float, bz: float, cos_theta: float) -> None:
    """The probability of chi-square is uniform (Kolmogorov-Smirnov, 1 in 16 000)."""
    assert_probability_is_flat(exact_sample(particle, p, bz, cos_theta).tracks)


def test_pull_gate_sees_a_wrong_field() -> None:
    """A fit that believes in a field 0.1 % too strong fails the gate on kappa."""
    result = run(
        load("besiii-cgem-design"),
        Gun("mu-", p=0.5, cos_theta=0.0),
        N,
        seed=11,
        **exact(),
        fit_detector=with_field("besiii-cgem-design", -1.001),
    )
    with pytest.raises(AssertionError, match="standard errors"):
        assert_no_bias(result.tracks["pull_kappa"], "kappa")


def test_pull_gate_sees_missing_material() -> None:
    """A fit that does not know of the beam pipe fails the gate on the width of the pull of dr."""
    detector, n = load("besiii-cgem-design"), 10_000
    result = run(
        detector,
        Gun("mu-", p=0.5, cos_theta=0.0),
        n,
        seed=11,
        **exact(),
        fit_detector=dataclasses.replace(detector, beam_pipe=detector.beam_pipe[:1]),
    )
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(result.tracks["pull_dr"].std(), 1, 1 / np.sqrt(2 * n), what="width of the pull of dr")


@pytest.mark.parametrize("p", [0.2, 0.5, 1.0, 2.0])
def test_core_pulls_with_the_papers_digitization(p: float) -> None:
    """With strips, unknown sides and straggling to W_max core widths stay within 1 +- 0.06, means within 0.08."""
    result = run("besiii-cgem-design", Gun("mu-", p=p, cos_theta=(-0.93, 0.93)), N, seed=13)
    assert sum(result.removed().values()) < 0.005 * N
    for row in pulls(result.tracks):
        assert abs(row.core - 1) < 0.06, f"core width of the pull of {row.parameter}: {row.core:.3f}"
        assert abs(row.core_mean) < 0.08, f"mean of the core of the pull of {row.parameter}: {row.core_mean:.3f}"


def test_sides_are_found() -> None:
    """Wrong sides are below 0.1 % of the hits farther than two standard deviations from their wire."""
    settings = dataclasses.replace(Settings(), fit=dataclasses.replace(Settings().fit, residuals=True))
    result = run("besiii-cgem-design", Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), 2000, seed=14, settings=settings)
    residuals = result.residuals
    assert residuals is not None
    wires = residuals[residuals["view"] == 2]
    truth = result.wire_truths[result.wire_hits["wire_truth"][wires["hit"]]]
    far = np.abs(truth["doca"]) > 2 * 0.130
    wrong = (wires["side"] != truth["side"])[far].mean()
    assert wrong < 1e-3


@cache
def widths_of_sides(sigma: str = "130 um") -> tuple[float, float, tuple[float, ...]]:
    """Return core widths of p with sides known and to be found, and widths of the pulls with sides to be found."""
    detector = load("besiii-cgem-design").with_overrides({"drift_chamber.sigma": sigma})
    gun, sides = Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), (exact(), exact(digitize=DigitizeSettings()))
    known, found = (run(detector, gun, 4000, seed=15, **how).tracks for how in sides)
    cores = (measure(tracks["res_p"]).core for tracks in (known, found))
    return *cores, tuple(found[f"pull_{name}"].std() for name in PARAMETERS)


def test_hidden_sides_cost_little() -> None:
    """Sides to be found cost less than 3 % in sigma(p), and the widths of the pulls stay within 0.05 of 1."""
    known, hidden, pull_widths = widths_of_sides()
    assert hidden / known < 1.03
    assert max(abs(width - 1) for width in pull_widths) < 0.05


def test_gate_sees_worse_wires() -> None:
    """Wires of 145 instead of 130 um cost more than sides may."""
    assert widths_of_sides("145 um")[1] / widths_of_sides()[0] > 1.03
