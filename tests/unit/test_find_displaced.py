"""The finder without truth: particles that start far from the beam line, and slow ones that stop or turn back."""

from math import gcd

import numpy as np
import pytest

import cgemit as cg
from cgemit.reconstruction.candidates import HIT_WIRE
from cgemit.simulation.background import BackgroundSettings

QUIET = cg.SimulateSettings(decays=False, fluctuations="gaussian")


def displaced(x, n=20, level="off", p=(0.15, 0.8)):
    """Pairs of pions from points on both sides of the beam line."""
    plus, minus = (
        cg.Gun(name, p=p, cos_theta=(-0.8, 0.8), vertex=(side * x, 0.0, 0.0))
        for name, side in (("pi+", 1), ("pi-", -1))
    )
    settings = cg.Settings(simulate=QUIET, background=BackgroundSettings(level=level))
    return cg.run("besiii-cgem", plus + minus, n=n, settings=settings, until="find", finder="ckf")


@pytest.fixture(scope="module")
def behind_all_layers():
    return displaced(180.0)


def hits_of(found):
    """The hits of each candidate, as a set of (event, hits)."""
    hits, events = found["candidate_hits"], found["candidates"]["event"]
    sets = [set() for _ in events]
    for candidate, view, row in zip(hits["candidate"], hits["view"], hits["row"], strict=True):
        sets[candidate].add((int(view), int(row)))
    return {(int(event), frozenset(rows)) for event, rows in zip(events, sets, strict=True)}


@pytest.mark.parametrize("x", [60.0, 105.0, 145.0])
def test_pions_from_between_the_layers(x):
    finding = cg.study.finding(displaced(x))
    rates = finding.rates()
    assert rates.efficiency.count == finding.findable.sum()
    assert finding.findable.sum() >= 39
    assert rates.fakes.count == rates.clones.count == 0
    assert finding.hit_efficiency > 0.95
    assert finding.purity > 0.99


def test_pions_from_behind_all_layers_have_hits_of_wires_alone(behind_all_layers):
    run = behind_all_layers
    finding = cg.study.finding(run)
    assert finding.rates().efficiency.count == finding.findable.sum() >= 39
    assert finding.rates().fakes.count == finding.rates().clones.count == 0
    # Of those that fly outward from their vertex, none has a cluster.
    outward = run.particles["x"] * run.particles["px"] > 0
    on_wires = run.candidate_hits["view"] == HIT_WIRE
    clusters = np.bincount(run.candidate_hits["candidate"][~on_wires], minlength=len(run.candidates))
    assert outward.sum() > 10
    assert (clusters[outward[finding.candidates.particle]] == 0).all()


def test_a_limit_of_the_distance_from_the_beam_line(behind_all_layers):
    run = behind_all_layers
    near = cg.find_tracks(run.detector, run.clusters, run.wire_hits, cg.FindSettings(max_d=20.0))
    # The distance of the closest approach is below 20 mm for about 7 % of the isotropic directions.
    assert len(near["candidates"]) < len(run.candidates) / 3


def test_displaced_tracks_with_background():
    finding = cg.study.finding(displaced(130.0, n=15, level="bes2009"))
    rates = finding.rates()
    assert rates.efficiency.count >= finding.findable.sum() - 1
    assert rates.fakes.count <= 1
    assert rates.clones.count == 0


def one_vertex(x, opening, n=10):
    """Two pions of 0.4 GeV/c from (x, 0, 0), whose paths cross 2.7 m sin(opening) behind it; truth finds."""
    plus, minus = (
        cg.Gun(name, p=0.4, cos_theta=0.1, phi=side * opening, vertex=(x, 0.0, 0.0))
        for name, side in (("pi+", -1), ("pi-", 1))
    )
    return cg.run("besiii-cgem", plus + minus, n=n, settings=cg.Settings(simulate=QUIET), until="find", finder="truth")


def found_in(run, clusters=None, wire_hits=None):
    """The metrics of what is found in the hits of a run, or in some of them."""
    tables = run.tables | {"clusters": clusters or run.clusters, "wire_hits": wire_hits or run.wire_hits}
    tables |= cg.find_tracks(run.detector, tables["clusters"], tables["wire_hits"])
    return cg.study.finding(cg.Result(**(vars(run) | {"tables": tables})))


@pytest.mark.parametrize("x", [60.0, 150.0])
@pytest.mark.parametrize("opening", [0.1, 0.6])
def test_two_tracks_of_a_vertex_beside_the_beam_line(x, opening):
    run = one_vertex(x, opening)
    wires = run.wire_truths
    cells = [
        set(zip(wires["event"][on], wires["layer"][on], wires["wire"][on], strict=True))
        for p in (0, 1)
        for on in [wires["particle"] == p]
    ]
    shared = np.bincount([event for event, *_ in cells[0] & cells[1]], minlength=10)
    assert (shared > 0).all() == (opening == 0.1)  # those of the smaller angle cross in the chamber
    finding = found_in(run)
    assert (finding.rates().efficiency.count, len(finding.candidates.hits)) == (20, 20)
    # A cell of both has the hit of one of them; all others belong to the particle.
    of = finding.candidates
    assert (of.hits - of.of_particle <= shared[of.particle // 2] + 1).all()
    assert (of.found >= 0.9 * finding.particles.hits[of.particle]).all()


def test_displaced_tracks_within_the_inner_chamber():
    """Layers below the closest approach to the beam line do not end the search for hits in those beyond it."""
    gun = cg.Gun("pi+", p=(0.3, 0.8), cos_theta=(-0.6, 0.6), phi=(1.2, 1.9), vertex=(130.0, 0.0, 0.0))
    run = cg.run("besiii-idc", gun, n=30, settings=cg.Settings(simulate=QUIET), until="find", finder="ckf")
    finding = cg.study.finding(run)
    assert finding.rates().efficiency.count >= 29
    assert finding.purity > 0.99


@pytest.mark.parametrize("dead", [(12, 13), (8, 17, 20, 30), (9, 10, 11)])
def test_displaced_tracks_across_dead_layers(dead):
    run = one_vertex(150.0, 0.6)
    finding = found_in(run, wire_hits=run.wire_hits[~np.isin(run.wire_hits["layer"], dead)])
    assert (finding.rates().efficiency.count, len(finding.candidates.hits)) == (20, 20)
    assert finding.hit_efficiency > 0.97
    assert finding.purity > 0.99


@pytest.mark.parametrize("dead", [1, 2])
def test_displaced_tracks_across_a_dead_cgem_layer(dead):
    run = one_vertex(60.0, 0.6)
    single = run.clusters["view"] < 2
    none = np.full(len(single), -1)
    clusters = run.clusters.with_columns(x_cluster=none, v_cluster=none)[single & (run.clusters["layer"] != dead)]
    finding = found_in(run, clusters)
    assert (finding.rates().efficiency.count, len(finding.candidates.hits)) == (20, 20)
    assert finding.hit_efficiency > 0.97


def test_displaced_tracks_turn_with_the_cells_and_with_charge_and_field(behind_all_layers):
    run = behind_all_layers
    straight = hits_of(cg.find_tracks(run.detector, run.clusters[:0], run.wire_hits))
    layers = {layer.number: layer.cells for layer in run.detector.drift_chamber.layers}
    period = gcd(*layers.values())
    cells = np.array([layers[number] for number in run.wire_hits["layer"]])
    wire = (run.wire_hits["wire"] + cells // period) % cells
    turned = run.wire_hits.with_columns(wire=wire.astype("i4"))
    other = run.detector.with_overrides({"field.bz": "1 T"})
    assert len(straight) >= 39
    assert period > 1
    assert hits_of(cg.find_tracks(run.detector, run.clusters[:0], turned)) == straight
    assert hits_of(cg.find_tracks(other, run.clusters[:0], run.wire_hits)) == straight


@pytest.mark.parametrize(("particle", "pt"), [("mu-", (0.044, 0.05)), ("pi+", (0.05, 0.055))])
def test_particles_that_stop_behind_the_last_layer(particle, pt):
    gun = cg.Gun(particle, pt=pt, cos_theta=(-0.8, 0.8))
    run = cg.run("besiii-cgem", gun, n=100, settings=cg.Settings(simulate=QUIET), until="find", finder="ckf")
    finding = cg.study.finding(run)
    without_wires = finding.findable & (finding.particles.wires == 0)
    assert without_wires.sum() > 5
    assert finding.found()[without_wires].mean() > 0.8
    assert finding.rates().efficiency.value > 0.93
    assert finding.rates().fakes.count == finding.rates().clones.count == 0


def test_particles_that_turn_back_in_the_first_axial_layers():
    gun = cg.Gun("pi-", pt=(0.056, 0.06), cos_theta=(-0.3, 0.3))
    run = cg.run("besiii-idc", gun, n=40, settings=cg.Settings(simulate=QUIET), until="find", finder="ckf")
    assert cg.study.finding(run).rates().efficiency.value > 0.9
