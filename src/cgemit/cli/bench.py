"""`cgemit bench`: what each stage costs per track."""

from __future__ import annotations

import argparse
import json
import sys

from cgemit.cli.common import HelpFormatter, add_common, positive

_DESCRIPTION = """\
Microseconds per track of each stage: mu- of 1 GeV/c, cos(theta) uniform in +-0.93, in besiii-cgem-design (CGEM and
outer drift chamber). The fit includes the smoother. The fastest of several runs counts."""

_EXAMPLES = """\
examples:
  cgemit bench
  cgemit bench --json > cost.json         {isa, threads, simulate_us, digitize_us, cluster_us, fit_us, fit_lr_us}
  cgemit bench --threads 2 --events 5000"""

_TEXT = {
    "simulate_us": "simulation",
    "digitize_us": "digitization",
    "cluster_us": "clusters",
    "fit_us": "fit, sides of wires known",
    "fit_lr_us": "fit, sides of wires unknown",
}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command."""
    from cgemit.bench import ISAS

    parser = subparsers.add_parser(
        "bench", help="time each stage per track", description=_DESCRIPTION, epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "--events", type=positive, default=2000, metavar="N", help="tracks of each thread and run (default 2000)"
    )
    parser.add_argument("--threads", type=positive, default=1, metavar="N", help="threads at the same time (default 1)")
    parser.add_argument("--repeat", type=positive, default=5, metavar="N", help="runs of each stage (default 5)")
    parser.add_argument("--isa", choices=ISAS, default=ISAS[0], help="instruction set (only scalar in this version)")
    parser.add_argument("--json", action="store_true", help="write the numbers as JSON to stdout")
    add_common(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the benchmark."""
    from cgemit.bench import machine, measure

    cost = measure(events=arguments.events, threads=arguments.threads, repeat=arguments.repeat).to_dict()
    if not arguments.quiet:
        print(
            f"{machine()}\n{cost['threads']} thread(s), {cost['isa']} code, {arguments.events:,} tracks a thread, "
            f"best of {arguments.repeat} runs",
            file=sys.stderr,
        )
    if arguments.json:
        print(json.dumps(cost))
    else:
        print("\n".join(f"{text:<28}{cost[name]:8.1f} us/track" for name, text in _TEXT.items()))
    return 0
