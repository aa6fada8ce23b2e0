"""Put the numbers of the benchmarks into docs/performance.md and draw its pictures: ``python benchmarks/page.py``.

Reads the `.csv` files that the other programs of this folder write. What stands between ``<!-- name -->`` and
``<!-- end -->`` is replaced, the words around it stay as they are.
"""

from __future__ import annotations

import csv
import platform
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from bench import machine
from cgemit.base.version import __version__

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "docs" / "performance.md"
IMAGES = PAGE.parent / "images"
Row = Mapping[str, str]

STAGES = {
    "simulate_us": "simulation", "digitize_us": "digitization", "cluster_us": "clusters",
    "find_us": "hits assigned by truth", "fit_us": "fit, sides known", "fit_lr_us": "fit, sides unknown",
    "simulate_kernel_us": "*kernel*: simulation", "fit_kernel_us": "*kernel*: fit, sides known, two iterations",
    "fit_lr_kernel_us": "*kernel*: fit, sides unknown",
}  # fmt: skip
KERNELS = {
    "simulate_kernel": "simulation", "fit_kernel": "fit, sides known", "fit_lr_kernel": "fit, sides unknown"
}  # fmt: skip
SAME_OPERATIONS = {"v4": "v3"}  # what valgrind cannot count
COLOURS = ("#999999", "#56B4E9", "#0072B2", "#D55E00", "#009E73", "#CC79A7")


def read(name: str) -> list[Row]:
    """Return the rows of a file; none if it is not there."""
    path = HERE / f"{name}.csv"
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a table of the page."""
    lines = [list(head), *([str(cell) for cell in row] for row in rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def about() -> str:
    """Return machine and versions."""
    return (
        f"{machine()}, numpy {np.__version__}, {platform.libc_ver()[0]} {platform.libc_ver()[1]}; cgemit {__version__}."
    )


def stages() -> str:
    """Return the table of stages, a column for each instruction set and number of threads, and the gain by threads."""
    runs = read("matrix")
    head = ["us per muon", *(f"{r['isa']}, {r['threads']} thread{'s' * (r['threads'] != '1')}" for r in runs)]
    rows = [[text, *(f"{float(r[name]):.2f}" for r in runs)] for name, text in STAGES.items()]
    single = {r["isa"]: r for r in runs if r["threads"] == "1"}
    gains = [
        [isa, *(f"{float(one[n]) / float(r[n]):.2f}" for n in ("simulate_us", "fit_us", "fit_lr_us", "fit_kernel_us"))]
        for isa, one in single.items()
        for r in runs
        if r["isa"] == isa and r["threads"] == "2"
    ]
    columns = ("simulation", "fit, sides known", "fit, sides unknown", "kernel of the fit")
    return table(head, rows) + "\n\n" + table(["gain by the second thread", *columns], gains)


def design_muon() -> str:
    """Return the table of one fit."""
    head = ["us per fit", "sides known, two iterations", "sides unknown", "ratio"]
    return table(head, ([r["isa"], r["known_us"], r["unknown_us"], r["ratio"]] for r in read("design_muon")))


def tracks() -> str:
    """Return the table of costs against the number of muons."""
    rows = read("stages")
    names = [name for name in rows[0] if name.endswith("(us)") and not name.startswith("product")]
    body = [
        [f"{int(r['events']):,}", *(f"{float(r[n]):.1f}" for n in names),
         f"{float(r['all (us)']) / float(r['product (us)']):.1f}"]
        for r in rows
    ]  # fmt: skip
    return table(["muons", *(n.removesuffix(" (us)") for n in names), "all / product"], body)


def memory() -> str:
    """Return the table of bytes per muon."""
    rows = read("memory")
    return table(
        ["kept", "tables, bytes per muon", "peak of the process, bytes per muon"],
        ((r["case"], f"{int(r['tables_bytes']):,}", f"{int(r['peak_bytes']):,}") for r in rows),
    )


def operations() -> str:
    """Return the table of operations, times and the share of what a core can do."""
    counts = {(r["kernel"], r["isa"]): r for r in read("operations")}
    rows = []
    for kernel, text in KERNELS.items():
        for run in (r for r in read("matrix") if r["threads"] == "1"):
            isa = run["isa"]
            count = counts.get((kernel, isa)) or counts.get((kernel, SAME_OPERATIONS.get(isa, "")))
            if count is None:
                continue
            us, rate = float(run[f"{kernel}_us"]), float(count["operations"]) / float(run[f"{kernel}_us"]) / 1e3
            instructions = f"{int(count['instructions']):,}" if (kernel, isa) in counts else "—"
            slow = int(count["divide"]) + int(count["root"])
            rows.append([text, isa, instructions, f"{int(count['operations']):,}", f"{slow:,}", f"{us:.2f}",
                         f"{rate:.2f}", f"{rate / float(run['limit_gflops']):.1%}"])  # fmt: skip
    head = [
        "kernel",
        "code",
        "instructions",
        "operations",
        "of these / and √",
        "us",
        "operations per ns",
        "of the limit",
    ]
    limit = max((float(r["limit_gflops"]) for r in read("matrix")), default=0.0)
    return f"A product of matrices runs at {limit:.1f} operations per ns on one core.\n\n" + table(head, rows)


def peers() -> str:
    """Return the table of cgemit beside ACTS."""
    rows = read("peers")
    return table(
        ["muons", "what", "ACTS, us", "code", "cgemit, us", "ratio"],
        ((r["case"], r["what"], f"{float(r['acts_us']):.1f}", r["isa"], f"{float(r['us']):.2f}", r["ratio"])
         for r in rows),
    )  # fmt: skip


def simulation() -> str:
    """Return the table of what the parts of the simulation cost."""
    rows = read("simulation")
    return table(
        ["simulated", "us per muon", "in products of matrices"],
        ((r["case"], f"{float(r['us']):.1f}", f"{float(r['products']):.2f}") for r in rows),
    )


def simulation_fields() -> str:
    """Return the table of what the kinds of fields cost the simulation."""
    return table(
        ["code", "field", "us per muon", "over uniform"],
        ((r["isa"], r["field"], f"{float(r['us']):.1f}", r["ratio"]) for r in read("simulation_fields")),
    )


def draw_stages() -> None:
    """Draw a group of bars for each stage."""
    runs = read("matrix")
    names = [name for name in STAGES if name != "find_us"]
    figure, axes = plt.subplots(figsize=(9.2, 4.4))
    width = 0.84 / len(runs)
    isas = list(dict.fromkeys(r["isa"] for r in runs))
    for i, run in enumerate(runs):
        x = np.arange(len(names)) + (i - 0.5 * (len(runs) - 1)) * width
        single = run["threads"] == "1"
        label = f"{run['isa']}, {run['threads']} thread{'' if single else 's'}"
        colour, alpha = COLOURS[isas.index(run["isa"])], 1 if single else 0.5
        axes.bar(x, [float(run[n]) for n in names], width * 0.94, color=colour, alpha=alpha, label=label)
    labels = [STAGES[n].replace("*kernel*: ", "kernel:\n").replace(", two iterations", "").replace("t, s", "t,\ns")
              for n in names]  # fmt: skip
    axes.set_xticks(np.arange(len(names)), labels, fontsize=8)
    axes.set(yscale="log", ylabel="us per muon")
    axes.grid(axis="y", alpha=0.3)
    axes.legend(ncols=4, frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    figure.tight_layout()
    figure.savefig(IMAGES / "performance-stages.png", dpi=100)


def draw_tracks() -> None:
    """Draw the costs against the number of muons."""
    rows = read("stages")
    figure, axes = plt.subplots(figsize=(6.4, 4.2))
    names = [name for name in rows[0] if name.endswith("(us)") and not name.startswith("product")]
    for name in names:
        style = {"color": "black", "lw": 2} if name.startswith("all") else {"lw": 1.3}
        counts, us = ([float(r[key]) for r in rows] for key in ("events", name))
        axes.plot(counts, us, "o-", ms=4, label=name.removesuffix(" (us)"), **style)
    axes.set(xscale="log", yscale="log", xlabel="muons", ylabel="us per muon, one thread")
    axes.grid(alpha=0.3)
    axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    figure.tight_layout()
    figure.savefig(IMAGES / "performance-tracks.png", dpi=100)


def covariance() -> str:
    """Return the table of one covariance beside one fit."""
    head = [
        "us per track",
        "single track",
        "of a point",
        "gradient / of a point",
        "fit, two iterations",
        "fit / of a point",
    ]
    columns = ("isa", "alone_us", "of_a_point_us", "gradient", "fit_us", "fit_over_covariance")
    return table(head, ([r[name] for name in columns] for r in read("covariance")))


def readout() -> str:
    """Return the table of analog read-outs against the number of electrons."""
    rows = read("readout")
    return table(rows[0], (row.values() for row in rows))


BLOCKS = {
    "about": ((), about), "stages": (("matrix",), stages),
    "design_muon": (("design_muon",), design_muon), "covariance": (("covariance",), covariance),
    "tracks": (("stages",), tracks),
    "memory": (("memory",), memory), "operations": (("operations", "matrix"), operations),
    "peers": (("peers",), peers), "simulation": (("simulation",), simulation),
    "simulation_fields": (("simulation_fields",), simulation_fields), "readout": (("readout",), readout),
}  # fmt: skip


def main() -> int:
    """Renew the page and its pictures."""
    text = PAGE.read_text()
    for name, (files, block) in BLOCKS.items():
        missing = [f"{file}.csv" for file in files if not read(file)]
        if missing:
            print(f"{name}: left as it is, there is no {' and no '.join(missing)}", file=sys.stderr)
            continue
        pattern = rf"(<!-- {name} -->\n).*?(<!-- end -->)"
        text, times = re.subn(pattern, lambda m, b=block: f"{m[1]}{b()}\n{m[2]}", text, flags=re.DOTALL)
        if times != 1:
            raise RuntimeError(f"{PAGE.name}: has {times} blocks {name!r}, expected 1")
    PAGE.write_text(text)
    for file, draw in (("matrix", draw_stages), ("stages", draw_tracks)):
        if read(file):
            draw()
    return 0


if __name__ == "__main__":
    sys.exit(main())
