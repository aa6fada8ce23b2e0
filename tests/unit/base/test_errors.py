"""What people read when something is wrong, and odd input that is refused at once or works."""

import signal
import subprocess
import sys
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

import cgemit as cg
from cgemit import study
from cgemit.base.files import OutputExistsError, check_free
from cgemit.chain import executor
from cgemit.cli.main import main
from cgemit.cli.options import whole
from cgemit.detector import DetectorError, load, write_field_map
from cgemit.draw.detector import draw_detector, draw_layers, draw_sides
from cgemit.draw.style import new_picture
from cgemit.particles.gun import Gun, generate
from cgemit.particles.records import ParticleError
from cgemit.particles.table import particles_from
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.fit import FitSettings, fit
from cgemit.simulation.digitize import digitize
from cgemit.simulation.transport import simulate
from cgemit.study import chi2_flatness, gaussian_fit, pulls, scan, sweep
from cgemit.study.optimize.run import read_optimize_plan
from cgemit.study.sweep.plan import PlanError, read_plan
from cgemit.tables import Table
from cgemit.truth.finder import by_truth
from cgemit.units import QuantityError, parse_quantity
from fitted import make_tracks
from interrupts import on_terminal

SIMULATE = ["simulate", "-d", "besiii-cgem-design", "--p", "1", "--theta", "1", "--quiet"]
ROW = {"event": [0], "pdg": [13], "px": [1.0], "py": [0.0], "pz": [0.0]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([*SIMULATE, "-n", "1", "-o", "file/inside"], "is a file"),
        ([*SIMULATE, "-n", "1", "-o", "x", "--seed", str(2**64)], "a whole number from 0 to 18446744073709551615"),
        ([*SIMULATE, "-n", "10000000000000", "-o", "x"], "a whole number from 1 to 2147483647"),
        ([*SIMULATE, "-n", "1", "-o", "x", "--set", "base=besiii-idc"], "load another base"),
        ([*SIMULATE, "-n", "1", "-o", "x", "--set", 'cgem.L2.pitch_x="0.5 mm"\nx=3'], "cgem.L2.pitch_x"),
        ([*SIMULATE, "-n", "1", "-o", "x", "--vertex", "1e300,0,0"], "vertex.x"),
        (["resolution", "-d", "besiii-idc", "--p", "1:2:100000000000", "-o", "x"], "a whole number from 1 to 10000"),
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

    monkeypatch.setattr("cgemit.base.files.tempfile.TemporaryFile", refuse)
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
    run = [*SIMULATE, "-n", "5", "-o", str(folder), "--overwrite"]
    assert main([*run, "--fit"]) == 0
    assert (folder / "tracks.npz").exists()
    assert main(run) == 0
    assert not (folder / "tracks.npz").exists()
    assert (folder / "clusters.npz").exists()
    (folder / "mine.npz").touch()
    assert main(run) == 2
    assert (folder / "mine.npz").exists()


@pytest.mark.usefixtures("undrawn")
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
        bar = read(r"[1-9]\d?%")  # any but the first: a slow machine may miss some
        assert "%" in bar
        assert "100%" not in bar
        assert list(tmp_path.iterdir())  # in the middle of it
        process.send_signal(signal.SIGTERM)
        rest = read()
        assert process.wait(60) == 130, rest
    assert rest.endswith("cgemit: interrupted\r\n")
    assert list(tmp_path.iterdir()) == []


DESIGN = "besiii-cgem-design"


@pytest.mark.parametrize(
    ("text", "dimension", "hint"),
    [("500MeV", "momentum", "500 MeV/c"), ("1.5 GeV", "momentum", "1.5 GeV/c"), ("79 MeV/c", "energy", "79 MeV")],
)
def test_energies_for_momenta(text, dimension, hint):
    with pytest.raises(QuantityError, match=f'did you mean "{hint}"'):
        parse_quantity(text, dimension)


def test_degrees_without_unit():
    with pytest.raises(ParticleError, match=r'theta: got 60, expected .*; did you mean "60 deg"\?'):
        cg.Gun("mu-", p=1, theta=60)
    assert cg.Gun("mu-", p=1, theta="60 deg").theta == pytest.approx(np.pi / 3)
    with pytest.raises(ParticleError) as caught:
        cg.Gun("mu-", p=1, theta=600)  # no angle in degrees either
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize(("text", "number"), [("1e4", 10_000), ("2.5e3", 2500), ("17", 17), ("1E2", 100)])
def test_numbers_of_events_in_scientific_form(text, number):
    assert whole(text, 1, 2**31 - 1) == number
    assert whole(str(2**64 - 1), 0, 2**64 - 1) == 2**64 - 1


@pytest.mark.parametrize("text", ["1.5", "1e400", "nan", "inf", "1e-1", "", "0x10", "1e20"])
def test_what_is_no_whole_number(text, capsys):
    arguments = ["simulate", "-d", DESIGN, "--p", "1", "--theta", "1", "-n", text, "-o", "never"]
    assert main(arguments) == 2
    assert "expected a whole number" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sturdy"], "cgemit: unknown command 'sturdy'; did you mean \"study\"?"),
        (["xyz"], "cgemit: unknown command 'xyz'; expected one of study, "),
        (["study", "--evnts", "3"], 'cgemit study: got --evnts 3, which it does not know; did you mean "--events"?'),
        (["resolution", "-d", "x"], "cgemit resolution: the following arguments are required: -o/--output"),
    ],
)
def test_an_error_of_the_command_line_is_one_line(arguments, message, capsys):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(message)
    assert captured.err.count("\n") == 1
    assert not captured.out


@dataclass(frozen=True, kw_only=True)
class Toy(cg.BinaryReadout):
    """A readout that nobody has registered."""

    name: ClassVar[str] = "toy"


def test_read_outs_that_are_not_registered():
    with pytest.raises(
        DetectorError,
        match=r"binary, gaussian, .*; cgemit.register_readout\(Toy, ...\) registers it",
    ):
        cg.load(DESIGN).with_readout(Toy())


def test_settings_of_another_read_out(tmp_path, capsys):
    file, base = tmp_path / "mine.toml", "base = 'besiii-cgem'\n[cgem.L1.readout]\n"
    file.write_text(f"{base}sigma_x = '0.1 mm'\n")
    assert main(["validate", str(file)]) == 2
    assert "cgem.L1.readout.sigma_x: got an unknown key" in (text := capsys.readouterr().err)
    assert "it is a key of name = 'gaussian', and name is 'binary' here" in text
    file.write_text(f"{base}name = 'gaussian'\nsigma_x = '0.1 mm'\n")
    assert main(["validate", str(file)]) == 0


def test_runs_larger_than_the_memory_are_refused(monkeypatch, capsys):
    gun = cg.Gun("mu-", p=1, theta=1)
    with pytest.raises(ValueError, match=r"n: 100000000 events need about [\d,]+ GB of memory") as caught:
        cg.run(DESIGN, gun, 100_000_000, workers=1)
    least = cg.run(DESIGN, gun, 1000)
    size = sum(column.nbytes for table in least.tables.values() for column in table.columns.values())
    stated = float(str(caught.value).partition("about ")[2].partition(" GB")[0].replace(",", ""))
    assert stated == pytest.approx(2e5 * size / 1e9, rel=0.03)
    arguments = ["simulate", "-d", DESIGN, "--p", "1", "--theta", "1", "-n", "1e8", "-o", "never", "--quiet"]
    assert main(arguments) == 2
    assert "GB are free; expected at most" in capsys.readouterr().err
    monkeypatch.setattr(executor, "available", lambda: 10**18)
    executor.check_memory({"tracks": 10**9}, {"tracks"}, 1000, 100_000_000)


def test_import_takes_no_numpy():
    """Ctrl-C during a long import would end the command line with a traceback."""
    code = "import sys, cgemit.__main__; sys.exit(any(name in sys.modules for name in ('numpy', 'cgemit._core')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert all(getattr(cg, name) is not None for name in cg.__all__)
    assert set(cg.__all__) <= set(dir(cg))
    assert cg.helix.momentum([0, 0, 1, 0, 0]) == 1  # modules, too
    with pytest.raises(AttributeError, match="no attribute 'rum'"):
        cg.rum  # noqa: B018


@pytest.mark.parametrize(
    "thing",
    [
        cg.Gun("mu-", p=[0.1] * 500, theta=1) + cg.Gun("pi+", pt=(0.1, 1), cos_theta=0), cg.Settings(),
        scan(DESIGN, [1.0], events=30).samples[0], cg.load(DESIGN).cgem[0], cg.load(DESIGN).drift_chamber,
        chi2_flatness(make_tracks(), 5), gaussian_fit(np.arange(50.0)), cg.load(DESIGN), pulls(make_tracks()),
    ],
    ids=lambda thing: type(thing).__name__,
)  # fmt: skip
def test_things_show_themselves(thing):
    html = thing._repr_html_()
    assert html.startswith("<")
    assert html.count("<tr") == html.count("</tr>")
    assert len(html) < 10_000
    if not isinstance(thing, type(cg.Gun("mu-", p=1, theta=1) + cg.Gun("mu-", p=1, theta=1))):
        assert len(repr(thing)) < 1500


def test_all_problems_of_a_sweep_at_once():
    with pytest.raises(ValueError, match=r"^sweep:") as refused:
        sweep("no-such", {"cgem.L1.pitch_x": []}, {"method": "no", "particle": "x", "p": [-1], "quantities": ["zz"]})
    for part in (
        "evaluate.method: got 'no'",
        "quantities[0]: got 'zz'",
        "particle: got 'x'",
        "p[0]",
        "no-such",
        "cgem.L1.pitch_x",
    ):
        assert part in str(refused.value), part
    with pytest.raises(ValueError, match=r"sweep:[\s\S]*p\[0\]: got -1[\s\S]*cgem.L9.pitch_x: got 'L9'"):
        sweep("besiii-cgem", {"cgem.L9.pitch_x": ["1 mm"]}, {"p": [-1]})


@pytest.mark.parametrize("read", [read_plan, read_optimize_plan])
def test_unknown_keys_and_wrong_values_of_a_plan_at_once(read, tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(
        'bse = 1\n[vary]\n"cgem.L1.pitch_x" = ["1 mm", "2 mm"]\n[evaluate]\np = "1 mm"\nno = 1\n[settings.fit]\nx = 1\n'
    )
    with pytest.raises(PlanError) as refused:
        read(path)
    begins = [problem.path for problem in refused.value.problems]
    assert sorted(begins) == ["base", "bse", "evaluate.no", "evaluate.p", "settings.fit.x"]


@pytest.mark.parametrize(
    "make",
    [
        lambda: cg.TigerReadout(jitter=1e300), lambda: cg.TigerReadout(noise=1e30), lambda: cg.Apv25Readout(jitter=1e6),
        lambda: cg.ProjectionReadout(noise=2000.0),
    ],
)  # fmt: skip
def test_noise_and_jitter_have_limits(make):
    with pytest.raises(ValueError, match=r"(jitter|noise): got .*expected a (time|charge) in (ns|fC) from 0 to 1000"):
        make()
