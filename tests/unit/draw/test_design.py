"""Pictures of budgets, sensitivities and sweeps: every artist against its data."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.draw import draw_budget, draw_maps, draw_sensitivity
from cgemit.draw.design import draw_sweep
from cgemit.draw.design import label as label_of_design
from cgemit.study import Evaluation, Sweep, latin_hypercube, sweep

DESIGN = "besiii-cgem-design"
P = [0.5, 0.2, 1.5, 1.0]


@pytest.fixture(scope="module")
def covariance():
    return cg.analytic(DESIGN, "mu-", P, 0.2, samples=16)


@pytest.fixture(scope="module")
def sensitivity():
    keys = ["cgem.L1.pitch_x", "field.bz", "drift_chamber.sigma", "cgem.L1.drift_gap"]
    return cg.sensitivity(DESIGN, "mu-", [0.3, 1.0], 0.2, keys=keys, samples=16)


def areas(axes):
    """Return x, lower and upper edge of every area by its label."""
    found = {}
    for area in axes.collections:
        x, y = np.concatenate([path.vertices for path in area.get_paths()]).T
        momenta = np.unique(x)
        edges = np.array([[y[x == p].min(), y[x == p].max()] for p in momenta])
        found[area.get_label()] = (momenta, edges[:, 0], edges[:, 1])
    return found


@pytest.mark.parametrize(
    ("quantity", "by", "most"), [("dr", "part", 8), ("p", "cause", 8), ("dz", "material", 3), ("pt", "source", 5)]
)
def test_areas_are_the_shares_of_the_variance(covariance, quantity, by, most):
    budget = covariance.budget(quantity)
    (axes,) = draw_budget(budget, by, most=most).axes
    order = np.argsort(P)
    shares = {name: (100 * value / budget.total)[order] for name, value in budget.grouped(by).items()}
    names = sorted(shares, key=lambda name: -shares[name].mean())
    drawn = areas(axes)
    expected = names[:most] + ["other"] * (len(names) > most)
    assert list(drawn) == expected
    low = np.zeros(4)
    for name in expected:
        share = shares[name] if name != "other" else np.sum([shares[one] for one in names[most:]], axis=0)
        momenta, below, above = drawn[name]
        np.testing.assert_allclose(momenta, np.sort(P))
        np.testing.assert_allclose(below, low, atol=1e-9)
        np.testing.assert_allclose(above, low + share, atol=1e-9)
        low = low + share
    np.testing.assert_allclose(low, 100, rtol=1e-9)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == expected[::-1]
    assert (axes.get_xlim(), axes.get_ylim()) == ((0.2, 1.5), (0.0, 100.0))
    colours = [tuple(area.get_facecolor()[0]) for area in axes.collections]
    assert len(set(colours)) == len(expected)


def test_a_budget_has_a_gap_where_no_track_has_a_covariance():
    budget = cg.analytic(DESIGN, "mu-", [0.02, 0.5, 1.0], 0.0, samples=4).budget("p")
    (axes,) = draw_budget(budget, "cause").axes
    momenta, _, above = areas(axes)["measurement"]
    assert momenta.tolist() == [0.5, 1.0]
    assert np.isfinite(above).all()


def test_bars_are_the_sensitivities_largest_first(sensitivity):
    for point in range(2):
        (axes,) = draw_sensitivity(sensitivity, point=point).axes
        size = {key: max(abs(sensitivity.of(key, name)[point]) for name in ("dr", "dz", "p"))
                for key in sensitivity.keys}  # fmt: skip
        keys = sorted(size, key=lambda key: -size[key])
        assert [text.get_text() for text in axes.get_yticklabels()] == keys
        assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the first on top
        for name, bars, label in zip(("dr", "dz", "p"), axes.containers, (r"$d_\rho$", "$d_z$", "p"), strict=True):
            assert bars.get_label() == f"σ({label})"
            widths = [bar.get_width() for bar in bars]
            np.testing.assert_allclose(widths, [sensitivity.of(key, name)[point] for key in keys])
            middle = [bar.get_y() + 0.5 * bar.get_height() for bar in bars]
            assert np.round(middle).tolist() == list(range(len(keys)))
        assert len({bars.patches[0].get_facecolor() for bars in axes.containers}) == 3
        assert [text.get_text() for text in axes.get_legend().get_texts()] == [b.get_label() for b in axes.containers]


def test_numbers_that_cannot_be_changed_have_no_bar(sensitivity):
    values = sensitivity.values.copy()
    values[1] = np.nan
    (axes,) = draw_sensitivity(replace(sensitivity, values=values), most=2).axes
    found = [text.get_text() for text in axes.get_yticklabels()]
    assert len(found) == 2
    assert "field.bz" not in found


def test_what_cannot_be_drawn_is_refused(covariance, sensitivity):
    with pytest.raises(ValueError, match=r"points of shape \(1,\).*expected a list of two momenta"):
        draw_budget(cg.analytic(DESIGN, p=[1.0], samples=2).budget("p"))
    with pytest.raises(ValueError, match="expected a list of two momenta or more at one cos"):
        draw_budget(cg.analytic(DESIGN, p=[0.5, 1.0], cos_theta=[0.0, 0.5], samples=2).budget("p"))
    with pytest.raises(ValueError, match="by: got 'layer'"):
        draw_budget(covariance.budget("p"), "layer")
    with pytest.raises(ValueError, match="got point 2, most 15; expected a point from 0 to 1"):
        draw_sensitivity(sensitivity, point=2)
    with pytest.raises(ValueError, match="got no derivative"):
        draw_sensitivity(replace(sensitivity, values=np.full_like(sensitivity.values, np.nan)))


@pytest.mark.parametrize("most", ["a", 0, 1.5, None])
def test_numbers_of_groups_that_are_none_are_refused(most, covariance, sensitivity):
    one = cg.analytic(DESIGN, p=1.0, samples=2).budget("p")
    for draw in (
        lambda: draw_budget(covariance.budget("p"), most=most),
        lambda: cg.draw.draw_budgets({"design": one}, most=most),
        lambda: draw_sensitivity(sensitivity, most=most),
    ):
        with pytest.raises(ValueError, match=rf"most {most!r}; expected .*most of "):
            draw()


DESIGN_SWEEP = cg.load("besiii-cgem-design")


def strips(detector: cg.Detector) -> dict[str, Any]:
    """Return the number of strips of the first layer, and of all."""
    counts = [layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem]
    return {"first": counts[0], "all": sum(counts)}


def simulated() -> Sweep:
    return sweep(
        DESIGN_SWEEP, {"cgem.*.pitch_x": ["900 um", "400 um"]}, evaluate=Evaluation("mc", p=[0.3, 1.0], events=100)
    )


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
    found = sweep(DESIGN_SWEEP, space, evaluate=strips)
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


def legend_of(picture: Any) -> list[str]:
    """Return the entries of the only legend."""
    (legend,) = [*picture.legends, *filter(None, [axes.get_legend() for axes in picture.axes])]
    return [text.get_text() for text in legend.get_texts()]


@pytest.mark.parametrize("count", [1, 2])
def test_designs_without_a_result_are_crosses(count: int) -> None:
    """In a scan on the axis, since they have no value."""

    def radii(detector: cg.Detector) -> dict[str, Any]:
        if detector.cgem["L1"].anode_radius == 90:
            raise ValueError("no result")
        return {"all": sum(layer.anode_radius for layer in detector.cgem)}

    keys = ("cgem.L1.anode_radius", "cgem.*.foils")[:count]
    values = [("80 mm", 3), ("125 mm", 2), ("90 mm", 1)]
    found = sweep(DESIGN_SWEEP, [dict(zip(keys, one, strict=False)) for one in values], evaluate=radii)
    assert found.columns["status"] == ["ok", "ok", "impossible", "failed"]
    picture = found.draw("all")
    (crosses,) = (line for line in picture.axes[0].lines if line.get_marker() == "x")
    assert crosses.get_xdata().tolist() == [125, 90]
    assert crosses.get_ydata().tolist() == ([0, 0] if count == 1 else [2, 1])
    if count == 1:
        heights = crosses.get_transform().transform(np.column_stack(crosses.get_data()))[:, 1]
        np.testing.assert_allclose(heights, picture.axes[0].bbox.y0)
    assert sorted(legend_of(picture)) == ["base", "impossible, failed"]


@pytest.mark.parametrize("count", [1, 2])
def test_a_base_that_is_not_drawn_has_no_entry(count: int) -> None:
    """The first two layers of the base differ in length, or the quantity is not known for it."""

    def length(detector: cg.Detector) -> dict[str, Any]:
        known = detector.cgem["L1"].foils == 2
        return {"length": detector.cgem["L1"].length, "known": 1.0 if known else float("nan")}

    for key, value, quantity in (("cgem.L[12].length", "500 mm", "length"), ("cgem.*.foils", 2, "known")):
        changes = dict([(key, value), ("field.bz", "0.9 T")][:count])
        picture = sweep(DESIGN_SWEEP, [changes], evaluate=length).draw(quantity)
        assert not picture.legends
        assert picture.axes[0].get_legend() is None


def test_parallel_coordinates_run_through_every_value() -> None:
    ranges = {"cgem.*.pitch_x": ("400 um", "900 um"), "cgem.*.foils": (1, 3), "cgem.*.gas": ["CgemGas", "MdcGas"]}
    found = sweep(DESIGN_SWEEP, latin_hypercube(ranges, 8), evaluate=strips)
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
    assert label_of_design("delta_sigma_p (MeV/c)") == "σ(p) − base  (MeV/c)"
    assert label_of_design("cost ($)") == r"cost  ($)"
    assert label_of_design("a$b") == r"a\$b"
    found = sweep(DESIGN_SWEEP, {"cgem.*.foils": [2]}, evaluate=strips)
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
    found = sweep(DESIGN_SWEEP, [dict(zip(keys, ("160 mm", "400 um", 2), strict=False))], evaluate=strips)
    assert found.columns["status"] == ["ok", "impossible"]
    with pytest.raises(ValueError, match="first: got no number to draw, expected at least one variant"):
        found.draw("first")


@pytest.mark.slow
def test_budgets_of_variants_are_bars_that_add_up_to_the_variance() -> None:
    found = sweep(
        DESIGN_SWEEP,
        {"cgem.L2.anode_radius": ["120 mm", "165 mm", "145 mm"]},
        evaluate=Evaluation(p=[0.3, 1.0], samples=16),
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
        float(cg.analytic(DESIGN_SWEEP, p=0.3, samples=16).rms_dr) ** 2, rel=1e-9
    )
    with pytest.raises(ValueError, match="expected one of dr, dz"):
        sweep(DESIGN_SWEEP, [{}], evaluate=strips).draw_budgets()


@pytest.mark.parametrize("turned", [False, True])
def test_maps_are_the_resolutions_of_a_grid(turned):
    p, cosines = np.array([0.2, 0.5, 2.0]), np.array([-0.7, 0.0, 0.2, 0.6])
    grid = (p[None, :], cosines[:, None]) if turned else (p[:, None], cosines)
    found = cg.analytic(DESIGN, "mu-", *grid, samples=8)
    picture = draw_maps(found, ["dr", "p"])
    values = [found.sigma("dr"), found.sigma("p"), found.n_clusters + found.n_wires]
    panels = [axes for axes in picture.axes if axes.get_xlabel() == "cos θ"]
    bars = [axes.get_ylabel() for axes in picture.axes if axes.get_ylabel() not in ("", "p  (GeV/c)")]
    assert len(panels) == 3
    assert [bar.rpartition("  ")[2] for bar in bars] == ["(µm)", "(MeV/c)", "clusters and wire hits"]
    for axes, expected in zip(panels, values, strict=True):
        (mesh,) = axes.collections
        np.testing.assert_allclose(mesh.get_array(), expected.T if turned else expected)
        assert axes.get_ylabel() == "p  (GeV/c)"
        assert axes.get_yscale() == "log"
    assert DESIGN in picture.get_suptitle()


@pytest.mark.parametrize("points", [(1.0, 0.0), ([0.3, 1.0], 0.0), (np.array([[1.0], [0.3]]), [0.0, 0.5])])
def test_maps_need_a_grid(points):
    with pytest.raises(ValueError, match="a grid of two momenta and two cosines or more, each in order"):
        draw_maps(cg.analytic(DESIGN, "mu-", *points, samples=4))


def test_a_budget_against_the_angle_and_a_logarithmic_momentum():
    budget = cg.analytic(DESIGN, pt=0.5, theta=["90 deg", "45 deg", "60 deg"], samples=2).budget("dz")
    (axes,) = draw_budget(budget, "cause").axes
    assert (axes.get_xlabel(), axes.get_xscale()) == ("θ  (deg)", "linear")
    assert axes.get_xlim() == pytest.approx((45, 90))
    assert axes.get_title(loc="left").endswith("$p_T$ = 0.5 GeV/c")
    share = 100 * budget.grouped("cause")["scattering"] / budget.total
    edges = np.array([line.get_ydata() for line in axes.lines if line.get_marker() != "|"])
    widths = np.diff(np.vstack([np.zeros(3), edges]), axis=0)
    assert any(one == pytest.approx(share[[1, 2, 0]]) for one in widths)
    (ticks,) = [line for line in axes.lines if line.get_marker() == "|"]
    assert ticks.get_xdata().tolist() == pytest.approx([45, 60, 90])
    (axes,) = draw_budget(cg.analytic(DESIGN, p=[0.2, 1.5], samples=2).budget("p")).axes
    assert axes.get_xscale() == "log"
