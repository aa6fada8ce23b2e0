"""Shared parts of the sub-commands: options, the detector, exit codes, the progress bar."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, ParamSpec, TextIO, TypeVar

from cgemit.base.errors import Problem, Problems, did_you_mean
from cgemit.units import QuantityError

if TYPE_CHECKING:
    from cgemit.base.progress import ProgressBar
    from cgemit.chain.settings import Settings
    from cgemit.detector import Detector
    from cgemit.detector.readouts import Readout
    from cgemit.tables import Table


#: What a gun takes for a quantity: one number, a uniform range, or values in turn.
Values = float | tuple[float, float] | list[float]


def momenta(text: str) -> Values:
    """Read momenta in GeV/c or with a unit: a number, ``A:B`` (uniform), ``A:B:N`` (ends included) or ``A,B,C``."""
    return _values(text, "momentum")


def cosines(text: str) -> Values:
    """Read cosines of the polar angle, as `momenta`."""
    return _values(text, "dimensionless")


def angles(text: str) -> Values:
    """Read angles in rad or with a unit, as `momenta`."""
    return _values(text, "angle")


def lengths(text: str) -> Values:
    """Read lengths in mm or with a unit, as `momenta`."""
    return _values(text, "length")


def values_of_key(text: str) -> list[Any]:
    """Read values of a key of the detector, ``A,B,C`` or ``A:B:COUNT`` with both ends; a value is as in its file."""
    from cgemit.study.sweep.space import split_range

    parts = [part.strip() for part in text.split(":")]
    given = [literal(part) for part in parts[:2]]
    ends = split_range(*given) if len(parts) in (2, 3) else None
    if ends is not None and len(parts) == 2:
        raise argparse.ArgumentTypeError(f"got {text}, a range; expected A,B,C or A:B:COUNT, such as {text}:5")
    if ends is None or ends[0]:
        return [literal(part.strip()) for part in text.split(",")]
    count, (_, low, high, unit) = whole(parts[2], 2, 1000), ends
    steps = [low + (high - low) * i / (count - 1) for i in range(count)]
    if all(isinstance(one, int) for one in given) and all(one.is_integer() for one in steps):
        return list(map(int, steps))  # of keys such as cells
    return [f"{one:.10g} {unit}" if unit else float(f"{one:.10g}") for one in steps]


def listed_angles(text: str) -> list[float]:
    """Read angles as `angles`, but no range."""
    return _listed_values(text, "angle")


def listed_numbers(text: str) -> list[float]:
    """Read numbers without a unit, but no range."""
    return _listed_values(text, "dimensionless")


def angle(text: str) -> float:
    """Read one angle in rad or with a unit."""
    return _one_value(text, "angle")


def field(text: str) -> float:
    """Read a magnetic field in T or with a unit."""
    return _one_value(text, "field")


def momentum(text: str) -> float:
    """Read one momentum in GeV/c or with a unit."""
    return _one_value(text, "momentum")


def number(text: str) -> float:
    """Read a number without a unit."""
    return _one_value(text, "dimensionless")


def triple(text: str) -> tuple[Values, Values, Values]:
    """Read lengths along x, y and z, ``X,Y,Z``; each may be a range ``A:B``."""
    from cgemit.base.validate import Axes

    x, y, z = _read(Axes("length").read, text)
    return x, y, z


def charges(text: str) -> dict[int, int]:
    """Read charges of PDG numbers, ``PDG=CHARGE,...``."""
    pairs = [part.strip().partition("=") for part in text.split(",")]
    try:
        return {int(pdg): int(charge) for pdg, _, charge in pairs}
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r:.50}, expected PDG=CHARGE,... such as 4900211=1") from None


def names(text: str) -> tuple[str, ...]:
    """Read names, ``A,B,C``."""
    return tuple(part.strip() for part in text.split(","))


def surfaces(text: str) -> tuple[float | str, ...]:
    """Read the surfaces of states, ``A,B,C``: a length is a radius, a name stays a name."""
    from cgemit.base.validate import number_of

    def surface(text: str) -> float | str:
        try:
            return number_of(text, "length")
        except QuantityError:
            return text  # a name, or what the setting refuses

    return tuple(map(surface, names(text)))


def positive(text: str) -> int:
    """Read a whole number of at least 1."""
    return whole(text, 1, 2**31 - 1)


def event(text: str) -> int:
    """Read the number of an event."""
    return whole(text, 0, 2**31 - 1)


def seed(text: str) -> int:
    """Read the seed of the random numbers."""
    return whole(text, 0, 2**64 - 1)


def whole(text: str, least: int, most: int) -> int:
    """Read a whole number from `least` to `most`."""
    from cgemit.base.validate import Whole

    return int(_read(Whole(least, most).read_text, text))


def length(text: str) -> float:
    """Read a positive length, in mm; `160 um` or `0.16 mm`."""
    from cgemit.base.validate import Quantity

    return float(_read(Quantity("length", 0, above=True).read, text))


def _one_value(text: str, dimension: str) -> float:
    from cgemit.base.validate import Quantity

    return float(_read(Quantity(dimension).read, text))


def _values(text: str, dimension: str) -> Values:
    from cgemit.base.validate import InTurn, Spread

    value = _read(Spread(dimension).read, text)
    return list(value.values) if isinstance(value, InTurn) else value


def _listed_values(text: str, dimension: str) -> list[float]:
    from cgemit.base.validate import Listed

    return list(_read(Listed(dimension).read, text))


def _read(read: Callable[[str, str, Problems], Any], text: str) -> Any:
    """Return what a constraint makes of a text, as it does for settings, plans and guns."""
    problems = Problems()
    value = read("", text, problems)
    if problems:
        raise argparse.ArgumentTypeError("; ".join(map(str, problems)))
    return value


class InputError(ValueError):
    """Wrong values on the command line; every problem is a line of the message."""


class Changes(NamedTuple):
    """What `--set` changes: settings and values of the detector, by dotted key, in order."""

    settings: list[tuple[str, object]]
    detector: dict[str, object]


class Option(NamedTuple):
    """An option that stands for a setting."""

    flag: str
    key: str
    value: object


def add_set(parser: argparse.ArgumentParser, about: str) -> None:
    """Add `--set`."""
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help=about)


def plan_changes(texts: list[str]) -> dict[str, object]:
    """Return what `--set` changes in a plan, by dotted key."""
    changes: dict[str, object] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name:
            raise InputError(f"--set: got {text!r}, expected KEY=VALUE such as evaluate.events=500")
        changes[name] = literal(value)
    return changes


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add `--settings`."""
    parser.add_argument(
        "--settings", metavar="FILE",
        help="settings of the stages: a TOML file with tables such as [fit] (see: cgemit settings), or the "
        "run.json of earlier results; --set comes after it; options that stand for a setting, such as --no-deltas, "
        "come last, and are an error where --set says otherwise",
    )  # fmt: skip


def add_readout(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Add `--readout`."""
    from cgemit.detector.readouts import names_of

    usual = f"default {default}" if default else "default: those of the detector"
    parser.add_argument(
        "--readout", metavar="NAME", default=default,
        help=f"readout of the CGEM layers: {names_of()} "
        f"({usual}; --set readout.KEY changes a value of it)",
    )  # fmt: skip


def stages() -> tuple[str, ...]:
    """Return the stages that have settings."""
    from cgemit.chain.settings import Settings

    return tuple(field.name for field in fields(Settings))


def split(
    texts: Sequence[str], problems: Problems, *, settings: bool = True, detector: bool = True, readout: bool = False
) -> Changes:
    """Return what the texts of `--set` change.

    Parameters
    ----------
    texts : sequence of str
        ``KEY=VALUE``.
    problems : Problems
        Receives each text of another form, and each key that is neither a setting nor a value of the detector.
    settings, detector, readout : bool
        Whether the command has settings, a detector, and a readout without a detector, to be changed.
    """
    from cgemit.detector.reader import TOP_LEVEL

    known = dict.fromkeys(stages(), "settings") if settings else {}
    known |= {name: "detector" for name in TOP_LEVEL if name not in known} if detector else {}
    known |= {"readout": "readout"} if readout else {}
    examples = " or ".join(["fit.loss=mean"] * settings + ['cgem.L2.pitch_x="500 um"'] * detector)
    changes = Changes([], {})
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        first, dot, rest = name.partition(".")
        kind = known.get(first)
        if detector and first == "background" and "." in rest:  # the detector's levels have labels
            kind = "detector"
        if not equals or not name or (kind == "settings" and not dot):
            problems.note("--set", repr(text), f"KEY=VALUE such as {examples}")
        elif kind == "settings":
            changes.settings.append((name, literal(value)))
        elif kind is not None:
            changes.detector[name] = literal(value)
        else:
            problems.note("--set", repr(name), ", or ".join(_kinds_of_keys(known)), did_you_mean(first, known))
    return changes


def _kinds_of_keys(known: Mapping[str, str]) -> list[str]:
    texts = {
        "settings": "a setting, which begins with",
        "detector": "a value of the detector, which begins with",
        "readout": "a value of the readout, which begins with",
    }
    keys = {kind: [name for name in known if known[name] == kind] for kind in texts}
    return [f"{text} {', '.join(keys[kind])}" for kind, text in texts.items() if keys[kind]]


def settings_and_readout(arguments: argparse.Namespace, *, one_track: bool = False) -> tuple[Settings, Readout | None]:
    """Return the settings, and the readout if one is given, of a command with `--readout` and without `--detector`.

    Parameters
    ----------
    arguments : Namespace
    one_track : bool
        Whether the fit can assume one mass only.

    Raises
    ------
    InputError
        Listing every problem.
    """
    problems = Problems()
    changes = split(arguments.overrides, problems, detector=False, readout=True)
    settings = read_settings(arguments, changes.settings, problems, one_track=one_track)
    readout = collect(problems, _readout, arguments.readout, changes.detector)
    if problems:
        raise InputError("\n  ".join(["wrong settings", *map(str, problems)]))
    return settings, readout


def settings_of(arguments: argparse.Namespace) -> Settings:
    """Return the settings of a command that has neither detector nor readout to be changed.

    Raises
    ------
    InputError
        Listing every problem.
    """
    problems = Problems()
    found = split(arguments.overrides, problems, detector=False)
    settings = read_settings(arguments, found.settings, problems)
    if problems:
        raise InputError("\n  ".join(["wrong settings", *map(str, problems)]))
    return settings


def _readout(name: str | None, changes: Mapping[str, object]) -> Readout | None:
    """Return the readout of a name with the values that `--set` changes by keys that begin with readout."""
    from cgemit.detector.reader import readout_of, readout_table, set_path

    if name is None and not changes:
        return None
    tables: dict[str, Any] = {} if name is None else {"readout": readout_table(name)}
    for path, value in changes.items():
        set_path(tables, path, value if path != "readout" else readout_table(str(value)))
    return readout_of(tables["readout"])


def read_settings(
    arguments: argparse.Namespace,
    changed: Sequence[tuple[str, object]],
    problems: Problems,
    *,
    one_track: bool = False,
) -> Settings:
    """Return the settings of all stages: the file, then `--set` in order, then the options that stand for a setting.

    Parameters
    ----------
    arguments : Namespace
        With `--settings` and these options, as far as the command has them.
    changed : sequence of (str, object)
        The settings that `--set` changes.
    problems : Problems
        Receives every problem, and every option that contradicts `--set`.
    one_track : bool
        Whether the fit can assume one mass only.
    """
    from cgemit.base.files import nested
    from cgemit.base.settings import SettingsError
    from cgemit.chain.settings import Settings

    layers: list[tuple[str, Mapping[str, Any]]] = []
    if arguments.settings is not None:
        try:
            layers.append((arguments.settings, _tables(arguments.settings)))
        except SettingsError as error:
            problems.extend(Problem(error.source, str(one), "") for one in error.problems)
    layers += [("--set", nested(key, value)) for key, value in changed]
    by_set = dict(changed)
    for flag, key, value in _options(arguments):
        layers.append((flag, nested(key, value)))
        if key in by_set and _listed(by_set[key]) != _listed(value):
            problems.note(flag, f"{value!r}, but {by_set[key]!r} from --set {key}", "one of them")
    try:
        settings = Settings.from_layers(layers)
    except SettingsError as error:
        problems += error.problems
        return Settings()
    names = settings.fit.hypotheses()
    if one_track and len(names) > 1:
        problems.note("fit.hypothesis", f"got {', '.join(names)}", "", "this command expects one of them")
    return settings


def _tables(file: str) -> Mapping[str, Any]:
    """Return the tables of a file of settings, or those that the record of a run holds."""
    from cgemit.base.settings import read_tables
    from cgemit.chain.record import recorded_settings

    return recorded_settings(file) if file.endswith(".json") else read_tables(file)


def _listed(value: object) -> list[object]:
    return list(value) if isinstance(value, tuple | list) else [value]


def literal(text: str) -> object:
    """Read a value as in a TOML file; strings need no quotes, since the shell removes them."""
    from cgemit.base.files import parse_toml

    try:
        tables = parse_toml(f"value = {text}")
    except ValueError:
        return text
    return tables["value"] if len(tables) == 1 else text  # more than one line: not a value


def add_physics(parser: argparse.ArgumentParser) -> None:
    """Add the options of the simulated processes in matter."""
    group = parser.add_argument_group("physics")
    group.add_argument(
        "--no-deltas",
        action="store_true",
        help="no delta electrons in the drift gaps (simulate.deltas=false); the fit's cluster errors are unchanged",
    )


def add_hypothesis(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add the particle whose mass the fit assumes, or the `several`."""
    parser.add_argument(
        "--hypothesis", metavar="NAME,..." if several else "NAME", type=names,
        help="fit with the mass of e, mu, pi, K or p (fit.hypothesis) instead of that of the candidates: their "
        "particle's, or that which the finder assumes (find.hypothesis)"
        + ("; several, or all: one track for each" if several else ""),
    )  # fmt: skip


def add_events(parser: argparse.ArgumentParser, *, or_folder: bool = False) -> None:
    """Add a file of measured events, `or_folder` of a run, and how its events are reconstructed."""
    folder = ", or the folder of a run" if or_folder else ""
    parser.add_argument("file", metavar="FILE", help=f"a .raw, .rec or .rtraw file{folder}")
    add_detector(parser, required=not or_folder)
    add_readout(parser)
    parser.add_argument(
        "--points", choices=("strips", "file"),
        help="clusters: made of the strips, or those of the file (default: those of the file if it has some)",
    )  # fmt: skip
    add_hypothesis(parser)


def _options(arguments: argparse.Namespace) -> list[Option]:
    """Return the options that stand for a setting and were given."""
    options = [Option("--no-deltas", "simulate.deltas", False)] if getattr(arguments, "no_deltas", False) else []
    for name in ("hypothesis", "states"):
        value = getattr(arguments, name, None)
        if value is not None:
            options.append(Option(f"--{name}", f"fit.{name}", list(value)))
    return options


P = ParamSpec("P")
T = TypeVar("T")

OK, BAD_INPUT, RUN_FAILED, INTERRUPTED = 0, 2, 3, 130


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keep the line breaks of descriptions and examples."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30, width=110)
        # argparse forgets the indent of sub-commands when it computes the width of the first column.
        self._action_max_length = 15


class Parser(argparse.ArgumentParser):
    """Say what is wrong in one line, with the nearest command or option; --help shows the rest."""

    def error(self, message: str) -> NoReturn:
        """Write the message and leave with exit code 2."""
        self.exit(BAD_INPUT, f"{self.prog}: {message} ({self.prog} --help lists the options)\n")

    def options(self) -> list[str]:
        """Return the options that the command knows."""
        return [option for action in self._actions for option in action.option_strings]

    def about(self, option: str) -> str:
        """Return the help of an option."""
        return next(action.help or "" for action in self._actions if option in action.option_strings)


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


def add_detector(parser: argparse.ArgumentParser, *, several: bool = False, required: bool = True) -> None:
    """Add `--detector`, which may be repeated if there are `several`, `--set` and `--name`."""
    detector = parser.add_argument(
        "-d", "--detector", action="append" if several else _Once, required=required, metavar="NAME|FILE",
        help="a preset (see: cgemit detectors) or a detector file in TOML"
        + ("; repeat it to compare detectors" if several else ""),
    )  # fmt: skip
    detector.completer = preset_names  # type: ignore[attr-defined]
    add_set(
        parser, f"change one value: of the settings if its key begins with {', '.join(stages())}, such as "
        'fit.loss=mean, else of the detector, such as cgem.L2.pitch_x="500 um"; may be repeated'
        + (", and applies to every detector given" if several else ""),
    )  # fmt: skip
    add_settings(parser)
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


def add_output(
    parser: argparse.ArgumentParser,
    about: str = "folder for the results",
    *,
    default: str | None = None,
    required: bool = False,
) -> None:
    """Add the output folder and `--overwrite`."""
    about += f" (default {default})" if default else ""
    parser.add_argument("-o", "--output", metavar="DIR", default=default, required=required, help=about)
    add_overwrite(parser, "replace the results in a folder that holds nothing else")


def add_overwrite(parser: argparse.ArgumentParser, about: str) -> None:
    """Add `--overwrite`."""
    parser.add_argument("--overwrite", action="store_true", help=f"{about}; files that were changed since stay")


def add_run(parser: argparse.ArgumentParser) -> None:
    """Add seed and threads."""
    add_seed(parser)
    parser.add_argument(
        "--threads", type=positive, default=None, metavar="N",
        help="number of threads (default: all cores); results do not depend on it",
    )  # fmt: skip


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add the seed."""
    parser.add_argument("--seed", type=seed, default=1, help="seed of the random numbers (default 1)")


def load_inputs(
    arguments: argparse.Namespace, gun: Callable[[argparse.Namespace], object] | None = None, *, one_track: bool = False
) -> tuple[list[Detector], Settings]:
    """Return the detectors of `--detector`, with the changes of `--set`, and the settings of all stages.

    Parameters
    ----------
    arguments : Namespace
    gun : callable, optional
        Makes the gun of the options; its problems are listed with the others, if there are any.
    one_track : bool
        Whether the command needs one track a particle, so that the fit can assume one mass only.

    Raises
    ------
    InputError
        Listing every problem of the settings and of all detectors.
    """
    problems = Problems()
    changes = split(arguments.overrides, problems)
    settings = read_settings(arguments, changes.settings, problems, one_track=one_track)
    sources = [arguments.detector] if isinstance(arguments.detector, str) else arguments.detector
    overrides = changes.detector | (collect(problems, _name, arguments.name, changes.detector, len(sources)) or {})
    detectors: dict[str, Detector] = {}
    for source in sources:
        detector = collect(
            problems, load_detector, source, overrides, arguments.field, getattr(arguments, "readout", None)
        )
        if detector is not None and detector.name in detectors:
            text = f"{source}, a second detector of the name {detector.name!r}"
            problems.note("-d", text, 'distinct names, as `name = "..."` in a detector file')
        elif detector is not None:
            detectors[detector.name] = detector
    if problems and gun:
        collect(problems, gun, arguments)
    if problems:
        texts = [str(one) for one in problems]
        raise InputError("\n  ".join(["wrong input", *texts]) if len(texts) > 1 else texts[0])
    return list(detectors.values()), settings


def collect(problems: Problems, make: Callable[P, T], *given: P.args, **named: P.kwargs) -> T | None:
    """Return what a function returns, or None with the message of its error added to `problems`."""
    try:
        return make(*given, **named)
    except ValueError as error:
        problems.note("", str(error), "")
    return None


def load_detector(source: str, overrides: dict[str, object], field: str | None, readout: str | None = None) -> Detector:
    """Return the detector of a preset or file in another field, with another readout, and with some values changed."""
    from cgemit.detector import load

    detector = load(source)
    if field is not None:
        detector = detector.with_field(field)
    if readout is not None:
        detector = detector.with_readout(readout)
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


def say(text: object, stream: TextIO | None = None) -> None:
    """Print a text; a reader that has gone, as `head` after some lines, gets no more, and the command goes on."""
    stream = stream or sys.stdout
    try:
        print(text, file=stream, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def note(arguments: argparse.Namespace, text: str) -> None:
    """Write a line to stderr unless `--quiet` is given."""
    if not arguments.quiet:
        say(text, sys.stderr)


def mostly_unconstrained(tracks: Table) -> bool:
    """Return whether most tracks do not measure their momentum."""
    from cgemit.tables.schema import FitStatus

    unconstrained = int((tracks["status"] == FitStatus.unconstrained).sum())
    return 2 * unconstrained > len(tracks)


def warn_unmeasured(detector: Detector, momenta: str) -> None:
    """Write to stderr that a detector does not measure momenta; most often their unit was meant to be another one."""
    text = f"cgemit: {detector.name} does not measure {momenta}: sigma(p)/p is above 0.5"
    say(f"{text}; momenta without a unit are in GeV/c", sys.stderr)


def progress_bar(arguments: argparse.Namespace, label: str) -> ProgressBar:
    """Return a bar on stderr, which shows nothing with `--quiet` or where stderr is no terminal."""
    from cgemit.base.progress import ProgressBar

    return ProgressBar(label, disable=arguments.quiet or None, leave=False)
