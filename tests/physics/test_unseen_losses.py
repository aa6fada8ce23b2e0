"""Losses change the momentum by what the fit does not see of them, and matter behind the last hit changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

import cgemit as cg
from cgemit.detector import slabs
from cgemit.fit_matter import tuned
from cgemit.tables.schema import has_momentum
from cores import core_of
from pages.optimal import Hit, unseen
from stats import assert_within
from tracks import MUON, hits_on

COIL = {"r_out": "2300 mm", "half_length": "2500 mm", "material": "Cu"}
PARAMETERS = ("dr", "phi0", "kappa", "dz", "tanl", "p")


def expected(detector: cg.Detector, p: float, particle: str = "mu-") -> np.ndarray:
    """Return the expected errors of a particle across the beam."""
    found = cg.analytic(detector, particle, p=p, cos_theta=0.3)
    return np.array([found.sigma(name) for name in PARAMETERS])


@pytest.mark.parametrize("particle", ["mu-", "e+"])
@pytest.mark.parametrize(("name", "radius"), [("idea-like", "2250 mm"), ("besiii-cgem-design", "900 mm")])
def test_copper_behind_the_last_layer_changes_no_error(name: str, radius: str, particle: str) -> None:
    """Errors agree to 0.1 % with 5 cm of copper or more behind all measurements, and without."""
    plain = cg.load(name)
    coil = plain.with_overrides({"walls.coil": COIL | {"r_in": radius, "r_out": f"{int(radius[:-3]) + 50} mm"}})
    for p in (0.5, 1.0, 3.0):
        np.testing.assert_allclose(expected(coil, p, particle), expected(plain, p, particle), rtol=1e-3)
    assert tuned(coil).unseen[-1] == 0


def test_fitted_momenta_do_not_depend_on_matter_behind() -> None:
    """The same hits give the same tracks with a coil and without."""
    plain = cg.load("idea-like")
    coil = plain.with_overrides({"walls.coil": COIL | {"r_in": "2250 mm"}})
    hits = cg.run(plain, cg.Gun("mu-", p=1.0, cos_theta=0.0), n=200, seed=2)
    tables = (hits.clusters, hits.wire_hits, hits.candidates, hits.candidate_hits)
    one, other = (cg.fit(detector, *tables)["tracks"] for detector in (plain, coil))
    for name in ("p", "err_p", "err_kappa", "err_dr", "err_tanl"):
        np.testing.assert_allclose(one[name], other[name], rtol=1e-3)


@pytest.mark.parametrize("name", ["besiii-cgem-design", "besiii-idc"])
def test_shares_are_those_of_the_optimal_estimate(name: str) -> None:
    """A loss in one slab after the other, followed in plain numpy, changes the estimate of least squares as much."""
    detector = cg.load(name)
    helix = np.array([0.0, 0.1, -1.0, 0.0, 0.0])
    found = hits_on(detector, helix)
    sigma = np.array([0.1387, 0.1327, 0.13])[found["kind"]]
    hits = [Hit(*(int(found[key][i]) for key in ("kind", "layer", "channel")), sigma[i]) for i in range(len(sigma))]
    best = unseen(detector, hits, helix, MUON)
    shares = tuned(detector).unseen
    assert shares.shape == (len(slabs(detector)),)
    np.testing.assert_allclose(shares, np.abs(best), atol=0.03)
    assert np.any(np.abs(shares - 1) > 0.3)  # the whole track's matter, each slab's with weight 1, would be wrong


@pytest.mark.parametrize(("name", "p"), [("idea-like", 0.6), ("idea-like", 1.0), ("cepc-like", 0.9)])
def test_expected_momentum_errors_are_simulated_ones(name: str, p: float) -> None:
    """Where straggling is a large part of the error, the expected one is that of the core to 5 %."""
    n = 3000
    found = cg.run(name, cg.Gun("mu-", p=p, cos_theta=0.0), n, seed=12)
    good = has_momentum(found.tracks) & (found.matches["decayed"] == 0)
    core = core_of(1e3 * found.matches["res_p"][good], 3.0)
    wanted = float(cg.analytic(name, "mu-", p=p, cos_theta=0.0).sigma("p"))
    assert_within(core.width, wanted, np.hypot(core.error, 0.0125 * wanted), what="sigma(p)")
    pull = core_of(found.matches["pull_kappa"][good], 3.0)
    assert_within(pull.width, 1, np.hypot(pull.error, 0.0125), what="pull of kappa")
    coarse = cg.FitSettings(momentum_error=0.003)
    wrong = float(cg.analytic(name, "mu-", p=p, cos_theta=0.0, fit=coarse).sigma("p"))
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(core.width, wrong, np.hypot(core.error, 0.0125 * wrong))
