"""Programs that measure read what they measure with, and write what they promise."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from cgemit.base import isa
from cgemit.detector import field_at, load
from pages.page import MissingToolError, Numbers, Page
from pages.performance import PAGE, blocks, electrons, peers, scaling, stages
from pages.performance.timing import DETECTOR, GUN, fastest, instruction_set


def test_stages_do_the_work_that_is_timed() -> None:
    calls = stages.stage_calls(load(DETECTOR), GUN, 200)
    assert len(calls["simulate"]()["truths"]) >= 590
    assert len(calls["cluster"]()) > 1700
    for name in ("fit", "fit_lr"):
        fitted = calls[name]()
        assert np.mean(fitted["tracks"]["status"] == 0) > 0.99
        assert len(fitted["residuals"]) > 200 * 30, "the smoother is part of the fit"
    assert list(calls) == list(stages.STAGES)


def test_kernels_do_the_work_that_is_timed() -> None:
    calls = stages.stage_calls(load(DETECTOR), GUN, 200)
    assert len(calls["simulate_kernel"]()["truths"]["event"]) >= 590
    two, found_out = calls["fit_kernel"](), calls["fit_lr_kernel"]()
    assert np.mean(two["iterations"] == 2) > 0.99
    assert np.mean(found_out["status"] == 0) > 0.99
    for fitted in (two, found_out):
        assert np.mean(fitted["err"] > 0) > 0.9, "residuals are part of the fit"


def test_instruction_set_is_the_one_asked_for_and_only_for_a_while() -> None:
    before = isa.name()
    for name in isa.available():
        with instruction_set(name):
            assert isa.name() == name
    assert isa.name() == before


def test_fastest_run_counts_and_calls_take_turns() -> None:
    order: list[str] = []
    ticks = iter([0.0, 5.0, 5.0, 6.0, 6.0, 8.0, 8.0, 11.0])
    calls = {name: lambda name=name: order.append(name) for name in ("a", "b")}
    assert fastest(calls, 2, lambda: next(ticks)) == {"a": 2.0, "b": 1.0}
    assert order == ["a", "b", "a", "b"]


def test_threads_are_timed_together() -> None:
    times = stages.stage_times(2, events=20, runs=1)
    assert list(times) == [f"{name}_us" for name in stages.STAGES]
    assert all(value > 0 for value in times.values())


def test_a_part_that_lacks_a_tool_stays_as_it_is(tmp_path: Path) -> None:
    def lacking(share: float) -> Numbers:
        raise MissingToolError("it needs a tool")

    page = Page("one", PAGE.file, "", {"chain": (stages.Chain, lacking)})
    assert page.measure(tmp_path) == ["one: chain is not renewed: it needs a tool"]
    assert not list(tmp_path.iterdir())


def test_the_chain_is_timed_stage_by_stage() -> None:
    """Every stage of the chain has its time, and together they take no longer than the whole."""
    cost = stages.chain_times(20)
    assert list(cost) == [*stages.CHAIN, "all"]
    assert all(value > 0 for value in cost.values())
    assert sum(cost[name] for name in stages.CHAIN) < cost["all"]


def test_times_are_labelled_with_plain_numbers() -> None:
    found = PAGE.read()
    for name, ends in {"performance-stages.png": (1, 20), "performance-tracks.png": (2, 50)}.items():
        figure = PAGE.pictures[name](found)
        (axes,) = figure.axes
        low, high = axes.get_ylim()
        texts = [text for at, text in zip(axes.get_yticks(), axes.get_yticklabels(), strict=True) if low <= at <= high]
        numbers = [float(text.get_text()) for text in texts]
        assert set(ends) <= set(numbers) <= {0.5, 1, 2, 5, 10, 20, 50, 100}
        assert not any(text.get_text() for text in axes.get_yticklabels(minor=True))
        plt.close(figure)


def test_exponents_are_those_of_power_laws() -> None:
    n = np.array([1.0, 4.0, 16.0, 64.0])
    assert scaling.exponent(n, 50 * n**0.4) == pytest.approx((0.4, 50))


def test_scaling_measures_all_that_the_page_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small samples: every number has a time, and fewer wire layers take less."""
    small = {"IN_ALL": 16, "TRACKS": (1, 4), "MUONS": 300, "LAYERS": (12, 112), "THREADED": 200, "RUNS": 2}
    for name, value in small.items():
        monkeypatch.setattr(scaling, name, value)
    assert [len(scaling.with_wire_layers(n).drift_chamber.layers) for n in scaling.LAYERS] == [12, 112]
    rows = scaling.measure(1).rows
    assert {row.what for row in rows} | {"events"} == set(scaling.TIMES)
    of_layers = {row.n: row.us for row in rows if row.what == "layers"}
    assert 0 < of_layers[12] < of_layers[112]
    assert all(row.us > 0 for row in rows)


def test_scaling_draws_its_numbers() -> None:
    found = PAGE.read()
    figure = PAGE.pictures["performance-scaling.png"](found)
    for axes, what in zip(figure.axes, ("tracks", "layers"), strict=True):
        own = [row for row in found["scaling"].rows if row.what == what]
        points, line = axes.get_lines()
        assert points.get_xydata().tolist() == [[row.n, row.us] for row in own]
        power, start = scaling.exponent([row.n for row in own], [row.us for row in own])
        assert line.get_ydata() == pytest.approx([start * row.n**power for row in own])
        assert f"{power:.2f}" in line.get_label()
        assert "µs" in axes.get_ylabel()
    plt.close(figure)


def test_muons_are_found_by_momentum_and_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "IN_ALL", 4)
    momentum, measurements = np.array([1.0, 1.09, 1.11, 0.95, 0.0]), np.array([20, 38, 38, 19, 38])
    assert peers.found(momentum, measurements, 1.0) == 0.5


def test_both_programs_find_the_muons(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("acts")
    monkeypatch.setattr(peers, "IN_ALL", 40)
    detector = load(DETECTOR)
    built = peers.geometry(peers.cylinders(detector), tmp_path)
    theirs, ours = peers.find_acts(built, tmp_path, 4, 1, 1.0, 0.8), peers.find_cgemit(detector, 4, 1.0, 0.8)
    assert theirs["found"] >= 0.95
    assert ours["found"] >= 0.95
    assert all(theirs[name] > 0 for name in (*peers.SEEDING, *peers.FOLLOWING))
    assert ours["find"] > 0
    assert ours["fit"] > 0


def test_both_programs_have_the_same_field(tmp_path: Path) -> None:
    acts = pytest.importorskip("acts")
    field = peers.acts_field("finite-solenoid", tmp_path)
    cache = field.makeCache(acts.MagneticFieldContext())
    points = [(0.0, 0.0, 0.0), (300.0, 0.0, 500.0), (705.0, 0.0, -1010.0)]
    theirs = [list(field.getField(acts.Vector3(*point), cache)) for point in points]
    ours = field_at(load(DETECTOR).with_field("finite-solenoid"), points)
    np.testing.assert_allclose(np.array(theirs) / acts.UnitConstants.T, -ours, atol=2e-4)


def test_tables_of_peers_show_what_was_measured() -> None:
    found = PAGE.read()
    rows = found["peers_finding"].rows
    shown = _cells(blocks(found)["peers-finding"])
    assert len(shown) == len(rows) == len(peers.TRACKS)
    for cells, row in zip(shown, rows, strict=True):
        acts, own = row.acts_seeding_us + row.acts_ckf_us, row.find_us + row.fit_us
        assert cells[0] == str(row.tracks)
        assert float(cells[3].rstrip("%")) == pytest.approx(100 * row.acts_found, abs=0.051)
        assert float(cells[6].rstrip("%")) == pytest.approx(100 * row.found, abs=0.051)
        assert float(cells[7]) == pytest.approx(acts / own, abs=0.051)


def test_the_table_of_electrons_shows_what_was_measured() -> None:
    found = PAGE.read()
    rows = found["electrons"].rows
    shown = _cells(blocks(found)["electrons"])
    assert [row.program for row in rows] == [
        "ACTS, Kalman filter", "ACTS, Gaussian-sum filter", "cgemit"
    ] * len(electrons.MOMENTA)  # fmt: skip
    for cells, row in zip(shown, rows, strict=True):
        core, _, error = cells[2].partition(" ± ")
        numbers = [float(text.replace("−", "-")) for text in (core, error, cells[3], cells[5])]
        assert numbers == pytest.approx([row.core, row.core_error, row.centre, row.q95], abs=0.051)
        assert numbers[0] == pytest.approx(row.core, abs=0.00051)
        shares = [float(text) for cell in (cells[4], cells[6]) for text in cell.split(", ")]
        expected = [row.within_1, row.within_2, row.within_5, row.in_68, row.in_95]
        assert shares == pytest.approx(expected, abs=0.051)
        assert float(cells[7]) == pytest.approx(row.us, rel=0.006)
        assert float(cells[8]) == pytest.approx(row.us / row.muon_us, abs=0.051)


def test_photons_of_a_mixture_have_the_spectrum_of_the_pdg() -> None:
    """Per X/X0, y dN/dy = 4/3 (1 - y) + y^2 has the integral 1, and y^2 dN/dy 4/3 (1/2 - 1/3) + 1/4 = 17/36."""
    (found,) = electrons.mixture()["ranges"]
    x = 0.01
    weight, mean, variance = (
        np.array([np.polyval(part[f"{name}_coeffs"], x) for part in found["components"]])
        for name in ("weight", "mean", "var")
    )
    assert weight.sum() == pytest.approx(1)
    assert np.sum(weight * (1 - mean)) == pytest.approx(x, rel=0.01)
    assert np.sum(weight * (variance + (1 - mean) ** 2)) == pytest.approx(17 / 36 * x, rel=0.02)
    assert (np.diff(mean[1:]) < 0).all()


def test_intervals_that_hold_the_truth_are_counted() -> None:
    low, high = np.array([-1.0, 0.5, -2.0, -1.0, -1.0]), np.array([1.0, 2.0, -1.0, 0.0, np.nan])
    assert electrons.covered(low, high) == 60  # an interval without an upper end (nan) holds all above its lower one


def test_both_programs_fit_electrons(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("acts")
    monkeypatch.setattr(electrons, "EVENTS", 1)
    detector = load(DETECTOR).with_field("uniform")
    built = peers.geometry(peers.cylinders(detector), tmp_path)
    theirs = electrons.run_acts(built, tmp_path, 1.0, 1, "eElectron")
    ours, us = electrons.run_cgemit(detector, 1.0, 1, "e-")
    assert set(theirs) == {"Kalman filter", "Gaussian-sum filter"}
    assert us > 0
    for off, error, time in theirs.values():
        assert len(off) == len(error) > 90
        assert abs(np.median(off)) < 0.01
        assert time > 0
    assert abs(np.median(ours["p"]) - 1) < 0.01


def _cells(table: str) -> list[list[str]]:
    """Return the cells of the rows below the head of a table."""
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.strip().splitlines()[2:]]
