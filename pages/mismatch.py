"""Renew the tables of docs/methods/mismatch.md: ``python docs/mismatch_numbers.py [--events N] [--threads N]``.

The same hits are fitted twice, by a description that is right and by one that is not; differences are taken track by
track, so that all noise of the hits cancels.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import cgemit as cg
from cgemit.tables.show import with_error

PAGE = Path(__file__).resolve().parent / "methods" / "mismatch.md"
DETECTOR, SEED, SHIFT = "besiii-cgem-design", 21, 0.05  # mm
#: Quantity, heading, factor to the unit of the heading.
QUANTITIES = (
    ("p", "p (MeV/c)", 1e3),
    ("dr", "d_rho (um)", 1e3),
    ("dz", "d_z (um)", 1e3),
    ("phi0", "phi_0 (mrad)", 1e3),
)


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
        found.append(mistaken(f"{layer.label} turned by 50 um", {f"cgem.{layer.label}.phi_first": f"{turned!r} deg"}))
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
        found.append(mistaken(f"{layer.label} shifted by 50 um to {end}", overrides))
    found.append(mistaken("no beam pipe", {"remove": ["beam_pipe"]}))
    for name in ("besiii", "finite-solenoid"):
        uneven = truth.with_field(name)
        found.append(Case(f"`{name}` is uniform", uneven, uneven.with_overrides({"field.kind": "uniform"})))
    return found


def row(case: Case, particle: str, events: int, threads: int | None) -> str:
    """Return the line of a table: mean differences, and core widths and pulls of p and d_rho."""
    gun = cg.Gun(particle, p=1.0, cos_theta=(-0.6, 0.6))
    right, wrong = (
        cg.run(case.flown, gun, events, SEED, fit_detector=believed, threads=threads).tracks
        for believed in (case.flown, case.believed)
    )
    both = (right["status"] == cg.FitStatus.ok) & (wrong["status"] == cg.FitStatus.ok)
    cells = [case.title]
    for name, _, scale in QUANTITIES:
        change = np.asarray(wrong[f"res_{name}"] - right[f"res_{name}"])[both] * scale
        cells.append(with_error(float(np.median(change)), _median_error(change)))
    for name in ("p", "dr"):
        widths = [cg.resolution(tracks[both], name).core for tracks in (right, wrong)]
        cells.append(f"{100 * (widths[1] / widths[0] - 1):+.1f} %")
    chi2 = [float(np.median(tracks["chi2"][both] / tracks["ndf"][both])) for tracks in (right, wrong)]
    cells.append(f"{chi2[0]:.3f} → {chi2[1]:.3f}")
    return "| " + " | ".join(cells) + " |"


def _median_error(values: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    """Return the standard error of a median, from the half-width that holds 68 %."""
    low, high = np.quantile(values, [0.1587, 0.8413])
    return float(1.2533 * (high - low) / 2 / math.sqrt(len(values)))


def table(particle: str, events: int, threads: int | None) -> str:
    """Return one table."""
    head = ("the fit assumes", *(heading for _, heading, _ in QUANTITIES), "width of p", "width of d_rho", "chi²/ndf")
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for case in cases():
        lines.append(row(case, particle, events, threads))
        print(lines[-1], flush=True)
    return "\n".join(lines)


def main() -> None:
    """Measure, and write the tables into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=int, default=10_000, help="tracks of each charge")
    parser.add_argument("--threads", type=int, default=None)
    given = parser.parse_args()
    text = PAGE.read_text(encoding="utf-8")
    for particle in ("mu-", "mu+"):
        begin, end = f"<!-- begin {particle} -->\n", f"<!-- end {particle} -->"
        (before, _), (_, after) = text.split(begin), text.split(end)
        text = f"{before}{begin}{table(particle, given.events, given.threads)}\n{end}{after}"
    note = f"{given.events:,} tracks of each charge, seed {SEED}, cgemit {cg.__version__}"
    begin, end = "<!-- begin sample -->", "<!-- end sample -->"
    (before, _), (_, after) = text.split(begin), text.split(end)
    PAGE.write_text(f"{before}{begin}{note}{end}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
