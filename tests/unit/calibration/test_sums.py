"""Normal equations of constants: against dense matrices and finite differences of the predictions."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.calibration.constants import columns_of, constants_of
from cgemit.calibration.constraints import Quantities
from cgemit.calibration.sums import Sums, constrained, core_sums, expected_sums, fitted_sums
from cgemit.reconstruction.fit import FitSettings
from dense import HELICES, PRIOR, linear_model, smeared_track
from normal import derivatives, rigid, summed
from tracks import MUON

Floats = npt.NDArray[np.float64]


@pytest.mark.parametrize("scalar", [False, True])
@pytest.mark.parametrize("which", HELICES)
def test_sums_are_those_of_dense_matrices(which: str, scalar: bool) -> None:
    """N, b and B of one track with all displacements: dense weights, derivatives by finite differences."""
    detector, core, helix, hits = smeared_track("besiii-cgem-design", which)
    constants = rigid(detector)
    residual, rows, covariance = linear_model(detector, core, helix, hits)
    a = np.concatenate([derivatives(detector, helix, hits, constants), np.zeros((5, len(constants)))])
    inverse = np.linalg.inv(covariance)
    fitted = np.linalg.solve(rows.T @ inverse @ rows, rows.T @ inverse)
    weight = inverse - inverse @ rows @ fitted
    normal, right, bias = a.T @ weight @ a, a.T @ weight @ residual, (fitted @ a).T
    found = summed(core, detector, helix, hits, constants, scalar=scalar)
    assert found["used"][0] == 1
    assert found["hits"][0] == len(hits["kind"])
    scale = 1 / np.sqrt(np.sum(a[:-5] ** 2 / hits["sigma"][:, None] ** 2, axis=0))
    # The normal to a wire is that of a point which may be 1e-3 mm from the closest one, on a track of 0.6 m radius.
    np.testing.assert_allclose(found["measured"] * scale**2, 1, rtol=2e-6)
    np.testing.assert_allclose(found["normal"] * np.outer(scale, scale), normal * np.outer(scale, scale), atol=1e-6)
    size = np.sqrt(residual @ weight @ residual)
    np.testing.assert_allclose(found["right"] * scale, right * scale, atol=1e-6 * size)
    sigma = np.sqrt(np.diag(found["cov"][0]))
    np.testing.assert_allclose(
        found["bias"][0] * scale[:, None] / sigma, bias * scale[:, None] / sigma, atol=1e-6 * np.abs(bias / sigma).max()
    )
    assert found["chi2"][0] == pytest.approx(residual @ weight @ residual, rel=1e-6)


def test_wire_layers_and_their_ends_have_their_derivatives() -> None:
    """Of two stereo layers and the ends of their wires, to 1e-5, and the zeros of their drift times."""
    detector, core, helix, hits = smeared_track("besiii-cgem-design", "1 GeV/c")
    parts = ("drift_chamber.layers.23", "drift_chamber.layers.30")
    constants = tuple(one for one in constants_of(detector) if one.part in parts and one.unit in ("mm", "rad"))
    assert len(constants) == 24
    found = summed(core, detector, helix, hits, constants)["measured"]
    a = derivatives(detector, helix, hits, constants)
    np.testing.assert_allclose(found, np.sum(a**2 / hits["sigma"][:, None] ** 2, axis=0), rtol=1e-5)


def test_lengths_of_strip_patterns_have_their_derivatives() -> None:
    """Of each CGEM layer against finite differences of the predictions."""
    detector, core, helix, hits = smeared_track("besiii-cgem-design", "1 GeV/c")
    constants = tuple(one for one in constants_of(detector) if one.key == "z_scale")
    assert len(constants) == 3
    found = summed(core, detector, helix, hits, constants)
    a = derivatives(detector, helix, hits, constants)
    np.testing.assert_allclose(found["measured"], np.sum(a**2 / hits["sigma"][:, None] ** 2, axis=0), rtol=1e-5)
    assert (found["measured"] > 0).all()


def test_wrong_derivatives_are_seen() -> None:
    """With the point about which the chamber turns off by 1 mm the sums differ."""
    detector, core, helix, hits = smeared_track("besiii-cgem-design", "1 GeV/c")
    constants = rigid(detector)
    right = summed(core, detector, helix, hits, constants)["normal"]
    columns = columns_of(detector, constants)
    columns["chamber_shift"] = np.array([1.0, 0.0, 0.0])
    assert not np.allclose(columns["chamber_shift"], columns_of(detector, constants)["chamber_shift"])
    moved = detector.with_alignment({"drift_chamber.shift_x": 1.0})
    other = summed(core, moved, helix, hits, constants)["normal"]
    scale = 1 / np.sqrt(np.diag(right))
    assert np.abs((other - right) * np.outer(scale, scale)).max() > 1e-5


@pytest.fixture(scope="module")
def run() -> cg.Result:
    return cg.run(
        "besiii-cgem-design", cg.Gun("mu-", p=(0.3, 2.0), cos_theta=(-0.9, 0.9)), n=60, seed=4, readout="gaussian"
    )


def test_lanes_do_not_matter(run: cg.Result) -> None:
    """Sums over many tracks are those of the tracks one by one, on lanes and with the scalar code."""
    constants = rigid(run.detector)
    whole = fitted_sums(run.detector, run.tables, constants, run.settings.fit)
    one_by_one = Sums.none(run.detector, constants)
    for event in range(run.n_events):
        one = run.select_events(event, event + 1)
        one_by_one = one_by_one + fitted_sums(run.detector, one.tables, constants, run.settings.fit)
    scale = 1 / np.sqrt(np.maximum(whole.measured, 1e-300))
    assert whole.tracks == one_by_one.tracks > 55
    np.testing.assert_allclose(
        whole.normal * np.outer(scale, scale), one_by_one.normal * np.outer(scale, scale), atol=1e-7
    )
    np.testing.assert_allclose(whole.right * scale, one_by_one.right * scale, atol=1e-5)


def test_expected_tracks_have_the_information_of_fitted_ones() -> None:
    """With the same directions, known sides and Gaussian clusters, N of both differs by hits and scattering alone."""
    detector = cg.load("besiii-cgem-design").with_readout("gaussian")
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6))
    settings = cg.Settings(
        simulate=cg.SimulateSettings(fluctuations="gaussian"), digitize=cg.DigitizeSettings(reveal_sides=True)
    )
    run = cg.run(detector, gun, n=400, seed=4, settings=settings)
    constants = rigid(detector)
    fitted = fitted_sums(detector, run.tables, constants, FitSettings())
    expected = expected_sums(detector, gun, 400, constants, FitSettings(), seed=4, reveal_sides=True)
    ratio = np.diag(fitted.normal) / np.diag(expected.normal)
    assert abs(fitted.tracks - expected.tracks) <= 2
    np.testing.assert_allclose(ratio, 1, atol=0.01)


def test_constraints_are_least_squares() -> None:
    """Quantities with errors and known derivatives: N and b of weighted least squares."""
    random = np.random.default_rng(1)
    slope, roots = random.normal(size=(7, 4, 5)), random.normal(size=(7, 5, 5))
    cov, apart = roots @ roots.transpose(0, 2, 1) + np.eye(5), random.normal(size=(7, 5))
    found = constrained(Quantities(apart, cov, slope, np.arange(7)), np.inf)
    normal = sum(d @ np.linalg.inv(v) @ d.T for d, v in zip(slope, cov, strict=True))
    right = sum(d @ np.linalg.inv(v) @ q for d, v, q in zip(slope, cov, apart, strict=True))
    np.testing.assert_allclose(found.normal, normal, rtol=1e-10)
    np.testing.assert_allclose(found.right, right, rtol=1e-10, atol=1e-12)
    assert found.pairs == 7


def test_wrong_input_is_refused() -> None:
    detector, core, helix, hits = smeared_track("besiii-cgem-design", "1 GeV/c")
    constants = rigid(detector)
    columns = columns_of(detector, constants)
    with pytest.raises(ValueError, match="layers: no such column"):
        core_sums(core, columns | {"columns": 3}, *_one(core, helix, hits), list(PRIOR))
    with pytest.raises(ValueError, match="kappa other than 0"):
        core_sums(core, columns, *_one(core, helix * np.array([1, 1, 0, 1, 1]), hits), list(PRIOR))


def _one(core: _core.detector.Detector, helix: Floats, hits: dict[str, Any]) -> tuple[Any, ...]:
    n = len(hits["kind"])
    used = {"used": np.ones(n, np.uint8), "used_value": hits["value"], "used_variance": hits["sigma"] ** 2}
    given = {
        "reference": np.atleast_2d(helix), "kinks": np.zeros((1, 2 * core.n_slabs)), "mass": np.array([MUON]),
        "charge": np.ones(1), "matter_p": np.zeros(1), "start_radius": np.zeros(1),
    }  # fmt: skip
    return np.array([0, n]), hits | used, given, np.array([0])
