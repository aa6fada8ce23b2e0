"""The usual forms of resolution curves, fitted to curves with known parameters."""

import json
import math

import numpy as np
import pytest

from cgemit.analysis.resolutions import FORMS, fit_form, mean_sine
from cgemit.particles.species import species

P = np.linspace(0.2, 2.0, 19)
COSINE = 0.6


def exact(quantity, a, b, particle="pi+"):
    """Return the form itself, written out."""
    sine = math.sqrt(1 - COSINE**2)
    if quantity == "pt_rel":
        return np.hypot(a * P * sine, b)
    beta = P / np.hypot(P, species(particle).mass)
    return np.hypot(a, b / (P * beta * sine ** {"dr": 1.5, "dz": 2.5}[quantity]))


@pytest.mark.parametrize("quantity", list(FORMS))
@pytest.mark.parametrize(("a", "b"), [(0.7, 0.4), (120.0, 30.0), (0.3, 0.0), (0.0, 0.5)])
def test_known_parameters_come_back(quantity, a, b):
    y = exact(quantity, a, b)
    for error in (None, 0.02 * y):
        found = fit_form(quantity, P, y, error, particle="pi+", cos_theta=COSINE)
        # A parameter that is zero is found as the root of a square that is zero to rounding.
        np.testing.assert_allclose([found.a, found.b], [a, b], rtol=1e-5, atol=1e-3 * max(a, b))
        assert found.deviation < 1e-5
        assert found.points == 19


@pytest.mark.parametrize("quantity", list(FORMS))
def test_errors_cover_the_parameters(quantity):
    """Of 400 curves with Gaussian errors, a and b spread by their errors, and chi2 has its mean."""
    rng = np.random.default_rng(3)
    y = exact(quantity, 0.7, 0.4)
    error = 0.01 * y
    fits = [fit_form(quantity, P, rng.normal(y, error), error, particle="pi+", cos_theta=COSINE) for _ in range(400)]
    for name, true in (("a", 0.7), ("b", 0.4)):
        pull = np.array([(getattr(one, name) - true) / getattr(one, f"{name}_error") for one in fits])
        assert abs(pull.mean()) < 4 / 20
        assert abs(pull.std() - 1) < 4 / math.sqrt(800)
    assert abs(np.mean([one.chi2 for one in fits]) - 17) < 4 * math.sqrt(34 / 400)


def test_a_curve_without_errors_has_equal_relative_weights():
    y = exact("dr", 0.7, 0.4) * (1 + 0.05 * np.sin(7 * P))
    free, weighted = (fit_form("dr", P, y, error, particle="pi+", cos_theta=COSINE) for error in (None, 0.01 * y))
    np.testing.assert_allclose([free.a, free.b, free.deviation], [weighted.a, weighted.b, weighted.deviation])
    assert math.isnan(free.a_error)
    assert math.isnan(free.b_error)
    assert not free.statistical
    assert "no statistical error" in str(free)
    assert "±" not in str(free)
    assert json.loads(json.dumps(free.as_json(), allow_nan=False))["a_error"] is None
    assert weighted.statistical
    assert str(weighted).count("±") == 2
    model = exact("dr", free.a, free.b)
    assert free.deviation == pytest.approx(np.max(np.abs(model / y - 1)), rel=1e-9)


def test_points_without_resolution_are_left_out():
    y = exact("dz", 0.7, 0.4)
    y[:3] = np.nan
    assert fit_form("dz", P, y, particle="pi+", cos_theta=COSINE).points == 16
    assert fit_form("dz", P[:5], y[:5]) is None


def test_mean_powers_of_the_sine():
    assert mean_sine(0.6, 2.0) == pytest.approx(0.64)
    assert mean_sine((-0.5, 0.5), 2.0) == pytest.approx(1 - 0.25 / 3)
    assert mean_sine((-0.9, 0.9), -2.0) == pytest.approx(math.atanh(0.9) / 0.9)
    assert mean_sine([0.0, 0.6], 1.0) == pytest.approx(0.9)


def test_bad_arguments_are_listed_together():
    with pytest.raises(ValueError, match=r"(?s)quantity: got 'q'.*shapes \(2,\), \(1,\).*positive momenta"):
        fit_form("q", [0.0, 1.0], [1.0])
