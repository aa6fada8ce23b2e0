"""Hits assigned to particles by truth: who gets what, and in which order."""

import numpy as np
import pytest

import gem_toy
from cgemit.detector import load
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.fit import fit
from cgemit.simulation.digitize import digitize
from cgemit.tables import SCHEMAS, Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X
from cgemit.truth.assign import own_clusters
from cgemit.truth.finder import by_truth

EVENTS = 30
DETECTOR = load("besiii-cgem-design")


def particle_table(event, particle, n_events=EVENTS):
    """Particles of which only event and number matter."""
    n = len(event)
    columns = {name: np.zeros(n) for name in ("x", "y", "z", "px", "py", "pz")}
    columns |= {
        "mass": np.full(n, 0.10566),
        "event": np.array(event),
        "particle": np.array(particle, "i4"),
        "pdg": np.full(n, 13, "i4"),
    }
    columns |= {"charge": np.full(n, -1, "i1"), "status": np.zeros(n, "i1")}
    return Table("particles", columns, n_events)


@pytest.fixture(scope="module", params=["binary", "gaussian"])
def chain(request):
    """Two particles in each of 30 events, hits from outside to inside in the truths, wires before their layer order."""
    rng = np.random.default_rng(3)
    singles = gem_toy.muons_through(gem_toy.design_layers(), 2 * EVENTS, seed=3, limit=0.7)
    truths = {name: values[::-1].copy() for name, values in singles.items()}
    truths["event"], truths["particle"] = np.repeat(np.arange(EVENTS), 6), np.tile([1, 1, 1, 0, 0, 0], EVENTS)
    n = 2 * EVENTS * 10
    wires = gem_toy.wire_truth_columns(
        np.repeat(np.arange(EVENTS), 20),
        np.tile(np.arange(17, 7, -1), 2 * EVENTS),
        rng.integers(0, 76, n),
        rng.uniform(-8, 8, n),
        np.tile(np.repeat([0, 1], 10), EVENTS),
    )
    truths = Table("truths", truths, EVENTS)
    wire_truths = Table("wire_truths", wires, EVENTS)
    detector = DETECTOR.with_readout(request.param)
    hits = digitize(detector, truths, wire_truths, seed=2)
    clusters = cluster(detector, hits["digis"])
    return {"truths": truths, "wire_truths": wire_truths, "wire_hits": hits["wire_hits"], "clusters": clusters}


def candidates_of(chain, particles):
    """Candidates of a particles table."""
    return by_truth(DETECTOR, particles, chain["clusters"], chain["wire_hits"], chain["truths"], chain["wire_truths"])


def hits_of(found, i):
    """Set of (view, row) of one candidate."""
    hits = found["candidate_hits"]
    mine = hits["candidate"] == i
    assert (hits["event"][mine] == found["candidates"]["event"][i]).all()
    return set(zip(hits["view"][mine].tolist(), hits["hit"][mine].tolist(), strict=True))


def counts_of(found):
    """Number of hits of each candidate."""
    return np.bincount(found["candidate_hits"]["candidate"], minlength=len(found["candidates"]))


def expected_hits(chain, event, particle):
    """The same by loops over the rows."""
    hits = set()
    for row in range(len(chain["clusters"])):
        view, truth = chain["clusters"]["view"][row], chain["clusters"]["truth"][row]
        owner = chain["truths"]["event"][truth], chain["truths"]["particle"][truth]
        if view < 2 and truth >= 0 and owner == (event, particle):
            hits.add((int(view), row))
    for row, truth in enumerate(chain["wire_hits"]["wire_truth"]):
        if (chain["wire_truths"]["event"][truth], chain["wire_truths"]["particle"][truth]) == (event, particle):
            hits.add((HIT_WIRE, row))
    return hits


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_each_particle_gets_its_own_hits(chain, order):
    """Against a loop over all rows, whatever the order of the particles within their event."""
    particles = particle_table(np.repeat(np.arange(EVENTS), 2), np.tile(order, EVENTS))
    candidates = candidates_of(chain, particles)
    for i in (0, 1, 7, 2 * EVENTS - 1):
        assert hits_of(candidates, i) == expected_hits(chain, particles["event"][i], particles["particle"][i])
    used = np.count_nonzero(chain["clusters"]["view"] < 2) + len(chain["wire_hits"])
    assert len(candidates["candidate_hits"]) == used
    assert candidates["candidates"]["candidate"].tolist() == [0, 1] * EVENTS
    assert candidates["candidates"].meta["finder"] == "truth"


def test_particles_that_are_not_in_the_table_keep_their_hits(chain):
    """A table without particle 0 leaves that one's hits over; one without hits gets an empty candidate."""
    particles = particle_table([2, 5, 5], [1, 1, 7])
    candidates = candidates_of(chain, particles)
    assert counts_of(candidates).tolist()[2] == 0
    assert hits_of(candidates, 0) == expected_hits(chain, 2, 1)
    assert hits_of(candidates, 1) == expected_hits(chain, 5, 1)


def test_neutral_particles_are_no_candidates(chain):
    """They leave no hits, and no track that would count as one that is not fitted."""
    particles = particle_table([2, 2, 5], [0, 1, 1]).with_columns(charge=np.array([0, -1, -1], "i1"))
    found = candidates_of(chain, particles)
    assert found["candidates"]["event"].tolist() == [2, 5]
    assert hits_of(found, 0) == expected_hits(chain, 2, 1)
    assert hits_of(found, 1) == expected_hits(chain, 5, 1)


def test_no_particles_no_candidates(chain):
    """Empty tables on either side."""
    assert not len(candidates_of(chain, particle_table([], []))["candidates"])
    empty = {kind: Table.empty(kind, EVENTS) for kind in ("clusters", "wire_hits", "truths", "wire_truths")}
    assert counts_of(candidates_of(empty, particle_table([0, 1], [0, 0]))).tolist() == [0, 0]


def test_hits_come_from_the_beam_line_outward(chain):
    """CGEM layers, then wire layers, each inside out; in a layer X before V."""
    particles = particle_table(np.repeat(np.arange(EVENTS), 2), np.tile([0, 1], EVENTS))
    candidates = candidates_of(chain, particles)
    hits = collect_hits(DETECTOR, *candidates.values(), chain["clusters"], chain["wire_hits"])
    candidate = np.repeat(np.arange(2 * EVENTS), np.diff(hits.hit_offsets))
    place = np.column_stack([candidate, hits.kind == HIT_WIRE, hits.layer, hits.channel, hits.kind]).tolist()
    assert place == sorted(place)


def test_measurements_are_those_of_the_rows(chain):
    """Value, error, channel, size and side of every hit, from the table it belongs to."""
    particles = particle_table(np.repeat(np.arange(EVENTS), 2), np.tile([0, 1], EVENTS))
    hits = collect_hits(DETECTOR, *candidates_of(chain, particles).values(), chain["clusters"], chain["wire_hits"])
    columns = {
        HIT_X: ("clusters", {"value": "x", "sigma": "err_x", "channel": "sheet", "layer": "layer", "size": "size"}),
        HIT_V: ("clusters", {"value": "v", "sigma": "err_v", "channel": "sheet", "layer": "layer", "size": "size"}),
        HIT_WIRE: (
            "wire_hits",
            {"value": "drift", "sigma": "sigma", "channel": "wire", "layer": "layer", "side": "side"},
        ),
    }
    for kind, (table, names) in columns.items():
        chosen = hits.kind == kind
        assert chosen.any()
        for name, column in names.items():
            np.testing.assert_array_equal(getattr(hits, name)[chosen], chain[table][column][hits.hit[chosen]])
    assert not np.isnan(hits.value).any()
    assert set(hits.size[hits.kind == HIT_WIRE]) == {0}
    assert set(hits.side[hits.kind != HIT_WIRE]) == {0}
    expected = {"kind": "u1", "layer": "i4", "channel": "i4", "value": "f8", "sigma": "f8", "size": "i4", "side": "i1"}
    assert all(getattr(hits, name).dtype == dtype for name, dtype in (expected | {"hit": "i8"}).items())


def test_later_events_count_from_the_first(chain):
    """Tables that start at event 10 work the same."""
    cut = {
        "clusters": chain["clusters"].select_events(10, 20),
        "wire_hits": chain["wire_hits"].select_events(10, 20),
    }
    particles = particle_table(np.repeat(np.arange(EVENTS), 2), np.tile([0, 1], EVENTS)).select_events(10, 20)
    part = by_truth(DETECTOR, particles, cut["clusters"], cut["wire_hits"], chain["truths"], chain["wire_truths"])
    whole = candidates_of(chain, particle_table(np.repeat(np.arange(EVENTS), 2), np.tile([0, 1], EVENTS)))
    np.testing.assert_array_equal(counts_of(part), counts_of(whole)[20:40])


def by_truth_of(chain, detector=DETECTOR, **other):
    """Candidates with some tables in the place of others."""
    tables = {"particles": particle_table([0], [0]), **chain, **other}
    names = ("particles", "clusters", "wire_hits", "truths", "wire_truths")
    return by_truth(detector, *(tables[name] for name in names))


def test_tables_that_do_not_belong_together_are_refused(chain):
    """Rows that are not there, of other events or of another detector; all tables that do not fit are named."""
    truths, wires = chain["truths"], chain["wire_truths"]
    with pytest.raises(
        ValueError,
        match=r"(?s)clusters row \d+: truth: got \d+, .*wire_hits row 0: wire_truth: got \d+, expected a row of",
    ):
        by_truth_of(chain, truths=truths[:10], wire_truths=wires[:7])
    with pytest.raises(
        ValueError, match=r"clusters row \d+: truth: got \d+, expected a row of truths, of the same event"
    ):
        by_truth_of(chain, truths=truths.with_columns(event=np.append(truths["event"][6:], [EVENTS - 1] * 6)))
    with pytest.raises(ValueError, match=r"clusters row 0: layer: got 0, expected a layer of besiii-idc"):
        by_truth_of(chain, load("besiii-idc"))
    layer = np.full(len(chain["wire_hits"]), 3, "i4")
    with pytest.raises(ValueError, match="wire_hits row 0: layer: got 3, expected a layer of besiii-cgem-design"):
        by_truth_of(chain, wire_hits=chain["wire_hits"].with_columns(layer=layer))
    sheet = np.full(len(chain["clusters"]), 1, "i4")
    with pytest.raises(
        ValueError, match="clusters row 0: sheet: got 1, expected a sheet of the layer, of besiii-cgem-design"
    ):
        by_truth_of(chain, clusters=chain["clusters"].with_columns(sheet=sheet))
    with pytest.raises(ValueError, match="clusters row 0: sheet: got -2, expected a whole number of at least 0"):
        by_truth_of(chain, clusters=chain["clusters"].with_columns(sheet=-2 * sheet))
    for view in (-1, 3):
        with pytest.raises(ValueError, match=rf"clusters row 0: view: got {view}, expected a whole number from 0 to 2"):
            by_truth_of(chain, clusters=chain["clusters"].with_columns(view=sheet.astype("i1") * view))
    with pytest.raises(
        ValueError, match=r"(?s)clusters: got a table of kind 'wire_hits', .*\n  wire_hits: got NoneType,"
    ):
        by_truth_of(chain, clusters=chain["wire_hits"], wire_hits=None)


def test_candidates_of_other_tables_are_refused(chain):
    """Hits in rows that the tables do not have, and tables changed for one another."""
    particles = particle_table(np.repeat(np.arange(EVENTS), 2), np.tile([0, 1], EVENTS))
    found = candidates_of(chain, particles)
    clusters, wires = chain["clusters"], chain["wire_hits"]
    with pytest.raises(
        ValueError, match=r"(?s)expected a row of clusters, of the same event.*expected a row of wire_hits"
    ):
        fit(DETECTOR, clusters[:10], wires[:9], *found.values())
    with pytest.raises(
        ValueError, match=r"(?s)clusters: got a table of kind 'wire_hits', .*wire_hits: got a table of k"
    ):
        fit(DETECTOR, wires, clusters, *found.values())


# ----- several clusters of one crossing


def cluster_table(rows):
    """Clusters of layer 1 from rows (sheet, view, first, last, truth), at the centre of their strips."""
    sheet, view, first, last, truth = (np.array(values, "i4") for values in zip(*rows, strict=True))
    n = len(rows)
    columns = {c.name: np.zeros((n, *c.shape), c.dtype) for c in SCHEMAS["clusters"]}
    centre = 0.5 * (first + last + 1) * 0.65
    columns |= {"layer": np.full(n, 1, "i4"), "sheet": sheet, "view": view.astype("i1"), "first": first, "last": last}
    columns |= {"size": last - first + 1, "truth": truth.astype("i8"), "n_truths": np.ones(n, "i4")}
    columns |= {"x": np.where(view == 0, centre, np.nan), "v": np.where(view == 1, centre, np.nan)}
    return Table("clusters", columns, 1)


def crossing(x, z, sheet=0, layer=1):
    """Truth above local X (mm) and z of a sheet of the design's layer 1."""
    phi, r = np.array([np.pi, 0.0])[sheet] + x / 132.5, 123.8
    point = np.array([[r * np.cos(phi), r * np.sin(phi), z]])
    return Table("truths", gem_toy.truth_columns(0, layer, point, point), 1)


def v_of(x, z):
    """Number of the V strip under a point of layer 1."""
    stereo = gem_toy.design_layers()["stereo"][1]
    return int((x * np.cos(stereo) + (-345.0 - z) * np.sin(stereo)) / 0.65)


def test_the_cluster_under_the_track_counts():
    """X strip 100 lies under it, the larger and nearer-centred cluster of strips 101 to 103 does not; V likewise."""
    x, z = 100.9 * 0.65, 20.0
    truths, v = crossing(x, z), v_of(x, z)
    rows = [(0, 0, 96, 100, 0), (0, 0, 102, 102, 0), (0, 1, v - 9, v - 5, 0), (0, 1, v - 3, v + 8, 0)]
    assert own_clusters(DETECTOR, cluster_table(rows), truths).tolist() == [0, 3]
    assert own_clusters(DETECTOR, cluster_table(rows[1:3]), truths).tolist() == [0, 1]


def test_without_a_cluster_under_the_track_the_nearest_counts():
    """Distance is that to the nearest strip, not to the centre, and goes over the seam between sheets."""
    truths = crossing(100.5 * 0.65, 20.0)
    rows = [(0, 0, 94, 94, 0), (0, 0, 103, 120, 0)]
    assert own_clusters(DETECTOR, cluster_table(rows), truths).tolist() == [1]
    last = gem_toy.design_layers()["strips_x"][1] - 1
    truths = crossing(0.1, 20.0, sheet=1)
    rows = [(0, 0, last, last, 0), (1, 0, 5, 5, 0)]
    assert own_clusters(DETECTOR, cluster_table(rows), truths).tolist() == [0]
    rows = [(0, 0, last, last, 0), (1, 0, 0, 1, 0)]
    assert own_clusters(DETECTOR, cluster_table(rows), truths).tolist() == [1]


def test_positions_weighted_by_charge_do_not_hide_the_strips():
    """A cluster whose charge sits at its far end still holds the strip under the track."""
    truths = crossing(100.5 * 0.65, 20.0)
    clusters = cluster_table([(0, 0, 90, 100, 0), (0, 0, 102, 102, 0)])
    weighted = clusters.with_columns(x=np.array([91.0, 102.5]) * 0.65)
    assert own_clusters(DETECTOR, weighted, truths).tolist() == [0]


def test_deltas_do_not_change_what_a_particle_gets():
    """Deposits away from the track make clusters of their own, of which the fit gets none."""
    n = 50
    truths = gem_toy.muons_through(gem_toy.design_layers(), n, seed=4, limit=0.7)
    link = np.arange(0, 3 * n, 5)
    phi = truths["phi"][link] + 5.0 / truths["r"][link]
    middle = np.column_stack([truths["r"][link] * np.cos(phi), truths["r"][link] * np.sin(phi), truths["z"][link]])
    truths["energy"][:] = 4.0
    steps = Table("steps", gem_toy.step_columns(truths, link, middle, 0 * middle), n)
    truths = Table("truths", truths, n)
    wires = Table.empty("wire_truths", n)
    found = []
    for rows in (None, steps):
        hits = digitize(DETECTOR, truths, wires, steps=rows)
        clusters = cluster(DETECTOR, hits["digis"])
        particles = particle_table(np.arange(n), np.zeros(n), n)
        candidates = by_truth(DETECTOR, particles, clusters, hits["wire_hits"], truths, wires)
        fitted = collect_hits(DETECTOR, *candidates.values(), clusters, hits["wire_hits"])
        found.append((len(clusters), fitted.value.tolist(), fitted.hit_offsets.tolist()))
    assert found[0][0] < found[1][0]
    assert found[0][1:] == found[1][1:]
