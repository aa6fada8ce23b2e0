"""Time of the read-out of chips against the number of electrons of ionization: writes readout.csv.

The same muons have 1, 2, 4, 8 and 16 times as many electrons at each step. The table holds the least-squares line
a + b n through the times, in proportion to them, and how far the times lie from it.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

import cgemit as cg
from cgemit import isa
from cgemit.tables import Table
from rows import write_rows

MUONS, REPEATS, FACTORS = 400, 7, (1, 2, 4, 8, 16)
READOUTS = (cg.TigerReadout(), cg.Apv25Readout())


def fastest(work: Callable[[], object]) -> float:
    """Return the least processor time of some calls, s."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    """Measure and write the table."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
    result = cg.run("besiii-cgem-design", gun, MUONS, 5, readout="tiger", until="digitize", threads=1)
    more = [scaled(result.steps, factor) for factor in FACTORS]
    electrons = np.array([steps["n_electrons"].sum() for steps in more]) / MUONS
    rows = []
    for code in ("scalar", "v3"):
        isa.use(code)
        for readout in READOUTS:
            micros = [
                1e6 / MUONS * fastest(lambda steps=steps, readout=readout: read(readout, result, steps))
                for steps in more
            ]
            start, slope = np.polynomial.Polynomial.fit(electrons, micros, 1, w=1 / np.array(micros)).convert().coef
            away = np.array(micros) / (start + slope * electrons) - 1
            rows += [
                {"isa": code, "readout": readout.name, "electrons": f"{n:.0f}", "us": f"{t:.1f}",
                 "start_us": f"{start:.1f}", "us_per_electron": f"{slope:.3f}", "from_line_percent": f"{100 * d:.1f}"}
                for n, t, d in zip(electrons, micros, away, strict=True)
            ]  # fmt: skip
    write_rows("readout.csv", rows)


def scaled(steps: Table, factor: int) -> Table:
    """Return steps with more electrons."""
    return steps.with_columns(n_electrons=steps["n_electrons"] * np.int32(factor))


def read(readout: cg.TigerReadout | cg.Apv25Readout, result: cg.Result, steps: Table) -> Table:
    """Read the muons out."""
    return readout.digitize(result.detector, result.truths, steps, 1)


if __name__ == "__main__":
    main()
