"""Dead and hot wires change nothing else."""

import tomllib

import numpy as np
import pytest

import cgemit as cg
from cgemit import Gun, load, run
from cgemit.detector import DetectorError
from cgemit.detector.core import wire_lists

DESIGN = load("besiii-cgem-design")


def test_dead_and_hot_wires():
    """Hits of some wires vanish, others fire in every event; no track takes either, and none is missed there."""
    plain = cg.load("besiii-cgem")
    changed = plain.with_overrides(
        {"drift_chamber.layers.12.dead": ["0-39"], "drift_chamber.layers.20.hot": ["5", "60-119"]}
    )
    assert load(tomllib.loads(changed.to_toml())) == changed
    gun, n = Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6)), 200
    for finder in ("truth", "ckf"):
        usual, found = (run(one, gun, n, seed=5, finder=finder) for one in (plain, changed))
        layer, wire = found.wire_hits["layer"], found.wire_hits["wire"]
        assert not ((layer == 12) & (wire < 40)).any()
        for one in (5, 60, 119):
            assert len(np.unique(found.wire_hits["event"][(layer == 20) & (wire == one)])) == n
        hits = found.candidate_hits["hit"][found.candidate_hits["view"] == 2]
        hot = (layer == 20) & ((wire == 5) | (wire >= 60) & (wire < 120))
        assert hot.sum() == 61 * n
        assert not hot[hits].any()
        taken = usual.wire_hits[usual.candidate_hits["hit"][usual.candidate_hits["view"] == 2]]
        dead = (taken["layer"] == 12) & (taken["wire"] < 40)
        masked = dead | (taken["layer"] == 20) & ((taken["wire"] == 5) | (taken["wire"] >= 60) & (taken["wire"] < 120))
        assert masked.sum() > 30
        assert len(hits) == pytest.approx(len(taken) - masked.sum(), abs=5)
        assert np.count_nonzero(found.tracks["status"] == 0) == np.count_nonzero(usual.tracks["status"] == 0)
    strips = lists_of(changed)
    assert (len(strips.dead), len(strips.hot)) == (40, 61)


def lists_of(detector):
    return wire_lists(detector.drift_chamber)


def test_the_covariance_knows_dead_wires():
    """Without the wires of six layers as without these layers, but for their gas; without all hits of others: more."""
    few = {
        f"drift_chamber.layers.{n}.dead": [f"0-{DESIGN.drift_chamber.layers[n - 8].cells - 1}"] for n in range(36, 42)
    }
    dead = DESIGN.with_overrides(few)
    silent = DESIGN.with_overrides({f"drift_chamber.layers.{n}.efficiency": 0.0 for n in range(36, 42)})
    expected, found, full = (cg.analytic(one, "mu-", p=[0.3, 1.0], cos_theta=0.2) for one in (silent, dead, DESIGN))
    np.testing.assert_allclose(found.sigma("p"), expected.sigma("p"), rtol=1e-12)
    assert (found.sigma("p") > 1.04 * full.sigma("p")).all()


def test_mistakes_of_dead_and_hot_wires():
    changes = {
        "drift_chamber.layers.9.dead": ["0:3", "5"], "drift_chamber.layers.10.dead": ["7-3"],
        "drift_chamber.layers.11.hot": ["5000"], "drift_chamber.layers.12.hot": "5",
    }  # fmt: skip
    with pytest.raises(DetectorError) as caught:
        DESIGN.with_overrides(changes)
    assert sorted(problem.path for problem in caught.value.problems) == [
        "drift_chamber.layers.10.dead[0]", "drift_chamber.layers.11.hot[0]", "drift_chamber.layers.12.hot",
        "drift_chamber.layers.9.dead[0]",
    ]  # fmt: skip
