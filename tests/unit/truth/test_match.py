"""The counts of hits behind a match, and the hits given by truth, against loops in Python."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from cgemit import _core

WIRE, POINT = 2, 3


def numbered(random: np.random.Generator, events: int, most: int, crossings: bool) -> dict[str, np.ndarray]:
    """Return rows of random particles, or of crossings of particles of which some are not in any table."""
    event = np.sort(random.integers(0, events, most))
    if not crossings:
        return {
            "event": event,
            "particle": np.concatenate([np.arange(n) for n in np.bincount(event) if n]).astype("i4"),
        }
    rows = {"event": event, "particle": random.integers(-1, 5, most).astype("i4")}
    return rows | {
        "daughter": random.choice([0, 0, 0, 1], most).astype("i4"),
        "half_turn": random.choice([0, 0, 0, 0, 1, 2, -1], most).astype("i1"),
    }


def owners(particles: dict[str, np.ndarray], crossings: dict[str, np.ndarray]) -> list[int]:
    """Return the row of the particle behind each crossing, by a dictionary."""
    rows = {key: row for row, key in enumerate(zip(particles["event"], particles["particle"], strict=True))}
    return [rows.get(key, -1) for key in zip(crossings["event"], crossings["particle"], strict=True)]


@pytest.mark.parametrize("seed", range(5))
def test_counts_are_those_of_a_loop(seed: int) -> None:
    random = np.random.default_rng(seed)
    particles = numbered(random, 20, 60, crossings=False)
    truths, cells = (numbered(random, 20, n, crossings=True) for n in (90, 150))
    clusters = {
        "event": np.zeros(120, int), "truth": random.integers(-1, 90, 120),
        "view": random.integers(0, 3, 120).astype("i1"), "x_cluster": random.integers(-1, 1, 120),
        "layer": random.integers(0, 3, 120).astype("i4"),
    }  # fmt: skip
    wires = {"event": np.zeros(200, int), "wire_truth": random.integers(-1, 150, 200)}
    wires["layer"] = random.integers(0, 9, 200).astype("i4")
    view = random.choice([0, 1, WIRE, WIRE, POINT], 300).astype("i1")
    row = np.where(view == WIRE, random.integers(0, 200, 300), random.integers(0, 120, 300))
    hits = {"event": np.zeros(300, int), "candidate": random.integers(0, 40, 300), "view": view, "hit": row}
    tables = {"particles": particles, "truths": truths, "wire_truths": cells, "clusters": clusters, "wire_hits": wires}
    found = _core.truth.match_hits(**tables, candidate_hits=hits, candidates=40)

    rows, links = (owners(particles, truths), owners(particles, cells)), (clusters["truth"], wires["wire_truth"])

    def behind(wire: bool, hit: int) -> tuple[int, bool, bool]:
        """Return owner, whether a daughter left the hit, and whether it is of the first half turn."""
        crossing = links[int(wire)][hit]
        if crossing < 0:
            return -1, False, True
        table = cells if wire else truths
        late, turn = table["daughter"][crossing] > 0, table["half_turn"][crossing] != 0
        return rows[int(wire)][crossing], bool(late), not (late or turn)

    np.testing.assert_array_equal(_core.common.particle_rows(particles, truths), rows[0])
    for candidate in range(40):
        mine = [
            (behind(view[i] == WIRE, row[i]), 2 if view[i] == POINT else 1)
            for i in np.flatnonzero(hits["candidate"] == candidate)
        ]
        assert found["hits"][candidate] == sum(weight for _, weight in mine)
        count = Counter()
        for (owner, _, _), weight in mine:
            count[owner] += weight
        count.pop(-1, None)
        best = min(count, key=lambda owner: (-count[owner], owner), default=-1)
        assert found["particle"][candidate] == best
        if best >= 0:
            own = [(late, first, weight) for (owner, late, first), weight in mine if owner == best]
            assert found["own"][candidate] == sum(weight for late, _, weight in own if not late)
            assert found["found"][candidate] == sum(weight for _, first, weight in own if first)
            assert found["of_daughters"][candidate] == sum(weight for late, _, weight in own if late)
            turned = Counter()
            measured = set()
            for i in np.flatnonzero(hits["candidate"] == candidate):
                wire = view[i] == WIRE
                owner, late, first = behind(wire, row[i])
                if owner != best or late:
                    continue
                crossing = links[int(wire)][row[i]]
                turned[int((cells if wire else truths)["half_turn"][crossing])] += 2 if view[i] == POINT else 1
                if first:
                    views = {WIRE: (f"wire hit {i}",), POINT: (0, 1)}.get(view[i], (int(view[i]),))
                    measured |= {(crossing, one) for one in views}
            assert found["of_loops"][candidate] == sum(weight for turn, weight in turned.items() if turn != 0)
            common = min(turned, key=lambda turn: (-turned[turn], turn), default=0)
            assert found["half_turn"][candidate] == common
            assert found["crossings"][candidate] == len(measured)
    left = Counter()
    for i in range(120):
        owner, _, first = behind(False, i)
        weight = 1 if clusters["view"][i] != 2 else 2 if clusters["x_cluster"][i] < 0 else 0
        left[owner] += weight * first
    for i in range(200):
        owner, _, first = behind(True, i)
        left[owner] += first
    assert found["left"].tolist() == [max(1, left[owner]) for owner in range(60)]
    crossings = {
        (0, clusters["truth"][i], one) for i in range(120) for one in (0, 1) if clusters["view"][i] in (one, 2)
    }
    crossings |= {(1, wires["wire_truth"][i], f"wire hit {i}") for i in range(200)}
    seen = Counter()
    for wire, crossing, _ in crossings:
        if crossing >= 0:
            table = cells if wire else truths
            seen[rows[wire][crossing]] += int(table["daughter"][crossing] <= 0 and table["half_turn"][crossing] == 0)
    assert found["crossings_left"].tolist() == [seen[owner] for owner in range(60)]

    candidates, chosen = random.integers(-1, 30, 60), np.flatnonzero(clusters["view"] < 2)[::2]
    given = _core.truth.assign_hits(**tables, candidates=candidates, rows=chosen)
    expected = []
    for wire, some in ((False, chosen), (True, np.arange(200))):
        table, kind = (wires, np.full(200, WIRE)) if wire else (clusters, clusters["view"])
        for i in some:
            owner, _, first = behind(wire, i)
            if owner >= 0 and first and candidates[owner] >= 0:
                expected.append((candidates[owner], wire, table["layer"][i], i, kind[i]))
    expected.sort(key=lambda one: one[:3])  # stable
    assert list(zip(*(given[name].tolist() for name in ("candidate", "hit", "view")), strict=True)) == [
        (candidate, i, kind) for candidate, _, _, i, kind in expected
    ]


def test_links_beyond_their_tables_are_refused() -> None:
    one = {"event": np.zeros(1, int), "particle": np.zeros(1, "i4")}
    crossing = one | {"daughter": np.zeros(1, "i4"), "half_turn": np.zeros(1, "i1")}
    clusters = {
        "event": np.zeros(1, int),
        "truth": np.ones(1, int),
        "view": np.zeros(1, "i1"),
        "x_cluster": np.zeros(1, int),
    }
    wires = {"event": np.zeros(1, int), "wire_truth": np.zeros(1, int)}
    hits = {"event": np.zeros(1, int), "candidate": np.zeros(1, int), "view": np.zeros(1, "i1"), "hit": np.ones(1, int)}
    tables = {"particles": one, "truths": crossing, "wire_truths": crossing, "wire_hits": wires, "candidate_hits": hits}
    with pytest.raises(ValueError, match="truth 0: got 1"):
        _core.truth.match_hits(**tables, clusters=clusters, candidates=1)
    with pytest.raises(ValueError, match="row: got 1"):
        _core.truth.match_hits(**tables, clusters=clusters | {"truth": np.zeros(1, int)}, candidates=1)
