"""`cgemit optimize`: the best designs of a detector, from a plan."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from cgemit.cli import options, sweep

if TYPE_CHECKING:
    from cgemit.study.optimize.result import Optimization


DESCRIPTION = """\
Find the best variants of a detector, as a plan in TOML says (docs/how-to/optimize.md): the best one of one objective,
or the Pareto front of several. Writes optimize.csv, one row for each design, summary.json, optimum.toml and pictures.
The same command continues after an interruption."""

EXAMPLES = """\
examples:
  cgemit optimize plan.toml -o best
  cgemit optimize plan.toml -o best --set search.method=cobyla
  cgemit optimize plan.toml -o best --processes 2 --confirm 20000     simulated tracks of the base and five designs

a plan:
  base = "besiii-cgem-design"
  minimize = "dr @ 0.3 GeV/c"
  [vary]
  "cgem.L2.anode_radius" = { from = "105 mm", to = "155 mm" }
  "cgem.*.pitch_x" = { from = "300 um", to = "1000 um" }
  [constraints]
  channels = { max = 10010 }
  [evaluate]
  p = [0.3, 1.0]"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("plan", metavar="PLAN", help="what is varied, minimized and limited: a TOML file")
    parser.add_argument(
        "-o", "--output", required=True, metavar="DIR", help="folder for the results; one of this plan is continued"
    )
    options.add_overwrite(parser, "replace the results in the folder, and compute everything anew")
    options.add_set(parser, "change one value of the plan, such as search.calls=50; may be repeated")
    parser.add_argument(
        "--confirm",
        type=options.positive,
        metavar="N",
        help="simulate N tracks for the base and up to five best designs",
    )
    parser.add_argument("--json", action="store_true", help="write summary.json to stdout instead of the table")
    sweep.add_workers(parser)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the optimization."""
    from cgemit.chain.run import Output
    from cgemit.study.optimize.run import read_optimize_plan

    plan = read_optimize_plan(arguments.plan, options.plan_changes(arguments.overrides))
    output = Path(arguments.output)
    with ExitStack() as stack:
        progress = stack.enter_context(options.progress_bar(arguments, "optimize"))
        result = plan.run(
            output=Output(output, overwrite=arguments.overwrite), workers=sweep.workers(arguments, stack),
            progress=progress, started=lambda: plan.write(output),
        )  # fmt: skip
    _report(result, output, arguments)
    return 0


def _report(result: Optimization, output: Path, arguments: argparse.Namespace) -> None:
    from cgemit.base.files import add_files

    if not result.front:
        problems = dict.fromkeys(filter(None, result.columns["problems"]))
        raise options.RunFailedError("\n  ".join([result.message, *list(problems)[:10]]))
    kinds = ["convergence", *(["front"] if len(result.objectives) > 1 else []), "parallel"]
    with add_files(output) as temporary:
        for kind in kinds:
            result.draw(kind).save(temporary / kind)
    options.say(json.dumps(result.summary(), indent=2) if arguments.json else result)
    if arguments.confirm:
        confirmation = result.confirm(events=arguments.confirm)
        confirmation.write(output)
        options.say(confirmation, sys.stderr if arguments.json else sys.stdout)
    options.note(arguments, f"table: {output}/optimize.csv, pictures: {', '.join(f'{one}.png' for one in kinds)}")
