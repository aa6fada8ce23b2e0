"""The page of a run: every number against the tables, pictures against the numbers, and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest

import cgemit as cg
from cgemit.cli.main import main
from cgemit.detector import compiled

N = 80


@pytest.fixture(scope="module")
def run():
    settings = cg.Settings(
        background=cg.BackgroundSettings(level="run91668"), simulate=cg.SimulateSettings(decays=False)
    )
    gun = cg.Gun("mu-", p=(0.5, 1.5), cos_theta=(-0.7, 0.7))
    return cg.run("besiii-cgem", gun, n=N, seed=21, readout="tiger", settings=settings, finder="ckf")


@pytest.fixture(scope="module")
def page(run):
    return cg.study.monitor(run)


def test_numbers_are_those_of_the_tables(run, page):
    counts = page.counts
    assert counts["events"] == N
    assert counts["strips"] == len(run.digis)
    assert [counts[f"clusters_{name}"] for name in ("x", "v", "xv")] == np.bincount(run.clusters["view"]).tolist()
    assert counts["tracks"] == np.count_nonzero(run.tracks["status"] == 0)
    status = np.where(np.arange(len(run.tracks)) < 3, cg.FitStatus.large_chi2, run.fitted["status"])
    tables = {**run.tables, "tracks": run.fitted.with_columns(status=status)}
    large = cg.study.monitor(replace(run, tables=tables)).counts
    assert large == counts | {"tracks_with_large_chi2": 3}
    assert counts["tracks_with_clusters"] == np.count_nonzero(run.tracks["n_clusters"] > 0)
    assert sum(one["fired"] for one in page.strips) == len(run.digis)
    row = next(one for one in page.strips if (one["layer"], one["view"]) == ("L1", "V"))
    mine = run.digis[(run.digis["layer"] == 0) & (run.digis["view"] == 1)]
    assert row["fired"] == len(mine)
    assert row["per_event"] == pytest.approx(len(mine) / N)
    assert row["negative"] == np.count_nonzero(mine["charge"] < 0) > 0
    assert row["saturated"] == np.count_nonzero(mine["charge"] >= 0.95 * 48.0) > 0
    assert row["channels"] == run.detector.cgem[0].strips_v
    assert len(page.residuals) == len(cg.study.hit_residuals(run))
    text = repr(page)
    for words in ("strips", "efficiency of layers", "Lorentz angles of drift gaps", f"events: {N}"):
        assert words in text


def test_hot_strips_are_listed(run, page):
    """The preset's hot strips of L1: each with its place, which the digis have, too."""
    status = cg.study.strip_status(run.detector, run.digis)
    assert [one["gid"] for one in page.channels] == np.flatnonzero(status).tolist()
    assert len(page.channels) > 0
    for one in page.channels:
        mine = run.digis[run.digis["gid"] == one["gid"]]
        assert {"layer": one["layer"][1:], "sheet": one["sheet"], "strip": one["strip"]} == {
            "layer": str(mine["layer"][0] + 1), "sheet": mine["sheet"][0], "strip": mine["strip"][0]
        }  # fmt: skip
        assert one["fired"] == len(np.unique(mine["event"]))
    assert "hot and dead strips" in repr(page)


def test_times_begin_with_the_first_electrons(run, page):
    """Strips of particles arrive within the drift time, those of noise anywhere in 990 ns."""
    true = run.digis["truth"] >= 0
    inside = (page.arrival > -50) & (page.arrival < page.longest + 50)
    assert inside[true].mean() > 0.97
    assert 0.1 < inside[~true].mean() < 0.45
    gap = compiled(run.detector) is not None and run.detector.cgem[0]
    assert page.longest.max() == pytest.approx((gap.r_gap_out - gap.r_gap_in) / 0.0344, rel=0.02)


def test_pictures_show_the_numbers(run, page):
    pictures = {name: picture for name, _, picture in page.pictures()}
    assert list(pictures) == ["strips", "signals", "residuals", "profiles", "efficiencies", "maps", "tracks"]
    for picture in pictures.values():
        for axes in picture.axes:
            assert axes.get_xlabel() or axes.get_title() or axes.get_ylabel(), "no label"
    boxes = [text.get_text() for axes in pictures["strips"].axes for text in axes.texts]
    assert [int(text.split()[0]) for text in boxes] == [one["fired"] for one in page.strips]
    hits = page.residuals
    first = pictures["residuals"].axes[0]
    mine = hits.select((hits.view == 0) & (hits.layer == 0))
    bars = sum(patch.get_xy()[:, 1].max() > 0 for patch in first.patches)
    assert bars == 1
    assert f"hits {len(mine)}, far {np.count_nonzero(~mine.counts)}" in first.texts[0].get_text()
    rms = 1e3 * mine.residual[mine.counts].std(ddof=1)
    assert f"RMS {rms:.0f} µm" in first.texts[0].get_text()
    shown = pictures["efficiencies"].axes[0].containers[0].lines[0].get_ydata()
    np.testing.assert_allclose(shown, 100 * page.efficiencies.x)
    bars = pictures["efficiencies"].axes[0].containers[0].lines[2][0].get_segments()
    ends = 100 * np.stack([page.efficiencies.x_low, page.efficiencies.x_high], axis=1)
    np.testing.assert_allclose([bar[:, 1] for bar in bars], ends)
    assert np.max([bar[:, 1] for bar in bars]) <= 100
    of_maps = pictures["maps"].axes
    first, own = of_maps[0].collections[0].get_array().compressed(), page.crossings.select(page.crossings.layer == 0)
    counts = np.histogram2d(own.phi, own.z, (12, 8), [(-np.pi, np.pi), (-np.abs(own.z).max(), np.abs(own.z).max())])[0]
    assert 0 < len(first) <= np.count_nonzero(counts) + 2
    assert first.max() <= 100
    assert of_maps[0].get_title().endswith(f", {len(own)} tracks")


def test_command_on_a_stored_run(run, page, tmp_path, capsys):
    run.save(tmp_path / "run")
    assert main(["monitor", str(tmp_path / "run"), "-o", str(tmp_path / "page")]) == 0
    assert f"tracks: {page.counts['tracks']}" in capsys.readouterr().out
    found = json.loads((tmp_path / "page" / "monitor.json").read_text())
    assert found["counts"] == page.counts
    assert found["strips"] == page.strips
    both = [row["both"] for row in found["efficiencies"]]
    np.testing.assert_allclose(both, page.efficiencies.both)
    text = (tmp_path / "page" / "index.html").read_text()
    for name, _, _ in page.pictures():
        assert f'src="{name}.png"' in text
        assert (tmp_path / "page" / f"{name}.png").stat().st_size > 10_000
    assert main(["monitor", str(tmp_path / "run"), "-o", str(tmp_path / "page")]) == 2
    capsys.readouterr()
    assert main(["monitor", str(tmp_path / "run"), "--readout", "apv25", "-o", str(tmp_path / "no")]) == 2
    assert "--readout: got the folder of a run, which has its own" in capsys.readouterr().err
    assert main(["monitor", str(tmp_path / "none.raw"), "-o", str(tmp_path / "no")]) == 2
    assert "--detector: got none for none.raw" in capsys.readouterr().err
    assert main(["monitor", str(tmp_path / "none.raw"), "-d", "besiii-cgem", "-o", str(tmp_path / "no")]) == 2


def test_readout_without_times():
    run = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), n=10)
    page = cg.study.monitor(run)
    assert page.angles is None
    assert "lorentz_angles" not in page.to_dict()
    assert np.isnan(page.arrival).all()
    assert len(list(page.pictures())) == 7


def test_a_strip_that_fires_twice_in_an_event_counts_once(run):
    """As three of the 815 strips of run 91668."""
    twice = run.digis[np.repeat(np.arange(len(run.digis)), 2)]
    heights = []
    for digis in (run.digis, twice):
        picture = cg.draw.draw_strips(run.detector, digis)
        heights.append(np.array(picture.axes[1].collections[0].get_segments())[:, 1, 1])
    assert heights[0].max() <= 100
    np.testing.assert_array_equal(*heights)


def test_strips_out_of_time_are_those_that_make_no_cluster_alone(run, page):
    """Each strip in an event of its own; the chip's delays are those of tracks here, of one point there (1 ns)."""
    n = len(run.digis)
    alone = cg.Table("digis", {**run.digis.columns, "event": np.arange(n)}, n_events=n)
    clusters = cg.cluster(run.detector, alone)
    outside = n - np.count_nonzero(clusters["view"] < 2)
    assert abs(page.counts["strips_outside_of_drift_time"] - outside) < 5
    assert outside > 0.2 * n
