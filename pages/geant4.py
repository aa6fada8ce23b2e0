"""The Geant4 numbers of validation/data beside those of cgemit: what is compared, and how far it may be off."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cgemit.simulation.slab import SlabResult

DATA = Path(__file__).resolve().parent / "data"

#: The slabs as `cgemit slab` takes them; the formula has the mass fractions of the epoxy to 0.0005.
_CGEM = "Kapton {} um + Cu {} um + C 2.0 g/cm3 {} um + C52H59O9 1.20 g/cm3 {} um"
SLABS = {
    "C_0.1X0": "C 2.0 g/cm3 213.485 um",
    "Cu_14um": "Cu 14 um",
    "Be_1.4mm": "Be 1.4 mm",
    "Ar_10mm": "Ar 10 mm",
    "HeC3H8_16mm": "He/C3H8 16 mm",
    "CGEM_0.114": _CGEM.format(300, 33, 120, 150),
    "CGEM_0.13": _CGEM.format(*(round(1.1387 * length, 3) for length in (300, 33, 120, 150))),
}
#: What people call them.
TITLES = {
    "C_0.1X0": "C 0.1 % X0",
    "Cu_14um": "Cu 14 um",
    "Be_1.4mm": "Be 1.4 mm",
    "Ar_10mm": "Ar 10 mm",
    "HeC3H8_16mm": "He/C3H8 60/40, 16 mm",
    "CGEM_0.114": "CGEM layer, 0.114 g/cm2",
    "CGEM_0.13": "CGEM layer, 0.130 g/cm2",
}
ANGLES = ("q68_mrad", "q98_mrad", "q999_mrad")
LOSSES = tuple(f"loss_kev_{name}" for name in ("mean", "mode", "fwhm", "q01", "q16", "q50", "q84", "q99"))

_SS_ERRORS = dict(zip(ANGLES, (0.004, 0.008, 0.06), strict=True))  # relative, validation/data/README.md
_GATED_LOSSES = ("C_0.1X0", "Be_1.4mm", "CGEM_0.114", "CGEM_0.13")
_TOLERANCES = {"q68_mrad": 0.05, "q98_mrad": 0.05, "q999_mrad": 0.10, "loss_kev_q50": 0.03, "loss_kev_q99": 0.08}
_SIGMAS = 3.0  # the tail of the angle may be off by so many standard errors, if that is more


@dataclass(frozen=True)
class Comparison:
    """One number of cgemit beside one of a reference.

    Attributes
    ----------
    slab, quantity, model, screening : str
        The slab by its short name; the reference's model; the screening of cgemit.
    p : float, GeV/c
    value, error, reference : float
    reference_error : float or None
        Standard errors; None where the reference's number of events is not known.
    gated : bool
        Whether the two have to agree, or are shown only.
    """

    slab: str
    quantity: str
    model: str
    screening: str
    p: float
    value: float
    error: float
    reference: float
    reference_error: float | None
    gated: bool

    @property
    def ratio(self) -> float:
        """Number of cgemit over that of the reference."""
        return self.value / self.reference

    @property
    def ratio_error(self) -> float:
        """Combined standard error of the ratio."""
        return self.ratio * math.hypot(self.error / self.value, (self.reference_error or 0.0) / self.reference)

    @property
    def allowed(self) -> float:
        """How far the ratio may be from 1: the tolerance, for q999 at least three combined standard errors."""
        if not self.gated:
            return math.inf
        tolerance = _TOLERANCES[self.quantity]
        return max(tolerance, _SIGMAS * self.ratio_error) if self.quantity == "q999_mrad" else tolerance

    @property
    def agrees(self) -> bool:
        """Whether the ratio is near enough to 1."""
        return abs(self.ratio - 1) <= self.allowed


def read(name: str) -> list[dict[str, str]]:
    """Return the rows of a file of validation/data."""
    lines = (DATA / name).read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def references() -> list[tuple[str, Mapping[str, str]]]:
    """Return the rows about slabs with the models they come from."""
    rows = [(row["model"], row) for row in read("scattering.csv")]
    rows += [("WVI", row) for row in read("geant4_wvi.csv")]
    return rows + [("PAI", row) for row in read("geant4_pai.csv")]


def cases() -> list[tuple[str, float]]:
    """Return slabs and momenta with a reference, in the order of `SLABS`."""
    found = {(row["slab"], float(row["p_gev"])) for _, row in references()}
    return sorted(found, key=lambda case: (list(SLABS).index(case[0]), case[1]))


def compare(result: SlabResult, slab: str) -> list[Comparison]:
    """Return the numbers of a simulated slab beside all references for it."""
    found = []
    for model, row in references():
        if row["slab"] == slab and float(row["p_gev"]) == result.p:
            found += _compare_row(result, slab, model, row)
    return found


def _compare_row(result: SlabResult, slab: str, model: str, row: Mapping[str, str]) -> Iterator[Comparison]:
    for name in (*ANGLES, *LOSSES):
        value, error = getattr(result, name), result.errors[name]
        if not row.get(name) or value is None or error is None:
            continue
        reference, events = float(row[name]), row["n"]
        # Of the other models only numbers of events are known: their relative errors are those of cgemit, scaled.
        share = error / value * math.sqrt(result.n / float(events)) if events else None
        if model == "SS":
            share = _SS_ERRORS[name]
        yield Comparison(
            slab=slab, quantity=name, model=model, screening=result.screening, p=result.p, value=value, error=error,
            reference=reference, reference_error=None if share is None else share * reference,
            gated=name in _TOLERANCES and result.screening == "wentzel" and _is_gate(slab, name, model),
        )  # fmt: skip


def _is_gate(slab: str, name: str, model: str) -> bool:
    trusted = "WVI 10 steps" if slab == "HeC3H8_16mm" else "SS"
    return model == trusted if name in ANGLES else model == "WVI" and slab in _GATED_LOSSES
