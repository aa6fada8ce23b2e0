"""The reference through a field map: predictions, derivatives and noise; fits that end at its edge."""

import math

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.detector import compiled, load, slabs
from cgemit.reconstruction.fit import FitStatus
from cgemit.reconstruction.states import StateStatus
from fields import HARMONIC, small_map
from tracks import MUON, hits_on, particles, without_matter

UNIFORM = load("besiii-cgem-design")
# A field that falls by a third: terms that a weak gradient would hide count.
UNEVEN = UNIFORM.with_field(
    {"kind": "harmonic", "bz": "-0.98 T", "b": "0.6 /m2", "q": "-0.251 /m4", "tolerance": "1e-8 mm"}
)
EVEN = UNIFORM.with_field({"kind": "harmonic", "bz": "-1 T", "b": "0 /m2", "tolerance": "1e-8 mm"})

# dr mm, phi0, kappa (GeV/c)^-1, dz mm, tanl
SHAPES = {
    "central 1 GeV/c": (0.3, 0.4, 1.0, 5.0, 0.02),
    "inclined 5 GeV/c": (-0.5, -2.9, -0.2, -20.0, 1.1),
    "displaced 0.5 GeV/c": (20.0, 1.7, 2.0, 30.0, -0.7),
    "slow": (0.2, -1.2, -1 / 0.16, -8.0, 0.5),
}
STEP = np.array([0.5, 5e-4, 2e-3, 0.5, 1e-3])
every_shape = pytest.mark.parametrize("shape", SHAPES)


def reference(core, parameters, hits):
    return _core._testing.reference(core, parameters, MUON, hits)


@every_shape
def test_constant_map_is_the_uniform_field(shape):
    """Rows and noise of two formulations agree: turns of helices, and transported derivatives."""
    parameters = np.array(SHAPES[shape])
    hits = hits_on(UNIFORM, parameters)
    bare, other_bare = (reference(without_matter(detector), parameters, hits) for detector in (UNIFORM, EVEN))
    scale = np.abs(bare["rows"]).max(axis=0)
    np.testing.assert_allclose(other_bare["rows"] / scale, bare["rows"] / scale, rtol=0, atol=1e-9)
    one, other = (reference(compiled(detector), parameters, hits) for detector in (UNIFORM, EVEN))
    assert other["predicted"] == pytest.approx(one["predicted"], abs=1e-6)
    # A displaced track loses its momentum after the same path in one, on the same cylinder in the other.
    for name, tolerance in (("rows", [2e-3, 1e-9, 1e-4, 1e-9, 1e-6]), ("noise", [5e-4, 5e-4, 1e-9, 1e-4, 1e-9])):
        scale = np.abs(one[name]).max(axis=0)
        assert (np.abs(other[name] - one[name]).max(axis=0) / scale < tolerance).all()


@every_shape
def test_taylor(shape):
    """Without matter, the error of the linear prediction falls by four with every halving of the step."""
    core, parameters = without_matter(UNEVEN), np.array(SHAPES[shape])
    hits, rng = hits_on(UNEVEN, parameters), np.random.default_rng(1)
    start = reference(core, parameters, hits)
    assert start["reached"] == len(hits["kind"]) > 20
    for _ in range(3):
        step, errors = STEP * rng.choice([-1, 1], 5) * 0.5, []
        for size in (1, 0.5, 0.25, 0.125):
            moved = reference(core, parameters + size * step, hits)["predicted"]
            errors.append(np.linalg.norm(moved - start["predicted"] - start["rows"] @ (size * step)))
        np.testing.assert_allclose(np.array(errors[:-1])[1:] / errors[2:], 4, rtol=0.12)


def test_taylor_sees_the_rows_of_a_uniform_field():
    parameters = np.array(SHAPES["central 1 GeV/c"])
    hits = hits_on(UNEVEN, parameters)
    rows = {det.field.kind: reference(without_matter(det), parameters, hits)["rows"] for det in (UNIFORM, UNEVEN)}
    error = np.abs(rows["harmonic"] - rows["uniform"]).max(axis=0) / np.abs(rows["uniform"]).max(axis=0)
    assert error[2] > 1e-3


@every_shape
def test_differences_with_matter(shape):
    """As in a uniform field: exact up to how obliquely the matter is crossed, which depends on z now, too."""
    core, parameters = compiled(UNEVEN), np.array(SHAPES[shape])
    hits = hits_on(UNEVEN, parameters)
    rows = reference(core, parameters, hits)["rows"]
    gentle = abs(parameters[0]) <= 1 and abs(parameters[2]) < 1 / 0.15
    for i, part in enumerate([6e-3, 1e-7, 3e-4, 1e-4, 6e-3] if gentle else [4e-2, 1e-7, 5e-3, 1e-4, 4e-2]):
        step = np.where(np.arange(5) == i, 0.05 * STEP, 0.0)
        ahead, behind = (reference(core, parameters + sign * step, hits)["predicted"] for sign in (1, -1))
        limit = part * np.abs(rows[:, i]).max()
        np.testing.assert_allclose(rows[:, i], (ahead - behind) / (2 * step[i]), rtol=0, atol=limit, err_msg=f"{i}")


@every_shape
def test_kinks_in_a_constant_map_are_those_of_a_uniform_field(shape):
    """Two formulations of a scattered reference agree in what it meets and, to the size of the angles, in its rows."""
    parameters = np.array(SHAPES[shape])
    hits = hits_on(UNIFORM, parameters)
    kinks = np.random.default_rng(3).normal(scale=0.01, size=(len(slabs(UNIFORM)), 2))
    cores = [compiled(detector) for detector in (UNIFORM, EVEN)]
    one, other = (_core._testing.reference(core, parameters, MUON, hits, kinks) for core in cores)
    assert other["predicted"] == pytest.approx(one["predicted"], abs=1e-6)
    assert other["noise_units"] == pytest.approx(one["noise_units"], rel=1e-6)
    assert np.abs(one["predicted"] - _core._testing.reference(cores[0], parameters, MUON, hits)["predicted"]).max() > 4
    for name, limits in (("rows", [4e-2, 1e-8, 5e-3, 1e-8, 3e-4]), ("noise", [2e-2, 2e-3, 1e-9, 2.5e-2, 1e-9])):
        scale = np.abs(one[name]).max(axis=0)
        assert (np.abs(other[name] - one[name]).max(axis=0) / scale < limits).all()


@every_shape
def test_differences_with_kinks(shape):
    """Displaced tracks are scattered on the same cylinder: rows through a map are exact up to how the loss depends."""
    core, parameters = compiled(UNEVEN), np.array(SHAPES[shape])
    hits = hits_on(UNEVEN, parameters)
    kinks = np.random.default_rng(3).normal(scale=0.01, size=(len(slabs(UNEVEN)), 2))
    rows = _core._testing.reference(core, parameters, MUON, hits, kinks)["rows"]
    for i, part in enumerate([8e-3, 1e-7, 3e-4, 3e-5, 2e-3]):
        step = np.where(np.arange(5) == i, 0.05 * STEP, 0.0)
        ends = [
            _core._testing.reference(core, parameters + sign * step, MUON, hits, kinks)["predicted"] for sign in (1, -1)
        ]
        limit = part * np.abs(rows[:, i]).max()
        np.testing.assert_allclose(rows[:, i], (ends[0] - ends[1]) / (2 * step[i]), rtol=0, atol=limit, err_msg=f"{i}")


@every_shape
def test_simulation_without_fluctuations_is_the_reference(shape):
    parameters = np.array(SHAPES[shape])
    hits = hits_on(UNEVEN, parameters)
    found = reference(compiled(UNEVEN), parameters, hits)["predicted"]
    value = np.where(hits["kind"] == 2, hits["value"] * hits["side"], hits["value"])
    assert found == pytest.approx(value, abs=1e-5)


def test_noise_is_a_kick_seen_from_the_origin():
    """A turn at the first slab, undone at the origin, leaves the hits where they were: the sum over parameters."""
    parameters = np.array(SHAPES["inclined 5 GeV/c"])
    core, hits = without_matter(UNEVEN, density=1e-4), hits_on(UNEVEN, parameters)
    out = reference(core, parameters, hits)
    # The innermost scatterer is the beam pipe, r = 32.6 mm: its turns move hits as a turn about the origin would,
    # but for the lever arm.
    turn = out["noise"][0] / out["noise"][0][1]
    shift = out["rows"] @ (turn - np.array([0, 1, 0, 0, 0]))
    lever = math.hypot(turn[0], 0)
    assert lever == pytest.approx(32.6, rel=0.02)
    moved = reference(core, parameters + 1e-4 * turn, hits)["predicted"] - out["predicted"]
    assert moved == pytest.approx(1e-4 * (out["rows"][:, 1] + shift), abs=1e-5)


def test_a_fit_that_leaves_its_map_says_so(tmp_path):
    whole = UNIFORM.with_field(HARMONIC)
    small = UNIFORM.with_field(small_map(tmp_path))
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.3, 0.3))
    result = cg.run(whole, gun, 30, seed=2, fit_detector=small)
    assert (result.tracks["status"] == FitStatus.left_field).all()
    assert result.removed() == {"left_field": 30}
    # What was simulated in the map is fitted in the map.
    inside = cg.run(small, gun, 30, seed=2)
    assert inside.transport() == {"left_field": 30}
    assert inside.removed() == {}
    assert inside.tracks["n_wires"].max() < 25 < result.wire_truths["event"].size / 30


def test_unknown_sides_and_low_momenta_are_fitted():
    result = cg.run(
        UNIFORM.with_field("finite-solenoid"), cg.Gun("mu-", p=(0.12, 2.0), cos_theta=(-0.9, 0.9)), 300, seed=4
    )
    fitted = result.tracks["status"] == FitStatus.ok
    assert fitted.mean() > 0.97
    assert np.median(np.abs(result.tracks["res_p"][fitted] / result.tracks["truth_p"][fitted])) < 0.01


@pytest.mark.parametrize("name", [HARMONIC, "finite-solenoid", "small map"])
def test_any_particle_ends_with_numbers_or_a_status(tmp_path, name):
    """From 25 MeV/c to 5 GeV/c, from far beside the beam line: nothing is NaN where all is said to be well."""
    rng, n = np.random.default_rng(5), 300
    flight = rng.normal(size=(n, 3))
    flight *= (10 ** rng.uniform(-1.6, 0.7, n) / np.linalg.norm(flight, axis=1))[:, None]
    place = rng.normal(size=(n, 3)) * np.where(rng.random(n) < 0.5, 5, 150)[:, None]
    table = particles(place, flight, rng.choice([13, -13, 211, -211, 2212, 11, -11, 321], n))
    settings = cg.Settings(fit=cg.FitSettings(states=("beam_line", 50.0, 400.0, 900.0, "hits")))
    detector = UNIFORM.with_field(small_map(tmp_path) if name == "small map" else name)
    result = cg.run(detector, table, seed=3, settings=settings)
    fitted = result.tracks["status"] == FitStatus.ok
    assert fitted.sum() > 100
    states = result.states[result.states["status"] == StateStatus.ok]
    assert len(states) > 0.8 * len(result.wire_hits)
    for column in ("x", "px", "kappa", "cov"):
        assert np.isfinite(states[column]).all()
    assert np.diagonal(states["cov"][:, 1:3, 1:3], axis1=1, axis2=2).min() > 0
    for name, rows in (
        ("truths", slice(None)),
        ("steps", slice(None)),
        ("wire_truths", slice(None)),
        ("tracks", fitted),
    ):
        for column, values in result.tables[name].columns.items():
            if values.dtype.kind == "f":
                assert np.isfinite(values[rows]).all(), f"{name}.{column}"
    cov = result.tracks["cov"][fitted]
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    assert np.linalg.eigvalsh(cov / (sigma[:, :, None] * sigma[:, None, :])).min() > 0
