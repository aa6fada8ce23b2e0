"""Fits of electrons: momenta and errors describe the core, tracks that radiate hardly anything before the last hit."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

import cgemit as cg
from cgemit.tables.schema import has_momentum
from cores import Core, core_of, mode_of
from stats import assert_within, fraction_error

N = 4000
PULLS = ("dr", "phi0", "kappa", "dz", "tanl")


class Fitted(NamedTuple):
    """Expected relative error of the momentum, ratios of fitted and true momenta, and cores of the pulls."""

    expected: float
    ratio: np.ndarray
    pulls: dict[str, Core]


@cache
def fitted(detector: str, particle: str, p: float, loss: str = "truncated", n: int = N) -> Fitted:
    """Return fits of electrons across the beam."""
    settings = cg.Settings(fit=cg.FitSettings(loss=loss))
    result = cg.run(detector, cg.Gun(particle, p=p, cos_theta=0.0), n, seed=45, settings=settings)
    good = has_momentum(result.tracks)
    expected = cg.analytic(detector, particle, p=p, cos_theta=0.0, fit=settings.fit).sigma("p") * 1e-3 / p
    pulls = {name: core_of(result.matches[f"pull_{name}"][good], 3.0 if name == "kappa" else 2.0) for name in PULLS}
    return Fitted(float(expected), np.asarray(result.tracks["p"][good]) / p, pulls)


def core_is_expected(found: Fitted) -> None:
    """The expected error is that of the core within 3 sigmas, to 4 % beside the statistical error."""
    core = core_of(found.ratio, 3.0)
    assert_within(core.width, found.expected, np.hypot(core.error, 0.0133 * found.expected), 3.0, "core of p")


def mode_is_true(found: Fitted) -> None:
    """The most probable momentum is the true one, within 0.05 % and a quarter of the error."""
    assert abs(mode_of(found.ratio, found.expected) - 1) < min(5e-4, 0.25 * found.expected)


def pulls_are_standard(found: Fitted) -> None:
    """Pulls have cores of width 1 about 0.

    Those of kappa within 3 sigmas, as for other particles; of the others within 2: photons before the first hit turn
    phi0 and d_rho.
    """
    for name, pull in found.pulls.items():
        assert abs(pull.width - 1) < 0.07, name
        assert abs(pull.mean) < 0.12, name


GATES = (core_is_expected, mode_is_true, pulls_are_standard)


@pytest.mark.parametrize("particle", ["e-", "e+"])
@pytest.mark.parametrize(
    ("detector", "p"), [("besiii-cgem", 0.3), ("besiii-cgem", 1.0), ("besiii-idc", 2.0), ("idea-like", 2.0)]
)
@pytest.mark.parametrize("gate", GATES)
def test_the_core_of_electrons(detector, particle, p, gate):
    """With 8000 tracks a width within 2 sigmas has an error of 1.2 %, a sixth of what pulls may be off."""
    gate(fitted(detector, particle, p, n=2 * N if gate is pulls_are_standard else N))


@pytest.mark.parametrize("gate", GATES)
def test_all_radiation_spoils_the_core(gate):
    """A fit that takes mean and variance of all photons passes no gate."""
    with pytest.raises(AssertionError):
        gate(fitted("besiii-cgem", "e-", 1.0, "mean"))


def test_most_electrons_are_near_the_truth():
    """At 1 GeV/c four of five are within 1 %; with the mean loss of all photons one of six is."""
    near = [np.mean(np.abs(fitted("besiii-cgem", "e-", 1.0, loss).ratio - 1) < 0.01) for loss in ("truncated", "mean")]
    assert near[0] > 0.78
    assert near[1] < 0.2


SHARES = np.array([0.03, 0.1, 0.5])


def losses_are_expected(found: Fitted, probability: np.ndarray) -> None:
    """Fractions of momenta that are too small by more than some shares are the expected ones, to 6 %."""
    fraction = np.mean(found.ratio[:, None] < 1 - SHARES, axis=0)
    error = [fraction_error(one, len(found.ratio)) for one in fraction]
    assert_within(fraction, probability, np.hypot(error, 0.02 * probability), 3.0, "loss probability")


def shares_are_expected(found: Fitted, within: np.ndarray) -> None:
    """Fractions of momenta within 1, 2 and 5 % of the truth are the expected ones, to 1 %."""
    fraction = np.mean(np.abs(found.ratio[:, None] - 1) < NEAR, axis=0)
    error = [fraction_error(one, len(found.ratio)) for one in fraction]
    assert_within(fraction, within, np.hypot(error, 0.003), 3.0, "share near the truth")


NEAR = np.array([0.01, 0.02, 0.05])


@pytest.mark.parametrize(
    ("detector", "particle", "p"),
    [("besiii-cgem", "e-", 0.3), ("besiii-cgem", "e+", 1.0), ("besiii-idc", "e-", 1.0), ("idea-like", "e-", 1.0)],
)
def test_tails_are_expected(detector, particle, p):
    """Tails and shares near the truth are those of `Covariance.losses`; with a third more matter both fail."""
    found, losses = fitted(detector, particle, p), cg.analytic(detector, particle, p=p, cos_theta=0.0).losses()
    losses_are_expected(found, losses.loss_probability(SHARES)[0])
    shares_are_expected(found, losses.share_within(NEAR)[0])
    wrong = dataclasses.replace(losses, thickness=1.33 * losses.thickness)
    with pytest.raises(AssertionError, match="standard errors"):
        losses_are_expected(found, wrong.loss_probability(SHARES)[0])
    with pytest.raises(AssertionError, match="standard errors"):
        shares_are_expected(found, wrong.share_within(NEAR)[0])
    everything = dataclasses.replace(losses, unseen=np.ones_like(losses.unseen))
    if detector == "idea-like":  # where half of the matter is seen, or behind all wires
        with pytest.raises(AssertionError, match="standard errors"):
            losses_are_expected(found, everything.loss_probability(SHARES)[0])
