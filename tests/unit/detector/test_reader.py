"""Detector files: base and overrides, derived values, text that reads back equal, and their JSON Schema."""

import math
import pickle
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cgemit.detector import Detector, DetectorError, detectors, load, schema
from cgemit.detector.reader import NAME

SAMPLE = """
base = "besiii-cgem-design"          # everything not said here comes from the base
name = "thin-L1"
[field]
kind = "uniform"
bz = "-1 T"
[cgem.L1]
pitch_x = "500 um"
drift_gap = "3 mm"
[drift_chamber]
sigma = "110 um"
"""


def read_back(detector: Detector) -> Detector:
    return load(tomllib.loads(detector.to_toml()))


def test_sample_of_the_documentation(tmp_path: Path) -> None:
    (tmp_path / "thin.toml").write_text(SAMPLE, encoding="utf-8")
    detector, base = load(tmp_path / "thin.toml"), load("besiii-cgem-design")
    assert detector.name == "thin-L1"
    layer = detector.cgem[0]
    assert (layer.pitch_x, layer.pitch_v, layer.drift_gap) == (0.5, 0.65, 3.0)
    # floor(2 pi 87.5/0.5) strips of a sheet 549.78 mm wide, diagonal of 1098 pitches over 532 mm.
    assert layer.strips_x == 1099
    assert layer.stereo == pytest.approx(0.80112, abs=1e-5)
    assert detector.cgem[1:] == base.cgem[1:]
    assert {wire.sigma for wire in detector.drift_chamber.layers} == {0.11}


def test_example_of_the_methods_page() -> None:
    page = (Path(__file__).parents[3] / "docs" / "methods" / "detector.md").read_text(encoding="utf-8")
    detector = load(tomllib.loads(page.split("```toml")[1].split("```")[0]))
    assert [layer.label for layer in detector.cgem] == ["L1", "L3"]
    assert (detector.field.bz, detector.cgem[0].gas.name) == (0.9, "MyGas")
    assert (detector.drift_chamber.layers[0].sigma, detector.drift_chamber.layers[0].efficiency) == (0.11, 0.95)


@pytest.mark.parametrize("name", list(detectors()))
def test_presets_read_back_equal(name: str, tmp_path: Path) -> None:
    detector = load(name)
    path = tmp_path / "copy.toml"
    path.write_text(detector.to_toml(), encoding="utf-8")
    assert load(path) == detector
    assert load(str(path)) == detector
    assert hash(load(path)) == hash(detector)
    assert pickle.loads(pickle.dumps(detector)) == detector
    assert detector != detector.with_overrides({"field.bz": "1 T"})
    assert load(detector) is detector


lengths = st.floats(0.5, 8.0).map(lambda mm: f"{mm} mm")
pitches = st.floats(100, 2000).map(lambda um: f"{um} um")
layers = st.fixed_dictionaries(
    {},
    optional={
        "pitch_x": pitches,
        "pitch_v": pitches,
        "drift_gap": lengths,
        "transfer_gap": st.floats(1, 2.5).map(lambda mm: f"{mm} mm"),
        "length": st.floats(300, 900).map(lambda mm: f"{mm} mm"),
        "phi_first": st.floats(-360, 360).map(lambda deg: f"{deg} deg"),
        "stereo_sign": st.sampled_from([-1, 1]),
        "foils": st.integers(1, 3),
        "gas": st.sampled_from(["CgemGas", "Ar", "Own gas"]),
    },
)
variants = st.fixed_dictionaries(
    {
        "base": st.sampled_from(["besiii-cgem", "besiii-cgem-design"]),
        "name": st.from_regex(NAME, fullmatch=True),
        "description": st.text(),
        "materials": st.fixed_dictionaries(
            {
                "Own gas": st.fixed_dictionaries(
                    {
                        "density": st.floats(1e-4, 1e-2).map(lambda rho: f"{rho} g/cm3"),
                        "composition": st.sampled_from(["Ar", "CF4", "C4H10", {"Ar": 0.7, "C": 0.1, "O": 0.2}]),
                        "gas": st.just(True),
                    }
                )
            }
        ),
    },
    optional={
        "cgem": st.dictionaries(st.sampled_from(["L1", "L2", "L3"]), layers),
        "field": st.floats(0.1, 3).map(lambda tesla: {"bz": f"{tesla} T"}),
        "drift_chamber": st.floats(10, 500).map(lambda um: {"sigma": f"{um} um", "wires": "smeared"}),
        "walls": st.dictionaries(
            st.from_regex(NAME, fullmatch=True),
            st.just({"r_in": "185 mm", "r_out": "186 mm", "half_length": "54 cm", "material": "Al"}),
            max_size=1,
        ),
        "remove": st.sampled_from([[], ["cgem.L1"], ["beam_pipe"], ["walls"]]),
    },
)


@pytest.mark.slow
@given(variants)
def test_any_variant_reads_back_equal(tables: dict[str, Any]) -> None:
    if tables.get("remove") == ["cgem.L1"]:
        tables.get("cgem", {}).pop("L1", None)
    detector = load(tables)
    assert read_back(detector) == detector
    assert detector.with_overrides({}) == detector


def test_strip_counts_of_the_base_do_not_outlive_its_pitch() -> None:
    base = load("besiii-cgem")  # states 630 strips of 660 um
    assert base.with_overrides({"cgem.L2.drift_gap": "3 mm"}).cgem[1].strips_x == 630
    wide = base.with_overrides({"cgem.L2.pitch_x": "700 um"}).cgem[1]
    assert (wide.strips_x, wide.stereo < 0) == (594, True)
    fine = base.with_overrides({"cgem.L2.pitch_v": "330 um"}).cgem[1]
    assert (fine.strips_x, fine.stereo, fine.strips_v) == (630, base.cgem[1].stereo, 2155)
    turned = base.with_overrides({"cgem.L2.stereo_sign": 1}).cgem[1]
    assert (turned.stereo, turned.strips_v) == (-base.cgem[1].stereo, 1077)
    for key, value in (("length", "500 mm"), ("pitch_x", "700 um"), ("anode_radius", "130 mm"), ("sheets", 3)):
        layer = base.with_overrides({f"cgem.L2.{key}": value}).cgem[1]
        # The V strips run along a diagonal of the X strips, and cover the sheet.
        diagonal = math.atan2((layer.strips_x - 1) * layer.pitch_x, layer.length)
        assert layer.stereo == pytest.approx(-diagonal, rel=1e-12), key
        width = 2 * math.pi * layer.r_readout / layer.sheets
        assert layer.strips_x == math.floor(width / layer.pitch_x), key
    stated = base.with_overrides({"cgem.L2.pitch_x": "700 um", "cgem.L2.strips_x": 500}).cgem[1]
    assert stated.strips_x == 500


def test_a_new_layer_may_be_added() -> None:
    base = load("besiii-cgem-design")
    outer = tomllib.loads(base.to_toml())["cgem"]["L3"]
    for name in ("strips_x", "stereo", "strips_v"):
        del outer[name]
    inner = {**outer, "anode_radius": "60 mm", "length": "400 mm", "sheets": 1}
    detector = load({"base": "besiii-cgem-design", "cgem": {"L0": inner}})
    assert [layer.label for layer in detector.cgem] == ["L0", "L1", "L2", "L3"]
    assert detector.cgem[1:] == base.cgem


def test_common_value_of_the_chamber_replaces_those_of_the_layers() -> None:
    variant = {"base": "besiii-idc-boss", "drift_chamber": {"sigma": "100 um", "layers": {"3": {"sigma": "90 um"}}}}
    layers = load(variant).drift_chamber.layers
    assert [(layer.sigma, layer.sigma_slope) for layer in layers[2:5]] == [(0.1, 0), (0.09, 0), (0.1, 0)]
    kept = load({"base": "besiii-idc-boss", "drift_chamber": {"efficiency": 0.98}}).drift_chamber.layers
    assert (kept[0].sigma, kept[0].efficiency) == (0.299, 0.98)


def test_bases_may_be_files(tmp_path: Path) -> None:
    (tmp_path / "first.toml").write_text('base = "besiii-idc"\n[field]\nbz = "0.9 T"\n', encoding="utf-8")
    (tmp_path / "second.toml").write_text('base = "first.toml"\n[drift_chamber]\nsigma = "1 mm"\n', encoding="utf-8")
    detector = load(tmp_path / "second.toml")
    assert detector.name == "second"
    assert detector.description == "variant of first.toml"
    assert detector.field.bz == 0.9
    assert detector.drift_chamber.layers[0].sigma == 1.0


def test_bases_that_lead_in_a_circle(tmp_path: Path) -> None:
    for one, other in (("a", "b"), ("b", "a")):
        (tmp_path / f"{one}.toml").write_text(f'base = "{other}.toml"', encoding="utf-8")
    with pytest.raises(DetectorError) as caught:
        load(tmp_path / "a.toml")
    assert [problem.path for problem in caught.value.problems] == ["base"]


def test_overrides_name_the_result() -> None:
    base = load("besiii-idc")
    changed = base.with_overrides({"field.bz": "0.9 T"})
    assert changed.name == "besiii-idc+field.bz=0.9T"
    assert changed.with_overrides({"drift_chamber.sigma": "1 mm"}).name.endswith(
        "+field.bz=0.9T+drift_chamber.sigma=1mm"
    )
    assert base.with_overrides({"name": "mine"}).name == "mine"


def test_detectors_print_themselves() -> None:
    detector = load("besiii-cgem-design")
    assert "cgem L1" in repr(detector)
    assert "845 X" in repr(detector)
    assert len(repr(detector).splitlines()) < 10
    html = detector.with_overrides({"name": "<b>"})._repr_html_()
    assert "&lt;b&gt;" in html
    assert "35 layers" in html


VALIDATOR = jsonschema.Draft202012Validator(schema())
FILES = sorted(
    entry.name for entry in (resources.files("cgemit.detector") / "presets").iterdir() if entry.name.endswith(".toml")
)


def test_it_is_a_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(schema())


@pytest.mark.parametrize("name", FILES)
def test_presets_and_their_parts(name: str) -> None:
    text = (resources.files("cgemit.detector") / "presets" / name).read_text(encoding="utf-8")
    tables = tomllib.loads(text)
    if name == "_materials.toml":
        tables["base"] = "besiii-cgem"  # materials alone are not a detector
    VALIDATOR.validate(tables)


@pytest.mark.parametrize("name", list(detectors()))
def test_complete_files(name: str) -> None:
    tables = tomllib.loads(load(name).to_toml())
    assert "base" not in tables
    VALIDATOR.validate(tables)


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"nmae": "x"}, "$"),
        ({"cgem": {"L1": {"pitch_x": "650"}}}, "$.cgem.L1.pitch_x"),
        ({"cgem": {"L1": {"pitch_x": 650}}}, "$.cgem.L1.pitch_x"),
        ({"cgem": {"L1": {"pitch_x": "650 T"}}}, "$.cgem.L1.pitch_x"),
        ({"cgem": {"L1": {"ptich_x": "650 um"}}}, "$.cgem.L1"),
        ({"cgem": {"L1": {"sheets": 9}}}, "$.cgem.L1.sheets"),
        ({"cgem": {"L1": {"foil": [{"material": "Cu"}]}}}, "$.cgem.L1.foil[0]"),
        ({"drift_chamber": {"wires": "thick"}}, "$.drift_chamber.wires"),
        ({"drift_chamber": {"layers": {"nine": {}}}}, "$.drift_chamber.layers"),
        ({"materials": {"Own": {"density": "1 g/cm3"}}}, "$.materials.Own"),
    ],
)
def test_mistakes(change: dict[str, Any], path: str) -> None:
    tables = {"base": "besiii-cgem", **change}
    assert [error.json_path for error in VALIDATOR.iter_errors(tables)] == [path]


def test_without_a_base_parts_must_be_complete() -> None:
    tables = tomllib.loads(load("besiii-idc").to_toml())
    del tables["walls"]["inner-wall-cfrp"]["material"]
    del tables["drift_chamber"]["layers"]["3"]["cells"]
    found = sorted(error.message for error in VALIDATOR.iter_errors(tables))
    assert found == ["'cells' is a required property", "'material' is a required property"]
    assert not VALIDATOR.is_valid({"name": "empty"})


@pytest.mark.parametrize(("name", "good"), [("thin L1 (µ)", True), ("", False), ("a\nb", False), ("../evil", False)])
def test_names(name: str, good: bool) -> None:
    assert VALIDATOR.is_valid({"base": "besiii-idc", "name": name}) == good


def test_every_key_is_documented() -> None:
    def walk(node: Any) -> None:
        if isinstance(node, dict):
            for name, inner in node.get("properties", {}).items() if isinstance(node.get("properties"), dict) else ():
                assert "description" in inner or name in ("layers", "c", "x0", "x1", "a", "k"), name
            for inner in node.values():
                walk(inner)

    walk(schema())
