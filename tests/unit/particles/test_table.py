"""Particles of generators: HepMC files, lists per event, tables in files."""

from __future__ import annotations

import gzip
import tracemalloc
from pathlib import Path
from typing import Any

import awkward as ak
import numpy as np
import pyhepmc
import pytest

import cgemit as cg
from cgemit.cli.main import main
from cgemit.particles import table
from cgemit.particles.gun import generate
from cgemit.particles.table import ParticleError, particles_from, read_hepmc

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
    assert result == cg.run(DESIGN, particles_from(file), seed=2)
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
        (lambda data: data.replace(b"V -1 0 [1]", b"V x y z", 2), "line 3: got an event that cannot be read"),
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
    monkeypatch.setattr(table, "_MOST_UNPACKED", len(data))
    assert len(read_hepmc(packed)[0]["pdg"]) > 0
    monkeypatch.setattr(table, "_MOST_UNPACKED", len(data) - 1)
    with pytest.raises(
        ValueError, match=r"packed.hepmc.gz: 1 problem\n  got more than .* MB unpacked, expected at most"
    ):
        read_hepmc(packed)
    assert len(read_hepmc(file)[0]["pdg"]) > 0  # its size is there to see


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
        ParticleError, match=r"got the file 'events.txt', expected one of .npz, .parquet, .root, .hepmc"
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
    assert read_hepmc(path)[0]["px"].tolist() == pytest.approx([px])


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
    columns, n_events = read_hepmc(tmp_path / name)
    assert n_events == 1
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
        assert read_hepmc(tmp_path / "a.hepmc2")[0]["pdg"].tolist() == [13]


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
