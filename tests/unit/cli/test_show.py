"""The sub-commands detectors, show and validate."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from cgemit.cli import options
from cgemit.cli.main import build_parser
from cgemit.cli.show import text
from cgemit.detector import DetectorError, describe, load, slabs
from cgemit.detector.inventory import material_scan

MATTER = """\
part          from r/mm  to r/mm  X/X0 %   sum %
------------------------------------------------
beam pipe        31.486   33.700  0.9719  0.9719
air              33.700   76.915  0.0142  0.9861
L1 cathode       76.915   78.991  0.1138  1.0999
L1 drift gap     78.991   84.140  0.0042  1.1041
"""


def call(*words: str) -> int:
    """Run a sub-command as the command line does, without turning errors into exit codes."""
    arguments = build_parser(words[0]).parse_args(words)
    return int(arguments.run(arguments))


def test_detectors(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("detectors") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [
        "babar-like", "belle2-like", "besiii-cgem", "besiii-cgem-design", "besiii-idc", "besiii-idc-boss",
        "besiii-pixel", "cepc-like", "clas12-like", "epic-like", "idea-like", "kloe2-like", "stcf-like",
    ]  # fmt: skip
    assert call("detectors", "--json") == 0
    assert list(json.loads(capsys.readouterr().out)) == [line.split()[0] for line in lines]


def test_every_printed_number_is_that_of_the_detector() -> None:
    """Tables of layers by hand from the parts, and thickness added up from the beam line outward."""
    detector = load("besiii-cgem")
    tables = text(describe(detector)).split("\n\n")
    material, sub_layers, cgem, wires = (table.splitlines()[3:] for table in tables[1:])
    total, shells = 0.0, sum(shell.x0 for slab in slabs(detector) for shell in slab.shells)
    for line in material:
        thickness, up_to_here = map(float, line.split()[-2:])
        total += thickness
        assert up_to_here == pytest.approx(total, abs=2e-4 * len(material))
        assert float(line.split()[-4]) < float(line.split()[-3])
    assert total == pytest.approx(100 * shells, abs=1e-4 * len(material))
    listed = [shell for slab in slabs(detector) for shell in slab.shells if len(slab.shells) > 1]
    for line, shell in zip(sub_layers, [one for one in listed if one.group != "gas"], strict=True):
        numbers = [shell.r_in, shell.r_out, shell.thickness, 100 * shell.x0]
        assert line.split()[-5] == shell.material.name
        assert [float(word) for word in line.split()[-4:]] == pytest.approx(numbers, abs=6e-5)
    for line, layer in zip(cgem, detector.cgem, strict=True):
        numbers = [
            layer.r_mid, layer.r_readout, layer.length, layer.drift_gap, 1e3 * layer.hole_outer, 1e3 * layer.hole_inner,
            1e3 * layer.hole_pitch, layer.sheets, math.degrees(layer.phi_first) % 360, 1e3 * layer.pitch_x,
            1e3 * layer.pitch_v, layer.strips_x, layer.strips_v, math.degrees(layer.stereo),
        ]  # fmt: skip
        assert line.split()[0] == layer.label
        assert [float(word) for word in line.split()[1:]] == pytest.approx(numbers, abs=6e-4)
    chamber = detector.drift_chamber
    assert chamber is not None
    for line, layer, gid in zip(wires, chamber.layers, chamber.gid_first, strict=True):
        numbers = [
            layer.number, layer.cells, gid, layer.r_end, layer.r_mid, layer.half_length, math.degrees(layer.twist),
        ]  # fmt: skip
        assert [float(word) for word in line.split()[:7]] == pytest.approx(numbers, abs=6e-3)
        numbers = [math.degrees(layer.phi_east), 1e3 * layer.sigma, 1e3 * layer.sigma_slope, layer.efficiency]
        assert [float(word) for word in line.split()[8:]] == pytest.approx(numbers, abs=6e-4)


@pytest.mark.slow
def test_show_prints_tables_and_draws(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = tmp_path / "out"
    assert call("show", "besiii-cgem", "-o", str(folder)) == 0
    printed = capsys.readouterr().out
    assert MATTER in printed
    rows = {line.split()[0]: line.split() for line in printed.splitlines() if line}
    assert rows["L2"][-3:] == ["630", "1077", "-31.033"]
    assert rows["L2"][5:8] == ["70", "50", "140"]
    assert rows["20"][:3] == ["20", "160", "1772"]
    assert "chamber gas" in printed
    names = {path.name for path in folder.iterdir()}
    pictures = {f"{name}.{end}" for name in ("r-phi", "r-z", "layers", "material") for end in ("png", "pdf")}
    assert names == {*pictures, "detector.toml", "summary.json", "material.csv", ".cgemit"}
    with (folder / "material.csv").open(encoding="utf-8") as stream:
        rows_of_angles = list(csv.DictReader(stream))
    angles, total = ([float(row[name]) for row in rows_of_angles] for name in ("cos_theta", "x0 (%)"))
    np.testing.assert_allclose(total, material_scan("besiii-cgem", list(angles)).total, rtol=1e-5)
    assert load(folder / "detector.toml") == load("besiii-cgem")


@pytest.mark.slow
def test_show_never_overwrites_unasked(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    call("show", "besiii-idc", "-o", str(folder))
    with pytest.raises(ValueError, match="already holds files"):
        call("show", "besiii-idc", "-o", str(folder))
    assert call("show", "besiii-idc", "-o", str(folder), "--overwrite", "--set", "field.bz=0.9 T") == 0
    assert json.loads((folder / "summary.json").read_text())["field_t"] == 0.9
    assert not (folder / "layers.png").exists()


@pytest.mark.slow
def test_show_json_with_changes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call("show", "besiii-cgem-design", "--set", "cgem.L2.pitch_x=500 um", "--set", "name=a:b", "--json") == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["cgem"][1]["pitch_x_um"] == 500
    assert numbers["cgem"][1]["strips_x"] == 832
    total = sum(part["x0_percent"] for part in numbers["material"])
    inner = sum(row["x0_percent"] for part in numbers["material"] for row in part["sub_layers"])
    assert total == pytest.approx(inner)
    assert (tmp_path / "cgemit-show-a-b" / "r-z.pdf").stat().st_size > 10_000


def test_a_full_folder_is_refused_before_anything_is_printed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(FileExistsError, match="already holds files"):
        call("show", "besiii-idc", "-o", str(tmp_path))
    assert capsys.readouterr().out == ""


def test_a_name_without_description_stands_alone() -> None:
    detector = load({"base": "besiii-idc", "name": "mine"})
    assert text(describe(detector)).splitlines()[0] == f"mine: {detector.description}"
    assert text(describe(replace(detector, description=""))).splitlines()[0] == "mine"


def test_show_reports_problems() -> None:
    with pytest.raises(DetectorError, match="did you mean"):
        call("show", "besiii-cgem-design", "--set", "cgem.L2.ptich_x=500 um")
    with pytest.raises(options.InputError, match="KEY=VALUE"):
        call("show", "besiii-cgem-design", "--set", "cgem.L2.pitch_x")


def test_validate_tells_layers_in_which_no_track_begins(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Wires of one stereo sign make no seeds."""
    one_sign = tmp_path / "one-sign.toml"
    layers = "[drift_chamber.superlayers.U]\nlayers = 12\nr_in = '290 mm'\ncells = '15 mm'\nstereo = '60 mrad'\n"
    one_sign.write_text(f'base = "kloe2-like"\n{layers}half_length = "1 m"\n', encoding="utf-8")
    assert call("validate", str(one_sign), "besiii-cgem") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("one-sign.toml: good (detector 'one-sign')")
    assert lines[1].startswith(
        "  finder ckf: no track begins in wires alone: it needs X and V in two of L1, L2, L3, L4"
    )
    assert lines[2].startswith("besiii-cgem: good")
    assert len(lines) == 3


def test_validate(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    good, bad = tmp_path / "good.toml", tmp_path / "bad.toml"
    good.write_text('base = "besiii-idc"', encoding="utf-8")
    bad.write_text('base = "besiii-idc"\nnmae = "x"\n[field]\nbz = "1"\n', encoding="utf-8")
    assert call("validate", str(good), "besiii-cgem") == 0
    assert call("validate", str(bad), str(good)) == 2
    streams = capsys.readouterr()
    assert streams.out.count("good (detector") == 3
    assert len(streams.err.splitlines()) == 3
    assert all(word in streams.err for word in ("bad.toml: 2 problems", "nmae", "field.bz"))
    assert call("validate", str(tmp_path / "none.toml")) == 2
    with pytest.raises(options.InputError, match="FILE"):
        call("validate")


def test_validate_writes_the_schema(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("validate", "--schema", "besiii-cgem") == 0
    jsonschema.Draft202012Validator.check_schema(json.loads(capsys.readouterr().out))


def test_show_and_validate_say_what_is_not_reached(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A layer that is longer than the field map is named by both."""
    file = tmp_path / "short.toml"
    field = 'kind = "harmonic"\nbz = "2 T"\nb = "1e-4 /m2"\nz_max = "2.1 m"\n'
    file.write_text(f'base = "idea-like"\nname = "short"\n[field]\n{field}', encoding="utf-8")
    line = "layer.WRAP1, layer.WRAP2 (2 of 119 layers): no track from the origin reaches z below -2100 mm"
    line += " and z above 2100 mm"
    assert call("validate", str(file)) == 0
    assert line in capsys.readouterr().out
    assert call("show", str(file), "-o", str(tmp_path / "out")) == 0
    assert line in capsys.readouterr().out
    assert call("show", str(file), "-o", str(tmp_path / "json"), "--json") == 0
    assert json.loads(capsys.readouterr().out)["unreachable"][0].startswith(line)
