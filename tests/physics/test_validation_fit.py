"""Pulls, chi-square, residuals, losses and sides of fitted tracks within the tolerances of docs/validation.md.

Points, seeds and tolerances are those of `python -m pages renew fit`; here with fewer points and tracks. Widths are
compared with the optimum in test_optimal_estimate.py.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

import cgemit as cg
from cgemit.chain.result import Result
from pages import fit
from pages.fit import (
    ANGLES,
    DETECTORS,
    MODES,
    MOMENTA,
    PARTICLES,
    FitResults,
    Point,
    failures,
    grid,
    measure_losses,
    measure_point,
    measure_sides,
    wrong_sides,
)  # fmt: skip

TRACKS = 1000


def some_points() -> list[Point]:
    """Return one point of the grid for each mode, detector and momentum, with angles and particles in turn.

    Without tracks of 0.1 GeV/c at cos(theta) 0.8: they turn back after 0.4 m, and the page lists by how much they are
    off, and why.
    """
    groups: dict[tuple[str, str, float], list[Point]] = {}
    for point in grid():
        if (point.p, point.cos_theta) != (0.1, 0.8):
            groups.setdefault((point.mode, point.detector, point.p), []).append(point)
    return [points[7 * i % len(points)] for i, points in enumerate(groups.values())]


POINTS = some_points()


@pytest.fixture(autouse=True)
def no_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the independent calculation, which takes longer than everything else."""
    monkeypatch.setattr(fit, "_has_optimum", lambda point: False)


def results(point: Point, tracks: int = TRACKS) -> FitResults:
    """Return what the validation measures at a point."""
    pulls, chi2, residuals, widths = measure_point(point, tracks, 2, some=3)
    return FitResults(pulls, [chi2], residuals, widths, losses=[], sides=[], known=[])


def rows_off(found: FitResults) -> set[str]:
    """Return which rows do not agree."""
    return {text.partition(": ")[0] for text in failures(found)}


def test_points_cover_the_grid() -> None:
    assert {(point.mode, point.detector) for point in POINTS} == {(point.mode, point.detector) for point in grid()}
    assert {point.p for point in POINTS} == set(MOMENTA)
    assert {point.cos_theta for point in POINTS} == set(ANGLES)
    assert {point.particle for point in POINTS} == set(PARTICLES)


@pytest.mark.parametrize("point", POINTS, ids=Point.label)
def test_point_agrees(point: Point) -> None:
    found = results(point)
    assert len(found.pulls) >= 5
    assert bool(found.residuals) == (point.mode == "gaussian")
    # Of the 2000 rows of all points one is beyond four standard errors in every tenth set of seeds.
    off = rows_off(found)
    assert not off or not off & rows_off(results(point, 10 * TRACKS))


def test_every_gate_sees_errors_that_are_a_sixth_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    right = cg.run

    def wrong(*arguments: object, **more: object) -> Result:
        result = right(*arguments, **more)
        pulls = {name: 1.2 * result.matches[name] for name in result.matches.columns if name.startswith("pull_")}
        matches = result.matches.with_columns(**pulls)
        tracks = result.fitted.with_columns(chi2=1.44 * result.fitted["chi2"])
        assert result.residuals is not None
        residuals = result.residuals.with_columns(pull=1.2 * result.residuals["pull"])
        return replace(result, tables={**result.tables, "matches": matches, "tracks": tracks, "residuals": residuals})

    monkeypatch.setattr(cg, "run", wrong)
    found = results(Point("gaussian", DETECTORS[0], "mu-", 1.0, 0.5))
    assert not any(row.agrees for rows in (found.pulls, found.chi2, found.residuals) for row in rows)


def test_strips_and_tails_are_not_gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where simulation and readout are not what the fit assumes, pulls of slow tracks are too wide."""
    monkeypatch.setitem(MODES, "gaussian", MODES["default"])
    assert failures(results(Point("gaussian", DETECTORS[0], "mu-", 0.2, 0.5)))


@pytest.mark.slow
def test_default_loss_leaves_kappa_unbiased() -> None:
    """The most probable loss does not, up to 0.5 GeV/c."""
    rows = measure_losses(2000, 2)
    assert len([row for row in rows if row.loss == "truncated"]) == 4
    assert all(row.agrees for row in rows)
    biased = [replace(row, loss="truncated") for row in rows if row.loss == "most_probable" and row.p <= 0.5]
    assert len(biased) == 3
    assert not any(row.agrees for row in biased)


def test_sides_are_found_at_no_cost() -> None:
    sides, known = measure_sides(2000, 2)
    assert len(known) == 2
    for row in known:
        assert row.agrees
        assert not replace(row, ratio=1.1 * row.ratio).agrees
        assert wrong_sides(sides, row.p) < 1e-3


def test_wires_that_measure_badly_hide_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    worse = cg.load(DETECTORS[0]).with_overrides({"drift_chamber.sigma": "0.4 mm"})
    monkeypatch.setattr(fit, "DETECTORS", (worse,))
    sides, known = measure_sides(500, 2)
    assert all(wrong_sides(sides, row.p) > 1e-3 for row in known)
