"""Background: rates, links, and what it leaves as it is."""

import numpy as np
import pytest

import cgemit as cg
from cgemit.background import RUNS, STRIP_RATE, add_background
from cgemit.tables import Table

MUON = cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))


@pytest.fixture(scope="module")
def run():
    return cg.run("besiii-cgem", MUON, n=100, until="cluster")


def added(run, **settings):
    return add_background(run.detector, run.digis, run.wire_hits, cg.BackgroundSettings(**settings), seed=3)


def empty(run, n=400):
    return [Table.empty(kind, n_events=n) for kind in ("digis", "wire_hits")]


def test_off_changes_nothing(run):
    for settings in ({}, {"level": "bes2009", "factor": 0.0}):
        tables = added(run, **settings)
        assert tables["digis"] is run.digis
        assert tables["wire_hits"] is run.wire_hits


def test_the_shares_of_fired_cells_are_the_measured_ones(run):
    # Mean shares of random triggers of 2009: 34, 14, 7, 6.3 and 1.5 %; their rates have two digits.
    for clumps in (False, True):
        settings = cg.BackgroundSettings(level="bes2009", clumps=clumps)
        wires = add_background(cg.load("besiii-idc"), *empty(run), settings, seed=1)["wire_hits"]
        cells = {layer.number: layer.cells for layer in cg.load("besiii-idc").drift_chamber.layers}
        for layer, share in ((0, 0.32), (3, 0.14), (9, 0.07), (20, 0.06), (36, 0.015)):
            mean = np.count_nonzero(wires["layer"] == layer) / 400 / cells[layer]
            assert mean == pytest.approx(share, rel=0.15), layer
    assert np.all(np.diff(wires["event"]) >= 0)


def test_a_given_share_of_cells_fires_within_the_drift_time(run):
    single = cg.BackgroundSettings(cells=0.2, clumps=False)
    wires = add_background(run.detector, *empty(run, 50), single, 1)["wire_hits"]
    total = 50 * sum(layer.cells for layer in run.detector.drift_chamber.layers)
    assert len(wires) / total == pytest.approx(0.2, abs=5 * np.sqrt(0.16 / total))
    assert wires["drift_time"].max() < 400
    clumped = add_background(run.detector, *empty(run, 50), cg.BackgroundSettings(cells=0.2), 1)["wire_hits"]
    assert len(clumped) / total == pytest.approx(0.2, rel=0.05)
    # Far more neighbours than of independent cells.
    pairs = [np.mean(np.diff(table["gid"]) == 1) for table in (wires, clumped)]
    assert pairs[0] == pytest.approx(0.2, abs=0.02)
    assert pairs[1] > 0.4
    assert RUNS[0] / RUNS.sum() == pytest.approx(0.645, abs=0.001)


def test_the_earliest_hit_of_a_cell_is_kept(run):
    wires = added(run, cells=0.5)["wire_hits"]
    key = np.stack([wires["event"], wires["gid"]])
    assert len(np.unique(key, axis=1).T) == len(wires)
    times = {(e, g): t for e, g, t in zip(wires["event"], wires["gid"], wires["drift_time"], strict=True)}
    for event, gid, drift in zip(
        run.wire_hits["event"], run.wire_hits["gid"], run.wire_hits["drift_time"], strict=True
    ):
        assert times[event, gid] <= drift
    lost = len(run.wire_hits) - np.count_nonzero(wires["wire_truth"] >= 0)
    assert 0.05 < lost / len(run.wire_hits) < 0.4
    first = dict(
        zip(zip(run.wire_hits["layer"], run.wire_hits["wire"], strict=True), run.wire_hits["gid"], strict=True)
    )
    for layer, wire, gid in zip(wires["layer"], wires["wire"], wires["gid"], strict=True):
        assert first.get((layer, wire), gid) == gid


def test_strips_of_particles_stay_as_they_are(run):
    digis = added(run, level="bes2026", factor=3.0)["digis"]
    mine = digis[digis["n_truths"] > 0]
    assert all(np.array_equal(mine[name], run.digis[name], equal_nan=True) for name in digis if name != "event")
    noise = digis[digis["n_truths"] == 0]
    assert (noise["truth"] == -1).all()
    known = dict(
        zip(
            zip(*(run.digis[name] for name in ("layer", "sheet", "view", "strip")), strict=True),
            run.digis["gid"],
            strict=True,
        )
    )
    places = zip(*(noise[name] for name in ("layer", "sheet", "view", "strip")), strict=True)
    assert all(known.get(place, gid) == gid for place, gid in zip(places, noise["gid"], strict=True))


def test_clusters_and_noise_of_strips_have_their_rates(run):
    quiet, noisy = (
        add_background(run.detector, *empty(run, 150), cg.BackgroundSettings(level=level), seed=1)["digis"]
        for level in ("bes2009", "bes2026")
    )
    layer = run.detector.cgem[0]
    expected = layer.sheets * layer.strips_v * STRIP_RATE[1] * 1e-3 * 150
    more = np.count_nonzero((noisy["layer"] == 0) & (noisy["view"] == 1)) - np.count_nonzero(
        (quiet["layer"] == 0) & (quiet["view"] == 1)
    )
    assert more == pytest.approx(expected, rel=0.1)
    # 1.9 kHz/cm^2 (r/76 mm)^-2.2: 4.9, 3.0 and 2.9 clusters of 3.5 strips in each view and microsecond.
    for number, clusters in enumerate((4.9, 3.0, 2.9)):
        strips = np.count_nonzero((quiet["layer"] == number) & (quiet["view"] == 0)) / 150
        assert strips == pytest.approx(3.5 * clusters, rel=0.3), number


def test_events_do_not_depend_on_each_other(run):
    settings = cg.BackgroundSettings(level="bes2026")
    whole = add_background(run.detector, *empty(run, 10), settings, seed=1)
    part = add_background(
        run.detector,
        *(Table.empty(kind, n_events=4, first_event=3) for kind in ("digis", "wire_hits")),
        settings,
        seed=1,
    )
    for name, table in part.items():
        assert table == whole[name].select_events(3, 7)


def test_background_is_part_of_the_chain():
    settings = cg.Settings(background=cg.BackgroundSettings(level="bes2009"))
    result = cg.run("besiii-cgem", MUON, n=5, settings=settings)
    assert np.count_nonzero(result.wire_hits["wire_truth"] < 0) > 100
    assert (result.matches["purity"] == 1).all()


def test_rates_that_cannot_be_are_refused():
    for wrong in ({"factor": 200.0}, {"cells": 0.5, "factor": 2.0}):
        with pytest.raises(ValueError, match=r"expected a (number from 0 to 100|product up to 0\.6)"):
            cg.BackgroundSettings(**wrong)
