"""docs/performance.md: time and memory per muon of each stage, on a machine that does nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

import cgemit as cg
from cgemit.detector import slabs
from pages.geant4 import read
from pages.page import Found, Page, table
from pages.performance import designs, electrons, fits, peers, scaling, simulation, stages
from pages.performance.scaling import TIMES, Growth, exponent
from pages.performance.stages import CHAIN, Chain, Cost
from pages.performance.timing import DETECTOR

STAGES = {
    "simulate_us": "simulation", "digitize_us": "digitization", "cluster_us": "clusters",
    "find_us": "hits assigned by truth", "fit_us": "fit, sides known", "fit_lr_us": "fit, sides unknown",
    "simulate_kernel_us": "*kernel*: simulation", "fit_kernel_us": "*kernel*: fit, sides known, two iterations",
    "fit_lr_kernel_us": "*kernel*: fit, sides unknown",
}  # fmt: skip
#: Instruction sets in the tables of the page; the numbers on file have all.
SHOWN = ("scalar", "v4")
COLOURS = ("#999999", "#56B4E9", "#0072B2", "#D55E00", "#009E73", "#CC79A7")


def _stages(rows: Sequence[Cost]) -> str:
    """Return the table of stages, a column for each instruction set and number of threads."""
    head = ["µs per muon", *(f"{row.isa}, {row.threads} thread{'s' * (row.threads != 1)}" for row in rows)]
    return table(head, [[text, *(f"{getattr(row, name):.2f}" for row in rows)] for name, text in STAGES.items()])


def _covariances(rows: Sequence[fits.OneCovariance]) -> str:
    head = ["µs per track", "single track", "track of a point", "gradient / track of a point"]
    head += ["fit, two iterations", "fit / track of a point"]
    return table(head, [[row.isa, f"{row.alone_us:.2f}", f"{row.of_a_point_us:.2f}", f"{row.gradient:.1f}",
                         f"{row.fit_us:.2f}", f"{row.fit_us / row.of_a_point_us:.2f}"] for row in rows])  # fmt: skip


def growths(found: Found) -> dict[str, tuple[list[float], list[float]]]:
    """Return numbers and times, us, of each key of `TIMES`; events from 1000 on, where the first calls do not count."""
    rows: list[Growth] = list(found["scaling"].rows)
    rows += [Growth("events", row.events, row.all) for row in found["chain"].rows if row.events >= 1000]
    return {what: ([row.n for row in rows if row.what == what], [row.us for row in rows if row.what == what])
            for what in TIMES}  # fmt: skip


def _scaling(found: Found) -> str:
    lines = []
    for what, (n, us) in growths(found).items():
        ends = [f"{one:,}: {time:.3g} µs" for one, time in ((n[0], us[0]), (n[-1], us[-1]))]
        lines.append([*TIMES[what], *ends, f"{exponent(n, us)[0]:.2f}"])
    return table(["time", "against", "smallest", "largest", "exponent"], lines)


def _peers(rows: Sequence[peers.Peer]) -> str:
    lines = [[row.what, f"{row.acts_us:.1f}", row.isa, f"{row.us:.2f}", f"{row.acts_us / row.us:.1f}"] for row in rows]
    return table(["", "ACTS, µs", "cgemit with", "cgemit, µs", "ratio"], lines)


def _finding(rows: Sequence[peers.Found]) -> str:
    lines = []
    for row in rows:
        acts, own = row.acts_seeding_us + row.acts_ckf_us, row.find_us + row.fit_us
        lines.append([str(row.tracks), f"{row.acts_seeding_us:.0f}", f"{row.acts_ckf_us:.0f}", f"{row.acts_found:.1%}",
                      f"{row.find_us:.0f}", f"{row.fit_us:.0f}", f"{row.found:.1%}", f"{acts / own:.1f}"])  # fmt: skip
    head = ["muons of the event", "ACTS: seeds, µs", "ACTS: CKF, µs", "ACTS: found", "cgemit: finding, µs",
            "cgemit: fit, µs", "cgemit: found", "ratio"]  # fmt: skip
    return table(head, lines)


def _electrons(rows: Sequence[electrons.Electrons]) -> str:
    """Return the table of the fits of electrons."""
    head = ["GeV/c", "fit", "core, %", "centre, %", "within 1, 2, 5 %", "95 % quantile, %", "in 68 and 95 % limits, %",
            "µs", "over its muons"]  # fmt: skip
    lines = [[f"{row.p:g}", row.program, f"{row.core:.3f} ± {row.core_error:.3f}",
              f"{row.centre:+.2f}".replace("-", "−"),
              f"{row.within_1:.1f}, {row.within_2:.1f}, {row.within_5:.1f}", f"{row.q95:.1f}",
              f"{row.in_68:.1f}, {row.in_95:.1f}", f"{row.us:.3g}", f"{row.us / row.muon_us:.1f}"]
             for row in rows]  # fmt: skip
    return table(head, lines)


def _slow_fits(rows: Sequence[peers.Peer]) -> str:
    """Return the ratios of the fits at 0.3 GeV/c, by instruction set."""
    fits = [row for row in rows if row.case.startswith("0.3 GeV") and row.what.startswith("fit, smoother")]
    return " and ".join(f"{row.acts_us / row.us:.0f} (`{row.isa}`)" for row in fits)


def _cases(rows: Sequence[simulation.CaseCost]) -> str:
    return table(["simulated", "µs per muon"], [[row.case, f"{row.us:.1f}"] for row in rows])


def _second_thread(rows: Sequence[Cost]) -> str:
    """Return by which factors a second thread speeds up the stages: their range and median."""
    costs = {(row.isa, row.threads): row for row in rows}
    gains = [getattr(costs[isa, 1], name) / getattr(row, name)
             for (isa, threads), row in costs.items() if threads == 2 for name in STAGES]  # fmt: skip
    return f"{_range(gains)} (median {np.median(gains):.1f})"


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.1f} to {max(values):.1f}"


def blocks(found: Found) -> dict[str, str]:
    """Return all tables and the numbers of the text."""
    every: dict[str, Sequence[Any]] = {name: numbers.rows for name, numbers in found.items()}
    rows = {name: [row for row in own if getattr(row, "isa", SHOWN[0]) in SHOWN] for name, own in every.items()}
    about = found["stages"].about
    curves = {f"curve-{row.curve.split()[0].strip(',')}": f"{row.ms:.2g}" for row in rows["curves"]}
    sweeps = [f"{row.wall_ms:.1f} ms {'a design ' * (i == 0)}with {row.samples}{' samples' * (i == 0)}"
              for i, row in enumerate(rows["sweeps"])]  # fmt: skip
    return {
        "about": f"{about['machine']}; {about['versions']}.",
        "stages": _stages(rows["stages"]),
        "second-thread": _second_thread(rows["stages"]),
        "covariances": _covariances(rows["covariances"]),
        **curves,
        "variants": _range([row.variant_ms for row in rows["variants"]]),
        "sweeps": f"{', '.join(sweeps[:-1])} and {sweeps[-1]}",
        "scaling": _scaling(found),
        "scatterers": str(len(slabs(cg.load(DETECTOR)))),
        "peers": _peers([row for row in rows["peers"] if row.case.startswith("1 GeV")]),
        "peers-slow": _slow_fits(rows["peers"]),
        "peers-machine": f"{found['peers_finding'].about['machine']}; `{every['peers_finding'][0].isa}`",
        "peers-finding": _finding(every["peers_finding"]),
        "electrons": _electrons(every["electrons"]),
        "electrons-machine": f"{found['electrons'].about['machine']}; `{every['electrons'][-1].isa}`",
        "programs": table(
            ["program", "µs per muon", "what it does"], [list(row.values()) for row in read("programs.csv")]
        ),
        "simulation": _cases(rows["simulation"]),
    }


def draw_stages(found: Found) -> Figure:
    """Draw a group of bars for each stage."""
    rows: Sequence[Cost] = found["stages"].rows
    names = [name for name in STAGES if name != "find_us"]
    figure, axes = plt.subplots(figsize=(9.2, 4.4), dpi=100)
    width = 0.84 / len(rows)
    isas = list(dict.fromkeys(row.isa for row in rows))
    for i, row in enumerate(rows):
        x = np.arange(len(names)) + (i - 0.5 * (len(rows) - 1)) * width
        label = f"{row.isa}, {row.threads} thread{'s' * (row.threads != 1)}"
        colour, alpha = COLOURS[isas.index(row.isa)], 1 if row.threads == 1 else 0.5
        axes.bar(x, [getattr(row, n) for n in names], width * 0.94, color=colour, alpha=alpha, label=label)
    labels = [STAGES[n].replace("*kernel*: ", "kernel:\n").replace(", two iterations", "").replace("t, s", "t,\ns")
              for n in names]  # fmt: skip
    axes.set_xticks(np.arange(len(names)), labels, fontsize=8)
    axes.set(yscale="log", ylabel="µs per muon")
    _plain_numbers(axes)
    axes.grid(axis="y", alpha=0.3)
    axes.legend(ncols=4, frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    figure.tight_layout()
    return figure


def _plain_numbers(axes: Axes) -> None:
    """Label a logarithmic vertical axis with 1, 2, 5, 10 ..."""
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def draw_chain(found: Found) -> Figure:
    """Draw the costs against the number of muons."""
    rows: Sequence[Chain] = found["chain"].rows
    figure, axes = plt.subplots(figsize=(6.4, 4.2), dpi=100)
    for name in (*CHAIN, "all"):
        style: dict[str, Any] = {"color": "black", "lw": 2} if name == "all" else {"lw": 1.3}
        axes.plot([row.events for row in rows], [getattr(row, name) for row in rows], "o-", ms=4, label=name, **style)
    axes.set(xscale="log", yscale="log", xlabel="muons", ylabel="µs per muon, one thread")
    _plain_numbers(axes)
    axes.grid(alpha=0.3)
    axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    figure.tight_layout()
    return figure


def draw_scaling(found: Found) -> Figure:
    """Draw times against tracks and wire layers, with their power laws."""
    figure, axes = plt.subplots(1, 2, figsize=(9.2, 3.8), dpi=100)
    for plot, what, colour in zip(axes, ("tracks", "layers"), COLOURS[2:], strict=False):
        n, us = growths(found)[what]
        power, start = exponent(n, us)
        plot.plot(n, us, "o", color=colour, label="measured")
        plot.plot(
            n, start * np.array(n, float) ** power, color=colour, lw=1.2, label=f"power law, exponent {power:.2f}"
        )
        time, against = TIMES[what]
        plot.set(xscale="log", yscale="log", xlabel=against, ylabel=f"{time}, µs")
        plot.set_xticks(n, [str(one) for one in n])
        plot.xaxis.set_minor_formatter(NullFormatter())
        _plain_numbers(plot)
        plot.grid(alpha=0.3)
        plot.legend(frameon=False)
    figure.tight_layout()
    return figure


PAGE = Page(
    "performance",
    "docs/performance.md",
    "10 min, quiet",
    {
        "stages": (Cost, stages.measure_stages),
        "covariances": (fits.OneCovariance, fits.measure_covariances),
        "curves": (fits.CurveCost, fits.measure_curves),
        "chain": (Chain, stages.measure_chain),
        "scaling": (Growth, scaling.measure),
        "simulation": (simulation.CaseCost, simulation.measure_cases),
        "variants": (designs.VariantCost, designs.measure_variants),
        "sweeps": (designs.SweepCost, designs.measure_sweeps),
        "peers": (peers.Peer, peers.measure),
        "peers_finding": (peers.Found, peers.measure_finding),
        "electrons": (electrons.Electrons, electrons.measure),
    },
    blocks,
    {
        "performance-stages.png": draw_stages,
        "performance-tracks.png": draw_chain,
        "performance-scaling.png": draw_scaling,
    },
)
