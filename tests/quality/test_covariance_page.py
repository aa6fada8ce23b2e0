"""docs/methods/covariance_checks.md is what validation/results/covariance.csv says, and that covers the whole grid.

What the program does now is compared in tests/physics/test_covariance_widths.py.
"""

from __future__ import annotations

import dataclasses

import pytest
from sources import ROOT

import covariance
from cgemit.tables.show import with_error
from covariance import MODES, QUANTITIES, Ratio, page, points
from results import FOLDER, read_rows

ROWS, ABOUT = read_rows(FOLDER / covariance.FILE, Ratio)


def test_page_is_up_to_date() -> None:
    """Write it anew with `python validation/covariance.py --page`."""
    assert page(ROWS, ABOUT) == (ROOT / "docs/methods/covariance_checks.md").read_text(encoding="utf-8")
    assert (ROOT / "docs/images" / covariance.PICTURE).exists()


def test_results_hold_the_whole_grid() -> None:
    found = [(row.mode, row.detector, row.particle, row.p, row.cos_theta, row.quantity) for row in ROWS]
    assert found == [(*point, quantity) for point in points() for quantity in QUANTITIES]
    assert int(ABOUT["tracks"]) == 50_000


def test_a_ratio_that_is_off_is_named() -> None:
    good = [dataclasses.replace(row, simulated=row.analytic) for row in ROWS]
    assert page(good, ABOUT).count("None.") == len(MODES)
    for mode, limit in (("gaussian", 0.02), ("default", 0.05)):
        row = next(row for row in good if row.mode == mode)
        off = dataclasses.replace(row, simulated=row.analytic / (1 + 1.5 * limit), simulated_error=1e-4 * row.analytic)
        assert off.fails
        assert not dataclasses.replace(off, simulated_error=limit * row.analytic).fails
        text = page([off, *good[1:]], ABOUT)
        place = f"| {row.detector} | {row.particle} | {row.p:g} | {row.cos_theta:g} | {row.quantity} |"
        assert f"{place} {with_error(off.ratio, off.error)} |" in text


@pytest.mark.slow
def test_the_picture_shows_every_gaussian_ratio() -> None:
    axes = covariance.draw(ROWS).get_axes()
    assert [plot.get_title() for plot in axes] == list(QUANTITIES)
    for plot, quantity in zip(axes, QUANTITIES, strict=True):
        drawn = sorted(float(line.get_ydata()[0]) for line in plot.lines if line.get_marker() not in ("None", "", None))
        assert drawn == sorted(row.ratio for row in ROWS if (row.mode, row.quantity) == ("gaussian", quantity))
