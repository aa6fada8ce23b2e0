"""Pictures of the error budget and of the sensitivities: every artist against its data."""

from dataclasses import replace

import numpy as np
import pytest

import cgemit as cg
from cgemit.draw import draw_budget, draw_sensitivity

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
    symbol = {"dr": r"$d_\rho$", "p": "p", "dz": "$d_z$", "pt": "$p_T$"}[quantity]
    assert axes.get_ylabel() == f"share of the variance of {symbol}  (%)"
    assert axes.get_xlabel() == "p  (GeV/c)"
    assert axes.get_title(loc="left") == f"{DESIGN}, mu-, cos θ = 0.2"
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
    for point, p in enumerate((0.3, 1.0)):
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
        assert axes.get_xlabel() == "change of the resolution for 1 % more  (%)"
        assert axes.get_title(loc="left") == f"{DESIGN}, mu-, p = {p:g} GeV/c, cos θ = 0.2"


def test_numbers_that_cannot_be_changed_have_no_bar(sensitivity):
    values = sensitivity.values.copy()
    values[1] = np.nan
    (axes,) = draw_sensitivity(replace(sensitivity, values=values), most=2).axes
    found = [text.get_text() for text in axes.get_yticklabels()]
    assert len(found) == 2
    assert "field.bz" not in found


def test_what_cannot_be_drawn_is_refused(covariance, sensitivity):
    with pytest.raises(ValueError, match=r"momenta of shape \(1,\).*expected a list of two momenta"):
        draw_budget(cg.analytic(DESIGN, p=[1.0], samples=2).budget("p"))
    with pytest.raises(ValueError, match="expected a list of two momenta or more at one cos"):
        draw_budget(cg.analytic(DESIGN, p=[0.5, 1.0], cos_theta=[0.0, 0.5], samples=2).budget("p"))
    with pytest.raises(ValueError, match="by: got 'layer'"):
        draw_budget(covariance.budget("p"), "layer")
    with pytest.raises(ValueError, match="got point 2, most 15; expected a point from 0 to 1"):
        draw_sensitivity(sensitivity, point=2)
    with pytest.raises(ValueError, match="got no derivative"):
        draw_sensitivity(replace(sensitivity, values=np.full_like(sensitivity.values, np.nan)))
