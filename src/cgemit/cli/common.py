"""Shared parts of the sub-commands: options, the detector, exit codes, the progress bar."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, NoReturn, ParamSpec, TextIO, TypeVar

from cgemit.cli import changes, read
from cgemit.cli.changes import InputError as InputError

if TYPE_CHECKING:
    from cgemit.detector import Detector
    from cgemit.stages import Settings

P = ParamSpec("P")
T = TypeVar("T")

OK, BAD_INPUT, RUN_FAILED, INTERRUPTED = 0, 2, 3, 130

#: The sub-commands in the order of the help text, each with its module, whose `add_parser` adds it.
COMMANDS = {
    "study": "study",
    "resolution": "resolution",
    "sweep": "sweep",
    "optimize": "optimize",
    "simulate": "simulate",
    "find": "find",
    "display": "display",
    "readout": "readout",
    "refit": "refit",
    "slab": "slab",
    "detectors": "detector",
    "show": "detector",
    "validate": "detector",
    "settings": "settings",
    "bench": "bench",
}


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keep the line breaks of descriptions and examples."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30, width=110)
        # argparse forgets the indent of sub-commands when it computes the width of the first column.
        self._action_max_length = 14


class Parser(argparse.ArgumentParser):
    """Say what is wrong in one line, with the nearest command or option; --help shows the rest."""

    def error(self, message: str) -> NoReturn:
        """Write the message and leave with exit code 2."""
        self.exit(BAD_INPUT, f"{self.prog}: {message} ({self.prog} --help lists the options)\n")

    def options(self) -> list[str]:
        """Return the options that the command knows."""
        return [option for action in self._actions for option in action.option_strings]


class RunFailedError(RuntimeError):
    """A run that has no result."""


class _Once(argparse.Action):
    """Store a value; a second one is an error, since it would replace the first."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: object, option: str | None = None
    ) -> None:
        if getattr(namespace, self.dest) is not None:
            raise argparse.ArgumentError(self, f"got a second one, {values}; expected one")
        setattr(namespace, self.dest, values)


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add the options that every sub-command with a run has."""
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.add_argument("--debug", action="store_true", help="show where in the program an error arose")


def add_detector(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add `--detector`, which may be repeated if there are `several`, `--set` and `--name`."""
    detector = parser.add_argument(
        "-d", "--detector", action="append" if several else _Once, required=True, metavar="NAME|FILE",
        help="a preset (see: cgemit detectors) or a detector file in TOML"
        + ("; repeat it to compare detectors" if several else ""),
    )  # fmt: skip
    detector.completer = preset_names  # type: ignore[attr-defined]
    changes.add_set(
        parser, f"change one value: of the settings if its key begins with {', '.join(changes.stages())}, such as "
        'fit.loss=mean, else of the detector, such as cgem.L2.pitch_x="500 um"; may be repeated'
        + (", and applies to every detector given" if several else ""),
    )  # fmt: skip
    changes.add_settings(parser)
    add_field(parser)
    parser.add_argument(
        "--name", metavar="NAME",
        help=("with one detector: " if several else "") + "what results call it (default: its own name, "
        "with what --set and --field change)",
    )  # fmt: skip


def preset_names(prefix: str = "", **_: object) -> list[str]:
    """Return the presets, and the files, that complete a word of the command line."""
    from argcomplete.completers import FilesCompleter

    from cgemit.detector import detectors

    return [name for name in detectors() if name.startswith(prefix)] + list(FilesCompleter("toml")(prefix))


def add_field(parser: argparse.ArgumentParser) -> None:
    """Add `--field`."""
    parser.add_argument(
        "--field", metavar="NAME|FILE",
        help="another magnetic field: besiii, besiii-harmonic, finite-solenoid, uniform, a map (.npz, .csv) or a TOML "
        "file with a table [field]",
    )  # fmt: skip


def add_output(parser: argparse.ArgumentParser, *, default: str | None = None) -> None:
    """Add the output folder and `--overwrite`."""
    parser.add_argument(
        "-o", "--output", metavar="DIR", default=default, required=default is None,
        help="folder for the results" + (f" (default {default})" if default else ""),
    )  # fmt: skip
    parser.add_argument(
        "--overwrite", action="store_true", help="write into a folder that already holds files, replacing results"
    )


def add_run(parser: argparse.ArgumentParser) -> None:
    """Add seed and threads."""
    add_seed(parser)
    parser.add_argument(
        "--threads", type=read.positive, default=None, metavar="N",
        help="number of threads (default: all cores); results do not depend on it",
    )  # fmt: skip


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add the seed."""
    parser.add_argument("--seed", type=read.seed, default=1, help="seed of the random numbers (default 1)")


def load_inputs(arguments: argparse.Namespace, *, one_track: bool = False) -> tuple[list[Detector], Settings]:
    """Return the detectors of `--detector`, with the changes of `--set`, and the settings of all stages.

    Parameters
    ----------
    arguments : Namespace
    one_track : bool
        Whether the command needs one track a particle, so that the fit can assume one mass only.

    Raises
    ------
    InputError
        Listing every problem of the settings and of all detectors.
    """
    problems: list[str] = []
    found = changes.split(arguments.overrides, problems)
    settings = changes.read_settings(arguments, found.settings, problems, one_track=one_track)
    detectors = collect(problems, load_detectors, arguments, found.detector)
    if problems or detectors is None:
        raise InputError("\n  ".join(["wrong input", *problems]) if len(problems) > 1 else problems[0])
    return detectors, settings


def collect(problems: list[str], make: Callable[P, T], *given: P.args, **named: P.kwargs) -> T | None:
    """Return what a function returns, or None with the message of its error added to `problems`."""
    try:
        return make(*given, **named)
    except ValueError as error:
        problems.append(str(error))
    return None


def load_detectors(arguments: argparse.Namespace, overrides: dict[str, object]) -> list[Detector]:
    """Return all detectors of `--detector` with some values changed; their names are distinct.

    Raises
    ------
    InputError
        With all problems of all detectors, or the names that several of them have.
    """
    sources = [arguments.detector] if isinstance(arguments.detector, str) else arguments.detector
    overrides = overrides | _name(arguments.name, overrides, len(sources))
    problems: list[str] = []
    loaded = [collect(problems, load_detector, source, overrides, arguments.field) for source in sources]
    detectors = [detector for detector in loaded if detector is not None]
    by_name: dict[str, list[str]] = {}
    for source, detector in zip(sources, detectors, strict=not problems):
        by_name.setdefault(detector.name, []).append(source)
    problems = problems or [
        f"-d: got {len(given)} detectors of the name {name!r} ({', '.join(given)}); expected distinct names, "
        'as `name = "..."` in a detector file'
        for name, given in by_name.items()
        if len(given) > 1
    ]
    if problems:
        raise InputError("\n".join(problems))
    return detectors


def load_detector(source: str, overrides: dict[str, object], field: str | None) -> Detector:
    """Return the detector of a preset or file in another field, if one is given, and with some values changed."""
    from cgemit.detector import load

    detector = load(source)
    if field is not None:
        detector = detector.with_field(field)
    return detector.with_overrides(overrides) if overrides else detector


def _name(name: str | None, overrides: dict[str, object], detectors: int) -> dict[str, object]:
    """Return what `--name` changes."""
    if name is None:
        return {}
    if not name.strip():
        raise InputError(f"--name: got {name!r}; expected a name")
    if detectors > 1:
        raise InputError(f"--name: got a name for {detectors} detectors; expected one detector")
    if overrides.get("name", name.strip()) != name.strip():
        raise InputError(f"--name: got {name!r}, but {overrides['name']!r} from --set name; expected one of them")
    return {"name": name.strip()}


_WIDTH = 28  # characters of the bar
_REDRAW = 0.1  # s between two drawings on a terminal
_STEP = 0.1  # share of the work between two lines in a log file


class Progress:
    """Show how much of a job is done: a moving bar on a terminal, a line every tenth in a log file.

    Parameters
    ----------
    label : str
        What is running.
    quiet : bool
        Show nothing.
    stream : text stream, optional
        Default: the error stream.
    """

    def __init__(self, label: str, *, quiet: bool = False, stream: TextIO | None = None) -> None:
        self.label, self.quiet = label, quiet
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._start = self._drawn = time.monotonic()
        self._shown = 0.0
        self._length = 0

    def __call__(self, fraction: float, label: str = "") -> None:
        """Show that `fraction` (0 to 1) of the work is done, and what is running now."""
        if self.quiet:
            return
        self.label = label or self.label
        now = time.monotonic()
        if self._terminal and (now - self._drawn >= _REDRAW or fraction >= 1):
            self._drawn = now
            self._draw(fraction, now - self._start)
        elif not self._terminal and (fraction - self._shown >= _STEP - 1e-9 or fraction >= 1 > self._shown):
            self._shown = fraction
            self._stream.write(f"{self.label}: {fraction:4.0%}, {now - self._start:.1f} s\n")
            self._stream.flush()

    def _draw(self, fraction: float, seconds: float) -> None:
        full = round(_WIDTH * min(1.0, fraction))
        line = f"[{'#' * full}{'.' * (_WIDTH - full)}] {fraction:4.0%} {seconds:5.1f} s  {self.label}"
        self._stream.write("\r" + line.ljust(self._length))
        self._length = len(line)
        self._stream.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Leave the terminal's line free for what is written next.
        if self._terminal and not self.quiet and self._length:
            self._stream.write("\r" + " " * self._length + "\r")
            self._stream.flush()
