"""The fit's errors are those of the optimal linear estimate, worked out by other means (`validation/optimal.py`)."""

from __future__ import annotations

import numpy as np
import pytest

import plain_tracks
from cgemit import _core
from cgemit.chain import run
from cgemit.detector import compiled, load, slabs
from cgemit.fit import FitSettings
from cgemit.gun import Gun
from exact import EXACT
from fit_results import N_SIGMA, Point
from fit_samples import measure_point
from optimal import errors, optimum
from plain_tracks import Hit
from tracks import MUON, hits_on

CUTS = (_core.CORE_MEAN_CUT, _core.CORE_VARIANCE_CUT)
# p GeV/c, cos(theta): sigma of dr um, dz mm, p MeV/c; from an independent program: exact helix, one Highland logarithm
# for the track, no energy loss, X 138.7 um, V 132.7 um, wires 130 um, one hit a layer, mu-.
PUBLISHED = {
    "besiii-cgem-design": {
        (0.2, 0.0): (500.7, 0.634, 0.570),
        (0.5, 0.0): (247.4, 0.351, 1.716),
        (1.0, 0.0): (166.8, 0.263, 4.944),
        (1.5, 0.0): (137.0, 0.241, 9.872),
        (1.0, 0.6): (200.8, 0.325, 4.594),
        (1.0, 0.8): (261.0, 0.483, 4.421),
    },
    "besiii-cgem": {(1.0, 0.0): (170.2, 0.265, 4.948)},
    "besiii-idc": {(0.5, 0.0): (169.4, 0.996, 1.450), (1.0, 0.0): (108.9, 0.982, 4.185)},
}
POINTS = [(name, *point) for name, points in PUBLISHED.items() for point in points]


def track(name: str, p: float, cos_theta: float):
    """Return detector, helix and one hit a layer, with the errors of the read-out `gaussian`."""
    detector = load(name)
    sine = np.sqrt(1 - cos_theta**2)
    helix = np.array([0.0, 0.4, -1 / (p * sine), 0.0, cos_theta / sine])
    found = hits_on(detector, helix)
    sigma = np.array([0.1387, 0.1327, 0.13])[found["kind"]]
    hits = [Hit(*(int(found[name][i]) for name in ("kind", "layer", "element")), sigma[i]) for i in range(len(sigma))]
    return detector, helix, found | {"sigma": sigma}, hits


@pytest.mark.parametrize("cos_theta", [0.0, 0.5, 0.8])
@pytest.mark.parametrize("p", [0.2, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("name", ["besiii-cgem-design", "besiii-idc"])
def test_errors_are_optimal(name: str, p: float, cos_theta: float) -> None:
    """Errors of the fit equal those of generalised least squares with explicit scattering to 1 %.

    Rows and noise of the fit leave out that the loss depends on how obliquely matter is met; the rest agrees to 1e-4.
    """
    detector, helix, found, hits = track(name, p, cos_theta)
    best = optimum(detector, hits, helix, MUON, CUTS).cov
    settings = FitSettings()
    out = _core.fit(
        compiled(detector), hit_offsets=np.array([0, len(hits)]), hits=found, mass=np.array([MUON]), start=helix[None],
        settings=_core.FitSettings(max_iterations=20, tolerance=1e-6, errors_from_track=False, least_width=0.1,
                                   delta_strips=0.0, kinks=True, outlier_pull=0.0, prior_sigma=settings.prior_sigma),
        residuals=False,
    )  # fmt: skip
    np.testing.assert_allclose(np.sqrt(np.diag(out["cov"][0]) / np.diag(best)), 1, atol=0.01)
    for quantity, sigma in errors(helix, best).items():
        assert errors(out["helix"][0], out["cov"][0])[quantity] == pytest.approx(sigma, rel=2e-3), quantity


def matter_of_that_program(detector) -> dict[float, float]:
    """Return X/X0 of each slab by its radius; that program had a pipe of 0.982 % and layers as built."""
    thickness = {slab.radius: slab.x0 for slab in slabs(detector)}
    wanted = {(0, 40): 0.00982}
    if detector.cgem:
        wanted |= {(70, 100): 0.00521, (115, 140): 0.00457, (155, 180): 0.00601}
    for (low, high), total in wanted.items():
        inside = [radius for radius in thickness if low < radius < high]
        scale = total / sum(thickness[radius] for radius in inside)
        thickness |= {radius: scale * thickness[radius] for radius in inside}
    return thickness


@pytest.mark.parametrize(("name", "p", "cos_theta"), POINTS)
def test_optimum_is_the_published_one(name: str, p: float, cos_theta: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """With that matter, Highland's formula and no loss the optimum is within 1.5 % of another program's."""
    detector, helix, _, hits = track(name, p, cos_theta)
    thickness = matter_of_that_program(detector)
    total = float(np.hypot(1, helix[4])) * sum(thickness.values())
    beta2 = p * p / (p * p + MUON**2)

    def highland(slab, p_before, p_after, mass, path):
        logarithm = 1 + 0.038 * np.log(total / beta2)
        return 13.6e-3 / (p_before * np.sqrt(beta2)) * np.sqrt(thickness[slab.radius] * path) * logarithm

    monkeypatch.setattr(plain_tracks, "_angle", highland)
    monkeypatch.setattr(plain_tracks, "_core_loss", lambda slab, p, mass, path: (0 * p, 0 * p))
    found = errors(helix, optimum(detector, hits, helix, MUON, CUTS).cov)
    ours = np.array([1000 * found["dr"], found["dz"], 1000 * found["p"]])
    np.testing.assert_allclose(ours, PUBLISHED[name][p, cos_theta], rtol=0.015)


@pytest.mark.slow
@pytest.mark.parametrize(("p", "cos_theta"), [(0.2, 0.5), (1.0, 0.0)])
def test_found_widths_are_optimal(p: float, cos_theta: float) -> None:
    """Where all is Gaussian, core widths of fitted tracks are within 3 % of the optimum; pulls and residuals agree."""
    point = Point("gaussian", "besiii-cgem-design", "mu-", p, cos_theta)
    pulls, chi2, residuals, widths = measure_point(point, 8000, 2)
    assert {row.quantity for row in widths} == {"dr", "dz", "p"}
    assert len(residuals) == 3 + 3 + 35
    assert all(row.agrees for row in (*pulls, *residuals, *widths, chi2))


def test_gate_sees_wires_that_are_worse_than_believed() -> None:
    """The optimum for wires of 160 um is far from the widths found with 130 um."""
    detector = load("besiii-cgem-design")
    tracks = run(detector, Gun("mu-", p=1.0, cos_theta=0.0), 2000, seed=3, settings=EXACT).tracks
    _, helix, _, hits = track("besiii-cgem-design", 1.0, 0.0)
    wrong = [
        Hit(hit.kind, hit.layer, hit.element, 0.16 if hit.kind == plain_tracks.WIRE else hit.sigma) for hit in hits
    ]
    expected = errors(helix, optimum(detector, wrong, helix, MUON, CUTS).cov)["p"]
    assert tracks["res_p"].std() < 0.9 * expected


@pytest.mark.slow
def test_mean_pulls_where_the_error_depends_on_the_estimate() -> None:
    """Slow, slanting pions: the pulls of dz and tanl have the means that the optimal estimate must have, and not 0."""
    point = Point("gaussian", "besiii-cgem-design", "pi-", 0.2, 0.8)
    pulls = {row.parameter: row for row in measure_point(point, 40_000, None)[0]}
    for name in ("dz", "tanl"):
        row = pulls[name]
        assert abs(row.mean) > N_SIGMA * row.mean_error
        assert abs(row.mean - row.expected_mean) < N_SIGMA * row.mean_error
        assert abs(row.bias - row.expected_bias) < N_SIGMA * row.mean_error
