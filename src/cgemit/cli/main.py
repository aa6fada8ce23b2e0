"""Entry point of `cgemit`: reads the command line, runs one sub-command, turns errors into exit codes."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import re
import shlex
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from cgemit.base.errors import did_you_mean, reason
from cgemit.base.version import __version__
from cgemit.cli.options import (
    BAD_INPUT,
    INTERRUPTED,
    OK,
    RUN_FAILED,
    HelpFormatter,
    Parser,
    RunFailedError,
    say,
)

#: The sub-commands in the order of the help text. Each is a module of this folder with the texts `DESCRIPTION` and
#: `EXAMPLES`, `add` for its options, and `run`.
COMMANDS = {
    "study": "reproduce the paper: all its figures and numbers",
    "resolution": "resolutions of a detector against momentum",
    "sweep": "evaluate many variants of a detector",
    "optimize": "find the best variants of a detector",
    "simulate": "shoot particles and write hits, clusters and tracks as tables",
    "find": "efficiency, fakes and clones of track finding",
    "display": "draw one event",
    "readout": "resolution of an analog readout against the incidence; errors of its clusters",
    "reconstruct": "find and fit the tracks of BESIII events, from fired cells and strips",
    "monitor": "page of a run: strips, residuals, efficiencies",
    "refit": "fit tracks of BESIII again, beside its own fit",
    "align": "find displaced parts of a detector with tracks, or forecast the errors",
    "slab": "scattering and energy loss in layers of matter",
    "detectors": "list the detectors that come with cgemit",
    "show": "tables of material and readout, pictures",
    "validate": "check detector files, listing every problem",
    "settings": "print the settings of all stages as a file",
    "notebooks": "write the notebooks of the documentation",
}

_DESCRIPTION = """\
Which resolution does a tracker of cylindrical GEM layers and drift chambers reach, and why?
Units: mm, ns, GeV, GeV/c, T, rad; values on the command line and in detector files carry their unit ("500 um")."""

_EXAMPLES = """\
examples:
  cgemit study                                       every figure and number of arXiv:1504.02570 in ./cgemit-study
  cgemit resolution -d besiii-cgem --p 0.2:2.0:10 -o curves
  cgemit sweep plan.toml -o pitches                  many variants of a detector, resumable
  cgemit optimize plan.toml -o best                  the best designs within limits
  cgemit slab "Kapton 300 um + Cu 33 um" --particle pi- --p 0.5
                                                     scattering and energy loss in layers of matter
  cgemit show besiii-cgem                            tables of material and readout, pictures
  cgemit simulate -d besiii-cgem --particle pi+ --p 0.5 --cos-theta 0 -n 1000 --fit -o sample
  cgemit display -d besiii-cgem --p 1 --cos-theta 0 -o event
                                                     one event as a picture; --html: in three dimensions
  cgemit reconstruct run.raw -d besiii-cgem --readout tiger -o run
                                                     tracks and pictures of measured events of BESIII
  cgemit settings > settings.toml                    settings of all stages; --settings settings.toml uses them

exit codes: 0 ok, 2 bad input, 3 the run failed, 130 interrupted
Problems of a detector, a gun or layers of matter are all listed at once; a malformed option is reported alone."""


def build_parser(*chosen: str) -> argparse.ArgumentParser:
    """Return the parser with all sub-commands; only the `chosen` ones have options, since their modules import much."""
    parser = Parser(prog="cgemit", description=_DESCRIPTION, epilog=_EXAMPLES, formatter_class=HelpFormatter)
    parser.add_argument("--version", action="version", version=f"cgemit {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        command = subparsers.add_parser(name, help=summary, formatter_class=HelpFormatter)
        if name in chosen:
            module = importlib.import_module(f"cgemit.cli.{name}")
            command.description, command.epilog = module.DESCRIPTION, module.EXAMPLES
            command.set_defaults(run=module.run)
            module.add(command)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; default: the arguments of the process.

    Returns
    -------
    int
        0 ok, 2 bad input, 3 run failed, 130 interrupted by Ctrl-C or SIGTERM.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # "?" where the encoding has no "±", rather than no result
    if "_ARGCOMPLETE" in os.environ:
        complete(build_parser(*os.environ["COMP_LINE"].split()[1:2]))
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: say(f"cgemit: {message}", sys.stderr)
        return _run(list(sys.argv[1:] if argv is None else argv))


_OF_INPUT = (ValueError, FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError)


def _run(argv: list[str]) -> int:
    arguments = argparse.Namespace()
    try:
        _parse(join_negative_values(argv), arguments)
        arguments.line = shlex.join(["cgemit", *argv])
        importlib.import_module("cgemit.base.isa").choose()  # a wrong CGEMIT_ISA is a mistake, whatever is run
        return int(arguments.run(arguments) or OK)
    except SystemExit as stop:  # --help, --version, or arguments that argparse has complained about
        return int(stop.code or OK)
    except KeyboardInterrupt:
        return _interrupted(arguments)
    except Exception as error:
        if _comes_from_interrupt(error):
            return _interrupted(arguments)
        code = BAD_INPUT if isinstance(error, _OF_INPUT) else RUN_FAILED
        return _report(error, code, getattr(arguments, "debug", False))


def _interrupted(arguments: argparse.Namespace) -> int:
    """Say what an interrupted command leaves, and how to go on."""
    folder = getattr(arguments, "output", None) if getattr(arguments, "command", "") in ("sweep", "optimize") else None
    more = ""
    if folder and Path(folder).is_dir():
        more = f"; {folder} keeps what is complete, and the same command (without --overwrite) continues"
    say(f"cgemit: interrupted{more}", sys.stderr)
    return INTERRUPTED


def _comes_from_interrupt(error: BaseException | None) -> bool:
    """Tell whether an interruption became another error, as in the imports, which may be in the middle of a class."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _parse(argv: list[str], arguments: argparse.Namespace) -> None:
    """Read the command line; unknown commands and options get the nearest known one as a hint."""
    parser = build_parser(*argv[:1])
    if not argv:
        say(parser.format_help())
        parser.exit(OK)
    if not argv[0].startswith("-") and argv[0] not in COMMANDS:
        hint = did_you_mean(argv[0], COMMANDS, "; ") or "; expected one of " + ", ".join(COMMANDS)
        parser.error(f"unknown command {argv[0]!r}{hint}")
    _, unknown = parser.parse_known_args(argv, arguments)
    if unknown:
        chosen = next(a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction))
        command = cast(Parser, chosen[arguments.command])
        word = unknown[0].partition("=")[0]
        hint = _near_option(word, command) if word.startswith("-") else _flag_before(argv, word, command)
        command.error(f"got {' '.join(unknown)}, which it does not know{hint}")


def _near_option(word: str, command: Parser) -> str:
    """Return the nearest known option as a hint; the dashes, which all have, make none near."""
    names = [option.removeprefix("--") for option in command.options() if option.startswith("--")]
    return did_you_mean(word.lstrip("-"), names, "; ").replace('"', '"--', 1)


def _flag_before(argv: list[str], word: str, command: Parser) -> str:
    """Return that the option before a word takes no value; an empty text if there is none."""
    before = argv[argv.index(word) - 1]
    return f"; {before} takes no value ({command.about(before)})" if before in command.options() else ""


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer a shell that asks for completions (argcomplete, extra [completion]), and leave."""
    import argcomplete

    argcomplete.autocomplete(parser)


def _report(error: Exception, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exception(error)
    foreseen = code == BAD_INPUT or isinstance(error, RunFailedError)
    text = f"{error.filename}: {reason(error)}" if isinstance(error, OSError) and error.filename else str(error)
    say(f"cgemit: {'' if foreseen else f'{type(error).__name__}: '}{text}", sys.stderr)
    if not foreseen and not debug:
        say("cgemit: the run failed; --debug shows where", sys.stderr)
    return code


def join_negative_values(argv: Sequence[str]) -> list[str]:
    """Write ``--cos-theta -0.9:0.9`` as ``--cos-theta=-0.9:0.9``, since argparse would take the value for an option."""
    joined: list[str] = []
    for text in argv:
        if joined and re.fullmatch(r"--[a-z-]+", joined[-1]) and re.match(r"-\.?\d", text):
            joined[-1] += f"={text}"
        else:
            joined.append(text)
    return joined


if __name__ == "__main__":
    sys.exit(main())
