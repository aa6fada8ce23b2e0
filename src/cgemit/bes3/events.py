"""Events of the BESIII software as tables (docs/how-to/real_events.md)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import helix
from cgemit.base.arrays import Column, Columns, Floats
from cgemit.base.errors import Problems, report
from cgemit.base.files import check_regular, package
from cgemit.detector import Detector, load
from cgemit.helix import wrap_angle
from cgemit.particles.species import KNOWN
from cgemit.particles.table import particles_from
from cgemit.reconstruction.candidates import label_candidates
from cgemit.reconstruction.fit import displaced, momentum_limits
from cgemit.reconstruction.given_hits import hit_tables
from cgemit.tables import SCHEMAS, Table
from cgemit.tables.schema import HIT_WIRE, HIT_X, XV_CLUSTER, FitStatus

_FLAGS, _STRIPS = 2, 4  # numbers in m_clusterflag and m_stripid


def clusters(of: dict[str, npt.NDArray[np.generic]]) -> dict[str, npt.NDArray[np.generic]]:
    """Return the fields of cluster records at their places.

    A record of 96 bytes has two words more than pybes3's fields of the shorter record. They are the lengths in front of
    `m_clusterflag` (2) and `m_stripid` (4), but pybes3 takes them for a field `m_recpositiony`: V is read as
    `m_recpositiony`, z as `m_recv`, and `m_recZ` holds a length and a flag. These lengths at their places tell such
    records apart from others, which stay as they are.

    Parameters
    ----------
    of : dict of str to ndarray
        Fields of pybes3's TRecCgemCluster, each (n, ...).
    """
    if "m_recpositiony" not in of or not len(of["m_recZ"]):
        return of
    words = np.ascontiguousarray(of["m_recZ"], ">f8").view(">i4").reshape(-1, 2)
    flags = np.asarray(of["m_clusterflag"])
    if not (np.all(words[:, 0] == _FLAGS) and np.all(flags[:, 1] == _STRIPS)):
        return of
    right = {"m_recv": of["m_recpositiony"], "m_recZ": of["m_recv"]}
    flag = np.stack([words[:, 1].astype(flags.dtype), flags[:, 0]], axis=1)
    return {name: one for name, one in of.items() if name != "m_recpositiony"} | right | {"m_clusterflag": flag}


def upper_triangles(matrices: npt.ArrayLike) -> Floats:
    """Return covariances of MdcTrack, (n, 5, 5).

    The software writes the upper triangle row by row (DstMdcTrack::setError), pybes3 fills the lower one row by row.
    Whichever order gives more positive definite matrices is right.

    Parameters
    ----------
    matrices : array_like, (n, 5, 5) float64
        As pybes3 returns them.
    """
    filled = np.array(matrices, np.float64).reshape(-1, 5, 5)
    below, above = np.tril_indices(5), np.triu_indices(5)
    moved = np.zeros_like(filled)
    moved[:, above[0], above[1]] = filled[:, below[0], below[1]]
    moved[:, above[1], above[0]] = filled[:, below[0], below[1]]
    return moved if _positive(moved) > _positive(filled) else filled


def _positive(matrices: Floats) -> int:
    """Return the number of positive definite matrices, whatever the units of their rows."""
    matrices = np.where(np.isfinite(matrices), matrices, 0.0)  # of fits that failed
    size = np.sqrt(np.abs(np.diagonal(matrices, axis1=1, axis2=2)))
    size = np.where(size > 0, size, 1.0)
    return int(np.count_nonzero(np.linalg.eigvalsh(matrices / (size[:, :, None] * size[:, None, :])).min(axis=1) > 0))


#: What files hold and what reads it, by the endings of their names.
ENDINGS: Mapping[str, str] = {
    ".rec": "digis, reconstructed hits, clusters and tracks (reconstruct, refit)",
    ".dst": "tracks, without hits (read_events)",
    ".rtraw": "digis and truth of simulated events (reconstruct)",
    ".raw": "digis as the detector was read out (reconstruct)",
}

#: Collections that are read, by our name; a file has one of the branches listed.
COLLECTIONS: Mapping[str, tuple[str, ...]] = {
    "run": ("TEvtHeader/m_runId",),
    "number": ("TEvtHeader/m_eventId",),
    "hits": ("TRecEvent/m_recMdcHitCol",),
    "clusters": ("TRecEvent/m_recCgemClusterCol",),
    "mdc_tracks": ("TRecEvent/m_recMdcTrackCol", "TDstEvent/m_mdcTrackCol"),
    "kal_tracks": ("TRecEvent/m_recMdcKalTrackCol", "TDstEvent/m_mdcKalTrackCol"),
    "particles": ("TMcEvent/m_mcParticleCol",),
    "cgem_truths": ("TMcEvent/m_cgemMcHitCol",),
    "mdc_truths": ("TMcEvent/m_mdcMcHitCol",),
    "cgem_digis": ("TDigiEvent/m_cgemDigiCol",),
    "mdc_digis": ("TDigiEvent/m_mdcDigiCol",),
    "start_times": ("TRecEvent/m_recEvTimeCol",),
}

#: PDG numbers of the masses of a Kalman track, in the order of its arrays, with the ends of the names of its helices.
HYPOTHESES = {11: "_e", 13: "_mu", 211: "", 321: "_k", 2212: "_p"}

_MM = 10.0  # in a cm
_GEV = 1e-3  # in MeV
_KEV = 1e3  # in MeV
_HELIX = np.array([_MM, 1.0, 1.0, _MM, 1.0])  # dr and dz in cm
_NOT_SET = -99.0  # of the software
_TDC = 3 / 32  # ns, a channel of the chamber's TDC, as drift times and channels of reconstructed hits tell
_NO_TIME = 0x7FFFFFFF
_SECONDARY = 1000  # added to the particle's number by a flag that the public simulation leaves to chance


def read_bes3(path: Path) -> tuple[dict[str, Columns], int]:
    """Return what a file holds as columns, and the number of its events.

    Returns
    -------
    tables : dict of str to dict of str to ndarray
        As `columns_of_events` returns them.
    n_events : int

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged or no file of the BESIII software, or pybes3 is not installed.
    """
    check_regular(path)
    pybes3 = package("pybes3", "bes3")  # teaches uproot the classes
    if path.suffix == ".raw":
        return _read_raw(pybes3, path)
    uproot = package("uproot", "bes3")
    try:
        with uproot.open(path) as file:
            tree = file["Event"]
            n_events = int(tree.num_entries)
            known = set(tree.keys())
            arrays = {
                name: tree[branch].array()
                for name, branches in COLLECTIONS.items()
                for branch in branches
                if branch in known
            }
    except FileNotFoundError:
        raise
    except Exception as error:  # of uproot and pybes3: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete file of the BESIII software ({error})") from error
    return columns_of_events(arrays), n_events


def _read_raw(pybes3: Any, path: Path) -> tuple[dict[str, Columns], int]:
    """Return what a file of the readout holds: numbers of runs and events, fired strips and fired cells."""
    try:
        with closing(pybes3.open_raw(str(path))) as file:
            arrays = file.arrays()
        header = arrays["evt_header"]
        collections = {"run": header["run_no"], "number": header["evt_no"], "mdc_digis": arrays["mdc"]}
        if "cgem" in arrays.fields:  # since 2024
            collections["cgem_digis"] = arrays["cgem"]
    except FileNotFoundError:
        raise
    except Exception as error:  # of pybes3: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete file of the BESIII readout ({error})") from error
    return columns_of_events(collections), len(header)


def columns_of_events(arrays: Mapping[str, Any]) -> dict[str, Columns]:
    """Return the collections of pybes3 as columns with our units, signs and sides; what is wrong in them is repaired.

    Parameters
    ----------
    arrays : mapping of str to awkward.Array
        Collections by the names of `COLLECTIONS`, as pybes3 0.5 returns them: one list of records an event.

    Returns
    -------
    dict of str to dict of str to ndarray
        ``events`` (run, number), ``clusters``, ``wire_hits``, ``mdc_tracks``, ``kal_tracks``, ``particles``,
        ``truths``, ``wire_truths``, ``digis``, ``wire_digis`` and ``start_times``, those that there are; ``event`` is
        the number of the event in the file.

    Raises
    ------
    ValueError
        If a collection lacks a field that is read.
    """
    tables: dict[str, Columns] = {}
    if {"run", "number"} <= arrays.keys():
        tables["events"] = {name: np.asarray(arrays[name], np.int64) for name in ("run", "number")}
    makers = {
        "hits": ("wire_hits", _wire_hits), "clusters": ("clusters", _clusters),
        "mdc_tracks": ("mdc_tracks", _mdc_tracks), "kal_tracks": ("kal_tracks", _kal_tracks),
        "particles": ("particles", _particles), "cgem_truths": ("truths", _truths),
        "mdc_truths": ("wire_truths", _wire_truths), "cgem_digis": ("digis", _digis),
        "mdc_digis": ("wire_digis", _wire_digis),
        "start_times": ("start_times", lambda flat: {"start_time": flat["m_estime"]}),
    }  # fmt: skip
    for name, (table, make) in makers.items():
        flat = _flat(arrays[name]) if name in arrays else {}
        if not flat:
            continue
        try:
            tables[table] = {"event": flat["event"], **make(flat)}
        except KeyError as error:
            raise ValueError(
                f"{COLLECTIONS[name][0]}: has no field {error}; expected the classes of 7.0 to 7.2"
            ) from error
    return tables


def _flat(lists: Any) -> Columns:
    """Return the fields of all records in one row each, and `event`; none where no event has a record."""
    awkward = package("awkward", "bes3")
    counts = np.asarray(awkward.num(lists, axis=1))
    records = awkward.flatten(lists, axis=1)
    if not awkward.fields(records):
        return {}
    fields = {}
    for name in awkward.fields(records):
        try:
            fields[name] = np.asarray(awkward.to_numpy(records[name]))
        except ValueError:  # lists of various lengths: none of them is read
            continue
    return {**fields, "event": np.repeat(np.arange(len(counts)), counts)}


def _wire(identifier: Column) -> Columns:
    """Return layer and wire of a MdcID."""
    bits = identifier.astype(np.int64)
    return {"layer": (bits >> 9) & 0x3F, "wire": bits & 0x1FF}


def _side(flag: Column) -> Column:
    """Return the sign of our doca: left (0) is to the right of the flight as we count, right (1) to the left."""
    return np.select([flag == 0, flag == 1], [1, -1], 0)


def _wire_hits(of: Columns) -> Columns:
    left, right = of["m_lr"] == 0, of["m_lr"] == 1
    both = [(np.abs(of[f"m_{name}l"]), np.abs(of[f"m_{name}r"])) for name in ("dd", "erdd")]
    drift, sigma = (_MM * np.select([left, right], [l, r], 0.5 * (l + r)) for l, r in both)  # noqa: E741
    side = _side(of["m_lr"])
    known = {"drift_time": of["m_driftT"], "candidate": of["m_trkid"]}
    known |= {"tdc": _TDC * of["m_tdc"], "z": _MM * of["m_zhit"]}
    return {**_wire(of["m_mdcid"]), "drift": drift, "sigma": sigma, "side": side, **known}


def _clusters(given: Columns) -> Columns:
    of = clusters(given)
    nan = np.full(len(of["m_flag"]), np.nan)
    has_phi, has_v, point = of["m_flag"] != 1, of["m_flag"] != 0, of["m_flag"] == 2
    charge = of["m_energydeposit"]
    parts = np.where(point[:, None], of["m_clusterflag"], -1)
    return {
        "layer": of["m_layerid"],
        "sheet": of["m_sheetid"],
        "view": of["m_flag"],
        "phi": np.where(has_phi, wrap_angle(of["m_recphi"]), nan),
        "v": np.where(has_v & ~point, of["m_recv"], nan),
        "z": np.where(point, of["m_recZ"], nan),
        "charge": np.where(charge == _NOT_SET, nan, charge),
        "x_cluster": _row_of(of, parts[:, 0]),
        "v_cluster": _row_of(of, parts[:, 1]),
        "candidate": of["m_trkid"],
    }


def _row_of(of: Columns, number: Column) -> Column:
    """Return the rows of clusters by their numbers in the same event; -1 where there is none."""
    rows = {key: row for row, key in enumerate(zip(of["event"].tolist(), of["m_clusterid"].tolist(), strict=True))}
    return np.array([rows.get(key, -1) for key in zip(of["event"].tolist(), number.tolist(), strict=True)], np.int64)


def _tracks(helix: Column, cov: Column, number: Column) -> Columns:
    """Return helices, (n, 5), and covariances, (n, 5, 5), in mm, with the azimuth in (-pi, pi]."""
    helix = helix * _HELIX
    helix[:, 1] = wrap_angle(helix[:, 1])
    return {"candidate": number, "helix": helix, "cov": cov * np.outer(_HELIX, _HELIX)}


def _mdc_tracks(of: Columns) -> Columns:
    tracks = _tracks(of["m_helix"], upper_triangles(of["m_err"]), of["m_trackId"])
    good = np.ones(len(of["m_chi2"]), np.bool_)
    return {
        **tracks,
        "chi2": of["m_chi2"],
        "ndf": of["m_ndof"],
        "hypothesis": np.zeros(len(good), np.int64),
        "ok": good,
    }


def _kal_tracks(of: Columns) -> Columns:
    """Return a row for each mass of each track; the first of two fits, the filter, where a file has both."""
    filtered = {name: of[f"m_{name}"] for name in ("chisq", "ndf", "stat")}
    filtered = {name: one[:, 0] if one.ndim == 3 else one for name, one in filtered.items()}
    parts = [
        {
            "event": of["event"],
            **_tracks(of[f"m_zhelix{end}"], of[f"m_zerror{end}"], of["m_trackId"]),
            "chi2": filtered["chisq"][:, i],
            "ndf": filtered["ndf"][:, i],
            "hypothesis": np.full(len(of["event"]), pdg),
            "ok": filtered["stat"][:, i] == 0,
        }
        for i, (pdg, end) in enumerate(HYPOTHESES.items())
    ]
    return {
        name: np.stack([part[name] for part in parts], 1).reshape(-1, *parts[0][name].shape[1:]) for name in parts[0]
    }


def _particles(of: Columns) -> Columns:
    """Return generated particles; lengths are in cm and momenta in GeV/c, other than those of the hits."""
    point = {axis: _MM * of[f"m_{axis}InitialPosition"] for axis in "xyz"}
    momentum = {f"p{axis}": of[f"m_{axis}InitialMomentum"] for axis in "xyz"}
    return {"particle": of["m_trackIndex"], "pdg": of["m_particleID"], **point, **momentum}


def _truths(of: Columns) -> Columns:
    """Return crossings of drift gaps; middle and momentum are the means of entry and exit."""
    enter, leave, before, after = (
        np.stack([of[f"m_{kind}_{end}_{axis}"] for axis in "xyz"], 1)
        for kind in ("XYZ", "P")
        for end in ("pre", "post")
    )
    momentum = 0.5 * _GEV * (before + after)
    middle = 0.5 * (enter + leave)
    columns: Columns = {"particle": of["m_ID_track"].astype(np.int64), "layer": of["m_ID_layer"].astype(np.int64)}
    for i, axis in enumerate("xyz"):
        columns |= {f"entry_{axis}": enter[:, i], f"exit_{axis}": leave[:, i], f"p{axis}": momentum[:, i]}
    columns |= {"phi": np.arctan2(middle[:, 1], middle[:, 0]), "z": middle[:, 2]}
    return columns | {"path": np.linalg.norm(leave - enter, axis=1), "energy": _KEV * of["m_E_deposit"]}


def _wire_truths(of: Columns) -> Columns:
    side = _side(of["m_posFlag"])
    point = {axis: of[f"m_{axis}Position"] for axis in "xyz"}
    doca = side * of["m_driftDistance"]
    return {"particle": of["m_trackIndex"].astype(np.int64), **_wire(of["m_id"]), "doca": doca, "side": side, **point}


def _digis(of: Columns) -> Columns:
    """Return fired strips with charge and time, where a file has them in fC and ns."""
    if not {"m_charge_fc", "m_time_ns"} <= of.keys():
        return dict.fromkeys(("event", "layer", "sheet", "view", "strip", "charge", "time"), of["event"][:0])
    bits = of["m_intId"].astype(np.int64)  # CgemID
    place = {"layer": bits & 7, "sheet": (bits >> 3) & 7, "view": (bits >> 6) & 1, "strip": (bits >> 7) & 0xFFF}
    return {**place, "charge": of["m_charge_fc"], "time": of["m_time_ns"]}


def _wire_digis(of: Columns) -> Columns:
    """Return what the cells have measured; the particle is -1 where it is noise, or noise came before."""
    channel = of["m_timeChannel"].astype(np.int64)
    owner = of["m_trackIndex"].astype(np.int64) if "m_trackIndex" in of else np.full(len(channel), -1)
    return {
        **_wire(of["m_intId"]),
        "tdc": np.where(channel == _NO_TIME, np.nan, _TDC * channel),
        "overflow": of["m_overflow"].astype(np.int64),
        "particle": np.where(owner < 0, -1, owner % _SECONDARY),
    }


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
        Reconstructed clusters, and the hits on tracks; `track` is the number of the track, -1 none. Wire hits also
        have `tdc`, ns from the start of the readout window, and `z` on the wire, mm.
    candidates, candidate_hits : Table
        The hits of each track. Candidate and track have the same number.
    mdc_tracks, kal_tracks : Table of kind "tracks"
        Tracks of the first fit, without matter (`hypothesis` 0), and of the Kalman filter, one row for each mass. Their
        `candidate` is -1 without hits. Fits that failed have the status not_converged.
    particles, truths, wire_truths : Table
        Generated particles of simulated events that are in our table of particles, and crossings of drift gaps and
        cells (`.rtraw`); their times are not read.
    digis : Table
        Fired strips with charge and time.
    start_time : ndarray, (n,) float64
        Start of each event in the readout window by the experiment's reconstruction, ns; NaN where the file has none.
    wire_digis : dict of str to ndarray, each (digis,)
        All fired cells: `event`, `layer`, `wire`, `tdc` (ns, NaN without a valid time), `overflow` (bits of the
        software), `particle` (number of the generated one, -1 none) and `track` (-1 none).
        `cgemit.bes3.wires` makes wire hits of them.
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
    start_time: Column
    wire_digis: Columns

    def __repr__(self) -> str:
        tables = (name for name, one in vars(self).items() if isinstance(one, Table) and len(one))
        rows = ", ".join(f"{len(getattr(self, name))} {name}" for name in tables)
        rows += f", {len(self.wire_digis['event'])} wire_digis" if len(self.wire_digis["event"]) else ""
        return f"<{len(self.run)} events of the BESIII software for {self.detector.name}: {rows}>"


def read_events(
    path: str | os.PathLike[str],
    detector: Detector | str | Mapping[str, Any],
    *,
    errors: tuple[float, float] = CLUSTER_ERRORS,
    every_cluster: bool = False,
) -> Bes3Events:
    """Read a `.rec`, `.dst` or `.rtraw` file of the BESIII software, or a `.raw` file of its readout.

    The extra ``[bes3]`` is needed.

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
        If it is damaged or no such file, its hits do not fit the detector, or pybes3 is not installed.

    Examples
    --------
    >>> events = cg.read_events("run.raw", "besiii-cgem")  # doctest: +SKIP
    >>> cg.read_events("run.root", "besiii-cgem")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ValueError: 'run.root' is no file of the BESIII software; expected one of .rec: digis, reconstructed hits, ...
    """
    path = Path(path)
    if path.suffix not in ENDINGS:
        kinds = "; ".join(f"{ending}: {what}" for ending, what in ENDINGS.items())
        raise ValueError(f"{str(path)[:80]!r} is no file of the BESIII software; expected one of {kinds}")
    found, n_events = read_bes3(path)
    return tables_of(found, n_events, detector, errors=errors, every_cluster=every_cluster)


def tables_of(
    tables: Mapping[str, Columns],
    n_events: int,
    detector: Detector | str | Mapping[str, Any],
    *,
    errors: tuple[float, float],
    every_cluster: bool,
) -> Bes3Events:
    """Return the tables of the columns that `cgemit.bes3.events` reads; arguments as for `read_events`."""
    detector = load(detector)
    _check(tables, detector, errors)
    clusters = _cluster_columns(detector, tables.get("clusters"), errors)
    wires = tables.get("wire_hits")
    if every_cluster and clusters is not None and wires is not None:
        clusters["candidate"] = _of_the_only_track(clusters, wires)
    hits = hit_tables(detector, clusters, wires, Problems(), events=np.arange(n_events))
    numbers = [_track_numbers(hits[i], given) for i, given in enumerate((clusters, wires))]
    named = label_candidates(hits[0], hits[1], numbers[0], numbers[1])
    cover = {"n_events": n_events, "events": hits[0].cover["events"]}
    events = tables.get("events", dict.fromkeys(("run", "number"), np.zeros(n_events, np.int64)))
    tracks = {name: _track_table(tables.get(name), named, detector, cover) for name in ("mdc_tracks", "kal_tracks")}
    fired = _fired(tables.get("wire_digis"), wires)
    simulated = {name: _filled(name, tables.get(name), detector, cover) for name in ("truths", "wire_truths", "digis")}
    start_time = np.full(n_events, np.nan)
    if "start_times" in tables:
        event, first = np.unique(tables["start_times"]["event"], return_index=True)
        start_time[event] = tables["start_times"]["start_time"][first]
    return Bes3Events(
        detector=detector,
        run=events["run"],
        number=events["number"],
        clusters=hits[0].with_columns(track=numbers[0]),
        wire_hits=hits[1].with_columns(track=numbers[1]),
        particles=_particle_table(tables.get("particles"), n_events),
        start_time=start_time,
        wire_digis=fired,
        **named,
        **tracks,
        **simulated,
    )


def _fired(given: Columns | None, wires: Columns | None) -> Columns:
    """Return the fired cells with the track of the reconstructed hit there, if any."""
    names = ("event", "layer", "wire", "tdc", "overflow", "particle")
    fired = {name: np.zeros(0) if name == "tdc" else np.zeros(0, np.int64) for name in names}
    fired = fired if given is None else given
    tracks: dict[tuple[int, ...], int] = {}
    if wires is not None:
        cells = zip(*(wires[name].tolist() for name in ("event", "layer", "wire")), strict=True)
        tracks = dict(zip(cells, wires["candidate"].tolist(), strict=True))
    cells = zip(*(fired[name].tolist() for name in ("event", "layer", "wire")), strict=True)
    return fired | {"track": np.array([tracks.get(cell, -1) for cell in cells], np.int64)}


def _check(tables: Mapping[str, Columns], detector: Detector, errors: tuple[float, float]) -> None:
    """Raise an error that lists the layers of hits that the detector does not have, and wrong errors."""
    chamber = detector.drift_chamber.layers if detector.drift_chamber else ()
    wires = [layer.number for layer in chamber]
    known = {"wire_hits": wires, "wire_digis": wires, "clusters": list(range(len(detector.cgem)))}
    problems = []
    for name, layers in known.items():
        given = np.unique(tables[name]["layer"]) if name in tables else np.zeros(0, np.int64)
        other = sorted(set(given.tolist()) - set(layers))
        if other:
            has = f"layers {layers[0]} to {layers[-1]}" if layers else "no such layer"
            problems.append(
                f"{name}: got layers {', '.join(map(str, other))}; expected those of {detector.name}: {has}"
            )
    if len(errors) != 2 or not all(0 < error < np.inf for error in errors):
        problems.append(f"errors: got {errors}; expected two positive numbers, X and V in mm")
    report("events of the BESIII software", problems)


def _cluster_columns(detector: Detector, clusters: Columns | None, errors: tuple[float, float]) -> Columns | None:
    """Return clusters with X on the sheet and errors, as `hit_tables` takes them."""
    if clusters is None:
        return None
    columns = dict(clusters)
    starts = np.array([(*layer.sheet_phi, *layer.sheet_phi)[:2] for layer in detector.cgem]).reshape(-1, 2)
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


def _track_table(fits: Columns | None, named: Mapping[str, Table], detector: Detector, cover: dict[str, Any]) -> Table:
    """Return tracks with the rows of the candidates that have their hits."""
    if fits is None:
        return Table.empty("tracks", **cover)
    candidates, of_hits = named["candidates"], named["candidate_hits"]
    row = {key: i for i, key in enumerate(zip(candidates["event"], candidates["candidate"], strict=True))}
    keys = zip(fits["event"], fits["candidate"], strict=True)
    candidate = np.array([row.get(key, -1) for key in keys], np.int64).reshape(-1)
    wire = of_hits["view"] == HIT_WIRE
    counts = [np.bincount(of_hits["candidate"][mine], minlength=len(candidates) + 1) for mine in (~wire, wire)]
    fitted, cov = fits["helix"], fits["cov"]
    with np.errstate(invalid="ignore"):  # fits that failed
        error = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    columns: dict[str, npt.ArrayLike] = {name: fits[name] for name in ("event", "hypothesis", "chi2", "ndf", "cov")}
    columns |= {"candidate": candidate, "track": fits["candidate"], "p": helix.momentum(fitted)}
    columns["charge"] = np.ones(len(fitted), np.int8)  # that BOSS assumes
    columns |= {name: fitted[:, i] for i, name in enumerate(helix.PARAMETERS)}
    columns |= {f"err_{name}": error[:, i] for i, name in enumerate(helix.PARAMETERS)}
    columns |= {
        "n_clusters": counts[0][candidate],
        "n_wires": counts[1][candidate],
        "err_p": helix.momentum_error(fitted, cov),
        "displaced": displaced(fitted[:, 0], error[:, 0], detector),
    }
    columns |= momentum_limits(np.asarray(columns["p"]), np.asarray(columns["err_p"]))
    columns["status"] = np.where(fits["ok"], FitStatus.ok, FitStatus.not_converged)
    return Table(
        "tracks",
        columns
        | dict.fromkeys(("n_outliers", "iterations"), np.zeros(len(candidate), np.int64))
        | dict.fromkeys(("radiated", "radius_radiated"), np.zeros(len(candidate))),
        **cover,
    )


def _particle_table(generated: Columns | None, n_events: int) -> Table:
    """Return the generated particles that we know; quarks and resonances are left out."""
    if generated is None:
        return Table.empty("particles", n_events)
    moves = (generated["px"] != 0) | (generated["py"] != 0) | (generated["pz"] != 0)
    known = np.isin(generated["pdg"], list(KNOWN)) & moves
    return particles_from({name: one[known] for name, one in generated.items()}, n_events=n_events, first_event=0)


def _filled(kind: str, rows: Columns | None, detector: Detector, cover: dict[str, Any]) -> Table:
    """Return a table of truth or digis, with the columns that follow from others; empty if the file has none."""
    if rows is None or not len(rows["event"]):
        return Table.empty(kind, **cover)
    n, columns = len(rows["event"]), dict(rows)
    if kind == "truths":
        columns["r"] = np.array([layer.r_mid for layer in detector.cgem])[columns["layer"]]
    if kind == "digis":
        columns["gid"] = strip_numbers(detector, columns)
        columns |= {"truth": np.full(n, -1)}
    for column in SCHEMAS[kind]:
        columns.setdefault(column.name, np.full(n, np.nan if column.dtype.kind == "f" else 0, column.dtype))
    return Table(kind, columns, **cover)


def strip_numbers(detector: Detector, of: Columns) -> Column:
    """Return the numbers of strips in the whole CGEM, (n,) int64.

    Parameters
    ----------
    detector : Detector
    of : dict of str to ndarray
        ``layer``, ``sheet``, ``view``, ``strip``.
    """
    strips = np.array([(layer.strips_x, layer.strips_v) for layer in detector.cgem])
    first = np.cumsum([0, *(layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem)])
    mine = strips[of["layer"]]
    return np.asarray(first[of["layer"]] + of["sheet"] * mine.sum(axis=1) + of["view"] * mine[:, 0] + of["strip"])
