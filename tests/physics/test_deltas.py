"""Delta electrons displace deposits in a drift gap as Geant4 says, and a wrong field or cathode is seen.

Reference, arrangement and tolerances are those of `python -m pages renew deltas`; here with fewer muons.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from caches import forget
from cgemit import _core
from cgemit.detector import compiled, gas, load, slabs
from pages.deltas import Fraction, born, displaced, failures, reference_stack
from slabs import MUON
from stats import assert_within

N = 100_000


def fractions(**changes: object) -> list[Fraction]:
    """Return the fractions in the arrangement of the Geant4 run, with changes to the detector."""
    return displaced(reference_stack().with_overrides(changes), N, seed=5)


def test_displaced_deposits_are_as_frequent_as_in_geant4() -> None:
    rows = fractions()
    assert sum(row.gated for row in rows) == 10
    assert not failures(rows)


def test_cathode_and_what_is_behind_give_their_parts() -> None:
    """Within the tolerance of the whole, also each by itself."""
    rows = [row for row in fractions() if row.origin in ("cathode", "behind") and row.reference]
    assert len(rows) == 10
    assert not failures([dataclasses.replace(row, gated=True) for row in rows])


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param({"field.bz": "1 mT"}, id="no field"),
        pytest.param({"cgem.L1.cathode": [{"material": "CgemGas", "thickness": "1 um"}]}, id="no cathode"),
    ],
)
def test_the_gate_sees(wrong: dict[str, object]) -> None:
    assert failures(fractions(**wrong))


def test_what_is_behind_the_second_foil_sends_electrons_back() -> None:
    """The whole layer has more of them far from the track, which is why it is not what the gate is about."""
    far = {
        detector: next(row for row in rows if (row.view, row.origin, row.distance) == ("r-phi", "behind", 5.0))
        for detector, rows in (("reference", fractions()), ("whole", displaced(load("besiii-cgem"), N, seed=5)))
    }
    error = np.hypot(far["reference"].error, far["whole"].error)
    assert far["whole"].percent - far["reference"].percent > 4 * error


def test_sign_of_the_field_mirrors() -> None:
    """Electrons fly outward more often than inward, so the field bends most to one side, reversed to the other."""
    means = []
    for bz in ("1 T", "-1 T"):
        core = compiled(reference_stack().with_overrides({"field.bz": bz}))
        found = _core._testing.ionize(core, 0, p=1.0, mass=MUON, n=N, seed=5, deltas=True, keep_clusters=False)
        far = np.abs(found["deposit_y"]) > 0.5
        means.append(np.mean(np.sign(found["deposit_y"][far])))
    assert means[0] * means[1] < 0
    assert abs(means[0] + means[1]) < 0.2 * abs(means[0] - means[1])


def test_electrons_born_in_the_gap() -> None:
    """Below 52 keV they are HEED's, up to 1.45 times as many as free electrons between 1 and 5 keV (argon K shell).

    Geant4 counts also those that delta electrons knock on: a fifth, and three standard errors.
    """
    for row in born(N, seed=7):
        error = 3 * np.sqrt(row.number / N)
        assert abs(row.number - row.universal) < 0.2 * row.universal + error, row
        assert 0.95 * row.free - error < row.number < 1.45 * row.free + error, row


def test_electrons_that_come_in_nearly_replace_those_that_leave() -> None:
    """The mean deposit is between the mean loss below 30 keV, whose electrons stay near, and Bethe's mean loss."""
    detector = load("besiii-cgem-design")
    core = compiled(detector)
    found = _core._testing.ionize(core, 0, p=1.0, mass=MUON, n=N, seed=3, deltas=True, keep_clusters=False)
    without = _core._testing.ionize(core, 0, p=1.0, mass=MUON, n=N, seed=3, deltas=False, keep_clusters=False)
    (gap,) = (i for i, slab in enumerate(slabs(detector)) if slab.gap == 0)
    restricted, bethe = (
        1e6 * _core.matter.restricted_loss(core, gap, path=1.0, p=1.0, mass=MUON, cut=cut) for cut in (30e-6, 1.0)
    )
    assert restricted < found["energy"].mean() < bethe
    # The usual track has no delta electron: the same, up to one electron of thirty.
    assert np.median(found["energy"]) == pytest.approx(np.median(without["energy"]), rel=0.04)
    # Without what the solids give a fifth of Bethe's loss would be missing.
    solids = found["deposit_energy"][found["deposit_origin"] > 0].sum() / N
    assert found["energy"].mean() - solids < 0.8 * bethe


def test_finer_steps_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """With steps of half the length the fractions agree within 3 % and 3 standard errors."""
    usual = [row for row in fractions() if row.gated]
    share = gas.step_share
    monkeypatch.setattr(gas, "step_share", lambda energy: 0.5 * share(energy))
    forget()
    try:
        finer = [row for row in fractions() if row.gated]
    finally:
        forget()
    percent, expected = (np.array([row.percent for row in rows]) for rows in (usual, finer))
    error = np.array([np.hypot(a.error, b.error) for a, b in zip(usual, finer, strict=True)])
    assert_within(percent, expected, error + 0.01 * percent, n_sigma=3, what="fractions")
