"""Cards of Delphes: rows by hand, the way there and back, an independent least-squares fit of the same rows."""

import math

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.detector import DetectorError, compiled
from cgemit.detector.delphes import card_of
from cgemit.detector.matter import slabs
from least_squares import Fit

#: Rows of cards/delphes_card_IDEA.tcl (github.com/delphes/delphes); of the chamber every eighth layer.
IDEA = """
  1 PIPE -100 100 0.01 0.00235 0.35276 0 0 0 0 0 0
  1 VTXLOW -0.0965 0.0965 0.012 0.00028 0.0937 2 0 1.5708 3e-06 3e-06 1
  1 VTXLOW -0.1609 0.1609 0.02 0.00028 0.0937 2 0 1.5708 3e-06 3e-06 1
  1 VTXLOW -0.2575 0.2575 0.031525 0.00028 0.0937 2 0 1.5708 3e-06 3e-06 1   # a comment
  1 VTXLOW -0.1609 0.1609 0.15 0.00028 0.0937 2 0 1.5708 3e-06 3e-06 1
  1 VTXHIGH -0.3263 0.3263 0.315 0.00047 0.0937 2 0 1.5708 7e-06 7e-06 1
  1 DCHCANI -2.125 2.125 0.345 0.0002 0.237223 0 0 0 0 0 0
  1 DCH -2 2 0.36 0.0147748 1400 1 0.0203738 0 0.0001 0 1
  1 DCH -2 2 0.478198 0.0147748 1400 1 0.0270602 0 0.0001 0 1
  1 DCH -2 2 0.596396 0.0147748 1400 1 -0.0337442 0 0.0001 0 1
  1 DCH -2 2 0.714595 0.0147748 1400 1 0.0404252 0 0.0001 0 1
  1 DCH -2 2 0.832793 0.0147748 1400 1 -0.0471025 0 0.0001 0 1
  1 DCH -2 2 0.950991 0.0147748 1400 1 0.0537757 0 0.0001 0 1
  1 DCH -2 2 1.06919 0.0147748 1400 1 -0.0604441 0 0.0001 0 1
  1 DCH -2 2 1.18739 0.0147748 1400 1 0.0671071 0 0.0001 0 1
  1 DCH -2 2 1.30559 0.0147748 1400 1 -0.0737642 0 0.0001 0 1
  1 DCH -2 2 1.42378 0.0147748 1400 1 0.0804147 0 0.0001 0 1
  1 DCH -2 2 1.54198 0.0147748 1400 1 -0.087058 0 0.0001 0 1
  1 DCH -2 2 1.66018 0.0147748 1400 1 0.0936937 0 0.0001 0 1
  1 DCH -2 2 1.77838 0.0147748 1400 1 -0.100321 0 0.0001 0 1
  1 DCH -2 2 1.89658 0.0147748 1400 1 0.10694 0 0.0001 0 1
  1 DCHCANO -2.125 2.125 2.02 0.02 1.667 0 0 0 0 0 0
  1 BSILWRP -2.35 2.35 2.04 0.00047 0.0937 2 0 1.5708 7e-06 9e-05 1
  1 BSILWRP -2.35 2.35 2.06 0.00047 0.0937 2 0 1.5708 7e-06 9e-05 1
  2 VTXDSK 0.0365 0.2515 0.2575 0.00028 0.0937 2 0 1.5708 7e-06 7e-06 1
  2 VTXDSK 0.0365 0.2515 -0.2575 0.00028 0.0937 2 0 1.5708 7e-06 7e-06 1
  2 FSILWRP 0.35 2.02 2.3 0.00047 0.0937 2 0 1.5708 7e-06 9e-05 1
"""


def card(tmp_path, rows=IDEA, field="set B 2.0"):
    path = tmp_path / "card.tcl"
    path.write_text(
        f"{field}\nmodule TrackCovariance TrackSmearing {{\n  set Bz $B\n  set DetectorGeometry {{\n{rows}  }}\n}}\n"
    )
    return path


def test_rows_become_parts(tmp_path):
    detector = cg.load(card(tmp_path))
    assert detector.name == "card"
    assert detector.description == "barrel of a Delphes card; left out: 3 disks (VTXDSK, FSILWRP)"
    assert detector.field.bz == 2
    pipe = detector.beam_pipe["PIPE"]
    assert (pipe.r_in, pipe.r_out) == pytest.approx((8.825, 11.175))
    assert pipe.material.name == "Be"
    assert [part.label for part in detector.walls] == ["DCHCANI", "DCHCANO"]
    assert detector.walls["DCHCANI"].material.x0 == pytest.approx(237.223)
    assert len(detector.layers) == 21
    pixel, strips, wrapper = (detector.layer[label] for label in ("VTXLOW2", "DCH3", "BSILWRP2"))
    assert (pixel.radius, pixel.length, pixel.thickness) == pytest.approx((20, 321.8, 0.28))
    assert (pixel.errors, pixel.material.name) == (pytest.approx((0.003, 0.003)), "Si")
    assert pixel.measures_z
    assert (strips.views, strips.errors[1], strips.stereo) == (("V",), pytest.approx(0.1), pytest.approx(-0.0337442))
    assert strips.thickness / strips.material.x0 == pytest.approx(0.0147748 / 1400)
    assert strips.material.gas
    assert wrapper.errors == pytest.approx((0.007, 0.09))


def test_a_detector_of_a_card_becomes_the_same_card(tmp_path):
    detector = cg.load(card(tmp_path))
    again = cg.load(card(tmp_path, card_of(detector).split("{", 1)[1].rsplit("}", 1)[0]))
    assert [layer.label for layer in again.layers] == [layer.label for layer in detector.layers]
    for one, other in zip(again.layers, detector.layers, strict=True):
        assert (one.radius, one.length, one.thickness) == pytest.approx((other.radius, other.length, other.thickness))
        assert one.errors == pytest.approx(other.errors)
        assert one.material.x0 == pytest.approx(other.material.x0, rel=1e-3)
    for p in (0.5, 20.0):
        ours, theirs = (cg.analytic(one, "mu-", p=p, cos_theta=0.3).cov for one in (again, detector))
        np.testing.assert_allclose(np.sqrt(np.diag(ours)), np.sqrt(np.diag(theirs)), rtol=1e-3)


WIDE = {
    "base": "besiii-cgem-design",
    "drift_chamber": {
        "half_length": "1500 mm", "sigma": "100 um",
        "superlayers": {"A": {"layers": 8, "cells": "50 mm", "stereo": "50 mrad", "r_in": "270 mm"}},
    },
}  # fmt: skip


def among_wires(radius):
    """Return a detector with a thin layer of silicon among the wires of its chamber."""
    return {
        "base": "besiii-pixel",
        "layer": {"W": {"radius": f"{radius} mm", "sigma": "55 um", "material": "Si"}},
    }


def matter(detector):
    """Return X/X0 of all layers and cylinders, without the gas of wires."""
    cylinders = sum((one.r_out - one.r_in) / one.material.x0 for one in (*detector.beam_pipe, *detector.walls))
    return cylinders + sum(shell.x0 for layer in (*detector.cgem, *detector.layer) for shell in layer.shells())


@pytest.mark.parametrize("source", [*cg.detectors(), WIDE, among_wires(548.9)], ids=lambda one: str(one)[:20])
def test_a_card_that_is_written_is_read_as_the_same_barrel(tmp_path, source):
    """Radii, angles, errors and matter of every row are those of the detector, and no row is cut by its neighbour."""
    detector = cg.load(source)
    path = tmp_path / "card.tcl"
    path.write_text(card_of(detector))
    again = cg.load(path)
    wires = detector.drift_chamber.layers if detector.drift_chamber else ()
    expected = [(one.r_mid, one.sigma) for one in wires]
    expected += [(one.radius, max(one.errors)) for one in detector.layer if max(one.errors) > 0]
    expected += [(0.5 * (one.r_gap_in + one.r_gap_out), 0.1387) for one in detector.cgem]
    found = [(one.radius, max(one.errors)) for one in again.layer]
    np.testing.assert_allclose(np.array(sorted(found))[:, 0], np.array(sorted(expected))[:, 0], atol=2e-2)
    assert sorted(one for _, one in found) == pytest.approx(sorted(one for _, one in expected), rel=1e-6)
    rows = [line.split() for line in path.read_text().splitlines() if line.lstrip().startswith("1 ")]
    of_rows = sum(float(row[5]) / float(row[6]) for row in rows)
    assert matter(again) == pytest.approx(of_rows, rel=1e-3)
    fixed = matter(detector)
    gas = detector.drift_chamber.gas.x0 if wires else math.inf
    filled = sum(4 * math.pi * one.r_mid / one.cells / gas for one in wires)
    metal = sum(shell.x0 for slab in slabs(detector) for shell in slab.shells if shell.label == "wires")
    assert fixed + 0.999 * metal < of_rows <= fixed + filled + 1.001 * metal + 1e-9 or (
        not wires and of_rows == pytest.approx(fixed)
    )


def test_a_layer_that_touches_wires_has_no_card():
    """The cylinder of the wires would be thinner than a layer can be."""
    detector = cg.load(among_wires(548.9))
    wires = min(detector.drift_chamber.layers, key=lambda one: abs(one.r_mid - 548.9))
    detector = cg.load(among_wires(wires.r_mid - 0.1501))
    with pytest.raises(DetectorError, match=rf"layer.wires{wires.number}.thickness: got .* from 0.001 to 50 mm"):
        card_of(detector)


def test_a_card_of_wires_and_cgem_layers():
    """One row for each stack of a CGEM layer, cylinder and wire layer, with all radiation lengths."""
    detector = cg.load("besiii-cgem-design")
    rows = [line.split() for line in card_of(detector).splitlines() if line.lstrip().startswith("1 ")]
    assert len(rows) == len(detector.beam_pipe) + len(detector.walls) + 3 * 4 + len(detector.drift_chamber.layers)
    of_layer = [row for row in rows if row[1].startswith("L1-")]
    x0 = sum(float(row[5]) / float(row[6]) for row in of_layer)
    assert x0 == pytest.approx(sum(shell.x0 for shell in detector.cgem["L1"].shells()), rel=1e-6)
    (gap,) = (row for row in of_layer if row[1] == "L1-drift")
    assert [float(word) for word in gap[7:]] == pytest.approx([2, 0, detector.cgem["L1"].stereo, 1.387e-4, 1.327e-4, 1])
    (wires,) = (row for row in rows if row[1] == "wires20")
    layer = next(one for one in detector.drift_chamber.layers if one.number == 20)
    (x1, y1, z1), (x2, y2, z2) = layer.end_points(0)
    assert float(wires[8]) == pytest.approx(
        math.copysign(math.atan2(math.hypot(x1 - x2, y1 - y2), z1 - z2), layer.twist)
    )
    assert float(wires[4]) == pytest.approx(1e-3 * layer.r_mid)
    assert float(wires[10]) == pytest.approx(1.3e-4)


@pytest.mark.parametrize(
    ("rows", "field", "message"),
    [
        ("1 A -1 1 0.1 0.001\n", "set B 2", 'line 5: got "1 A -1 1 0.1 0.001", expected 13 columns'),
        ("3 A -1 1 0.1 0.001 0.1 0 0 0 0 0 0\n", "set B 2", "line 5"),
        ("1 A 2 1 0.1 0.001 0.1 0 0 0 0 0 0\n", "set B 2", "z from low to high, within 5 m of z = 0"),
        ("1 A 6 8 0.1 0.001 0.1 0 0 0 0 0 0\n", "set B 2", "z from low to high, within 5 m of z = 0"),
        ("1 A 0 2 0.1 0.001 0.1 1 0 0 1e-5 0 1\n1 B 1 3 0.1 0.001 0.1 1 0 0 1e-5 0 1\n", "set B 2", "A and B at r ="),
        ("1 A -1 1 -0.1 0.001 0.1 0 0 0 0 0 0\n", "set B 2", "a radius, thickness and radiation length above 0"),
        ("1 A -1 1 0.1 0.001 nan 0 0 0 0 0 0\n", "set B 2", "13 columns"),
        (IDEA, "", "expected a line such as: set Bz 2.0"),
        ("1 A -1 1 0.1 0.001 $X 0 0 0 0 0 0\n", "set B 2", "no value is set for \\$X: add a line such as set X 1.0"),
        ("1 A -1 1 0.1 0.001 0.1 2 0 1.57 1e-5 1e-5 1.2\n", "set B 2", "an efficiency from 0 to 1"),
        ("1 A -1 1 0.1 0.001 0.1 3 0 1.57 1e-5 1e-5 1\n", "set B 2", "expected 0, 1 or 2 coordinates"),
        ("1 A -1 1 0.1 0.001 0.1 2 0 1.57 -1e-5 1e-5 1\n", "set B 2", "resolutions of 0 .not measured. or more"),
        (IDEA, "set B 2\nif {1} {set B 3}", r"B: got .\[if ...\]"),
    ],
)
def test_rows_that_cannot_be_read(tmp_path, rows, field, message):
    with pytest.raises(DetectorError, match=message):
        cg.load(card(tmp_path, rows, field))


def test_a_variable_without_a_value_is_told_once(tmp_path):
    """As RLENGTH of cards/delphes_card_CEPC_4th.tcl (github.com/oiunun/Delphes_CEPC), in 67 rows."""
    path = card(tmp_path, IDEA.replace(" 1400 ", " $RLENGTH "))
    expected = r"1 problem\n  line 13: got .* and 13 more rows, expected .*add a line such as set RLENGTH 1.0"
    with pytest.raises(DetectorError, match=expected):
        cg.load(path)
    path.write_text(f"set RLENGTH 1400\n{path.read_text()}")
    assert len(cg.load(path).layers) == 21


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda data: data[: data.rindex(b"1 BSILWRP")],
            "line 2: got a brace or quote before .set Bz .B. that does not",
        ),
        (lambda data: data.rstrip()[:-1], "line 2: got a brace or quote before .set Bz .B. that does not end"),
        (lambda data: data + b'set Name "x\n', "line 35: got a brace or quote before .x. that does not end"),
        (lambda data: data + data.partition(b"\n")[2], "line 35: got the module TrackSmearing twice"),
        (
            lambda data: data.replace(b"comment", b"\xe9"),
            "line 9: got bytes that are no text, expected a card in UTF-8",
        ),
    ],
)
def test_cards_that_are_cut_or_doubled(tmp_path, change, message):
    """At the end of a row as well: the rows before the cut are a smaller detector."""
    path = card(tmp_path)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(DetectorError, match=f"card.tcl: 1 problem\n  {message}"):
        cg.load(path)


SENSORS = "".join(f"1 T{i} -1 1 {0.03 + 0.06 * i} 0.0002 0.0937 2 0 1.5708 6e-6 6e-6 1\n" for i in range(6))


@pytest.mark.parametrize("own", ["3.0", "-2.0", "$Other", "{1.5}", '"1.5"'])
def test_the_field_is_that_of_the_tracker(tmp_path, own):
    """Not the first one of the card, nor one in a comment or of a module that is not used."""
    path = tmp_path / "card.tcl"
    path.write_text(
        "set B 2.0 ;# of all\nset Other 2.5\n# set Bz 9\nset ExecutionPath {\n  Used\n}\n"
        f"module TrackCovariance Unused {{\n set Bz 7\n}}\nmodule TrackCovariance Used {{\n  set Bz {own}; set N 1\n"
        f"  set DetectorGeometry {{\n{SENSORS}  }}\n}}\nmodule ParticlePropagator P {{ set Bz 8 }}\n"
    )
    assert cg.load(path).field.bz == float({"$Other": "2.5"}.get(own, own.strip('{"}')))


def test_variables_and_files_beside_the_card(tmp_path):
    """Commands are not run, and files of other folders are not read."""
    folder = tmp_path / "cards"
    folder.mkdir()
    (folder / "field.tcl").write_text("set B 2.5\n")
    (tmp_path / "secret.tcl").write_text("set B 9\n")
    path = folder / "card.tcl"
    path.write_text(
        f"set Z 1.4 ; set XGAS 900.\nsource field.tcl\nsource ../secret.tcl\nexec touch {tmp_path}/ran\n"
        f"set A [exec touch {tmp_path}/ran]\nset DetectorGeometry {{\n{SENSORS}"
        "1 DC -$Z ${Z} 0.7 0.01 $XGAS 1 0.05 0 0.0001 0 0.9 ;# gas\n}\n"
    )
    detector = cg.load(path)
    assert detector.field.bz == 2.5
    assert detector.description == "barrel of a Delphes card; not read: ../secret.tcl"
    assert not (tmp_path / "ran").exists()
    wires = detector.layer["DC"]
    assert (wires.length, wires.thickness / wires.material.x0) == pytest.approx((2800, 0.01 / 900))
    assert (wires.efficiency, detector.layer["T0"].efficiency) == (0.9, 1)
    assert card_of(detector).splitlines()[-2].split()[-1] == "0.9"


def test_rows_that_overlap_keep_their_matter(tmp_path):
    """Rows that touch, overlap, lie inside another one; a coil behind; the sum of w/X0 and radii are the card's."""
    rows = (
        "1 PIPE -1 1 0.010 0.002 0.35276 0 0 0 0 0 0\n1 IN -1 1 0.0105 0.00005 0.0937 2 0 1.5708 6e-6 6e-6 1\n"
        + SENSORS
        + "1 SUP -2 2 0.5 0.0008 0.08 0 0 0 0 0 0\n1 SUPB -2 2 0.5004 0.0008 0.08 0 0 0 0 0 0\n"
        + "1 SAME -1 1 0.03 0.0008 0.22 0 0 0 0 0 0\n1 MAG -3 3 3.2 0.38 0.0658 0 0 0 0 0 0\n"
    )
    detector = cg.load(card(tmp_path, rows))
    right = sum(float(words[5]) / float(words[6]) for words in map(str.split, rows.splitlines()))
    assert matter(detector) == pytest.approx(right, rel=1e-5)
    assert detector.layer["IN"].radius == pytest.approx(10.5)
    pipe = detector.beam_pipe["PIPE"]
    assert pipe.thickness * pipe.material.density == pytest.approx(2 * 1.848, rel=1e-3)
    assert detector.walls["SAME"].r_in == pytest.approx(30.1)
    assert detector.description.endswith("; put behind a layer at the same radius: SAME")
    assert detector.walls["MAG"].r_in == pytest.approx(3010)


def test_unequal_ends(tmp_path):
    """Matter and layers have the ends of their rows, and a card of the detector states them again."""
    rows = "1 A -0.5 0.8 0.5 0.0008 0.08 0 0 0 0 0 0\n1 B -0.9 0.6 0.6 0.0002 0.0937 2 0 1.5708 6e-6 6e-6 1\n"
    detector = cg.load(card(tmp_path, SENSORS + rows))
    assert detector.description == "barrel of a Delphes card"
    assert detector.walls["A"].ends == (-500, 800)
    assert detector.layer["B"].ends == (-900, 600)
    lines = {line.split()[1]: line.split()[2:4] for line in card_of(detector).splitlines() if line.startswith("  1 ")}
    assert (lines["A"], lines["B"]) == (["-0.5", "0.8"], ["-0.9", "0.6"])
    long = cg.load(card(tmp_path, SENSORS + "1 A -9 100 0.5 0.0008 0.08 0 0 0 0 0 0\n"))
    assert long.walls["A"].ends == (-5000, 5000)


HALF_ROWS = "".join(
    line.replace("-1 1 ", z, 1) + "\n" for line in SENSORS.splitlines() for z in ("-1 -0.2 ", "-0.2 0.1 ", "0.1 1 ")
)


def test_rows_on_one_side(tmp_path):
    """Rows of one radius that lie beside each other keep their ends, thickness and matter, to the card and back."""
    rows = HALF_ROWS + "1 COIL 0.3 1.2 0.5 0.08 0.08 0 0 0 0 0 0\n1 TRUNK -1.4 -0.3 0.5 0.002 0.02 0 0 0 0 0 0\n"
    detector = cg.load(card(tmp_path, rows))
    assert [layer.ends for layer in detector.layers][:3] == [(-1000, -200), (-200, 100), (100, 1000)]
    assert {layer.radius for layer in detector.layers[:3]} == {30}
    assert [layer.thickness for layer in detector.layers] == pytest.approx([0.2] * 18)
    assert detector.walls["COIL"].ends == (300, 1200)
    assert detector.walls["TRUNK"].thickness == pytest.approx(2)
    again = tmp_path / "again.tcl"
    again.write_text(card_of(detector))
    back = cg.load(again)
    for mine, its in zip(detector.layers, back.layers, strict=True):
        assert (its.ends, its.errors) == (mine.ends, mine.errors)
        assert its.radius == pytest.approx(mine.radius, rel=1e-9)
    for one in (detector, back):  # by hand: six sensors, and the coil or the trunk
        for tanl, beyond in ((1.3, 0.08 / 0.08), (-1.3, 0.002 / 0.02)):
            found = _core.matter.total_matter(compiled(one), tanl)[0] / math.hypot(1, tanl)
            assert found == pytest.approx(6 * 0.0002 / 0.0937 + beyond, rel=1e-4)


def test_a_card_of_halves_has_the_resolutions_of_the_whole(tmp_path):
    whole, halves = (cg.load(card(tmp_path, rows)) for rows in (SENSORS, HALF_ROWS))
    for what in ("dr", "dz", "p"):
        sigma = [
            cg.analytic(one, "mu-", p=1.0, cos_theta=[-0.8, -0.3, 0.0, 0.8]).sigma(what) for one in (whole, halves)
        ]
        assert sigma[1] == pytest.approx(sigma[0], rel=5e-4)
        assert sigma[1][0] == pytest.approx(sigma[1][3], rel=5e-4)


def test_a_card_is_a_base(tmp_path):
    """Its field may be elsewhere; problems name the line of the card."""
    path = card(tmp_path, SENSORS, "")
    detector = cg.load({"base": str(path), "name": "mine", "field": {"bz": "2 T"}, "layer": {"T0": {"sigma": "9 um"}}})
    assert (detector.field.bz, detector.layer["T0"].errors, len(detector.layers)) == (2, (0.009, 0.009), 6)
    with pytest.raises(DetectorError, match=r"base: got line 5: "):
        cg.load({"base": str(card(tmp_path, "1 A\n"))})


def test_a_card_without_geometry(tmp_path):
    path = tmp_path / "card.tcl"
    path.write_text("set B 2\n")
    with pytest.raises(DetectorError, match="no block DetectorGeometry"):
        cg.load(path)


MOLIERE = cg.FitSettings(screening="moliere")


def test_rows_alone_are_a_base(tmp_path):
    """As geometries are beside FastTrackCovariance: without a card and a field."""
    (tmp_path / "GeoIDEA.txt").write_text(IDEA)
    with pytest.raises(DetectorError, match="expected a detector file with the file as base and a table"):
        cg.load(tmp_path / "GeoIDEA.txt")
    for base in ("GeoIDEA.txt", "GeoIDEA.tcl"):
        (tmp_path / base).write_text(IDEA if base.endswith("txt") else f"set DetectorGeometry {{{IDEA}}}")
        (tmp_path / "file.toml").write_text(f'name = "rows"\nbase = "{base}"\n[field]\nkind = "uniform"\nbz = "2 T"\n')
        found = cg.load(tmp_path / "file.toml")
        assert (len(found.layers), found.field.bz) == (21, 2.0)
        assert matter(found) == pytest.approx(matter(cg.load(card(tmp_path))), rel=1e-9)
    (tmp_path / "words.txt").write_text(IDEA + "and some words\n")
    with pytest.raises(DetectorError, match='line 29: got "and some words", expected 13 columns'):
        cg.load(tmp_path / "words.txt")
    (tmp_path / "toml.txt").write_text('base = "besiii-cgem"\n')
    assert cg.load(tmp_path / "toml.txt").cgem == cg.load("besiii-cgem").cgem


def rows_by_radius(text):
    """Return the barrel rows of a card as `least_squares.Fit` takes them; thick matter in twenty slices."""
    found = []
    for line in text.split("\n"):
        words = line.split("#")[0].split()
        if words and words[0] == "1":
            r, width, x0, count, up, down, first, second = (float(words[i]) for i in (4, 5, 6, 7, 8, 9, 10, 11))
            views = [(up, 1e3 * first)] * (first > 0) + [(down, 1e3 * second)] * (count > 1)
            element = {0.35276: "Be", 0.0937: "Si"}.get(x0, "C")
            n = 20 if width > 0.005 and not views else 1
            places = (1e3 * (r + width * ((k + 0.5) / n - 0.5)) for k in range(n))
            found += [(place, width / x0 / n, views, element) for place in places]
    return sorted(found, key=lambda row: row[0])


def assert_as_least_squares(detector, text, p, cos_theta, bz):
    """To 1 %, kappa without straggling."""
    rows = rows_by_radius(text)
    acting = Fit(rows, 1.0, 0.0, bz).acting()
    expected = np.sqrt(np.diag(Fit(rows, p, cos_theta, bz).covariance(*acting)))
    result = cg.analytic(detector, "mu-", p=p, cos_theta=cos_theta, phi=0.3, fit=MOLIERE)
    found = np.sqrt(np.diag(result.cov))
    np.testing.assert_allclose(found[[0, 1, 3, 4]], expected[[0, 1, 3, 4]], rtol=0.01)
    parts = result.budget("kappa").grouped("cause")
    assert sum(parts.values()) == pytest.approx(found[2] ** 2, rel=1e-6)
    assert math.sqrt(parts["measurement"] + parts["scattering"]) == pytest.approx(expected[2], rel=0.01)
    return expected


@pytest.mark.slow
@pytest.mark.parametrize("p", [1.0, 10.0, 100.0])
@pytest.mark.parametrize("cos_theta", [0.0, 0.5])
def test_resolutions_of_a_card_are_those_of_least_squares(tmp_path, p, cos_theta):
    assert_as_least_squares(cg.load(card(tmp_path)), IDEA, p, cos_theta, 2.0)


#: Rows as in cards of silicon trackers: supports in the middle of double layers (CLD), behind sensors that they touch
#: or overlap (SiD), and a calorimeter and a coil behind the last layer.
SILICON = "\n".join([
    "1 PIPE -100 100 0.015 0.0012 0.35276 0 0 0 0 0 0",
    *(f"1 VTX -0.125 0.125 {r} 5e-05 0.0937 2 0 1.5708 3e-6 3e-6 1" for r in (0.0175, 0.0185, 0.037, 0.038)),
    *(f"1 VTX -0.125 0.125 {r} 0.000557 0.0937 0 0 0 0 0 0" for r in (0.018, 0.0375)),
    *(f"1 TRK -1.2 1.2 {r} 0.0002 0.0937 2 0 1.5708 7e-6 9e-5 1" for r in (0.127, 0.4, 0.67, 1.0, 1.568, 2.136)),
    "1 TOUCH -1.2 1.2 0.1271 0.000181 0.0937 0 0 0 0 0 0",
    "1 BESIDE -1.2 1.2 0.401 0.0012 0.2372 0 0 0 0 0 0",
    "1 SHELL -1.2 1.2 1.0205 0.04 2.5 0 0 0 0 0 0",
    "1 CAL -2 2 2.3 0.2 0.0165 0 0 0 0 0 0",
    "1 COIL -2 2 3.5 0.3 0.08897 0 0 0 0 0 0",
])  # fmt: skip


@pytest.mark.parametrize("p", [1.0, 10.0, 100.0])
def test_rows_that_touch_and_overlap_are_in_the_resolutions(tmp_path, p):
    """Also matter behind the last layer, which changes nothing; without the supports sigma(p) is smaller."""
    text = SILICON
    detector = cg.load(card(tmp_path, text))
    right = sum(float(words[5]) / float(words[6]) for words in map(str.split, text.splitlines()))
    assert matter(detector) == pytest.approx(right, rel=1e-5)
    assert {"CAL", "COIL"} < {wall.label for wall in detector.walls}
    with_all = assert_as_least_squares(detector, text, p, 0.0, 2.0)
    supports = ("BESIDE", "SHELL", "TOUCH", " 0.000557 ")
    rows = rows_by_radius("\n".join(line for line in text.splitlines() if not any(one in line for one in supports)))
    without = np.sqrt(np.diag(Fit(rows, p, 0.0, 2.0).covariance(*Fit(rows, 1.0, 0.0, 2.0).acting())))
    assert with_all[0] / without[0] > 1.02


#: Barrel rows of GeoCLD.txt (github.com/selvaggi/FastTrackCovariance).
CLD = """
1 PIPE -100 100 0.015 0.0012 0.35276 0 0 0 0 0 0
1 VTX -0.125 0.125 0.0175 4.5e-05 0.0937 2 0 1.5708 3e-06 3e-06 1
1 VTX -0.125 0.125 0.0185 4.5e-05 0.0937 2 0 1.5708 3e-06 3e-06 1
1 VTX -0.125 0.125 0.037 4.5e-05 0.0937 2 0 1.5708 3e-06 3e-06 1
1 VTX -0.125 0.125 0.038 4.5e-05 0.0937 2 0 1.5708 3e-06 3e-06 1
1 VTX -0.125 0.125 0.057 4.5e-05 0.0937 2 0 1.5708 3e-06 3e-06 1
1 VTX -0.125 0.125 0.058 4.5e-05 0.0937 2 0 1.5708 3e-06 3e-06 1
1 VTX -0.125 0.125 0.018 0.000557 0.0937 0 0 0 0 0 0
1 VTX -0.125 0.125 0.0375 0.000557 0.0937 0 0 0 0 0 0
1 VTX -0.125 0.125 0.0575 0.000557 0.0937 0 0 0 0 0 0
1 VTX -0.5 0.5 0.112 0.000337 0.0937 0 0 0 0 0 0
1 VTX -0.126 0.126 0.111 9e-06 0.0937 0 0 0 0 0 0
1 VTX -0.5 0.5 0.1115 9e-06 0.0937 0 0 0 0 0 0
1 ITK -0.4816 0.4816 0.127 0.000956 0.0937 2 0 1.5708 7e-06 9e-05 1
1 ITK -0.4816 0.4816 0.4 0.000956 0.0937 2 0 1.5708 7e-06 9e-05 1
1 ITK -0.6923 0.6923 0.67 0.000956 0.0937 2 0 1.5708 7e-06 9e-05 1
1 ITK -0.4816 0.4816 0.132 0.000159 0.0937 0 0 0 0 0 0
1 ITK -0.4816 0.4816 0.405 0.000159 0.0937 0 0 0 0 0 0
1 ITK -0.6923 0.6923 0.675 0.000159 0.0937 0 0 0 0 0 0
1 ITK -2.3 2.3 0.686 0.001171 0.0937 0 0 0 0 0 0
1 ITK -2.3 2.3 0.6855 0.000281 0.0937 0 0 0 0 0 0
1 OTK -1.2642 1.2642 1 0.000956 0.0937 2 0 1.5708 7e-06 9e-05 1
1 OTK -1.2642 1.2642 1.568 0.000956 0.0937 2 0 1.5708 7e-06 9e-05 1
1 OTK -1.2642 1.2642 2.136 0.000956 0.0937 2 0 1.5708 7e-06 9e-05 1
1 OTK -1.2642 1.2642 1.005 0.000244 0.0937 0 0 0 0 0 0
1 OTK -1.2642 1.2642 1.578 0.000117 0.0937 0 0 0 0 0 0
1 OTK -1.2642 1.2642 2.126 0.000117 0.0937 0 0 0 0 0 0
1 MAG -2.5 2.5 2.25 0.05 0.0658 0 0 0 0 0 0
"""


@pytest.mark.parametrize("p", [1.0, 10.0, 100.0])
def test_cld_is_as_least_squares_and_as_published(tmp_path, p):
    """Published for muons of 100 GeV/c: 4e-5/GeV (viazlo_FCCweek2018.tex of github.com/oviazlo/presentations)."""
    (tmp_path / "GeoCLD.txt").write_text(CLD)
    detector = cg.load({"base": str(tmp_path / "GeoCLD.txt"), "name": "cld", "field": {"kind": "uniform", "bz": "2 T"}})
    right = sum(float(words[5]) / float(words[6]) for words in map(str.split, CLD.strip().splitlines()))
    assert (len(detector.layers), matter(detector)) == (12, pytest.approx(right, rel=1e-5))
    errors = assert_as_least_squares(detector, CLD, p, 0.0, 2.0)
    if p == 100.0:
        assert errors[2] == pytest.approx(4e-5, abs=0.5e-5)  # of kappa, across the beam that of 1/pT


def test_show_writes_a_card(tmp_path, capsys):
    from cgemit.cli.main import main

    assert main(["show", str(card(tmp_path)), "--delphes", "-o", str(tmp_path / "out")]) == 0
    assert "barrel of a Delphes card" in capsys.readouterr().out
    assert cg.load(tmp_path / "out" / "detector.toml").layers == cg.load(card(tmp_path)).layers
    assert "VTXLOW2" in (tmp_path / "out" / "detector.tcl").read_text()


def test_a_card_states_the_efficiency_of_cgem_layers():
    """In the row that measures; 1 stood there whatever the layer states."""
    detector = cg.load("besiii-cgem").with_overrides({"cgem.L2.efficiency": 0.9})
    rows = {row[1]: row for row in map(str.split, card_of(detector).splitlines()) if row and row[0] == "1"}
    assert [rows[f"{label}-drift"][-1] for label in ("L1", "L2", "L3")] == ["1", "0.9", "1"]
    assert rows["L2-anode"][-1] == "0"
