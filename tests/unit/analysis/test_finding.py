"""Metrics of track finding on candidates whose hits are moved by hand, half turns included."""

from dataclasses import replace

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.finding import ParticleCounts, findable_of
from cgemit.analysis.widths import Fraction
from cgemit.reconstruction.candidates import label_candidates
from cgemit.reconstruction.fit import fit
from cgemit.tables.schema import HIT_WIRE
from cgemit.truth.match import match
from stats import assert_within


@pytest.fixture(scope="module")
def run():
    gun = cg.Gun("mu-", p=0.5, cos_theta=(-0.5, 0.5))
    settings = cg.Settings(simulate=cg.SimulateSettings(decays=False))
    return cg.run("besiii-cgem", gun, n=4, settings=settings, until="find")


def changed(run, candidate, kept=None):
    """The run with hits in other candidates, and some left out."""
    hits = run.candidate_hits.with_columns(candidate=candidate)
    hits = hits if kept is None else hits[kept]
    return replace(run, tables=run.tables | {"candidate_hits": hits})


def in_one_event(run):
    """The same particles and hits, as if all were of one event: the particle's number tells them apart."""
    tables = dict(run.tables)
    for name in ("particles", "truths", "wire_truths"):
        tables[name] = tables[name].with_columns(particle=tables[name]["event"].astype("i4"))
    for name in tables:
        columns = dict(tables[name].columns)
        columns["event"] = np.zeros(len(tables[name]), "i8")
        tables[name] = cg.Table(name, columns, first_event=0, n_events=1)
    return replace(run, tables=tables)


def classes(finding, definition="belle2"):
    return [cg.MatchStatus(i).name for i in finding.classes[definition]]


def test_the_perfect_finder_scores_all_and_nothing_else(run):
    finding = cg.study.finding(run)
    assert classes(finding) == ["matched"] * 4
    rates = finding.rates()
    assert (rates.efficiency.value, rates.fakes.value, rates.clones.value) == (1, 0, 0)
    assert (finding.purity, finding.hit_efficiency) == (1, 1)


def test_lost_hits_lower_the_hit_efficiency_only(run):
    kept = np.ones(len(run.candidate_hits), np.bool_)
    mine = np.flatnonzero(run.candidate_hits["candidate"] == 0)
    kept[mine[::2]] = False
    finding = cg.study.finding(changed(run, run.candidate_hits["candidate"], kept))
    left = len(mine) - len(mine[::2])
    assert finding.purity == 1
    assert finding.hit_efficiency == pytest.approx((3 + left / len(mine)) / 4, abs=1e-12)
    assert finding.rates().efficiency.value == 1


def test_a_track_of_which_a_third_is_foreign_is_matched_and_of_which_more_is_a_fake(run):
    one = in_one_event(run)
    candidate = one.candidate_hits["candidate"]
    own, other = np.flatnonzero(candidate == 0), np.flatnonzero(candidate == 1)
    kept = np.ones(len(candidate), np.bool_)
    kept[own[len(own) // 2 * 2 :]] = False  # an even number: exactly two thirds can be its own
    for moved, expected in ((len(own) // 2, "matched"), (len(own) // 2 + 1, "fake")):
        labels = candidate.copy()
        labels[other[-moved:]] = 0
        finding = cg.study.finding(changed(one, labels, kept))
        assert classes(finding)[0] == expected
        assert classes(finding, "acts")[0] == "matched"
        if expected == "fake":
            assert finding.rates().efficiency == Fraction(3, 4)
            assert finding.rates().fakes == Fraction(1, 4)
            assert finding.rates().clones == Fraction(0, 3)  # of the candidates that belong to a particle


def test_measurements_of_particles_by_hand(run):
    """Of every particle: layers and cells of either tilt, one event for each."""
    counts, clusters, wires = cg.study.finding(run).particles, run.clusters, run.wire_hits
    twist = {layer.number: layer.twist for layer in run.detector.drift_chamber.layers}
    tilts = np.array([twist[number] for number in wires["layer"]])
    assert min(tilts) < 0 < max(tilts)
    for event in range(4):
        mine, cells = clusters["event"] == event, wires["event"] == event
        assert counts.wires[event] == cells.sum()
        assert counts.stereo[event] == np.count_nonzero(tilts[cells])
        for view, layers in ((0, counts.x_layers), (1, counts.v_layers)):
            assert layers[event] == len(np.unique(clusters["layer"][mine & (clusters["view"] == view)]))


def test_of_two_halves_of_a_track_the_longer_is_matched_and_the_shorter_a_clone(run):
    one = in_one_event(run)
    candidate = one.candidate_hits["candidate"].copy()
    kept = candidate != 1  # the second candidate gets hits of the first particle
    mine = np.flatnonzero(candidate == 0)
    candidate[mine[-(len(mine) // 3) :]] = 1
    finding = cg.study.finding(changed(one, candidate, kept | (candidate == 1) & (np.arange(len(kept)) <= mine[-1])))
    assert classes(finding) == ["matched", "clone", "matched", "matched"]
    assert finding.rates().clones == Fraction(1, 4)
    assert finding.rates().efficiency == Fraction(3, 4)


def test_a_track_with_less_than_a_twentieth_of_a_particle_is_a_fake_for_belle_ii(run):
    one = in_one_event(run)
    candidate = one.candidate_hits["candidate"]
    mine = np.flatnonzero(candidate == 0)
    kept = candidate != 0
    kept[mine[:2]] = True
    assert len(mine) > 40
    finding = cg.study.finding(changed(one, candidate, kept))
    assert classes(finding)[0] == "fake"
    assert classes(finding, "acts")[0] == "matched"


def test_a_piece_of_a_decay_is_no_fake(run):
    """Of a particle that left its clusters, the hits of a daughter alone: none of the particle's measurements."""
    of_first = run.wire_truths["event"] == 0
    daughters = run.wire_truths.with_columns(daughter=of_first.astype("i4"))
    decayed = replace(run, tables=run.tables | {"wire_truths": daughters})
    hits = run.candidate_hits
    kept = (hits["candidate"] != 0) | (hits["view"] == HIT_WIRE)
    finding = cg.study.finding(changed(decayed, hits["candidate"], kept))
    assert (finding.candidates.found[0], finding.candidates.left[0]) == (0, 6)
    assert classes(finding) == ["decay_daughter"] + ["matched"] * 3
    rates = finding.rates()
    assert (rates.decays, rates.fakes, rates.clones) == (Fraction(1, 4), Fraction(0, 4), Fraction(0, 3))
    assert rates.efficiency == Fraction(3, 4)
    # With a twentieth of the particle's own, it is the particle's track, or a further one.
    assert classes(cg.study.finding(decayed)) == ["matched"] * 4


@pytest.mark.parametrize(("share", "short"), [(0.45, 1), (0.55, 0)])
def test_tracks_with_less_than_half_of_their_particle_are_cut_short(run, share, short):
    kept = np.ones(len(run.candidate_hits), np.bool_)
    mine = np.flatnonzero(run.candidate_hits["candidate"] == 2)
    kept[mine[int(share * len(mine)) :]] = False
    rates = cg.study.finding(changed(run, run.candidate_hits["candidate"], kept)).rates()
    assert (rates.short, rates.efficiency) == (Fraction(short, 4), Fraction(4, 4))


@pytest.mark.parametrize(
    ("columns", "wrong", "fitted"),
    [
        ({}, 0, 4),
        ({"pull_dz": -8.5}, 1, 4),
        ({"pull_tanl": 8.5}, 1, 4),
        ({"pull_dz": 7.5}, 0, 4),
        ({"pull_dr": 9.0}, 0, 4),
    ],
)
def test_tracks_wrong_in_z_are_those_beyond_eight_errors(columns, wrong, fitted):
    gun = cg.Gun("mu-", p=0.5, cos_theta=(-0.5, 0.5))
    result = cg.run("besiii-cgem", gun, n=4, settings=cg.Settings(simulate=cg.SimulateSettings(decays=False)))

    def rates(**tables):
        return cg.study.finding(replace(result, tables=result.tables | tables)).rates()

    one = {name: np.where(np.arange(4) == 1, value, result.matches[name]) for name, value in columns.items()}
    moved = result.matches.with_columns(**one)
    assert rates(matches=moved).wrong_z == Fraction(wrong, fitted)
    lost = result.fitted.with_columns(status=np.array([0, 1, 0, 0], np.int8))
    assert rates(matches=moved, tracks=lost).wrong_z == Fraction(0, 3)


def test_no_track_is_wrong_in_z_before_the_fit(run):
    assert cg.study.finding(run).rates().wrong_z == Fraction(0, 0)


ALL_STEREO = {
    "name": "stereo", "field": {"bz": "1 T"},
    "drift_chamber": {
        "gas": "HePropane", "half_length": "1000 mm", "sigma": "150 um", "wires": "none",
        "superlayers": {
            name: {"layers": 6, "r_in": f"{r} mm", "cells": "12 mm", "stereo": angle}
            for name, r, angle in (("U", 250, "60 mrad"), ("U2", 400, "40 mrad"))
        },
    },
    "materials": {
        "HePropane": {"density": "0.84e-3 g/cm3", "composition": {"He": 0.12, "C": 0.72, "H": 0.16}, "gas": True}
    },
}  # fmt: skip


def test_findable_particles_in_layers_without_seeds_are_counted():
    muon = cg.Gun("mu-", p=1.0, cos_theta=(-0.3, 0.3))
    with pytest.warns(UserWarning, match="stereo: finder ckf: no track can begin: circles need 6 layers"):
        nowhere = cg.run(ALL_STEREO, muon, n=5, finder="ckf")
    found = cg.study.finding(nowhere)
    assert found.findable.sum() == found.seedless.sum() == 5
    assert found.rates().efficiency == Fraction(0, 5)
    assert ("findable, in layers that make no seed", "5") in found.rows()
    assert "seeds     no track can begin: circles need 6 layers with axial wires or X (got 0)" in repr(nowhere)
    assert "no track can begin" not in repr(cg.run(ALL_STEREO, muon, n=1))  # the perfect finder needs none


def test_particles_from_behind_the_cgem_have_no_seeds_where_wires_make_none():
    """Wires of one stereo sign make none; those of both do, as axial ones."""
    inside = cg.Gun("mu-", p=1.0, cos_theta=(-0.3, 0.3))
    outside = cg.Gun("mu-", p=1.0, theta=np.pi / 2, phi=0.1, vertex=("240 mm", 0, 0))
    chamber = {"superlayers": {"U": {"layers": 24, "r_in": "290 mm", "cells": "15 mm", "stereo": "60 mrad"}}}
    one_sign = {"base": "kloe2-like", "drift_chamber": chamber | {"half_length": "1 m"}}
    result = cg.run(one_sign, inside + outside, n=5, seed=3, finder="ckf", until="find")
    found = cg.study.finding(result)
    assert found.findable.all()
    assert found.seedless.reshape(5, 2).sum(axis=0).tolist() == [0, 5]
    assert not found.found()[found.seedless].any()
    assert "seeds     no track begins in wires alone: it needs X and V in two of L1, L2, L3, L4, since" in repr(result)
    for name in ("besiii-cgem", "kloe2-like"):
        own = cg.study.finding(cg.run(name, outside, n=5, seed=3, finder="ckf", until="find"))
        assert not own.seedless.any()
        assert own.found().all()


def test_noise_counts_in_the_purity_and_belongs_to_no_particle(run):
    hits = run.wire_hits
    noisy = replace(run, tables=run.tables | {"wire_hits": hits.with_columns(wire_truth=np.full(len(hits), -1))})
    finding = cg.study.finding(noisy)
    assert classes(finding) == ["fake"] * 4  # 6 clusters among more than 40 hits
    assert finding.findable.all()  # 3 layers of the CGEM are enough
    assert finding.particles.wires.tolist() == [0] * 4


def test_particles_without_enough_hits_are_not_findable_and_the_reason_is_counted(run):
    few = run.wire_truths["event"].copy()
    clusters = run.clusters.with_columns(truth=np.where(run.clusters["layer"] > 0, -1, run.clusters["truth"]))
    kept = np.isin(np.arange(len(run.wire_hits)), np.flatnonzero(few != 2))
    wires = run.wire_hits.with_columns(wire_truth=np.where(kept, run.wire_hits["wire_truth"], -1))
    finding = cg.study.finding(replace(run, tables=run.tables | {"clusters": clusters, "wire_hits": wires}))
    assert finding.findable.tolist() == [True, True, False, True]  # a chamber alone is enough, one CGEM layer is not
    assert finding.removed == {
        "no hit at all": 0,
        "3 stereo wires among 10 or more": 0,
        "3 wires, or 6 coordinates, beside X and V in 2 layers": 0,
        "10 wires, or X and V in 2 layers": 1,
    }


@pytest.mark.parametrize(
    ("x", "v", "crossed", "wires", "expected"),
    [
        (3, 3, 0, 0, True),
        (3, 3, 1, 0, True),
        (4, 2, 0, 0, True),
        (3, 2, 0, 0, False),  # five coordinates
        (5, 1, 0, 0, False),  # one along the beam
        (2, 4, 0, 0, False),  # two across it
        (2, 4, 1, 0, True),
        (2, 3, 1, 0, False),
        (0, 6, 3, 0, True),  # strips at two stereo angles
        (0, 6, 0, 0, False),  # at one
        (0, 6, 2, 0, False),
        (2, 2, 0, 3, True),
        (2, 2, 1, 3, True),
        (2, 2, 0, 2, False),
        (2, 1, 0, 9, False),
        (1, 3, 1, 3, True),
        (0, 0, 0, 10, True),
    ],
)
def test_coordinates_that_make_a_particle_findable(x, v, crossed, wires, expected):
    columns = {"x_layers": x, "v_layers": v, "crossed": crossed, "wires": wires, "stereo": wires // 3}
    of = ParticleCounts(
        **{name: np.array([n]) for name, n in columns.items()}, hits=np.array([x + v + wires]), layers=None
    )
    findable, removed = findable_of(of, np.array([True]))
    assert findable.tolist() == [expected]
    assert sum(removed.values()) == (not expected)
    assert not findable_of(of, np.array([False]))[0].any()


SILICON = {"material": "Si", "thickness": "0.1 mm", "length": "2 m"}


@pytest.mark.parametrize(
    ("sensors", "counts", "findable"),
    [
        (({"sigma_x": "20 um"}, {"sigma_v": "20 um"}), (3, 3, 0), True),
        (({"sigma_x": "20 um"}, {"sigma_v": "20 um", "stereo": "5 deg"}), (3, 3, 0), True),
        (({"sigma_v": "20 um", "stereo": "5 deg"}, {"sigma_v": "20 um", "stereo": "-5 deg"}), (0, 6, 3), True),
        (({"sigma_v": "20 um", "stereo": "5 deg"},), (0, 6, 0), False),
        (({"sigma_x": "20 um"},), (6, 0, 0), False),
        (({"sigma_v": "20 um", "stereo": "5 deg"}, {"sigma_v": "20 um"}), (0, 6, 0), False),
    ],
)
def test_layers_of_one_coordinate_count_for_what_they_measure(sensors, counts, findable):
    layers = {f"S{i}": SILICON | sensors[i % len(sensors)] | {"radius": f"{100 + 50 * i} mm"} for i in range(6)}
    detector = cg.load({"name": "strips", "field": {"bz": "1 T"}, "layer": layers})
    found = cg.study.finding(cg.run(detector, cg.Gun("mu-", p=1.0, cos_theta=0.2), n=3, seed=1, until="find"))
    of = found.particles
    assert (of.x_layers.tolist(), of.v_layers.tolist(), of.crossed.tolist()) == tuple([n] * 3 for n in counts)
    assert found.findable.tolist() == [findable] * 3
    assert found.rates().efficiency.n == 3 * findable


def test_a_run_without_candidates_is_told_apart(run):
    with pytest.raises(ValueError, match="finding: got a result without candidates"):
        cg.study.finding(replace(run, tables={k: t for k, t in run.tables.items() if "candidate" not in k}))


def test_wilson_intervals():
    # Brown, Cai, DasGupta, Stat. Sci. 16 (2001) 101: centre (k + z^2/2)/(n + z^2).
    low, high = Fraction(8, 10).interval(z=1.959964)
    assert (low, high) == pytest.approx((0.4901624, 0.9433178), abs=1e-6)
    assert Fraction(0, 10).interval()[0] == 0
    assert Fraction(10, 10).interval()[1] == 1
    assert 0 < Fraction(0, 10).interval()[1] < 0.1


def test_the_efficiency_against_what_the_event_holds():
    """Number of findable particles, share of hit cells and place of the vertex are those of the tables."""
    gun = cg.Gun("mu-", p=0.5, cos_theta=(-0.99, 0.99))
    result = cg.run("besiii-cgem", gun + gun + gun, n=40, seed=2, finder="ckf", until="find")
    finding = cg.study.finding(result)
    event = result.particles["event"]
    tracks = np.array([np.count_nonzero(finding.findable & (event == one)) for one in event])
    np.testing.assert_array_equal(finding.tracks, tracks)
    assert len(np.unique(tracks)) > 1
    cells = sum(layer.cells for layer in result.detector.drift_chamber.layers)
    hits = np.array([np.count_nonzero(result.wire_hits["event"] == one) for one in event])
    np.testing.assert_allclose(finding.occupancy, 100 * hits / cells, rtol=1e-14)
    bins = finding.against("tracks", [0.5, 2.5, 3.5])
    assert bins[1].n == np.count_nonzero(finding.findable & (tracks == 3))


def test_occupancy_without_a_chamber_is_that_of_the_strips():
    design = cg.load("besiii-cgem-design")
    detector = replace(design, drift_chamber=None)
    result = cg.run(detector, cg.Gun("mu-", p=0.5, cos_theta=0.2), n=5, finder="ckf", until="find")
    strips = sum(layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem)
    fired = np.array([np.count_nonzero(result.digis["event"] == one) for one in range(5)])
    np.testing.assert_allclose(cg.study.finding(result).occupancy, 100 * fired / strips, rtol=1e-14)


@pytest.fixture(scope="module")
def run_loops():
    """One event with a positron of five half turns, each with 20 cells or more."""
    settings = cg.Settings(simulate=cg.SimulateSettings(half_turns=5, fluctuations="gaussian"))
    return cg.run("besiii-cgem", cg.Gun("e+", p=0.06, cos_theta=0.05), n=1, seed=3, settings=settings)


def turns(run):
    """The half turn behind each cluster, -9 for XV clusters, and each wire hit."""
    return (
        np.where(run.clusters["view"] < 2, run.truths["half_turn"][run.clusters["truth"]], -9).astype(int),
        run.wire_truths["half_turn"][run.wire_hits["wire_truth"]].astype(int),
    )


def labelled(run, label):
    """The run with candidates by a function of the half turn behind each hit; below 0: none."""
    found = label_candidates(run.clusters, run.wire_hits, *(np.vectorize(label)(turn) for turn in turns(run)))
    return replace(run, tables=run.tables | found)


def classes_loops(run, definition="belle2"):
    return [cg.MatchStatus(i).name for i in cg.study.finding(run).classes[definition]]


@pytest.mark.parametrize("definition", ["belle2", "acts"])
def test_tracks_of_later_half_turns_are_loop_clones(run_loops, definition):
    """Neither clones nor fakes; the efficiency of hits is that of the first half turn, which has all of its own."""
    each = labelled(run_loops, lambda turn: turn)
    assert classes_loops(each, definition) == [
        "matched",
        "other_half_turn",
        "other_half_turn",
        "other_half_turn",
        "other_half_turn",
    ]
    finding = cg.study.finding(each)
    rates = finding.rates(definition)
    assert (rates.efficiency.value, rates.fakes.count, rates.clones.count) == (1, 0, 0)
    assert (rates.loops.count, rates.loops.n) == (4, 5)
    assert (finding.purity, finding.hit_efficiency) == (1, 1)
    assert "loop clones" in repr(finding)


def test_the_first_half_turn_decides_what_is_findable_and_found(run_loops):
    later = cg.study.finding(labelled(run_loops, lambda turn: turn - 1))
    assert [cg.MatchStatus(i).name for i in later.classes["belle2"]] == ["other_half_turn"] * 4
    assert later.findable.tolist() == [True]
    assert later.rates().efficiency.count == 0
    of_cluster, of_wire = turns(run_loops)
    first = np.count_nonzero(of_wire == 0) + np.count_nonzero(of_cluster == 0)
    assert later.particles.hits.tolist() == [first]
    assert later.particles.wires.tolist() == [np.count_nonzero(of_wire == 0)]


def test_hits_of_later_half_turns_are_own_hits(run_loops):
    """Half of the second half turn's hits in the track of the first: its purity stays, and so does its efficiency."""
    found = labelled(run_loops, lambda turn: min(turn, 1))
    hits = found.candidate_hits
    with_some = hits["candidate"].copy()
    with_some[np.flatnonzero(hits["candidate"] == 1)[:8]] = 0
    moved = replace(found, tables=found.tables | {"candidate_hits": hits.with_columns(candidate=with_some)})
    finding = cg.study.finding(moved)
    assert [cg.MatchStatus(i).name for i in finding.classes["belle2"]] == ["matched", "other_half_turn"]
    assert (finding.purity, finding.hit_efficiency) == (1, 1)
    assert finding.candidates.of_loops[0] >= 8


def test_hits_of_daughters_are_not_pure(run):
    """They tell whose track it is, and count neither in its purity nor in its efficiency."""
    links = run.wire_hits["wire_truth"][run.candidate_hits["hit"][run.candidate_hits["view"] == HIT_WIRE]]
    daughter = np.zeros(len(run.wire_truths), "i4")
    daughter[links[run.wire_truths["event"][links] == 1][:7]] = 1
    tracks = fit(run.detector, run.clusters, run.wire_hits, run.candidates, run.candidate_hits)["tracks"]
    matches = match(
        tracks, run.candidates, run.candidate_hits, run.clusters, run.wire_hits, run.particles, run.truths,
        run.wire_truths.with_columns(daughter=daughter), detector=run.detector,
    )["matches"]  # fmt: skip
    n = np.bincount(run.candidate_hits["candidate"])
    assert matches["particle"].tolist() == [0] * 4
    np.testing.assert_allclose(matches["purity"], [1, (n[1] - 7) / n[1], 1, 1])
    assert matches["efficiency"][1] == 1


@pytest.fixture(scope="module")
def curled():
    """Muons that curl up, found on their first half turn alone, and on six."""
    gun = cg.Gun("mu-", pt=(0.2, 0.5), cos_theta=(-0.3, 0.3))
    settings = [cg.Settings(simulate=cg.SimulateSettings(half_turns=n, decays=False)) for n in (1, 6)]
    return [cg.run("cepc-like", gun, n=80, seed=7, finder="ckf", settings=one) for one in settings]


def test_tracks_of_later_half_turns_are_no_measurements_of_the_first(curled):
    """They have a class, no residual and no pull, and widen nothing; the true helix is the particle's all the same."""
    once, often = curled
    tracks, later = often.tracks, often.tracks["match"] == cg.MatchStatus.other_half_turn
    assert np.count_nonzero(later) > 50
    assert np.all(tracks["half_turn"][later] > 0)
    assert np.all(tracks["half_turn"][tracks["match"] == 0] == 0)
    good = tracks["status"] == 0
    for name in ("dr", "phi0", "kappa", "dz", "tanl", "p"):
        for kind in ("res", "pull"):
            np.testing.assert_array_equal(np.isnan(tracks[f"{kind}_{name}"])[good], later[good])
        assert np.isfinite(tracks[f"truth_{name}"]).all()
    one, six = cg.resolution(once, "dr"), cg.resolution(often, "dr")
    assert dict(six.removed)["other_half_turn"] == np.count_nonzero(later & good)
    assert "other_half_turn" not in dict(one.removed)
    assert abs(six.n - one.n) <= 2
    assert six.q68 < 1.3 * one.q68  # 60 times with later half turns
    for pull in cg.study.pulls(often):
        assert_within(pull.q68, 1, pull.q68_error, what=pull.parameter)
    assert often.removed() == dict(six.removed)
    assert f"{np.count_nonzero(later & good):,} other_half_turn" in repr(often)
    # As without a class: the comparison with the first helix.
    foreign = tracks["dr"][later] - tracks["truth_dr"][later]
    assert np.median(np.abs(foreign)) > 5e-3 * one.q68


def test_classes_of_tracks_are_those_of_the_finder(curled):
    for result in curled:
        found = cg.study.finding(result)
        np.testing.assert_array_equal(result.matches["match"], found.classes["belle2"][result.fitted["candidate"]])
        np.testing.assert_array_equal(found.candidates.left, found.particles.hits[found.candidates.particle])
        others = np.count_nonzero(result.matches["match"] == cg.MatchStatus.other_half_turn)
        assert found.rates().loops.count == others


def test_matches_count_the_first_half_turn(run_loops):
    """A track of the second half turn is all its particle's, and has no hit of the first one."""
    each = labelled(run_loops, lambda turn: turn)
    tracks = fit(each.detector, each.clusters, each.wire_hits, each.candidates, each.candidate_hits)["tracks"]
    matches = match(
        tracks, each.candidates, each.candidate_hits, each.clusters, each.wire_hits, each.particles, each.truths,
        each.wire_truths, detector=each.detector,
    )["matches"]  # fmt: skip
    assert matches["purity"].tolist() == [1] * 5
    assert matches["efficiency"].tolist() == [1, 0, 0, 0, 0]
    assert matches["half_turn"].tolist() == [0, 1, 2, 3, 4]
    assert [cg.MatchStatus(one).name for one in matches["match"]] == ["matched", *4 * ["other_half_turn"]]
