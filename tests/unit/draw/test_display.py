"""The event display: everything that is drawn is compared with the tables of the event."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import Normalize, to_hex

import cgemit as cg
from cgemit.cli.main import main
from cgemit.detector.layers.cgem import v_of_strips
from cgemit.detector.layers.layer import crossing_z
from cgemit.draw.display import TRACK_COLORS
from cgemit.draw.event import helix_points, smooth_curve, strip_line, view_of, wire_positions
from cgemit.draw.style import COLORS
from cgemit.tables import Table
from cgemit.truth.assign import residuals

# Two particles a few degrees apart, so that X and V strips pair wrongly; and a slow one.
PAIR: dict[str, Any] = {
    "event": [0, 0, 1], "particle": [0, 1, 0], "pdg": [13, -211, -211], "px": [0.6, 0.5, 0.08],
    "py": [0.1, 0.2, 0.03], "pz": [0.2, -0.1, 0.02], "x": [0.0] * 3, "y": [0.0] * 3, "z": [0.0] * 3,
}  # fmt: skip


@pytest.fixture(scope="module")
def result() -> cg.Result:
    return cg.run("besiii-cgem", PAIR, seed=3)


@pytest.fixture(scope="module")
def pair(result: cg.Result) -> Any:
    return cg.draw.event(result, 0)


def lines(axes: Any) -> dict[str, Any]:
    """Return the lines of axes by their label."""
    return {line.get_label(): line for line in axes.lines}


def distance(points: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """Return the distance of points from a curve given by points, (n,)."""
    start, step = curve[:-1], np.diff(curve, axis=0)
    step, start = step[(step != 0).any(1)], start[(step != 0).any(1)]
    t = np.clip(np.sum((points[:, None] - start) * step, -1) / np.sum(step * step, -1), 0, 1)
    return np.linalg.norm(points[:, None] - start - t[..., None] * step, axis=-1).min(axis=1)


def test_points_across_the_beam_are_those_of_the_tables(result: cg.Result, pair: Any) -> None:
    truths = result.truths.select_events(0, 1)
    across = [truths["r"] * np.cos(truths["phi"]), truths["r"] * np.sin(truths["phi"])]
    for axes in pair.axes[:2]:
        np.testing.assert_array_equal(lines(axes)["true crossing"].get_data(), across)
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("x  (mm)", "y  (mm)")
    along = lines(pair.axes[2])
    np.testing.assert_array_equal(along["true crossing"].get_data(), [truths["z"], truths["r"]])
    cells = result.wire_truths.select_events(0, 1)
    np.testing.assert_array_equal(
        along["true crossing of a cell"].get_data(), [cells["z"], np.hypot(cells["x"], cells["y"])]
    )
    assert (pair.axes[2].get_xlabel(), pair.axes[2].get_ylabel()) == ("z  (mm)", "r  (mm)")


def test_ghosts_are_the_pairs_of_different_crossings(result: cg.Result, pair: Any) -> None:
    clusters = result.clusters.select_events(0, 1)
    expected: dict[str, list[tuple[float, float]]] = {"cluster": [], "ghost": []}
    for row in np.flatnonzero(clusters["view"] == 2):
        one, other = (clusters["truth"][clusters[f"{name}_cluster"][row]] for name in "xv")
        kind = "cluster" if one == other else "ghost"
        expected[kind].append((clusters["z"][row], clusters["r"][row]))
    assert len(expected["ghost"]) > 2
    assert len(expected["cluster"]) == 6
    drawn = lines(pair.axes[2])
    ghosts = drawn["ghost: X and V of different crossings"]
    assert list(zip(*ghosts.get_data(), strict=True)) == expected["ghost"]
    assert list(zip(*drawn["cluster"].get_data(), strict=True)) == expected["cluster"]
    assert ghosts.get_color() != drawn["cluster"].get_color()


def test_drift_circles_have_the_drift_distance_as_radius_and_touch_the_track(result: cg.Result, pair: Any) -> None:
    hits = result.wire_hits.select_events(0, 1)
    circles = next(one for one in pair.axes[0].collections if isinstance(one, EllipseCollection))
    np.testing.assert_allclose(circles.get_widths(), 2 * np.abs(hits["drift"]))
    np.testing.assert_array_equal(circles.get_widths(), circles.get_heights())
    layers = {layer.number: layer for layer in result.detector.drift_chamber.layers}
    z = result.wire_truths["z"][hits["wire_truth"]]
    where = [
        wire_positions(layers[n], np.array([w]), zi) for n, w, zi in zip(hits["layer"], hits["wire"], z, strict=True)
    ]
    np.testing.assert_allclose(circles.get_offsets(), np.reshape(where, (-1, 2)), atol=0.2)  # z of the track, not true
    curves = [path.points[:, :2] for path in view_of(result, 0).paths]
    away = np.min([np.abs(distance(circles.get_offsets(), curve) - np.abs(hits["drift"])) for curve in curves], axis=0)
    assert np.quantile(away, 0.9) < 0.5


def test_tracks_are_drawn_in_colours_of_their_own(result: cg.Result, pair: Any) -> None:
    drawn = [line for line in pair.axes[0].lines if line.get_label().startswith("fitted track")]
    momenta = [f"fitted track, p = {p:.3f} GeV/c" for p in result.tracks["p"][:2]]
    assert [line.get_label() for line in drawn] == momenta
    assert [line.get_color() for line in drawn] == list(TRACK_COLORS[:2])
    assert not set(TRACK_COLORS) & {COLORS[name] for name in ("idc", "cgem", "truth", "x", "v")}
    for line, path in zip(drawn, view_of(result, 0).paths, strict=True):
        np.testing.assert_array_equal(line.get_data(), path.points[:, :2].T)


def test_a_track_with_a_large_chi_square_says_so(result: cg.Result) -> None:
    status = result.fitted["status"].copy()
    status[1] = cg.FitStatus.large_chi2
    tables = {**result.tables, "tracks": result.fitted.with_columns(status=status)}
    picture = cg.draw.event(replace(result, tables=tables), 0)
    labels = [line.get_label() for line in picture.axes[0].lines if line.get_label().startswith("fitted track")]
    assert [label.endswith(", large chi-square") for label in labels] == [False, True]


def test_a_slow_track_meets_its_hits_where_its_helix_misses_them(result: cg.Result) -> None:
    view = view_of(result, 1)
    (path,) = view.paths
    crossed = np.stack([view.wire_truths[axis] for axis in "xy"], axis=1)[: int(view.tracks["n_wires"][0])]
    helix = np.array([view.tracks[name][0] for name in ("dr", "phi0", "kappa", "dz", "tanl")])
    unslowed = np.stack(helix_points(helix, result.detector.field.bz, 900, 2000), axis=1)
    assert np.quantile(distance(crossed, path.points[:, :2]), 0.9) < 0.5  # mm, the fit's own errors
    assert np.max(distance(crossed, unslowed[:, :2])) > 5


def test_a_smooth_curve_through_points_of_a_helix_is_the_helix() -> None:
    turn = np.linspace(0, 2.5, 6)
    points = np.stack([300 * np.cos(turn), 300 * np.sin(turn), 50 * turn], axis=1)
    directions = np.stack([-300 * np.sin(turn), 300 * np.cos(turn), np.full(6, 50)], axis=1)
    curve = smooth_curve(points, directions)
    np.testing.assert_allclose(np.hypot(curve[:, 0], curve[:, 1]), 300, atol=0.1)
    np.testing.assert_array_equal(curve[::12], points)
    assert np.max(np.abs(np.hypot(*smooth_curve(points, np.roll(directions, 1, 1))[:, :2].T) - 300)) > 5


def test_strips_on_the_unrolled_anode_are_the_fired_ones(result: cg.Result, pair: Any) -> None:
    digis = result.digis.select_events(0, 1)
    for number, axes in enumerate(pair.axes[3:6]):
        layer = result.detector.cgem[number]
        drawn = {one.get_label(): one for one in axes.collections if isinstance(one, LineCollection)}
        fired = (digis["layer"] == number) & (digis["view"] == 0)
        phi = (
            np.array(layer.sheet_phi)[digis["sheet"][fired]]
            + (digis["strip"][fired] + 0.5) * layer.pitch_x / layer.r_readout
        )
        x = [line[:, 0].tolist() for line in drawn["fired X strips (width: charge)"].get_segments()]
        expected = (np.degrees(phi) + 180) % 360 - 180
        np.testing.assert_allclose(x, np.stack([expected, expected], 1), rtol=0, atol=1e-9)
        widths = drawn["fired X strips (width: charge)"].get_linewidths()
        share = digis["charge"][fired] / digis["charge"].max()
        np.testing.assert_allclose(widths, 0.4 + 2.4 * share, rtol=1e-12)
        for line in drawn["fired V strips (width: charge)"].get_segments():
            assert np.abs(line[:, 0]).max() <= 180
            assert np.abs(line[:, 1]).max() <= layer.half_length + 1e-9
        truths = lines(axes)["true crossing"].get_data()
        nearest = [np.min(np.abs(expected - phi)) for phi in truths[0]]
        assert max(nearest) < np.degrees(2 * layer.pitch_x / layer.r_readout)
        assert axes.get_xlabel() == "φ  (deg)"


def test_a_strip_line_is_the_middle_of_its_strip() -> None:
    for layer in cg.load("besiii-cgem").cgem:
        for strip in (0, 1, layer.strips_v // 2, layer.strips_v - 1):
            phi, z = strip_line(layer, layer.sheets - 1, 1, strip)
            x = layer.r_readout * (phi - layer.sheet_phi[-1])
            np.testing.assert_allclose(z, crossing_z(layer, x, v_of_strips(layer, strip + 0.5)))
            assert np.abs(z).max() <= layer.half_length + 1e-9
            assert x.min() >= -1e-9
            assert x.max() <= 2 * np.pi * layer.r_readout / layer.sheets + 1e-9
            ends = (np.abs(np.abs(z) - layer.half_length) < 1e-6) | (x < 1e-6) | (x > x.max() - 1e-6)
            assert ends[[0, -1]].all()


def test_three_dimensions_show_the_same(result: cg.Result) -> None:
    figure = cg.draw.event_3d(result, 0)
    drawn = {trace.name: trace for trace in figure.data}
    truths, view = result.truths.select_events(0, 1), view_of(result, 0)
    np.testing.assert_array_equal(drawn["true crossing"].z, truths["z"])
    np.testing.assert_allclose(np.hypot(drawn["true crossing"].x, drawn["true crossing"].y), truths["r"])
    for path in view.paths:
        trace = drawn[f"fitted track, p = {path.p:.3f} GeV/c"]
        np.testing.assert_array_equal(np.stack([trace.x, trace.y, trace.z], 1), path.points)
    assert len(drawn["ghost"].x) == np.count_nonzero(view.ghosts)
    wires = np.stack([drawn["hit sense wires"][axis] for axis in "xyz"], 1).reshape(-1, 3, 3)
    layers = {layer.number: layer for layer in result.detector.drift_chamber.layers}
    hits = view.wire_hits
    ends = [layers[n].end_points(w) for n, w in zip(hits["layer"].tolist(), hits["wire"].tolist(), strict=True)]
    np.testing.assert_array_equal(wires[:, :2], ends)
    assert {"L1", "L2", "L3", "beam pipe", "fired X strips", "fired V strips"} <= set(drawn)


def test_the_page_needs_no_network(result: cg.Result, tmp_path: Path) -> None:
    path = cg.draw.save_page(cg.draw.event_3d(result, 0), tmp_path / "event.html")
    page = path.read_text(encoding="utf-8")
    assert "<script src" not in page
    assert "<link" not in page
    assert "<title>besiii-cgem, event 0: mu- 0.64 GeV/c, cos θ = 0.31; pi- 0.548 GeV/c, cos θ = -0.18</title>" in page
    with pytest.raises(FileExistsError):
        cg.draw.save_page(cg.draw.event_3d(result, 0), path)


def test_without_plotly_the_message_names_the_extra(result: cg.Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    with pytest.raises(ValueError, match=r"pip install 'cgemit\[notebook\]'"):
        cg.draw.event_3d(result, 0)


def test_events_without_tracks_hits_or_parts_are_drawn(result: cg.Result) -> None:
    for detector in ("besiii-idc", "besiii-cgem"):
        for until in ("simulate", "cluster", "find"):
            part = cg.run(detector, cg.Gun("mu-", p=1.0, theta=0.05), 1, 1, until=until)
            assert view_of(part, 0).paths == []
            assert cg.draw.event(part).axes
    with pytest.raises(ValueError, match="event: got 2; expected a number from 0 to 1"):
        cg.draw.event(result, 2)


def test_the_title_names_no_readout_of_a_detector_without_cgem_layers() -> None:
    run = cg.run("cepc-like", cg.Gun("mu-", p=1.0, theta=1.0), 1, 1, until="digitize")
    assert cg.draw.event(run).get_suptitle().startswith("cepc-like, event 0")


def test_the_command_draws_the_event_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(
        "cgemit.draw.display.event", lambda result, number: drawn.append((result, number)) or _Nothing()
    )
    words = ["display", "-d", "besiii-cgem", "--particle", "pi-", "--p", "0.2:0.4", "--cos-theta", "0.1:0.3"]
    assert main([*words, "--event", "3", "--seed", "5", "--html", "-o", str(tmp_path / "out"), "--quiet"]) == 0
    ((result, number),) = drawn
    whole = cg.run("besiii-cgem", cg.Gun("pi-", p=(0.2, 0.4), cos_theta=(0.1, 0.3)), 4, 5).select_events(3, 4)
    assert number == 3
    assert {name: table.columns for name, table in result.tables.items()}.keys() == dict(whole.tables).keys()
    for name, table in result.tables.items():
        for column in table.columns:
            np.testing.assert_array_equal(table[column], whole.tables[name][column], err_msg=f"{name}.{column}")
    assert (tmp_path / "out" / "event.html").stat().st_size > 1e6


class _Nothing:
    def save(self, path: Path) -> None:
        """Write nothing."""


def test_the_command_writes_pictures(tmp_path: Path) -> None:
    words = ["display", "-d", "besiii-cgem", "--p", "1", "--cos-theta", "0", "--quiet", "-o", str(tmp_path / "out")]
    assert main(words) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        ".cgemit",
        "detector.toml",
        "event.pdf",
        "event.png",
        "run.json",
    ]
    assert main(words) == 2


@pytest.mark.parametrize("readout", ["tiger", "binary"])
def test_charges_of_the_strips_are_those_of_the_tables(readout: str) -> None:
    result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=0.4), n=1, seed=2, readout=readout)
    picture = cg.draw.event(result, 0)
    assert picture.get_suptitle().startswith(f"besiii-cgem-design, readout {readout}, event 0")
    digis, clusters = result.digis, result.clusters
    with_truth = np.flatnonzero((clusters["view"] < 2) & (clusters["truth"] >= 0))
    off_truth = residuals(result.detector, clusters, result.truths, with_truth)
    off = dict(zip(with_truth.tolist(), off_truth.tolist(), strict=True))
    (scale,) = picture.axes[8].child_axes
    assert scale.get_ylabel() == "time of the strip  (ns)"
    times = scale.get_ylim()
    for number, axes in enumerate(picture.axes[6:9]):
        layer = result.detector.cgem[number]
        for code, sign in ((0, 1.0), (1, -1.0)):
            rows = np.flatnonzero((clusters["layer"] == number) & (clusters["view"] == code))
            row = rows[np.argmax(clusters["charge"][rows])]
            near = (digis["layer"] == number) & (digis["view"] == code) & (digis["sheet"] == clusters["sheet"][row])
            near &= (digis["strip"] >= clusters["first"][row] - 6) & (digis["strip"] <= clusters["last"][row] + 6)
            bars = next(one for one in axes.containers if one.get_label() == f"_{'XV'[code]}")
            np.testing.assert_array_equal([bar.get_height() for bar in bars], sign * digis["charge"][near])
            strips = digis["strip"][near] + 0.5
            middle = strips * layer.pitch_x if code == 0 else v_of_strips(layer, strips)
            drawn = [bar.get_x() + 0.5 * bar.get_width() for bar in bars]
            np.testing.assert_allclose(drawn, middle - clusters["xv"[code]][row], rtol=0, atol=1e-9)
            colours = matplotlib.colormaps["viridis"](Normalize(*times)(digis["time"][near]))
            np.testing.assert_allclose([bar.get_facecolor() for bar in bars], colours, rtol=0, atol=1e-12)
            text = next(one.get_text() for one in axes.texts if one.get_text().startswith("XV"[code]))
            assert f"{clusters['charge'][row]:.1f} fC, {clusters['size'][row]} strip" in text
            assert f"residual {1000 * off[int(row)]:+.0f} µm".replace("-", "−") in text


def test_noise_has_circles_of_its_own_and_the_title_names_the_finder() -> None:
    settings = cg.Settings().with_overrides({"background.level": "bes2009"})
    gun = cg.Gun("mu-", p=0.5, cos_theta=0.2)
    result = cg.run("besiii-cgem", gun, n=1, seed=2, settings=settings, finder="ckf")
    picture = cg.draw.event(result, 0)
    assert picture.get_suptitle().startswith("besiii-cgem, readout binary, finder ckf, event 0")
    truth = result.wire_hits["wire_truth"]
    circles = [one for one in picture.axes[0].collections if isinstance(one, EllipseCollection)]
    for one, label, rows in zip(
        circles, ("drift circle", "drift circle of no particle"), (truth >= 0, truth < 0), strict=True
    ):
        assert rows.sum() > 10
        np.testing.assert_allclose(one.get_widths(), 2 * np.abs(result.wire_hits["drift"][rows]), rtol=1e-12)
        assert lines(picture.axes[0])[label].get_markeredgecolor() == to_hex(one.get_edgecolor()[0]).upper()


GUN = cg.Gun("mu-", p=1, cos_theta=(-0.5, 0.5))


@pytest.mark.parametrize("number", [3, 10**9 + 7, np.int64(10**15)])
def test_events_with_any_numbers_are_drawn(number):
    run = cg.run("besiii-cgem", GUN, n=3, seed=4)
    numbers = [3, 10**9 + 7, 10**15]
    tables = {
        name: Table(name, {**one.columns, "event": np.array(numbers)[one["event"]]}, 3, events=numbers, meta=one.meta)
        for name, one in run.tables.items()
    }
    gaps = replace(run, tables=tables)
    picture = cg.draw.event(gaps, number)
    assert f"event {int(number)}:" in picture.get_suptitle()
    for wrong in (4, 10**15 + 1, 0, 10**400, "x"):
        with pytest.raises(ValueError, match="expected one of 3, 1000000007, 1000000000000000"):
            cg.draw.event(gaps, wrong)


@pytest.mark.usefixtures("undrawn")
def test_display_says_what_it_has_drawn(tmp_path):
    line = ["display", "-d", "besiii-cgem", "--p", "1", "--cos-theta", "0.1", "--seed", "7", "--event", "3", "--quiet"]
    assert main([*line, "--set", "fit.loss=mean", "-o", str(tmp_path / "out")]) == 0
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["seed"] == 7
    assert record["command"].startswith("cgemit display -d besiii-cgem")
    assert record["settings"]["fit"]["loss"] == "mean"
    assert (record["first_event"], record["events"]) == (3, 1)
    assert cg.load(tmp_path / "out" / "detector.toml") == cg.load("besiii-cgem")
    assert main([*line, "--settings", str(tmp_path / "out" / "run.json"), "-o", str(tmp_path / "again")]) == 0


def test_inner_layers_are_those_inside_of_the_chamber() -> None:
    """The view of the inner layers of `idea-like` ends behind its pixels, and shows layers of matter alone."""
    result = cg.run("idea-like", cg.Gun("mu-", p=5.0, cos_theta=0.2), n=1)
    axes = cg.draw.event(result, 0).axes[1]
    assert axes.get_xlim()[1] == pytest.approx(1.1 * result.detector.layer["VTX5"].r_out)
    bare = {"base": "epic-like", "name": "covered"}
    cover = {"layer": {"COVER": {"radius": "900 mm", "length": "3 m", "thickness": "5 mm", "material": "Al"}}}
    matter = []
    for tables in (bare, bare | cover):
        picture = cg.draw.event(cg.run(tables, cg.Gun("mu-", p=5.0, cos_theta=0.2), n=1), 0)
        colour = to_hex(COLORS["matter"])
        matter.append(
            [sum(to_hex(patch.get_facecolor()) == colour for patch in one.patches) for one in picture.axes[:3]]
        )
    assert (np.array(matter[1]) - matter[0]).tolist() == [1, 1, 1]
