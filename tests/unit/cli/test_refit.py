"""`cgemit refit`: numbers, table and picture beside the experiment's tracks."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest

import bes3_layout
import cgemit as cg
from cgemit import helix
from cgemit.bes3 import events as bes3_events
from cgemit.bes3.refit import Refit, displacement, refit
from cgemit.cli.main import main
from cgemit.draw import draw_refit

pytestmark = pytest.mark.usefixtures("undrawn")

NAMES = (*helix.PARAMETERS, "p")


@pytest.fixture(scope="module")
def run():
    return cg.run("besiii-cgem-design", cg.Gun("pi-", p=(0.3, 1.0), cos_theta=(-0.8, 0.8)), n=25, seed=5)


@pytest.fixture(scope="module")
def found(run):
    return refit(
        bes3_layout.tables_of(bes3_layout.events_of(run), run.detector), "kal", cg.FitSettings(hypothesis="pi")
    )


def moved(found: Refit, name: str, errors: np.ndarray) -> Refit:
    """Return the same with one parameter of ours moved by some errors of theirs."""
    columns = dict(found.columns)
    diff = errors * columns[f"boss_err_{name}"]
    columns |= {f"diff_{name}": diff, f"pull_{name}": errors, name: columns[f"boss_{name}"] + diff}
    return Refit(found.kind, found.detector, found.ours, found.boss, columns)


def test_summary(found):
    errors = np.linspace(-1, 3, len(found.ours))
    row = moved(found, "dz", errors).summary()["dz"]
    assert row["pull"] == pytest.approx(1.0)
    assert row["pull_width"] == pytest.approx(4 * 0.6827 / 2)
    assert (row["unit"], row["diff"]) == ("mm", pytest.approx(np.median(errors * found.boss["err_dz"])))
    assert row["error_ratio"] == pytest.approx(np.median(found.ours["err_dz"] / found.boss["err_dz"]))


def test_displacement():
    """The experiment knows that its chamber is displaced, our description does not, and finds it."""
    moved = {"shift_x": "80 um", "shift_y": "0.98 mm", "shift_z": "-0.3 mm", "rotation": "2 mrad"}
    nominal = cg.load("besiii-idc")
    there = nominal.with_overrides({f"drift_chamber.{name}": value for name, value in moved.items()})
    settings = cg.Settings(simulate=cg.SimulateSettings(decays=False))
    gun = cg.Gun("mu-", p=(0.5, 1.5), cos_theta=(-0.8, 0.8))
    arrays = bes3_layout.events_of(cg.run(there, gun, n=40, seed=5, settings=settings))
    muon = cg.FitSettings(hypothesis="mu")
    beside = refit(bes3_layout.tables_of(arrays, nominal), "kal", muon)
    assert np.abs(beside.columns["pull_dr"]).max() > 2
    found = displacement(beside, nominal)
    np.testing.assert_allclose(found.value, [0.08, 0.98, -0.3, 2e-3], atol=0.03)
    assert found.value[3] == pytest.approx(2e-3, abs=1e-4)
    assert (np.abs(found.value - [0.08, 0.98, -0.3, 2e-3]) < 5 * found.error).all()
    again = refit(bes3_layout.tables_of(arrays, nominal.with_overrides(found.overrides)), "kal", muon)
    assert np.abs(again.columns["pull_dr"]).max() < 0.5
    few = Refit(
        beside.kind, beside.detector, beside.ours[:3], beside.boss[:3], {k: v[:3] for k, v in beside.columns.items()}
    )
    with pytest.raises(ValueError, match="got 3 tracks that both have fitted, expected 4 or more"):
        displacement(few, nominal)


def test_failed_tracks_are_left_out(found):
    boss = found.boss.with_columns(status=np.where(np.arange(len(found.boss)) < 5, 5, 0))
    left = Refit(found.kind, found.detector, found.ours, boss, found.columns)
    assert left.good.sum() == found.good.sum() - 5
    assert left.summary()["dr"]["pull"] == pytest.approx(np.median(found.columns["pull_dr"][5:]))
    assert "25 tracks, 20 fitted by both" in repr(left)


def test_picture(found):
    shown = moved(found, "tanl", np.full(len(found.ours), 1.5))
    picture = draw_refit(shown)
    axes = picture.axes
    assert len(axes) == 8
    for plot, name in zip(axes, NAMES, strict=False):
        assert plot.get_title(loc="left").startswith(f"median {shown.summary()[name]['pull']:.2f}")
    low, high = axes[4].get_xlim()
    points = axes[4].patches[0].get_xy()
    inside = (points[:, 0] > 1.2) & (points[:, 0] < 1.8) & (points[:, 1] > 0)
    assert (low, high) == (-4, 4)
    assert points[inside, 1].max() == len(found.ours)  # all tracks in the bin of 1.5
    chi2 = axes[6].lines[1]
    np.testing.assert_allclose(chi2.get_xdata(), shown.boss["chi2"] / shown.boss["ndf"])
    np.testing.assert_allclose(chi2.get_ydata(), shown.ours["chi2"] / shown.ours["ndf"])
    ratios = [shown.summary()[name]["error_ratio"] for name in NAMES]
    np.testing.assert_allclose(axes[7].lines[1].get_ydata(), ratios)


@pytest.fixture
def file(run, monkeypatch, tmp_path):
    """A file that holds the run: only the step from bytes to arrays is left out, which is pybes3's."""
    path = tmp_path / "run.rec"
    path.write_bytes(b"root")
    arrays = bes3_layout.events_of(run)
    monkeypatch.setattr(bes3_events, "read_bes3", lambda _: (bes3_events.columns_of_events(arrays), run.n_events))
    return path


def test_command(file, run, tmp_path, capsys):
    out = tmp_path / "out"
    line = ["refit", str(file), "-d", "besiii-cgem-design", "--hypothesis", "pi", "--quiet"]
    assert main([*line, "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "MdcKalTrack): 25 tracks, 25 fitted by both, with besiii-cgem-design" in printed
    assert "chi2/ndf, median: ours" in printed
    assert "clusters at the positions of the file, with the Lorentz shift of the experiment's software" in printed
    names = {f"{kind}.{end}" for kind in ("kal", "mdc") for end in ("csv", "png", "pdf")}
    assert {path.name for path in out.iterdir()} == names | {"summary.json", ".cgemit"}
    with (out / "kal.csv").open(encoding="ascii") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["boss_dr"]) for row in rows] == pytest.approx(run.tracks["dr"].tolist())
    diff = [float(row["diff_dz"]) for row in rows]
    assert diff == pytest.approx([float(row["dz"]) - float(row["boss_dz"]) for row in rows])
    numbers = json.loads((out / "summary.json").read_text())
    median = numbers["kal"]["dr"]["diff"]  # in um there and where it is printed, as every quoted number
    assert numbers["kal"]["dr"]["unit"] == "um"
    assert median == pytest.approx(1e3 * np.median([float(row["diff_dr"]) for row in rows]))
    assert re.search(rf"dr um +{median:.3g} ", printed)
    assert numbers["clusters"] == "the positions of the file, with the Lorentz shift of the experiment's software"
    assert numbers["kal"]["dz"]["diff"] == pytest.approx(np.median(diff))
    assert numbers["kal"]["fitted"] == numbers["mdc"]["tracks"] == 25
    assert main([*line, "-o", str(out)]) == 2  # the folder holds results


def test_options(file, capsys):
    line = ["refit", str(file), "-d", "besiii-cgem-design", "--tracks", "kal", "--json"]

    def printed(*words):
        assert main([*line, *words]) == 0
        return json.loads(capsys.readouterr().out)

    usual, loose = printed(), printed("--cluster-errors", "1 mm", "1 mm")
    assert set(usual) & {"kal", "mdc"} == {"kal"}
    assert loose["kal"]["dr"]["error_ratio"] > 1.5 * usual["kal"]["dr"]["error_ratio"]
    every = printed("--hypothesis", "all", "--clusters", "all")
    assert every["kal"]["tracks"] == 5 * usual["kal"]["tracks"]
    assert "160 um and 150 um" in capsys_help(capsys)
    assert bes3_events.CLUSTER_ERRORS == (0.16, 0.15)
    assert main([*line, "--cluster-errors", "0", "1 mm"]) == 2


def test_json_counts_the_tracks_that_both_have_fitted(file, monkeypatch, capsys):
    def failing(*how):
        one = refit(*how)
        return replace(one, boss=one.boss.with_columns(status=np.where(np.arange(len(one.boss)) < 5, 5, 0)))

    monkeypatch.setattr("cgemit.bes3.refit.refit", failing)
    assert main(["refit", str(file), "-d", "besiii-cgem-design", "--tracks", "kal", "--json"]) == 0
    about = json.loads(capsys.readouterr().out)["kal"]
    assert (about["tracks"], about["fitted"]) == (25, 20)


def capsys_help(capsys):
    assert main(["refit", "--help"]) == 0
    return " ".join(capsys.readouterr().out.split())
