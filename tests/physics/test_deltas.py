"""Delta electrons displace deposits in a drift gap as Geant4 says, and a wrong field or cathode is seen."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from cgemit import _core
from cgemit.detector import Detector, compiled, load, slabs
from slabs import MUON
from stats import assert_within

N = 100_000
DISTANCES = np.array([0.2, 0.5, 1.0, 2.0, 5.0])  # mm
# Geant4 11.4.1, range cut 1 um, muon of 1 GeV/c at normal incidence through the cathode of L1 as built, 5 mm of
# Ar/iC4H10, foil, 2 mm of gas, foil; 1 T. Per cent of muons with an electron in the gap farther from the track than
# DISTANCES. This cut lets out all that can come out, as here. The number of muons was not kept: 1e5 for its error.
GEANT4 = {"r-phi": [3.30, 2.73, 2.29, 1.73, 0.79], "z": [3.37, 2.75, 2.32, 1.89, 1.34]}
GEANT4_CATHODE = [1.48, 1.43, 1.31, 1.05, 0.47]
GEANT4_N = 100_000
# Electrons born in the gap above 1, 2, 5, 10, 20, 50, 100 keV per muon, knocked on by delta electrons included.
BORN = {1: 0.0879, 2: 0.0416, 5: 0.0157, 10: 0.0075, 20: 0.0036, 50: 0.0014, 100: 0.0007}


@functools.cache
def reference() -> Detector:
    """Return the arrangement of the Geant4 run; what lies behind the second foil is made as good as nothing."""
    return load("besiii-cgem").with_overrides(
        {
            "cgem.L1.drift_gap": "5 mm",
            "cgem.L1.transfer_gap": "2 mm",
            "cgem.L1.foils": 2,
            "cgem.L1.induction_gap": "0.1 mm",
            "cgem.L1.anode": [{"material": "CgemGas", "thickness": "0.01 um"}],
        }
    )


def displaced(detector: Detector, origin: int | None = None, n: int = N, seed: int = 5) -> dict[str, np.ndarray]:
    """Return the per cent of muons of 1 GeV/c with a displaced deposit, (5,) in each direction."""
    found = _core.ionize(compiled(detector), 0, p=1.0, mass=MUON, n=n, seed=seed, deltas=True, keep_clusters=False)
    chosen = slice(None) if origin is None else found["deposit_origin"] == origin
    x, y, z, dx, dy, dz, owner = (
        found[f"deposit_{name}"][chosen] for name in ("x", "y", "z", "dx", "dy", "dz", "crossing")
    )
    per_cent = {}
    ends = [(x + sign * dx / 2, y + sign * dy / 2, z + sign * dz / 2) for sign in (-1, 1)]
    for name, distance in (
        ("r-phi", [np.hypot(a, b) * np.arctan2(b, a) for a, b, _ in ends]),
        ("z", [c for _, _, c in ends]),
    ):
        farthest = np.zeros(n)
        np.maximum.at(farthest, owner, np.max(np.abs(distance), axis=0))
        per_cent[name] = 100 * np.array([np.mean(farthest > limit) for limit in DISTANCES])
    return per_cent


def allowed(expected: list[float]) -> np.ndarray:
    """Return a fifth and three standard errors of both sides, per cent."""
    share = np.array(expected) / 100
    return 100 * (0.2 * share + 3 * np.sqrt(share * (1 - share) * (1 / N + 1 / GEANT4_N)))


def agrees(found: np.ndarray, expected: list[float]) -> bool:
    return bool(np.all(np.abs(found - expected) < allowed(expected)))


def test_displaced_deposits_are_as_frequent_as_in_geant4() -> None:
    found = displaced(reference())
    for direction, expected in GEANT4.items():
        assert agrees(found[direction], expected), (direction, found[direction])


def test_cathode_gives_its_part() -> None:
    found = displaced(reference(), origin=1)["r-phi"]
    assert agrees(found, GEANT4_CATHODE), found


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param({"field.bz": "1 mT"}, id="no field"),
        pytest.param({"cgem.L1.cathode": [{"material": "CgemGas", "thickness": "1 um"}]}, id="no cathode"),
    ],
)
def test_the_gate_sees(wrong: dict[str, object]) -> None:
    found = displaced(reference().with_overrides(wrong))
    assert not all(agrees(found[direction], expected) for direction, expected in GEANT4.items()), found


def test_sign_of_the_field_mirrors() -> None:
    """Electrons fly outward more often than inward, so the field bends most to one side, reversed to the other."""
    means = []
    for bz in ("1 T", "-1 T"):
        core = compiled(reference().with_overrides({"field.bz": bz}))
        found = _core.ionize(core, 0, p=1.0, mass=MUON, n=N, seed=5, deltas=True, keep_clusters=False)
        far = np.abs(found["deposit_y"]) > 0.5
        means.append(np.mean(np.sign(found["deposit_y"][far])))
    assert means[0] * means[1] < 0
    assert abs(means[0] + means[1]) < 0.2 * abs(means[0] - means[1])


def test_electrons_born_in_the_gap() -> None:
    """Numbers above a threshold, next to Geant4's, which count also those that delta electrons knock on.

    Above 52 keV the spectrum is Rutherford's: xi/beta^2 (1/E - 1/W_max ...); below it is HEED's, up to 1.4 times
    Rutherford's between 1 and 5 keV where the argon K shell adds to it.
    """
    n = 100_000
    core = compiled(reference())
    found = _core.ionize(core, 0, p=1.0, mass=MUON, n=n, seed=7, deltas=False, keep_clusters=True)
    energy = found["deposit_energy"]
    xi = 1e6 * reference().cgem[0].gas.xi(5.0) * (1 + MUON**2)
    fast = xi / 51.8
    for threshold, geant4 in BORN.items():
        if threshold > 50:
            continue
        number = np.count_nonzero(energy > threshold) / n + fast
        error = 3 * np.sqrt(number / n)
        assert abs(number - geant4) < 0.2 * geant4 + error, (threshold, number, geant4)
        assert 0.95 * xi / threshold - error < number < 1.45 * xi / threshold + error, (threshold, number)


def test_electrons_that_come_in_nearly_replace_those_that_leave() -> None:
    """The mean deposit is between the mean loss below 30 keV, whose electrons stay near, and Bethe's mean loss."""
    detector = load("besiii-cgem-design")
    core = compiled(detector)
    found = _core.ionize(core, 0, p=1.0, mass=MUON, n=N, seed=3, deltas=True, keep_clusters=False)
    without = _core.ionize(core, 0, p=1.0, mass=MUON, n=N, seed=3, deltas=False, keep_clusters=False)
    (gap,) = (i for i, slab in enumerate(slabs(detector)) if slab.gap == 0)
    restricted, bethe = (
        1e6 * _core.restricted_loss(core, gap, path=1.0, p=1.0, mass=MUON, cut=cut) for cut in (30e-6, 1.0)
    )
    assert restricted < found["energy"].mean() < bethe
    # The usual track has no delta electron: the same, up to one electron of thirty.
    assert np.median(found["energy"]) == pytest.approx(np.median(without["energy"]), rel=0.04)
    # Without what the solids give a fifth of Bethe's loss would be missing.
    solids = found["deposit_energy"][found["deposit_origin"] > 0].sum() / N
    assert found["energy"].mean() - solids < 0.8 * bethe


def test_finer_steps_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """With steps of half the length the fractions agree within 3 % and 3 standard errors."""
    from cgemit.detector import gaps

    usual = displaced(reference(), n=N)
    share = gaps.step_share
    monkeypatch.setattr(gaps, "step_share", lambda energy: 0.5 * share(energy))
    compiled.cache_clear()
    try:
        finer = displaced(reference(), n=N)
    finally:
        compiled.cache_clear()
    for direction, per_cent in usual.items():
        part = per_cent / 100
        error = 100 * np.sqrt(2 * part * (1 - part) / N)
        assert_within(per_cent, finer[direction], error + 0.01 * per_cent, n_sigma=3, what=direction)
