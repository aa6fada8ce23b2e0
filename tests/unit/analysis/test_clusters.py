"""Fractions of crossings with delta electrons, windows of the X residual, pictures of the tails."""

import dataclasses
import json

import numpy as np
import pytest

import cgemit
import gem_toy
from cgemit.analysis.clusters import (
    X_WINDOW,
    X_WINDOWS,
    ClusterResiduals,
    geant4_runs,
    v_fit,
    v_spectrum,
    x_beyond,
    x_spectrum,
    x_widths,
)
from cgemit.cli.main import main
from cgemit.study import delta_displacements, delta_fractions, reproduce
from cgemit.study.paper import report
from cgemit.tables import Table
from cgemit.tables.show import shown, with_error
from stats import assert_within, fraction_error


def residuals_with_tails(n=200_000, seed=3):
    """A core of 139 um with one in 200 clusters moved by up to 6 mm."""
    rng = np.random.default_rng(seed)
    x = rng.normal(0, 0.139, n) + (rng.random(n) < 0.005) * rng.uniform(-6, 6, n)
    return ClusterResiduals(x, np.ones(n, "i4"), x, np.ones(n, "i4"), 0, 0)


def steps_beside(truths, rows, rphi, z, length=0.0):
    """Steps at given distances from the tracks, at mid-gap, along the circumference."""
    link = np.asarray(rows)
    r = truths["r"][link]
    phi = truths["phi"][link] + np.asarray(rphi) / r
    along = np.column_stack([-np.sin(phi), np.cos(phi), 0 * phi]) * length
    middle = np.column_stack([r * np.cos(phi), r * np.sin(phi), truths["z"][link] + np.asarray(z)])
    return gem_toy.step_columns(truths, link, middle, along)


def test_displacements_are_those_of_hand_made_deposits():
    """Largest of several deposits of a crossing, with the ends of a step; zero where there is none."""
    truths = gem_toy.muons_through(gem_toy.design_layers(), 4, seed=2)
    steps = steps_beside(truths, [0, 0, 3, 7], [0.3, -1.5, 0.1, 4.0], [2.0, 0.0, -0.4, 9.0], length=0.2)
    rphi, z = delta_displacements(Table("truths", truths, 4), Table("steps", steps, 4))
    expected = np.zeros((2, 12))
    expected[0, [0, 3, 7]], expected[1, [0, 3, 7]] = (1.6, 0.2, 4.1), (2.0, 0.4, 9.0)
    # Mid-gap lies some um beside the chord.
    np.testing.assert_allclose((rphi, z), expected, atol=5e-3)
    own = steps | {"parent": np.zeros(4, "i1")}
    assert not np.any(delta_displacements(Table("truths", truths, 4), Table("steps", own, 4)))


def test_displacement_follows_an_inclined_track():
    """A deposit on the track itself, near the exit, is not displaced."""
    truths = gem_toy.muons_through(gem_toy.design_layers(), 50, seed=4, p=0.3)
    ends = [np.column_stack([truths[f"{end}_{axis}"] for axis in "xyz"]) for end in ("entry", "exit")]
    steps = gem_toy.step_columns(truths, np.arange(150), 0.1 * ends[0] + 0.9 * ends[1], np.zeros((150, 3)))
    rphi, z = delta_displacements(Table("truths", truths, 50), Table("steps", steps, 50))
    assert rphi.max() < 0.01
    assert z.max() < 0.01


def test_fractions_count_crossings():
    """Every tenth crossing of a result gets a deposit 1.5 mm beside it in r-phi and 0.3 mm in z."""
    result = cgemit.run("besiii-cgem-design", cgemit.Gun("mu-", p=1.0, cos_theta=0.2), 100, 1)
    rows = np.arange(0, 300, 10)
    steps = steps_beside(result.truths, rows, np.full(30, 1.5), np.full(30, 0.3))
    result = dataclasses.replace(result, tables={**result.tables, "steps": Table("steps", steps, 100)})
    found = delta_fractions(result)
    assert found.rphi == (0.1, 0.1, 0.1, 0.0, 0.0)
    assert found.z == (0.1, 0.0, 0.0, 0.0, 0.0)
    assert found.crossings == 300
    np.testing.assert_allclose(found.rphi_error[0], fraction_error(0.1, 300), rtol=0.01)
    assert found.z_error[4] > 0
    assert delta_fractions(result, [1.4, 1.6]).rphi == (0.1, 0.0)
    assert "beyond [mm]" in repr(found)
    assert "<table>" in found._repr_html_()
    empty = delta_fractions(cgemit.run("besiii-idc", cgemit.Gun("mu-", p=1.0, cos_theta=0.2), 2, 1))
    assert np.isnan(empty.rphi).all()


def test_rms_grows_with_the_window_as_the_tail_says():
    """Core and a uniform tail: variances and the fraction beyond add up as worked by hand."""
    residuals = residuals_with_tails()
    for window in (1.0, 2.0, 3.0, 5.0):
        share = 0.005 * window / 6
        expected = np.sqrt(((1 - 0.005) * 0.139**2 + share * window**2 / 3) / (1 - 0.005 + share))
        widths = x_widths(residuals, window)
        assert_within(widths.rms, 1e3 * expected, widths.rms_error, what=f"{window} mm")
    rms = [x_widths(residuals, window).rms for window in X_WINDOWS.values()]
    assert rms == sorted(rms)
    assert rms[-1] > 1.9 * 139
    assert x_widths(residuals).rms == rms[2]
    beyond, error = x_beyond(residuals)
    assert_within(beyond, 0.0025, error)
    with pytest.raises(AssertionError):
        assert_within(beyond, 0.005, error)


def test_core_does_not_follow_the_tails():
    """The fitted core stays at 139 um, and the fit of V leaves out what is beyond a pitch."""
    residuals = residuals_with_tails()
    widths = x_widths(residuals)
    assert_within(widths.core, 139, np.hypot(widths.core_error, 0.5))
    assert v_fit(residuals).sigma < 150 < widths.rms


def test_pictures_of_the_tails_mark_the_windows():
    """Statistics say which window the RMS is of and how many are outside."""
    residuals = residuals_with_tails(20_000)
    lines = x_spectrum(residuals).statistics()
    outside = np.count_nonzero(np.abs(residuals.x) > X_WINDOW)
    assert f"beyond 3 mm: {outside}" in lines
    assert any(line.startswith("RMS (3 mm): ") for line in lines)
    assert any("beyond 650 µm" in line for line in v_spectrum(residuals).statistics())
    assert x_spectrum(residuals, 8000, 160).counts["all"].sum() == 20_000


def test_geant4_rows_match_the_windows():
    """One RMS for each window and run, growing with the window; without deltas it does not."""
    runs = geant4_runs()
    for run in runs:
        rms = [float(text.split("–")[0]) for text in run.rms]
        assert len(rms) == len(X_WINDOWS)
        assert rms == sorted(rms)
    assert len(set(runs[-1].rms)) == 1


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(("options", "deltas"), [([], True), (["--no-deltas"], False)])
def test_switch_of_the_shell(options, deltas, tmp_path, monkeypatch):
    """All commands that simulate know it, and nothing but the simulation changes."""
    design = ["-d", "besiii-cgem-design", "--p", "1", "--quiet"]
    for command in (["simulate", *design, "--cos-theta", "0", "-n", "3"], ["resolution", *design, "--events", "20"]):
        assert main([*command, "-o", str(tmp_path / command[0]), *options]) == 0
        summary = json.loads((tmp_path / command[0] / "summary.json").read_text())
        assert summary.get("inputs", summary)["settings"]["simulate"]["deltas"] is deltas
    given = []
    monkeypatch.setattr("cgemit.study.paper.run.reproduce", lambda *_, settings, **__: given.append(settings))
    main(["study", "-o", str(tmp_path / "out"), "--quiet", *options])
    assert given[0] == cgemit.Settings(simulate=cgemit.SimulateSettings(deltas=deltas))


def test_study_without_delta_electrons_says_so(tmp_path, monkeypatch):
    """Their fractions vanish, every window has the same RMS, and the report tells how to repeat it."""
    settings = cgemit.Settings(simulate=cgemit.SimulateSettings(deltas=False))
    study = reproduce(events=400, settings=settings)
    assert study.summary()["inputs"]["settings"]["simulate"]["deltas"] is False
    assert all(row.value == 0 for row in study.results if row.id.startswith("delta_fraction"))
    assert study["x_residual_rms_all"].value == study["x_residual_rms"].value < 188
    monkeypatch.setattr(report, "_image", lambda *_: "")  # they take seconds to draw
    page = report.paper_report(study, tmp_path)
    # The verdict stands before the contents, with each of the paper's numbers on the right side.
    verdict = page[: page.index("Contents")]
    near, far = verdict[verdict.index("Within 5 %") :].split("Farther away")
    given = [row for row in study.results if row.paper is not None]
    assert len(given) == 5
    for row in given:
        text = f"{with_error(row.value, row.error)} {shown(row.unit)} ({row.paper:g}, "
        is_near = abs(row.value - row.paper) <= 0.05 * row.paper + row.error
        assert (text in near, text in far) == (is_near, not is_near), text
    assert f"{100 * (study['sigma_p'].value / 5.5 - 1):+.0f} %".replace("-", "−") in far
    for text in ("--no-deltas", "Delta electrons were left out", "187.6 µm"):
        assert text in page, text
    other = cgemit.Settings(fit=cgemit.FitSettings(kinks=False))
    changed = dataclasses.replace(study, inputs=dataclasses.replace(study.inputs, settings=other))
    assert "--seed 1 --settings run.json -o DIR" in report.paper_report(changed, tmp_path)
