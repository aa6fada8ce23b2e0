"""Where designs are evaluated: options of `cgemit sweep` and `cgemit optimize`."""

from __future__ import annotations

import argparse
from concurrent.futures import Executor
from contextlib import ExitStack

from cgemit.cli import read


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add the number of threads or processes."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--threads", type=read.positive, metavar="N",
        help="number of threads (default: all cores); results do not depend on it",
    )  # fmt: skip
    where.add_argument(
        "--processes", type=read.positive, metavar="N", help="processes instead of threads, faster for many designs"
    )


def executor(arguments: argparse.Namespace, stack: ExitStack) -> Executor | None:
    """Return the pool that is asked for, which ends with `stack`; None: the default."""
    from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
    from multiprocessing import get_context

    if arguments.processes:
        return stack.enter_context(ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")))
    return stack.enter_context(ThreadPoolExecutor(arguments.threads)) if arguments.threads else None
