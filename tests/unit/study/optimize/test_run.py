"""Optimization: goals by hand, gradients, optima within limits, problems all at once, files and the command."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import cgemit as cg
from cgemit.base.errors import Problems
from cgemit.cli.main import main
from cgemit.detector import inventory
from cgemit.study import Background, Optimization, PlanError, Search, optimize, sobol, sweep
from cgemit.study.optimize.goals import Goals, Variable, goal_of, limits_of, variables_of
from cgemit.study.optimize.run import KEYS, read_optimize_plan
from cgemit.study.optimize.search import Descent, Design, Evaluator, rounded, with_failures
from cgemit.study.sweep.evaluate import Evaluation
from variants import varied

pytestmark = pytest.mark.usefixtures("undrawn")

DESIGN = cg.load("besiii-cgem-design")
SPACE = {
    "cgem.L1.anode_radius": ("80 mm", "100 mm"),
    "cgem.L2.anode_radius": ("105 mm", "155 mm"),
    "cgem.L1.pitch_x": ("400 um", "1000 um"),
    "cgem.*.pitch_v": ("x0.6", "x2"),
}
LIMITS = {"channels": (None, 10010), "gap": (3, None)}
HOW: dict[str, Any] = {"minimize": "dr", "constraints": LIMITS, "evaluate": Evaluation(p=0.3, samples=64)}


#: The gas between the outer layer and a chamber far from it changes its lumps with every few millimetres.
FAR = """
name = "far"
field.bz = "1.2 T"
beam_pipe.pipe = { r_in = "25 mm", r_out = "26 mm", half_length = "200 mm", material = "Be" }

[cgem.L1]
anode_radius = "60 mm"
length = "400 mm"
sheets = 1
phi_first = "0 deg"
pitch_x = "400 um"
pitch_v = "400 um"
drift_gap = "3 mm"
transfer_gap = "2 mm"
induction_gap = "2 mm"
gas = "Gas"
cathode = [{ label = "Kapton", material = "Kapton", thickness = "50 um" }]
foil = [{ label = "Kapton", material = "Kapton", thickness = "50 um" }]
anode = [{ label = "Kapton", material = "Kapton", thickness = "100 um" }]

[cgem.L2]
like = "L1"
anode_radius = "95 mm"

[drift_chamber]
gas = "MdcGas"
sigma = "110 um"
half_length = "400 mm"
superlayers.inner = { layers = 8, r_in = "120 mm", cells = "10 mm", stereo = ["50 mrad", "-50 mrad"] }
superlayers.outer = { layers = 12, r_in = "220 mm", cells = "12 mm" }

[materials.Gas]
density = "1.66e-3 g/cm3"
composition = { Ar = 0.7, C = 0.25, H = 0.05 }
gas = true
"""


@pytest.fixture(scope="module")
def found() -> Optimization:
    return optimize(DESIGN, SPACE, **HOW)


def test_numbers_of_a_design_by_hand() -> None:
    radii, lengths = (87.5, 132.5, 175), (532, 690, 847)
    assert inventory.channels(DESIGN) == 845 + 1175 + 2 * (640 + 1094) + 2 * (845 + 1416)
    area = sum(2 * math.pi * r * length for r, length in zip(radii, lengths, strict=True))
    assert inventory.area(DESIGN) == pytest.approx(area / 1e6, rel=1e-12)
    assert inventory.radiation_lengths(DESIGN) == pytest.approx(0.43079 + 0.36687 + 0.51079, abs=2e-5)
    assert (inventory.inner_radius(DESIGN), inventory.outer_radius(DESIGN)) == pytest.approx((74.262, 179.365))
    # Beam pipe ends at 33.7 mm, the layers lie from 74.262, 119.198 and 161.69 mm, the wall begins at 182.6 mm.
    gaps = [74.262 - 33.7, 119.198 - 91.745, 161.69 - 136.7375, 182.6 - 179.365]
    assert inventory.gaps(DESIGN) == pytest.approx(gaps, abs=1e-9)
    assert inventory.smallest_gap(DESIGN) == pytest.approx(3.235)
    assert inventory.pt_threshold(DESIGN) == pytest.approx(0.299792458 * 1.0 * 166.34 / 2, rel=1e-4)


def test_unseen_matter_of_electrons() -> None:
    """The goal is the mean of what `Covariance.losses` has; a muon has none."""
    evaluation = Evaluation(particle="e-", p=[0.3, 1.0], cos_theta=[0.0, 0.7])
    goal = goal_of("minimize", "unseen_x0", evaluation.p, Problems())
    assert goal is not None
    found = Goals((goal,), evaluation, None)(DESIGN)["values"]["unseen_x0 (%)"]
    at = [cg.analytic(DESIGN, "e-", p=[0.3, 1.0], cos_theta=c).losses().effective.sum() for c in (0.0, 0.7)]
    assert found == pytest.approx(100 * sum(at) / 4)
    space = {"cgem.L1.pitch_x": ("400 um", "800 um")}
    with pytest.raises(PlanError, match=r"evaluate.particle: got 'mu-', expected 'e-' or 'e[+]'"):
        optimize(DESIGN, space, minimize="unseen_x0", evaluate=Evaluation(p=0.3))


def test_occupancy_by_hand() -> None:
    background = Background(rate=10, radius=78.84, power=0, window=1000, strips=3)
    sheets = [2 * math.pi * 8.75 * 53.2 / 845, 2 * math.pi * 13.25 * 69 / 2 / 640, 2 * math.pi * 17.5 * 84.7 / 2 / 845]
    mean = 10e3 * max(sheets) * 3 * 1e-6
    assert inventory.occupancy(DESIGN, background) == pytest.approx(100 * (1 - math.exp(-mean)), rel=1e-9)
    # Falling with the square of the radius, from 10 kHz/cm2 at 50 mm.
    falling = dataclasses.replace(background, radius=50, power=2)
    middles = [layer.r_mid for layer in DESIGN.cgem]
    mean = max(10e3 * (50 / r) ** 2 * sheet * 3 * 1e-6 for r, sheet in zip(middles, sheets, strict=True))
    assert inventory.occupancy(DESIGN, falling) == pytest.approx(100 * (1 - math.exp(-mean)), rel=1e-9)


def test_occupancy_of_wires_and_cost_by_hand() -> None:
    background = Background(rate=10, radius=100, power=0, wire_window=400)
    cells = [2 * math.pi * one.r_mid / one.cells * (one.ends[1] - one.ends[0]) / 100 for one in DESIGN.wires]  # cm2
    wanted = 100 * (1 - math.exp(-10e3 * max(cells) * 400e-9))
    assert inventory.wire_occupancy(DESIGN, background) == pytest.approx(wanted, rel=1e-9)
    assert inventory.wires(DESIGN) == sum(one.cells for one in DESIGN.wires)
    prices = {"channels": 20, "area": 5e4}
    space = {"cgem.*.pitch_x": ("400 um", "800 um")}
    limits = {"wire_occupancy": (None, 90), "cost": (None, 3e5)}
    how: dict[str, Any] = {"evaluate": Evaluation(p=0.3, samples=16), "background": background, "prices": prices}
    found = optimize(DESIGN, space, "dr", limits, **how)
    assert found["cost"][0] == pytest.approx(20 * 10010 + 5e4 * inventory.area(DESIGN))
    assert found["wire_occupancy (%)"][0] == pytest.approx(wanted)
    best = found.detector()
    assert found["cost"][-1] == pytest.approx(20 * inventory.channels(best) + 5e4 * inventory.area(best))
    assert 0.99 * 3e5 < found["cost"][-1] <= 3e5
    with pytest.raises(PlanError) as error:
        optimize(DESIGN, space, "dr", {"cost": (None, 1)}, prices={"chanels": 2, "area": "much"})
    assert "prices.chanels: got 2, expected prices of channels, wires" in str(error.value)
    assert "prices.area: got 'much', expected a number" in str(error.value)
    with pytest.raises(PlanError, match="prices: got none, expected prices"):
        optimize(DESIGN, space, "cost")


def strips_of_first(detector: cg.Detector) -> float:
    """Strips of L1, as a user's own limit."""
    return detector.cgem[0].strips_x


def _many(detector: cg.Detector) -> Any:
    return "many"


def test_a_function_of_the_user_is_a_limit_and_a_goal(tmp_path: Path) -> None:
    space = {"cgem.L1.pitch_x": ("400 um", "900 um")}
    how: dict[str, Any] = {"evaluate": {"p": 0.3, "samples": 16}, "search": "cobyla"}
    found = optimize(DESIGN, space, "dr", {strips_of_first: (None, 700)}, **how)
    (best,) = found.front
    assert found["strips_of_first"][0] == DESIGN.cgem[0].strips_x > 700
    assert 690 <= found["strips_of_first"][best] <= 700
    (tmp_path / "own.py").write_text("def strips_of_first(detector):\n    return detector.cgem[0].strips_x\n")
    (tmp_path / "plan.toml").write_text("""
base = "besiii-cgem-design"
minimize = "dr"
vary."cgem.L1.pitch_x" = { from = "400 um", to = "900 um" }
constraints."own.py:strips_of_first" = { max = 700 }
evaluate = { p = 0.3, samples = 16 }
search.method = "cobyla"
""")
    plan = read_optimize_plan(tmp_path / "plan.toml")
    again = plan.run(output=tmp_path / "out", started=lambda: plan.write(tmp_path / "out"))
    assert again["sigma_dr (um)"].tolist() == found["sigma_dr (um)"].tolist()
    assert again["strips_of_first"].tolist() == found["strips_of_first"].tolist()
    copied = read_optimize_plan(tmp_path / "out" / "plan.toml")
    assert [key.__name__ for key in copied.arguments["constraints"]] == ["strips_of_first"]
    with pytest.raises(PlanError, match=r"FILE\.py:FUNCTION with a file that exists"):
        read_optimize_plan(tmp_path / "plan.toml", {"minimize": "none.py:f"})
    with pytest.raises(PlanError, match="_many: got 'many', expected a finite number"):
        optimize(DESIGN, space, "dr", {_many: (None, 1)}, **how)


def test_strips_without_rounding_are_never_fewer() -> None:
    for variant in sobol({"cgem.*.pitch_x": ("300 um", "900 um"), "cgem.*.pitch_v": ("300 um", "900 um")}, 16).variants:
        detector = DESIGN.with_overrides(dict(variant))
        whole, real = inventory.channels(detector), inventory.smooth_channels(detector)
        # At most one strip of each view and sheet, and some V strips because the diagonal is that of whole X strips.
        assert whole <= real < whole + 30


def test_gradients_are_the_slopes_of_what_is_minimized() -> None:
    problems: list[str] = []
    texts = ("dr @ 0.3", "dz", "channels", "x0")
    space = {**SPACE, "cgem.*.foil.Kapton.thickness": ("+0 %", "+100 %"), "cgem.*.drift_gap": ("4 mm", "6 mm")}
    goals = tuple(goal_of("", text, (0.3, 1.0), problems) for text in texts)
    evaluation = Evaluation(p=[0.3, 1.0], cos_theta=[0.0, 0.6], quantities=["dr", "dz"], samples=64)
    limits = limits_of({"dz": (None, 10), "channels": (None, 1e5), "x0": (None, 10)}, (0.3, 1.0), problems)
    evaluator = Evaluator(DESIGN, Goals(goals, evaluation, None), limits, None, cg.Workers())
    descent = Descent(evaluator, variables_of(DESIGN, space, problems), goals[0])
    assert not problems
    u = np.array([0.4, 0.5, 0.3, 0.4, 0.2, 0.5])
    point = descent.start(u)
    slope, margins = descent.slopes(point)
    covariances = [cg.analytic(descent.detector(u), "mu-", p=[0.3, 1.0], cos_theta=c, samples=64) for c in (0, 0.6)]

    def numbers(u: Any) -> Any:
        """The objective and the margins, with the hits of the design at u."""
        detector = descent.detector(u)
        found = [varied(one, [detector])[0] for one in covariances]
        dr = np.mean([np.log(one.sigma("dr")[0]) for one in found])
        dz = math.exp(np.mean([np.log(one.sigma("dz")) for one in found]))
        return [dr, 1 - dz / 10, 1 - inventory.smooth_channels(detector) / 1e5,
                1 - inventory.radiation_lengths(detector) / 10, *(np.array(inventory.gaps(detector)) / 10)]  # fmt: skip

    assert point.value == pytest.approx(numbers(u)[0], rel=1e-12)
    assert point.margins[:3] == pytest.approx(np.array(numbers(u)[1:4]) - [3e-4, 1e-5, 1e-5], rel=1e-9)
    slopes = np.array([slope, *margins])
    scale = np.maximum(np.abs(slopes).max(axis=1), 1e-3)  # the last free space does not change
    errors = []
    for step in (0.02, 0.01):  # Taylor: the error of central differences falls with the square of the step
        up, down = (np.array([numbers(u + s * step * one) for one in np.eye(len(u))]) for s in (1, -1))
        errors.append(np.abs((up - down).T / (2 * step) - slopes).max(axis=1) / scale)
    # d_z oscillates with the pitch of the V strips, so that its second differences are large.
    assert (errors[0] < [2e-3, 0.2, 2e-3, *(1e-6,) * (len(slopes) - 3)]).all()
    assert (errors[1] < np.maximum(errors[0] / 3.5, 1e-6)).all()


def test_a_step_onto_an_impossible_design_is_cut() -> None:
    space = {"cgem.L3.anode_radius": "bounds"}
    how: dict[str, Any] = {"minimize": "dr @ 0.3", "evaluate": Evaluation(p=0.3, samples=64)}
    low, high = DESIGN.bounds("cgem.L3.anode_radius")
    for method in ("gradient", "cobyla"):
        found = optimize(DESIGN, space, search=Search(method=method), **how)
        (best,) = found.front
        assert low <= found["cgem.L3.anode_radius (mm)"][best] <= high
        assert found["sigma_dr at 0.3 GeV/c (um)"][best] <= found["sigma_dr at 0.3 GeV/c (um)"][0]


#: Seven variables of the design. The base violates the limit of d_z.
SEVEN = {
    "cgem.L1.anode_radius": ("60 mm", "95 mm"), "cgem.L2.anode_radius": ("100 mm", "150 mm"),
    "cgem.L3.anode_radius": ("150 mm", "178 mm"), "cgem.*.pitch_x": ("300 um", "1000 um"),
    "cgem.*.pitch_v": ("300 um", "1000 um"), "cgem.*.drift_gap": ("3 mm", "8 mm"),
    "cgem.*.stereo": ("15 deg", "60 deg"),
}  # fmt: skip
SEVEN_LIMITS = {"channels": (None, 12000), "x0": (None, 1.5), "gap": (3, None), "dz @ 0.3": (None, 0.29)}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"cgem.*.pitch_x": "350 um", "cgem.*.pitch_v": "350 um"},
        {"cgem.*.pitch_x": "900 um", "cgem.*.stereo": "20 deg"},
        {"cgem.*.drift_gap": "3 mm"},
    ],
)
def test_a_start_that_violates_limits_ends_at_the_allowed_optimum(changes: dict[str, Any]) -> None:
    """NSGA-II needs 6100 designs for 206 um; impossible to miss from any of these starts."""
    base = DESIGN.with_overrides(changes) if changes else DESIGN
    found = optimize(base, SEVEN, "dr @ 0.3", SEVEN_LIMITS, Evaluation(particle="pi-", p=0.3))
    assert not found.columns["allowed"][0]
    (best,) = found.front
    assert best == len(found) - 1
    header = "sigma_dr at 0.3 GeV/c (um)"
    allowed = found["allowed"] & np.isfinite(found[header])
    assert found[header][best] == found[header][allowed].min() < 1.01 * 206
    assert found.evaluations < 100
    first = int(np.flatnonzero(allowed)[0])
    assert f"the start misses a limit, the first allowed design is number {first};" in found.message
    assert "no design" not in found.message
    table = found.to_pandas().loc[best]
    assert (table["channels"] <= 12000) & (table["x0 (%)"] <= 1.5) & (table["gap (mm)"] >= 3 - 1e-5)
    assert table["sigma_dz at 0.3 GeV/c (mm)"] <= 0.29


def test_a_search_within_the_bounds_ends_at_a_possible_design() -> None:
    found = optimize(DESIGN, {"cgem.L3.anode_radius": "bounds"}, minimize="dz", evaluate=Evaluation(p=0.3, samples=16))
    assert [found.columns["kind"][i] for i in found.front] == ["optimum"]


def test_a_search_goes_on_where_slabs_and_wires_change_their_order() -> None:
    """Where the layer moves away from the chamber, the lumps of gas between them change."""
    key = "cgem.L3.anode_radius"
    gradient, cobyla = (
        optimize(
            DESIGN, {key: ("150 mm", "185 mm")}, minimize="dr", evaluate=Evaluation(p=0.5, samples=16),
            search=Search(method=method),
        )
        for method in ("gradient", "cobyla")
    )  # fmt: skip
    (first, second) = (one[f"{key} (mm)"][one.front[0]] for one in (gradient, cobyla))
    assert first == pytest.approx(second, abs=0.01)


def test_a_start_beyond_a_limit_crosses_other_orders(tmp_path: Path) -> None:
    (tmp_path / "far.toml").write_text(FAR)
    best = optimize(
        tmp_path / "far.toml",
        {"cgem.L1.anode_radius": ("40 mm", "80 mm"), "cgem.L2.anode_radius": ("70 mm", "105 mm"),
         "cgem.*.pitch_x": ("300 um", "800 um"), "cgem.*.pitch_v": ("300 um", "800 um")},
        minimize="dr", constraints={"channels": (None, 4500)}, evaluate=Evaluation(p=0.5, samples=16),
    )  # fmt: skip
    (row,) = best.front
    assert best["channels"][0] > 4500 >= best["channels"][row]
    assert best["sigma_dr (um)"][row] < 0.7 * best["sigma_dr (um)"][0]
    assert not any("another order" in str(one) for one in best.columns["problems"])


def test_the_free_space_between_parts_is_linear(found: Optimization) -> None:
    descent = Descent(found.evaluator, found.variables, found.objectives[0])
    start = descent.start(np.full(4, 0.5))
    _, slopes = descent.slopes(start)
    for u in ([0.0, 0.9, 0.2, 0.1], [1.0, 0.3, 0.8, 0.9]):
        gaps = inventory.gaps(descent.detector(np.array(u)))
        expected = start.margins[1:] + slopes[1:] @ (np.array(u) - 0.5)
        assert expected == pytest.approx((np.array(gaps) - 3) / 10, abs=1e-5)


def test_both_searches_find_the_same_optimum_and_keep_all_limits(found: Optimization) -> None:
    other = optimize(DESIGN, SPACE, **HOW, search=Search(method="cobyla"))
    for one in (found, other):
        (best,) = one.front
        assert one.columns["kind"][best] == "optimum"
        assert one["channels"][best] <= 10010
        assert one["gap (mm)"][best] >= 3 - 1e-5
    values = [one["sigma_dr (um)"][one.front[0]] for one in (found, other)]
    assert values[0] == pytest.approx(values[1], rel=2e-3)
    assert values[0] < 0.85 * found["sigma_dr (um)"][0]
    assert 0 < found.gradients <= found.evaluations < other.evaluations
    assert other.gradients == 0


def test_no_allowed_design_of_a_sample_is_better(found: Optimization) -> None:
    def numbers(detector: cg.Detector) -> dict[str, float]:
        return {"channels": inventory.channels(detector), "gap": inventory.smallest_gap(detector)}

    space = sobol(SPACE, 64)
    table = sweep(DESIGN, space, evaluate=Evaluation(p=0.3, samples=64, quantities=["dr"])).to_pandas()
    more = sweep(DESIGN, space, evaluate=numbers).to_pandas()
    allowed = (more["status"] == "ok") & (more["channels"] <= 10010) & (more["gap"] >= 3)
    assert allowed.sum() > 15
    best = found["sigma_dr (um)"][found.front[0]]
    assert table["sigma_dr (um)"][allowed].min() > best


def test_the_optimum_has_sheets_full_of_whole_strips(found: Optimization) -> None:
    layer = found.detector().cgem[0]
    assert layer.strips_x * layer.pitch_x == pytest.approx(2 * math.pi * layer.r_readout, rel=1e-7)
    before = found.detector(len(found) - 2).cgem[0]
    assert 2 * math.pi * before.r_readout - before.strips_x * before.pitch_x > 1e-3
    assert inventory.channels(found.detector()) == found["channels"][-1]


@pytest.mark.parametrize("preset", ["besiii-cgem-design", "besiii-cgem"])
@pytest.mark.parametrize("pitch", [700.0, 812.3, 555.5])
def test_as_many_strips_fill_the_sheet(preset: str, pitch: float) -> None:
    """Of `besiii-cgem` the V strips are centred: their offset follows from the pitch."""
    base = cg.load(preset)
    variables = (
        Variable("cgem.L1.pitch_x", 400.0, 900.0, unit="um"),
        Variable("cgem.L1.pitch_v", 400.0, 900.0, unit="um"),
    )
    before, after = (
        base.with_overrides({one.key: f"{value!r} um" for one, value in zip(variables, values, strict=True)}).cgem[0]
        for values in ((pitch, pitch), rounded(base, variables, (pitch, pitch)))
    )
    assert after.strips_x == before.strips_x
    width = (after.strips_x - 1) * after.pitch_x * math.cos(after.stereo)
    assert after.strips_v * after.pitch_v == pytest.approx(width + after.length * math.sin(abs(after.stereo)), rel=1e-6)


def test_strips_that_begin_off_the_corner_fill_the_rest_of_the_sheet() -> None:
    """With an offset of 7.5 strips, as many less fit across the X strips."""
    base = DESIGN.with_overrides({"cgem.L2.strips_v": 1000})
    variables = (Variable("cgem.L2.pitch_v", 500.0, 900.0, unit="um"), Variable("cgem.L2.offset_v", 0.0, 10.0))
    variables += (Variable("cgem.L2.strips_v", 900, 1100, whole=True),)
    pitch, *others = rounded(base, variables, (600.0, 7.5, 1000))
    assert others == [7.5, 1000]
    changes = {"cgem.L2.pitch_v": f"{pitch!r} um", "cgem.L2.offset_v": 7.5, "cgem.L2.strips_v": 1000}
    layer = base.with_overrides(changes).cgem[1]
    along = layer.strips_x * layer.pitch_x * math.cos(layer.stereo) + layer.length * math.sin(abs(layer.stereo))
    assert (layer.strips_v + 7.5) * layer.pitch_v == pytest.approx(along, rel=1e-7)


@pytest.mark.slow
def test_an_objective_without_tracks_ends_at_its_limit() -> None:
    best = optimize(
        DESIGN,
        {"cgem.*.pitch_x": ("300 um", "900 um"), "cgem.*.pitch_v": ("300 um", "900 um")},
        minimize="channels",
        constraints={"dr @ 0.3": (None, 320)},
        evaluate=Evaluation(p=[0.3, 1.0], samples=64),
    )
    assert best["sigma_dr at 0.3 GeV/c (um)"][best.front[0]] == pytest.approx(320, rel=2e-3)
    assert best["channels"][best.front[0]] < best["channels"][0]


@pytest.mark.slow
def test_an_optimum_without_an_allowed_design_says_so() -> None:
    none = optimize(
        DESIGN,
        {"cgem.*.pitch_x": ("500 um", "700 um")},
        constraints={"channels": (None, 100)},
        evaluate=Evaluation(samples=64),
    )
    assert none.front == []
    channels = none.columns["channels"]
    text = f"no design that was tried keeps all limits; the nearest one has channels {min(channels):g}, "
    assert f"{text}{min(channels) - 100:.3g} % above its limit 100" in none.message
    with pytest.raises(ValueError, match="expected the row of a design"):
        none.detector()


def test_every_problem_is_listed_at_once() -> None:
    space = {
        "cgem.L9.pitch_x": ("1 um", "2 um"),
        "cgem.*.foils": [1, 2],
        "cgem.L1.pitch_x": ("600 um", "1 rad"),
        "a": 3,
    }
    with pytest.raises(PlanError) as error:
        optimize(
            DESIGN,
            space,
            ["dr", "drr", "dz @ 0.7"],
            {"occupancy": (None, 1), "x0": (2, 1)},
            Evaluation(p=0.3),
            "gradient",
        )
    text = str(error.value)
    with pytest.raises(PlanError) as error:
        optimize(DESIGN, space, evaluate={"events": 0}, search={"method": "gradientt", "calls": -1, "tolerance": 2})
    text += str(error.value)
    for part in (
        "cgem.L9", "cgem.*.foils, which is a choice", "cgem.L1.pitch_x: got ('600 um', '1 rad')", "a: got 3",
        "'drr'", 'did you mean "dr"?', "'dz @ 0.7', expected one of p: 0.3", "background: got none",
        "constraints.x0: got (2, 1)", "for 3 objectives", "search.calls: got -1",
        "evaluate.events: got 0", "search.tolerance: got 2",
    ):  # fmt: skip
        assert part in text, part
    for given in ({"p": (0.3, 1.0)}, {"pt": 0.3}):
        with pytest.raises(PlanError, match=r"'dr @ 0\.3', expected no momentum: p has no fixed values"):
            optimize(DESIGN, {"cgem.L1.pitch_x": ("400 um", "650 um")}, "dr @ 0.3", evaluate=Evaluation(**given))


def test_an_optimum_with_charge_and_time_has_the_resolution_of_its_design() -> None:
    detector = cg.load(DESIGN).with_readout("tiger")
    space = {"cgem.*.pitch_x": ("500 um", "800 um"), "cgem.*.drift_gap": ("4 mm", "6 mm")}
    found = optimize(detector, space, minimize="dr", evaluate=Evaluation(p=0.5, samples=16), search=Search(calls=2))
    best = found.front[0]
    sigma = float(cg.analytic(found.detector(best), p=0.5, samples=16).sigma("dr"))
    assert found["sigma_dr (um)"][best] == pytest.approx(sigma, rel=1e-9)
    base = float(cg.analytic(DESIGN, p=0.5, readout="tiger", samples=16).sigma("dr"))
    assert sigma < base


def test_a_search_with_failed_evaluations_says_how_many(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(self: Goals, detector: cg.Detector) -> dict[str, Any]:
        raise ValueError("never")

    monkeypatch.setattr(Goals, "__call__", fails)
    space = {"cgem.*.pitch_x": ("600 um", "700 um")}
    search = Search(method="nsga2", population=4, calls=0)
    found = optimize(DESIGN, space, minimize="channels", evaluate=Evaluation(samples=2), search=search)
    assert found.message.startswith("0 calls; no design could be evaluated; 4 of 4 evaluations failed, the first")
    row = {"status": "failed", "problems": ["ValueError: never"]}
    designs = [Design(1, "value", (1.0,), {"status": "ok"}), Design(2, "value", (2.0,), row)]
    ended = "Optimization terminated; 1 of 2 evaluations failed, the first with ValueError: never"
    assert with_failures("Optimization terminated successfully", designs) == ended
    assert with_failures("Optimization terminated successfully", designs[:1]) == "Optimization terminated successfully"


def test_a_search_counts_its_failed_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    own = Goals.__call__

    def fails(self: Goals, detector: cg.Detector) -> dict[str, Any]:
        if detector.cgem[0].pitch_x > 0.8:
            raise ValueError("too wide")
        return own(self, detector)

    monkeypatch.setattr(Goals, "__call__", fails)
    found = optimize(
        DESIGN,
        {"cgem.*.pitch_x": ("600 um", "1 mm")},
        minimize="channels",
        evaluate=Evaluation(samples=2),
        search=Search(method="cobyla"),
    )
    failed = found.columns["status"].count("failed")
    assert failed > 0
    assert f"; {failed} of {found.evaluations} evaluations failed, the first with ValueError: too wide" in found.message
    assert "successfully" not in found.message


def test_ends_of_a_range_may_have_different_units() -> None:
    problems = Problems()
    (one, same) = (
        variables_of(DESIGN, {"cgem.*.pitch_x": ends}, problems)[0]
        for ends in (("400 um", "1 mm"), ("400 um", "1000 um"))
    )
    assert (problems, one) == ([], same)
    assert sobol({"a": ("400 um", "1 mm")}, 4) == sobol({"a": ("400 um", "1000 um")}, 4)
    for wrong in (("400 um", "1 rad"), ("400 um", 1000), ("400 um", "x2"), ("1 mm", "400 um")):
        assert variables_of(DESIGN, {"cgem.*.pitch_x": wrong}, problems) == ()
    assert len(problems) == 4
    assert variables_of(DESIGN, {"cgem.*.pitch_x": ("1 rad", "2 rad")}, problems) == ()
    assert "cgem.L1.pitch_x: got" in str(problems[4])
    assert "expected a length" in str(problems[4])


def test_the_row_of_the_base_shows_its_own_values_and_the_search_starts_there() -> None:
    space = {
        "drift_chamber.sigma": ("100 um", "200 um"),
        "cgem.L2.anode_radius": ("140 mm", "155 mm"),
        "cgem.*.length": ("500 mm", "510 mm"),
        "cgem.*.pitch_x": ["500 um", "650 um"],
        "cgem.*.pitch_v": ["500 um", "900 um"],
        "cgem.*.gas": ["MdcGas", "CgemGas"],
        "cgem.L1.foils": [1, 2],
    }
    variables = variables_of(DESIGN, space, problems := Problems())
    assert not problems
    own = [130.0, 132.5, math.nan, "650 um", "0.65 mm", "CgemGas", 3.0]
    assert [one.own(DESIGN) for one in variables] == pytest.approx(own, nan_ok=True)
    starts = [130.0, 147.5, 505.0, "650 um", "500 um", "CgemGas", 1]
    assert [one.start(DESIGN) for one in variables] == pytest.approx(starts)
    thin = DESIGN.with_overrides({"drift_chamber.sigma": "120 um"})
    found = optimize(thin, {"drift_chamber.sigma": "bounds"}, "x0", search="cobyla")
    assert found.columns["drift_chamber.sigma (mm)"][:2] == [0.12, 0.12]


def test_wrong_types_are_problems_of_their_arguments() -> None:
    with pytest.raises(PlanError) as error:
        optimize(
            DESIGN, [], 3, [1], {"method": "both", "p": ["1 GeV", "x", None], "samples": 0}, "gradientt", {"rat": 3},
        )  # type: ignore[arg-type]  # fmt: skip
    for part in (
        "space: got []", "minimize: got 3", 'p[0]: got "1 GeV"', 'p[1]: got "x"', "p[2]: got None",
        "constraints: got [1]", "background.rat: got an unknown key",
        'did you mean "gradient"?', "evaluate.method: got 'both'", "samples: got 0",
    ):  # fmt: skip
        assert part in str(error.value), part


def test_swapped_and_equal_ends_say_so() -> None:
    for ends, expected in ((("100 mm", "80 mm"), "the lower end first"), (("8 cm", "80 mm"), "two different ends")):
        with pytest.raises(PlanError, match=rf"cgem.L1.anode_radius: got \(.*, expected {expected}"):
            optimize(DESIGN, {"cgem.L1.anode_radius": ends})
    with pytest.raises(PlanError, match=r"constraints.gap: got \(5, 3\), expected the lower limit first"):
        optimize(DESIGN, SPACE, constraints={"gap": (5, 3)})


@pytest.mark.parametrize("method", ["gradient", "cobyla"])
def test_the_best_of_several_starts_counts(method: Any) -> None:
    # Below 107 mm is no room for L2: no search starts there.
    space = {"cgem.L2.anode_radius": ("80 mm", "155 mm"), "cgem.L1.pitch_x": ("400 um", "1000 um")}
    searches = [Search(method=method, starts=n, steps=20, seed=2) for n in (1, 3)]
    one, three = (optimize(DESIGN, space, search=how, evaluate=Evaluation(p=0.3, samples=64)) for how in searches)
    assert three.message.startswith("the best of 3 starts: ")
    assert three.columns["kind"].index("optimum") == len(three) - 1 >= 2 * (len(one) - 1)
    assert three.columns["call"] == list(range(len(three)))
    optima = [found["sigma_dr (um)"][found.front[0]] for found in (one, three)]
    assert optima[1] <= optima[0]
    names = [name for name, kind in zip(three.columns["name"], three.columns["kind"], strict=True) if kind == "value"]
    assert len(set(names)) >= 4  # the three starts and an end


def test_an_impossible_start_is_a_problem() -> None:
    space = {"cgem.L1.anode_radius": ("110 mm", "115 mm"), "cgem.L2.anode_radius": ("105 mm", "110 mm")}
    with pytest.raises(PlanError, match=r"start\..*no overlap with cgem.L2"):
        optimize(DESIGN, space, evaluate=Evaluation(samples=64))


def test_simulation_confirms_the_optimum(found: Optimization) -> None:
    confirmed = found.confirm(events=3000)
    assert confirmed["design"].tolist() == [0, found.front[0]]
    assert (np.abs(confirmed["ratio"] - 1) < 4 * confirmed["ratio_error"]).all()
    assert confirmed["ratio_error"].max() < 0.02
    # The same tracks in both: the gain is known better than from two samples.
    gain, error = confirmed["to_base"][1], confirmed["to_base_error"][1]
    assert gain == pytest.approx(found["sigma_dr (um)"][found.front[0]] / found["sigma_dr (um)"][0], abs=4 * error)
    assert error < math.hypot(*confirmed["ratio_error"])


@pytest.mark.slow
def test_a_confirmation_expects_what_its_tracks_have() -> None:
    space = {"cgem.L1.anode_radius": ("80 mm", "100 mm")}
    found = optimize(DESIGN, space, evaluate=Evaluation(), search=Search(steps=1))
    (ratio,), (error,) = (found.confirm([0], events=30_000, seed=2)[name] for name in ("ratio", "ratio_error"))
    assert abs(ratio - 1) < 3 * error < 0.02  # 0.96 if the fit allows for delta electrons that are not simulated
    full = found.confirm([0], events=100, fluctuations="full")
    assert full.columns["expected"] == full.columns["optimized"]


def test_the_picture_shows_every_allowed_design_and_the_best_so_far(found: Optimization) -> None:
    (axes,) = found.draw().axes
    table = found.to_pandas()
    allowed = table[table["allowed"]]
    (container,) = axes.containers
    assert container.lines[0].get_ydata().tolist() == allowed["sigma_dr (um)"].tolist()
    (best,) = [one for one in axes.lines if one.get_drawstyle() == "steps-post"]
    assert best.get_ydata()[-1] == allowed["sigma_dr (um)"].min()
    assert axes.get_ylabel() == r"σ($d_\rho$)  (µm)"


def test_the_result_is_the_same_after_an_interruption(tmp_path: Path) -> None:
    folder = tmp_path / "out"

    def stop(share: float, text: str) -> None:
        if share > 0.02:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        optimize(DESIGN, SPACE, output=folder, progress=stop, **HOW)
    kept = len(list((folder / "chunks").iterdir()))
    assert 0 < kept < 8
    again = optimize(DESIGN, SPACE, output=folder, **HOW)
    whole = optimize(DESIGN, SPACE, output=tmp_path / "whole", **HOW)
    assert (folder / "optimize.csv").read_bytes() == (tmp_path / "whole" / "optimize.csv").read_bytes()
    assert (
        cg.load(folder / "optimum.toml").content_hash == again.detector().content_hash == whole.detector().content_hash
    )


PLAN = """
base = "besiii-cgem-design"
minimize = "dr"
[vary]
"cgem.L2.anode_radius" = { from = "105 mm", to = "155 mm" }
"cgem.L1.pitch_x" = "bounds"
[constraints]
channels = { max = 10010 }
[evaluate]
p = "300 MeV/c"
samples = 64
"""


def test_the_command_line_writes_what_python_returns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan, output = tmp_path / "plan.toml", tmp_path / "out"
    plan.write_text(PLAN)
    command = ["optimize", str(plan), "-o", str(output), "--quiet", "--confirm", "500", "--json"]
    assert main([*command, "--set", "search.method=cobyla", "--set", "search.tolerance=0.05"]) == 0
    summary = json.loads(capsys.readouterr().out)
    table = pd.read_csv(output / "optimize.csv")
    assert summary["inputs"]["vary"]["cgem.L1.pitch_x"] == [0.01, 20.0, "mm"]
    assert summary["evaluations"] == len(table) - 1
    assert table["sigma_dr (um)"].iloc[-1] == pytest.approx(summary["best"][0]["sigma_dr (um)"], rel=1e-5)
    assert {path.suffix for path in output.glob("convergence.*")} == {".png", ".pdf"}
    assert len(pd.read_csv(output / "confirmation.csv")) == 2
    stored = str(output / "plan.toml")
    assert list(read_optimize_plan(stored).arguments["space"]) == ["cgem.L2.anode_radius", "cgem.L1.pitch_x"]
    assert main(["optimize", stored, "-o", str(output), "--quiet"]) == 0


def test_the_plans_of_the_documentation_run(tmp_path: Path) -> None:
    plans = Path(__file__).resolve().parents[4] / "docs" / "plans"
    page = (plans.parent / "how-to" / "optimize.md").read_text()
    keys = [*KEYS, *(one.name for cls in (Evaluation, Search, Background) for one in dataclasses.fields(cls))]
    unsaid = [key for key in keys if f"`{key}`" not in page and f"[{key}" not in page]
    assert set(unsaid) <= {"quantities", "chunk"}  # which an optimization sets itself
    result = read_optimize_plan(plans / "front.toml", {"search.calls": 0, "search.population": 4}).run()
    assert len(result) == 5
    assert read_optimize_plan(plans / "optimum.toml").arguments["constraints"] == LIMITS
    _, plan = (plans / "optimum.toml").read_text().split("\n", 1)
    assert f"```toml\n{plan}```\n" in page


@pytest.mark.slow
def test_processes_find_what_one_process_finds(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(PLAN + "[search]\nmethod = 'nsga2'\npopulation = 12\noffspring = 6\ncalls = 2\n")
    assert main(["optimize", str(plan), "-o", str(tmp_path / "one"), "--quiet", "--threads", "1"]) == 0
    assert main(["optimize", str(plan), "-o", str(tmp_path / "two"), "--quiet", "--processes", "2"]) == 0
    assert (tmp_path / "one/optimize.csv").read_bytes() == (tmp_path / "two/optimize.csv").read_bytes()


def test_the_command_line_refuses_other_folders_and_lists_problems(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(
        PLAN.replace("[vary]", "[vary]\nnothing = 1").replace("minimize", "minimise") + "x = 1\n[search]\ny = 2"
    )
    assert main(["optimize", str(plan), "-o", str(tmp_path / "new")]) == 2
    error = capsys.readouterr().err
    assert all(part in error for part in ("minimise: got an unknown key", "evaluate.x: got an", "search.y: got an"))
    plan.write_text(PLAN)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "file").write_text("")
    assert main(["optimize", str(plan), "-o", str(tmp_path / "foreign")]) == 2
    assert "already holds files" in capsys.readouterr().err
    sweep(DESIGN, [{}], evaluate=lambda detector: {"a": 1}, output=tmp_path / "sweep")
    assert main(["optimize", str(plan), "-o", str(tmp_path / "sweep")]) == 2
