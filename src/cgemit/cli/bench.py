"""`cgemit bench`: wall time of each stage per track."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any

from cgemit.cli.options import HelpFormatter, add_common, positive

_DESCRIPTION = """\
Microseconds per track of each stage: mu- of 1 GeV/c, cos(theta) uniform in +-0.93, in besiii-cgem-design (CGEM and
outer drift chamber). The fit includes the smoother. The fastest of several runs counts; with several threads, wall time
divided by the tracks of all of them. Kernel: the compiled core alone, on prepared arrays; its fit starts from a given
helix and makes two iterations where the sides are known."""

_EXAMPLES = """\
examples:
  cgemit bench
  cgemit bench --isa all --threads 1 2
  cgemit bench --json > cost.json         {isa, threads, simulate_us, digitize_us, cluster_us, fit_us, fit_lr_us, ...};
                                          a list of these for several instruction sets or numbers of threads"""

_TEXT = {
    "simulate_us": "simulation",
    "digitize_us": "digitization",
    "cluster_us": "clusters",
    "find_us": "hits assigned by truth",
    "fit_us": "fit, sides of wires known",
    "fit_lr_us": "fit, sides of wires unknown",
    "simulate_kernel_us": "kernel: simulation",
    "fit_kernel_us": "kernel: fit, sides known",
    "fit_lr_kernel_us": "kernel: fit, sides unknown",
}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command."""
    from cgemit.base.isa import available

    parser = subparsers.add_parser(
        "bench", help="time each stage per track", description=_DESCRIPTION, epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "-n", "--events", type=positive, default=2000, metavar="N", help="tracks of each thread and run (default 2000)"
    )
    parser.add_argument(
        "--threads", type=positive, nargs="+", default=[1], metavar="N", help="threads at the same time (default 1)"
    )
    parser.add_argument("--repeat", type=positive, default=5, metavar="N", help="runs of each stage (default 5)")
    parser.add_argument(
        "--isa", choices=(*available(), "all"),
        help="instruction set of the kernels (default: the one in use; all: one after the other)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="write the numbers as JSON to stdout")
    add_common(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the benchmark."""
    from cgemit.base.isa import available
    from cgemit.bench import machine, measure

    sets = available() if arguments.isa == "all" else [arguments.isa]
    if not arguments.quiet:
        print(
            f"{machine()}\n{arguments.events:,} tracks a thread, best of {arguments.repeat} runs", file=sys.stderr
        )  # fmt: skip
    costs = [
        measure(events=arguments.events, threads=threads, repeat=arguments.repeat, isa=isa).to_dict()
        for isa in sets
        for threads in arguments.threads
    ]
    if arguments.json:
        print(json.dumps(costs if len(costs) > 1 else costs[0]))
    else:
        print("\n".join(_table(costs)))
    return 0


def _table(costs: Sequence[dict[str, Any]]) -> list[str]:
    """Lines of a table with a column for each run."""
    titles = [f"{cost['isa']}, {cost['threads']} thread{'s' if cost['threads'] > 1 else ''}" for cost in costs]
    width = max(16, *(len(title) + 3 for title in titles))
    lines = [f"{'us per track':<28}" + "".join(f"{title:>{width}}" for title in titles)]
    return lines + [
        f"{text:<28}" + "".join(f"{cost[name]:{width}.2f}" for cost in costs) for name, text in _TEXT.items()
    ]
