"""The detector as an immutable dataclass of its parts."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cgemit.detector import check, text
from cgemit.detector.field import Field
from cgemit.detector.material import Material
from cgemit.detector.parts import CgemLayer, Cylinder, DriftChamber
from cgemit.problems import DetectorError


@dataclass(frozen=True, kw_only=True)
class Detector:
    """A complete detector, parts ordered from the beam line outward.

    Raises
    ------
    DetectorError
        With every problem, if parts overlap, strips do not fit, or a value is out of its range.

    """

    name: str
    description: str
    field: Field
    beam_pipe: tuple[Cylinder, ...]
    cgem: tuple[CgemLayer, ...]
    walls: tuple[Cylinder, ...]
    drift_chamber: DriftChamber | None
    air: Material  # fills the space between parts inside the drift chamber

    def __post_init__(self) -> None:
        problems = check.value_problems(self) + check.geometry_problems(
            self.beam_pipe, self.cgem, self.walls, self.drift_chamber
        )
        if problems:
            raise DetectorError(self.name, problems)

    def __hash__(self) -> int:
        # What was made for a detector is looked up at every call, which the hash of all parts would slow down.
        return hash((self.name, self.description))

    def __repr__(self) -> str:
        return text.summary(self)

    def _repr_html_(self) -> str:
        return text.summary_html(self)

    def to_toml(self) -> str:
        """Return a complete detector file, without a base, that `load` reads back to an equal detector."""
        from cgemit.detector.write import to_toml

        return to_toml(self)

    def with_overrides(self, overrides: dict[str, object]) -> "Detector":
        """Return a variant: dotted keys of the detector file and their values.

        For example ``{"cgem.L2.pitch_x": "500 um"}``. Strip counts and stereo angles that depend on a changed value
        are worked out anew.

        Raises
        ------
        DetectorError
            With every problem of the result.

        """
        from cgemit.detector.build import override

        return override(self, overrides)

    def with_field(self, source: "str | Path | Mapping[str, Any]") -> "Detector":
        """Return the same detector in another field: a preset (see `fields`), a map, a TOML file, or a table [field].

        Raises DetectorError with every problem of the field.
        """
        from cgemit.detector.build import replace_field

        return replace_field(self, source)
