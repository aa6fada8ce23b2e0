"""Constants of drift times and of the Lorentz shift from 10 000 muons: by value, and with their errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

import cgemit as cg

NOMINAL = cg.load("besiii-cgem-design")
TRACKS = 10_000


@pytest.mark.slow
def test_drift_times_and_lorentz_shifts() -> None:
    """Zero times of wire layers to 0.1 ns, their relation to 10 um, Lorentz shifts to 10 um: errors, and errors made.

    The zero of all times is that of the outermost layer; layers are not turned.
    """
    random = np.random.default_rng(5)
    wrong = {f"drift_chamber.layers.{n}.t0": float(random.normal(0, 2)) for n in range(8, 42)}
    wrong |= {f"drift_chamber.drift_relation.{k}mm": float(random.normal(0, 2)) for k in range(1, 8)}
    wrong |= {f"cgem.L{k}.lorentz_shift": float(random.normal(0, 0.2)) for k in (1, 2, 3)}
    real = NOMINAL.with_alignment(wrong)
    muons = cg.Gun("mu-", p=(0.4, 1.5), cos_theta=(-0.8, 0.8))
    simulated = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian"))
    run = cg.run(real, muons, TRACKS, seed=7, fit_detector=NOMINAL, settings=simulated)
    settings = cg.AlignmentSettings(
        free=("drift_chamber.layers.*.t0",), calibrate=("relation", "lorentz"), fixed=("drift_chamber.layers.42.t0",)
    )
    found = cg.align(run, settings)
    assert found.converged
    assert found.zero_modes == ()
    error = found.solution.err
    apart = found.compare(real) * error
    names = found.solution.names
    # Times of the relation as distances: electrons drift by at most 0.045 mm in 1 ns.
    for key, limit in ((".t0", 0.1), ("mm", 0.010 / 0.045), ("lorentz_shift", 0.010)):
        rows = [i for i, name in enumerate(names) if name.endswith(key)]
        assert len(rows) >= 3
        assert error[rows].max() < limit, key
        assert np.abs(apart[rows]).max() < limit + 3 * error[rows].max(), key
    assert 1e-4 < chi2.sf(apart @ np.linalg.solve(found.cov, apart), len(names)) < 1 - 1e-4
    start = found.compare(NOMINAL) * error
    assert chi2.sf(start @ np.linalg.solve(found.cov, start), len(names)) < 1e-9
