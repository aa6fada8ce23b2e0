"""Instructions and floating-point operations per muon, counted by valgrind (callgrind) and objdump; Linux.

Callgrind counts how often each instruction of the compiled core runs, the disassembly says what it is. Unlike times,
the counts do not depend on what else the machine does. A run that calls a kernel twice more than another leaves the
two calls when the other is subtracted. Valgrind does not know AVX-512: there the operations are those of AVX2.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from cgemit.base.isa import available
from cgemit.detector import load
from pages.page import ROOT, MissingToolError, Numbers
from pages.performance.stages import stage_calls
from pages.performance.timing import DETECTOR, GUN

TRACKS = 128  # whole packs of any width
KERNELS = ("simulate_kernel", "fit_kernel", "fit_lr_kernel")
UNKNOWN_TO_VALGRIND = ("v4",)

Address = tuple[str, int]  # library, offset
ARITHMETIC = re.compile(r"v?(add|sub|mul|div|sqrt)(s|p)d$")
FUSED = re.compile(r"vfn?m(?:add|sub)(?:132|213|231)(s|p)d$")
NAMES = {"add": "add", "sub": "add", "mul": "multiply", "div": "divide", "sqrt": "root"}
WIDTHS = {"xmm": 2, "ymm": 4, "zmm": 8}


@dataclass(frozen=True)
class Counts:
    """Instructions of a kernel per muon, and operations of each kind; of all, fused ones count two."""

    kernel: str
    isa: str
    instructions: int
    add: int
    multiply: int
    fused: int
    divide: int
    root: int
    operations: int


COLUMNS = tuple(Counts.__annotations__)[2:]


def counted(stage: str, isa: str, folder: Path) -> Counter[Address]:
    """Return how often each instruction ran in a process that calls every kernel once, and `stage` twice more."""
    out = folder / f"{isa}-{stage or 'none'}"
    program = f"from pages.performance.operations import calls; calls({stage!r})"
    subprocess.run(
        ["valgrind", "--tool=callgrind", "--dump-instr=yes", f"--callgrind-out-file={out}",
         sys.executable, "-c", program],
        check=True, capture_output=True, cwd=ROOT,
        env={**os.environ, "CGEMIT_ISA": isa, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    return parsed(out.read_text().splitlines())


def calls(stage: str) -> None:
    """Be the program that is counted."""
    kernels = stage_calls(load(DETECTOR), GUN, TRACKS)
    for name in (*KERNELS, *([stage] * 2 if stage else [])):
        kernels[name]()


def parsed(lines: list[str]) -> Counter[Address]:
    """Return the instructions of the core and of the mathematical library from a profile (callgrind format 1)."""
    counts: Counter[Address] = Counter()
    names: dict[str, str] = {}
    library, address, inclusive = "", 0, False
    for line in lines:
        if line.startswith(("ob=", "cob=")):  # a name is spelled out where it comes first
            number, _, name = line.partition("=")[2].partition(" ")
            names.setdefault(number, name)
            library = names[number] if line[0] == "o" else library
        elif line.startswith("calls="):
            inclusive = True  # the next line is what the called function cost
        elif line and line[0] in "0123456789+-*":
            place, _, rest = line.partition(" ")
            address = address if place == "*" else address + int(place, 0) if place[0] in "+-" else int(place, 0)
            if not inclusive and ("cgemit" in library or Path(library).name.startswith("libm.")):
                counts[library, address] += int(rest.split()[1])
            inclusive = False
    return counts


def kinds(library: str) -> dict[int, tuple[str, int]]:
    """Return kind of operation and number of lanes of each arithmetic instruction of a library."""
    found = {}
    for line in disassembly(library).splitlines():
        place, _, rest = line.partition(":")
        name, _, operands = rest.strip().partition(" ")
        match, fused = ARITHMETIC.match(name), FUSED.match(name)
        if not (match or fused):
            continue
        packed = (fused or match).groups()[-1] == "p"
        width = max((WIDTHS[w] for w in WIDTHS if w in operands), default=1) if packed else 1
        found[int(place, 16)] = ("fused" if fused else NAMES[match[1]], width)
    return found


def disassembly(library: str) -> str:
    """Return the instructions of a library, a line each: place, name and operands."""
    command = ["objdump", "-d", "--no-show-raw-insn", library]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def per_track(counts: Counter[Address]) -> dict[str, float]:
    """Return instructions and operations of each kind per muon, for two calls."""
    by_library: dict[str, dict[int, int]] = defaultdict(dict)
    for (library, address), count in counts.items():
        by_library[library][address] = count
    total = dict.fromkeys(COLUMNS, 0.0)
    for library, addresses in by_library.items():
        kind_of = kinds(library)
        for address, count in addresses.items():
            total["instructions"] += count
            if address in kind_of:
                kind, width = kind_of[address]
                total[kind] += count * width
                total["operations"] += count * width * (2 if kind == "fused" else 1)
    return {name: value / (2 * TRACKS) for name, value in total.items()}


def measure(_share: float) -> Numbers:
    """Count the operations of each kernel for each instruction set that valgrind knows."""
    missing = [tool for tool in ("valgrind", "objdump") if shutil.which(tool) is None]
    if missing:
        raise MissingToolError(f"it needs {' and '.join(missing)}")
    sets = [isa for isa in available() if isa not in UNKNOWN_TO_VALGRIND]
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = [(stage, isa) for isa in sets for stage in ("", *KERNELS)]
        profiles = dict(zip(jobs, pool.map(lambda job: counted(*job, Path(name)), jobs), strict=True))
        rows = []
        for isa in sets:
            for stage in KERNELS:
                counts = profiles[stage, isa].copy()
                counts.subtract(profiles["", isa])
                rows.append(Counts(stage, isa, **{k: round(v) for k, v in per_track(counts).items()}))
    return Numbers(rows)
