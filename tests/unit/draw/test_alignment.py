"""Pictures of alignment show the numbers of the result."""

from __future__ import annotations

import numpy as np
import pytest

import cgemit as cg

MUONS = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
NOMINAL = cg.load("besiii-cgem-design").with_readout("gaussian")


@pytest.fixture(scope="module")
def found() -> cg.Alignment:
    real = NOMINAL.with_alignment({"cgem.L1.shift_z": 0.5})
    return cg.align(
        cg.run(real, MUONS, n=200, fit_detector=NOMINAL), cg.AlignmentSettings(free=("cgem.L1", "cgem.L2.shift_z"))
    )


def test_errors_and_convergence(found: cg.Alignment) -> None:
    errors, steps = cg.draw.draw_constants(found).axes
    heights = sorted(bar.get_height() for bar in errors.patches)
    units = np.where(np.array(found.table.unit) == "mm", 1e3, 1e6)
    np.testing.assert_allclose(heights, sorted(units * found.table.err))
    assert list(steps.lines[0].get_ydata()) == [one.step for one in found.history]


def test_residuals_before_and_after(found: cg.Alignment) -> None:
    (axes,) = cg.draw.draw_residual_means(found).axes
    before, after = (np.asarray(one[0].get_ydata()) for one in axes.containers)
    names = [label.get_text() for label in axes.get_xticklabels()]
    assert names == [f"L{i} {view}" for i in (1, 2, 3) for view in "XV"]
    assert abs(before[1]) > 50  # um, V of the displaced layer
    assert np.abs(after).max() < 0.3 * np.abs(before).max()


def test_modes_are_arrows(found: cg.Alignment) -> None:
    picture = cg.draw.draw_modes(found, 2)
    assert len(picture.axes) == 4
    assert found.modes(2).names[0] in picture.axes[0].get_title()
