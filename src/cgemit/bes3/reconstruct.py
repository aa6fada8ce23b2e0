"""Events of BESIII from fired cells and strips to tracks, with nothing of the experiment's reconstruction needed."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from cgemit.analysis.hits import hit_residuals
from cgemit.base.arrays import Flags, Floats
from cgemit.base.files import new_file
from cgemit.bes3.events import Bes3Events, strip_numbers
from cgemit.bes3.wires import all_wire_hits, find_start_times
from cgemit.chain.finders import finder_by_name
from cgemit.chain.record import table_meta
from cgemit.chain.result import Result
from cgemit.chain.settings import TABLES, Settings, detectors_of, fit_settings
from cgemit.detector import Detector
from cgemit.detector.parts import cgem_numbers
from cgemit.detector.readouts import AnalogReadout
from cgemit.helix import wrap_angle
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.reconstruct import reconstruct
from cgemit.reconstruction.refine import MOST_STEP, StartTimeStatus, refinements
from cgemit.reconstruction.states import crossings_of
from cgemit.reconstruction.strip_times import from_start, strip_times
from cgemit.tables import Table
from cgemit.tables.formats import plain_columns, write_columns
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, XV_CLUSTER, is_fitted
from cgemit.tables.show import write_csv

#: Turns of finding and fitting the start times from wires alone, and the step, ns, that ends them.
TURNS, STAYS = 5, 0.5
#: Distances in X and z, mm, within which a cluster may belong to a track of wires.
NEAR = (5.0, 15.0)


def reconstruct_events(
    events: Bes3Events,
    settings: Settings | None = None,
    *,
    points: Literal["strips", "file"] | None = None,
    start_time: npt.ArrayLike | None = None,
) -> Result:
    """Find and fit the tracks of events of the experiment from all fired cells, and from strips or clusters.

    Tracks of wires alone tell the start time of each event. They are found again with it, until it stays: hits depend
    on nanoseconds. The times of strips follow from the start times and one constant between both electronics, which
    `strip_times` fits. Strips then become clusters, and tracks are found and fitted with clusters and wires.

    Parameters
    ----------
    events : Bes3Events
        Of `read_events`.
    settings : Settings or None
        Of clusters, finder, fit and refinements; in any case, drift times are raw, start times are fitted, and clusters
        compete for tracks.
    points : str or None
        ``"strips"``: clusters are made of the fired strips, with the readout of the detector. ``"file"``: the clusters
        of the file. None: those of the file if it has some.
    start_time : array_like, (events,) float64, or None
        First guess of the start of each event in the readout window, ns. None: that of the file, or where it has none
        that of `find_start_times`.

    Returns
    -------
    Result
        Without particles. ``start_times`` has the start of each event in the readout window of the wires, and
        ``strip_times`` that in the times of the strips. Events without a start time have no wire hits.

    Raises
    ------
    ValueError
        If there is another number of start times than of events, or no fired cells.
    """
    if not len(events.wire_digis["event"]):
        raise ValueError(
            "reconstruct: the events have no fired cells, as those of a .dst file; expected a .raw, .rec or .rtraw file"
        )
    begin = time.perf_counter()
    settings = Settings.of(settings)
    refine = replace(settings.refine, drift_times="raw", start_time="fitted", points="compete")
    settings = replace(settings, refine=refine)
    made, start = _steady(events, _guess(events, start_time), settings)
    of_wires = made["start_times"]
    wires = all_wire_hits(events, start)
    tables: dict[str, Table] = {"digis": events.digis, "wire_hits": wires, "clusters": events.clusters}
    if points == "strips" or (points is None and not len(events.clusters)):
        known = 0
        while (fitted := _fitted(made)).sum() > known:  # clusters may give further events a start time
            known = fitted.sum()
            tables |= _of_strips(events, settings, np.where(fitted, start + made["start_times"]["start_time"], np.nan))
            made = _tracks(events, tables["clusters"], wires, settings)
    elif len(events.clusters):
        made = _tracks(events, events.clusters, wires, settings)
    tables |= made | {"start_times": _absolute(made["start_times"], of_wires, start)}
    detector = events.detector
    about = table_meta(detectors_of(detector, None), settings, 0, None)
    seconds = time.perf_counter() - begin
    return Result(
        detector=detector, gun=None, seed=0, settings=settings, timings={"find": seconds, "wall": seconds},
        tables={name: tables[name].with_meta(**about) for name in TABLES if name in tables},
    )  # fmt: skip


@dataclass(frozen=True)
class PointOffset:
    """Where the points of a layer are, seen from the tracks of wires.

    Attributes
    ----------
    label : str
        Of the layer.
    n : int
        Tracks with a cluster nearby.
    x, err_x : float
        mm, mean of X minus that of the track, and the error of the mean; NaN with fewer than two tracks.
    z, err_z : float
        mm, the same along the beam.
    """

    label: str
    n: int
    x: float
    err_x: float
    z: float
    err_z: float


def point_offsets(events: Bes3Events, result: Result) -> list[PointOffset]:
    """Compare the clusters of each CGEM layer with tracks that are found and fitted with wires alone.

    A track counts with its nearest XV cluster, if X is within 5 mm of it and z within 15 mm. Offsets are those of the
    position of a layer, of the Lorentz shift and of the start time together, which one field does not tell apart.

    Parameters
    ----------
    events : Bes3Events
    result : Result
        Of `reconstruct_events`.
    """
    made = _tracks(events, events.clusters[:0], result.wire_hits, result.settings)
    tracks, points = made["tracks"][is_fitted(made["tracks"])], result.clusters[result.clusters["view"] == XV_CLUSTER]
    offsets = []
    for number in cgem_numbers(events.detector):
        layer = events.detector.layers[number]
        at = crossings_of(events.detector, tracks, number)
        here = points[points["layer"] == number]
        away = []
        for event, phi, z in zip(at.states["event"].tolist(), at.phi, at.z, strict=True):
            mine = here[here["event"] == event]
            dx = layer.r_readout * wrap_angle(mine["phi"] - phi)
            dz = mine["z"] - z
            near = (np.abs(dx) < NEAR[0]) & (np.abs(dz) < NEAR[1])
            if near.any():
                best = np.flatnonzero(near)[np.hypot(dx / NEAR[0], dz / NEAR[1])[near].argmin()]
                away.append((dx[best], dz[best]))
        distances = np.array(away).reshape(-1, 2)
        n = len(distances)
        enough = n > 1
        mean = distances.mean(axis=0) if enough else np.full(2, np.nan)
        error = distances.std(axis=0, ddof=1) / np.sqrt(n) if enough else np.full(2, np.nan)
        numbers = (float(mean[0]), float(error[0]), float(mean[1]), float(error[1]))
        offsets.append(PointOffset(layer.label, n, *numbers))
    return offsets


def aligned_layers(detector: Detector, offsets: Sequence[PointOffset]) -> Detector:
    """Return the detector with each CGEM layer turned and shifted along the beam, so that its points lie on the tracks.

    Offsets are those of the nearest clusters; where layers are off by millimetres, reconstruct again and repeat.

    Parameters
    ----------
    detector : Detector
        That the offsets were found with.
    offsets : sequence of PointOffset
        Layers with fewer than two tracks stay.
    """
    changes: dict[str, object] = {}
    for offset in offsets:
        if offset.n > 1:
            layer = detector.cgem[offset.label]
            changes[f"cgem.{offset.label}.rotation"] = f"{layer.rotation - offset.x / layer.r_readout:.6g} rad"
            changes[f"cgem.{offset.label}.shift_z"] = f"{layer.shift_z - offset.z:.6g} mm"
    return detector.with_overrides(changes)


def numbered_tables(events: Bes3Events, result: Result) -> dict[str, dict[str, npt.NDArray[Any]]]:
    """Return tracks, points and residuals with the experiment's numbers of runs, events, layers, strips and wires.

    `run` and `number` are those of the event in the experiment, `event` that in the file, and `track` the row of
    ``tracks``, also of tracks that were not fitted (`status`).

    Parameters
    ----------
    events : Bes3Events
    result : Result
        Of `reconstruct_events`.

    Returns
    -------
    dict of str to dict of str to ndarray
        ``tracks``: one row for each; helix, covariance (`cov_0_0` ...), momentum, errors, numbers of hits, status, and
        `start_time_status` of the event (`StartTimeStatus`): other than 0, drift times count from a guess.

        ``points``: one row for each track and sheet with an X or a V cluster on it. `x_first`, `x_last`, `v_first`,
        `v_last` are the first and last strips (-1 without the cluster), then charges (fC), times (ns), X and V on the
        sheet with errors (mm), and phi (rad), z, r (mm) where X and V cross. `ambiguous` is 1 if another choice of
        clusters is nearly as likely.

        ``residuals``: one row for each hit of a fitted track, as `cgemit.study.hit_residuals`. `first` and `last` are
        strips, or the wire; `gid` counts the strips of the CGEM, or the wires of the chamber, from 0.
    """
    tracks = result.tracks
    about = {name: tracks[name] for name in tracks if tracks[name].ndim == 1 and name not in ("event", "candidate")}
    rows = np.arange(len(tracks))
    own = {"event": tracks["event"], "track": rows} | about | plain_columns({"cov": tracks["cov"]})
    own["start_time_status"] = result.start_times["status"][tracks["event"]]
    tables = {"tracks": own, "points": _points_on_tracks(result), "residuals": _numbered_residuals(result)}
    return {
        name: {"run": events.run[columns["event"]], "number": events.number[columns["event"]]} | columns
        for name, columns in tables.items()
    }


#: Formats of the files of `save_numbered`.
NumberedFormat = Literal["csv", "parquet", "root"]


def save_numbered(
    tables: Mapping[str, Mapping[str, npt.NDArray[Any]]], folder: str | os.PathLike[str], format: NumberedFormat = "csv"
) -> list[Path]:
    """Write the tables of `numbered_tables` for other programs, as ``bes3_tracks.csv`` and so on.

    Parameters
    ----------
    tables : mapping of str to mapping of str to ndarray
    folder : path
        Where there is no such file yet.
    format : str
        ``"csv"``, ``"parquet"`` (needs pyarrow) or ``"root"`` (one TTree a file; needs uproot).

    Returns
    -------
    list of Path

    Raises
    ------
    FileExistsError
        If there is one of the files.
    ValueError
        If the format is unknown, or needs a package that is not installed.
    """
    if format not in get_args(NumberedFormat):
        raise ValueError(f"format: got {format!r}, expected one of {', '.join(map(repr, get_args(NumberedFormat)))}")
    files = []
    for name, columns in tables.items():
        files.append(Path(folder) / f"bes3_{name}.{format}")
        with new_file(files[-1]) as path:
            if format == "csv":
                write_csv(path, columns, digits=9)
            else:
                write_columns(path, format, name, columns)
    return files


def _first_tracks(result: Result) -> npt.NDArray[np.int64]:
    """Return the first row of ``tracks`` of each candidate, -1 without one."""
    rows = np.full(len(result.candidates), -1, np.int64)
    rows[result.tracks["candidate"][::-1]] = np.arange(len(result.tracks))[::-1]
    return rows


def _points_on_tracks(result: Result) -> dict[str, npt.NDArray[Any]]:
    """Return the table ``points`` of `numbered_tables`, without the experiment's numbers of events."""
    clusters, hits = result.clusters, result.candidate_hits
    on = hits[(hits["view"] == HIT_X) | (hits["view"] == HIT_V)]
    crossing = clusters[(clusters["view"] == XV_CLUSTER) & (clusters["x_cluster"] >= 0)]
    pairs = zip(crossing["x_cluster"].tolist(), crossing["v_cluster"].tolist(), strict=True)
    of_pair = {pair: row for row, pair in enumerate(pairs)}
    keys = np.stack(
        [_first_tracks(result)[on["candidate"]], clusters["layer"][on["hit"]], clusters["sheet"][on["hit"]]]
    )
    (track, layer, sheet), place = np.unique(keys, axis=1, return_inverse=True)
    at = np.full((2, len(track)), -1, np.int64)  # rows of X and V
    at[on["view"], place.reshape(-1)] = on["hit"]
    ambiguous = np.zeros(len(track), np.int8)
    if "ambiguous" in on:
        np.maximum.at(ambiguous, place.reshape(-1), on["ambiguous"])

    def of(row: npt.NDArray[np.int64], name: str, none: float) -> npt.NDArray[Any]:
        column = clusters[name]
        return np.append(column, np.array(none, column.dtype))[row]  # the last one for row -1

    columns: dict[str, npt.NDArray[Any]] = {
        "event": result.tracks["event"][track], "track": track, "layer": layer, "sheet": sheet, "ambiguous": ambiguous
    }  # fmt: skip
    for view, row in zip("xv", at, strict=True):
        columns |= {f"{view}_{name}": of(row, name, -1) for name in ("first", "last")}
        columns |= {f"{view}_{name}": of(row, name, np.nan) for name in ("charge", "time")}
        columns |= {name: of(row, name, np.nan) for name in (view, f"err_{view}")}
    both = np.array([of_pair.get((x, v), -1) for x, v in at.T.tolist()], np.int64)
    columns |= {name: np.append(crossing[name], np.nan)[both] for name in ("phi", "err_phi", "z", "err_z")}
    return columns | {"r": np.array([one.r_mid for one in result.detector.layers], np.float64)[layer]}


def _numbered_residuals(result: Result) -> dict[str, npt.NDArray[Any]]:
    """Return the table ``residuals`` of `numbered_tables`, without the experiment's numbers of events."""
    hits = hit_residuals(result)
    wire, strip = hits.view == HIT_WIRE, hits.view != HIT_WIRE
    columns: dict[str, npt.NDArray[Any]] = {name: one for name, one in vars(hits).items() if name != "hit"}
    # The fit of the residuals has one track for each candidate.
    columns |= {"track": _first_tracks(result)[hits.track], "used": hits.used.astype(np.int8), "pull": hits.pull}
    for name, of_strips, of_wires in (("first", "first", "wire"), ("last", "last", "wire"), ("gid", None, "gid")):
        columns[name] = np.full(len(hits), -1, np.int64)
        columns[name][wire] = result.wire_hits[of_wires][hits.hit[wire]]
        if of_strips is not None:
            columns[name][strip] = result.clusters[of_strips][hits.hit[strip]]
    place = {name: columns[name][strip] for name in ("layer", "sheet", "view")} | {"strip": columns["first"][strip]}
    columns["gid"][strip] = strip_numbers(result.detector, place)
    return columns


def _absolute(times: Table, of_wires: Table, start: Floats) -> Table:
    """Return start times in the readout window; those of wires alone where tracks with clusters tell none."""
    good = times["status"] == StartTimeStatus.ok
    columns = {name: np.where(good, one, of_wires[name]) for name, one in times.columns.items()}
    return times.with_columns(**columns | {"start_time": start + columns["start_time"]})


def _fitted(made: Mapping[str, Table]) -> Flags:
    """Return which events have a start time that their tracks tell, (events,) bool."""
    return np.asarray(made["start_times"]["status"] == StartTimeStatus.ok)


def _of_strips(events: Bes3Events, settings: Settings, start: Floats) -> dict[str, Table]:
    """Return the clusters of the fired strips, and when the events began in their times if the readout has times."""
    detector, digis = events.detector, events.digis
    if not len(digis) or not any(isinstance(group.readout, AnalogReadout) for group in detector.groups):
        return {"clusters": cluster(detector, digis, settings.cluster)}
    times = strip_times(detector, digis, start)
    return {"strip_times": times, "clusters": cluster(detector, from_start(digis, times), settings.cluster)}


def _guess(events: Bes3Events, start_time: npt.ArrayLike | None) -> Floats:
    """Return the first guess of the start times, (events,) float64, ns."""
    if start_time is not None:
        guess = np.asarray(start_time, np.float64)
        if guess.shape != (len(events.run),):
            raise ValueError(f"start_time: got shape {guess.shape}, expected one for each of {len(events.run)} events")
        return guess
    if np.isfinite(events.start_time).all():
        return events.start_time
    return np.where(np.isfinite(events.start_time), events.start_time, find_start_times(events))


def _steady(events: Bes3Events, start: Floats, settings: Settings) -> tuple[dict[str, Table], Floats]:
    """Return tracks of wires, found again until the start times stay, and the start times that their hits have."""
    for _ in range(TURNS):
        made = _tracks(events, events.clusters[:0], all_wire_hits(events, start), settings)
        moved = np.where(_fitted(made), made["start_times"]["start_time"], 0.0)
        if np.abs(moved).max(initial=0.0) < STAYS:
            break
        start = start + np.clip(moved, -MOST_STEP, MOST_STEP)
    return made, start


def _tracks(events: Bes3Events, clusters: Table, wires: Table, settings: Settings) -> dict[str, Table]:
    """Find and fit tracks."""
    how: dict[str, Any] = {"refinements": refinements(settings.refine), "find_again": settings.refine.find_again}
    how["compete"] = settings.refine.points == "compete" and len(clusters) > 0
    finder = finder_by_name("ckf", settings)
    return reconstruct(events.detector, clusters, wires, finder, fit_settings(settings), **how)
