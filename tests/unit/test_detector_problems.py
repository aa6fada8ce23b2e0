"""Mistakes in detector files: all are reported at once, each with its place, what was given and what was expected."""

import dataclasses
import math
import pickle
from pathlib import Path
from typing import Any

import pytest

from cgemit.detector import DetectorError, Problem, load

TEN_MISTAKES = """
base = "besiii-cgem-design"
nmae = "ten mistakes"
[field]
bz = "1 mm"
[cgem.L1]
pitch_x = "650"
drift_gap = "-5 mm"
gas = "CgemGaz"
[cgem.L2]
strips_x = 900
ptich_v = "650 um"
[cgem.L3]
anode_radius = "nan mm"
[walls.shield]
r_in = "140 mm"
r_out = "139 mm"
half_length = "500 mm"
material = "Al"
[walls.collar]
r_in = "130 mm"
r_out = "131 mm"
half_length = "500 mm"
material = "Al"
"""


WALL = {"half_length": "1 m", "material": "Al"}


def problems(tables: Any) -> dict[str, Problem]:
    with pytest.raises(DetectorError) as caught:
        load(tables)
    assert isinstance(caught.value, ValueError)
    return {problem.path: problem for problem in caught.value.problems}


def test_ten_mistakes_give_ten_messages(tmp_path: Path) -> None:
    path = tmp_path / "ten.toml"
    path.write_text(TEN_MISTAKES, encoding="utf-8")
    found = problems(path)
    expected = {
        "nmae": ("unknown key", "name", 'did you mean "name"?'),
        "field.bz": ('"1 mm" (a length)', "a field", ""),
        "cgem.L1.pitch_x": ("no unit", "a length", '"650 um"'),
        "cgem.L1.drift_gap": ("-5 mm", "from 0.1 to 50 mm", ""),
        "cgem.L1.gas": ("CgemGaz", "CgemGas", 'did you mean "CgemGas"?'),
        "cgem.L2.strips_x": ("900 strips", "at most 640", ""),
        "cgem.L2.ptich_v": ("unknown key", "pitch_v", 'did you mean "pitch_v"?'),
        "cgem.L3.anode_radius": ("not finite", "a length", ""),
        "walls.shield.r_out": ("139 mm", "more than r_in = 140 mm", ""),
        "walls.collar": ("130.0000 to 131.0000", "no overlap with cgem.L2", ""),
    }
    assert found.keys() == expected.keys()
    for path_to_value, (given, wanted, hint) in expected.items():
        problem = found[path_to_value]
        assert given in problem.given
        assert wanted in problem.expected
        assert hint in problem.hint
    with pytest.raises(DetectorError) as caught:
        load(path)
    text = str(caught.value)
    assert len(text.splitlines()) == 11
    assert all(name in text for name in expected)


@pytest.mark.parametrize(
    ("change", "path", "given"),
    [
        ({"cgem": {"L1": {"sheets": 9}}}, "cgem.L1.sheets", "9"),
        ({"cgem": {"L1": {"sheets": 1.0}}}, "cgem.L1.sheets", "1.0"),
        ({"cgem": {"L1": {"sheets": True}}}, "cgem.L1.sheets", "true"),
        ({"cgem": {"L1": {"stereo_sign": 0}}}, "cgem.L1.stereo_sign", "0"),
        ({"cgem": {"L1": {"stereo": "0.5 deg"}}}, "cgem.L1.stereo", "0.5 deg"),
        ({"cgem": {"L1": {"strips_v": 5000}}}, "cgem.L1.strips_v", "5000 strips"),
        ({"cgem": {"L1": {"pitch_x": "1 m"}}}, "cgem.L1.pitch_x", '"1 m" = 1000 mm'),
        ({"cgem": {"L1": {"cathode": []}}}, "cgem.L1.cathode", "a list of 0"),
        ({"cgem": {"L1": {"cathode": "Cu"}}}, "cgem.L1.cathode", '"Cu"'),
        ({"cgem": {"L1": {"foil": [{"material": "Cu"}]}}}, "cgem.L1.foil[0]", "only material"),
        ({"cgem": {"L1": {"foil": [{"material": 3, "thickness": "3 um"}]}}}, "cgem.L1.foil[0].material", "3"),
        ({"cgem": {"L1": {"foil": ["Cu"]}}}, "cgem.L1.foil[0]", '"Cu"'),
        ({"cgem": {"L2": {"drift_gap": "40 mm"}}}, "cgem.L2", "r = 84.198"),
        ({"cgem": {"l1": {"drift_gap": "4 mm"}}}, "cgem.l1", "only drift_gap"),
        ({"cgem": {"L1": 3}}, "cgem.L1", "3"),
        ({"cgem": 3}, "cgem", "3"),
        ({"walls": {"w": {**WALL, "r_in": "1 cm", "r_out": "30 cm"}}}, "walls.w.r_out", "thickness of 290 mm"),
        ({"walls": {"w": {**WALL, "r_in": "180 mm", "r_out": "183 mm"}}}, "walls.w", "r = 180"),
        ({"drift_chamber": {"wires": "smear"}}, "drift_chamber.wires", '"smear"'),
        ({"drift_chamber": {"efficiency": "120 %"}}, "drift_chamber.efficiency", '"120 %"'),
        ({"drift_chamber": {"sigma": "110"}}, "drift_chamber.sigma", "no unit"),
        ({"drift_chamber": {"layers": {"nine": {}}}}, "drift_chamber.layers.nine", '"nine"'),
        ({"drift_chamber": {"layers": {"9": {"r_end": "196 mm"}}}}, "drift_chamber.layers.9.r_end", "196 mm"),
        ({"drift_chamber": {"layers": {"9": {"twist_cells": 40}}}}, "drift_chamber.layers.9.twist_cells", "40 cells"),
        ({"drift_chamber": {"layers": {"9": {"sigma_slope": -0.05}}}}, "drift_chamber.layers.9.sigma_slope", "-0.05"),
        ({"drift_chamber": {"layers": {"9": {"sigma_slope": "-50 um/mm"}}}}, "drift_chamber.layers.9.sigma_slope",
         "an error of"),
        ({"cgem": {"L1": {"gas": "Kapton"}}}, "cgem.L1.gas", '"Kapton", which is no gas'),
        ({"drift_chamber": {"gas": "Al"}}, "drift_chamber.gas", '"Al", which is no gas'),
        ({"field": {"bz": "0 T"}}, "field.bz", "0 T"),
        ({"field": {"kind": "dipole"}}, "field.kind", "dipole"),
        ({"name": 3}, "name", "3"),
        ({"name": ""}, "name", '""'),
        ({"name": " "}, "name", '" "'),
        ({"name": "a\nb"}, "name", r'"a\nb"'),
        ({"name": "../../evil"}, "name", '"../../evil"'),
        ({"name": "a\\b"}, "name", r'"a\\b"'),
        ({"remove": ["cgem.L9"]}, "remove", "cgem.L9"),
        ({"remove": "cgem"}, "remove", "cgem"),
        ({"remove": ["cgem", "drift_chamber"]}, "", "no detector"),
        ({"remove": ["field"]}, "field", "nothing"),
        ({"base": "besiii-cgm"}, "base", "besiii-cgm"),
        ({"base": 3}, "base", "3"),
    ],
)  # fmt: skip
def test_one_mistake_gives_one_message(change: dict[str, Any], path: str, given: str) -> None:
    found = problems({"base": "besiii-cgem-design", **change})
    assert list(found) == [path]
    assert given in found[path].given


def test_a_part_that_cannot_be_read_does_not_hide_what_else_is_wrong_with_it() -> None:
    layer = {"length": "690", "strips_x": 900, "drift_gap": "40 mm"}
    found = problems({"base": "besiii-cgem-design", "cgem": {"L2": layer}})
    assert found.keys() == {"cgem.L2.length", "cgem.L2.strips_x", "cgem.L2"}


def test_unknown_base_does_not_hide_other_mistakes() -> None:
    tables = {"base": "besiii-cgm", "cgem": {"L1": {"pitch_x": 3}}, "filed": {}}
    found = problems(tables)
    assert found.keys() == {"base", "cgem.L1.pitch_x", "filed"}
    assert found["base"].hint == 'did you mean "besiii-cgem"?'


def test_syntax_errors_say_where(tmp_path: Path) -> None:
    path = tmp_path / "broken.toml"
    path.write_text('base = "besiii-cgem"\n[cgem.L1\n', encoding="utf-8")
    assert "line 2" in problems(path)[""].given
    path.write_bytes(b"name = '\xff'")
    assert "utf-8" in problems(path)[""].given


def test_unknown_names() -> None:
    assert "besiii-idc-boss" in problems("besiii-idc-bos")[""].hint
    assert "besiii-cgem" in problems("no/such/file.toml")[""].expected


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({1: 2}, "1"),
        ({"cgem": {"L1": {1: 2}}}, "cgem.L1.1"),
        ({"cgem": {1: {}}}, "cgem.1"),
        ({"field": {None: 2}}, "field.None"),
        ({"cgem": {"new": {1: 2}}}, "cgem.new.1"),
    ],
)
def test_keys_that_are_no_text(change: dict[Any, Any], path: str) -> None:
    """Mappings made in Python may have any key; what is none of a detector file is unknown."""
    found = problems({"base": "besiii-cgem", **change})
    assert "unknown key" in found[path].given or "table" in found[path].given


def test_wrong_override_paths() -> None:
    detector = load("besiii-cgem-design")
    for overrides, path in (
        ({"cgem.L2.ptich_x": "500 um"}, "cgem.L2.ptich_x"),
        ({"cgme.L2.pitch_x": "500 um"}, "cgme"),
        ({"field.bz": "1 T", "field.bz.x": "1 T"}, "field.bz.x"),
    ):
        with pytest.raises(DetectorError) as caught:
            detector.with_overrides(overrides)
        assert caught.value.problems[0].path == path


def test_detectors_made_in_python_are_checked_too() -> None:
    detector = load("besiii-cgem-design")
    layer = dataclasses.replace(detector.cgem[0], pitch_x=-1.0, strips_v=10_000)
    with pytest.raises(DetectorError) as caught:
        dataclasses.replace(detector, cgem=(layer, *detector.cgem[1:]))
    assert [problem.path for problem in caught.value.problems] == ["cgem.L1.pitch_x", "cgem.L1.strips_v"]
    with pytest.raises(DetectorError, match=r"field\.bz"):
        dataclasses.replace(detector, field=dataclasses.replace(detector.field, bz=math.nan))
    solid = dataclasses.replace(detector.cgem[0], gas=detector.cgem[0].foil[0].material)
    with pytest.raises(DetectorError, match=r"cgem\.L1\.gas: .*which is no gas"):
        dataclasses.replace(detector, cgem=(solid, *detector.cgem[1:]))
    with pytest.raises(DetectorError, match="overlap"):
        dataclasses.replace(detector, cgem=(detector.cgem[0], *detector.cgem))


def test_errors_pickle() -> None:
    with pytest.raises(DetectorError) as caught:
        load({"base": "besiii-cgem", "name": 3})
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (str(copy), copy.problems) == (str(caught.value), caught.value.problems)
