"""The JSON Schema accepts every preset and what is written, and refuses mistakes."""

import tomllib
from importlib import resources
from typing import Any

import jsonschema
import pytest

from cgemit.detector import detectors, load, schema

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
