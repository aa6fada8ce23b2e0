"""Particles of generators: HepMC files, lists per event, tables in files."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import time
import tracemalloc
import warnings
from pathlib import Path
from typing import Any

import awkward as ak
import numpy as np
import pandas as pd
import pyhepmc
import pytest
import uproot

import cgemit as cg
from cgemit.cli.main import main
from cgemit.particles import records, species
from cgemit.particles.gun import generate
from cgemit.particles.records import ParticleError, read_hepmc
from cgemit.particles.table import particles_from, read_particles

DESIGN = "besiii-cgem-design"


def event(
    number: int, units: tuple[Any, Any], point: tuple[float, ...], final: list[tuple[int, tuple[float, ...]]]
) -> Any:
    """Return an event with a J/psi that decays at a point to final particles and one that is not final."""
    made = pyhepmc.GenEvent(*units)
    made.event_number = number
    vertex = pyhepmc.GenVertex((*point, 0.0))
    vertex.add_particle_in(pyhepmc.GenParticle((0.0, 0.0, 0.0, 3.1), 443, 2))
    for pdg, momentum in final:
        vertex.add_particle_out(pyhepmc.GenParticle((*momentum, 1.0), pdg, 1))
    vertex.add_particle_out(pyhepmc.GenParticle((0.1, 0.1, 0.1, 1.0), 113, 2))
    made.add_vertex(vertex)
    return made


MEV, GEV = (pyhepmc.Units.MEV, pyhepmc.Units.CM), (pyhepmc.Units.GEV, pyhepmc.Units.MM)
EVENTS = [
    (MEV, (0.1, 0.2, -0.3), []),
    (MEV, (0.1, 0.2, -0.3), [(13, (100.0, 200.0, 300.0)), (-13, (-100.0, -200.0, -300.5)), (22, (1.0, 0.0, 0.0))]),
    (GEV, (0.0, 0.0, 0.5), [(211, (0.25, 0.5, -0.125)), (-211, (0.5, 0.25, 0.125))]),
    (GEV, (0.0, 0.0, 0.5), []),
]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A HepMC3 file whose event numbers repeat, with an event without final particles at each end."""
    path = tmp_path / "events.hepmc"
    with pyhepmc.open(str(path), "w") as stream:
        for units, point, final in EVENTS:
            stream.write(event(3, units, point, final))
    return path


def test_hepmc_is_read_with_its_units_and_vertices(file: Path) -> None:
    particles = particles_from(file)
    assert (particles.n_events, particles.first_event) == (4, 0)
    assert particles["event"].tolist() == [1, 1, 1, 2, 2]
    assert particles["particle"].tolist() == [0, 1, 2, 0, 1]
    assert particles["pdg"].tolist() == [13, -13, 22, 211, -211]
    assert particles["charge"].tolist() == [-1, 1, 0, 1, -1]
    assert particles["hepmc_id"].tolist() == [2, 3, 4, 2, 3]
    expected = {"x": [1.0] * 3 + [0.0] * 2, "y": [2.0] * 3 + [0.0] * 2, "z": [-3.0] * 3 + [0.5] * 2}
    expected |= {"px": [0.1, -0.1, 0.001, 0.25, 0.5], "py": [0.2, -0.2, 0.0, 0.5, 0.25]}
    expected["pz"] = [0.3, -0.3005, 0.0, -0.125, 0.125]
    for name, values in expected.items():
        assert particles[name] == pytest.approx(values, rel=1e-12, abs=0)


def test_hepmc_runs_as_the_same_columns_do(file: Path, tmp_path: Path) -> None:
    result = cg.run(DESIGN, file, seed=2)
    other = cg.run(DESIGN, particles_from(file), seed=2)
    assert {name: table for name, table in result.tables.items() if name != "events"} == dict(other.tables)
    assert (result.n_events, result.gun) == (4, None)
    assert result.tracks["event"].tolist() == [1, 1, 2, 2]
    packed = tmp_path / "events.hepmc.gz"
    packed.write_bytes(gzip.compress(file.read_bytes()))
    assert particles_from(str(packed)) == particles_from(file)
    old = tmp_path / "old.hepmc2"
    with pyhepmc.open(str(old), "w", format="HepMC2") as stream:
        for units, point, final in EVENTS[1:3]:
            stream.write(event(3, units, point, final))
    assert particles_from(old)["px"] == pytest.approx(particles_from(file)["px"], rel=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: b"", "got no beginning of a list of events"),
        (lambda data: b"hello\n", "got no beginning of a list of events"),
        (lambda data: data[: len(data) // 2], r"line \d+: got a last line that does not end the list of events"),
    ],
)
def test_damaged_hepmc_is_refused(file: Path, change: Any, message: str) -> None:
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(ValueError, match=rf"events.hepmc: 1 problem\n  {message}.*, expected a complete HepMC file"):
        cg.run(DESIGN, file)


def test_packed_hepmc_that_unpacks_to_too_much_is_refused(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, packed = file.read_bytes(), tmp_path / "packed.hepmc.gz"
    packed.write_bytes(gzip.compress(data))
    monkeypatch.setattr(records, "_MOST_UNPACKED", len(data))
    assert len(read_hepmc(packed).columns["pdg"]) > 0
    monkeypatch.setattr(records, "_MOST_UNPACKED", len(data) - 1)
    with pytest.raises(
        ValueError, match=r"packed.hepmc.gz: 1 problem\n  got more than .* MB unpacked, expected at most"
    ):
        read_hepmc(packed)
    assert len(read_hepmc(file).columns["pdg"]) > 0  # its size is there to see


def test_hepmc_without_lines_is_refused_before_it_is_unpacked(file: Path, tmp_path: Path) -> None:
    packed = tmp_path / "zeros.hepmc.gz"
    packed.write_bytes(gzip.compress(file.read_bytes() + bytes(50_000_000), 1))
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"line \d+: got a line of more than 1000000 bytes, expected a complete"):
        read_hepmc(packed)
    assert tracemalloc.get_traced_memory()[1] < 20_000_000
    tracemalloc.stop()


def test_other_damaged_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "events.hepmc.gz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match="expected a complete HepMC file"):
        particles_from(tmp_path / "events.hepmc.gz")
    with pytest.raises(FileNotFoundError):
        particles_from(tmp_path / "missing.hepmc")
    with pytest.raises(
        ParticleError, match=r"got the file 'events.txt', expected one of .npz, .parquet, .root, .csv, .hepmc"
    ):
        particles_from("events.txt")
    cg.Table.empty("digis").save(tmp_path / "digis.npz")
    with pytest.raises(ParticleError, match="got a table of kind 'digis', expected 'particles'"):
        particles_from(tmp_path / "digis.npz")


@pytest.mark.parametrize("suffix", [".npz", ".parquet", ".root"])
def test_tables_in_files_are_particles(tmp_path: Path, suffix: str) -> None:
    particles = generate(cg.Gun("mu-", p=1, theta=1), 3, seed=1, first_event=5)
    particles.save(tmp_path / f"mine{suffix}")
    assert particles_from(tmp_path / f"mine{suffix}") == particles


def test_lists_per_event_are_particles() -> None:
    lists = ak.Array(
        [
            [],
            [{"pdg": 13, "px": 0.1, "py": 0.2, "pz": 0.3}, {"pdg": -211, "px": 0.4, "py": 0.5, "pz": 0.6}],
            [{"pdg": 321, "px": 0.7, "py": 0.8, "pz": 0.9}],
            [],
        ]
    )
    particles = particles_from(lists)
    assert (particles.n_events, particles.first_event) == (4, 0)
    assert particles["event"].tolist() == [1, 1, 2]
    assert particles["particle"].tolist() == [0, 1, 0]
    assert particles["px"].tolist() == [0.1, 0.4, 0.7]
    record = ak.zip({name: lists[name] for name in ak.fields(lists)}, depth_limit=1)
    assert particles_from(record) == particles  # a record of lists
    result = cg.run(DESIGN, lists)
    assert result.n_events == 4
    assert particles_from(result.particles.to_awkward()).columns["pz"].tolist() == [0.3, 0.6, 0.9]
    later = generate(cg.Gun("mu-", p=1, theta=1, multiplicity=2), 3, seed=1, first_event=5)
    assert particles_from(later.to_awkward()) == later


def test_lists_that_are_none_are_refused() -> None:
    flat = ak.Array([{"pdg": 13, "px": 1.0, "py": 0.0, "pz": 0.0}])
    with pytest.raises(ParticleError, match=r"a list of records per event .got pdg 1, px 1, py 1, pz 1 dimensions"):
        particles_from(flat)
    with pytest.raises(ParticleError, match="got no fields dimensions"):
        particles_from(ak.Array([[1, 2]]))
    uneven = ak.zip({"pdg": ak.Array([[13], []]), "px": ak.Array([[1.0], [2.0]])}, depth_limit=1)
    with pytest.raises(ParticleError, match="px: got lists of other lengths than pdg"):
        particles_from(uneven)
    with pytest.raises(ParticleError, match="py: got nothing"):
        particles_from(ak.Array([[{"pdg": 13, "px": 1.0, "pz": 1.0}]]))


def test_the_command_line_takes_particles(file: Path, tmp_path: Path, capsys: Any) -> None:
    words = ["simulate", "-d", DESIGN, "--quiet", "-o", str(tmp_path / "run")]
    assert main([*words, "--particles", str(file), "--fit", "--seed", "2"]) == 0
    assert cg.Result.load(tmp_path / "run") == cg.run(DESIGN, file, seed=2)
    assert main([*words, "--overwrite", "--particles", str(file), "--p", "1", "--vertex", "1,2,3"]) == 2
    assert "--particles: got --p, --vertex, too; expected particles of a file or of a gun" in capsys.readouterr().err
    assert main([*words, "--overwrite", "--particles", str(file), "-n", "5"]) == 2
    assert "n: got 5, expected 4, the events of the table of particles" in capsys.readouterr().err
    assert main([*words, "--overwrite", "--theta", "1"]) == 2
    assert "got no -n, no --p or --pt; expected all of these, or --particles FILE, or" in capsys.readouterr().err


HEPMC = """HepMC::Version 3.02.05
HepMC::Asciiv3-START_EVENT_LISTING
E 0 1 2
U {units}
V -1 0 [1] @ 0 0 0 0
P 1 0 443 0 0 0 3.1 3.1 2
P 2 -1 13 0.5 0 0 0.51 0.106 1
HepMC::Asciiv3-END_EVENT_LISTING
"""


@pytest.mark.parametrize(("units", "px"), [("GEV MM", 0.5), ("MEV CM", 0.5e-3)])
def test_units_of_hepmc(units, px, tmp_path):
    path = tmp_path / "events.hepmc3"
    path.write_text(HEPMC.format(units=units))
    assert particles_from(path)["px"].tolist() == pytest.approx([px])


@pytest.mark.parametrize("units", ["TEV MM", "GEV FOOT", "GEV", "gev mm"])
def test_unknown_units_of_hepmc(units, tmp_path):
    path = tmp_path / "events.hepmc3"
    path.write_text(HEPMC.format(units=units))
    with pytest.raises(ValueError, match=f"line 4: got the units 'U {units}', expected GEV or MEV, then MM or CM"):
        read_hepmc(path)


def test_hepmc_without_units(tmp_path):
    path = tmp_path / "events.hepmc3"
    path.write_text(HEPMC.replace("U {units}\n", ""))
    with pytest.raises(ValueError, match="line 3: got an event that does not name its units, expected a U line"):
        read_hepmc(path)


@pytest.mark.parametrize(
    "table", [{"name": "a\ud800"}, {"description": "a\udfff"}, {"materials": {"\ud800": {"base": "Cu"}}}]
)
def test_halves_of_surrogate_pairs(table):
    """No file can hold them, so that a run would end at its last step."""
    with pytest.raises(cg.DetectorError, match="expected"):
        cg.load({"base": "besiii-cgem", "name": "x", **table})


MUONS = {"event": [0, 1], "pdg": [13, -13], "px": [1.0, 1.0], "py": [0.0, 0.1], "pz": [0.0, 0.1]}


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"mass": [0.10566, 105.66]}, "mass: is not that of the pdg number .105.66. in row 1"),
        ({"mass": [0.000511, 0.10566]}, "mass: is not that of the pdg number .0.000511. in row 0"),
        ({"vz": [200.0, 200.0]}, 'vz: got an unknown column, expected the vertex .*did you mean "z"'),
        ({"Vertex_X": [1.0, 1.0]}, 'Vertex_X: got an unknown column, .*did you mean "x"'),
        ({"px": np.ma.masked_array([1.0, 2.0], [True, False])}, "px: got masked values"),
    ],
)
def test_columns_that_would_be_misread(columns, message):
    """A mass in MeV, a vertex under another name, values below a mask."""
    with pytest.raises(ValueError, match=message):
        particles_from({**MUONS, **columns})


def test_columns_beside_those_of_particles():
    """Columns without a meaning here are left out; masses near the usual one are taken, and masks of nothing."""
    columns = {"mass": [0.1057, 0.1], "z": [2.0, 3.0], "vz": [9.0, 9.0], "px": np.ma.masked_array([1.0, 2.0])}
    table = particles_from({**MUONS, **columns})
    assert [table[name].tolist() for name in ("z", "px", "mass")] == [[2.0, 3.0], [1.0, 2.0], [0.1057, 0.1]]


OLD_HEPMC = """HepMC::Version 2.06.09
HepMC::IO_GenEvent-START_EVENT_LISTING
E 0 -1 -1.0 -1.0 -1.0 0 0 2 1 2 0 0
U GEV MM
V -1 0 1 2 3 0 2 2 0
P 1 11 0 0 1.5 1.5 0.0005 4 0 0 -1 0
P 2 -11 0 0 -1.5 1.5 0.0005 4 0 0 -1 0
P 3 310 0.5 0.25 0.5 0.9 0.4976 2 0 0 -2 0
P 4 13 -0.5 -0.25 -0.5 0.8 0.105 1 0 0 0 0
V -2 0 4 5 6 0 0 2 0
P 5 211 0.25 0.5 -0.125 0.6 0.1396 1 0 0 0 0
P 6 -211 0.25 -0.25 0.625 0.75 0.1396 1 0 0 0 0
HepMC::IO_GenEvent-END_EVENT_LISTING
"""
NEW_HEPMC = """HepMC::Version 3.02.05
HepMC::Asciiv3-START_EVENT_LISTING
E 0 2 5
U GEV MM
P 1 0 443 0 0 0.2 3.1 3.0969 4
V -1 0 [1] @ 1 2 3 0
P 2 -1 310 0.5 0.25 0.5 0.9 0.4976 2
P 3 -1 13 -0.5 -0.25 -0.5 0.8 0.105 1
V -2 0 [2] @ 4 5 6 0
P 4 -2 211 0.25 0.5 -0.125 0.6 0.1396 1
P 5 -2 -211 0.25 -0.25 0.625 0.75 0.1396 1
HepMC::Asciiv3-END_EVENT_LISTING
"""


@pytest.mark.parametrize(("name", "text"), [("a.hepmc2", OLD_HEPMC), ("a.hepmc3", NEW_HEPMC)])
def test_hepmc_of_both_forms_gives_the_numbers_of_its_lines(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    columns = particles_from(tmp_path / name)
    assert columns.n_events == 1
    order = np.argsort(-columns["pdg"])
    assert columns["pdg"][order].tolist() == [211, 13, -211]
    assert columns["x"][order].tolist() == [4.0, 1.0, 4.0]
    assert columns["z"][order].tolist() == [6.0, 3.0, 6.0]
    assert columns["px"][order].tolist() == [0.25, -0.5, 0.25]
    assert columns["pz"][order].tolist() == [-0.125, -0.5, 0.625]


KILLERS = [
    # A vertex with the number 0.
    ("a.hepmc2", OLD_HEPMC.replace("V -2 0", "V 0 0"), 3),
    # Weights of a vertex that no particle enters.
    ("a.hepmc2", OLD_HEPMC.replace(" 0 0 -2 0", " 0 0 0 0").replace("0 0 2 0\nP 5", "0 0 2 1 1.0\nP 5"), 3),
    # A vertex that its own particle enters.
    ("a.hepmc3", NEW_HEPMC.replace("V -2 0 [2] @ 4 5 6 0", "V -2 0 [4]"), 3),
]


@pytest.mark.parametrize(("name", "text", "line"), KILLERS)
def test_hepmc_that_ends_the_process_of_pyhepmc_is_refused(name: str, text: str, line: int, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ParticleError, match=rf"{name}: 1 problem\n  line {line}: got .*expected a complete HepMC file"):
        read_hepmc(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.hepmc2", OLD_HEPMC.replace("P 6 -211 0.25 -0.25 0.625 0.75 0.1396 1 0 0 0 0\n", ""), "line 12: got 5 part"),
        ("a.hepmc2", OLD_HEPMC.replace("-1.0 0 0 2 1", "-1.0 0 0 3 1"), "line 13: got 2 vertices of the event th"),
        ("a.hepmc2", OLD_HEPMC.replace("5 6 0 0 2 0", "5 6 0 0"), "line 10: got 'V -2 0 4 5 6 0 0', expected a whole"),
        ("a.hepmc3", NEW_HEPMC.replace("P 5 -2 -211 0.25 -0.25 0.625 0.75 0.1396 1\n", ""), "line 11: got 4 particles"),
        ("a.hepmc3", NEW_HEPMC.replace("E 0 2 5", "E 0 2"), "line 3: got 'E 0 2', expected a whole number in column 4"),
    ],
)  # fmt: skip
def test_hepmc_whose_lines_are_not_those_announced_is_refused(
    name: str, text: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ParticleError, match=message):
        read_hepmc(tmp_path / name)


def test_particles_that_pyhepmc_leaves_out_are_counted(tmp_path: Path) -> None:
    (tmp_path / "a.hepmc2").write_text(OLD_HEPMC.replace(" 0 0 -2 0", " 0 0 0 0"))  # nothing enters the second vertex
    with pytest.warns(UserWarning, match="a.hepmc2: 4 of the 6 particles of the event that begins in line 3 are read"):
        assert particles_from(tmp_path / "a.hepmc2")["pdg"].tolist() == [13]


@pytest.mark.parametrize(
    ("name", "old", "new", "line", "expected"),
    [
        ("a.hepmc3", "0.5 0.25 0.5 0.9", "0,5 0.25 0.5 0.9", 7, "numbers such as"),
        ("a.hepmc3", "0.5 0.25 0.5 0.9", "x 0.25 0.5 0.9", 7, "numbers such as"),
        ("a.hepmc3", "0.5 0.25 0.5 0.9", "0.5D0 0.25 0.5 0.9", 7, "numbers such as"),
        ("a.hepmc3", "0.105 1", "0.105 1.5", 8, "numbers such as"),
        ("a.hepmc3", "3 -1 13", "3 -1 99999999999", 8, "a PDG number up to 2147483647"),
        ("a.hepmc3", "3 -1 13", "3  -1 13", 8, "numbers such as -1.5e-3 between single spaces"),
        ("a.hepmc3", "4 -2 211", "4 -7 211", 10, "vertices .below 0. and particles of its event"),
        ("a.hepmc3", "3 -1 13", "3 99 13", 8, "vertices .below 0. and particles of its event"),
        ("a.hepmc3", "V -2 0 [2]", "V -2 0 [99]", 9, "vertices .below 0. and particles of its event"),
        ("a.hepmc3", "@ 1 2 3 0", "@ 1 2,5 3 0", 6, "V number status .particles. @ x y z ct"),
        ("a.hepmc3", "@ 4 5 6 0", "4 5 6 0", 9, "V number status .particles. @ x y z ct"),
        ("a.hepmc3", "@ 4 5 6 0", "@ 4 5 6 0 9", 9, "V number status .particles. @ x y z ct"),
        ("a.hepmc3", "E 0 2 5", "E 0 2 5 @ 1 2 x 0", 3, "numbers such as"),
        ("a.hepmc3", "E 0 2 5", "E\t0 2 5", 3, "single spaces"),
        ("a.hepmc2", "0.5 0.25 0.5 0.9", "0,5 0.25 0.5 0.9", 8, "numbers such as"),
        ("a.hepmc2", "V -2 0 4 5", "V -2 0 4 five", 10, "numbers such as"),
        ("a.hepmc2", "P 5 211", "P 5 99999999999", 11, "a PDG number up to 2147483647"),
        ("a.hepmc2", "P 5 211", "P  5 211", 11, "numbers such as -1.5e-3 between single spaces"),
        ("a.hepmc2", "0.105 1 0", "0.105 1.5 0", 9, "numbers such as"),
    ],
)
def test_hepmc_numbers_that_would_be_misread_are_refused(
    name: str, old: str, new: str, line: int, expected: str, tmp_path: Path
) -> None:
    """0 for a word or 0,5, the last bits of a large number, the origin for a vertex that is not there."""
    text = OLD_HEPMC if name == "a.hepmc2" else NEW_HEPMC
    (tmp_path / name).write_text(text)
    assert len(particles_from(tmp_path / name)) == 3
    assert text.count(old) == 1
    (tmp_path / name).write_text(text.replace(old, new))
    with pytest.raises(ParticleError, match=rf"1 problem\n  line {line}: got .*, expected {expected}"):
        particles_from(tmp_path / name)


def test_long_wrong_lines_of_hepmc_take_no_time(tmp_path: Path) -> None:
    """The form of a line is not tried in many ways."""
    (tmp_path / "a.hepmc2").write_text(OLD_HEPMC.replace("V -2 0", f"V -2{100 * ' 1234567890'} x 0"))
    begin = time.perf_counter()
    with pytest.raises(ParticleError, match="line 10: got 'V -2 1234567890"):
        particles_from(tmp_path / "a.hepmc2")
    assert time.perf_counter() - begin < 20


@pytest.mark.parametrize(("value", "message"), [("nan", "not finite"), ("inf", "not finite"), ("1e300", "beyond")])
def test_momenta_of_hepmc_that_are_none(value: str, message: str, tmp_path: Path) -> None:
    """Without warnings of numpy on the way."""
    (tmp_path / "a.hepmc3").write_text(NEW_HEPMC.replace("-0.5 -0.25 -0.5 0.8", f"{value} -0.25 -0.5 0.8"))
    with pytest.raises(ParticleError, match=rf"px: is {message}"):
        particles_from(tmp_path / "a.hepmc3")


def damaged(text: str, random: np.random.Generator) -> str:
    """Return a text of HepMC with lines doubled, dropped or exchanged, and words changed, dropped, added or cut."""
    lines = text.split("\n")
    for _ in range(random.choice([1, 1, 1, 2, 3])):
        i, j = random.integers(2, len(lines) - 2, 2)
        words = lines[i].split(" ")
        word = int(random.integers(len(words)))
        match random.integers(7):
            case 0:
                lines.insert(i, lines[i])
            case 1:
                del lines[i]
            case 2:
                lines[i], lines[j] = lines[j], lines[i]
            case 3:
                words[word] = str(random.choice(["-1", "0", "1", "3", "-2", "99", "1e300", "nan", "x", "2147483648"]))
                lines[i] = " ".join(words)
            case 4:
                lines[i] = " ".join(words[:word] + words[word + 1 :])
            case 5:
                lines[i] = " ".join([*words[:word], str(random.choice(["1", "-1", "[3]", "@"])), *words[word:]])
            case _:
                lines[i] = lines[i][: random.integers(len(lines[i]) + 1)]
        if len(lines) < 6:
            break
    return "\n".join(lines)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*are read, of all events:UserWarning")
def test_no_damaged_hepmc_ends_the_process(tmp_path: Path) -> None:
    random = np.random.default_rng(7)
    refused = 0
    for number in range(200):
        name, text = (("a.hepmc2", OLD_HEPMC), ("a.hepmc3", NEW_HEPMC))[number % 2]
        (tmp_path / name).write_text(damaged(text, random))
        try:
            read_hepmc(tmp_path / name)
        except ParticleError:
            refused += 1
    assert 50 < refused < 200


HEAD = "HepMC::Version 3.02.05\nHepMC::Asciiv3-START_EVENT_LISTING\nW Default\n"
END = "HepMC::Asciiv3-END_EVENT_LISTING\n"
PION = "P {} -1 211 0.4 0.1 0.3 0.55 0.1396 1\n"


def written(folder: Path, lines: str, first: str = "E 0 1 3") -> Path:
    """Return a file with an event: an electron ends at (0, 0, 1.5) mm in a pion and other particles."""
    path = folder / "a.hepmc3"
    event = f"{first}\nU GEV MM\nP 1 0 11 0 0 -10 10 0 4\nV -1 0 [1] @ 0 0 1.5 0\n" + PION.format(2)
    path.write_text(HEAD + event + lines + END)
    return path


@pytest.mark.parametrize(
    ("line", "charge", "mass", "status", "message"),
    [
        ("P 3 -1 1000020040 3 0.01 1 4.9 3.7274 1", 2, 3.7273794118, "outside", ""),
        ("P 3 -1 -1000822080 0.1 0 9 193.9 193.7 1", -82, 193.687, "curled", ""),
        ("P 3 -1 1000022 1 0 1 100 100 1", 0, 100, "neutral", ""),
        ("P 3 -1 1000024 50 0 1 112 100 1", 1, 100, "outside", ""),
        (
            "P 3 -1 -4900211 1 0 1 2 0.5 1",
            0,
            0.5,
            "neutral",
            r"1 particles whose charge is not known .* -4900211 .1.; gi",
        ),
        ("P 3 -1 2112 0 0 0 0.94 0.94 1", 0, 0.93957, "neutral", ""),
        ("P 3 -1 2212 0 0 0 0.94 0.94 1", 1, 0.93827, "at_rest", "1 at rest"),
        ("P 3 -1 13 1e7 0 0 1e7 0.1 1", -1, 0.10566, "out_of_range", "or above 1e.06 GeV/c"),
    ],
)
def test_strange_particles_stay_with_a_status(line, charge, mass, status, message, tmp_path, recwarn):
    """One particle never refuses a file, and the others of the event have their tracks."""
    result = cg.run(DESIGN, written(tmp_path, line + "\n"), seed=1)
    assert len(recwarn) == bool(message)
    if message:
        assert re.search(message, str(recwarn[0].message))
    assert result.particles["charge"].tolist() == [1, charge]
    assert result.particles["mass"][1] == pytest.approx(mass, rel=1e-4)
    assert cg.TransportStatus(result.particles["status"][1]).name == status
    assert len(result.tracks) == (2 if status in ("outside", "curled") else 1)


def test_charges_of_unknown_particles(tmp_path, capsys):
    path = written(tmp_path, "P 3 -1 4900211 1 0 1 1.5 0.5 1\n")
    result = cg.run(DESIGN, path, seed=1, charges={4900211: 1})
    assert result.particles["charge"].tolist() == [1, 1]
    assert result.tracks["status"].tolist() == [0, 0]
    words = ["simulate", "-d", DESIGN, "--quiet", "--fit", "-o", str(tmp_path / "run"), "--seed", "1"]
    assert main([*words, "--particles", str(path), "--charges", "4900211=1"]) == 0
    assert cg.Result.load(tmp_path / "run") == result
    assert main([*words, "--overwrite", "--charges", "4900211=1"]) == 2
    assert "--charges: got charges without --particles" in capsys.readouterr().err
    wrong = r"charges\[13\]: got 1, expected -1, that of mu-(.|\n)*charges\[99\]: got 0.5, expected a whole PDG number"
    with pytest.raises(ValueError, match=wrong):
        cg.run(DESIGN, path, charges={13: 1, 99: 0.5})
    with pytest.raises(ValueError, match=r"charges: got .13: -1., expected none for a gun or a sample"):
        cg.run(DESIGN, cg.Gun("mu-", p=1, theta=1), 1, charges={13: -1})


@pytest.mark.parametrize("charge", [2, -3])
def test_any_given_charge_is_simulated_and_fitted(charge, tmp_path):
    """The curvature is that of the charge, and the momentum of the track that of the particle."""
    path = written(tmp_path, "P 3 -1 4900211 4 0 1 5.1 3 1\n")
    result = cg.run(DESIGN, path, seed=1, charges={4900211: charge})
    track = result.tracks[1]
    assert result.particles["charge"].tolist() == [1, charge]
    assert (track["status"], track["charge"], track["hypothesis"]) == (0, abs(charge), 4900211)
    assert track["kappa"] == pytest.approx(charge / 4, rel=0.1)
    assert abs(track["p"] - np.hypot(4, 1)) < 5 * track["err_p"]
    assert track["truth_p"] == pytest.approx(np.hypot(4, 1))


def test_the_rules_of_pdg_numbers_give_the_listed_charges(monkeypatch):
    listed = dict(species.KNOWN)
    for pdg, one in listed.items():
        monkeypatch.setattr(species, "KNOWN", {k: v for k, v in listed.items() if k != pdg})
        assert species.charge_of(pdg) == one.charge, pdg


@pytest.mark.parametrize(
    ("pdg", "charge"),
    [(2224, 2), (1114, -1), (-213, -1), (9000211, 1), (20413, 1), (541, 1), (12212, 1), (1000037, 1), (-1000011, 1),
     (9900012, 0), (9900042, 2), (24, 1), (1000822080, 82), (1, None), (2203, None), (0, None), (4900022, None),
     (1000612, None), (9221132, None)],
)  # fmt: skip
def test_charges_of_pdg_numbers(pdg, charge):
    assert species.charge_of(pdg) == charge


@pytest.mark.parametrize(
    ("pdg", "mass"),
    [(1000010010, 0.938272), (1000020030, 2.808391), (1000060120, 11.17486), (1000260560, 52.08977),
     (1000822080, 193.6868)],
)  # fmt: skip
def test_masses_of_nuclei(pdg, mass):
    """Of the atomic mass evaluation 2020, without electrons."""
    assert species.nuclear_mass(pdg) == pytest.approx(mass, rel=1e-3)


@pytest.mark.parametrize(("unit", "scale"), [("MM", 1), ("CM", 10)])
@pytest.mark.parametrize(
    "text", ["P 1 0 13 1 0 0.1 1.01 0.105 1\n", "P 1 0 443 0 0 0 3.1 3.1 4\nV -1 0 [1]\nP 2 -1 13 1 0 0.1 1 0.1 1\n"]
)
def test_the_position_of_the_event_has_its_units(unit, scale, text, tmp_path):
    vertices, particles = text.count("V"), text.count("P")
    path = tmp_path / "a.hepmc3"
    path.write_text(HEAD + f"E 7 {vertices} {particles} @ 1 2 3 4\nU GEV {unit}\nW 2.5\n" + text + END)
    found, events = read_particles(path)
    assert [found[axis][0] for axis in "xyz"] == pytest.approx([scale, 2 * scale, 3 * scale])
    assert found["time"][0] == pytest.approx(4 * scale / 299.792458)
    assert events["number"].tolist() == [7]
    assert events["weight"].tolist() == [2.5]
    assert events["time"][0] == pytest.approx(4 * scale / 299.792458)


def test_events_without_particles_and_their_numbers(tmp_path):
    """The first, a middle and the last event have no particles."""
    full = "E {} 1 2\nU GEV MM\nW {}\nP 1 0 443 0 0 0 3.1 3.1 4\nV -1 0 [1]\nP 2 -1 13 1 0 0.1 1.01 0.106 1\n"
    empty = "E {} 0 0\nU GEV MM\nW 1\n"
    lines = empty.format(9) + full.format(4, 0.5) + empty.format(5) + full.format(6, -2) + empty.format(7)
    path = tmp_path / "a.hepmc3"
    path.write_text(HEAD + lines + END)
    result = cg.run(DESIGN, path, seed=1, keep=["particles", "events"], output=tmp_path / "run", workers=1)
    assert result.particles["event"].tolist() == [1, 3]
    assert result.n_events == 5
    assert result.events["event"].tolist() == [0, 1, 2, 3, 4]
    assert result.events["number"].tolist() == [9, 4, 5, 6, 7]
    assert result.events["weight"].tolist() == [1, 0.5, 1, -2, 1]
    with pytest.raises(ValueError, match=r"keep: got events, which this run does not make"):
        cg.run(DESIGN, cg.Gun("mu-", p=1, theta=1), 1, keep=["events"])


@pytest.mark.parametrize(("ending", "packed"), [("bz2", bz2.compress), ("xz", lzma.compress)])
def test_packed_hepmc(ending, packed, file, tmp_path):
    path = tmp_path / f"a.hepmc.{ending}"
    path.write_bytes(packed(file.read_bytes()))
    assert particles_from(path) == particles_from(file)
    path.write_bytes(packed(file.read_bytes())[:-20])
    with pytest.raises(ParticleError, match="expected a complete HepMC file"):
        particles_from(path)


DECAYS = """V -2 0 [3] @ 0 200 1.5 {ct}
P 4 -2 -13 0.01 0.45 0.02 0.47 0.10566 1
P 5 -2 14 0 0.05 0 0.05 0 1
"""


@pytest.mark.parametrize("ct", [0, 208.0])
def test_decays_of_the_generator_end_the_flight(ct, tmp_path):
    """A pion that the generator lets decay at 200 mm crosses the cells before, and its muon the others."""
    line = "P 3 -1 211 0 0.5 0 0.519 0.13957 2\n"
    path = written(tmp_path, line + DECAYS.format(ct=ct), "E 0 2 5")
    with pytest.warns(UserWarning, match="of the charged particles of status 2, 1 are followed to their decay"):
        result = cg.run({"base": "besiii-idc", "field": {"bz": "0 T"}}, path, seed=1, until="simulate")
    assert result.particles["pdg"].tolist() == [211, 211, -13, 14]
    assert result.particles["parent"].tolist() == [1, 1, 3, 3]
    assert cg.TransportStatus(result.particles["status"][1]).name == "decayed"
    time = ct / 299.792458 if ct else 200 * np.hypot(0.5, 0.13957) / 0.5 / 299.792458
    assert result.particles["decay_time"][1] == pytest.approx(time)
    wires = result.wire_truths
    radius = np.hypot(wires["x"], wires["y"])
    speed = 299.792458 * 0.5 / np.hypot(0.5, 0.13957)
    assert radius[wires["particle"] == 1].max() < time * speed < radius[wires["particle"] == 2].min() + 12
    assert len(result.decays) == 0
    layers = wires["layer"]
    assert not set(layers[wires["particle"] == 1]) & set(layers[wires["particle"] == 2])
    assert set(layers[np.isin(wires["particle"], [1, 2])]) == set(range(43))


def test_decays_within_the_beam_pipe_are_counted(tmp_path):
    lines = "P 3 -1 3222 0 0.5 0 1.29 1.18937 2\nV -2 0 [3] @ 0 4 1.5 9\nP 4 -2 2212 0 0.4 0 1 0.938 1\n"
    path = written(tmp_path, lines, "E 0 2 4")
    with pytest.warns(UserWarning, match="1 that decay within 5 mm of the beam line are left out"):
        assert particles_from(path)["pdg"].tolist() == [211, 2212]


def test_late_particles_have_late_hits(tmp_path):
    """By the time of production alone, in wires and in strips."""
    early = {"event": [0, 1], "pdg": [13, 13], "px": [1.0, 1.0], "py": [0.0, 0.0], "pz": [0.1, 0.1]}
    settings = cg.Settings(digitize=cg.DigitizeSettings(wire_times="raw"))
    late = early | {"time": [0.0, 7.0]}
    a, b = (cg.run("besiii-cgem", one, seed=1, settings=settings, readout="tiger") for one in (early, late))
    for name, column in (("truths", "time"), ("wire_truths", "time"), ("wire_hits", "drift_time"), ("digis", "time")):
        shift = b.tables[name][column] - a.tables[name][column]
        event = b.tables[name]["event"]
        assert shift[event == 0] == pytest.approx(0, abs=1e-9)
        assert shift[event == 1] == pytest.approx(7, abs=0.5 if name == "digis" else 1e-9)
    with pytest.raises(ParticleError, match=r"time: is not finite .nan. in row 1"):
        particles_from(early | {"time": [0.0, np.nan]})
    with pytest.raises(ParticleError, match=r"decay_time: is not above 0 .-1.0. in row 0"):
        particles_from(early | {"decay_time": [-1.0, np.inf]})


OWN = {"event": [0, 0, 2], "pdg": [13, -13, 211], "px": [0.9, -0.9, 0.3], "py": [0.2, -0.2, 0.1], "pz": [0.1, -0.1, 1]}


def other_program(folder: Path, ending: str, columns: dict[str, Any]) -> Path:
    """Write a table as another program does."""
    path = folder / f"own{ending}"
    arrays = {name: np.asarray(column) for name, column in columns.items()}
    if ending == ".csv":
        pd.DataFrame(columns).to_csv(path, index=False)
    elif ending == ".parquet":
        pd.DataFrame(columns).to_parquet(path)
    elif ending == ".npz":
        np.savez(path, **arrays)
    else:
        with uproot.recreate(path) as file:
            file["particles"] = arrays
    return path


@pytest.mark.parametrize("ending", [".csv", ".parquet", ".npz", ".root"])
def test_tables_of_other_programs(ending, tmp_path):
    """They are taken as the same columns of a data frame are; what lacks a column is refused with those that it has."""
    assert particles_from(other_program(tmp_path, ending, OWN)) == particles_from(pd.DataFrame(OWN))
    path = other_program(tmp_path, ending, {name: column for name, column in OWN.items() if name != "pz"})
    with pytest.raises(ParticleError) as error:
        particles_from(path)
    text = str(error.value)
    assert "pz" in text
    assert "event, pdg, px, py" in text
    assert "of another program" in text


@pytest.mark.parametrize("ending", [".csv", ".parquet", ".npz"])
def test_units_in_the_names_of_columns(ending, tmp_path):
    columns = {
        "event": [0],
        "pdg": [13],
        "px [MeV]": [900.0],
        "py (GeV/c)": [0.2],
        "pz[MeV/c]": [100.0],
        "x [cm]": [1.5],
    }
    columns |= {"time [us]": [0.002], "mass [MeV/c^2]": [105.66]}
    found = particles_from(other_program(tmp_path, ending, columns))
    values = [found[name][0] for name in ("px", "py", "pz", "x", "time", "mass")]
    assert values == pytest.approx([0.9, 0.2, 0.1, 15, 2, 0.10566])


def test_units_of_columns_as_an_argument():
    found = particles_from({**OWN, "z": [1, 2, 3]}, units={"px": "MeV", "z": "cm"})
    assert found["px"] == pytest.approx([9e-4, -9e-4, 3e-4])
    assert found["z"] == pytest.approx([10, 20, 30])
    with pytest.raises(ParticleError) as error:
        particles_from({**OWN, "x [cm]": [1, 2, 3], "y [foot]": [1, 2, 3]}, units={"x": "mm", "e": "GeV"})
    text = str(error.value)
    assert "units['x']: got 'mm', expected 'cm', as the name of the column says" in text
    assert "y [foot]: got the unit 'foot', expected a length with its unit" in text
    assert "units['e']: got 'GeV', expected a unit of one of the columns event, pdg" in text


def test_lists_per_event_in_a_tree_of_another_program(tmp_path):
    lists = {"pdg": ak.Array([[13, -13], [], [211]])}
    lists |= {name: ak.Array([[0.9, -0.9], [], [0.3]]) for name in ("px", "py", "pz")}
    with uproot.recreate(tmp_path / "own.root") as file:
        file["events"] = lists
    found = particles_from(tmp_path / "own.root")
    assert found.n_events == 3
    assert found["event"].tolist() == [0, 0, 2]
    assert found["pdg"].tolist() == [13, -13, 211]


def test_csv_with_mistakes_and_other_columns(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("# from a spreadsheet\nevent;pdg;px;py;pz;name\n0;13;1;0;0;mu\n\n1;-13;1;0;0.5;mubar\n")
    with pytest.warns(UserWarning, match=r"own.csv: columns without one number a row are left out: name"):
        assert particles_from(path)["pz"].tolist() == [0, 0.5]
    path.write_text("event,pdg,px,py,pz\n0,13,1,0,0\n0,13,1,0\n")
    with pytest.raises(ParticleError, match="line 3: got 4 values, expected 5, as the line of names has"):
        particles_from(path)
    path.write_text("event,pdg,px,py,pz\n0,13,1,0,0\n0,13,1,zero,x\n")
    with pytest.raises(ParticleError, match=r"line 3: got py 'zero', expected a number\n  line 3: got pz 'x', exp"):
        particles_from(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.lhe", "got Les Houches events, which hold partons, expected hadrons: shower the file with Pythia 8"),
        ("a.lhe.gz", "got Les Houches events"),
        ("a.hepevt", "got HEPEVT, which does not name its units, expected HepMC: read it with pyhepmc"),
        ("a.slcio", "got a file of LCIO or StdHep, expected EDM4hep or HepMC: convert"),
    ],
)
def test_other_records_are_refused_by_name(name, message, tmp_path):
    (tmp_path / name).write_text("x")
    with pytest.raises(ParticleError, match=message):
        cg.run(DESIGN, tmp_path / name)


def fill_tree(file: Any, name: str, branches: dict[str, Any]) -> None:
    """Write a TTree: assigning makes an RNTuple."""
    file.mktree(name, {key: array.type.content for key, array in branches.items()}).extend(branches)


#: A J/psi that decays to a muon and a K_S, which decays to pions, as HepMC3 stores them; cm and MeV.
TREE = {
    "event_number": [3, 4], "momentum_unit": [0, 0], "length_unit": [1, 1],
    **{f"event_pos.m_v{k}": [float(k), 0.0] for k in (1, 2, 3, 4)},
    "weights": [[0.5, 9.0], []],
    "particles.pid": [[443, 310, 13, 211, -211], []], "particles.status": [[4, 2, 1, 1, 1], []],
    "particles.mass": [[3096.9, 497.6, 105.7, 139.6, 139.6], []],
    "particles.momentum.m_v1": [[0.0, 500.0, -500.0, 250.0, 250.0], []],
    "particles.momentum.m_v2": [[0.0, 250.0, -250.0, 500.0, -250.0], []],
    "particles.momentum.m_v3": [[200.0, 500.0, -500.0, -125.0, 625.0], []],
    **{f"vertices.position.m_v{k}": [[0.0, 3.0 + k], []] for k in (1, 2, 3, 4)},
    "links1": [[1, -1, -1, 2, -2, -2], []], "links2": [[-1, 2, 3, -2, 4, 5], []],
}  # fmt: skip


def test_hepmc_in_root(tmp_path):
    """As the text of the same events gives; vertices without a position have that of the event."""
    path = tmp_path / "a.hepmc3.tree.root"
    with uproot.recreate(path) as file:
        fill_tree(file, "hepmc3_tree", {name: ak.Array(values) for name, values in TREE.items()})
    found, events = read_particles(path)
    text = (
        HEAD + "E 3 2 5 @ 1 2 3 4\nU MEV CM\nW 0.5\nP 1 0 443 0 0 200 3100 3096.9 4\nV -1 0 [1]\n"
        "P 2 -1 310 500 250 500 900 497.6 2\nP 3 -1 13 -500 -250 -500 800 105.7 1\nV -2 0 [2] @ 4 5 6 7\n"
        "P 4 -2 211 250 500 -125 600 139.6 1\nP 5 -2 -211 250 -250 625 750 139.6 1\nE 4 0 0\nU MEV CM\nW 1\n" + END
    )
    (tmp_path / "a.hepmc3").write_text(text)
    expected, other = read_particles(tmp_path / "a.hepmc3")
    assert found["pdg"].tolist() == [13, 211, -211]
    assert [found[axis].tolist() for axis in "xyz"] == [[10, 40, 40], [20, 50, 50], [30, 60, 60]]
    assert found["parent"].tolist() == [1, 2, 2]
    assert found.columns.keys() == expected.columns.keys()
    for name in expected.columns:
        assert found[name] == pytest.approx(expected[name]), name
    for name in other.columns:
        assert events[name] == pytest.approx(other[name]), name
    with uproot.recreate(path) as file:
        fill_tree(file, "hepmc3_tree", {"n": ak.Array([1, 2])})
    with pytest.raises(ParticleError, match=r"got no branch 'particles.pid', expected a whole event record of HepMC3"):
        particles_from(path)


def test_edm4hep(tmp_path):
    """An electron ends in a dark charged particle, a pion that decays at 200 mm, and its muon; two events."""
    names = {"PDG": [11, 4900211, 211, -13], "generatorStatus": [4, 1, 2, 1], "charge": [-1.0, 1, 1, 1]}
    names |= {"mass": [0.000511, 2, 0.13957, 0.10566], "time": [0.0, 0.5, 0.5, 1.25]}
    names |= {"vertex.x": [0.0, 0, 0, 200], "endpoint.x": [0.0, 0, 200, 0], "momentum.x": [0.0, 1, 0.5, 0.4]}
    names |= {f"{one}.{axis}": [0.0] * 4 for one in ("vertex", "endpoint", "momentum") for axis in "yz"}
    names |= {"parents_begin": [0, 0, 1, 2], "parents_end": [0, 1, 2, 3]}
    tree = {f"MCParticles.{name}": ak.Array([values, []]) for name, values in names.items()}
    tree |= {"_MCParticles_parents.index": ak.Array([[0, 0, 2], []])}
    tree |= {"EventHeader.eventNumber": ak.Array([[12], [13]]), "EventHeader.weight": ak.Array([[0.25], [1.0]])}
    with uproot.recreate(tmp_path / "a.edm4hep.root") as file:
        fill_tree(file, "events", tree)
    with pytest.warns(UserWarning, match="of the charged particles of status 2, 1 are followed to their decay"):
        found, events = read_particles(tmp_path / "a.edm4hep.root")
    assert found.n_events == 2
    assert found["pdg"].tolist() == [4900211, 211, -13]
    assert found["charge"].tolist() == [1, 1, 1]
    assert found["mass"][0] == 2
    assert found["x"].tolist() == [0, 0, 200]
    assert found["time"] == pytest.approx([0.5, 0.5, 1.25])
    assert found["edm4hep_id"].tolist() == [1, 2, 3]
    assert found["parent"].tolist() == [0, 0, 2]
    flight = 200 * np.hypot(0.5, 0.13957039) / 0.5 / 299.792458
    assert found["decay_time"] == pytest.approx([np.inf, flight, np.inf])
    assert events["number"].tolist() == [12, 13]
    assert events["weight"].tolist() == [0.25, 1]


EDM = {
    "PDG": [13], "generatorStatus": [1], "charge": [-1.0], "mass": [0.10566], "time": [0.0],
    **{f"{one}.{axis}": [0.0] for one in ("vertex", "endpoint") for axis in "xyz"},
    **{f"momentum.{axis}": [0.5] for axis in "xyz"}, "parents_begin": [0], "parents_end": [0],
}  # fmt: skip


def write_edm4hep(path, *collections, **changes):
    """Write one event with collections of generated particles of these names."""
    values = EDM | changes
    tree = {f"{name}.{key}": ak.Array([value]) for name in collections for key, value in values.items()}
    with uproot.recreate(path) as file:
        fill_tree(file, "events", tree)
    return path


def test_edm4hep_particles_of_another_collection(tmp_path):
    """The only one with statuses of a generator, or MCParticles; several others are named."""
    assert len(particles_from(write_edm4hep(tmp_path / "one.root", "GenParticles"))) == 1
    assert len(particles_from(write_edm4hep(tmp_path / "two.root", "GenParticles", "MCParticles"))) == 1
    several = write_edm4hep(tmp_path / "several.root", "A", "B")
    with pytest.raises(ParticleError, match="got collections of particles A, B, expected one, or one of the name MCP"):
        particles_from(several)


def test_a_record_without_final_particles_is_refused(tmp_path):
    path = write_edm4hep(tmp_path / "none.root", "MCParticles", generatorStatus=[62])
    with pytest.raises(ParticleError, match=r"got no particle of status 1 among 1, statuses 62 \(1\), expected final"):
        particles_from(path)


@pytest.mark.parametrize(("end", "told"), [(0.0, False), (200.0, True)])
def test_unknown_charges_count_where_a_track_could_be(tmp_path, end, told):
    """A cluster of status 2 (PDG number 91) that ends where it begins is no row whatever its charge."""
    changes = {name: [*value, *value] for name, value in EDM.items()} | {"PDG": [91, 13], "generatorStatus": [2, 1]}
    changes |= {"endpoint.x": [end, 0.0], "charge": [float("nan"), -1.0]}
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        assert len(particles_from(write_edm4hep(tmp_path / "a.root", "MCParticles", **changes))) == 1
    assert any("whose charge is not known" in str(one.message) for one in found) == told


def test_damaged_root_files_are_refused(tmp_path: Path) -> None:
    """Whatever of uproot notices it; files whose changed bytes mean nothing give the same columns."""
    columns = {**{name: np.array(values) for name, values in MUONS.items()}, "px [MeV]": np.array([1e3, 2e3])}
    del columns["px"]
    with uproot.recreate(tmp_path / "whole.root") as file:
        file["particles"] = columns
    whole = (tmp_path / "whole.root").read_bytes()
    right = particles_from(tmp_path / "whole.root")
    assert right["px"].tolist() == [1.0, 2.0]
    random, refused = np.random.default_rng(5), 0
    for cut in (0.3, 0.5, 0.7, 0.9):
        (tmp_path / "cut.root").write_bytes(whole[: int(cut * len(whole))])
        with pytest.raises(
            ParticleError, match=r"cut.root: 1 problem\n  got a file that uproot cannot read \(.+\), expected"
        ):
            particles_from(tmp_path / "cut.root")
    for _ in range(40):
        changed = bytearray(whole)
        for place in random.integers(0, len(whole), 3):
            changed[place] ^= int(random.integers(1, 256))
        (tmp_path / "changed.root").write_bytes(changed)
        try:
            particles_from(tmp_path / "changed.root")
        except ParticleError:
            refused += 1
    assert refused > 5
