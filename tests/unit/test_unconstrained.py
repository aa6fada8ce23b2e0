"""Fits that the hits do not constrain say so: a few clusters of a particle that stops behind the CGEM."""

import numpy as np
import pytest

import cgemit as cg
from cgemit import isa
from cgemit.reconstruction.fit import FitStatus

STOPPING = cg.Gun("p", p=(0.20, 0.26), cos_theta=(-0.3, 0.3))


@pytest.mark.slow
@pytest.mark.parametrize("name", isa.available())
def test_protons_that_stop_behind_the_cgem_are_unconstrained(name: str) -> None:
    before = isa.name()
    isa.use(name)
    try:
        tracks = cg.run("besiii-cgem-design", STOPPING, n=2000, seed=3, workers=1).tracks
    finally:
        isa.use(before)
    wide = tracks["err_p"] > 0.5 * tracks["p"]
    weak = tracks["status"] == FitStatus.unconstrained
    assert np.count_nonzero(weak) > 3
    assert np.array_equal(weak, wide & (tracks["n_wires"] == 0) & ((tracks["status"] == FitStatus.ok) | weak))
    assert np.isfinite(tracks["chi2"][weak]).all()
    assert np.isfinite(tracks["cov"][weak]).all()


def test_a_fast_muon_with_wires_is_not_called_unconstrained() -> None:
    """At 300 GeV/c the chamber measures the sign at best; the fit is what it is."""
    tracks = cg.run("besiii-cgem-design", cg.Gun("mu-", p=300.0, cos_theta=0.2), n=50, seed=3).tracks
    assert (tracks["err_p"] > 0.5 * tracks["p"]).any()
    assert not (tracks["status"] == FitStatus.unconstrained).any()
