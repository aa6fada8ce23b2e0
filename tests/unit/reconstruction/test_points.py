"""Clusters that compete for tracks: wrong ones are replaced, missing ones found, twins marked, far ones leave."""

import numpy as np
import pytest

import cgemit as cg
from cgemit.reconstruction.points import CERTAIN, settle_points

N = 60


@pytest.fixture(scope="module")
def run():
    settings = cg.Settings(
        background=cg.BackgroundSettings(level="run91668"), simulate=cg.SimulateSettings(decays=False)
    )
    gun = cg.Gun("mu-", p=(0.5, 1.5), cos_theta=(-0.7, 0.7))
    return cg.run("besiii-cgem", gun, n=N, seed=5, readout="tiger", settings=settings)  # true hits


def settled(run, clusters=None, **columns):
    """Return the candidate hits that competition leaves of the true ones, some of them changed."""
    clusters = run.clusters if clusters is None else clusters
    hits = run.candidate_hits.with_columns(**columns)
    found = {"candidates": run.candidates, "candidate_hits": hits}
    return settle_points(run.detector, clusters, run.wire_hits, found, cg.FitSettings())["candidate_hits"]


def strips(hits):
    return {
        key for key in zip(*(hits[name].tolist() for name in ("candidate", "view", "hit")), strict=True) if key[1] < 2
    }


def test_true_clusters_stay(run):
    hits = settled(run)
    true, mine = strips(run.candidate_hits), strips(hits)
    assert len(true & mine) > 0.98 * len(true)
    assert len(mine - true) < 0.01 * len(true)
    wire = hits["view"] == 2
    assert np.isnan(hits["margin"][wire]).all()
    assert (hits["margin"][~wire] > 0).all()
    np.testing.assert_array_equal(hits["ambiguous"] == 1, hits["margin"] < CERTAIN)
    assert hits["ambiguous"][~wire].mean() < 0.1


def test_a_wrong_v_is_replaced_and_lost_clusters_come_back(run):
    """V of L2 is another cluster of its sheet, wherever there is one; X and V of L3 are on no track."""
    clusters, given = run.clusters, run.candidate_hits
    row = given["hit"].copy()
    v = np.flatnonzero((given["view"] == 1) & (clusters["layer"][np.where(given["view"] < 2, row, 0)] == 1))
    wrong = []
    for i in v.tolist():
        same = [clusters[name] == clusters[name][row[i]] for name in ("event", "layer", "sheet", "view")]
        others = np.setdiff1d(np.flatnonzero(np.all(same, axis=0)), row[i])
        if len(others):
            row[i] = others[0]
            wrong.append(i)
    assert len(wrong) > 10
    in_l3 = (given["view"] < 2) & (clusters["layer"][np.where(given["view"] < 2, row, 0)] == 2)
    spoilt = given.with_columns(hit=row)[~in_l3]
    found = {"candidates": run.candidates, "candidate_hits": spoilt}
    true = strips(given)
    mine = strips(settle_points(run.detector, clusters, run.wire_hits, found, cg.FitSettings())["candidate_hits"])
    assert len(true & strips(spoilt)) < 0.7 * len(true)
    assert len(true & mine) > 0.97 * len(true)
    assert len(mine - true) < 0.02 * len(true)


def test_a_far_cluster_leaves_and_its_partner_stays(run):
    """V of L1 is 30 mm away from its tracks, with its pairs."""
    clusters = run.clusters
    moved = clusters.with_columns(
        v=np.where((clusters["layer"] == 0) & (clusters["view"] == 1), clusters["v"] + 30.0, clusters["v"])
    )
    hits = settled(run, moved)
    layer = clusters["layer"][np.where(hits["view"] < 2, hits["hit"], 0)]
    assert np.count_nonzero((hits["view"] == 0) & (layer == 0)) > 0.97 * N
    of_l1 = {key for key in strips(run.candidate_hits) if key[1] == 1 and clusters["layer"][key[2]] == 0}
    assert len(of_l1) > 0.9 * N
    assert not of_l1 & strips(hits)
    assert np.count_nonzero((hits["view"] == 1) & (layer == 0)) < 0.2 * N  # noise near the track instead


def test_clusters_that_measure_nothing_are_on_no_track(run):
    """V of L2 with an error of 300 mm, such as single strips have that may have lost most of their charge."""
    clusters = run.clusters
    of_l2 = (clusters["layer"] == 1) & (clusters["view"] == 1)
    hits = settled(run, clusters.with_columns(err_v=np.where(of_l2, 300.0, clusters["err_v"])))
    assert not of_l2[hits["hit"][hits["view"] == 1]].any()


def test_twins_are_ambiguous():
    """A V cluster 0.1 mm beside that of the track is as likely: whichever is taken is marked."""
    run = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=1, seed=2, readout="tiger")
    clusters = run.clusters
    n, v = len(clusters), int(np.flatnonzero((clusters["layer"] == 1) & (clusters["view"] == 1))[0])
    pair = int(np.flatnonzero(clusters["v_cluster"] == v)[0])
    columns = {name: np.concatenate([one, one[[v, pair]]]) for name, one in clusters.columns.items()}
    columns["v"] = columns["v"] + np.where(np.arange(n + 2) == n, 0.1, 0.0)
    columns["v_cluster"] = np.where(np.arange(n + 2) == n + 1, n, columns["v_cluster"])
    hits = settled(run, cg.Table("clusters", columns, n_events=1))
    taken = (hits["view"] == 1) & np.isin(hits["hit"], [v, n])
    assert taken.sum() == 1
    assert hits["ambiguous"][taken].tolist() == [1]
    assert not hits["ambiguous"][~taken].any()


def test_runs_take_it_from_the_settings():
    settings = cg.Settings(refine=cg.RefineSettings(points="compete"))
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))
    run = cg.run("besiii-cgem", gun, n=5, readout="tiger", settings=settings, finder="ckf")
    assert "ambiguous" in run.candidate_hits
    true = cg.run("besiii-cgem", gun, n=5, readout="tiger", settings=settings)
    assert "ambiguous" not in true.candidate_hits
