"""Time of building a variant of a detector beside reading its complete file: writes variants.csv.

The fastest of some repeats counts; the two ways alternate.
"""

from __future__ import annotations

import csv
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import cgemit as cg
from cgemit.detector import Detector, compiled

CHANGES: dict[str, Callable[[int], dict[str, object]]] = {
    "pitch of one layer": lambda i: {"cgem.L2.pitch_x": f"{500 + i} um"},
    "radius of one layer": lambda i: {"cgem.L2.anode_radius": f"{130 + 0.01 * i} mm"},
    "error of all wires": lambda i: {"drift_chamber.sigma": f"{100 + i} um"},
    "gaps of all layers": lambda i: {"cgem.*.drift_gap": f"{3 + 0.01 * i} mm"},
    "foils of all layers": lambda i: {"cgem.*.foil.Kapton.thickness": f"{30 + 0.1 * i} um"},
}
REPEATS = 30


def seconds(work: Callable[[], object]) -> float:
    """Return the wall time of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def complete(variant: Detector) -> object:
    """Read a variant from its file and compile it with everything that the simulation needs."""
    return compiled(cg.load(tomllib.loads(variant.to_toml())))


def rows(base: Detector) -> Iterator[tuple[str, float, float]]:
    """Yield each kind of change with the times of both ways, ms."""
    compiled(base, gaps=False)
    for name, change in CHANGES.items():
        fast, whole = [], []
        for i in range(REPEATS):
            changes = change(i)
            fast.append(seconds(lambda changes=changes: compiled(base.with_overrides(changes), gaps=False)))
            whole.append(seconds(lambda changes=changes: complete(base.with_overrides(changes))))
        yield name, 1000 * min(fast), 1000 * min(whole)


def main() -> None:
    """Write the table."""
    with Path(__file__).with_suffix(".csv").open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["change", "variant (ms)", "file, with gap tables (ms)", "ratio"])
        for name, fast, whole in rows(cg.load("besiii-cgem-design")):
            writer.writerow([name, f"{fast:.2f}", f"{whole:.1f}", f"{whole / fast:.1f}"])


if __name__ == "__main__":
    main()
