"""Every option of the commands that run the chain gives what the same call in Python gives, and changes something."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cgemit.base.settings import SettingsError
from cgemit.chain.result import Result
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.cli import options
from cgemit.cli.main import build_parser, main
from cgemit.detector import load
from cgemit.detector.reader import TOP_LEVEL
from cgemit.detector.readouts import BinaryReadout, GaussianReadout
from cgemit.particles.gun import Gun
from cgemit.reconstruction.clusterers.clusterer import ClusterSettings
from cgemit.reconstruction.find.ckf import FindSettings
from cgemit.reconstruction.fit import FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings
from cgemit.study.scan import Scan, scan
from cgemit.tables import Table

pytestmark = pytest.mark.usefixtures("undrawn")

DESIGN = "besiii-cgem-design"
FILE = '[fit]\nkinks = false\n[cluster]\nposition = "charge"\n[digitize]\nreveal_sides = true\n'
OF_FILE = Settings(
    fit=FitSettings(kinks=False),
    cluster=ClusterSettings(position="charge"),
    digitize=DigitizeSettings(reveal_sides=True),
)
#: Options that say how results are shown or where they go; other tests look at them.
SHOWN = {
    "--help",
    "--json",
    "--map",
    "--budget",
    "--sensitivity",
    "--output",
    "--overwrite",
    "--quiet",
    "--debug",
    "--method",
    "--format",
}


@dataclass
class Row:
    """An option on the command line, and the arguments that do the same in Python.

    Attributes
    ----------
    option : str
        Its long form.
    words : list of str
        Of the command line, with the options that they replace left out.
    same : dict
        Changed arguments in Python.
    instead : str
        Option of the usual command line that goes, besides the option itself.
    idle : bool
        Whether the option changes no result.
    """

    option: str
    words: list[str]
    same: dict[str, Any] = field(default_factory=dict)
    instead: str = ""
    idle: bool = False


def name(row: Row) -> str:
    """Return what a test with this row is called."""
    return " ".join(row.words) or f"no {row.option}"


@pytest.fixture(autouse=True)
def settings_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put the file of settings that rows name into the current folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mine.toml"
    path.write_text(FILE, encoding="utf-8")
    return path


def command_line(start: list[str], usual: dict[str, list[str]], row: Row) -> list[str]:
    """Return the words of the usual command line with those of a row."""
    kept = [word for option, words in usual.items() if option not in (row.option, row.instead) for word in words]
    return [*start, *kept, *row.words]


def options_of(command: str) -> set[str]:
    """Return the long forms of the options of a command."""
    choices = next(a.choices for a in build_parser(command)._actions if isinstance(a, argparse._SubParsersAction))
    return {next(o for o in action.option_strings if o.startswith("--")) for action in choices[command]._actions}


def with_settings(**stages: Any) -> dict[str, Any]:
    """Return the argument of settings that are not all defaults."""
    return {"settings": Settings(**stages)}


COMMON = [
    Row("--detector", ["-d", "besiii-idc"], {"detector": "besiii-idc"}),
    Row("--set", ["--set", "cgem.L2.pitch_x=500 um"],
        {"detector": load(DESIGN).with_overrides({"cgem.L2.pitch_x": "500 um"})}),
    Row("--set", ["--set", "fit.loss=mean"], with_settings(fit=FitSettings(loss="mean"))),
    Row("--set", ["--set", "simulate.sublayers=true", "--set", "cluster.position=charge"],
        with_settings(simulate=SimulateSettings(sublayers=True), cluster=ClusterSettings(position="charge"))),
    Row("--set",
        ["--set", "cgem.*.readout=gaussian", "--set", "cgem.L1.readout.sigma_x=0.2 mm", "--set", "field.bz=0.9 T"],
        {"detector": load(DESIGN).with_overrides(
            {"cgem.*.readout": "gaussian", "cgem.L1.readout.sigma_x": "0.2 mm", "field.bz": "0.9 T"})}),
    Row("--settings", ["--settings", "mine.toml"], {"settings": OF_FILE}),
    Row("--settings", ["--settings", "mine.toml", "--set", "digitize.reveal_sides=false", "--set", "fit.kinks=true"],
        {"settings": replace(OF_FILE, fit=FitSettings(), digitize=DigitizeSettings())}),
    Row("--field", ["--field", "besiii-harmonic"], {"detector": load(DESIGN).with_field("besiii-harmonic")}),
    Row("--name", ["--name", "mine"], {"detector": load(DESIGN).with_overrides({"name": "mine"})}),
    Row("--readout", ["--readout", "gaussian"], {"detector": load(DESIGN).with_readout("gaussian")}),
    Row("--readout", ["--readout", "gaussian", "--set", "readout.sigma_x=0.2 mm"],
        {"detector": load(DESIGN).with_readout("gaussian").with_overrides({"readout.sigma_x": "0.2 mm"})}),
    Row("--no-deltas", ["--no-deltas"], with_settings(simulate=SimulateSettings(deltas=False))),
    Row("--hypothesis", ["--hypothesis", "K"], with_settings(fit=FitSettings(hypothesis=("K",)))),
    Row("--particle", ["--particle", "pi+"], {"particle": "pi+"}),
    Row("--p", ["--p", "0.5"], {"p": 0.5}),
    Row("--cos-theta", ["--cos-theta", "-0.5:0.2"], {"cos_theta": (-0.5, 0.2)}),
    Row("--seed", ["--seed", "18446744073709551615"], {"seed": 2**64 - 1}),
]  # fmt: skip

GUN = ("particle", "p", "pt", "theta", "cos_theta", "eta", "phi", "vertex", "vertex_sigma")
SIMULATE = {
    "--detector": ["-d", DESIGN], "--p": ["--p", "0.3"], "--cos-theta": ["--cos-theta", "0.1"],
    "--events": ["-n", "30"], "--fit": ["--fit"],
}  # fmt: skip
SIMULATE_ROWS = [
    Row("--threads", ["--threads", "2"], {"workers": 2}, idle=True),
    *COMMON,
    Row("--events", ["-n", "31"], {"n": 31}),
    Row("--pt", ["--pt", "0.3:0.4"], {"p": None, "pt": (0.3, 0.4)}, "--p"),
    Row("--theta", ["--theta", "60 deg"], {"cos_theta": None, "theta": "60 deg"}, "--cos-theta"),
    Row("--eta", ["--eta", "-1:1"], {"cos_theta": None, "eta": (-1.0, 1.0)}, "--cos-theta"),
    Row("--phi", ["--phi", "1,2"], {"phi": [1.0, 2.0]}),
    Row("--vertex", ["--vertex", "1,2,30"], {"vertex": (1.0, 2.0, 30.0)}),
    Row("--vertex-sigma", ["--vertex-sigma", "0.1,0.2,3"], {"vertex_sigma": (0.1, 0.2, 3.0)}),
    Row("--hypothesis", ["--hypothesis", "mu,K"], with_settings(fit=FitSettings(hypothesis=("mu", "K")))),
    Row("--finder", ["--finder", "ckf", "--set", "find.hypothesis=pi"],
        {"finder": "ckf", **with_settings(find=FindSettings(hypothesis="pi"))}),
    Row("--keep", ["--keep", "tracks,digis"], {"keep": ("tracks", "digis")}),
    Row("--states", ["--states", "hits,9 cm"], with_settings(fit=FitSettings(states=("hits", 90.0)))),
]  # fmt: skip


def simulated(**change: Any) -> Result:
    """Return what the usual command line, or a changed one, gives in Python."""
    given = {"detector": DESIGN, "particle": "mu-", "p": 0.3, "cos_theta": 0.1, "n": 30, "seed": 1} | change
    gun = Gun(**{key: given.pop(key) for key in GUN if given.get(key) is not None})
    return run(gun=gun, **{key: value for key, value in given.items() if key not in GUN})


DISPLAY = {"--detector": ["-d", DESIGN], "--p": ["--p", "0.3"], "--cos-theta": ["--cos-theta", "0.1"]}
DISPLAY_ROWS = [
    *(row for row in SIMULATE_ROWS if row.option not in ("--events", "--states", "--threads", "--keep")
      and row.words != ["--hypothesis", "mu,K"]),
    Row("--event", ["--event", "4"]),
]  # fmt: skip


@pytest.mark.parametrize("row", DISPLAY_ROWS, ids=name)
def test_options_of_display(row: Row, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []

    class Reached(Exception):
        """The picture would begin."""

    def begin(*given: Any) -> None:
        drawn.append(given)
        raise Reached

    monkeypatch.setattr("cgemit.draw.display.event", begin)
    for one in (Row("", []), row):
        assert main([*command_line(["display"], DISPLAY, one), "--quiet", "-o", "out"]) == 3
    (usual, _), (found, number) = drawn
    assert number == (4 if row.option == "--event" else 0)
    expected = simulated(**{"n": 5} | row.same).select_events(number, number + 1)
    assert_same_rows(found, expected)
    assert found.detector.name == expected.detector.name
    if row.option not in ("--name", "--no-deltas", "--set", "--settings"):  # which change no row of some events
        with pytest.raises(AssertionError, match=r"Arrays are not equal|assert \["):
            assert_same_rows(found, usual)


def assert_same_rows(found: Result, expected: Result) -> None:
    """Compare all tables but what they say of the gun."""
    assert list(found.tables) == list(expected.tables)
    for kind, table in expected.tables.items():
        for column in table.columns:
            np.testing.assert_array_equal(found.tables[kind][column], table[column], err_msg=f"{kind}.{column}")


@pytest.fixture(scope="module")
def usual() -> Result:
    return simulated()


@pytest.mark.parametrize("row", SIMULATE_ROWS, ids=name)
def test_options_of_simulate(row: Row, usual: Result, tmp_path: Path) -> None:
    words = command_line(["simulate"], SIMULATE, row)
    assert main([*words, "--quiet", "-o", str(tmp_path / "out")]) == 0
    found = Result.load(tmp_path / "out")
    assert found == simulated(**row.same)
    assert (found == usual) is row.idle
    if row.option != "--name":
        assert (dict(found.tables) == dict(usual.tables)) is row.idle
    assert json.loads((tmp_path / "out" / "run.json").read_text())["command"].startswith("cgemit simulate ")


def test_fit_writes_the_tracks(usual: Result, tmp_path: Path) -> None:
    words = command_line(["simulate"], SIMULATE, Row("--fit", []))
    assert main([*words, "--quiet", "-o", str(tmp_path / "out")]) == 0
    expected = {name: table for name, table in usual.tables.items() if name in Result.load(tmp_path / "out").tables}
    assert dict(Result.load(tmp_path / "out").tables) == expected
    assert "tracks" not in expected
    assert "clusters" in expected


@pytest.mark.parametrize(
    "option", ["--states=hits", "--hypothesis=mu", "--set=fit.loss=mean", "--finder=ckf", "--set=find.gate=5"]
)
def test_what_only_the_fit_can_give_is_fitted(option: str, tmp_path: Path) -> None:
    words = command_line(["simulate"], SIMULATE, Row("--fit", [option]))
    assert main([*words, "--quiet", "-o", str(tmp_path / "out")]) == 0
    assert len(Table.load(tmp_path / "out" / "tracks.npz")) == 30


RESOLUTION = {
    "--detector": ["-d", DESIGN], "--p": ["--p", "0.3"], "--cos-theta": ["--cos-theta", "0.1"],
    "--events": ["--events", "30"],
}  # fmt: skip
RESOLUTION_ROWS = [
    Row("--threads", ["--threads", "2"], {"threads": 2}, idle=True),
    *COMMON,
    Row("--events", ["--events", "31"], {"events": 31}),
    Row("--pt", ["--pt", "0.3"], {"p": None, "pt": [0.3]}, "--p"),
    Row("--theta", ["--theta", "60 deg:70 deg"], {"cos_theta": None, "theta": ("60 deg", "70 deg")}, "--cos-theta"),
    Row("--theta", ["--theta", "60 deg,70 deg"], {"cos_theta": None, "theta": ["60 deg", "70 deg"]}, "--cos-theta"),
    Row("--p", ["--p", "0.3:0.5"], {"p": (0.3, 0.5)}, "--p"),
    Row("--eta", ["--eta", "-1:1:3"], {"cos_theta": None, "eta": [-1.0, 0.0, 1.0]}, "--cos-theta"),
    Row("--phi", ["--phi", "0:1"], {"phi": (0.0, 1.0)}),
    Row("--d", ["--d", "0,2 cm"], {"d": [0.0, 20.0]}),
    Row("--against", ["--against", "eta=0,1"], {"cos_theta": None, "eta": [0.0, 1.0]}, "--cos-theta"),
    Row("--against", ["--against", "cos-theta=0:0.6:3"], {"cos_theta": [0.0, 0.3, 0.6]}, "--cos-theta"),
    Row("--against", ["--against", "d", "--d", "5"], {"d": 5.0, "against": "d"}),
    Row("--against", ["--against", "cgem.*.pitch_x=400 um:0.6 mm:3"],
        {"against": {"cgem.*.pitch_x": ["400 um", "500 um", "600 um"]}}),
    Row("--against", ["--against", "cgem.*.readout=tiger,binary"],
        {"against": {"cgem.*.readout": ["tiger", "binary"]}}),
    Row("--finder", ["--finder", "ckf", "--set", "find.hypothesis=pi"],
        {"finder": "ckf", **with_settings(find=FindSettings(hypothesis="pi"))}),
]  # fmt: skip


def scanned(**change: Any) -> Scan:
    """Return what the usual command line, or a changed one, gives in Python."""
    given = {"detector": DESIGN, "particle": "mu-", "p": 0.3, "cos_theta": 0.1, "events": 30, "seed": 1} | change
    p = given.pop("p")
    return scan(load(given.pop("detector")), p, **given)


def tracks_of(found: Scan) -> list[tuple[str, Table]]:
    return [(sample.detector.name, sample.tracks) for sample in found.samples]


@pytest.fixture(scope="module")
def usual_scan() -> Scan:
    return scanned()


@pytest.mark.parametrize("row", RESOLUTION_ROWS, ids=name)
def test_options_of_resolution(row: Row, usual_scan: Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    saved: list[Any] = []
    monkeypatch.setattr(sys.modules["cgemit.study.scan"], "save_scans", lambda scans, *_, **__: saved.extend(scans))
    assert main([*command_line(["resolution"], RESOLUTION, row), "--quiet", "-o", "out"]) == 0
    assert tracks_of(saved[0]) == tracks_of(scanned(**row.same))
    assert (tracks_of(saved[0]) == tracks_of(usual_scan)) is row.idle


STUDY_ROWS = [
    Row("--events", ["--events", "500"], {"events": 500}),
    Row("--quick", ["--quick"], {"quick": True}),
    Row("--pdf", ["--pdf"], {"pdf": True}),
    Row("--seed", ["--seed", "7"], {"seed": 7}),
    Row("--finder", ["--finder", "ckf"], {"finder": "ckf"}),
    Row("--threads", ["--threads", "1"], {"threads": 1}),
    Row("--field", ["--field", "finite-solenoid"], {"field": "finite-solenoid"}),
    Row("--settings", ["--settings", "mine.toml"], {"settings": OF_FILE}),
    Row("--set", ["--set", "fit.loss=mean"], with_settings(fit=FitSettings(loss="mean"))),
    Row("--readout", ["--readout", "gaussian"], {"readout": GaussianReadout()}),
    Row("--set", ["--set", "readout.threshold=5 fC"], {"readout": BinaryReadout(threshold=5)}),
    Row(
        "--readout",
        ["--readout", "gaussian", "--set", "readout.sigma_x=0.2 mm"],
        {"readout": GaussianReadout(sigma_x=0.2)},
    ),
    Row("--no-deltas", ["--no-deltas"], with_settings(simulate=SimulateSettings(deltas=False))),
]


@pytest.mark.parametrize("row", STUDY_ROWS, ids=name)
def test_options_of_study(row: Row, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[dict[str, Any]] = []

    class Reached(Exception):
        """The study would begin."""

    def begin(output: object, **given: Any) -> None:
        calls.append(given)
        raise Reached

    monkeypatch.setattr("cgemit.study.paper.run.reproduce", begin)
    for words in ([], row.words):
        assert main(["study", *words]) == 3
    shown = {"progress", "command"}
    usual, changed = ({key: value for key, value in call.items() if key not in shown} for call in calls)
    assert changed == usual | row.same != usual


@pytest.mark.parametrize(
    ("command", "rows"),
    [("simulate", SIMULATE_ROWS), ("resolution", RESOLUTION_ROWS), ("study", STUDY_ROWS), ("display", DISPLAY_ROWS)],
)
def test_every_option_is_tried(command: str, rows: list[Row]) -> None:
    tried = {row.option for row in rows} | SHOWN
    elsewhere = {"--fit", "--particles", "--charges", "--sample"}
    tried |= {"display": {"--html", "--sample"}, "simulate": elsewhere}.get(command, set())
    assert options_of(command) - tried == set()


def test_a_run_is_repeated_from_its_record(tmp_path: Path) -> None:
    words = command_line(["simulate"], SIMULATE, Row("", ["--quiet"]))
    assert main([*words, "--settings", "mine.toml", "--no-deltas", "-o", "first"]) == 0
    assert main([*words, "--settings", "first/run.json", "-o", "again"]) == 0
    assert Result.load("first") == Result.load("again") != simulated()


@pytest.mark.parametrize(
    ("words", "messages"),
    [
        (["--set", "fit.loss=meen"], ['fit.loss: got \'meen\', expected one of', 'did you mean "mean"?']),
        (["--set", "fitt.loss=mean"],
         ["a setting, which begins with simulate, digitize, background, cluster",
          "a value of the detector, which begins with"]),
        (["--set", "fit=3"], ["got 'fit=3', expected KEY=VALUE such as fit.loss=mean or cgem.L2.pitch_x"]),
        (["--set", "fit.loss"], ["expected KEY=VALUE"]),
        (["--no-deltas", "--set", "simulate.deltas=true"], ["--no-deltas: got False, but True from --set"]),
        (["--hypothesis", "mu", "--set", "fit.hypothesis=pi"], ["--hypothesis: got ['mu'], but 'pi' from --set"]),
        (["--name", "a", "--set", "name=b"], ["--name: got 'a', but 'b' from --set name"]),
        (["--settings", "none.toml"], ["none.toml: got", "expected a TOML file"]),
        (["--settings", "wrong.toml", "--set", "fit.los=1", "--set", "x=1", "--set", "cgem.L2.pitch=1",
          "--hypothesis", "d"],
         ["wrong.toml: digitize.reveal_sides: got -1", "--set: fit.los: got an unknown key", "--set: got 'x'",
          "cgem.L2.pitch: got an unknown key", "--hypothesis: fit.hypothesis[0]: got 'd'"]),
    ],
)  # fmt: skip
def test_mistakes_are_all_listed(
    words: list[str], messages: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "wrong.toml").write_text("[digitize]\nreveal_sides = -1\n", encoding="utf-8")
    assert main([*command_line(["simulate"], SIMULATE, Row("", words)), "-o", "never"]) == 2
    text = capsys.readouterr().err
    assert [message for message in messages if message not in text] == []
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize("command", ["simulate -n 1", "resolution", "find -n 1", "display"])
def test_mistakes_of_detector_settings_and_gun_are_listed_together(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = ["-d", "besiii-cgam", "--set", "fit.los=1", "--p", "0", "--cos-theta", "2"]
    assert main([*command.split(), *wrong, "-o", "never"]) == 2
    text = capsys.readouterr().err
    messages = ["fit.los: got an unknown key", 'got "besiii-cgam"', "p: got 0.0", "cos_theta: got 2.0"]
    assert [message for message in messages if message not in text] == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["study", "--set", "field.bz=1 T"], "expected a setting, which begins with"),
        (["show", DESIGN, "--set", "fit.loss=mean"], "expected a value of the detector, which begins with"),
        (["settings", "--set", "name=x"], "expected a setting, which begins with"),
        (["study", "--set", "fit.hypothesis=all"], "this command expects one of them"),
    ],
)
def test_commands_without_a_detector_or_settings_say_so(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    assert message in capsys.readouterr().err


def test_equal_values_are_no_contradiction() -> None:
    words = ["--no-deltas", "--set", "simulate.deltas=false", "--hypothesis", "mu", "--set", "fit.hypothesis=mu"]
    assert main([*command_line(["simulate"], SIMULATE, Row("", words)), "--quiet", "-o", "out"]) == 0


def test_the_first_word_tells_settings_and_detector_apart() -> None:
    assert set(options.stages()) & set(TOP_LEVEL) == {"background"}  # whose levels in the detector have labels


def printed(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Return what a command prints."""
    assert main(words) == 0
    return capsys.readouterr().out


def test_settings_are_printed_as_a_file(settings_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert Settings.from_dict(tomllib.loads(printed(["settings"], capsys))) == Settings()
    words = ["settings", "--settings", str(settings_file), "--set", "fit.states=[90, 'hits']"]
    expected = replace(OF_FILE, fit=FitSettings(kinks=False, states=(90, "hits")))
    assert Settings.from_dict(tomllib.loads(printed(words, capsys))) == expected
    assert "loss = \"truncated\"  # one of 'truncated', 'mean', 'most_probable'" in printed(["settings"], capsys)
    with pytest.raises(SettingsError):
        Settings.from_dict(tomllib.loads("fit = 3"))


def closed(words: list[str], stream: str, folder: Path) -> int:
    """Run a command whose reader has gone before the first line, and return its exit code."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    read, write = os.pipe()
    os.close(read)
    streams: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL} | {stream: write}
    try:
        return subprocess.run(
            [sys.executable, "-u", "-m", "cgemit", *words], cwd=folder, env=environment, check=False, **streams
        ).returncode
    finally:
        os.close(write)


@pytest.mark.slow
@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_closed_pipe_leaves_no_files_out(stream: str, tmp_path: Path) -> None:
    if stream == "stdout":  # where `show` prints
        assert closed(["show", DESIGN, "-o", "pictures"], stream, tmp_path) == 0
        pictures = {f"{picture}.{end}" for picture in ("r-phi", "r-z", "layers") for end in ("png", "pdf")}
        assert pictures < {path.name for path in (tmp_path / "pictures").iterdir()}
    words = command_line(["simulate"], SIMULATE, Row("", []))
    assert closed([*words, "-o", "run"], stream, tmp_path) == 0
    assert Result.load(tmp_path / "run") == simulated()


def test_a_closed_pipe_hides_no_failure(tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("nonsense = 1\n", encoding="utf-8")
    assert closed(["validate", DESIGN, "bad.toml"], "stdout", tmp_path) == 2
    assert closed(["validate", "bad.toml"], "stderr", tmp_path) == 2


def test_no_fitted_track_is_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    slow = ["resolution", "-d", "besiii-idc", "-d", DESIGN, "--p", "0.02", "--events", "20", "--quiet", "-o", "out"]
    assert main(slow) == 3
    text = capsys.readouterr().err
    assert "besiii-idc: at 0.02 GeV/c: 0 of 20 tracks fitted" in text
    assert f"{DESIGN}: at 0.02 GeV/c: 0 of 20 tracks fitted" in text
    assert not (tmp_path / "out").exists()
