"""Events of the BESIII software (`.rec`, `.dst`, `.rtraw`) as columns in our units and signs, read by pybes3.

Meanings are those of the classes RecMdcHit, RecMdcTrack, RecMdcKalTrack, MdcMcHit and their converters in the
software's source (github.com/redeboer/BOSS_ExternalLibs, commit ec210d3), and what the simulated events in the tests of
pybes3 show (docs/how-to/real_events.md). Fields whose meaning neither tells are not read.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.io import bes3_repairs
from cgemit.io.files import check_regular
from cgemit.io.packages import package

Column = npt.NDArray[Any]
Columns = dict[str, Column]

#: Endings of the names of files.
ENDINGS = (".rec", ".dst", ".rtraw")

#: What is read: our name, and the branches of which a file has one.
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
}

#: PDG numbers of the masses of a Kalman track, in the order of its arrays, with the ends of the names of its helices.
HYPOTHESES = {11: "_e", 13: "_mu", 211: "", 321: "_k", 2212: "_p"}

_MM = 10.0  # in a cm
_GEV = 1e-3  # in MeV
_KEV = 1e3  # in MeV
_HELIX = np.array([_MM, 1.0, 1.0, _MM, 1.0])  # dr and dz in cm
_NOT_SET = -99.0  # of the software


def read_bes3(path: Path) -> tuple[dict[str, Columns], int]:
    """Return what a file holds as columns, and the number of its events.

    Parameters
    ----------
    path : Path

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
    package("pybes3", "bes3")  # teaches uproot the classes
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
        ``truths``, ``wire_truths`` and ``digis``, those that there are; ``event`` is the number of the event in the
        file.

    Raises
    ------
    ValueError
        If a collection lacks a field that is read.
    """
    found: dict[str, Columns] = {}
    if {"run", "number"} <= arrays.keys():
        found["events"] = {name: np.asarray(arrays[name], np.int64) for name in ("run", "number")}
    makers = {
        "hits": ("wire_hits", _wire_hits), "clusters": ("clusters", _clusters),
        "mdc_tracks": ("mdc_tracks", _mdc_tracks), "kal_tracks": ("kal_tracks", _kal_tracks),
        "particles": ("particles", _particles), "cgem_truths": ("truths", _truths),
        "mdc_truths": ("wire_truths", _wire_truths), "cgem_digis": ("digis", _digis),
    }  # fmt: skip
    for name, (table, make) in makers.items():
        flat = _flat(arrays[name]) if name in arrays else {}
        if not flat:
            continue
        try:
            found[table] = {"event": flat["event"], **make(flat)}
        except KeyError as error:
            raise ValueError(
                f"{COLLECTIONS[name][0]}: has no field {error}; expected the classes of 7.0 to 7.2"
            ) from error
    return found


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
    return {**_wire(of["m_mdcid"]), "drift": drift, "sigma": sigma, "side": side, **known}


def _clusters(given: Columns) -> Columns:
    of = bes3_repairs.clusters(given)
    nan = np.full(len(of["m_flag"]), np.nan)
    has_phi, has_v, point = of["m_flag"] != 1, of["m_flag"] != 0, of["m_flag"] == 2
    charge = of["m_energydeposit"]
    parts = np.where(point[:, None], of["m_clusterflag"], -1)
    return {
        "layer": of["m_layerid"],
        "sheet": of["m_sheetid"],
        "view": of["m_flag"],
        "phi": np.where(has_phi, _wrapped(of["m_recphi"]), nan),
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
    helix[:, 1] = _wrapped(helix[:, 1])
    return {"candidate": number, "helix": helix, "cov": cov * np.outer(_HELIX, _HELIX)}


def _mdc_tracks(of: Columns) -> Columns:
    tracks = _tracks(of["m_helix"], bes3_repairs.upper_triangles(of["m_err"]), of["m_trackId"])
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


def _wrapped(angle: Column) -> Column:
    """Return angles in (-pi, pi]."""
    return np.asarray(np.pi - np.remainder(np.pi - angle, 2 * np.pi))
