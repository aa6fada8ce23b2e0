"""Write the table of docs/methods/alignment.md: ``python docs/alignment_numbers.py``."""

from __future__ import annotations

import sys

import numpy as np

import cgemit as cg

PARTS = ("cgem.L1", "cgem.L2", "cgem.L3", "drift_chamber")
NAMES = {"shift_x": "100 um", "shift_z": "100 um", "tilt_x": "1 mrad", "rotation": "1 mrad"}  # ten units of the table
QUANTITIES = {"dr": 1000, "dz": 1000, "p": 1000}  # from mm, mm, GeV/c to um, um, MeV/c
PER_UNIT = {"dr": 1, "dz": 1000, "p": 1}  # from the units of `resolution`
EVENTS = 4000
SETTINGS = cg.Settings.from_dict(
    {"simulate": {"fluctuations": "gaussian", "deltas": False}, "digitize": {"readout": "gaussian"}}
)


def fitted(detector: cg.Detector, nominal: cg.Detector, events: int = EVENTS) -> cg.Table:
    """Return the tracks of 1 GeV/c muons in a detector, fitted as if its parts were in place."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    return cg.run(detector, gun, events, seed=1, settings=SETTINGS, fit_detector=nominal).tracks


def rows(events: int = EVENTS) -> list[tuple[str, str, dict[str, tuple[float, float, float]]]]:
    """Return part, key, and for each quantity the mean and RMS change per unit, and the percent of resolution lost."""
    nominal = cg.load("besiii-cgem-design")
    plain, found = fitted(nominal, nominal, events), []
    for part in PARTS:
        for name, size in NAMES.items():
            moved = fitted(nominal.with_overrides({f"{part}.{name}": size}), nominal, events)
            good = (plain["status"] == 0) & (moved["status"] == 0)
            row = {}
            for quantity, scale in QUANTITIES.items():
                change = scale * (moved[f"res_{quantity}"] - plain[f"res_{quantity}"])[good] / 10
                width = cg.resolution(plain, quantity).core * PER_UNIT[quantity]
                lost = 100 * (np.hypot(1, np.std(change) / width) - 1)
                row[quantity] = (float(np.mean(change)), float(np.std(change)), float(lost))
            found.append((part, name, row))
            print(part, name, file=sys.stderr)
    return found


def _percent(lost: float) -> str:
    return f"{lost:.2g} %" if lost >= 0.001 else "< 0.001 %"


def main() -> None:
    """Print the table."""
    print("| part, key | unit | d_rho [um] | lost | d_z [um] | lost | p [MeV/c] | lost |\n" + "| --- " * 8 + "|")
    for part, name, row in rows():
        unit = "10 um" if "shift" in name else "0.1 mrad"
        cells = [f"{mean:+.2f}, {rms:.2f} | {_percent(lost)}" for mean, rms, lost in row.values()]
        print(f"| `{part}.{name}` | {unit} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
