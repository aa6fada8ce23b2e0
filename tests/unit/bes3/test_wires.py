"""Wire hits of all fired cells: what was simulated comes back, and is found, with any start time."""

from dataclasses import replace

import awkward as ak
import numpy as np
import pytest

import bes3_layout
import cgemit as cg
from cgemit.bes3 import wires as bes3_wires
from cgemit.detector.drift import BESIII


@pytest.fixture(scope="module")
def run():
    settings = cg.Settings(simulate=cg.SimulateSettings(decays=False))
    return cg.run("besiii-idc", cg.Gun("pi+", p=(0.4, 1.0), cos_theta=(-0.7, 0.7)), n=40, seed=3, settings=settings)


@pytest.fixture(scope="module")
def arrays(run):
    return bes3_layout.events_of(run)


@pytest.fixture(scope="module")
def events(arrays):
    return bes3_layout.tables_of(arrays, "besiii-idc")


def reconstructed(events, wires):
    how = cg.refinements(cg.RefineSettings(drift_times="raw", start_time="fitted"))
    settings = cg.FitSettings(hypothesis="pi")
    return cg.reconstruct(events.detector, events.clusters, wires, cg.find_tracks, settings, refinements=how)


def test_every_fired_cell_comes_back(run, events):
    calibration = bes3_wires.DriftCalibration(zero_time=dict.fromkeys(range(43), bes3_layout.ZERO))
    wires, ours = bes3_wires.all_wire_hits(events, calibration=calibration), run.wire_hits
    assert events.start_time.tolist() == [bes3_layout.START] * 40
    assert len(events.wire_digis["event"]) == len(ours) + 40
    assert np.count_nonzero(np.isnan(events.wire_digis["tdc"])) == 40
    for name in ("event", "layer", "wire", "gid"):
        assert np.array_equal(wires[name], ours[name]), name
    assert np.abs(wires["drift_time"] - ours["drift_time"] - bes3_layout.delay(run)).max() <= bes3_layout.TICK / 2
    assert np.array_equal(wires["particle"], run.wire_truths["particle"][ours["wire_truth"]])
    on_track = np.zeros(len(ours), np.bool_)
    of = run.candidate_hits
    on_track[of["hit"][of["view"] == 2]] = True
    assert np.array_equal(wires["track"] >= 0, on_track)


def test_calibration(events):
    """Zero times by layer; distances as those of the simulation, whose cells all have one relation."""
    found = bes3_wires.calibrate(events)
    assert list(found.zero_time) == list(range(43))
    assert np.abs(np.array(list(found.zero_time.values())) - bes3_layout.ZERO).max() < bes3_layout.TICK
    time = np.linspace(10.0, 200.0, 20)
    assert {layer for layer, _ in found.relation} >= set(range(8))
    known = found.distance(events.detector, np.full(20, 3), time)
    assert np.abs(known - BESIII.distance_at(time)).max() < 0.1  # mm
    none = bes3_wires.DriftCalibration()
    assert np.array_equal(none.distance(events.detector, np.full(20, 3), time), BESIII.distance_at(time))
    slower = events.detector.with_overrides({"drift_chamber.layers.3.drift_velocity": "20 um/ns"})
    assert none.distance(slower, np.full(20, 3), time) == pytest.approx(0.02 * time)


def test_tracks_of_all_hits(run, events):
    wires = bes3_wires.all_wire_hits(events)
    ours = bes3_wires.match_wires(events, wires, reconstructed(events, wires))
    theirs = bes3_wires.match_wires(events, wires)
    assert len(ours) == len(theirs) == 40
    np.testing.assert_allclose(theirs["purity"], run.matches["purity"])
    np.testing.assert_allclose(theirs["truth_p"], run.matches["truth_p"])
    assert ours["purity"].mean() > 0.98
    assert ours["efficiency"].mean() > theirs["efficiency"].mean() - 0.02


def test_start_times_are_searched(run, events):
    """From a search without the given time, the fit finds the same start."""
    silent = replace(events, start_time=np.full(40, np.nan))
    assert len(bes3_wires.all_wire_hits(silent)) == 0
    calibration = bes3_wires.calibrate(events)
    start = bes3_wires.find_start_times(silent, np.arange(580.0, 751.0, 25.0), calibration=calibration)
    assert np.abs(start - bes3_layout.START).max() <= 25
    wires = bes3_wires.all_wire_hits(silent, start, calibration=calibration)
    fitted = reconstructed(silent, wires)["start_times"]
    assert (fitted["status"] == 0).all()
    assert np.abs(start + fitted["start_time"] - bes3_layout.START).max() < 5
    none = bes3_wires.find_start_times(silent, [50.0], calibration=calibration)
    assert np.isnan(none).all()


def test_hot_and_dead_cells(events):
    """Cells that fire by chance in three of ten events, one in all of them and one in none."""
    random = np.random.default_rng(1)
    n, layer = 100, 20
    cells = next(one.cells for one in events.detector.drift_chamber.layers if one.number == layer)
    fires = random.random((n, cells)) < 0.3
    fires[:, 5], fires[:, 7] = True, False
    event, wire = np.nonzero(fires)
    fired = {"event": event, "wire": wire, "layer": np.full(len(event), layer), "tdc": np.zeros(len(event))}
    status = bes3_wires.cell_status(replace(events, run=np.zeros(n), wire_digis=fired))
    first = events.detector.drift_chamber.gid_first[layer]
    assert np.flatnonzero(status == 1).tolist() == [first + 5]
    assert np.flatnonzero(status == -1).tolist() == [first + 7]
    assert not bes3_wires.cell_status(events).min() < 0  # too few events


def test_cells_are_left_out(events):
    wires = bes3_wires.all_wire_hits(events)
    gid = int(wires["gid"][0])
    left = bes3_wires.all_wire_hits(events, without=[gid])
    assert len(left) == np.count_nonzero(wires["gid"] != gid) < len(wires)


def test_other_numbers_of_start_times(events):
    with pytest.raises(ValueError, match=r"start_time: got shape \(3,\), expected one number, or one for each of 40"):
        bes3_wires.all_wire_hits(events, [1.0, 2.0, 3.0])


def test_files_without_digis(arrays):
    bare = bes3_layout.tables_of({name: one for name, one in arrays.items() if "digis" not in name}, "besiii-idc")
    assert len(bes3_wires.all_wire_hits(bare)) == 0
    assert np.isnan(bes3_wires.find_start_times(bare, [656.0])).all()
    other = ak.with_field(arrays["mdc_digis"], arrays["mdc_digis"]["m_intId"] | (0x3F << 9), "m_intId")
    with pytest.raises(ValueError, match="wire_digis: got layers 63; expected those of besiii-idc"):
        bes3_layout.tables_of(arrays | {"mdc_digis": other}, "besiii-idc")


def test_events_without_truth_have_no_matches(events):
    """Data of an experiment; with particles, the same tables match."""
    wires = bes3_wires.all_wire_hits(events)
    measured = replace(events, particles=events.particles[:0])
    for fitted in (None, reconstructed(measured, wires)):
        with pytest.raises(ValueError, match=r"match_wires: the events have no generated particles"):
            bes3_wires.match_wires(measured, wires, fitted)
