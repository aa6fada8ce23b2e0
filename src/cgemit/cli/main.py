"""Entry point of `cgemit`: reads the command line, runs one sub-command, turns errors into exit codes."""

from __future__ import annotations

import argparse
import importlib
import io
import re
import shlex
import sys
import traceback
from collections.abc import Sequence

from cgemit.cli.common import BAD_INPUT, COMMANDS, INTERRUPTED, OK, RUN_FAILED, HelpFormatter, RunFailedError
from cgemit.cli.interrupts import interrupts_kept, pipes_kept
from cgemit.version import VERSION

_DESCRIPTION = """\
Which resolution does a tracker of cylindrical GEM layers and drift chambers reach, and why?
Units: mm, ns, GeV, GeV/c, T, rad; values on the command line and in detector files carry their unit ("500 um")."""

_EXAMPLES = """\
examples:
  cgemit study                                       every figure and number of arXiv:1504.02570 in ./cgemit-study
  cgemit resolution -d besiii-cgem --p 0.2:2.0:10 -o curves
  cgemit slab "Kapton 300 um + Cu 33 um" --particle pi- --p 0.5
                                                     scattering and energy loss in sheets of matter
  cgemit show besiii-cgem                            tables of material and read-out, pictures
  cgemit simulate -d besiii-cgem --particle pi+ --p 0.5 --cos-theta 0 -n 1000 --fit -o sample
  cgemit settings > settings.toml                    settings of all stages; --settings settings.toml uses them

exit codes: 0 ok, 2 bad input, 3 the run failed, 130 interrupted
Problems of a detector, a gun or sheets of matter are all listed at once; a malformed option ends at the first."""


def build_parser() -> argparse.ArgumentParser:
    """Return the parser with all sub-commands."""
    parser = argparse.ArgumentParser(
        prog="cgemit", description=_DESCRIPTION, epilog=_EXAMPLES, formatter_class=HelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"cgemit {VERSION}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in COMMANDS:
        importlib.import_module(f"cgemit.cli.{name}").add_parser(subparsers)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; default: those of the process.

    Returns
    -------
    int
        0 ok, 2 bad input, 3 run failed, 130 interrupted by Ctrl-C or SIGTERM.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # "?" where the encoding has no "±", rather than no result
    with pipes_kept():
        return _run(list(sys.argv[1:] if argv is None else argv))


def _run(words: list[str]) -> int:
    arguments = argparse.Namespace()
    try:
        with interrupts_kept():
            build_parser().parse_args(join_negative_values(words), arguments)
            arguments.line = shlex.join(["cgemit", *words])
            importlib.import_module("cgemit.isa").choose()  # a wrong CGEMIT_ISA is a mistake, whatever is run
            return int(arguments.run(arguments) or OK)
    except SystemExit as stop:  # --help, --version, or arguments that argparse has complained about
        return int(stop.code or OK)
    except KeyboardInterrupt:
        print("cgemit: interrupted", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, FileNotFoundError) as error:
        return _report(error, BAD_INPUT, getattr(arguments, "debug", False))
    except Exception as error:
        return _report(error, RUN_FAILED, getattr(arguments, "debug", False))


def _report(error: Exception, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exception(error)
    foreseen = code == BAD_INPUT or isinstance(error, RunFailedError)
    print(f"cgemit: {'' if foreseen else f'{type(error).__name__}: '}{error}", file=sys.stderr)
    if not foreseen and not debug:
        print("cgemit: the run failed; --debug shows where", file=sys.stderr)
    return code


def join_negative_values(argv: Sequence[str]) -> list[str]:
    """Write ``--cos-theta -0.9:0.9`` as ``--cos-theta=-0.9:0.9``, since argparse would take the value for an option."""
    joined: list[str] = []
    for word in argv:
        if joined and re.fullmatch(r"--[a-z-]+", joined[-1]) and re.match(r"-\.?\d", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


if __name__ == "__main__":
    sys.exit(main())
