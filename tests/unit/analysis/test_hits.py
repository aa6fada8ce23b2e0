"""Residuals and efficiencies of hits, against truth and against what is taken away or spoilt."""

import numpy as np
import pytest
from scipy import stats

import cgemit as cg
from cgemit.detector.core import layer_table
from stats import assert_within

N = 250


@pytest.fixture(scope="module")
def run():
    settings = cg.Settings(simulate=cg.SimulateSettings(decays=False))
    gun = cg.Gun("mu-", p=(0.5, 1.5), cos_theta=(-0.7, 0.7))
    return cg.run("besiii-cgem", gun, n=N, seed=11, readout="tiger", settings=settings)


@pytest.fixture(scope="module")
def hits(run):
    return cg.study.hit_residuals(run)


def changed(run, **tables):
    """Return the run with other tables, found and fitted again without truth."""
    clusters, wires = tables.get("clusters", run.clusters), tables.get("wire_hits", run.wire_hits)
    made = cg.reconstruct(run.detector, clusters, wires, cg.find_tracks)
    kept = {"clusters": clusters, "wire_hits": wires, **made}
    return cg.Result(detector=run.detector, gun=None, seed=0, settings=run.settings, timings={}, tables=kept)


def test_rows_are_hits_of_their_tables(run, hits):
    x, wire = hits.select(hits.view == 0), hits.select(hits.view == 2)
    np.testing.assert_array_equal(x.size, run.clusters["size"][x.hit])
    np.testing.assert_array_equal(x.layer, run.clusters["layer"][x.hit])
    np.testing.assert_array_equal(x.own, run.clusters["err_x"][x.hit])
    np.testing.assert_array_equal(wire.layer, run.wire_hits["layer"][wire.hit])
    np.testing.assert_array_equal(wire.time, run.wire_hits["drift_time"][wire.hit])
    away = np.angle(np.exp(1j * (x.phi - run.clusters["phi"][x.hit])))
    assert np.quantile(np.abs(away), 0.9) < 0.02
    # Muons from the beam line: tan(incidence) is |z| over the radius, but for the bending.
    radius = np.array([layer.r_mid for layer in run.detector.cgem])[x.layer]
    assert np.median(np.abs(np.tan(x.incidence) - np.abs(x.z) / radius)) < 0.02
    assert hits.used.sum() == run.tracks["n_clusters"].sum() + run.tracks["n_wires"].sum()


def test_pulls_of_good_errors_are_one_and_of_halved_ones_larger(run, hits):
    table = hits.select(hits.view < 2).binned("layer")
    assert table.n.sum() == np.count_nonzero(hits.view < 2)
    assert (np.abs(table.pull - 0.95) < 0.2).all()
    halved = run.clusters.with_columns(**{name: 0.5 * run.clusters[name] for name in ("err_x", "err_phi")})
    worse = cg.study.hit_residuals(changed(run, clusters=halved))
    worse = worse.select(worse.view == 0).binned("layer")
    assert (worse.pull > 1.2).all()


def test_bins(hits):
    by_hand = hits.select((hits.view == 1) & (hits.size == 3) & (np.abs(hits.pull) < 5))
    table = hits.binned("size", edges=[1, 2, 3, 4])
    row = np.flatnonzero((table.view == 1) & (table.low == 3))[0]
    assert_within(table.mean[row], by_hand.residual.mean(), 1e-12)
    assert_within(table.rms[row], by_hand.residual.std(ddof=1), 1e-12)
    assert_within(table.err_mean[row], by_hand.residual.std(ddof=1) / np.sqrt(len(by_hand)), 1e-12)
    equal = hits.binned("time")
    counts = equal.n[equal.view == 0]
    assert len(counts) == 8
    assert counts.max() - counts.min() < 0.1 * counts.mean()
    with pytest.raises(ValueError, match="by: got 'sizes', expected one of event, track, layer"):
        hits.binned("sizes")
    with pytest.raises(ValueError, match="expected two or more numbers that grow"):
        hits.binned("size", edges=[2, 1])
    assert "residuals from tracks fitted without the hit" in repr(hits)


def test_efficiency_of_a_layer_that_loses_a_known_share(run):
    """A third of the V clusters of L2 are taken away; predictions come from the other layers."""
    whole = cg.study.layer_efficiencies(run)
    at = [i for i, name in enumerate(whole.region) if name == "all"]
    assert (whole.both[at] > 0.95).all()
    assert (whole.tracks[at] > 0.9 * N).all()
    clusters = run.clusters
    # Rows stay, so that links do; a cluster that is moved away from its track is lost to it.
    lost = (clusters["layer"] == 1) & (clusters["view"] == 1) & (clusters["event"] % 3 == 0)
    moved = clusters.with_columns(v=np.where(lost, clusters["v"] + 60.0, clusters["v"]))
    tables = dict(run.tables) | {"clusters": moved}
    found = cg.study.layer_efficiencies(
        cg.Result(detector=run.detector, gun=None, seed=0, settings=run.settings, timings={}, tables=tables)
    )
    row = at[1]
    assert found.label[row] == "L2"
    n = found.tracks[row]
    assert_within(found.v[row], whole.v[row] * 2 / 3, np.sqrt(2 / 9 / n), 4.0)
    assert found.x[row] == whole.x[row]
    assert found.both[at[0]] == pytest.approx(whole.both[at[0]], abs=0.03)
    sheets = [i for i in range(len(found.label)) if found.label[i] == "L2" and found.region[i].startswith("sheet")]
    assert found.tracks[sheets].sum() == n
    with pytest.raises(ValueError, match=r"near: got -1\.0, expected a positive distance"):
        cg.study.layer_efficiencies(run, near=-1.0)


def test_intervals_of_efficiencies_are_those_of_scipy(run):
    """Wilson's interval without continuity correction, of scipy; all of n seen: up to 100 % and not beyond."""
    found = cg.study.layer_efficiencies(run)
    confidence = 2 * stats.norm.cdf(1) - 1
    for name in ("x", "v", "both"):
        share, low, high = (getattr(found, key) for key in (name, f"{name}_low", f"{name}_high"))
        for i, n in enumerate(found.tracks.tolist()):
            ends = stats.binomtest(round(share[i] * n), n).proportion_ci(confidence, method="wilson")
            np.testing.assert_allclose((low[i], high[i]), ends, rtol=1e-9)
        assert high.max() <= 1
    whole = found.columns()
    row = int(np.argmax(found.x))
    assert whole["x"][row] == whole["x_high"][row] == 1
    assert whole["x_low"][row] < 1
    assert "100.0 +0.0 -" in repr(found)


def test_efficiencies_in_bins(run):
    """Clusters of L1 in a part of the azimuth are moved away: the bins there lose them, the others do not."""
    crossings = cg.study.layer_crossings(run)
    whole = crossings.regions()
    at = [i for i, name in enumerate(whole.region) if name == "all"]
    by_z = crossings.binned("z", edges=[-400, -50, 50, 400])
    assert by_z.label == ["L1"] * 3 + ["L2"] * 3 + ["L3"] * 3
    assert by_z.tracks.reshape(3, 3).sum(axis=1).tolist() == whole.tracks[at].tolist()
    clusters = run.clusters
    lost = (clusters["layer"] == 0) & (clusters["view"] == 0) & (np.abs(clusters["phi"]) < 0.5)
    moved = clusters.with_columns(phi=np.where(lost, clusters["phi"] + 1.5, clusters["phi"]))
    spoilt = cg.Result(
        detector=run.detector, gun=None, seed=0, settings=run.settings, timings={},
        tables=dict(run.tables) | {"clusters": moved},
    )  # fmt: skip
    by_phi = cg.study.layer_crossings(spoilt).binned("phi", edges=[-3.2, -0.6, -0.4, 0.4, 0.6, 3.2])
    assert by_phi.x[2] == 0
    assert by_phi.x[[0, 4]].min() > 0.95
    assert by_phi.v[2] > 0.9
    assert by_phi.low[:5].tolist() == [-3.2, -0.6, -0.4, 0.4, 0.6]
    with pytest.raises(ValueError, match="by: got 'layer', expected one of event, sheet, phi"):
        crossings.binned("layer")


def test_hot_and_dead_strips():
    detector = cg.load("besiii-cgem")
    layer = detector.cgem[0]
    n, strips = 600, layer.strips_x
    first = int(layer_table(detector.layers)["gid_first"][0])
    fires = np.random.default_rng(3).random((n, strips)) < 0.05
    fires[:, 100], fires[:, 200] = False, np.random.default_rng(4).random(n) < 0.3
    event, strip = np.nonzero(fires)
    none = np.zeros(len(event), np.int64)
    columns = dict.fromkeys(("layer", "sheet", "view", "n_truths"), none) | {"event": event, "truth": none - 1}
    columns |= {"strip": strip, "gid": first + strip, "position": none + np.nan, "charge": none + 1.0}
    columns["time"] = none + 0.0
    digis = cg.Table("digis", columns, n_events=n)
    status = cg.study.strip_status(detector, digis)
    assert np.flatnonzero(status == -1).tolist() == [first + 100]
    assert np.flatnonzero(status == 1).tolist() == [first + 200]
    few = digis[digis["event"] < 50]
    assert not (cg.study.strip_status(detector, few) == -1).any()


def test_results_without_tracks(run):
    tables = {"clusters": run.clusters, "wire_hits": run.wire_hits}
    bare = cg.Result(detector=run.detector, gun=None, seed=0, settings=run.settings, timings={}, tables=tables)
    for name, said in (("hit_residuals",) * 2, ("layer_crossings",) * 2, ("layer_efficiencies", "layer_crossings")):
        with pytest.raises(ValueError, match=f"{said}: got a result without tracks"):
            getattr(cg.study, name)(bare)
