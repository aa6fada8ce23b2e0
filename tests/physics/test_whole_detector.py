"""Matter of a whole detector: what merging sub-layers changes, and the fit's angle against the simulated one."""

import math

import numpy as np
import pytest

from cgemit import _core
from cgemit.detector import load, slab_table, slabs
from cgemit.detector.core import layer_table, wire_table
from cgemit.fit_matter import tuned
from cgemit.reconstruction.fit import FitSettings
from stats import assert_within
from tracks import MUON, hits_on


def covariance(core, hits, helix):
    """Return the fit's covariance on a given helix."""
    settings = {
        "max_iterations": 1, "tolerance": 1e9, "errors_from_track": False, "least_width": 0.1, "delta_strips": 0.0,
        "kinks": False, "outlier_pull": 0.0, "momentum": 1.0, "prior_sigma": tuple(FitSettings().prior_sigma),
        "beam": (0.0, 0.0),
    }  # fmt: skip
    out = _core.reconstruction.fit(
        core, hit_offsets=np.array([0, len(hits["kind"])]), hits=hits, mass=np.array([MUON]),
        start=np.atleast_2d(helix), settings=settings, residuals=False,
    )  # fmt: skip
    assert out["status"][0] == _core.common.FitStatus.ok
    return out["cov"][0]


def merging(detector, helix, merged=None):
    """Return the change of the covariance by merging, in units of the errors without."""
    hits = hits_on(detector, helix)
    whole, parts = (covariance(core, hits, helix) for core in (merged or tuned(detector), tuned(detector, merge=False)))
    sigma = np.sqrt(np.diag(parts))
    return (whole - parts) / np.outer(sigma, sigma)


@pytest.mark.parametrize("name", ["besiii-cgem-design", "besiii-cgem", "besiii-idc"])
@pytest.mark.parametrize(("pt", "bound"), [(0.1, 0.01), (0.2, 0.008), (0.5, 0.007), (2.0, 0.002)])
@pytest.mark.parametrize("tanl", [0.0, 0.6, 1.5])
def test_merging_changes_no_covariance_element(name, pt, bound, tanl):
    """Every element of the covariance moves by less than 1 % of the product of errors, 0.2 % for fast tracks."""
    detector = load(name)
    assert np.abs(merging(detector, np.array([0.1, 0.5, -1 / pt, 2.0, tanl]))).max() < bound


def test_the_gate_sees_lost_matter():
    """A merge that loses three per cent of the matter is seen."""
    detector = load("besiii-cgem-design")
    table = slab_table(slabs(detector))
    lossy = _core.detector.Detector(
        bz=-1.0, slabs=table.slabs, log_terms=table.log_terms, layers=layer_table(detector.cgem),
        composition=table.composition | {"moles": 0.97 * table.composition["moles"]},
        wires=wire_table(detector.drift_chamber), screening=_core.matter.Screening.wentzel,
    )  # fmt: skip
    assert np.abs(merging(detector, np.array([0.1, 0.5, -2.0, 2.0, 0.0]), lossy)).max() > 0.007


def part_of_the_matter(screening, gas):
    """Return the chamber gas of the design alone, or all but the gas, as the core has it."""
    detector = load("besiii-cgem-design")
    table = slab_table([slab for slab in slabs(detector) if (slab.shells[0].group == "gas") == gas])
    return _core.detector.Detector(
        bz=-1.0, **table._asdict(), layers=layer_table(detector.cgem), wires=wire_table(detector.drift_chamber),
        screening=getattr(_core.matter.Screening, screening),
    )  # fmt: skip


def core_through(core, p):
    """Return the fit's plane angle behind all slabs at normal incidence, the momentum taken half-way through each."""
    _, xi, total = _core.matter.total_matter(core, 0.0)
    variance, energy = 0.0, math.hypot(p, MUON)
    for slab in range(core.n_slabs):
        before = math.sqrt(energy**2 - MUON**2)
        energy -= _core._testing.core_loss(core, slab, path=1.0, p=before, mass=MUON, charge=-1, track_xi=xi)[0]
        middle = 0.5 * (before + math.sqrt(energy**2 - MUON**2))
        variance += (
            _core.matter.scattering_angle(core, slab, path=1.0, p=middle, mass=MUON, charge=-1, track_chi_c2=total) ** 2
        )
    return math.sqrt(variance)


def truncated_width(sample):
    """Return the width of a Gaussian whose standard deviation within 3 sigma is the sample's."""
    sigma = np.quantile(np.abs(sample), 0.6827)
    for _ in range(30):
        sigma = sample[np.abs(sample) < 3 * sigma].std() / 0.98658
    return sigma


@pytest.mark.parametrize("screening", ["wentzel", "moliere"])
@pytest.mark.parametrize("p", [0.2, 1.0])
@pytest.mark.parametrize("gas", [False, True])
def test_the_fits_angle_is_the_core_of_the_simulated_one(gas, screening, p):
    """Behind gas, or all else, the fit's angle is the half width of 68 % to 1 %, the truncated width to 2 %."""
    core = part_of_the_matter(screening, gas)
    out = _core.simulation.through_slabs(core, p=p, mass=MUON, charge=-1, n=25_000, seed=1)
    angles = np.concatenate([out["angle_1"], out["angle_2"]])
    expected = core_through(core, p)
    error = expected / math.sqrt(len(angles))  # of a quantile and of a width, or a little less
    half_width = np.quantile(np.abs(angles), 0.6827)
    width = truncated_width(angles)
    assert_within(half_width, expected, math.hypot(error, 0.01 / 4 * expected), what="half width of 68 %")
    assert_within(width, expected, math.hypot(error, 0.02 / 4 * expected), what="truncated width")
    # The gate sees three per cent more.
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(half_width, 1.03 * expected, math.hypot(error, 0.01 / 4 * expected))
