"""Constants that are no displacement of a whole part: their names, what they do to a description, zero modes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

import cgemit as cg
from cgemit.calibration.constants import constants_of
from cgemit.calibration.modes import known_modes
from cgemit.detector.alignment import points_of_relation, value_of
from cgemit.detector.drift import relation_of
from cgemit.detector.layers.layer import crossing_z, local_v
from cgemit.reconstruction.cluster import read_by

NOMINAL = cg.load("besiii-cgem-design").with_readout("gaussian")
PLATES = (2, 2, 2, 2, 2, 2, 23)
MUONS = cg.Gun("mu-", p=(0.4, 1.5), cos_theta=(-0.8, 0.8))


def moved(real: cg.Detector, n: int, seed: int = 5) -> cg.Result:
    settings = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian"))
    return cg.run(real, MUONS, n=n, seed=seed, fit_detector=NOMINAL, settings=settings)


def test_every_constant_changes_the_description_by_its_value() -> None:
    """One after the other, by a small value: `value_of` tells it back, and adding its negative undoes it."""
    seen = set()
    for one in constants_of(NOMINAL, PLATES, wires=True):
        kind = "".join(letter for letter in one.name if not letter.isdigit())
        if kind in seen:
            continue
        seen.add(kind)
        there = NOMINAL.with_alignment({one.name: 1e-3})
        before, after, again = (
            value_of(detector, one.name) for detector in (NOMINAL, there, there.with_alignment({one.name: -1e-3}))
        )
        assert before is not None, one.name
        assert after is not None
        assert again is not None
        assert after[0] - before[0] == pytest.approx(1e-3, rel=1e-9), one.name
        assert again[0] == pytest.approx(before[0], abs=1e-12), one.name
        assert after[2] == pytest.approx(before[2] - (0 if one.key.endswith("mm") or one.key == "scale" else 1e-3))
    assert len(seen) == 42


def test_constants_move_what_their_names_say() -> None:
    real = NOMINAL.with_alignment(
        {
            "cgem.L2.sheets.1.shift_z": 0.3, "cgem.L3.sheets.0.rotation": 1e-3, "drift_chamber.layers.20.t0": 1.5,
            "drift_chamber.plates.10-11.west_shift_x": 0.1, "drift_chamber.layers.11.west_shift_x": 0.05,
            "drift_chamber.drift_relation.3mm": 2.0, "drift_chamber.layers.9.drift_relation.3mm": 1.0,
        }
    )  # fmt: skip
    assert real.cgem["L2"].sheet_shift_z == (0.0, 0.3)
    assert real.cgem["L3"].sheet_rotation == (1e-3, 0.0)
    assert real.drift_chamber is not None
    assert NOMINAL.drift_chamber is not None
    layers, before = ({one.number: one for one in det.drift_chamber.layers} for det in (real, NOMINAL))
    assert [layers[n].west_shift_x for n in (9, 10, 11, 12)] == [0.0, 0.1, pytest.approx(0.15), 0.0]
    assert [layers[n].t0 for n in (19, 20)] == [0.0, 1.5]
    for number, change in ((8, 2.0), (9, 3.0), (42, 2.0)):
        nodes = relation_of(layers[number])
        then = np.interp([2.0, 2.5, 3.0, 3.75, 4.0, 8.3], nodes.distance, nodes.time)
        old = relation_of(before[number])
        expected = np.interp([2.0, 2.5, 3.0, 3.75, 4.0, 8.3], old.distance, old.time)
        np.testing.assert_allclose(then - expected, np.array([0, 0.5, 1, 0.25, 0, 0]) * change, atol=0.4)
        np.testing.assert_allclose((then - expected)[[0, 2, 4]], np.array([0, 1, 0]) * change, atol=1e-9)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"cgem.L1.sheets.1.shift_z": 0.1}, r"cgem\.L1\.sheets\.1"),  # it has one
        ({"cgem.L2.sheets.0.tilt_x": 0.1}, "tilt_x"),
        ({"drift_chamber.plates.60-61.east_shift_x": 0.1}, "60-61"),
        ({"drift_chamber.layers.60.drift_relation.3mm": 0.1}, "a wire layer of the detector"),
        ({"drift_chamber.drift_relation.0mm": 0.1}, "1 to 9 mm"),
        ({"drift_chamber.drift_relation.3mm": -100.0}, "times that rise"),
        ({"cgem.L2.sheets.0.shift_z": 3.0}, "sheet_shift_z"),
        ({"drift_chamber.layers.20.t0": float("inf")}, "finite"),
    ],
)
def test_constants_that_are_none_are_refused(values: dict[str, float], expected: str) -> None:
    with pytest.raises(cg.DetectorError, match=expected):
        NOMINAL.with_alignment(values)


def test_plates_are_those_of_the_detector() -> None:
    settings = cg.AlignmentSettings(free=("drift_chamber.plates.*",), plates=(2, 2))
    with pytest.raises(ValueError, match="plates: got 4 wire layers, expected the 35"):
        cg.alignment_forecast(NOMINAL, [(MUONS, 10)], settings)


def test_sheets_are_found() -> None:
    real = NOMINAL.with_alignment(
        {"cgem.L2.sheets.1.shift_z": 0.4, "cgem.L3.sheets.0.rotation": 1e-3, "cgem.L2.sheets.0.rotation": -5e-4}
    )
    found = cg.align(moved(real, 300), cg.AlignmentSettings(free=("cgem.*.sheets.*",)))
    pulls = found.compare(real)
    assert found.converged
    assert len(found.table.name) == 10
    assert np.abs(pulls).max() < 4
    assert np.abs(found.compare(NOMINAL)).max() > 10


def test_plates_and_their_own_layers_are_found() -> None:
    """Ends of wires by pairs of end plates, the outermost one held."""
    real = NOMINAL.with_alignment(
        {"drift_chamber.plates.8-9.east_rotation": 1e-3, "drift_chamber.plates.12-13.west_shift_x": 0.5}
    )
    settings = cg.AlignmentSettings(
        free=("drift_chamber.plates.*",), plates=PLATES, fixed=("drift_chamber.plates.20-42.*",)
    )
    found = cg.align(moved(real, 300), settings)
    assert found.converged
    assert len(found.solution.names) == 36
    assert np.abs(found.compare(real)).max() < 4.5
    assert np.abs(found.compare(NOMINAL)).max() > 8


def test_times_of_wire_layers_and_their_relation_are_found() -> None:
    """Zero times of 2 ns and times of the relation of 2 ns, with the layer outermost as the zero of all."""
    random = np.random.default_rng(1)
    values = {f"drift_chamber.layers.{n}.t0": float(random.normal(0, 2)) for n in range(8, 42)}
    values |= {f"drift_chamber.drift_relation.{k}mm": float(random.normal(0, 2)) for k in range(1, 8)}
    real = NOMINAL.with_alignment(values)
    settings = cg.AlignmentSettings(
        free=("drift_chamber.layers.*.t0",), calibrate=("relation",), fixed=("drift_chamber.layers.42.t0",)
    )
    found = cg.align(moved(real, 400), settings)
    assert found.converged
    assert found.zero_modes == ()
    pulls = found.compare(real)
    assert np.nanmax(np.abs(pulls)) < 4.5
    assert 0.6 < np.sqrt(np.nanmean(pulls**2)) < 1.5
    assert np.nanmax(np.abs(found.compare(NOMINAL))) > 5


def test_lengths_of_strip_patterns_are_found() -> None:
    """By value, with pulls and all correlations; V is counted along a pattern that is longer about z = 0."""
    values = {"cgem.L1.z_scale": 8e-3, "cgem.L2.z_scale": -6e-3, "cgem.L3.z_scale": 5e-3}
    real = NOMINAL.with_alignment(values)
    for layer, plain in zip(real.cgem, NOMINAL.cgem, strict=True):
        x, z, scale = np.array([3.0, 70.0]), np.array([-120.0, 95.0]), 1 + values[f"{layer.path}.z_scale"]
        np.testing.assert_allclose(local_v(layer, x, z), local_v(plain, x, z / scale), rtol=1e-12)
        np.testing.assert_allclose(crossing_z(layer, x, local_v(layer, x, z)), z, rtol=1e-12)
    found = cg.align(moved(real, 400), cg.AlignmentSettings(free=("cgem.*.shift_z",), calibrate=("z_scale",)))
    assert found.converged
    assert found.zero_modes == ()
    assert np.abs(found.compare(real)).max() < 4
    # Stereo wires tell the common scale to 0.2 %, hits of three layers on a line one combination to 1e-4.
    right, wrong = (found.compare(one) * found.solution.err for one in (real, NOMINAL))
    size, size_wrong = (float(apart @ np.linalg.solve(found.cov, apart)) for apart in (right, wrong))
    assert 1e-4 < chi2.sf(size, 6) < 1 - 1e-4
    assert chi2.sf(size_wrong, 6) < 1e-9


@pytest.mark.parametrize("readout", ["binary", "gaussian"])
def test_clusters_are_read_with_another_length(readout: str) -> None:
    """Positions along the beam are those of clusters that the other description makes of the same strips."""
    described = NOMINAL.with_readout(readout).with_alignment({"cgem.L2.sheets.1.shift_z": 0.3, "cgem.L2.z_scale": 1e-3})
    other = described.with_alignment({"cgem.L1.z_scale": -2e-3, "cgem.L2.z_scale": 2e-3, "cgem.L2.sheets.0.shift_z": 1})
    made = cg.run(described, MUONS, n=40, seed=3, until="cluster")
    again = cg.cluster(other, made.digis)
    for name in ("x", "v", "phi", "z"):
        np.testing.assert_allclose(read_by(other, described, made.clusters)[name], again[name], atol=1e-9)
    assert np.nanmax(np.abs(again["z"] - made.clusters["z"])) > 0.1


@pytest.fixture(scope="module")
def run() -> cg.Result:
    return moved(NOMINAL, 150)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (
            {"free": ("cgem.L2", "cgem.L2.sheets.*")},
            {"cgem.L2.shift_z and shift_z of its parts", "cgem.L2.rotation and rotation of its parts"},
        ),
        (
            {"free": ("cgem.L1.rotation",), "calibrate": ("t0", "relation")},
            {"t0 of all wire layers and their relation"},
        ),
        (
            {"free": ("drift_chamber.plates.*.*_shift_x", "drift_chamber.shift_x"), "plates": PLATES},
            {"drift_chamber.shift_x and east_shift_x of its parts"},
        ),
        ({"free": ("drift_chamber.layers.20.*_shift_x", "cgem.L2.sheets.*")}, set()),
        (
            {"free": ("drift_chamber.layers.20.shift_x", "drift_chamber.layers.20.*_shift_x")},
            {"drift_chamber.layers.20.shift_x and east_shift_x of its parts"},
        ),
        (
            {"free": ("cgem.L2.sheets.*",), "calibrate": ("lorentz",)},
            {"Lorentz shift and rotation of L2"},
        ),
        (
            {"free": ("cgem.*.rotation", "drift_chamber.plates.*.*_rotation"), "plates": PLATES},
            {"common rotation"},
        ),
    ],
)  # fmt: skip
def test_zero_modes_have_names(run: cg.Result, settings: dict[str, tuple[object, ...]], expected: set[str]) -> None:
    """Constants that do the same are named, and get no number; all others have one."""
    found = cg.align(run, cg.AlignmentSettings(**settings))  # type: ignore[arg-type]
    assert set(found.zero_modes) == expected
    assert ("undetermined" in found.table.status) == bool(expected)


def test_modes_are_combinations_of_free_constants() -> None:
    constants = constants_of(NOMINAL, PLATES)
    modes = known_modes(NOMINAL, constants)
    assert len(modes) > len(constants)
    assert points_of_relation(NOMINAL)[0] == 1
    vector = modes["drift_chamber.shift_x and shift_x of its parts"]
    moving = {one.name for one, share in zip(constants, vector, strict=True) if share}
    assert len(moving) == 36
