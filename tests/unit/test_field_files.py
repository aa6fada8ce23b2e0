"""Fields in detector files, and field maps in files: read back equal, every mistake named at once."""

import json
import pickle
import re
import tomllib
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import cgemit as cg
from cgemit.cli.main import main
from cgemit.detector import (
    DetectorError,
    Field,
    HarmonicField,
    MapField,
    SolenoidField,
    field_at,
    read_field_map,
    schema,
    write_field_map,
)

R, Z = np.linspace(0, 900, 19), np.linspace(-1300, 1300, 27)


def rz_columns(bz=-0.9):
    """Return a weak quadrupole-like fall-off that obeys Maxwell's equations."""
    r, z = R[:, None] / 1000, Z[None, :] / 1000
    return {"r": R, "z": Z, "br": bz * 0.1 * z * r, "bz": bz * (1 - 0.1 * (z**2 - r**2 / 2))}


def box_columns():
    axes = {"x": np.linspace(-800, 800, 9), "y": np.linspace(-800, 800, 9), "z": Z[::2]}
    shape = tuple(map(len, axes.values()))
    return axes | {"bx": np.zeros(shape), "by": np.full(shape, 0.01), "bz": np.full(shape, 1.0)}


@pytest.fixture(scope="module")
def design():
    return cg.load("besiii-cgem-design")


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
@pytest.mark.parametrize("columns", [rz_columns(), box_columns()], ids=["cylinder", "box"])
def test_maps_are_read_as_written(tmp_path, design, suffix, columns):
    path = write_field_map(tmp_path / f"map{suffix}", columns)
    grid = read_field_map(path)
    components = [name for name in columns if name.startswith("b")]
    assert grid.values == pytest.approx(np.stack([columns[name] for name in components], axis=-1), abs=0)
    detector = design.with_field(path)
    assert isinstance(detector.field, MapField)
    assert detector.field.bz == pytest.approx(columns["bz"].flat[0] if "x" in columns else -0.9)
    assert cg.load(tomllib.loads(detector.to_toml())) == detector
    assert pickle.loads(pickle.dumps(detector)) == detector
    jsonschema.validate(tomllib.loads(detector.to_toml()), schema())


def test_units_of_a_map(tmp_path):
    columns = rz_columns()
    write_field_map(tmp_path / "mm.npz", columns)
    scaled = {name: values / 10 if name in "rz" else values * 10 for name, values in columns.items()}
    np.savez(tmp_path / "cm.npz", **scaled, length_unit="cm", field_unit="kG")
    one, other = (read_field_map(tmp_path / name) for name in ("mm.npz", "cm.npz"))
    assert other.values == pytest.approx(one.values, abs=1e-15)
    assert [axis.step for axis in other.axes] == pytest.approx([axis.step for axis in one.axes])


def test_rows_of_a_csv_map_may_have_any_order(tmp_path):
    path = write_field_map(tmp_path / "map.csv", rz_columns())
    header, *rows = path.read_text().splitlines()
    shuffled = np.random.default_rng(1).permutation(rows)
    (tmp_path / "other.csv").write_text("\n".join(["# measured", header, *shuffled]))
    assert read_field_map(tmp_path / "other.csv") == read_field_map(path)


def test_a_map_stands_beside_its_detector_file(tmp_path, monkeypatch):
    folder = tmp_path / "magnet"
    folder.mkdir()
    write_field_map(folder / "map.npz", rz_columns())
    text = 'base = "besiii-idc"\n[field]\nkind = "map"\nfile = "map.npz"\n'
    (folder / "detector.toml").write_text(text)
    detector = cg.load(folder / "detector.toml")
    assert detector.field.bz == pytest.approx(-0.9)  # the base's 1 T does not scale the map
    (folder / "scaled.toml").write_text(text + 'bz = "-0.45 T"\n')
    scaled = cg.load(folder / "scaled.toml")
    assert field_at(scaled, [[100, 50, 300]]) == pytest.approx(0.5 * field_at(detector, [[100, 50, 300]]))
    monkeypatch.chdir(folder)
    assert cg.load("besiii-idc").with_overrides({"field.kind": "map", "field.file": "map.npz"}).field == detector.field
    assert cg.load("besiii-idc").with_field("detector.toml").field == detector.field


def test_a_map_that_changed_is_noticed(tmp_path, design):
    path = write_field_map(tmp_path / "map.npz", rz_columns())
    tables = tomllib.loads(design.with_field(path).to_toml())
    write_field_map(path, rz_columns(bz=-0.8), overwrite=True)
    with pytest.raises(DetectorError, match=r"field\.checksum"):
        cg.load(tables)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"bz": None}, ["bz: got nothing"]),
        ({"z": Z**3 / 1e6}, ["z: got steps"]),
        ({"r": R + 10}, ["r: got 10 mm first, expected r = 0"]),
        ({"r": R + 10, "br": np.ones((19, 27))}, ["r: got 10 mm first, expected r = 0"]),
        ({"z": np.where(Z < 0, Z, np.inf)}, ["z: got 14 values that are not finite"]),
        ({"z": Z + 2000}, ["z: got 700 to 3300 mm, expected a range with 0"]),
        ({"bz": np.full((19, 27), np.nan)}, ["bz: got 513 values that are not finite"]),
        ({"br": np.zeros((27, 19))}, ["br: got shape (27, 19)"]),
        ({"br": np.ones((19, 27))}, ["br: got up to 1 T at r = 0"]),
        ({"length_unit": "inch", "field_unit": None}, ['length_unit: got unit "inch"', "field_unit: got nothing"]),
        ({"r": R[:3], "br": np.full((19, 27), np.inf)}, ["r: got shape (3,)", "br: got 513 values"]),
        ({"r": np.array(["a"] * 19)}, ["r: got an array of <U1, expected numbers"]),
        (
            {"br": None, "field_unit": "x", "bz": np.full((19, 27), np.nan), "z": Z + 2000},
            ["br: got nothing", 'field_unit: got unit "x"', "bz: got 513 values", "z: got 700 to 3300 mm"],
        ),
        (
            {"length_unit": "x", "z": Z + 2000, "br": np.ones((19, 27)), "bz": np.full((19, 27), np.inf)},
            ['length_unit: got unit "x"', "z: got 700 to 3300, expected", "bz: got 513 values", "br: got up to 1 T"],
        ),
        (
            {"z": Z**3 / 1e6, "br": np.zeros((27, 19)), "bz": np.full((27, 19), np.nan)},
            ["z: got steps", "br: got shape", "bz: got shape", "bz: got 513 values"],
        ),
    ],
)
def test_every_mistake_of_an_npz_map(tmp_path, design, changes, expected):
    columns = rz_columns() | {"length_unit": "mm", "field_unit": "T"} | changes
    path = tmp_path / "bad.npz"
    np.savez(path, **{name: value for name, value in columns.items() if value is not None})
    with pytest.raises(DetectorError) as error:
        read_field_map(path)
    for text in expected:
        assert text in str(error.value)
    assert len(error.value.problems) == len(expected)
    with pytest.raises(DetectorError, match=r"field\.file: got .*bad\.npz"):
        design.with_field(path)


TOO_FEW = ["r: got shape (1,)", "z: got shape (1,)"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ["header: got columns none"]),
        ("r[mm],z[mm],br[T]\n0,0,0\n", ["no column bz", *TOO_FEW]),
        ("r[mm],z[mm],bz[T]\n0,0,0,1\n0,1,0,1\n", ["no column br"]),
        ("r[mm],z[mm],bz[T]\n0,0,0,1\n0,x,0,1\n", ["no column br", "row 2 below the header, expected numbers"]),
        ("r[mm],z[inch],br[T],bz[Vs]\n0,0,0,0\n", ["header bz", "header z", *TOO_FEW]),
        ("r[mm],z[mm],br[T],bz[T]\n", ["r: got shape (0,)", "z: got shape (0,)"]),
        ("r[mm],z[mm],br[T],bz[x]\n0,0,0,nan\n0,0,0,1\n", ["header bz", "rows: got 2 rows", "bz: got 1 values"]),
        ("r[mm],z[mm],br[T],bz[T]\n0,0,0\n0,x,0,1\n", ["row 1, 2 below the header"]),
        (
            "r[mm],z[mm],br[T],bz[T]\n0,0,0,1\n0,1,0,1\n1,0,0,1\n",
            ["rows: got 3 rows, expected each point of the 2 x 2"],
        ),
    ],
)
def test_every_mistake_of_a_csv_map(tmp_path, text, expected):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(DetectorError) as error:
        read_field_map(path)
    for part in expected:
        assert part in str(error.value)
    assert len(error.value.problems) == len(expected)


@pytest.mark.parametrize("name", ["missing.npz", "map.txt", "text.npz", "empty.npz", "array.npz"])
def test_files_that_are_no_maps(tmp_path, name, capsys):
    (tmp_path / "text.npz").write_text("no archive")
    (tmp_path / "empty.npz").touch()
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(tmp_path / "array.npz")
    (tmp_path / "map.txt").write_text("r z br bz")
    with pytest.raises(DetectorError):
        read_field_map(tmp_path / name)
    assert main(["show", "besiii-idc", "--field", str(tmp_path / name)]) == 2
    assert re.search(rf"{name}(.|\n)*, expected .*(\.npz|detector)", capsys.readouterr().err)


def test_files_are_written_completely_or_not_at_all(tmp_path, monkeypatch):
    with pytest.raises(DetectorError):
        write_field_map(tmp_path / "map.npz", {"r": R, "z": Z, "br": np.zeros((2, 2))})
    path = write_field_map(tmp_path / "map.npz", rz_columns())
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        write_field_map(path, rz_columns(bz=-0.8))

    def interrupted(file, **_):
        Path(file).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_field_map(path, rz_columns(bz=-0.8), overwrite=True)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_kinds_replace_each_other(design):
    harmonic = design.with_overrides({"field.kind": "harmonic", "field.b": "0.1 /m2"})
    assert harmonic.field == HarmonicField(bz=-1.0, b=1e-7)
    coil = {"field.kind": "solenoid", "field.coil_radius": "1.4 m", "field.half_length": "1.7 m"}
    assert harmonic.with_overrides(coil).field == SolenoidField(bz=-1.0, coil_radius=1400.0, half_length=1700.0)
    assert harmonic.with_overrides({"field.kind": "uniform"}).field == Field(kind="uniform", bz=-1.0)
    for detector in (harmonic, design.with_overrides(coil)):
        assert cg.load(tomllib.loads(detector.to_toml())) == detector
        jsonschema.validate(tomllib.loads(detector.to_toml()), schema())


@pytest.mark.parametrize(
    ("field", "problems"),
    [
        ({"kind": "harmonic", "bz": "1 T"}, ["field"]),
        ({"kind": "harmonic", "bz": "1 T", "b": "0.1 /m4", "coil": 1}, ["field.b", "field.coil"]),
        ({"kind": "solenoid", "bz": "1 T", "coil_radius": "0.8 m", "half_length": "1 m"}, ["field.coil_radius"]),
        ({"kind": "dipole", "bz": "1 T"}, ["field.kind"]),
        ({"kind": "map", "file": 3}, ["field.file"]),
        ({"kind": "map"}, ["field"]),
        ({"bzz": "1 T"}, ["field.bzz", "field"]),
    ],
)
def test_every_mistake_of_a_field_table(design, field, problems):
    with pytest.raises(DetectorError) as error:
        design.with_field(field)
    assert [problem.path for problem in error.value.problems] == problems


def test_unknown_fields_are_named(design, tmp_path):
    with pytest.raises(DetectorError, match='did you mean "besiii-harmonic"'):
        design.with_field("besii-harmonic")
    (tmp_path / "empty.toml").write_text('name = "x"')
    with pytest.raises(DetectorError, match=r"a table \[field\]"):
        design.with_field(tmp_path / "empty.toml")


def test_command_line_takes_fields(tmp_path, capsys):
    arguments = ["-d", "besiii-cgem-design", "--p", "1", "--cos-theta", "0", "-n", "20", "--quiet"]
    assert main(["simulate", *arguments, "--field", "besiii-harmonic", "-o", str(tmp_path / "out")]) == 0
    written = cg.load(tmp_path / "out" / "detector.toml")
    assert isinstance(written.field, HarmonicField)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["transport"] == {"outside": 20}
    capsys.readouterr()
    assert main(["simulate", *arguments, "--field", "nothing", "-o", str(tmp_path / "other")]) == 2
    assert "one of besiii, besiii-harmonic" in capsys.readouterr().err
