"""Settings of the background, and the level of a detector that they ask for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cgemit.detector import Detector
from cgemit.detector.background import BackgroundLevel
from cgemit.kinds import Check
from cgemit.problems import did_you_mean
from cgemit.settings import SettingsData

Level = Annotated[str, Check(lambda value: 0 < len(value) <= 100, "off, or the label of a level of the detector")]
Factor = Annotated[float, Check(lambda value: 0 <= value <= 100, "a number from 0 to 100")]
Time = Annotated[float, Check(lambda value: abs(value) <= 1e6, "a time in ns, within +-1e6")]
StartTime = Annotated[float, Check(lambda value: 0 <= value <= 1e3, "a time in ns from 0 to 1000")]
Offset = tuple[Time, Time]
Share = Annotated[float, Check(lambda value: 0 <= value <= 0.6, "a share from 0 to 0.6")]


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings(SettingsData):
    """Background that is added to the digis and wire hits of every event.

    Attributes
    ----------
    level : str
        ``"off"``, or a table ``[background.LEVEL]`` of the detector. BESIII detectors have ``"bes2009"``, cells of the
        drift chamber from random triggers, and clusters of the CGEM at rates extrapolated from them, and
        ``"bes2026"``, with noise of single strips as well.
    factor : float
        All rates are multiplied by it, up to 100. Times `cells` it is a share, up to 0.6.
    cells : float
        If above 0: share of the cells of every layer that fire within the drift time, instead of the level's rates.
    clumps : bool
        Whether cells fire in clumps of neighbours, as measured, or each for itself.
    events : str
        Folder of a run whose digis and wire hits are mixed in, a random event of it in each event; empty: none.
    offset : (float, float)
        ns, range of the time of these events, uniform.
    start_time : float
        ns, standard deviation of the start time of the event: all drift times of an event are wrong by the same number.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    level: Level = "off"
    factor: Factor = 1.0
    cells: Share = 0.0
    clumps: bool = True
    events: str = ""
    offset: Offset = (0.0, 0.0)
    start_time: StartTime = 0.0

    def contradictions(self) -> list[str]:
        """Return what does not go together."""
        problems = []
        if isinstance(self.offset, tuple) and len(self.offset) == 2 and self.offset[0] > self.offset[1]:
            problems.append(f"offset: got {self.offset}, expected a range from low to high")
        numbers = [value for value in (self.factor, self.cells) if isinstance(value, int | float)]
        if len(numbers) == 2 and self.cells * self.factor > 0.6:
            problems.append(f"cells: got {self.cells:g}, times factor {self.factor:g}, expected a product up to 0.6")
        return problems

    @property
    def is_off(self) -> bool:
        """Whether no cell and no strip is added; events may still be mixed in, and the start time be wrong."""
        return (self.level == "off" and self.cells == 0) or self.factor == 0


def level_of(detector: Detector, settings: BackgroundSettings) -> BackgroundLevel | None:
    """Return the level that settings ask for; None for ``"off"``.

    Parameters
    ----------
    detector : Detector
    settings : BackgroundSettings

    Raises
    ------
    ValueError
        If the detector has no such level.
    """
    if settings.level == "off":
        return None
    levels = {level.label: level for level in detector.background}
    if settings.level in levels:
        return levels[settings.level]
    known = ", ".join(["off", *levels])
    missing = "" if levels else f"; {detector.name} has no table [background.{settings.level}]"
    hint = did_you_mean(settings.level, levels, "; ")
    raise ValueError(f"background.level: got {settings.level!r}, expected one of {known}{missing}{hint}")
