"""Tracks of three CGEM layers without a chamber: events with known answers."""

import dataclasses

import numpy as np
import pytest

import cgemit as cg
from cgemit.reconstruction.candidates import HIT_V, HIT_X
from cgemit.reconstruction.cluster import calibrated_clusterer
from cgemit.reconstruction.cluster_errors import calibration_of
from cgemit.reconstruction.find.truth import own_clusters
from cgemit.tables import Table

QUIET = cg.Settings(simulate=cg.SimulateSettings(decays=False, fluctuations="gaussian"))
N = 40


@pytest.fixture(scope="module")
def layers():
    return dataclasses.replace(cg.load("besiii-cgem-design"), drift_chamber=None)


@pytest.fixture(scope="module")
def run(layers):
    gun = cg.Gun("mu-", p=0.6, cos_theta=(-0.5, 0.5))
    return cg.run(layers, gun, N, settings=QUIET, until="cluster", finder="truth")


@pytest.fixture(scope="module")
def single(run):
    """The X and V clusters of one muon an event, without points."""
    rows = own_clusters(run.detector, run.clusters, run.truths)
    clusters = run.clusters[np.sort(rows)]
    none = np.full(len(clusters), -1)
    return clusters.with_columns(x_cluster=none, v_cluster=none)[clusters["view"] < 2]


def find(layers, clusters, **settings):
    wires = Table.empty("wire_hits", **clusters.cover)
    return cg.find_tracks(layers, clusters, wires, cg.FindSettings(**settings))


def sizes(found):
    """Numbers of hits of the candidates of each event, the best first."""
    hits, candidate = np.zeros((N, 8), int), found["candidate_hits"]["candidate"]
    np.add.at(hits, (found["candidate_hits"]["event"], found["candidates"]["candidate"][candidate]), 1)
    return hits


def on(clusters, layer, view):
    return (clusters["layer"] == layer) & (clusters["view"] == view)


def joined(*parts):
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["event"], kind="stable")
    return Table("clusters", {name: column[order] for name, column in columns.items()}, **parts[0].cover)


def test_six_clusters_are_a_track(layers, single):
    hits = sizes(find(layers, single))
    assert (hits[:, 0] == 6).mean() > 0.97
    assert not hits[:, 1:].any()


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_a_track_without_one_height_has_five_clusters(layers, single, layer):
    hits = sizes(find(layers, single[~on(single, layer, HIT_V)]))
    assert (hits[:, 0] == 5).mean() > 0.9
    assert not hits[:, 1:].any()


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_two_coordinates_across_the_beam_are_no_track(layers, single, layer):
    assert len(find(layers, single[~on(single, layer, HIT_X)])["candidates"]) == 0


def test_a_height_moved_by_more_than_a_line_allows_is_left_out(layers, single):
    moved = single.with_columns(v=single["v"] + np.where(on(single, 1, HIT_V), 15.0, 0.0))
    found = find(layers, moved)
    assert (sizes(found)[:, 0] == 5).mean() > 0.9
    assert not on(moved[found["candidate_hits"]["row"]], 1, HIT_V).any()


def test_a_cluster_moved_by_a_delta_electron_stays(layers, single):
    # Ten errors of the cluster; without tails in the score, the track would be one of five clusters.
    moved = single.with_columns(v=single["v"] + np.where(on(single, 1, HIT_V), 10 * single["err_v"], 0.0))
    assert (sizes(find(layers, moved))[:, 0] == 6).mean() > 0.9


def test_of_two_clusters_in_a_view_the_one_on_the_line_is_taken(layers, single):
    other = single[on(single, 2, HIT_V)]
    other = other.with_columns(v=other["v"] + 4.0, truth=np.full(len(other), -1))
    clusters = joined(other, single)
    found = find(layers, clusters)
    hits = sizes(found)
    assert (hits[:, 0] == 6).mean() > 0.97
    assert not hits[:, 1:].any()
    rows = found["candidate_hits"]["row"]
    assert np.mean(clusters["truth"][rows] >= 0) > 0.97


@pytest.mark.parametrize(("turned", "tracks"), [(2, 2), (1, 1)])
def test_two_tracks_may_share_a_third_of_their_clusters(layers, single, turned, tracks):
    """A second particle whose clusters in the outer layers lie 3 mm aside, and which shares the others."""
    part = single["layer"] >= 3 - turned
    stereo = np.array([layer.stereo for layer in layers.cgem])[single["layer"]]
    shift = np.where(single["view"] == HIT_X, 3.0, 3.0 * np.cos(stereo))
    copy = single.with_columns(x=single["x"] + shift, v=single["v"] + shift)[part]
    hits = sizes(find(layers, joined(single, copy)))
    assert ((hits > 0).sum(axis=1) == tracks).mean() > 0.9


def test_two_tracks_may_not_share_half_of_their_clusters(layers, single):
    """A second line in z through the same X clusters, 10 mm along the beam."""
    sine = np.sin([layer.stereo for layer in layers.cgem])[single["layer"]]
    copy = single.with_columns(v=single["v"] + 10.0 * sine)[single["view"] == HIT_V]
    hits = sizes(find(layers, joined(single, copy)))
    assert (hits[:, 0] == 6).mean() > 0.9
    assert not hits[:, 1:].any()


def test_the_score_asked_for_decides(layers, single):
    assert len(find(layers, single, min_score=60.0)["candidates"]) == 0
    assert len(find(layers, single, method="chamber")["candidates"]) == 0


def test_the_order_of_clusters_does_not_matter(layers, single):
    random = np.random.default_rng(3)
    order = np.lexsort((random.random(len(single)), single["event"]))
    straight, mixed = find(layers, single), find(layers, single[order])
    assert straight["candidates"] == mixed["candidates"]
    assert np.array_equal(straight["candidate_hits"]["row"], order[mixed["candidate_hits"]["row"]])


def test_seeds_may_leave_out_a_layer():
    """Particles that begin behind the beam pipe, in four layers of which the second is dead."""
    detector = dataclasses.replace(cg.load("kloe2-like"), drift_chamber=None)
    gun = cg.Gun("mu-", p=(0.3, 0.6), cos_theta=(-0.5, 0.5), vertex=(80.0, 0.0, 0.0), phi=(0.6, 1.0))
    result = cg.run(detector, gun, N, settings=QUIET, until="cluster")
    for dead in (1, 2):
        clusters = result.clusters[(result.clusters["layer"] != dead) & (result.clusters["view"] < 2)]
        hits = sizes(find(detector, clusters))
        assert (hits[:, 0] == 6).mean() > 0.9


@pytest.mark.parametrize(("margin", "of_six"), [(50.0, (0.9, 1.0)), (1e4, (0.0, 0.1))])
def test_strips_out_of_time_do_not_move_a_track(layers, margin, of_six):
    """Noise on 24 strips beside a V cluster, 600 ns late, would move its centre of charge off the track."""
    tiger = cg.TigerReadout(time_margin=margin, estimator="centroid")
    gun = cg.Gun("mu-", p=0.6, cos_theta=(-0.3, 0.3))
    run = cg.run(layers, gun, N, readout=tiger, until="cluster")
    digis = run.digis
    last = np.flatnonzero(on(digis, 1, HIT_V) & np.append(np.diff(digis["strip"]) != 1, True))
    rows = np.repeat(last, 25)
    beside = np.tile(np.arange(25), len(last))
    noise = digis[rows].with_columns(
        strip=(digis["strip"][rows] + beside).astype("i4"),
        charge=digis["charge"][rows] * 0.98**beside,  # no valley, at which clusters are split
        time=digis["time"][rows] + 600.0,
    )[beside > 0]
    columns = {name: np.concatenate([digis[name], noise[name]]) for name in digis}
    order = np.lexsort([columns[name] for name in ("strip", "view", "sheet", "layer", "event")])
    noisy = Table("digis", {name: column[order] for name, column in columns.items()}, **digis.cover)
    clusters = calibrated_clusterer(tiger).cluster_with(layers, noisy, calibration_of(layers, tiger))
    share = (sizes(find(layers, clusters)) == 6).any(axis=1).mean()
    assert of_six[0] <= share <= of_six[1]


def test_with_background_and_charge_and_time():
    """X and V of nearly all findable particles, few fakes: the working point of docs/methods/find.md."""
    detector = dataclasses.replace(cg.load("besiii-cgem"), drift_chamber=None)
    gun = cg.Gun("mu-", p=(0.1, 1), cos_theta=(-0.9, 0.9)) + cg.Gun("pi+", p=(0.1, 1), cos_theta=(-0.9, 0.9))
    settings = cg.Settings(
        simulate=cg.SimulateSettings(decays=False),
        background=cg.BackgroundSettings(level="bes2026"),
        digitize=cg.DigitizeSettings(readout="tiger"),
    )
    finding = cg.study.finding(cg.run(detector, gun + gun, 100, settings=settings, seed=5, until="find", finder="ckf"))
    rates = finding.rates()
    assert rates.efficiency.value > 0.985
    assert rates.fakes.value < 0.02
    assert rates.clones.value < 0.01
    assert finding.purity > 0.99
