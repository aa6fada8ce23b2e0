"""The fit's errors are those of the optimal linear estimate, worked out by other means (`pages/optimal.py`)."""

from __future__ import annotations

import numpy as np
import pytest

from cgemit import _core
from cgemit.chain.run import run
from cgemit.detector import load
from cgemit.fit_matter import tuned
from cgemit.helix import RADIUS_PER_KAPPA
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import FitSettings
from exact import exact
from pages.fit import N_SIGMA, Point, measure_point
from pages.linear_table import TABLE, lossless_stack, table_stack
from pages.optimal import WIRE, Hit, Stack, errors, optimum
from tracks import MUON, hits_on

pytestmark = pytest.mark.slow

POINTS = [(name, *point) for name, points in TABLE.items() for point in points]


def track(name: str, p: float, cos_theta: float):
    """Return detector, helix and one hit a layer, with the errors of the readout `gaussian`."""
    detector = load(name)
    sine = np.sqrt(1 - cos_theta**2)
    helix = np.array([0.0, 0.4, -1 / (p * sine), 0.0, cos_theta / sine])
    found = hits_on(detector, helix)
    sigma = np.array([0.1387, 0.1327, 0.13])[found["kind"]]
    hits = [Hit(*(int(found[name][i]) for name in ("kind", "layer", "channel")), sigma[i]) for i in range(len(sigma))]
    return detector, helix, found | {"sigma": sigma}, hits


@pytest.mark.parametrize("cos_theta", [0.0, pytest.param(0.5, marks=pytest.mark.slow), 0.8])
@pytest.mark.parametrize("p", [0.2, *(pytest.param(p, marks=pytest.mark.slow) for p in (0.5, 1.0)), 2.0])
@pytest.mark.parametrize("name", ["besiii-cgem-design", "besiii-idc"])
def test_errors_are_optimal(name: str, p: float, cos_theta: float) -> None:
    """Errors of the fit equal those of generalised least squares with explicit scattering to 1 %.

    Rows and noise of the fit leave out that the loss depends on how obliquely matter is met; the rest agrees to 1e-4.
    """
    detector, helix, found, hits = track(name, p, cos_theta)
    best = optimum(detector, hits, helix, MUON).cov
    settings = FitSettings()
    out = _core.reconstruction.fit(
        tuned(detector), hit_offsets=np.array([0, len(hits)]), hits=found, mass=np.array([MUON]), start=helix[None],
        settings={
            "max_iterations": 20, "tolerance": 1e-6, "errors_from_track": False, "least_width": 0.1,
            "delta_strips": 0.0, "kinks": True, "outlier_pull": 0.0, "prior_sigma": settings.prior_sigma,
            "momentum": 1.0, "beam": (0.0, 0.0),
        },
        residuals=False,
    )  # fmt: skip
    np.testing.assert_allclose(np.sqrt(np.diag(out["cov"][0]) / np.diag(best)), 1, atol=0.01)
    for quantity, sigma in errors(helix, best).items():
        assert errors(out["helix"][0], out["cov"][0])[quantity] == pytest.approx(sigma, rel=2e-3), quantity


def test_bias_is_the_same_at_the_edge_of_a_sheet() -> None:
    """Tracks on both sides of the edge, where X begins anew, are as near to each other as elsewhere."""
    detector, helix, _, hits = track("besiii-cgem-design", 0.3, 0.0)
    hits = [hit for hit in hits if hit.kind != WIRE]
    layer, edge = detector.cgem[2], detector.cgem[2].sheet_phi[hits[-1].channel]
    half_turn = np.arcsin(0.5 * layer.r_mid * helix[2] * detector.field.bz / RADIUS_PER_KAPPA)
    expected = optimum(detector, hits, helix, MUON).bias
    for beside in (-1e-3, 0.0):
        turned = helix.copy()
        turned[1] = edge + beside - 0.5 * np.pi + half_turn
        np.testing.assert_allclose(optimum(detector, hits, turned, MUON).bias, expected, atol=1e-6)


def of_the_table(name: str, p: float, cos_theta: float, matter: Stack) -> np.ndarray:
    """Return the optimum over the table's numbers, with one hit a layer."""
    detector, helix, _, hits = track(name, p, cos_theta)
    found = errors(helix, optimum(detector, hits, helix, MUON, matter=matter).cov)
    return np.array([1000 * found["dr"], found["dz"], 1000 * found["p"]]) / TABLE[name][p, cos_theta]


@pytest.mark.parametrize(("name", "p", "cos_theta"), POINTS)
def test_optimum_is_that_of_the_table(name: str, p: float, cos_theta: float) -> None:
    """With the table's matter, Highland's formula and no loss the optimum is within 2 % of another program's."""
    assert of_the_table(name, p, cos_theta, table_stack) == pytest.approx([1.0, 1.0, 1.0], abs=0.02)


def test_the_gate_sees_the_model() -> None:
    """With scattering from elements sigma(p) is off by more; so is d_rho with foils of 5 um of copper for 2 um."""
    assert of_the_table("besiii-cgem-design", 0.5, 0.0, lossless_stack)[2] < 0.97
    dr, _, _ = of_the_table("besiii-cgem", 1.0, 0.0, table_stack)
    published = {name: TABLE[name][1.0, 0.0][0] for name in ("besiii-cgem", "besiii-cgem-design")}
    assert dr * published["besiii-cgem"] / published["besiii-cgem-design"] > 1.04


@pytest.mark.slow
@pytest.mark.parametrize(("p", "cos_theta"), [(0.2, 0.5), (1.0, 0.0)])
def test_found_widths_are_optimal(p: float, cos_theta: float) -> None:
    """Where all is Gaussian, core widths of fitted tracks are within 3 % of the optimum; pulls and residuals agree."""
    point = Point("gaussian", "besiii-cgem-design", "mu-", p, cos_theta)
    pulls, chi2, residuals, widths = measure_point(point, 8000, 2, some=3)
    assert {row.quantity for row in widths} == {"dr", "dz", "p"}
    assert len(residuals) == 3 + 3 + 35
    assert all(row.agrees for row in (*pulls, *residuals, *widths, chi2))


def test_gate_sees_wires_that_are_worse_than_believed() -> None:
    """The optimum for wires of 160 um is far from the widths found with 130 um."""
    detector = load("besiii-cgem-design")
    tracks = run(detector, Gun("mu-", p=1.0, cos_theta=0.0), 2000, seed=3, **exact()).tracks
    _, helix, _, hits = track("besiii-cgem-design", 1.0, 0.0)
    wrong = [Hit(hit.kind, hit.layer, hit.channel, 0.16 if hit.kind == WIRE else hit.sigma) for hit in hits]
    expected = errors(helix, optimum(detector, wrong, helix, MUON).cov)["p"]
    assert tracks["res_p"].std() < 0.9 * expected


@pytest.mark.slow
def test_mean_pulls_where_the_error_depends_on_the_estimate() -> None:
    """Slow, slanting pions: the pulls of dz and tanl have the means that the optimal estimate must have, and not 0."""
    point = Point("gaussian", "besiii-cgem-design", "pi-", 0.2, 0.8)
    pulls = {row.parameter: row for row in measure_point(point, 40_000, None, some=1)[0]}
    for name in ("dz", "tanl"):
        row = pulls[name]
        assert abs(row.mean) > N_SIGMA * row.mean_error
        assert abs(row.mean - row.expected_mean) < N_SIGMA * row.mean_error
        assert abs(row.bias - row.expected_bias) < N_SIGMA * row.mean_error
