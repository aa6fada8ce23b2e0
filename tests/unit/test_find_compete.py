"""Which of the tracks that share hits remain: against all subsets, and by hand."""

import itertools
import math

import numpy as np
import pytest

from cgemit import _core

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
    for _ in range(300):
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
