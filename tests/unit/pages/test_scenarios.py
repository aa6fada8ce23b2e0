"""Hits that are lost, added or exchanged are those that the scenario says, and the tables stay tables."""

import numpy as np
import pytest

from cgemit.chain import run
from cgemit.detector import load
from cgemit.particles.gun import Gun
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X
from pages.robustness import fitted
from pages.scenarios import (
    SCENARIOS,
    Hits,
    add_noise,
    exchange_clusters,
    has_enough,
    kaon_decays,
    keep,
    lose_layers,
    own_hits,
    run_scenario,
)

DETECTOR = load("besiii-cgem-design")


@pytest.fixture(scope="module")
def result():
    """Return a run of 300 muons."""
    return run.run(DETECTOR, Gun("mu-", p=(0.5, 1.0), cos_theta=(-0.8, 0.8)), 300, seed=5)


@pytest.fixture(scope="module")
def hits(result):
    """Return its hits as the fit got them."""
    return Hits(result.candidates, result.candidate_hits, result.clusters, result.wire_hits)


def generator():
    """Return random numbers."""
    return np.random.default_rng(1)


def test_all_hits_are_own(hits, result):
    """By truth every hit belongs to its candidate, and to its event."""
    assert own_hits(hits, result).all()
    assert len(hits.track) == len(hits.candidate_hits)


def test_keep(hits):
    """What is kept keeps its order and its candidate."""
    kept = keep(hits, ~hits.on_wire)
    assert not kept.on_wire.any()
    np.testing.assert_array_equal(kept.track, hits.track[~hits.on_wire])
    np.testing.assert_array_equal(kept.row, hits.row[~hits.on_wire])


def test_layers_are_lost_as_a_whole(hits):
    """X and V of a crossing go together, in the share asked for."""
    left = lose_layers(hits, 0.3, generator())
    share, n = len(left.track) / len(hits.track), len(hits.track)
    assert abs(share - 0.7) < 4 * np.sqrt(0.21 * 2 / n)

    def crossings(some, view):
        return (some.track * 10 + some.layer)[some.view == view]

    views, full = ([crossings(some, view) for view in (HIT_X, HIT_V)] for some in (left, hits))
    both = np.intersect1d(*full)
    np.testing.assert_array_equal(np.intersect1d(views[0], both), np.intersect1d(views[1], both))


def test_exchanged_clusters_are_others(hits, result):
    """X and V of the layer, and nothing else, come from another event."""
    tracks = np.arange(300) < 150
    wrong = exchange_clusters(hits, 1, tracks)
    strange = ~own_hits(wrong, result)
    expected = (hits.layer == 1) & (hits.view != HIT_WIRE) & tracks[hits.track]
    assert np.count_nonzero(strange & ~expected) == 0
    assert np.count_nonzero(strange) > 0.95 * np.count_nonzero(expected)


def test_noise_is_beside_the_hits(hits, result):
    """In the share asked for; close by, of nobody, in the same layer; own hits stay but for those of a fired cell."""
    noisy = add_noise(DETECTOR, hits, 0.2, generator())
    own = own_hits(noisy, result)
    n, added = len(hits.track), np.count_nonzero(~own)
    assert abs(added / n - 0.2) < 4 * np.sqrt(0.16 / n)
    lost = n - np.count_nonzero(own)
    wires = np.count_nonzero(~own & noisy.on_wire)
    assert abs(lost / wires - 1 / 7) < 4 * np.sqrt(6 / 49 / wires)
    for kind, column, unit in ((HIT_WIRE, "wire", 3), (HIT_X, "x", 10), (HIT_V, "v", 10)):
        of_kind = np.flatnonzero(noisy.view == kind)
        table = noisy.wire_hits if kind == HIT_WIRE else noisy.clusters
        value = table[column][noisy.row[of_kind]].astype(float)
        same = np.flatnonzero(np.diff(noisy.track[of_kind]) == 0)
        same = same[(np.diff(noisy.layer[of_kind])[same] == 0) & (own[of_kind][same] & ~own[of_kind][same + 1])]
        apart = np.abs(np.diff(value)[same])
        assert len(same) > 50
        if kind == HIT_WIRE:  # around the layer, too
            cells = {layer.number: layer.cells for layer in DETECTOR.drift_chamber.layers}
            apart = np.minimum(apart, [cells[number] for number in noisy.layer[of_kind][same]] - apart)
        assert np.max(apart) < unit + 0.7
        assert np.min(apart) > 0


def test_noise_leaves_tables_sorted(hits):
    """New rows stand in their events, and candidates point at rows of their own event."""
    noisy = add_noise(DETECTOR, hits, 0.5, generator())
    for table, mask in ((noisy.clusters, ~noisy.on_wire), (noisy.wire_hits, noisy.on_wire)):
        assert np.all(np.diff(table["event"]) >= 0)
        np.testing.assert_array_equal(table["event"][noisy.row[mask]], noisy.track[mask])


def test_kaon_decays():
    """Two pions of the mass of a K_S, from a vertex on its way, within 100 mm; energy and momentum are conserved."""
    table = kaon_decays(2000, 1)
    p = np.stack([table["px"], table["py"], table["pz"]], axis=1).reshape(-1, 2, 3)
    energy = np.sqrt(np.sum(p**2, axis=2) + table["mass"].reshape(-1, 2) ** 2).sum(axis=1)
    total = p.sum(axis=1)
    np.testing.assert_allclose(np.sqrt(energy**2 - np.sum(total**2, axis=1)), 0.497611, rtol=1e-9)
    vertex = np.stack([table["x"], table["y"], table["z"]], axis=1)[::2]
    along = np.cross(vertex, total)
    assert np.abs(along).max() < 1e-6
    assert np.hypot(vertex[:, 0], vertex[:, 1]).max() < 100
    assert np.all(table["charge"].reshape(-1, 2).sum(axis=1) == 0)


def test_hits_of_a_daughter_are_not_own():
    """Of all cells in events with one kaon each: what a muon leaves behind its decay is not the kaon's."""
    found = run.run(DETECTOR, Gun("K+", p=0.3, cos_theta=(-0.5, 0.5)), 40, seed=3)
    wires, n = found.wire_hits, len(found.wire_hits)
    assert len(found.candidates) == 40
    columns = {"event": wires["event"], "candidate": wires["event"], "view": np.full(n, HIT_WIRE), "hit": np.arange(n)}
    every = Hits(found.candidates, Table("candidate_hits", columns, 40), found.clusters, wires)
    daughter = found.wire_truths["daughter"][wires["wire_truth"]] > 0
    assert 20 < daughter.sum() < n - 20
    np.testing.assert_array_equal(own_hits(every, found), ~daughter)


def test_a_helix_needs_three_hits_across_the_beam(hits, result):
    """All hits along the beam, and two or three of the others."""
    tilted = [layer.number for layer in DETECTOR.drift_chamber.layers if layer.twist != 0]
    along = (hits.view == HIT_V) | (hits.on_wire & np.isin(hits.layer, tilted))
    across = np.flatnonzero(~along)
    number = np.arange(len(across)) - np.searchsorted(hits.track[across], hits.track[across])
    for least, expected in ((2, False), (3, True)):
        chosen = along.copy()
        chosen[across[number < least]] = True
        assert (has_enough(DETECTOR, keep(hits, chosen), result) == expected).all()


def test_enough_hits(hits):
    """With one layer nothing is left that could be fitted; with all, every track can."""
    by_name = {scenario.name: scenario for scenario in SCENARIOS}
    assert run_scenario(by_name["plain"], 20).enough.all()
    assert len(by_name) == len(SCENARIOS)


def test_row_of_the_page():
    outcome = run_scenario(SCENARIOS[0], 30)
    row = fitted(outcome)
    assert (row.name, row.removed) == (SCENARIOS[0].name, "")
    assert row.fitted == 100 * outcome.efficiency == 100
    assert row.p == 100 * outcome.resolution("p").core
    assert row.pull_kappa == outcome.pull("kappa").core
