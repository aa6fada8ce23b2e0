"""Clusters of charge and time: two maxima, pairs of X and V, and the direction of their track."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.widths import measure
from cgemit.detector.gas import drift_columns
from cgemit.reconstruction.cluster import calibrated_clusterer
from cgemit.reconstruction.cluster_errors import (
    CHARGES,
    DISTANCES,
    PATH_KNOTS,
    SIZES,
    SLOPE_KNOTS,
    calibration_of,
    neutral,
)
from cgemit.reconstruction.clusterers.charge import ChargeTimeClusterer
from cgemit.reconstruction.find import truth
from cgemit.reconstruction.find.ckf import find_tracks
from cgemit.reconstruction.refine import track_directions
from cgemit.study.readout.calibrate import (
    Measurements,
    _muons,
    crossing_paths,
    crossing_slopes,
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


def digis_of(strips, charge, time=150.0, view=0):
    """Return digis of strips of the first layer."""
    n = len(strips)
    gid = np.asarray(strips) + view * L1.strips_x
    return cg.Table(
        "digis",
        {
            **{name: np.zeros(n, np.int32) for name in ("layer", "sheet")}, "event": np.zeros(n, np.int64),
            "view": np.full(n, view, np.int8), "strip": np.asarray(strips, np.int32), "gid": gid.astype(np.int32),
            "position": np.full(n, np.nan), "charge": np.asarray(charge, np.float64), "time": np.full(n, time),
            "truth": np.zeros(n, np.int64), "n_truths": np.ones(n, np.int32),
        },
        n_events=1,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("charges", "expected"),
    [
        ([10, 20, 10, 2, 12, 18, 5], [(0, 3, 41.0), (3, 6, 36.0)]),
        ([10, 20, 10, 4, 12, 18, 5], [(0, 6, 79.0)]),  # 4 is more than a fifth of 18
        ([20, 1, 3, 1, 20], [(0, 1, 20.5), (1, 4, 24.5)]),  # of equal strips, the first
        ([20, 2, 30, 3, 20], [(0, 1, 21.0), (1, 3, 32.5), (3, 4, 21.5)]),
        ([1, 2, 3, 20, 3, 2, 1], [(0, 6, 32.0)]),
        ([9], [(0, 0, 9.0)]),
    ],
)
def test_valleys(charges, expected):
    """A strip below a share of both maxima divides a cluster and gives half of its charge to each part."""
    readout = dataclasses.replace(TIGER, valley=0.2)
    found = calibrated_clusterer(readout).cluster_with(DESIGN, digis_of(np.arange(len(charges)), charges))
    assert list(zip(found["first"], found["last"], found["charge"], strict=True)) == expected
    whole = calibrated_clusterer(dataclasses.replace(TIGER, valley=0.0)).cluster_with(
        DESIGN, digis_of(np.arange(len(charges)), charges)
    )
    assert whole["charge"].tolist() == [sum(charges)]


def test_score_of_pairs():
    """The score is the logarithm of the ratio of two densities; a tenth of the pairs is as those of two particles."""
    calibration = calibration_of(DESIGN, TIGER)
    mean, width, mean_time, width_time, apart, apart_time = calibration.pairs[0]
    x, v = digis_of([100], [20.0], 160.0), digis_of([300, 900], [16.0, 2.5], 171.0, view=1)
    both = cg.Table("digis", {name: np.concatenate([x[name], v[name]]) for name in x}, n_events=1)
    found = CLUSTERER.cluster_with(DESIGN, both, calibration)
    pairs = np.flatnonzero(found["view"] == 2)
    assert len(pairs) > 0
    assert np.isnan(found["score"][found["view"] < 2]).all()

    def density(value, sigma):
        return np.exp(-0.5 * (value / sigma) ** 2) / np.sqrt(2 * np.pi) / sigma

    for row in pairs:
        one, other = found["x_cluster"][row], found["v_cluster"][row]
        ratio = np.log(found["charge"][one] / found["charge"][other])
        late = found["time"][one] - found["time"][other]
        of_two = density(ratio, apart) * density(late, apart_time)
        of_one = 0.9 * density(ratio - mean, width) * density(late - mean_time, width_time) + 0.1 * of_two
        assert found["score"][row] == pytest.approx(np.log(of_one / of_two), abs=1e-9)


def test_score_of_pairs_that_differ_in_everything():
    """No charge and no time makes the score worse than that of a touched cluster, ln 0.1, or less than finite."""
    x, v = digis_of([100], [1e5], 0.0), digis_of([300, 900], [0.0, 1e-9], 1e6, view=1)
    both = cg.Table("digis", {name: np.concatenate([x[name], v[name]]) for name in x}, n_events=1)
    found = CLUSTERER.cluster_with(DESIGN, both, calibration_of(DESIGN, TIGER))
    assert found["score"][found["view"] == 2] == pytest.approx(np.log(0.1), abs=1e-9)


def test_time_of_a_cluster():
    """The time is the mean of the strips', weighted with charge, without the chip's delay for each charge."""
    charge, delay = CLUSTERER.delays(drift_columns(DESIGN)["induction"])
    found = CLUSTERER.cluster_with(DESIGN, digis_of([10, 11], [4.0, 12.0], 180.0))
    walk = np.interp([4.0, 12.0], charge[0], delay[0])
    assert found["time"][0] == pytest.approx(180 - (4 * walk[0] + 12 * walk[1]) / 16, abs=1e-9)


def test_scores_separate_ghosts():
    """Of pairs that geometry allows, those of one particle have the larger scores."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6))
    result = cg.run(DESIGN, gun + gun, 250, 3, readout=TIGER, until="cluster")
    clusters = result.clusters
    pairs = clusters["view"] == 2
    true = pairs & (clusters["truth"] >= 0)
    score = clusters["score"]
    assert np.isfinite(score[pairs]).all()
    ghosts = np.sort(score[pairs & ~true])
    assert len(ghosts) > 600
    assert np.mean(np.searchsorted(ghosts, score[true])) > 0.8 * len(ghosts)
    # Pairs that differ in charge or time are as rare as their scores say.
    low = score < -2
    assert np.count_nonzero(low & true) > 50
    share = np.mean(low[true]) / np.mean(low[pairs & ~true])
    assert np.log(share) == pytest.approx(score[low & true].mean(), abs=0.5)
    binary = cg.run(DESIGN, gun, 5, 3, until="cluster").clusters
    assert set(binary["score"][binary["view"] == 2]) == {0.0}


def test_finder_takes_the_pair_that_fits():
    """Of two V clusters at one place, the finder takes that whose score is better; without scores it cannot know."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))
    result = cg.run(DESIGN, gun, 40, 3, readout=TIGER, until="cluster")
    clusters = result.clusters
    twin = {name: np.repeat(clusters[name], 2) for name in clusters}
    second = np.tile([False, True], len(clusters))
    keep = ~second | (twin["view"] == 1) | (twin["view"] == 2)
    number = np.cumsum(keep) - 1
    new_row = {which: number[np.arange(len(clusters)) * 2 + which] for which in (0, 1)}
    columns = {name: column[keep] for name, column in twin.items()}
    of_second, is_pair = second[keep], columns["view"] == 2
    x, v = columns["x_cluster"][is_pair], columns["v_cluster"][is_pair]
    columns["x_cluster"][is_pair] = new_row[0][x]
    columns["v_cluster"][is_pair] = np.where(of_second[is_pair], new_row[1][v], new_row[0][v])
    # Both copies of a V cluster are measured alike, but not as one; the second is the better partner of each X.
    columns["v"] = columns["v"] + 1e-6 * of_second  # mm
    columns["score"][is_pair] = np.where(of_second[is_pair], 3.0, -3.0)
    twins = cg.Table("clusters", columns, **clusters.cover)

    def share_of_second(table):
        hits = find_tracks(DESIGN, table, result.wire_hits)["candidate_hits"]
        rows = hits["row"][hits["view"] == 1]
        assert len(rows) > 60
        return np.mean(of_second[rows])

    assert share_of_second(twins) > 0.95
    assert share_of_second(twins.with_columns(score=-columns["score"])) < 0.05


def test_a_touched_cluster_starts_a_track_all_the_same():
    """Charge of something else on the V strips of one layer costs the track neither its seed nor that cluster."""
    result = cg.run(LAYERS, cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), 30, 3, readout=TIGER, until="cluster")
    plain = find_tracks(LAYERS, result.clusters, result.wire_hits)["candidates"]
    touched = (result.digis["layer"] == 0) & (result.digis["view"] == 1)
    digis = result.digis.with_columns(
        charge=result.digis["charge"] * np.where(touched, 4.0, 1.0),
        time=result.digis["time"] - np.where(touched, 60.0, 0.0),
    )
    clusters = CLUSTERER.cluster_with(LAYERS, digis, calibration_of(LAYERS, TIGER))
    assert np.median(clusters["score"][(clusters["view"] == 2) & (clusters["layer"] == 0)]) < -2
    found = find_tracks(LAYERS, clusters, result.wire_hits)
    assert len(plain) >= 27
    assert len(found["candidates"]) >= len(plain) - 2
    assert np.mean(np.bincount(found["candidate_hits"]["candidate"]) == 6) > 0.85


def test_pairs_that_do_not_fit_make_no_track():
    """Without a chamber, tracks need pairs; implausible ones give none."""
    result = cg.run(LAYERS, cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), 30, 3, readout=TIGER, until="cluster")
    plain = find_tracks(LAYERS, result.clusters, result.wire_hits)["candidates"]
    spoilt = result.clusters.with_columns(score=np.full(len(result.clusters), -20.0))
    assert len(plain) > 25
    assert len(find_tracks(LAYERS, spoilt, result.wire_hits)["candidates"]) == 0


def circle_states(bz: float, kappa: float, dr: float, tanl: float) -> tuple[cg.Table, np.ndarray]:
    """Return X states where a circle crosses the middle of L1's gap, and dX/dr and path per radius from its points."""
    radius = 3335.6409519815204 / (bz * kappa)
    angle = np.linspace(0, 0.4, 400_001)  # about the centre, from the closest point, in the sense of flight
    flown = -np.sign(radius) * angle
    x, y = (dr + radius) - radius * np.cos(flown), -radius * np.sin(flown)
    r, azimuth, arc = np.hypot(x, y), np.unwrap(np.arctan2(y, x)), np.abs(radius) * angle
    edges = [L1.r_gap_in, L1.r_gap_out]
    turn, path = (np.diff(np.interp(edges, r, values))[0] for values in (azimuth, arc))
    here = np.searchsorted(r, L1.r_mid)
    states = cg.Table.empty("states", n_events=1)
    columns = {name: np.zeros((1, *states[name].shape[1:]), states[name].dtype) for name in states}
    pt = 1 / abs(kappa)
    step = np.array([x[here + 1] - x[here], y[here + 1] - y[here]])
    px, py = pt * step / np.hypot(*step)
    values = {"x": x[here], "y": y[here], "px": px, "py": py, "pz": pt * tanl, "tanl": tanl}
    columns |= {name: np.array([value]) for name, value in values.items()}
    slope = np.array([L1.r_readout * turn, path * np.hypot(1, tanl)]) / L1.drift_gap
    return cg.Table("states", columns, n_events=1), slope


@pytest.mark.parametrize(
    ("bz", "kappa", "dr", "within"),
    [
        (-1.0, 1.3, 0.0, 1e-3), (-1.0, -2.0, 5.0, 1e-3), (1.0, 0.7, -3.0, 1e-3), (0.5, -4.0, 2.0, 1e-3),
        (-1.0, 6.0, 60.0, 4e-3),
    ],
)  # fmt: skip
def test_direction_at_mid_gap_is_that_of_the_gap(bz: float, kappa: float, dr: float, within: float) -> None:
    """Both charges and fields, and a displaced track at 55 degrees, against points of the circle."""
    states, expected = circle_states(bz, kappa, dr, 0.7)
    found = track_directions(DESIGN, 1, states)[0]
    np.testing.assert_allclose(found, expected, rtol=within, atol=1e-4)


def test_tracks_that_may_not_cross_the_gap_have_no_direction() -> None:
    states, _ = circle_states(-1.0, 1.3, 0.0, 0.7)
    turned = states.with_columns(px=states["py"], py=-states["px"])
    failed = states.with_columns(status=np.ones(1, np.int8))
    for one in (turned, failed):
        assert np.isnan(track_directions(DESIGN, 1, one)).all()


def test_directions_of_tracks():
    """Slopes and paths of fitted tracks are those of the crossings, in a field map, too."""
    gun = cg.Gun("mu-", p=2.0, cos_theta=(-0.8, 0.8))
    settings = cg.Settings(simulate=cg.SimulateSettings(deltas=False), fit=cg.FitSettings(states=("origin", "hits")))
    for detector in (DESIGN, DESIGN.with_field("besiii")):
        result = cg.run(detector, gun, 200, 3, settings=settings)
        slopes, paths = track_directions(DESIGN, len(result.clusters), result.states).T
        own = truth.own_clusters(DESIGN, result.clusters, result.truths)
        own = own[np.isfinite(slopes[own])]
        true = crossing_slopes(DESIGN, result.truths)[result.clusters["truth"][own], result.clusters["view"][own]]
        assert len(own) > 1000
        apart = slopes[own] - true
        assert np.median(np.abs(apart)) < 0.01
        assert np.std(true[result.clusters["view"][own] == 1]) > 0.3  # it is not only near 0
        path = crossing_paths(result.truths)[result.clusters["truth"][own]]
        assert np.median(np.abs(paths[own] - path)) < 0.01
        assert path.max() > 1.5


def test_positions_along_a_track():
    """Strips of a line through the gap, with exact times, give its position at any angle, from few strips too."""
    calibration = neutral(3)
    timing = {name: np.array([column[0]] * 3) for name, column in drift_columns(DESIGN).items()}
    charge, delay = CLUSTERER.delays(drift_columns(DESIGN)["induction"])
    readout = dataclasses.replace(TIGER, estimator="micro-tpc", lorentz=False)
    flight = L1.r_mid / 299.792458
    for slope in (-0.8, 0.0, 0.4, 1.2):
        for strips in ([100], [100, 101], [100, 101, 102, 103]):
            strips = np.array(strips)
            centre = (strips.mean() + 0.5) * L1.pitch_x + 0.05
            position = (strips + 0.5) * L1.pitch_x
            height = (position - centre) / slope if slope else np.zeros(len(strips))
            if np.abs(height).max() > 2.5:
                continue
            time = flight + timing["delay"][0] + (0.5 * L1.drift_gap - height) / timing["velocity"][0]
            digis = digis_of(strips, np.full(len(strips), 10.0)).with_columns(
                time=time + np.interp(10.0, charge[0], delay[0])
            )
            found = calibrated_clusterer(readout).cluster_with(
                DESIGN, digis, calibration, directions=np.array([[slope, 1.0]])
            )
            expected = centre if slope else position.mean()
            assert found["x"][0] == pytest.approx(expected, abs=1e-9)


def test_second_pass_improves_positions():
    """With the angle of the track, X and V are measured better and errors fit; rows stay the same."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
    runs = [
        cg.run(DESIGN, gun, 500, 7, readout=dataclasses.replace(TIGER, second_pass=second)) for second in (False, True)
    ]
    assert runs[0].clusters == runs[1].clusters
    first, second = runs[0].clusters, runs[1].fitted_hits[0]
    for name in ("event", "first", "last", "charge", "x_cluster", "v_cluster"):
        assert np.array_equal(first[name], second[name])
    own = truth.own_clusters(DESIGN, first, runs[0].truths)
    spread = []
    for clusters in (first, second):
        residual = np.abs(truth.residuals(DESIGN, clusters, runs[0].truths, own))
        spread.append([np.quantile(residual[clusters["view"][own] == view], 0.6) for view in (0, 1)])
    assert spread[1][0] < 0.92 * spread[0][0]
    assert spread[1][1] < 0.92 * spread[0][1]
    pull = residual / np.where(second["view"] == 0, second["err_x"], second["err_v"])[own]
    assert 0.9 < np.quantile(pull, 0.683) < 1.25
    widths = [np.quantile(np.abs(one.tracks["res_dr"]), 0.683) for one in runs]
    assert widths[1] < 0.98 * widths[0]


@pytest.mark.parametrize("along", [False, True])
def test_errors_follow_the_distance_of_centroid_and_line(along):
    """The factor is that of the range of the distance; along a track there is another one for charge and size."""
    digis = cg.run(DESIGN, cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), 30, 5, readout=TIGER, until="digitize").digis
    calibration = neutral(3)
    calibration.shares[:], calibration.slope_shares[:], calibration.edges[:] = 0.5, 0.5, 30 * np.arange(1, CHARGES)
    edges = 0.05 * np.arange(1, DISTANCES - 1)
    calibration.distance_edges[int(along)] = edges
    calibration.distance_factors[int(along)] = np.arange(1, DISTANCES + 1)
    calibration.charge_factors[:] = np.arange(1, CHARGES + 1)[:, None] * (1 + 0.1 * np.arange(SIZES))
    place, clusters = {}, None
    for estimator in ("centroid", "micro-tpc", "merged"):
        readout = dataclasses.replace(TIGER, estimator=estimator)
        directions = np.tile([0.1, 1.0], (10_000, 1)) if along else None
        clusters = calibrated_clusterer(readout).cluster_with(DESIGN, digis, calibration, directions=directions)
        strips = clusters["view"] < 2
        place[estimator] = np.where(clusters["view"] == 0, clusters["x"], clusters["v"])[strips]
    distance = np.abs(place["centroid"] - place["micro-tpc"])
    expected = np.where(distance > 0, 2 + np.searchsorted(edges, distance, side="right"), 1)
    if along:
        charge = np.searchsorted(calibration.edges[0, 0], clusters["charge"][strips], side="right")
        expected = expected * (1 + charge) * (1 + 0.1 * (np.minimum(clusters["size"][strips], SIZES) - 1))
    error = np.where(clusters["view"] == 0, clusters["err_x"], clusters["err_v"])[strips]
    assert len(np.unique(expected if not along else np.searchsorted(edges, distance))) == DISTANCES - along
    np.testing.assert_allclose(error, expected)


def test_slopes_must_fit():
    """The core refuses fewer slopes than clusters."""
    with pytest.raises(ValueError, match="one for each cluster"):
        CLUSTERER.cluster_with(DESIGN, digis_of([1, 5], [5.0, 5.0]), directions=np.zeros((1, 2)))


def test_strips_out_of_time_are_left_out():
    """Strips count whose drift times lie within those of the gap, or at most the margin beside them."""
    columns = drift_columns(LAYERS)
    charge, delay = CLUSTERER.delays(columns["induction"])
    longest = L1.drift_gap / columns["velocity"][0]
    arrival = columns["delay"][0] + L1.r_mid / 299.792458 + np.interp(10.0, charge[0], delay[0])
    drift = np.array([-51.0, -49.0, 20.0, longest + 51.0, longest + 49.0, 400.0])
    digis = digis_of(np.arange(10, 16), np.full(6, 10.0), arrival + drift)
    found = CLUSTERER.cluster_with(LAYERS, digis)
    assert list(zip(found["first"], found["last"], found["charge"], strict=True)) == [(11, 14, 30.0)]
    every = calibrated_clusterer(dataclasses.replace(TIGER, time_margin=1000.0)).cluster_with(LAYERS, digis)
    assert list(zip(every["first"], every["last"], every["charge"], strict=True)) == [(10, 15, 60.0)]


def test_strips_of_particles_are_in_time():
    """Hardly any strip of a particle is out of time, and its cluster is the same with such strips."""
    result = cg.run(LAYERS, cg.Gun("pi-", p=0.2, cos_theta=(-0.9, 0.9)), 60, 3, readout=TIGER, until="cluster")
    wide = dataclasses.replace(TIGER, time_margin=1e6)
    every = calibrated_clusterer(wide).cluster_with(LAYERS, result.digis, calibration_of(LAYERS, wide))
    assert len(every) > 500
    assert every["charge"].sum() == pytest.approx(result.clusters["charge"].sum(), rel=1e-3)


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
