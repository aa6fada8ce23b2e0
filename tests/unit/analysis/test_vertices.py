"""True values of vertices: by hand, for particles of every number, and none where a track has no particle."""

from __future__ import annotations

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.vertices import with_truth

MUON = 0.1056583755  # GeV/c2, PDG 2024


@pytest.fixture(scope="module")
def run() -> cg.Result:
    """Two events of muons 0 and 1 that leave one point at right angles."""
    gun = {"p": 1.0, "cos_theta": 0.0, "vertex": (1.0, -2.0, 3.0)}
    return cg.run("besiii-cgem-design", cg.Gun("mu+", phi=0.0, **gun) + cg.Gun("mu-", phi="90 deg", **gun), n=2, seed=1)


def test_truth_by_hand(run: cg.Result) -> None:
    """The mass of two particles of energy E and momenta at right angles is sqrt(4 E^2 - 2 p^2)."""
    vertices = cg.fit_vertices(run.detector, run.fitted, particles=("mu", "mu"))
    assert vertices["status"].tolist() == [0, 0]
    found = with_truth(vertices, run.fitted, run.matches, run.particles)
    mass = np.sqrt(4 * (1 + MUON**2) - 2)
    for name, true in {"x": 1.0, "y": -2.0, "z": 3.0, "mass": mass}.items():
        np.testing.assert_allclose(found[f"truth_{name}"], true, rtol=1e-9)
        np.testing.assert_allclose(found[f"res_{name}"], vertices[name] - true, rtol=1e-9)
        np.testing.assert_allclose(found[f"pull_{name}"], found[f"res_{name}"] / vertices[f"err_{name}"], rtol=1e-9)


def test_no_truth_without_a_particle(run: cg.Result) -> None:
    """Particle -1 of the second event has not the number of the last one of the first event."""
    vertices = cg.fit_vertices(run.detector, run.fitted, particles=("mu", "mu"))
    particle = run.matches["particle"].copy()
    assert particle.tolist() == [0, 1, 0, 1]
    particle[2] = -1
    found = with_truth(vertices, run.fitted, run.matches.with_columns(particle=particle), run.particles)
    assert np.isfinite(found["truth_x"]).tolist() == [True, False]
