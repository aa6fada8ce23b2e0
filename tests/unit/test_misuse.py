"""Odd and wrong input that has to be refused at once, or to work."""

import signal
import subprocess
import sys

import numpy as np
import pytest

from cgemit import study
from cgemit.base.files import OutputExistsError, check_free
from cgemit.cli.main import main
from cgemit.detector import DetectorError, load, write_field_map
from cgemit.draw.detector import draw_detector, draw_layers, draw_sides
from cgemit.draw.style import new_picture
from cgemit.particles.gun import Gun, generate
from cgemit.particles.table import ParticleError, particles_from
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.find import by_truth
from cgemit.reconstruction.fit import FitSettings, fit
from cgemit.simulation.digitize import digitize
from cgemit.simulation.transport import simulate
from cgemit.tables import Table
from interrupts import on_terminal

SIMULATE = ["simulate", "-d", "besiii-cgem-design", "--p", "1", "--theta", "1", "--quiet"]
ROW = {"event": [0], "pdg": [13], "px": [1.0], "py": [0.0], "pz": [0.0]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([*SIMULATE, "-n", "1", "-o", "file/inside"], "is a file"),
        ([*SIMULATE, "-n", "1", "-o", "x", "--seed", str(2**64)], "at most 18446744073709551615"),
        ([*SIMULATE, "-n", "10000000000000", "-o", "x"], "at most 2147483647"),
        ([*SIMULATE, "-n", "1", "-o", "x", "--set", "base=besiii-idc"], "load another base"),
        ([*SIMULATE, "-n", "1", "-o", "x", "--set", 'cgem.L2.pitch_x="0.5 mm"\nx=3'], "cgem.L2.pitch_x"),
        ([*SIMULATE, "-n", "1", "-o", "x", "--vertex", "1e300,0,0"], "vertex.x"),
        (["resolution", "-d", "besiii-idc", "--p", "1:2:100000000000", "-o", "x"], "at most 10000"),
        (["resolution", "-d", "besiii-idc", "--particle", "gamma", "--p", "1", "-o", "x"], "a charged particle"),
        (["study", "--quick", "-o", "file/inside"], "is a file"),
    ],
)
def test_refused_at_once(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("here")
    assert main(arguments) == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_output_folder_that_cannot_be_written(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("cgemit.base.files.tempfile.TemporaryDirectory", refuse)
    with pytest.raises(ValueError, match=r"nothing can be written in .*Permission denied"):
        check_free(tmp_path / "a" / "b")


def test_output_folder_below_missing_ones_is_free_and_nothing_stays(tmp_path):
    check_free(tmp_path / "a" / "b")
    assert not list(tmp_path.iterdir())
    (tmp_path / "a").touch()
    with pytest.raises(OutputExistsError, match="is a file"):
        check_free(tmp_path / "a" / "b" / "c")


def test_overwriting_removes_tables_of_the_run_before(tmp_path):
    folder = tmp_path / "run"
    (tmp_path / "run").mkdir()
    (folder / "mine.npz").touch()
    run = [*SIMULATE, "-n", "5", "-o", str(folder), "--overwrite"]
    assert main([*run, "--fit"]) == 0
    assert (folder / "tracks.npz").exists()
    assert main(run) == 0
    assert not (folder / "tracks.npz").exists()
    assert (folder / "clusters.npz").exists()
    assert (folder / "mine.npz").exists()


def test_resolution_with_angles_in_turn(tmp_path, capsys):
    arguments = ["resolution", "-d", "besiii-idc", "--p", "1", "--cos-theta", "0,0.5", "--events", "60", "--quiet"]
    assert main([*arguments, "-o", str(tmp_path / "x"), "--json"]) == 0
    assert '"cos_theta": [\n      0.0,\n      0.5\n    ]' in capsys.readouterr().out


@pytest.mark.parametrize("p", [[1, [2]], np.ones((2, 2)), 10**400, [], 2e6])
def test_gun_lists_odd_momenta_as_problems(p):
    with pytest.raises(ParticleError, match="p"):
        Gun("mu-", p=p, theta=1)


def test_gun_takes_numbers_of_numpy():
    gun = Gun("mu-", p=np.array(1.0), theta=np.float32(1), multiplicity=np.int64(2))
    assert gun == Gun("mu-", p=1, theta=1, multiplicity=2)
    assert Gun("mu-", p=np.array(["1 GeV/c", "2 GeV/c"]), theta=1) == Gun("mu-", p=[1, 2], theta=1)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"event": np.array([2**63 + 1], np.uint64)}, "event: is above"),
        ({"event": [1e19]}, "event: is above"),
        ({"x": [1e308]}, "x: is beyond"),
        ({"pz": [-1e308]}, "pz: is beyond"),
        ({"particle": [-1]}, "particle: is negative"),
        ({"pdg": [9999], "charge": [1], "mass": [0.0]}, "mass: is 0"),
    ],
)
def test_table_of_particles_with_values_out_of_range(columns, message):
    with pytest.raises(ParticleError, match=message):
        particles_from({**ROW, **columns})
    assert len(particles_from(ROW)) == 1


def test_detector_file_with_byte_order_mark_and_folder_in_its_place(tmp_path):
    file = tmp_path / "marked.toml"
    file.write_text('base = "besiii-idc"\n', encoding="utf-8-sig")
    assert load(file).drift_chamber == load("besiii-idc").drift_chamber
    with pytest.raises(DetectorError, match="a folder, expected one of"):
        load(tmp_path)


def test_a_chamber_that_is_no_table_is_one_problem():
    with pytest.raises(DetectorError) as caught:
        load({"base": "besiii-cgem", "drift_chamber": "none"})
    assert [problem.path for problem in caught.value.problems] == ["drift_chamber"]


WRITERS = {
    "picture": lambda path: new_picture()[0].save(path.with_suffix(".png")),
    "table": lambda path: Table.empty("truths").save(path),
    "settings": lambda path: FitSettings().save(path),
    "map": lambda path: write_field_map(
        path.with_suffix(".csv"), {**{key: [0, 1, 2, 3] for key in "rz"}, "br": np.zeros((4, 4)), "bz": np.ones((4, 4))}
    ),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_a_file_does_not_make_folders(write, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no folder .*mistyped"):
        write(tmp_path / "mistyped" / "file.npz")
    assert list(tmp_path.iterdir()) == []


def test_stages_take_names_of_detectors():
    """Every public function that takes a detector takes what `load` takes."""
    name = "besiii-cgem-design"
    found = {}
    for given in (name, load(name)):
        tables = simulate(given, generate(Gun("mu-", p=1, theta=1), 4, seed=1), seed=1)
        tables |= digitize(given, tables["truths"], tables["wire_truths"], seed=1, steps=tables["steps"])
        tables["clusters"] = cluster(given, tables["digis"])
        order = ("particles", "clusters", "wire_hits", "truths", "wire_truths")
        tables |= by_truth(given, *(tables[one] for one in order))
        hits = (tables[one] for one in ("clusters", "wire_hits", "candidates", "candidate_hits"))
        found[given] = tables | fit(given, *hits)
    assert found[name] == found[load(name)]
    assert repr(study.scan(name, [1.0], events=20)) == repr(study.scan(load(name), [1.0], events=20))
    for draw in (draw_detector, draw_sides, draw_layers):
        assert draw(name).get_axes()


def test_interrupt_during_the_import_ends_without_a_traceback():
    code = """
import runpy, sys
class Interrupt:
    def find_spec(name, *_):
        if name == "cgemit.cli.main":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt)
sys.argv = ["cgemit", "detectors"]
runpy.run_module("cgemit", run_name="__main__", alter_sys=True)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr, done.stdout) == (130, "", "")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGTERM to handle")
def test_sigterm_leaves_nothing(tmp_path):
    command = [sys.executable, "-u", "-m", "cgemit", *SIMULATE[:-1], "-n", "200000", "-o", str(tmp_path / "out")]
    with on_terminal(command) as (process, read):
        assert "1%" in read("1%")
        assert list(tmp_path.iterdir())  # in the middle of it
        process.send_signal(signal.SIGTERM)
        rest = read()
        assert process.wait(60) == 130, rest
    assert rest.endswith("cgemit: interrupted\r\n")
    assert list(tmp_path.iterdir()) == []
