"""Scattering and energy loss in slabs against Geant4 (pages/reference), within the tolerances of docs/validation.md.

Reference and tolerances are those of `python -m pages renew geant4`; here with fewer particles.
"""

import dataclasses

import pytest

import cgemit as cg
from cgemit.simulation.slab import SlabResult
from pages.geant4 import ANGLES, SLABS, Comparison, cases, compare, read

N = 100_000


def gates(result: SlabResult, slab: str) -> list[Comparison]:
    return [row for row in compare(result, slab) if row.gated]


def failures(rows: list[Comparison]) -> list[str]:
    return [f"{r.quantity} {r.ratio:.3f} +- {r.ratio_error:.3f}" for r in rows if not r.agrees]


@pytest.mark.parametrize(("slab", "p"), cases())
def test_slabs_agree_with_geant4(slab: str, p: float) -> None:
    rows = gates(cg.slab(SLABS[slab], "mu-", p, N), slab)
    assert not failures(rows)


def test_every_gate_has_its_rows() -> None:
    """Three widths in C, Cu, Ar at 0.2 and 1 GeV/c and Be at 1, one in chamber gas; loss in C, Be, both CGEM layers."""
    rows = [row for slab, p in cases() for row in gates(cg.slab(SLABS[slab], "mu-", p, 2500), slab)]
    angles = [row for row in rows if row.quantity in ANGLES]
    assert len(angles) == 7 * 3 + 2
    assert len(rows) - len(angles) == 4 * 3 * 2


def test_slabs_are_those_of_the_reference() -> None:
    for row in read("geant4_wvi.csv"):
        found = cg.slab(SLABS[row["slab"]], "mu-", 1.0, 1000)
        assert found.mass_gcm2 == pytest.approx(float(row["mass_gcm2"]), rel=1e-3)


@pytest.mark.parametrize("p", [0.2, 1.0])
def test_hydrogen_is_screened_as_in_geant4(p: float) -> None:
    """In the gas of the drift chamber the core agrees within 1.5 %; with a factor 2 for hydrogen it is 2 % narrower."""
    row = next(row for row in gates(cg.slab(SLABS["HeC3H8_16mm"], "mu-", p, 4 * N), "HeC3H8_16mm"))
    assert row.quantity == "q68_mrad"
    assert row.error < 0.002 * row.value
    assert abs(row.ratio - 1) < 0.015


def test_another_screening_fails() -> None:
    for slab in ("C_0.1X0", "Be_1.4mm", "Ar_10mm"):
        wrong = dataclasses.replace(cg.slab(SLABS[slab], "mu-", 1.0, N, screening="moliere"), screening="wentzel")
        assert any(text.startswith("q68") for text in failures(gates(wrong, slab))), slab


def test_a_gaussian_without_tail_fails() -> None:
    found = cg.slab(SLABS["C_0.1X0"], "mu-", 1.0, N)
    wrong = dataclasses.replace(found, q98_mrad=found.q68_mrad, q999_mrad=found.q68_mrad)
    assert {text[:4] for text in failures(gates(wrong, "C_0.1X0"))} == {"q98_", "q999"}


@pytest.mark.parametrize(("density", "quantity"), [(2.2, "loss_kev_q50"), (2.4, "loss_kev_q99")])
def test_another_density_fails(density: float, quantity: str) -> None:
    """Ten per cent more are seen in the median, twenty in the 99 % quantile."""
    wrong = cg.slab(f"C {density} g/cm3 213.485 um", "mu-", 1.0, N)
    assert quantity in {text.split()[0] for text in failures(gates(wrong, "C_0.1X0"))}
