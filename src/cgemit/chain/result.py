"""The result of a run, in memory or in files; tables of files are read on first access."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.base.files import new_folder
from cgemit.chain.finders import seedless_layers
from cgemit.chain.record import Run, gun_data, read_run, record, write_about
from cgemit.chain.settings import (
    EVERY_RUN,
    TABLES,
    NotKeptError,
    Settings,
    detectors_of,
    finder_in,
    hits_by,
    left_out,
    mass_by,
)
from cgemit.detector import Detector
from cgemit.particles.gun import Guns, Source
from cgemit.reconstruction.find.ckf import BEYOND
from cgemit.simulation.transport import transport_counts
from cgemit.tables import SCHEMAS, Table, select_events
from cgemit.tables.check import refuse_wrong
from cgemit.tables.formats import check_format
from cgemit.tables.schema import FitStatus
from cgemit.tables.store import StoredTables, about_of, column_of, write_tables
from cgemit.tables.table import what
from cgemit.truth.match import counts_left_out, joined

#: Columns that `Result.tracks` takes from the matches.
_MATCHED = {column.name for column in SCHEMAS["matches"]} - {"event", "track"}


class _Stored:
    """One of the tables of a result; None where the run ended before it, or did not ask for it."""

    def __init__(self, name: str = "") -> None:
        self._name = name

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = self._name or name

    def __get__(self, result: Result | None, owner: type | None = None) -> Any:
        if result is None:
            return self
        if self._name in left_out(result.tables):
            kept = ", ".join(result.tables)
            raise NotKeptError(f"the run made the table {self._name!r}, but kept only {kept} (keep=)")
        return result.tables.get(self._name)


@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """All tables of a run, with its detector, gun, seed and settings.

    Attributes
    ----------
    detector : Detector
    gun : Gun, EventSample, Guns or None
        None: the particles were given.
    seed : int
    settings : Settings
    tables : mapping of str to Table
        By name, in the order of `TABLES`; each is also an attribute, None where the run did not make it, and an
        AttributeError where the run did not keep it. ``tracks`` holds the fitted tracks without the comparison with
        truth: the attribute `fitted`.
    timings : mapping of str to float
        Seconds of each stage, summed over chunks, and `wall`, from start to end.
    transported : mapping of str to int, or None
        Particles of each transport status, if the run did not keep their table.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=20)
    >>> result.n_events, len(result.tracks), result.rows["truths"]
    (20, 20, 60)
    >>> result.clusters.keys() >= {"phi", "z"}, result.detector.name
    (True, 'besiii-cgem')
    """

    detector: Detector
    gun: Source | Guns | None
    seed: int
    settings: Settings
    fit_detector: Detector | None = None
    tables: Mapping[str, Table]
    timings: Mapping[str, float]
    transported: Mapping[str, int] | None = None

    particles = _Stored()
    events = _Stored()
    decays = _Stored()
    truths = _Stored()
    steps = _Stored()
    wire_truths = _Stored()
    digis = _Stored()
    wire_hits = _Stored()
    clusters = _Stored()
    candidates = _Stored()
    candidate_hits = _Stored()
    searches = _Stored()
    refined_clusters = _Stored()
    refined_wire_hits = _Stored()
    fitted = _Stored("tracks")
    residuals = _Stored()
    states = _Stored()
    components = _Stored()
    start_times = _Stored()
    strip_times = _Stored()
    matches = _Stored()

    @property
    def tracks(self) -> Any:
        """The fitted tracks with the columns of their matches; None where the run did not fit."""
        if "tracks" not in self.tables or "matches" not in self.tables:
            return self.fitted
        return joined(self.fitted, self.matches)

    @property
    def fitted_hits(self) -> tuple[Table, Table]:
        """Clusters and wire hits as the last fit took them: as measured, or as the reconstruction refined them."""
        return self.fitted_clusters, self._fitted("wire_hits")

    @property
    def fitted_clusters(self) -> Table:
        """The clusters of `fitted_hits`."""
        return self._fitted("clusters")

    def _fitted(self, name: str) -> Table:
        refined = self.tables.get(f"refined_{name}")
        if refined is None:
            table: Table = getattr(self, name)
            return table
        return Table(name, refined.columns, meta=refined.meta, **refined.cover)

    @property
    def n_events(self) -> int:
        """Number of events, with and without rows."""
        return int(self._cover()["n_events"])

    @property
    def first_event(self) -> int:
        """Number of the first event."""
        return int(self._cover()["first_event"])

    def _cover(self) -> Mapping[str, Any]:
        return about_of(self.tables, next(iter(self.tables)))

    @property
    def rows(self) -> dict[str, int]:
        """Number of rows of each table."""
        return {name: about_of(self.tables, name)["rows"] for name in self.tables}

    def column(self, table: str, column: str) -> Any:
        """Return one column of a table, (n,) or (n, ...); of a run in files, the others are not read.

        Parameters
        ----------
        table, column : str
            ``tracks`` has the columns of the matches, too.

        Raises
        ------
        KeyError
            If there is no such table or column.
        """
        if table == "tracks" and "matches" in self.tables and column in _MATCHED:
            table = "matches"
        if table not in self.tables:
            raise KeyError(f"the result has no table {table!r}, only {', '.join(self.tables)}")
        return column_of(self.tables, table, column)

    def parts(self) -> Iterator[Result]:
        """Yield the results of the parts of a run in files, one after the other; of another run, the result itself.

        Links of a part count rows of its own tables. Each part's tables are read when they are asked for, so that
        the memory is that of one part.
        """
        if not isinstance(self.tables, StoredTables):
            yield self
            return
        for part in self.tables.parts():
            yield replace(self, tables=part, transported=None if "particles" in part else self.transported)

    @property
    def is_measured(self) -> bool:
        """Whether the events are of an experiment: nothing was simulated, and there is no truth."""
        return self.gun is None and "particles" not in self.tables and not self.transported

    @property
    def finder(self) -> str | None:
        """Name of the finder that assigned the hits to candidates; None where the run did not."""
        name = next((name for name in ("candidates", "tracks") if name in self.tables), None)
        return None if name is None else finder_in(about_of(self.tables, name)["meta"])

    @property
    def mass(self) -> str | None:
        """Particles whose masses finder and fit assumed, as text; None where the run made no candidates."""
        name = next((name for name in ("tracks", "candidates") if name in self.tables), None)
        return None if name is None else mass_by(about_of(self.tables, name)["meta"])

    def __eq__(self, other: object) -> bool:
        """Compare everything but the timings."""
        if not isinstance(other, Result):
            return NotImplemented
        mine, theirs = ((r.detector, r.fit_detector, r.gun, r.seed, r.settings, dict(r.tables)) for r in (self, other))
        return mine == theirs

    def select_events(self, first: int, stop: int) -> Result:
        """Return the result of the events ``first ... stop - 1``: all its tables, with links between their rows.

        Parameters
        ----------
        first, stop : int

        Raises
        ------
        IndexError
            If the run does not cover them.
        """
        return replace(self, tables=select_events(self.tables, first, stop))

    def to_awkward(self) -> dict[str, Any]:
        """Return every table as an awkward array with one list per event; links count rows within the event.

        ``tracks`` holds the columns of the matches, too.
        """
        return {name: table.to_awkward(self.tables) for name, table in self._matched().items()}

    def to_pandas(self) -> dict[str, Any]:
        """Return every table as a `pandas.DataFrame`; ``tracks`` holds the columns of the matches, too."""
        return {name: table.to_pandas() for name, table in self._matched().items()}

    def _matched(self) -> dict[str, Table]:
        return {**self.tables, **({"tracks": self.tracks} if "tracks" in self.tables else {})}

    def removed(self) -> dict[str, int]:
        """Count the tracks that resolutions leave out, by `FitStatus` and, of those that were fitted, `MatchStatus`.

        Those that are `unconstrained` are left out of momenta alone; they count as fitted elsewhere.
        """
        if "tracks" not in self.tables:
            return {}
        match = column_of(self.tables, "matches", "match") if "matches" in self.tables else None
        return counts_left_out(column_of(self.tables, "tracks", "status"), match)

    def large_chi2(self) -> int:
        """Count the tracks of status `large_chi2`; resolutions, pulls and efficiencies count them."""
        if "tracks" not in self.tables:
            return 0
        return int(np.count_nonzero(column_of(self.tables, "tracks", "status") == FitStatus.large_chi2))

    def beyond_search(self) -> int:
        """Count the events whose search for tracks left out seeds at a limit; 0 if the finder does not tell."""
        if "searches" not in self.tables:
            return 0
        return int((column_of(self.tables, "searches", "limits") & BEYOND != 0).sum())

    def transport(self) -> dict[str, int]:
        """Count the particles of each transport status."""
        if "particles" not in self.tables:
            return dict(self.transported or {})
        return transport_counts(column_of(self.tables, "particles", "status"))

    def save(
        self, folder: str | os.PathLike[str], *, overwrite: bool = False, command: str = "", format: str = "npz"
    ) -> list[Path]:
        """Write the run to a folder, from which `load` reads it back.

        Every table in a file of its name, with tables.json beside them; detector.toml, fit_detector.toml if the fit had
        another one, and the field map if it was a file; and run.json, which holds what the tables depend on: detectors,
        gun, seed, settings of all stages, versions, configuration hash.

        Parameters
        ----------
        folder : path
        overwrite : bool
            Whether to replace the results in a folder that holds nothing else.
        command : str
            Command line for run.json, if there was one.
        format : str
            Of the tables: "npz", "parquet" (needs pyarrow) or "root" (one TTree a file; needs uproot).

        Returns
        -------
        list of Path

        Raises
        ------
        OutputExistsError
            If the folder holds files and `overwrite` is false, or files that are not of earlier results or were
            changed.
        ValueError
            If the format is unknown, or needs a package that is not installed.
        """
        check_format(format)
        entries = self.entries(command)
        with new_folder(folder, overwrite=overwrite) as temporary:
            files = write_tables(self.tables, temporary, format)
            files += write_about(temporary, detectors_of(self.detector, self.fit_detector), entries)
            names = [path.name for path in files]
        return [Path(folder) / name for name in names]

    def entries(self, command: str = "") -> dict[str, Any]:
        """Return what run.json holds.

        Parameters
        ----------
        command : str
            Command line, if there was one.
        """
        entries = {"events": self.n_events, "first_event": self.first_event, "tables": list(self.tables)}
        if self.transported is not None:
            entries["transported"] = dict(self.transported)
        return record(
            detectors=detectors_of(self.detector, self.fit_detector), settings=self.settings, seed=self.seed,
            source=gun_data(self.gun), command=command, **entries, timings=dict(self.timings),
        )  # fmt: skip

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Result:
        """Read what `save`, or ``cgemit simulate``, wrote: an equal result, with all its tables in memory.

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
        run = read_run(Path(folder), Settings, TABLES, EVERY_RUN)
        return result_of(run, {name: run.tables[name] for name in TABLES if name in run.tables})

    def _summary(self) -> list[tuple[str, str]]:
        rows = [("detector", self.detector.name)]
        if self.is_measured:
            rows.append(("gun", "none: measured events"))
        else:
            rows.append(("gun", f"{self.gun!r}" if self.gun is not None else "given particles"))
            rows.append(("seed", str(self.seed)))
        rows.append(("events", f"{self.n_events:,}"))
        if not self.is_measured:
            rows.append(("transport", ", ".join(f"{n:,} {name}" for name, n in self.transport().items())))
        if "tracks" in self.tables:
            removed = ", ".join(f"{n:,} {name}" for name, n in self.removed().items()) or "none"
            large = f"; large chi-square: {n:,}" if (n := self.large_chi2()) else ""
            rows.append(("tracks", f"{self.rows['tracks']:,} (left out: {removed}{large})"))
        rows.append(("rows", ", ".join(f"{name} {number:,}" for name, number in self.rows.items())))
        if self.finder is not None:
            rows.append(("hits", hits_by(self.finder)))
        if self.mass is not None:
            rows.append(("mass", self.mass))
        if missing := seedless_layers(self.finder, self.fit_detector or self.detector, self.settings):
            rows.append(("seeds", missing))
        if beyond := self.beyond_search():
            rows.append(("search", f"{beyond:,} {'event' if beyond == 1 else 'events'} beyond the search"))
        rows.append(("time", f"{self.timings['wall']:.2f} s"))
        return rows

    def __repr__(self) -> str:
        return "\n".join(["Result", *(f"  {name:<10}{text}" for name, text in self._summary())])

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self._summary())
        return f"<table>{rows}</table>"


def result_of(run: Run[Settings], tables: Mapping[str, Table]) -> Result:
    """Return the result of a run that was read, with its own tables or the given ones."""
    fields: dict[str, Any] = {"gun": run.gun, "settings": run.settings, **run.detectors}
    fields |= {name: run.entries[name] for name in ("seed", "timings")} | {
        "transported": run.entries.get("transported")
    }
    return Result(tables=tables, **fields)


def open(folder: str | os.PathLike[str]) -> Result:
    """Return the run of a folder, without reading its tables: each is read when it is first asked for.

    `Result.parts` and `Result.column` read no more than a part or a column at a time, so that runs larger than the
    memory can be studied. `cgemit.resolution` and its neighbours use them.

    Parameters
    ----------
    folder : path
        What `Result.save`, ``run(..., output=)`` or ``cgemit simulate`` wrote.

    Returns
    -------
    Result

    Raises
    ------
    FileNotFoundError
        If the folder holds no complete run.
    RecordError
        A ValueError that lists what is damaged in run.json and tables.json, and which files are missing. A damaged
        table raises a ValueError when it is read.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=20)
    >>> files = result.save("run")
    >>> cg.open("run").tracks == result.tracks
    True
    """
    run = read_run(Path(folder), Settings, TABLES, EVERY_RUN, lazy=True)
    return result_of(run, run.tables)


class TrackColumns:
    """Columns of the tracks of a run by name, with those of their matches; of a run in files only these are read."""

    def __init__(self, result: Result) -> None:
        self._result = result
        self._columns: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._columns:
            self._columns[name] = self._result.column("tracks", name)
        return self._columns[name]


def track_columns(given: Result | Table) -> Table | TrackColumns:
    """Return the tracks of a result, or a table of tracks with their truth, by columns.

    Parameters
    ----------
    given : Result or Table of kind "tracks"

    Raises
    ------
    TypeError, ValueError
        As `tracks_of`, or if the table does not say what is true.
    """
    if isinstance(given, Result) and "tracks" in given.tables:
        return TrackColumns(given)
    tracks = tracks_of(given)
    if not {"res_dr", "match"} <= tracks.keys():
        raise ValueError(
            "tracks: got none with truth (match, res_dr, pull_dr ...), expected those of a run; cg.match compares "
            "fitted tracks with particles"
        )
    return tracks


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
        If it is a table of another kind or with wrong values, or a result without tracks.
    """
    if isinstance(given, Result):
        if "tracks" not in given.tables:
            raise ValueError("tracks: the result has none, since the run ended before the fit")
        tracks: Table = given.tracks
        return tracks
    if not isinstance(given, Table) or given.kind != "tracks":
        kind = ValueError if isinstance(given, Table) else TypeError
        raise kind(f"tracks: got {what(given)}, expected a table of kind 'tracks', or a Result")
    refuse_wrong("tracks", ignore=("cov",), tracks=given)
    return given
