"""Pictures of sweeps: what is drawn is what the table holds, with the labels of its columns."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.draw.design import draw_sweep, label
from cgemit.study import Evaluation, Sweep, latin_hypercube, sweep

DESIGN = cg.load("besiii-cgem-design")


def strips(detector: cg.Detector) -> dict[str, Any]:
    """Return the number of strips of the first layer, and of all."""
    counts = [layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem]
    return {"first": counts[0], "all": sum(counts)}


def simulated() -> Sweep:
    return sweep(DESIGN, {"cgem.*.pitch_x": ["900 um", "400 um"]}, evaluate=Evaluation("mc", p=[0.3, 1.0], events=100))


@pytest.mark.slow
def test_a_scan_is_a_line_for_each_point_in_order_of_the_key() -> None:
    found = simulated()
    axes = found.draw("sigma_dz (mm)").axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == (r"cgem.*.pitch_x  (µm)", r"σ($d_z$)  (mm)")
    table = found.to_pandas()
    for container, p in zip(axes.containers, (0.3, 1.0), strict=True):
        rows = table[(table["p (GeV/c)"] == p) & (table["variant"] > 0)].sort_values("cgem.*.pitch_x (um)")
        line, _, (bars,) = container.lines
        assert container.get_label() == f"p = {p:g} GeV/c, cos θ = 0"
        assert line.get_xdata().tolist() == [400, 900]
        assert line.get_ydata().tolist() == rows["sigma_dz (mm)"].tolist()
        half = [0.5 * (segment[1, 1] - segment[0, 1]) for segment in bars.get_segments()]
        assert half == pytest.approx(rows["sigma_dz_error (mm)"].tolist(), rel=1e-12)
    bases = [line for line in axes.lines if line.get_markersize() == 9 and len(line.get_xdata())]
    base = table[table["variant"] == 0]["sigma_dz (mm)"].tolist()
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in bases] == [(650, base[0]), (650, base[1])]


def test_a_map_holds_the_value_of_each_cell_and_crosses() -> None:
    space = {"cgem.L2.anode_radius": ["120 mm", "140 mm", "160 mm"], "cgem.*.gas": ["CgemGas", "MdcGas"]}
    found = sweep(DESIGN, space, evaluate=strips)
    picture = found.draw("all")
    axes = picture.axes[0]
    (mesh,) = axes.collections
    expected = np.array(found.columns["all"][1:]).reshape(3, 2).T
    np.testing.assert_array_equal(mesh.get_array().filled(np.nan), expected)
    assert [text.get_text() for text in axes.get_yticklabels()] == ["CgemGas", "MdcGas"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("cgem.L2.anode_radius  (mm)", "cgem.*.gas")
    crosses = next(line for line in axes.lines if line.get_marker() == "x")
    assert (crosses.get_xdata().tolist(), crosses.get_ydata().tolist()) == ([160, 160], [0, 1])
    base = next(line for line in axes.lines if line.get_marker() == "o")
    assert (base.get_xdata().tolist(), base.get_ydata().tolist()) == ([132.5], [0])
    assert picture.axes[1].get_ylabel() == "all"


def test_parallel_coordinates_run_through_every_value() -> None:
    ranges = {"cgem.*.pitch_x": ("400 um", "900 um"), "cgem.*.foils": (1, 3), "cgem.*.gas": ["CgemGas", "MdcGas"]}
    found = sweep(DESIGN, latin_hypercube(ranges, 8), evaluate=strips)
    axes = found.draw("first").axes[0]
    lines = np.array([line.get_ydata() for line in axes.lines[:8]])
    for i, name in enumerate((*found.parameters[:2], "first")):
        values = np.array(found.columns[name][1:], np.float64)
        scaled = (values - values.min()) / (values.max() - values.min())
        np.testing.assert_allclose(lines[:, i if i < 2 else 3], scaled, atol=1e-12)
    ticks = [text.get_text() for text in axes.get_xticklabels()]
    assert ticks == ["cgem.*.pitch_x\n(µm)", "cgem.*.foils", "cgem.*.gas", "first"]
    shown = {text.get_text() for text in axes.texts}
    assert {f"{min(found.columns['first'][1:])}", "1", "3", "CgemGas", "MdcGas"} <= shown


def test_labels_and_mistakes() -> None:
    assert label("delta_sigma_p (MeV/c)") == "σ(p) − base  (MeV/c)"
    assert label("cost ($)") == r"cost  ($)"
    assert label("a$b") == r"a\$b"
    found = sweep(DESIGN, {"cgem.*.foils": [2]}, evaluate=strips)
    with pytest.raises(ValueError, match="expected one of first, all"):
        found.draw("second")
    with pytest.raises(ValueError, match="expected one of scan, map, parallel"):
        found.draw("all", kind="pie")
    with pytest.raises(ValueError, match="'map' for 1 keys, expected 2"):
        found.draw("all", kind="map")
    nothing = {**found.columns, "all": [float("nan")] * 2}
    with pytest.raises(ValueError, match="no number to draw"):
        draw_sweep(nothing, found.parameters, "all")


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_table_with_the_base_alone_has_nothing_to_draw(count: int) -> None:
    keys = ("cgem.L1.anode_radius", "cgem.L1.pitch_x", "cgem.L1.foils")[:count]
    found = sweep(DESIGN, [dict(zip(keys, ("160 mm", "400 um", 2), strict=False))], evaluate=strips)
    assert found.columns["status"] == ["ok", "impossible"]
    with pytest.raises(ValueError, match="first: got no number to draw, expected at least one variant"):
        found.draw("first")


def test_parallel_coordinates_are_of_the_first_point_with_a_variant() -> None:
    keys = ("cgem.*.foils", "cgem.*.pitch_x", "cgem.*.pitch_v")
    found = sweep(
        DESIGN, [dict(zip(keys, (2, "400 um", "400 um"), strict=True))], evaluate=Evaluation(p=[0.3, 1.0], samples=2)
    )
    columns = {**found.columns, "sigma_dr (um)": [300.0, 150.0, float("nan"), 140.0]}
    axes = draw_sweep(columns, found.parameters, "sigma_dr (um)").axes[0]
    assert axes.get_title() == "p = 1 GeV/c, cos θ = 0"


@pytest.mark.slow
def test_budgets_of_variants_are_bars_that_add_up_to_the_variance() -> None:
    found = sweep(
        DESIGN, {"cgem.L2.anode_radius": ["120 mm", "165 mm", "145 mm"]}, evaluate=Evaluation(p=[0.3, 1.0], samples=16)
    )
    picture = found.draw_budgets("dr", "cause", point=1)
    (axes,) = picture.axes
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert names == ["base", "cgem.L2.anode_radius=120mm", "cgem.L2.anode_radius=145mm"]  # 165 mm is impossible
    for row, variant in enumerate((0, 1, 3)):
        covariance = cg.analytic(found.detector(variant), p=1.0, samples=16)
        budget = covariance.budget("dr").grouped("cause")
        widths = {bars.get_label(): bars[row].get_width() for bars in axes.containers}
        assert widths == pytest.approx({name: float(value) for name, value in budget.items()}, rel=1e-9)
        assert axes.texts[row].get_text() == f"RMS {covariance.rms_dr:.4g} µm"
    assert len(found.draw("sigma_dz (mm)", kind="budget").axes[0].containers) > 5
    few = found.draw_budgets("dr", "source").axes[0]
    assert len(few.containers) == 8 + 1
    assert few.containers[-1].get_label() == "other"
    assert sum(bars[0].get_width() for bars in few.containers) == pytest.approx(
        float(cg.analytic(DESIGN, p=0.3, samples=16).rms_dr) ** 2, rel=1e-9
    )
    with pytest.raises(ValueError, match="expected one of dr, dz"):
        sweep(DESIGN, [{}], evaluate=strips).draw_budgets()
