"""Clusters that delta electrons made longer: the fit knows what they are worth."""

import numpy as np
import pytest

import gem_toy
from cgemit.detector import load
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.fit import FitSettings, fit
from cgemit.simulation.digitize import digitize
from cgemit.simulation.transport import SimulateSettings, simulate
from cgemit.study import pulls, resolution
from cgemit.tables import Table
from cgemit.truth.finder import by_truth
from cgemit.truth.match import joined, match

DESIGN = load("besiii-cgem-design")
RATE, MOST = 0.04, 20  # one crossing in 25 gets strips beside it: k of 20 with a weight of 1/k
EVENTS = 5000


def with_deltas(tables, seed=6):
    """Add to some crossings a deposit along the circumference that begins on the track and goes to one side."""
    truths, rng = tables["truths"], np.random.default_rng(seed)
    link = np.flatnonzero(rng.random(len(truths)) < RATE)
    number = np.arange(1, MOST + 1)
    strips = rng.choice(number, len(link), p=(1 / number) / (1 / number).sum())
    anode = np.array([layer.r_readout for layer in DESIGN.cgem])[truths["layer"][link]]
    turn = rng.choice([-1, 1], len(link)) * 0.65 * strips / anode
    r = truths["r"][link]
    ends = [
        np.column_stack([r * np.cos(phi), r * np.sin(phi), truths["z"][link]])
        for phi in (truths["phi"][link], truths["phi"][link] + turn)
    ]
    columns = gem_toy.step_columns(truths, link, 0.5 * (ends[0] + ends[1]), ends[1] - ends[0])
    energy = truths["energy"] + np.bincount(link, minlength=len(truths))
    return tables | {
        "truths": truths.with_columns(energy=energy),
        "steps": Table("steps", columns, truths.n_events, truths.first_event),
    }


@pytest.fixture(scope="module")
def fitted():
    """Return a function that fits muons of 1 GeV/c with some settings, with and without added strips."""
    particles = generate(Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), EVENTS, seed=4)
    # Everything else is as the fit assumes.
    simulated = simulate(DESIGN, particles, SimulateSettings(fluctuations="gaussian", deltas=False), seed=4)
    prepared = {}
    for deltas in (True, False):
        tables = with_deltas(simulated) if deltas else simulated
        tables |= digitize(DESIGN, tables["truths"], tables["wire_truths"], seed=4, steps=tables["steps"])
        tables["clusters"] = cluster(DESIGN, tables["digis"])
        names = ("particles", "clusters", "wire_hits", "truths", "wire_truths")
        prepared[deltas] = tables, by_truth(DESIGN, *(tables[name] for name in names))

    def run(deltas, **settings):
        tables, found = prepared[deltas]
        hits = tables["clusters"], tables["wire_hits"]
        out = fit(DESIGN, *hits, *found.values(), FitSettings(residuals=True, **settings))
        of_truth = tables["particles"], tables["truths"], tables["wire_truths"]
        matches = match(out["tracks"], *found.values(), *hits, *of_truth, detector=DESIGN)["matches"]
        return out | {"tracks": joined(out["tracks"], matches)}

    return run


def hit_pulls(out, view):
    """Pulls of the clusters of a view to the track without them."""
    rows = out["residuals"]
    return rows["pull"][rows["view"] == view]


@pytest.mark.parametrize("view", [0, 1])
def test_pulls_of_clusters_stay_sane(fitted, view):
    """RMS 1 within 3 %, hardly a cluster beyond 5; a fit that knows of no delta electrons does several times worse."""
    pull, blind = (hit_pulls(fitted(True, outlier_pull=0, **how), view) for how in ({}, {"delta_strips": 0}))
    rms, blind_rms = (np.sqrt(np.mean(values**2)) for values in (pull, blind))
    assert abs(rms - 1) < 0.03 < abs(blind_rms - 1)
    beyond, blind_beyond = (np.mean(np.abs(values) > 5) for values in (pull, blind))
    assert beyond < 0.001
    assert blind_beyond > 4 * beyond


def test_pulls_of_tracks_stay_sane(fitted):
    """All five parameters; a fit that knows of no delta electrons fails in d_rho."""
    widths = pulls(fitted(True)["tracks"])
    for width in widths:
        assert abs(width.rms - 1) < 0.06, width
    assert pulls(fitted(True, delta_strips=0)["tracks"])["dr"].rms > 1.06


def test_core_resolutions_hardly_move(fitted):
    """Delta electrons widen the core of d_rho, d_z and p by less than 3 %: particles and noise are the same."""
    on, off = (fitted(deltas)["tracks"] for deltas in (True, False))
    for name in ("dr", "dz", "p"):
        assert resolution(on, name).core < 1.03 * resolution(off, name).core, name


def test_reckoning_with_delta_electrons_in_vain_costs_little(fitted):
    """Without any, the core of d_rho is at most 3 % wider than that of a fit that knows there are none."""
    width, knowing = (resolution(fitted(False, **how)["tracks"], "dr").core for how in ({}, {"delta_strips": 0}))
    assert knowing < width < 1.03 * knowing
