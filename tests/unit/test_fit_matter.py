"""What the fit assumes of matter and momenta: from one muon, never of a detector that is only compiled."""

from __future__ import annotations

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.detector import compiled
from cgemit.fit_matter import MOST_MOMENTUM_ERROR, tuned, unseen_cut, usual_momentum_error, with_hits_of
from cgemit.simulation.transport import core_arguments
from slabs import ELECTRON

DESIGN = cg.load("besiii-cgem-design")
ACTING = np.full(compiled(DESIGN).n_slabs, np.inf)


def simulated(
    core: _core.detector.Detector, fluctuations: cg.simulation.transport.Fluctuations
) -> dict[str, np.ndarray]:
    """Return the crossings of some muons."""
    particles = cg.run(DESIGN, cg.Gun("mu-", p=(0.1, 1.0), cos_theta=(-0.9, 0.9)), n=20, seed=5).particles
    settings = cg.SimulateSettings(fluctuations=fluctuations)
    found: dict[str, np.ndarray] = _core.simulation.simulate(
        **core_arguments(DESIGN, particles, settings, 5) | {"detector": core}
    )["truths"]
    return found


def test_a_compiled_detector_assumes_nothing_whatever_was_tuned_before() -> None:
    for gaps in (True, False):
        assert np.array_equal(compiled(DESIGN, gaps=gaps).acting, ACTING)
    variant = tuned(DESIGN.with_overrides({"cgem.L2.pitch_x": "500 um"}))
    before = tuned(DESIGN).acting
    assert np.all(np.isfinite(before))
    with_hits_of(tuned(DESIGN), variant, DESIGN.layers)
    for gaps in (True, False):
        assert np.array_equal(compiled(DESIGN, gaps=gaps).acting, ACTING)
    assert tuned(DESIGN).acting.tobytes() == before.tobytes()


def test_a_detector_is_tuned_once_for_each_choice() -> None:
    assert tuned(DESIGN) is tuned(DESIGN)
    assert tuned(DESIGN) is tuned(DESIGN, momentum_error=None)
    assert tuned(DESIGN) is not tuned(DESIGN, loss="mean")


def test_without_matter_nothing_acts_and_nothing_is_lost() -> None:
    core = tuned(DESIGN, matter=False)
    assert np.array_equal(core.acting, ACTING)
    assert _core.matter.total_matter(core, 0.0)[:2] == (0.0, 0.0)


def test_only_noise_like_the_fits_depends_on_what_the_fit_assumes() -> None:
    """With full fluctuations every scatter and collision is drawn, and the fit's assumptions change no bit."""
    assumed = compiled(DESIGN).with_acting(0.01 * tuned(DESIGN).acting)
    assumed = assumed.with_loss(loss=_core.matter.CoreLoss.mean, radiation=False, momentum_error=0.1)
    for fluctuations, same in (("full", True), ("gaussian", False), ("off", False)):
        usual, other = (simulated(core, fluctuations) for core in (compiled(DESIGN), assumed))
        assert all(np.array_equal(usual[name], other[name]) for name in usual) == same, fluctuations


@pytest.mark.parametrize("fluctuations", ["full", "gaussian", "off"])
def test_the_simulation_takes_the_fits_noise(fluctuations: cg.simulation.transport.Fluctuations) -> None:
    settings = cg.SimulateSettings(fluctuations=fluctuations)
    particles = cg.run(DESIGN, cg.Gun("mu-", p=1.0, cos_theta=0.0), n=1).particles
    core = core_arguments(DESIGN, particles, settings, 1)["detector"]
    assert core is (compiled(DESIGN) if fluctuations == "full" else tuned(DESIGN))


@pytest.mark.parametrize("name", ["besiii-cgem", "cepc-like"])
def test_the_momentum_error_is_that_of_a_muon_of_1_gev_at_most_three_per_mille(name: str) -> None:
    """By the budget of the same muon without straggling, with the fit's own priors and hit errors, within 3 %."""
    detector = cg.load(name)
    budget = cg.analytic(detector, "mu-", p=1.0, cos_theta=0.0).budget("kappa")
    expected = float(np.sqrt(budget.total - budget.grouped("cause")["straggling"]))
    assert (expected > MOST_MOMENTUM_ERROR) == (name == "besiii-cgem")
    assert usual_momentum_error(detector) == pytest.approx(min(expected, 0.003), rel=0.03)


@pytest.mark.parametrize("error", [-0.1, 1.5, np.nan])
def test_impossible_momentum_errors_are_refused(error: float) -> None:
    with pytest.raises(ValueError, match=r"loss momentum_error: got"):
        compiled(DESIGN).with_loss(loss=_core.matter.CoreLoss.truncated, radiation=True, momentum_error=error)


def test_the_loss_is_that_of_the_choice() -> None:
    """Electrons lose more on average with radiation; a larger momentum error lets harder collisions count."""

    def loss(core: _core.detector.Detector) -> float:
        given = {"path": 1.0, "p": 1.0, "mass": ELECTRON, "charge": -1, "track_xi": 1e-6}
        found: float = _core._testing.core_loss(core, 0, **given)[0]
        return found

    assert loss(tuned(DESIGN)) > loss(tuned(DESIGN, radiation=False))
    small, large = (loss(tuned(DESIGN, radiation=False, momentum_error=error)) for error in (0.001, 0.1))
    assert small < loss(tuned(DESIGN, radiation=False)) < large


@pytest.mark.parametrize("mass", [ELECTRON, 0.1056583755])
def test_the_cut_of_a_slab_is_scaled_by_what_the_fit_does_not_see(mass: float) -> None:
    """A slab that is half seen has the cut of twice the loss: its variance doubles, and its sum counts by halves."""
    whole = compiled(DESIGN).with_loss(loss=_core.matter.CoreLoss.truncated, radiation=False, momentum_error=0.003)
    half = whole.with_unseen(np.full(whole.n_slabs, 0.5))
    assert _core.matter.total_matter(half, 0.0)[1] == pytest.approx(
        0.5 * _core.matter.total_matter(whole, 0.0)[1], rel=1e-12
    )
    xi = _core.matter.total_matter(whole, 0.0)[1]
    given = {"path": 1.0, "p": 0.8, "mass": mass, "charge": -1.0, "track_xi": xi}
    one, two = (np.array(_core._testing.core_loss(core, 3, **given)) for core in (whole, half))
    assert two[1] / one[1] == pytest.approx(2, rel=0.3 if mass > ELECTRON else 1e-9)  # W_max of muons is near
    assert two[0] > one[0]
    none = whole.with_unseen(np.zeros(whole.n_slabs))
    assert np.array_equal(_core._testing.core_loss(none, 3, **given), one)


def test_matter_behind_the_last_measurement_acts_on_nothing() -> None:
    """Shares fall from 1 at the beam pipe to 0 behind the last wires."""
    coil = DESIGN.with_overrides(
        {"walls.coil": {"r_in": "900 mm", "r_out": "950 mm", "half_length": "2500 mm", "material": "Cu"}}
    )
    shares, plain = tuned(coil).unseen, tuned(DESIGN).unseen
    assert shares[0] == pytest.approx(1, abs=0.01)
    assert shares[-1] == 0
    np.testing.assert_allclose(shares[: len(plain) - 1], plain[:-1], atol=2e-4)  # then gas that is cut otherwise
    assert _core.matter.total_matter(tuned(coil), 0.0)[1] == pytest.approx(
        _core.matter.total_matter(tuned(DESIGN), 0.0)[1], rel=1e-5
    )
    assert _core.matter.total_matter(compiled(coil), 0.0)[1] > 2 * _core.matter.total_matter(compiled(DESIGN), 0.0)[1]


def test_electrons_have_the_error_of_their_momentum() -> None:
    """The cut is that of 7/3 of the relative error without straggling, by hits and scattering, and 5 xi."""
    for p, cosine in ((0.5, 0.0), (1.0, 0.0), (2.0, 0.6)):
        budget = cg.analytic(DESIGN, "e-", p=p, cos_theta=cosine).budget("p")
        error = 1e-3 / p * float(np.sqrt(budget.total - budget.grouped("cause")["straggling"]))
        tanl = cosine / np.sqrt(1 - cosine**2)
        xi = _core.matter.total_matter(tuned(DESIGN), tanl)[1]
        found = unseen_cut(DESIGN, "wentzel", True, None, p, tanl)
        assert found == pytest.approx(7 / 3 * error + 5 * xi / p, rel=0.12)  # one muon tells all
    assert unseen_cut(DESIGN, "wentzel", True, 0.01, 1.0, 0.0) == pytest.approx(0.07 / 3 + 5 * xi / 1.25, rel=0.02)
