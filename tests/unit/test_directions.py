"""Positions and errors of clusters of charge and time by the direction of their track."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.widths import measure
from cgemit.reconstruction.cluster import calibrated_clusterer
from cgemit.reconstruction.cluster_errors import PATH_KNOTS, SLOPE_KNOTS, calibration_of, neutral
from cgemit.reconstruction.clusterers.charge import ChargeTimeClusterer
from cgemit.reconstruction.find import truth
from cgemit.study.readout.calibrate import (
    Measurements,
    _muons,
    known_directions,
    lorentz_slopes,
    measurements,
    set_depths,
    true_directions,
)

DESIGN = cg.load("besiii-cgem-design")
LAYERS = dataclasses.replace(DESIGN, drift_chamber=None)
L1 = DESIGN.cgem[0]
TIGER = cg.TigerReadout()
CLUSTERER = ChargeTimeClusterer(TIGER)
BINS = np.array([-0.93, -0.75, -0.45, -0.15, 0.15, 0.45, 0.75, 0.93])
READOUTS = {"tiger": TIGER, "apv25": cg.Apv25Readout(), "analog-projection": cg.ProjectionReadout()}


@pytest.fixture(scope="module")
def digitized():
    muons = _muons([1.0], 6000, 5, 0.93)  # of both charges, whose means in X have opposite signs in the first pass
    return {name: cg.run(LAYERS, muons, seed=5, readout=one, until="digitize") for name, one in READOUTS.items()}


def sample_of(result, readout, calibration, along):
    """Return the measurements, and the polar angle of each."""
    clusters = calibrated_clusterer(readout).cluster_with(LAYERS, result.digis, calibration)
    if along:
        directions = true_directions(LAYERS, clusters, result.truths)
        clusters = calibrated_clusterer(readout).cluster_with(LAYERS, result.digis, calibration, directions=directions)
    sample = measurements(LAYERS, clusters, result.truths, lorentz=getattr(readout, "lorentz", False))
    z = result.truths["z"][sample.truth]
    return sample, z / np.hypot(z, np.array([layer.r_mid for layer in LAYERS.cgem])[sample.layer])


def misfits(sample, cos_theta):
    """Return what is wrong with the pulls of each view and range of the angle, as text."""
    found = []
    for view in (0, 1):
        for low, high in pairwise(BINS):
            here = (sample.view == view) & (cos_theta > low) & (cos_theta < high)
            pull = measure(sample.residual[here] / sample.error[here])
            if abs(pull.core - 1) > 0.05 + 2 * pull.core_error:
                found.append(f"{'XV'[view]} {low} to {high}: width {pull.core:.3f}")
            if abs(pull.core_mean) > 0.1 + 2 * pull.core_mean_error:
                found.append(f"{'XV'[view]} {low} to {high}: mean {pull.core_mean:.3f}")
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "along"),
    [("tiger", False), ("tiger", True), ("apv25", False), ("apv25", True), ("analog-projection", False)],
)
def test_pulls_at_all_angles(digitized, name, along):
    """Pulls of X and V have unit width and no bias at any angle, without and with the angle of the track."""
    readout = READOUTS[name]
    assert not misfits(*sample_of(digitized[name], readout, calibration_of(LAYERS, readout), along))


@pytest.mark.slow
@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("name", ["tiger", "apv25"])
def test_known_tracks_have_no_bias_of_their_charge(digitized, name, charge):
    """With the track, widths and means hold for each charge alone; without it, X has means of opposite signs."""
    result, readout = digitized[name], READOUTS[name]
    calibration, of_charge = calibration_of(LAYERS, readout), result.particles["charge"] == charge
    sample, cos_theta = sample_of(result, readout, calibration, True)
    mine = of_charge[result.truths["event"][sample.truth]]
    assert not misfits(Measurements._make(values[mine] for values in sample), cos_theta[mine])
    sample, _ = sample_of(result, readout, calibration, False)
    mine = of_charge[result.truths["event"][sample.truth]] & (sample.view == 0)
    pull = measure(sample.residual[mine] / sample.error[mine])
    assert 0.02 < charge * pull.core_mean < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("table", ["direction_depths", "direction_factors"])
def test_pulls_need_the_direction(digitized, table):
    """Without depths V pulls have means, without factors other widths."""
    calibration = calibration_of(LAYERS, TIGER)
    empty = getattr(neutral(len(LAYERS.cgem)), table)
    wrong = misfits(*sample_of(digitized["tiger"], TIGER, dataclasses.replace(calibration, **{table: empty}), False))
    assert sum(("mean" if table.endswith("depths") else "width") in text for text in wrong) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("along", [False, True])
@pytest.mark.parametrize("name", ["tiger", "apv25"])
def test_pulls_of_all_sizes(digitized, name, along):
    """Up to six strips, beyond which X clusters are those of delta electrons, pulls have unit width."""
    readout = READOUTS[name]
    sample, _ = sample_of(digitized[name], readout, calibration_of(LAYERS, readout), along)
    for view in (0, 1):
        for strips in range(1, 7):
            here = (sample.view == view) & (sample.size == strips)
            if np.count_nonzero(here) < 300:
                continue
            pull = measure(sample.residual[here] / sample.error[here])
            assert abs(pull.core - 1) < 0.05 + 2 * pull.core_error, (view, strips)


def strips_of(view, first, times):
    """Return the digis of strips of the first layer with equal charges."""
    n = len(times)
    strip = first + np.arange(n)
    return {
        "layer": np.zeros(n, np.int32), "sheet": np.zeros(n, np.int32), "event": np.zeros(n, np.int64),
        "view": np.full(n, view, np.int8), "strip": strip.astype(np.int32),
        "gid": (strip + view * L1.strips_x).astype(np.int32), "position": np.full(n, np.nan),
        "charge": np.full(n, 10.0), "time": np.asarray(times, np.float64), "truth": np.zeros(n, np.int64),
        "n_truths": np.ones(n, np.int32),
    }  # fmt: skip


def crossing(v_first):
    """Return digis of three X strips and three V strips from this one on."""
    columns = [strips_of(0, 100, [200, 180, 160]), strips_of(1, v_first, [200, 180, 160])]
    return cg.Table("digis", {name: np.concatenate([one[name] for one in columns]) for name in columns[0]}, n_events=1)


def changed(of_track):
    """Return a calibration with known depths and factors."""
    calibration = neutral(3)
    depths, factors = (table[int(of_track)] for table in (calibration.direction_depths, calibration.direction_factors))
    depths[:] = 0.1 * np.concatenate([SLOPE_KNOTS, 1 + PATH_KNOTS])
    factors[:] = np.concatenate([1 + np.arange(len(SLOPE_KNOTS)), 10.0 ** np.arange(len(PATH_KNOTS))])
    return calibration


def expected(slope, path):
    """Return what `changed` does to a position and its error."""
    shift = slope * 0.1 * (np.minimum(np.abs(slope), SLOPE_KNOTS[-1]) + 1 + np.minimum(path, PATH_KNOTS[-1]))
    factor = [np.searchsorted(knots, value, side="right") for knots, value in
              ((SLOPE_KNOTS, np.abs(slope)), (PATH_KNOTS, path))]  # fmt: skip
    return shift, factor[0] * 10.0 ** (factor[1] - 1)


@pytest.mark.parametrize("v_first", [300, 420, 560])
def test_direction_from_the_place(v_first):
    """X and V that cross have the direction of a straight track from the beam line through their place."""
    digis = crossing(v_first)
    before, after = (CLUSTERER.cluster_with(DESIGN, digis, one) for one in (neutral(3), changed(False)))
    assert len(before) == 3  # X, V, and the pair
    rise = before["z"][2] / L1.r_mid
    bend = lorentz_slopes(DESIGN, True)[0]
    for view, name in enumerate("xv"):
        slope = (-np.sin(L1.stereo) * rise if view else 0.0) - bend[view]
        shift, factor = expected(slope, np.hypot(1, rise))
        assert before[name][view] - after[name][view] == pytest.approx(shift, abs=1e-9)
        assert after[f"err_{name}"][view] == pytest.approx(factor)
        assert after[name][2] == after[name][view]  # the pair has the same
    assert abs(rise) > 0.05


def test_direction_of_the_track():
    """With a track, its slope and path count, and not the place; without one, those of the place."""
    digis = crossing(420)
    directions = np.array([[0.9, 1.3], [np.nan, np.nan], [np.nan, np.nan]])
    found = [CLUSTERER.cluster_with(DESIGN, digis, one, directions=directions) for one in (neutral(3), changed(True))]
    shift, factor = expected(0.9 - lorentz_slopes(DESIGN, True)[0, 0], 1.3)
    assert found[0]["x"][0] - found[1]["x"][0] == pytest.approx(shift, abs=1e-9)
    assert found[1]["err_x"][0] == pytest.approx(factor)
    assert found[0]["v"][1] == found[1]["v"][1]
    alone = CLUSTERER.cluster_with(DESIGN, digis, changed(False), directions=directions)
    assert alone["x"][0] == found[0]["x"][0]
    assert alone["v"][1] == CLUSTERER.cluster_with(DESIGN, digis, changed(False))["v"][1]


def test_a_cluster_without_pair_has_no_direction():
    """Of an X cluster alone the place is not known."""
    digis = cg.Table("digis", strips_of(0, 100, [200, 180, 160]), n_events=1)
    before, after = (CLUSTERER.cluster_with(DESIGN, digis, one) for one in (neutral(3), changed(False)))
    assert before["x"][0] == after["x"][0]
    assert before["err_x"][0] == after["err_x"][0]


def test_depths_of_a_sample():
    """The depths that made the residuals are found, in spite of tails."""
    random = np.random.default_rng(1)
    n = 20_000
    slope, path = random.uniform(-1.5, 1.5, n), random.uniform(1, 2.2, n)
    true = 0.3 * np.exp(-3 * SLOPE_KNOTS)
    residual = slope * (np.interp(np.abs(slope), SLOPE_KNOTS, true) + 0.05 * (path - 1)) + random.normal(0, 0.1, n)
    residual[:500] += 3
    zero = np.zeros(n, np.int64)
    sample = Measurements(residual, np.ones(n), slope, zero, np.ones(n), zero, zero, zero, zero)
    found = neutral(1)
    set_depths(found, True, 0, sample, (slope, path))
    depths = found.direction_depths[1, 0, 0, 0]
    for at, height in zip(SLOPE_KNOTS[1:], true[1:], strict=True):
        for way in (1.1, 2.0):
            fitted = depths[: len(SLOPE_KNOTS)], depths[len(SLOPE_KNOTS) :]
            value = np.interp(at, SLOPE_KNOTS, fitted[0]) + np.interp(way, PATH_KNOTS, fitted[1])
            assert at * value == pytest.approx(at * (height + 0.05 * (way - 1)), abs=0.012)


def test_known_directions_are_those_of_muons():
    """Muons of 5 GeV/c are straight: the place gives their slope and path."""
    gun = cg.Gun("mu-", p=5.0, cos_theta=(-0.9, 0.9))
    result = cg.run(LAYERS, gun, 100, 5, readout=TIGER, until="digitize")
    sample, _ = sample_of(result, TIGER, neutral(3), False)
    place, track = (
        known_directions(LAYERS, result.truths, sample, of_track=one, lorentz=True) for one in (False, True)
    )
    for one, other in zip(place, track, strict=True):
        assert np.quantile(np.abs(one - other), 0.9) < 0.02
    assert np.ptp(track[0]) > 2


def test_own_part_of_a_divided_cluster():
    """Of several clusters of a crossing, the own one is at it after the correction for the Lorentz shift."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, -0.8))
    result = cg.run(LAYERS, gun, 300, 5, readout=TIGER, until="cluster")
    clusters, truths = result.clusters, result.truths
    rows = np.flatnonzero((clusters["view"] < 2) & (clusters["truth"] >= 0))
    apart = np.abs(truth.residuals(LAYERS, clusters, truths, rows))
    pitch = np.array([(layer.pitch_x, layer.pitch_v) for layer in LAYERS.cgem])
    outside = apart - 0.5 * clusters["size"][rows] * pitch[clusters["layer"][rows], clusters["view"][rows]]
    least = np.full(2 * len(truths), np.inf)
    place = 2 * clusters["truth"][rows] + clusters["view"][rows]
    np.minimum.at(least, place, np.maximum(outside, 0))
    own = np.isin(rows, truth.own_clusters(LAYERS, clusters, truths))
    assert np.count_nonzero(~own) > 100
    np.testing.assert_allclose(np.maximum(outside, 0)[own], least[place[own]], atol=1e-5)
