"""Constraints between fitted tracks: against dense least squares with all tracks at once, and what they determine."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import cgemit as cg
from cgemit import helix
from cgemit.calibration.constants import constants_of
from cgemit.calibration.constraints import Quantities, known_tracks, quantities
from cgemit.calibration.sums import constrained, fitted_sums
from dense import HELICES, linear_model, smeared_track
from normal import derivatives, summed
from tracks import MUON

Floats = npt.NDArray[np.float64]
NOMINAL = cg.load("besiii-cgem-design").with_readout("gaussian")
EVERYTHING = ("cgem.*", "drift_chamber")
TILTS = ("drift_chamber.tilt_*", "cgem.*.tilt_*")


@pytest.fixture(scope="module")
def pair() -> tuple[Any, ...]:
    """Two tracks with their dense models, as if of one event, and what the core makes of them."""
    models, sums, dense = [], [], []
    for which in list(HELICES)[:2]:
        detector, core, track, hits = smeared_track("besiii-cgem-design", which)
        constants = tuple(one for one in constants_of(detector) if one.part in ("cgem.L1", "cgem.L2", "drift_chamber"))
        constants = tuple(one for one in constants if one.unit in ("mm", "rad") and "lorentz" not in one.name)
        residual, rows, cov = linear_model(detector, core, track, hits)
        a = np.concatenate([derivatives(detector, track, hits, constants), np.zeros((5, len(constants)))])
        models.append((track, constants))
        dense.append((residual, rows, cov, a))
        sums.append(summed(core, detector, track, hits, constants))
    found = {name: np.concatenate([one[name] for one in sums]) for name in ("helix", "cov", "bias", "used")}
    return found, sums, dense, models


#: Error of quantities that are exact, which the dense inverse needs: mm, rad ...
_LOOSE = 1e-4


def loosened(one: Quantities) -> Quantities:
    return replace(one, cov=one.cov + _LOOSE**2 * np.eye(one.apart.shape[1]))


def together(
    dense: list[tuple[Floats, Floats, Floats, Floats]], jacobian: Floats, values: Floats, spread: Floats, cov: Floats
) -> tuple[Floats, Floats]:
    """Return N and b of least squares with the helices of all tracks at once.

    `values` (k,) of quantities at the references, with derivatives (k, 5 tracks) by the helices, which are `spread`
    (k, m) times numbers of covariance `cov` (m, m).
    """
    k, m = spread.shape
    tracks = len(dense)
    rows = sum(len(one[0]) for one in dense) + k + m
    residual, design, weight = np.zeros(rows), np.zeros((rows, 5 * tracks + m)), np.zeros((rows, rows))
    a = np.zeros((rows, dense[0][3].shape[1]))
    at = 0
    for i, (its_residual, its_rows, its_cov, its_a) in enumerate(dense):
        part = slice(at, at + len(its_residual))
        residual[part], design[part, 5 * i : 5 * i + 5] = its_residual, its_rows
        weight[part, part], a[part] = np.linalg.inv(its_cov), its_a
        at += len(its_residual)
    quantity, point = slice(at, at + k), slice(at + k, at + k + m)
    residual[quantity] = -values
    design[quantity] = np.concatenate([jacobian, -spread], axis=1)
    weight[quantity, quantity] = np.eye(k) / _LOOSE**2
    design[point, 5 * tracks :], weight[point, point] = np.eye(m), np.linalg.inv(cov)
    scale = 1 / np.sqrt(np.diagonal(design.T @ weight @ design))
    design = design * scale
    inner = np.linalg.inv(design.T @ weight @ design)
    whole = weight - weight @ design @ inner @ design.T @ weight
    return a.T @ whole @ a, a.T @ whole @ residual


def test_a_common_vertex_is_that_of_dense_matrices(pair: tuple[Any, ...]) -> None:
    """N and b of both tracks from one point on the beam line, to 1e-5 of the information with known tracks."""
    found, sums, dense, models = pair
    settings = cg.AlignmentSettings(pairs=("vertex", "beam_line"), beam_width=(0.5, 0.2))
    event, mass, charge = np.zeros(2, np.int64), np.full(2, MUON), np.ones(2)
    (one,) = quantities(found, event, mass, charge, settings)
    assert one.apart.shape == (1, 4)
    added = constrained(loosened(one), np.inf)
    phi, tanl = found["helix"][:, 1], found["helix"][:, 4]
    jacobian, spread = np.zeros((4, 10)), np.zeros((4, 3))
    values = np.zeros(4)
    for i in range(2):
        jacobian[i, 5 * i], jacobian[2 + i, 5 * i + 3] = 1, 1
        spread[i] = np.cos(phi[i]), np.sin(phi[i]), 0
        spread[2 + i] = tanl[i] * np.sin(phi[i]), -tanl[i] * np.cos(phi[i]), 1
        values[i], values[2 + i] = models[i][0][0], models[i][0][3]
    normal, right = together(dense, jacobian, values, spread, np.diag([0.5, 0.2, 100.0]) ** 2)
    scale = 1 / np.sqrt(sum(part["measured"] for part in sums))
    mine = sum(part["normal"] for part in sums) + added.normal
    np.testing.assert_allclose(mine * np.outer(scale, scale), normal * np.outer(scale, scale), atol=1e-5)
    alone = sum(part["normal"] for part in sums)
    assert np.abs((mine - alone) * np.outer(scale, scale)).max() > 1e-3  # it matters
    size = np.sqrt(sum(part["chi2"][0] for part in sums))
    mine = sum(part["right"] for part in sums) + added.right
    np.testing.assert_allclose(mine * scale, right * scale, atol=1e-4 * size)


def test_a_mass_has_its_derivatives(pair: tuple[Any, ...]) -> None:
    """The last row of the quantities: the invariant mass, and by finite differences its change with the helices."""
    found, _, _, _ = pair
    settings = cg.AlignmentSettings(pairs=("mass",), mass=0.5, mass_width=0.01)
    event, mass, charge = np.zeros(2, np.int64), np.full(2, MUON), np.ones(2)

    def apart(helices: Floats) -> tuple[float, Quantities]:
        (one,) = quantities({**found, "helix": helices}, event, mass, charge, settings)
        return float(one.apart[0, 0]), one

    value, one = apart(found["helix"])
    p = helix.momentum_vector(found["helix"])
    energy = np.sqrt(np.sum(p**2, axis=1) + MUON**2)
    assert value + 0.5 == pytest.approx(np.sqrt(energy.sum() ** 2 - np.sum(p.sum(axis=0) ** 2)), rel=1e-12)
    variance, slope = 0.01**2, np.zeros(found["bias"].shape[1])
    jacobian = np.zeros(10)
    for i in range(10):
        step = np.zeros((2, 5))
        step[i // 5, i % 5] = 1e-6
        jacobian[i] = (apart(found["helix"] + step)[0] - apart(found["helix"] - step)[0]) / 2e-6
    for track in range(2):
        own = jacobian[5 * track : 5 * track + 5]
        variance += own @ found["cov"][track] @ own
        slope += found["bias"][track] @ own
    assert one.cov[0, 0, 0] == pytest.approx(variance, rel=1e-5)
    np.testing.assert_allclose(one.slope[0, :, 0], slope, rtol=1e-5, atol=1e-9 * np.abs(slope).max())


def test_known_tracks_are_that_of_dense_matrices(pair: tuple[Any, ...]) -> None:
    found, sums, dense, models = pair
    cov = np.array([np.diag([0.1, 1e-3, 0.01, 0.2, 1e-3]) ** 2] * 2)
    known = np.stack([one[0] for one in models])  # the references themselves
    cov[1], known[1] = np.nan, np.nan  # not known
    (one,) = known_tracks(found, np.zeros(2, np.int64), known, cov)
    added = constrained(loosened(one), np.inf)
    normal, _ = together(dense[:1], np.eye(5), np.zeros(5), np.eye(5), cov[0])
    scale = 1 / np.sqrt(sums[0]["measured"])
    mine = sums[0]["normal"] + added.normal
    np.testing.assert_allclose(mine * np.outer(scale, scale), normal * np.outer(scale, scale), atol=1e-5)


def resonance(n: int, mass: float = 3.0969) -> dict[str, Any]:
    """Return pairs of muons of this mass, moving slowly."""
    random = np.random.default_rng(7)
    cosine, phi = random.uniform(-0.7, 0.7, n), random.uniform(-np.pi, np.pi, n)
    sine, p = np.sqrt(1 - cosine**2), np.sqrt(mass**2 / 4 - MUON**2)
    momenta = p * np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=1)
    momenta = np.concatenate([momenta, -momenta])
    of_pair = {"event": np.tile(np.arange(n), 2), "pdg": np.repeat([13, -13], n)}
    return of_pair | dict(zip(("px", "py", "pz"), momenta.T, strict=True))


def pairs(n: int, seed: int, real: cg.Detector = NOMINAL, fit: cg.Detector = NOMINAL) -> cg.Result:
    both = cg.Gun("mu-", p=0.6, cos_theta=(-0.7, 0.7)) + cg.Gun("mu+", p=(0.4, 1.2), cos_theta=(-0.7, 0.7))
    settings = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian"))
    return cg.run(real, both, n=n, seed=seed, fit_detector=fit, settings=settings)


def test_the_beam_line_tells_where_the_detector_is_across_it() -> None:
    """Of the four displacements of everything it determines two, to the width of the beam over the root of tracks."""
    real = NOMINAL.with_alignment(
        {f"{part}.shift_x": 0.3 for part in ("cgem.L1", "cgem.L2", "cgem.L3", "drift_chamber")}
    )
    run = pairs(150, 3, real)
    free = cg.align(run, cg.AlignmentSettings(free=EVERYTHING, fixed=TILTS, pairs=()))
    assert set(free.zero_modes) == {"common shift_x", "common shift_y", "common shift_z", "common rotation"}
    found = cg.align(run, cg.AlignmentSettings(free=EVERYTHING, fixed=TILTS, pairs=("beam_line", "vertex")))
    assert set(found.zero_modes) == {"common shift_z", "common rotation"}
    pulls = found.compare(real)
    across = [i for i, name in enumerate(found.solution.names) if name.endswith(("shift_x", "shift_y"))]
    # The rotation of all, of which nothing is known, turns the shift of the chamber along y, too.
    assert np.nanmax(np.abs(pulls[across])) < 4
    assert np.isfinite(pulls[across]).sum() >= 7
    assert np.nanmax(np.abs(found.compare(NOMINAL)[across])) > 6


def test_a_vertex_adds_information() -> None:
    run = pairs(60, 4)
    constants = tuple(one for one in constants_of(NOMINAL) if one.part in ("cgem.L1", "cgem.L2", "cgem.L3"))[:6]
    alone = fitted_sums(NOMINAL, run.tables, constants, run.settings.fit)
    joined = fitted_sums(
        NOMINAL, run.tables, constants, run.settings.fit, settings=cg.AlignmentSettings(pairs=("vertex",))
    )
    assert joined.pairs > 50
    gain = np.linalg.eigvalsh(joined.normal - alone.normal)
    assert gain.min() > -1e-6 * gain.max()
    ndf = joined.chi2 - alone.chi2
    assert abs(ndf - joined.pairs) < 4 * np.sqrt(2 * joined.pairs)  # one for each pair: two lines meet


def test_tracks_that_do_not_belong_together_are_left_out() -> None:
    """Every sixth event has a second muon from 20 mm beside the beam line; the others tell where the detector is."""
    real = NOMINAL.with_alignment(
        {f"{part}.shift_x": 0.3 for part in ("cgem.L1", "cgem.L2", "cgem.L3", "drift_chamber")}
    )
    muons = resonance(90)
    muons["x"] = np.where((muons["event"] % 6 == 0) & (muons["pdg"] < 0), 20.0, 0.0)
    simulated = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian"))
    run = cg.run(real, muons, seed=9, fit_detector=NOMINAL, settings=simulated)
    settings = cg.AlignmentSettings(free=EVERYTHING, fixed=TILTS, pairs=("vertex", "beam_line"))
    found = cg.align(run, settings)
    assert found.converged
    assert found.history[0].left_out >= 10  # without a cut: those that are ten times the median apart
    assert 14 <= found.history[-1].left_out <= 17
    assert all(one.left_out + one.pairs <= 90 for one in found.history)
    assert f"{found.history[-1].left_out} of" in found.note()
    across = [i for i, name in enumerate(found.solution.names) if name.endswith("shift_x")]
    assert np.nanmax(np.abs(found.compare(real)[across])) < 4


def test_constants_that_lose_their_tracks_stay_as_described() -> None:
    """All muons come from 20 mm beside the beam line: only the first iteration, without a cut, joins them to it."""
    muons = resonance(60)
    muons["x"] = np.where(muons["pdg"] < 0, 20.0, 0.0)
    run = cg.run(NOMINAL, muons, seed=9)
    settings = cg.AlignmentSettings(free=EVERYTHING, fixed=TILTS, pairs=("vertex", "beam_line"), iterations=4)
    found = cg.align(run, settings)
    assert found.history[0].pairs > 50
    assert found.history[-1].left_out > 50
    assert {"common shift_x", "common shift_y"} <= set(found.zero_modes)
    assert found.detector.drift_chamber is not None
    assert found.detector.drift_chamber.shift_y == 0
    assert found.at_limits == ()
    assert found.p_value > 1e-4


def test_a_mass_tells_the_scale_of_the_field() -> None:
    """Pairs of muons of the mass of a resonance; the description has a field that is 0.5 % too weak."""
    wrong = NOMINAL.with_alignment({"field.scale": -5e-3})
    simulated = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian"))
    run = cg.run(NOMINAL, resonance(200), seed=6, fit_detector=wrong, settings=simulated)
    alone = cg.align(run, cg.AlignmentSettings(free=("field.scale",), pairs=()))
    assert alone.zero_modes == ("field.scale",)
    found = cg.align(run, cg.AlignmentSettings(free=("field.scale",), pairs=("mass",), mass=3.0969))
    assert found.zero_modes == ()
    assert abs(found.table.value[0] - 5e-3) < 4 * found.table.err[0]
    assert found.table.err[0] < 1e-3


def test_known_tracks_tell_where_the_detector_is() -> None:
    """Tracks of the same hits fitted with the true detector: every displacement has a number, and the right one."""
    real = NOMINAL.with_alignment(
        {f"{part}.shift_z": 0.5 for part in ("cgem.L1", "cgem.L2", "cgem.L3", "drift_chamber")}
    )
    run = pairs(60, 8, real)
    hits = (run.clusters, run.wire_hits, run.candidates, run.candidate_hits)
    known = cg.fit(real, *hits, run.settings.fit)["tracks"]
    tables = dict(zip(("clusters", "wire_hits", "candidates", "candidate_hits"), hits, strict=True)) | {
        "reference": known
    }
    settings = cg.AlignmentSettings(free=("cgem.*", "drift_chamber"), fixed=TILTS, pairs=())
    found = cg.align(tables, settings, detector=NOMINAL, fit=run.settings.fit)
    assert found.zero_modes == ()
    row = found.table.name.index("drift_chamber.shift_z")
    assert abs(found.table.value[row] - 0.5) < 2 * found.table.err[row]
    assert found.table.err[row] < 0.3


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"pairs": ("mass",)}, "mass: got None"),
        ({"mass": 3.0969}, "if, and only if"),
        ({"beam_width": (0.0, 1.0)}, "beam_width"),
    ],
)
def test_wrong_constraints_are_listed(changes: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        cg.AlignmentSettings(**changes)


def test_reference_needs_events_of_the_experiment() -> None:
    with pytest.raises(ValueError, match="reference: got 'kal'"):
        cg.align(pairs(5, 1), reference="kal")
