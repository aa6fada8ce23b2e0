"""`--settings`, `--set` and options that stand for a setting: one set of settings, and changes of the detector."""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, NamedTuple

from cgemit.cli import read
from cgemit.problems import did_you_mean

if TYPE_CHECKING:
    from cgemit.stages import Settings


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
    found: dict[str, object] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name:
            raise InputError(f"--set: got {text!r}, expected KEY=VALUE such as evaluate.events=500")
        found[name] = literal(value)
    return found


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add `--settings`."""
    parser.add_argument(
        "--settings", metavar="FILE",
        help="settings of the stages: a TOML or JSON file with tables such as [fit] (see: cgemit settings), or the "
        "run.json of earlier results; --set comes after it; options that stand for a setting, such as --no-deltas, "
        "come last, and are an error where --set says otherwise",
    )  # fmt: skip


def add_readout(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Add `--readout`."""
    usual = f"default {default}; " if default else ""
    parser.add_argument(
        "--readout", metavar="NAME", default=default,
        help="read-out of the CGEM layers: binary, gaussian, tiger, apv25 or analog-projection "
        f"({usual}digitize.readout; --set digitize.readout.KEY changes its settings)",
    )  # fmt: skip


def stages() -> tuple[str, ...]:
    """Return the stages that have settings."""
    from cgemit.stages import Settings

    return tuple(field.name for field in fields(Settings))


def split(texts: Sequence[str], problems: list[str], *, settings: bool = True, detector: bool = True) -> Changes:
    """Return what the texts of `--set` change.

    Parameters
    ----------
    texts : sequence of str
        ``KEY=VALUE``.
    problems : list of str
        Receives each text of another form, and each key that is neither a setting nor a value of the detector.
    settings, detector : bool
        Whether the command has settings, and a detector, to be changed.
    """
    from cgemit.detector.read import TOP_LEVEL

    known = dict.fromkeys(stages(), "settings") if settings else {}
    known |= {name: "detector" for name in TOP_LEVEL if name not in known} if detector else {}
    examples = " or ".join(["fit.loss=mean"] * settings + ['cgem.L2.pitch_x="500 um"'] * detector)
    found = Changes([], {})
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        first, dot, rest = name.partition(".")
        kind = known.get(first)
        if detector and first == "background" and "." in rest:  # the detector's levels have labels
            kind = "detector"
        if not equals or not name or (kind == "settings" and not dot):
            problems.append(f"--set: got {text!r}, expected KEY=VALUE such as {examples}")
        elif kind == "settings":
            found.settings.append((name, literal(value)))
        elif kind == "detector":
            found.detector[name] = literal(value)
        else:
            expected = ", or ".join(_kinds_of_keys(known))
            problems.append(f"--set: got {name!r}, expected {expected}{did_you_mean(first, known, '; ')}")
    return found


def _kinds_of_keys(known: Mapping[str, str]) -> list[str]:
    texts = {"settings": "a setting, which begins with", "detector": "a value of the detector, which begins with"}
    keys = {kind: [name for name in known if known[name] == kind] for kind in texts}
    return [f"{text} {', '.join(keys[kind])}" for kind, text in texts.items() if keys[kind]]


def settings_of(arguments: argparse.Namespace, *, one_track: bool = False) -> Settings:
    """Return the settings of a command that has no detector to be changed.

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
    problems: list[str] = []
    found = split(arguments.overrides, problems, detector=False)
    settings = read_settings(arguments, found.settings, problems, one_track=one_track)
    if problems:
        raise InputError("\n  ".join(["wrong settings", *problems]))
    return settings


def read_settings(
    arguments: argparse.Namespace,
    changed: Sequence[tuple[str, object]],
    problems: list[str],
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
    problems : list of str
        Receives every problem, and every option that contradicts `--set`.
    one_track : bool
        Whether the fit can assume one mass only.
    """
    from cgemit.io.toml import nested
    from cgemit.settings import SettingsError
    from cgemit.stages import Settings

    layers: list[tuple[str, Mapping[str, Any]]] = []
    if arguments.settings is not None:
        try:
            layers.append((arguments.settings, _tables(arguments.settings)))
        except SettingsError as error:
            problems += [f"{error.source}: {text}" for text in error.problems]
    if getattr(arguments, "readout", None) is not None:
        layers.append(("--readout", nested("digitize.readout", arguments.readout)))
    layers += [("--set", nested(key, value)) for key, value in changed]
    given = dict(changed)
    for flag, key, value in _options(arguments):
        layers.append((flag, nested(key, value)))
        if key in given and _listed(given[key]) != _listed(value):
            problems.append(f"{flag}: got {value!r}, but {given[key]!r} from --set {key}; expected one of them")
    try:
        settings = Settings.from_layers(layers)
    except SettingsError as error:
        problems += error.problems
        return Settings()
    names = settings.fit.hypotheses()
    if one_track and len(names) > 1:
        problems.append(f"fit.hypothesis: got {', '.join(names)}; this command expects one of them")
    return settings


def _tables(file: str) -> Mapping[str, Any]:
    """Return the tables of a file of settings, or those that the record of a run holds."""
    from cgemit.record import FORMAT
    from cgemit.settings import read_tables

    tables = read_tables(file)
    inner = tables.get("settings")
    return inner if tables.get("format") == FORMAT and isinstance(inner, Mapping) else tables


def _listed(value: object) -> list[object]:
    return list(value) if isinstance(value, tuple | list) else [value]


def literal(text: str) -> object:
    """Read a value as in a TOML file; strings need no quotes, since the shell removes them."""
    try:
        tables = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
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
        "--hypothesis", metavar="NAME,..." if several else "NAME", type=read.names,
        help="fit with the mass of e, mu, pi, K or p instead of the particle's own (fit.hypothesis)"
        + ("; several, or all: one track for each" if several else ""),
    )  # fmt: skip


def _options(arguments: argparse.Namespace) -> list[Option]:
    """Return the options that stand for a setting and were given."""
    options = [Option("--no-deltas", "simulate.deltas", False)] if getattr(arguments, "no_deltas", False) else []
    for name in ("hypothesis", "states"):
        value = getattr(arguments, name, None)
        if value is not None:
            options.append(Option(f"--{name}", f"fit.{name}", list(value)))
    return options
