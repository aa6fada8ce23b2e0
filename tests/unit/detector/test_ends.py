"""Ends of parts: their keys and short forms, variants, mistakes, and what is made of them, by value."""

import dataclasses
import math
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import jsonschema
import numpy as np
import pytest

import cgemit as cg
from cgemit.detector import DetectorError, schema, slabs
from cgemit.detector.check import unreachable

DESIGN = cg.load("besiii-cgem-design")
SENSOR = {"radius": "40 mm", "sigma": "20 um", "material": "Si"}


def problems(changes: dict[str, Any]) -> list[tuple[str, str]]:
    with pytest.raises(DetectorError) as caught:
        DESIGN.with_overrides(changes)
    return [(problem.path, problem.given) for problem in caught.value.problems]


def test_a_length_is_the_short_form_of_both_ends() -> None:
    assert DESIGN.cgem["L1"].ends == (-266.0, 266.0)
    both = DESIGN.with_overrides({"cgem.L1.z_min": "-266 mm", "cgem.L1.z_max": "266 mm"})
    assert both.content_hash == DESIGN.content_hash
    assert both.to_toml().replace(both.name, DESIGN.name) == DESIGN.to_toml()
    cut = DESIGN.with_overrides({
        "cgem.L1": {"z_min": "-100 mm", "z_max": "300 mm"},
        "layer.VTX": {**SENSOR, "z_min": "-60 mm", "z_max": "90 mm"},
        "drift_chamber.layers.8": {"z_min": "-200 mm", "z_max": "390 mm"}, "walls.*.z_max": "350 mm",
    })  # fmt: skip
    layer, sensor, wires = cut.cgem["L1"], cut.layer["VTX"], cut.wires[0]
    assert (layer.ends, layer.length, layer.z_ref) == ((-100.0, 300.0), 400.0, 300.0)
    assert (sensor.ends, sensor.length) == ((-60.0, 90.0), 150.0)
    assert (wires.ends, wires.half_length, wires.z_mid) == ((-200.0, 390.0), 295.0, 95.0)
    assert [part.ends[1] for part in cut.walls] == [350.0] * len(cut.walls)
    assert "z = -100 to 300 mm" in layer.text()
    assert cg.load(tomllib.loads(cut.to_toml())) == cut
    jsonschema.Draft202012Validator(schema()).validate(tomllib.loads(cut.to_toml()))
    assert cut.content_hash != DESIGN.content_hash


def test_variants_of_ends() -> None:
    """One end stands beside the base's other one; a length replaces both; strips and angle follow from the length."""
    one = DESIGN.with_overrides({"cgem.L2.z_max": "300 mm", "beam_pipe.*.z_min": "-90 mm"})
    assert one.cgem["L2"].ends == (-345.0, 300.0)
    assert {part.ends[0] for part in one.beam_pipe} == {-90.0}
    shorter = DESIGN.with_overrides({"cgem.L2.length": "645 mm"})
    assert one.cgem["L2"].stereo == pytest.approx(shorter.cgem["L2"].stereo)
    assert one.cgem["L2"].strips_v == shorter.cgem["L2"].strips_v
    assert one.with_overrides({"cgem.L2.length": "690 mm"}).cgem["L2"] == DESIGN.cgem["L2"]
    assert one.with_overrides({"cgem.L2.z_min": "x0.5"}).cgem["L2"].ends == (-172.5, 300.0)
    assert DESIGN.with_overrides({"cgem.L2.z_min": "x0.5"}).cgem["L2"].ends == (-172.5, 345.0)
    file = cg.load({"base": "besiii-cgem-design", "drift_chamber": {"layers": {"8": {"z_max": "200 mm"}}}})
    assert file.wires[0].ends == (-DESIGN.wires[0].half_length, 200.0)
    assert cg.load(
        {"base": "besiii-cgem-design", "cgem": {"L0": {"like": "L1", "anode_radius": "62 mm", "z_max": "100 mm"}}}
    ).cgem["L0"].ends == (-266.0, 100.0)


def test_ends_of_superlayers() -> None:
    """Radii are those in the middle of the wires, 100 mm from the origin; tan(50 mrad) 900 mm = 45.04 mm."""
    rows = {"A": {"layers": 2, "r_in": "350 mm", "cells": 180, "stereo": "50 mrad"}, "B": {"layers": 1, "cells": 180}}
    rows["B"] |= {"r_in": "400 mm", "half_length": "700 mm"}
    chamber = {"gas": "MdcGas", "sigma": "100 um", "z_min": "-800 mm", "z_max": "1000 mm", "superlayers": rows}
    tables = {"name": "own", "field": {"kind": "uniform", "bz": "1 T"}, "drift_chamber": chamber}
    detector = cg.load(tables)
    first, _, last = detector.wires
    assert (first.ends, last.ends) == ((-800.0, 1000.0), (-700.0, 700.0))
    assert first.r_end == pytest.approx(math.hypot(first.r_mid, 45.0375), abs=1e-3)
    assert first.radius_at(100.0) == pytest.approx(first.r_mid)
    assert first.radius_at(-800.0) == pytest.approx(first.r_end)
    east, west = first.end_points(3)
    assert (east[2], west[2]) == (1000.0, -800.0)
    assert cg.load(tomllib.loads(detector.to_toml())) == detector
    jsonschema.Draft202012Validator(schema()).validate(tables)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"cgem.L1": {"length": "500 mm", "z_max": "300 mm"}}, ("cgem.L1.length", "also z_max")),
        ({"layer.VTX": {**SENSOR, "z_max": "300 mm"}}, ("layer.VTX", "only z_max")),
        ({"cgem.L1.z_min": "270 mm"}, ("cgem.L1.z_min", "270 mm")),
        ({"layer.VTX": {**SENSOR, "z_min": "60 mm", "z_max": "-60 mm"}}, ("layer.VTX.z_max", "-60 mm")),
        ({"layer.VTX": {**SENSOR, "z_min": "60 mm", "z_max": "65 mm"}}, ("layer.VTX.length", "5.0 mm")),
        ({"drift_chamber.layers.9.z_min": "3 m"}, ("drift_chamber.layers.9.z_min", "3000 mm")),
        ({"cgem.L1.z_max": "300"}, ("cgem.L1.z_max", '"300" (no unit)')),
        ({"walls.W": {"r_in": "1 m", "r_out": "1.01 m", "material": "Al"}}, ("walls.W", "only r_in, r_out, material")),
        ({"drift_chamber.layers.8.z_min": "-6 m"}, ("drift_chamber.layers.8.z_min", "-6000 mm")),
    ],
)
def test_mistakes(changes: dict[str, Any], expected: tuple[str, str]) -> None:
    (found,) = problems(changes)
    assert found[0] == expected[0]
    assert found[1].startswith(expected[1]) or expected[1] in found[1]


def test_parts_on_one_side() -> None:
    """Keys, texts, files and schema of parts on one side of z = 0, and of two that meet at z = 0 and at one radius."""
    cut = DESIGN.with_overrides({
        "cgem.L1.z_min": "20 mm", "drift_chamber.layers.8.z_max": "-50 mm", "walls.*.z_min": "0 mm",
        "layer.FWD": {**SENSOR, "z_min": "0 mm", "z_max": "90 mm"},
        "layer.BWD": {**SENSOR, "z_min": "-70 mm", "z_max": "0 mm"},
    })  # fmt: skip
    assert cut.cgem["L1"].ends == (20.0, 266.0)
    assert cut.cgem["L1"].length == 246.0
    assert (cut.layer["FWD"].ends, cut.layer["BWD"].ends) == ((0.0, 90.0), (-70.0, 0.0))
    assert cut.wires[0].z_mid == 0.5 * (cut.wires[0].ends[0] - 50.0)
    assert "z = 20 to 266 mm" in cut.cgem["L1"].text()
    assert cg.load(tomllib.loads(cut.to_toml())) == cut
    jsonschema.Draft202012Validator(schema()).validate(tomllib.loads(cut.to_toml()))
    assert cut.with_overrides({"cgem.L1.length": "532 mm"}).cgem["L1"] == DESIGN.cgem["L1"]
    assert not unreachable(cut)
    with pytest.raises(DetectorError, match=r"above z_min, 20 mm"):
        dataclasses.replace(cut, barrels=[dataclasses.replace(cut.cgem["L1"], z_max=10.0)])


def test_parts_beside_each_other() -> None:
    """Parts overlap only where they have z in common; wire layers beside each other share z with their neighbours."""
    one = {**SENSOR, "z_min": "-60 mm", "z_max": "30 mm"}
    for low, overlap in (("30 mm", False), ("29 mm", True)):
        changes = {"layer.A": one, "layer.B": {**one, "radius": "40.1 mm", "z_min": low, "z_max": "90 mm"}}
        if overlap:
            ((path, given),) = problems(changes)
            assert (path, given) == ("layer.B", "r = 39.9500 to 40.2500 mm")
        else:
            assert len(DESIGN.with_overrides(changes).layers) == 5
    ((path, given),) = problems({
        "drift_chamber.layers.8.z_max": "-50 mm", "drift_chamber.layers.9.z_min": "-50 mm"
    })  # fmt: skip
    assert (path, given) == ("drift_chamber.layers.9", f"wires from z = -50 to {DESIGN.wires[1].half_length:g} mm")
    # A wall in the middle of the chamber, but beyond the end of its wires.
    ring = {"r_in": "500 mm", "r_out": "520 mm", "z_min": "1300 mm", "z_max": "1500 mm", "material": "Al"}
    beside = DESIGN.with_overrides({"walls.ring": ring})
    gas = [[slab.x0 for slab in slabs(one) if slab.filler == 2] for one in (DESIGN, beside)]
    assert gas[0] == gas[1]
    assert [path for path, _ in problems({"walls.ring": {**ring, "z_min": "300 mm"}})] == ["walls.ring"]


def test_touching_cylinders_beside_each_other_are_two_scatterers() -> None:
    """Joined ones would have matter on the other side; those about z = 0 are joined, whatever their ends."""

    def pipe(*ends: tuple[float, float]) -> list[tuple[float, float]]:
        parts = {
            f"P{i}": {
                "r_in": f"{20 + i} mm", "r_out": f"{21 + i} mm", "z_min": f"{low} mm", "z_max": f"{high} mm",
                "material": "Be",
            }
            for i, (low, high) in enumerate(ends)
        }  # fmt: skip
        tables = {"name": "own", "field": {"bz": "1 T"}, "beam_pipe": parts, "layer": {"A": SENSOR}}
        return [slab.ends for slab in slabs(cg.load(tables)) if slab.shells[0].group == "pipe"]

    assert pipe((-300, 0), (0, 200)) == [(-300.0, 0.0), (0.0, 200.0)]
    assert pipe((50, 300), (50, 300)) == [(50.0, 300.0)]
    assert pipe((-50, 300), (-80, 200)) == [(-80.0, 300.0)]


def test_wires_that_cross_at_one_end_only() -> None:
    """A stereo layer outside of an axial one whose wires come inside of it in their middle, which is not at z = 0."""
    rows = {
        "1": {"cells": 100, "r_end": "405 mm", "z_min": "-300 mm", "z_max": "300 mm", "twist_cells": 0.0},
        "2": {"cells": 100, "r_end": "430 mm", "z_min": "-300 mm", "z_max": "900 mm", "twist_cells": 12.0},
    }
    chamber = {
        "gas": "MdcGas",
        "sigma": "100 um",
        "layers": {n: {"phi_east": "0 rad", **row} for n, row in rows.items()},
    }
    tables = {"name": "own", "field": {"kind": "uniform", "bz": "1 T"}, "drift_chamber": chamber}
    # Its radius is 430 mm cos(0.377) = 399.8 mm at z = 300 mm, the end of the inner layer; 405 mm at z = 55 mm.
    with pytest.raises(DetectorError, match=r"wires at r = 399\.\d+ mm at z = 300 mm"):
        cg.load(tables)
    rows["1"]["z_max"] = "50 mm"
    chamber["layers"] = {n: {"phi_east": "0 rad", **row} for n, row in rows.items()}
    assert len(cg.load(tables).wires) == 2


def test_the_range_of_the_field_and_the_ends() -> None:
    """A map up to |z| = 200 mm reaches the end at -150 mm, but not that at 266 mm."""
    harmonic = {"kind": "harmonic", "bz": "-1 T", "b": "1e-3 /m2", "r_max": "2 m", "z_max": "200 mm"}
    found = unreachable(DESIGN.with_overrides({"cgem.L1.z_min": "-150 mm"}).with_field(harmonic))
    (line,) = [one for one in found if one.startswith("cgem.L1")]
    assert "z above 200 mm" in line
    assert "below" not in line
    found = unreachable(DESIGN.with_overrides({"cgem.L1.z_min": "210 mm"}).with_field(harmonic))
    (line,) = [one for one in found if one.startswith("cgem.L1")]
    assert line.endswith("no track from the origin reaches it: the field ends before")


def test_volumes_of_a_file_for_geant4(tmp_path: Path) -> None:
    """Tubes as long as their parts, placed in their middle."""
    cut = DESIGN.with_overrides({"cgem.L1": {"z_min": "-100 mm", "z_max": "300 mm"}})
    cut.to_gdml(tmp_path / "cut.gdml")
    root = ElementTree.parse(tmp_path / "cut.gdml").getroot()
    tubes = {one.get("name"): float(one.get("z", "")) for one in root.iter("tube")}
    placed = {}
    for one in root.iter("physvol"):
        position, reference = one.find("position"), one.find("volumeref")
        assert reference is not None
        placed[f"{reference.get('ref')}_solid"] = 0.0 if position is None else float(position.get("z", ""))
    own = [name for name, length in tubes.items() if length == 400.0]
    assert len(own) == len(list(cut.cgem["L1"].shells()))
    assert {placed[name] for name in own} == {100.0}
    assert {z for name, z in placed.items() if name not in own} == {0.0}


def test_volumes_of_parts_on_one_side(tmp_path: Path) -> None:
    """Two tubes of one radius, each in its middle, and a world that holds the farther end."""
    cut = DESIGN.with_overrides({
        "layer.FWD": {**SENSOR, "z_min": "20 mm", "z_max": "90 mm"},
        "layer.BWD": {**SENSOR, "z_min": "-2000 mm", "z_max": "20 mm"},
    })  # fmt: skip
    cut.to_gdml(tmp_path / "cut.gdml")
    root = ElementTree.parse(tmp_path / "cut.gdml").getroot()
    tubes = {one.get("name"): (float(one.get("z", "")), one.get("rmin")) for one in root.iter("tube")}
    assert {tube for name, tube in tubes.items() if "sensor" in str(name)} == {(70.0, "39.85"), (2020.0, "39.85")}
    middle = [float(one.get("z", "")) for one in root.iter("position") if "sensor" in str(one.get("name"))]
    assert sorted(middle) == [-990.0, 55.0]
    (box,) = root.iter("box")
    assert float(box.get("z", "")) == 2 * (2000 + 10)


def test_slabs_end_where_their_parts_do() -> None:
    angle = f"{DESIGN.cgem['L1'].stereo!r} rad"
    cut = DESIGN.with_overrides({"cgem.L1": {"z_min": "-100 mm", "z_max": "300 mm", "stereo": angle}})
    (gap,) = [slab for slab in slabs(cut) if slab.gap == 0]
    assert gap.row.numbers[:2] == (-100.0, 300.0)
    sigma, plain = (
        cg.analytic(one, "mu-", p=1.0, cos_theta=[-0.9, 0.9], readout="gaussian").sigma("dr") for one in (cut, DESIGN)
    )
    assert sigma[1] == pytest.approx(plain[1], rel=1e-9)  # 170 mm at 0.9: inside of both
    assert sigma[0] > 1.05 * plain[0]
    assert np.isfinite(sigma).all()
