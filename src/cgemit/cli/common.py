"""What several sub-commands share: options, the detector they stand for, exit codes."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from cgemit.cli import read

if TYPE_CHECKING:
    from cgemit.detector import Detector
    from cgemit.result import Settings

OK, BAD_INPUT, RUN_FAILED, INTERRUPTED = 0, 2, 3, 130

#: The sub-commands, in the order of the help text; each is a module with `add_parser`.
COMMANDS = ("study", "resolution", "simulate", "slab", "detectors", "show", "validate", "bench")


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keep the line breaks of descriptions and examples."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30, width=110)
        # argparse forgets the indent of sub-commands when it works out the width of the first column.
        self._action_max_length = 14


class InputError(ValueError):
    """Wrong values on the command line; every problem is a line of the message."""


class _Once(argparse.Action):
    """Store a value, and complain about a second one, of which the first would get lost."""

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
    parser.add_argument(
        "-d", "--detector", action="append" if several else _Once, required=True, metavar="NAME|FILE",
        help="a preset (see: cgemit detectors) or a detector file in TOML"
        + ("; repeat it to compare detectors" if several else ""),
    )  # fmt: skip
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides",
        help='change one value of the detector, such as cgem.L2.pitch_x="500 um"; may be repeated'
        + (", and applies to every detector given" if several else ""),
    )  # fmt: skip
    add_field(parser)
    parser.add_argument(
        "--name", metavar="NAME",
        help=("with one detector: " if several else "") + "what results call it (default: its own name, "
        "with -modified after --set or --field)",
    )  # fmt: skip


def add_field(parser: argparse.ArgumentParser) -> None:
    """Add `--field`."""
    parser.add_argument(
        "--field", metavar="NAME|FILE",
        help="another magnetic field: besiii, besiii-harmonic, finite-solenoid, uniform, a map (.npz, .csv) or a TOML file "
        "with a table [field]",
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


def add_physics(parser: argparse.ArgumentParser) -> None:
    """Add what is simulated of the passage through matter."""
    group = parser.add_argument_group("physics")
    group.add_argument(
        "--no-deltas",
        action="store_true",
        help="no delta electrons in the drift gaps; nothing else changes, the fit reckons with them all the same",
    )


def add_hypothesis(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add the particle whose mass the fit assumes, or the `several`."""
    parser.add_argument(
        "--hypothesis", metavar="NAME,..." if several else "NAME", type=read.names,
        help="fit with the mass of e, mu, pi, K or p instead of the particle's own"
        + ("; several, or all: one track for each" if several else ""),
    )  # fmt: skip


def settings_of(arguments: argparse.Namespace) -> Settings:
    """Return the settings of all stages with what `add_physics`, and more where a sub-command has it, read."""
    from cgemit.fit import FitSettings
    from cgemit.result import Settings
    from cgemit.simulate import SimulateSettings

    chosen = {name: getattr(arguments, name, None) for name in ("hypothesis", "states")}
    fit = FitSettings(**{name: value for name, value in chosen.items() if value is not None})
    return Settings(simulate=SimulateSettings(deltas=not arguments.no_deltas), fit=fit)


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add the seed."""
    parser.add_argument("--seed", type=read.seed, default=1, help="seed of the random numbers (default 1)")


def load_detector(arguments: argparse.Namespace, name: str | None = None) -> Detector:
    """Return the detector of `--detector` with the changes of `--set`, under a name of its own if there is one."""
    return _load(arguments.detector, _overrides(arguments, name), arguments.field)


def load_detectors(arguments: argparse.Namespace) -> list[Detector]:
    """Return all detectors of `--detector` with the changes of `--set`; their names are distinct.

    Raises
    ------
    InputError
        With all problems of all detectors, or the names that several of them have.
    """
    from cgemit.detector import DetectorError

    sources = arguments.detector
    if arguments.name is not None and len(sources) > 1:
        raise InputError(f"--name: got a name for {len(sources)} detectors; expected one detector")
    overrides = _overrides(arguments, arguments.name)
    detectors, problems = [], []
    for source in sources:
        try:
            detectors.append(_load(source, overrides, arguments.field))
        except DetectorError as error:
            problems.append(str(error))
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


def _overrides(arguments: argparse.Namespace, name: str | None) -> dict[str, object]:
    if name is not None and not name.strip():
        raise InputError(f"--name: got {name!r}; expected a name")
    return dict(_override(text) for text in arguments.overrides) | ({} if name is None else {"name": name.strip()})


def _load(source: str, overrides: dict[str, object], field: str | None) -> Detector:
    from cgemit.detector import load

    detector = load(source)
    if field is not None:
        detector = detector.with_field(field)
    return detector.with_overrides(overrides) if overrides else detector


def _override(text: str) -> tuple[str, object]:
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise InputError(f'--set: got {text!r}; expected KEY=VALUE such as cgem.L2.pitch_x="500 um"')
    return name.strip(), _literal(value.strip())


def _literal(text: str) -> object:
    """Read a value as a detector file would, but let strings go without quotes, which the shell has eaten."""
    import tomllib

    try:
        tables = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    return tables["value"] if len(tables) == 1 else text  # more than one line: not a value
