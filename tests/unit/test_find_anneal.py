"""Cells that two tracks cross: whose hit it is."""

import numpy as np
import pytest

import cgemit as cg
from cgemit.reconstruction.candidates import HIT_WIRE

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
    candidate[hits["row"][on]] = hits["candidate"][on]
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
        sorted(zip(*(found["candidate_hits"][name] for name in ("view", "row")), strict=True))
        for found in (moved, stayed)
    ]
    assert hits[0] == hits[1]
    assert moved["candidate_hits"] != stayed["candidate_hits"]
