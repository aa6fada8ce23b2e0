"""Displaced descriptions: random ones, patterns, tables, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

import cgemit as cg
from cgemit.detector.alignment import PATTERNS, pattern_at, pattern_values
from cgemit.detector.layers.layer import PLACEMENT

DETECTOR = cg.load("besiii-cgem")
FOLLOWED = ("telescope", "layer_rotation", "curl", "skew", "clamshell", "sagitta")


def test_constants_add_to_the_description() -> None:
    once = DETECTOR.with_alignment({"cgem.L1.shift_x": 0.1, "field.scale": 1e-3, "drift_chamber.tilt_y": 1e-4})
    twice = once.with_alignment({"cgem.L1.shift_x": 0.1, "field.scale": 1e-3})
    assert twice.cgem["L1"].shift_x == pytest.approx(0.2)
    assert twice.field.bz == pytest.approx(DETECTOR.field.bz * np.exp(2e-3))
    assert twice.drift_chamber.tilt_y == 1e-4
    assert twice.name == DETECTOR.name


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"cgem.L1.shift_w": 0.1, "cgem.L9.shift_x": 0.1}, "shift_w.*\n.*L9"),
        ({"cgem.L1.shift_x": 2.5}, "shift_x"),
        ({"cgem.L1.shift_x": float("nan")}, "finite"),
        ({"cgem.L1.sheets": 1}, "dotted key of a displacement"),
        (3, "a table of constants"),
    ],
)
def test_wrong_constants_are_listed(values: object, expected: str) -> None:
    with pytest.raises(cg.DetectorError, match=expected):
        DETECTOR.with_alignment(values)  # type: ignore[arg-type]


def test_random_displacements_have_their_sizes() -> None:
    """Their spread over seeds, within four standard errors; a constant depends on the seed and its name alone."""
    sizes = {"cgem.*": ("100 um", "0.1 mrad")}
    tables = [DETECTOR.misaligned(seed, sizes).displacements() for seed in range(60)]
    values = np.array([table.value[:18] for table in tables]).reshape(60, 3, 6)
    for part, size in ((values[..., :3], 0.1), (values[..., 3:], 1e-4)):
        assert abs(part.std() / size - 1) < 4 / np.sqrt(2 * part.size)
        assert abs(part.mean()) < 4 * size / np.sqrt(part.size)
    one = DETECTOR.misaligned(1, {"cgem.L2": ("100 um", "0.1 mrad")})
    assert one.cgem["L2"].shift_x == DETECTOR.misaligned(1, sizes).cgem["L2"].shift_x
    assert not one.cgem["L1"].is_moved
    assert not one.drift_chamber.is_moved


@pytest.mark.parametrize("name", FOLLOWED)
def test_whole_parts_follow_a_pattern(name: str) -> None:
    """The rigid displacement of each part is the mean of the pattern over the part."""
    found = DETECTOR.misaligned(1, {name: "100 um"})
    assert any(layer.is_moved for layer in found.cgem)
    values, share = pattern_values(DETECTOR, name)
    assert 0.1 < share <= 1 + 1e-9
    outer = max(layer.r_mid for layer in DETECTOR.drift_chamber.layers)
    l1 = {key: values.get(f"cgem.L1.{key}", 0.0) for key in PLACEMENT}
    r = DETECTOR.cgem["L1"].r_mid
    expected = {
        "telescope": {"shift_z": r / outer},
        "layer_rotation": {"rotation": (r / outer - 0.5) / outer},
        "curl": {"rotation": r / outer / outer},
        "clamshell": {"shift_y": 0.5 * r / outer},
        "sagitta": {"shift_y": r / outer},
    }
    if name in expected:
        for key, value in l1.items():
            assert value == pytest.approx(expected[name].get(key, 0.0), abs=1e-6)
    else:
        assert l1["tilt_y"] < 0  # z grows with x


@pytest.mark.parametrize("name", [name for name in PATTERNS if name not in (*FOLLOWED, "twist")])
def test_patterns_that_whole_parts_cannot_follow_are_refused(name: str) -> None:
    with pytest.raises(cg.DetectorError, match=f"{name}.*displacements of whole parts"):
        DETECTOR.misaligned(1, {name: "100 um"})


def test_ends_of_wires_follow_a_twist() -> None:
    """They turn against each other, by the angle of the pattern at each end; nothing else moves."""
    values, share = pattern_values(DETECTOR, "twist")
    assert share == pytest.approx(1, abs=0.02)  # wires are straight
    outer = max(layer.r_end for layer in DETECTOR.wires)
    longest = max(layer.half_length for layer in DETECTOR.wires)
    for layer in DETECTOR.wires:
        for end, z in (("east", layer.ends[1]), ("west", layer.ends[0])):
            assert values[f"{layer.path}.{end}_rotation"] == pytest.approx(z / longest / outer, rel=0.05)
    assert all(abs(value) < 1e-4 for name, value in values.items() if "shift" in name)
    found = DETECTOR.misaligned(1, {"twist": "100 um"})
    assert not any(layer.is_moved for layer in found.cgem)
    assert found.wires[0].east_rotation > 0 > found.wires[0].west_rotation


def test_patterns_are_at_most_about_one() -> None:
    random = np.random.default_rng(1)
    phi, r, z = random.uniform(-np.pi, np.pi, 500), random.uniform(50, 800, 500), random.uniform(-1000, 1000, 500)
    points = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    for name in PATTERNS:
        moved = np.linalg.norm(pattern_at(name, points, (800.0, 1000.0)), axis=1)
        assert 0.4 < moved.max() < 1.5, name


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        ({"cgem.L9": ("1 um", "1 mrad")}, "cgem.L9"),
        ({"cgem.*": "1 um"}, "a part with a length and an angle"),
        ({"cgem.*": ("1 um", "1 um")}, "angle"),
        ({"telescop": "1 um"}, "telescope"),
        ({"cgem.*.shift_x": "-1 um"}, "0 or more"),
    ],
)
def test_wrong_sizes_are_listed(sizes: dict[str, object], expected: str) -> None:
    with pytest.raises(cg.DetectorError, match=expected):
        DETECTOR.misaligned(1, sizes)
    with pytest.raises(cg.DetectorError, match="seed"):
        DETECTOR.misaligned(-1, {"curl": "1 um"})
