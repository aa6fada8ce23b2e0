"""Metrics of track finding for particles of several half turns, on candidates made of their hits by hand."""

from dataclasses import replace

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.finding import CLASSES
from cgemit.chain.match import match
from cgemit.reconstruction.candidates import label_candidates
from cgemit.reconstruction.fit import fit


@pytest.fixture(scope="module")
def run():
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


def classes(run, definition="belle2"):
    return [CLASSES[i] for i in cg.study.finding(run).classes[definition]]


@pytest.mark.parametrize("definition", ["belle2", "acts"])
def test_tracks_of_later_half_turns_are_loop_clones(run, definition):
    """Neither clones nor fakes; the efficiency of hits is that of the first half turn, which has all of its own."""
    each = labelled(run, lambda turn: turn)
    assert classes(each, definition) == ["matched", "loop", "loop", "loop", "loop"]
    finding = cg.study.finding(each)
    rates = finding.rates(definition)
    assert (rates.efficiency.value, rates.fakes.count, rates.clones.count) == (1, 0, 0)
    assert (rates.loops.count, rates.loops.n) == (4, 5)
    assert (finding.purity, finding.hit_efficiency) == (1, 1)
    assert "loop clones" in repr(finding)


def test_the_first_half_turn_decides_what_is_findable_and_found(run):
    later = cg.study.finding(labelled(run, lambda turn: turn - 1))
    assert [CLASSES[i] for i in later.classes["belle2"]] == ["loop"] * 4
    assert later.findable.tolist() == [True]
    assert later.rates().efficiency.count == 0
    of_cluster, of_wire = turns(run)
    first = np.count_nonzero(of_wire == 0) + np.count_nonzero(of_cluster == 0)
    assert later.particles.hits.tolist() == [first]
    assert later.particles.wires.tolist() == [np.count_nonzero(of_wire == 0)]


def test_hits_of_later_half_turns_are_own_hits(run):
    """Half of the second half turn's hits in the track of the first: its purity stays, and so does its efficiency."""
    found = labelled(run, lambda turn: min(turn, 1))
    hits = found.candidate_hits
    with_some = hits["candidate"].copy()
    with_some[np.flatnonzero(hits["candidate"] == 1)[:8]] = 0
    moved = replace(found, tables=found.tables | {"candidate_hits": hits.with_columns(candidate=with_some)})
    finding = cg.study.finding(moved)
    assert [CLASSES[i] for i in finding.classes["belle2"]] == ["matched", "loop"]
    assert (finding.purity, finding.hit_efficiency) == (1, 1)
    assert finding.candidates.of_loops[0] >= 8


def test_matches_count_the_first_half_turn(run):
    """A track of the second half turn is all its particle's, and has no hit of the first one."""
    each = labelled(run, lambda turn: turn)
    tracks = fit(each.detector, each.clusters, each.wire_hits, each.candidates, each.candidate_hits)["tracks"]
    matches = match(
        tracks, each.candidates, each.candidate_hits, each.clusters, each.wire_hits, each.particles, each.truths,
        each.wire_truths, detector=each.detector,
    )["matches"]  # fmt: skip
    assert matches["purity"].tolist() == [1] * 5
    assert matches["efficiency"].tolist() == [1, 0, 0, 0, 0]
