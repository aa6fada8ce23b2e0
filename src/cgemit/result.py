"""What a run is made with, and what comes of it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from html import escape
from pathlib import Path
from typing import Any

from cgemit.cluster import ClusterSettings
from cgemit.detector import Detector
from cgemit.digitize import DigitizeSettings
from cgemit.fit import FitSettings, FitStatus
from cgemit.gun import Gun, Guns
from cgemit.io.folders import new_folder
from cgemit.record import gun_data, read_run, record, write_run
from cgemit.settings import SettingsData
from cgemit.simulate import SimulateSettings, TransportStatus
from cgemit.tables import Table
from cgemit.tables.table import what

TABLES = (
    *("particles", "truths", "steps", "wire_truths", "digis", "wire_hits", "clusters", "tracks", "residuals", "states"),
)


@dataclass(frozen=True, kw_only=True)
class Settings(SettingsData):
    """Settings of all stages.

    Raises
    ------
    SettingsError
        A ValueError that lists every stage that is given something else than its settings.
    """

    simulate: SimulateSettings = field(default_factory=SimulateSettings)
    digitize: DigitizeSettings = field(default_factory=DigitizeSettings)
    cluster: ClusterSettings = field(default_factory=ClusterSettings)
    fit: FitSettings = field(default_factory=FitSettings)


@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """All tables of a run, and what made them."""

    detector: Detector
    gun: Gun | Guns | None
    seed: int
    settings: Settings
    fit_detector: Detector | None = None
    """What the fit assumed, if that is not `detector`."""
    particles: Table
    truths: Table
    steps: Table
    wire_truths: Table
    digis: Table
    wire_hits: Table
    clusters: Table
    tracks: Table = field(default=None)  # type: ignore[assignment]
    """None where the run was saved without its fit."""
    residuals: Table | None = None
    states: Table | None = None
    timings: Mapping[str, float]
    """Seconds of each stage, summed over chunks, and `wall`, from start to end."""

    @property
    def tables(self) -> dict[str, Table]:
        """The tables by name."""
        return {name: getattr(self, name) for name in TABLES if getattr(self, name) is not None}

    def __eq__(self, other: object) -> bool:
        """Compare everything but the timings."""
        if not isinstance(other, Result):
            return NotImplemented
        mine, theirs = ((r.detector, r.fit_detector, r.gun, r.seed, r.settings, r.tables) for r in (self, other))
        return mine == theirs

    def removed(self) -> dict[str, int]:
        """Count the tracks of each status other than ok."""
        status = self.tracks["status"]
        return {s.name: n for s in FitStatus if s != FitStatus.ok and (n := int((status == s).sum()))}

    def transport(self) -> dict[str, int]:
        """Count the particles of each transport status."""
        status = self.particles["status"]
        return {s.name: n for s in TransportStatus if (n := int((status == s).sum()))}

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False, command: str = "") -> list[Path]:
        """Write the run to a folder, from which `load` reads it back.

        Every table as .npz, with tables.json beside them; detector.toml; and run.json, which holds what the tables
        depend on: detectors, gun, seed, settings of all stages, versions, configuration hash.

        Parameters
        ----------
        folder : path
        overwrite : bool
            Whether the folder may hold files already. Those of the same name are replaced.
        command : str
            The command line that run.json shall name, if there was one.

        Returns
        -------
        list of Path

        Raises
        ------
        OutputExistsError
            If the folder holds files and `overwrite` is false.
        """
        about = {"events": self.particles.n_events, "first_event": self.particles.first_event}
        entries = record(
            detectors=detectors_of(self.detector, self.fit_detector), settings=self.settings, seed=self.seed,
            source=gun_data(self.gun), command=command, **about, timings=dict(self.timings),
        )  # fmt: skip
        with new_folder(folder, overwrite=overwrite) as place:
            names = [path.name for path in write_run(place, self.tables, entries)]
        return [Path(folder) / name for name in names]

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Result:
        """Read what `save`, or ``cgemit simulate``, wrote: an equal result.

        Parameters
        ----------
        folder : path

        Raises
        ------
        FileNotFoundError
            If the folder holds no run.
        RecordError
            A ValueError that lists every file that is damaged, and every table that is not of the run that run.json
            describes.
        """
        required = [f.name for f in fields(cls) if f.name in TABLES and f.default is MISSING]
        run = read_run(Path(folder), Settings, TABLES, required)
        about: dict[str, Any] = {"gun": run.gun, "settings": run.settings, **run.detectors, **run.tables}
        return cls(seed=run.entries["seed"], timings=run.entries["timings"], **about)

    def _summary(self) -> list[tuple[str, str]]:
        shots = f"{self.gun!r}" if self.gun is not None else "given particles"
        rows = [("detector", self.detector.name), ("gun", shots), ("seed", str(self.seed))]
        rows.append(("events", f"{self.particles.n_events:,}"))
        rows.append(("transport", ", ".join(f"{n:,} {name}" for name, n in self.transport().items())))
        if "tracks" in self.tables:
            removed = ", ".join(f"{n:,} {name}" for name, n in self.removed().items()) or "none"
            rows.append(("tracks", f"{len(self.tracks):,} (not fitted: {removed})"))
        rows.append(("rows", ", ".join(f"{name} {len(table):,}" for name, table in self.tables.items())))
        rows.append(("hits", "assigned by truth"))
        rows.append(("time", f"{self.timings['wall']:.2f} s"))
        return rows

    def __repr__(self) -> str:
        return "\n".join(["Result", *(f"  {name:<10}{text}" for name, text in self._summary())])

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self._summary())
        return f"<table>{rows}</table>"


def detectors_of(detector: Detector, fit_detector: Detector | None) -> dict[str, Detector]:
    """Return the detectors of a run by what they are for, as run.json names them."""
    return {"detector": detector} | ({} if fit_detector is None else {"fit_detector": fit_detector})


def tracks_of(given: Result | Table) -> Table:
    """Return the tracks of a result, or the table of tracks itself.

    Parameters
    ----------
    given : Result or Table of kind "tracks"

    Raises
    ------
    TypeError
        If it is neither a result nor a table.
    ValueError
        If it is a table of another kind.
    """
    if isinstance(given, Result):
        return given.tracks
    if not isinstance(given, Table) or given.kind != "tracks":
        kind = ValueError if isinstance(given, Table) else TypeError
        raise kind(f"tracks: got {what(given)}, expected a table of kind 'tracks', or a Result")
    return given
