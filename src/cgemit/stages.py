"""The stages of a run: their names, their tables, their settings, and what a run may be asked for."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

from cgemit.background import BackgroundSettings
from cgemit.candidates import Finder, finder_name
from cgemit.cluster import ClusterSettings
from cgemit.detector import Detector
from cgemit.digitize import DigitizeSettings, Readout
from cgemit.find.settings import FindSettings
from cgemit.fit import FitSettings
from cgemit.problems import did_you_mean
from cgemit.settings import SettingsData
from cgemit.simulate import SimulateSettings
from cgemit.tables import Table

FinderName = Literal["truth", "ckf"]
FinderLike = Finder | FinderName

FINDERS = ("truth", "ckf")  # by name; any function of (detector, clusters, wire_hits) is a finder, too
STAGES = ("simulate", "digitize", "cluster", "find", "fit")  # where a run can end

TABLES = (
    *("particles", "decays", "truths", "steps", "wire_truths", "digis", "wire_hits", "clusters"),
    *("candidates", "candidate_hits", "tracks", "residuals", "states", "matches"),
)

#: Tables of every run, wherever it ends.
EVERY_RUN = ("particles", "decays", "truths", "steps", "wire_truths")


@dataclass(frozen=True, kw_only=True)
class Settings(SettingsData):
    """Settings of all stages.

    Raises
    ------
    SettingsError
        A ValueError that lists every stage whose settings are of another class.
    """

    simulate: SimulateSettings = field(default_factory=SimulateSettings)
    digitize: DigitizeSettings = field(default_factory=DigitizeSettings)
    background: BackgroundSettings = field(default_factory=BackgroundSettings)
    cluster: ClusterSettings = field(default_factory=ClusterSettings)
    find: FindSettings = field(default_factory=FindSettings)
    fit: FitSettings = field(default_factory=FitSettings)


def fit_settings(settings: Settings) -> FitSettings:
    """Return the settings of the fit; a screening of None becomes the simulated one.

    Parameters
    ----------
    settings : Settings
    """
    return settings.fit if settings.fit.screening else replace(settings.fit, screening=settings.simulate.screening)


def with_readout(settings: Settings, readout: Readout | str | None) -> Settings:
    """Return settings with another read-out, and with the ionization clusters that it needs.

    Parameters
    ----------
    settings : Settings
    readout : Readout, str or None
        None: that of the settings.

    Raises
    ------
    ValueError
        If the read-out is unknown, or the simulation cannot make what it needs.
    """
    if readout is not None:
        digitized = DigitizeSettings(readout=readout, reveal_sides=settings.digitize.reveal_sides)
        settings = replace(settings, digitize=digitized)
    if getattr(settings.digitize.readout, "needs_clusters", False) and not settings.simulate.steps:
        settings = replace(settings, simulate=replace(settings.simulate, steps=True))
    return settings


def tables_made(until: str, settings: Settings) -> tuple[str, ...]:
    """Return the tables that a run makes.

    Parameters
    ----------
    until : str
        Its last stage.
    settings : Settings
    """
    fitted = ("tracks", *(name for name in ("residuals", "states") if getattr(settings.fit, name)), "matches")
    by_stage = (EVERY_RUN, ("digis", "wire_hits"), ("clusters",), ("candidates", "candidate_hits"), fitted)
    return tuple(name for names in by_stage[: STAGES.index(until) + 1] for name in names)


def check_calibration(detector: Detector | None, settings: Settings | None, until: object) -> None:
    """Raise an error if the read-out needs a calibration that there is not, before anything is simulated."""
    if detector is None or settings is None or until not in STAGES[2:]:
        return
    readout = settings.digitize.readout
    if hasattr(readout, "calibration"):
        readout.expected_errors(detector)


def check_request(
    finder: object, until: object, executor: Executor | None, keep: Any, settings: Settings | None
) -> tuple[str, ...] | None:
    """Raise an error if a run cannot be as asked for; return the tables to be kept, None for all."""
    problems = []
    names = [keep] if isinstance(keep, str) else [] if keep is None else list(keep)
    problems += [
        f"keep: got {name!r:.50}, expected some of {', '.join(TABLES)}{did_you_mean(str(name), TABLES, '; ')}"
        for name in names
        if name not in TABLES
    ]
    if keep is not None and not names:
        problems.append("keep: got no table, expected at least one")
    if not callable(finder) and finder not in FINDERS:
        problems.append(
            f"finder: got {finder!r}, expected 'truth', 'ckf' or a function of (detector, clusters, wire_hits)"
        )
    if until not in STAGES:
        problems.append(f"until: got {until!r}, expected one of {', '.join(map(repr, STAGES))}")
    elif settings is not None:
        made = tables_made(str(until), settings)
        missing = [name for name in names if name in TABLES and name not in made]
        if missing:
            problems.append(f"keep: got {', '.join(missing)}, which this run does not make, only {', '.join(made)}")
    if problems:
        raise ValueError("run:\n  " + "\n  ".join(problems))
    if callable(finder) and isinstance(executor, ProcessPoolExecutor):
        try:
            pickle.dumps(finder)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise TypeError(
                f"finder: got {finder_name(finder)}, which cannot be sent to other processes ({error}); "
                "expected a function of a module, or an executor of threads"
            ) from error
    return None if keep is None else (*names, *(["matches"] if "tracks" in names else []))


def expected_settings(given: object) -> str:
    """Return the expected form of settings; those of one stage go into `Settings`."""
    stage = next((f.name for f in fields(Settings) if type(given) is f.default_factory), "")
    return (
        f"Settings({stage}=...)"
        if stage
        else "Settings(simulate=..., digitize=..., background=..., cluster=..., find=..., fit=...)"
    )


def finder_of(table: Table) -> str:
    """Return the name of the finder of the candidates or tracks of a table; ``"given"`` if it has none.

    Parameters
    ----------
    table : Table
        Of candidates, of their hits, or of fitted tracks.
    """
    return finder_in(table.meta)


def finder_in(meta: Mapping[str, Any]) -> str:
    """Return the name of the finder in the metadata of a table, as `finder_of`."""
    return str(meta.get("finder", "given"))


def hits_text(table: Table) -> str:
    """Return how hits came to their tracks, for reports.

    Parameters
    ----------
    table : Table
        As in `finder_of`.
    """
    return hits_by(finder_of(table))


def hits_by(name: str) -> str:
    """Return how the hits of a finder of this name came to their tracks, as `hits_text`."""
    return {"truth": "assigned by truth", "given": "given with their candidates"}.get(name, f"found by {name}")
