"""Time of the analog read-outs against the number of ionization electrons: writes readout.csv.

The same muons have 1, 2, 4 ... times as many electrons at every step. Digitization and clustering are timed together in
processor time, one thread; the smallest of some repeats counts.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import cgemit as cg
from cgemit import isa
from cgemit.detector.readouts import Apv25Readout, Readout, TigerReadout
from cgemit.simulation.digitize import digitizer_of
from cgemit.tables import Table
from rows import write_rows

MUONS, SEED, REPEATS = 500, 5, 7
FACTORS = (1, 2, 4, 8)


def muons(n: int = MUONS) -> cg.Result:
    """Return muons of 1 GeV/c with their ionization clusters."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
    return cg.run("besiii-cgem-design", gun, n, SEED, readout="tiger", until="simulate", threads=1)


def with_electrons(steps: Table, factor: int) -> Table:
    """Return the steps with so many times the electrons."""
    return steps.with_columns(n_electrons=(factor * steps["n_electrons"]).astype(steps["n_electrons"].dtype))


def seconds(result: cg.Result, readout: Readout, steps: Table) -> float:
    """Return the processor time of digitization and clustering."""
    best = float("inf")
    for _ in range(REPEATS):
        start = time.process_time()
        digis = digitizer_of(readout).digitize(result.detector, result.truths, steps, SEED)
        cg.cluster(result.detector, digis, readout=readout)
        best = min(best, time.process_time() - start)
    return best


def main() -> None:
    """Measure, and write a row for each instruction set and read-out."""
    result = muons()
    rows: list[dict[str, Any]] = []
    for name in isa.available():
        isa.use(name)
        for readout in (TigerReadout(), Apv25Readout()):
            steps = [with_electrons(result.steps, factor) for factor in FACTORS]
            electrons = np.array([table["n_electrons"].sum() for table in steps]) / MUONS
            us = np.array([1e6 * seconds(result, readout, table) / MUONS for table in steps])
            slope, rest = np.polyfit(electrons, us, 1)
            off = np.max(np.abs(us / (rest + slope * electrons) - 1))
            times = {f"{n:.0f} electrons": f"{value:.1f}" for n, value in zip(electrons, us, strict=True)}
            rows.append(
                {"isa": name, "readout": readout.name} | times
                | {"us per electron": f"{slope:.3f}", "us without": f"{rest:.1f}", "from a line": f"{100 * off:.1f} %"}
            )  # fmt: skip
            print(*rows[-1].values(), flush=True)
    write_rows("readout.csv", rows)


if __name__ == "__main__":
    main()
