"""Wire layers generated from superlayers."""

import dataclasses
import math
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import cgemit as cg
from cgemit.detector import DetectorError, WireLayer, schema, slabs
from cgemit.detector.delphes import card_of
from cgemit.detector.drift import BESIII, DriftRelation, read_by, relation_of, relations_of

GAS = {"density": "3.913e-4 g/cm3", "composition": {"He": 0.3827, "C": 0.5103, "H": 0.1070}, "gas": True}
A1 = {"layers": 8, "r_in": "350 mm", "cells": "12 mm", "stereo": ["50 mrad", "-50 mrad"]}
A2 = {"layers": 4, "r_in": "460 mm", "cells": 240, "height": "15 mm", "stereo": "100 mrad", "sigma": "90 um"}


def chamber(*superlayers: dict[str, Any], **more: Any) -> dict[str, Any]:
    labelled = {f"A{i}": one for i, one in enumerate(superlayers, start=1)}
    common = {"gas": "Own", "sigma": "100 um", "half_length": "2000 mm"}
    return {
        "name": "own", "field": {"kind": "uniform", "bz": "2 T"}, "materials": {"Own": GAS},
        "drift_chamber": common | {"superlayers": labelled} | more,
    }  # fmt: skip


def layers_of(tables: dict[str, Any] | cg.Detector) -> tuple[WireLayer, ...]:
    found = cg.load(tables).drift_chamber
    assert found
    return found.layers


def idea() -> dict[str, Any]:
    """Return 14 superlayers of eight layers with a twist of 30 deg, signs in turn, as in the IDEA chamber."""
    rows: list[dict[str, Any]] = [
        {"layers": 8, "cells": 192 + 48 * i, "twist": ["30 deg", "-30 deg"]} for i in range(14)
    ]
    return chamber({"r_in": "350 mm", **rows[0]}, *rows[1:])


def problems(tables: dict[str, Any]) -> list[tuple[str, str]]:
    with pytest.raises(DetectorError) as caught:
        cg.load(tables)
    return [(problem.path.removeprefix("drift_chamber."), problem.given) for problem in caught.value.problems]


def test_numbers_by_hand() -> None:
    """The first layer at 356 mm: 2 pi 356/12 = 186.4; tan(50 mrad) 2000 mm = 100.083 mm."""
    layers = layers_of(chamber(A1))
    assert [layer.number for layer in layers] == list(range(8))
    assert [layer.cells for layer in layers] == [186, 193, 199, 205, 212, 218, 224, 230]
    assert [layer.r_mid for layer in layers] == pytest.approx([356 + 12 * i for i in range(8)])
    first, second = layers[:2]
    assert first.r_end == pytest.approx(math.hypot(356, 100.083417), abs=1e-6)
    assert first.twist == pytest.approx(2 * math.atan(100.083417 / 356), abs=1e-8)
    assert second.twist == pytest.approx(-2 * math.atan(100.083417 / 368), abs=1e-8)
    assert (first.half_length, first.sigma) == (2000.0, 0.1)


def test_wires_have_the_stereo_angle() -> None:
    """A positive angle is that of a wire whose azimuth grows with z; all points at the end plates at +-2 m."""
    for layer, angle in zip(layers_of(chamber(A1)), [0.05, -0.05] * 4, strict=True):
        east, west = layer.end_points(5)
        mid_phi = math.atan2(east[1] + west[1], east[0] + west[0])
        across = -math.sin(mid_phi) * (east[0] - west[0]) + math.cos(mid_phi) * (east[1] - west[1])
        assert math.atan2(across, east[2] - west[2]) == pytest.approx(angle)
        assert math.hypot(*(0.5 * (a + b) for a, b in zip(east[:2], west[:2], strict=True))) == pytest.approx(
            layer.r_mid
        )


def test_neighbours_are_staggered_at_the_middle() -> None:
    def azimuths(stagger: bool) -> list[float]:
        """Return the azimuth of wire 0 at z = 0, in cells."""
        layers = layers_of(chamber(A1 | {"stagger": stagger}))
        return [(layer.phi_east - 0.5 * layer.twist) * layer.cells / (2 * math.pi) for layer in layers]

    assert azimuths(stagger=True) == pytest.approx([0, 0.5] * 4)
    assert azimuths(stagger=False) == pytest.approx([0] * 8)


def test_superlayers_follow_each_other() -> None:
    layers = layers_of(chamber(A1, {"layers": 2, "cells": 300, "stereo": "60 mrad"}, A2 | {"r_in": "600 mm"}))
    assert layers[8].r_mid == pytest.approx(446 / (1 - math.pi / 300))  # cells as high as wide begin at 350 + 8 * 12 mm
    height = layers[8].r_mid * 2 * math.pi / 300
    assert 446 + 0.5 * height == pytest.approx(layers[8].r_mid)
    assert [layer.cells for layer in layers[8:]] == [300, 300, 240, 240, 240, 240]
    assert [layer.r_mid for layer in layers[10:]] == pytest.approx([607.5, 622.5, 637.5, 652.5])
    assert [layer.sigma for layer in layers] == [0.1] * 10 + [0.09] * 4
    axial = layers_of(chamber(A1 | {"stereo": "0 mrad"}))
    assert all((layer.twist, layer.r_end) == (0.0, layer.r_mid) for layer in axial)
    assert axial == layers_of(chamber({name: value for name, value in A1.items() if name != "stereo"}))


def test_idea_has_its_cells_and_angles() -> None:
    """56 448 cells in 112 layers; stereo angles from 50 to 250 mrad (both from its publications)."""
    detector = cg.load(idea())
    layers = layers_of(detector)
    assert (len(layers), sum(layer.cells for layer in layers)) == (112, 56448)
    tilts = [math.atan(layer.r_end * math.sin(0.5 * layer.twist) / 2000) for layer in layers]
    assert (tilts[0], tilts[-1]) == pytest.approx((0.048, -0.246), abs=1e-3)
    assert layers[-1].r_end < 2000
    widths = [2 * math.pi * layer.r_mid / layer.cells for layer in layers]
    assert 11 < min(widths) < max(widths) < 15
    assert len(layers_of(chamber(A1 | {"layers": 112, "cells": "13.7 mm"}))) == 112


def test_idea_is_simulated_and_fitted() -> None:
    detector = cg.load(idea())
    sigma = cg.analytic(detector, "mu-", p=[1.0, 10.0], cos_theta=0.0).sigma("dr")  # um
    assert sigma.shape == (2,)
    assert all(20 < value < 200 for value in sigma)
    result = cg.run(detector, cg.Gun("mu-", p=1.0, cos_theta=0.0), n=20, seed=1)
    assert (result.tracks["status"] == 0).sum() >= 19
    assert result.tracks["n_wires"].mean() > 100
    assert result.tracks["p"].mean() == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"stereo": "50"}, [("superlayers.A1.stereo", '"50" (no unit)')]),
        ({"stereo": ["50 mrad", "2 rad"]}, [("superlayers.A1.stereo[1]", '"2 rad"')]),
        ({"stereo": []}, [("superlayers.A1.stereo", "a list of 0")]),
        ({"stereo": "300 mrad"}, [("superlayers.A1.stereo", "a twist of 120.2 deg of layer 0")]),
        ({"stereo": "50 mrad", "twist": "1 deg"}, [("superlayers.A1.twist", "both stereo and twist")]),
        ({"cells": 3}, [("superlayers.A1.cells", "3")]),
        ({"cells": 200.0}, [("superlayers.A1.cells", "200.0")]),
        ({"cells": "900 mm", "height": "12 mm"}, [("superlayers.A1.cells", "2 (cells of layer 0)")]),
        ({"height": "0 mm"}, [("superlayers.A1.height", '"0 mm"')]),
        ({"stagger": 1}, [("superlayers.A1.stagger", "1")]),
        ({"layers": 1001}, [("superlayers.A1.layers", "1001")]),
        ({"layers": 300}, [("superlayers.A1.layers", "3009.66 mm (r_end of layer 221)")]),
        ({"r_in": "500 mm"}, [("superlayers.A2.r_in", "460 mm")]),
        ({"wires": 8}, [("superlayers.A1.wires", "an unknown key")]),
    ],
)
def test_mistakes(change: dict[str, Any], expected: list[tuple[str, str]]) -> None:
    outer = [] if "layers" in change else [A2]
    assert [(path, given[: len(expected[0][1])]) for path, given in problems(chamber(A1 | change, *outer))] == expected


def test_all_problems_are_listed() -> None:
    first = {"layers": "8", "cells": "12 mm", "stereo": "50 T"}
    found = problems(chamber(first, {"r_in": "400 mm", "cells": 200}, A2 | {"r_in": "9 m"}, half_length="2000"))
    assert [path for path, _ in found] == [
        "half_length", "superlayers.A1.layers", "superlayers.A1.stereo", "superlayers.A2", "superlayers.A3.r_in",
        "superlayers.A1.r_in",
    ]  # fmt: skip
    assert problems(chamber())[-1] == ("layers", "no wire layer")
    assert problems(chamber(A1, layers={}))[0] == ("drift_chamber", "both layers and superlayers")
    assert problems(chamber(A1 | {"layers": 600}, {"layers": 600, "cells": 300})) == [("superlayers", "1200 layers")]
    own = chamber(A1)
    del own["drift_chamber"]["half_length"]
    assert problems(own) == [("superlayers.A1", "only layers, r_in, cells, stereo")]


def test_wires_of_an_axial_superlayer_may_not_cross_those_of_a_stereo_one() -> None:
    """At the end plates, the stereo wires at 440 mm are at hypot(440, 100) = 451 mm, the axial ones still at 448 mm."""
    near = {"layers": 4, "cells": "12 mm"}
    assert problems(chamber(A1, near | {"height": "4 mm"}))[0][0] == "layers.8"
    assert len(layers_of(chamber(A1, near | {"r_in": "455 mm"}))) == 12


def test_all_superlayers_that_overlap_are_listed() -> None:
    """A1 ends at 446 mm; A2 begins inside of it and ends at 460 mm, A3 and A4 begin inside of these; A5 is free."""
    inside = A2 | {"r_in": "400 mm"}
    found = problems(chamber(A1, inside, A2 | {"r_in": "440 mm"}, A1 | {"r_in": "410 mm"}, A2 | {"r_in": "520 mm"}))
    assert found == [(f"superlayers.A{i}.r_in", f"{r} mm") for i, r in ((2, 400), (3, 440), (4, 410))]


SHORT: dict[str, Any] = {
    "ZD": {"layers": 6, "r_in": "48 mm", "cells": "10 mm", "half_length": "200 mm", "stereo": "200 mrad"},
    "AX": {"layers": 16, "r_in": "132 mm", "cells": "14 mm"},
    "U": {"layers": 16, "r_in": "370 mm", "cells": "14 mm", "stereo": ["25 mrad", "-25 mrad"]},
}


def short_inside() -> cg.Detector:
    """Return a chamber whose inner wires, continued to |z| = 1 m, would be at 220 mm, outside of others at 139 mm."""
    return cg.load(chamber(half_length="1000 mm", sigma="110 um", gas="MdcGas", superlayers=SHORT))


@pytest.mark.parametrize("cos_theta", [0.0, 0.5, 0.7, 0.85, 0.9, 0.962])
def test_a_short_chamber_inside_a_long_one_is_crossed_layer_by_layer(cos_theta: float) -> None:
    """At 0.962 tracks pass the end of the short chamber at 57 mm and meet the long one, up to 284 mm."""
    detector = short_inside()
    slope = cos_theta / math.sqrt(1 - cos_theta**2)
    met = {
        layer.number for layer in layers_of(detector) if slope * layer.radius_at(layer.half_length) < layer.half_length
    }
    calm = cg.SimulateSettings(fluctuations="off", decays=False, deltas=False)
    gun = cg.Gun("mu-", p=10.0, cos_theta=cos_theta)
    hits = cg.run(detector, gun, 20, 1, until="digitize", settings=cg.Settings(simulate=calm)).wire_hits
    for event in range(20):
        assert set(hits["layer"][hits["event"] == event].tolist()) == met


def test_tracks_are_found_and_fitted_in_a_short_chamber_inside_a_long_one() -> None:
    """All of them, with pulls of width 1 within four standard errors of 300 tracks."""
    gun = cg.Gun("mu-", p=(0.3, 2.0), cos_theta=(-0.93, 0.93))
    how = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian", decays=False))
    result = cg.run(short_inside(), gun, n=300, seed=1, settings=how)
    found = cg.find_tracks(result.detector, result.clusters, result.wire_hits)
    rates = cg.study.finding(dataclasses.replace(result, tables={**result.tables, **found})).rates()
    assert (rates.efficiency.count, rates.fakes.count, rates.clones.count) == (300, 0, 0)
    good = result.tracks[result.tracks["status"] == 0]
    assert len(good) == 300
    for name in ("dr", "phi0", "kappa", "dz", "tanl"):
        assert good[f"pull_{name}"].std() == pytest.approx(1.0, abs=4 * 0.041)
    assert np.isfinite(cg.analytic(short_inside(), "mu-", p=1.0, cos_theta=[0.0, 0.9]).sigma("p")).all()


def test_first_wires_are_found_where_no_part_lies_before_them() -> None:
    """The first layers have the hits of the particles: by rounding, the closest approach is before itself."""
    gun = cg.Gun("mu-", p=(0.3, 2.0), cos_theta=(-0.9, 0.9))
    how = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian", decays=False))
    found, own = (cg.run(short_inside(), gun, n=400, seed=4, settings=how, finder=name) for name in ("ckf", "truth"))
    hits = [np.bincount(one.wire_hits["layer"][one.candidate_hits["hit"]])[:3].sum() for one in (found, own)]
    assert hits[0] > 0.995 * hits[1] > 1000


def test_it_writes_plain_layers_and_reads_them_back() -> None:
    detector = cg.load(chamber(A1, A2))
    tables = tomllib.loads(detector.to_toml())
    assert len(tables["drift_chamber"]["layers"]) == 12
    assert "superlayers" not in tables["drift_chamber"]
    again = cg.load(tables)
    assert again == detector
    assert again.content_hash == detector.content_hash


def test_single_layers_can_be_changed() -> None:
    detector = cg.load(chamber(A1, A2))
    changed = layers_of(detector.with_overrides({"drift_chamber.layers.3.sigma": "70 um"}))
    assert [layer.sigma for layer in changed] == [0.1] * 3 + [0.07] + [0.1] * 4 + [0.09] * 4
    assert changed[3].r_end == layers_of(detector)[3].r_end
    fewer = detector.with_overrides({"remove": ["drift_chamber.layers.3"]})
    assert len(layers_of(fewer.with_overrides({"materials.Own.density": "4e-4 g/cm3"}))) == 11
    assert len(layers_of(fewer.with_overrides({"drift_chamber.sigma": "80 um"}))) == 11
    assert {layer.sigma for layer in layers_of(fewer.with_overrides({"drift_chamber.sigma": "80 um"}))} == {0.08}


def test_superlayers_can_be_changed() -> None:
    detector = cg.load(chamber(A1, A2))
    changes: dict[str, tuple[Any, dict[str, Any]]] = {
        "A1.cells": ("13 mm", chamber(A1 | {"cells": "13 mm"}, A2)),
        "A2.cells": ("x2", chamber(A1, A2 | {"cells": 480})),
        "A1.stereo": ("x0.5", chamber(A1 | {"stereo": ["25 mrad", "-25 mrad"]}, A2)),
        "A1.twist": ("10 deg", chamber({k: v for k, v in A1.items() if k != "stereo"} | {"twist": "10 deg"}, A2)),
        "*.layers": (2, chamber(A1 | {"layers": 2}, A2 | {"layers": 2})),
        "A3": (A2 | {"r_in": "600 mm", "half_length": "2 m"}, chamber(A1, A2, A2 | {"r_in": "600 mm"})),
    }
    for key, (value, same) in changes.items():
        assert layers_of(detector.with_overrides({f"drift_chamber.superlayers.{key}": value})) == layers_of(same)
    shorter = detector.with_overrides({"drift_chamber.half_length": "1500 mm"})
    assert layers_of(shorter) == layers_of(chamber(A1, A2, half_length="1500 mm"))
    both = {"drift_chamber.superlayers.A1.layers": 4, "drift_chamber.layers.3.efficiency": 0.9}
    assert [layer.efficiency for layer in layers_of(detector.with_overrides(both))] == [1.0] * 3 + [0.9] + [1.0] * 4
    assert layers_of(detector.with_overrides({"remove": ["drift_chamber.superlayers.A2"]})) == layers_of(chamber(A1))
    following = cg.load(chamber(A1, {"layers": 2, "cells": 300}, half_length="500 mm"))
    with pytest.raises(DetectorError, match=r"superlayers\.A2\.r_in: got nothing"):
        following.with_overrides({"remove": ["drift_chamber.superlayers.A1"]})
    with pytest.raises(DetectorError, match=r"superlayers\.A1: got only cells"):
        cg.load(tomllib.loads(detector.to_toml())).with_overrides({"drift_chamber.superlayers.A1.cells": "14 mm"})


def test_bounds_and_sweeps_of_generator_keys() -> None:
    detector = cg.load(chamber(A1, A2))
    low, high = detector.bounds("drift_chamber.superlayers.A1.cells")
    assert (low, high) == pytest.approx((0.5, 13.75))  # eight layers of 13.75 mm from 350 to 460 mm
    assert detector.bounds("drift_chamber.superlayers.A1.r_in")[1] == pytest.approx(364)
    table = cg.study.sweep(
        detector, {"drift_chamber.superlayers.A1.cells": ["8 mm", "12 mm", "20 mm"]}, evaluate={"p": [1.0]}
    ).to_pandas()
    assert list(table["status"]) == ["ok", "ok", "ok", "impossible"]


def test_files_with_a_base(tmp_path: Path) -> None:
    """A file changes superlayers, or layers, of its base; its superlayers replace plain layers of the base."""
    (tmp_path / "base.toml").write_text(_toml(chamber(A1, A2)), encoding="utf-8")
    base: dict[str, Any] = {"base": str(tmp_path / "base.toml")}
    cells = cg.load(base | {"drift_chamber": {"superlayers": {"A1": {"cells": 190}}}})
    assert layers_of(cells) == layers_of(chamber(A1 | {"cells": 190}, A2))
    single = cg.load(base | {"drift_chamber": {"layers": {"3": {"sigma": "70 um"}}}})
    assert layers_of(single) == layers_of(
        cg.load(chamber(A1, A2)).with_overrides({"drift_chamber.layers.3.sigma": "70 um"})
    )
    shorter = cg.load(base | {"drift_chamber": {"half_length": "1500 mm"}})
    assert layers_of(shorter) == layers_of(chamber(A1, A2, half_length="1500 mm"))
    own = chamber(A1, A2)["drift_chamber"] | {"gas": "MdcGas"}
    expected = layers_of(chamber(A1, A2, drift_velocity="25 um/ns"))  # of the base
    tables = {"remove": ["cgem", "walls"], "drift_chamber": own}
    assert layers_of(tables | {"base": "kloe2-like"}) == expected
    changes = {f"drift_chamber.{name}": value for name, value in own.items()}
    assert layers_of(cg.load("kloe2-like").with_overrides(changes)) == expected


def _toml(tables: dict[str, Any]) -> str:
    from cgemit.base.files import toml_text

    return toml_text(tables, in_place=("composition",))


def test_the_schema_has_superlayers() -> None:
    validator = jsonschema.Draft202012Validator(schema())
    for tables in (chamber(A1, A2), idea()):
        validator.validate(tables)
        validator.validate(
            {"base": "kloe2-like", "drift_chamber": {"superlayers": tables["drift_chamber"]["superlayers"]}}
        )
    wrong = (
        chamber(A1 | {"stereo": 50}), chamber(A1 | {"cells": 12.5}), chamber(A1 | {"layers": 0}),
        chamber({"layers": 8}), chamber(A1, layers={}),
    )  # fmt: skip
    assert not any(validator.is_valid(tables) for tables in wrong)


#: Cells of the layers, radius at the end plates and holes between the ends of a wire (two a cell) of the chamber of
#: Belle II, first and last layer of each superlayer: cdc/data/CDC.xml of github.com/belle2/basf2.
BELLE2 = (
    (8, 160, 168.0, 238.0, 0), (6, 160, 257.0, 348.0, 18), (6, 192, 365.2, 455.7, 0), (6, 224, 476.9, 566.9, -18),
    (6, 256, 584.1, 674.1, 0), (6, 288, 695.3, 785.3, 19), (6, 320, 802.5, 892.5, 0), (6, 352, 913.7, 1003.7, -20),
    (6, 384, 1020.9, 1111.4, 0),
)  # fmt: skip


def belle2_wires(**more: Any) -> dict[str, Any]:
    """Return the wires of Belle II: 14 336 of tungsten (30 um) and 42 240 of aluminium (126 um), as in its software."""
    rows: dict[str, Any] = {}
    for layers, cells, first, last, holes in BELLE2:
        for i in range(layers):
            r = first + (last - first) * i / (layers - 1)
            rows[str(len(rows))] = {
                "cells": cells, "r_end": f"{r} mm", "half_length": "1000 mm", "twist_cells": 0.5 * holes,
                "phi_east": "0 rad",
            }  # fmt: skip
    wires = [
        {"material": "W", "diameter": "30 um"},
        {"material": "Al", "diameter": "126 um", "number": 42240 / 14336},
    ]
    common = {"gas": "Own", "sigma": "120 um", "layers": rows, "cell_wires": wires}
    return chamber(superlayers=None) | {"field": {"bz": "1.5 T"}, "drift_chamber": common | more}


def test_wires_of_belle2_by_numbers_and_diameters() -> None:
    """Each layer has N n pi d^2/4 of metal on a circle of 2 pi r, longer by 1/cos(stereo angle).

    Radiation lengths of tungsten and aluminium are 3.504 mm and 88.97 mm (Particle Data Group).
    """
    detector = cg.load(belle2_wires())
    found = layers_of(detector)
    assert sum(layer.cells for layer in found) == 14336
    total = 0.0
    for layer in found:
        tilt = math.atan(layer.r_end * math.sin(0.5 * layer.twist) / layer.half_length)
        sense, fields = (math.pi / 4 * d**2 / x0 for d, x0 in ((0.030, 3.504), (0.126, 88.97)))
        total += layer.cells * (sense + fields * 42240 / 14336) / (2 * math.pi * layer.r_mid * math.cos(tilt))
    assert total == pytest.approx(0.002597, abs=1e-6)
    matter = [shell for slab in slabs(detector) for shell in slab.shells if shell.group == "gas"]
    wires = [shell for shell in matter if shell.label == "wires"]
    assert {shell.material.name for shell in wires} == {"W wires", "Al wires"}
    assert sum(shell.x0 for shell in wires) == pytest.approx(total, rel=2e-3)  # Tsai's radiation length of tungsten
    text = detector.drift_chamber.text() if detector.drift_chamber else ""
    assert "matter of the wires W and Al, 0.26 % X0, spread over the gas" in text
    heavier = cg.analytic(detector, "mu-", p=1.0, cos_theta=0.0).sigma("p")
    without = cg.analytic(cg.load(belle2_wires(wires="none")), "mu-", p=1.0, cos_theta=0.0).sigma("p")
    assert float(heavier / without) > 1.1


def test_straw_tubes_have_walls() -> None:
    """A straw of 10 mm with a wall of 30 um has pi (5^2 - 4.97^2) mm2 of matter."""
    straw = {"material": "Kapton", "diameter": "10 mm", "wall": "30 um"}
    (layer,) = layers_of(chamber({"layers": 1, "r_in": "300 mm", "cells": "10 mm"}, cell_wires=[straw]))
    thickness = layer.cells * math.pi * (5**2 - 4.97**2) / (2 * math.pi * layer.r_mid)
    ((material, x0),) = layer.wire_matter(layer.cell_wires[0].material)
    assert (material.name, x0) == ("Kapton", pytest.approx(thickness / 284.1))
    found = problems(chamber(A1, cell_wires=[straw | {"wall": "6 mm"}]))
    assert found == [("cell_wires[0].wall", "6 mm")]


def test_mistakes_of_wires() -> None:
    assert problems(chamber(A1, cell_wires=[{"material": "Wo", "diameter": "30 um"}])) == [
        ("cell_wires[0].material", 'unknown material "Wo"')
    ]
    assert problems(chamber(A1, cell_wires=[{"material": "W"}])) == [("cell_wires[0]", "only material")]
    both = {"cell_wires": [{"material": "W", "diameter": "30 um"}], "wire_x0": 1e-5}
    assert problems(chamber(A1 | both)) == [("superlayers.A1.wire_x0", "also cell_wires")]
    assert problems(chamber(A1, wires="smeared")) == [("wires", '"smeared" and no matter of any wires')]


def test_wires_in_files_with_a_base_and_of_single_superlayers(tmp_path: Path) -> None:
    wires = [{"material": "W", "diameter": "30 um"}]
    detector = cg.load(chamber(A1, A2 | {"wire_x0": 1e-5}, cell_wires=wires))
    assert [bool(layer.cell_wires) for layer in layers_of(detector)] == [True] * 8 + [False] * 4
    assert [layer.wire_x0 for layer in layers_of(detector)] == [0.0] * 8 + [1e-5] * 4
    assert cg.load(tomllib.loads(detector.to_toml())) == detector
    (tmp_path / "base.toml").write_text(_toml(chamber(A1, A2, wires="none")), encoding="utf-8")
    base: dict[str, Any] = {"base": str(tmp_path / "base.toml")}
    added = cg.load(base | {"drift_chamber": {"cell_wires": wires}})
    assert layers_of(added) == layers_of(chamber(A1, A2, cell_wires=wires))
    assert added.drift_chamber is not None
    assert added.drift_chamber.wires == "smeared"
    thinner = added.with_overrides({"drift_chamber.wire_x0": 1e-5})
    assert all(layer.wire_x0 and not layer.cell_wires for layer in layers_of(thinner))
    assert added.content_hash != cg.load(base).content_hash != thinner.content_hash


def test_superlayers_have_a_gas_of_their_own() -> None:
    """Half of the layers in argon/isobutane of 121.65 m, the others in the helium mixture of the chamber."""
    detector = cg.load(chamber(A1 | {"gas": "CgemGas"}, A2))
    gases = [
        shell.material.name for slab in slabs(detector, merge=False) for shell in slab.shells if shell.group == "gas"
    ]
    assert gases[-5:] == ["CgemGas"] + ["Own"] * 4
    assert gases.count("CgemGas") == 7  # without walls the chamber begins at its first wires
    assert cg.load(tomllib.loads(detector.to_toml())) == detector
    assert detector.drift_chamber is not None
    assert "gas CgemGas and Own" in detector.drift_chamber.text()
    assert problems(chamber(A1 | {"gas": "Al"})) == [("superlayers.A1.gas", '"Al", which is no gas')]


def test_cards_have_the_matter_of_wires() -> None:
    detector = cg.load(belle2_wires())
    rows = [line.split() for line in card_of(detector).splitlines() if line.split()[1:2] and "wires" in line.split()[1]]
    x0 = sum(float(row[5]) / float(row[6]) for row in rows)
    gas = sum(shell.x0 for slab in slabs(cg.load(belle2_wires(wires="none"))) for shell in slab.shells)
    assert x0 == pytest.approx(0.002597 + gas, rel=0.03)


POINTS = [{"distance": f"{d} mm", "time": f"{t} ns"} for d, t in ((0, 0), (4, 100), (9, 350))]
ERRORS = [{"distance": f"{d} mm", "sigma": f"{s} um"} for d, s in ((0, 200), (2, 100), (5, 130))]


def first_relation(detector: cg.Detector) -> DriftRelation:
    assert detector.drift_chamber is not None
    return relation_of(detector.drift_chamber.layers[0])


def test_each_chamber_has_a_relation_of_drift_distance_and_time() -> None:
    """Times by hand: 6 mm are 100 ns + 2 mm of 50 ns/mm; 10 mm continue the last line; 25 um/ns is 240 ns for 6 mm."""
    own = cg.load(chamber(A1, drift_relation=POINTS))
    relation = first_relation(own)
    for preset in ("idea-like", "besiii-cgem"):
        changed = cg.load(preset).with_overrides({"drift_chamber.drift_relation": POINTS})
        assert first_relation(changed).time.tolist() == [0.0, 100.0, 350.0]
        back = changed.with_overrides({"drift_chamber.drift_velocity": "30 um/ns"})
        assert first_relation(back).distance_at(100.0) == pytest.approx(3.0)
    assert relation.distance_at([50.0, 200.0, 400.0]).tolist() == pytest.approx([2.0, 6.0, 10.0])
    assert relation.velocity_at([1.0, 6.0, 10.0]).tolist() == pytest.approx([0.04, 0.02, 0.02])
    assert cg.load(tomllib.loads(own.to_toml())) == own
    assert own.drift_chamber is not None
    assert "drift times of a table of 3 points" in own.drift_chamber.text()
    constant = cg.load(chamber(A1, drift_velocity="2.5 cm/us"))
    assert first_relation(constant).distance_at(240.0) == pytest.approx(6.0)
    assert own.content_hash != constant.content_hash != cg.load(chamber(A1)).content_hash
    assert first_relation(cg.load(chamber(A1))) is BESIII
    for detector, expected in ((own, 200.0), (constant, 240.0), (cg.load(chamber(A1)), 210.9)):
        hits = cg.run(detector, cg.Gun("mu-", p=1.0, cos_theta=(-0.3, 0.3)), 100, 1, until="digitize").wire_hits
        near = np.abs(hits["drift"] - 6.0) < 0.05
        assert np.median(hits["drift_time"][near]) == pytest.approx(expected, abs=4)


def of_their_own() -> cg.Detector:
    """BESIII with layer 9 of the table, layer 10 of 20 um/ns and both 7 ns late; layer 11 has another error."""
    layers = {
        "9": {"drift_relation": POINTS, "t0": "7 ns"}, "10": {"drift_velocity": "20 um/ns", "t0": "7 ns"},
        "11": {"sigma": "300 um"},
    }  # fmt: skip
    return cg.load({"base": "besiii-cgem", "drift_chamber": {"layers": layers}})


def test_layers_of_wires_have_relations_of_their_own() -> None:
    """By hand: 6 mm are 200 + 7 ns in layer 9, 300 + 7 ns in layer 10, and 150 + 50 1.3/1.05 ns in the others."""
    own = of_their_own()
    assert own.drift_chamber is not None
    assert cg.load(tomllib.loads(own.to_toml())) == own
    assert "drift times of 3 relations" in own.drift_chamber.text()
    relations, layer = relations_of(own), [8, 9, 10, 11]
    times = [200 + 50 * 0.25 / 1.15, 207.0, 307.0, 200 + 50 * 0.25 / 1.15]
    assert relations.distance_at(layer, times) == pytest.approx([6.0] * 4)
    assert relations.velocity_at(layer, [6.0] * 4) == pytest.approx([1.15 / 50, 0.02, 0.02, 1.15 / 50])
    hits = cg.run(own, cg.Gun("mu-", p=1.0, cos_theta=(-0.3, 0.3)), 100, 1, until="digitize").wire_hits
    assert relations.distance_at(hits["layer"], hits["drift_time"]) == pytest.approx(hits["drift"], abs=1e-9)
    for number, expected in zip(layer, times, strict=True):
        near = (hits["layer"] == number) & (np.abs(hits["drift"] - 6.0) < 0.2)
        assert np.median(hits["drift_time"][near]) == pytest.approx(expected, abs=4)
    with pytest.raises(ValueError, match="no wire layer 7"):
        relations.distance_at([7], [10.0])


def test_a_superlayer_has_a_relation_of_its_own() -> None:
    """A value of a layer takes the place of its superlayer's, and that of the chamber's."""
    rows = {"A": {"layers": 2, "r_in": "300 mm", "cells": 150}, "B": {"layers": 2, "cells": 150, "t0": "4 ns"}}
    rows["B"]["drift_velocity"] = "20 um/ns"
    tables = chamber(drift_velocity="40 um/ns")
    tables["drift_chamber"]["superlayers"] = rows
    detector = cg.load(tables).with_overrides({"drift_chamber.layers.3.drift_relation": POINTS})
    assert relations_of(detector).distance_at([0, 1, 2, 3], [104.0] * 4) == pytest.approx([4.16, 4.16, 2.0, 4.0])
    assert cg.load(tomllib.loads(detector.to_toml())) == detector
    # A new value of the chamber is that of all layers.
    again = detector.with_overrides({"drift_chamber.drift_relation": POINTS, "drift_chamber.t0": "0 ns"})
    assert relations_of(again).distance_at([0, 1, 2, 3], [100.0] * 4) == pytest.approx([4.0] * 4)


def test_the_reconstruction_reads_drift_times_with_its_own_relation() -> None:
    """A zero time of the fit that is 7 ns late takes v t0 from the distances; errors are those of its layers."""
    plain = cg.load("besiii-cgem")
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.3, 0.3))
    made = cg.run(plain, gun, 50, 1, until="digitize").wire_hits
    other = cg.run(plain, gun, 50, 1, until="digitize", fit_detector=of_their_own()).wire_hits
    times = made["drift_time"]
    assert np.array_equal(times, other["drift_time"])
    expected = {9: np.interp(times - 7, [0, 100, 350, 1350], [0, 4, 9, 29]), 10: 0.02 * (times - 7)}
    for number, drift in expected.items():
        rows = (made["layer"] == number) & (times > 7)
        assert rows.sum() > 30
        assert other["drift"][rows] == pytest.approx(drift[rows], abs=1e-9)
    same = (made["layer"] != 9) & (made["layer"] != 10)
    assert np.array_equal(other["drift"][same], made["drift"][same])
    assert set(other["sigma"][made["layer"] == 11]) == {0.3}
    assert np.array_equal(other["sigma"][made["layer"] == 12], made["sigma"][made["layer"] == 12])
    assert read_by(plain, plain, made) is made


@pytest.mark.parametrize(
    ("change", "path", "given"),
    [
        ({"drift_relation": POINTS[1:]}, "drift_relation", "a list of 2"),
        ({"drift_relation": POINTS[:1]}, "drift_relation", "a list of 1"),
        ({"drift_relation": [POINTS[0], POINTS[2], POINTS[1]]}, "drift_relation", "a list of 3"),
        ({"drift_relation": [{"distance": "1"}]}, "drift_relation[0].distance", '"1" (no unit)'),
        ({"drift_relation": POINTS, "drift_velocity": "25 um/ns"}, "drift_velocity", "also drift_relation"),
        ({"drift_velocity": "25 m/ns"}, "drift_velocity", '"25 m/ns"'),
        ({"sigma_points": ERRORS[1:]}, "sigma_points", "a list of 2"),
        ({"sigma_points": ERRORS}, "sigma", "also sigma_points"),
    ],
)
def test_mistakes_of_relations_and_errors(change: dict[str, Any], path: str, given: str) -> None:
    tables = chamber(A1, **change)
    if path == "sigma_points":
        del tables["drift_chamber"]["sigma"]
    assert (path, given) in [(one, text[: len(given)]) for one, text in problems(tables)]


def test_errors_as_a_table_in_all_stages() -> None:
    """The error is a straight line between points and constant beyond; diffusion adds its width in quadrature.

    Standard deviations of simulated residuals by distance: four standard errors, of 1000 hits and more each.
    """
    tables = chamber(A1, sigma_points=ERRORS, diffusion="100 um/sqrt(cm)")
    del tables["drift_chamber"]["sigma"]
    detector = cg.load(tables)
    layer = layers_of(detector)[0]
    at = np.array([0.0, 0.8, 1.6, 3.2, 6.4])
    plain = np.interp(at, [0, 2, 5], [0.2, 0.1, 0.13])
    assert layer.error_at(at) == pytest.approx(np.hypot(plain, 0.1 * np.sqrt(at / 10)), rel=1e-9)
    assert cg.load(tomllib.loads(detector.to_toml())) == detector
    run = cg.run(detector, cg.Gun("mu-", p=2.0, cos_theta=(-0.5, 0.5)), 3000, 1, until="digitize")
    hits = run.wire_hits
    assert hits["sigma"] == pytest.approx(layer.error_at(np.maximum(hits["drift"], 0.0)), rel=1e-5)
    doca = np.abs(run.tables["wire_truths"]["doca"][hits["wire_truth"]])
    for low, high in ((0.0, 0.2), (1.9, 2.1), (4.5, 5.5)):
        inside = (doca > low) & (doca < high)
        pull = (hits["drift"] - doca)[inside] / layer.error_at(doca[inside])
        assert len(pull) > 500
        assert pull.std() == pytest.approx(1.0, abs=4 / np.sqrt(2 * len(pull)))
    same = {"distance": "0 mm", "sigma": "100 um"}, {"distance": "10 mm", "sigma": "200 um"}
    straight = chamber(A1, dict(A2), sigma="100 um", sigma_slope="10 um/mm")
    line = chamber(A1, A2 | {"sigma": "100 um"}, sigma_points=list(same))
    del line["drift_chamber"]["sigma"]
    line["drift_chamber"]["superlayers"]["A2"] |= {"sigma_slope": "10 um/mm"}
    straight["drift_chamber"]["superlayers"]["A2"] |= {"sigma": "100 um"}
    found = [cg.analytic(cg.load(one), "mu-", p=1.0, cos_theta=0.3).sigma("kappa") for one in (straight, line)]
    assert found[1] == pytest.approx(found[0], rel=1e-6)
    plain_a2 = {name: value for name, value in A2.items() if name != "sigma"}
    double = chamber(A1, plain_a2, sigma_points=[one | {"sigma": "200 um"} for one in same])
    del double["drift_chamber"]["sigma"]
    assert cg.analytic(cg.load(double), "mu-", p=1.0, cos_theta=0.3).sigma("kappa") > 1.1 * found[0]
    assert [one.sigma for one in layers_of(detector.with_overrides({"drift_chamber.sigma": "80 um"}))] == [0.08] * 8
