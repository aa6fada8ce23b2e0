"""First helices from the hits: near the true ones, whatever part of the hits is wrong."""

import numpy as np
import pytest

import tracks
from cgemit import _core, helix
from cgemit.chain import run
from cgemit.detector import compiled, load
from cgemit.reconstruction.candidates import collect_hits
from pages.scenarios import SCENARIOS, Hits, exchange_clusters

DETECTOR = load("besiii-cgem-design")
ALL = _core._testing.SeedFrom.wires_and_clusters

# What a first helix of a clean track may miss: a few times what it does (dr mm, phi0 rad, kappa relative, dz mm, tanl).
NEAR = np.array([2.0, 0.02, 0.05, 5.0, 0.04])


def seeds(hits, offsets, mass, source=ALL, detector=DETECTOR):
    """Return the first helices of some candidates."""
    core = compiled(detector)
    return _core._testing.seeds(
        core, hit_offsets=offsets, hits=hits, mass=np.broadcast_to(mass, len(offsets) - 1), source=source
    )


def distance(found, true):
    """Return how far first helices are off, kappa relative."""
    apart = np.abs(found - true)
    apart[:, 1] = np.abs(np.remainder(found[:, 1] - true[:, 1] + np.pi, 2 * np.pi) - np.pi)
    apart[:, 2] /= np.abs(true[:, 2])
    return apart


def of_scenario(name, events=400, spoil=None, mass=None):
    """Return how far the first helices of a scenario are off; infinite where there is none."""
    scenario = next(one for one in SCENARIOS if one.name == name)
    result = run.run(DETECTOR, scenario.particles(events, 1), seed=1)
    hits = Hits(result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
    spoil = spoil or scenario.spoil
    hits = spoil(DETECTOR, hits, np.random.default_rng(1)) if spoil else hits
    flat = collect_hits(DETECTOR, hits.candidates, hits.candidate_hits, hits.clusters, hits.wire_hits)
    mass = result.particles["mass"] if mass is None else mass
    found = seeds(flat.columns(), flat.hit_offsets, mass)
    return np.nan_to_num(distance(found, helix.at_origin(result.particles, DETECTOR.field.bz)), nan=np.inf)


@pytest.mark.parametrize("bz", ["-1 T", "1 T"])
@pytest.mark.parametrize("kappa", [-2.5, 0.8, 4.0])
@pytest.mark.parametrize("hidden", [False, True])
def test_clean_track(bz, kappa, hidden):
    """Through exact hits goes the helix that made them, for both charges and fields, with sides known or not."""
    detector = DETECTOR.with_overrides({"field.bz": bz})
    for number in range(8):
        true = np.array([[0.3, 0.7 * number - 2.5, kappa, 4.0, 0.2 * number - 0.7]])
        hits = tracks.hits_on(detector, true)
        if hidden:
            hits["side"][:] = 0
        for source in (ALL, _core._testing.SeedFrom.wires):
            found = seeds(hits, [0, len(hits["kind"])], tracks.MUON, source, detector)
            near = NEAR * (1, 1, 1, 4, 1) if source != ALL and hidden else NEAR
            assert np.all(distance(found, true) < near), (number, source, found)


def test_straight_track():
    """Nothing special happens at 10 TeV/c."""
    true = np.array([[0.3, 0.5, 1e-4, 4.0, 0.3]])
    hits = tracks.hits_on(DETECTOR, true)
    found = seeds(hits, [0, len(hits["kind"])], tracks.MUON)
    assert abs(found[0, 2]) < 2e-2
    assert np.all(np.abs(found - true)[0, [0, 1, 3, 4]] < NEAR[[0, 1, 3, 4]])


@pytest.mark.parametrize("name", ["noise", "wrong cluster"])
def test_wrong_hits_do_not_matter(name):
    """19 tracks of 20 start as near as clean ones, though every one has hits that are not its own."""
    assert np.all(np.quantile(of_scenario(name), 0.95, axis=0) < NEAR)


def test_all_clusters_wrong_is_seen():
    """Where no cluster is the track's own, a first helix that counts on them is off."""

    def all_wrong(_detector, hits, _random):
        for layer in range(3):
            hits = exchange_clusters(hits, layer, np.ones(len(hits.candidates), bool))
        return hits

    assert np.any(np.quantile(of_scenario("plain", spoil=all_wrong), 0.95, axis=0) > NEAR)


def test_slow_particles_start_with_what_they_had_at_the_origin():
    """The momentum lost in beam pipe and CGEM is put back; without a mass to reckon with it is missing."""
    kappa = 2
    reckoned, blind = (of_scenario("slow muons", mass=mass)[:, kappa] for mass in (None, 5e-4))
    assert np.quantile(reckoned, 0.68) < 0.07
    assert np.quantile(blind, 0.5) > 0.15


@pytest.mark.parametrize("number", [0, 1, 2, 5])
def test_too_few_points(number):
    """No helix goes through two points; five hits may or may not be enough."""
    hits = tracks.hits_on(DETECTOR, np.array([[0.3, 0.5, 1.0, 4.0, 0.3]]))
    few = {name: column[:number] for name, column in hits.items()}
    for source in (ALL, _core._testing.SeedFrom.wires, _core._testing.SeedFrom.azimuths):
        found = seeds(few, [0, number], tracks.MUON, source)
        assert np.isnan(found).all() or (number == 5 and np.isfinite(found).all())


def test_all_on_one_layer():
    """Many hits of one layer are no track: no helix, or some helix, but numbers."""
    layer = DETECTOR.drift_chamber.layers[10]
    n = 12
    hits = {
        "kind": np.full(n, 2, np.uint8), "layer": np.full(n, layer.number, np.int32),
        "channel": np.arange(n, dtype=np.int32), "size": np.zeros(n, np.int32),
        "value": np.full(n, 3.0), "sigma": np.full(n, 0.13), "side": np.zeros(n, np.int8),
    }  # fmt: skip
    for source in (ALL, _core._testing.SeedFrom.wires, _core._testing.SeedFrom.azimuths):
        found = seeds(hits, [0, n], tracks.MUON, source)
        assert np.isnan(found).all() or np.isfinite(found).all()
