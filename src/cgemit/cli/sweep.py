"""`cgemit sweep`: many variants of a detector, from a plan."""

from __future__ import annotations

import argparse
import json
import signal
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cgemit.cli import options

if TYPE_CHECKING:
    from cgemit.study.sweep.result import Sweep


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add the number of threads or processes."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--threads", type=options.positive, metavar="N",
        help="number of threads (default: all cores); results do not depend on it",
    )  # fmt: skip
    where.add_argument(
        "--processes", type=options.positive, metavar="N", help="processes instead of threads, faster for many designs"
    )


def workers(arguments: argparse.Namespace, stack: ExitStack) -> Executor | int | None:
    """Return the processes that are asked for, which end with `stack`, or the number of threads."""
    if arguments.processes:
        return stack.enter_context(_processes(arguments.processes))
    return arguments.threads  # type: ignore[no-any-return]


@contextmanager
def _processes(workers: int) -> Iterator[Executor]:
    """Yield a pool of processes; Ctrl-C in this one ends them, whatever they are at."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import active_children, get_context

    ignore = (signal.SIGINT, signal.SIG_IGN)
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=signal.signal, initargs=ignore)
    try:
        yield pool
    except KeyboardInterrupt:
        for child in active_children():
            child.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


DESCRIPTION = """\
Evaluate variants of a detector: a grid, a sample or a list of changes of its file, as a plan in TOML says
(docs/how-to/sweeps.md). Writes sweep.csv, one row for each variant, momentum and angle, a picture, and each part of the
results as soon as it is complete: the same command continues after an interruption."""

EXAMPLES = """\
examples:
  cgemit sweep plan.toml -o pitches
  cgemit sweep plan.toml -o pitches --set evaluate.events=500 --set 'vary.cgem.*.pitch_x=["400 um", "600 um"]'
  cgemit sweep plan.toml -o pitches --array-index 3/20     part 3 of 0 to 19 (docs/how-to/many_cores.md)
  cgemit sweep --merge pitches                             the table of all parts

a plan:
  base = "besiii-cgem-design"
  [vary]
  "cgem.*.pitch_x" = ["400 um", "650 um", "900 um"]
  [evaluate]
  p = [0.3, 1.0]"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("plan", nargs="?", metavar="PLAN", help="what is varied and evaluated: a TOML file")
    parser.add_argument("-o", "--output", metavar="DIR", help="folder for the results; one of this plan is continued")
    options.add_overwrite(
        parser, "replace the results in the folder, and compute everything (with --array-index: this part) anew"
    )
    options.add_set(parser, "change one value of the plan, such as evaluate.events=500; may be repeated")
    parser.add_argument(
        "--array-index", type=_part, metavar="I/N",
        help="compute part I (0 to N - 1) of N parts only, and write no table",
    )  # fmt: skip
    parser.add_argument("--merge", metavar="DIR", help="write the table of a folder whose parts are complete")
    parser.add_argument("--json", action="store_true", help="write summary.json to stdout instead of the table")
    add_workers(parser)
    options.add_common(parser)


def _part(text: str) -> tuple[int, int]:
    first, slash, last = text.partition("/")
    if slash and first.isdecimal() and last.isdecimal() and int(first) < int(last):
        return int(first), int(last)
    raise argparse.ArgumentTypeError(f"got {text!r}; expected I/N with I from 0 to N - 1, such as 3/20")


def run(arguments: argparse.Namespace) -> int:
    """Run the sweep, or merge one."""
    from cgemit.chain.run import Output
    from cgemit.study.sweep.plan import read_plan

    file, output = _places(arguments)
    merge = arguments.merge is not None
    plan = read_plan(file, options.plan_changes(arguments.overrides), evaluated=merge)
    with ExitStack() as stack:
        progress = stack.enter_context(options.progress_bar(arguments, "sweep"))
        result = plan.run(
            output=Output(output, overwrite=arguments.overwrite), workers=workers(arguments, stack), compute=not merge,
            part=arguments.array_index, progress=progress, started=None if merge else lambda: plan.write(output),
        )  # fmt: skip
    missing = result.missing()
    if merge and missing:
        raise options.RunFailedError(
            f"{output}: {missing} of {len(plan.arguments['space']) + 1} variants are missing; "
            f"cgemit sweep {Path(output) / 'plan.toml'} -o {output} computes them"
        )
    if arguments.array_index is None:
        _report(result, plan.draw, Path(output), arguments)
    return 0


def _places(arguments: argparse.Namespace) -> tuple[str, str]:
    """Return the plan's file and the folder of the results."""
    problems = []
    if arguments.merge is None:
        problems += ["PLAN: missing, expected a TOML file"] * (arguments.plan is None)
        problems += ["-o: missing, expected a folder for the results"] * (arguments.output is None)
    else:
        arguments_of = {"PLAN": arguments.plan, "-o": arguments.output, "--set": arguments.overrides or None,
                 "--array-index": arguments.array_index, "--overwrite": arguments.overwrite or None}  # fmt: skip
        problems += [
            f"{name}: got one, expected none beside --merge" for name, one in arguments_of.items() if one is not None
        ]
    if problems:
        raise options.InputError("\n  ".join(["wrong input", *problems]) if len(problems) > 1 else problems[0])
    if arguments.merge is None:
        return arguments.plan, arguments.output
    plan = Path(arguments.merge) / "plan.toml"
    if not plan.is_file():
        raise options.InputError(f"--merge: {arguments.merge} holds no plan.toml; expected the folder of a sweep")
    return str(plan), arguments.merge


def _report(result: Sweep, draw: Any, output: Path, arguments: argparse.Namespace) -> None:
    from cgemit.base.files import add_files

    rows = zip(*(result.columns[name] for name in ("variant", "status", "problems")), strict=True)
    varied = [(status, problems) for number, status, problems in rows if number > 0]
    if all(status != "ok" for status, _ in varied):
        reasons = dict.fromkeys(problems for _, problems in varied if problems)
        raise options.RunFailedError("\n  ".join(["no variant could be evaluated", *list(reasons)[:10]]))
    with add_files(output) as place:
        result.draw(draw.quantity, **({"kind": draw.kind} if draw.kind else {})).save(place / "sweep")
    options.say(json.dumps(result.summary(), indent=2) if arguments.json else result)
    options.note(arguments, f"table: {output}/sweep.csv, picture: {output}/sweep.png")
