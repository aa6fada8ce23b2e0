"""Closure in fields that are not uniform: errors of the fit are errors, and a wrong field is seen."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import cgemit as cg
from cgemit.chain.result import Result
from cgemit.detector import load
from cgemit.reconstruction.fit import PARAMETERS
from exact import assert_no_bias, assert_probability_is_flat, assert_pulls_are_standard_normal, exact
from fields import HARMONIC

N = 3000
POINTS = [
    ("besiii", "mu-", 0.2, 0.3),
    ("besiii", "mu+", 1.0, -0.5),
    ("finite-solenoid", "pi+", 0.5, 0.7),
]


@cache
def exact_sample(field: str, particle: str, p: float, cos_theta: float) -> Result:
    """Tracks in the mode in which everything is Gaussian and known."""
    detector = load("besiii-cgem-design").with_field(field)
    return cg.run(detector, cg.Gun(particle, p=p, cos_theta=cos_theta), N, seed=11, **exact())


@pytest.mark.parametrize(("field", "particle", "p", "cos_theta"), POINTS)
def test_pulls_are_standard_normal(field: str, particle: str, p: float, cos_theta: float) -> None:
    tracks = exact_sample(field, particle, p, cos_theta).tracks
    assert_pulls_are_standard_normal(tracks)
    assert_probability_is_flat(tracks)


def test_pulls_of_displaced_vertices() -> None:
    """The truth is tracked back through the map, and the fit is where it says."""
    detector = load("besiii-cgem-design").with_field(HARMONIC)
    gun = cg.Gun("mu-", p=0.5, cos_theta=(-0.5, 0.5), vertex=(8, 25, 10))
    tracks = cg.run(detector, gun, N, seed=12, **exact()).tracks
    for name in PARAMETERS:
        assert_no_bias(tracks[f"pull_{name}"], name)


@pytest.mark.parametrize("believed", ["uniform", "a thousandth more"])
def test_pull_gate_sees_a_wrong_field(believed: str) -> None:
    detector = load("besiii-cgem-design").with_field(HARMONIC)
    wrong = {"uniform": {"field.kind": "uniform"}, "a thousandth more": {"field.bz": "-0.98098 T"}}[believed]
    result = cg.run(
        detector, cg.Gun("mu-", p=1.0, cos_theta=-0.5), N, seed=11,
        fit_detector=detector.with_overrides(wrong), **exact(),
    )  # fmt: skip
    with pytest.raises(AssertionError, match="standard errors"):
        assert_no_bias(result.tracks["pull_kappa"], "kappa")


def test_a_start_at_the_solution_of_a_uniform_field_is_left() -> None:
    """The first iterations take a uniform field; a track that has converged in it has not in the map."""
    result = exact_sample("finite-solenoid", "pi+", 0.5, 0.7)
    hits = (result.clusters, result.wire_hits, result.candidates, result.candidate_hits)
    uniform = result.detector.with_overrides({"field.kind": "uniform"})
    wrong = cg.fit(uniform, *hits)["tracks"]
    start = np.stack([wrong[name] for name in PARAMETERS], axis=1)
    tracks = cg.fit(result.detector, *hits, start=start)["tracks"]
    error = np.sqrt(result.tracks["cov"][:, 2, 2])
    assert np.abs(wrong["kappa"] - result.tracks["kappa"]).min() > 3 * error.max()
    assert np.abs((tracks["kappa"] - result.tracks["kappa"]) / error).max() < 0.1
