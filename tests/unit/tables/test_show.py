"""What people see of results: data frames, tables of widths, completed keys, progress, completion in the shell."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit import study
from cgemit.analysis.quantities import QUANTITIES

DESIGN = "besiii-cgem-design"


@pytest.fixture(scope="module")
def result() -> cg.Result:
    return cg.run(DESIGN, cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), 120, 1)


def objects(result: cg.Result) -> dict[str, Any]:
    return {
        "resolution": cg.resolution(result, "dr", window=(-500, 500)),
        "resolutions": study.resolutions(result),
        "pulls": study.pulls(result),
        "curve": study.resolution_against(result, "dz", "cos_theta", 4),
        "flatness": study.chi2_flatness(result),
        "gaussian": study.gaussian_fit(result.tracks["pull_dr"]),
        "deltas": study.delta_fractions(result),
        "form": study.fit_form("dr", [0.2, 0.5, 1.0], [400, 250, 200], [4, 3, 2]),
        "scan": study.scan(DESIGN, [1.0], events=40),
        "lines": study.scan_analytic(DESIGN, [1.0]),
        "covariance": cg.analytic(DESIGN, p=[0.5, 1.0]),
        "budget": cg.analytic(DESIGN, p=[0.5]).budget("dr"),
        "sensitivity": cg.sensitivity(DESIGN, p=1.0),
        "slab": cg.slab("Kapton 300 um", "pi-", p=0.5, n=1000),
    }


def test_every_result_becomes_a_data_frame_of_its_own_numbers(result: cg.Result) -> None:
    made = objects(result)
    frames = {name: one.to_pandas() for name, one in made.items()}
    assert all(len(frame) for frame in frames.values())
    one = made["resolution"]
    for name in ("core", "core_error", "q68", "rms_error", "mean", "outside", "tail", "n"):
        assert frames["resolution"][name][0] == getattr(one, name)
    assert frames["resolution"][["window_low", "window_high"]].to_numpy().tolist() == [[-500, 500]]
    for kind, names in (("resolutions", list(QUANTITIES)), ("pulls", ["dr", "phi0", "kappa", "dz", "tanl", "p"])):
        assert frames[kind]["parameter"].tolist() == names
        assert frames[kind]["core"].tolist() == [width.core for width in made[kind]]
    assert frames["curve"]["core"].tolist() == made["curve"].column("core").tolist()
    assert frames["curve"]["cos_theta_low"].tolist() == list(made["curve"].edges[:-1])
    assert frames["deltas"]["rphi"].tolist() == list(made["deltas"].rphi)
    assert frames["form"]["a"][0] == made["form"].a
    assert frames["gaussian"]["sigma"][0] == made["gaussian"].sigma
    assert frames["flatness"]["chi2"][0] == made["flatness"].chi2
    np.testing.assert_array_equal(frames["slab"]["loss"], made["slab"].loss)
    tables = result.to_pandas()
    assert list(tables) == list(result.tables)
    assert tables["tracks"]["res_dr"].tolist() == result.tracks["res_dr"].tolist()


def test_without_pandas_the_message_names_the_extra(result: cg.Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pip install 'cgemit\[io\]'"):
        cg.resolution(result, "p").to_pandas()


def test_resolutions_are_one_table_by_name(result: cg.Result) -> None:
    found = study.resolutions(result)
    assert found["dz"] == cg.resolution(result, "dz")
    assert len(found) == len(QUANTITIES)
    lines = repr(found).splitlines()
    assert lines[1].split()[:2] == ["quantity", "core"]
    assert [line.split()[0] for line in lines[2:]] == list(QUANTITIES)
    assert found._repr_html_().count("<tr>") == 1 + len(QUANTITIES)
    with pytest.raises(ValueError, match=r"got 'dzz'; expected one of .*did you mean \"dz\""):
        found["dzz"]


def test_keys_are_completed(result: cg.Result) -> None:
    for one in (study.resolutions(result), study.pulls(result), result.tracks, objects(result)["scan"].to_pandas()):
        keys = one._ipython_key_completions_() if hasattr(one, "_ipython_key_completions_") else list(one)
        assert keys
        for key in keys:
            one[key]
    swept = study.sweep(DESIGN, {"cgem.L1.pitch_x": ["600 um"]}, evaluate=study.Evaluation(p=[1.0]))
    assert "sigma_dr (um)" in swept._ipython_key_completions_()


def test_the_progress_bar_follows_the_work(capsys: pytest.CaptureFixture[str]) -> None:
    cg.run(DESIGN, cg.Gun("mu-", p=1.0, theta=1.2), 40, progress=cg.ProgressBar("muons"), workers=cg.Workers(chunk=10))
    text = capsys.readouterr().err
    assert "muons: 100%" in text
    study.scan(DESIGN, [0.5, 1.0], events=20, progress=cg.ProgressBar())
    assert f"{DESIGN}, mu-, 1 GeV/c: 100%" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("cgemit res", ["resolution"]),
        ("cgemit resolution --meth", ["--method"]),
        ("cgemit resolution --method a", ["analytic"]),
        ("cgemit show besiii-cg", ["besiii-cgem", "besiii-cgem-design"]),
        ("cgemit simulate -d besiii-idc-", ["besiii-idc-boss"]),
    ],
)
def test_the_shell_completes(line: str, found: list[str], tmp_path: Path) -> None:
    answer = tmp_path / "answer"
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n"}
    asked |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "_ARGCOMPLETE_SUPPRESS_SPACE": "1"}
    subprocess.run([sys.executable, "-m", "cgemit"], env=os.environ | asked, cwd=tmp_path, timeout=60, check=False)
    assert sorted(answer.read_text().split()) == found
