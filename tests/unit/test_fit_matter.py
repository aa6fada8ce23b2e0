"""What the fit assumes of matter and momenta: from one muon, never of a detector that is only compiled."""

from __future__ import annotations

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.detector import compiled
from cgemit.fit_matter import momentum_error, tuned
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
    before = tuned(DESIGN).acting
    assert np.all(np.isfinite(before))
    tuned(DESIGN.with_overrides({"cgem.L2.pitch_x": "500 um"}), hits_of=DESIGN)
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
    assumed = _core._testing.with_acting(compiled(DESIGN), 0.01 * tuned(DESIGN).acting)
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


#: Momenta and angles, those of curling tracks and beside the chamber's ends included.
ERRORS = [
    ("besiii-cgem", "mu-", 1.0, 0.0), ("besiii-cgem", "pi+", 0.17, 0.2), ("besiii-cgem", "proton", 3.0, -0.6),
    ("besiii-cgem", "e-", 0.5, 0.3), ("besiii-cgem", "mu-", 1.0, 0.9), ("cepc-like", "e-", 0.28, -0.13),
    ("cepc-like", "mu-", 0.6, 0.0), ("idea-like", "e+", 1.0, 0.0), ("epic-like", "K-", 2.0, 0.4),
]  # fmt: skip


@pytest.mark.parametrize(("name", "particle", "p", "cos_theta"), ERRORS)
def test_the_momentum_error_is_that_of_the_track(name: str, particle: str, p: float, cos_theta: float) -> None:
    """By the budget of the same track without straggling, to a fifth, or a third where tracks turn back or leave."""
    detector = cg.load(name)
    budget = cg.analytic(detector, particle, p=p, cos_theta=cos_theta).budget("p")
    expected = 1e-3 / p * float(np.sqrt(budget.total - budget.grouped("cause")["straggling"]))
    found = momentum_error(detector, particle, p, cos_theta / np.sqrt(1 - cos_theta**2))
    turns_or_leaves = (name, p) == ("cepc-like", 0.28) or cos_theta == 0.9
    assert found == pytest.approx(expected, rel=0.35 if turns_or_leaves else 0.2)


def test_momentum_errors_grow_with_momentum_and_end_at_ten_percent() -> None:
    """By hits with p, by scattering with 1/beta; beyond the table the same laws hold."""
    one, two = (momentum_error(DESIGN, "mu-", p) for p in (20.0, 10.0))
    assert one == pytest.approx(2 * two, rel=0.01)
    assert momentum_error(DESIGN, "mu-", 1e3) == 0.1
    assert momentum_error(DESIGN, "proton", 0.4) > 1.5 * momentum_error(DESIGN, "mu-", 0.4)
    # A doubly charged particle bends like one of half the momentum.
    assert momentum_error(DESIGN, "alpha", 40.0) == pytest.approx(one, rel=0.01)


@pytest.mark.parametrize("tanl", [0.3, 1.1])
def test_momentum_errors_do_not_depend_on_choices_that_leave_the_track_as_it_is(tanl: float) -> None:
    """The sign of the field, how slabs are merged, hits of the detector itself, and the radius where tracks begin."""
    reversed_field = DESIGN.with_overrides({"field.bz": "1 T"})
    for p in (0.08, 0.13, 0.5, 2.0):

        def error(core: _core.detector.Detector, p: float = p) -> float:
            return _core.matter.momentum_error(core, p=p, mass=0.1056583755, tanl=tanl)

        right = momentum_error(DESIGN, "mu-", p, tanl)
        assert momentum_error(reversed_field, "mu-", p, tanl) == pytest.approx(right, rel=1e-9)
        assert momentum_error(DESIGN, "mu-", p, -tanl) == right
        cores = tuned(DESIGN, merge=False), tuned(DESIGN, hits_of=DESIGN), tuned(DESIGN).beginning_at(40.0)
        assert [error(core) for core in cores] == pytest.approx([right] * 3, rel=1e-9)


def test_momentum_errors_of_unequal_ends_take_the_sign_of_the_slope() -> None:
    """Wires that end at a third on one side: there errors grow; on the other they are those of the whole chamber."""
    for side, sign in (("z_max", 1), ("z_min", -1)):
        cut = DESIGN.with_overrides({f"drift_chamber.layers.*.{side}": "x0.3"})
        short, whole = (momentum_error(cut, "mu-", 1.0, slope * sign) for slope in (1.2, -1.2))
        assert whole == pytest.approx(momentum_error(DESIGN, "mu-", 1.0, 1.2), rel=0.05)
        assert short > 1.5 * whole


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
    half = _core._testing.with_unseen(whole, np.full(whole.n_slabs, 0.5))
    assert _core.matter.total_matter(half, 0.0)[1] == pytest.approx(
        0.5 * _core.matter.total_matter(whole, 0.0)[1], rel=1e-12
    )
    xi = _core.matter.total_matter(whole, 0.0)[1]
    given = {"path": 1.0, "p": 0.8, "mass": mass, "charge": -1.0, "track_xi": xi}
    one, two = (np.array(_core._testing.core_loss(core, 3, **given)) for core in (whole, half))
    assert two[1] / one[1] == pytest.approx(2, rel=0.3 if mass > ELECTRON else 1e-9)  # W_max of muons is near
    assert two[0] > one[0]
    none = _core._testing.with_unseen(whole, np.zeros(whole.n_slabs))
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


@pytest.mark.parametrize(("p", "cos_theta"), [(0.5, 0.0), (1.0, 0.0), (2.0, 0.6)])
def test_electrons_are_cut_at_multiples_of_their_error(p: float, cos_theta: float) -> None:
    """The cut is 2.6 errors, with straggling: of hits and scattering, collisions, and photons below the cut."""
    tanl = cos_theta / np.sqrt(1 - cos_theta**2)
    core = tuned(DESIGN)
    cut = _core.matter.light_cut(core, p=p, mass=ELECTRON, charge=-1.0, tanl=tanl)
    length, xi, _ = _core.matter.total_matter(core, tanl)
    error = momentum_error(DESIGN, "e-", p, tanl)
    photons = 2 / 3 * length * cut**2
    assert 0.05 < photons / error**2 < 0.2
    assert cut == pytest.approx(2.6 * np.sqrt(error**2 + xi / p * cut + photons), rel=1e-3)
    none = core.with_loss(loss=_core.matter.CoreLoss.truncated, radiation=False, momentum_error=error)
    less = _core.matter.light_cut(none, p=p, mass=ELECTRON, charge=-1.0, tanl=tanl)
    assert less == pytest.approx(2.6 * np.sqrt(error**2 + xi / p * less), rel=1e-3)
