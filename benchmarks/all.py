"""Renew docs/performance.md from scratch: ``python benchmarks/all.py``, eight minutes on a quiet machine.

Runs the programs of this folder one after the other. What needs a tool that is not there (valgrind, ACTS) says so, and
its numbers stay as they are.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
PROGRAMS = (
    "matrix",
    "design_muon",
    "covariance",
    "stages",
    "memory",
    "simulation",
    "operations",
    "peers",
    "readout",
    "variants",
    "sweep",
    "page",
)


def main() -> int:
    """Run all, and return 1 if one of them failed."""
    failed = []
    for name in PROGRAMS:
        start = time.perf_counter()
        print(f"==> {name}", file=sys.stderr, flush=True)
        if subprocess.run([sys.executable, HERE / f"{name}.py"], check=False).returncode:
            failed.append(name)
        print(f"    {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    if failed:
        print(f"not renewed: {', '.join(failed)}", file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
