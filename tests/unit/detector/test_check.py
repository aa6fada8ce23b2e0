"""Mistakes and limits of detector files: all are reported at once, each with its place and what was expected."""

import dataclasses
import math
import pickle
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text

import cgemit as cg
from cgemit.analysis.curves import Line
from cgemit.cli.main import main
from cgemit.detector import DetectorError, Problem, describe, load, schema, write_field_map
from cgemit.detector.build import library
from cgemit.draw.curves import draw_probabilities, draw_pulls, draw_resolutions
from cgemit.draw.detector import draw_detector, draw_layers, draw_sides

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


def paths(tables: Any) -> list[str]:
    """Return the paths of all problems of a detector that may have none."""
    try:
        load(tables)
    except DetectorError as error:
        return [problem.path for problem in error.problems]
    return []


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
        ({"walls": {"w": {**WALL, "r_in": "1 cm", "r_out": "130 cm"}}}, "walls.w.r_out", "thickness of 1290 mm"),
        ({"walls": {"w": {**WALL, "r_in": "180 mm", "r_out": "183 mm"}}}, "walls.w", "r = 180"),
        ({"drift_chamber": {"wires": "smear"}}, "drift_chamber.wires", '"smear"'),
        ({"drift_chamber": {"efficiency": "120 %"}}, "drift_chamber.efficiency", '"120 %"'),
        ({"drift_chamber": {"sigma": "110"}}, "drift_chamber.sigma", "no unit"),
        ({"drift_chamber": {"layers": {"nine": {}}}}, "drift_chamber.layers.nine", '"nine"'),
        ({"drift_chamber": {"layers": {"9": {"r_end": "196 mm"}}}}, "drift_chamber.layers.9", "r = 196 mm"),
        ({"drift_chamber": {"layers": {"9": {"twist_cells": 40}}}}, "drift_chamber.layers.9.twist_cells", "40 cells"),
        ({"drift_chamber": {"layers": {"9": {"sigma_slope": -0.05}}}}, "drift_chamber.layers.9.sigma_slope", "-0.05"),
        ({"drift_chamber": {"layers": {"9": {"sigma_slope": "-50 um/mm"}}}}, "drift_chamber.layers.9.sigma_slope",
         "an error of"),
        ({"drift_chamber": {"layers": {"9": {"sigma_slope": "-12 um/mm"}}}}, "drift_chamber.layers.9.sigma_slope",
         "an error of -0.0180137 mm at 12.3 mm"),  # in an outer corner, not at 8.8 mm
        ({"cgem": {"L1": {"gas": "Kapton"}}}, "cgem.L1.gas", '"Kapton", which is no gas'),
        ({"drift_chamber": {"gas": "Al"}}, "drift_chamber.gas", '"Al", which is no gas'),
        ({"field": {"bz": "11 T"}}, "field.bz", "11 T"),
        ({"field": {"kind": "dipole"}}, "field.kind", "dipole"),
        ({"name": 3}, "name", "3"),
        ({"name": ""}, "name", '""'),
        ({"name": " "}, "name", '" "'),
        ({"name": "a\nb"}, "name", r'"a\nb"'),
        ({"name": "../../evil"}, "name", '"../../evil"'),
        ({"name": "a\\b"}, "name", r'"a\\b"'),
        ({"remove": ["cgem.L9"]}, "remove", "cgem.L9"),
        ({"remove": "cgem"}, "remove", "cgem"),
        ({"remove": ["cgem", "drift_chamber"]}, "", "nothing that measures"),
        (
            {"remove": ["cgem", "drift_chamber"], "layer": {"SHELL": {"radius": "5 cm", "material": "Al"}}},
            "", "nothing that measures",
        ),
        (
            {"remove": ["cgem", "drift_chamber"], "layer": {"P": {"radius": "5 cm", "material": "Si", "sigma": "5"}}},
            "layer.P.sigma", "5",
        ),
        ({"remove": ["field"]}, "field", "nothing"),
        ({"base": "besiii-cgm"}, "base", "besiii-cgm"),
        ({"base": 3}, "base", "3"),
    ],
)  # fmt: skip
def test_one_mistake_gives_one_message(change: dict[str, Any], path: str, given: str) -> None:
    found = problems({"base": "besiii-cgem-design", **change})
    assert list(found) == [path]
    assert given in found[path].given


@pytest.mark.parametrize(
    ("layer", "path", "named"),
    [
        (
            {"anode_radius": "1.9 m", "pitch_x": "0.1 mm"},
            "strips_x",
            ("anode_radius = 1900", "sheets", "pitch_x = 0.1"),
        ),
        ({"anode_radius": "1.9 m", "length": "100 mm"}, "stereo", ("anode_radius = 1900", "sheets", "length = 100")),
        ({"sheets": 8, "anode_radius": "11 mm"}, "stereo", ("anode_radius", "sheets = 8", "length")),
    ],
)
def test_values_that_follow_from_others_name_them(layer: dict[str, Any], path: str, named: tuple[str, ...]) -> None:
    problem = problems({"base": "besiii-cgem-design", "cgem": {"L1": layer}})[f"cgem.L1.{path}"]
    assert all(text in problem.hint for text in named)


def test_an_inner_face_below_0_overlaps_nothing() -> None:
    tables = {"base": DESIGN, "remove": ["beam_pipe"], "cgem": {"L1": {"anode_radius": "11 mm", "stereo": "40 deg"}}}
    assert paths(tables) == ["cgem.L1"]


def test_radii_of_3_m_are_possible() -> None:
    layer = {"anode_radius": "3 m", "length": "3 m"}
    detector = load({"base": "besiii-cgem-design", "remove": ["drift_chamber", "walls"], "cgem": {"L3": layer}})
    assert detector.cgem[-1].anode_radius == 3000


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
        dataclasses.replace(detector, barrels=(layer, *detector.cgem[1:]))
    assert [problem.path for problem in caught.value.problems] == ["cgem.L1.pitch_x", "cgem.L1.strips_v"]
    with pytest.raises(DetectorError, match=r"field\.bz"):
        dataclasses.replace(detector, field=dataclasses.replace(detector.field, bz=math.nan))
    solid = dataclasses.replace(detector.cgem[0], gas=detector.cgem[0].foil[0].material)
    with pytest.raises(DetectorError, match=r"cgem\.L1\.gas: .*which is no gas"):
        dataclasses.replace(detector, barrels=(solid, *detector.cgem[1:]))
    with pytest.raises(DetectorError, match="overlap"):
        dataclasses.replace(detector, barrels=(detector.cgem[0], *detector.cgem))


@pytest.mark.parametrize("wrong", [{"half_length": 0.0}, {"cells": 0}])
def test_wire_layers_made_in_python_are_checked_too(wrong: dict[str, Any]) -> None:
    detector = load("besiii-idc")
    chamber = detector.drift_chamber
    assert chamber
    layers = (dataclasses.replace(chamber.layers[0], **wrong), *chamber.layers[1:])
    with pytest.raises(DetectorError) as caught:
        dataclasses.replace(detector, drift_chamber=dataclasses.replace(chamber, layers=layers))
    path = f"drift_chamber.layers.{chamber.layers[0].number}.{next(iter(wrong))}"
    assert [problem.path for problem in caught.value.problems] == [path]


def chamber_of(layers: list[dict[str, Any]], walls: dict[str, Any] | None = None) -> dict[str, Any]:
    rows = {str(i): {"phi_east": "0 rad", "sigma": "100 um", **layer} for i, layer in enumerate(layers)}
    return {
        "name": "chamber", "field": {"bz": "2 T"}, "walls": walls or {},
        "drift_chamber": {"gas": "MdcGas", "layers": rows},
    }  # fmt: skip


def sampled_radii(layer: dict[str, Any], z: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the distance from the beam line of points on the straight line between the ends of a wire."""
    r, h = layer["_r"], layer["_h"]
    turn = layer["twist_cells"] * 2 * math.pi / layer["cells"]
    east, west = np.array([r, 0, h]), np.array([r * math.cos(turn), -r * math.sin(turn), -h])
    points = west + (z[:, None] + h) / (2 * h) * (east - west)
    return np.asarray(np.hypot(points[:, 0], points[:, 1]))


def random_wires(rng: np.random.Generator, r: float) -> dict[str, Any]:
    cells, h = int(rng.integers(50, 200)), float(rng.uniform(500, 900))
    twist = float(rng.choice([0.0, *rng.uniform(-0.6, 0.6, 2)])) * cells / (2 * math.pi)
    return {"cells": cells, "twist_cells": twist, "r_end": f"{r!r} mm", "half_length": f"{h!r} mm", "_r": r, "_h": h}


def test_wire_layers_may_be_nested_hyperboloids() -> None:
    """Random pairs of layers, and of a layer and a wall, against the distances of many points on their wires."""
    rng = np.random.default_rng(1)
    seen = {"nested": 0, "crossing": 0, "bands overlap, wires do not": 0, "free": 0, "hit": 0}
    for _ in range(200):
        inner, outer = random_wires(rng, 300.0), random_wires(rng, 300 + float(rng.uniform(0, 12)))
        wall_r, wall_h = float(rng.uniform(280, 302)), float(rng.uniform(50, 900))
        both = np.linspace(0, min(inner["_h"], outer["_h"]), 400)
        crosses = bool((sampled_radii(inner, both) >= sampled_radii(outer, both)).any())
        at_wall = sampled_radii(inner, np.linspace(0, min(inner["_h"], wall_h), 400))
        hit = bool(at_wall[0] < wall_r + 1 and at_wall[-1] > wall_r)
        seen["crossing" if crosses else "nested"] += 1
        seen["hit" if hit else "free"] += 1
        seen["bands overlap, wires do not"] += not crosses and sampled_radii(outer, both)[0] < 300
        layers = [{name: value for name, value in one.items() if name[0] != "_"} for one in (inner, outer)]
        assert paths(chamber_of(layers)) == (["drift_chamber.layers.1"] if crosses else [])
        wall = {"r_in": f"{wall_r!r} mm", "r_out": f"{wall_r + 1!r} mm", "half_length": f"{wall_h!r} mm"}
        found = paths(chamber_of(layers[:1], {"w": wall | {"material": "Al"}}))
        assert found == (["walls.w"] if hit else [])
    assert min(seen.values()) > 10, seen


def test_wires_of_layers_that_are_no_neighbours_are_compared_where_others_end() -> None:
    """A layer between two long ones ends before the inner one meets the outer one: 300 mm becomes hypot(300, 60)."""
    long = {"cells": 100, "r_end": "306 mm", "half_length": "900 mm", "twist_cells": 6.25}
    short = {"cells": 100, "r_end": "303 mm", "half_length": "100 mm", "twist_cells": 0.0}
    layers = [long, short, short | {"r_end": "305 mm", "half_length": "900 mm"}]
    inner = 306 * math.cos(math.pi * 6.25 / 100)
    found = problems(chamber_of(layers))
    assert list(found) == ["drift_chamber.layers.2"]
    assert "more than the 306 mm of layer 0 there" in found["drift_chamber.layers.2"].expected
    assert inner < 303
    assert paths(chamber_of([*layers[:2], layers[2] | {"r_end": "307 mm"}])) == []


def test_smeared_wires_need_matter() -> None:
    layer = {"cells": 100, "r_end": "300 mm", "half_length": "900 mm", "twist_cells": 0.0}
    smeared = chamber_of([layer, layer | {"r_end": "310 mm"}])
    smeared["drift_chamber"]["wires"] = "smeared"
    found = problems(smeared)
    assert {path: one.given for path, one in found.items()} == {
        "drift_chamber.wires": '"smeared" and no matter of any wires'
    }
    smeared["drift_chamber"]["layers"]["1"]["wire_x0"] = 1e-5
    assert paths(smeared) == []


@pytest.mark.parametrize("view", ["x", "v"])
def test_a_coordinate_has_an_error_or_a_pitch(view: str) -> None:
    layer = {"radius": "50 mm", "material": "Si", f"pitch_{view}": "50 um"}
    tables = {"field": {"bz": "1 T"}, "layer": {"P": layer | {f"sigma_{view}": "5 um"}}}
    found = problems(tables)[f"layer.P.pitch_{view}"]
    assert found.given == f"0.05 mm and sigma_{view} = 0.005 mm"
    assert "one of them" in found.expected
    both = {"radius": "50 mm", "material": "Si", "pitch": "50 um", "sigma": "5 um"}
    assert paths(tables | {"layer": {"P": both}}) == ["layer.P.pitch_x", "layer.P.pitch_v"]
    other = layer | {f"sigma_{'v' if view == 'x' else 'x'}": "5 um"}
    assert paths(tables | {"layer": {"P": other}}) == []


def idea() -> dict[str, Any]:
    """Return 112 layers at 0.35 to 2 m turned by 30 degrees, so at 50 to 250 mrad, of alternating sign (IDEA)."""
    layers = []
    for i in range(112):
        r, cells = (350 + 1600 / 111 * i) / math.cos(math.radians(15)), 192 + 48 * (i // 8)
        turn = (-1) ** i * cells / 12
        layers.append({"cells": cells, "r_end": f"{r!r} mm", "half_length": "2 m", "twist_cells": turn})
    return chamber_of(layers)


def test_the_stereo_angles_of_idea_are_possible() -> None:
    """Each wire layer has a hit of a track that crosses all of them, near the ends of the chamber, too."""
    gun = cg.Gun("mu-", p=10, cos_theta=[0.0, 0.4, -0.69])
    result = cg.run(load(idea()), gun, 30, 1, until="cluster", workers=cg.Workers(threads=1))
    hits = result.tables["wire_hits"]
    for event in range(30):
        assert len(np.unique(hits["layer"][hits["event"] == event])) == 112


def test_errors_pickle() -> None:
    with pytest.raises(DetectorError) as caught:
        load({"base": "besiii-cgem", "name": 3})
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (str(copy), copy.problems) == (str(caught.value), caught.value.problems)


IDC = "besiii-idc"
DESIGN = "besiii-cgem-design"
LAYER = next(iter(tomllib.loads(load(IDC).to_toml())["drift_chamber"]["layers"].values()))


def problems_limits(tables):
    """Return the paths of the problems of a detector, whose message is short."""
    with pytest.raises(DetectorError) as caught:
        load(tables)
    assert len(str(caught.value)) < 2000
    return [problem.path for problem in caught.value.problems]


DIGITS = "1" * 400


@pytest.mark.parametrize(
    ("changes", "path"),
    [
        ({"field": {"kind": [1, 2, 3]}}, "field.kind"),
        ({"field": {"bz": f"{DIGITS} T"}}, "field.bz"),
        ({"field": {"bz": int(DIGITS)}}, "field.bz"),
        ({"drift_chamber": {"sigma_slope": int(DIGITS)}}, "drift_chamber.sigma_slope"),
        ({"drift_chamber": {"efficiency": int(DIGITS)}}, "drift_chamber.efficiency"),
        ({"drift_chamber": {"first_gid": int(DIGITS)}}, "drift_chamber.first_gid"),
        ({"drift_chamber": {"layers": {"65536": LAYER}}}, "drift_chamber.layers.65536"),
        ({"drift_chamber": {"layers": {"-1": LAYER}}}, "drift_chamber.layers.-1"),
        ({"drift_chamber": {"layers": {"08": LAYER}}}, "drift_chamber.layers.08"),
        ({"drift_chamber": {"layers": {"٣": LAYER}}}, "drift_chamber.layers.٣"),
        ({"drift_chamber": {"layers": {str(n): LAYER for n in range(100, 1101)}}}, "drift_chamber.layers"),
        ({"cgem": {f"L{n}": {} for n in range(101)}}, "cgem"),
        ({"beam_pipe": {f"p{n}": {} for n in range(101)}}, "beam_pipe"),
        ({"name": "."}, "name"),
        ({"name": ".."}, "name"),
        ({"name": "a" * 101}, "name"),
        ({"name": "a\x07b"}, "name"),
        ({"name": "a\u202eb"}, "name"),
        ({"beam_pipe": {"a/b": {}}}, 'beam_pipe."a/b"'),
    ],
)
def test_limits_of_detector_files(changes, path):
    assert path in problems_limits({"base": IDC, **changes})


@pytest.mark.parametrize("base", ["b" * 5000, "a\0b", "/" + "d/" * 3000, ["x"], "~", ""])
def test_bases_that_cannot_be(base):
    assert problems_limits({"base": base}) == ["base"]


def test_a_base_is_the_file_itself_however_it_is_written(tmp_path):
    (tmp_path / "deep").mkdir()
    for spelling in ("x.toml", "./x.toml", "deep/../x.toml", str(tmp_path / "x.toml")):
        (tmp_path / "x.toml").write_text(f'base = "{spelling}"\n')
        assert problems_limits(tmp_path / "x.toml") == ["base"]
    (tmp_path / "x.toml").write_text('base = "besiii-idc"\nname = "x"\n')
    (tmp_path / "y.toml").write_text('base = "./x.toml"\n')
    assert load(tmp_path / "y.toml").drift_chamber == load(IDC).drift_chamber
    # A table may have the name of its base.
    assert load({"base": IDC, "name": IDC}) == load({"base": IDC, "name": IDC, "description": "variant of besiii-idc"})


def test_nested_tables_without_end():
    tables = {"base": IDC}
    inner = tables
    for _ in range(5000):
        inner["field"] = {}
        inner = inner["field"]
    with pytest.raises(DetectorError):
        load(tables)


def test_limits_of_maps(tmp_path):
    axis = np.linspace(0, 100, 5)
    columns = {"r": axis, "z": axis, "br": np.zeros((5, 5)), "bz": np.full((5, 5), 11.0)}
    with pytest.raises(DetectorError, match=r"bz: got up to 11 T, expected at most 10 T"):
        write_field_map(tmp_path / "map.npz", columns)
    long = np.linspace(0, 100, 5001)
    with pytest.raises(DetectorError, match=r"z: got shape .5001,., expected one dimension of 4 to 5000 points"):
        write_field_map(
            tmp_path / "map.npz", columns | {"z": long, "br": np.zeros((5, 5001)), "bz": np.ones((5, 5001))}
        )
    rows = "\n".join(f"{i},{i},{i},0,0,1" for i in range(3000))
    (tmp_path / "map.csv").write_text("x[mm],y[mm],z[mm],bx[T],by[T],bz[T]\n" + rows)
    # Such a grid would not fit into memory.
    with pytest.raises(DetectorError, match="3000 rows, expected each point of the 3000 x 3000 x 3000 grid"):
        load({"base": IDC, "field": {"kind": "map", "file": str(tmp_path / "map.csv")}})


def test_a_field_is_uniform_if_nothing_else_is_said():
    tables = tomllib.loads(load(IDC).to_toml())
    del tables["field"]["kind"]
    assert load(tables) == load(IDC)
    assert "kind" not in schema()["$defs"]["complete"]["properties"]["field"].get("required", [])


def test_an_unknown_kind_of_field_hides_no_other_problem():
    field = {"kind": "unifrom", "bz": "3 mm", "coil_radius": "1 T", "b": "1e-7 /mm2", "wrong": 1}
    found = problems_limits({"base": IDC, "field": field})
    assert sorted(found) == ["field.bz", "field.coil_radius", "field.kind", "field.wrong"]


@pytest.mark.parametrize("name", sorted(library()))
def test_a_material_inherits_what_it_does_not_say(name):
    """A detector with a material of the program changed can be written, and changed further."""
    old = library()[name]
    for own in ({"density": f"{0.5 * old.density!r} g/cm3"}, {"x0": "77 mm"}, {"excitation_energy": "90 eV"}, {}):
        detector = load(
            {
                "base": DESIGN,
                "name": "mine",
                "remove": ["drift_chamber"],
                "materials": {name: own},
                "walls": {"extra": {"r_in": "40 mm", "r_out": "40.1 mm", "half_length": "100 mm", "material": name}},
            }
        )
        found = next(wall.material for wall in detector.walls if wall.label == "extra")
        assert found.composition == old.composition
        assert (found.gas, found.z_over_a) == (old.gas, old.z_over_a)
        assert found.density == (0.5 * old.density if "density" in own else old.density)
        x0 = 77.0 if "x0" in own else old.x0 * old.density / found.density
        assert found.x0 == pytest.approx(x0, rel=1e-14)
        assert (found == old) == (own == {})
        assert load(tomllib.loads(detector.to_toml())) == detector
        assert detector.with_field("besiii").with_overrides({"field.bz": "-0.5 T"}).walls == detector.walls
    other = load({"base": DESIGN, "remove": ["drift_chamber"], "materials": {name: {"composition": "Fe"}}})
    other = other.with_overrides({"name": "x"})
    assert other.name == "x"


def test_a_thin_gas_can_be_written():
    gas = {"density": "1e-6 g/cm3", "composition": "He", "gas": True}
    detector = load({"base": IDC, "name": "thin", "materials": {"N": gas}, "drift_chamber": {"gas": "N"}})
    assert load(tomllib.loads(detector.to_toml())) == detector
    assert detector.with_field("besiii").drift_chamber == detector.drift_chamber
    half = detector.with_overrides({"materials.N.density": "2e-6 g/cm3"})
    assert half.drift_chamber.gas.x0 == pytest.approx(0.5 * detector.drift_chamber.gas.x0)
    assert half.drift_chamber.gas.composition == (("He", 1.0),)


@pytest.mark.slow
def test_dollars_are_drawn_as_they_are(tmp_path, capsys):
    """Formulas of matplotlib begin with a dollar; a name with one must neither fail nor vanish."""
    tables = tomllib.loads(load(DESIGN).to_toml()) | {"name": "a$^$b$"}
    tables["cgem"] = {f"{label}$^$": layer for label, layer in tables["cgem"].items()}
    tables["materials"] = tables.get("materials", {}) | {"K$^$": {"base": "Kapton"}}
    for layer in tables["cgem"].values():
        layer["cathode"][0]["material"] = "K$^$"
    detector = load(tables)
    texts = []
    line = Line("sigma_p", detector.name, np.array([1.0]), "GeV/c", np.array([5.0]), np.array([0.1]), "MeV/c")
    pulls = {detector.name: {name: np.zeros(3) for name in "abcdef"}}
    words = {detector.name: dict.fromkeys("abcdef", detector.name)}
    for picture in (
        draw_detector(detector), draw_sides(detector), draw_layers(detector), draw_resolutions([("σ(p)", [line])], "p"),
        draw_pulls(pulls, words), draw_probabilities({detector.name: np.array([0.5])}),
    ):  # fmt: skip
        picture.savefig(tmp_path / "x.pdf")
        texts += [text.get_text().replace(r"\$", "$") for text in picture.findobj(Text)]
    for wanted in (detector.name, "L1$^$", "K$^$"):
        assert any(wanted in text for text in texts), wanted
    file = tmp_path / "dollar.toml"
    file.write_text(detector.to_toml(), encoding="utf-8")
    assert (
        main(["resolution", "-d", str(file), "--p", "1", "--events", "30", "-o", str(tmp_path / "o"), "--quiet"]) == 0
    )


NO_TRACK = "no track from the origin reaches"
#: A cylinder of field, and what of a detector lies outside of it: part, and what its line says.
OUTSIDE = [
    (
        {"z_max": "2 m"},
        f"layer.WRAP1, layer.WRAP2 (2 of 119 layers): {NO_TRACK} z below -2000 mm and z above 2000 mm",
    ),
    ({"r_max": "2.05 m"}, "layer.WRAP2 (1 of 119 layers): no track from the origin reaches it: the field ends before"),
    ({"z_max": "5 m", "r_max": "3 m"}, None),
]


@pytest.mark.parametrize(("limits", "line"), OUTSIDE)
def test_what_lies_outside_of_the_field_is_not_reached(limits: dict[str, str], line: str | None) -> None:
    """Layers beyond the range of the field are named with what is not reached of them; tracks make no hits there."""
    tables = {"kind": "harmonic", "bz": "2 T", "b": "1e-4 /m2"} | limits
    detector = cg.load("idea-like").with_field(tables)
    found = describe(detector)["unreachable"]
    assert len(found) == (line is not None)
    assert all(one.startswith(line) and one in repr(detector) for one in found)
    gun = cg.Gun("mu-", p=20.0, cos_theta=(-0.75, 0.75))
    truths = cg.run(detector, gun, n=200, seed=1, until="simulate", workers=1).truths
    z = truths["z"][truths["layer"] == 6]
    field = detector.field
    assert (len(z) == 0) == (field.r_max < 2060)
    assert np.abs(z).max(initial=0) <= min(field.z_max, 2350)
    assert len(z) == 0 or np.abs(z).max() > 0.95 * min(field.z_max, 2350)


def test_wires_outside_of_the_field_are_named() -> None:
    """Wires that leave the range of the field are named up to where they are in it; many lines are one."""
    detector = cg.load("idea-like").with_field({"kind": "harmonic", "bz": "2 T", "b": "1e-4 /m2", "z_max": "1.9 m"})
    last = detector.drift_chamber.layers[-1].number
    assert describe(detector)["unreachable"][0].startswith("layer.WRAP1, 112 more, drift_chamber.layers.")
    assert f"drift_chamber.layers.{last} (114 of 119 layers): no track" in describe(detector)["unreachable"][0]
    assert describe(cg.load("besiii-cgem").with_field("besiii"))["unreachable"] == []
    wire = next(one for one in cg.load("besiii-idc").drift_chamber.layers if one.number == 24)
    radius = 0.5 * (wire.r_mid + wire.r_end)
    limits = {"kind": "harmonic", "bz": "-1 T", "b": "1e-4 /m2", "r_max": f"{radius} mm"}
    stereo = cg.load("besiii-idc").with_field(limits)
    text = next(one for one in describe(stereo)["unreachable"] if f"layers.{wire.number} (" in one)
    z = float(text.split("above ")[1].split(" mm")[0])
    assert wire.radius_at(z) == pytest.approx(radius, abs=0.01)


@pytest.mark.parametrize("name", list(cg.detectors()))
def test_presets_are_reached_everywhere(name: str) -> None:
    assert describe(cg.load(name))["unreachable"] == []
