"""The GDML file of a detector has its matter: read back by an XML parser, X/X0 along rays compared."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import pytest

import cgemit as cg
from cgemit.cli.main import main
from cgemit.detector import describe
from cgemit.detector.export import write_gdml
from cgemit.detector.matter import slabs

NAMES = ["besiii-cgem-design", "besiii-cgem", "besiii-idc", "kloe2-like"]


def tsai(z: float, a: float) -> float:
    """Return the radiation length of an element, g/cm2 (Y.S. Tsai, Rev. Mod. Phys. 46 (1974) 815, as in PDG 2024)."""
    light = {1: (5.31, 6.144), 2: (4.79, 5.621), 3: (4.74, 5.805), 4: (4.71, 5.924)}
    rad, rad2 = light.get(round(z), (math.log(184.15 * z ** (-1 / 3)), math.log(1194 * z ** (-2 / 3))))
    y = (z / 137.036) ** 2
    coulomb = y * (1 / (1 + y) + 0.20206 - 0.0369 * y + 0.0083 * y**2 - 0.002 * y**3)
    return 716.408 * a / (z**2 * (rad - coulomb) + z * rad2)


class Geometry:
    """Tubes of a GDML file with their radiation lengths, stated and from the composition."""

    def __init__(self, path: Path) -> None:
        root = ElementTree.parse(path).getroot()
        elements = {
            one.get("name"): tsai(float(one.get("Z", "")), float(one.find("atom").get("value")))  # type: ignore[union-attr, arg-type]
            for one in root.iter("element")
        }
        x0 = {}
        for one in root.iter("material"):
            density = float(one.find("D").get("value"))  # type: ignore[union-attr, arg-type]
            parts = [(float(f.get("n", "")), elements[f.get("ref")]) for f in one.iter("fraction")]
            if parts:
                assert sum(share for share, _ in parts) == pytest.approx(1, abs=1e-12)
            x0[one.get("name")] = 10 / (density * sum(s / x for s, x in parts)) if parts else math.inf
        tubes = {one.get("name"): one for one in root.iter("tube")}
        self.tubes, self.air = [], (0.0, 0.0)
        for one in root.iter("volume"):
            stated, material = one.find("auxiliary"), one.find("materialref").get("ref")  # type: ignore[union-attr]
            lengths = (math.inf if stated is None else float(stated.get("auxvalue", "")), x0[material])
            solid = one.find("solidref").get("ref")  # type: ignore[union-attr]
            if one.get("name") == "world":
                self.air = lengths
                placed = {ref.get("ref") for ref in one.iter("volumeref")}
            else:
                size = [float(tubes[solid].get(key, "")) for key in ("rmin", "rmax", "z")]
                self.tubes.append((one.get("name"), *size, lengths))
        assert placed == {name for name, *_ in self.tubes}
        assert root.find("setup/world").get("ref") == "world"  # type: ignore[union-attr]

    def thickness(self, tan_lambda: float, stated: bool) -> float:
        """Return X/X0 along a ray from the origin to the outermost tube; between tubes there is air."""
        which, slope, total, reached = 0 if stated else 1, math.hypot(1, tan_lambda), 0.0, 0.0
        for _, r_in, r_out, length, x0 in sorted(self.tubes, key=lambda tube: tube[1]):
            assert r_in > reached - 1e-9  # no overlap
            total += slope * max(0.0, r_in - reached) / self.air[which]
            inside = abs(tan_lambda) * r_out < 0.5 * length
            total += slope * (r_out - r_in) / (x0 if inside else self.air)[which]
            reached = r_out
        return total


@pytest.mark.parametrize("wires", ["none", "smeared"])
@pytest.mark.parametrize("name", NAMES)
def test_matter_along_rays_is_ours(name: str, wires: str, tmp_path: Path) -> None:
    metal = [{"material": "W", "diameter": "30 um"}, {"material": "Al", "diameter": "120 um", "number": 3}]
    matter = {"drift_chamber.cell_wires": metal} if name == "kloe2-like" else {}
    detector = cg.load(name).with_overrides({**matter, "drift_chamber.wires": wires})
    detector.to_gdml(tmp_path / "detector.gdml")
    read = Geometry(tmp_path / "detector.gdml")
    normal = sum(part["x0_percent"] for part in describe(detector)["material"]) / 100
    assert read.thickness(0.0, stated=True) == pytest.approx(normal, rel=1e-9)
    for tan_lambda in (0.3, -0.9, 1.4):
        slope, ours = math.hypot(1, tan_lambda), 0.0
        for shell in (shell for slab in slabs(detector, merge=False) for shell in slab.shells):
            inside = abs(tan_lambda) * shell.r_out < shell.ends[1]
            air = shell.thickness / detector.air.x0 if shell.label != "wires" else 0.0
            ours += slope * (shell.x0 if inside else air)
        assert read.thickness(tan_lambda, stated=True) == pytest.approx(ours, rel=1e-9)
    assert read.thickness(0.0, stated=False) == pytest.approx(normal, rel=0.04)


def test_a_wrong_thickness_or_density_is_seen(tmp_path: Path) -> None:
    detector = cg.load("besiii-cgem-design")
    detector.to_gdml(tmp_path / "good.gdml")
    good = Geometry(tmp_path / "good.gdml")
    thin = detector.with_overrides({"beam_pipe.inner-be.r_in": "31.9 mm"})
    write_gdml(thin, tmp_path / "thin.gdml")
    assert Geometry(tmp_path / "thin.gdml").thickness(0.0, stated=True) < 0.99 * good.thickness(0.0, stated=True)
    text = (tmp_path / "good.gdml").read_text().replace('value="1.848"', 'value="18.48"')
    (tmp_path / "heavy.gdml").write_text(text)
    heavy = Geometry(tmp_path / "heavy.gdml").thickness(0.0, stated=False)
    assert heavy > 1.5 * good.thickness(0.0, stated=False)


def test_a_material_of_bulk_properties_has_an_equivalent_element(tmp_path: Path) -> None:
    bulk = {"density": "2 g/cm3", "x0": "100 mm", "z_over_a": 0.49, "excitation_energy": "120 eV"}
    tables = {
        "base": "besiii-idc", "name": "odd names: 1 & <2>",
        "materials": {"stuff": bulk}, "walls": {"inner-wall-cfrp": {"material": "stuff"}},
    }  # fmt: skip
    detector = cg.load(tables)
    detector.to_gdml(tmp_path / "bulk.gdml")
    read = Geometry(tmp_path / "bulk.gdml")
    (tube,) = (tube for tube in read.tubes if "cfrp" in str(tube[0]))
    assert tube[-1] == (100.0, pytest.approx(100.0, rel=0.05))


def test_description_of_a_layer_has_the_numbers_of_its_file() -> None:
    changes = {"cgem.L2.pitch_x": "500 um", "cgem.L2.pitch_v": "800 um", "cgem.L2.hole_pitch": "130 um"}
    rows = describe(cg.load("besiii-cgem-design").with_overrides(changes))["cgem"]
    assert [(row["layer"], row["pitch_x_um"], row["pitch_v_um"]) for row in rows] == [
        ("L1", 650, 650), ("L2", 500, 800), ("L3", 650, 650),
    ]  # fmt: skip
    assert rows[1]["hole_pitch_um"] == pytest.approx(130)


def test_files_are_not_replaced_unasked(tmp_path: Path) -> None:
    detector = cg.load("besiii-idc")
    detector.to_gdml(tmp_path / "one.gdml")
    with pytest.raises(FileExistsError):
        detector.to_gdml(tmp_path / "one.gdml")
    detector.to_gdml(tmp_path / "one.gdml", overwrite=True)


@pytest.mark.slow
def test_show_writes_it(tmp_path: Path) -> None:
    assert main(["show", "besiii-idc", "--gdml", "-o", str(tmp_path / "out")]) == 0
    cg.load("besiii-idc").to_gdml(tmp_path / "same.gdml")
    assert (tmp_path / "out" / "detector.gdml").read_text() == (tmp_path / "same.gdml").read_text()
