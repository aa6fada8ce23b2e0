"""Delta electrons of a drift gap beside Geant4: how far from the track they get, and how many are born there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import cgemit as cg
from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.gas import LARGEST_SIZE, ionization
from geant4_reference import read

MUON, P = 0.1056583755, 1.0  # GeV/c2, GeV/c
#: Everything that can come out of the solids is followed here, as in Geant4 with this range cut and no other.
GATED_CUT = "1 um"
TOLERANCE, SIGMAS = 0.20, 3.0
DISTANCES = (0.2, 0.5, 1.0, 2.0, 5.0)  # mm
THRESHOLDS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # keV
CUTS = ("0.7 mm", "30 um", "1 um", "0.7 mm PAI")
VIEWS = ("r-phi", "z")
ORIGINS = {"all": (0, 1, 2), "gas": (0,), "cathode": (1,), "behind": (2,)}

_REFERENCE_EVENTS = 100_000  # not recorded: assumed
_CHUNK = 100_000


def reference_stack() -> Detector:
    """Return the arrangement of the Geant4 run in layer 0; what lies behind its second foil is as good as nothing."""
    changes: dict[str, object] = {
        "cgem.L1.drift_gap": "5 mm",
        "cgem.L1.transfer_gap": "2 mm",
        "cgem.L1.foils": 2,
        "cgem.L1.induction_gap": "0.1 mm",
        "cgem.L1.anode": [{"material": "CgemGas", "thickness": "0.01 um"}],
    }
    return cg.load("besiii-cgem").with_overrides(changes)


def solid_foils(detector: Detector) -> Detector:
    """Return a detector whose first layer has foils of full density."""
    layers = [
        {"material": material, "thickness": f"{thickness} um"}
        for material, thickness in (("Cu", 5), ("Kapton", 50), ("Cu", 5))
    ]
    return detector.with_overrides({"cgem.L1.foil": layers})


#: What the fractions are measured in: name, and how to make it.
ARRANGEMENTS = {
    "reference": reference_stack,
    "reference, foils without holes": lambda: solid_foils(reference_stack()),
    "whole layer": lambda: cg.load("besiii-cgem"),
}


@dataclass(frozen=True)
class Fraction:
    """Per cent of muons with an electron farther from the track than a distance (mm), beside Geant4's if there is one.

    Attributes
    ----------
    arrangement, view, origin : str
        Key of `ARRANGEMENTS`; r-phi or z; key of `ORIGINS`.
    distance : float, mm
    percent, error : float
        With its standard error.
    reference : float or None
        Per cent in Geant4 with the range cut `GATED_CUT`.
    gated : bool
        Whether the two have to agree, or are shown only.
    """

    arrangement: str
    view: str
    origin: str
    distance: float
    percent: float
    error: float
    reference: float | None
    gated: bool

    @property
    def ratio(self) -> float | None:
        """Number of cgemit over that of Geant4."""
        return None if self.reference is None else self.percent / self.reference

    @property
    def allowed(self) -> float | None:
        """How far the ratio may be from 1: the tolerance and three combined standard errors."""
        if self.reference is None:
            return None
        error = math.sqrt(self.reference * (100 - self.reference) / _REFERENCE_EVENTS)
        return TOLERANCE + SIGMAS * math.hypot(self.error, error) / self.reference

    @property
    def agrees(self) -> bool:
        """Whether the ratio is near enough to 1."""
        return self.ratio is None or self.allowed is None or abs(self.ratio - 1) <= self.allowed


@dataclass(frozen=True)
class Born:
    """Electrons born in the gap per muon above an energy (keV).

    Attributes
    ----------
    energy : float, keV
    number, error : float
        Of cgemit: those that the muon strikes; the error is statistical.
    free : float
        What the muon would strike of free electrons.
    universal, pai : float
        Of Geant4 with two models of the loss: with those that electrons strike.
    """

    energy: float
    number: float
    error: float
    free: float
    universal: float
    pai: float


def measure(detector: Detector, n: int, seed: int, arrangement: str = "reference") -> list[Fraction]:
    """Return the fractions in the first layer of a detector, of muons of 1 GeV/c at normal incidence."""
    core = compiled(detector)
    beyond: dict[tuple[str, str], Any] = {}
    for chunk, first in enumerate(range(0, n, _CHUNK)):
        count = min(_CHUNK, n - first)
        columns = _core._testing.ionize(
            core, 0, p=P, mass=MUON, n=count, seed=seed + chunk, deltas=True, keep_clusters=False
        )
        for key, found in _count(columns, count).items():
            beyond[key] = beyond.get(key, 0) + found
    known = reference_fractions()
    rows = []
    for (view, origin), numbers in beyond.items():
        for distance, number in zip(DISTANCES, numbers, strict=True):
            share = float(number) / n
            error = math.sqrt(max(share, 1 / n) * (1 - share) / n)
            reference = known.get((view, origin, distance))
            gated = arrangement == "reference" and origin == "all"
            rows.append(Fraction(arrangement, view, origin, distance, 100 * share, 100 * error, reference, gated))
    return rows


def reference_fractions(cut: str = GATED_CUT) -> dict[tuple[str, str, float], float]:
    """Return Geant4's per cent with a range cut by view, origin and distance in mm."""
    rows = [row for row in read("deltas.csv") if row["cut"] == cut]
    return {(row["view"], row["origin"], d): float(row[f"mm_{d:g}"]) for row in rows for d in DISTANCES}


def _count(columns: Mapping[str, Any], n: int) -> dict[tuple[str, str], Any]:
    """Return how many of n muons have an electron beyond each distance, by view and origin.

    The tracks go along the x axis: displacements are those along the circle, and along z.
    """
    x, y, z, dx, dy, dz = (columns[f"deposit_{name}"] for name in ("x", "y", "z", "dx", "dy", "dz"))
    ends = [(x + part * dx, y + part * dy, z + part * dz) for part in (-0.5, 0.5)]
    displaced = {
        "r-phi": np.maximum(*(np.abs(np.hypot(a, b) * np.arctan2(b, a)) for a, b, _ in ends)),
        "z": np.maximum(*(np.abs(c) for _, _, c in ends)),
    }
    found = {}
    for view, distance in displaced.items():
        for origin, codes in ORIGINS.items():
            wanted = np.isin(columns["deposit_origin"], codes)
            farthest = np.zeros(n)
            np.maximum.at(farthest, columns["deposit_crossing"][wanted], distance[wanted])
            found[view, origin] = np.array([np.sum(farthest > limit) for limit in DISTANCES])
    return found


def born(n: int, seed: int) -> list[Born]:
    """Return the numbers of electrons born in the gap of the reference arrangement.

    Counted where clusters are drawn from the table of sizes; above it free electrons' spectrum, integrated:
    xi (1/E - 1/W - beta^2/W ln(W/E) + (W - E)/(2 E_total^2)), W the largest transfer (docs/methods/deltas.md).
    """
    detector = reference_stack()
    core, gap = compiled(detector), detector.cgem[0]
    counts = np.zeros(len(THRESHOLDS))
    for chunk, first in enumerate(range(0, n, _CHUNK)):
        count = min(_CHUNK, n - first)
        columns = _core._testing.ionize(
            core, 0, p=P, mass=MUON, n=count, seed=seed + chunk, deltas=False, keep_clusters=True
        )
        energy = columns["deposit_energy"]
        counts += [np.sum(energy > threshold) for threshold in THRESHOLDS]
    seam = (LARGEST_SIZE + 0.5) * ionization("ar-ic4h10-90-10").w_value
    xi = 1e6 * gap.gas.xi(gap.drift_gap)
    rows = []
    reference = {row["model"]: row for row in read("delta_spectrum.csv")}
    for threshold, number in zip(THRESHOLDS, counts, strict=True):
        above = _free(xi, max(threshold, seam))
        known = [float(reference[model][f"kev_{threshold:g}"]) for model in ("universal", "PAI")]
        own = float(number / n + above), float(np.sqrt(number) / n)
        rows.append(Born(threshold, *own, _free(xi, threshold), *known))
    return rows


def _free(xi: float, energy: float) -> float:
    """Return the number of free electrons struck with more than an energy; keV, xi without 1/beta^2."""
    electron, total = 510.99895, 1e6 * math.hypot(P, MUON)
    betagamma, gamma = P / MUON, math.hypot(P, MUON) / MUON
    ratio = electron * 1e-6 / MUON
    largest = 2 * electron * betagamma**2 / (1 + 2 * gamma * ratio + ratio**2)
    beta2 = (betagamma / gamma) ** 2
    spectrum = 1 / energy - 1 / largest - beta2 / largest * math.log(largest / energy)
    return xi / beta2 * (spectrum + 0.5 * (largest - energy) / total**2)


def failures(rows: Sequence[Fraction]) -> list[str]:
    """Return what has to agree and does not, as text."""
    wrong = [row for row in rows if row.gated and not row.agrees]
    return [f"{row.view}, {row.distance:g} mm: {row.ratio:.3f} of Geant4's" for row in wrong]
