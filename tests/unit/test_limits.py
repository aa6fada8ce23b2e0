"""Limits of detector files, and what a file need not say."""

import time
import tomllib

import numpy as np
import pytest
from matplotlib.text import Text

from cgemit.analysis.curves import Line
from cgemit.cli.main import main
from cgemit.detector import DetectorError, load, schema, write_field_map
from cgemit.detector.build import library
from cgemit.draw.curves import draw_probabilities, draw_pulls, draw_resolutions
from cgemit.draw.detector import draw_detector, draw_layers, draw_sides

IDC = "besiii-idc"
DESIGN = "besiii-cgem-design"
LAYER = next(iter(tomllib.loads(load(IDC).to_toml())["drift_chamber"]["layers"].values()))


def problems(tables):
    """Return the problems of a detector, found in less than a second."""
    start = time.monotonic()
    with pytest.raises(DetectorError) as caught:
        load(tables)
    assert time.monotonic() - start < 1
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
    assert path in problems({"base": IDC, **changes})


@pytest.mark.parametrize("base", ["b" * 5000, "a\0b", "/" + "d/" * 3000, ["x"], "~", ""])
def test_bases_that_cannot_be(base):
    assert problems({"base": base}) == ["base"]


def test_a_base_is_the_file_itself_however_it_is_written(tmp_path):
    (tmp_path / "deep").mkdir()
    for spelling in ("x.toml", "./x.toml", "deep/../x.toml", str(tmp_path / "x.toml")):
        (tmp_path / "x.toml").write_text(f'base = "{spelling}"\n')
        assert problems(tmp_path / "x.toml") == ["base"]
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
    start = time.monotonic()
    with pytest.raises(DetectorError, match="3000 rows, expected each point of the 3000 x 3000 x 3000 grid"):
        load({"base": IDC, "field": {"kind": "map", "file": str(tmp_path / "map.csv")}})
    assert time.monotonic() - start < 1


def test_a_field_is_uniform_if_nothing_else_is_said():
    tables = tomllib.loads(load(IDC).to_toml())
    del tables["field"]["kind"]
    assert load(tables) == load(IDC)
    assert "kind" not in schema()["$defs"]["complete"]["properties"]["field"].get("required", [])


def test_an_unknown_kind_of_field_hides_no_other_problem():
    field = {"kind": "unifrom", "bz": "3 mm", "coil_radius": "1 T", "b": "1e-7 /mm2", "wrong": 1}
    found = problems({"base": IDC, "field": field})
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
        picture.savefig(tmp_path / "x.png")
        picture.savefig(tmp_path / "x.pdf")
        texts += [text.get_text().replace(r"\$", "$") for text in picture.findobj(Text)]
    for wanted in (detector.name, "L1$^$", "K$^$"):
        assert any(wanted in text for text in texts), wanted
    file = tmp_path / "dollar.toml"
    file.write_text(detector.to_toml(), encoding="utf-8")
    assert (
        main(["resolution", "-d", str(file), "--p", "1", "--events", "30", "-o", str(tmp_path / "o"), "--quiet"]) == 0
    )
