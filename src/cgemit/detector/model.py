"""The detector as an immutable, checked dataclass of its parts, and how it is made from files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cgemit.detector import check, describe
from cgemit.detector.build import read_contents
from cgemit.detector.files import field_tables, merged, open_source, place_map, resolve, set_path
from cgemit.detector.parts import Contents
from cgemit.detector.read import shown
from cgemit.problems import DetectorError, Problem


@dataclass(frozen=True, kw_only=True)
class Detector(Contents):
    """A complete detector, parts ordered from the beam line outward.

    Raises
    ------
    DetectorError
        With every problem, if parts overlap, strips do not fit, or a value is out of its range.

    """

    def __post_init__(self) -> None:
        problems = check.value_problems(self) + check.geometry_problems(
            self.beam_pipe, self.cgem, self.walls, self.drift_chamber
        )
        if problems:
            raise DetectorError(self.name, problems)

    def __hash__(self) -> int:
        # Caches look up the detector at every call; the hash of all parts would slow this down.
        return hash((self.name, self.description))

    def __repr__(self) -> str:
        return describe.summary(self)

    def _repr_html_(self) -> str:
        return describe.summary_html(self)

    def to_toml(self) -> str:
        """Return a complete detector file, without a base, that `load` reads back to an equal detector."""
        return describe.to_toml(self)

    def with_overrides(self, overrides: dict[str, object]) -> "Detector":
        """Return a variant: dotted keys of the detector file and their values.

        For example ``{"cgem.L2.pitch_x": "500 um"}``. Strip counts and stereo angles that depend on a changed value
        are recomputed.

        Raises
        ------
        DetectorError
            With every problem of the result.

        """
        return override(self, overrides)

    def with_field(self, source: "str | Path | Mapping[str, Any]") -> "Detector":
        """Return the same detector in another field: a preset (see `fields`), a map, a TOML file, or a table [field].

        Raises DetectorError with every problem of the field.
        """
        return replace_field(self, source)


def load(source: str | Path | Mapping[str, Any] | Detector) -> Detector:
    """Return the detector that a preset, a detector file or a mapping of the same form describes.

    Parameters
    ----------
    source : str, Path, mapping or Detector
        Name of a preset (see `detectors`), path to a TOML file, or tables as `tomllib` returns them; a `Detector`
        is returned as it is.

    Raises
    ------
    DetectorError
        With all problems of the description.

    """
    if isinstance(source, Detector):
        return source
    opened = open_source(source)
    problems: list[Problem] = []
    try:
        tables = resolve(opened, problems)
    except RecursionError:
        raise DetectorError(opened.name, [Problem("", "tables in tables in tables ...", "fewer levels")]) from None
    if "name" not in opened.tables:
        tables["name"] = Path(opened.name).stem
    if "description" not in opened.tables:
        base = opened.tables.get("base")
        tables["description"] = f"variant of {base}" if base else ""
    return build(opened.name, tables, problems)


def override(detector: Detector, overrides: Mapping[str, object]) -> Detector:
    """Return the detector with some values changed; see `Detector.with_overrides`."""
    problems: list[Problem] = []
    variant: dict[str, Any] = {}
    for path, value in overrides.items():
        if path == "base":
            problems.append(Problem(path, shown(value), "a value of the detector; load another base instead"))
        elif not set_path(variant, path, value):
            problems.append(Problem(path, shown(value), "a value whose table is not itself overridden by a value"))
    tables = merged(describe.to_dict(detector), place_map(variant, None), problems)
    if "name" not in variant and overrides:
        tables["name"] = detector.name.removesuffix("-modified") + "-modified"
    return build(detector.name, tables, problems)


def replace_field(detector: Detector, source: str | Path | Mapping[str, Any]) -> Detector:
    """Return the detector in another field; see `Detector.with_field`."""
    tables = describe.to_dict(detector) | {"field": field_tables(source)}
    return build(detector.name, tables | {"name": detector.name.removesuffix("-modified") + "-modified"}, [])


def build(source: str, tables: Mapping[str, Any], problems: list[Problem]) -> Detector:
    """Return the detector that complete tables describe; `problems` are those found before.

    Raises
    ------
    DetectorError
        With `problems` and all others of the tables.

    """
    contents = read_contents(source, tables, problems)
    try:
        return Detector(**vars(contents))
    except DetectorError as error:
        raise DetectorError(source, error.problems) from None
