"""Events of the BESIII software as our tables (docs/how-to/real_events.md)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import helix
from cgemit.candidates import HIT_WIRE, HIT_X, XV_CLUSTER, label_candidates
from cgemit.detector import Detector, load
from cgemit.fit import FitStatus
from cgemit.fit_begins import displaced
from cgemit.io.bes3 import ENDINGS, Columns, columns_of_events, read_bes3
from cgemit.own_hits import hit_tables
from cgemit.particles import particles_from
from cgemit.species import KNOWN
from cgemit.tables import SCHEMAS, Table

Column = npt.NDArray[Any]

#: Errors of X and V of clusters, mm, which the files do not hold: the standard deviations of the 30 clusters of the
#: public simulated events from the truth (docs/how-to/real_events.md).
CLUSTER_ERRORS = (0.16, 0.15)


@dataclass(frozen=True, eq=False)
class Bes3Events:
    """Events of one file; all tables cover events 0 to n - 1 of the file, without rows where it has no such records.

    Attributes
    ----------
    detector : Detector
    run, number : ndarray, (n,) int64
        The experiment's numbers of run and event.
    clusters, wire_hits : Table
        Reconstructed clusters, and the hits on tracks; `track` is the number of the track, -1 none.
    candidates, candidate_hits : Table
        The hits of each track; the candidate's number is that of the track.
    mdc_tracks, kal_tracks : Table of kind "tracks"
        Tracks of the first fit, without matter (`hypothesis` 0), and of the Kalman filter, one row for each mass. Their
        `candidate` is -1 without hits. Fits that failed have the status not_converged.
    particles, truths, wire_truths : Table
        Generated particles of simulated events that are in our table of particles, and crossings of drift gaps and
        cells (`.rtraw`); their times are not read.
    digis : Table
        Fired strips with charge and time.
    """

    detector: Detector
    run: Column
    number: Column
    clusters: Table
    wire_hits: Table
    candidates: Table
    candidate_hits: Table
    mdc_tracks: Table
    kal_tracks: Table
    particles: Table
    truths: Table
    wire_truths: Table
    digis: Table

    def __repr__(self) -> str:
        tables = (name for name, one in vars(self).items() if isinstance(one, Table) and len(one))
        rows = ", ".join(f"{len(getattr(self, name))} {name}" for name in tables)
        return f"<{len(self.run)} events of the BESIII software for {self.detector.name}: {rows}>"


def read_events(
    path: str | os.PathLike[str],
    detector: Detector | str | Mapping[str, Any],
    *,
    errors: tuple[float, float] = CLUSTER_ERRORS,
    every_cluster: bool = False,
) -> Bes3Events:
    """Read a `.rec`, `.dst` or `.rtraw` file of the BESIII software (extra ``[bes3]``).

    Parameters
    ----------
    path : path
    detector : Detector, or what `load` accepts
        With the layers that the events have, such as ``"besiii-idc"`` before 2024 and ``"besiii-cgem"`` since.
    errors : (float, float)
        Standard deviations of X and V of the clusters, mm.
    every_cluster : bool
        Whether clusters that belong to no track count as hits of the track, where an event has one track.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged or no such file, or its hits are not those of the detector, or pybes3 is not installed.
    """
    path = Path(path)
    if path.suffix not in ENDINGS:
        raise ValueError(f"{str(path)[:80]!r} is no file of the BESIII software; expected one of {', '.join(ENDINGS)}")
    found, n_events = read_bes3(path)
    return tables_of(found, n_events, detector, errors=errors, every_cluster=every_cluster)


def events_of(
    arrays: Mapping[str, Any],
    detector: Detector | str | Mapping[str, Any],
    *,
    errors: tuple[float, float] = CLUSTER_ERRORS,
    every_cluster: bool = False,
) -> Bes3Events:
    """Return the same for collections of pybes3 that are read already.

    Parameters
    ----------
    arrays : mapping of str to awkward.Array
        By the names of `cgemit.io.bes3.COLLECTIONS`, such as ``"hits"`` for m_recMdcHitCol.
    detector, errors, every_cluster
        As for `read_events`.
    """
    n_events = max((len(one) for one in arrays.values()), default=0)
    found = columns_of_events(arrays)
    return tables_of(found, n_events, detector, errors=errors, every_cluster=every_cluster)


def tables_of(
    found: Mapping[str, Columns],
    n_events: int,
    detector: Detector | str | Mapping[str, Any],
    *,
    errors: tuple[float, float],
    every_cluster: bool,
) -> Bes3Events:
    """Return the tables of the columns that `cgemit.io.bes3` reads; arguments as for `read_events`."""
    detector = load(detector)
    _check(found, detector, errors)
    clusters = _cluster_columns(detector, found.get("clusters"), errors)
    wires = found.get("wire_hits")
    if every_cluster and clusters is not None and wires is not None:
        clusters["candidate"] = _of_the_only_track(clusters, wires)
    hits = hit_tables(detector, clusters, wires, [], events=np.arange(n_events))
    numbers = [_track_numbers(hits[i], given) for i, given in enumerate((clusters, wires))]
    named = label_candidates(hits[0], hits[1], numbers[0], numbers[1])
    cover = {"n_events": n_events, "events": hits[0].cover["events"]}
    events = found.get("events", dict.fromkeys(("run", "number"), np.zeros(n_events, np.int64)))
    tracks = {name: _tracks(found.get(name), named, detector, cover) for name in ("mdc_tracks", "kal_tracks")}
    simulated = {name: _filled(name, found.get(name), detector, cover) for name in ("truths", "wire_truths", "digis")}
    return Bes3Events(
        detector=detector,
        run=events["run"],
        number=events["number"],
        clusters=hits[0].with_columns(track=numbers[0]),
        wire_hits=hits[1].with_columns(track=numbers[1]),
        particles=_particles(found.get("particles"), n_events),
        **named,
        **tracks,
        **simulated,
    )


def _check(found: Mapping[str, Columns], detector: Detector, errors: tuple[float, float]) -> None:
    """Raise an error that lists the layers of hits that the detector does not have, and wrong errors."""
    chamber = detector.drift_chamber.layers if detector.drift_chamber else ()
    known = {"wire_hits": [layer.number for layer in chamber], "clusters": list(range(len(detector.cgem)))}
    problems = []
    for name, layers in known.items():
        given = np.unique(found[name]["layer"]) if name in found else np.zeros(0, np.int64)
        other = sorted(set(given.tolist()) - set(layers))
        if other:
            has = f"layers {layers[0]} to {layers[-1]}" if layers else "no such layer"
            problems.append(
                f"{name}: got layers {', '.join(map(str, other))}; expected those of {detector.name}: {has}"
            )
    if len(errors) != 2 or not all(0 < error < np.inf for error in errors):
        problems.append(f"errors: got {errors}; expected two positive numbers, X and V in mm")
    if problems:
        raise ValueError("events of the BESIII software:\n  " + "\n  ".join(problems))


def _cluster_columns(detector: Detector, given: Columns | None, errors: tuple[float, float]) -> Columns | None:
    """Return clusters with X on the sheet and errors, as `hit_tables` takes them."""
    if given is None:
        return None
    columns = dict(given)
    starts = np.array([(*layer.sheet_phi, *layer.sheet_phi)[:2] for layer in detector.cgem])
    radius = np.array([layer.r_readout for layer in detector.cgem])[columns["layer"]]
    start = starts[columns["layer"], np.clip(columns["sheet"], 0, 1)]
    x = radius * np.remainder(columns["phi"] - start, 2 * np.pi)
    only_x = columns["view"] == HIT_X
    columns["x"] = np.where(only_x, x, np.nan)
    columns["err_x"] = np.where(np.isnan(columns["phi"]), np.nan, errors[0])
    columns["err_v"] = np.where(only_x, np.nan, errors[1])
    return columns


def _of_the_only_track(clusters: Columns, wires: Columns) -> Column:
    """Return the track of each cluster: points of no track belong to the only track of their event."""
    tracks = np.unique(np.stack([wires["event"], wires["candidate"]])[:, wires["candidate"] >= 0], axis=1)
    events, first, count = np.unique(tracks[0], return_index=True, return_counts=True)
    alone = dict(zip(events[count == 1].tolist(), tracks[1][first[count == 1]].tolist(), strict=True))
    free = (clusters["candidate"] < 0) & (clusters["view"] == XV_CLUSTER)
    only = np.array([alone.get(event, -1) for event in clusters["event"].tolist()], np.int64)
    return np.where(free, only, clusters["candidate"])


def _track_numbers(table: Table, given: Columns | None) -> Column:
    """Return the number of the track of each row."""
    return np.zeros(0, np.int64) if given is None else given["candidate"][table["given_row"]].astype(np.int64)


def _tracks(given: Columns | None, named: Mapping[str, Table], detector: Detector, cover: dict[str, Any]) -> Table:
    """Return tracks with the rows of the candidates that have their hits."""
    if given is None:
        return Table.empty("tracks", **cover)
    candidates, of_hits = named["candidates"], named["candidate_hits"]
    row = {key: i for i, key in enumerate(zip(candidates["event"], candidates["candidate"], strict=True))}
    keys = zip(given["event"], given["candidate"], strict=True)
    candidate = np.array([row.get(key, -1) for key in keys], np.int64).reshape(-1)
    wire = of_hits["view"] == HIT_WIRE
    counts = [np.bincount(of_hits["candidate"][mine], minlength=len(candidates) + 1) for mine in (~wire, wire)]
    fitted, cov = given["helix"], given["cov"]
    with np.errstate(invalid="ignore"):  # fits that failed
        error = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    columns: dict[str, npt.ArrayLike] = {name: given[name] for name in ("event", "hypothesis", "chi2", "ndf", "cov")}
    columns |= {"candidate": candidate, "track": given["candidate"], "p": helix.momentum(fitted)}
    columns |= {name: fitted[:, i] for i, name in enumerate(helix.PARAMETERS)}
    columns |= {f"err_{name}": error[:, i] for i, name in enumerate(helix.PARAMETERS)}
    columns |= {
        "n_clusters": counts[0][candidate],
        "n_wires": counts[1][candidate],
        "err_p": helix.momentum_error(fitted, cov),
        "displaced": displaced(fitted[:, 0], error[:, 0], detector),
    }
    columns["status"] = np.where(given["ok"], FitStatus.ok, FitStatus.not_converged)
    return Table(
        "tracks", columns | dict.fromkeys(("n_outliers", "iterations"), np.zeros(len(candidate), np.int64)), **cover
    )


def _particles(given: Columns | None, n_events: int) -> Table:
    """Return the generated particles that we know; quarks and resonances are left out."""
    if given is None:
        return Table.empty("particles", n_events)
    moves = (given["px"] != 0) | (given["py"] != 0) | (given["pz"] != 0)
    known = np.isin(given["pdg"], list(KNOWN)) & moves
    return particles_from({name: one[known] for name, one in given.items()}, n_events=n_events, first_event=0)


def _filled(kind: str, given: Columns | None, detector: Detector, cover: dict[str, Any]) -> Table:
    """Return a table of truth or digis, with the columns that follow from others, and none where nothing is known."""
    if given is None or not len(given["event"]):
        return Table.empty(kind, **cover)
    n, columns = len(given["event"]), dict(given)
    if kind == "truths":
        columns["r"] = np.array([layer.r_mid for layer in detector.cgem])[columns["layer"]]
    if kind == "digis":
        columns["gid"] = _strip_numbers(detector, columns)
        columns |= {"truth": np.full(n, -1)}
    for column in SCHEMAS[kind]:
        columns.setdefault(column.name, np.full(n, np.nan if column.dtype.kind == "f" else 0, column.dtype))
    return Table(kind, columns, **cover)


def _strip_numbers(detector: Detector, of: Columns) -> Column:
    """Return the numbers of strips in the whole CGEM."""
    strips = np.array([(layer.strips_x, layer.strips_v) for layer in detector.cgem])
    first = np.cumsum([0, *(layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem)])
    mine = strips[of["layer"]]
    return np.asarray(first[of["layer"]] + of["sheet"] * mine.sum(axis=1) + of["view"] * mine[:, 0] + of["strip"])
