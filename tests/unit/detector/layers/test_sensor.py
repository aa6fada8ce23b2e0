"""Layers that measure positions: their keys, and mistakes in them."""

import math
import tomllib

import pytest

import cgemit as cg
from cgemit import load
from cgemit.detector import DetectorError, slabs

LAYER = {"radius": "50 mm", "sigma": "10 um", "material": "Si"}


def with_layer(**keys):
    return load({"base": "besiii-cgem-design", "name": "layered", "layer": {"VTX": {**LAYER, **keys}}})


def test_a_measurement_layer_needs_three_keys():
    layer = with_layer().layer["VTX"]
    assert (layer.views, layer.errors) == (("X", "V"), (0.01, 0.01))
    assert (layer.r_in, layer.r_out, layer.half_length) == (49.85, 50.15, 125.0)
    assert layer.measures_z
    assert "0.32 % X0 of Si, r phi to 10 um, z to 10 um" in repr(layer)


def test_measurement_layers_are_ordered_among_the_others():
    detector = with_layer(radius="100 mm")
    assert [layer.label for layer in detector.layers] == ["L1", "VTX", "L2", "L3"]
    assert [layer.label for layer in detector.cgem] == ["L1", "L2", "L3"]
    shells = [slab.shells for slab in slabs(detector) if slab.gap == 1]
    assert [[shell.label for shell in one] for one in shells] == [["Si"]]


def test_thickness_in_radiation_lengths_and_support():
    support = [{"material": "CarbonFiber", "thickness": "0.4 mm"}]
    layer = with_layer(x0=0.005, support=support).layer["VTX"]
    assert sum(shell.x0 for shell in layer.shells() if shell.group == "sensor") == pytest.approx(0.005)
    assert layer.r_out == pytest.approx(layer.r_gap_out + 0.4)
    assert [slab.gap for slab in slabs(with_layer(support=support)) if slab.shells[0].group == "support"] == [-1]


@pytest.mark.parametrize(
    ("keys", "views", "errors"),
    [
        ({"pitch": "0.1 mm"}, ("X", "V"), (0.1 / math.sqrt(12), 0.1 / math.sqrt(12))),
        ({"sigma_x": "5 um"}, ("X",), (0.005, 0.0)),
        ({"sigma_v": "5 um"}, ("V",), (0.0, 0.005)),
        ({"sigma_x": "5 um", "pitch_v": "1 mm"}, ("X", "V"), (0.005, 1 / math.sqrt(12))),
        ({}, (), (0.0, 0.0)),
    ],
)
def test_what_is_given_is_measured(keys, views, errors):
    only = {key: value for key, value in LAYER.items() if key != "sigma"}
    detector = load({"base": "besiii-cgem-design", "name": "layered", "layer": {"VTX": {**only, **keys}}})
    layer = detector.layer["VTX"]
    assert layer.views == views
    assert layer.errors == pytest.approx(errors)
    assert (layer in detector.layers) == bool(views)
    assert any(shell.label == "Si" for slab in slabs(detector) for shell in slab.shells)
    assert load(tomllib.loads(detector.to_toml())) == detector


@pytest.mark.parametrize(
    ("overrides", "errors"),
    [
        ({"sigma": "20 um"}, (0.02, 0.02)),
        ({"sigma_v": "20 um"}, (0.01, 0.02)),
        ({"pitch_x": "0.1 mm"}, (0.1 / math.sqrt(12), 0.01)),
        ({"pitch": "0.1 mm"}, (0.1 / math.sqrt(12), 0.1 / math.sqrt(12))),
    ],
)
def test_errors_of_a_variant_replace_those_of_its_base(overrides, errors):
    for label in ("VTX", "*"):
        variant = with_layer().with_overrides({f"layer.{label}.{key}": value for key, value in overrides.items()})
        assert variant.layer["VTX"].errors == pytest.approx(errors)
        assert load(tomllib.loads(variant.to_toml())) == variant


def test_a_file_changes_the_layer_of_its_base(tmp_path):
    base = tmp_path / "base.toml"
    base.write_text(
        'base = "besiii-cgem-design"\n[layer.VTX]\nradius = "50 mm"\nsigma = "10 um"\nmaterial = "Si"\nx0 = 0.01\n'
    )
    for text, thickness, errors in (
        ('sigma_x = "5 um"', 0.01 * load(base).layer["VTX"].material.x0, (0.005, 0.01)),
        ('thickness = "50 um"', 0.05, (0.01, 0.01)),
        ('pitch = "0.2 mm"', 0.01 * load(base).layer["VTX"].material.x0, (0.2 / math.sqrt(12),) * 2),
    ):
        own = tmp_path / "own.toml"
        own.write_text(f'base = "base.toml"\n[layer.VTX]\n{text}\n[layer.SECOND]\nlike = "VTX"\nradius = "60 mm"\n')
        detector = load(own)
        assert detector.layer["VTX"].thickness == pytest.approx(thickness)
        assert detector.layer["VTX"].errors == pytest.approx(errors)
        assert detector.layer["SECOND"].radius == 60
        assert detector.layer["SECOND"].material.name == "Si"


def test_mistakes_of_a_measurement_layer_are_listed():
    with pytest.raises(DetectorError) as caught:
        load({"base": "besiii-cgem-design", "layer": {
            "A": {**LAYER, "sigma_x": "3 um"},
            "B": {"radius": "60 mm", "sigma": "5 um", "material": "Silicon", "x0": 0.1, "thickness": "1 mm"},
            "C": {"radius": "2 mm", "sigma": "5 um", "material": "Si", "efficiency": 1.2},
            "D": {"sigma": "5 um", "material": "Si"},
            "E": {**LAYER, "radius": "150 mm", "stereo": "0.5 mrad"},
            "F": {**LAYER, "radius": "145 mm", "pitch_x": "99 cm"},
        }})  # fmt: skip
    found = {problem.path: problem for problem in caught.value.problems}
    for path in ("A.sigma", "B.material", "B.x0", "C.radius", "C.efficiency", "D", "F.pitch_x"):
        assert f"layer.{path}" in found, path
    assert "one of both" in str(found["layer.A.sigma"])
    assert "also radius" in str(found["layer.D"])
    with pytest.raises(DetectorError, match=r"layer\.VTX\.stereo: got 0\.5 mrad, expected at least 1 mrad"):
        with_layer(stereo="0.5 mrad")
    with pytest.raises(DetectorError, match=r"layer\.VTX\.sigma_tan: got 0\.05 mm and no sigma_v, expected a sigma"):
        load(
            {
                "base": "besiii-cgem-design",
                "layer": {
                    "VTX": {
                        "radius": "50 mm",
                        "sigma_x": "10 um",
                        "pitch_v": "1 mm",
                        "material": "Si",
                        "sigma_tan": "50 um",
                    }
                },
            }
        )
    with pytest.raises(DetectorError, match="no overlap with"):
        with_layer(radius="79 mm")


def test_keys_that_stand_for_several_values_are_varied():
    base = with_layer().with_overrides({"layer.VTX.sigma": "x2", "layer.VTX.x0": "x0.5"})
    assert base.layer["VTX"].errors == (0.02, 0.02)
    assert base.layer["VTX"].thickness == pytest.approx(0.15)
    assert with_layer().bounds("layer.VTX.sigma")[0] == 0
    key = "layer.VTX.sigma"
    slope = float(cg.sensitivity(with_layer(), "mu-", p=5.0, keys=[key]).of(key, "dr"))
    each = [f"{key}_{view}" for view in "xv"]
    apart = cg.sensitivity(with_layer(), "mu-", p=5.0, keys=each)
    assert slope == pytest.approx(sum(float(apart.of(one, "dr")) for one in each), rel=1e-3)
    assert slope > 0.1
