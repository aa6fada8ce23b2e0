"""Electron transport: rows of the tables, what lies between and beyond, and the way through the gaps of a layer."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from cgemit import load
from cgemit.detector.gas import MAX_B, drift_columns, layer_drift, mean_shift, transport

DESIGN = load("besiii-cgem-design")
ISOBUTANE, CO2 = "ar-ic4h10-90-10", "ar-co2-70-30"


def test_rows_of_the_tables_in_native_units() -> None:
    found = transport(ISOBUTANE, 1.5, -1.0)
    per_root = 1e-3 / math.sqrt(10)  # um/sqrt(cm) in mm/sqrt(mm)
    np.testing.assert_allclose(found, (0.03434, 0.477, 438 * per_root, 406 * per_root, 199 * per_root))
    np.testing.assert_allclose(transport(CO2, 5.0, 0.0)[:2], (0.07587, 0.0))
    assert transport(ISOBUTANE, 1.0, 1.0).tan_lorentz == 0.867  # only tabulated at 1 T


def test_linear_between_and_beyond() -> None:
    """The tangent is linear in B through 0 and 1 T; between two electric fields all is."""
    for b in (0.0, 0.3, 0.9, MAX_B):
        assert transport(ISOBUTANE, 3.0, b).tan_lorentz == pytest.approx(0.186 * b)
        assert transport(ISOBUTANE, 3.0, b).velocity == pytest.approx(1e-3 * (35.07 + b * (34.57 - 35.07)))
    assert transport(ISOBUTANE, 1.75, 1.0).tan_lorentz == pytest.approx(0.5 * (0.477 + 0.314))


@pytest.mark.parametrize(
    ("gas", "e", "b", "message"),
    [
        (ISOBUTANE, 1.5, 1.3, r"magnetic field: got 1.3 T, expected 0 to 1.2 T"),
        (ISOBUTANE, 1.2, 0.5, r"electric field: got 1.2 kV/cm, expected 1.5 to 5 kV/cm.* at 0.5 T"),
        (ISOBUTANE, 0.9, 1.0, r"expected 1 to 5 kV/cm.* at 1 T"),
        (CO2, 0.75, 1.0, r"expected 1.5 to 5 kV/cm"),  # without widths in the table
        (CO2, 5.1, 0.0, r"electric field: got 5.1 kV/cm"),
    ],
)  # fmt: skip
def test_beyond_the_tables_is_an_error(gas: str, e: float, b: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        transport(gas, e, b)


def test_all_problems_of_all_layers_at_once() -> None:
    detector = DESIGN.with_overrides(
        {"cgem.L1.drift_field": "900 V/cm", "cgem.L2.gas": "Ar", "cgem.L3.induction_field": "6 kV/cm"}
    )
    with pytest.raises(ValueError, match="no electron transport") as caught:
        drift_columns(detector)
    for text in (
        "L1.drift_field: electric field: got 0.9",
        "L2.gas: got Ar",
        "L3.induction_field: electric field: got 6",
    ):
        assert f"cgem.{text}" in str(caught.value)


def test_shift_is_the_integral_over_the_radius() -> None:
    """d(phi)/dr = tan(alpha)/r in each gap, straight through the foils."""
    layer = DESIGN.cgem[0]
    drift, foil = layer_drift(layer, 1.0), sum(part.thickness for part in layer.foil)
    radius, turned = layer.r_gap_out, quad(lambda r: 0.477 / r, layer.r_mid, layer.r_gap_out)[0]
    for gap, tangent in ((2.0, 0.186), (2.0, 0.186), (2.0, 0.113)):
        radius += foil
        turned += quad(lambda r, t=tangent: t / r, radius, radius + gap)[0]
        radius += gap
    assert radius == pytest.approx(layer.anode_radius)
    assert mean_shift(layer, 1.0) == pytest.approx(layer.r_readout * turned, rel=1e-12)
    assert drift.delay == pytest.approx(4 / 0.03457)
    assert drift.induction == pytest.approx(2 / 0.0351)


def test_electrons_bend_towards_larger_phi_in_a_field_along_z() -> None:
    """A classical electron with friction in a radial field: m dv/dt = -e (E + v x B) - m v/tau, E inward."""
    v = np.zeros(3)
    for _ in range(1000):
        force = -(np.array([-1.0, 0.0, 0.0]) + np.cross(v, [0.0, 0.0, 0.5])) - v
        v += 2e-2 * force
    assert v[0] > 0
    assert v[1] / v[0] == pytest.approx(0.5, rel=1e-6)
    assert layer_drift(DESIGN.cgem[0], 1.0).tan_lorentz > 0 > layer_drift(DESIGN.cgem[0], -1.0).tan_lorentz


def test_shift_of_the_design_and_of_a_plane() -> None:
    """Published model: 2.20 mm in a plane 5/2/2/2 stack, 2.35, 2.30, 2.27 mm with the radii of the design."""
    shifts = [mean_shift(layer, 1.0) for layer in DESIGN.cgem]
    np.testing.assert_allclose(shifts, (2.35, 2.30, 2.27), atol=0.05)
    plane = DESIGN.with_overrides(
        {"cgem.L3.anode_radius": "1999 mm", "remove": ["walls", "drift_chamber", "cgem.L1", "cgem.L2"]}
    )
    assert mean_shift(plane.cgem[0], 1.0) == pytest.approx(2.20, abs=0.05)
    assert mean_shift(plane.cgem[0], -1.0) == -mean_shift(plane.cgem[0], 1.0)
    wrong = DESIGN.with_overrides({"cgem.L1.transfer_field": "5 kV/cm"})  # the gate can fail
    assert abs(mean_shift(wrong.cgem[0], 1.0) - 2.35) > 0.05
