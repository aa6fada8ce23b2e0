"""Simulated events in the layout of pybes3 0.5, with its known faults: fields and types as it returns them.

``LAYOUT`` lists name, dtype and shape of every field of the collections that cgemit reads, as pybes3 0.5.6 gives them
for files of the experiment's software 7.2.0.
"""

from __future__ import annotations

import awkward as ak
import numpy as np

from cgemit import helix
from cgemit.bes3 import events
from cgemit.bes3.events import CLUSTER_ERRORS, HYPOTHESES
from cgemit.detector.drift import propagation_time
from cgemit.units import LIGHT

_I, _U, _F = "i4", "u4", "f8"
_POINTS = ("e", "mu", "k", "p")

LAYOUT = {
    "hits": {
        "m_isGrouped": "?", "m_id": _I, "m_trkid": _I, "m_ddl": _F, "m_ddr": _F, "m_erddl": _F, "m_erddr": _F,
        "m_pChisq": _F, "m_lr": _I, "m_stat": _I, "m_mdcid": _U, "m_tdc": _F, "m_adc": _F, "m_driftT": _F, "m_doca": _F,
        "m_entra": _F, "m_zhit": _F, "m_fltLen": _F,
    },
    "clusters": {
        "m_clusterid": _I, "m_trkid": _I, "m_layerid": _I, "m_sheetid": _I, "m_flag": _I, "m_energydeposit": _F,
        "m_recphi": _F, "m_recpositiony": _F, "m_recv": _F, "m_recZ": _F, "m_clusterflag": (_I, 2),
        "m_stripid": (_I, 2, 2),
    },
    "mdc_tracks": {
        "m_trackId": _I, "m_helix": (_F, 5), "m_stat": _I, "m_chi2": _F, "m_ndof": _I, "m_err": (_F, 5, 5),
        "m_nhits": _I, "m_nster": _I, "m_nlayer": _I, "m_vx0": _F, "m_vy0": _F, "m_vz0": _F, "m_fiTerm": _F,
    },
    "kal_tracks": {
        "m_trackId": _I, "m_mass": (_F, 5), "m_stat": (_I, 2, 5), "m_chisq": (_F, 2, 5), "m_ndf": (_I, 2, 5),
        "m_zhelix": (_F, 5), "m_zerror": (_F, 5, 5),
        **{f"m_zhelix_{one}": (_F, 5) for one in _POINTS}, **{f"m_zerror_{one}": (_F, 5, 5) for one in _POINTS},
    },
    "particles": {
        "m_particleID": _I, "m_trackIndex": _I, "m_vertexIndex0": _I, "m_vertexIndex1": _I, "m_statusFlags": _U,
        **{f"m_{axis}{when}Position": _F for when in ("Initial", "Final") for axis in "xyzt"},
        **{f"m_{axis}InitialMomentum": _F for axis in "xyze"}, "m_mother": _I,
    },
    "cgem_truths": {
        "m_ID_track": _U, "m_isSecondary": _U, "m_ID_layer": _U, "m_pdg_code": _U, "m_ID_parent": _U,
        "m_E_deposit": _F,
        **{f"m_{of}_{end}_{axis}": _F for of in ("XYZ", "P") for end in ("pre", "post") for axis in "xyz"},
    },
    "mdc_truths": {
        "m_id": _U, "m_trackIndex": _U, **{f"m_{axis}Position": _F for axis in "xyz"}, "m_driftDistance": _F,
        "m_depositEnergy": _F, "m_posFlag": _I,
    },
    "cgem_digis": {
        "m_intId": _U, "m_timeChannel": _U, "m_chargeChannel": _U, "m_trackIndex": _I, "m_overflow": _U,
        "m_time_ns": _F, "m_charge_fc": _F,
    },
    "mdc_digis": {"m_intId": _U, "m_timeChannel": _U, "m_chargeChannel": _U, "m_trackIndex": _I, "m_overflow": _U},
    "start_times": {"m_status": _I, "m_estime": _F, "m_quality": _F},
}  # fmt: skip

START, ZERO, TICK = 656.0, -231.0, 3 / 32  # ns: start of the events, zero time of the wires, TDC channel

CM = np.array([0.1, 1.0, 1.0, 0.1, 1.0])  # per mm, of dr and dz


def records(collection, event, n_events, given):
    """Return one list of records an event, with all fields of the layout; those that are not given are 0."""
    columns = {}
    for name, kind in LAYOUT[collection].items():
        dtype, *shape = (kind,) if isinstance(kind, str) else kind
        columns[name] = np.asarray(given.get(name, np.zeros((len(event), *shape))), dtype)
        assert columns[name].shape == (len(event), *shape), name
    unknown = set(given) - set(columns)
    assert not unknown, unknown
    counts = np.bincount(event, minlength=n_events)
    return ak.unflatten(ak.zip(columns, depth_limit=1), counts)


def events_of(result):
    """Return a simulated and fitted run as the experiment's software and pybes3 would: cm, left and right, faults."""
    n, tracks = result.n_events, result.tracks
    matches = result.matches
    of_track = tracks["event"], np.zeros(len(tracks), np.int64)
    assert np.array_equal(of_track[0], np.unique(of_track[0])), "one track an event"
    assert len(matches) == len(tracks)
    arrays = {"run": ak.Array(np.full(n, -9989, "i4")), "number": ak.Array(np.arange(100, 100 + n, dtype="i4"))}
    arrays["hits"] = _hits(result, n)
    arrays["mdc_digis"] = _fired(result, n)
    arrays["start_times"] = records("start_times", np.arange(n), n, {"m_estime": np.full(n, START)})
    arrays["clusters"] = _clusters(result, n)
    fitted = np.stack([tracks[name] for name in helix.PARAMETERS], 1) * CM
    fitted[:, 1] %= 2 * np.pi
    cov = tracks["cov"] * np.outer(CM, CM)
    common = {"m_trackId": of_track[1]}
    mdc = {"m_helix": fitted, "m_err": as_pybes3_fills(cov), "m_chi2": tracks["chi2"], "m_ndof": tracks["ndf"]}
    arrays["mdc_tracks"] = records("mdc_tracks", of_track[0], n, common | mdc)
    kal = {name: np.tile(tracks[of][:, None, None], (1, 2, 5)) for name, of in (("m_chisq", "chi2"), ("m_ndf", "ndf"))}
    for second in kal.values():
        second[:, 1] += 1  # of the second fit, the smoother
    for end in HYPOTHESES.values():
        kal |= {f"m_zhelix{end}": fitted, f"m_zerror{end}": cov}
    arrays["kal_tracks"] = records("kal_tracks", of_track[0], n, common | kal)
    arrays |= _truth(result, n)
    return arrays


def tables_of(arrays, detector, *, errors=CLUSTER_ERRORS, every_cluster=False):
    """Return the tables of collections of pybes3, by the names of `cgemit.bes3.events.COLLECTIONS`."""
    n_events = max((len(one) for one in arrays.values()), default=0)
    found = events.columns_of_events(arrays)
    return events.tables_of(found, n_events, detector, errors=errors, every_cluster=every_cluster)


def as_read_out(result, late, offset):
    """Return what the readout alone gives: cells and strips of events that begin `late` by some ns, whole channels.

    Strips count from `offset`, ns, in the times of the wires.
    """
    of_run = events_of(result)
    cells, strips = of_run["mdc_digis"], of_run["cgem_digis"]
    channel = cells["m_timeChannel"]
    moved = ak.where(channel == 0x7FFFFFFF, channel, channel + np.rint(late / TICK).astype("i4"))
    time = strips["m_time_ns"] + (START + late + offset)
    return {
        "run": of_run["run"], "number": of_run["number"],
        "mdc_digis": ak.with_field(cells, ak.values_astype(moved, "u4"), "m_timeChannel"),
        "cgem_digis": ak.with_field(strips, time, "m_time_ns"),
    }  # fmt: skip


def as_pybes3_fills(cov):
    """Write the upper triangle row by row, and read it as the lower one."""
    upper, lower = np.triu_indices(5), np.tril_indices(5)
    filled = np.zeros_like(cov)
    filled[:, lower[0], lower[1]] = cov[:, upper[0], upper[1]]
    filled[:, lower[1], lower[0]] = cov[:, upper[0], upper[1]]
    return filled


def _left_right(side):
    return np.where(side > 0, 0, np.where(side < 0, 1, 2))


def _wire_id(layer, wire):
    return 0x10000000 | (layer.astype(np.int64) << 9) | wire


def _hits(result, n):
    hits = result.wire_hits
    drift = 0.1 * np.abs(hits["drift"])  # smeared beyond the wire, a distance is one on its other side
    on_track = np.full(len(hits), -1)
    of = result.candidate_hits
    on_track[of["hit"][of["view"] == 2]] = 0
    return records("hits", hits["event"], n, {
        "m_isGrouped": np.ones(len(hits)), "m_id": np.arange(len(hits)), "m_trkid": on_track,
        "m_ddl": drift, "m_ddr": drift,
        "m_erddl": 0.1 * hits["sigma"], "m_erddr": 0.1 * hits["sigma"],
        "m_lr": _left_right(hits["side"] * np.sign(hits["drift"])), "m_stat": np.ones(len(hits)),
        "m_mdcid": _wire_id(hits["layer"], hits["wire"]), "m_driftT": hits["drift_time"], "m_tdc": _tdc(result),
        "m_zhit": 0.1 * result.wire_truths["z"][hits["wire_truth"]],
    })  # fmt: skip


def delay(result):
    """Return flight, as from the origin with the speed of light, and propagation of each wire hit, ns."""
    hits = result.wire_hits
    z = result.wire_truths["z"][hits["wire_truth"]]
    radii = {layer.number: layer.r_mid for layer in result.detector.drift_chamber.layers}
    radius = np.array([radii[layer] for layer in hits["layer"].tolist()])
    return np.hypot(radius, z) / LIGHT + propagation_time(result.detector, hits["layer"], z)


def _tdc(result):
    """Return TDC channels of the wire hits."""
    return np.rint((result.wire_hits["drift_time"] + delay(result) + START + ZERO) / TICK)


def _fired(result, n):
    """Return a digi for each wire hit, with its particle, and one cell without a valid time in each event."""
    hits = result.wire_hits
    owner = result.wire_truths["particle"][hits["wire_truth"]]
    columns = {
        "m_intId": _wire_id(hits["layer"], hits["wire"]), "m_timeChannel": _tdc(result),
        "m_trackIndex": owner + 1000 * (hits["layer"] % 2),
    }  # fmt: skip
    silent = {"m_intId": _wire_id(np.full(n, 42), 0), "m_timeChannel": 0x7FFFFFFF, "m_trackIndex": -1000}
    columns = {name: np.concatenate([np.broadcast_to(silent[name], n), columns[name]]) for name in columns}
    event = np.concatenate([np.arange(n), hits["event"]])
    order = np.argsort(event, kind="stable")
    return records("mdc_digis", event[order], n, {name: column[order] for name, column in columns.items()})


def _clusters(result, n):
    """Return X, V and XV clusters; the fields behind phi are shifted by two words, as pybes3 0.5 reads them."""
    clusters = result.clusters
    event, view = clusters["event"], clusters["view"]
    first = np.searchsorted(event, event)
    number = np.arange(len(event)) - first  # within the event
    parts = [np.where(view == 2, clusters[f"{one}_cluster"] - first, -1) for one in "xv"]
    words = np.stack([np.full(len(event), 2), parts[0]], 1).astype(">i4")
    unset = np.full(len(event), -99.0)
    strips = np.full((len(event), 2, 2), -1)
    strips[view == 0, 1], strips[view == 1, 0] = -9999, -9999
    of_track = np.full(len(event), -1)
    of = result.candidate_hits
    of_track[of["hit"][of["view"] != 2]] = 0
    return records("clusters", event, n, {
        "m_clusterid": number, "m_trkid": of_track, "m_layerid": clusters["layer"], "m_sheetid": clusters["sheet"],
        "m_flag": view, "m_energydeposit": unset, "m_recphi": np.where(view == 1, unset, clusters["phi"] % (2 * np.pi)),
        "m_recpositiony": np.where(view == 0, unset, clusters["v"]),
        "m_recv": np.where(view == 2, clusters["z"], unset),
        "m_recZ": words.view(">f8")[:, 0], "m_clusterflag": np.stack([parts[1], np.full(len(event), 4)], 1),
        "m_stripid": strips,
    })  # fmt: skip


def _truth(result, n):
    particles, truths, crossed, digis = result.particles, result.truths, result.wire_truths, result.digis
    found = {"m_particleID": particles["pdg"], "m_trackIndex": particles["particle"]}
    for axis in "xyz":
        found[f"m_{axis}InitialPosition"] = 0.1 * particles[axis]
        found[f"m_{axis}InitialMomentum"] = particles[f"p{axis}"]
    gaps = {"m_ID_track": truths["particle"], "m_ID_layer": truths["layer"], "m_E_deposit": 1e-3 * truths["energy"]}
    for end, ours in (("pre", "entry"), ("post", "exit")):
        gaps |= {f"m_XYZ_{end}_{axis}": truths[f"{ours}_{axis}"] for axis in "xyz"}
        gaps |= {f"m_P_{end}_{axis}": 1e3 * truths[f"p{axis}"] for axis in "xyz"}
    cells = {f"m_{axis}Position": crossed[axis] for axis in "xyz"}
    cells |= {"m_id": _wire_id(crossed["layer"], crossed["wire"]), "m_trackIndex": crossed["particle"]}
    cells |= {"m_driftDistance": np.abs(crossed["doca"]), "m_posFlag": _left_right(crossed["side"])}
    strip = digis["strip"].astype(np.int64) << 7 | digis["view"].astype(np.int64) << 6
    fired = {"m_intId": 0x60000000 | strip | digis["sheet"].astype(np.int64) << 3 | digis["layer"]}
    fired |= {"m_time_ns": digis["time"], "m_charge_fc": digis["charge"]}
    return {
        "particles": records("particles", particles["event"], n, found),
        "cgem_truths": records("cgem_truths", truths["event"], n, gaps),
        "mdc_truths": records("mdc_truths", crossed["event"], n, cells),
        "cgem_digis": records("cgem_digis", digis["event"], n, fired),
    }
