"""From fired cells and strips to tracks: simulated events whose wires and strips count from different moments."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import awkward as ak
import numpy as np
import pytest

import bes3_layout
import cgemit as cg
from cgemit.bes3 import events as bes3_events
from cgemit.bes3.events import read_events
from cgemit.bes3.reconstruct import (
    aligned_layers,
    numbered_tables,
    point_offsets,
    reconstruct_events,
    save_numbered,
)
from cgemit.bes3.refit import refit
from cgemit.cli.main import main
from cgemit.cli.reconstruct import _fullest as fullest
from cgemit.helix import at_origin
from cgemit.reconstruction.refine import StartTimeStatus
from stats import assert_within

EVENTS, OFFSET = 30, -8645.0  # ns, of the strips against the wires
CGEM = cg.load("besiii-cgem").with_readout("tiger")
SETTINGS = cg.Settings(fit=cg.FitSettings(hypothesis="mu"))
DATA = os.environ.get("CGEMIT_BES3_DATA", "")
REAL = pytest.mark.skipif(not DATA, reason="CGEMIT_BES3_DATA is not the folder of pybes3's test files")


@pytest.fixture(scope="module")
def run():
    settings = cg.Settings(simulate=cg.SimulateSettings(decays=False))
    gun = cg.Gun("mu-", p=(0.4, 1.5), cos_theta=(-0.7, 0.7))
    return cg.run(CGEM, gun, n=EVENTS, seed=4, settings=settings)


@pytest.fixture(scope="module")
def late():
    """How much later each event began, in whole channels of the TDC, ns."""
    return bes3_layout.TICK * np.random.default_rng(2).integers(-3000, 3000, EVENTS)


@pytest.fixture(scope="module")
def arrays(run, late):
    """What the readout gives: cells and strips, without any result of the experiment's software."""
    return bes3_layout.as_read_out(run, late, OFFSET)


@pytest.fixture(scope="module")
def found(arrays):
    return reconstruct_events(bes3_layout.tables_of(arrays, CGEM), SETTINGS)


def test_tracks_have_points_of_all_layers(run, found):
    tracks = found.tracks
    assert tracks["event"].tolist() == list(range(EVENTS))
    assert (tracks["status"] == 0).all()
    assert tracks["n_clusters"].mean() > 5.7
    assert tracks["n_wires"].mean() > 0.95 * run.tracks["n_wires"].mean()
    for name in ("dr", "dz", "kappa"):
        away = tracks[name] - run.tracks[name]
        assert np.median(np.abs(away / run.tracks[f"err_{name}"])) < 0.5  # the same hits, with times that are found


def test_start_times(found, late):
    """The zero time of all layers is -233.5 ns by default, and -231 ns here: start times are later by that."""
    times = found.start_times
    assert (times["status"] == StartTimeStatus.ok).all()
    away = times["start_time"] - late - bes3_layout.START
    assert_within(away.mean(), -231.0 + 233.5, 0.3)
    assert np.std(away) < 2.0
    strips = found.strip_times
    assert_within(strips.meta["offset"] + away.mean(), OFFSET, strips.meta["err_offset"], 3.0)
    assert np.std(strips["strip_time"] - late) < 2.0
    assert not strips["n_outside"].any()


def test_a_wrong_guess_is_mended(arrays, found, late):
    events = bes3_layout.tables_of(arrays, CGEM)
    guess = bes3_layout.START + late + np.where(np.arange(EVENTS) % 2, 15.0, -15.0)
    again = reconstruct_events(events, SETTINGS, start_time=guess)
    np.testing.assert_allclose(again.start_times["start_time"], found.start_times["start_time"], atol=1.0)
    assert (again.tracks["n_clusters"] == found.tracks["n_clusters"]).mean() > 0.9
    with pytest.raises(ValueError, match=r"got shape \(2,\), expected one for each of 30 events"):
        reconstruct_events(events, start_time=[1.0, 2.0])


def test_clusters_of_the_file(run):
    events = bes3_layout.tables_of(bes3_layout.events_of(run), CGEM)
    ours = reconstruct_events(events, SETTINGS)
    assert ours.strip_times is None
    assert len(ours.clusters) == len(events.clusters)
    assert ours.tracks["n_clusters"].mean() > 2.5  # XV clusters
    made = reconstruct_events(events, SETTINGS, points="strips")
    assert made.strip_times is not None
    assert made.tracks["n_clusters"].mean() > 5.7


def test_layers_that_are_not_where_they_should_be(arrays):
    """X of a layer that is turned by -6 mrad in the description, and z of one that is shifted by 1.5 mm."""
    other = CGEM.with_overrides({"cgem.L2.rotation": "-6 mrad", "cgem.L3.shift_z": "1.5 mm"})
    nominal, moved = (
        {one.label: one for one in point_offsets(events, reconstruct_events(events, SETTINGS))}
        for events in (bes3_layout.tables_of(arrays, CGEM), bes3_layout.tables_of(arrays, other))
    )
    assert all(one.n > 25 for one in (*nominal.values(), *moved.values()))
    for label in ("L1", "L2", "L3"):
        assert_within(nominal[label].x, 0.0, nominal[label].err_x, 4.0)
        assert_within(nominal[label].z, 0.0, nominal[label].err_z, 4.0)
    radius = CGEM.cgem["L2"].r_readout
    assert abs(moved["L2"].x - nominal["L2"].x + 6e-3 * radius) < 0.05
    assert abs(moved["L3"].z - nominal["L3"].z - 1.5) < 0.2
    assert abs(moved["L1"].x - nominal["L1"].x) < 0.05
    back = aligned_layers(other, list(moved.values()))
    assert abs(back.cgem["L2"].rotation) < 4 * moved["L2"].err_x / radius
    assert abs(back.cgem["L3"].shift_z) < 4 * moved["L3"].err_z
    assert other.cgem["L3"].shift_z == 1.5


def test_events_without_strips_or_start(arrays):
    wires = {name: one for name, one in arrays.items() if name != "cgem_digis"}
    events = bes3_layout.tables_of(wires, CGEM)
    events = replace(
        events, wire_digis={name: one[events.wire_digis["event"] < 3] for name, one in events.wire_digis.items()}
    )
    found = reconstruct_events(events, SETTINGS)
    assert set(found.tracks["event"]) <= {0, 1, 2}
    assert np.isnan(found.start_times["start_time"][3:]).all()
    assert (found.start_times["status"][3:] == StartTimeStatus.no_track).all()
    assert not len(found.clusters)


def test_files_without_fired_cells_are_refused(run):
    """As `.dst` files, which hold tracks alone."""
    arrays = bes3_layout.events_of(run)
    names = ("mdc_tracks", "kal_tracks", "run", "number")
    events = bes3_layout.tables_of({name: one for name, one in arrays.items() if name in names}, CGEM)
    assert len(events.mdc_tracks) == EVENTS
    with pytest.raises(ValueError, match=r"reconstruct: the events have no fired cells, as those of a \.dst file"):
        reconstruct_events(events, SETTINGS)
    with pytest.raises(ValueError, match=r"got 0 sets of hits and 30 .*\(cgemit reconstruct takes \.raw and"):
        refit(events, "mdc")


def test_tracks_say_whether_their_event_has_a_start_time(arrays, found):
    events = bes3_layout.tables_of(arrays, CGEM)
    assert (numbered_tables(events, found)["tracks"]["start_time_status"] == StartTimeStatus.ok).all()
    status = found.start_times["status"].copy()
    status[3] = StartTimeStatus.not_converged
    other = replace(found, tables={**found.tables, "start_times": found.start_times.with_columns(status=status)})
    marked = numbered_tables(events, other)["tracks"]
    assert np.unique(marked["event"][marked["start_time_status"] == StartTimeStatus.not_converged]).tolist() == [3]


def test_tables_with_numbers_of_the_experiment(arrays, found, tmp_path):
    """Every row against the readout's own words, and the files of all formats against the columns."""
    events = bes3_layout.tables_of(arrays, CGEM)
    tables = numbered_tables(events, found)
    fired = {"cgem": set(), "mdc": set()}
    for event, one in enumerate(arrays["cgem_digis"]["m_intId"].to_list()):
        fired["cgem"] |= {(100 + event, bits & 7, bits >> 3 & 7, bits >> 6 & 1, bits >> 7 & 0xFFF) for bits in one}
    for event, one in enumerate(arrays["mdc_digis"]["m_intId"].to_list()):
        fired["mdc"] |= {(100 + event, bits >> 9 & 0x3F, bits & 0x1FF) for bits in one}
    points, residuals = tables["points"], tables["residuals"]
    assert len(points["number"]) > 2.7 * EVENTS
    for i in range(len(points["number"])):
        place = [int(points[name][i]) for name in ("number", "layer", "sheet")]
        for view, name in enumerate("xv"):
            ends = [int(points[f"{name}_{end}"][i]) for end in ("first", "last")]
            if ends[0] >= 0:
                assert {(*place, view, strip) for strip in ends} <= fired["cgem"]
    wire = residuals["view"] == 2
    cells = zip(*(residuals[name][wire].tolist() for name in ("number", "layer", "first")), strict=True)
    assert set(cells) <= fired["mdc"]
    gid = np.unique(np.stack([found.wire_hits[name] for name in ("layer", "wire", "gid")]), axis=1)
    known = {(layer, cell): number for layer, cell, number in gid.T.tolist()}
    of_wires = zip(*(residuals[name][wire].tolist() for name in ("layer", "first", "gid")), strict=True)
    assert all(known[layer, cell] == number for layer, cell, number in of_wires)
    of_strips = {
        tuple(row) for row in np.stack([found.digis[n] for n in ("layer", "sheet", "view", "strip", "gid")]).T.tolist()
    }
    names = ("layer", "sheet", "view", "first", "gid")
    assert set(zip(*(residuals[name][~wire].tolist() for name in names), strict=True)) <= of_strips
    # Where X and V cross: the layer's radius and the track's own position.
    both = np.isfinite(points["z"])
    assert both.mean() > 0.9
    near = points["z"][both] - residuals_at(tables, points, both)
    assert np.median(np.abs(near)) < 0.5
    assert tables["tracks"]["run"].tolist() == [-9989] * EVENTS
    for kind in ("csv", "parquet", "root"):
        files = save_numbered(tables, tmp_path, kind)
        assert [path.name for path in files] == [f"bes3_{name}.{kind}" for name in tables]
    pandas, uproot = pytest.importorskip("pandas"), pytest.importorskip("uproot")
    for name, columns in tables.items():
        as_csv, as_parquet = (
            pandas.read_csv(tmp_path / f"bes3_{name}.csv"),
            pandas.read_parquet(tmp_path / f"bes3_{name}.parquet"),
        )
        with uproot.open(tmp_path / f"bes3_{name}.root") as file:
            as_root = file[name].arrays(library="np")
        assert list(as_csv) == list(as_parquet) == list(as_root) == list(columns)
        for key, column in columns.items():
            np.testing.assert_array_equal(as_parquet[key], column)
            np.testing.assert_array_equal(as_root[key], column)
            np.testing.assert_allclose(
                as_csv[key].to_numpy(np.float64), column.astype(np.float64), rtol=1e-8, atol=1e-12
            )
    with pytest.raises(ValueError, match=r"format: got 'xls', expected one of 'csv', 'parquet', 'root'"):
        save_numbered(tables, tmp_path, "xls")


def residuals_at(tables, points, rows):
    """Return z of the track at the X hit of points, from the table of residuals."""
    of = tables["residuals"]
    x = of["view"] == 0
    keys = zip(*(of[name][x].tolist() for name in ("track", "layer", "sheet")), strict=True)
    z = dict(zip(keys, of["z"][x].tolist(), strict=True))
    return np.array(
        [z[key] for key in zip(*(points[n][rows].tolist() for n in ("track", "layer", "sheet")), strict=True)]
    )


def test_result_is_saved_and_drawn(found, tmp_path):
    found.save(tmp_path / "run")
    again = cg.open(tmp_path / "run")
    assert again.is_measured
    assert "measured events" in repr(again)
    np.testing.assert_array_equal(again.strip_times["strip_time"], found.strip_times["strip_time"])
    picture = cg.draw.event(found, 3)
    labels = {text.get_text() for text in picture.legends[0].get_texts()}
    assert {"cluster", "drift circle"} <= labels
    assert not any("no particle" in label or "true" in label or "ghost" in label for label in labels)
    assert "event 3: measured" in picture.get_suptitle().replace("\u00a0", " ")


class Raw:
    """A file of the readout, as pybes3 opens it."""

    def __init__(self, arrays):
        fields = {"mdc": arrays["mdc_digis"][["m_intId", "m_chargeChannel", "m_timeChannel", "m_overflow"]]}
        fields["cgem"] = arrays["cgem_digis"][["m_intId", "m_time_ns", "m_charge_fc"]]
        fields["evt_header"] = ak.zip({"run_no": arrays["run"], "evt_no": arrays["number"]})
        self._arrays = ak.zip(fields, depth_limit=1)

    def arrays(self):
        """Return the collections."""
        return self._arrays

    def close(self):
        """Close nothing."""


@pytest.fixture
def raw(arrays, tmp_path, monkeypatch):
    import pybes3

    path = tmp_path / "run.raw"
    path.write_bytes(b"any")
    monkeypatch.setattr(pybes3, "open_raw", lambda path: Raw(arrays))
    return path


def test_raw_files(arrays, raw):
    events, given = read_events(raw, CGEM), bes3_layout.tables_of(arrays, CGEM)
    assert events.number.tolist() == given.number.tolist()
    for name in ("layer", "sheet", "view", "strip", "charge", "time"):
        np.testing.assert_array_equal(events.digis[name], given.digis[name])
    for name in ("event", "layer", "wire", "tdc"):
        np.testing.assert_array_equal(events.wire_digis[name], given.wire_digis[name])
    assert (events.wire_digis["particle"] == -1).all()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pybes3 leaves it open
def test_damaged_raw_file(tmp_path):
    path = tmp_path / "run.raw"
    path.write_bytes(bytes(100))
    with pytest.raises(ValueError, match=r"run.raw is not a complete file of the BESIII readout"):
        read_events(path, CGEM)
    with pytest.raises(ValueError, match=r"\.raw: digis as the detector was read out"):
        read_events(tmp_path / "run.root", CGEM)


def test_command(raw, found, tmp_path, capsys):
    out = tmp_path / "out"
    given = ["reconstruct", str(raw), "-d", "besiii-cgem", "--readout", "tiger", "--hypothesis", "mu", "-o", str(out)]
    assert main([*given, "--event", "3"]) == 0
    text = capsys.readouterr().out
    row = found.tracks[0]
    assert f"{row['p']:.3f}" in text
    assert f"{row['chi2']:.1f}" in text
    assert (out / "event-3.png").stat().st_size > 10_000
    assert {"bes3_tracks.csv", "bes3_points.csv", "bes3_residuals.csv"} < {path.name for path in out.iterdir()}
    summary = json.loads((out / "summary.json").read_text())
    assert summary["large_chi2"] == np.count_nonzero(found.tracks["status"] == cg.FitStatus.large_chi2)
    assert len(re.findall(r" ok +ok *$", text, re.MULTILINE)) == EVENTS
    offset = summary["strip_times"]["offset"]
    assert offset["value"] == pytest.approx(found.strip_times.meta["offset"])
    assert summary["events_with_start_time"] == EVENTS
    cells, kept = summary["cells"], len(found.wire_hits)
    assert cells["fired"] - cells["outside"] == kept > 1000
    strips = f"{found.strip_times['n_outside'].sum()} of {len(found.digis)} strips"
    assert f"without a start time: {cells['outside']} of {cells['fired']} cells, {strips}" in text
    table = np.genfromtxt(out / "bes3_tracks.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["p"], found.tracks["p"], rtol=1e-7)
    assert main([*given, "--event", "30", "--overwrite"]) == 2
    assert "--event: got 30; expected numbers from 0 to 29" in capsys.readouterr().err


def test_the_event_to_draw_has_most_clusters(found):
    """Event 5 of run 91668 has most hits, and no cluster on a track."""
    clusters, wires = np.zeros(EVENTS, np.int64), np.full(EVENTS, 20)
    wires[5], clusters[[2, 8]], wires[8] = 90, 6, 30
    assert fullest(found.tracks.with_columns(n_clusters=clusters, n_wires=wires)) == 8
    assert fullest(found.tracks[:0]) == 0


@REAL
def test_public_events_of_2026():
    """Run 91668: 815 strips, of which the clustering kept none when their times counted from elsewhere."""
    events = read_events(
        Path(DATA) / "test_raw_data.raw", cg.load("besiii-cgem").with_field("besiii").with_readout("tiger")
    )
    found = reconstruct_events(events, SETTINGS)
    assert len(found.clusters) > 200
    assert abs(found.strip_times.meta["offset"] + 8638) < 10
    assert (found.start_times["status"] == StartTimeStatus.ok).sum() == 5
    assert (found.tracks["n_clusters"] > 0).sum() >= 5
    assert bes3_events.ENDINGS.keys() >= {".raw"}


@REAL
def test_public_simulated_strips(tmp_path):
    """Errors and Lorentz angle that the ten muons' own tracks tell make their pulls right; the truth is not used."""

    def muons(detector, table):
        events = read_events(Path(DATA) / "test_cgem.rtraw", detector)
        settings = replace(SETTINGS, cluster=cg.ClusterSettings(error_factors=table))
        return events, reconstruct_events(events, settings)

    def off(events, result):
        particles = events.particles
        first = [np.flatnonzero((particles["event"] == i) & (particles["pdg"] == -13))[0] for i in range(10)]
        true = at_origin(particles[np.array(first)], -1.0)[result.tracks["event"]]
        away = np.stack([result.tracks["dr"] - true[:, 0], result.tracks["dz"] - true[:, 3]])
        errors = np.stack([result.tracks["err_dr"], result.tracks["err_dz"]])
        return np.sqrt(np.mean(away**2, axis=1)), np.sqrt(np.mean((away / errors) ** 2, axis=1))

    described = cg.load("besiii-cgem").with_field("besiii").with_readout("tiger")
    events, first = muons(described, "")
    assert first.tracks["event"].tolist() == list(range(10))
    rms, pull = off(events, first)
    assert (pull > 1.5).all()
    detector = described
    for turn in range(2):
        angles = cg.lorentz_angles(muons(detector, "")[1])
        table = tmp_path / f"errors-{turn}.csv"
        detector = described.with_overrides(angles.overrides)
        cg.cluster_error_factors(muons(detector, "")[1]).save(table)
    rms_after, pull_after = off(*muons(detector, str(table)))
    assert 26 < np.degrees(angles.angle[3]) < 33
    assert (rms_after < rms).all()
    assert rms_after[1] < 0.55
    assert (pull_after < 1.25).all()
