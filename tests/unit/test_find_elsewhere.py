"""The finder in detectors that are not BESIII's, and at the seams of sheets."""

import dataclasses

import numpy as np
import pytest

import cgemit as cg

DESIGN = cg.load("besiii-cgem-design")
SETTINGS = cg.Settings(simulate=cg.SimulateSettings(decays=False))
ANGLES = {"p": (0.2, 2.0), "cos_theta": (-0.8, 0.8)}


def five_layers():
    layers = {"cgem.L4": cg.like("L3", anode_radius="250 mm"), "cgem.L5": cg.like("L3", anode_radius="320 mm")}
    return dataclasses.replace(DESIGN, drift_chamber=None, walls=()).with_overrides(layers)


@pytest.mark.parametrize(
    "detector", [five_layers(), dataclasses.replace(DESIGN, cgem=())], ids=["five CGEM layers", "outer chamber"]
)
def test_every_track_is_found_without_new_numbers(detector):
    """Five CGEM layers without a chamber, and the outer chamber alone."""
    gun = cg.Gun("mu-", **ANGLES) + cg.Gun("pi+", **ANGLES)
    finding = cg.study.finding(cg.run(detector, gun, 150, 3, settings=SETTINGS, finder="ckf", until="find"))
    rates = finding.rates()
    assert finding.findable.all()
    assert (rates.efficiency.count, rates.fakes.count, rates.clones.count) == (300, 0, 0)
    assert finding.purity > 0.999
    assert finding.hit_efficiency > 0.99


def test_a_track_through_the_gap_at_a_seam():
    """It has no cluster in that layer, and all of its other hits."""
    detector = DESIGN.with_overrides({"cgem.L2.dead_seam": "8 mm"})
    seam = detector.cgem[1].sheet_phi[0]
    gun = cg.Gun("mu-", p=(1.0, 2.0), cos_theta=(-0.8, 0.8), phi=(seam - 0.1, seam + 0.1))
    result = cg.run(detector, gun, 200, 5, settings=SETTINGS, finder="ckf", until="find")
    clusters = result.clusters
    crossed = np.unique(clusters["event"][(clusters["layer"] == 1) & (clusters["view"] < 2)])
    lost = np.setdiff1d(np.arange(200), crossed)
    assert 20 < len(lost) < 180
    finding = cg.study.finding(result)
    assert finding.found()[np.isin(result.particles["event"], lost)].all()
    assert (finding.purity, finding.rates().fakes.count, finding.rates().clones.count) == (1, 0, 0)
    layers = clusters["layer"][result.candidate_hits["row"][result.candidate_hits["view"] < 2]]
    events = result.candidates["event"][result.candidate_hits["candidate"][result.candidate_hits["view"] < 2]]
    for event in lost:  # the seams of the other layers are near: some tracks miss one of them, too
        left = set(clusters["layer"][clusters["event"] == event])
        assert set(layers[events == event]) == left
        assert left <= {0, 2}
