"""Runs in files, of which no more is read than is asked for."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from cgemit.record import read_run
from cgemit.result import Result, result_of
from cgemit.stages import EVERY_RUN, TABLES, Settings
from cgemit.tables import Table
from cgemit.tables.table import what


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
    """Return the tracks of a result, or a table of tracks, by columns; raises as `tracks_of`.

    Parameters
    ----------
    given : Result or Table of kind "tracks"
    """
    if isinstance(given, Result) and "tracks" in given.tables:
        return TrackColumns(given)
    return tracks_of(given)


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
        If it is a table of another kind, or a result without tracks.
    """
    if isinstance(given, Result):
        if "tracks" not in given.tables:
            raise ValueError("tracks: the result has none, since the run ended before the fit")
        tracks: Table = given.tracks
        return tracks
    if not isinstance(given, Table) or given.kind != "tracks":
        kind = ValueError if isinstance(given, Table) else TypeError
        raise kind(f"tracks: got {what(given)}, expected a table of kind 'tracks', or a Result")
    return given
