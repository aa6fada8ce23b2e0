"""Memory per track of the whole chain: ``python benchmarks/memory.py``.

The peak of a process that runs 40 000 muons, less that of one that runs 10 000, per muon; beside it the bytes of the
tables that it returns. Chunks are joined at the end, so that the tables exist twice for a moment. Writes `memory.csv`.
"""

from __future__ import annotations

import resource
import subprocess
import sys

from bench import DETECTOR, GUN, SEED
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.reconstruction.fit import FitSettings
from rows import write_rows

COUNTS = (10_000, 40_000)
CASES = {"tables of all stages": False, "and residuals of all hits": True}


def table_bytes(events: int, residuals: bool) -> int:
    """Run the chain and return the bytes of its tables."""
    result = run(DETECTOR, GUN, events, SEED, settings=Settings(fit=FitSettings(residuals=residuals)), threads=1)
    return sum(column.nbytes for table in result.tables.values() for column in table.columns.values())


def measured(events: int, residuals: bool) -> tuple[int, int]:
    """Return peak and table bytes of a process of its own."""
    done = subprocess.run(
        [sys.executable, __file__, "--run", str(events), str(int(residuals))],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    peak, tables = map(int, done.stdout.split())
    return peak, tables


def main() -> int:
    """Measure, write and print."""
    rows = []
    for case, residuals in CASES.items():
        (peak, tables), (higher, larger) = (measured(count, residuals) for count in COUNTS)
        more = COUNTS[1] - COUNTS[0]
        rows.append(
            {"case": case, "tables_bytes": round((larger - tables) / more), "peak_bytes": round((higher - peak) / more)}
        )
    write_rows("memory.csv", rows)
    for row in rows:
        print("{case}: {tables_bytes:,} bytes of tables per muon, {peak_bytes:,} at the peak".format(**row))
    return 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--run"]:
        tables = table_bytes(int(sys.argv[2]), sys.argv[3] == "1")
        # ru_maxrss is in KiB on Linux, in bytes on macOS.
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024), tables)
    else:
        sys.exit(main())
