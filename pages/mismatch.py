"""docs/methods/alignment.md: results of fits with a wrong description of the detector.

The same hits are fitted twice, by a description that is right and by one that is not; differences are taken track by
track, so that all noise of the hits cancels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import cgemit as cg
from cgemit.tables.schema import has_momentum
from pages.page import Found, Numbers, Page, sample, share_of, table

EVENTS, PARTICLES = 10_000, ("mu-", "mu+")
DETECTOR, SEED, SHIFT = "besiii-cgem-design", 21, 0.05  # mm
#: Quantity, heading, factor to the unit of the heading.
QUANTITIES = (
    ("p", "p (MeV/c)", 1e3),
    ("dr", "d_rho (µm)", 1e3),
    ("dz", "d_z (µm)", 1e3),
    ("phi0", "phi_0 (mrad)", 1e3),
)


@dataclass(frozen=True)
class Effect:
    """A wrong description: mean changes in the units of `QUANTITIES`, of widths in %, chi2/ndf of both fits."""

    particle: str
    title: str
    p: float
    p_error: float
    dr: float
    dr_error: float
    dz: float
    dz_error: float
    phi0: float
    phi0_error: float
    width_p: float
    width_dr: float
    chi2_right: float
    chi2_wrong: float


@dataclass(frozen=True)
class Case:
    """A detector, and what the fit believes of it."""

    title: str
    flown: cg.Detector
    believed: cg.Detector


def cases() -> list[Case]:
    """Return all mistakes of the table, in its order."""
    truth = cg.load(DETECTOR)

    def mistaken(title: str, overrides: Mapping[str, Any]) -> Case:
        return Case(title, truth, truth.with_overrides(dict(overrides)))

    found = [mistaken("field 0.1 % too strong", {"field.bz": "-1.001 T"})]
    for layer in truth.cgem:
        turned = math.degrees(layer.phi_first + SHIFT / layer.r_readout)
        found.append(mistaken(f"{layer.label} turned by 50 µm", {f"cgem.{layer.label}.phi_first": f"{turned!r} deg"}))
    for layer in truth.cgem:
        # V counts from an end of the sheet: a longer one, with the same strips, is one whose end lies farther out.
        farther = {
            "length": f"{layer.length + 2 * SHIFT!r} mm",
            "strips_x": layer.strips_x,
            "strips_v": layer.strips_v,
            "stereo": f"{math.degrees(layer.stereo)!r} deg",
        }
        overrides = {f"cgem.{layer.label}.{name}": value for name, value in farther.items()}
        end = "+z" if layer.stereo > 0 else "-z"
        found.append(mistaken(f"{layer.label} shifted by 50 µm to {end}", overrides))
    found.append(mistaken("no beam pipe", {"remove": ["beam_pipe"]}))
    for name in ("besiii", "finite-solenoid"):
        uneven = truth.with_field(name)
        found.append(Case(f"`{name}` is uniform", uneven, uneven.with_overrides({"field.kind": "uniform"})))
    return found


def effect(case: Case, particle: str, events: int) -> Effect:
    """Fit the same tracks with both descriptions."""
    gun = cg.Gun(particle, p=1.0, cos_theta=(-0.6, 0.6))
    right, wrong = (
        cg.run(case.flown, gun, events, SEED, fit_detector=believed).tracks for believed in (case.flown, case.believed)
    )
    both = has_momentum(right) & has_momentum(wrong)
    numbers = {}
    for name, _, scale in QUANTITIES:
        change = np.asarray(wrong[f"res_{name}"] - right[f"res_{name}"])[both] * scale
        numbers |= {name: float(np.median(change)), f"{name}_error": _median_error(change)}
    for name in ("p", "dr"):
        widths = [cg.resolution(tracks[both], name).core for tracks in (right, wrong)]
        numbers[f"width_{name}"] = 100 * (widths[1] / widths[0] - 1)
    for name, tracks in (("right", right), ("wrong", wrong)):
        numbers[f"chi2_{name}"] = float(np.median(tracks["chi2"][both] / tracks["ndf"][both]))
    return Effect(particle, case.title, **numbers)


def _median_error(values: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    """Return the standard error of a median, from the half-width that holds 68 %."""
    low, high = np.quantile(values, [0.1587, 0.8413])
    return float(1.2533 * (high - low) / 2 / math.sqrt(len(values)))


def measure(share: float) -> Numbers:
    """Measure every mistake with both charges."""
    events = share_of(EVENTS, share, 200)
    rows = [effect(case, particle, events) for particle in PARTICLES for case in cases()]
    return Numbers(rows, {"events": f"{events:,} tracks of each charge, seed {SEED}"})


def blocks(found: Found) -> dict[str, str]:
    """Return the table of negative muons with a wrong field or wrong matter, and what was run."""
    head = ["the fit assumes", *(heading for name, heading, _ in QUANTITIES if name != "phi0"), "width of p"]
    lines = []
    for row in found["effects"].rows:
        if row.particle != PARTICLES[0] or " by " in row.title:  # displaced layers: pages/alignment.py shows more
            continue
        changes = [f"{change:+.2f}" for change in (row.p, row.dr, row.dz)]
        lines.append([row.title, *changes, f"{row.width_p:+.1f} %"])
    return {"sample": sample(found["effects"]), PARTICLES[0]: table(head, lines)}


PAGE = Page("mismatch", "docs/methods/alignment.md", "1 min", {"effects": (Effect, measure)}, blocks)
