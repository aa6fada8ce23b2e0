"""Tracks that share hits and cells between two tracks: against all subsets, sums of numpy, and by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit._core import _testing
from cgemit.tables.schema import HIT_WIRE

MIN_SCORE = 2.0


def settle(tracks, wire, along):
    """Return the numbers of the tracks that remain and their hits; a track is (score, hits, gains)."""
    out = _core._testing.settle_tracks(
        tracks={"score": np.array([t[0] for t in tracks]), "hits": np.array([len(t[1]) for t in tracks])},
        entries={
            "hit": np.concatenate([t[1] for t in tracks]).astype("i8"),
            "gain": np.concatenate([t[2] for t in tracks]).astype(float),
        },
        hits={"wire": np.array(wire), "along": np.array(along)},
        min_score=MIN_SCORE,
    )
    ends = np.cumsum(out["hits"])
    return {
        number: out["hit"][end - n : end]
        for number, n, end in zip(out["track"].tolist(), out["hits"], ends, strict=True)
    }


def kept(tracks, chosen, wire, along):
    """Tell whether each of the chosen tracks may remain beside the better ones; the tracks are in order."""
    used = set()
    for number in chosen:
        score, hits, gains = tracks[number]
        shared = [hit in used for hit in hits]
        n, own = len(hits), len(hits) - sum(shared)
        alone = score - sum(g for g, s in zip(gains, shared, strict=True) if s)
        clusters = not any(wire[hit] for hit in hits)
        if sum(shared) > 0.3 * n:
            likely = alone > MIN_SCORE + 4 + 2.5 * own
            if not (clusters and sum(shared) <= 0.5 * n and likely):
                return False
        left = [hit for hit, s in zip(hits, shared, strict=True) if not (s and wire[hit])]
        if sum(not along[hit] for hit in left) < 3 or sum(along[hit] for hit in left) < 2:
            return False
        used |= set(hits)
    return True


def worth(tracks, chosen):
    """Return the sum of scores, each hit counted once, less what tracks cost."""
    total = sum(tracks[i][0] - MIN_SCORE - 2.5 * math.log(len(tracks[i][1])) for i in chosen)
    gains = {}
    for i in chosen:
        for hit, gain in zip(*tracks[i][1:], strict=True):
            gains.setdefault(hit, []).append(gain)
    return total - sum(sum(several) - max(several) for several in gains.values())


def groups(tracks):
    """Return the tracks connected by sharing more than 30 % of the worse one."""
    found = [{i} for i in range(len(tracks))]
    for i, j in itertools.combinations(range(len(tracks)), 2):
        if len(set(tracks[i][1]) & set(tracks[j][1])) > 0.3 * len(tracks[j][1]):
            a, b = (next(group for group in found if k in group) for k in (i, j))
            if a is not b:
                found.remove(b)
                a |= b
    return [sorted(group) for group in found]


def one_by_one(tracks, numbers, wire, along):
    chosen = []
    for i in numbers:
        if kept(tracks, [*chosen, i], wire, along):
            chosen.append(i)
    return chosen


def random_event(random, n, n_hits, of_clusters):
    wire, along = random.random(n_hits) > of_clusters, random.random(n_hits) < 0.5
    tracks = []
    for _ in range(n):
        size = int(random.integers(6, 13))
        first = int(random.integers(0, n_hits - 14))
        hits = np.sort(first + random.permutation(14)[:size])
        gains = random.uniform(2, 8, size)
        tracks.append((float(gains.sum() + random.uniform(-3, 8)), hits.tolist(), gains.tolist()))
    likely = [t for t in tracks if t[0] > MIN_SCORE + 2.5 * len(t[1])]
    return sorted(likely, key=lambda t: -t[0]), wire.tolist(), along.tolist()


@pytest.mark.parametrize("of_clusters", [0.0, 0.5, 1.0])
def test_the_best_of_all_sets_remains_of_small_groups(of_clusters):
    random, differ, sizes = np.random.default_rng(3), 0, []
    for _ in range(150):
        tracks, wire, along = random_event(random, int(random.integers(2, 12)), 40, of_clusters)
        if not tracks:
            continue
        best = []
        for group in groups(tracks):
            sets = [
                one
                for k in range(len(group) + 1)
                for one in itertools.combinations(group, k)
                if kept(tracks, one, wire, along)
            ]
            best += max(sets, key=lambda one: worth(tracks, one))
            sizes.append(len(group))
        expected = one_by_one(tracks, sorted(best), wire, along)
        assert list(settle(tracks, wire, along)) == expected
        differ += expected != one_by_one(tracks, range(len(tracks)), wire, along)
    assert differ > 30
    assert max(sizes) >= 7


def test_two_tracks_are_worth_more_than_the_best_one_between_them():
    """Half of its hits are of one of them, half of the other: the best track alone is the wrong answer."""
    wire, along = [True] * 24, [i % 2 == 1 for i in range(24)]
    tracks = [
        (64.0, list(range(6, 18)), [5.0] * 12),
        (60.0, list(range(12)), [5.0] * 12),
        (59.0, list(range(12, 24)), [5.0] * 12),
    ]
    assert one_by_one(tracks, range(3), wire, along) == [0]
    assert sorted(settle(tracks, wire, along)) == [1, 2]
    # A track of its own that has hardly more than the cost of any track does not replace the best one.
    weak = [tracks[0], (36.0, *tracks[1][1:]), (35.0, *tracks[2][1:])]
    assert sorted(settle(weak, wire, along)) == [0]


def test_a_shared_hit_counts_once():
    """Two tracks with three of ten hits in common explain less than their scores say."""
    wire, along = [True] * 17, [i % 2 == 1 for i in range(17)]
    tracks = [
        (75.0, [*range(3, 14)], [6.0] * 11),  # shares 7 with the next one, 4 with the last
        (60.0, [*range(10)], [6.0] * 10),
        (56.0, [*range(7, 17)], [6.0] * 10),
    ]
    pair = worth(tracks, (1, 2))
    assert pair == pytest.approx(60 + 56 - 3 * 6 - 2 * (MIN_SCORE + 2.5 * math.log(10)))
    assert pair > worth(tracks, (0,))
    found = settle(tracks, wire, along)
    assert {number: hits.tolist() for number, hits in found.items()} == {1: [*range(10)], 2: [*range(10, 17)]}
    dear = [(105.0, *tracks[0][1:]), *tracks[1:]]  # less than 60 + 56
    assert list(settle(dear, wire, along)) == [0]


def test_order_of_tracks_does_not_matter():
    random = np.random.default_rng(8)
    for _ in range(50):
        tracks, wire, along = random_event(random, 14, 40, 0.3)
        turn = random.permutation(len(tracks))
        straight = settle(tracks, wire, along)
        turned = settle([tracks[i] for i in turn], wire, along)
        assert [int(turn[i]) for i in turned] == list(straight)
        assert all(np.array_equal(a, b) for a, b in zip(turned.values(), straight.values(), strict=True))


def test_larger_groups_are_settled_one_by_one():
    """Thirteen tracks, each conflicting with its neighbours."""
    wire, along = [True] * 100, [i % 2 == 1 for i in range(100)]
    scores = [60.0, 64.0, 59.0, *(50.0 - i for i in range(10))]
    tracks = [(score, [*range(6 * i, 6 * i + 12)], [5.0] * 12) for i, score in enumerate(scores)]
    assert 0 not in settle(tracks, wire, along)
    assert 0 in settle(tracks[:12], wire, along)


def test_wrong_hits_are_refused():
    with pytest.raises(ValueError, match="hit: expected the number of a hit"):
        settle([(50.0, [0, 1, 9], [5.0] * 3)], [True] * 3, [False] * 3)


QUIET = cg.Settings(simulate=cg.SimulateSettings(decays=False, fluctuations="gaussian"))
NEAR, FAR = 0.4, 1.2  # mm, between the distances of both tracks from the wire: both pass within the gate of a fit


@pytest.fixture(scope="module")
def crossing():
    """Two circles of radius 2.7 m, flown through in opposite senses, that cross about 0.4 m from the beam line."""
    gun = cg.Gun("mu-", pt=0.8, theta=np.pi / 2, phi=(0.0, 0.02)) + cg.Gun("mu+", pt=0.8, theta=np.pi / 2, phi=-0.15)
    return cg.run("besiii-cgem", gun, n=60, settings=QUIET, until="find")


@pytest.fixture(scope="module")
def shared(crossing):
    """Hits of cells that both particles cross at different distances: (row, distances of both)."""
    wires, hits = crossing.wire_truths, crossing.wire_hits
    found = []
    for row in range(len(hits)):
        same = np.logical_and.reduce([wires[name] == hits[name][row] for name in ("event", "layer", "wire")])
        away = [np.abs(wires["doca"][same & (wires["particle"] % 2 == p)]) for p in (0, 1)]
        if all(len(one) == 1 for one in away) and NEAR < abs(away[0][0] - away[1][0]) < FAR:
            found.append((row, float(away[0][0]), float(away[1][0])))
    return found


def owners(run, wire_hits, rows, **settings):
    """The particle of an event, 0 or 1, whose candidate has each of the hits; -1: none."""
    found = cg.find_tracks(run.detector, run.clusters, wire_hits, cg.FindSettings(**settings))
    hits = found["candidate_hits"]
    on = hits["view"] == HIT_WIRE
    candidate = np.full(len(wire_hits), -1)
    candidate[hits["hit"][on]] = hits["candidate"][on]
    particle = run.wire_truths["particle"][wire_hits["wire_truth"]] % 2
    number = np.full(len(found["candidates"]) + 1, -1)
    for i in range(len(found["candidates"])):
        number[i] = np.bincount(particle[candidate == i], minlength=2).argmax()
    return number[candidate[rows]]


def with_distances(run, shared, nearer):
    """The wire hits of a run, those of shared cells at the distance of one of both particles; and their rows."""
    rows = np.array([row for row, *_ in shared])
    drift = run.wire_hits["drift"].copy()
    drift[rows] = [distances[nearer] for _, *distances in shared]
    return run.wire_hits.with_columns(drift=drift), rows


@pytest.mark.parametrize("nearer", [0, 1])
def test_a_shared_cell_belongs_to_the_track_at_the_measured_distance(crossing, shared, nearer):
    """Whichever of both tracks was found first, or has the better score."""
    wires, rows = with_distances(crossing, shared, nearer)
    assert len(rows) > 60
    assert (owners(crossing, wires, rows) == nearer).all()


def test_without_annealing_the_first_track_keeps_what_it_has(crossing, shared):
    wires, rows = with_distances(crossing, shared, 0)
    first = owners(crossing, wires, rows, annealing=False)
    assert 0.02 < np.mean(first == 1) < 0.2
    wires, rows = with_distances(crossing, shared, 1)
    assert 0.02 < np.mean(owners(crossing, wires, rows, annealing=False) == 0) < 0.2


def test_annealing_moves_hits_and_nothing_else(crossing):
    """The same tracks, and the same hits in all of them together."""
    tables = crossing.detector, crossing.clusters, crossing.wire_hits
    moved, stayed = (cg.find_tracks(*tables, cg.FindSettings(annealing=on)) for on in (True, False))
    assert moved["candidates"] == stayed["candidates"]
    hits = [
        sorted(zip(*(found["candidate_hits"][name] for name in ("view", "hit")), strict=True))
        for found in (moved, stayed)
    ]
    assert hits[0] == hits[1]
    assert moved["candidate_hits"] != stayed["candidate_hits"]


SIZE = 192


def summed(first: list[int], last: list[int]) -> np.ndarray:
    counts = np.zeros(SIZE, np.int64)
    for low, high in zip(first, last, strict=True):
        counts[low : high + 1] += 1
    return counts


@pytest.mark.parametrize(
    ("first", "last"),
    [
        ([], []),
        ([5], [5]),
        ([0], [SIZE - 1]),
        ([63, 64, 127, 0], [63, 64, 128, 191]),  # at the borders of words
        ([10, 20, 30] * 42, [100, 90, 80] * 42),  # 126 of at most 127
    ],
)
def test_ranges_by_hand(first: list[int], last: list[int]) -> None:
    counts, most, where = _testing.count_ranges(np.array(first, np.int32), np.array(last, np.int32))
    expected = summed(first, last)
    np.testing.assert_array_equal(counts, expected)
    assert most == expected.max()
    np.testing.assert_array_equal(where, expected == expected.max())


@pytest.mark.parametrize("seed", range(20))
def test_random_ranges(seed: int) -> None:
    random = np.random.default_rng(seed)
    ends = np.sort(random.integers(0, SIZE, (random.integers(1, 127), 2)), axis=1).astype(np.int32)
    counts, most, where = _testing.count_ranges(ends[:, 0], ends[:, 1])
    expected = summed(ends[:, 0].tolist(), ends[:, 1].tolist())
    np.testing.assert_array_equal(counts, expected)
    assert most == expected.max()
    np.testing.assert_array_equal(where, expected == expected.max())


@pytest.mark.parametrize(("first", "last"), [(-1, 3), (4, 3), (0, SIZE)])
def test_ranges_outside_are_refused(first: int, last: int) -> None:
    with pytest.raises(ValueError, match="expected ranges within 0 and 191"):
        _testing.count_ranges(np.array([first], np.int32), np.array([last], np.int32))
