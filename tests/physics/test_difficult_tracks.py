"""Tracks with noise, wrong clusters, few layers, low momentum or a displaced vertex are fitted, and fitted well."""

from dataclasses import replace

import numpy as np
import pytest

import stats
from cgemit.reconstruction.fit import FitSettings
from pages.scenarios import SCENARIOS, WITHOUT_DECAYS, run_scenario

pytestmark = pytest.mark.slow

EVENTS = 600
BY_NAME = {scenario.name: scenario for scenario in SCENARIOS}


def outcome(name, **settings):
    """Return the tracks of a scenario."""
    return run_scenario(BY_NAME[name], EVENTS, settings=replace(WITHOUT_DECAYS, fit=FitSettings(**settings)))


@pytest.mark.parametrize(
    "name",
    ["wide", "end plates", "layers missing", "one CGEM layer, outer", "drift chamber only", "CGEM only", "noise",
     "much noise", "wrong cluster", "loopers", "loopers with noise", "muons 0.1 GeV/c", "K_S pions",
     "electrons", "kaons", "protons", "10 GeV/c"],
)  # fmt: skip
def test_are_fitted(name):
    """More than 99 % of the tracks that have six hits of their own with a lever arm."""
    result = outcome(name)
    n = np.count_nonzero(result.enough)
    assert n > 0.9 * EVENTS
    assert result.efficiency > 0.99 - 3 * stats.fraction_error(0.99, n), result.removed


def test_noise_costs_no_resolution():
    """Core widths within 5 % of those of the same tracks without, and errors that are right; not so if noise stays."""
    clean, noisy, blind = outcome("plain"), outcome("noise"), outcome("noise", outlier_pull=0)
    for name in ("p", "dr", "dz"):
        a, b, c = (one.resolution(name) for one in (clean, noisy, blind))
        # Noise is the only difference between the two: the error of the ratio is below that of either.
        assert abs(b.core / a.core - 1) < 0.05, name
        assert c.core / a.core - 1 > 0.05, name
    for name in ("dr", "phi0", "kappa", "dz", "tanl"):
        assert abs(noisy.pull(name).core - 1) < 0.05 + 4 * noisy.pull(name).core_error


def test_slow_particles():
    """Down to pT 50 MeV/c, where muons and pions lose up to half of their energy on the way."""
    assert outcome("slow muons").efficiency > 0.97
    assert outcome("slow pions 65").efficiency > 0.98
    assert outcome("slow pions 50").efficiency > 0.9
    # Told that they are protons, which would not get there, few are.
    assert outcome("slow pions 65", hypothesis="p").efficiency < 0.5
