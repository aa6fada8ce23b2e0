"""Single wires: their sums against those of whole layers, their solution against dense matrices, closure."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import null_space

import cgemit as cg
from cgemit.calibration.blocks import Blocks
from cgemit.calibration.constants import Constant, constants_of, neighbours
from cgemit.calibration.modes import LEAST_HITS, solve
from cgemit.calibration.sums import Sums, expected_sums, expected_tracks, fitted_sums, track_sums
from cgemit.detector.layers.layer import PLACEMENT
from cgemit.particles.gun import generate
from cgemit.reconstruction.fit import FitSettings, compiled_for_fit
from dense import smeared_track
from normal import derivatives, summed

Floats = npt.NDArray[np.float64]
GAS = {"density": "3.913e-4 g/cm3", "composition": {"He": 0.3827, "C": 0.5103, "H": 0.1070}, "gas": True}
ROWS = {"layers": 4, "cells": 36, "height": "16 mm"}
WIRES = ("drift_chamber.layers.*.wires.*",)
EAST_WEST = ("east_shift_r", "east_shift_phi", "west_shift_r", "west_shift_phi")


def small(**layers: dict[str, Any]) -> cg.Detector:
    """Return a chamber of 8 axial and 8 stereo layers of 36 cells, 2304 constants."""
    rows = {
        "A": ROWS | {"r_in": "150 mm"}, "U": ROWS | {"stereo": ["80 mrad", "-80 mrad"]}, "B": ROWS,
        "V": ROWS | {"stereo": ["-80 mrad", "80 mrad"]},
    }  # fmt: skip
    return cg.load(
        {
            "name": "small", "field": {"kind": "uniform", "bz": "1 T"}, "materials": {"Own": GAS},
            "drift_chamber": {
                "gas": "Own", "sigma": "50 um", "half_length": "800 mm", "wires": "none", "superlayers": rows,
                "drift_velocity": "30 um/ns",
            },
        } | ({"layer": layers} if layers else {})
    )  # fmt: skip


LAYER = {"length": "900 mm", "sigma": "50 um", "material": "Si", "x0": 0.01}
HELD = {"A": LAYER | {"radius": "40 mm"}, "B": LAYER | {"radius": "80 mm"}, "C": LAYER | {"radius": "120 mm"}}
FAST = cg.Gun("mu-", p=(0.4, 1.5), cos_theta=(-0.8, 0.8)) + cg.Gun("mu+", p=(0.4, 1.5), cos_theta=(-0.8, 0.8))
MUONS = cg.Gun("mu-", p=(0.2, 0.6), cos_theta=(-0.8, 0.8)) + cg.Gun("mu+", p=(0.2, 0.6), cos_theta=(-0.8, 0.8))
SIMULATED = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian"))


def single(detector: cg.Detector) -> tuple[Constant, ...]:
    return tuple(one for one in constants_of(detector, wires=True) if ".wires." in one.name)


@cache
def sums_of_small(n: int = 750) -> tuple[cg.Detector, Sums]:
    detector = small(**HELD)
    return detector, expected_sums(detector, MUONS, n, single(detector), FitSettings(), reveal_sides=True)


def test_wires_have_their_derivatives() -> None:
    """Of a wire of an axial layer and of two of stereo layers, against finite differences."""
    detector, core, helix, hits = smeared_track("besiii-cgem-design", "1 GeV/c")
    met = np.flatnonzero(hits["kind"] == 2)[[5, 12, 25]]
    names = {
        f"drift_chamber.layers.{hits['layer'][i]}.wires.{hits['channel'][i]}.{key}" for i in met for key in EAST_WEST
    }  # fmt: skip
    constants = tuple(one for one in single(detector) if one.name in names)
    assert len(constants) == 12
    found = summed(core, detector, helix, hits, constants)
    a = derivatives(detector, helix, hits, constants)
    order = neighbours(detector, constants)
    np.testing.assert_allclose(found["measured"], np.sum(a**2 / hits["sigma"][:, None] ** 2, axis=0)[order], rtol=1e-5)
    assert (found["column_hits"] == 1).all()


def test_shifts_of_all_wires_of_a_layer_are_those_of_the_layer() -> None:
    """N and b of all wires, turned to shifts of whole layers' ends, against the dense sums of these."""
    detector = small(**HELD)
    run = cg.run(detector, MUONS, n=150, seed=3)
    constants = single(detector)
    ends = tuple(
        one for one in constants_of(detector) if ".layers." in one.name and one.key[:6] in ("east_s", "west_s")
    )
    assert len(ends) == 4 * 16
    wires = fitted_sums(detector, run.tables, constants, FitSettings())
    layers = fitted_sums(detector, run.tables, ends, FitSettings())
    assert wires.tracks == layers.tracks > 250
    turn = np.zeros((len(constants), len(ends)))
    number = {one.name: i for i, one in enumerate(ends)}
    for i, one in enumerate(constants):
        layer_number, wire, key = one.columns[0][1]
        layer = detector.wires[layer_number]
        x, y = layer.wire_ends(np.array([wire]))[0, key // 2, :2] / layer.r_end
        end = f"{layer.path}.{'east' if key < 2 else 'west'}_shift_"
        turn[i, number[f"{end}x"]], turn[i, number[f"{end}y"]] = (x, y) if key % 2 == 0 else (-y, x)
    assert isinstance(wires.normal, Blocks)
    scale = 1 / np.sqrt(layers.measured)
    assert not isinstance(layers.normal, Blocks)
    units = np.outer(scale, scale)
    np.testing.assert_allclose(turn.T @ wires.normal.dense() @ turn * units, layers.normal * units, atol=1e-9)
    np.testing.assert_allclose(turn.T @ wires.right * scale, layers.right * scale, atol=1e-7)


def test_matrices_in_blocks() -> None:
    """A product with the matrix of the small chamber, and its diagonal, as those of dense matrices."""
    _, sums = sums_of_small()
    assert isinstance(sums.normal, Blocks)
    assert len(sums.normal.first) == 5
    dense = sums.normal.dense()
    vector = np.random.default_rng(1).standard_normal(len(dense))
    np.testing.assert_allclose(sums.normal @ vector, dense @ vector, rtol=1e-9, atol=1e-9 * np.abs(dense).max())
    np.testing.assert_array_equal(sums.normal.diagonal(), np.diag(dense))


def test_the_solution_is_that_of_dense_matrices() -> None:
    """Values and errors of the small chamber to 1e-6 of an error, without and with surveys."""
    detector, sums = sums_of_small()
    constants = single(detector)
    assert isinstance(sums.normal, Blocks)
    sums = replace(sums, right=sums.normal @ np.random.default_rng(2).normal(0, 0.05, len(constants)))
    assert isinstance(sums.normal, Blocks)
    for prior in (0.0, 0.05):
        found = solve(detector, constants, sums, {one.name: prior for one in constants} if prior else {})
        normal = sums.normal.dense() + (np.eye(len(constants)) / prior**2 if prior else 0.0)
        scale = 1 / np.sqrt(np.diag(normal))
        cov = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
        value = cov @ sums.right
        assert found.zero_modes == ()
        determined = found.determined
        assert determined.all() if prior else determined.mean() > 0.5
        err = np.sqrt(np.diag(cov))[determined]
        np.testing.assert_allclose(found.err[determined], err, rtol=1e-6)
        np.testing.assert_allclose((found.value[determined] - value[determined]) / err, 0, atol=1e-6)


def test_few_hits_have_no_number() -> None:
    """Of 40 tracks most wires see fewer hits than they need; a survey gives them a number."""
    detector = small(**HELD)
    constants = single(detector)
    sums = expected_sums(detector, MUONS, 150, constants, FitSettings(), reveal_sides=True)
    assert isinstance(sums.normal, Blocks)
    few = sums.normal.hits < LEAST_HITS
    assert 0.5 < few.mean() < 1
    bare = solve(detector, constants, sums, {})
    assert not bare.determined[few].any()
    assert np.isnan(bare.err[few]).all()
    assert (bare.value[few] == 0).all()
    surveyed = solve(detector, constants, sums, {one.name: 0.05 for one in constants})
    assert surveyed.determined.all()
    np.testing.assert_allclose(surveyed.err[sums.normal.hits == 0], 0.05)
    assert (surveyed.err <= 0.05 * (1 + 1e-9)).all()


def test_zero_modes_of_a_chamber_alone() -> None:
    """Nothing holds it: its displacements as a whole are named; their constraint is that of a basis without them."""
    detector = small()
    constants = single(detector)
    sums = expected_sums(detector, FAST, 750, constants, FitSettings(), reveal_sides=True)
    assert isinstance(sums.normal, Blocks)
    true = np.random.default_rng(3).normal(0, 0.05, len(constants))
    sums = replace(sums, right=sums.normal @ true)
    open_ = solve(detector, constants, sums, {})
    assert set(open_.zero_modes) == {f"common {key}" for key in PLACEMENT}
    assert not open_.determined.any()
    sums = sums.scaled(100)
    found = solve(detector, constants, sums, {}, constrain=True)
    assert found.zero_modes == open_.zero_modes
    free = found.determined
    assert free.mean() > 0.5
    assert isinstance(sums.normal, Blocks)
    scale = 1 / np.sqrt(np.where(sums.measured > 0, sums.measured, 1))
    basis = null_space(found.zeros / scale**2 * scale)  # of the scaled constants
    inside = basis.T @ (sums.normal.dense() * np.outer(scale, scale)) @ basis
    half = basis @ np.linalg.inv(np.linalg.cholesky(inside)).T
    err = np.sqrt(np.sum(half**2, axis=1)) * scale
    np.testing.assert_allclose(found.err[free] / err[free], 1, atol=1e-4)
    value = half @ (half.T @ (sums.right * scale)) * scale
    np.testing.assert_allclose((found.value - value)[free] / err[free], 0, atol=1e-4)


def displaced(detector: cg.Detector, seed: int) -> cg.Detector:
    return detector.misaligned(seed, {"drift_chamber.layers.*.wires.*": "50 um"})


def test_displaced_wires_are_found() -> None:
    """Ends displaced by 50 um, in 2500 tracks: pulls with the survey's errors, and those without scattering."""
    nominal = small(**HELD)
    real = displaced(nominal, 5)
    run = cg.run(real, MUONS, n=1250, seed=6, fit_detector=nominal, settings=SIMULATED)
    settings = cg.AlignmentSettings(free=WIRES, priors=(f"{WIRES[0]}=50 um",), pairs=())
    found = cg.align(run, settings)
    assert found.converged
    pull = found.compare(real)
    assert len(pull) == 2304
    assert np.isfinite(pull).all()
    assert abs(np.mean(pull)) < 0.1
    assert np.std(pull) == pytest.approx(1, abs=0.05)
    assert np.median(np.array(found.table.err)[1::2]) < 0.03  # of a survey of 0.05 mm
    once = replace(settings, iterations=1, outlier_pull=(5.0,), tolerance=1e9)
    wrong = cg.align(run, replace(once, scattering=False), detector=found.detector)
    assert np.std(wrong.compare(real)) > 1.15


def test_what_does_not_go_with_single_wires() -> None:
    detector = small(**HELD)
    samples = [(MUONS, 20)]
    with pytest.raises(ValueError, match=r"free: got single wires and other constants.*\n.*pairs: got cosmic"):
        cg.alignment_forecast(detector, samples, cg.AlignmentSettings(free=(*WIRES, "drift_chamber")))
    forecast = cg.alignment_forecast(detector, samples, cg.AlignmentSettings(free=WIRES, pairs=()))
    assert "drift_chamber.layers.0.wires.*.east_shift_r" in str(forecast)
    for refused in (forecast.modes, lambda: forecast.cov, lambda: forecast.induced("mu-")):
        with pytest.raises(ValueError, match="neither a covariance nor modes"):
            refused()
    run = cg.run(detector, MUONS, n=5)
    with pytest.raises(ValueError, match="expected neither records"):
        cg.write_mille("mille.bin", run, cg.AlignmentSettings(free=WIRES, pairs=()))


@pytest.mark.slow
def test_all_wires_of_besiii_take_a_minute() -> None:
    """25 248 constants in 20 000 muons of 1 GeV/c: the seconds of all cores together, after the expected hits."""
    detector = cg.load("besiii-cgem-design").with_readout("gaussian")
    constants, fit = single(detector), FitSettings()
    assert len(constants) == 25_248
    muons = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)) + cg.Gun("mu+", p=1.0, cos_theta=(-0.8, 0.8))
    particles = generate(muons, 10_000, 1, detector=detector)
    helices = cg.helix.at_origin(particles, detector.field.bz)
    mass, charge = (np.asarray(particles[name], np.float64) for name in ("mass", "charge"))
    expected = expected_tracks(detector, helices, mass, np.abs(charge), fit)
    start = time.process_time()
    sums = track_sums(compiled_for_fit(detector, fit), detector, constants, *expected, particles["event"], fit)
    found = solve(detector, constants, sums, {one.name: 0.05 for one in constants})
    assert time.process_time() - start <= 60
    assert sums.tracks > 19_000
    assert found.determined.all()
    assert np.median(found.err[1::2]) == pytest.approx(0.031, abs=0.002)
