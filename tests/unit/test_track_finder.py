"""The finder without truth: events with known answers, symmetries, bounds."""

import dataclasses
import time
from math import gcd

import numpy as np
import pytest

import cgemit as cg
from cgemit.reconstruction.candidates import HIT_WIRE, HIT_XV
from cgemit.reconstruction.fit import fit
from cgemit.simulation.background import BackgroundSettings
from cgemit.tables import Table

QUIET = cg.Settings(simulate=cg.SimulateSettings(decays=False, fluctuations="gaussian"))
PAIR = cg.Gun("mu-", p=(0.3, 1.0), cos_theta=(-0.6, 0.6)) + cg.Gun("pi+", p=(0.2, 0.5), cos_theta=(-0.6, 0.6))


@pytest.fixture(scope="module")
def run():
    return cg.run("besiii-cgem", PAIR, n=20, settings=QUIET, until="find")


@pytest.fixture(scope="module")
def chamber():
    return cg.run("besiii-idc", PAIR, n=10, settings=QUIET, until="find")


def hits_of(found):
    """The hits of each candidate, as a set of (event, hits)."""
    hits, events = found["candidate_hits"], found["candidates"]["event"]
    sets = [set() for _ in events]
    for candidate, view, row in zip(hits["candidate"], hits["view"], hits["row"], strict=True):
        sets[candidate].add((int(view), int(row)))
    return {(int(event), frozenset(rows)) for event, rows in zip(events, sets, strict=True)}


def found_of(result, clusters=None, wire_hits=None):
    """The metrics of what is found in the hits of a run, or in other ones that link to the same truths."""
    tables = result.tables | {"clusters": clusters or result.clusters, "wire_hits": wire_hits or result.wire_hits}
    tables |= cg.find_tracks(result.detector, tables["clusters"], tables["wire_hits"])
    return cg.study.finding(cg.Result(**(vars(result) | {"tables": tables})))


def shuffled(table, random):
    """A table with the rows of each event in another order, and the old row of each."""
    order = np.lexsort((random.random(len(table)), table["event"]))
    return table[order], order


@pytest.mark.parametrize("name", ["besiii-cgem", "besiii-cgem-design", "besiii-idc"])
def test_single_tracks_have_all_their_hits_and_no_others(name):
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6))
    found, truth = (cg.run(name, gun, n=40, settings=QUIET, until="find", finder=f) for f in ("ckf", "truth"))
    assert len(found.candidates) == 40
    assert found.finder == "ckf"
    finding = cg.study.finding(found)
    assert finding.rates().efficiency.value == 1
    assert finding.purity == 1
    assert len(hits_of(found.tables) & hits_of(truth.tables)) > 30


def test_pairs_are_found(run):
    finding = found_of(run)
    assert finding.rates().efficiency.count == finding.findable.sum() == 40
    assert len(finding.candidates.hits) == 40
    assert finding.hit_efficiency > 0.98


def test_nothing_but_measurements_is_read(run):
    blind = run.clusters.with_columns(truth=np.full(len(run.clusters), -1), n_truths=np.zeros(len(run.clusters), "i4"))
    wires = run.wire_hits.with_columns(wire_truth=np.full(len(run.wire_hits), -1))
    assert hits_of(cg.find_tracks(run.detector, blind, wires)) == hits_of(
        cg.find_tracks(run.detector, run.clusters, run.wire_hits)
    )


def test_the_order_of_hits_does_not_matter(run):
    random = np.random.default_rng(1)
    single = run.clusters[run.clusters["view"] < 2]
    clusters, of_cluster = shuffled(single, random)
    wires, of_wire = shuffled(run.wire_hits, random)
    found = cg.find_tracks(run.detector, clusters, wires)
    hits = found["candidate_hits"]
    wire = hits["view"] == HIT_WIRE
    row = np.where(wire, np.append(of_wire, 0)[np.where(wire, hits["row"], -1)], 0)
    row[~wire] = of_cluster[hits["row"][~wire]]
    found["candidate_hits"] = hits.with_columns(row=row)
    straight = cg.find_tracks(run.detector, single, run.wire_hits)
    assert found["candidates"] == straight["candidates"]
    assert hits_of(found) == hits_of(straight)


def test_chunks_and_threads_do_not_matter():
    settings = cg.Settings(background=BackgroundSettings(level="bes2026"))
    whole, parts = (
        cg.run(
            "besiii-cgem", PAIR, n=12, settings=settings, finder="ckf", workers=cg.Workers(threads=threads, chunk=chunk)
        )
        for chunk, threads in ((100, 1), (5, 2))
    )
    assert whole == parts


def test_rotation_by_a_common_period_of_the_cells(chamber):
    layers = {layer.number: layer.cells for layer in chamber.detector.drift_chamber.layers}
    period = gcd(*layers.values())
    assert period > 1
    cells = np.array([layers[number] for number in chamber.wire_hits["layer"]])
    wire = (chamber.wire_hits["wire"] + cells // period) % cells
    turned = chamber.wire_hits.with_columns(wire=wire.astype("i4"))
    found = [cg.find_tracks(chamber.detector, chamber.clusters, wires) for wires in (chamber.wire_hits, turned)]
    assert len(found[0]["candidates"]) == 20
    assert hits_of(found[0]) == hits_of(found[1])


def test_the_other_charge_in_the_other_field_is_the_same_track(run):
    other = run.detector.with_overrides({"field.bz": "1 T"})
    found = [cg.find_tracks(detector, run.clusters, run.wire_hits) for detector in (run.detector, other)]
    assert hits_of(found[0]) == hits_of(found[1])


def test_two_tracks_that_cross_in_the_chamber():
    # Two circles of radius 1/3 m, flown through in opposite senses, cross 0.4 m from the beam line.
    gun = cg.Gun("mu-", pt=0.3, theta=np.pi / 2, phi=0.0) + cg.Gun("mu+", pt=0.3, theta=np.pi / 2, phi=-0.43)
    run = cg.run("besiii-cgem", gun, n=5, settings=QUIET, until="find")
    wires = run.wire_truths
    cells = [
        set(zip(wires["layer"][on], wires["wire"][on], strict=True)) for p in (0, 1) for on in [wires["particle"] == p]
    ]
    assert cells[0] & cells[1]  # they share cells: one of both loses its hit
    finding = found_of(run)
    assert len(finding.candidates.hits) == 10
    assert finding.rates().efficiency.value == 1
    assert (finding.candidates.of_particle >= 0.93 * finding.candidates.hits).all()


@pytest.mark.parametrize("dead", [0, 1, 2])
def test_a_dead_cgem_layer(run, dead):
    keep = run.clusters["layer"] != dead
    clusters = run.clusters.with_columns(x_cluster=np.full(len(keep), -1), v_cluster=np.full(len(keep), -1))[
        keep & (run.clusters["view"] < 2)
    ]
    finding = found_of(run, clusters)
    assert finding.rates().efficiency.value > 0.97
    assert finding.rates().fakes.count == 0


def test_dead_layers_of_wires(chamber):
    wires = chamber.wire_hits[~np.isin(chamber.wire_hits["layer"], [3, 12, 13, 24])]
    finding = found_of(chamber, wire_hits=wires)
    assert finding.rates().efficiency.value == 1
    assert finding.hit_efficiency > 0.97


def test_points_that_are_only_in_xv_clusters(run):
    points = run.clusters[run.clusters["view"] == 2]
    alone = points.with_columns(x_cluster=np.full(len(points), -1), v_cluster=np.full(len(points), -1))
    found = cg.find_tracks(run.detector, alone, run.wire_hits)
    views = found["candidate_hits"]["view"]
    assert set(views.tolist()) == {HIT_WIRE, HIT_XV}
    tracks = fit(run.detector, alone, run.wire_hits, **found)["tracks"]
    assert (tracks["status"] == cg.FitStatus.ok).mean() > 0.9


@pytest.mark.slow
def test_tracks_are_found_in_a_field_map():
    detector = cg.load("besiii-cgem").with_field("besiii")
    run = cg.run(detector, PAIR, n=3, settings=QUIET, finder="ckf")
    assert cg.study.finding(run).rates().efficiency.value == 1
    assert (run.tracks["status"] == cg.FitStatus.ok).all()


@pytest.mark.parametrize("method", ["segments", "chamber"])
def test_each_source_of_seeds_finds_tracks_by_itself(run, method):
    found = cg.find_tracks(run.detector, run.clusters, run.wire_hits, cg.FindSettings(method=method))
    assert len(found["candidates"]) >= 38


def test_events_without_hits_and_without_tracks(run):
    empty = [Table.empty(kind, n_events=3) for kind in ("clusters", "wire_hits")]
    found = cg.find_tracks(run.detector, *empty)
    assert len(found["candidates"]) == 0
    assert found["candidates"].n_events == 3
    some = run.wire_hits[np.arange(len(run.wire_hits)) % 20 == 0]
    assert len(cg.find_tracks(run.detector, run.clusters[:0], some)["candidates"]) == 0


@pytest.mark.parametrize("name", ["besiii-cgem", "besiii-idc"])
def test_a_third_of_all_cells_at_random_is_bounded_work(name):
    nothing = cg.Gun("mu-", p=0.3, cos_theta=0.0)
    for clumps in (True, False):
        settings = cg.Settings(background=BackgroundSettings(level="bes2026", factor=1.0, cells=0.3, clumps=clumps))
        run = cg.run(name, nothing, n=2, settings=settings, until="cluster")
        start = time.perf_counter()
        found = cg.find_tracks(run.detector, run.clusters, run.wire_hits)
        assert time.perf_counter() - start < 5
        hits = found["candidate_hits"]
        on_wires = hits["row"][hits["view"] == HIT_WIRE]
        assert len(np.unique(on_wires)) == len(on_wires)  # no wire hit is of two tracks


def test_random_events_never_crash(run):
    random = np.random.default_rng(5)
    n = 400
    layers = random.integers(8, 43, n)
    cells = {layer.number: layer.cells for layer in run.detector.drift_chamber.layers}
    columns = {name: np.zeros(n, run.wire_hits[name].dtype) for name in run.wire_hits}
    columns |= {
        "layer": layers.astype("i4"),
        "wire": np.array([random.integers(cells[number]) for number in layers], "i4"),
        "drift": random.normal(4, 6, n), "sigma": random.uniform(0.01, 1, n), "wire_truth": np.full(n, -1),
        "event": np.sort(random.integers(0, 20, n)),
    }  # fmt: skip
    wires = Table("wire_hits", columns, **run.wire_hits.cover)
    pick = random.permutation(len(run.clusters))[:200]
    clusters = run.clusters[np.sort(pick)]
    wild = clusters.with_columns(
        x=clusters["x"] + random.normal(0, 300, 200), v=clusters["v"] * random.normal(0, 2, 200)
    )
    wild = wild.with_columns(x_cluster=np.full(200, -1), v_cluster=np.full(200, -1))
    cg.find_tracks(run.detector, wild[wild["view"] < 2], wires)


def test_wrong_input_is_listed(run):
    wrong = run.wire_hits.with_columns(layer=run.wire_hits["layer"] + 100)
    with pytest.raises(ValueError, match="wire_hits row 0: layer: got 108"):
        cg.find_tracks(run.detector, run.clusters, wrong)
    with pytest.raises(ValueError, match="wire_hits: cover other events"):
        cg.find_tracks(run.detector, run.clusters, Table.empty("wire_hits", n_events=1))
    with pytest.raises(TypeError, match="expected FindSettings"):
        cg.find_tracks(run.detector, run.clusters, run.wire_hits, cg.FitSettings())
    with pytest.raises(ValueError, match="expected 'truth', 'ckf' or a function"):
        cg.run("besiii-cgem", PAIR, n=1, finder="hough")


def test_of_tracks_that_share_hits_the_best_remains():
    # Slow pions are never beyond doubt: all their seeds are followed, and compete in the end.
    slow = cg.Gun("pi-", pt=(0.06, 0.1), cos_theta=(-0.8, 0.8))
    run = cg.run(
        "besiii-cgem", slow, n=100, settings=cg.Settings(simulate=cg.SimulateSettings(decays=False)), until="find"
    )
    finding = found_of(run)
    assert finding.rates().efficiency.value > 0.97
    assert len(finding.candidates.hits) <= 102
    assert finding.rates().fakes.count == 0


@pytest.mark.parametrize("name", ["besiii-cgem-design", "kloe2-like"])
def test_of_lines_in_z_the_one_from_the_origin_is_likelier(name):
    """Of the V clusters of a muon and of the same muon from 150 mm along the beam, the first ones win.

    The score of segments decides in three layers, that of followed tracks in four.
    """
    layers = dataclasses.replace(cg.load(name), drift_chamber=None)
    near, far = (
        cg.run(layers, cg.Gun("mu-", p=0.6, cos_theta=(-0.2, 0.2), vertex=(0, 0, z)), 40, settings=QUIET, until="find")
        for z in (0.0, 150.0)
    )
    parts = [near.clusters[near.clusters["view"] < 2], far.clusters[far.clusters["view"] == 1]]
    both = {name: np.concatenate([part[name] for part in parts]) for name in near.clusters}
    both["truth"][len(parts[0]) :] = -1
    order = np.argsort(both["event"], kind="stable")
    clusters = Table("clusters", {name: column[order] for name, column in both.items()}, **near.clusters.cover)
    found = cg.find_tracks(layers, clusters, near.wire_hits)
    first = found["candidates"]["candidate"][found["candidate_hits"]["candidate"]] == 0
    rows = found["candidate_hits"]["row"][first & (found["candidate_hits"]["view"] == 1)]
    assert len(rows) > 100
    assert np.mean(clusters["truth"][rows] >= 0) > 0.97


def test_unknown_views_are_refused():
    clusters = cg.run("besiii-cgem", PAIR, n=2, settings=QUIET, until="cluster").clusters
    view = clusters["view"].copy()
    view[3] = 100
    with pytest.raises(ValueError, match="clusters row 3: view: got 100, expected 0, 1 or 2"):
        cg.find_tracks("besiii-cgem", clusters.with_columns(view=view), cg.Table.empty("wire_hits", **clusters.cover))
