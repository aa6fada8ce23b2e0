"""Errors of clusters and Lorentz angles from tracks, against errors and angles that were made wrong on purpose."""

from dataclasses import replace

import numpy as np
import pytest

import cgemit as cg
from cgemit.reconstruction.cluster_errors import ErrorFactors, read_error_factors, with_factors

NOMINAL = cg.load("besiii-cgem").with_readout("tiger")


@pytest.fixture(scope="module")
def run():
    settings = cg.Settings(simulate=cg.SimulateSettings(decays=False))
    gun = cg.Gun("mu-", p=(0.5, 1.5), cos_theta=(-0.7, 0.7))
    return cg.run(NOMINAL, gun, n=300, seed=12, settings=settings)


@pytest.fixture(scope="module")
def factors(run):
    return cg.cluster_error_factors(run)


def reconstructed(run, detector, clusters):
    made = cg.reconstruct(detector, clusters, run.wire_hits, cg.find_tracks)
    kept = {"clusters": clusters, "wire_hits": run.wire_hits, **made}
    return cg.Result(detector=detector, gun=None, seed=0, settings=run.settings, timings={}, tables=kept)


def of_views(factor):
    """Return factors of X and V, each the mean over layers and sizes, weighted with hits."""
    return [np.average(factor.factor[factor.view == i], weights=factor.hits[factor.view == i]) for i in (0, 1)]


def test_errors_of_the_design_need_no_factor(run, factors):
    for value in of_views(factors):
        assert value == pytest.approx(0.93, abs=0.15)
    assert factors.hits.sum() > 5.5 * 300
    assert "factors on errors of clusters" in repr(factors)


def test_errors_that_are_wrong_by_known_factors(run, factors):
    """X errors are halved and V errors doubled; factors undo both, although each track has wrong errors everywhere."""
    wrong = ErrorFactors(
        factors.layer, factors.view, factors.size, factors.hits, np.where(factors.view == 0, 0.5, 2.0), factors.err
    )
    spoilt = reconstructed(run, NOMINAL, with_factors(NOMINAL, run.clusters, wrong))
    x, v = of_views(cg.cluster_error_factors(spoilt))
    x0, v0 = of_views(factors)
    assert x == pytest.approx(2 * x0, rel=0.15)
    assert v == pytest.approx(0.5 * v0, rel=0.15)
    pulls = cg.study.hit_residuals(spoilt)
    assert np.sqrt(np.mean(pulls.pull[(pulls.view == 0) & pulls.counts] ** 2)) > 1.2


def test_the_setting_reads_the_saved_table(run, factors, tmp_path):
    double = ErrorFactors(
        *(getattr(factors, n) for n in ("layer", "view", "size", "hits")), 2 + factors.factor * 0, factors.err
    )
    path = double.save(tmp_path / "errors.csv")
    again = read_error_factors(str(path))
    np.testing.assert_array_equal(again.factor, double.factor)
    wider = cg.cluster(NOMINAL, run.digis, cg.ClusterSettings(error_factors=str(path)))
    plain = cg.cluster(NOMINAL, run.digis)
    for name in ("err_x", "err_v", "err_phi", "err_z"):
        np.testing.assert_allclose(wider[name], 2 * plain[name], rtol=1e-12)
    for name in ("x", "v", "z", "phi", "x_cluster"):
        np.testing.assert_array_equal(wider[name], plain[name])
    one_view = ErrorFactors(factors.layer, factors.view, factors.size, factors.hits, 1.0 + factors.view, factors.err)
    joined = with_factors(NOMINAL, plain, one_view)
    xv = joined["view"] == 2
    stereo = np.array([layer.stereo for layer in NOMINAL.cgem])[joined["layer"]]
    expected = np.hypot(2 * plain["err_v"], np.cos(stereo) * plain["err_x"]) / np.abs(np.sin(stereo))
    np.testing.assert_allclose(joined["err_z"][xv], expected[xv], rtol=1e-9)
    np.testing.assert_array_equal(joined["err_phi"][xv], plain["err_phi"][xv])


def test_wrong_tables_and_readouts(run, factors, tmp_path):
    path = tmp_path / "errors.csv"
    path.write_text("layer,view,size,hits,factor,err\n0,0,1,5,1.5,0.1\n0,2,1,5,1.5,0.1\nx,0,1,5,1.5,0.1\n0,0,1,5,-1,\n")
    with pytest.raises(ValueError, match="line 3") as caught:
        read_error_factors(str(path))
    for line in ("line 3: got '0,2,1,5,1.5,0.1'", "line 4: got 'x,0", "line 5: got '0,0,1,5,-1,'"):
        assert line in str(caught.value)
    path.write_text("a,b\n")
    with pytest.raises(ValueError, match="line 1: got 'a,b', expected layer,view,size"):
        read_error_factors(str(path))
    binary = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.1), n=3)
    with pytest.raises(ValueError, match="expected those of a readout with charge"):
        cg.cluster_error_factors(binary)
    with pytest.raises(ValueError, match="expected those of a readout with charge"):
        with_factors(binary.detector, binary.clusters, factors)
    with pytest.raises(ValueError, match="has no readout with times"):
        cg.lorentz_angles(binary)


def test_lorentz_angle_is_found(run):
    """Clusters of 25.5 degrees, made with 25.5 and with 32 degrees."""
    right = cg.lorentz_angles(run)
    assert right.label == ["L1", "L2", "L3", "all"]
    assert np.degrees(right.assumed) == pytest.approx(25.5, abs=0.05)
    assert abs(np.degrees(right.angle[3] - right.assumed[3])) < 1.5
    assert np.degrees(right.err[3]) < 0.6
    other = NOMINAL.with_overrides({"cgem.*.lorentz_angle": "32 deg"})
    wrong = cg.lorentz_angles(reconstructed(run, other, cg.cluster(other, run.digis)))
    assert np.degrees(wrong.assumed) == pytest.approx(32.0)
    assert abs(np.degrees(wrong.angle[3]) - 26.5) < 2.0
    assert wrong.assumed[3] - wrong.angle[3] > 6 * wrong.err[3]
    assert set(wrong.overrides) == {f"cgem.L{i}.lorentz_{one}" for i in (1, 2, 3) for one in ("angle", "shift")}
    few = reconstructed(run, NOMINAL, run.clusters)
    few.tables["candidate_hits"] = few.tables["candidate_hits"][few.candidate_hits["event"] < 5]
    assert np.isnan(cg.lorentz_angles(few).angle[:3]).all()


def test_a_new_angle_leaves_x_of_mid_gap(run):
    """Clusters with another angle alone move by 0.3 mm together: the track cannot tell this from a rotation."""
    found = cg.lorentz_angles(run)
    turned = replace(found, angle=found.angle + np.radians(6.0))
    moved = {name: text for name, text in turned.overrides.items() if name.endswith("angle")}
    means = []
    for overrides in (turned.overrides, moved):
        detector = NOMINAL.with_overrides(overrides)
        again = cg.cluster(detector, run.digis)
        x = (again["view"] == 0) & (again["charge"] > 10)
        means.append(np.mean(again["x"][x] - cg.cluster(NOMINAL, run.digis)["x"][x]))
    assert abs(means[0]) < 0.06
    assert means[1] > 0.25
    few = replace(found, angle=np.array([np.nan, *found.angle[1:]]))
    assert few.overrides["cgem.L1.lorentz_angle"] == f"{found.angle[3]:.6g} rad"
    none = replace(found, angle=np.full(4, np.nan))
    assert none.overrides == {}


def test_lorentz_angle_moves_the_charge_of_a_depth():
    """tan(35 deg) - tan(25.5 deg) over the ratio of radii per mm of depth, in simulation and clusters alike."""
    turned = NOMINAL.with_overrides({"cgem.*.lorentz_angle": "35 deg"})
    run = cg.run(turned, cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), n=60, seed=3)
    mine = cg.study.hit_residuals(run)
    mine = mine.select((mine.view == 0) & mine.counts)
    assert np.sqrt(np.mean(mine.pull**2)) < 1.3
    assert "lorentz_angle" in turned.to_toml()
    assert "lorentz_angle" not in NOMINAL.to_toml()
