"""Settings as frozen dataclasses: annotations define the allowed values; TOML and `--set` follow."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from html import escape
from typing import Any, Self

from cgemit.base.errors import Problem, Problems, ProblemsError, reason
from cgemit.base.files import flat, nested, new_file, parse_toml, read_text, toml_text
from cgemit.base.validate import NONE, build, check_fields, default_of, expected, is_settings, kinds_of


class SettingsError(ProblemsError):
    """Settings with mistakes; `problems` lists them all."""


class SettingsData:
    """Base of the frozen dataclasses that hold settings.

    Raises
    ------
    SettingsError
        A ValueError that lists every value that the annotation of its field does not allow, and values that do not go
        together.
    """

    def __post_init__(self) -> None:
        problems = Problems()
        check_fields(self, problems)
        self.contradictions(problems)
        problems.report(type(self).__name__, SettingsError)

    def contradictions(self, problems: Problems) -> None:
        """Note values that do not go together; also called where values are wrong by themselves."""

    @classmethod
    def of(cls, given: Self | None, name: str = "settings") -> Self:
        """Return the settings that a function was given as its argument `name`, the defaults for None.

        Raises
        ------
        TypeError
            If they are something else.
        """
        if not isinstance(given, cls | None):
            raise TypeError(f"{name}: got {type(given).__name__}, expected {cls.__name__}")
        return cls() if given is None else given

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as nested dict of what JSON can hold: all of them, None as None."""
        return {name: _plain(getattr(self, name), kind) for name, kind in kinds_of(type(self)).items()}

    @classmethod
    def from_dict(cls, given: Mapping[str, Any], source: str = "") -> Self:
        """Return the settings that nested tables hold; settings left out have their defaults.

        Parameters
        ----------
        given : mapping
            As `to_dict`, or a TOML file, gives it.
        source : str
            Name of the source, for messages.

        Raises
        ------
        SettingsError
            Listing every unknown key and every wrong value, with its path.
        """
        problems = Problems()
        built = build(cls, given, "", problems)
        problems.report(source or cls.__name__, SettingsError)
        assert built is not None
        return built

    @classmethod
    def from_layers(cls, layers: Sequence[tuple[str, Mapping[str, Any]]]) -> Self:
        """Return the settings that several sources give together: each is laid over those before it.

        Parameters
        ----------
        layers : sequence of (str, mapping)
            Name of the source for messages, such as a file, and its nested tables.

        Raises
        ------
        SettingsError
            Listing all problems of all sources, each with the source of the value.
        """
        tree: dict[str, Any] = {}
        origins: dict[str, str] = {}
        for origin, tables in layers:
            _lay_over(tree, tables, "", origin, origins)
        try:
            return cls.from_dict(tree, "settings")
        except SettingsError as error:
            raise SettingsError(error.source, [_with_origin(one, origins) for one in error.problems]) from None

    def _repr_html_(self) -> str:
        left = 'style="text-align:left"'
        rows = "".join(
            f"<tr><th {left}>{escape(path)}</th><td {left}>{escape(str(value))}</td></tr>"
            for path, value in flat("", self.to_dict())
        )
        return f"<p><b>{type(self).__name__}</b></p><table>{rows}</table>"

    def with_overrides(self, overrides: Mapping[str, object]) -> Self:
        """Return the settings with some values changed, such as ``{"fit.loss": "mean"}`` of settings of all stages.

        Parameters
        ----------
        overrides : mapping of str to object
            Dotted keys and their values, in the form that files have.

        Raises
        ------
        SettingsError
            Listing every problem.
        """
        return type(self).from_layers([("", self.to_dict()), *(("", nested(*item)) for item in overrides.items())])

    def to_toml(self, *, comments: bool = False) -> str:
        """Return all settings as the text of a TOML file, with `comments` also what each may be, None as the text."""
        tables = _without_none(self, self.to_dict(), say_none=comments)
        return toml_text(tables, comment=(lambda path: _about(self, path)) if comments else None)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Return the settings of a TOML file.

        Raises
        ------
        SettingsError
            Listing every problem, or that the file cannot be read.
        """
        return cls.from_dict(read_tables(path), str(path))

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write all settings to a TOML file.

        Raises
        ------
        FileExistsError
            If the file exists and `overwrite` is false.
        """
        with new_file(path, overwrite=overwrite) as temporary:
            temporary.write_text(self.to_toml(), encoding="utf-8")


def read_tables(path: str | os.PathLike[str]) -> Mapping[str, Any]:
    """Return the nested tables of a TOML file.

    Raises
    ------
    SettingsError
        If it cannot be read.
    """
    try:
        text = read_text(path)
    except (OSError, ValueError) as error:
        raise SettingsError(str(path), [Problem("", reason(error), "a TOML file")]) from error
    return _parsed(text, str(path))


def _parsed(text: str, source: str) -> Mapping[str, Any]:
    try:
        return parse_toml(text)
    except (ValueError, RecursionError) as error:
        raise SettingsError(source, [Problem("", f"not a TOML file: {error}", "")]) from error


def _plain(value: Any, kind: Any) -> Any:
    """Return a value as JSON has it."""
    if is_settings(kind):
        return {name: _plain(getattr(value, name), inner) for name, inner in kinds_of(type(value)).items()}
    return list(value) if isinstance(value, tuple) else value


def _about(settings: Any, path: str) -> str:
    """Return what the value at a dotted path may be."""
    first, _, rest = path.partition(".")
    value, kind = getattr(settings, first), kinds_of(type(settings))[first]
    return _about(value, rest) if rest else expected(kind)


def _without_none(settings: Any, tables: Mapping[str, Any], *, say_none: bool) -> dict[str, Any]:
    """Return tables without what is None by default, and the text where None is not the default, or always."""
    without = dict(tables)
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_settings(kinds_of(type(settings))[field.name]):
            without[field.name] = _without_none(value, tables[field.name], say_none=say_none)
        elif value is None and default_of(field) is None and not say_none:
            del without[field.name]
        elif value is None:
            without[field.name] = NONE
    return without


def _lay_over(tree: dict[str, Any], tables: Mapping[str, Any], path: str, origin: str, origins: dict[str, str]) -> None:
    """Lay tables over others."""
    for name, value in tables.items():
        origins[f"{path}{name}"] = origin
        if not isinstance(value, Mapping):
            tree[name] = value
            continue
        old = tree.get(name)
        below = dict(old) if isinstance(old, Mapping) else {}
        _lay_over(below, value, f"{path}{name}.", origin, origins)
        tree[name] = below


def _with_origin(problem: Problem, origins: Mapping[str, str]) -> Problem:
    """Return a problem with the source of the value before its path, if that is known."""
    path = problem.path.partition("[")[0]
    while path and path not in origins:
        path = path.rpartition(".")[0]
    origin = origins.get(path)
    return problem._replace(path=f"{origin}: {problem.path}") if origin else problem
