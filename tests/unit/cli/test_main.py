"""The command line: exit codes, values, output folders, interruption."""

import argparse
import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cgemit import Settings
from cgemit.analysis.quantities import REPORTED
from cgemit.cli import options
from cgemit.cli.main import COMMANDS, join_negative_values, main
from cgemit.detector import load, write_field_map
from cgemit.tables import Table
from interrupts import interruptible, on_terminal

pytestmark = pytest.mark.usefixtures("undrawn")

RESOLUTION = ["resolution", "-d", "besiii-cgem-design", "--p", "0.5,1", "--events", "60", "--quiet"]
SIMULATE = ["simulate", "-d", "besiii-cgem-design", "--p", "1", "--cos-theta", "-0.5:0.5", "-n", "50", "--quiet"]


def test_help_and_version(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in COMMANDS)
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("cgemit ")
    for name in COMMANDS:
        assert main([name, "--help"]) == 0, name
        assert "examples:" in capsys.readouterr().out, name


def test_settings_in_the_examples_exist(capsys):
    """What the help of the commands sets can be set."""
    keys = []
    for name in COMMANDS:
        main([name, "--help"])
        keys += re.findall(r"--set (\S+)=(\S+)", capsys.readouterr().out.partition("examples:")[2])
    stages = {key: value for key, value in keys if key.partition(".")[0] in Settings().to_dict()}
    assert "fit.loss" in stages
    changed = Settings().with_overrides(
        {key: int(value) if value.isdigit() else value for key, value in stages.items()}
    )
    assert changed.fit.loss == "mean"
    readouts = {key: value.strip('"') for key, value in keys if key.startswith("readout.")}
    assert readouts.keys() == {"readout.threshold", "readout.gain"}
    load("besiii-cgem-design").with_overrides({"readout.gain": 20_000.0, "readout.threshold": "5 fC"})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sturdy"], "unknown command"),
        (["study", "--events", "none"], "whole number"),
        (["study", "--events", "10", "-o", "never"], "from 400"),
        (["study", "--threads", "0"], "a whole number from 1"),
        ([*RESOLUTION, "-o", "never", "--method", "geant"], "geant"),
        (
            ["resolution", "-d", "besiii-cgem", "--p", "1:2:3:4", "-o", "never"],
            "A,B,C or A:B:COUNT",
        ),
        (["resolution", "-d", "besiii-cgam", "--p", "1", "-o", "never"], "besiii-cgem"),
        (["resolution", "-d", "besiii-cgem", "--p", "1 mm", "-o", "never"], "momentum"),
        (["resolution", "-d", "besiii-cgem", "--p", "-1", "-o", "never"], "p"),
        (["resolution", "-d", "besiii-cgem", "--p", "1 gev", "-o", "never"], 'did you mean "GeV/c"'),
        (["readout", "--angles", "0:40:9"], "got 40 rad = 2291.83 deg"),
        (
            ["simulate", "-d", "besiii-cgem", "--p", "1", "-n", "1", "-o", "never"],
            "got no --theta or --cos-theta or --eta; expected one",
        ),
        (["simulate", "-d", "besiii-cgem", "--sample", "jpsi-rhopi", "-o", "never"], "got no -n; expected one"),
        (["show", "besiii-cgem", "--gdml", "x.gdml", "-o", "never"], "--gdml takes no value"),
        ([*SIMULATE, "--set", "cgem.L2.pitch_x", "-o", "never"], "KEY=VALUE"),
        ([*SIMULATE, "--set", "cgem.L2.pitch_x=500 kg", "-o", "never"], "cgem.L2.pitch_x"),
        ([*SIMULATE, "--particle", "muon+-", "-o", "never"], "muon+-"),
        (["simulate", "-d", "besiii-cgem", "--cos-theta", "0", "-n", "1", "-o", "never"], "--p"),
    ],
)
def test_bad_input_is_explained_with_exit_code_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert "Traceback" not in captured.err
    assert not captured.out
    assert list(tmp_path.iterdir()) == []


def test_options_are_near_by_their_names_alone(capsys):
    for words, hint in (
        (["align", "--forecast", "--readout", "tiger"], "which it does not know ("),  # not --forecast
        (["align", "--forcast"], 'which it does not know; did you mean "--forecast"? ('),
        ([*RESOLUTION, "-o", "never", "--agianst", "p"], 'which it does not know; did you mean "--against"? ('),
        ([*RESOLUTION, "-o", "never", "-p", "1"], 'did you mean "--p"?'),
    ):
        assert main(words) == 2
        assert hint in capsys.readouterr().err


def test_every_mistake_of_a_detector_file_is_listed(tmp_path, capsys):
    file = tmp_path / "wrong.toml"
    lines = [
        'base = "besiii-cgem-design"', "nonsense = 1", "[field]", 'bz = "1 mm"', 'kinds = "uniform"',
        "[cgem.L1]", 'pitch_x = "-3 mm"', 'pich_v = "1 mm"', "drift_gap = 5", 'gas = "Unobtainium"',
        "[cgem.L2]", "sheets = 9", 'length = "inf mm"', "[drift_chamber]", 'sigma = "130 smoots"',
    ]  # fmt: skip
    file.write_text("\n".join(lines), encoding="utf-8")
    options = ["--p", "1", "--cos-theta", "0", "-n", "1", "-o", str(tmp_path / "out")]
    assert main(["simulate", "-d", str(file), *options]) == 2
    text = capsys.readouterr().err
    places = (
        "nonsense", "field.bz", "field.kinds", "L1.pitch_x", "L1.pich_v", "L1.drift_gap", "L1.gas", "L2.sheets",
        "L2.length", "drift_chamber.sigma",
    )  # fmt: skip
    assert [place for place in places if place not in text] == []
    assert "10 problems" in text
    assert not (tmp_path / "out").exists()


def test_failures_of_the_run_have_exit_code_3(monkeypatch, capsys, tmp_path):
    def fail(*_, **__):
        raise RuntimeError("the sky fell")

    monkeypatch.setattr("cgemit.study.paper.run.reproduce", fail)
    arguments = ["study", "-o", str(tmp_path / "out")]
    assert main(arguments) == 3
    text = capsys.readouterr().err
    assert "RuntimeError: the sky fell" in text
    assert "Traceback" not in text
    assert main([*arguments, "--debug"]) == 3
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        [*SIMULATE, "--settings", "absent.toml", "-o", "never"],
        [*SIMULATE, "--settings", "absent.json", "-o", "never"],
        ["simulate", "-d", "besiii-cgem", "--particles", "absent.parquet", "-o", "never"],
        ["sweep", "absent.toml", "-o", "never"],
        ["optimize", "absent.toml", "-o", "never"],
        ["validate", "absent.toml"],
        ["resolution", "-d", "besiii-cgem", "--p", "1", "--field", "absent.toml", "-o", "never"],
        ["show", "absent.toml"],
        ["study", "--field", "absent.npz", "-o", "never"],
        ["find", "-d", "absent.toml", "--p", "1", "--cos-theta", "0", "-n", "1"],
        ["display", "-d", "absent.toml", "--p", "1", "--cos-theta", "0", "-o", "never"],
        ["refit", "-d", "besiii-cgem", "absent.rec"],
        ["settings", "--settings", "absent.toml"],
        ["readout", "--settings", "absent.toml"],
    ],
)
def test_missing_files_are_named_in_words(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "absent." in said
    assert re.search("no such file|does not exist|is missing", said, re.IGNORECASE)
    assert "rrno" not in said


def test_the_command_alone_prints_its_help(capsys):
    assert main([]) == 0
    assert "examples:" in capsys.readouterr().out


@pytest.mark.parametrize("method", ["mc", "analytic"])
def test_momenta_that_are_not_measured_are_named_with_their_unit(method, tmp_path, capsys):
    words = [
        "resolution",
        "-d",
        "besiii-cgem",
        "--p",
        "0.5,500",
        "--method",
        method,
        "--quiet",
        "-o",
        str(tmp_path / "out"),
    ]
    assert main([*words, "-n", "100", "--threads", "1"]) == 0
    said = capsys.readouterr().err
    assert "does not measure 500 GeV/c" in said
    assert "without a unit are in GeV/c" in said


@pytest.mark.parametrize("keep", [[], ["--keep", "tracks"]])
def test_a_simulation_names_momenta_that_are_not_measured(keep, tmp_path, capsys):
    """Whether its tables are in memory or written in parts."""
    for p, said in (("0.5", False), ("500", True)):
        words = ["simulate", "-d", "besiii-cgem", "--p", p, "--theta", "1.5", "-n", "20", "--fit", "--quiet", *keep]
        assert main([*words, "-o", str(tmp_path / p)]) == 0
        assert ("does not measure most of the momenta" in capsys.readouterr().err) is said


def test_an_interruption_that_became_another_error_has_exit_code_130(monkeypatch, capsys):
    def interrupted(_):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stop:
            raise RuntimeError("Error calling __set_name__") from stop

    monkeypatch.setattr("cgemit.cli.main.importlib.import_module", interrupted)
    assert main(["detectors"]) == 130
    assert capsys.readouterr().err == "cgemit: interrupted\n"


def test_an_interrupted_sweep_says_how_to_go_on(monkeypatch, capsys, tmp_path):
    """Other commands keep nothing, and say nothing of it."""

    def stop(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("cgemit.cli.sweep.run", stop)
    monkeypatch.setattr("cgemit.cli.simulate.run", stop)
    assert main(["sweep", "plan.toml", "-o", str(tmp_path)]) == 130
    expected = f"{tmp_path} keeps what is complete, and the same command (without --overwrite) continues"
    assert capsys.readouterr().err == f"cgemit: interrupted; {expected}\n"
    assert main(["sweep", "plan.toml", "-o", str(tmp_path / "none")]) == 130
    assert main(["simulate", "-d", "besiii-cgem", "--p", "1", "-o", str(tmp_path)]) == 130
    assert capsys.readouterr().err == "cgemit: interrupted\n" * 2


@pytest.mark.parametrize(
    ("closed", "words", "code"),
    [(1, ["detectors"], 0), (2, ["validate", "absent.toml"], 2), (2, ["slab", "Cu 1 mm", "--p", "1", "-n", "1000"], 0)],
)
def test_streams_may_be_closed(closed, words, code, tmp_path):
    """Nothing reaches the other stream that belongs to the closed one."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = ["bash", "-c", f'exec "$0" "$@" {closed}>&-', sys.executable, "-m", "cgemit", *words]
    done = subprocess.run(command, capture_output=True, env=environment, cwd=tmp_path, check=False)
    assert done.returncode == code, done
    assert b"absent" not in done.stdout
    assert not done.stderr


def test_interruption_has_exit_code_130(monkeypatch, capsys, tmp_path):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("cgemit.study.paper.run.reproduce", interrupt)
    assert main(["study", "-o", str(tmp_path / "out")]) == 130
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["besiii-idc", "drawing"])
def test_ctrl_c_during_a_study_leaves_nothing(moment, tmp_path):
    command = [sys.executable, "-u", "-m", "cgemit", "study", "--events", "1200", "-o", str(tmp_path / "out")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with on_terminal(command, env=environment) as (process, read):
        assert moment in read(moment)
        process.send_signal(signal.SIGINT)
        rest = read()
        assert process.wait(60) == 130, rest
    assert list(tmp_path.iterdir()) == []


ENDLESS = ["--set", "fit.max_iterations=2147483647", "--set", "fit.tolerance=1e-300"]  # a fit that never ends
INTERRUPTED = {
    "fit": ["simulate", *RESOLUTION[1:3], "--p", "1", "--cos-theta", "0", "-n", "2000", "--fit", *ENDLESS],
    "analytic": [
        "resolution",
        *RESOLUTION[1:3],
        "--method",
        "analytic",
        "--p",
        "0.2:2:5000",
        "--cos-theta",
        "-0.9:0.9",
    ],
    "simulation": [
        "simulate",
        *RESOLUTION[1:3],
        "--p",
        "1",
        "--cos-theta",
        "-0.9:0.9",
        "-n",
        "1000000",
        "--keep",
        "all",
    ],
    "finder": ["find", *RESOLUTION[1:3], "--p", "1", "--cos-theta", "0:0.9", "--tracks", "8", "-n", "20000"],
    "readout": ["readout", "--readout", "tiger", "-n", "100000"],
    "sweep": ["sweep", "plan.toml"],
    "processes": ["sweep", "plan.toml", "--processes", "2"],
}
PLAN = """
base = "besiii-cgem-design"
[vary]
"cgem.*.pitch_x" = ["400 um", "500 um", "600 um", "700 um"]
[evaluate]
method = "mc"
events = 100000
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "signals"),
    [
        *((name, (signal.SIGINT,) * 3) for name in INTERRUPTED),
        ("fit", (signal.SIGINT,)),
        ("processes", (signal.SIGINT,)),
        ("simulation", (signal.SIGTERM, signal.SIGINT)),
    ],
)
def test_an_interrupted_command_ends_with_130_whatever_it_was_at(name, signals, tmp_path):
    """The first Ctrl-C is enough, also for a fit that never ends; further ones change nothing, and no C++ aborts."""
    (tmp_path / "plan.toml").write_text(PLAN)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONFAULTHANDLER": ""}
    command = [sys.executable, "-m", "cgemit", *INTERRUPTED[name], "--threads", "2"]
    command = command[:-2] if name == "processes" else command
    with interruptible(
        [*command, "-o", "out"], cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        wait_until_at_work(process.pid, 2 if name == "processes" else 1)
        for number in signals:
            process.send_signal(number)
            time.sleep(0.02)
        error = process.communicate(timeout=60)[1].decode()
    assert process.returncode == 130, error
    assert "terminate" not in error
    assert "Traceback" not in error
    assert not list(tmp_path.glob(".cgemit-*"))
    assert {path.name for path in tmp_path.iterdir()} <= {"plan.toml", *(["out"] if "plan.toml" in command else [])}


def wait_until_at_work(process, seconds):
    """Wait until a process and its children have used this much time of processors since the first look."""

    def used():
        groups = [f"/proc/{process}", *(f"/proc/{one}" for one in children(process))]
        ticks = [
            Path(one, "stat").read_text().rpartition(")")[2].split()[11:13] for one in groups if Path(one).exists()
        ]
        return sum(int(one) for pair in ticks for one in pair) / os.sysconf("SC_CLK_TCK")

    deadline = time.monotonic() + 90
    while used() < 2.5 + seconds and time.monotonic() < deadline:
        time.sleep(0.1)


def children(process):
    return Path(f"/proc/{process}/task/{process}/children").read_text().split()


@pytest.mark.slow
@pytest.mark.parametrize("command", [["validate", "--schema"], [*RESOLUTION, "-o", "out"]])
def test_an_encoding_without_all_signs(command, tmp_path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [sys.executable, "-m", "cgemit", *command], capture_output=True, env=environment, cwd=tmp_path, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"?" in done.stdout
    assert done.stdout.isascii()


@pytest.mark.slow
def test_output_folders_are_not_overwritten_unasked(tmp_path, capsys):
    folder = tmp_path / "out"
    folder.mkdir()  # an empty one is free
    arguments = [*RESOLUTION, "-o", str(folder)]
    assert main(arguments) == 0
    mine = folder / "mine.txt"
    mine.write_text("keep", encoding="utf-8")
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert main(arguments) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    assert main([*arguments, "--overwrite"]) == 2
    assert "holds 'mine.txt', which is not of the results" in capsys.readouterr().err
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    mine.unlink()
    time.sleep(0.01)
    assert main([*arguments, "--overwrite"]) == 0
    after = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert after.keys() == before.keys() - {"mine.txt"}
    assert after["summary.json"] > before["summary.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
def test_resolution_writes_table_curves_and_json(tmp_path, capsys):
    assert main([*RESOLUTION, "-o", str(tmp_path / "a"), "--threads", "1"]) == 0
    table = capsys.readouterr().out
    assert table.splitlines()[1].split()[:2] == ["p", "[GeV/c]"]
    assert len(table.splitlines()) == 4
    assert main([*RESOLUTION, "-o", str(tmp_path / "b"), "--threads", "2", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    first, second = (json.loads((tmp_path / name / "summary.json").read_text()) for name in "ab")
    assert printed["curves"] == second["curves"]
    assert first["curves"] == second["curves"]  # whatever the number of threads
    assert [curve["id"] for curve in first["curves"]][:3] == ["sigma_dr", "sigma_dz", "sigma_p"]
    assert first["curves"][2]["y_unit"] == "MeV/c"
    header = (tmp_path / "a" / "resolution.csv").read_text().splitlines()[0]
    assert "sigma_dr (um)" in header.split(",")
    assert (tmp_path / "a" / "resolution.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "a" / "resolution.pdf").read_bytes().startswith(b"%PDF")


def test_variants_from_the_shell(tmp_path):
    options = ["--set", "cgem.L2.pitch_x=500 um", "--set", "field.bz=1.5 T"]
    assert main([*SIMULATE, *options, "-o", str(tmp_path / "out")]) == 0
    detector = load(tmp_path / "out" / "detector.toml")
    assert (detector.cgem[1].pitch_x, detector.field.bz) == (0.5, 1.5)


@pytest.mark.slow
def test_several_detectors_give_one_table_each_and_one_file_of_all(tmp_path, capsys):
    thin = tmp_path / "thin.toml"
    thin.write_text('base = "besiii-cgem-design"\n[cgem.L1]\ndrift_gap = "3 mm"\n', encoding="utf-8")
    names = ["besiii-cgem-design", "thin", "besiii-idc"]
    assert main([*RESOLUTION, "-d", str(thin), "-d", "besiii-idc", "-o", str(tmp_path / "all")]) == 0
    tables = capsys.readouterr().out.split("\n\n")
    differences = [f"{name} minus besiii-cgem-design" for name in names[1:]]
    assert [table.split(",")[0] for table in tables] == names + differences
    with (tmp_path / "all" / "resolution.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["name"], row["p (GeV/c)"]) for row in rows] == [(name, p) for name in names for p in ("0.5", "1")]
    summary = json.loads((tmp_path / "all" / "summary.json").read_text())
    assert summary["inputs"]["detectors"] == names
    curves = [(curve["detector"], curve["id"]) for curve in summary["curves"]]
    assert curves == [(name, f"sigma_{what}") for name in names for what in REPORTED]
    assert len({tuple(curve["y"]) for curve in summary["curves"]}) == 27
    assert load(tmp_path / "all" / "detector-2-thin.toml") == load(thin)
    assert main([*RESOLUTION, "-o", str(tmp_path / "one"), "--json"]) == 0  # alone it has the same curves
    assert json.loads(capsys.readouterr().out)["curves"] == summary["curves"][:9]


@pytest.fixture
def narrow_map(tmp_path):
    """Return a map of the field that ends within the detector."""
    r, z = np.linspace(0, 150, 7), np.linspace(-1300, 1300, 27)
    shape = (len(r), len(z))
    columns = {"r": r, "z": z, "br": np.zeros(shape), "bz": np.full(shape, -1.0)}
    return str(write_field_map(tmp_path / "narrow.npz", columns))


ENDS = "the map is of r = 0 to 150 mm, z = -1300 to 1300 mm; the detector goes to r = 763"


def test_a_study_in_a_map_that_is_too_small_says_so(narrow_map, tmp_path, capsys):
    assert main(["study", "--events", "400", "--field", narrow_map, "-o", str(tmp_path / "out"), "--quiet"]) == 2
    first, *others = capsys.readouterr().err.splitlines()
    assert first.startswith("cgemit: besiii-cgem-design, 1 GeV/c sample: 0 of 400 tracks fitted, expected at least 10")
    assert "transport: left_field 400 of 400; fit: " in first
    assert ENDS in first
    assert [line.partition(",")[0] for line in others] == ["besiii-cgem-design with a 3 mm gap"]
    assert list(tmp_path.iterdir()) == [Path(narrow_map)]


def test_resolutions_in_a_map_that_is_too_small_say_so(narrow_map, tmp_path, capsys):
    assert main([*RESOLUTION, "--field", narrow_map, "-o", str(tmp_path / "out")]) == 3
    captured = capsys.readouterr()
    begin = "cgemit: besiii-cgem-design+field=narrow: at 0.5, 1 GeV/c: 0 of 120 tracks fitted"
    assert captured.err.startswith(begin)
    assert "transport: left_field 120 of 120; fit: " in captured.err
    assert ENDS in captured.err
    assert not captured.out
    assert list(tmp_path.iterdir()) == [Path(narrow_map)]


@pytest.mark.slow
def test_slow_tracks_that_curl_are_no_matter_of_the_map(narrow_map, tmp_path, capsys):
    slow = ["resolution", "-d", "besiii-idc", "--p", "0.02,1", "--events", "60", "--quiet", "-o", str(tmp_path / "out")]
    assert main(slow) == 0
    note = capsys.readouterr().out.splitlines()[-1]
    assert note.startswith("at 0.02 GeV/c: 0 of 60 tracks fitted")
    assert "map" not in note


@pytest.mark.slow
def test_changes_apply_to_every_detector(tmp_path):
    arguments = [*RESOLUTION, "-d", "besiii-idc", "--set", "field.bz=1.5 T", "-o", str(tmp_path / "out")]
    assert main(arguments) == 0
    files = sorted((tmp_path / "out").glob("detector-*.toml"))
    assert [(load(file).name, load(file).field.bz) for file in files] == [
        ("besiii-cgem-design+field.bz=1.5T", 1.5),
        ("besiii-idc+field.bz=1.5T", 1.5),
    ]


@pytest.mark.parametrize("command", [RESOLUTION, [*SIMULATE, "--json"]])
def test_a_variant_has_the_name_it_is_given(command, tmp_path, capsys):
    assert main([*command, "--set", "field.bz=1.5 T", "--name", "strong field", "-o", str(tmp_path / "out")]) == 0
    assert "strong field" in capsys.readouterr().out
    assert "strong field" in (tmp_path / "out" / "summary.json").read_text()
    detector = load(tmp_path / "out" / "detector.toml")
    assert (detector.name, detector.field.bz) == ("strong field", 1.5)


@pytest.mark.parametrize(
    ("options", "messages"),
    [
        (["-d", "besiii-cgem-design"], ["a second detector of the name 'besiii-cgem-design'"]),
        (["-d", "besiii-idc", "--name", "x"], ["--name", "2 detectors"]),
        (["--name", " "], ["--name: got ' '"]),
        (["-d", "besiii-adc", "-d", "besiii-cgam"], ["besiii-adc", "besiii-cgam"]),
        (["-d", "besiii-idc", "--set", "cgem.L1.sheets=1"], ["besiii-idc: 1 problem"]),
    ],
)
def test_mistakes_about_several_detectors(options, messages, tmp_path, capsys):
    assert main([*RESOLUTION, *options, "-o", str(tmp_path / "never")]) == 2
    text = capsys.readouterr().err
    assert [message for message in messages if message not in text] == []
    assert list(tmp_path.iterdir()) == []


def test_simulate_takes_one_detector(tmp_path, capsys):
    assert main([*SIMULATE, "-d", "besiii-idc", "-o", str(tmp_path / "never")]) == 2
    assert "got a second one, besiii-idc" in capsys.readouterr().err


def test_simulate_writes_tables(tmp_path, capsys):
    assert main([*SIMULATE, "-o", str(tmp_path / "bare")]) == 0
    assert (
        main([*SIMULATE, "--fit", "-o", str(tmp_path / "fitted"), "--vertex", "1,2,3 cm", "--json", "--seed", "4"]) == 0
    )
    assert {path.stem for path in (tmp_path / "fitted").iterdir()} - {
        path.stem for path in (tmp_path / "bare").iterdir()
    } == {"candidates", "candidate_hits", "tracks", "matches"}
    particles = Table.load(tmp_path / "fitted" / "particles.npz")
    assert particles.n_events == 50
    np.testing.assert_array_equal(particles["z"], 30.0)
    cosine = particles["pz"] / np.sqrt(particles["px"] ** 2 + particles["py"] ** 2 + particles["pz"] ** 2)
    assert -0.5 <= cosine.min() < cosine.max() <= 0.5
    summary = json.loads((tmp_path / "fitted" / "summary.json").read_text())
    assert summary["rows"]["tracks"] == 50
    assert (summary["seed"], summary["events"]) == (4, 50)
    assert '"tracks": 50' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("1", 1.0),
        ("200 MeV/c", 0.2),
        ("0.2:0.8", (0.2, 0.8)),
        ("0.2:1.0:5", [0.2, 0.4, 0.6, 0.8, 1.0]),
        ("2:3:1", [2.0]),
        ("1,500 MeV/c", [1.0, 0.5]),
    ],
)
def test_values(text, values):
    assert options.momenta(text) == values


def test_negative_values_are_not_options():
    words = ["--cos-theta", "-0.9:0.9", "-n", "-5", "--phi", "-.5", "--quiet", "-o", "x"]
    assert join_negative_values(words) == ["--cos-theta=-0.9:0.9", "-n", "-5", "--phi=-.5", "--quiet", "-o", "x"]


def test_progress_is_shown_on_a_terminal_only(capsys):
    arguments = argparse.Namespace(quiet=False)
    with options.progress_bar(arguments, "work") as progress:
        progress(0.5)
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_progress_leaves_the_line_free(tmp_path):
    for quiet in ([], ["--quiet"]):
        command = [sys.executable, "-m", "cgemit", "slab", "Be 1 mm", "-n", "1000", *quiet]
        with on_terminal(command, cwd=tmp_path, stdout=subprocess.DEVNULL) as (process, read):
            text = read()
            assert process.wait(60) == 0, text
        assert text.endswith("\r") if not quiet else not text
