"""docs/methods/alignment.md: what a displaced layer or chamber costs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import cgemit as cg
from cgemit.tables.schema import has_momentum
from pages.page import Found, Numbers, Page, share_of, table

PARTS = ("cgem.L1", "cgem.L2", "cgem.L3", "drift_chamber")
SHOWN = ("cgem.L1", "drift_chamber")  # on the page; the numbers on file have all
UNITS = 10  # of the table, in each displacement
NAMES = {"shift_x": "100 um", "shift_z": "100 um", "tilt_x": "1 mrad", "rotation": "1 mrad"}
#: Quantity -> heading, factors from mm, GeV/c and from the units of `resolution` to those of the heading.
QUANTITIES = {"dr": ("d_rho [µm]", 1000, 1), "dz": ("d_z [µm]", 1000, 1000), "p": ("p [MeV/c]", 1000, 1)}
EVENTS = 4000
SETTINGS = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian", deltas=False))


@dataclass(frozen=True)
class Change:
    """Change of a fitted quantity by a unit of displacement: mean, RMS, and the per cent by which it widens."""

    part: str
    key: str
    quantity: str
    mean: float
    rms: float
    lost: float


def fitted(detector: cg.Detector, nominal: cg.Detector, events: int) -> cg.Table:
    """Return the tracks of 1 GeV/c muons in a detector, fitted as if its parts were in place."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    return cg.run(
        detector, gun, events, seed=1, settings=SETTINGS, readout="gaussian", fit_detector=nominal
    ).tracks  # fmt: skip


def changes(events: int) -> Iterator[Change]:
    """Yield the changes by each key of each part."""
    nominal = cg.load("besiii-cgem-design")
    plain = fitted(nominal, nominal, events)
    for part in PARTS:
        for key, size in NAMES.items():
            moved = fitted(nominal.with_overrides({f"{part}.{key}": size}), nominal, events)
            good = has_momentum(plain) & has_momentum(moved)
            for quantity, (_, scale, of_width) in QUANTITIES.items():
                change = scale * (moved[f"res_{quantity}"] - plain[f"res_{quantity}"])[good] / UNITS
                width = cg.resolution(plain, quantity).core * of_width
                lost = 100 * (np.hypot(1, np.std(change) / width) - 1)
                yield Change(part, key, quantity, float(np.mean(change)), float(np.std(change)), float(lost))


def measure(share: float) -> Numbers:
    """Measure all changes."""
    events = share_of(EVENTS, share, 200)
    return Numbers(list(changes(events)), {"events": f"{events} tracks"})


def blocks(found: Found) -> dict[str, str]:
    """Return the table, the number of tracks, and the numbers of the example."""
    head = ["part, key", "unit", *(text for text, _, _ in QUANTITIES.values()), "lost, at most"]
    rows = {(row.part, row.key, row.quantity): row for row in found["changes"].rows}
    lines = []
    for part, key in ((part, key) for part in SHOWN for key in NAMES):
        cells = [rows[part, key, quantity] for quantity in QUANTITIES]
        texts = [f"{row.mean:+.2f}, {row.rms:.2f}" for row in cells]
        lost = _per_cent(max(row.lost for row in cells))
        lines.append([f"`{part}.{key}`", "10 µm" if "shift" in key else "0.1 mrad", *texts, lost])
    across, along = rows["cgem.L1", "shift_x", "dr"], rows["cgem.L1", "shift_z", "dz"]
    variance = (1 + across.lost / 100) ** 2 - 1  # added by one unit, of the width's square
    return {
        "changes": table(head, lines),
        "events": found["changes"].about["events"],
        "shift-x": f"{UNITS * across.rms:.0f}",
        "wider-x": f"{100 * (np.sqrt(1 + UNITS**2 * variance) - 1):.0f}",
        "shift-z": f"{UNITS * along.mean:.0f}",
    }


def _per_cent(lost: float) -> str:
    return f"{lost:.2g} %" if lost >= 0.001 else "< 0.001 %"


PAGE = Page("alignment", "docs/methods/alignment.md", "10 s", {"changes": (Change, measure)}, blocks)
